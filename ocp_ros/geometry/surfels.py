# SPDX-License-Identifier: Apache-2.0
"""
Shadow maps of surfels: points as small discs that lie on the surface they were sampled from.

A cell of the map holds the inverse distance of the nearest disc along the ray through the cell's
centre. Along a plane, inverse distance is linear in the ray's direction, n.u / n.d for the ray u
and the point d, so within a disc's few cells it is a sum of two steps; and since a point is
compared with the map by that same quantity, taken at the centre of the cell, a surface seen at a
slant does not hide itself and needs no compensation for its slope.
"""

import math
from typing import NamedTuple

from numba import njit
import numpy as np

from ocp_ros.geometry.cameras import Lens, OMNIDIRECTIONAL
from ocp_ros.geometry.shadow_maps import in_view, Pose

f32, i32, u32, u64 = np.float32, np.int32, np.uint32, np.uint64
#: Nothing here may come out as NaN, and the order of a sum does not matter.
FAST = {'nsz', 'arcp', 'contract', 'afn', 'reassoc'}
PI, HALF_PI, HALF, ONE = f32(np.pi), f32(np.pi / 2), f32(0.5), f32(1.0)
#: On grazing surfaces, the least cosine and the farthest from its point that a disc may reach.
LEAST_COSINE, LOWEST, HIGHEST = f32(0.12), f32(0.7), f32(1.4)
#: Points that are looked at or passed over together.
BLOCK = 256
#: Unsigned, since an index that might be negative keeps a loop from being vectorised.
STEP = u64(BLOCK)


class Surfels(NamedTuple):
    """
    Points with their tangent planes; each field is (N,) float32, metres, map frame.

    :ivar x: position.
    :ivar y: position.
    :ivar z: position.
    :ivar nx: unit normal of either sign.
    :ivar ny: unit normal.
    :ivar nz: unit normal.
    :ivar radius: radius of the disc.
    """

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    nx: np.ndarray
    ny: np.ndarray
    nz: np.ndarray
    radius: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, normals: np.ndarray, radius: np.ndarray) -> 'Surfels':
        """Build surfels from points (N, 3), normals (N, 3) and radii (N,)."""
        columns = [*np.asarray(points).T, *np.asarray(normals).T, radius]
        return cls(*(np.ascontiguousarray(column, dtype=np.float32) for column in columns))


def spatial_order(points: np.ndarray) -> np.ndarray:
    """
    Sort points along a Morton curve, so that neighbours in the order are neighbours in space.

    :param points: (N, 3), metres.
    :returns: (N,) int64 indices.
    """
    if len(points) == 0:
        return np.empty(0, dtype=np.int64)
    low = points.min(axis=0)
    extent = max(float(np.ptp(points, axis=0).max()), 1e-9)
    cells = ((points - low) / extent * 1023).astype(np.int64)
    code = np.zeros(len(points), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind='stable')


def block_bounds(points: np.ndarray) -> np.ndarray:
    """
    Bound each block of ``BLOCK`` points in a row.

    :param points: (N, 3), metres, in spatial order.
    :returns: (B, 2, 3) float32: lowest and highest corners, metres.
    """
    starts = np.arange(0, len(points), BLOCK)
    if len(starts) == 0:
        return np.empty((0, 2, 3), dtype=np.float32)
    return np.stack([np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts)],
                    axis=1).astype(np.float32)


@njit(cache=True, nogil=True)
def blocks_in_range(bounds, position, farthest):
    """
    Find the blocks that a camera may measure some point of.

    :param bounds: (B, 2, 3) float32, metres.
    :param position: (3,) float32, metres.
    :param farthest: range of the camera, metres.
    :returns: int64 indices of blocks.
    """
    found = np.empty(bounds.shape[0], dtype=np.int64)
    count = 0
    for b in range(bounds.shape[0]):
        total = f32(0.0)
        for axis in range(3):
            short = max(bounds[b, 0, axis] - position[axis], position[axis] - bounds[b, 1, axis])
            total += max(short, f32(0.0)) ** 2
        if total <= farthest * farthest:
            found[count] = b
            count += 1
    return found[:count]


class SurfelView(NamedTuple):
    """
    Where surfels appear from a camera; each field is (N,) float32.

    :ivar inverse: 1 / distance, 1/m; 0 where the camera cannot measure the point.
    :ivar row: elevation in rows of the map.
    :ivar column: azimuth in columns of the map.
    :ivar flat: cosine of the elevation.
    :ivar slope_row: relative change of the inverse distance per radian of elevation.
    :ivar slope_column: the same per radian across, on the great circle.
    :ivar cosine: of the angle of incidence, at least ``LEAST_COSINE``.
    """

    inverse: np.ndarray
    row: np.ndarray
    column: np.ndarray
    flat: np.ndarray
    slope_row: np.ndarray
    slope_column: np.ndarray
    cosine: np.ndarray

    @classmethod
    def empty(cls, count: int) -> 'SurfelView':
        """Allocate room for ``count`` surfels."""
        return cls(*(np.empty(count, dtype=np.float32) for _ in cls._fields))


class SurfelSettings(NamedTuple):
    """
    How discs fill a map and how deep behind it a visible point may be.

    :ivar rows: rows of the map; it has twice as many columns.
    :ivar base: metres.
    :ivar share: multiples of the disc's radius.
    :ivar single: discs of fewer cells than this fill their own cell only.
    :ivar quad: discs of fewer cells than this fill up to the four nearest cells, larger ones the
        cells whose centre they cover.
    """

    rows: int
    base: float
    share: float
    single: float
    quad: float


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


@njit(cache=True, nogil=True, fastmath=FAST, error_model='numpy')
def _project(surfels, blocks, position, nearest, farthest, rows, view):
    """Project without regard to the field of view; per block one loop without branches."""
    x0, y0, z0 = position[0], position[1], position[2]
    per_radian = f32(rows) / PI
    for block in blocks:
        for i in range(u64(block) * STEP, min(u64(block + 1) * STEP, u64(surfels.x.shape[0]))):
            dx, dy, dz = surfels.x[i] - x0, surfels.y[i] - y0, surfels.z[i] - z0
            flat = math.sqrt(dx * dx + dy * dy)
            distance = math.sqrt(dx * dx + dy * dy + dz * dz)
            inverse = ONE / max(distance, f32(1e-6))
            across = ONE / max(flat, f32(1e-6))
            cos_a, sin_a = dx * across, dy * across
            cos_e, sin_e = flat * inverse, dz * inverse
            outward = surfels.nx[i] * cos_a + surfels.ny[i] * sin_a
            facing = outward * cos_e + surfels.nz[i] * sin_e
            cosine = max(abs(facing), LEAST_COSINE)
            steep = (ONE if facing >= f32(0.0) else -ONE) / cosine
            view.cosine[i] = cosine
            view.slope_row[i] = (surfels.nz[i] * cos_e - outward * sin_e) * steep
            view.slope_column[i] = (surfels.ny[i] * cos_a - surfels.nx[i] * sin_a) * steep
            view.row[i] = min((_arctan2(dz, flat) + HALF_PI) * per_radian, f32(rows) - f32(1e-3))
            view.column[i] = min((_arctan2(dy, dx) + PI) * per_radian, f32(2 * rows) - f32(2e-3))
            view.flat[i] = max(cos_e, f32(1e-4))
            measured = (distance >= nearest) & (distance <= farthest)
            view.inverse[i] = inverse if measured else f32(0.0)


@njit(cache=True, nogil=True)
def _keep_in_view(surfels, blocks, pose, lens, view):
    """Drop what lies outside the viewing cone."""
    for block in blocks:
        for i in range(u64(block) * STEP, min(u64(block + 1) * STEP, u64(surfels.x.shape[0]))):
            if not _in_cone(surfels.x[i], surfels.y[i], surfels.z[i], pose, lens):
                view.inverse[i] = f32(0.0)


@njit(cache=True, nogil=True, inline='always')
def _in_cone(x, y, z, pose, lens):
    """Tell whether a point lies in a camera's viewing cone."""
    position, rotation = pose.position, pose.rotation
    dx, dy, dz = x - position[0], y - position[1], z - position[2]
    return in_view(rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz,
                   rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz,
                   rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz, lens)


def project_surfels(surfels: Surfels, blocks: np.ndarray, pose: Pose, lens: Lens, rows: int,
                    view: SurfelView) -> None:
    """
    Write where surfels appear from a camera.

    :param surfels: N surfels.
    :param blocks: the blocks of surfels to look at.
    :param pose: the camera's pose.
    :param lens: the camera model.
    :param rows: rows of the map.
    :param view: N entries, out; those of other blocks stay as they are.
    """
    _project(surfels, blocks, np.asarray(pose.position, dtype=np.float32),
             f32(max(lens.min_range, 1e-3)), f32(lens.max_range), rows, view)
    if lens.kind != OMNIDIRECTIONAL:
        _keep_in_view(surfels, blocks, pose, lens, view)


@njit(nogil=True, inline='always', fastmath=FAST)
def _clamped(value, inverse):
    """Keep a disc near its point, however grazing the ray."""
    return min(max(value, LOWEST * inverse), HIGHEST * inverse)


@njit(nogil=True, inline='always', fastmath=FAST)
def _splat_quad(inverse, row, column, reach, across, step_row, step_column, stride, inverse_map):
    """Fill those of the four nearest cells whose centre is within reach, in rows and columns."""
    first_row, first_column = i32(row + HALF), i32(column + HALF)
    down, left = row + HALF - f32(first_row), column + HALF - f32(first_column)
    value = inverse - step_row * down - step_column * left
    above, beside = down <= reach, left <= across
    below, beyond = ONE - down <= reach, ONE - left <= across
    nothing = f32(0.0)
    cell = u64(u32(first_row) * u32(stride) + u32(first_column))
    under = cell + u64(stride)
    a = _clamped(value, inverse) if above & beside else nothing
    b = _clamped(value + step_column, inverse) if above & beyond else nothing
    c = _clamped(value + step_row, inverse) if below & beside else nothing
    d = _clamped(value + step_row + step_column, inverse) if below & beyond else nothing
    inverse_map[cell] = max(inverse_map[cell], a)
    inverse_map[cell + u64(1)] = max(inverse_map[cell + u64(1)], b)
    inverse_map[under] = max(inverse_map[under], c)
    inverse_map[under + u64(1)] = max(inverse_map[under + u64(1)], d)


@njit(nogil=True, inline='always', fastmath=FAST)
def _splat_ellipse(inverse, row, column, flat, slope_row, slope_column, cosine, size,
                   step_row, step_column, rows, inverse_map):
    """Fill the cells whose centre is within the disc, an ellipse in the map, and its own."""
    columns, stride = 2 * rows, 2 * rows + 2
    # |w|^2 + (n.w / n.u)^2 <= size^2 for an offset w, solved for the columns of each row.
    form, widen = ONE + slope_column * slope_column, ONE / flat
    tilt = slope_row * slope_column * widen / form
    upright = slope_row * cosine
    height = size * math.sqrt(max(ONE - upright * upright, f32(1e-4)))
    own_row, own_column = i32(row), i32(column)
    first_row = max(min(i32(math.ceil(row - height - HALF)), own_row), 0)
    last_row = min(max(i32(math.floor(row + height - HALF)), own_row), rows - 1)
    for r in range(first_row, last_row + 1):
        down = f32(r) + HALF - row
        root = max(form * size * size - down * down / (cosine * cosine), f32(0.0))
        middle = column - tilt * down
        reach = math.sqrt(root) * widen / form
        first, last = i32(math.ceil(middle - reach - HALF)), i32(math.floor(middle + reach - HALF))
        if r == own_row:
            first, last = min(first, own_column), max(last, own_column)
        if last - first >= columns:
            first, last = 0, columns - 1
        value = inverse + step_row * down + step_column * (f32(first) + HALF - column)
        start = (r + 1) * stride + 1
        if first >= 0 and last < columns:
            for cell in range(u64(start + first), u64(start + last + 1)):
                inverse_map[cell] = max(inverse_map[cell], _clamped(value, inverse))
                value += step_column
        else:
            for c in range(first, last + 1):
                cell = u64(start + c % columns)
                inverse_map[cell] = max(inverse_map[cell], _clamped(value, inverse))
                value += step_column


@njit(cache=True, nogil=True, fastmath=FAST, error_model='numpy')
def splat_surfels(view, radius, blocks, farthest, settings, inverse_map):
    """
    Fill a map with the nearest of the discs that cover each cell's centre.

    :param view: :class:`SurfelView` of N surfels.
    :param radius: (N,) float32, metres.
    :param blocks: the blocks of surfels that were projected.
    :param farthest: what an empty cell reads, metres.
    :param settings: :class:`SurfelSettings`.
    :param inverse_map: ((H + 2) (W + 2),) float32, out: inverse distances, 1/m, with a border of
        one cell that repeats the cells across the seam.
    """
    rows, columns, stride = settings.rows, 2 * settings.rows, 2 * settings.rows + 2
    per_cell, cells = PI / f32(rows), f32(rows) / PI
    single, quad = f32(settings.single), f32(settings.quad)
    inverse_map[:] = ONE / f32(farthest)
    for block in blocks:
        for i in range(u64(block) * STEP, min(u64(block + 1) * STEP, u64(radius.shape[0]))):
            inverse = view.inverse[i]
            if inverse == f32(0.0):
                continue
            # Local copies: the compiler cannot know that the map is not one of these arrays.
            row, column, flat = view.row[i], view.column[i], view.flat[i]
            slope_row, slope_column = view.slope_row[i], view.slope_column[i]
            size = radius[i] * inverse * cells
            step_row = inverse * per_cell * slope_row
            step_column = inverse * per_cell * slope_column * flat
            if size < flat * single:
                own_row, own_column = i32(row), i32(column)
                value = (inverse + step_row * (f32(own_row) + HALF - row)
                         + step_column * (f32(own_column) + HALF - column))
                cell = u64(u32(own_row + 1) * u32(stride) + u32(own_column + 1))
                inverse_map[cell] = max(inverse_map[cell], _clamped(value, inverse))
            elif size < flat * quad:
                _splat_quad(inverse, row, column, max(size, HALF), max(size / flat, HALF),
                            step_row, step_column, stride, inverse_map)
            else:
                _splat_ellipse(inverse, row, column, flat, slope_row, slope_column, view.cosine[i],
                               size, step_row, step_column, rows, inverse_map)
    _join_seam(rows, columns, stride, inverse_map)


@njit(nogil=True)
def _join_seam(rows, columns, stride, inverse_map):
    """Give both sides of the azimuth seam the nearer of what either has."""
    for row in range(rows + 2):
        first = row * stride
        for left, right in ((0, columns), (1, columns + 1)):
            nearer = max(inverse_map[first + left], inverse_map[first + right])
            inverse_map[first + left] = inverse_map[first + right] = nearer


@njit(cache=True, nogil=True, fastmath=FAST, error_model='numpy')
def visible_surfels(view, radius, blocks, order, settings, inverse_map, out):
    """
    Add the surfels that a camera sees to those that others see.

    A surfel is seen if, at the centre of one of the four nearest cells, its plane is at most
    base + share * radius behind the map.

    :param view: :class:`SurfelView` of N surfels.
    :param radius: (N,) float32, metres.
    :param blocks: the blocks of surfels that were projected.
    :param order: (N,) int64, each surfel's index in ``out``.
    :param settings: :class:`SurfelSettings`.
    :param inverse_map: from :func:`splat_surfels`.
    :param out: (N,) bool, in and out: set where the surfel is visible, else left alone.
    """
    stride = u32(2 * settings.rows + 2)
    per_cell = PI / f32(settings.rows)
    base, share = f32(settings.base), f32(settings.share)
    for block in blocks:
        for i in range(u64(block) * STEP, min(u64(block + 1) * STEP, u64(radius.shape[0]))):
            inverse = view.inverse[i]
            step_row = inverse * per_cell * view.slope_row[i]
            step_column = inverse * per_cell * view.slope_column[i] * view.flat[i]
            down, left = view.row[i] + HALF, view.column[i] + HALF
            row, column = i32(down), i32(left)
            value = inverse - step_row * (down - f32(row)) - step_column * (left - f32(column))
            behind = base + share * radius[i]
            cell = u32(row) * stride + u32(column)
            a, b = inverse_map[cell], inverse_map[cell + u32(1)]
            c, d = inverse_map[cell + stride], inverse_map[cell + stride + u32(1)]
            # t <= SM + behind, with t = 1 / value and SM = 1 / a, without the divisions.
            seen = (_clamped(value, inverse) * (ONE + behind * a) >= a)
            seen |= (_clamped(value + step_column, inverse) * (ONE + behind * b) >= b)
            seen |= (_clamped(value + step_row, inverse) * (ONE + behind * c) >= c)
            value += step_row + step_column
            seen |= (_clamped(value, inverse) * (ONE + behind * d) >= d)
            out[order[i]] |= seen & (inverse > f32(0.0))


def distances(inverse_map: np.ndarray, rows: int) -> np.ndarray:
    """Return a map from :func:`splat_surfels` as (H, W) float32 distances in metres."""
    return 1.0 / inverse_map.reshape(rows + 2, 2 * rows + 2)[1:-1, 1:-1]
