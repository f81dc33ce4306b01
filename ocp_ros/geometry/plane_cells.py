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
Cells of a horizontal grid: close those near surfaces, and find the nearest open cell.

A grid is an (X, Y) array. Contrary to an image, its rows are numbered along x and its columns
along y. Cameras may be in open cells only.
"""

import math

import numpy as np
from ocp_ros.util.kernels import njit

#: The row of the nearest open cell, for a column without any.
NO_ROW = -1


@njit(cache=True, nogil=True)
def close_cells(points, heights, clearance, low, edge, cells):
    """
    Close the cells in which a camera may come nearer to a point than a given distance, in 3D.

    :param points: (N, 3) N points of surfaces, metres.
    :param heights: (2,) the lowest and the highest z of cameras, metres.
    :param clearance: the distance, metres.
    :param low: (2,) metres, corner of the first cell.
    :param edge: the edge of a cell, metres.
    :param cells: (X, Y) bool, in and out, whether a cell is open; closed cells become False.
    """
    for point in range(len(points)):
        z = points[point, 2]
        height_gap = max(heights[0] - z, z - heights[1], 0.0)
        if height_gap >= clearance:
            continue
        # The disc in which the sphere of radius ``clearance`` around the point meets the nearest
        # plane of cameras: its radius and its centre in units of cells.
        radius = math.sqrt(clearance * clearance - height_gap * height_gap) / edge
        x, y = (points[point, 0] - low[0]) / edge, (points[point, 1] - low[1]) / edge
        first, last = int(math.floor(x - radius)), int(math.floor(x + radius))
        for i in range(max(first, 0), min(last + 1, cells.shape[0])):
            row_gap = max(i - x, x - (i + 1), 0.0)
            half_width = math.sqrt(max(radius * radius - row_gap * row_gap, 0.0))
            begin, end = int(math.floor(y - half_width)), int(math.floor(y + half_width))
            for j in range(max(begin, 0), min(end + 1, cells.shape[1])):
                cells[i, j] = False


@njit(cache=True, nogil=True)
def nearest_rows(cells):
    """
    Return the row of the open cell nearest to each cell in the same column.

    :param cells: (X, Y) bool, whether a cell is open.
    :returns: (X, Y) int32, the lower row of two equally near ones; ``NO_ROW`` if the column has no
        open cell.
    """
    rows, columns = cells.shape
    nearest = np.full(cells.shape, NO_ROW, dtype=np.int32)
    # Upwards: the nearest open cell in this row or a lower one.
    for i in range(rows):
        for j in range(columns):
            if cells[i, j]:
                nearest[i, j] = i
            elif i > 0:
                nearest[i, j] = nearest[i - 1, j]
    # Downwards: an open cell in a higher row replaces that cell if it is nearer.
    for i in range(rows - 2, -1, -1):
        for j in range(columns):
            upper = nearest[i + 1, j]
            if upper > i and (nearest[i, j] == NO_ROW or upper - i < i - nearest[i, j]):
                nearest[i, j] = upper
    return nearest


@njit(cache=True, nogil=True)
def move_into_open_cells(positions, low, edge, nearest):
    """
    Move positions into the nearest open cells, a micrometre from their edges, in place.

    Of equally near cells, that with the lowest column is taken, then that with the lowest row.

    :param positions: (M, 2) float64, x and y of M positions, metres, in and out; outside the grid,
        the cell of a position is the nearest one.
    :param low: (2,) metres, corner of the first cell.
    :param edge: the edge of a cell, metres.
    :param nearest: (X, Y) int32, from :func:`nearest_rows`; at least one cell has to be open.
    """
    rows, columns = nearest.shape
    inset_m = 1e-6
    for m in range(len(positions)):
        i = int(min(max(math.floor((positions[m, 0] - low[0]) / edge), 0), rows - 1))
        j = int(min(max(math.floor((positions[m, 1] - low[1]) / edge), 0), columns - 1))
        # The least squared distance of an open cell so far, in cells, and that cell. Columns are
        # tried from the nearest on, until their distance alone is too large.
        least, best_row, best_column = rows * rows + columns * columns, i, j
        for gap in range(max(j, columns - 1 - j) + 1):
            if gap * gap > least:
                break
            for column in (j - gap, j + gap):
                if 0 <= column < columns and nearest[i, column] != NO_ROW:
                    squared = gap * gap + (nearest[i, column] - i) ** 2
                    if squared < least or (squared == least and column < best_column):
                        least, best_row, best_column = squared, nearest[i, column], column
        for k, index in enumerate((best_row, best_column)):
            corner = low[k] + edge * index
            positions[m, k] = min(max(positions[m, k], corner + inset_m), corner + edge - inset_m)
