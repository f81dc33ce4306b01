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
    Find the K points nearest to each point, of which the first is the point itself.

    :param points: (N, 3), metres, N >= 1.
    :param count: K.
    :returns: distances (N, K) float64, metres, ascending, and indices (N, K) int64; infinity and N
        where there are fewer than K points.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    low, high = corners_of(points)
    size = high - low
    # The surface area of a room is about that of its bounding box.
    surface = 2.0 * float(size @ np.roll(size, 1))
    # With K / 2 points per cell, most of the K neighbours lie in the 27 cells around a point.
    points_per_cell = 0.5 * count
    edge = np.sqrt(max(surface, 1e-12) * points_per_cell / len(points))
    # A border of empty cells gives each cell with points all its neighbour cells.
    shape = np.floor(size / edge) + 3
    # The grid of an uneven cloud has many empty cells (checked here) or crowded ones (checked
    # below), so the tree is faster.
    if len(points) > count and np.prod(shape) <= 16.0 * len(points):
        shape = shape.astype(np.int64)
        cells = ((points - low) / edge).astype(np.int64) + 1
        cell_numbers = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
        cell_counts = np.bincount(cell_numbers, minlength=np.prod(shape))
        if cell_counts.max() <= 16.0 * points_per_cell:
            order = np.argsort(cell_numbers, kind='stable')
            starts = np.concatenate([[0], np.cumsum(cell_counts)])
            # Near cells are searched first, so that few points of the others enter a list.
            offsets = np.array(sorted(product((-1, 0, 1), repeat=3), key=np.linalg.norm))
            cell_offsets = offsets @ [shape[1] * shape[2], shape[2], 1]
            distances = np.full((len(points), count), np.inf)
            indices = np.full((len(points), count), len(points))
            # The parts are searched in parallel.
            part_count = 4
            ends = len(points) * np.arange(part_count + 1) // part_count
            grid = points[order], order, cell_numbers[order], starts, cell_offsets
            mapped(lambda k: _search_cells(*grid, ends[k], ends[k + 1], distances, indices),
                   range(part_count))
            # If the last neighbour is farther away than the edge of a cell, nearer points may lie
            # outside the 27 cells.
            unsure = np.flatnonzero(distances[:, -1] > edge)
            if len(unsure):
                distances[unsure], indices[unsure] = _search_tree(points, points[unsure], count)
            return distances, indices
    return _search_tree(points, points, count)


def _search_tree(points: np.ndarray, queries: np.ndarray, count: int
                 ) -> tuple[np.ndarray, np.ndarray]:
    """Find the points nearest to each of ``queries`` (M, 3); see :func:`nearest`."""
    return cKDTree(points).query(queries, k=np.arange(1, count + 1))


@njit(cache=True, nogil=True)
def _search_cells(points, order, cell_numbers, starts, cell_offsets, first, end, distances,
                  indices):
    """
    Find the K nearest points of some of N points in the 27 cells around each.

    :param points: (N, 3) float64, metres, in the order of their cells.
    :param order: (N,) int64, the index of each point among the caller's points.
    :param cell_numbers: (N,) int64, the number of the cell of each point.
    :param starts: (C + 1,) int64, the index of the first point of each of the C cells.
    :param cell_offsets: (27,) int64, the numbers of the cells around a cell, less its own number.
    :param first: the index in ``points`` of the first point whose neighbours are searched for.
    :param end: the index after the last such point.
    :param distances: (N, K) metres, written, in the caller's order; if the last distance exceeds
        the edge of a cell, nearer points may lie in other cells.
    :param indices: (N, K), written: indices among the caller's points.
    """
    count = distances.shape[1]
    # The squared distances and the indices of the nearest points found so far.
    squares, neighbours = np.empty(count), np.empty(count, dtype=np.int64)
    for i in range(first, end):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        squares[:] = np.inf
        last = count - 1
        for cell in cell_numbers[i] + cell_offsets:
            for j in range(starts[cell], starts[cell + 1]):
                dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
                square = dx * dx + dy * dy + dz * dz
                # Insert the point into the list, which is sorted by distance.
                if square < squares[last]:
                    k = last
                    while k > 0 and squares[k - 1] > square:
                        squares[k], neighbours[k] = squares[k - 1], neighbours[k - 1]
                        k -= 1
                    squares[k], neighbours[k] = square, j
        for k in range(count):
            if squares[k] < np.inf:
                distances[order[i], k] = np.sqrt(squares[k])
                indices[order[i], k] = order[neighbours[k]]
