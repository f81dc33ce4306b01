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

"""Fusion of incoming point clouds into one observed cloud of bounded size."""

import numpy as np
from ocp_ros.geometry.clouds import cell_numbers, MAX_CELL

#: Smallest limit of the points: 8 voxels meet at the origin and never merge, whatever their edge.
MIN_POINTS = 8


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
