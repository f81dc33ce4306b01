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

"""Point clouds: bounding boxes, samples of a fixed size, thinning, fusion, cells of grids."""

from typing import NamedTuple

import numpy as np
from ocp_ros.util.kernels import njit

#: The number of bits of a cell number per axis.
BITS_PER_AXIS = 21
#: The number of cells on each side of the origin along an axis.
MAX_CELL = 1 << (BITS_PER_AXIS - 1)
#: Metres: the smallest edge of a voxel.
MIN_VOXEL_M = 0.001
#: The odd multiplier of a multiplicative hash: 2^64 over the golden ratio.
HASH_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)
#: The mark of a free slot of a hash table.
EMPTY = -1
#: Smallest limit of a fused cloud: 8 voxels meet at the origin and never merge, whatever their
#: edge.
MIN_POINTS = 8


def evenly(count: int, max_count: int) -> np.ndarray:
    """Return the indices of at most ``max_count`` of ``count`` things, evenly spread."""
    kept = min(count, max_count)
    return np.arange(kept) * count // max(kept, 1)


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
        Divide a box into cells of 0.1 m, or into about 4 million larger ones.

        :param bounds: (2, 3) the lowest and the highest corner of the box, metres.
        :param centred: whether the grid is centred on the box, so that a mirrored room has
            mirrored cells.
        """
        size = bounds[1] - bounds[0]
        edge = max(0.1, float((size.prod() / 4_000_000) ** (1.0 / 3.0)))
        shape = np.floor(size / edge).astype(int) + 1
        low = bounds.mean(axis=0) - 0.5 * edge * shape if centred else bounds[0]
        return cls(low, edge, shape)

    def cells(self, points: np.ndarray) -> np.ndarray:
        """Return the cells of points (M, 3), metres, nearest ones for points outside: (3, M)."""
        cells = np.floor((points - self.low) / self.edge).astype(int)
        return np.clip(cells, 0, self.shape - 1).T

    def middles(self, cells: np.ndarray) -> np.ndarray:
        """Return the centres (M, 3), metres, of the cells with indices (M, 3)."""
        return self.low + self.edge * (cells + 0.5)

    def taken(self, points: np.ndarray) -> np.ndarray:
        """Return whether each cell contains any of N points (N, 3), metres: (X, Y, Z) bool."""
        taken = np.zeros(self.shape, dtype=bool)
        taken[tuple(self.cells(points))] = True
        return taken


def voxel_downsample(points: np.ndarray, voxel_size: float) -> np.ndarray:
    """
    Replace the points in each cube of a grid by their mean.

    :param points: (N, 3), N points, metres.
    :param voxel_size: edge of the cubes, metres.
    :returns: (M, 3) float32, metres, one point for each of M occupied cubes, sorted by x,
        then y, then z of the cubes.
    :raises ValueError: if the voxel size is below a millimetre.
    """
    if not voxel_size >= MIN_VOXEL_M:
        raise ValueError(f'voxel_size: found {voxel_size}; expected at least {MIN_VOXEL_M} m')
    grid = _VoxelGrid(points)
    occupied = grid.assign_points(voxel_size)
    counts = np.bincount(grid.ranks)
    means = np.column_stack([np.bincount(grid.ranks, column) / counts for column in points.T])
    # Cell numbers are in the order of x, then y, then z; see :func:`_rank_voxels`.
    return means[np.argsort(grid.cells[:occupied])].astype(np.float32)


def thinned_to(points: np.ndarray, max_points: int) -> np.ndarray:
    """
    Return a cloud with at most a given number of points.

    :param points: (N, 3), N points, metres.
    :param max_points: the largest number of points wanted.
    :returns: the given array if it is small enough; otherwise the mean of the points in each of M
        voxels, (M, 3) float32, see :func:`voxel_downsample`.
    """
    if len(points) <= max_points:
        return points
    return voxel_downsample(points, voxel_size_for(points, max_points))


def voxel_size_for(points: np.ndarray, max_points: int) -> float:
    """
    Find the smallest voxel size, to 2 %, that leaves at most ``max_points`` points.

    :param points: (N, 3), N points, metres.
    :param max_points: the largest number of points wanted.
    :returns: the voxel size, metres.
    """
    grid = _VoxelGrid(points)
    # The voxel size is between these limits, metres.
    low, high = MIN_VOXEL_M, 1000.0
    x, y, z = np.maximum(np.ptp(grid.corners, axis=0), MIN_VOXEL_M)
    # A room has about the surface of its bounding box; the first trial divides it into squares.
    trial = np.sqrt(2.0 * (x * y + y * z + z * x) / max_points)
    attempt = 0
    while high / low > 1.02:
        # Each trial moves one of the limits, since it lies between them.
        trial = np.clip(trial, low * 1.004, high / 1.004)
        attempt += 1
        count = grid.assign_points(trial)
        if count > max_points:
            low = trial
        else:
            high = trial
        # The number of cubes on a surface falls with the square of their edge. Steps are
        # 0.5 % too long, so that both limits move. Every fourth step is a bisection, which
        # converges even if steps by this rule do not.
        trial *= np.sqrt(count / max_points) * (1.005 if count > max_points else 1.0 / 1.005)
        if attempt % 4 == 0:
            trial = np.sqrt(low * high)
    return float(high)


class _VoxelGrid:
    """
    Points in the voxels of a grid that begins at their lowest corner.

    :param points: (N, 3), N points, metres.
    :ivar corners: (2, 3) the lowest and the highest corner of their bounding box.
    :ivar ranks: (N,) int64: the rank of each point's voxel, in the order in which voxels are
        found.
    :ivar cells: (N,) int64: the number of the grid's cell for each rank; entries after the last
        rank are undefined.
    """

    def __init__(self, points: np.ndarray) -> None:
        self._points = np.asarray(points)
        self.corners = corners_of(self._points)
        self.ranks, self.cells = np.empty((2, len(points)), dtype=np.int64)
        # A power of two, as the search needs it; at least half of the slots stay empty, so that
        # searches are short.
        self._slots = np.empty(1 << (2 * len(points)).bit_length(), dtype=np.int64)

    def assign_points(self, voxel_size: float) -> int:
        """Assign the points to voxels of an edge in metres; return how many are occupied."""
        self._slots.fill(EMPTY)
        edge = self._points.dtype.type(voxel_size)
        return _rank_voxels(self._points, self.corners, edge, self._slots, self.ranks, self.cells)


@njit(cache=True, nogil=True)
def _rank_voxels(points, corners, edge, slots, ranks, cells):
    """
    Rank the occupied voxels with a hash table with open addressing.

    :param points: (N, 3), metres.
    :param corners: (2, 3) of the same type, see :class:`_VoxelGrid`.
    :param edge: the edge of a voxel, metres, of the same type.
    :param slots: (2^S,) int64, in and out: ranks of voxels, all ``EMPTY`` at first.
    :param ranks: (N,) int64, out, see :class:`_VoxelGrid`.
    :param cells: (N,) int64, out, see :class:`_VoxelGrid`.
    :returns: the number of occupied voxels.
    """
    low = corners[0]
    mask = slots.shape[0] - 1
    occupied = 0
    y_count = np.int64(np.floor((corners[1, 1] - low[1]) / edge)) + 1
    z_count = np.int64(np.floor((corners[1, 2] - low[2]) / edge)) + 1
    for i in range(points.shape[0]):
        x = np.int64(np.floor((points[i, 0] - low[0]) / edge))
        y = np.int64(np.floor((points[i, 1] - low[1]) / edge))
        z = np.int64(np.floor((points[i, 2] - low[2]) / edge))
        cell = (x * y_count + y) * z_count + z
        # The search begins at a slot that the upper half of the product selects. It tries the next
        # slots until it finds the cell or an empty slot.
        slot = np.int64((np.uint64(cell) * HASH_MULTIPLIER) >> np.uint64(32)) & mask
        while slots[slot] != EMPTY and cells[slots[slot]] != cell:
            slot = (slot + 1) & mask
        if slots[slot] == EMPTY:
            slots[slot], cells[occupied] = occupied, cell
            occupied += 1
        ranks[i] = slots[slot]
    return occupied


class FusedCloud:
    """
    A point cloud with one point per voxel: the first point that was added in that voxel.

    While the cloud has more than ``max_points`` points, the edge of the voxels is doubled and the
    cloud is thinned. Large voxels are unions of small ones, so every occupied region stays
    occupied.

    :param voxel: first edge of the voxels, metres.
    :param max_points: largest number of points.
    :raises ValueError: if ``voxel`` is not positive and finite, or ``max_points`` is less than 8.
    :ivar edge: current edge of the voxels, metres.
    """

    def __init__(self, voxel: float, max_points: int) -> None:
        if not 0.0 < voxel < np.inf:
            raise ValueError(f'voxel: found {voxel}; expected metres above 0')
        if max_points < MIN_POINTS:
            raise ValueError(f'max_points: found {max_points}; expected at least {MIN_POINTS}')
        self.voxel = voxel
        self.max_points = max_points
        self.clear()

    def clear(self) -> None:
        """Remove all points and reset the edge of the voxels."""
        self.edge = self.voxel
        self._points = np.empty((0, 3), dtype=np.float32)
        #: Numbers of the voxels with a point, ascending.
        self._voxel_numbers = np.empty(0, dtype=np.int64)

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self._points)

    @property
    def points(self) -> np.ndarray:
        """Return the points in the order in which they were added: (N, 3) float32, metres."""
        return self._points

    def add(self, points: np.ndarray) -> None:
        """
        Add points.

        :param points: (M, 3) float32, metres, always in the same frame.
        :raises ValueError: if a coordinate is not finite or its voxel is beyond the range of voxel
            numbers; then no point is added.
        """
        points, numbers = self._thin(np.asarray(points, dtype=np.float32))
        # ``assume_unique`` holds: after thinning each voxel has one point.
        is_new = ~np.isin(numbers, self._voxel_numbers, assume_unique=True)
        self._points = np.concatenate([self._points, points[is_new]])
        self._voxel_numbers = np.sort(np.concatenate([self._voxel_numbers, numbers[is_new]]))
        while len(self._points) > self.max_points:
            self.edge *= 2.0
            self._points, numbers = self._thin(self._points)
            self._voxel_numbers = np.sort(numbers)

    def _thin(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the first of the points (M, 3) in each of V voxels, and its voxel's number."""
        max_distance = MAX_CELL * self.edge
        if not (np.abs(points) < max_distance).all():
            raise ValueError(
                f'points: found coordinates up to {np.abs(points).max()} m; expected finite ones '
                f'within {max_distance:.0f} m of the origin; check the unit and the frame')
        # With ``np.float64`` NumPy divides in float64; in float32, points near the sides of voxels
        # would be rounded.
        numbers = cell_numbers(np.floor(points / np.float64(self.edge)).astype(np.int64))
        # Neighbours in a depth image often share a voxel. They are left out first, since sorting
        # takes longest.
        run_starts = np.flatnonzero(np.diff(numbers, prepend=numbers[:1] - 1))
        _, first_runs = np.unique(numbers[run_starts], return_index=True)
        # Back from the order of the voxel numbers to that of the points.
        first_indices = np.sort(run_starts[first_runs])
        return points[first_indices], numbers[first_indices]
