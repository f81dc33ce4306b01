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

"""What is exported: a placement in the frame of the files, perhaps with its room."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple
import warnings

import numpy as np
from ocp_ros.geometry.cameras import (
    CameraModel,
    heading_of,
    PINHOLE,
    rotation_matrix,
    TO_BODY,
)
from ocp_ros.report.assessment import Assessment
from ocp_ros.rig.placement_file import FRAME, Placed, Placement
from ocp_ros.scenes.source_frame import SourceFrame
from ocp_ros.util.settings import ConfigurationError

#: Name of the frame with the axes of the room's scan, in metres.
SCAN_FRAME = 'scan'
#: Width in pixels of the image of a camera whose resolution is unknown; its pixels are square.
DEFAULT_WIDTH = 640


class Link(NamedTuple):
    """
    A transform between frames of a placement.

    :ivar parent: name of the parent frame.
    :ivar child: name of the child frame.
    :ivar position: origin of the child frame in the parent frame, metres.
    :ivar angles: rotation of the child frame in the parent frame: roll, pitch, yaw in radians.
    """

    parent: str
    child: str
    position: tuple[float, float, float]
    angles: tuple[float, float, float]


def link_between(parent: str, child: str, rotation: np.ndarray, position: np.ndarray) -> Link:
    """
    Return the transform between two frames.

    :param rotation: (3, 3) from child to parent.
    :param position: (3,) metres, origin of the child frame in the parent frame.
    """
    yaw, pitch, roll = heading_of(rotation).tolist()
    return Link(parent, child, tuple(position.tolist()), (roll, pitch, yaw))


class Pinhole(NamedTuple):
    """
    A camera with an image plane, without distortion, its optical axis in the image centre.

    Image coordinates begin at the corner of the first pixel, so its centre is at (0.5, 0.5).

    :ivar frame: name of the camera's body frame.
    :ivar placed: the camera and its pose.
    :ivar size: width and height of the image, pixels.
    :ivar focal: focal lengths fx and fy, pixels.
    """

    frame: str
    placed: Placed
    size: tuple[int, int]
    focal: tuple[float, float]

    @property
    def matrix(self) -> np.ndarray:
        """Return the intrinsic matrix: (3, 3) pixels, skew 0."""
        return np.array([[self.focal[0], 0.0, 0.5 * self.size[0]],
                         [0.0, self.focal[1], 0.5 * self.size[1]], [0.0, 0.0, 1.0]])

    @property
    def from_world(self) -> np.ndarray:
        """Return the transform (4, 4) from the frame of the file to the optical frame."""
        return np.linalg.inv(pose_matrix(self.placed, 'optical'))


def pose_matrix(placed: Placed, frame: str = 'body') -> np.ndarray:
    """
    Return the transform from a frame of a camera to the frame of the file.

    :param frame: ``body``, ``optical`` or ``opengl``, see
        :data:`~ocp_ros.geometry.cameras.TO_BODY`.
    :returns: (4, 4), metres.
    """
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(*placed.pose[3:]) @ TO_BODY[frame]
    matrix[:3, 3] = placed.position
    return matrix


def image_size(model: CameraModel) -> tuple[int, int]:
    """Return width and height of the image of a pinhole camera, pixels."""
    lens = model.lens
    return model.resolution or (
        DEFAULT_WIDTH, max(round(DEFAULT_WIDTH * lens.half_vertical / lens.half_horizontal), 1))


@dataclass(frozen=True, eq=False)
class Exported:
    """
    A placement for files.

    :ivar original: the placement in the map frame, with which scores are computed.
    :ivar prefix: prefix of the names of camera frames, so that those of two rigs differ.
    :ivar omitted: names of cameras to leave out, such as those whose calibration was refused.
    :ivar assessed: the placement in its room; None if no format needs the room.
    """

    original: Placement
    prefix: str = ''
    omitted: Collection[str] = ()
    assessed: Assessment | None = None

    @property
    def source(self) -> SourceFrame:
        """Return the frame of the room's scan; that of the map without a room."""
        return self.assessed.scene.source if self.assessed else SourceFrame()

    @property
    def in_scan_axes(self) -> bool:
        """Return whether files have the axes of the scan in place of the map."""
        return self.assessed is not None and not self.assessed.data_frame.is_map

    @property
    def scales(self) -> np.ndarray:
        """Return the metres per unit of x, y and z in tables: (3,)."""
        return self.source.scales if self.in_scan_axes else np.ones(3)

    @cached_property
    def placement(self) -> Placement:
        """Return the placement in the frame of the files: metres, axes of the map or the scan."""
        if not self.in_scan_axes:
            return self.original
        cameras = []
        for placed in self.original.cameras:
            rotation = self.source.rotation.T @ rotation_matrix(*placed.pose[3:])
            angles = np.round(np.rad2deg(heading_of(rotation)), 6)
            cameras.append(placed._replace(
                position=tuple(self.to_file(np.array(placed.position)).tolist()),
                angles=tuple(angles.tolist())))
        return replace(self.original, cameras=tuple(cameras), frame=SCAN_FRAME)

    def to_file(self, positions: np.ndarray) -> np.ndarray:
        """Return positions (..., 3) in the map as positions in the frame of the files, metres."""
        if not self.in_scan_axes:
            return positions
        return self.source.scales * self.source.to_source(positions)

    def check_z_up(self, kind: str) -> None:
        """
        Check that z of the files is up, which is not so in the axes of some scans.

        :param kind: the kind of file, for the message.
        :raises ConfigurationError: if z is not up.
        """
        up = self.to_file(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
        if abs(up[1, 2] - up[0, 2] - 1.0) > 1e-6:
            raise ConfigurationError(
                f'{kind}: found a frame whose z axis does not point up; expected one with z up; '
                'leave out --frame source')

    @property
    def links(self) -> list[Link]:
        """Return the transform between map and scan, if they differ."""
        source = self.source
        if source.is_map:
            return []
        # In metres, map = rotation @ scan - shift; a scan as parent frame needs the inverse.
        if self.in_scan_axes:
            return [link_between(SCAN_FRAME, FRAME, source.rotation.T,
                                 source.rotation.T @ source.shift)]
        return [link_between(FRAME, SCAN_FRAME, source.rotation, -source.shift)]

    def cameras(self) -> Iterator[tuple[int, Placed]]:
        """Yield the number, from 0, and the pose of each camera that is not omitted."""
        return ((number, placed) for number, placed in enumerate(self.placement.cameras)
                if placed.camera.name not in self.omitted)

    def frame(self, number: int) -> str:
        """Return the name of the body frame of a camera by its number from 0."""
        return f'{self.prefix}camera_{number}'

    def pinholes(self, kind: str) -> list[Pinhole]:
        """
        Return the cameras that have an image plane; warn of the others.

        :param kind: the kind of file, for messages.
        :raises ConfigurationError: if no camera has an image plane.
        """
        found, left_out = [], []
        for number, placed in self.cameras():
            lens = placed.camera.model.lens
            if lens.kind == PINHOLE:
                size = image_size(placed.camera.model)
                found.append(Pinhole(self.frame(number), placed, size, (
                    0.5 * size[0] / lens.half_horizontal, 0.5 * size[1] / lens.half_vertical)))
            else:
                left_out.append(placed.camera.name)
        expected = 'expected fields of view below 180 degrees, which have an image plane'
        if not found:
            raise ConfigurationError(f'{kind}: found {", ".join(left_out) or "no cameras"}; '
                                     f'{expected}; choose another format')
        if left_out:
            warnings.warn(f'{kind}: found {", ".join(left_out)}; {expected}; they are left out',
                          stacklevel=2)
        return found
