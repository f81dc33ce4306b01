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

"""Cells of a horizontal grid: close those near surfaces, and find the nearest open cell."""

import math

import numpy as np
from ocp_ros.util.kernels import njit

#: The row number for a column without an open cell.
NO_ROW = -1
#: Metres: positions moved into a cell keep this distance from its edges.
INSET_M = 1e-6


@njit(cache=True, nogil=True)
def close_near(points, heights, clearance, low, edge, cells):
    """
    Close the cells with any position nearer to a point than a given distance, in 3D.

    :param points: (N, 3) metres.
    :param heights: (2,) metres, the lowest and the highest z of the positions.
    :param clearance: the distance, metres.
    :param low: (2,) metres, corner of the first cell.
    :param edge: the edge of a cell, metres.
    :param cells: (X, Y) bool, written to: those that are too near become False.
    """
    for point in range(len(points)):
        z = points[point, 2]
        off = max(heights[0] - z, z - heights[1], 0.0)
        if off >= clearance:
            continue
        # In units of cells: the disc in which the sphere of radius ``clearance`` meets the plane.
        radius = math.sqrt(clearance * clearance - off * off) / edge
        x, y = (points[point, 0] - low[0]) / edge, (points[point, 1] - low[1]) / edge
        first, last = int(math.floor(x - radius)), int(math.floor(x + radius))
        for i in range(max(first, 0), min(last + 1, cells.shape[0])):
            away = max(i - x, x - (i + 1), 0.0)
            half = math.sqrt(max(radius * radius - away * away, 0.0))
            begin, end = int(math.floor(y - half)), int(math.floor(y + half))
            for j in range(max(begin, 0), min(end + 1, cells.shape[1])):
                cells[i, j] = False


@njit(cache=True, nogil=True)
def nearest_rows(cells):
    """
    Find the nearest open cell along the first axis; of two equally near ones, the lower.

    :param cells: (X, Y) bool.
    :returns: (X, Y) int32, the first index of this cell; ``NO_ROW`` if the column has none.
    """
    rows, columns = cells.shape
    near = np.full(cells.shape, NO_ROW, dtype=np.int32)
    for i in range(rows):
        for j in range(columns):
            if cells[i, j]:
                near[i, j] = i
            elif i > 0:
                near[i, j] = near[i - 1, j]
    for i in range(rows - 2, -1, -1):
        for j in range(columns):
            above = near[i + 1, j]
            if above > i and (near[i, j] == NO_ROW or above - i < i - near[i, j]):
                near[i, j] = above
    return near


@njit(cache=True, nogil=True)
def moved_into(positions, low, edge, near):
    """
    Move positions into the nearest open cell; see :func:`nearest_rows`.

    Of equally near cells, the one with the lowest second index is taken, then the lowest first.

    :param positions: (M, 2) float64, metres, overwritten; a position outside of the grid is
        treated as in its nearest cell.
    :param low: (2,) metres, corner of the first cell.
    :param edge: the edge of a cell, metres.
    :param near: (X, Y) int32, from :func:`nearest_rows`; at least one cell has to be open.
    """
    rows, columns = near.shape
    for m in range(len(positions)):
        i = int(min(max(math.floor((positions[m, 0] - low[0]) / edge), 0), rows - 1))
        j = int(min(max(math.floor((positions[m, 1] - low[1]) / edge), 0), columns - 1))
        best, x, y = rows * rows + columns * columns, i, j
        for off in range(max(j, columns - 1 - j) + 1):
            if off * off > best:
                break
            for column in (j - off, j + off):
                if 0 <= column < columns and near[i, column] != NO_ROW:
                    away = off * off + (near[i, column] - i) ** 2
                    if away < best or (away == best and column < y):
                        best, x, y = away, near[i, column], column
        for k, cell in enumerate((x, y)):
            corner = low[k] + edge * cell
            positions[m, k] = min(max(positions[m, k], corner + INSET_M), corner + edge - INSET_M)
