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
One time step of a rig that knows only what it has seen: observe, plan, constrain, aim.

``policy_node``, ``ocp plan`` with an online planner and the benchmark all take this step.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.online.constraint_filter import ConstraintFilter
from ocp_ros.online.heading_planner import HeadingPlanner, never
from ocp_ros.online.online_planner import AHEAD, Online, PlannedTurn
from ocp_ros.online.rig_state import clearance_of, RigState
from ocp_ros.rig.free_plane import CLEARANCE, FreePlane
from ocp_ros.rig.motion import kept_inside, towards
from ocp_ros.rig.rig_file import Rig


class Limits(NamedTuple):
    """
    What a rig can do in one time step.

    :ivar max_step: farthest a camera moves, metres.
    :ivar max_turn: farthest a camera rotates, radians; 0 where none does.
    :ivar wall_margin: cameras stay this far inside the observed bounding box, metres.
    :ivar clearance: cameras stay this far from all points that were seen, metres; those of a rig
        file as far as it says.
    """

    max_step: float
    max_turn: float
    wall_margin: float
    clearance: float = CLEARANCE


class Command(NamedTuple):
    """
    Where the cameras go.

    :ivar placement: (K + F, 6) metres, map frame, and radians; cameras in place stay.
    :ivar rotated: numbers of the cameras whose heading is commanded.
    :ivar held: sentences, one for each camera that stays since it may go nowhere.
    """

    placement: np.ndarray
    rotated: list[int]
    held: list[str]


class OnlineStep:
    """
    Choose the next command for a rig from what it has seen.

    :param planner: chooses the moves.
    :param limits: of one time step.
    :param rig: constraints of the cameras; None for those that move freely on a plane.
    :param report: is told in a sentence what failed, and the cameras stay as they are; None to
        raise the error.
    """

    def __init__(self, planner: Online, limits: Limits, rig: Rig | None = None,
                 report: Callable[[str], None] | None = None) -> None:
        self.planner, self.limits, self.rig, self._report = planner, limits, rig, report
        self._filter = None if rig is None else ConstraintFilter(rig, limits.wall_margin)
        self.aim = self._make_aim()
        #: The step that is to be thought about while the cameras move.
        self._next: PlannedTurn | None = None

    def _make_aim(self) -> HeadingPlanner | None:
        """Build what chooses headings; None where all cameras are known to be omnidirectional."""
        if self.rig is None:
            return None
        aim = HeadingPlanner(self.rig.models, len(self.rig.cameras), self.rig.pitch,
                             self.limits.wall_margin)
        return aim if aim.aimed else None

    def change(self, planner: Online, limits: Limits) -> None:
        """Go on with another planner and other limits; what has been seen stays known."""
        before, self.planner, self.limits = self.limits, planner, limits
        if before.wall_margin != limits.wall_margin:
            self.aim = self._make_aim()
            if self._filter is not None:
                self._filter.wall_margin = limits.wall_margin

    def reset(self) -> None:
        """Forget the last episode."""
        self._next = None
        self.planner.reset()
        if self._filter is not None:
            self._filter.reset()
        if self.aim is not None:
            self.aim.reset()

    def __call__(self, cloud: np.ndarray, state: RigState, turn: int, turns: int) -> Command:
        """
        Take one step.

        :param cloud: (M, 3) float32, metres, map frame: the points seen so far.
        :param state: the cameras as they are.
        :param turn: time steps taken so far.
        :param turns: time steps of the whole episode.
        """
        self.reflect()
        moves = self.plan(cloud, state, turn, turns)
        placement = state.placement.copy()
        targets, held = self._constrain(cloud, state, moves)
        placement[:state.movable, :3] = targets
        headings = self._aim(cloud, state, placement[:, :3], turn, turns)
        for camera, heading in headings.items():
            placement[camera, 3:] = heading
        if turns >= AHEAD and turn + 1 < turns and len(cloud) and self._filter is not None:
            self._next = PlannedTurn(cloud.copy(), placement[:state.movable, :3], turn + 1, turns,
                                     state._replace(placement=placement))
        return Command(placement, list(headings), held)

    def plan(self, cloud: np.ndarray, state: RigState, turn: int, turns: int) -> np.ndarray:
        """Show the planner what is; return its moves (K, 2), metres, none where it fails."""
        positions = state.placement[:state.movable, :3]
        self.planner.know(state)
        # Planners know what to do without a room. What else may happen, a node goes on.
        with self._reported('planner', 'where they are'):
            moves = self.planner.move(cloud, positions, turn, turns)
            if not np.isfinite(moves).all():
                raise ValueError('moves of NaN or inf')
            return moves
        return np.zeros((state.movable, 2))

    def reflect(self, interrupted: Callable[[], bool] = never) -> None:
        """
        Think about the next turn while the cameras move: its plan, where they may be, how to aim.

        Who does not call it gets the same answers: the next step makes up for it.

        :param interrupted: tells whether the next turn has waited for too long; then what was
            found so far has to do.
        """
        self.planner.interrupted = interrupted
        with self._reported('planner', 'where they are'):
            self.planner.reflect()
        self.planner.interrupted = never
        if self._next is None:
            return
        (cloud, positions, turn, turns, state), self._next = self._next, None
        self._filter.prepare(cloud, positions)
        if self.aim is None or not self.limits.max_turn:
            return
        targets = state.placement[:, :3].copy()
        with self._reported('aiming', 'turned as they are'):
            targets[:state.movable, :2] = self.planner.goals(positions)
            self.aim.think(cloud, state, targets, self.limits.max_turn, turn, turns,
                           self.planner.headings, interrupted)

    def _constrain(self, cloud: np.ndarray, state: RigState, moves: np.ndarray
                   ) -> tuple[np.ndarray, list[str]]:
        """Bring moves to where cameras may be: targets (K, 3) metres, and who stays and why."""
        positions, limits = state.placement[:state.movable, :3], self.limits
        targets = positions.copy()
        if len(cloud) == 0:
            targets[:, :2] = towards(positions[:, :2], positions[:, :2] + moves, limits.max_step)
            return targets, []
        # Nobody leaves the floor that was seen: beyond a wall one looks through its back.
        plane = FreePlane.around(cloud, positions, limits.wall_margin,
                                 clearance_of(state, limits.clearance))
        targets[:, :2] = plane.moved(positions[:, :2], moves, limits.max_step)
        targets, _ = kept_inside(targets, corners_of(cloud).astype(np.float64),
                                 limits.wall_margin)
        if self._filter is None:
            # A camera with a frustum may stand far outside what it has seen.
            targets[:, :2] = towards(positions[:, :2], targets[:, :2], limits.max_step)
            return targets, []
        found = self._filter(cloud, positions, targets, limits.max_step,
                             state.placement[state.movable:, :3], state)
        return found.targets, found.held

    def _aim(self, cloud: np.ndarray, state: RigState, targets: np.ndarray, turn: int, turns: int
             ) -> dict[int, np.ndarray]:
        """Choose headings (3,) in radians for the cameras that are not omnidirectional."""
        if self.aim is None or not self.limits.max_turn:
            return {}
        with self._reported('aiming', 'turned as they are'):
            headings = self.aim(cloud, state, targets, self.limits.max_turn, turn, turns,
                                self.planner.headings)
            return {camera: headings[camera] for camera in self.aim.aimed}
        return {}

    @contextmanager
    def _reported(self, what: str, how: str) -> Iterator[None]:
        """Report an error and go on behind the block, or raise it where nobody is told."""
        try:
            yield
        except Exception as error:
            if self._report is None:
                raise
            self._report(f'{what}: found {type(error).__name__}: {error}; cameras stay {how}')
