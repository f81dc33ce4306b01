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

"""Camera models and poses: the field of view of depth cameras, without occlusion."""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
from ocp_ros.util.kernels import njit

OMNIDIRECTIONAL, PINHOLE, SPHERICAL = 0, 1, 2
#: From the optical frame (z forward, x right, y down) to the body frame (x forward, y left, z up).
OPTICAL_TO_BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
#: From the frames of clouds to the body frame; in OpenGL, x is right, y up and z backward.
TO_BODY = {'optical': OPTICAL_TO_BODY, 'body': np.eye(3),
           'opengl': OPTICAL_TO_BODY @ np.diag([1.0, -1.0, -1.0])}


class Frustum(NamedTuple):
    """
    A camera model as plain numbers for the kernels.

    :ivar kind: ``OMNIDIRECTIONAL``, ``PINHOLE`` or ``SPHERICAL``.
    :ivar min_range: metres.
    :ivar max_range: metres.
    :ivar half_horizontal: half the horizontal field of view: its tangent for a pinhole camera,
        radians otherwise.
    :ivar half_vertical: half the vertical field of view, in the same form.
    """

    kind: int
    min_range: float
    max_range: float
    half_horizontal: float
    half_vertical: float


class Pose(NamedTuple):
    """
    The pose of a camera.

    :ivar position: (3,) float64, metres, map frame.
    :ivar rotation: (3, 3) float64, body frame (x forward, y left, z up) to map frame.
    """

    position: np.ndarray
    rotation: np.ndarray

    @classmethod
    def of(cls, camera: np.ndarray) -> 'Pose':
        """
        Build a pose from one row of a placement.

        :param camera: (3,) x, y, z in metres, or (6,) with yaw, pitch and roll in radians after
            them; see :func:`rotation_matrix`.
        :raises ValueError: for another shape or a number that is not finite.
        """
        camera = np.asarray(camera, dtype=np.float64)
        if camera.shape not in ((3,), (6,)) or not np.isfinite(camera).all():
            raise ValueError(f'camera pose: found {camera.tolist()}; expected x, y, z in metres, '
                             'or x, y, z, yaw, pitch, roll with angles in radians, all finite')
        return cls(camera[:3], rotation_matrix(*camera[3:]) if len(camera) == 6 else LEVEL)

    def within(self, base: 'Pose') -> 'Pose':
        """Return this pose, which is in the frame of a base, in the frame that the base is in."""
        return Pose(base.position + base.rotation @ self.position, base.rotation @ self.rotation)

    def away_from(self, other: 'Pose') -> tuple[float, float]:
        """Return the distance and the rotation angle to another pose: metres and radians."""
        return (float(np.linalg.norm(self.position - other.position)),
                angle_between(self.rotation, other.rotation))


class CameraArrays(NamedTuple):
    """
    The poses and models of K cameras, for kernels that look from all of them in one call.

    :ivar positions: (K, 3) float64, metres, map frame.
    :ivar rotations: (K, 3, 3) float64, body frame to map frame.
    :ivar lenses: (K, 5) float64, the fields of each :class:`Frustum`.
    """

    positions: np.ndarray
    rotations: np.ndarray
    lenses: np.ndarray

    @classmethod
    def of(cls, cameras: Sequence[tuple[Pose, Frustum]]) -> 'CameraArrays':
        """Build the arrays of cameras, given the pose and the model of each."""
        return cls(np.array([pose.position for pose, _ in cameras], dtype=np.float64),
                   np.array([pose.rotation for pose, _ in cameras], dtype=np.float64),
                   np.array([lens for _, lens in cameras], dtype=np.float64))


@njit(cache=True, nogil=True, inline='always')
def camera_of(cameras, number):
    """Return the :class:`Pose` and the :class:`Frustum` of one of the cameras."""
    lens = cameras.lenses[number]
    return (Pose(cameras.positions[number], cameras.rotations[number]),
            Frustum(int(lens[0]), lens[1], lens[2], lens[3], lens[4]))


class DepthNoise(NamedTuple):
    """
    The standard deviation of one measured depth z of a sensor, at an angle of incidence t.

    It is constant + linear z + quadratic z^2 + grazing z^1.5 t^2 / (pi/2 - t)^2, which has the
    terms of published models: stereo errs with z^2, and the last term is that of Fankhauser et
    al., "Kinect v2 for Mobile Robot Navigation: Evaluation and Modeling", ICAR 2015.

    :ivar constant: metres.
    :ivar linear: metres per metre.
    :ivar quadratic: 1 / metre.
    :ivar grazing: metres^-0.5; 0 if the published model does not depend on the angle.
    """

    constant: float = 0.0
    linear: float = 0.0
    quadratic: float = 0.0
    grazing: float = 0.0


@dataclass(frozen=True)
class CameraModel:
    """
    The viewing cone of a depth camera, F_i in equation 5 of arXiv 2110.11106.

    A field of view of 180 degrees or more has no image plane. Limits of azimuth and elevation
    bound such a cone, as for a spinning lidar; 360 x 180 degrees is omnidirectional.

    :param min_range: metres; nearer points are not measured.
    :param max_range: metres; the effective range.
    :param horizontal_fov: radians, in (0, 2 pi].
    :param vertical_fov: radians, in (0, pi].
    :param resolution: pixels across and down; None if unknown.
    :param noise: the noise of its depths; None if unknown.
    :raises ValueError: if a range, an angle or the resolution is out of its limits.
    """

    min_range: float = 0.0
    max_range: float = 4.0
    horizontal_fov: float = 2.0 * np.pi
    vertical_fov: float = np.pi
    resolution: tuple[int, int] | None = None
    noise: DepthNoise | None = None

    def __post_init__(self) -> None:
        """Check the ranges, the angles and the resolution."""
        if not 0.0 <= self.min_range < self.max_range < np.inf:
            raise ValueError(
                f'camera ranges: found min_range {self.min_range} m and max_range '
                f'{self.max_range} m; expected 0 <= min_range < max_range')
        # 1e-9 is the tolerance for rounding, as in ``omnidirectional``.
        if not (0.0 < self.horizontal_fov <= 2.0 * np.pi + 1e-9
                and 0.0 < self.vertical_fov <= np.pi + 1e-9):
            raise ValueError(
                f'camera field of view: found {self.horizontal_fov} x {self.vertical_fov} rad; '
                'expected at most 2 pi x pi, both above 0')
        if self.resolution is not None and not min(self.resolution) > 0:
            raise ValueError(f'camera resolution: found {self.resolution}; expected pixels across '
                             'and down, both above 0')

    @property
    def omnidirectional(self) -> bool:
        """Whether the viewing cone contains every direction."""
        return self.horizontal_fov >= 2.0 * np.pi - 1e-9 and self.vertical_fov >= np.pi - 1e-9

    @property
    def pixels_per_unit(self) -> float | None:
        """
        Return the pixels per metre on a surface at one metre that faces the camera.

        For a pinhole camera, the distance of the surface is that along the optical axis, and the
        number is the focal length in pixels. Of across and down, the smaller number is returned;
        None if the resolution is unknown.
        """
        if self.resolution is None:
            return None
        lens = self.lens
        return float(min(self.resolution[0] / (2.0 * lens.half_horizontal),
                         self.resolution[1] / (2.0 * lens.half_vertical)))

    @property
    def lens(self) -> Frustum:
        """Return the model as plain numbers for the kernels."""
        half_horizontal, half_vertical = 0.5 * self.horizontal_fov, 0.5 * self.vertical_fov
        if self.omnidirectional:
            kind = OMNIDIRECTIONAL
        # The tangent of a right angle is infinite.
        elif max(half_horizontal, half_vertical) < 0.5 * np.pi - 1e-6:
            kind = PINHOLE
            half_horizontal, half_vertical = np.tan(half_horizontal), np.tan(half_vertical)
        else:
            kind = SPHERICAL
        return Frustum(kind, float(self.min_range), float(self.max_range),
                       float(half_horizontal), float(half_vertical))


def view_grid(model: CameraModel, rows: int, columns: int) -> np.ndarray:
    """
    Return directions that cover a field of view evenly, its edges included.

    :returns: (rows, columns, 3) unit vectors, body frame: from top to bottom, from left to right.
    """
    lens = model.lens
    vertical, horizontal = np.meshgrid(np.linspace(1.0, -1.0, rows),
                                       np.linspace(1.0, -1.0, columns), indexing='ij')
    if lens.kind == PINHOLE:
        # For a pinhole camera the halves are tangents, which are coordinates at x = 1.
        directions = np.stack([np.ones_like(vertical), horizontal * lens.half_horizontal,
                               vertical * lens.half_vertical], axis=-1)
        return directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    azimuth, elevation = horizontal * lens.half_horizontal, vertical * lens.half_vertical
    return np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                     np.sin(elevation)], axis=-1)


def rotation_matrix(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """
    Return the rotation from a camera's body frame (x forward, y left, z up) to the map frame.

    :param yaw: radians about z, counter-clockwise seen from above.
    :param pitch: radians about y; positive looks down (REP-103).
    :param roll: radians about x.
    :returns: (3, 3) float64, R_z(yaw) R_y(pitch) R_x(roll).
    """
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    cr, sr = np.cos(roll), np.sin(roll)
    return np.array([
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr]])


def pose_features(poses: np.ndarray, metres_per_radian: float) -> np.ndarray:
    """
    Return vectors whose distance is small for poses with similar views.

    :param poses: (M, 6) x, y, z in metres and yaw, pitch, roll in radians of M cameras.
    :param metres_per_radian: the distance in metres that counts as much as a rotation of the
        viewing direction by one radian.
    :returns: (M, 6) metres: positions and scaled viewing directions.
    """
    yaw, pitch = poses[:, 3], poses[:, 4]
    ahead_xyz = np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), -np.sin(pitch)
    return np.hstack([poses[:, :3], metres_per_radian * np.stack(ahead_xyz).T])


def heading_of(rotation: np.ndarray) -> np.ndarray:
    """
    Return yaw, pitch and roll of a rotation, the inverse of :func:`rotation_matrix`.

    :param rotation: (3, 3), body frame to map frame.
    :returns: (3,) yaw, pitch and roll in radians, the pitch from -pi / 2 to pi / 2. If the camera
        looks straight up or down, the yaw is the whole rotation about the vertical axis, and the
        roll is 0.
    """
    x_axis, y_axis, z_axis = rotation.T
    level_length = np.hypot(x_axis[0], x_axis[1])
    pitch = np.arctan2(-x_axis[2], level_length)
    # The camera looks straight up or down: the y axis, which is level, gives the yaw.
    if level_length < 1e-7:
        return np.array([np.arctan2(-y_axis[0], y_axis[1]), pitch, 0.0])
    return np.array([np.arctan2(x_axis[1], x_axis[0]), pitch, np.arctan2(y_axis[2], z_axis[2])])


def angle_between(rotation: np.ndarray, other: np.ndarray) -> float:
    """Return the angle between two rotation matrices (3, 3), radians."""
    # The cosine is inaccurate for small angles, so the sine of half the angle is used: the norm
    # of the difference is root 8 times this sine.
    half_angle_sine = np.linalg.norm(rotation - other) / np.sqrt(8.0)
    return float(2.0 * np.arcsin(min(half_angle_sine, 1.0)))


#: The rotation of a level camera that looks along x.
LEVEL = np.eye(3)


@njit(cache=True, nogil=True, inline='always')
def in_view(x: float, y: float, z: float, lens: Frustum) -> bool:
    """Return whether a direction (x, y, z) in the body frame of a camera is in its cone."""
    if lens.kind == OMNIDIRECTIONAL:
        return True
    if lens.kind == PINHOLE:
        # No branches, so that loops over this function are vectorised.
        return ((x > 0.0) & (abs(y) <= x * lens.half_horizontal)
                & (abs(z) <= x * lens.half_vertical))
    return (abs(math.atan2(y, x)) <= lens.half_horizontal
            and abs(math.atan2(z, math.hypot(x, y))) <= lens.half_vertical)


@njit(cache=True, nogil=True, inline='always')
def in_cone(dx: float, dy: float, dz: float, pose: Pose, lens: Frustum) -> bool:
    """Return whether an offset (dx, dy, dz) from a camera, metres, map frame, is in its cone."""
    # The transposed rotation leads from the map frame to the body frame.
    rotation = pose.rotation
    x = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
    y = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
    z = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
    return in_view(x, y, z, lens)


@njit(cache=True, nogil=True)
def mark_headings(points, position, rotations, lens, bits):
    """
    Mark, for each point, the headings of a camera whose viewing cone contains the point.

    :param points: (N, 3) float32, N points, metres, map frame.
    :param position: (3,) float64, the position of the camera, metres.
    :param rotations: (H, 3, 3) float64, one for each of H headings, body frame to map frame.
    :param lens: the camera model's :class:`Frustum`.
    :param bits: (N, W) uint64, in and out, W >= H / 64: bit k of word w stands for heading
        64 w + k.
    """
    offsets = points.astype(np.float64) - position
    for heading in range(rotations.shape[0]):
        pose = Pose(position, rotations[heading])
        flag = np.uint64(1) << np.uint64(heading & 63)
        for i in range(offsets.shape[0]):
            if in_cone(offsets[i, 0], offsets[i, 1], offsets[i, 2], pose, lens):
                bits[i, heading >> 6] |= flag
