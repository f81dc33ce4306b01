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
