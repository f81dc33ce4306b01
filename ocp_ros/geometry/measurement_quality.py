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

"""How well a camera measures a visible point: pixel density, noise, and angle of incidence."""

from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, DepthNoise, PINHOLE
from ocp_ros.util.kernels import njit


class QualityLimits(NamedTuple):
    """
    The limits of depth, incidence and noise within which a camera measures a point well enough.

    :ivar planar: whether a depth is measured along the optical axis; otherwise along the ray.
    :ivar max_depth: metres.
    :ivar min_cosine: of the angle of incidence.
    :ivar max_noise: the largest standard deviation of a depth, metres.
    :ivar noise: the noise of the camera.
    """

    planar: bool
    max_depth: float
    min_cosine: float
    max_noise: float
    noise: DepthNoise

    @classmethod
    def of(cls, model: CameraModel, pixel_density: float | None, max_noise: float | None,
           incidence: float | None) -> 'QualityLimits':
        """
        Return the limits of a camera; None for each limit that is not required.

        :param pixel_density: the least number of pixels per metre, on a surface at the depth of
            the point that faces the camera.
        :param max_noise: the largest standard deviation of a depth, metres.
        :param incidence: the largest angle between the ray and the normal of the surface, radians.
        :raises ValueError: if the camera has no resolution, or no noise model, for its limit.
        """
        if pixel_density is not None and model.pixels_per_unit is None:
            raise ValueError('resolution')
        if max_noise is not None and model.noise is None:
            raise ValueError('depth_noise')
        return cls(
            model.lens.kind == PINHOLE,
            np.inf if pixel_density is None else model.pixels_per_unit / pixel_density,
            0.0 if incidence is None else float(np.cos(incidence)),
            np.inf if max_noise is None else max_noise, model.noise or DepthNoise())


@njit(cache=True, nogil=True, error_model='numpy')
def keep_measured_well(points, normals, position, rotations, limits, bits):
    """
    Clear, for each point, the headings of a camera with which it is not measured well enough.

    :param points: (n, 3) metres, map frame.
    :param normals: (n, 3) unit vectors of either direction.
    :param position: (3,) float64, the position of the camera, metres.
    :param rotations: (H, 3, 3) float64, one for each of H headings, body frame to map frame.
    :param limits: :class:`QualityLimits`.
    :param bits: (n, W) uint64, in and out, W >= H / 64: bit k of word w stands for heading
        64 w + k.
    """
    noise = limits.noise
    for i in range(points.shape[0]):
        x, y, z = points[i] - position
        distance = max(np.sqrt(x * x + y * y + z * z), 1e-9)
        normal = normals[i]
        cosine = min(abs(x * normal[0] + y * normal[1] + z * normal[2]) / distance, 1.0)
        angle = np.arccos(cosine)
        # Infinite at a right angle.
        grazing = noise.grazing * (angle / (0.5 * np.pi - angle)) ** 2 if noise.grazing else 0.0
        for heading in range(rotations.shape[0]):
            depth = distance
            if limits.planar:
                depth = (rotations[heading, 0, 0] * x + rotations[heading, 1, 0] * y
                         + rotations[heading, 2, 0] * z)
            deviation = (noise.constant + noise.linear * depth + noise.quadratic * depth * depth
                         + grazing * depth * np.sqrt(max(depth, 0.0)))
            if not (depth <= limits.max_depth and cosine >= limits.min_cosine
                    and deviation <= limits.max_noise):
                bits[i, heading >> 6] &= ~(np.uint64(1) << np.uint64(heading & 63))
