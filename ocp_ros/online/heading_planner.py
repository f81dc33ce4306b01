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
Choose the headings of cameras with a frustum: yaw and pitch, judged on the observed cloud.

Each camera has a goal, which it turns towards turn by turn. Goals are sought among directions from
where the cameras go, one camera after the other, for the depth error of the observed cloud that
all cameras leave together, less a bonus for unseen air, which falls to nothing as it does where
positions are judged. So a rig that faces a wall looks around first.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, Frustum
from ocp_ros.geometry.packed_bits import count_bits
from ocp_ros.geometry.visibility import FAST
from ocp_ros.online.partial_map import curiosity, KeptModel, LookHistory, PartialMap
from ocp_ros.online.rig_state import AROUND, directions, RigState
from ocp_ros.rig.motion import turned_towards, way_between
from ocp_ros.rig.rig_file import Rig
from ocp_ros.scenes.scene import SceneError
from ocp_ros.simulation.simulator import View

#: Points and rows of depth maps of the model.
POINTS, ROWS = 12000, 64
#: Yaws and at most how many pitches that are tried.
YAWS, PITCHES = 12, 3
#: Radians: steps of the search around the best of these.
FINER = np.deg2rad([15.0, 7.5])
#: How often each camera is asked.
ROUNDS = 2


def never() -> bool:
    """Tell that nobody waits."""
    return False


class Goal(NamedTuple):
    """
    Where a camera will look, and what it then sees.

    :ivar heading: (3,) yaw, pitch, roll in radians.
    """

    heading: np.ndarray
    view: View


class HeadingPlanner:
    """
    Choose where cameras look, turn after turn of an episode.

    :param models: what the K cameras see that are to be placed, then the F in place.
    :param movable: K.
    :param pitch: radians, the least and the most that cameras look down.
    :param wall_margin: cameras stay this far inside the observed bounding box, metres.
    :ivar aimed: the cameras that are not omnidirectional, by number: the others stay as they are.
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
        """Make one for a rig; None where all cameras are known to be omnidirectional."""
        if rig is None:
            return None
        made = cls(rig.models, len(rig.cameras), rig.pitch, wall_margin)
        return made if made.aimed else None

    def reset(self) -> None:
        """Forget the last episode."""
        self._memory = LookHistory()
        self._kept = KeptModel(self._range, self._wall_margin, POINTS, ROWS, AROUND)
        #: (K + F, 3) yaw, pitch, roll in radians, where all cameras will look.
        self._headings: np.ndarray | None = None
        #: The turn that was thought about before it came.
        self._ahead: int | None = None

    def __call__(self, cloud: np.ndarray, rig_state: RigState, targets: np.ndarray,
                 max_turn: float, turn: int, turns: int, hint: np.ndarray | None = None
                 ) -> np.ndarray:
        """
        Choose how the cameras are turned where they go.

        :param cloud: (N, 3) float32, metres, map frame: the points seen so far.
        :param rig_state: the cameras as they are.
        :param targets: (K + F, 3) metres: where they go.
        :param max_turn: the most that a camera is turned in a turn, radians.
        :param turn: turns played so far.
        :param turns: turns of the whole episode.
        :param hint: (K, 3) radians, how somebody else would turn them; it is taken where it is
            better to begin with.
        :returns: (K + F, 3) yaw, pitch, roll in radians. The pitch of a camera that was outside
            the limits may still be on its way.
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
        Choose where the cameras will look; if that is done before the turn has come, it holds.

        :param rig_state: the cameras as they will be; see :meth:`__call__` for all else.
        :param interrupted: returns whether what was found so far has to do.
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
        """Look farther to the left, for want of a room in which to choose."""
        goals = now.copy()
        goals[self.aimed, 0] += max_turn
        goals[self.aimed, 1] = np.clip(goals[self.aimed, 1], *self._pitch)
        return goals

    def _goals(self, model: PartialMap, rig_state: RigState, targets: np.ndarray, max_turn: float,
               turn: int, turns: int, hint: np.ndarray | None,
               interrupted: Callable[[], bool]) -> np.ndarray:
        """Choose where the cameras will look before the episode ends."""
        now, reach = rig_state.placement[:, 3:], max_turn * max(turns - turn, 1)
        sought = _Search(model, self._memory.unseen(model), targets, rig_state.lenses,
                         self._begun(now, self._headings, reach))
        sought.price(curiosity(turn / turns), self.aimed, self._directions)
        if hint is not None:
            sought.begin(self._begun(now, hint, reach))
        choices = {camera: self._choices(sought.goals[camera].heading, now[camera], reach)
                   for camera in self.aimed}
        for _ in range(ROUNDS):
            for camera in np.roll(self.aimed, turn):
                if interrupted():
                    break
                sought.best(camera, choices[camera])
                for step in FINER:
                    near = _around(sought.goals[camera].heading, step)
                    sought.best(camera, self._allowed(near, now[camera], reach))
        return np.array([goal.heading for goal in sought.goals])

    def _begun(self, now: np.ndarray, goals: np.ndarray | None, reach: float) -> np.ndarray:
        """Return what to begin with: goals that there are, as far as cameras reach them."""
        begun = now.copy()
        if goals is not None:
            begun[self.aimed, :2] = goals[self.aimed, :2]
        begun[self.aimed, 1] = np.clip(begun[self.aimed, 1], *self._pitch)
        return turned_towards(now, begun, reach)

    def _choices(self, goal: np.ndarray, now: np.ndarray, reach: float) -> np.ndarray:
        """List directions all around for one camera: (H, 3)."""
        level = self._directions[:YAWS] * [1.0, 0.0, 0.0] + [0.0, goal[1], 0.0]
        grid = np.concatenate([level, self._directions]) + [goal[0], 0.0, now[2]]
        return self._allowed(grid, now, reach)

    def _allowed(self, headings: np.ndarray, now: np.ndarray, reach: float) -> np.ndarray:
        """Keep what is within the limits and within reach."""
        low, high = self._pitch
        inside = (headings[:, 1] >= low) & (headings[:, 1] <= high)
        return headings[inside & (np.linalg.norm(way_between(now, headings), axis=-1) <= reach)]


class _Search:
    """
    Seek goals for one camera after the other.

    :param model: the engine on what has been seen.
    :param unseen: packed bits of the model's cells that no camera has covered.
    :param targets: (C, 3) metres.
    :param lenses: of the cameras.
    :param headings: (C, 3) radians, to begin with.
    """

    def __init__(self, model: PartialMap, unseen: np.ndarray, targets: np.ndarray,
                 lenses: Sequence[Frustum], headings: np.ndarray) -> None:
        self._model, self._unseen, self._weight = model, unseen, 0.0
        self._targets, self._lenses = targets, lenses
        self._views: dict[tuple, View] = {}
        self.goals = self._goals(headings)

    def _goals(self, headings: np.ndarray) -> list[Goal]:
        """Let cameras look in directions (C, 3)."""
        return [Goal(heading, *self._look(camera, heading[None]))
                for camera, heading in enumerate(headings)]

    def price(self, curiosity: float, cameras: Sequence[int], headings: np.ndarray) -> None:
        """
        Say what covering a cell is worth.

        Nothing is lost by looking elsewhere for some turns: what was seen stays seen. So a look is
        worth by how much of what it covers is unseen, be that small beside all that is.

        :param curiosity: what a look into nothing but unseen air is worth, in errors of seeing
            nothing.
        :param cameras: some of them.
        :param headings: (H, 3) radians, directions all around.
        """
        if curiosity:
            counts = [int(count_bits(view.covered)) for camera in cameras
                      for view in self._look(camera, headings)]
            self._weight = curiosity * self._model.depth_error.worst / max(np.mean(counts), 1.0)

    def begin(self, headings: np.ndarray) -> None:
        """Begin with other directions (C, 3) if they are better together."""
        goals = self._goals(headings)
        if self._worth(goals) < self._worth(self.goals):
            self.goals = goals

    def _worth(self, goals: list[Goal]) -> float:
        """Return what goals are worth together, metres; less is better."""
        views = [goal.view for goal in goals]
        return self._value(self._model.together(views), views[0])

    def _look(self, camera: int, headings: np.ndarray) -> list[View]:
        """Compute what a camera would see in directions (H, 3), or remember it."""
        keys = [(camera, *heading.tolist()) for heading in headings]
        new = [k for k, key in enumerate(keys) if key not in self._views]
        if new:
            views = self._model.look_many(
                self._targets[camera], headings[new], self._lenses[camera])
            self._views.update(zip([keys[k] for k in new], views, strict=True))
        return [self._views[key] for key in keys]

    def best(self, camera: int, headings: np.ndarray) -> None:
        """Let a camera look where it helps most: as it does, or one of some headings (H, 3)."""
        others = self._model.together([
            goal.view for k, goal in enumerate(self.goals) if k != camera])
        least = self._value(others, self.goals[camera].view)
        for heading, view in zip(headings, self._look(camera, headings), strict=True):
            value = self._value(others, view)
            if value < least:
                least, self.goals[camera] = value, Goal(heading, view)

    def _value(self, others: View, view: View) -> float:
        """Return what a view is worth beside what others see, metres; less is better."""
        error = self._model.depth_error(others.seen | view.seen)
        if not self._weight:
            return error
        covered = (others.covered | view.covered) & self._unseen
        return error - self._weight * int(count_bits(covered))


def _around(heading: np.ndarray, step: float) -> np.ndarray:
    """Return four headings (4, 3) beside one, a step in radians away."""
    return heading + step * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
