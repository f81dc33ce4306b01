# Copyright 2026 The ocp_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Evaluate policies in validation or test rooms."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from ocp_ros.online.online_planner import Online, settings_of
from ocp_ros.online.step import play
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.policy.learned import PolicyAlone
from ocp_ros.policy.policy import Policy
from ocp_ros.rig.motion import bounded_moves
from ocp_ros.rooms.scene_source import make_room
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import make_problem, Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.training.encoded_environment import turn_for
from ocp_ros.training.training_config import RoomsConfig, TrainingConfig
from ocp_ros.training.training_rooms import room_names
from ocp_ros.util.worker_pool import WorkerPool

#: Cameras (0: those of the rig file), turns and longest move (metres) of the trials of a run whose
#: episodes are drawn.
DRAWN_TRIALS = ((4, 5, 2.0), (4, 8, 2.0), (4, 30, 0.5), (2, 8, 2.0), (6, 8, 2.0), (0, 8, 2.0))


@dataclass(frozen=True)
class ValidationTrial:
    """
    The settings of one episode, in which a policy is evaluated.

    :ivar room: name of the room; see :mod:`ocp_ros.training.training_rooms`.
    :ivar rooms: options for making the room.
    :ivar rotation: rotation of the room about the vertical axis, degrees.
    :ivar simulation: the rig, and the engine that computes the depth error.
    :ivar seed: random seed of the start positions and of random choices.
    :ivar weights: weights of the policy to evaluate, as one blob; empty for random moves.
    """

    room: str
    rooms: RoomsConfig
    rotation: float
    simulation: SimulationConfig
    seed: int = 0
    weights: bytes = b''


class RandomMoves(Online):
    """An online planner that moves every camera at random."""

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Return random moves (K, 2), metres; the arguments are those of ``Online.move``."""
        return bounded_moves(self.rng.uniform(-1.0, 1.0, (len(positions), 2)), self.max_step)


def play_trial(trial: ValidationTrial) -> tuple[float, float, float]:
    """
    Run one episode, and return its results.

    :returns: depth errors at start and end, metres, and space coverage at the end, cubic metres.
    """
    problem = _cached_problem(trial.rooms, trial.room, trial.rotation, trial.simulation)
    # Planner and episode have one generator each, so the start does not depend on the planner.
    rng = np.random.default_rng([trial.seed, 1])
    settings = settings_of(trial.simulation.episode, problem.rig, rng)
    planner: Online = RandomMoves(*settings)
    if trial.weights:
        planner = PolicyAlone(policy_of(trial.weights), *settings)
    episode = Episode(problem, np.random.default_rng([trial.seed, 0]))
    errors = play(planner, episode).depth_error
    return float(errors[0]), float(errors[-1]), float(episode.turn.space_coverage)


@lru_cache(maxsize=32)
def _cached_problem(rooms: RoomsConfig, room: str, rotation: float, config: SimulationConfig
                    ) -> Problem:
    """Return the problem of a room, rotated by degrees; the latest 32 problems are cached."""
    return make_problem(make_room(room, rotation, **rooms.reading), config)


@lru_cache(maxsize=1)
def policy_of(weights: bytes) -> Policy:
    """Return the policy of some weights, which are one blob; the latest policy is cached."""
    return Policy(Checkpoint.from_bytes(weights))


def trials_of(config: TrainingConfig, part: str) -> list[ValidationTrial]:
    """
    Return one trial for each room of a set; without a rig file, with at most 4 cameras.

    The rotations of the settings alternate between rooms. If the episodes of the run are drawn,
    ``DRAWN_TRIALS`` alternate too.

    :param config: settings of the training run.
    :param part: ``training``, ``validation`` or ``test``.
    """
    rooms, simulation = config.rooms, config.simulation
    if config.episodes.longest_step:
        settings = [_drawn_trial(config, *trial) for trial in DRAWN_TRIALS
                    if trial[0] or config.episodes.rig_file]
    elif simulation.rig_file:
        settings = [simulation]
    else:
        rig = replace(simulation.rig, cameras=min(4, simulation.rig.cameras))
        settings = [replace(simulation, rig=rig)]
    # The second term keeps settings and rotations apart where there are as many of both.
    count = len(settings)
    return [ValidationTrial(room, rooms,
                            rooms.angles[(index // count + index % count) % len(rooms.angles)],
                            settings[index % count], seed=index)
            for index, room in enumerate(room_names(rooms, part))]


def _drawn_trial(config: TrainingConfig, cameras: int, turns: int, max_step: float
                 ) -> SimulationConfig:
    """Return the settings of one of ``DRAWN_TRIALS``; 0 cameras stand for the rig file."""
    simulation = config.simulation
    episode = replace(simulation.episode, turns=turns, max_step=max_step,
                      max_turn=turn_for(max_step, simulation.episode))
    if not cameras:
        return replace(simulation, episode=episode, rig_file=config.episodes.rig_file)
    rig = replace(simulation.rig, cameras=cameras, max_range=4.0)
    return replace(simulation, episode=episode, rig=rig)


def evaluate(pool: WorkerPool, trials: Sequence[ValidationTrial], weights: bytes = b''
             ) -> dict[str, float]:
    """
    Run episodes in parallel, and return their mean results.

    :param pool: the worker pool that runs the episodes.
    :param trials: the settings of the episodes.
    :param weights: weights of the policy to evaluate, as one blob; empty: those of each trial.
    :returns: mean depth error at start and end (metres), their ratio, and mean space coverage at
        the end (cubic metres).
    """
    if weights:
        trials = [replace(trial, weights=weights) for trial in trials]
    start_errors, end_errors, coverages = np.array(list(pool.map(play_trial, trials))).T
    return {'depth_error_start': float(start_errors.mean()),
            'depth_error_end': float(end_errors.mean()),
            'ratio': float(end_errors.mean() / start_errors.mean()),
            'space_coverage_end': float(coverages.mean())}
