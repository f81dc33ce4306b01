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
Spherical shadow maps of points as cubes: the distance to the nearest surface in each direction.

A shadow map is an (H, W) float32 array; row = elevation from -pi/2 to pi/2, column = azimuth from
-pi to pi, value = metres. The method is section III-B of arXiv 2110.11106.
"""

import math
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import Frustum, in_cone, OMNIDIRECTIONAL, Pose
from ocp_ros.util.kernels import njit

HALF_PI = 0.5 * np.pi
TWO_PI = 2.0 * np.pi
u64 = np.uint64


class CubeSettings(NamedTuple):
    """
    The size of the points' cubes in a shadow map, and the depth tolerance of visible points.

    :ivar rows: rows of a map; it has twice as many columns.
    :ivar cube_scale: half the side of a point's cube in multiples of its spacing.
    :ivar compensation: how much deeper than the map a visible point may be, metres.
    """

    rows: int
    cube_scale: float
    compensation: float


class Projection(NamedTuple):
    """
    The spherical coordinates of N points relative to a camera.

    :ivar distance: (N,) float32, metres; inf for points out of the camera's range or field of
        view.
    :ivar elevation: (N,) float32, radians; 0 for these points.
    :ivar azimuth: (N,) float32, radians; 0 for these points.
    """

    distance: np.ndarray
    elevation: np.ndarray
    azimuth: np.ndarray


@njit(cache=True, nogil=True)
def projected(points, pose, lens):
    """
    Return the :class:`Projection` of points: distances and angles along the axes of the map frame.

    :param points: (N, 3) float32, N points, metres, map frame.
    :param pose: the camera's :class:`Pose`.
    :param lens: the camera model's :class:`~ocp_ros.geometry.cameras.Frustum`.
    """
    distance, elevation, azimuth = np.zeros((3, len(points)), dtype=np.float32)
    x0, y0, z0 = pose.position[0], pose.position[1], pose.position[2]
    for i in range(points.shape[0]):
        dx, dy, dz = points[i, 0] - x0, points[i, 1] - y0, points[i, 2] - z0
        level_distance = math.sqrt(dx * dx + dy * dy)
        r = math.sqrt(level_distance * level_distance + dz * dz)
        if (r < lens.min_range or r > lens.max_range or r == 0.0
                or not (lens.kind == OMNIDIRECTIONAL or in_cone(dx, dy, dz, pose, lens))):
            distance[i] = np.inf
            continue
        distance[i] = r
        elevation[i] = math.atan2(dz, level_distance)
        azimuth[i] = math.atan2(dy, dx)
    return Projection(distance, elevation, azimuth)


def in_reach(points: np.ndarray, pose: Pose, lens: Frustum) -> np.ndarray:
    """Return whether points (N, 3), metres, are in a camera's cone and range: (N,) bool."""
    return np.isfinite(projected(points, pose, lens).distance)


@njit(nogil=True, inline='always')
def _floor(value):
    """Return the floor of a number, without the function call of libm."""
    whole = int(value)
    return whole - (value < whole)


@njit(nogil=True, inline='always')
def _ceil(value):
    """Return the ceiling of a number, without the function call of libm."""
    whole = int(value)
    return whole + (value > whole)


@njit(nogil=True, inline='always')
def _wrapped(column, columns):
    """Return a column from -columns to 2 * columns - 1 as one of the map, without a division."""
    return column + columns * (column < 0) - columns * (column >= columns)


@njit(cache=True, nogil=True, inline='always')
def cell_of(elevation, azimuth, rows, columns):
    """
    Return the row and the column of the cell of a direction.

    :param elevation: radians.
    :param azimuth: radians; pi is the same as -pi.
    :param rows: rows of the map.
    :param columns: columns of the map.
    """
    row = min(max(_floor((elevation + HALF_PI) * rows / np.pi), 0), rows - 1)
    return row, _wrapped(_floor((azimuth + np.pi) * columns / TWO_PI), columns)


@njit(cache=True, nogil=True, inline='always')
def footprint(distance, elevation, azimuth, half_side, rows, columns):
    """
    Return the cells that a point covers: first and last row, first column and column count.

    The point is a cube, so it covers a rectangle of half-width half_side / distance in elevation
    and half_side / (distance cos(elevation)) in azimuth. It covers the cells whose centre lies in
    this rectangle, and always the cell of its centre; a cube that extends over a pole covers full
    rows.

    :param distance: metres.
    :param elevation: radians.
    :param azimuth: radians.
    :param half_side: half the side of the cube, metres.
    :param rows: rows of the map.
    :param columns: columns of the map.
    :returns: four integers. The first column may be negative, or the last one beyond the map: the
        caller has to wrap the columns.
    """
    row, _ = cell_of(elevation, azimuth, rows, columns)
    half_angle = half_side / distance
    centre_row = (elevation + HALF_PI) * rows / np.pi - 0.5
    half_rows = half_angle * rows / np.pi
    first_row = max(min(_ceil(centre_row - half_rows), row), 0)
    last_row = min(max(_floor(centre_row + half_rows), row), rows - 1)
    pole_angle = HALF_PI - abs(elevation)
    half_azimuth = half_angle / max(math.cos(elevation), 1e-6)
    if half_angle >= pole_angle or half_azimuth >= np.pi:
        return first_row, last_row, 0, columns
    centre_column = (azimuth + np.pi) * columns / TWO_PI - 0.5
    half_columns = half_azimuth * columns / TWO_PI
    column = _floor(centre_column + 0.5)
    first_column = min(_ceil(centre_column - half_columns), column)
    last_column = max(_floor(centre_column + half_columns), column)
    return first_row, last_row, first_column, min(last_column - first_column + 1, columns)


@njit(cache=True, nogil=True)
def splat(projection, spacing, cube_scale, empty_depth, shadow_map):
    """
    Fill a shadow map with the distance of the nearest point that covers each cell.

    :param projection: :class:`Projection` of N points.
    :param spacing: (N,) float32, the distance of each point to its nearest neighbour, metres.
    :param cube_scale: half the side of a point's cube in multiples of its spacing.
    :param empty_depth: the value of an empty cell, metres; points farther away are left out.
    :param shadow_map: (H, W) float32, metres, H rows and W columns, out.
    """
    rows, columns = shadow_map.shape
    shadow_map[:] = empty_depth
    cells = shadow_map.ravel()
    for i in range(spacing.shape[0]):
        distance = projection.distance[i]
        if distance > empty_depth:
            continue
        first_row, last_row, first_column, count = footprint(
            distance, projection.elevation[i], projection.azimuth[i], cube_scale * spacing[i],
            rows, columns)
        first = _wrapped(first_column, columns)
        end = first + count
        for row in range(first_row, last_row + 1):
            row_start = row * columns
            # Unsigned, since an index that may be negative is checked each time.
            for cell in range(u64(row_start + first), u64(row_start + min(end, columns))):
                cells[cell] = min(cells[cell], distance)
            for cell in range(u64(row_start), u64(row_start + end - min(end, columns))):
                cells[cell] = min(cells[cell], distance)


@njit(cache=True, nogil=True)
def mark_visible(projection, compensation, shadow_map, flags):
    """
    Set the flags of the points that are visible: distance <= shadow_map[cell] + compensation.

    :param projection: :class:`Projection` of N points from a camera.
    :param compensation: how much deeper than the map a visible point may be, metres.
    :param shadow_map: (H, W) float32, metres, of the same camera, see :func:`splat`.
    :param flags: (N,) bool, in and out: True for visible points, otherwise unchanged.
    """
    rows, columns = shadow_map.shape
    for i in range(flags.shape[0]):
        distance = projection.distance[i]
        if distance == np.inf:
            continue
        row, column = cell_of(projection.elevation[i], projection.azimuth[i], rows, columns)
        if distance <= shadow_map[row, column] + compensation:
            flags[i] = True


@njit(cache=True, nogil=True)
def look_at_cubes(points, spacing, places, pose, lens, settings, seen, covered):
    """
    Set the bits of the points and positions that are visible to a camera, without the GIL.

    :param points: (N, 3) float32, N points, metres, map frame.
    :param spacing: (N,) float32, the distance of each point to its nearest neighbour, metres.
    :param places: (M, 3) float32, M positions, metres.
    :param pose: the camera's :class:`Pose`.
    :param lens: the camera model's :class:`~ocp_ros.geometry.cameras.Frustum`.
    :param settings: :class:`CubeSettings`.
    :param seen: uint64, packed bits of the points, in and out.
    :param covered: uint64, packed bits of the positions, in and out; empty to leave them out.
    """
    shadow_map = np.empty((settings.rows, 2 * settings.rows), dtype=np.float32)
    projection = projected(points, pose, lens)
    splat(projection, spacing, settings.cube_scale, lens.max_range, shadow_map)
    _set_visible_bits(projection, settings.compensation, shadow_map, seen)
    if len(covered):
        _set_visible_bits(projected(places, pose, lens), settings.compensation, shadow_map,
                          covered)


@njit(nogil=True)
def _set_visible_bits(projection, compensation, shadow_map, words):
    """Set the packed bits of the points that are visible; see :func:`mark_visible`."""
    flags = np.zeros(len(projection.distance), dtype=np.bool_)
    mark_visible(projection, compensation, shadow_map, flags)
    for i in range(len(flags)):
        words[u64(i) >> u64(6)] |= u64(flags[i]) << (u64(i) & u64(63))
