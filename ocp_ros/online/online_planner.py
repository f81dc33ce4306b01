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
Planners that know only what has been seen: they move cameras turn by turn, without a scan.

What they know of the room is the observed cloud;
:class:`~ocp_ros.online.partial_map.PartialMap` makes an engine of it.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from ocp_ros.online.heading_planner import never
from ocp_ros.online.partial_map import LookHistory, PartialMap
from ocp_ros.online.rig_state import clearance_of, record_views, RigState
from ocp_ros.rig.free_plane import CLEARANCE, FreePlane
from ocp_ros.rig.motion import bounded_moves, towards
from ocp_ros.rig.rig_file import Rig
from ocp_ros.scenes.scene import SceneError
from ocp_ros.simulation.simulation_config import EpisodeConfig
from scipy.optimize import linear_sum_assignment

#: Metres: no way is worth that a camera takes the place of one of another kind.
UNLIKE = 1e6
#: Share of the turns after which plans are refined: before that too little has been seen.
REFINING = 0.6
#: Turns of an episode from which on plans are made while the cameras move, on what was seen before
#: they did: a turn of many is cheap, one of few is not.
AHEAD = 20


def matched(positions: np.ndarray, targets: np.ndarray, kinds: np.ndarray | None = None
            ) -> np.ndarray:
    """
    Match targets with cameras, so that they walk least.

    :param positions: (K, 3) metres, where the cameras are.
    :param targets: (K, 2) metres, where they shall go.
    :param kinds: (K,) of cameras and of targets: a camera takes one of its kind; None for one
        kind.
    :returns: (K,) the target of each camera.
    """
    way = np.linalg.norm(positions[:, None, :2] - targets[None], axis=2)
    if kinds is not None:
        way = way + np.where(kinds[:, None] == kinds[None], 0.0, UNLIKE)
    return linear_sum_assignment(way)[1]


def standing(positions: np.ndarray, rig_state: RigState | None) -> np.ndarray:
    """Return how cameras at positions (K, 3) stand: (K, 6) metres and radians."""
    if rig_state is None:
        return np.hstack([positions, np.zeros_like(positions)])
    return np.hstack([positions, rig_state.placement[:rig_state.movable, 3:]])


def settings_of(episode: EpisodeConfig, rig: Rig, rng: np.random.Generator) -> tuple:
    """Return what every online planner gets of its rig and its time steps."""
    return rng, episode.max_step, rig.farthest, episode.wall_margin, episode.clearance


class KnownTurn(NamedTuple):
    """
    What is known at a turn.

    :ivar cloud: (M, 3) float32, metres, map frame: the points seen so far.
    :ivar positions: (K, 3) metres: where the cameras are.
    :ivar turn: turns played so far, of so many ``turns``.
    :ivar model: the engine on what has been seen.
    :ivar space: where cameras may be, as far as has been seen.
    :ivar unseen: packed bits of the model's cells of the air that no camera has covered yet.
    """

    cloud: np.ndarray
    positions: np.ndarray
    turn: int
    turns: int
    model: PartialMap
    space: FreePlane
    unseen: np.ndarray


class Online(ABC):
    """
    A planner that knows only what has been seen.

    :param rng: the only source of chance.
    :param max_step: farthest a camera moves in one turn, metres.
    :param max_range: effective range of the omnidirectional cameras, metres.
    :param wall_margin: cameras stay this far inside the observed bounding box, metres.
    :param clearance: cameras stay this far from all points that were seen, metres.
    :ivar targets: (K, 2) metres, where each camera goes in the end; None for planners that do not
        say so, and before the first turn.
    :ivar headings: (K, 3) radians, how the cameras would best be turned there, where a plan says
        so.
    :ivar interrupted: tells, while it thinks about the next turn, whether that has waited for too
        long: then the plan so far has to do.
    """

    interrupted: Callable[[], bool] = staticmethod(never)
    targets: np.ndarray | None = None
    headings: np.ndarray | None = None

    def __init__(self, rng: np.random.Generator, max_step: float, max_range: float,
                 wall_margin: float, clearance: float = CLEARANCE) -> None:
        self.rng, self.max_step, self.max_range = rng, max_step, max_range
        self.wall_margin, self.clearance = wall_margin, clearance
        self.rig_state: RigState | None = None

    def set_rig_state(self, rig_state: RigState | None) -> None:
        """Learn before a turn how the cameras stand and what each sees; None for all around."""
        self.rig_state = rig_state

    @property
    def directional(self) -> bool:
        """Return whether a camera is known not to be omnidirectional."""
        return self.rig_state is not None and bool(self.rig_state.aimed)

    def reset(self) -> None:  # noqa: B027
        """Forget the last episode; most planners remember nothing."""

    @abstractmethod
    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """
        Choose the next move of each camera.

        :param cloud: (M, 3) float32, metres, map frame: the points seen so far.
        :param positions: (K, 3) metres: where the cameras are.
        :param turn: turns played so far.
        :param turns: turns of the whole episode.
        :returns: (K, 2) metres on the plane, none longer than ``max_step``.
        """

    def propose(self, known: KnownTurn) -> np.ndarray:
        """
        Return where the cameras would best be in the end, for another planner to begin with.

        Those that do not say so propose where their next move leads.

        :returns: (K, 6) metres, map frame, and radians.
        """
        positions = known.positions
        placed = standing(positions, self.rig_state)
        placed[:, :2] += self.move(known.cloud, positions, known.turn, known.turns)
        return placed

    def plan_ahead(self) -> None:  # noqa: B027
        """
        Think about the next turn while the cameras move; most planners only answer.

        Who does not call it gets the same answers: :meth:`move` makes up for it.
        """

    def space(self, cloud: np.ndarray, positions: np.ndarray) -> FreePlane:
        """Return where the cameras may be as far as is known; the cloud is not empty."""
        return FreePlane.around(cloud, positions, self.wall_margin,
                                clearance_of(self.rig_state, self.clearance))

    def towards(self, positions: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """
        Go from positions to targets as far as a turn reaches.

        :param positions: (K, 3) or (K, 2) metres.
        :param targets: (K, 2) metres.
        :returns: (K, 2) metres.
        """
        return towards(positions[:, :2], targets, self.max_step)

    def goals(self, positions: np.ndarray) -> np.ndarray:
        """Return where cameras at (K, 3) are by the plan after a turn: (K, 2) metres."""
        if self.targets is None:
            return positions[:, :2]
        return self.towards(positions, self.targets)

    def random_walk(self, cloud: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Move at random, for want of anything to plan with: (K, 2) metres."""
        moves = bounded_moves(self.rng.uniform(-1.0, 1.0, (len(positions), 2)), self.max_step)
        if len(cloud) == 0:
            return moves
        inside = self.space(cloud, positions).inside(positions[:, :2] + moves)
        return self.towards(positions, inside) - positions[:, :2]


class PlannedTurn(NamedTuple):
    """
    A turn to plan for.

    :ivar cloud: (M, 3) float32, metres: the points seen so far.
    :ivar positions: (K, 3) metres, where the cameras will be.
    :ivar turn: turns played by then, of so many ``turns``.
    :ivar rig_state: how the cameras stood when the cloud was seen.
    """

    cloud: np.ndarray
    positions: np.ndarray
    turn: int
    turns: int
    rig_state: RigState | None


class PipelinedPlanner(Online):
    """
    A planner that in an episode of many turns plans while the cameras move.

    Then a plan is of what was seen before they did, and the next cloud is answered at once. The
    first turn is planned for when its cloud is there.

    :ivar memory: what the cameras have looked at.
    """

    def reset(self) -> None:
        """Forget the last episode."""
        self.memory = LookHistory()
        #: Where cameras may be, as far as was known when a plan was made.
        self._space: FreePlane | None = None
        #: The turn that is to be planned for while the cameras move.
        self._next: PlannedTurn | None = None

    @abstractmethod
    def _think(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> None:
        """
        Plan for a turn; see :meth:`Online.move`.

        :raises SceneError: if what has been seen is no room.
        """

    def goals(self, positions: np.ndarray) -> np.ndarray:
        """Go around what is in the way; see :meth:`Online.goals`."""
        if self._space is None or self.targets is None:
            return super().goals(positions)
        return self._space.on_way(positions[:, :2], self.targets, self.max_step)

    def _ahead(self, turns: int) -> bool:
        """Return whether plans are made while the cameras move, in an episode of so many turns."""
        return turns >= AHEAD

    def _waited_for(self, turn: int, turns: int, cameras: int) -> bool:
        """Return whether a turn is planned for when its cloud is there."""
        return not (self._ahead(turns) and self._planned(cameras))

    def _planned(self, cameras: int) -> bool:
        """Return whether there is a plan for so many cameras."""
        return self.targets is not None and len(self.targets) == cameras

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Choose the next moves; see :meth:`Online.move`."""
        self.plan_ahead()
        record_views(self.memory, positions, self.rig_state)
        try:
            if self._waited_for(turn, turns, len(positions)):
                self._think(cloud, positions, turn, turns)
        except SceneError:
            return self.random_walk(cloud, positions)
        goals = self.goals(positions)
        if turn + 1 < turns and not self._waited_for(turn + 1, turns, len(positions)):
            self.plan_later(PlannedTurn(cloud.copy(), np.column_stack([goals, positions[:, 2]]),
                                        turn + 1, turns, self.rig_state))
        return goals - positions[:, :2]

    def plan_later(self, turn: PlannedTurn) -> None:
        """Leave a turn to be planned for while the cameras move."""
        self._next = turn

    def plan_ahead(self) -> None:
        """Make the next plan, where a turn has been left to it; see :meth:`Online.plan_ahead`."""
        if self._next is None:
            return
        (cloud, positions, turn, turns, rig_state), now = self._next, self.rig_state
        self._next, self.rig_state = None, rig_state
        try:
            self._think(cloud, positions, turn, turns)
        except SceneError:
            # The plan so far holds; a cloud that is no room yet will grow.
            pass
        finally:
            self.rig_state = now
