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
Shadow maps of surfels: points as small discs that lie on the surface they were sampled from.

A cell of the map contains the inverse distance of the nearest disc along the ray through the
cell's centre. In a plane with normal n through a point d, the inverse distance along the unit ray
u is n.u / n.d, which is linear in u. So within the few cells of a disc, the inverse distance
changes by a constant step per row and per column. A point is compared with the farthest of the
four cells around it. The cells of a slanted surface lie on both sides of the point, so such a
surface does not hide itself and needs no compensation for its slope.

Points of a scan deviate from their surface, and so do their planes. Along a ray, this error is
divided by the cosine of the angle between ray and normal. The nearest of all discs in a cell
counts, so the more points there are, the farther the map lies in front of the surface, most of all
for large cells and slanted surfaces. Therefore a disc can be set back by a share of the depth that
its plane spans in one cell.
"""

import math
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import camera_of, in_cone, OMNIDIRECTIONAL
from ocp_ros.geometry.packed_bits import find_blocks_in_view, POINTS_PER_BLOCK, WORDS_PER_BLOCK
from ocp_ros.geometry.shadow_maps import LANES, put_nearer
from ocp_ros.util.kernels import njit

f32, i32, u32, u64 = np.float32, np.int32, np.uint32, np.uint64
#: LLVM's fast-math flags: no value here becomes NaN, and the order of a sum does not matter.
FASTMATH = {'nsz', 'arcp', 'contract', 'afn', 'reassoc'}
PI, HALF_PI, HALF, ONE = f32(np.pi), f32(np.pi / 2), f32(0.5), f32(1.0)
#: The least inverse distance of a disc, in multiples of that of its point.
MIN_INVERSE_RATIO = f32(0.7)
#: The largest inverse distance of a disc, in multiples of that of its point.
MAX_INVERSE_RATIO = f32(1.4)
#: The least cosine used of the angle between ray and normal, for grazing surfaces.
MIN_COSINE = f32(0.12)
#: Metres: a point nearer to the camera than this is the camera itself.
MIN_DISTANCE_M = f32(1e-3)


class Surfels(NamedTuple):
    """
    N points as discs in their tangent planes; each field is (N,) float32, map frame.

    :ivar x: x of the point, metres.
    :ivar y: y of the point, metres.
    :ivar z: z of the point, metres.
    :ivar radius: radius of the disc, metres.
    :ivar nx: x of the unit normal, which has either sign.
    :ivar ny: y of the unit normal.
    :ivar nz: z of the unit normal.
    """

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    radius: np.ndarray
    nx: np.ndarray
    ny: np.ndarray
    nz: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, normals: np.ndarray, radius: np.ndarray) -> 'Surfels':
        """Build surfels from points (N, 3), metres, unit normals (N, 3) and radii (N,), metres."""
        columns = [*np.asarray(points).T, radius, *np.asarray(normals).T]
        return cls(*(np.ascontiguousarray(column, dtype=np.float32) for column in columns))


class SurfelPlaces(NamedTuple):
    """
    M positions in the air, which do not occlude; each field is (M,) float32, metres, map frame.

    :ivar x: x of the position.
    :ivar y: y of the position.
    :ivar z: z of the position.
    :ivar radius: 0; the field exists because :func:`mark_visible_points` reads it.
    """

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    radius: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray) -> 'SurfelPlaces':
        """Build positions from points (M, 3), metres."""
        columns = [*np.asarray(points).T, np.zeros(len(points))]
        return cls(*(np.ascontiguousarray(column, dtype=np.float32) for column in columns))


class SurfelSettings(NamedTuple):
    """
    The rules of filling a map with discs and of comparing points with it.

    :ivar rows: rows of the map; it has twice as many columns.
    :ivar base_tolerance: depth tolerance of a visible point, metres.
    :ivar radius_tolerance: additional tolerance in multiples of the disc's radius.
    :ivar single_limit: discs whose radius is less than this number of columns fill only their own
        cell.
    :ivar quad_limit: other discs whose radius is less than this number of columns fill up to the
        four nearest cells; larger ones fill the cells whose centre they cover.
    :ivar setback: the share of the depth that a disc's plane spans in one cell, along rows and
        columns, by which the disc is set back in the map.
    """

    rows: int
    base_tolerance: float
    radius_tolerance: float
    single_limit: float
    quad_limit: float
    setback: float = 0.0


class Workspace(NamedTuple):
    """
    Memory for one view: a map of H rows and W columns, and the projection of a block of points.

    :ivar inverse_map: ((H + 2) (W + 2),) float32: inverse distances, 1/m, with a border of one
        cell that repeats the cells beyond azimuth -pi and pi.
    :ivar farthest_of_four: the same shape, 1/m: the least value of each cell and the three cells
        to the right and above.
    :ivar inverse: (256,) float32, 1 / distance of the disc after setting it back, 1/m; 0 for
        points beyond the camera's range or nearer than ``MIN_DISTANCE_M``.
    :ivar row: (256,) float32, elevation in rows of the map.
    :ivar column: (256,) float32, azimuth in columns of the map.
    :ivar elevation_cosine: (256,) float32.
    :ivar step_row: (256,) float32, change of the inverse distance per row along the disc, 1/m.
    :ivar step_column: (256,) float32, the same per column.
    :ivar radius_rows: (256,) float32, radius of the disc in rows of the map.
    :ivar radius_columns: (256,) float32, the same in columns.
    :ivar own_cell: (256,) uint32, the index in the map of the cell that contains the point.
    :ivar own_value: (256,) float32, the inverse distance of the disc in this cell, 1/m.
    :ivar disc_lists: (3, 257) uint32, a row each for the discs that fill one cell, up to four
        cells, and more: their numbers in the block.
    :ivar quad_values: (4, 256) float32, the inverse distances of each disc of the second row in
        the four cells around it, 1/m.
    :ivar quad_cell: (256,) uint32, the lower left one of these four cells.
    :ivar flags: (256,) uint8, whether a point is visible.
    :ivar octets: (32,) uint64, the same memory as ``flags``, with eight flags in each integer.
    :ivar distance: (N,) float32, the distance of each of all N points, metres.
    :ivar lower_left: (N,) uint32, the lower left one of the four cells around each point.
    :ivar blocks: (B,) uint32, the indices of the blocks to process, of all B blocks.
    """

    inverse_map: np.ndarray
    farthest_of_four: np.ndarray
    inverse: np.ndarray
    row: np.ndarray
    column: np.ndarray
    elevation_cosine: np.ndarray
    step_row: np.ndarray
    step_column: np.ndarray
    radius_rows: np.ndarray
    radius_columns: np.ndarray
    own_cell: np.ndarray
    own_value: np.ndarray
    disc_lists: np.ndarray
    quad_values: np.ndarray
    quad_cell: np.ndarray
    flags: np.ndarray
    octets: np.ndarray
    distance: np.ndarray
    lower_left: np.ndarray
    blocks: np.ndarray

    @classmethod
    def of(cls, rows: int, count: int) -> 'Workspace':
        """Allocate memory for maps with ``rows`` rows and ``count`` points."""
        cells, size = (rows + 2) * (2 * rows + 2), POINTS_PER_BLOCK
        octets = np.zeros(size // 8, u64)
        # Writing a whole vector may go beyond the end of the last row.
        maps = [np.full(cells + LANES, np.inf, f32)[:cells] for _ in range(2)]
        # The eight fields from ``inverse`` to ``radius_columns``.
        block = [np.empty(size, f32) for _ in range(8)]
        own_cell, quad_cell = (np.empty(size, u32) for _ in range(2))
        return cls._make([
            *maps, *block, own_cell, np.empty(size, f32), np.zeros((3, size + 1), u32),
            np.empty((4, size), f32), quad_cell, octets.view(np.uint8), octets,
            np.empty(count, f32), np.empty(count, u32), np.empty(-(-count // size), u32)])


@njit(nogil=True, inline='always', fastmath=FASTMATH)
def _arctan2(y, x):
    """Return the angle of (x, y), to 2e-6 radians, by a polynomial, which LLVM can vectorise."""
    x_size, y_size = abs(x), abs(y)
    ratio = min(x_size, y_size) / max(max(x_size, y_size), f32(1e-20))
    square = ratio * ratio
    angle = f32(-0.0117212) * square + f32(0.05265332)
    angle = angle * square + f32(-0.11643287)
    angle = angle * square + f32(0.19354346)
    angle = angle * square + f32(-0.33262347)
    angle = (angle * square + f32(0.99997726)) * ratio
    angle = HALF_PI - angle if y_size > x_size else angle
    angle = PI - angle if x < f32(0.0) else angle
    return -angle if y < f32(0.0) else angle


@njit(nogil=True, inline='always', fastmath=FASTMATH)
def _block_range(number, count):
    """Return the first point of a block, and its number of points, of ``count`` in all blocks."""
    # Unsigned, since an index that may be negative prevents the vectorisation of a loop.
    size = u64(POINTS_PER_BLOCK)
    first = u64(number) * size
    return first, min(size, u64(count) - first)


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model='numpy')
def project_block(surfels, number, position, max_range, settings, work):
    """
    Project the surfels of one block into the map of a camera, in one loop without branches.

    :param surfels: N :class:`Surfels`.
    :param number: the number of the block.
    :param position: (3,) float64, of the camera, metres.
    :param max_range: of the camera, metres.
    :param settings: :class:`SurfelSettings`.
    :param work: :class:`Workspace`, in which the fields that :func:`splat_surfels` needs change.
    """
    rows = settings.rows
    setback, range_limit = f32(settings.setback), f32(max_range)
    x0, y0, z0 = f32(position[0]), f32(position[1]), f32(position[2])
    # Columns have the same scale as rows: a map has 2 * rows columns for 2 pi.
    rows_per_radian, radians_per_row = f32(rows) / PI, PI / f32(rows)
    # Elevation pi / 2 and azimuth pi belong to the last row and column.
    last_row, last_column = f32(rows) - f32(1e-3), f32(2 * rows) - f32(2e-3)
    stride = u32(2 * rows + 2)
    first, count = _block_range(number, surfels.x.shape[0])
    for j in range(count):
        i = first + j
        dx, dy, dz = surfels.x[i] - x0, surfels.y[i] - y0, surfels.z[i] - z0
        level_distance = math.sqrt(dx * dx + dy * dy)
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        inverse = ONE / max(distance, f32(1e-6))
        inverse_level = ONE / max(level_distance, f32(1e-6))
        # Cosine and sine of azimuth and elevation.
        cos_a, sin_a = dx * inverse_level, dy * inverse_level
        cos_e, sin_e = level_distance * inverse, dz * inverse
        # The normal's component along the horizontal part of the ray, and along the ray.
        normal_level = surfels.nx[i] * cos_a + surfels.ny[i] * sin_a
        incidence = normal_level * cos_e + surfels.nz[i] * sin_e
        # The factor of the steps of n.u / n.d, see the module; the divisor has a lower limit.
        scale = inverse * radians_per_row
        scale = (scale if incidence >= f32(0.0) else -scale) / max(abs(incidence), MIN_COSINE)
        step_row = (surfels.nz[i] * cos_e - normal_level * sin_e) * scale
        step_column = (surfels.ny[i] * cos_a - surfels.nx[i] * sin_a) * scale * cos_e
        inverse_set_back = inverse - setback * (abs(step_row) + abs(step_column))
        row = min((_arctan2(dz, level_distance) + HALF_PI) * rows_per_radian, last_row)
        column = min((_arctan2(dy, dx) + PI) * rows_per_radian, last_column)
        work.row[j], work.column[j] = row, column
        work.distance[i] = distance
        # The lower left one of the four nearest cells is (floor(row - 0.5), floor(column - 0.5)).
        # The border adds 1 to both indices.
        work.lower_left[i] = u32(i32(row + HALF)) * stride + u32(i32(column + HALF))
        work.elevation_cosine[j] = max(cos_e, f32(1e-4))
        work.step_row[j], work.step_column[j] = step_row, step_column
        in_range = (distance >= MIN_DISTANCE_M) & (distance <= range_limit)
        work.inverse[j] = inverse_set_back if in_range else f32(0.0)


@njit(nogil=True, inline='always', fastmath=FASTMATH)
def _clamped(value, inverse):
    """Return the inverse distance of a disc, limited to values near that of its point."""
    return min(max(value, MIN_INVERSE_RATIO * inverse), MAX_INVERSE_RATIO * inverse)


@njit(nogil=True, fastmath=FASTMATH, error_model='numpy')
def _sort_block(surfels, number, settings, work):
    """
    List the discs of a block by how many cells they fill; compute values of their own cells.

    :returns: how many discs fill only the cell of their point, up to four cells, and more; their
        numbers are in the three rows of ``work.disc_lists``.
    """
    rows_per_radian, stride = f32(settings.rows) / PI, u32(2 * settings.rows + 2)
    single_limit, quad_limit = f32(settings.single_limit), f32(settings.quad_limit)
    first, count = _block_range(number, surfels.x.shape[0])
    for j in range(count):
        inverse, row, column = work.inverse[j], work.row[j], work.column[j]
        radius = surfels.radius[first + j] * inverse * rows_per_radian
        # Rows are shorter near the poles, so the disc covers more columns there.
        work.radius_rows[j], work.radius_columns[j] = radius, radius / work.elevation_cosine[j]
        own_row, own_column = i32(row), i32(column)
        value = (inverse + work.step_row[j] * (f32(own_row) + HALF - row)
                 + work.step_column[j] * (f32(own_column) + HALF - column))
        work.own_cell[j] = u32(own_row + 1) * stride + u32(own_column + 1)
        work.own_value[j] = _clamped(value, inverse)
    singles = quads = ellipses = u64(0)
    for j in range(count):
        # The next disc overwrites the entries in the two rows that this disc does not belong to.
        work.disc_lists[0, singles] = work.disc_lists[1, quads] = work.disc_lists[2, ellipses] = j
        in_range = work.inverse[j] > f32(0.0)
        radius = work.radius_columns[j]
        singles += u64(in_range & (radius < single_limit))
        quads += u64(in_range & (radius >= single_limit) & (radius < quad_limit))
        ellipses += u64(in_range & (radius >= quad_limit))
    return singles, quads, ellipses


@njit(nogil=True, fastmath=FASTMATH, error_model='numpy')
def _splat_quads(discs, stride, work, inverse_map):
    """Fill those of the four cells nearest to each disc whose centre is within its radius."""
    zero, values = f32(0.0), work.quad_values
    for k in range(len(discs)):
        j = discs[k]
        # Rows and columns from the centre of the first border cell: the border adds 1, and its
        # centre is at 0.5. So the integer part is the lower left one of the four nearest cells.
        inverse, row, column = work.inverse[j], work.row[j] + HALF, work.column[j] + HALF
        step_row, step_column = work.step_row[j], work.step_column[j]
        # With half a cell at least, a disc fills one of the four cells or more.
        radius_rows = max(work.radius_rows[j], HALF)
        radius_columns = max(work.radius_columns[j], HALF)
        first_row, first_column = i32(row), i32(column)
        row_offset, column_offset = row - f32(first_row), column - f32(first_column)
        value = inverse - step_row * row_offset - step_column * column_offset
        in_row, in_column = row_offset <= radius_rows, column_offset <= radius_columns
        in_next_row = ONE - row_offset <= radius_rows
        in_next_column = ONE - column_offset <= radius_columns
        work.quad_cell[k] = u32(first_row) * u32(stride) + u32(first_column)
        values[0, k] = _clamped(value, inverse) if in_row & in_column else zero
        values[1, k] = _clamped(value + step_column, inverse) if in_row & in_next_column else zero
        values[2, k] = _clamped(value + step_row, inverse) if in_next_row & in_column else zero
        values[3, k] = (_clamped(value + step_row + step_column, inverse)
                        if in_next_row & in_next_column else zero)
    # Discs may share cells, so this loop is not vectorised.
    for k in range(len(discs)):
        cell = u64(work.quad_cell[k])
        next_cell = cell + u64(stride)
        inverse_map[cell] = max(inverse_map[cell], values[0, k])
        inverse_map[cell + u64(1)] = max(inverse_map[cell + u64(1)], values[1, k])
        inverse_map[next_cell] = max(inverse_map[next_cell], values[2, k])
        inverse_map[next_cell + u64(1)] = max(inverse_map[next_cell + u64(1)], values[3, k])


@njit(nogil=True, inline='always', fastmath=FASTMATH)
def _ceil(value):
    """Return the ceiling of a number, without the function call of libm."""
    whole = i32(value)
    return whole + i32(value > f32(whole))


@njit(nogil=True, fastmath=FASTMATH, error_model='numpy')
def _splat_ellipse(inverse, row, column, cosine, radius, step_row, step_column, rows, inverse_map):
    """
    Fill the cells whose centre is within the disc, an ellipse in the map, and its own cell.

    The disc contains an offset w from its point, perpendicular to the ray u, if
    |w|^2 + (n.w / n.u)^2 <= radius^2. This is solved for the columns of each row. The parameters
    are those of one disc in :class:`Workspace`: ``radius`` in rows, ``cosine`` of the elevation.
    """
    columns, stride = 2 * rows, 2 * rows + 2
    columns_per_row = ONE / cosine
    tilt_scale = f32(rows) / (PI * inverse)
    # The components of n / n.u along rows and columns.
    tilt_row, tilt_column = step_row * tilt_scale, step_column * tilt_scale * columns_per_row
    square_factor = ONE + tilt_column * tilt_column
    determinant = square_factor + tilt_row * tilt_row
    column_scale = columns_per_row / square_factor
    centre_step = tilt_row * tilt_column * column_scale
    squared_radius = square_factor * radius * radius
    half_rows = radius * math.sqrt(max(square_factor / determinant, f32(1e-4)))
    low, high = MIN_INVERSE_RATIO * inverse, MAX_INVERSE_RATIO * inverse
    own_row, own_column = i32(row), i32(column)
    # -_ceil(-x) is the floor of x.
    first_row = max(min(_ceil(row - half_rows - HALF), own_row), 0)
    last_row = min(max(-_ceil(HALF - row - half_rows), own_row), rows - 1)
    for r in range(first_row, last_row + 1):
        row_offset = f32(r) + HALF - row
        # The distances, in rows, from the point over each pole to this row on the other side. A
        # disc that extends so far over a pole covers the row on both sides, so the whole row.
        if min(row + f32(r) + HALF, f32(2 * rows) - row - f32(r) - HALF) <= radius:
            value = _clamped(inverse + step_row * row_offset, inverse)
            for cell in range(u64((r + 1) * stride + 1), u64((r + 1) * stride + 1 + columns)):
                inverse_map[cell] = max(inverse_map[cell], value)
            continue
        # The columns of the ellipse in this row.
        centre = column - centre_step * row_offset
        inside = squared_radius - row_offset * row_offset * determinant
        half_columns = math.sqrt(max(inside, f32(0.0))) * column_scale
        first, last = _ceil(centre - half_columns - HALF), -_ceil(HALF - centre - half_columns)
        if r == own_row:
            first, last = min(first, own_column), max(last, own_column)
        if last - first >= columns:
            first, last = 0, columns - 1
        value = inverse + step_row * row_offset + step_column * (f32(first) + HALF - column)
        if first >= 0 and last < columns:
            cell = u64((r + 1) * stride + 1 + first)
            for remaining in range(last - first, -1, -LANES):
                put_nearer(inverse_map, cell, value, step_column, low, high, f32(remaining))
                cell += u64(LANES)
                value += step_column * f32(LANES)
        else:
            # These columns go on at the other edge of the map.
            for c in range(first, last + 1):
                cell = u64((r + 1) * stride + 1 + c % columns)
                inverse_map[cell] = max(inverse_map[cell], _clamped(value, inverse))
                value += step_column


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model='numpy')
def splat_surfels(surfels, blocks, position, max_range, settings, work):
    """
    Fill a map with the inverse distance of the nearest disc in each cell.

    :param surfels: N :class:`Surfels`.
    :param blocks: (B,) the indices of the blocks whose discs are used.
    :param position: (3,) float64, of the camera, metres.
    :param max_range: of the camera, metres; empty cells have this distance.
    :param settings: :class:`SurfelSettings`.
    :param work: :class:`Workspace`, whose maps are overwritten.
    """
    rows, stride = settings.rows, 2 * settings.rows + 2
    inverse_map = work.inverse_map
    inverse_map[:] = ONE / f32(max_range)
    # Discs of one cell, of up to four cells, and larger ones; each block reuses the workspace.
    for number in blocks:
        project_block(surfels, number, position, max_range, settings, work)
        singles, quads, ellipses = _sort_block(surfels, number, settings, work)
        for k in range(singles):
            j = work.disc_lists[0, k]
            cell = u64(work.own_cell[j])
            inverse_map[cell] = max(inverse_map[cell], work.own_value[j])
        _splat_quads(work.disc_lists[1, :quads], stride, work, inverse_map)
        for k in range(ellipses):
            j = work.disc_lists[2, k]
            _splat_ellipse(work.inverse[j], work.row[j], work.column[j], work.elevation_cosine[j],
                           work.radius_rows[j], work.step_row[j], work.step_column[j], rows,
                           inverse_map)
    _join_edges(rows, stride, inverse_map)
    _take_farthest(rows, stride, inverse_map, work.farthest_of_four)


@njit(nogil=True)
def _join_edges(rows, stride, inverse_map):
    """Set the cells on both sides of azimuth pi to the nearer value; fill rows beyond poles."""
    columns = stride - 2
    for row in range(1, rows + 1):
        first = row * stride
        # A border cell and the cell that it repeats: discs may have been written to either one.
        for left, right in ((0, columns), (1, columns + 1)):
            nearer = max(inverse_map[first + left], inverse_map[first + right])
            inverse_map[first + left] = inverse_map[first + right] = nearer
    # Rows beyond a pole are never the farthest cells.
    inverse_map[:stride] = f32(np.inf)
    inverse_map[(rows + 1) * stride:] = f32(np.inf)


@njit(nogil=True)
def _take_farthest(rows, stride, inverse_map, farthest_of_four):
    """Write the least value of each cell and the three cells to the right and above."""
    width = u64(stride)
    for row in range(u64(rows + 1)):
        for cell in range(row * width, row * width + width - u64(1)):
            lower = min(inverse_map[cell], inverse_map[cell + u64(1)])
            upper = min(inverse_map[cell + width], inverse_map[cell + width + u64(1)])
            farthest_of_four[cell] = min(lower, upper)


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model='numpy')
def locate_block(places, number, position, rows, work):
    """
    Project the positions of one block; like :func:`project_block`, without discs.

    :param places: M :class:`SurfelPlaces`.
    :param number: the number of the block.
    :param position: (3,) float64, of the camera, metres.
    :param rows: rows of the map.
    :param work: :class:`Workspace`, whose ``distance`` and ``lower_left`` change.
    """
    x0, y0, z0 = f32(position[0]), f32(position[1]), f32(position[2])
    rows_per_radian, stride = f32(rows) / PI, u32(2 * rows + 2)
    # These two limits and the offset of half a cell are as in ``project_block``.
    last_row, last_column = f32(rows) - f32(1e-3), f32(2 * rows) - f32(2e-3)
    first, count = _block_range(number, places.x.shape[0])
    for i in range(first, first + count):
        dx, dy, dz = places.x[i] - x0, places.y[i] - y0, places.z[i] - z0
        level_distance = math.sqrt(dx * dx + dy * dy)
        work.distance[i] = math.sqrt(dx * dx + dy * dy + dz * dz)
        row = min((_arctan2(dz, level_distance) + HALF_PI) * rows_per_radian, last_row)
        column = min((_arctan2(dy, dx) + PI) * rows_per_radian, last_column)
        work.lower_left[i] = u32(i32(row + HALF)) * stride + u32(i32(column + HALF))


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model='numpy')
def mark_visible_points(points, blocks, pose, lens, settings, work, seen):
    """
    Set the bits of the points that are visible to a camera.

    A point is visible if it is at most base_tolerance + radius_tolerance * radius behind the
    farthest of the four nearest cells.

    :param points: N :class:`Surfels` or :class:`SurfelPlaces` whose blocks have been projected.
    :param blocks: (B,) the indices of the blocks whose points are checked.
    :param pose: the camera's :class:`~ocp_ros.geometry.cameras.Pose`.
    :param lens: the camera model's :class:`~ocp_ros.geometry.cameras.Frustum`.
    :param settings: :class:`SurfelSettings`.
    :param work: :class:`Workspace` after :func:`splat_surfels` for the same camera.
    :param seen: (W,) uint64, packed bits, in and out: set for visible points, otherwise unchanged.
    """
    base_tolerance, radius_tolerance = f32(settings.base_tolerance), f32(settings.radius_tolerance)
    min_range, max_range = max(f32(lens.min_range), MIN_DISTANCE_M), f32(lens.max_range)
    flags = work.flags
    for number in blocks:
        first, count = _block_range(number, points.x.shape[0])
        for j in range(count):
            distance = work.distance[first + j]
            limit = distance - base_tolerance - radius_tolerance * points.radius[first + j]
            # limit <= the distance of the farthest of the four cells, without a division.
            flags[j] = ((limit * work.farthest_of_four[work.lower_left[first + j]] <= ONE)
                        & (distance >= min_range) & (distance <= max_range))
        flags[count:] = 0
        if lens.kind != OMNIDIRECTIONAL:
            _clear_outside_cone(points, first, count, pose, lens, flags)
        # The octets are the memory of ``flags``, eight flags in each.
        _add_bits(work.octets, seen, u64(number) * u64(WORDS_PER_BLOCK))


@njit(nogil=True)
def _clear_outside_cone(points, first, count, pose, lens, flags):
    """Clear the flags (256,) of points outside the cone; flag j is that of point first + j."""
    x0, y0, z0 = pose.position[0], pose.position[1], pose.position[2]
    for j in range(count):
        i = first + j
        flags[j] &= in_cone(points.x[i] - x0, points.y[i] - y0, points.z[i] - z0, pose, lens)


@njit(cache=True, nogil=True)
def kept_in_cone(points, bounds, pose, lens, seen):
    """
    Return the points visible to an omnidirectional camera that are also in a viewing cone.

    :param points: N :class:`Surfels` or :class:`SurfelPlaces` in spatial order.
    :param bounds: (B, 2, 3) float32, metres, the bounding boxes of their B blocks.
    :param pose: the camera's :class:`~ocp_ros.geometry.cameras.Pose`.
    :param lens: the camera model's :class:`~ocp_ros.geometry.cameras.Frustum`.
    :param seen: (W,) uint64, packed bits of the visible points.
    :returns: (W,) uint64, packed bits of the visible points that are in the viewing cone.
    """
    kept, blocks = np.zeros_like(seen), np.empty(bounds.shape[0], dtype=np.uint32)
    # One memory with two names: ``flags`` has one byte for each point of a block, ``flag_groups``
    # has eight of these bytes in each integer, which ``_add_bits`` packs at once.
    flag_groups = np.empty(POINTS_PER_BLOCK // 8, dtype=np.uint64)
    flags = flag_groups.view(np.uint8)
    block_count = find_blocks_in_view(bounds, pose, lens, blocks)
    for number in blocks[:block_count]:
        first, count = _block_range(number, points.x.shape[0])
        flags[:count], flags[count:] = 1, 0
        _clear_outside_cone(points, first, count, pose, lens, flags)
        _add_bits(flag_groups, kept, u64(number) * u64(WORDS_PER_BLOCK))
    return kept & seen


@njit(nogil=True, inline='always')
def _add_bits(flag_groups, seen, first):
    """Set the bits of 256 flags, eight in each integer, in the four words from ``first``."""
    for word in range(u64(WORDS_PER_BLOCK)):
        bits = u64(0)
        for k in range(u64(8)):
            # The product moves the lowest bit of each byte into the highest byte.
            byte = (flag_groups[word * u64(8) + k] * u64(0x0102040810204080)) >> u64(56)
            bits |= byte << (k * u64(8))
        seen[first + word] |= bits


@njit(cache=True, nogil=True)
def look_at_surfels_from_all(surfels, bounds, places, place_bounds, cameras, settings, work, seen,
                             covered):
    """
    Call :func:`look_at_surfels` for K cameras.

    :param cameras: the :class:`~ocp_ros.geometry.cameras.CameraArrays` of these cameras.
    :param seen: (K, W) uint64, packed bits of the points, a row for each camera, in and out.
    :param covered: (K, V) uint64, packed bits of the positions, in and out.
    """
    for k in range(len(seen)):
        pose, lens = camera_of(cameras, k)
        look_at_surfels(surfels, bounds, places, place_bounds, pose, lens, settings, work, seen[k],
                        covered[k])


@njit(cache=True, nogil=True)
def look_at_surfels(surfels, bounds, places, place_bounds, pose, lens, settings, work, seen,
                    covered):
    """
    Set the bits of points and positions that are visible to a camera, in one call without the GIL.

    :param surfels: N :class:`Surfels` in spatial order.
    :param bounds: (B, 2, 3) float32, metres, the bounding boxes of their B blocks.
    :param places: M :class:`SurfelPlaces` in spatial order; empty to leave them out.
    :param place_bounds: (C, 2, 3) float32, metres, the bounding boxes of their C blocks.
    :param pose: the camera's :class:`~ocp_ros.geometry.cameras.Pose`.
    :param lens: the camera model's :class:`~ocp_ros.geometry.cameras.Frustum`.
    :param settings: :class:`SurfelSettings`.
    :param work: :class:`Workspace`.
    :param seen: (W,) uint64, packed bits of the points, in and out.
    :param covered: (V,) uint64, packed bits of the positions, in and out.
    """
    # The call writes the block numbers into ``work.blocks``, and returns how many there are.
    blocks = work.blocks[:find_blocks_in_view(bounds, pose, lens, work.blocks)]
    splat_surfels(surfels, blocks, pose.position, lens.max_range, settings, work)
    mark_visible_points(surfels, blocks, pose, lens, settings, work, seen)
    if covered.shape[0]:
        blocks = work.blocks[:find_blocks_in_view(place_bounds, pose, lens, work.blocks)]
        for number in blocks:
            locate_block(places, number, pose.position, settings.rows, work)
        mark_visible_points(places, blocks, pose, lens, settings, work, covered)
