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

"""Drawings of fields of view: the part of a plan in range, and the edges of a frustum."""

from collections.abc import Sequence

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, OMNIDIRECTIONAL, PINHOLE, rotation_matrix
from scipy.spatial import ConvexHull

#: Number of directions along each edge of a field of view.
STEPS = 25


def rim(model: CameraModel) -> np.ndarray:
    """
    Return directions once around the edge of a field of view.

    :returns: (M, 3) unit vectors, body frame (x forward, y left, z up).
    """
    lens, half = model.lens, np.linspace(-1.0, 1.0, STEPS)
    one = np.ones_like(half)
    # Bottom, left, top and right, of a square from -1 to 1.
    across = np.concatenate([half, one, -half, -one])
    up = np.concatenate([-one, half, one, -half])
    if lens.kind == PINHOLE:
        ways = np.column_stack([np.ones(len(across)), across * lens.half_horizontal,
                                up * lens.half_vertical])
        return ways / np.linalg.norm(ways, axis=1, keepdims=True)
    azimuth, elevation = across * 0.5 * model.horizontal_fov, up * 0.5 * model.vertical_fov
    return np.column_stack([np.cos(elevation) * np.cos(azimuth),
                            np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])


def reach(model: CameraModel, pose: np.ndarray, heights: Sequence[float]) -> np.ndarray:
    """
    Return the part of a plan that a camera sees without occlusion.

    :param pose: (6,) metres, map frame, and radians.
    :param heights: of floor and ceiling, metres, which limit the rays.
    :returns: (M, 2) metres, map frame, corners of a polygon.
    """
    position, turn = pose[:3], rotation_matrix(*pose[3:])
    if model.lens.kind != PINHOLE:
        half = 0.5 * model.horizontal_fov
        azimuth = np.linspace(-half, half, 8 * STEPS)
        level = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)])
        arc = position + _ended(level @ turn.T, position[2], model.max_range, heights)
        full = half >= np.pi - 1e-6
        return arc[:, :2] if full else np.concatenate([arc, [position]])[:, :2]
    # Directions inside the rim are needed too: the optical axis may reach farthest in the plan.
    ways = np.concatenate([scale * rim(model) + [1.0 - scale, 0.0, 0.0]
                           for scale in np.linspace(0.1, 1.0, 10)])
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    ends = position + _ended(ways @ turn.T, position[2], model.max_range, heights)
    flat = np.concatenate([ends, [position]])[:, :2]
    return flat[ConvexHull(flat, qhull_options='QJ').vertices]


def _ended(ways: np.ndarray, height: float, far: float, heights: Sequence[float]
           ) -> np.ndarray:
    """Return directions (M, 3) with the length to the range, the floor or the ceiling."""
    room = np.where(ways[:, 2] > 0.0, heights[1] - height, height - heights[0])
    steep = np.maximum(np.abs(ways[:, 2]), 1e-9)
    return ways * np.minimum(far, np.maximum(room, 0.0) / steep)[:, None]


def edges(model: CameraModel, pose: np.ndarray, length: float) -> np.ndarray:
    """
    Return a camera's frustum as lines: its rim, and four rays to it for a pinhole camera.

    :param pose: (6,) metres, map frame, and radians.
    :param length: metres, from the camera to the rim.
    :returns: (M, 3) metres, map frame; a row of NaN between two lines; empty for an
        omnidirectional camera.
    """
    if model.lens.kind == OMNIDIRECTIONAL:
        return np.empty((0, 3))
    ring = pose[:3] + length * rim(model) @ rotation_matrix(*pose[3:]).T
    rays = [np.stack([pose[:3], ring[k]]) for k in range(0, len(ring), STEPS)]
    return chained([np.concatenate([ring, ring[:1]]),
                    *(rays if model.lens.kind == PINHOLE else [])])


def chained(lines: Sequence[np.ndarray]) -> np.ndarray:
    """Join lines (M, 3) into one array, with a row of NaN between two lines."""
    gap = np.full((1, 3), np.nan)
    return np.concatenate([part for line in lines for part in (line, gap)])[:-1]
