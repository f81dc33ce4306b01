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
The engine's look in plain NumPy, point by point and cell by cell: slow, obvious, and the measure.

The kernels of :mod:`ocp_ros.geometry.surfels` have to agree with it, and to be faster.
"""

import numpy as np
from ocp_ros.geometry.surfels import (
    MAX_INVERSE_RATIO,
    MIN_COSINE,
    MIN_INVERSE_RATIO,
    SurfelSettings,
)


class Twin:
    """
    Look at points as surfels.

    :param points: (N, 3), metres, map frame.
    :param normals: (N, 3) unit vectors.
    :param radius: (N,), metres.
    :param position: (3,) of an omnidirectional camera, metres.
    :param max_range: metres.
    :param settings: rules.
    :ivar shadow: (H, W) inverse distances, 1/m.
    """

    def __init__(self, points: np.ndarray, normals: np.ndarray, radius: np.ndarray,
                 position: np.ndarray, max_range: float, settings: SurfelSettings) -> None:
        self.settings, self.max_range = settings, max_range
        self.rows, self.columns = settings.rows, 2 * settings.rows
        self.radius = np.asarray(radius, dtype=np.float64)
        self._project(np.asarray(points, dtype=np.float64) - position, normals)
        self.shadow = np.full((self.rows, self.columns), 1.0 / max_range)
        size, inside = self.size, self.distance <= max_range
        self._splat_single(inside & (size < self.flat * settings.single_limit))
        self._splat_quad(inside & (size >= self.flat * settings.single_limit)
                         & (size < self.flat * settings.quad_limit))
        self._splat_ellipse(np.flatnonzero(
            inside & (size >= self.flat * max(settings.single_limit, settings.quad_limit))))

    def _project(self, offset: np.ndarray, normals: np.ndarray) -> None:
        """Compute where points appear and how their planes lean: one step is one cell."""
        self.distance = np.linalg.norm(offset, axis=1)
        self.inverse = 1.0 / self.distance
        elevation = np.arctan2(offset[:, 2], np.hypot(offset[:, 0], offset[:, 1]))
        azimuth = np.arctan2(offset[:, 1], offset[:, 0])
        self.row = (elevation + np.pi / 2) * self.rows / np.pi
        self.column = (azimuth + np.pi) * self.rows / np.pi
        self.flat = np.cos(elevation)
        zero = np.zeros(len(offset))
        up = np.stack([-np.sin(elevation) * np.cos(azimuth), -np.sin(elevation) * np.sin(azimuth),
                       np.cos(elevation)], axis=1)
        across = np.stack([-np.sin(azimuth), np.cos(azimuth), zero], axis=1)
        facing = (normals * offset).sum(axis=1) * self.inverse
        facing = np.copysign(np.maximum(np.abs(facing), MIN_COSINE), facing)
        self.slope_row = (normals * up).sum(axis=1) / facing
        self.slope_column = (normals * across).sum(axis=1) / facing
        steps = np.abs(self.slope_row) + np.abs(self.slope_column) * self.flat
        self.inverse *= 1.0 - self.settings.setback * steps * np.pi / self.rows
        self.size = self.radius * self.inverse * self.rows / np.pi

    def _put(self, which: np.ndarray, row: np.ndarray, column: np.ndarray,
             over: bool = False) -> None:
        """Write points into one cell each, at the depth of their planes in its centre."""
        cell = np.pi / self.rows
        # A disc that is set back leans as the one that it stands for.
        value = self.inverse[which] + 1.0 / self.distance[which] * (
            self.slope_row[which] * cell * (row + 0.5 - self.row[which])
            + (not over) * self.slope_column[which] * self.flat[which] * cell
            * (column + 0.5 - self.column[which]))
        value = np.clip(value, MIN_INVERSE_RATIO * self.inverse[which],
                        MAX_INVERSE_RATIO * self.inverse[which])
        np.maximum.at(self.shadow, (row, column % self.columns), value)

    def _splat_single(self, small: np.ndarray) -> None:
        """Fill the own cell of each point."""
        self._put(small, self.row[small].astype(int), self.column[small].astype(int))

    def _splat_quad(self, middling: np.ndarray) -> None:
        """Fill those of the four nearest cells whose centre is within reach."""
        which = np.flatnonzero(middling)
        for k in (0, 1):
            for m in (0, 1):
                row = np.floor(self.row[which] - 0.5).astype(int) + k
                column = np.floor(self.column[which] - 0.5).astype(int) + m
                size = self.size[which]
                within = (np.abs(row + 0.5 - self.row[which]) <= np.maximum(size, 0.5)) \
                    & (np.abs(column + 0.5 - self.column[which])
                       <= np.maximum(size / self.flat[which], 0.5)) \
                    & (row >= 0) & (row < self.rows)
                self._put(which[within], row[within], column[within])

    def _splat_ellipse(self, large: np.ndarray) -> None:
        """Fill the cells whose centre is within the disc, and the own one."""
        for i in large:
            form = 1.0 + self.slope_column[i] ** 2
            whole = form + self.slope_row[i] ** 2
            height = self.size[i] * np.sqrt(max(form / whole, 1e-4))
            own_row, own_column = int(self.row[i]), int(self.column[i])
            first = max(min(int(np.ceil(self.row[i] - height - 0.5)), own_row), 0)
            last = min(max(int(np.floor(self.row[i] + height - 0.5)), own_row), self.rows - 1)
            for row in range(first, last + 1):
                down = row + 0.5 - self.row[i]
                middle = self.column[i] \
                    - self.slope_row[i] * self.slope_column[i] / (form * self.flat[i]) * down
                reach = np.sqrt(max(form * self.size[i] ** 2 - down ** 2 * whole, 0.0)) \
                    / (form * self.flat[i])
                left = int(np.ceil(middle - reach - 0.5))
                right = int(np.floor(middle + reach - 0.5))
                if row == own_row:
                    left, right = min(left, own_column), max(right, own_column)
                if right - left >= self.columns:
                    left, right = 0, self.columns - 1
                middle_of_row = row + 0.5
                over = min(self.row[i] + middle_of_row,
                           2 * self.rows - self.row[i] - middle_of_row) <= self.size[i]
                if over:
                    left, right = 0, self.columns - 1
                columns = np.arange(left, right + 1)
                self._put(np.full(len(columns), i), np.full(len(columns), row), columns, over)

    def visible(self) -> np.ndarray:
        """Return (N,) bool: at most base + share * radius behind the farthest of four cells."""
        around = np.pad(np.pad(self.shadow, ((0, 0), (1, 1)), mode='wrap'), ((1, 1), (0, 0)),
                        constant_values=np.inf)
        row = np.floor(self.row + 0.5).astype(int)
        column = np.floor(self.column + 0.5).astype(int)
        deepest = 1.0 / np.min([around[row + k, column + m] for k in (0, 1) for m in (0, 1)],
                               axis=0)
        behind = self.settings.base_tolerance + self.settings.radius_tolerance * self.radius
        return (self.distance <= self.max_range) & (self.distance <= deepest + behind)
