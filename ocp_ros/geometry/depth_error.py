# SPDX-License-Identifier: Apache-2.0
"""
Depth observation error: what the depth maps of a room lose if only some points are seen.

Equations 2 and 3 of arXiv 2110.11106, with the mean over a map's pixels instead of their sum. The
viewpoints never move, so the points that cover each pixel are listed once, nearest first; the
depth of a partial cloud is then the first visible entry of each list.
"""

from dataclasses import dataclass

from numba import njit
import numpy as np

from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.geometry.shadow_maps import footprint, Pose, project, Projection


def viewpoints(bounds: np.ndarray) -> np.ndarray:
    """
    Place the viewpoints: the centre, and 2/3 of the way from it to the corners, at half height.

    :param bounds: (2, 3), lowest and highest corner, metres.
    :returns: (5, 3) float64, metres.
    """
    centre = bounds.mean(axis=0)
    half = 0.5 * (bounds[1] - bounds[0])
    signs = np.array([[0, 0], [-1, -1], [-1, 1], [1, -1], [1, 1]], dtype=np.float64)
    offsets = np.zeros((5, 3))
    offsets[:, :2] = signs * half[:2] * 2.0 / 3.0
    return centre + offsets


@njit(cache=True, nogil=True)
def _count_candidates(projection, order, half_sides, rows, columns, counts):
    """Count the points that cover each pixel: counts (H * W,) int64, out."""
    for i in order:
        first_row, last_row, first_column, count = footprint(
            projection.distance[i], projection.elevation[i], projection.azimuth[i],
            half_sides[i], rows, columns)
        for row in range(first_row, last_row + 1):
            for k in range(first_column, first_column + count):
                counts[row * columns + k % columns] += 1


@njit(cache=True, nogil=True)
def _list_candidates(projection, order, half_sides, rows, columns, ends, indices):
    """Write each pixel's points in the given order; ends (H * W,) int64 moves to each end."""
    for i in order:
        first_row, last_row, first_column, count = footprint(
            projection.distance[i], projection.elevation[i], projection.azimuth[i],
            half_sides[i], rows, columns)
        for row in range(first_row, last_row + 1):
            for k in range(first_column, first_column + count):
                cell = row * columns + k % columns
                indices[ends[cell]] = i
                ends[cell] += 1


@njit(cache=True, nogil=True)
def _error(first, starts, indices, depths, full, far, visible):
    """Sum |partial depth - full depth| over the covered pixels of one viewpoint."""
    total = 0.0
    for pixel in range(first.shape[0]):
        # Most often the nearest point is seen, and nothing is missing.
        if visible[first[pixel]]:
            continue
        depth = far
        for k in range(starts[pixel] + 1, starts[pixel + 1]):
            if visible[indices[k]]:
                depth = depths[k]
                break
        total += depth - full[pixel]
    return total


@dataclass(frozen=True)
class _View:
    """
    One viewpoint: the points that cover each covered pixel, nearest first.

    :ivar pixels: (C,) the covered pixels; in the others there is nothing to miss.
    :ivar first: (C,) int32, the nearest point of each.
    :ivar starts: (C + 1,) int32, where each pixel's list begins.
    :ivar indices: (L,) int32, points.
    :ivar depths: (L,) float32, their distances, metres.
    :ivar full: (C,) float32, distance of the nearest, metres.
    """

    pixels: np.ndarray
    first: np.ndarray
    starts: np.ndarray
    indices: np.ndarray
    depths: np.ndarray
    full: np.ndarray


class DepthError:
    """
    The depth observation error of a scene for any subset of its points.

    :param points: (N, 3) float32, metres, map frame.
    :param spacing: (N,) float32, metres.
    :param bounds: (2, 3), lowest and highest corner, metres.
    :param rows: rows of the depth maps; they have twice as many columns.
    :param cube_scale: half the side of a point's cube in multiples of its spacing.
    """

    def __init__(self, points: np.ndarray, spacing: np.ndarray, bounds: np.ndarray, rows: int,
                 cube_scale: float) -> None:
        self.far = float(np.linalg.norm(bounds[1] - bounds[0]))
        self.shape = (rows, 2 * rows)
        self.viewpoints = viewpoints(bounds)
        half_sides = (cube_scale * spacing).astype(np.float32)
        self._views = [self._view(points, half_sides, position) for position in self.viewpoints]
        #: The error of seeing nothing, metres.
        self.worst = self(np.zeros(len(points), dtype=bool))

    def _view(self, points: np.ndarray, half_sides: np.ndarray, position: np.ndarray) -> _View:
        """List the candidates of every pixel of one viewpoint, nearest first."""
        rows, columns = self.shape
        projection = Projection.empty(len(points))
        # Far enough that a room's own far corner is never cut off by rounding.
        lens = CameraModel(max_range=2.0 * self.far).lens
        project(points, Pose(position, np.eye(3)), lens, projection)
        order = np.argsort(projection.distance, kind='stable')
        order = order[np.isfinite(projection.distance[order])]
        counts = np.zeros(rows * columns, dtype=np.int64)
        _count_candidates(projection, order, half_sides, rows, columns, counts)
        ends = np.concatenate([[0], np.cumsum(counts)])
        indices = np.empty(ends[-1], dtype=np.int32)
        _list_candidates(projection, order, half_sides, rows, columns, ends[:-1].copy(), indices)
        pixels = np.flatnonzero(counts)
        starts = np.append(ends[pixels], ends[-1]).astype(np.int32)
        depths = projection.distance[indices]
        return _View(pixels, indices[starts[:-1]], starts, indices, depths, depths[starts[:-1]])

    def depth_map(self, viewpoint: int) -> np.ndarray:
        """
        Return the depth map of the whole scene.

        :param viewpoint: 0 to 4.
        :returns: (H, W) float32, metres; an empty pixel reads the bounding box's diagonal.
        """
        view = self._views[viewpoint]
        depth = np.full(self.shape[0] * self.shape[1], self.far, dtype=np.float32)
        depth[view.pixels] = view.full
        return depth.reshape(self.shape)

    def __call__(self, visible: np.ndarray) -> float:
        """
        Return the depth observation error of the visible points.

        :param visible: (N,) bool.
        :returns: metres: the sum over the viewpoints of the mean over the pixels.
        """
        total = sum(_error(view.first, view.starts, view.indices, view.depths, view.full,
                           np.float32(self.far), visible) for view in self._views)
        return float(total / (self.shape[0] * self.shape[1]))
