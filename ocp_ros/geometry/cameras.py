# SPDX-License-Identifier: Apache-2.0
"""Camera models and poses: what a depth camera could see if nothing stood in its way."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

OMNIDIRECTIONAL, PINHOLE, SPHERICAL = 0, 1, 2


class Lens(NamedTuple):
    """
    A camera model as the kernels take it.

    :ivar kind: ``OMNIDIRECTIONAL``, ``PINHOLE`` or ``SPHERICAL``.
    :ivar half_horizontal: pinhole: tangent of half the angle; spherical: half the angle, radians.
    :ivar half_vertical: the same for the vertical angle.
    """

    kind: int
    min_range: float
    max_range: float
    half_horizontal: float
    half_vertical: float


@dataclass(frozen=True)
class CameraModel:
    """
    The viewing cone of a depth camera, F_i in equation 5 of arXiv 2110.11106.

    An angle of view of 180 degrees or more cannot be an image plane: such a model is bounded by
    azimuth and elevation instead (a spinning lidar), and 360 x 180 degrees is omnidirectional.

    :param min_range: metres; nearer points are not measured.
    :param max_range: metres; the effective range.
    :param horizontal_fov: radians, in (0, 2 pi].
    :param vertical_fov: radians, in (0, pi].
    :raises ValueError: if a range or an angle makes no sense.
    """

    min_range: float = 0.0
    max_range: float = 4.0
    horizontal_fov: float = 2.0 * np.pi
    vertical_fov: float = np.pi

    def __post_init__(self) -> None:
        """Check the ranges and the angles."""
        if not 0.0 <= self.min_range < self.max_range < np.inf:
            raise ValueError(
                f'camera ranges: found min_range {self.min_range} m and max_range '
                f'{self.max_range} m; expected 0 <= min_range < max_range')
        if not (0.0 < self.horizontal_fov <= 2.0 * np.pi + 1e-9
                and 0.0 < self.vertical_fov <= np.pi + 1e-9):
            raise ValueError(
                f'camera field of view: found {self.horizontal_fov} x {self.vertical_fov} rad; '
                'expected at most 2 pi x pi, both above 0')

    @property
    def omnidirectional(self) -> bool:
        """Whether the viewing cone contains every direction."""
        return self.horizontal_fov >= 2.0 * np.pi - 1e-9 and self.vertical_fov >= np.pi - 1e-9

    @property
    def lens(self) -> Lens:
        """Return the model as plain numbers for the kernels."""
        half_horizontal, half_vertical = 0.5 * self.horizontal_fov, 0.5 * self.vertical_fov
        if self.omnidirectional:
            kind = OMNIDIRECTIONAL
        elif max(half_horizontal, half_vertical) < 0.5 * np.pi - 1e-6:
            kind = PINHOLE
            half_horizontal, half_vertical = np.tan(half_horizontal), np.tan(half_vertical)
        else:
            kind = SPHERICAL
        return Lens(kind, float(self.min_range), float(self.max_range),
                    float(half_horizontal), float(half_vertical))


def rotation_matrix(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """
    Rotate from the camera's body frame (x forward, y left, z up) to the map frame.

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
