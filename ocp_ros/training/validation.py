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

"""Evaluate policies and planners in validation or test rooms."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from ocp_ros.online.online_planner import Online, settings_of
from ocp_ros.online.rollout import play
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.policy.learned import planned_by
from ocp_ros.policy.policy import make_policy, Policy, ValuePolicy
from ocp_ros.rig.motion import bounded_moves
from ocp_ros.search.registry import PLANNERS
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import make_problem, Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.training.training_config import RoomsConfig, TrainingConfig
from ocp_ros.training.training_rooms import make_scene, room_names
from ocp_ros.util.worker_pool import WorkerPool

#: Name of the baseline that moves the cameras at random.
RANDOM_MOVES = 'random_moves'


@dataclass(frozen=True)
class ValidationTrial:
    """
    The settings of one episode, in which a policy or planner is evaluated.

    :ivar room: name of the room; see :mod:`ocp_ros.training.training_rooms`.
    :ivar rooms: options for making the room.
    :ivar rotation: rotation of the room about the vertical axis, degrees.
    :ivar simulation: the rig, and the engine that computes the depth error.
    :ivar seed: random seed of the start positions and of random choices.
    :ivar planner: name of an online planner, or ``random_moves``; unused if there are weights.
    :ivar weights: weights of the policy to evaluate, as one blob; empty for none.
    """

    room: str
    rooms: RoomsConfig
    rotation: float
    simulation: SimulationConfig
    seed: int = 0
    planner: str = RANDOM_MOVES
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
    if trial.weights:
        planner: Online = planned_by(policy_of(trial.weights), settings)
    elif trial.planner == RANDOM_MOVES:
        planner = RandomMoves(*settings)
    else:
        planner = PLANNERS[trial.planner].make(trial.simulation.episode, problem.rig, rng)
    episode = Episode(problem, np.random.default_rng([trial.seed, 0]))
    errors = play(planner, episode).depth_error
    return float(errors[0]), float(errors[-1]), float(episode.turn.space_coverage)


@lru_cache(maxsize=32)
def _cached_problem(rooms: RoomsConfig, room: str, rotation: float, config: SimulationConfig
                    ) -> Problem:
    """Return the problem of a room, rotated by degrees; the latest 32 problems are cached."""
    return make_problem(make_scene(rooms, room, rotation), config)


@lru_cache(maxsize=1)
def policy_of(weights: bytes) -> Policy | ValuePolicy:
    """Return the policy of some weights, which are one blob; the latest policy is cached."""
    return make_policy(Checkpoint.from_bytes(weights))


def trials_of(config: TrainingConfig, part: str) -> list[ValidationTrial]:
    """
    Return one trial for each room of a set; without a rig file, with at most 4 cameras.

    The rotations of the settings alternate between rooms.

    :param config: settings of the training run.
    :param part: ``training``, ``validation`` or ``test``.
    """
    rooms, simulation = config.rooms, config.simulation
    if not simulation.rig_file:
        rig = replace(simulation.rig, cameras=min(4, simulation.rig.cameras))
        simulation = replace(simulation, rig=rig)
    return [ValidationTrial(room, rooms, rooms.angles[index % len(rooms.angles)], simulation,
                            seed=index)
            for index, room in enumerate(room_names(rooms, part))]


def evaluate(pool: WorkerPool, trials: Sequence[ValidationTrial], weights: bytes = b''
             ) -> dict[str, float]:
    """
    Run episodes in parallel, and return their mean results.

    :param pool: the worker pool that runs the episodes.
    :param trials: the settings of the episodes.
    :param weights: weights of the policy to evaluate, as one blob; empty: each trial runs its own
        weights or, without any, its own planner.
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
