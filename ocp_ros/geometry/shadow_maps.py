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
-pi to pi, value = metres or inverse metres. The method is section III-B of arXiv 2110.11106.
"""

import math
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import camera_of, Frustum, in_cone, OMNIDIRECTIONAL, Pose
from ocp_ros.util.kernels import import_elsewhere, njit

f32, i32, u32, u64 = np.float32, np.int32, np.uint32, np.uint64
PI, HALF_PI, QUARTER_PI = np.pi, 0.5 * np.pi, 0.25 * np.pi
TAN_EIGHTH = np.sqrt(2.0) - 1.0
ir, types = import_elsewhere('llvmlite.ir'), import_elsewhere('numba').types
cgutils = import_elsewhere('numba.core.cgutils')
#: The number of cells that are written at once.
LANES = 8
#: LLVM's fast-math flags: no value here becomes NaN.
FASTMATH = ('nnan', 'nsz', 'contract', 'reassoc')


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
    :ivar elevation: (N,) float32, radians.
    :ivar azimuth: (N,) float32, radians.
    :ivar elevation_cosine: (N,) float32.
    """

    distance: np.ndarray
    elevation: np.ndarray
    azimuth: np.ndarray
    elevation_cosine: np.ndarray


class Footprints(NamedTuple):
    """
    The rectangles of cells that N points cover in a map of H rows and W columns.

    :ivar first_row: (N,) int32, from 0.
    :ivar last_row: (N,) int32, to H - 1.
    :ivar first_column: (N,) int32, from 0 to W - 1.
    :ivar count: (N,) int32, the number of columns, to W; columns beyond the last one continue at
        the first column of the map.
    """

    first_row: np.ndarray
    last_row: np.ndarray
    first_column: np.ndarray
    count: np.ndarray


@njit(nogil=True, inline='always')
def _arctan2(y, x):
    """Return the angle of (x, y), to 1e-11 radians, by a polynomial, which LLVM can vectorise."""
    x_size, y_size = abs(x), abs(y)
    low, high = min(x_size, y_size), max(max(x_size, y_size), 1e-300)
    # For an angle from pi / 8 to pi / 4, the polynomial gives the angle minus pi / 4.
    steep = low > TAN_EIGHTH * high
    ratio = (low - high if steep else low) / (low + high if steep else high)
    square = ratio * ratio
    angle = 0.047186489606509029 * square - 0.084620183188714782
    angle = angle * square + 0.11041615712244986
    angle = angle * square - 0.14281689220245003
    angle = angle * square + 0.199998879078746
    angle = angle * square - 0.33333332157429613
    angle = (angle * square + 0.99999999997983069) * ratio
    angle = angle + QUARTER_PI if steep else angle
    angle = HALF_PI - angle if y_size > x_size else angle
    angle = PI - angle if x < 0.0 else angle
    return -angle if y < 0.0 else angle


@njit(cache=True, nogil=True, error_model='numpy')
def projected(coordinates, pose, lens):
    """
    Return the :class:`Projection` of points: distances and angles along the axes of the map frame.

    :param coordinates: (3, N) float32, x, y and z of N points in contiguous rows, metres, map
        frame.
    :param pose: the camera's :class:`Pose`.
    :param lens: the camera model's :class:`~ocp_ros.geometry.cameras.Frustum`.
    """
    xs, ys, zs = coordinates[0], coordinates[1], coordinates[2]
    distance, elevation, azimuth, elevation_cosine = np.empty((4, len(xs)), dtype=np.float32)
    x0, y0, z0 = pose.position[0], pose.position[1], pose.position[2]
    # A loop without branches, so that LLVM vectorises it.
    for i in range(u64(len(xs))):
        dx, dy, dz = xs[i] - x0, ys[i] - y0, zs[i] - z0
        level_distance = math.sqrt(dx * dx + dy * dy)
        r = math.sqrt(dx * dx + dy * dy + dz * dz)
        # A distance that is 0 as float32 has no inverse, so the point is left out.
        inside = (r >= lens.min_range) & (r <= lens.max_range) & (f32(r) > f32(0.0))
        distance[i] = f32(r) if inside else f32(np.inf)
        elevation[i] = _arctan2(dz, level_distance)
        azimuth[i] = _arctan2(dy, dx)
        elevation_cosine[i] = level_distance / max(r, 1e-30)
    if lens.kind != OMNIDIRECTIONAL:
        for i in range(len(xs)):
            if distance[i] < np.inf and not in_cone(xs[i] - x0, ys[i] - y0, zs[i] - z0, pose,
                                                    lens):
                distance[i] = np.inf
    return Projection(distance, elevation, azimuth, elevation_cosine)


def in_reach(points: np.ndarray, pose: Pose, lens: Frustum) -> np.ndarray:
    """Return whether points (N, 3), metres, are in a camera's cone and range: (N,) bool."""
    return np.isfinite(projected(np.ascontiguousarray(points.T), pose, lens).distance)


@njit(nogil=True, inline='always')
def _floor(value):
    """Return the floor of a number, without the function call of libm."""
    whole = i32(value)
    return whole - i32(value < whole)


@njit(nogil=True, inline='always')
def _ceil(value):
    """Return the ceiling of a number, without the function call of libm."""
    whole = i32(value)
    return whole + i32(value > whole)


@njit(nogil=True, inline='always')
def _wrapped(column, columns):
    """Return a column from -columns to 2 * columns - 1 as one of the map, without a division."""
    return column + columns * i32(column < 0) - columns * i32(column >= columns)


@njit(nogil=True, inline='always')
def _row_of(elevation, rows):
    """Return the row of the cell of an elevation, radians, in a map of ``rows`` rows."""
    return min(max(_floor((elevation + HALF_PI) * rows / PI), i32(0)), i32(rows) - i32(1))


@njit(cache=True, nogil=True, error_model='numpy')
def footprints(projection, half_sides, rows, columns):
    """
    Return the :class:`Footprints` of points in a map.

    A point is a cube, so it covers a rectangle of half-width half_side / distance in elevation
    and half_side / (distance cos(elevation)) in azimuth. It covers the cells whose centre lies in
    this rectangle, and always the cell of its centre; a cube that extends over a pole covers full
    rows.

    :param projection: :class:`Projection` of N points.
    :param half_sides: (N,) float32, half the side of each point's cube, metres.
    :param rows: rows of the map.
    :param columns: columns of the map.
    """
    first_row, last_row, first_column, count = np.empty((4, len(half_sides)), dtype=np.int32)
    rows_per_radian, columns_per_radian = rows / PI, 0.5 * columns / PI
    all_columns = i32(columns)
    # A loop without branches, so that LLVM vectorises it.
    for i in range(u64(len(half_sides))):
        elevation = np.float64(projection.elevation[i])
        half_angle = min(np.float64(half_sides[i]) / projection.distance[i], PI)
        row = _row_of(elevation, rows)
        # Rows and columns are measured from the centre of the first cell, whose edge is at -0.5.
        centre_row = (elevation + HALF_PI) * rows_per_radian - 0.5
        half_rows = half_angle * rows_per_radian
        first_row[i] = max(min(_ceil(centre_row - half_rows), row), i32(0))
        last_row[i] = min(max(_floor(centre_row + half_rows), row), i32(rows) - i32(1))
        half_azimuth = half_angle / max(np.float64(projection.elevation_cosine[i]), 1e-6)
        over_pole = (half_angle >= HALF_PI - abs(elevation)) | (half_azimuth >= PI)
        centre_column = (projection.azimuth[i] + PI) * columns_per_radian - 0.5
        half_columns = min(half_azimuth, PI) * columns_per_radian
        # Measured from the edge instead, the floor is the cell that contains the point.
        column = _floor(centre_column + 0.5)
        first = min(_ceil(centre_column - half_columns), column)
        last = max(_floor(centre_column + half_columns), column)
        first_column[i] = i32(0) if over_pole else _wrapped(first, all_columns)
        count[i] = all_columns if over_pole else min(last - first + i32(1), all_columns)
    return Footprints(first_row, last_row, first_column, count)


@njit(cache=True, nogil=True, error_model='numpy')
def splat(projection, footprints, empty_depth, rows, columns):
    """
    Return a shadow map with the inverse distance of the nearest point that covers each cell.

    :param projection: :class:`Projection` of N points.
    :param footprints: :class:`Footprints` of these points in the map.
    :param empty_depth: the depth of an empty cell, metres; points farther away are left out.
    :param rows: rows of the map, H.
    :param columns: columns of the map, W.
    :returns: (H, W) float32, 1/m.
    """
    # Writing a whole vector may go beyond the end of the last row.
    cells = np.full(rows * columns + LANES, f32(1.0 / empty_depth), dtype=np.float32)
    for i in range(u64(len(projection.distance))):
        if projection.distance[i] > empty_depth:
            continue
        inverse = f32(1.0) / projection.distance[i]
        first, count = footprints.first_column[i], footprints.count[i]
        # Columns up to the right edge of the map; the others continue at the left edge. All cells
        # get the same value.
        before_edge = min(count, columns - first)
        for row in range(footprints.first_row[i], footprints.last_row[i] + 1):
            start = row * columns
            for k in range(0, before_edge, LANES):
                put_nearer(cells, u64(start + first + k), inverse, f32(0.0), inverse, inverse,
                           f32(before_edge - 1 - k))
            after_edge = count - before_edge
            for k in range(0, after_edge, LANES):
                put_nearer(cells, u64(start + k), inverse, f32(0.0), inverse, inverse,
                           f32(after_edge - 1 - k))
    return cells[:rows * columns].reshape((rows, columns))


@njit(cache=True, nogil=True)
def look_at_cubes(points, half_sides, places, pose, lens, settings, seen, covered):
    """
    Set the bits of the points and positions that are visible to a camera, without the GIL.

    :param points: (3, N) float32, x, y and z of N points in contiguous rows, metres, map frame.
    :param half_sides: (N,) float32, half the side of each point's cube, metres.
    :param places: (3, M) float32, the same of M positions in the air.
    :param pose: the camera's :class:`Pose`.
    :param lens: the camera model's :class:`~ocp_ros.geometry.cameras.Frustum`.
    :param settings: :class:`CubeSettings`.
    :param seen: uint64, packed bits of the points, in and out.
    :param covered: uint64, packed bits of the positions, in and out; empty to leave them out.
    """
    rows, columns = settings.rows, 2 * settings.rows
    projection = projected(points, pose, lens)
    inverse_map = splat(projection, footprints(projection, half_sides, rows, columns),
                        lens.max_range, rows, columns)
    mark_visible(projection, settings.compensation, inverse_map, seen)
    if len(covered):
        mark_visible(projected(places, pose, lens), settings.compensation, inverse_map,
                     covered)


@njit(cache=True, nogil=True)
def look_at_cubes_from_all(points, half_sides, places, cameras, settings, seen, covered):
    """
    Call :func:`look_at_cubes` for K cameras.

    :param cameras: the :class:`~ocp_ros.geometry.cameras.CameraArrays` of these cameras.
    :param seen: (K, W) uint64, packed bits of the points, a row for each camera, in and out.
    :param covered: (K, V) uint64, packed bits of the positions, in and out.
    """
    for k in range(len(seen)):
        pose, lens = camera_of(cameras, k)
        look_at_cubes(points, half_sides, places, pose, lens, settings, seen[k], covered[k])


@njit(cache=True, nogil=True, error_model='numpy')
def mark_visible(projection, compensation, inverse_map, words):
    """Set the packed bits of points with distance <= 1 / inverse_map[cell] + compensation."""
    rows, columns = inverse_map.shape
    cells, cell_of = inverse_map.ravel(), np.empty(len(projection.distance), dtype=np.uint32)
    for i in range(u64(len(cell_of))):
        row = _row_of(np.float64(projection.elevation[i]), rows)
        column = _floor((np.float64(projection.azimuth[i]) + PI) * (0.5 * columns / PI))
        cell_of[i] = u32(row) * u32(columns) + u32(_wrapped(column, i32(columns)))
    for i in range(u64(len(cell_of))):
        distance = projection.distance[i]
        visible = (distance <= f32(1.0) / cells[cell_of[i]] + compensation) & (distance < np.inf)
        words[i >> u64(6)] |= u64(visible) << (i & u64(63))


@import_elsewhere('numba.extending').intrinsic
def put_nearer(typing, cells, first, value, step, low, high, last):
    """
    Generate code that writes a plane into up to ``LANES`` cells of a row, where it is nearer.

    Compilers do not vectorise such short loops. The memory of ``LANES`` cells is read and
    written; cells after the last one do not change.

    :param cells: (N,) float32, inverse distances, 1/m, in and out.
    :param first: uint64, the index of the first cell.
    :param value: float32, the inverse distance of the plane in the first cell, 1/m.
    :param step: float32, the increase of the inverse distance per cell, 1/m.
    :param low: float32, the lower limit of the written values, 1/m.
    :param high: float32, the upper limit of the written values, 1/m.
    :param last: float32, the number of cells after the first one.
    :returns: the signature and the code generator, for Numba. This function gets the types of the
        arguments, and ``generate`` their LLVM values.
    """
    def generate(context, builder, signature, arguments):
        cells, first, *scalars = arguments
        integer, vector = ir.IntType(32), ir.VectorType(ir.FloatType(), LANES)
        undefined = ir.Constant(vector, ir.Undefined)

        def repeat_in_lanes(scalar):
            first_lane = builder.insert_element(undefined, scalar, ir.Constant(integer, 0))
            return builder.shuffle_vector(
                first_lane, undefined, ir.Constant(ir.VectorType(integer, LANES), [0] * LANES))

        def call_intrinsic(name, left, right):
            function = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(vector, [vector, vector]),
                f'llvm.{name}.v{LANES}f32')
            return builder.call(function, [left, right], fastmath=FASTMATH)

        value, step, low, high, last = map(repeat_in_lanes, scalars)
        ramp = ir.Constant(vector, [float(lane) for lane in range(LANES)])
        value = builder.fadd(value, builder.fmul(ramp, step, flags=FASTMATH), flags=FASTMATH)
        value = call_intrinsic('maxnum', call_intrinsic('minnum', value, high), low)
        # Lanes after the last cell get 0, which is infinitely far away, so that the maximum below
        # does not change their cells; storing only some lanes would be slow.
        value = builder.select(builder.fcmp_ordered('<=', ramp, last), value,
                               ir.Constant(vector, [0.0] * LANES))
        # The alignment is that of one cell, 4 bytes: a row may begin anywhere.
        array = cgutils.create_struct_proxy(signature.args[0])(context, builder, cells)
        pointer = builder.bitcast(builder.gep(array.data, [first]), vector.as_pointer())
        nearer = call_intrinsic('maxnum', builder.load(pointer, align=4), value)
        builder.store(nearer, pointer, align=4)
        return context.get_dummy_value()

    return types.void(cells, first, *[types.float32] * 5), generate
