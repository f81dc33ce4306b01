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

#: Smallest value of ``most``: 8 voxels meet at the origin and never merge, whatever their edge.
MIN_POINTS = 8


class FusedCloud:
    """
    A point cloud with one point per voxel: the first point that was added in that voxel.

    If the cloud has more than ``most`` points, the edge of the voxels is doubled and the cloud is
    thinned, until at most ``most`` points remain. Large voxels are unions of small ones, so every
    occupied region stays occupied.

    :param voxel: first edge of the voxels, metres.
    :param most: largest number of points.
    :raises ValueError: if ``voxel`` is not positive and finite, or ``most`` is less than 8.
    """

    def __init__(self, voxel: float, most: int) -> None:
        if not 0.0 < voxel < np.inf:
            raise ValueError(f'voxel: found {voxel}; expected metres above 0')
        if most < MIN_POINTS:
            raise ValueError(f'most: found {most} points; expected at least {MIN_POINTS}')
        self.voxel, self.most = voxel, most
        self.clear()

    def clear(self) -> None:
        """Remove all points and reset the edge of the voxels."""
        #: Current edge of the voxels, metres.
        self.edge = self.voxel
        self._points = np.empty((0, 3), dtype=np.float32)
        #: Numbers of the voxels with a point, ascending.
        self._numbers = np.empty(0, dtype=np.int64)

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
        points, numbers = self._thinned(np.asarray(points, dtype=np.float32))
        new = ~np.isin(numbers, self._numbers, assume_unique=True)
        self._points = np.concatenate([self._points, points[new]])
        self._numbers = np.sort(np.concatenate([self._numbers, numbers[new]]))
        while len(self._points) > self.most:
            self.edge *= 2.0
            self._points, numbers = self._thinned(self._points)
            self._numbers = np.sort(numbers)

    def _thinned(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Keep the first point of each voxel; return the points and their voxels' numbers."""
        reach = MAX_CELL * self.edge
        if not (np.abs(points) < reach).all():
            raise ValueError(
                f'points: found coordinates up to {np.abs(points).max()} m; expected finite ones '
                f'within {reach:.0f} m of the origin; check the unit and the frame')
        numbers = cell_numbers(np.floor(points / np.float64(self.edge)).astype(np.int64))
        _, first = np.unique(numbers, return_index=True)
        first.sort()
        return points[first], numbers[first]
