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

"""Point clouds: samples of a fixed size, bounding boxes, and numbers for the cells of a grid."""

import numpy as np

#: The number of bits of a cell number per axis.
BITS_PER_AXIS = 21
#: The number of cells on each side of the origin along an axis.
MAX_CELL = 1 << (BITS_PER_AXIS - 1)


def fixed_size(points: np.ndarray, count: int) -> np.ndarray:
    """
    Take ``count`` points at even strides through a cloud; repeat some if it has fewer.

    :param points: (N, 3) metres, the N >= 1 points of the cloud.
    :param count: the number of points to take.
    :returns: (count, 3) float32, metres.
    """
    return np.ascontiguousarray(points[np.arange(count) * len(points) // count], dtype=np.float32)


def corners_of(points: np.ndarray) -> np.ndarray:
    """
    Return the bounding box of points: its lowest and its highest corner.

    :param points: (N, D) N >= 1 points of D coordinates, in any unit.
    :returns: (2, D) of the same type and unit.
    """
    # The coordinates are copied first, since NumPy reduces contiguous rows 25 times faster.
    columns = np.ascontiguousarray(points.T)
    return np.stack([columns.min(axis=1), columns.max(axis=1)])


def away_from(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """
    Return the distances of points from a box.

    :param points: (N, D) N points of D coordinates, in any unit.
    :param corners: (2, D) the lowest and the highest corner of the box, see :func:`corners_of`.
    :returns: (N,) in the same unit; 0 for points inside the box.
    """
    low, high = corners
    return np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0.0), axis=1)


def cell_numbers(cells: np.ndarray) -> np.ndarray:
    """
    Return the numbers of cells of an endless grid; a cell has the same number in every cloud.

    :param cells: (N, 3) int64, the indices of N cells along x, y and z, in [-2^20, 2^20).
    :returns: (N,) int64, one number per cell.
    """
    shifted = cells + MAX_CELL
    return (shifted[:, 0] << 2 * BITS_PER_AXIS) | (shifted[:, 1] << BITS_PER_AXIS) | shifted[:, 2]


def cells_numbered(numbers: np.ndarray) -> np.ndarray:
    """Return the cells (N, 3) int64 of cell numbers (N,); the inverse of :func:`cell_numbers`."""
    mask = (1 << BITS_PER_AXIS) - 1
    axes = (numbers >> 2 * BITS_PER_AXIS & mask, numbers >> BITS_PER_AXIS & mask, numbers & mask)
    return np.stack(axes, axis=1) - MAX_CELL
