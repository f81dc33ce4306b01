# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Demonstrations: episodes in which an expert says at each turn what it would do.

Who moves the cameras is a mixture: at first the expert, then more and more the policy that learns
from it, so that it also learns to get out of where its own moves lead (DAgger: Ross, Gordon and
Bagnell, 2011). Experts are the greedy step and the other online planners, which know no more than
the policy, and any offline planner, which knows the room and goes straight to its answer.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from stable_baselines3 import SAC
import torch

from ocp_ros.agent.agent_config import AgentConfig
from ocp_ros.agent.move_effects import CHOICES, greedy
from ocp_ros.planners.exact import exact_plane
from ocp_ros.planners.online_planner import Online, shared_out
from ocp_ros.planners.registry import OFFLINE, ONLINE, settings_of
from ocp_ros.planners.rig_methods import EXACT
from ocp_ros.planners.rollout import state_of
from ocp_ros.planners.scorer import Scorer
from ocp_ros.planners.solve import solve
from ocp_ros.scenes.scene import Scene
from ocp_ros.simulation.environment import CameraPlacementEnv
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import plane_of
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.training.augmentation import random_symmetries, turn, turn_observation
from ocp_ros.training.demonstration_rounds import (
    ACTIONS,
    ENDS,
    LAST,
    MOVES,
    NO_INPUTS,
    REWARDS,
)
from ocp_ros.training.encoded_environment import encoded, unwrapped
from ocp_ros.training.training_config import DemonstrationsConfig, RoomsConfig, TrainingConfig
from ocp_ros.training.training_rooms import make
from ocp_ros.training.validation import policy_of


@dataclass(frozen=True)
class DemonstrationTask:
    """
    One episode to play.

    :ivar config: of the run.
    :ivar room: name of the room; see :mod:`ocp_ros.training.training_rooms`.
    :ivar seed: of everything that is drawn.
    :ivar expert_moves: chance that a camera does what the expert says.
    :ivar weights: of the policy that moves the others, as one blob; empty for the expert alone.
    """

    config: TrainingConfig
    room: str
    seed: tuple[int, ...]
    expert_moves: float
    weights: bytes = b''


class Walk(Online):
    """
    Go straight to a placement that was found with the scan at hand.

    :param placement: (K, 2) metres.
    :param settings: of :class:`~ocp_ros.planners.online_planner.Online`.
    """

    def __init__(self, placement: np.ndarray, *settings) -> None:
        super().__init__(*settings)
        self._placement, self._targets = placement, None

    def reset(self) -> None:
        """Forget which camera goes where."""
        self._targets = None

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Choose the next moves; see :meth:`~ocp_ros.planners.online_planner.Online.move`."""
        if self._targets is None:
            self._targets = shared_out(positions, self._placement)
        return self.towards(positions, self._targets) - positions[:, :2]


def expert_of(name: str, simulator: Simulator, config: SimulationConfig, budget: int,
              rng: np.random.Generator, seconds: float = 10.0) -> Online:
    """
    Return who says what to do in a room.

    :param name: of a planner, offline or online, or ``exact``.
    :param simulator: the engine for the room.
    :param config: the episode's rig.
    :param budget: evaluations of an offline planner.
    :param rng: the only source of chance.
    :param seconds: the most time that ``exact`` takes.
    """
    if name in ONLINE:
        return ONLINE[name](config, rng)
    space = plane_of(simulator, config.episode, config.rig.cameras)
    found = exact_plane(simulator, space, budget, seconds) if name == EXACT else solve(
        OFFLINE[name](space, rng, budget), Scorer(simulator), budget)
    return Walk(found.placement[:, :2], *settings_of(config, rng))


def demonstrate(task: DemonstrationTask) -> dict[str, np.ndarray]:
    """
    Play one episode, camera by camera.

    :returns: the inputs of the network at each of S + 1 steps, S being turns x cameras;
        ``expert`` (S + 1, 1, 2), the expert's moves in units of the longest step (none at the
        last); ``actions`` (S + 1, 1, 2), those that were played; ``rewards`` (S + 1,); ``last``
        (S + 1,) bool, the step that is not answered any more; ``ends`` (S + 1, 2), the depth
        error at the end and that of seeing nothing, metres.
    """
    settings, simulation = task.config.demonstrations, task.config.simulation
    rng = np.random.default_rng(task.seed)
    cameras = int(rng.integers(task.config.fewest_cameras, simulation.rig.cameras + 1))
    rotation = float(rng.choice(task.config.rooms.angles))
    scene = _room(task.config.rooms, task.room)
    env: Any = encoded(CameraPlacementEnv(
        [scene], simulation, fewest=task.config.fewest_cameras, rotations=(rotation,)),
        task.config.agent)
    observation, _ = env.reset(seed=int(rng.integers(1 << 31)), options={'cameras': cameras})
    episode = unwrapped(env).episode
    config = replace(simulation, rig=replace(simulation.rig, cameras=cameras))
    expert = Expert(settings, task.config.agent, episode.simulator, config, rng)
    policy: Any = policy_of(task.weights) if task.weights else None
    steps: list[tuple] = []
    truncated = False
    while not truncated:
        told = expert.answer(episode, env.camera, observation)
        played = told
        if policy is not None and rng.random() >= task.expert_moves:
            (played,) = policy.choose(_without_present(observation))
        if rng.random() < settings.stray:
            played = rng.uniform(-0.7, 0.7, 2)
        before = observation
        observation, reward, _, truncated, _ = env.step(played[None])
        steps.append((before, told, played, reward))
    nothing = np.zeros(2)
    steps.append((observation, nothing, nothing, 0.0))
    inputs, told, played, rewards = zip(*steps)
    arrays = {name: np.stack([one[name] for one in inputs]) for name in observation}
    ends = episode.turn.depth_error, episode.simulator.depth_error.worst
    return {**arrays, MOVES: np.array(told, dtype=np.float32)[:, None],
            ACTIONS: np.array(played, dtype=np.float32)[:, None],
            REWARDS: np.array(rewards, dtype=np.float32),
            LAST: np.arange(len(steps)) == len(steps) - 1,
            ENDS: np.broadcast_to(np.array(ends, dtype=np.float32), (len(steps), 2))}


def _without_present(observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return an observation of a single camera, which is there."""
    return {name: value for name, value in observation.items() if name != 'present'}


class Expert:
    """
    Who says what each camera should do.

    :param settings: who it is.
    :param agent: what the policy reads.
    :param simulator: the engine for the room, of which only offline planners know.
    :param config: the episode's rig.
    :param rng: the only source of chance.
    """

    def __init__(self, settings: DemonstrationsConfig, agent: AgentConfig, simulator: Simulator,
                 config: SimulationConfig, rng: np.random.Generator) -> None:
        self._config, self._turn, self._moves = config, -1, np.empty((0, 2))
        # Where the policy reads what moves would change, nothing has to be tried again.
        self._greedy = settings.expert == 'greedy_step' and agent.world
        if not self._greedy:
            self._planner = expert_of(settings.expert, simulator, config, settings.budget, rng,
                                      settings.seconds)
            self._planner.reset()

    def answer(self, episode: Episode, camera: int, observation: dict[str, np.ndarray]
               ) -> np.ndarray:
        """Return a camera's move, (2,) in units of the longest step."""
        longest = self._config.episode.max_step
        if self._greedy:
            # It knows of the cameras before this one; planners answer for all at once.
            return CHOICES[int(np.argmin(greedy(observation)))] / longest
        turn = episode.turn
        if turn.step != self._turn:
            self._turn = turn.step
            if episode.problem.rig is not None:
                self._planner.know(state_of(episode))
            self._moves = self._planner.move(episode.observed_cloud, turn.positions, turn.step,
                                             episode.config.turns) / longest
        return self._moves[camera]


@lru_cache(maxsize=64)
def _room(config: RoomsConfig, name: str) -> Scene:
    """Keep some rooms ready."""
    return make(config, name)


def tasks_of(config: TrainingConfig, rooms: Sequence[str], number: int, weights: bytes
             ) -> list[DemonstrationTask]:
    """
    Return the episodes of a round.

    :param config: of the run.
    :param rooms: names of the training rooms.
    :param number: of the round, from 0.
    :param weights: of the policy so far.
    """
    settings, rng = config.demonstrations, np.random.default_rng([config.seed, number])
    share = 1.0 if number < settings.alone else settings.expert_moves * settings.fading ** number
    return [DemonstrationTask(config, rooms[int(rng.integers(len(rooms)))], (config.seed, number,
                                                                             index),
                              share, weights if number >= settings.alone else b'')
            for index in range(settings.episodes)]


def turns_played(steps: dict[str, np.ndarray]) -> int:
    """Return how many moves of single cameras there are in some rounds."""
    return int(np.count_nonzero(~steps[LAST]))


class Imitation:
    """
    What an expert said, in batches that are turned or mirrored at random.

    :param steps: from :func:`~ocp_ros.training.demonstration_rounds.load_rounds`.
    :param device: where the batches are used.
    """

    def __init__(self, steps: dict[str, np.ndarray], device: torch.device) -> None:
        self._device, answered = device, ~steps[LAST]
        self._inputs = {name: torch.from_numpy(value[answered]) for name, value in steps.items()
                        if name not in NO_INPUTS}
        self._moves = torch.from_numpy(steps[MOVES][answered])

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self._moves)

    def loss(self, actor, rows: torch.Tensor) -> torch.Tensor:
        """Return how far an actor is from what the expert said at some steps (B,)."""
        maps = random_symmetries(len(rows), self._device)
        batch = {name: _ready(value[rows], self._device) for name, value in self._inputs.items()}
        moves, present = actor.moves(turn_observation(batch, maps))
        told = turn(_ready(self._moves[rows], self._device), maps.matrices)
        return (moves.imitation(told) * present).sum() / present.sum()

    def loss_of(self, actor, size: int) -> torch.Tensor:
        """Return the same for steps drawn at random."""
        return self.loss(actor, torch.randint(len(self), (size,)))


def _ready(values: torch.Tensor, device: torch.device) -> torch.Tensor:
    """Put stored numbers where they are used, in full precision; indices stay as they are."""
    return values.to(device, torch.float32) if values.is_floating_point() else values.to(device)


def fit(model: SAC, steps: dict[str, np.ndarray], config: DemonstrationsConfig, epochs: int
        ) -> float:
    """
    Teach SAC's actor to do what the expert did.

    :param model: from :func:`ocp_ros.training.sac.make_sac`.
    :param steps: from :func:`~ocp_ros.training.demonstration_rounds.load_rounds`.
    :param config: batch size and step size.
    :param epochs: how often each step is looked at.
    :returns: the mean loss of the last epoch.
    """
    actor, imitation = model.policy.actor, Imitation(steps, model.device)
    size = min(config.batch_size, len(imitation))
    batches = len(imitation) // size
    optimizer = torch.optim.AdamW(actor.parameters(), config.learning_rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, config.learning_rate, total_steps=epochs * batches + 1)
    actor.set_training_mode(True)
    for _ in range(epochs):
        order, total = torch.randperm(len(imitation)), 0.0
        for number in range(batches):
            loss = imitation.loss(actor, order[number * size:(number + 1) * size])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            total += loss.item()
    actor.set_training_mode(False)
    model._n_updates += epochs * batches
    return total / batches


def fill(model: SAC, steps: dict[str, np.ndarray]) -> None:
    """
    Put the transitions of demonstrations into SAC's replay buffer; the latest if not all fit.

    :param model: from :func:`ocp_ros.training.sac.make_sac`.
    :param steps: from :func:`~ocp_ros.training.demonstration_rounds.load_rounds`.
    """
    buffer, side_by_side = model.replay_buffer, model.n_envs
    inputs = [name for name in steps if name not in NO_INPUTS]
    starts = np.flatnonzero(~steps[LAST])
    count = min(len(starts) // side_by_side, buffer.buffer_size)
    nothing, never = [{}] * side_by_side, np.zeros(side_by_side, dtype=bool)
    # Which of them lie side by side makes no difference: each goes with the step after its own.
    for rows in starts[len(starts) - count * side_by_side:].reshape(count, side_by_side):
        before, after = ({name: steps[name][rows + k] for name in inputs} for k in (0, 1))
        buffer.add(before, after, steps[ACTIONS][rows], steps[REWARDS][rows], never, nothing)
