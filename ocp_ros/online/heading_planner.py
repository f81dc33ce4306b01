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

Each camera has a goal heading and rotates towards it in each turn. The search takes one
camera after the other at its target position. It minimises the depth error of the observed cloud
from all cameras together, less a bonus for unseen air. The bonus decreases to 0 during the
episode, as in the choice of positions. So cameras that face a wall rotate away from it first.
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

#: Number of yaws and largest number of pitches of the candidate headings.
YAWS, PITCHES = 12, 3


def never_interrupted() -> bool:
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
    Choose the headings of cameras at each turn of an episode.

    :param models: camera models of the K movable cameras, then of the F fixed ones.
    :param movable: K, the number of movable cameras.
    :param pitch: radians, smallest and largest pitch; positive is down.
    :param wall_margin: cameras stay this far inside the observed bounding box, metres.
    :ivar aimed: numbers of the movable cameras that are not omnidirectional; all other cameras
        keep their headings.
    """

    def __init__(self, models: Sequence[CameraModel], movable: int, pitch: tuple[float, float],
                 wall_margin: float) -> None:
        self._range = max(model.max_range for model in models)
        self._pitch_limits = pitch
        self._wall_margin = wall_margin
        self.aimed = [k for k in range(movable) if not models[k].omnidirectional]
        self._directions = directions(pitch, YAWS, PITCHES)
        self.reset()

    @classmethod
    def of(cls, rig: Rig | None, wall_margin: float) -> 'HeadingPlanner | None':
        """Create a planner for a rig; None without rig or if all cameras are omnidirectional."""
        if rig is None:
            return None
        planner = cls(rig.models, len(rig.cameras), rig.pitch, wall_margin)
        return planner if planner.aimed else None

    def reset(self) -> None:
        """Discard the state of the last episode."""
        self._memory = LookHistory()
        self._kept_model = KeptModel(self._range, self._wall_margin, max_points=12000, rows=64,
                                     air_radius=AIR_RADIUS_M)
        #: (K + F, 3) yaw, pitch, roll in radians: the goal headings of all cameras.
        self._goal_headings: np.ndarray | None = None
        #: The turn for which goals were computed in advance.
        self._computed_turn: int | None = None

    def __call__(self, cloud: np.ndarray, rig_state: RigState, targets: np.ndarray,
                 max_turn: float, turn: int, turns: int,
                 interrupted: Callable[[], bool] = never_interrupted) -> np.ndarray:
        """
        Choose the headings of the cameras at their target positions.

        :param cloud: (N, 3) float32, metres, map frame: the observed cloud.
        :param rig_state: current state of the cameras.
        :param targets: (K + F, 3) metres: target positions.
        :param max_turn: largest rotation of a camera in a turn, radians.
        :param turn: turns taken so far.
        :param turns: turns of the whole episode.
        :param interrupted: as for :meth:`think`.
        :returns: (K + F, 3) yaw, pitch, roll in radians. A pitch that started outside the limits
            may still be outside them.
        """
        self._memory.visit(rig_state.placement, rig_state.lenses)
        if self._computed_turn != turn:
            self.think(cloud, rig_state, targets, max_turn, turn, turns, interrupted)
        self._computed_turn = None
        return turned_towards(rig_state.placement[:, 3:], self._goal_headings, max_turn)

    def think(self, cloud: np.ndarray, rig_state: RigState, targets: np.ndarray, max_turn: float,
              turn: int, turns: int, interrupted: Callable[[], bool] = never_interrupted) -> None:
        """
        Compute and store the goal headings of a turn, also in advance.

        :param rig_state: the cameras at that turn; see :meth:`__call__` for all else.
        :param interrupted: called for each camera; returns whether to stop and use the best goals
            found so far.
        """
        headings = rig_state.placement[:, 3:]
        try:
            # The feasible region is not used here, so it needs no clearance.
            model, _ = self._kept_model(cloud, rig_state.placement[:rig_state.movable, :3], FAST,
                                        clearance=0.0)
        except SceneError:
            self._goal_headings = self._sweep_goals(headings, max_turn)
        else:
            self._goal_headings = self._search_goals(model, rig_state, targets, max_turn, turn,
                                                     turns, interrupted)
        self._computed_turn = turn

    def _sweep_goals(self, headings: np.ndarray, max_turn: float) -> np.ndarray:
        """Return headings (C, 3) rotated to the left, for a cloud too small for a search."""
        goals = headings.copy()
        goals[self.aimed, 0] += max_turn
        goals[self.aimed, 1] = np.clip(goals[self.aimed, 1], *self._pitch_limits)
        return goals

    def _search_goals(self, model: PartialMap, rig_state: RigState, targets: np.ndarray,
                      max_turn: float, turn: int, turns: int, interrupted: Callable[[], bool]
                      ) -> np.ndarray:
        """Return goal headings (C, 3) of C cameras, which reach them before the episode ends."""
        headings = rig_state.placement[:, 3:]
        max_angle = max_turn * max(turns - turn, 1)
        search = _Search(model, self._memory.unseen(model), targets, rig_state.lenses,
                         self._first_goals(headings, self._goal_headings, max_angle))
        search.set_bonus(exploration_bonus(turn / turns), self.aimed, self._directions)
        candidates = {camera: self._candidates(search.goals[camera].heading, headings[camera],
                                               max_angle) for camera in self.aimed}
        # Two passes over all cameras; in each turn another camera is the first one.
        for _ in range(2):
            for camera in np.roll(self.aimed, turn):
                if interrupted():
                    break
                objective = search.objective_of(camera)
                search.improve_goal(camera, candidates[camera], objective)
                # Local search around the best candidate.
                for step in np.deg2rad([15.0, 7.5]):
                    neighbours = _neighbours(search.goals[camera].heading, step)
                    allowed = self._allowed(neighbours, headings[camera], max_angle)
                    search.improve_goal(camera, allowed, objective)
        return np.array([goal.heading for goal in search.goals])

    def _first_goals(self, headings: np.ndarray, goals: np.ndarray | None, max_angle: float
                     ) -> np.ndarray:
        """
        Return the first goal headings (C, 3) of the search.

        :param headings: (C, 3) radians, current headings of all cameras.
        :param goals: (>= K, 3) radians, wanted headings, limited here; None for the current ones.
        :param max_angle: largest rotation of a camera until the end of the episode, radians.
        """
        first_goals = headings.copy()
        if goals is not None:
            first_goals[self.aimed, :2] = goals[self.aimed, :2]
        first_goals[self.aimed, 1] = np.clip(first_goals[self.aimed, 1], *self._pitch_limits)
        return turned_towards(headings, first_goals, max_angle)

    def _candidates(self, goal: np.ndarray, heading: np.ndarray, max_angle: float) -> np.ndarray:
        """Return the candidate headings (H, 3) of a camera with a goal (3,) and a heading (3,)."""
        # All yaws at the pitch of the goal, then the grid of directions; both are relative to the
        # goal's yaw. The roll is that of the camera. The grid begins with all yaws at one pitch.
        at_goal_pitch = self._directions[:YAWS] * [1.0, 0.0, 0.0] + [0.0, goal[1], 0.0]
        grid = np.concatenate([at_goal_pitch, self._directions]) + [goal[0], 0.0, heading[2]]
        return self._allowed(grid, heading, max_angle)

    def _allowed(self, headings: np.ndarray, start: np.ndarray, max_angle: float) -> np.ndarray:
        """Return those headings (H, 3) in the pitch limits and within an angle of a start (3,)."""
        low, high = self._pitch_limits
        is_allowed = (headings[:, 1] >= low) & (headings[:, 1] <= high)
        angles = np.linalg.norm(way_between(start, headings), axis=-1)
        return headings[is_allowed & (angles <= max_angle)]


class _Search:
    """
    Search goal headings for one of C cameras after the other.

    :param model: partial map of the observed cloud.
    :param unseen: packed bits of the model's cells that no camera has covered.
    :param targets: (C, 3) metres, target positions of the cameras.
    :param lenses: frusta of the cameras.
    :param headings: (C, 3) radians, the first goals.
    :ivar goals: the best goal found so far for each camera.
    """

    def __init__(self, model: PartialMap, unseen: np.ndarray, targets: np.ndarray,
                 lenses: Sequence[Frustum], headings: np.ndarray) -> None:
        self._model, self._unseen = model, unseen
        self._targets, self._lenses = targets, lenses
        #: Bonus for each unseen cell that the goals' views cover, metres of depth error.
        self._cell_bonus = 0.0
        #: Views by number and heading of the camera.
        self._views: dict[tuple, View] = {}
        self.goals = self._goals_at(headings)

    def _goals_at(self, headings: np.ndarray) -> list[Goal]:
        """Return the goals for headings (C, 3) of all cameras."""
        return [Goal(heading, *self._views_of(camera, heading[None]))
                for camera, heading in enumerate(headings)]

    def set_bonus(self, bonus: float, cameras: Sequence[int], headings: np.ndarray) -> None:
        """
        Set the bonus for each unseen cell that the goals' views cover.

        The bonus is divided by the mean number of cells in a view. The choice of positions divides
        it by the number of all unseen cells, which is larger while most of the air is unseen. So
        early in an episode a cell counts more here, and cameras rotate away from observed points.
        These points are not lost, because they stay in the observed cloud.

        :param bonus: bonus for a view whose cells are all unseen, in multiples of the depth error
            without any visible point.
        :param cameras: numbers of the cameras whose views are averaged.
        :param headings: (H, 3) radians, directions all around.
        """
        if bonus:
            counts = [int(count_bits(view.covered)) for camera in cameras
                      for view in self._views_of(camera, headings)]
            self._cell_bonus = bonus * self._model.depth_error.worst / max(np.mean(counts), 1.0)

    def _views_of(self, camera: int, headings: np.ndarray) -> list[View]:
        """Return the views of a camera with headings (H, 3), computed once and then cached."""
        keys = [(camera, *heading.tolist()) for heading in headings]
        new = [k for k, key in enumerate(keys) if key not in self._views]
        if new:
            views = self._model.look_many(
                self._targets[camera], headings[new], self._lenses[camera])
            self._views.update(zip([keys[k] for k in new], views, strict=True))
        return [self._views[key] for key in keys]

    def objective_of(self, camera: int) -> Callable[[View, float], float]:
        """
        Return the objective of a camera's view, given the views of the other cameras.

        :returns: a function of a view and of ``max_value``, metres. It returns the objective
            value, metres; if this exceeds ``max_value``, it returns any value above.
        """
        others = self._model.together([
            goal.view for k, goal in enumerate(self.goals) if k != camera])
        error_with = self._model.depth_error.given(others.seen)

        def objective(view: View, max_value: float) -> float:
            bonus = self._bonus(others, view)
            return error_with(view.seen, max_value + bonus) - bonus

        return objective

    def improve_goal(self, camera: int, headings: np.ndarray,
                     objective: Callable[[View, float], float]) -> None:
        """
        Set the goal of a camera to the best of its current goal and some headings.

        :param headings: (H, 3) radians.
        :param objective: the result of :meth:`objective_of`.
        """
        best_value, best = np.inf, self.goals[camera]
        for heading, view in [best, *zip(headings, self._views_of(camera, headings), strict=True)]:
            value = objective(view, best_value)
            if value < best_value:
                best_value, best = value, Goal(heading, view)
        self.goals[camera] = best

    def _bonus(self, others: View, view: View) -> float:
        """Return the bonus for the unseen cells that two views cover together, metres."""
        if not self._cell_bonus:
            return 0.0
        return self._cell_bonus * int(count_bits((others.covered | view.covered) & self._unseen))


def _neighbours(heading: np.ndarray, step: float) -> np.ndarray:
    """Return four headings (4, 3) with yaw or pitch changed by plus or minus a step, radians."""
    return heading + step * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
