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

"""Thin clouds on a voxel grid, find voxel sizes, and divide rooms into cells."""

from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.util.kernels import njit

#: Metres: the smallest edge of a voxel.
MIN_VOXEL_M = 0.001
#: Multiplier of a multiplicative hash: 2^64 over the golden ratio, odd.
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
EMPTY = -1


class CellGrid(NamedTuple):
    """
    Equal cubes that fill a box.

    :ivar low: (3,) metres, corner of the first cell.
    :ivar edge: the edge of a cell, metres.
    :ivar shape: (3,) int, the number of cells along each axis.
    """

    low: np.ndarray
    edge: float
    shape: np.ndarray

    @classmethod
    def over(cls, bounds: np.ndarray, centred: bool = False) -> 'CellGrid':
        """
        Divide a box into cells.

        :param bounds: (2, 3) metres, its lowest and its highest corner.
        :param centred: whether the grid is centred on the box, so that a mirrored room has
            mirrored cells.
        """
        size = bounds[1] - bounds[0]
        # Metres.
        edge = max(0.1, float((size.prod() / 4_000_000) ** (1.0 / 3.0)))
        shape = np.floor(size / edge).astype(int) + 1
        low = bounds.mean(axis=0) - 0.5 * edge * shape if centred else bounds[0]
        return cls(low, edge, shape)

    def cells(self, points: np.ndarray) -> np.ndarray:
        """Return the cell indices (3, M) of points (M, 3); points outside get the nearest cell."""
        cells = np.floor((points - self.low) / self.edge).astype(int)
        return np.clip(cells, 0, self.shape - 1).T

    def middles(self, cells: np.ndarray) -> np.ndarray:
        """Return the centres (M, 3) of cells given by indices (M, 3), metres."""
        return self.low + self.edge * (cells + 0.5)

    def taken(self, points: np.ndarray) -> np.ndarray:
        """Return which cells contain any of some points (N, 3): (X, Y, Z) bool."""
        taken = np.zeros(self.shape, dtype=bool)
        taken[tuple(self.cells(points))] = True
        return taken


def voxel_downsample(points: np.ndarray, voxel_size: float) -> np.ndarray:
    """
    Replace the points in each cube of a grid by their mean.

    :param points: (N, 3), metres.
    :param voxel_size: edge of the cubes, metres.
    :returns: (M, 3) float32, ordered by cube: M <= N.
    :raises ValueError: if the voxel size is below a millimetre.
    """
    if not voxel_size >= MIN_VOXEL_M:
        raise ValueError(f'voxel_size: found {voxel_size}; expected at least {MIN_VOXEL_M} m')
    grid = _Grid(points)
    found = grid.fill(voxel_size)
    counts = np.bincount(grid.ranks)
    means = np.column_stack([np.bincount(grid.ranks, column) / counts for column in points.T])
    return means[np.argsort(grid.cells[:found])].astype(np.float32)


def thinned_to(points: np.ndarray, most: int) -> np.ndarray:
    """Return at most ``most`` points of a cloud (N, 3), thinned on a voxel grid if it has more."""
    if len(points) <= most:
        return points
    return voxel_downsample(points, voxel_size_for(points, most))


def voxel_size_for(points: np.ndarray, max_points: int) -> float:
    """
    Find the smallest voxel size, to 2 %, that leaves at most ``max_points`` points.

    :param points: (N, 3), metres.
    :param max_points: the largest number of points wanted.
    :returns: metres.
    """
    grid, low, high = _Grid(points), MIN_VOXEL_M, 1000.0
    x, y, z = np.maximum(np.ptp(grid.corners, axis=0), MIN_VOXEL_M)
    # A room has about the surface of its bounding box.
    middle = np.sqrt(2.0 * (x * y + y * z + z * x) / max_points)
    attempt = 0
    while high / low > 1.02:
        middle, attempt = np.clip(middle, low * 1.004, high / 1.004), attempt + 1
        found = grid.fill(middle)
        if found > max_points:
            low = middle
        else:
            high = middle
        # The number of cubes on a surface falls with the square of their edge; if steps by this
        # rule do not converge, bisection does.
        middle *= np.sqrt(found / max_points) * (1.005 if found > max_points else 1.0 / 1.005)
        if attempt % 4 == 0:
            middle = np.sqrt(low * high)
    return float(high)


class _Grid:
    """
    Points in the voxels of a grid that begins at their lowest corner.

    :param points: (N, 3), metres.
    :ivar corners: (2, 3) the corners of their bounding box.
    :ivar ranks: (N,) int64: the rank of each point's voxel, in the order in which voxels are
        found.
    :ivar cells: (N,) int64: the number of each voxel found; later entries are undefined.
    """

    def __init__(self, points: np.ndarray) -> None:
        self._points = np.asarray(points)
        self.corners = corners_of(self._points)
        self.ranks, self.cells = np.empty((2, len(points)), dtype=np.int64)
        # At least half of the slots stay empty, so that searches are short.
        self._slots = np.empty(1 << (2 * len(points)).bit_length(), dtype=np.int64)

    def fill(self, voxel_size: float) -> int:
        """Assign the points to voxels of an edge in metres; return how many are occupied."""
        self._slots.fill(EMPTY)
        size = self._points.dtype.type(voxel_size)
        return _fill(self._points, self.corners, size, self._slots, self.ranks, self.cells)


@njit(cache=True, nogil=True)
def _fill(points, corners, size, slots, ranks, cells):
    """
    Number the occupied voxels with a hash table with open addressing.

    :param points: (N, 3).
    :param corners: (2, 3) of the same type.
    :param size: the edge of a voxel, of the same type.
    :param slots: (2^S,) int64, in and out: ranks of voxels, all ``EMPTY`` at first.
    :param ranks: (N,) int64, out; see :class:`_Grid`.
    :param cells: (N,) int64, out.
    :returns: the number of occupied voxels.
    """
    low, mask, found = corners[0], slots.shape[0] - 1, 0
    along = np.int64(np.floor((corners[1, 1] - low[1]) / size)) + 1
    up = np.int64(np.floor((corners[1, 2] - low[2]) / size)) + 1
    for i in range(points.shape[0]):
        x = np.int64(np.floor((points[i, 0] - low[0]) / size))
        y = np.int64(np.floor((points[i, 1] - low[1]) / size))
        z = np.int64(np.floor((points[i, 2] - low[2]) / size))
        cell = (x * along + y) * up + z
        slot = np.int64((np.uint64(cell) * GOLDEN) >> np.uint64(32)) & mask
        while slots[slot] != EMPTY and cells[slots[slot]] != cell:
            slot = (slot + 1) & mask
        if slots[slot] == EMPTY:
            slots[slot], cells[found] = found, cell
            found += 1
        ranks[i] = slots[slot]
    return found
