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

"""State of a rig at a time step, what it can do in one, and what it is commanded to do."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, Frustum
from ocp_ros.online.partial_map import LookHistory, PartialMap
from ocp_ros.rig.free_plane import CLEARANCE
from ocp_ros.simulation.simulator import View

#: Metres around a camera in which there is air to look into, whatever has been seen of it: those
#: that are not omnidirectional know nothing of what is behind them.
AROUND = 2.0
#: How much of the pitches that are allowed one of them stands for, radians.
PITCH_STEP = np.deg2rad(30.0)


class RigState(NamedTuple):
    """
    The cameras of a rig as they stand at a turn: those that may be moved, then those in place.

    :ivar placement: (K + F, 6) x, y, z in metres, map frame, yaw, pitch, roll in radians.
    :ivar models: what each sees.
    :ivar movable: K.
    :ivar pitch: radians, the least and the most that the K cameras look down.
    :ivar turns: whether they are turned at all.
    :ivar clearance: metres that the K cameras have to stay from surfaces, as far as a horizontal
        plane can tell; None for what planners are set to.
    """

    placement: np.ndarray
    models: Sequence[CameraModel]
    movable: int
    pitch: tuple[float, float] = (0.0, 0.5 * np.pi)
    turns: bool = True
    clearance: float | None = None

    @property
    def lenses(self) -> list[Frustum | None]:
        """
        Return the lens of each camera: K, then F.

        Where the K cameras are all omnidirectional, theirs are None: planners take them to see as
        far as they themselves have been told.
        """
        lenses = [model.lens for model in self.models]
        return lenses if self.aimed else [None] * self.movable + lenses[self.movable:]

    @property
    def aimed(self) -> list[int]:
        """Return the numbers of the cameras that may be moved and are not omnidirectional."""
        return [k for k in range(self.movable) if not self.models[k].omnidirectional]

    def headings(self, camera: int, yaws: int, pitches: int) -> np.ndarray:
        """
        List how a camera may be turned: (H, 3) radians; as it is where it is not turned.

        Its roll is that of its mount and stays.

        :param yaws: of :func:`directions`.
        :param pitches: of :func:`directions`.
        """
        if self.models[camera].omnidirectional or not self.turns:
            return self.placement[camera, None, 3:]
        listed = directions(self.pitch, yaws, pitches)
        listed[:, 2] = self.placement[camera, 5]
        return listed


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


def clearance_of(rig_state: RigState | None, otherwise: float) -> float:
    """Return how far a plane keeps from surfaces, metres: a setting, or a rig's own if not 0."""
    if not otherwise or rig_state is None or rig_state.clearance is None:
        return otherwise
    return rig_state.clearance


def fixed_views(model: PartialMap, rig_state: RigState | None) -> list[View]:
    """Return what the cameras in place see of what is known, as far as there are any."""
    if rig_state is None:
        return []
    first = rig_state.movable
    fixed = zip(rig_state.placement[first:], rig_state.lenses[first:], strict=True)
    return [model.look(camera, lens) for camera, lens in fixed]


def view_from(model: PartialMap, rig_state: RigState | None, camera: int,
              position: np.ndarray, heading: np.ndarray | None = None) -> View:
    """Compute what a camera would see at a position (3,), turned by a heading (3,) or as it is."""
    lens = None if rig_state is None else rig_state.lenses[camera]
    if lens is None:
        return model.look(position)
    turned = rig_state.placement[camera, 3:] if heading is None else heading
    return model.look(np.concatenate([position, turned]), lens)


def record_views(memory: LookHistory, positions: np.ndarray, rig_state: RigState | None) -> None:
    """
    Take note of where cameras have looked at a turn, those in place included.

    :param positions: (K, 3) metres, of those that may be moved.
    """
    if rig_state is None:
        memory.visit(positions)
    else:
        memory.visit(rig_state.placement, rig_state.lenses)


def directions(pitch: tuple[float, float], yaws: int, pitches: int) -> np.ndarray:
    """
    List directions all around.

    :param pitch: radians, the least and the most that cameras look down.
    :param yaws: how many at each pitch.
    :param pitches: at most so many: the middles of equal parts of the range.
    :returns: (H, 3) yaw, pitch and roll in radians.
    """
    low, high = pitch
    count = int(np.clip(np.ceil((high - low) / PITCH_STEP), 1, pitches))
    middles = low + (high - low) * (np.arange(count) + 0.5) / count
    return np.array([(yaw, middle, 0.0) for middle in middles
                     for yaw in np.arange(yaws) * (2.0 * np.pi / yaws)])
