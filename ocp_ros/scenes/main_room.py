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
The room that a scan is of: what lies behind its doors belongs to others.

Walls reach up to the ceiling, and so do lintels over doors: on a plan of both the free floor
falls apart into rooms. A beam over the whole width of a corridor is no lintel, and a strip behind
a shelf no room.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import numpy as np
from ocp_ros.geometry.voxels import voxel_downsample
from ocp_ros.scenes.scene import MIN_POINTS, Scene
from scipy import ndimage
from scipy.spatial import cKDTree

#: Metres: the edge of a cell of the plan, and of the largest one with which rooms are told apart;
#: in multiples of the points' spacing.
CELL, COARSEST, SPACINGS = 0.1, 0.2, 1.5
#: Metres: the edge of the cubes whose points are merged for it; points whose spacing is measured,
#: and among how many.
VOXEL, TRIED, AMONG = 0.04, 2000, 9
#: How much finer walls are split between the rooms on both sides, and cells of that at most.
FINER, MOST = 4, 4_000_000
#: Metres above the floor that a wall reaches through, in bands, all of which but one have points,
#: and under the ceiling; above the floor where lintels are and beams are not.
BANDS, UNDER_CEILING, LINTEL = (0.9, 1.2, 1.5, 1.8), (0.12, 0.5), (2.0, 2.35)
BAND = 0.3
#: The same as a share of a high room; metres under a low ceiling from which on lintels are looked
#: for, and where their faces end; cells that a face is high at least, since a ceiling is flat.
HIGH, UNDER_LOW, BELOW, UPRIGHT = 0.78, 0.35, 0.03, 1.3
#: Metres: layers in which a ceiling stands out, above which height, by how many times.
LAYER, OVERHEAD, FULLER = 0.1, 1.9, 3.0
#: Metres that a lintel reaches from the next wall at most, that gaps in a floor are closed over,
#: and half of the width of an opening up to the ceiling that parts two rooms.
REACH, GAP, NARROW = 1.0, 0.4, 0.25
#: Half of the width of a room at least, and of a door at most, metres; the most that a door is
#: wide as a share of the rooms on both sides, and a wider one.
HALF, DOOR, GATE = 0.6, 0.75, 0.5
#: Square metres of a room's floor, and its share of the points; of a hole in what is seen that is
#: no unseen room.
FLOOR, SHARE, HOLE = 1.0, 0.02, 1.0
#: The thickest wall, metres, whose two faces are told apart, how far from a room in cells, and
#: how near to a place, in multiples of the points' spacing, something stands there.
THICK, ASIDE, NEAR = 0.3, 3.5, 0.6
#: A scan is of a building where so many rooms are beside the one with the most points, or where
#: that has less than such a share of them.
MANY, BUILDING = 4, 0.45
#: Square metres of the largest plan on which rooms are looked for.
LARGEST_PLAN = 5000.0


def main_room(scene: Scene, points: np.ndarray) -> Scene:
    """
    Leave out what belongs to other rooms, with a note; the same scene where there is none.

    :param points: (N, 3) metres, those of the file before any were merged.
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
    # What is seen of a room through a door has hardly any walls around it.
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
    Return a function that finds the nearest room of places.

    :param rooms: (X, Y) their numbers on the plan, whose cells have this edge, metres.
    :returns: of places (N, 3), metres from the corner of the plan, the numbers (N,).
    """
    # On the two faces of a wall there are points of two rooms.
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
    Tell which points of walls beside a room nothing stands before: of a wall of one face, that.

    :param points: (N, 3) metres from the corner of the plan, as in ``tree``.
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
    """Return how high the ceiling is, of heights above the floor, metres."""
    top = float(np.percentile(height, 99))
    layers = np.bincount(((height[height > OVERHEAD] - OVERHEAD) / LAYER).astype(int), minlength=2)
    # It may be on both sides of the border of two layers.
    layers[1:] += layers[:-1].copy()
    if layers.max() <= FULLER * np.median(layers):
        return top
    return min(top, OVERHEAD + LAYER * (int(layers.argmax()) + 0.5))


def _rooms(points: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """
    Tell rooms apart on a plan of points.

    :param points: (N, 3) metres above the floor, from the lowest corner of the plan.
    :returns: (X, Y), the number of a room from 1, 0 in walls and outside, and the share of the
        border of each that is walls.
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
    # A larger one is of walls, and of rooms, that are not seen.
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
    # What is seen through a door is narrower than the room that it is a part of.
    widths = np.append(0.0, ndimage.maximum(aside, rooms, numbers))
    rooms = joined[rooms]
    wide = np.zeros(count + 1, dtype=bool)
    wide[joined[widths >= HALF]] = True
    rooms[~wide[rooms]] = 0
    _, (x, y) = ndimage.distance_transform_edt(rooms == 0, return_indices=True)
    # Within a thick wall there is no room.
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
    Join rooms between which there are beams.

    :param rooms: (X, Y) numbers.
    :param lintels: (X, Y), what may be one or a beam.
    :param half: (X, Y) metres to the next wall.
    :param widths: of the rooms by their number, the most of ``half``.
    :param reach: cells from a lintel to the rooms that it parts.
    :returns: the number of the room that each is a part of.
    """
    joined, near, margin = np.arange(len(widths)), _disc(reach), int(reach) + 1
    # A beam has two faces, and its underside between them; in a thick wall nothing hangs.
    between = ndimage.binary_closing(lintels, near) & ~ndimage.binary_closing(half == 0.0, near)
    blobs, _ = ndimage.label(lintels | between)
    openings: dict[tuple[int, int], float] = {}
    for number, box in enumerate(ndimage.find_objects(blobs), start=1):
        around = tuple(slice(max(side.start - margin, 0), side.stop + margin) for side in box)
        blob = blobs[around] == number
        parted = np.setdiff1d(rooms[around][ndimage.binary_dilation(blob, near)], [0])
        for pair in combinations(parted.tolist(), 2):
            # Between columns there are many beams.
            opening = half[around][blob & lintels[around]].max(initial=0.0)
            openings[pair] = openings.get(pair, 0.0) + opening
    for pair, opening in openings.items():
        one, other = pair
        if opening > widths[[one, other]].min() * (DOOR if opening <= HALF else GATE):
            joined[joined == joined[other]] = joined[one]
    return joined


def _disc(radius: float) -> np.ndarray:
    """Return the cells within a radius, in cells."""
    reach = np.arange(-int(radius), int(radius) + 1)
    return np.hypot(reach[:, None], reach) <= radius
