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

"""
One turn of an online planner: observe, plan, apply constraints, choose headings; and its gain.

``policy_node``, ``ocp plan`` with an online planner and the benchmark all use this step. The last
two play simulated episodes: they repeat the step.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
import time
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.visibility import FINE
from ocp_ros.online.constraint_filter import StepConstraints
from ocp_ros.online.heading_planner import HeadingPlanner, never_interrupted
from ocp_ros.online.online_planner import Online, PlannedTurn
from ocp_ros.online.partial_map import PartialMap
from ocp_ros.online.rig_state import Command, RigState
from ocp_ros.rig.motion import turned_towards
from ocp_ros.rig.rig_file import Rig
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.simulation_config import EpisodeLimits


class OnlineStep:
    """
    Choose the next command for a rig from the observed cloud.

    :param planner: chooses the moves.
    :param limits: limits of the rig in one turn.
    :param rig: the rig with its constraints; None without constraints.
    :param report: called with a message after an error; the cameras then keep their poses. None to
        raise the error.
    :param at_once: see :class:`~ocp_ros.online.online_planner.Online`; it holds for each planner.
    :ivar constraints: correct the moves of the planner.
    :ivar aim: chooses the headings where the planner has none; None if no camera has a heading to
        choose.
    """

    def __init__(self, planner: Online, limits: EpisodeLimits, rig: Rig | None = None,
                 report: Callable[[str], None] | None = None, at_once: bool = False) -> None:
        self._at_once, self._report = at_once, report
        self.planner, self.limits = planner, limits
        self.constrain(rig)
        #: The turn to prepare while the cameras move.
        self._next_turn: PlannedTurn | None = None

    def constrain(self, rig: Rig | None) -> None:
        """Apply the constraints of a rig from now on; None for none."""
        # A free rig has no constraints and no headings to choose.
        self.rig = rig = None if rig is None or rig.free else rig
        self.constraints = StepConstraints(self.limits, rig)
        self.aim = HeadingPlanner.of(rig, self.limits.wall_margin)
        self._use(self.planner, self.limits)

    def change(self, planner: Online, limits: EpisodeLimits) -> None:
        """Replace the planner and the limits during an episode."""
        if self.limits.wall_margin != limits.wall_margin:
            self.aim = HeadingPlanner.of(self.rig, limits.wall_margin)
        self._use(planner, limits)
        self.constraints.set_limits(limits)

    def _use(self, planner: Online, limits: EpisodeLimits) -> None:
        """Plan by a planner from now on, within the constraints of the rig."""
        self.planner, self.limits = planner, limits
        planner.at_once = self._at_once
        planner.limit_to(self.constraints.filter and self.constraints.filter.allowed)

    def reset(self) -> None:
        """Discard the state of the last episode."""
        self._next_turn = None
        self.planner.reset()
        self.constraints.reset()
        if self.aim is not None:
            self.aim.reset()

    def __call__(self, cloud: np.ndarray, state: RigState, turn: int, turns: int,
                 interrupted: Callable[[], bool] = never_interrupted) -> Command:
        """
        Return the command for the next turn.

        :param cloud: (M, 3) float32, metres, map frame: the observed cloud.
        :param state: current state of the cameras.
        :param turn: turns taken so far.
        :param turns: turns of the whole episode.
        :param interrupted: as for :meth:`plan_ahead`.
        """
        # No effect if the caller did this while the cameras moved.
        self.plan_ahead(interrupted)
        with self._interrupted_by(interrupted):
            moves = self.plan(cloud, state, turn, turns)
        placement = state.placement.copy()
        targets, held = self.constraints(cloud, state, moves)
        placement[:state.movable, :3] = targets
        headings = self._choose_headings(cloud, state, placement[:, :3], turn, turns, interrupted)
        for camera, heading in headings.items():
            placement[camera, 3:] = heading
        can_prepare = self.planner.plans_ahead(turns) and turn + 1 < turns
        if can_prepare and len(cloud) and self.rig is not None:
            self._next_turn = PlannedTurn(cloud.copy(), placement[:state.movable, :3], turn + 1,
                                          turns, state._replace(placement=placement))
        return Command(placement, list(headings), held)

    def plan(self, cloud: np.ndarray, state: RigState, turn: int, turns: int) -> np.ndarray:
        """Return the planner's moves (K, 2) of K cameras, metres; 0 after a reported error."""
        positions = state.placement[:state.movable, :3]
        self.planner.set_rig_state(state)
        # Planners handle a cloud that is too small. After any other error a node must continue.
        with self._report_errors('planner', 'where they are'):
            moves = self.planner.move(cloud, positions, turn, turns)
            if not np.isfinite(moves).all():
                raise ValueError('moves of NaN or inf')
            return moves
        # Reached only after a reported error.
        return np.zeros((state.movable, 2))

    def plan_ahead(self, interrupted: Callable[[], bool] = never_interrupted) -> None:
        """
        Compute plan, feasible region and headings of the next step while the cameras move.

        The call is optional: without it, the next turn computes the same results.

        :param interrupted: called often; returns whether to stop and use the best results so far,
            because the next turn waits for them.
        """
        with self._interrupted_by(interrupted), self._report_errors('planner', 'where they are'):
            self.planner.plan_ahead()
        if self._next_turn is None:
            return
        cloud, positions, turn, turns, state = self._next_turn
        self._next_turn = None
        self.constraints.prepare(cloud, positions)
        if (self.aim is None or not self.limits.max_turn
                or self.planner.headings is not None):
            return
        targets = state.placement[:, :3].copy()
        with self._report_errors('aiming', 'turned as they are'):
            targets[:state.movable, :2] = self.planner.goals(positions)
            self.aim.think(cloud, state, targets, self.limits.max_turn, turn, turns, interrupted)

    def _choose_headings(self, cloud: np.ndarray, state: RigState, targets: np.ndarray, turn: int,
                         turns: int, interrupted: Callable[[], bool]) -> dict[int, np.ndarray]:
        """Return the next headings (3,), radians, by the numbers of the cameras that rotate."""
        if self.aim is None or not self.limits.max_turn:
            return {}
        planned = self.planner.headings
        if planned is not None:
            headings = turned_towards(
                state.placement[:state.movable, 3:], planned, self.limits.max_turn)
            return {camera: headings[camera] for camera in self.aim.aimed}
        with self._report_errors('aiming', 'turned as they are'):
            headings = self.aim(cloud, state, targets, self.limits.max_turn, turn, turns,
                                interrupted)
            return {camera: headings[camera] for camera in self.aim.aimed}
        # Reached only after a reported error.
        return {}

    @contextmanager
    def _interrupted_by(self, interrupted: Callable[[], bool]) -> Iterator[None]:
        """Let the planner stop in the block as soon as a function returns True."""
        self.planner.interrupted = interrupted
        yield
        self.planner.interrupted = never_interrupted

    @contextmanager
    def _report_errors(self, source: str, pose: str) -> Iterator[None]:
        """Report an error and continue after the block; without ``report`` raise the error."""
        try:
            yield
        except Exception as error:
            if self._report is None:
                raise
            self._report(f'{source}: found {type(error).__name__}: {error}; cameras stay {pose}')


def state_of(episode: Episode) -> RigState:
    """Return the current state of an episode's rig, fixed cameras included."""
    problem, rig = episode.problem, episode.problem.rig
    # An episode may place only the first cameras of the rig.
    movable = len(episode.turn.positions)
    models = (*problem.models[:movable], *problem.models[len(rig.cameras):])
    return RigState(episode.placement, models, movable, rig.pitch, clearance=rig.clearance)


@dataclass(frozen=True)
class Outcome:
    """
    Result of the rollout of an episode with K movable cameras; T turns were taken.

    :ivar trajectory: (T + 1, K, 3) metres: positions of the cameras, the start first.
    :ivar depth_error: (T + 1,) metres, of the start and of the placement after each turn.
    :ivar seconds: (T,) duration of the computation of each command.
    """

    trajectory: np.ndarray
    depth_error: np.ndarray
    seconds: np.ndarray


def play(online: Online, episode: Episode, should_stop: Callable[[int], bool] = lambda turn: False,
         clock: Callable[[], float] = time.perf_counter) -> Outcome:
    """
    Run an episode to its end; the cameras of a rig file satisfy all constraints of the file.

    :param online: the planner that moves the cameras; it is reset first.
    :param episode: an episode before its first turn.
    :param should_stop: gets the number of turns taken, and returns whether to end the
        episode early.
    :param clock: returns the current time, seconds.
    """
    config, rig = episode.config, episode.problem.rig
    step = OnlineStep(online, config, rig)
    step.reset()
    turn_states, seconds = [episode.turn], []
    while not (episode.turn.truncated or should_stop(episode.turn.step)):
        state, cloud = state_of(episode), episode.observed_cloud
        start_time = clock()
        command = step(cloud, state, episode.turn.step, config.turns)
        seconds.append(clock() - start_time)
        moves = (command.placement - state.placement)[:state.movable, :3]
        turn_states.append(episode.move(moves, command.placement[:state.movable, 3:]))
    return Outcome(np.array([turn.positions for turn in turn_states]),
                   np.array([turn.depth_error for turn in turn_states]), np.array(seconds))


class ExpectedGain(NamedTuple):
    """
    The depth error of the observed cloud before and after moves; unseen space is not included.

    :ivar before: metres, with the cameras at their current poses.
    :ivar after: metres, with the cameras at their targets.
    """

    before: float
    after: float

    @classmethod
    def of(cls, cloud: np.ndarray, state: RigState, placement: np.ndarray, max_range: float
           ) -> 'ExpectedGain':
        """
        Compute both errors on the observed cloud.

        :param cloud: (M, 3) float32, metres, map frame: the observed cloud.
        :param state: current state of the cameras.
        :param placement: (K + F, 6) metres and radians: the K movable and F fixed cameras after
            the moves.
        :param max_range: effective range of the omnidirectional cameras, metres.
        :raises SceneError: if the points are too few or too flat to be a room.
        """
        # An operator waits for the result, so the model has few points, and the depth maps of the
        # error have few rows. The maps of visibility are other maps, with the size in ``FINE``.
        model = PartialMap(cloud, state.placement[:, :3], max_range, max_points=12000, rows=64,
                           settings=FINE)

        def error(poses: np.ndarray) -> float:
            return model.error([model.look(pose, lens)
                                for pose, lens in zip(poses, state.lenses, strict=True)])

        return cls(error(state.placement), error(placement))

    def __str__(self) -> str:
        """Return the comparison as a sentence."""
        if not self.after < self.before:
            return ('expected: no gain in the part of the room that has been seen so far; these '
                    'moves look at the rest')
        share = 1.0 - self.after / self.before
        return (f'expected: {100.0 * share:.0f} % of what is missing in the part of the room that '
                'has been seen so far is gone')
