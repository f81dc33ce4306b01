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
Online planners: they move cameras turn by turn, without a scan of the room.

Their input is the observed cloud, as a :class:`~ocp_ros.online.partial_map.PartialMap`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from ocp_ros.online.heading_planner import never_interrupted
from ocp_ros.online.partial_map import LookHistory
from ocp_ros.online.rig_state import clearance_of, record_views, RigState
from ocp_ros.rig.free_plane import CLEARANCE, FreePlane
from ocp_ros.rig.motion import bounded_moves, towards
from ocp_ros.rig.rig_file import Rig
from ocp_ros.scenes.scene import SceneError
from ocp_ros.simulation.simulation_config import EpisodeConfig
from scipy.optimize import linear_sum_assignment

#: In episodes of at least this number of turns, plans are computed while the cameras move, on
#: the cloud before the move. In a shorter episode the older cloud would make plans too bad.
MIN_PIPELINED_TURNS = 20


#: A function of the observed cloud (M, 3), the positions (K, 3) of the cameras and places (P, 3),
#: metres: it returns which of these the constraints of the rig allow, (P,) bool.
Allowed = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def matched(positions: np.ndarray, targets: np.ndarray, kinds: np.ndarray | None = None
            ) -> np.ndarray:
    """
    Assign targets to cameras with the shortest total path.

    :param positions: (K, 3) metres, current positions of the cameras.
    :param targets: (K, 2) metres.
    :param kinds: (K,) kind of camera k and of target k: a camera gets a target of its kind; None
        if all are of one kind.
    :returns: (K,) the number of the target of each camera.
    """
    costs = np.linalg.norm(positions[:, None, :2] - targets[None], axis=2)
    if kinds is not None:
        # A target of another kind costs 1,000 km, which forbids it.
        costs = costs + np.where(kinds[:, None] == kinds[None], 0.0, 1e6)
    return linear_sum_assignment(costs)[1]


def standing(positions: np.ndarray, rig_state: RigState | None) -> np.ndarray:
    """
    Return the poses of cameras at given positions with their current headings.

    :param positions: (K, 3) metres, of the K movable cameras.
    :param rig_state: current state of the rig; None for omnidirectional cameras.
    :returns: (K, 6) metres and radians.
    """
    if rig_state is None:
        return np.hstack([positions, np.zeros_like(positions)])
    return np.hstack([positions, rig_state.placement[:rig_state.movable, 3:]])


def settings_of(episode: EpisodeConfig, rig: Rig, rng: np.random.Generator) -> tuple:
    """Return the constructor arguments of :class:`Online` for a rig and an episode."""
    return rng, episode.max_step, rig.farthest, episode.wall_margin, episode.clearance


class Online(ABC):
    """
    A planner whose only input is the observed cloud.

    :param rng: the only source of random numbers.
    :param max_step: farthest a camera moves in one turn, metres.
    :param max_range: effective range of the omnidirectional cameras, metres.
    :param wall_margin: cameras stay this far inside the observed bounding box, metres.
    :param clearance: cameras stay this far from all observed points, metres.
    :ivar targets: (K, 2) metres, final positions of K movable cameras in the plan; None before
        the first turn and for planners without such a plan.
    :ivar headings: (K, 3) radians, headings in the plan; None if a plan has positions alone.
    :ivar interrupted: a function that :meth:`move` and :meth:`plan_ahead` call. It returns whether
        to stop and use the best plan so far, because a command waits for the plan.
    :ivar at_once: whether a command may not wait for a plan on the newest cloud, as with real
        cameras: then the planner plans while the cameras move in an episode of any length, and as
        much as there is time for. Otherwise the work for each turn is fixed, so that commands do
        not depend on the speed of the machine.
    :ivar rig_state: camera models and headings; None if all cameras are omnidirectional.
    :ivar allowed: see :meth:`limit_to`.
    """

    interrupted: Callable[[], bool] = staticmethod(never_interrupted)
    at_once = False
    allowed: Allowed | None = None
    targets: np.ndarray | None = None
    headings: np.ndarray | None = None

    def __init__(self, rng: np.random.Generator, max_step: float, max_range: float,
                 wall_margin: float, clearance: float = CLEARANCE) -> None:
        self.rng = rng
        self.max_step, self.max_range = max_step, max_range
        self.wall_margin, self.clearance = wall_margin, clearance
        self.rig_state: RigState | None = None

    def set_rig_state(self, rig_state: RigState | None) -> None:
        """Set the state of the rig before a turn; None for omnidirectional cameras."""
        self.rig_state = rig_state

    @property
    def directional(self) -> bool:
        """Return whether at least one movable camera is not omnidirectional."""
        return self.rig_state is not None and bool(self.rig_state.aimed)

    def limit_to(self, allowed: Allowed | None) -> None:
        """Limit the feasible region to what ``allowed`` returns; None for no limit."""
        self.allowed = allowed

    def reset(self) -> None:  # noqa: B027
        """Discard the state of the last episode; most planners have none."""

    @abstractmethod
    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """
        Choose the next move of each camera.

        :param cloud: (M, 3) float32, metres, map frame: the observed cloud.
        :param positions: (K, 3) metres: current positions of the cameras.
        :param turn: turns taken so far.
        :param turns: turns of the whole episode.
        :returns: (K, 2) metres, horizontal moves, none longer than ``max_step``.
        """

    def plans_ahead(self, turns: int) -> bool:
        """Return whether an episode of ``turns`` turns plans while the cameras move."""
        return self.at_once or turns >= MIN_PIPELINED_TURNS

    def plan_ahead(self) -> None:  # noqa: B027
        """
        Compute the next plan while the cameras move; most planners do nothing here.

        The call is optional: without it, :meth:`move` computes the same plan.
        """

    def space(self, cloud: np.ndarray, positions: np.ndarray) -> FreePlane:
        """Return the feasible region of cameras at positions (K, 3) in a cloud (M, 3), M >= 1."""
        return FreePlane.around(cloud, positions, self.wall_margin,
                                clearance_of(self.rig_state, self.clearance),
                                self._limit(cloud, positions))

    def _limit(self, cloud: np.ndarray, positions: np.ndarray
               ) -> Callable[[np.ndarray], np.ndarray] | None:
        """Return which places (P, 3) the rig allows in a cloud, as a function; None for all."""
        return None if self.allowed is None else partial(self.allowed, cloud, positions)

    def towards(self, positions: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """
        Return positions moved towards targets by at most ``max_step``.

        :param positions: (K, 3) or (K, 2) metres.
        :param targets: (K, 2) metres.
        :returns: (K, 2) metres.
        """
        return towards(positions[:, :2], targets, self.max_step)

    def goals(self, positions: np.ndarray) -> np.ndarray:
        """Return the planned positions after one step from positions (K, 3): (K, 2) metres."""
        if self.targets is None:
            return positions[:, :2]
        return self.towards(positions, self.targets)

    def random_walk(self, cloud: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Return random moves, for a cloud that is too small for a plan: (K, 2) metres."""
        moves = bounded_moves(self.rng.uniform(-1.0, 1.0, (len(positions), 2)), self.max_step)
        if len(cloud) == 0:
            return moves
        inside = self.space(cloud, positions).inside(positions[:, :2] + moves)
        return self.towards(positions, inside) - positions[:, :2]


class PlannedTurn(NamedTuple):
    """
    A turn whose plan is still to be computed.

    :ivar cloud: (M, 3) float32, metres: the observed cloud.
    :ivar positions: (K, 3) metres, expected positions of the cameras at that turn.
    :ivar turn: turns taken before that turn.
    :ivar turns: turns of the whole episode.
    :ivar rig_state: state of the rig to plan with; None for omnidirectional cameras. A
        :class:`PipelinedPlanner` stores the state before the move, because it does not know the
        headings after the move.
    """

    cloud: np.ndarray
    positions: np.ndarray
    turn: int
    turns: int
    rig_state: RigState | None


class PipelinedPlanner(Online):
    """
    A planner that computes its plan while the cameras move, see :meth:`Online.plans_ahead`.

    Such a plan uses the cloud before the move, and the next turn does not wait for it. The
    first turn has no plan in advance, so it waits for its plan.

    :ivar memory: the cells of the air that the cameras have covered.
    """

    def reset(self) -> None:
        """Discard the state of the last episode."""
        self.memory = LookHistory()
        #: Feasible region at the time of the last plan.
        self._space: FreePlane | None = None
        #: The turn whose plan is computed while the cameras move.
        self._next_turn: PlannedTurn | None = None

    @abstractmethod
    def _think(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> None:
        """
        Compute the plan for a turn; see :meth:`Online.move`.

        :raises SceneError: if the points are too few or too flat to be a room.
        """

    def _scouted(self, cloud: np.ndarray, positions: np.ndarray, goals: np.ndarray, turn: int,
                 turns: int) -> np.ndarray:
        """Return goals (K, 2), metres, in which some cameras may explore instead."""
        return goals

    def goals(self, positions: np.ndarray) -> np.ndarray:
        """Return the planned positions, on paths around obstacles; see :meth:`Online.goals`."""
        if self._space is None or self.targets is None:
            return super().goals(positions)
        return self._space.on_way(positions[:, :2], self.targets, self.max_step)

    def _waits_for_plan(self, turns: int, cameras: int) -> bool:
        """Return whether the present turn waits for a plan on the newest cloud."""
        return not (self.plans_ahead(turns) and self._has_plan(cameras))

    def _has_plan(self, cameras: int) -> bool:
        """Return whether there is a plan for this number of cameras."""
        return self.targets is not None and len(self.targets) == cameras

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Choose the next moves; see :meth:`Online.move`."""
        # Compute the plan for this turn here if no caller did so while the cameras moved.
        self.plan_ahead()
        self._record(positions)
        try:
            if self._waits_for_plan(turns, len(positions)):
                self._think(cloud, positions, turn, turns)
        except SceneError:
            return self.random_walk(cloud, positions)
        goals = self._scouted(cloud, positions, self.goals(positions), turn, turns)
        if turn + 1 < turns and not self._waits_for_plan(turns, len(positions)):
            next_positions = np.column_stack([goals, positions[:, 2]])
            self._next_turn = PlannedTurn(cloud.copy(), next_positions, turn + 1, turns,
                                          self.rig_state)
        return goals - positions[:, :2]

    def _record(self, positions: np.ndarray) -> None:
        """Record the cameras at positions (K, 3), metres, in the turn that begins."""
        record_views(self.memory, positions, self.rig_state)

    def plan_ahead(self) -> None:
        """Compute the plan of the stored turn, if any; see :meth:`Online.plan_ahead`."""
        if self._next_turn is None:
            return
        cloud, positions, turn, turns, rig_state = self._next_turn
        self._next_turn = None
        # Plan with the state that was stored, so that the plan is the same whether or not a newer
        # state has been set since.
        current_state = self.rig_state
        self.rig_state = rig_state
        try:
            self._think(cloud, positions, turn, turns)
        except SceneError:
            # Keep the last plan: the cloud is too small for a new one and will grow.
            pass
        finally:
            self.rig_state = current_state
