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

"""Slow, obvious NumPy twins of the engine's kernels, and the cameras they are tried with."""

import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.geometry.surfels import MAX_INVERSE_RATIO, MIN_COSINE, MIN_INVERSE_RATIO

MODELS = {
    'omnidirectional': CameraModel(0.0, 4.0),
    'pinhole': CameraModel(0.3, 5.0, np.deg2rad(87), np.deg2rad(58)),
    'lidar': CameraModel(0.5, 6.0, 2 * np.pi, np.deg2rad(30)),
}


def polar(points, position):
    """Return offset (N, 3), distance, elevation and azimuth, each (N,)."""
    d = points.astype(np.float64) - position
    return (d, np.linalg.norm(d, axis=1), np.arctan2(d[:, 2], np.hypot(d[:, 0], d[:, 1])),
            np.arctan2(d[:, 1], d[:, 0]))


def project(points, position, rotation, model):
    """Return distance (inf where not measured), elevation and azimuth, each (N,)."""
    d, r, elevation, azimuth = polar(points, position)
    measured = (r >= model.min_range) & (r <= model.max_range) & (r > 0)
    x, y, z = (d @ rotation).T
    if not model.omnidirectional:
        if max(model.horizontal_fov, model.vertical_fov) < np.pi:
            cone = ((x > 0) & (np.abs(y) <= x * np.tan(model.horizontal_fov / 2))
                    & (np.abs(z) <= x * np.tan(model.vertical_fov / 2)))
        else:
            cone = ((np.abs(np.arctan2(y, x)) <= model.horizontal_fov / 2)
                    & (np.abs(np.arctan2(z, np.hypot(x, y))) <= model.vertical_fov / 2))
        measured &= cone
    return np.where(measured, r, np.inf), elevation, azimuth


def directions(rows):
    """Return the unit vectors through the cells' centres: (H, W, 3)."""
    cell = np.pi / rows
    elevation = (-np.pi / 2 + (np.arange(rows) + 0.5) * cell)[:, None]
    azimuth = (-np.pi + (np.arange(2 * rows) + 0.5) * cell)[None, :]
    return np.stack(np.broadcast_arrays(np.cos(elevation) * np.cos(azimuth),
                                        np.cos(elevation) * np.sin(azimuth),
                                        np.sin(elevation)), axis=-1)


def disc(point, normal, position, rows):
    """Return, per cell, the distance to a point's plane and how far from the point that is."""
    d = point - position
    rays = directions(rows)
    with np.errstate(divide='ignore', invalid='ignore'):
        distance = (d @ normal) / (rays @ normal)
    offset = np.linalg.norm(distance[..., None] * rays - d, axis=-1)
    return distance, np.where(distance > 0, offset, np.inf)


def covered(distance, elevation, azimuth, half_side, rows):
    """Return the (H, W) mask of the cells that one point covers."""
    columns = 2 * rows
    cell = np.pi / rows
    elevations = -np.pi / 2 + (np.arange(rows) + 0.5) * cell
    azimuths = -np.pi + (np.arange(columns) + 0.5) * cell
    half = half_side / distance
    row = min(max(int(np.floor((elevation + np.pi / 2) / cell)), 0), rows - 1)
    column = int(np.floor((azimuth + np.pi) / cell)) % columns
    in_rows = np.abs(elevations - elevation) <= half
    in_rows[row] = True
    half_azimuth = half / max(np.cos(elevation), 1e-6)
    if half >= np.pi / 2 - abs(elevation) or half_azimuth >= np.pi:
        in_columns = np.ones(columns, dtype=bool)
    else:
        offset = np.abs((azimuths - azimuth + np.pi) % (2 * np.pi) - np.pi)
        in_columns = offset <= half_azimuth
        in_columns[column] = True
    return in_rows[:, None] & in_columns[None, :]


def shadow_map(distance, elevation, azimuth, half_sides, rows, far):
    """Return the (H, W) map: the minimum over the points that cover each cell."""
    result = np.full((rows, 2 * rows), far)
    for r, e, a, h in zip(distance, elevation, azimuth, half_sides):
        if r <= far:
            mask = covered(r, e, a, h, rows)
            result[mask] = np.minimum(result[mask], r)
    return result


def visible(distance, elevation, azimuth, compensation, shadow):
    """Return (N,) bool: r <= SM[cell] + compensation."""
    rows, columns = shadow.shape
    row = np.clip(((elevation + np.pi / 2) * rows / np.pi).astype(int), 0, rows - 1)
    column = np.floor((azimuth + np.pi) * columns / (2 * np.pi)).astype(int) % columns
    return np.isfinite(distance) & (distance <= shadow[row, column] + compensation)


def depth_error_by_point(points, half_sides, positions, far, rows, seen):
    """
    Return (N,): what the pixels lose that show a point.

    All of it is the sum over viewpoints of the mean difference of two depth maps.
    """
    lost = np.zeros(len(points))
    for position in positions:
        _, distance, elevation, azimuth = polar(points, position)
        full, part = (np.full((rows, 2 * rows), far) for _ in range(2))
        nearest = np.zeros(full.shape, dtype=int)
        # The nearest point is written last.
        for i in np.argsort(-distance):
            mask = covered(distance[i], elevation[i], azimuth[i], half_sides[i], rows)
            nearest[mask], full[mask] = i, min(distance[i], far)
            if seen[i]:
                part[mask] = full[mask]
        lost += np.bincount(nearest.ravel(), (part - full).ravel(), len(points)) / full.size
    return lost


def edge_aware_normals(points, neighbours):
    """Return normals (N, 3) and how well the best plane fits (N,)."""
    around = points.astype(np.float64)[neighbours]
    offsets = around - around.mean(axis=1, keepdims=True)
    spread, directions = np.linalg.eigh(np.einsum('nki,nkj->nij', offsets, offsets))
    normals = directions[:, :, 0]
    roughness = np.sqrt(np.clip(spread[:, 0] / np.maximum(spread.sum(axis=1), 1e-30), 0.0, 1.0))
    candidates = neighbours[:, :12]
    offsets = points[:, None] - points[candidates]
    distance = np.abs(np.einsum('nki,nki->nk', offsets, normals[candidates]))
    typical = np.linalg.norm(points - points[neighbours[:, 1]], axis=1).mean()
    best = (distance / typical + 3.0 * roughness[candidates]).argmin(axis=1)
    return normals[candidates[np.arange(len(points)), best]]


class SurfelTwin:
    """
    Look at points as surfels, point by point and cell by cell.

    :param position: (3,) of an omnidirectional camera, metres.
    :ivar shadow: (H, W) inverse distances, 1/m.
    """

    def __init__(self, points, normals, radius, position, max_range, settings):
        self.settings, self.max_range = settings, max_range
        self.rows, self.columns = settings.rows, 2 * settings.rows
        self.radius = np.asarray(radius, dtype=np.float64)
        self.project(points, normals, position)
        self.shadow = np.full((self.rows, self.columns), 1.0 / max_range)
        inside = self.distance <= max_range
        small = self.size < self.flat * settings.single_limit
        large = ~small & (self.size >= self.flat * settings.quad_limit)
        # The small ones fill their own cells.
        own = np.flatnonzero(inside & small)
        self.put(own, self.row[own].astype(int), self.column[own].astype(int))
        self.splat_four(np.flatnonzero(inside & ~small & ~large))
        self.splat_ellipse(np.flatnonzero(inside & large))

    def project(self, points, normals, position):
        """Compute where points appear and how their planes lean: one step is one cell."""
        offset, self.distance, elevation, azimuth = polar(points, position)
        self.inverse = 1.0 / self.distance
        self.row = (elevation + np.pi / 2) * self.rows / np.pi
        self.column = (azimuth + np.pi) * self.rows / np.pi
        self.flat = np.cos(elevation)
        up = np.stack([-np.sin(elevation) * np.cos(azimuth), -np.sin(elevation) * np.sin(azimuth),
                       self.flat], axis=1)
        across = np.stack([-np.sin(azimuth), np.cos(azimuth), 0.0 * azimuth], axis=1)
        facing = (normals * offset).sum(axis=1) * self.inverse
        facing = np.copysign(np.maximum(np.abs(facing), MIN_COSINE), facing)
        self.slope_row = (normals * up).sum(axis=1) / facing
        self.slope_column = (normals * across).sum(axis=1) / facing
        steps = np.abs(self.slope_row) + np.abs(self.slope_column) * self.flat
        self.inverse *= 1.0 - self.settings.setback * steps * np.pi / self.rows
        self.size = self.radius * self.inverse * self.rows / np.pi

    def put(self, which, row, column, over=False):
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

    def splat_four(self, which):
        """Fill those of the four nearest cells whose centre is within reach."""
        for k in (0, 1):
            for m in (0, 1):
                row = np.floor(self.row[which] - 0.5).astype(int) + k
                column = np.floor(self.column[which] - 0.5).astype(int) + m
                size = self.size[which]
                within = (np.abs(row + 0.5 - self.row[which]) <= np.maximum(size, 0.5)) \
                    & (np.abs(column + 0.5 - self.column[which])
                       <= np.maximum(size / self.flat[which], 0.5)) \
                    & (row >= 0) & (row < self.rows)
                self.put(which[within], row[within], column[within])

    def splat_ellipse(self, large):
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
                self.put(np.full(len(columns), i), np.full(len(columns), row), columns, over)

    def visible(self):
        """Return (N,) bool: at most base + share * radius behind the farthest of four cells."""
        around = np.pad(np.pad(self.shadow, ((0, 0), (1, 1)), mode='wrap'), ((1, 1), (0, 0)),
                        constant_values=np.inf)
        row = np.floor(self.row + 0.5).astype(int)
        column = np.floor(self.column + 0.5).astype(int)
        deepest = 1.0 / np.min([around[row + k, column + m] for k in (0, 1) for m in (0, 1)],
                               axis=0)
        behind = self.settings.base_tolerance + self.settings.radius_tolerance * self.radius
        return (self.distance <= self.max_range) & (self.distance <= deepest + behind)
