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

"""State of a rig at a turn, and its command."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, Frustum
from ocp_ros.online.partial_map import LookHistory, PartialMap
from ocp_ros.simulation.simulator import View

#: Radius around a camera with a frustum in which cells count as air even if unobserved, metres:
#: such a camera does not observe the space behind it.
AIR_RADIUS_M = 2.0


class RigState(NamedTuple):
    """
    Poses and models of the cameras of a rig at a turn: K movable cameras, then F fixed ones.

    :ivar placement: (K + F, 6) x, y, z in metres, map frame, yaw, pitch, roll in radians.
    :ivar models: K + F camera models.
    :ivar movable: K, the number of movable cameras.
    :ivar pitch: radians, smallest and largest pitch of the K cameras; positive is down.
    :ivar may_rotate: whether the cameras may rotate.
    :ivar clearance: smallest distance of the K cameras from surfaces in the horizontal plane,
        metres; None for the setting of the planner.
    """

    placement: np.ndarray
    models: Sequence[CameraModel]
    movable: int
    pitch: tuple[float, float] = (0.0, 0.5 * np.pi)
    may_rotate: bool = True
    clearance: float | None = None

    @classmethod
    def omnidirectional(cls, cameras: int) -> 'RigState':
        """Return the state of ``cameras`` omnidirectional cameras whose poses are not used."""
        return cls(np.zeros((cameras, 6)), (CameraModel(),) * cameras, cameras)

    @property
    def lenses(self) -> list[Frustum | None]:
        """
        Return the frusta of the K movable cameras, then of the F fixed cameras.

        If the K cameras are all omnidirectional, their frusta are None: planners then use their
        own ``max_range``.
        """
        lenses = [model.lens for model in self.models]
        return lenses if self.aimed else [None] * self.movable + lenses[self.movable:]

    @property
    def aimed(self) -> list[int]:
        """Return the numbers of the movable cameras that are not omnidirectional."""
        return [k for k in range(self.movable) if not self.models[k].omnidirectional]

    def headings(self, camera: int, yaws: int, pitches: int) -> np.ndarray:
        """
        Return the H candidate headings of a camera: (H, 3) yaw, pitch, roll in radians.

        A camera that is omnidirectional or may not rotate has its current heading alone. The roll
        is given by the mount and does not change.

        :param yaws: number of yaws at each pitch.
        :param pitches: largest number of pitches.
        """
        if self.models[camera].omnidirectional or not self.may_rotate:
            return self.placement[camera, None, 3:]
        headings = directions(self.pitch, yaws, pitches)
        headings[:, 2] = self.placement[camera, 5]
        return headings


class Command(NamedTuple):
    """
    Commanded poses of K movable cameras, with the poses of F fixed cameras.

    :ivar placement: (K + F, 6) metres, map frame, and radians.
    :ivar rotated: numbers of the cameras whose heading is commanded.
    :ivar held: messages about cameras that stay because they have no feasible position; see
        :class:`~ocp_ros.online.constraint_filter.FilteredTargets`.
    """

    placement: np.ndarray
    rotated: list[int]
    held: list[str]


def clearance_of(rig_state: RigState | None, default: float) -> float:
    """
    Return the smallest distance of cameras from surfaces: that of the rig, or else a default.

    :param default: metres; 0 means no limit and is returned for every rig.
    :returns: metres.
    """
    if not default or rig_state is None or rig_state.clearance is None:
        return default
    return rig_state.clearance


def fixed_views(model: PartialMap, rig_state: RigState | None) -> list[View]:
    """Return the views of the fixed cameras in a partial map; [] without fixed cameras."""
    if rig_state is None:
        return []
    movable = rig_state.movable
    return [model.look(pose, lens) for pose, lens in zip(
        rig_state.placement[movable:], rig_state.lenses[movable:], strict=True)]


def view_from(model: PartialMap, rig_state: RigState | None, camera: int,
              position: np.ndarray, heading: np.ndarray | None = None) -> View:
    """
    Return the view of a camera from a position.

    :param rig_state: current state of the rig; None for omnidirectional cameras.
    :param camera: number of the camera.
    :param position: (3,) metres.
    :param heading: (3,) yaw, pitch, roll in radians; None for the current heading.
    """
    lens = None if rig_state is None else rig_state.lenses[camera]
    if lens is None:
        return model.look(position)
    heading = rig_state.placement[camera, 3:] if heading is None else heading
    return model.look(np.concatenate([position, heading]), lens)


def record_views(memory: LookHistory, positions: np.ndarray, rig_state: RigState | None) -> None:
    """
    Record the poses of all cameras at a turn, fixed cameras included.

    :param memory: the record, changed here.
    :param positions: (K, 3) metres, of the K movable cameras; used only without ``rig_state``.
    :param rig_state: state of the rig at that turn; None for omnidirectional cameras.
    """
    if rig_state is None:
        memory.visit(positions)
    else:
        memory.visit(rig_state.placement, rig_state.lenses)


def directions(pitch: tuple[float, float], yaws: int, pitches: int) -> np.ndarray:
    """
    Return H headings, evenly spread over all yaws and a range of pitches.

    :param pitch: radians, smallest and largest pitch; positive is down.
    :param yaws: number of yaws at each pitch.
    :param pitches: largest number of pitches. Each pitch is the centre of an equal part of the
        range; there are fewer if parts of at most 30 degrees need fewer.
    :returns: (H, 3) yaw, pitch and roll in radians: all yaws at the first pitch, then at the next.
    """
    low, high = pitch
    count = int(np.clip(np.ceil((high - low) / np.deg2rad(30.0)), 1, pitches))
    centres = low + (high - low) * (np.arange(count) + 0.5) / count
    return np.array([(yaw, centre, 0.0) for centre in centres
                     for yaw in np.arange(yaws) * (2.0 * np.pi / yaws)])
