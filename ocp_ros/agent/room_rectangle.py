# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The corners that a room may have beyond what has been seen of it."""

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from ocp_ros.scenes.scene import SceneError

#: Metres: how far inside a corner of the room one looks whether it is there.
INSIDE = 0.3
#: Metres: a box that the corners enlarge by no more than this is left as it is.
SAME = 0.05


def smallest_rectangle(points: np.ndarray) -> np.ndarray:
    """
    Find the rectangle of least area around points: rooms have right angles.

    One of its sides lies on a side of the convex hull (Freeman and Shapira, 1975).

    :param points: (N, 2).
    :returns: (4, 2) its corners.
    :raises SceneError: if the points are on a line.
    """
    try:
        hull = points[ConvexHull(points).vertices].astype(np.float64)
    except QhullError as error:
        raise SceneError('observed cloud: found all points on a line, seen from above; expected '
                         'a room with volume') from error
    sides = np.roll(hull, -1, axis=0) - hull
    along = sides / np.linalg.norm(sides, axis=1, keepdims=True)
    axes = np.stack([along, np.stack([-along[:, 1], along[:, 0]], axis=1)], axis=1)
    spans = axes @ hull.T
    low, high = spans.min(axis=2), spans.max(axis=2)
    best = int(np.argmin(np.prod(high - low, axis=1)))
    ends = np.array([[x, y] for x in (low[best, 0], high[best, 0])
                     for y in (low[best, 1], high[best, 1])])
    return ends @ axes[best]


def inset(corners: np.ndarray) -> np.ndarray:
    """Return places a little inside the corners of a rectangle: (4, 2) metres."""
    way = corners.mean(axis=0) - corners
    length = np.linalg.norm(way, axis=1, keepdims=True)
    return corners + way * np.minimum(INSIDE / length, 1.0)


def with_corners(bounds: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the box (2, 3) around a box and some corners (C, 2), metres."""
    larger = bounds.copy()
    larger[0, :2] = np.minimum(bounds[0, :2], corners.min(axis=0, initial=np.inf))
    larger[1, :2] = np.maximum(bounds[1, :2], corners.max(axis=0, initial=-np.inf))
    return np.where(np.abs(larger - bounds) > SAME, larger, bounds)
