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
Find the main room of a scan: points behind its doors belong to other rooms.

Walls and the lintels over doors reach up to the ceiling. On a plan of both, the free floor
separates into rooms. A beam over the whole width of a corridor is not a lintel, and a strip behind
a shelf is not a room.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import numpy as np
from ocp_ros.geometry.voxels import voxel_downsample
from ocp_ros.scenes.scene import MIN_POINTS, Scene
from scipy import ndimage
from scipy.spatial import cKDTree

#: Metres: the usual edge of a cell of the plan, and the largest one at which rooms can be
#: separated; the least edge in multiples of the point spacing.
CELL, COARSEST, SPACINGS = 0.1, 0.2, 1.5
#: Metres: the edge of the voxels for the plan; the number of points at which the spacing is
#: measured, and the number of neighbours of each.
VOXEL, TRIED, AMONG = 0.04, 2000, 9
#: The factor by which cells are subdivided to split walls between the rooms on both sides, and the
#: largest number of these cells.
FINER, MOST = 4, 4_000_000
#: Metres above the floor at which the bands begin through which a wall reaches (all but one have
#: to contain points); range under the ceiling in which walls have points; range above the floor
#: that contains lintels but not beams.
BANDS, UNDER_CEILING, LINTEL = (0.9, 1.2, 1.5, 1.8), (0.12, 0.5), (2.0, 2.35)
BAND = 0.3
#: The top of the lintel range as a share of the height of a high room; metres under a low ceiling
#: from which on lintels are searched for, and metres under the ceiling where their faces end; the
#: least height of a face in cells, since a ceiling is flat.
HIGH, UNDER_LOW, BELOW, UPRIGHT = 0.78, 0.35, 0.03, 1.3
#: Metres: the thickness of the layers in which the ceiling is found, and the height above which
#: they are examined; how many times more points than the median layer the ceiling layer has.
LAYER, OVERHEAD, FULLER = 0.1, 1.9, 3.0
#: Metres: the largest distance of a lintel from the nearest wall, the gaps in a floor that are
#: closed, and half the width of the narrowest opening up to the ceiling that still joins two
#: spaces.
REACH, GAP, NARROW = 1.0, 0.4, 0.25
#: Metres: half the least width of a room, and ratios: the width of an opening to the width of the
#: narrower room above which two spaces are one room, for narrow openings (up to ``HALF``) and for
#: wider ones.
HALF, DOOR, GATE = 0.6, 0.75, 0.5
#: The least floor area of a room in square metres and its least share of the points; the largest
#: area in square metres of a hole in the scanned floor that is filled.
FLOOR, SHARE, HOLE = 1.0, 0.02, 1.0
#: The largest thickness in metres of a wall whose two faces are separated; the largest distance of
#: a wall point from the room in cells; the radius in multiples of the point spacing within which a
#: position is occupied.
THICK, ASIDE, NEAR = 0.3, 3.5, 0.6
#: A scan shows a building if at least this many other rooms are beside the main room, or if the
#: main room has less than this share of the points.
MANY, BUILDING = 4, 0.45
#: The largest plan in square metres on which rooms are searched for.
LARGEST_PLAN = 5000.0


def main_room(scene: Scene, points: np.ndarray) -> Scene:
    """
    Leave out the points of other rooms and add a note; return the same scene if there are none.

    :param points: (N, 3) metres, the points of the file before merging.
    """
    thin = voxel_downsample(points, VOXEL)
    corner = np.append(thin[:, :2].min(axis=0) - 2.0 * GAP, np.percentile(thin[:, 2], 1))
    thin = thin - corner
    tree = cKDTree(thin)
    reach = float(np.median(tree.query(thin[::max(len(thin) // TRIED, 1)], k=AMONG)[0][:, -1]))
    cell = max(CELL, SPACINGS * reach * np.sqrt(np.pi / (AMONG - 1)))
    if cell > COARSEST or np.prod(np.ptp(thin[:, :2], axis=0)) > LARGEST_PLAN:
        return scene
    rooms, closed = _rooms(thin, cell)
    if rooms.max() < 2:
        return scene
    nearest = _nearest(rooms, cell)
    counts = np.bincount(nearest(thin), minlength=rooms.max() + 1)
    # A part of a room that is visible only through a door has few walls around it.
    weights = counts * closed
    main, floors = int(weights.argmax()), np.bincount(rooms.ravel()) * cell * cell
    others = [room for room in np.flatnonzero(counts >= SHARE * len(thin))
              if room != main and floors[room] >= FLOOR]
    if len(others) >= MANY or others and weights[main] < BUILDING * weights.sum():
        remark = f'{len(others) + 1} rooms with openings between them: all are planned for'
        return replace(scene, remarks=(*scene.remarks, remark))
    places = scene.points - corner
    kept = ~np.isin(nearest(places), others)
    kept[~kept] = _faces(places[~kept], rooms == main, cell, tree, NEAR * reach)
    if kept.all() or kept.sum() < MIN_POINTS:
        return scene
    note = (f'found {len(scene) - kept.sum():,} points of another room behind an opening; '
            'expected one room; that part of the scan is not planned for: --all-rooms includes it')
    return replace(scene.only(kept), notes=(*scene.notes, note))


def _nearest(rooms: np.ndarray, cell: float) -> Callable[[np.ndarray], np.ndarray]:
    """
    Return a function that finds the nearest room of positions.

    :param rooms: (X, Y) room numbers on the plan.
    :returns: a function from positions (N, 3), metres from the corner of the plan, to room numbers
        (N,).
    """
    # The two faces of a wall belong to two rooms, so the cells are subdivided.
    finer = int(np.clip(np.sqrt(MOST / rooms.size), 1, FINER))
    fine = rooms.repeat(finer, axis=0).repeat(finer, axis=1)
    _, (x, y) = ndimage.distance_transform_edt(fine == 0, return_indices=True)
    fine = fine[x, y]

    def nearest(places: np.ndarray) -> np.ndarray:
        at = (places[:, :2] * (finer / cell)).astype(int)
        return fine[tuple(np.clip(at, 0, np.array(fine.shape) - 1).T)]
    return nearest


def _faces(points: np.ndarray, room: np.ndarray, cell: float, tree: cKDTree,
           radius: float) -> np.ndarray:
    """
    Return which wall points beside a room have no points between them and the room.

    :param points: (N, 3) metres from the corner of the plan, in the frame of ``tree``.
    :param room: (X, Y) bool.
    """
    away, (x, y) = ndimage.distance_transform_edt(~room, return_indices=True)
    at = tuple(np.clip((points[:, :2] / cell).astype(int), 0, np.array(room.shape) - 1).T)
    found = away[at] <= ASIDE
    way = np.column_stack([x[at], y[at]])[found] * cell + 0.5 * cell - points[found, :2]
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    way = np.column_stack([way, np.zeros(len(way))])
    open_to = np.ones(len(way), dtype=bool)
    for step in np.arange(1.4 * radius, THICK, radius):
        nearest, _ = tree.query(points[found] + step * way, distance_upper_bound=radius)
        open_to &= ~np.isfinite(nearest)
    found[found] = open_to
    return found


def _ceiling(height: np.ndarray) -> float:
    """Return the height of the ceiling, given heights of points above the floor, metres."""
    top = float(np.percentile(height, 99))
    layers = np.bincount(((height[height > OVERHEAD] - OVERHEAD) / LAYER).astype(int), minlength=2)
    # The ceiling may lie across the border of two layers.
    layers[1:] += layers[:-1].copy()
    if layers.max() <= FULLER * np.median(layers):
        return top
    return min(top, OVERHEAD + LAYER * (int(layers.argmax()) + 0.5))


def _rooms(points: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """
    Separate rooms on a plan of points.

    :param points: (N, 3) metres, from the lowest corner of the plan, z above the floor.
    :returns: (X, Y) room numbers from 1, 0 in walls and outside; and per room the share of its
        border that is wall.
    """
    place = (points[:, :2] / cell).astype(int)
    shape = tuple(place.max(axis=0) + 1 + int(2.0 * GAP / cell))
    height, top = points[:, 2], _ceiling(points[:, 2])

    def seen(low: float = -np.inf, high: float = np.inf) -> np.ndarray:
        cells = np.zeros(shape, dtype=bool)
        cells[tuple(place[(height >= low) & (height < high)].T)] = True
        return cells

    near = _disc(1.0)
    high = ndimage.binary_dilation(seen(top - UNDER_CEILING[1], top - UNDER_CEILING[0]), near)
    bands = [ndimage.binary_dilation(seen(low, low + BAND), near) for low in BANDS]
    upright = np.sum(bands, axis=0) >= len(BANDS) - 1
    walls = upright & high
    aside = ndimage.distance_transform_edt(~walls) * cell
    lowest = min(LINTEL[0], top - UNDER_LOW)
    part = (height >= lowest) & (height < top - BELOW)
    ends = np.full((2, *shape), -np.inf)
    for end, way in zip(ends, (1.0, -1.0), strict=True):
        np.maximum.at(end, tuple(place[part].T), way * height[part])
    faces = (seen(lowest, max(LINTEL[1], HIGH * top))
             & (ends.sum(axis=0) >= UPRIGHT * cell))
    lintels = ndimage.binary_dilation(faces, near) & high & ~upright & (aside <= REACH)
    known = ndimage.binary_closing(seen(), _disc(GAP / cell))
    holes, _ = ndimage.label(ndimage.binary_fill_holes(known) & ~known)
    # A larger hole consists of walls and rooms that were not scanned.
    small = np.bincount(holes.ravel()) * cell * cell <= HOLE
    known |= small[holes] & (holes > 0)
    barrier = walls | lintels
    free = known & ~barrier
    clear = ndimage.distance_transform_edt(~barrier) * cell
    rooms, count = ndimage.label(free & (clear >= NARROW))
    half = ndimage.distance_transform_edt(known & ~walls) * cell
    numbers = np.arange(1, count + 1)
    widths = np.append(0.0, ndimage.maximum(half, rooms, numbers))
    joined = _joined(rooms, lintels, half, widths, NARROW / cell + 1.5)
    # A part that is visible only through a door is narrower than the room that it belongs to.
    widths = np.append(0.0, ndimage.maximum(aside, rooms, numbers))
    rooms = joined[rooms]
    wide = np.zeros(count + 1, dtype=bool)
    wide[joined[widths >= HALF]] = True
    rooms[~wide[rooms]] = 0
    _, (x, y) = ndimage.distance_transform_edt(rooms == 0, return_indices=True)
    # The inside of a thick wall is not a room.
    parts, _ = ndimage.label(free)
    rooms = np.where(np.isin(parts, parts[rooms > 0]) & free, rooms[x, y], 0)
    border = np.zeros((2, rooms.max() + 1))
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        beside = np.roll(rooms, step, axis)
        edge = (beside > 0) & (beside != rooms)
        border += [np.bincount(beside[cells], minlength=border.shape[1])
                   for cells in (edge & barrier, edge)]
    return rooms, border[0] / np.maximum(border[1], 1.0)


def _joined(rooms: np.ndarray, lintels: np.ndarray, half: np.ndarray, widths: np.ndarray,
            reach: float) -> np.ndarray:
    """
    Join spaces that are separated only by beams.

    :param rooms: (X, Y) room numbers.
    :param lintels: (X, Y) bool, cells of possible lintels or beams.
    :param half: (X, Y) metres to the nearest wall.
    :param widths: the largest value of ``half`` in each room, by room number.
    :param reach: the distance in cells from a lintel to the spaces that it separates.
    :returns: for each number, the number of the joined room.
    """
    joined, near, margin = np.arange(len(widths)), _disc(reach), int(reach) + 1
    # A beam has two faces and an underside between them; cells inside thick walls are excluded.
    between = ndimage.binary_closing(lintels, near) & ~ndimage.binary_closing(half == 0.0, near)
    blobs, _ = ndimage.label(lintels | between)
    openings: dict[tuple[int, int], float] = {}
    for number, box in enumerate(ndimage.find_objects(blobs), start=1):
        around = tuple(slice(max(side.start - margin, 0), side.stop + margin) for side in box)
        blob = blobs[around] == number
        parted = np.setdiff1d(rooms[around][ndimage.binary_dilation(blob, near)], [0])
        for pair in combinations(parted.tolist(), 2):
            # The openings of several beams between columns add up.
            opening = half[around][blob & lintels[around]].max(initial=0.0)
            openings[pair] = openings.get(pair, 0.0) + opening
    for pair, opening in openings.items():
        one, other = pair
        if opening > widths[[one, other]].min() * (DOOR if opening <= HALF else GATE):
            joined[joined == joined[other]] = joined[one]
    return joined


def _disc(radius: float) -> np.ndarray:
    """Return the mask of a disc with a radius in cells."""
    reach = np.arange(-int(radius), int(radius) + 1)
    return np.hypot(reach[:, None], reach) <= radius
