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
viewpoints are fixed, so the points that cover each pixel are listed once, nearest first. If only
some points are visible, the depth of a pixel is that of the first visible point in its list.

The lists of neighbouring pixels begin with the same points, so the lists are stored as trees. If
the point of a node is visible, it sets the depths of all pixels below the node at once.
"""

from collections.abc import Callable, Sequence
from copy import copy
from functools import cached_property
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, LEVEL, Pose
from ocp_ros.geometry.packed_bits import no_bits
from ocp_ros.geometry.shadow_maps import footprints, projected, splat
from ocp_ros.util.kernels import njit
from ocp_ros.util.threads import mapped

#: The largest half side of a point's cube, in multiples of the median spacing of all points: a
#: stray point must not cover as much as a wall.
MAX_HALF_SIDE = 3.0


def five_viewpoints(corners: np.ndarray, height: float) -> np.ndarray:
    """
    Return the viewpoints of arXiv 2110.11106: the centre, and 2/3 of the way to each corner.

    :param corners: (4, 2) the corners of the room's bounding rectangle, metres.
    :param height: z of the viewpoints, metres: half the height of the room.
    :returns: (5, 3) float64, metres.
    """
    centre = corners.mean(axis=0)
    positions_xy = np.vstack([centre, centre + (corners - centre) * 2.0 / 3.0])
    return np.column_stack([positions_xy, np.full(5, height)])


@njit(cache=True, nogil=True)
def _list_points(covered, order, columns, ends, indices):
    """
    Write the points that cover each pixel of a map of H rows and W columns, in the given order.

    :param covered: :class:`~ocp_ros.geometry.shadow_maps.Footprints` of N points.
    :param order: (M,) indices of the points to list, the nearest first.
    :param columns: W.
    :param ends: (H * W,) int64, in and out: the end of each pixel's list in ``indices``, raised by
        one per point.
    :param indices: (L,) int32, out: the L entries of all lists; if empty, entries are only
        counted.
    """
    for i in order:
        first_column = covered.first_column[i]
        for row in range(covered.first_row[i], covered.last_row[i] + 1):
            for k in range(first_column, first_column + covered.count[i]):
                # Columns beyond the last one continue at the first one.
                pixel = row * columns + k - columns * (k >= columns)
                if indices.shape[0]:
                    indices[ends[pixel]] = i
                ends[pixel] += 1


class Trees(NamedTuple):
    """
    The point lists of all pixels as trees of T nodes, parents before children.

    Each field is (T,).

    :ivar point: uint32, the point of a node: the next one in the lists of all pixels below.
    :ivar end: uint32, the index of the first node after the subtree of this node.
    :ivar gap: float32, metres, the summed error of the pixels below if this point is the first
        visible one in their lists.
    :ivar rest: float32, metres, the summed error of the pixels whose list ends here, if none of
        its points is visible.
    """

    point: np.ndarray
    end: np.ndarray
    gap: np.ndarray
    rest: np.ndarray


@njit(cache=True, nogil=True)
def _build_trees(pixels, starts, indices, depths, empty_depth, max_length):
    """
    Build the trees of the point lists of pixels.

    :param pixels: the pixels with a list, those with the same first points next to each other.
    :param starts: (H * W + 1,) int64, the start of each pixel's list in ``indices``.
    :param indices: (L,) int32, the points of all lists.
    :param depths: (L,) float32, the distances of these points, metres.
    :param empty_depth: the depth of an empty pixel, metres.
    :param max_length: the number of points of the longest list.
    :returns: the fields of :class:`Trees`.
    """
    size = indices.shape[0]
    point, end = np.empty(size, dtype=np.uint32), np.empty(size, dtype=np.uint32)
    gap, rest = np.zeros(size), np.zeros(size)
    # The nodes of the points of the list that was added last; it begins at ``path_start``.
    path = np.empty(max_length, dtype=np.int64)
    path_length = path_start = nodes = 0
    for pixel in pixels:
        start, length = starts[pixel], starts[pixel + 1] - starts[pixel]
        # The number of first points that both lists share; these points have nodes already.
        shared = 0
        while (shared < min(length, path_length)
               and indices[start + shared] == indices[path_start + shared]):
            shared += 1
        # The subtrees of the other points of the last list end here.
        for k in range(shared, path_length):
            end[path[k]] = nodes
        for k in range(shared, length):
            point[nodes] = indices[start + k]
            path[k] = nodes
            nodes += 1
        path_length, path_start = length, start
        # The errors of this pixel if point k is the first visible one, and if none is visible.
        for k in range(length):
            gap[path[k]] += depths[start + k] - depths[start]
        rest[path[length - 1]] += empty_depth - depths[start]
    for k in range(path_length):
        end[path[k]] = nodes
    return (point[:nodes].copy(), end[:nodes].copy(), gap[:nodes].astype(np.float32),
            rest[:nodes].astype(np.float32))


@njit(cache=True, nogil=True)
def lost_depth(trees, seen, max_sum=np.inf):
    """
    Sum the depth errors of the pixels of all viewpoints.

    A pixel has a list of points, the nearest first, and shows the first visible one. The error of
    a pixel is how much farther that point is than the nearest one of the list. If no point of the
    list is visible, the error is the depth of an empty pixel minus that of the nearest point. A
    visible point decides all pixels below it, so its subtree is skipped; see :class:`Trees`.

    :param trees: the trees of a :class:`DepthError`.
    :param seen: (W,) uint64, packed bits of the points, 64 a word: whether each is visible.
    :param max_sum: metres; the summation may stop as soon as the sum exceeds this value.
    :returns: the sum, metres; divided by ``DepthError.pixels`` it is the depth error.
    """
    total = 0.0
    node = np.uint32(0)
    while node < trees.point.shape[0] and total <= max_sum:
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
    Return the trees without the nodes at and below visible points, and the error of these nodes.

    :param trees: the trees of a :class:`DepthError`.
    :param seen: (W,) uint64, packed bits of the points: whether each is visible.
    :returns: the remaining trees, whose ``rest`` includes the errors of removed nodes, and the
        summed error of trees that were removed as a whole, metres. For ``seen`` and any further
        points, :func:`lost_depth` of all trees equals that of the remaining trees plus this sum.
    """
    size = trees.point.shape[0]
    # The number of kept nodes before each node, and the kept nodes.
    ranks, kept = np.empty(size + 1, dtype=np.uint32), np.empty(size, dtype=np.uint32)
    rest = np.empty(size, dtype=np.float32)
    # The kept nodes above the current one, by their indices among the kept ones.
    path = np.empty(size, dtype=np.uint32)
    path_length = 0
    total = 0.0
    node = count = np.uint32(0)
    while node < size:
        while path_length and trees.end[kept[path[path_length - 1]]] <= node:
            path_length -= 1
        ranks[node] = count
        point = trees.point[node]
        if (seen[point >> np.uint32(6)] >> np.uint64(point & np.uint32(63))) & np.uint64(1):
            # The pixels below have this error if no point above is visible.
            if path_length:
                rest[path[path_length - 1]] += trees.gap[node]
            else:
                total += trees.gap[node]
            node = trees.end[node]
        else:
            kept[count], rest[count], path[path_length] = node, trees.rest[node], count
            path_length += 1
            count, node = count + np.uint32(1), node + np.uint32(1)
    ranks[size] = count
    kept = kept[:count]
    # A subtree of a kept node never ends inside a removed one, so its end has a rank.
    return Trees(trees.point[kept], ranks[trees.end[kept]], trees.gap[kept], rest[:count]), total


@njit(cache=True, nogil=True)
def _add_lost_depth(trees, seen, lost):
    """Add each pixel's error, metres, to ``lost`` (N,) at the nearest point of its list."""
    node = np.uint32(0)
    # One tree at a time: its root is the nearest point of all its pixels.
    while node < trees.point.shape[0]:
        nearest, tree_end = trees.point[node], trees.end[node]
        while node < tree_end:
            point = trees.point[node]
            if (seen[point >> np.uint32(6)] >> np.uint64(point & np.uint32(63))) & np.uint64(1):
                lost[nearest] += trees.gap[node]
                node = trees.end[node]
            else:
                lost[nearest] += trees.rest[node]
                node += np.uint32(1)


def _join(arrays: list[np.ndarray]) -> np.ndarray:
    """Concatenate the arrays of a list, and empty it."""
    joined = np.concatenate(arrays)
    arrays.clear()
    return joined


def pixel_angles(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return elevations (H,) and azimuths (W,), radians, of a depth map of H rows, W columns."""
    return (((np.arange(rows) + 0.5) / rows - 0.5) * np.pi,
            ((np.arange(columns) + 0.5) / columns - 0.5) * 2.0 * np.pi)


class Unscanned(NamedTuple):
    """
    What a scan does not show from V viewpoints: directions without any point.

    Gaps of less than three pixels are those between points.

    :ivar shares: (V,) of the pixels of each map, 0 to 1.
    :ivar error: metres, the depth error if there are surfaces at the bounding box of the points,
        of which none is visible.
    """

    shares: np.ndarray
    error: float


def unscanned_share(points: np.ndarray, spacing: np.ndarray, position: np.ndarray, far: float,
                    rows: int) -> float:
    """
    Return the share of :class:`Unscanned` from one position, without its error.

    :param points: (N, 3) float32, metres; their ``spacing`` (N,), metres.
    :param position: (3,) metres.
    :param far: metres, the diameter of the room.
    :param rows: rows of the map.
    """
    lens = CameraModel(max_range=far).lens
    projection = projected(np.ascontiguousarray(points.T), Pose(position, LEVEL), lens)
    inverse_map = splat(projection, footprints(projection, _half_sides(spacing), rows, 2 * rows),
                        far, rows, 2 * rows)
    return float(_without_gaps(inverse_map <= np.float32(1.0 / far)).mean())


def _half_sides(spacing: np.ndarray) -> np.ndarray:
    """Return half the side of each point's cube, metres: (N,) float32."""
    # Half the side of the paper's cube is the spacing of the points. Smaller cubes leave holes in
    # the maps of a whole room.
    return np.minimum(spacing, MAX_HALF_SIDE * np.median(spacing)).astype(np.float32)


def _without_gaps(empty: np.ndarray) -> np.ndarray:
    """Return which pixels (H, W) of a map are empty, without gaps of less than three pixels."""
    for reduce in (np.all, np.any):
        # Columns go around, rows end at the poles.
        padded = np.pad(np.pad(empty, ((1, 1), (0, 0)), 'edge'), ((0, 0), (1, 1)), 'wrap')
        empty = reduce(np.lib.stride_tricks.sliding_window_view(padded, (3, 3)), axis=(2, 3))
    return empty


def _unscanned(depth_map: np.ndarray, position: np.ndarray, bounds: np.ndarray, far: float
               ) -> tuple[float, float]:
    """
    Return the share of the pixels that are empty, and the sum of their depth errors, metres.

    :param depth_map: (H, W) metres; an empty pixel reads ``far``.
    :param bounds: (2, 3) metres, the bounding box of all points.
    """
    empty = _without_gaps(depth_map >= far)
    elevation, azimuth = (angles[index] for angles, index in zip(
        pixel_angles(*depth_map.shape), np.nonzero(empty)))
    directions = np.column_stack([np.cos(elevation) * np.cos(azimuth),
                                  np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    # Pixels are centred beside the axes, so that no component is 0.
    exits = (np.where(directions > 0.0, bounds[1], bounds[0]) - position) / directions
    return float(empty.mean()), float((far - np.clip(exits.min(axis=1), 0.0, far)).sum())


class DepthError:
    """
    The depth observation error of a scene for any subset of its points.

    :param points: (N, 3) float32, N points, metres, map frame.
    :param spacing: (N,) float32, the distance of each point to its nearest neighbour, metres.
    :param empty_depth: the depth of an empty pixel, metres: the diameter of the room.
    :param viewpoints: (V, 3) metres, the V viewpoints of the depth maps. The error is scaled to
        that of five viewpoints.
    :param rows: rows of the depth maps; they have twice as many columns.
    :param folds: 1 for the error with all points. For n >= 2, each point belongs to one of n
        folds, and each viewpoint in turn leaves out the points of one fold; the error is scaled so
        that the error of seeing nothing stays the same. A placement whose error depends on single
        points of this scan does not reach that error on another scan.
    :ivar far: the depth of an empty pixel, metres.
    :ivar shape: rows and columns of the depth maps.
    :ivar trees: the trees, for kernels that call :func:`lost_depth` many times.
    :ivar pixels: the divisor of the sum over all pixels: a fifth of the number of pixels of all
        viewpoints; scaled as described for ``folds``.
    :ivar worst: the error of seeing nothing, metres.
    """

    def __init__(self, points: np.ndarray, spacing: np.ndarray, empty_depth: float,
                 viewpoints: np.ndarray, rows: int, folds: int = 1) -> None:
        self.far = empty_depth
        self._count = len(points)
        self.viewpoints = viewpoints
        self.shape = (rows, 2 * rows)
        # The paper sums over five viewpoints. With folds, this number is scaled below.
        self.pixels = rows * 2 * rows * len(viewpoints) / 5
        half_sides = _half_sides(spacing)
        # Folds are assigned in the order of distance from the first viewpoint, which does not
        # change when the scan is rotated.
        order = np.argsort(np.linalg.norm(points - viewpoints[0], axis=1), kind='stable')
        fold = np.empty(len(points), dtype=np.int64)
        fold[order] = np.random.default_rng(0).integers(folds, size=len(points))
        # Of each viewpoint: its position and the points that it does not leave out.
        inputs = [(position, (fold != number % folds) if folds > 1 else None)
                  for number, position in enumerate(viewpoints)]
        results = mapped(lambda pair: self._trees_and_map(points, half_sides, *pair), inputs)
        self._maps = [depth_map for _, depth_map in results]
        for depth_map in self._maps:
            depth_map.setflags(write=False)
        parts = Trees(*map(list, zip(*(trees for trees, _ in results))))
        # All trees need much memory, so those of a viewpoint are freed when they are joined.
        del results
        self._bounds = np.stack([points.min(axis=0), points.max(axis=0)])
        #: The first node of each viewpoint, and the number of all nodes: (V + 1,).
        self._starts = np.cumsum([0, *map(len, parts.end)])
        for number, start in enumerate(self._starts[:-1]):
            # The indices of nodes go on after the trees of earlier viewpoints.
            parts.end[number] = parts.end[number] + np.uint32(start)
        self.trees = Trees(*map(_join, parts))
        # Calling this object computes an error, here without any visible point.
        self.worst = self(no_bits(len(points)))
        if folds > 1:
            # The error of seeing nothing without folds, to which the error with folds is scaled.
            full_worst = sum(float((self.far - depth_map).sum(dtype=np.float64))
                             for depth_map in self._maps) / self.pixels
            self.pixels *= self.worst / full_worst
            self.worst = full_worst

    def _trees_and_map(self, points: np.ndarray, half_sides: np.ndarray, position: np.ndarray,
                       kept: np.ndarray | None) -> tuple[Trees, np.ndarray]:
        """
        Return the trees of one viewpoint, and its depth map with all points.

        :param points: (N, 3) metres.
        :param half_sides: (N,) half the side of each point's cube, metres.
        :param position: (3,) the viewpoint, metres.
        :param kept: (N,) bool, the points in the trees; None for all.
        """
        rows, columns = self.shape
        # The range is so large that rounding never cuts off a far corner of the room.
        lens = CameraModel(max_range=2.0 * self.far).lens
        projection = projected(np.ascontiguousarray(points.T), Pose(position, LEVEL), lens)
        covered = footprints(projection, half_sides, rows, columns)
        order = np.argsort(projection.distance, kind='stable')
        order = order[np.isfinite(projection.distance[order])]
        # Count the points of each pixel, then list them.
        counts = np.zeros(rows * columns, dtype=np.int64)
        _list_points(covered, order, columns, counts, np.empty(0, dtype=np.int32))
        starts = np.concatenate([[0], np.cumsum(counts)])
        indices = np.empty(starts[-1], dtype=np.int32)
        # The call raises the starts to the ends of the lists, so it gets a copy.
        _list_points(covered, order, columns, starts[:-1].copy(), indices)
        depth_map = np.full(rows * columns, self.far, dtype=np.float32)
        filled = counts > 0
        # The first point of each list is the nearest.
        depth_map[filled] = projection.distance[indices[starts[:-1][filled]]]
        # Leave out the points of the fold, and count the others of each list by cumulated sums.
        if kept is not None:
            in_trees = kept[indices]
            counts = np.diff(np.concatenate([[0], np.cumsum(in_trees)])[starts])
            starts = np.concatenate([[0], np.cumsum(counts)])
            indices = indices[in_trees]
        depths = projection.distance[indices]
        pixels = np.flatnonzero(counts)
        # Sorting by the six nearest points makes pixels with the same first points neighbours.
        # Shorter lists have the key -1; the padding is for the last lists, and lexsort takes the
        # last key first.
        sort_keys = 6
        padded = np.append(indices, np.zeros(sort_keys, dtype=np.int32))
        keys = [np.where(counts[pixels] > k, padded[starts[pixels] + k], -1)
                for k in range(sort_keys)]
        pixels = pixels[np.lexsort(keys[::-1])]
        fields = _build_trees(pixels, starts, indices, depths, self.far, int(counts.max()))
        return Trees(*fields), depth_map.reshape(self.shape)

    @cached_property
    def unscanned(self) -> Unscanned:
        """Return what the scan does not show, whatever is visible; only a promise asks for it."""
        shares, sums = zip(*(_unscanned(depth_map, position, self._bounds, self.far)
                             for depth_map, position in zip(self._maps, self.viewpoints)))
        # Its maps have all points, so that ``folds`` do not scale it.
        return Unscanned(np.array(shares), sum(sums) / (self._maps[0].size * len(self._maps) / 5))

    def parts(self, groups: np.ndarray) -> dict[int, 'DepthError']:
        """
        Return the errors of groups of viewpoints, whose sum is the error.

        :param groups: (V,) int, the group of each viewpoint; viewpoints of a group follow on each
            other.
        :returns: by group, in its share of the error.
        """
        parts = {}
        for group in np.unique(groups):
            rows = np.flatnonzero(groups == group)
            nodes = slice(self._starts[rows[0]], self._starts[rows[-1] + 1])
            trees = Trees(*(field[nodes] for field in self.trees))
            parts[int(group)] = part = copy(self)
            part.trees = trees._replace(end=trees.end - np.uint32(nodes.start))
            vars(part).pop('unscanned', None)
            part.viewpoints = self.viewpoints[rows]
            part._maps = [self._maps[row] for row in rows]
            part._starts = self._starts[rows[0]:rows[-1] + 2] - nodes.start
            part.worst = part(no_bits(self._count))
        return parts

    def depth_map(self, viewpoint: int) -> np.ndarray:
        """
        Return the depth map of the whole scene from one viewpoint.

        :param viewpoint: the number of the viewpoint, from 0.
        :returns: (H, W) float32, metres, in H rows and W columns; an empty pixel reads ``far``.
        """
        return self._maps[viewpoint]

    def __call__(self, seen: np.ndarray, max_error: float = np.inf) -> float:
        """
        Return the depth observation error if only some points are visible.

        :param seen: (W,) uint64, packed bits of the points, 64 a word: whether each is visible.
        :param max_error: metres; for a larger error, any value above this one may be returned.
        :returns: metres: the sum over five viewpoints of the mean over the pixels; for another
            number of viewpoints, five times their mean.
        """
        return lost_depth(self.trees, seen, max_error * self.pixels) / self.pixels

    def given(self, seen: np.ndarray) -> Callable[..., float]:
        """
        Return a fast function that computes the error of given points plus one further view.

        :param seen: (W,) uint64, packed bits of the given points, which are visible.
        :returns: a function of the view ((W,) uint64, packed bits of its visible points) and of
            ``max_error``, see :meth:`__call__`; it returns the error, metres.
        """
        trees, settled = unsettled(self.trees, seen)
        return lambda view, max_error=np.inf: (
            settled + lost_depth(trees, view, max_error * self.pixels - settled)) / self.pixels

    def changes(self, given_views: Sequence[np.ndarray], views: Sequence[np.ndarray],
                floor_share: float) -> np.ndarray:
        """
        Return the change of the error by each of many views, if it is added to given views.

        :param given_views: any number of views: (W,) uint64, packed bits of the visible points.
        :param views: M views of the same form.
        :param floor_share: the share of the error of seeing nothing that is added to both errors,
            since 0 has no logarithm.
        :returns: (M,) logarithms of (error with the view / error without it); less is better.
        """
        seen = np.bitwise_or.reduce([no_bits(self._count), *given_views])
        offset = floor_share * self.worst
        errors = np.array([*map(self.given(seen), views)])
        return np.log((errors + offset) / (self(seen) + offset))

    def error_by_point(self, seen: np.ndarray) -> np.ndarray:
        """
        Return the error by points: that of a pixel belongs to the nearest point in its list.

        :param seen: (W,) uint64, packed bits of the points: whether each is visible.
        :returns: (N,) metres, in the order of the points; their sum is the error.
        """
        lost = np.zeros(self._count)
        _add_lost_depth(self.trees, seen, lost)
        return lost / self.pixels
