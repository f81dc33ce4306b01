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

"""Shapes of fields of view to draw: the part of a plan in range, and the edges of a frustum."""

from collections.abc import Sequence

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, OMNIDIRECTIONAL, PINHOLE, rotation_matrix
from scipy.spatial import ConvexHull

#: Number of directions along each edge of a field of view.
EDGE_STEPS = 25


def rim(model: CameraModel) -> np.ndarray:
    """
    Return the directions of M points once around the edge of a field of view.

    :returns: (M, 3) unit vectors, body frame (x forward, y left, z up).
    """
    lens, steps = model.lens, np.linspace(-1.0, 1.0, EDGE_STEPS)
    ones = np.ones_like(steps)
    # Four edges of a square from -1 to 1: bottom, left, top and right. Left is 1, as y is left.
    horizontal = np.concatenate([steps, ones, -steps, -ones])
    vertical = np.concatenate([-ones, steps, ones, -steps])
    if lens.kind == PINHOLE:
        # For a pinhole camera the halves are tangents, which are coordinates at x = 1.
        directions = np.column_stack([np.ones(len(horizontal)), horizontal * lens.half_horizontal,
                                      vertical * lens.half_vertical])
        return directions / np.linalg.norm(directions, axis=1, keepdims=True)
    azimuth = horizontal * 0.5 * model.horizontal_fov
    elevation = vertical * 0.5 * model.vertical_fov
    return np.column_stack([np.cos(elevation) * np.cos(azimuth),
                            np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])


def reach(model: CameraModel, pose: np.ndarray, heights: Sequence[float]) -> np.ndarray:
    """
    Return the part of the floor plan that a camera would see if nothing hid anything.

    :param pose: (6,) metres, map frame, and radians.
    :param heights: heights of floor and ceiling, metres, map frame, which limit the rays.
    :returns: (M, 2) metres, map frame: the M corners of a polygon.
    """
    position, rotation = pose[:3], rotation_matrix(*pose[3:])
    if model.lens.kind != PINHOLE:
        # A circle around the camera, or a sector with the camera as its tip.
        half_angle = 0.5 * model.horizontal_fov
        azimuth = np.linspace(-half_angle, half_angle, 8 * EDGE_STEPS)
        horizontal = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)])
        ends = _ray_ends(position, horizontal @ rotation.T, model.max_range, heights)
        full_circle = half_angle >= np.pi - 1e-6
        return ends[:, :2] if full_circle else np.concatenate([ends, [position]])[:, :2]
    # Directions between the optical axis (scale 0) and the rim (scale 1) are needed too, since the
    # directions near the optical axis may reach farthest in the plan.
    directions = np.concatenate([scale * rim(model) + [1.0 - scale, 0.0, 0.0]
                                 for scale in np.linspace(0.1, 1.0, 10)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ends = _ray_ends(position, directions @ rotation.T, model.max_range, heights)
    corners = np.concatenate([ends, [position]])[:, :2]
    # With the option QJ, corners on one line are no error.
    return corners[ConvexHull(corners, qhull_options='QJ').vertices]


def _ray_ends(position: np.ndarray, directions: np.ndarray, max_range: float,
              heights: Sequence[float]) -> np.ndarray:
    """Return the ends (M, 3) of rays along M directions, at the range, the floor or ceiling."""
    below, above = position[2] - heights[0], heights[1] - position[2]
    space = np.where(directions[:, 2] > 0.0, above, below)
    slopes = np.maximum(np.abs(directions[:, 2]), 1e-9)
    return position + directions * np.minimum(max_range, np.maximum(space, 0.0) / slopes)[:, None]


def edges(model: CameraModel, pose: np.ndarray, length: float) -> np.ndarray:
    """
    Return a camera's frustum as lines: its rim, and for a pinhole camera four rays to the rim.

    :param pose: (6,) metres, map frame, and radians.
    :param length: metres, from the camera to the rim.
    :returns: (M, 3) metres, map frame, points of lines with a row of NaN between two lines; empty
        for an omnidirectional camera.
    """
    if model.lens.kind == OMNIDIRECTIONAL:
        return np.empty((0, 3))
    ring = pose[:3] + length * rim(model) @ rotation_matrix(*pose[3:]).T
    # Each of the four edges in the ring begins at a corner of the field of view.
    rays = [np.stack([pose[:3], ring[k]]) for k in range(0, len(ring), EDGE_STEPS)]
    return chained([np.concatenate([ring, ring[:1]]),
                    *(rays if model.lens.kind == PINHOLE else [])])


def chained(lines: Sequence[np.ndarray]) -> np.ndarray:
    """Return lines (M, 3) as one array, with a row of NaN between two lines."""
    gap = np.full((1, 3), np.nan)
    return np.concatenate([rows for line in lines for rows in (line, gap)])[:-1]
