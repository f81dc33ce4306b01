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
Choose the headings of cameras with a frustum: yaw and pitch, scored on the observed cloud.

Each camera has a goal heading and rotates towards it in each time step. The search takes one
camera after the other at its target position. It minimises the depth error of the observed cloud
from all cameras together, less a bonus for unseen air. The bonus decreases to 0 during the
episode, as in the choice of positions. So a rig that faces a wall looks around first.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, Frustum
from ocp_ros.geometry.packed_bits import count_bits
from ocp_ros.geometry.visibility import FAST
from ocp_ros.online.partial_map import exploration_bonus, KeptModel, LookHistory, PartialMap
from ocp_ros.online.rig_state import AIR_RADIUS_M, directions, RigState
from ocp_ros.rig.motion import turned_towards, way_between
from ocp_ros.rig.rig_file import Rig
from ocp_ros.scenes.scene import SceneError
from ocp_ros.simulation.simulator import View

#: Points and depth-map rows of the model.
POINTS, ROWS = 12000, 64
#: Number of yaws and largest number of pitches of the candidate headings.
YAWS, PITCHES = 12, 3
#: Radians: steps of the local search around the best candidate.
FINE_STEPS = np.deg2rad([15.0, 7.5])
#: Number of passes over all cameras.
PASSES = 2


def never() -> bool:
    """Return False: the computation is never interrupted."""
    return False


class Goal(NamedTuple):
    """
    Goal heading of a camera, and its view there.

    :ivar heading: (3,) yaw, pitch, roll in radians.
    """

    heading: np.ndarray
    view: View


class HeadingPlanner:
    """
    Choose the headings of cameras at each time step of an episode.

    :param models: camera models of the K movable cameras, then of the F fixed ones.
    :param movable: K.
    :param pitch: radians, smallest and largest pitch; positive is down.
    :param wall_margin: cameras stay this far inside the observed bounding box, metres.
    :ivar aimed: numbers of the movable cameras that are not omnidirectional; all other cameras
        keep their headings.
    """

    def __init__(self, models: Sequence[CameraModel], movable: int, pitch: tuple[float, float],
                 wall_margin: float) -> None:
        self._range = max(model.max_range for model in models)
        self._pitch, self._wall_margin = pitch, wall_margin
        self.aimed = [k for k in range(movable) if not models[k].omnidirectional]
        self._directions = directions(pitch, YAWS, PITCHES)
        self.reset()

    @classmethod
    def of(cls, rig: Rig | None, wall_margin: float) -> 'HeadingPlanner | None':
        """Create one for a rig; None without a rig or if all cameras are omnidirectional."""
        if rig is None:
            return None
        made = cls(rig.models, len(rig.cameras), rig.pitch, wall_margin)
        return made if made.aimed else None

    def reset(self) -> None:
        """Discard the state of the last episode."""
        self._memory = LookHistory()
        self._kept = KeptModel(self._range, self._wall_margin, POINTS, ROWS, AIR_RADIUS_M)
        #: (K + F, 3) yaw, pitch, roll in radians: the goal headings of all cameras.
        self._headings: np.ndarray | None = None
        #: The time step for which goals were computed in advance.
        self._ahead: int | None = None

    def __call__(self, cloud: np.ndarray, rig_state: RigState, targets: np.ndarray,
                 max_turn: float, turn: int, turns: int, hint: np.ndarray | None = None
                 ) -> np.ndarray:
        """
        Choose the headings of the cameras at their target positions.

        :param cloud: (N, 3) float32, metres, map frame: the observed cloud.
        :param rig_state: current state of the cameras.
        :param targets: (K + F, 3) metres: target positions.
        :param max_turn: largest rotation of a camera in a time step, radians.
        :param turn: time steps taken so far.
        :param turns: time steps of the whole episode.
        :param hint: (K, 3) radians, headings that a planner proposes. The search starts from them
            if they have a better objective value than the last goals.
        :returns: (K + F, 3) yaw, pitch, roll in radians. A pitch that started outside the limits
            may still be outside them.
        """
        self._memory.visit(rig_state.placement, rig_state.lenses)
        if self._ahead != turn:
            self.think(cloud, rig_state, targets, max_turn, turn, turns, hint)
        self._ahead = None
        return turned_towards(rig_state.placement[:, 3:], self._headings, max_turn)

    def think(self, cloud: np.ndarray, rig_state: RigState, targets: np.ndarray, max_turn: float,
              turn: int, turns: int, hint: np.ndarray | None = None,
              interrupted: Callable[[], bool] = never) -> None:
        """
        Compute the goal headings; those computed in advance are used when their step comes.

        :param rig_state: the cameras at that time step; see :meth:`__call__` for all else.
        :param interrupted: returns whether to stop and use the best goals found so far.
        """
        now = rig_state.placement[:, 3:]
        try:
            model, _ = self._kept(cloud, rig_state.placement[:rig_state.movable, :3], FAST,
                                  clearance=0.0)
        except SceneError:
            goals = self._swept(now, max_turn)
        else:
            goals = self._goals(model, rig_state, targets, max_turn, turn, turns, hint,
                                interrupted)
        self._headings, self._ahead = goals, turn

    def _swept(self, now: np.ndarray, max_turn: float) -> np.ndarray:
        """Rotate cameras to the left by one step: the cloud is too small for a search."""
        goals = now.copy()
        goals[self.aimed, 0] += max_turn
        goals[self.aimed, 1] = np.clip(goals[self.aimed, 1], *self._pitch)
        return goals

    def _goals(self, model: PartialMap, rig_state: RigState, targets: np.ndarray, max_turn: float,
               turn: int, turns: int, hint: np.ndarray | None,
               interrupted: Callable[[], bool]) -> np.ndarray:
        """Search goal headings that the cameras reach before the episode ends."""
        now, reach = rig_state.placement[:, 3:], max_turn * max(turns - turn, 1)
        sought = _Search(model, self._memory.unseen(model), targets, rig_state.lenses,
                         self._begun(now, self._headings, reach))
        sought.price(exploration_bonus(turn / turns), self.aimed, self._directions)
        if hint is not None:
            sought.begin(self._begun(now, hint, reach))
        choices = {camera: self._choices(sought.goals[camera].heading, now[camera], reach)
                   for camera in self.aimed}
        for _ in range(PASSES):
            for camera in np.roll(self.aimed, turn):
                if interrupted():
                    break
                value = sought.beside(camera)
                sought.best(camera, choices[camera], value)
                for step in FINE_STEPS:
                    near = _around(sought.goals[camera].heading, step)
                    sought.best(camera, self._allowed(near, now[camera], reach), value)
        return np.array([goal.heading for goal in sought.goals])

    def _begun(self, now: np.ndarray, goals: np.ndarray | None, reach: float) -> np.ndarray:
        """Return the first headings of the search: given goals, limited to what is in reach."""
        begun = now.copy()
        if goals is not None:
            begun[self.aimed, :2] = goals[self.aimed, :2]
        begun[self.aimed, 1] = np.clip(begun[self.aimed, 1], *self._pitch)
        return turned_towards(now, begun, reach)

    def _choices(self, goal: np.ndarray, now: np.ndarray, reach: float) -> np.ndarray:
        """List the candidate headings of one camera: (H, 3) radians."""
        level = self._directions[:YAWS] * [1.0, 0.0, 0.0] + [0.0, goal[1], 0.0]
        grid = np.concatenate([level, self._directions]) + [goal[0], 0.0, now[2]]
        return self._allowed(grid, now, reach)

    def _allowed(self, headings: np.ndarray, now: np.ndarray, reach: float) -> np.ndarray:
        """Return the headings within the pitch limits and within reach."""
        low, high = self._pitch
        inside = (headings[:, 1] >= low) & (headings[:, 1] <= high)
        return headings[inside & (np.linalg.norm(way_between(now, headings), axis=-1) <= reach)]


class _Search:
    """
    Search goal headings for one camera after the other.

    :param model: partial map of the observed cloud.
    :param unseen: packed bits of the model's cells that no camera has covered.
    :param targets: (C, 3) metres.
    :param lenses: frusta of the cameras.
    :param headings: (C, 3) radians, the first goals.
    """

    def __init__(self, model: PartialMap, unseen: np.ndarray, targets: np.ndarray,
                 lenses: Sequence[Frustum], headings: np.ndarray) -> None:
        self._model, self._unseen, self._weight = model, unseen, 0.0
        self._targets, self._lenses = targets, lenses
        self._views: dict[tuple, View] = {}
        self.goals = self._goals(headings)

    def _goals(self, headings: np.ndarray) -> list[Goal]:
        """Return the goals for headings (C, 3) of all cameras."""
        return [Goal(heading, *self._look(camera, heading[None]))
                for camera, heading in enumerate(headings)]

    def price(self, curiosity: float, cameras: Sequence[int], headings: np.ndarray) -> None:
        """
        Compute the bonus for each covered unseen cell.

        The bonus is divided by the mean number of cells in a view, not by the number of all unseen
        cells: points already observed stay observed, so a view elsewhere costs nothing.

        :param curiosity: bonus for a view whose cells are all unseen, in multiples of the depth
            error without any visible point.
        :param cameras: numbers of the cameras whose views are averaged.
        :param headings: (H, 3) radians, directions all around.
        """
        if curiosity:
            counts = [int(count_bits(view.covered)) for camera in cameras
                      for view in self._look(camera, headings)]
            self._weight = curiosity * self._model.depth_error.worst / max(np.mean(counts), 1.0)

    def begin(self, headings: np.ndarray) -> None:
        """Replace the goals by headings (C, 3) if these have a better objective value."""
        goals = self._goals(headings)
        if self._worth(goals) < self._worth(self.goals):
            self.goals = goals

    def _worth(self, goals: list[Goal]) -> float:
        """Return the objective value of all goals together, metres; less is better."""
        views = [goal.view for goal in goals]
        together = self._model.together(views)
        return self._model.depth_error(together.seen) - self._bonus(together, views[0])

    def _look(self, camera: int, headings: np.ndarray) -> list[View]:
        """Return the views of a camera with headings (H, 3), computed once and then cached."""
        keys = [(camera, *heading.tolist()) for heading in headings]
        new = [k for k, key in enumerate(keys) if key not in self._views]
        if new:
            views = self._model.look_many(
                self._targets[camera], headings[new], self._lenses[camera])
            self._views.update(zip([keys[k] for k in new], views, strict=True))
        return [self._views[key] for key in keys]

    def beside(self, camera: int) -> Callable[..., float]:
        """
        Return a function that computes the objective value of a view with those of other cameras.

        :returns: a function of a view and of ``most``, metres; above it, any larger value may be
            returned.
        """
        others = self._model.together([
            goal.view for k, goal in enumerate(self.goals) if k != camera])
        error_with = self._model.depth_error.given(others.seen)

        def value(view: View, most: float) -> float:
            bonus = self._bonus(others, view)
            return error_with(view.seen, most + bonus) - bonus

        return value

    def best(self, camera: int, headings: np.ndarray, value: Callable[..., float]) -> None:
        """
        Set the goal of a camera to the best of its current goal and some headings.

        :param headings: (H, 3) radians.
        :param value: of :meth:`beside`.
        """
        least, best = np.inf, self.goals[camera]
        for heading, view in [best, *zip(headings, self._look(camera, headings), strict=True)]:
            found = value(view, least)
            if found < least:
                least, best = found, Goal(heading, view)
        self.goals[camera] = best

    def _bonus(self, others: View, view: View) -> float:
        """Return the bonus for the unseen cells that views cover together, metres."""
        if not self._weight:
            return 0.0
        return self._weight * int(count_bits((others.covered | view.covered) & self._unseen))


def _around(heading: np.ndarray, step: float) -> np.ndarray:
    """Return four headings (4, 3): yaw or pitch changed by plus or minus a step, radians."""
    return heading + step * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
