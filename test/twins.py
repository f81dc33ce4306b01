# SPDX-License-Identifier: Apache-2.0
"""Slow, obvious NumPy twins of the engine's kernels."""

import numpy as np


def project(points, normals, position, rotation, model):
    """Return distance (inf where not measured), elevation, azimuth and cosine, each (N,)."""
    d = points.astype(np.float64) - position
    r = np.linalg.norm(d, axis=1)
    elevation = np.arctan2(d[:, 2], np.hypot(d[:, 0], d[:, 1]))
    azimuth = np.arctan2(d[:, 1], d[:, 0])
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
    cosine = np.ones(len(points))
    if len(normals):
        with np.errstate(invalid='ignore'):
            cosine = np.abs((d * normals).sum(axis=1)) / r
    return np.where(measured, r, np.inf), elevation, azimuth, cosine


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


def visible(distance, elevation, azimuth, cosine, spacing, settings, shadow):
    """Return (N,) bool: r <= SM[cell] + compensation."""
    rows, columns = shadow.shape
    row = np.clip(((elevation + np.pi / 2) * rows / np.pi).astype(int), 0, rows - 1)
    column = np.floor((azimuth + np.pi) * columns / (2 * np.pi)).astype(int) % columns
    cosine = np.clip(cosine, 1e-6, 1.0)
    tangent = np.minimum(np.sqrt(1 - cosine ** 2) / cosine, settings.max_tangent)
    measured = np.isfinite(distance)
    reach = settings.cube_scale * spacing + np.where(measured, distance, 0) * np.pi / rows / 2
    return measured & (
        distance <= shadow[row, column] + settings.base + settings.slope * reach * tangent)


def depth_error(points, spacing, positions, far, settings, seen):
    """Return the sum over viewpoints of the mean difference of two depth maps."""
    total = 0.0
    for position in positions:
        d = points.astype(np.float64) - position
        r = np.linalg.norm(d, axis=1)
        e, a = np.arctan2(d[:, 2], np.hypot(d[:, 0], d[:, 1])), np.arctan2(d[:, 1], d[:, 0])
        half = settings.cube_scale * spacing
        full = shadow_map(r, e, a, half, settings.rows, far)
        part = shadow_map(r[seen], e[seen], a[seen], half[seen], settings.rows, far)
        total += np.abs(part - full).mean()
    return total
