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

"""
Depth observation error: the error of the depth maps of a room if only some points are visible.

Equations 2 and 3 of arXiv 2110.11106, with the mean over a map's pixels instead of their sum. The
viewpoints are fixed, so the points that cover each pixel are listed once, nearest first. The depth
of a pixel for a partial cloud is that of the first visible point in its list.

The lists of neighbouring pixels begin with the same points, so the lists are stored as trees. If
the point of a node is visible, the depths of all pixels below the node are determined at once.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, LEVEL, Pose
from ocp_ros.geometry.packed_bits import no_bits
from ocp_ros.geometry.shadow_maps import footprint, projected
from ocp_ros.util.kernels import njit
from ocp_ros.util.threads import mapped

#: The largest side of a cube, in multiples of the median spacing: a stray point is a speck, not a
#: wall.
MAX_CUBE = 3.0


def five_viewpoints(corners: np.ndarray, height: float) -> np.ndarray:
    """
    Place the viewpoints of the paper: the centre, and 2/3 of the way from it to the corners.

    :param corners: (4, 2) the corners of the room's bounding rectangle, metres.
    :param height: z of the viewpoints, metres: half the height of the room.
    :returns: (5, 3) float64, metres.
    """
    centre = corners.mean(axis=0)
    flat = np.vstack([centre, centre + (corners - centre) * 2.0 / 3.0])
    return np.column_stack([flat, np.full(5, height)])


@njit(cache=True, nogil=True)
def _list_candidates(projection, order, half_sides, rows, columns, ends, indices):
    """
    Write the points that cover each pixel, in the given order.

    :param ends: (H * W,) int64, in and out: the next free index of each pixel, raised by one per
        point.
    :param indices: (L,) int32, out: the points; an empty array only counts them.
    """
    for i in order:
        first_row, last_row, first_column, count = footprint(
            projection.distance[i], projection.elevation[i], projection.azimuth[i],
            half_sides[i], rows, columns)
        for row in range(first_row, last_row + 1):
            for k in range(first_column, first_column + count):
                cell = row * columns + k % columns
                if indices.shape[0]:
                    indices[ends[cell]] = i
                ends[cell] += 1


class Trees(NamedTuple):
    """
    The point lists of all pixels as trees, parents before children; each field is (T,).

    :ivar point: uint32, the point of a node: the next one in the lists of all pixels below.
    :ivar end: uint32, the index of the first node after the subtree of this node.
    :ivar gap: float32, metres, the summed error of the pixels below if this point is the first
        visible one.
    :ivar rest: float32, metres, the summed error of the pixels whose list ends here, if none of
        its points is visible.
    """

    point: np.ndarray
    end: np.ndarray
    gap: np.ndarray
    rest: np.ndarray


@njit(cache=True, nogil=True)
def _grow(pixels, starts, indices, depths, far, longest):
    """
    Build the trees of the point lists of pixels.

    :param pixels: the pixels with a list, those with the same first points next to each other.
    :param starts: (H * W + 1,) int64, the start of each pixel's list.
    :param indices: (L,) int32, points.
    :param depths: (L,) float32, the distances of these points, metres.
    :param far: the depth of an empty pixel, metres.
    :param longest: the number of points of the longest list.
    :returns: the fields of :class:`Trees`.
    """
    most = indices.shape[0]
    point, end = np.empty(most, dtype=np.uint32), np.empty(most, dtype=np.uint32)
    gap, rest = np.zeros(most), np.zeros(most)
    path = np.empty(longest, dtype=np.int64)
    nodes = depth = last = 0
    for pixel in pixels:
        first, length = starts[pixel], starts[pixel + 1] - starts[pixel]
        shared = 0
        while (shared < min(length, depth)
               and indices[first + shared] == indices[last + shared]):
            shared += 1
        for k in range(shared, depth):
            end[path[k]] = nodes
        for k in range(shared, length):
            point[nodes] = indices[first + k]
            path[k] = nodes
            nodes += 1
        depth, last = length, first
        for k in range(length):
            gap[path[k]] += depths[first + k] - depths[first]
        rest[path[length - 1]] += far - depths[first]
    for k in range(depth):
        end[path[k]] = nodes
    return (point[:nodes].copy(), end[:nodes].copy(), gap[:nodes].astype(np.float32),
            rest[:nodes].astype(np.float32))


@njit(cache=True, nogil=True)
def lost_depth(trees, seen, most=np.inf):
    """
    Sum the depth errors of the pixels of all viewpoints.

    A pixel has a list of points, the nearest first, and shows the first of them that is seen. Its
    error is the distance of that point beyond the nearest one, or the whole depth that is missing
    if none is seen. So the subtree below a seen point is skipped; see :class:`Trees`.

    :param trees: the trees of a :class:`DepthError`.
    :param seen: (W,) uint64, packed bits of the points.
    :param most: metres; the sum may stop as soon as it exceeds this value.
    :returns: the sum, metres; the depth error is this sum divided by the number of pixels of a
        map.
    """
    total, node = 0.0, np.uint32(0)
    while node < trees.point.shape[0] and total <= most:
        point = trees.point[node]
        if (seen[point >> np.uint32(6)] >> np.uint64(point & np.uint32(63))) & np.uint64(1):
            total += trees.gap[node]
            node = trees.end[node]
        else:
            total += trees.rest[node]
            node += np.uint32(1)
    return total


@njit(cache=True, nogil=True)
def unsettled(trees, seen):
    """
    Remove the nodes at and below points that are visible anyway, and keep their error.

    :param trees: the trees of a :class:`DepthError`.
    :param seen: (W,) uint64, packed bits of the points.
    :returns: the remaining trees, whose ``rest`` includes the errors of removed nodes, and the
        summed error of trees that were removed as a whole, metres. For ``seen`` and any further
        points, :func:`lost_depth` of all trees equals that of the remaining trees plus this sum.
    """
    most = trees.point.shape[0]
    before, kept = np.empty(most + 1, dtype=np.uint32), np.empty(most, dtype=np.uint32)
    rest, path = np.empty(most, dtype=np.float32), np.empty(most, dtype=np.uint32)
    total, node, count, depth = 0.0, np.uint32(0), np.uint32(0), 0
    while node < most:
        while depth and trees.end[kept[path[depth - 1]]] <= node:
            depth -= 1
        before[node] = count
        point = trees.point[node]
        if (seen[point >> np.uint32(6)] >> np.uint64(point & np.uint32(63))) & np.uint64(1):
            # These pixels have this error unless a point above is visible.
            if depth:
                rest[path[depth - 1]] += trees.gap[node]
            else:
                total += trees.gap[node]
            node = trees.end[node]
        else:
            kept[count], rest[count], path[depth] = node, trees.rest[node], count
            count, depth, node = count + np.uint32(1), depth + 1, node + np.uint32(1)
    before[most] = count
    kept = kept[:count]
    return Trees(trees.point[kept], before[trees.end[kept]], trees.gap[kept], rest[:count]), total


@njit(cache=True, nogil=True)
def _lost_at(trees, seen, lost):
    """Add each pixel's error to the first point of its list, the true surface: ``lost`` (N,)."""
    node = np.uint32(0)
    while node < trees.point.shape[0]:
        first, last = trees.point[node], trees.end[node]
        while node < last:
            point = trees.point[node]
            if (seen[point >> np.uint32(6)] >> np.uint64(point & np.uint32(63))) & np.uint64(1):
                lost[first] += trees.gap[node]
                node = trees.end[node]
            else:
                lost[first] += trees.rest[node]
                node += np.uint32(1)


class DepthError:
    """
    The depth observation error of a scene for any subset of its points.

    :param points: (N, 3) float32, metres, map frame.
    :param spacing: (N,) float32, metres.
    :param far: the depth of an empty pixel, metres: the diameter of the room.
    :param places: (V, 3) metres, the viewpoints. For any number of them, the error is scaled to
        that of five.
    :param rows: rows of the depth maps; they have twice as many columns.
    :param folds: 1 for the error with all points. For n >= 2, each point belongs to one of n
        folds, and each viewpoint in turn leaves out the points of one fold; the error is scaled so
        that the error of seeing nothing stays the same. A placement whose error depends on single
        points of this scan does not reach that error on another scan.
    :ivar trees: the trees, for kernels that call :func:`lost_depth` many times.
    :ivar pixels: the divisor of the sum over all pixels: a fifth of the number of pixels of all
        viewpoints; scaled as described for ``folds``.
    """

    def __init__(self, points: np.ndarray, spacing: np.ndarray, far: float, places: np.ndarray,
                 rows: int, folds: int = 1) -> None:
        self.far = far
        self._count = len(points)
        self.viewpoints = places
        self.shape = (rows, 2 * rows)
        # The paper has five viewpoints.
        self.pixels = rows * 2 * rows * len(places) / 5
        # Half the side of the paper's cube is the spacing of the points. Smaller cubes leave holes
        # in the maps of a whole room.
        half_sides = np.minimum(spacing, MAX_CUBE * np.median(spacing)).astype(np.float32)
        # Folds are assigned in the order of distance from the first viewpoint, which does not
        # change when the scan is rotated.
        order = np.argsort(np.linalg.norm(points - places[0], axis=1), kind='stable')
        fold = np.empty(len(points), dtype=np.int64)
        fold[order] = np.random.default_rng(0).integers(folds, size=len(points))
        wanted = [(position, fold != number % folds if folds > 1 else None)
                  for number, position in enumerate(self.viewpoints)]
        self._maps, grown = [], []
        for trees, depth_map in mapped(
                lambda one: self._viewpoint(points, half_sides, *one), wanted):
            end = trees.end + np.uint32(sum(len(before.end) for before in grown))
            grown.append(trees._replace(end=end))
            depth_map.setflags(write=False)
            self._maps.append(depth_map)
        self.trees = Trees(*(np.concatenate(field) for field in zip(*grown)))
        #: The error of seeing nothing, metres.
        self.worst = self(no_bits(len(points)))
        if folds > 1:
            whole = sum(float((self.far - depth_map).sum(dtype=np.float64))
                        for depth_map in self._maps) / self.pixels
            self.pixels *= self.worst / whole
            self.worst = whole

    def _viewpoint(self, points: np.ndarray, half_sides: np.ndarray,
                   position: np.ndarray, kept: np.ndarray | None
                   ) -> tuple[Trees, np.ndarray]:
        """List the points that cover each pixel of one viewpoint, and compute its depth map."""
        rows, columns = self.shape
        # The range is so large that rounding never cuts off a far corner of the room.
        lens = CameraModel(max_range=2.0 * self.far).lens
        projection = projected(points, Pose(position, LEVEL), lens)
        order = np.argsort(projection.distance, kind='stable')
        order = order[np.isfinite(projection.distance[order])]
        counts = np.zeros(rows * columns, dtype=np.int64)
        _list_candidates(projection, order, half_sides, rows, columns, counts,
                         np.empty(0, dtype=np.int32))
        starts = np.concatenate([[0], np.cumsum(counts)])
        indices = np.empty(starts[-1], dtype=np.int32)
        _list_candidates(projection, order, half_sides, rows, columns, starts[:-1].copy(), indices)
        depth, pixels = np.full(rows * columns, self.far, dtype=np.float32), counts > 0
        depth[pixels] = projection.distance[indices[starts[:-1][pixels]]]
        if kept is not None:
            left = kept[indices]
            counts = np.diff(np.concatenate([[0], np.cumsum(left)])[starts])
            indices, starts = indices[left], np.concatenate([[0], np.cumsum(counts)])
        depths, pixels = projection.distance[indices], np.flatnonzero(counts)
        # Sorting by the six nearest points makes pixels with the same first points neighbours.
        sort_keys = 6
        padded = np.append(indices, np.zeros(sort_keys, dtype=np.int32))
        keys = [np.where(counts[pixels] > k, padded[starts[pixels] + k], -1)
                for k in range(sort_keys)]
        pixels = pixels[np.lexsort(keys[::-1])]
        trees = Trees(*_grow(pixels, starts, indices, depths, self.far, int(counts.max())))
        return trees, depth.reshape(self.shape)

    def depth_map(self, viewpoint: int) -> np.ndarray:
        """
        Return the depth map of the whole scene.

        :param viewpoint: the number of the viewpoint, from 0.
        :returns: (H, W) float32, metres; an empty pixel reads ``far``.
        """
        return self._maps[viewpoint]

    def __call__(self, seen: np.ndarray, most: float = np.inf) -> float:
        """
        Return the depth observation error of the visible points.

        :param seen: (W,) uint64, packed bits of the points.
        :param most: metres; if the error is above this value, any value above it may be returned.
        :returns: metres: the sum over five viewpoints of the mean over the pixels; for another
            number of viewpoints, five times their mean.
        """
        return lost_depth(self.trees, seen, most * self.pixels) / self.pixels

    def given(self, seen: np.ndarray) -> Callable[..., float]:
        """
        Return a fast function that computes the error of some points and one further view.

        :param seen: (W,) uint64, packed bits of the points.
        :returns: a function of a view ((W,) uint64, packed bits) and of ``most``, see
            :meth:`__call__`; it returns metres.
        """
        trees, settled = unsettled(self.trees, seen)
        return lambda view, most=np.inf: (
            settled + lost_depth(trees, view, most * self.pixels - settled)) / self.pixels

    def changes(self, beside: Sequence[np.ndarray], views: Sequence[np.ndarray], floor: float
                ) -> np.ndarray:
        """
        Return the change of the error by each of many views, added to some given views.

        :param beside: the given views: any number of (W,) uint64, packed bits of the points.
        :param views: M views of the same form.
        :param floor: the share of the error of seeing nothing that is added to both errors.
        :returns: (M,) logarithms of (error with the view / error without it); less is better.
        """
        seen = np.bitwise_or.reduce([no_bits(self._count), *beside])
        added, error = floor * self.worst, self.given(seen)
        beyond = np.array([error(view) for view in views])
        return np.log((beyond + added) / (self(seen) + added))

    def error_by_point(self, seen: np.ndarray) -> np.ndarray:
        """
        Return the error by points: that of a pixel goes to the point that it should show.

        :param seen: (W,) uint64, packed bits of the points.
        :returns: (N,) metres, in the order of the points; their sum is the error.
        """
        lost = np.zeros(self._count)
        _lost_at(self.trees, seen, lost)
        return lost / self.pixels
