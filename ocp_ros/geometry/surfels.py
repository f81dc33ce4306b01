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
cell's centre. Along a plane, inverse distance is linear in the ray's direction, n.u / n.d for the
ray u and the point d, so within the few cells of a disc it is a sum of two steps. A point is
compared with the farthest of the four cells around it. The cells of a slanted surface lie on both
sides of the point, so such a surface does not hide itself and needs no compensation for its slope.

Points of a scan deviate from their surface, and so do their planes: along a ray by the error over
the cosine. The nearest of all discs in a cell counts, so the more points there are, the farther
the map lies in front of the surface, most of all for large cells and slanted surfaces. Therefore a
disc can be set back by a share of the depth that its plane spans in one cell.
"""

import math
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import in_cone, OMNIDIRECTIONAL
from ocp_ros.geometry.packed_bits import BLOCK, blocks_in_view, WORDS
from ocp_ros.geometry.vector_rows import LANES, put_nearer
from ocp_ros.util.kernels import njit

f32, i32, u32, u64 = np.float32, np.int32, np.uint32, np.uint64
#: No value here becomes NaN, and the order of a sum does not matter.
FAST = {'nsz', 'arcp', 'contract', 'afn', 'reassoc'}
PI, HALF_PI, HALF, ONE = f32(np.pi), f32(np.pi / 2), f32(0.5), f32(1.0)
MAX_DEPTH_RATIO = f32(1.4)
#: The range of a disc's inverse distance, in multiples of that of its point.
MIN_DEPTH_RATIO = f32(0.7)
#: The least cosine used, for grazing surfaces.
MIN_COSINE = f32(0.12)
#: Metres: a point nearer to the camera than this is the camera itself.
MIN_DISTANCE_M = f32(1e-3)
#: Unsigned, since an index that may be negative prevents the vectorisation of a loop.
STEP = u64(BLOCK)


class Surfels(NamedTuple):
    """
    Points with their tangent planes; each field is (N,) float32, metres, map frame.

    :ivar x: position.
    :ivar y: position.
    :ivar z: position.
    :ivar radius: radius of the disc.
    :ivar nx: unit normal of either sign.
    :ivar ny: unit normal.
    :ivar nz: unit normal.
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
        """Build surfels from points (N, 3), normals (N, 3) and radii (N,)."""
        columns = [*np.asarray(points).T, radius, *np.asarray(normals).T]
        return cls(*(np.ascontiguousarray(column, dtype=np.float32) for column in columns))


class SurfelPlaces(NamedTuple):
    """
    Positions in the air, which do not occlude; each field is (M,) float32, metres, map frame.

    :ivar x: position.
    :ivar y: position.
    :ivar z: position.
    :ivar radius: 0.
    """

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    radius: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray) -> 'SurfelPlaces':
        """Build positions from points (M, 3)."""
        columns = [*np.asarray(points).T, np.zeros(len(points))]
        return cls(*(np.ascontiguousarray(column, dtype=np.float32) for column in columns))


class SurfelSettings(NamedTuple):
    """
    The rules of filling a map with discs and of comparing points with it.

    :ivar rows: rows of the map; it has twice as many columns.
    :ivar base: depth tolerance of a visible point, metres.
    :ivar share: additional tolerance in multiples of the disc's radius.
    :ivar single: discs of fewer cells than this fill only their own cell.
    :ivar quad: discs of fewer cells than this fill up to the four nearest cells; larger ones fill
        the cells whose centre they cover.
    :ivar setback: the share of the depth that a disc's plane spans in one cell, along rows and
        columns, by which the disc is set back in the map.
    """

    rows: int
    base: float
    share: float
    single: float
    quad: float
    setback: float = 0.0


class Workspace(NamedTuple):
    """
    Memory for one view: the map, and the projection of one block of points.

    :ivar inverse_map: ((H + 2) (W + 2),) float32: inverse distances, 1/m, with a border of one
        cell that repeats the cells across the seam.
    :ivar farthest_of_four: the same shape: the minimum of each cell and the three to the right and
        above.
    :ivar inverse: (256,) float32, 1 / distance of the disc after setting it back, 1/m; 0 for
        points beyond the camera's range or nearer than ``MIN_DISTANCE_M``.
    :ivar row: (256,) float32, elevation in rows of the map.
    :ivar column: (256,) float32, azimuth in columns of the map.
    :ivar flat: (256,) float32, cosine of the elevation.
    :ivar step_row: (256,) float32, change of the inverse distance per row along the disc.
    :ivar step_column: (256,) float32, the same per column.
    :ivar size: (256,) float32, radius of the disc in rows of the map.
    :ivar wide: (256,) float32, the same in columns.
    :ivar own: (256,) uint32, the cell of the point.
    :ivar value: (256,) float32, the inverse distance of the disc in this cell, 1/m.
    :ivar listed: (3, 257) uint32, the numbers of the discs that fill one cell, up to four, and
        more.
    :ivar four: (4, 256) float32, the inverse distances of the second kind in the four cells around
        it, 1/m.
    :ivar around_quad: (256,) uint32, the lower left one of these four cells.
    :ivar flags: (256,) uint8, whether a point is visible.
    :ivar octets: (32,) uint64, the same memory as ``flags``.
    :ivar distance: (N,) float32, the distance of every point, metres.
    :ivar around: (N,) uint32, the lower left one of the four cells around every point.
    :ivar blocks: (B,) uint32, the numbers of the blocks to process.
    """

    inverse_map: np.ndarray
    farthest_of_four: np.ndarray
    inverse: np.ndarray
    row: np.ndarray
    column: np.ndarray
    flat: np.ndarray
    step_row: np.ndarray
    step_column: np.ndarray
    size: np.ndarray
    wide: np.ndarray
    own: np.ndarray
    value: np.ndarray
    listed: np.ndarray
    four: np.ndarray
    around_quad: np.ndarray
    flags: np.ndarray
    octets: np.ndarray
    distance: np.ndarray
    around: np.ndarray
    blocks: np.ndarray

    @classmethod
    def of(cls, rows: int, count: int) -> 'Workspace':
        """Allocate memory for maps with ``rows`` rows and ``count`` points."""
        cells, octets = (rows + 2) * (2 * rows + 2), np.zeros(BLOCK // 8, dtype=np.uint64)
        # Writing a whole vector may go beyond the end of the last row.
        maps = [np.full(cells + LANES, np.inf, dtype=np.float32)[:cells] for _ in range(2)]
        block = [np.empty(BLOCK, dtype=np.float32) for _ in range(8)]
        own, around_quad = (np.empty(BLOCK, dtype=np.uint32) for _ in range(2))
        return cls._make([*maps, *block, own, np.empty(BLOCK, dtype=np.float32),
                          np.zeros((3, BLOCK + 1), dtype=np.uint32),
                          np.empty((4, BLOCK), dtype=np.float32), around_quad,
                          octets.view(np.uint8), octets,
                          np.empty(count, dtype=np.float32), np.empty(count, dtype=np.uint32),
                          np.empty(-(-count // BLOCK), dtype=np.uint32)])


@njit(nogil=True, inline='always', fastmath=FAST)
def _arctan2(y, x):
    """Approximate the arc tangent to 2e-6 by an odd polynomial; vectorises where libm does not."""
    across, up = abs(x), abs(y)
    ratio = min(across, up) / max(max(across, up), f32(1e-20))
    square = ratio * ratio
    angle = f32(-0.0117212) * square + f32(0.05265332)
    angle = angle * square + f32(-0.11643287)
    angle = angle * square + f32(0.19354346)
    angle = angle * square + f32(-0.33262347)
    angle = (angle * square + f32(0.99997726)) * ratio
    angle = HALF_PI - angle if up > across else angle
    angle = PI - angle if x < f32(0.0) else angle
    return -angle if y < f32(0.0) else angle


@njit(nogil=True, inline='always', fastmath=FAST)
def _block(number, count):
    """Return the first point of a block and its number of points."""
    first = u64(number) * STEP
    return first, min(STEP, u64(count) - first)


@njit(cache=True, nogil=True, fastmath=FAST, error_model='numpy')
def project_block(surfels, number, position, farthest, settings, out):
    """
    Project the surfels of one block into the map of a camera, in one loop without branches.

    :param surfels: N :class:`Surfels`.
    :param number: the number of the block.
    :param position: (3,) float64, of the camera, metres.
    :param farthest: the range of the camera, metres.
    :param settings: :class:`SurfelSettings`.
    :param out: :class:`Workspace`.
    """
    rows, setback = settings.rows, f32(settings.setback)
    x0, y0, z0 = f32(position[0]), f32(position[1]), f32(position[2])
    per_radian, per_cell, far = f32(rows) / PI, PI / f32(rows), f32(farthest)
    last_row, last_column = f32(rows) - f32(1e-3), f32(2 * rows) - f32(2e-3)
    stride = u32(2 * rows + 2)
    first, count = _block(number, surfels.x.shape[0])
    for j in range(count):
        i = first + j
        dx, dy, dz = surfels.x[i] - x0, surfels.y[i] - y0, surfels.z[i] - z0
        flat = math.sqrt(dx * dx + dy * dy)
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        inverse = ONE / max(distance, f32(1e-6))
        across = ONE / max(flat, f32(1e-6))
        cos_a, sin_a = dx * across, dy * across
        cos_e, sin_e = flat * inverse, dz * inverse
        outward = surfels.nx[i] * cos_a + surfels.ny[i] * sin_a
        facing = outward * cos_e + surfels.nz[i] * sin_e
        cell = inverse * per_cell
        steep = (cell if facing >= f32(0.0) else -cell) / max(abs(facing), MIN_COSINE)
        step_row = (surfels.nz[i] * cos_e - outward * sin_e) * steep
        step_column = (surfels.ny[i] * cos_a - surfels.nx[i] * sin_a) * steep * cos_e
        set_back = inverse - setback * (abs(step_row) + abs(step_column))
        row = min((_arctan2(dz, flat) + HALF_PI) * per_radian, last_row)
        column = min((_arctan2(dy, dx) + PI) * per_radian, last_column)
        out.row[j], out.column[j], out.distance[i] = row, column, distance
        out.around[i] = u32(i32(row + HALF)) * stride + u32(i32(column + HALF))
        out.flat[j] = max(cos_e, f32(1e-4))
        out.step_row[j], out.step_column[j] = step_row, step_column
        out.inverse[j] = set_back if (distance >= MIN_DISTANCE_M) & (distance <= far) else f32(0.0)


@njit(nogil=True, inline='always', fastmath=FAST)
def _clamped(value, inverse):
    """Limit the inverse distance of a disc to values near that of its point, for grazing rays."""
    return min(max(value, MIN_DEPTH_RATIO * inverse), MAX_DEPTH_RATIO * inverse)


@njit(nogil=True, fastmath=FAST, error_model='numpy')
def _sort_block(surfels, number, settings, out):
    """
    Sort the discs of a block by the cells they fill; compute their values in their own cells.

    :returns: the numbers of discs that fill only their own cell, up to four cells, and more; the
        indices of these discs are in the rows of ``out.listed``.
    """
    cells, stride = f32(settings.rows) / PI, u32(2 * settings.rows + 2)
    single, quad = f32(settings.single), f32(settings.quad)
    first, count = _block(number, surfels.x.shape[0])
    for j in range(count):
        inverse, row, column = out.inverse[j], out.row[j], out.column[j]
        size = surfels.radius[first + j] * inverse * cells
        # Rows are shorter near the poles, so the disc is wider there in cells.
        out.size[j], out.wide[j] = size, size / out.flat[j]
        own_row, own_column = i32(row), i32(column)
        value = (inverse + out.step_row[j] * (f32(own_row) + HALF - row)
                 + out.step_column[j] * (f32(own_column) + HALF - column))
        out.own[j] = u32(own_row + 1) * stride + u32(own_column + 1)
        out.value[j] = _clamped(value, inverse)
    singles = quads = ellipses = u64(0)
    for j in range(count):
        # An entry of the wrong kind is overwritten by the next disc.
        out.listed[0, singles] = out.listed[1, quads] = out.listed[2, ellipses] = j
        near, wide = out.inverse[j] > f32(0.0), out.wide[j]
        singles += u64(near & (wide < single))
        quads += u64(near & (wide >= single) & (wide < quad))
        ellipses += u64(near & (wide >= quad))
    return singles, quads, ellipses


@njit(nogil=True, fastmath=FAST, error_model='numpy')
def _splat_quads(listed, stride, out, inverse_map):
    """Fill the cells among the four nearest whose centre is within reach in rows and columns."""
    nothing, four = f32(0.0), out.four
    for k in range(len(listed)):
        j = listed[k]
        inverse, row, column = out.inverse[j], out.row[j] + HALF, out.column[j] + HALF
        step_row, step_column = out.step_row[j], out.step_column[j]
        reach, across = max(out.size[j], HALF), max(out.wide[j], HALF)
        first_row, first_column = i32(row), i32(column)
        down, left = row - f32(first_row), column - f32(first_column)
        value = inverse - step_row * down - step_column * left
        above, beside = down <= reach, left <= across
        below, beyond = ONE - down <= reach, ONE - left <= across
        out.around_quad[k] = u32(first_row) * u32(stride) + u32(first_column)
        four[0, k] = _clamped(value, inverse) if above & beside else nothing
        four[1, k] = _clamped(value + step_column, inverse) if above & beyond else nothing
        four[2, k] = _clamped(value + step_row, inverse) if below & beside else nothing
        four[3, k] = (_clamped(value + step_row + step_column, inverse) if below & beyond
                      else nothing)
    for k in range(len(listed)):
        cell = u64(out.around_quad[k])
        under = cell + u64(stride)
        inverse_map[cell] = max(inverse_map[cell], four[0, k])
        inverse_map[cell + u64(1)] = max(inverse_map[cell + u64(1)], four[1, k])
        inverse_map[under] = max(inverse_map[under], four[2, k])
        inverse_map[under + u64(1)] = max(inverse_map[under + u64(1)], four[3, k])


@njit(nogil=True, inline='always', fastmath=FAST)
def _ceil(value):
    """Return the ceiling of a number, without the function call of libm."""
    whole = i32(value)
    return whole + i32(value > f32(whole))


@njit(nogil=True, fastmath=FAST, error_model='numpy')
def _splat_ellipse(inverse, row, column, flat, size, step_row, step_column, rows, inverse_map):
    """Fill the cells whose centre is within the disc, an ellipse in the map, and its own cell."""
    columns, stride = 2 * rows, 2 * rows + 2
    widen = ONE / flat
    per_radian = f32(rows) / (PI * inverse)
    slope_row, slope_column = step_row * per_radian, step_column * per_radian * widen
    # |w|^2 + (n.w / n.u)^2 <= size^2 for an offset w, solved for the columns of each row.
    form = ONE + slope_column * slope_column
    whole = form + slope_row * slope_row
    shrink = widen / form
    tilt, within = slope_row * slope_column * shrink, form * size * size
    height = size * math.sqrt(max(form / whole, f32(1e-4)))
    low, high = MIN_DEPTH_RATIO * inverse, MAX_DEPTH_RATIO * inverse
    own_row, own_column = i32(row), i32(column)
    first_row = max(min(_ceil(row - height - HALF), own_row), 0)
    last_row = min(max(-_ceil(HALF - row - height), own_row), rows - 1)
    for r in range(first_row, last_row + 1):
        down = f32(r) + HALF - row
        # A disc that extends over the pole covers these rows on both sides of the pole.
        if min(row + f32(r) + HALF, f32(2 * rows) - row - f32(r) - HALF) <= size:
            value = _clamped(inverse + step_row * down, inverse)
            for cell in range(u64((r + 1) * stride + 1), u64((r + 1) * stride + 1 + columns)):
                inverse_map[cell] = max(inverse_map[cell], value)
            continue
        middle = column - tilt * down
        reach = math.sqrt(max(within - down * down * whole, f32(0.0))) * shrink
        first, last = _ceil(middle - reach - HALF), -_ceil(HALF - middle - reach)
        if r == own_row:
            first, last = min(first, own_column), max(last, own_column)
        if last - first >= columns:
            first, last = 0, columns - 1
        value = inverse + step_row * down + step_column * (f32(first) + HALF - column)
        if first >= 0 and last < columns:
            cell = u64((r + 1) * stride + 1 + first)
            for left in range(last - first, -1, -LANES):
                put_nearer(inverse_map, cell, value, step_column, low, high, f32(left))
                cell += u64(LANES)
                value += step_column * f32(LANES)
        else:
            for c in range(first, last + 1):
                cell = u64((r + 1) * stride + 1 + c % columns)
                inverse_map[cell] = max(inverse_map[cell], _clamped(value, inverse))
                value += step_column


@njit(cache=True, nogil=True, fastmath=FAST, error_model='numpy')
def splat_surfels(surfels, blocks, position, farthest, settings, out):
    """
    Fill a map with the nearest disc that covers each cell's centre.

    :param surfels: N :class:`Surfels`.
    :param blocks: (B,) the blocks to splat.
    :param position: (3,) float64, of the camera, metres.
    :param farthest: the range of the camera, metres; empty cells have this distance.
    :param settings: :class:`SurfelSettings`.
    :param out: :class:`Workspace`, whose maps are overwritten.
    """
    rows, stride = settings.rows, 2 * settings.rows + 2
    inverse_map = out.inverse_map
    inverse_map[:] = ONE / f32(farthest)
    for number in blocks:
        project_block(surfels, number, position, farthest, settings, out)
        singles, quads, ellipses = _sort_block(surfels, number, settings, out)
        for k in range(singles):
            j = out.listed[0, k]
            cell = u64(out.own[j])
            inverse_map[cell] = max(inverse_map[cell], out.value[j])
        _splat_quads(out.listed[1, :quads], stride, out, inverse_map)
        for k in range(ellipses):
            j = out.listed[2, k]
            _splat_ellipse(out.inverse[j], out.row[j], out.column[j], out.flat[j], out.size[j],
                           out.step_row[j], out.step_column[j], rows, inverse_map)
    _join_edges(rows, stride, inverse_map)
    _take_farthest(rows, stride, inverse_map, out.farthest_of_four)


@njit(nogil=True)
def _join_edges(rows, stride, inverse_map):
    """Set the cells on both sides of the azimuth seam to the nearer value; fill the poles."""
    columns = stride - 2
    for row in range(1, rows + 1):
        first = row * stride
        for left, right in ((0, columns), (1, columns + 1)):
            nearer = max(inverse_map[first + left], inverse_map[first + right])
            inverse_map[first + left] = inverse_map[first + right] = nearer
    # Rows beyond a pole are never the farthest cells.
    inverse_map[:stride] = f32(np.inf)
    inverse_map[(rows + 1) * stride:] = f32(np.inf)


@njit(nogil=True)
def _take_farthest(rows, stride, inverse_map, farthest_of_four):
    """Write the minimum of each cell and the three to the right and above."""
    step = u64(stride)
    for row in range(u64(rows + 1)):
        for cell in range(row * step, row * step + step - u64(1)):
            lower = min(inverse_map[cell], inverse_map[cell + u64(1)])
            upper = min(inverse_map[cell + step], inverse_map[cell + step + u64(1)])
            farthest_of_four[cell] = min(lower, upper)


@njit(cache=True, nogil=True, fastmath=FAST, error_model='numpy')
def locate_block(places, number, position, rows, out):
    """Project the positions of one block; like :func:`project_block`, without discs."""
    x0, y0, z0 = f32(position[0]), f32(position[1]), f32(position[2])
    per_radian, stride = f32(rows) / PI, u32(2 * rows + 2)
    last_row, last_column = f32(rows) - f32(1e-3), f32(2 * rows) - f32(2e-3)
    first, count = _block(number, places.x.shape[0])
    for i in range(first, first + count):
        dx, dy, dz = places.x[i] - x0, places.y[i] - y0, places.z[i] - z0
        flat = math.sqrt(dx * dx + dy * dy)
        out.distance[i] = math.sqrt(dx * dx + dy * dy + dz * dz)
        row = min((_arctan2(dz, flat) + HALF_PI) * per_radian, last_row)
        column = min((_arctan2(dy, dx) + PI) * per_radian, last_column)
        out.around[i] = u32(i32(row + HALF)) * stride + u32(i32(column + HALF))


@njit(cache=True, nogil=True, fastmath=FAST, error_model='numpy')
def see_surfels(points, blocks, pose, lens, settings, work, seen):
    """
    Add the points that are visible to a camera.

    A point is visible if it is at most base + share * radius behind the farthest of the four
    nearest cells.

    :param points: N :class:`Surfels` or :class:`SurfelPlaces` whose blocks have been projected.
    :param blocks: (B,) the blocks to look at.
    :param pose: the camera's :class:`~ocp_ros.geometry.cameras.Pose`.
    :param lens: the camera model's :class:`~ocp_ros.geometry.cameras.Frustum`.
    :param settings: :class:`SurfelSettings`.
    :param work: :class:`Workspace` after :func:`splat_surfels` for the same camera.
    :param seen: (W,) uint64, packed bits, in and out: set for visible points.
    """
    base, share = f32(settings.base), f32(settings.share)
    nearest, farthest = max(f32(lens.min_range), MIN_DISTANCE_M), f32(lens.max_range)
    flags = work.flags
    for number in blocks:
        first, count = _block(number, points.x.shape[0])
        for j in range(count):
            distance = work.distance[first + j]
            ahead = distance - base - share * points.radius[first + j]
            # ahead <= 1 / deepest, without the division.
            flags[j] = ((ahead * work.farthest_of_four[work.around[first + j]] <= ONE)
                        & (distance >= nearest) & (distance <= farthest))
        flags[count:] = 0
        if lens.kind != OMNIDIRECTIONAL:
            _keep_in_cone(points, first, count, pose, lens, flags)
        _pack(work.octets, seen, u64(number) * u64(WORDS))


@njit(nogil=True)
def _keep_in_cone(points, first, count, pose, lens, flags):
    """Clear the flags of points outside the viewing cone."""
    x0, y0, z0 = pose.position[0], pose.position[1], pose.position[2]
    for j in range(count):
        i = first + j
        flags[j] &= in_cone(points.x[i] - x0, points.y[i] - y0, points.z[i] - z0, pose, lens)


@njit(cache=True, nogil=True)
def kept_in_cone(points, bounds, pose, lens, seen):
    """
    Clip the points visible to an omnidirectional camera to a frustum.

    :param points: N :class:`Surfels` or :class:`SurfelPlaces` in spatial order.
    :param bounds: (B, 2, 3) float32, of their blocks.
    :param pose: the camera's :class:`~ocp_ros.geometry.cameras.Pose`.
    :param lens: the camera model's :class:`~ocp_ros.geometry.cameras.Frustum`.
    :param seen: (W,) uint64, packed bits of the points.
    :returns: (W,) uint64, packed bits of the points in the viewing cone.
    """
    kept, blocks = np.zeros_like(seen), np.empty(bounds.shape[0], dtype=np.uint32)
    octets = np.empty(BLOCK // 8, dtype=np.uint64)
    flags = octets.view(np.uint8)
    for number in blocks[:blocks_in_view(bounds, pose, lens, blocks)]:
        first, count = _block(number, points.x.shape[0])
        flags[:count], flags[count:] = 1, 0
        _keep_in_cone(points, first, count, pose, lens, flags)
        _pack(octets, kept, u64(number) * u64(WORDS))
    return kept & seen


@njit(nogil=True, inline='always')
def _pack(octets, seen, first):
    """Pack 256 flags, eight of one byte each per number, and add them to four words of bits."""
    for word in range(u64(WORDS)):
        bits = u64(0)
        for k in range(u64(8)):
            # The product moves the lowest bit of each byte into the highest byte.
            byte = (octets[word * u64(8) + k] * u64(0x0102040810204080)) >> u64(56)
            bits |= byte << (k * u64(8))
        seen[first + word] |= bits


@njit(cache=True, nogil=True)
def look_at_surfels(surfels, bounds, places, place_bounds, pose, lens, settings, work, seen,
                    covered):
    """
    Add the points and positions that are visible to a camera, in one call without the GIL.

    :param surfels: N :class:`Surfels` in spatial order.
    :param bounds: (B, 2, 3) float32, of their blocks.
    :param places: M :class:`SurfelPlaces` in spatial order; empty to leave them out.
    :param place_bounds: (C, 2, 3) float32, of their blocks.
    :param pose: the camera's :class:`~ocp_ros.geometry.cameras.Pose`.
    :param lens: the camera model's :class:`~ocp_ros.geometry.cameras.Frustum`.
    :param settings: :class:`SurfelSettings`.
    :param work: :class:`Workspace`.
    :param seen: (W,) uint64, packed bits of the points, in and out.
    :param covered: (V,) uint64, packed bits of the positions, in and out.
    """
    blocks = work.blocks[:blocks_in_view(bounds, pose, lens, work.blocks)]
    splat_surfels(surfels, blocks, pose.position, lens.max_range, settings, work)
    see_surfels(surfels, blocks, pose, lens, settings, work, seen)
    if covered.shape[0]:
        blocks = work.blocks[:blocks_in_view(place_bounds, pose, lens, work.blocks)]
        for number in blocks:
            locate_block(places, number, pose.position, settings.rows, work)
        see_surfels(places, blocks, pose, lens, settings, work, covered)
