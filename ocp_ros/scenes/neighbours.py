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
Find the nearest neighbours of all points within a cloud.

Clouds that were thinned on a voxel grid have an even density: the nearest points of a point lie in
the few cells of a coarse grid around it, and searching these cells is faster than building a tree.
Points whose neighbours are not found there, and uneven clouds, are searched with a k-d tree.
"""

from itertools import product

import numpy as np
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.util.kernels import njit
from ocp_ros.util.threads import mapped
from scipy.spatial import cKDTree


def nearest(points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """
    Find the points nearest to each point, itself first.

    :param points: (N, 3), metres, N >= 1.
    :param count: the number K of points to find.
    :returns: distances (N, K) float64, metres, ascending, and indices (N, K) int64; infinity and N
        if there are fewer points.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    low, high = corners_of(points)
    extent = high - low
    # The surface area of a room is about that of its bounding box.
    surface = 2.0 * float(extent @ np.roll(extent, 1))
    # With half as many points per cell, most of the neighbours lie in the 27 cells around a point.
    points_per_cell = 0.5 * count
    edge = np.sqrt(max(surface, 1e-12) * points_per_cell / len(points))
    # A border of empty cells: each cell with points has all its neighbour cells.
    shape = np.floor(extent / edge) + 3
    if len(points) > count and np.prod(shape) <= 16.0 * len(points):
        shape = shape.astype(np.int64)
        cells = ((points - low) / edge).astype(np.int64) + 1
        numbers = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
        held = np.bincount(numbers, minlength=np.prod(shape))
        # An uneven cloud has crowded cells, or many empty ones.
        if held.max() <= 16.0 * points_per_cell:
            order = np.argsort(numbers, kind='stable')
            starts = np.concatenate([[0], np.cumsum(held)])
            offsets = np.array(sorted(product((-1, 0, 1), repeat=3), key=np.linalg.norm))
            around = offsets @ [shape[1] * shape[2], shape[2], 1]
            distances = np.full((len(points), count), np.inf)
            indices = np.full((len(points), count), len(points))
            parts = 4
            ends = len(points) * np.arange(parts + 1) // parts
            ordered = points[order], order, numbers[order], starts, around, count
            mapped(lambda k: _search(*ordered, ends[k], ends[k + 1], distances, indices),
                   range(parts))
            far = np.flatnonzero(distances[:, -1] > edge)
            if len(far):
                distances[far], indices[far] = _by_tree(points, points[far], count)
            return distances, indices
    return _by_tree(points, points, count)


def _by_tree(points: np.ndarray, of: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the points nearest to the points ``of`` (M, 3); see :func:`nearest`."""
    return cKDTree(points).query(of, k=np.arange(1, count + 1))


@njit(cache=True, nogil=True)
def _search(points, order, numbers, starts, around, count, first, end, distances, indices):
    """
    Search the 27 cells around each of some points.

    :param points: (N, 3) float64, metres, in the order of their cells.
    :param order: (N,) int64, the index of each point among the caller's points.
    :param numbers: (N,) int64, the cell of each.
    :param starts: (C + 1,) int64, where each cell begins.
    :param around: (27,) int64, the offsets from the number of a cell to those of the cells around
        it.
    :param count: the number K of points to find.
    :param first: the first of these points.
    :param end: the index after the last of these points.
    :param distances: (N, K) out, in the caller's order; if the last distance exceeds the edge of a
        cell, nearer points may lie in other cells.
    :param indices: (N, K) out.
    """
    squares, found = np.empty(count), np.empty(count, dtype=np.int64)
    for i in range(first, end):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        squares[:] = np.inf
        last = count - 1
        for number in numbers[i] + around:
            for j in range(starts[number], starts[number + 1]):
                dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
                square = dx * dx + dy * dy + dz * dz
                if square < squares[last]:
                    k = last
                    while k > 0 and squares[k - 1] > square:
                        squares[k], found[k] = squares[k - 1], found[k - 1]
                        k -= 1
                    squares[k], found[k] = square, j
        own = order[i]
        for k in range(count):
            if squares[k] < np.inf:
                distances[own, k], indices[own, k] = np.sqrt(squares[k]), order[found[k]]
