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

"""State of a rig at a time step, its limits in one time step, and its command."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, Frustum
from ocp_ros.online.partial_map import LookHistory, PartialMap
from ocp_ros.rig.free_plane import CLEARANCE
from ocp_ros.simulation.simulator import View

#: Radius around a camera with a frustum in which cells count as air even if unobserved, metres:
#: such a camera does not observe the space behind it.
AIR_RADIUS_M = 2.0
#: Largest part of the pitch range that one listed pitch represents, radians.
PITCH_STEP = np.deg2rad(30.0)


class RigState(NamedTuple):
    """
    Poses and models of the cameras of a rig at a time step: K movable cameras, then F fixed ones.

    :ivar placement: (K + F, 6) x, y, z in metres, map frame, yaw, pitch, roll in radians.
    :ivar models: camera models.
    :ivar movable: K.
    :ivar pitch: radians, smallest and largest pitch of the K cameras; positive is down.
    :ivar turns: whether the headings may change.
    :ivar clearance: smallest distance of the K cameras from surfaces in the horizontal plane,
        metres; None for the setting of the planner.
    """

    placement: np.ndarray
    models: Sequence[CameraModel]
    movable: int
    pitch: tuple[float, float] = (0.0, 0.5 * np.pi)
    turns: bool = True
    clearance: float | None = None

    @classmethod
    def omnidirectional(cls, cameras: int) -> 'RigState':
        """Return the state of omnidirectional cameras whose poses are not used."""
        return cls(np.zeros((cameras, 6)), (CameraModel(),) * cameras, cameras)

    @property
    def lenses(self) -> list[Frustum | None]:
        """
        Return the frustum of each camera: K, then F.

        If the K cameras are all omnidirectional, theirs are None, and planners use their own
        ``max_range`` for them.
        """
        lenses = [model.lens for model in self.models]
        return lenses if self.aimed else [None] * self.movable + lenses[self.movable:]

    @property
    def aimed(self) -> list[int]:
        """Return the numbers of the movable cameras that are not omnidirectional."""
        return [k for k in range(self.movable) if not self.models[k].omnidirectional]

    def headings(self, camera: int, yaws: int, pitches: int) -> np.ndarray:
        """
        List the candidate headings of a camera: (H, 3) radians.

        A camera that is omnidirectional or may not rotate has its current heading alone. The roll
        is given by the mount and does not change.

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
    Limits of a rig in one time step.

    :ivar max_step: farthest a camera moves, metres.
    :ivar max_turn: largest rotation of a camera, radians; 0 if no camera rotates.
    :ivar wall_margin: cameras stay this far inside the observed bounding box, metres.
    :ivar clearance: cameras stay this far from all observed points, metres; a rig file replaces
        any value but 0.
    """

    max_step: float
    max_turn: float
    wall_margin: float
    clearance: float = CLEARANCE


class Command(NamedTuple):
    """
    Commanded poses of the cameras.

    :ivar placement: (K + F, 6) metres, map frame, and radians; fixed cameras stay.
    :ivar rotated: numbers of the cameras whose heading is commanded.
    :ivar held: messages, one for each camera that stays because it has no feasible position.
    """

    placement: np.ndarray
    rotated: list[int]
    held: list[str]


def clearance_of(rig_state: RigState | None, otherwise: float) -> float:
    """
    Return the distance that cameras keep from surfaces: that of the rig, or else of a setting.

    :param otherwise: the setting, metres; 0 means no limit and is returned for every rig.
    :returns: metres.
    """
    if not otherwise or rig_state is None or rig_state.clearance is None:
        return otherwise
    return rig_state.clearance


def fixed_views(model: PartialMap, rig_state: RigState | None) -> list[View]:
    """Return the views of the fixed cameras in a partial map; [] without fixed cameras."""
    if rig_state is None:
        return []
    first = rig_state.movable
    fixed = zip(rig_state.placement[first:], rig_state.lenses[first:], strict=True)
    return [model.look(camera, lens) for camera, lens in fixed]


def view_from(model: PartialMap, rig_state: RigState | None, camera: int,
              position: np.ndarray, heading: np.ndarray | None = None) -> View:
    """Compute the view of a camera at a position (3,) with a heading (3,), None for its own."""
    lens = None if rig_state is None else rig_state.lenses[camera]
    if lens is None:
        return model.look(position)
    turned = rig_state.placement[camera, 3:] if heading is None else heading
    return model.look(np.concatenate([position, turned]), lens)


def record_views(memory: LookHistory, positions: np.ndarray, rig_state: RigState | None) -> None:
    """
    Record the poses of all cameras at a time step, fixed cameras included.

    :param positions: (K, 3) metres, of the movable cameras.
    """
    if rig_state is None:
        memory.visit(positions)
    else:
        memory.visit(rig_state.placement, rig_state.lenses)


def directions(pitch: tuple[float, float], yaws: int, pitches: int) -> np.ndarray:
    """
    List headings over all yaws and a range of pitches.

    :param pitch: radians, smallest and largest pitch; positive is down.
    :param yaws: number of yaws at each pitch.
    :param pitches: largest number of pitches; they are the middles of equal parts of the range.
    :returns: (H, 3) yaw, pitch and roll in radians.
    """
    low, high = pitch
    count = int(np.clip(np.ceil((high - low) / PITCH_STEP), 1, pitches))
    middles = low + (high - low) * (np.arange(count) + 0.5) / count
    return np.array([(yaw, middle, 0.0) for middle in middles
                     for yaw in np.arange(yaws) * (2.0 * np.pi / yaws)])
