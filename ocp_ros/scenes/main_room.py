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

#: Metres: gaps in a floor up to this width are closed.
MAX_FLOOR_GAP_M = 0.4
#: Metres: half the least width of a room.
MIN_HALF_WIDTH_M = 0.6


def main_room(scene: Scene, points: np.ndarray) -> Scene:
    """
    Leave out the points of other rooms and add a note; return the same scene if there are none.

    :param points: (N, 3) metres, the points of the file before merging.
    """
    thin = voxel_downsample(points, 0.04)
    corner = np.append(thin[:, :2].min(axis=0) - 2.0 * MAX_FLOOR_GAP_M,
                       np.percentile(thin[:, 2], 1))
    thin = thin - corner
    tree = cKDTree(thin)
    neighbours = 9
    reach = float(np.median(tree.query(thin[::max(len(thin) // 2000, 1)], k=neighbours)[0][:, -1]))
    cell = max(0.1, 1.5 * reach * np.sqrt(np.pi / (neighbours - 1)))
    # Rooms cannot be separated with coarser cells, nor on a plan of more than 5000 m2.
    if cell > 0.2 or np.prod(np.ptp(thin[:, :2], axis=0)) > 5000.0:
        return scene
    rooms, closed = _rooms(thin, cell)
    if rooms.max() < 2:
        return scene
    nearest = _room_finder(rooms, cell)
    counts = np.bincount(nearest(thin), minlength=rooms.max() + 1)
    # A part of a room that is visible only through a door has few walls around it.
    weights = counts * closed
    main, floors = int(weights.argmax()), np.bincount(rooms.ravel()) * cell * cell
    # A room has 2 % of the points and 1 m2 of floor at least.
    others = [room for room in np.flatnonzero(counts >= 0.02 * len(thin))
              if room != main and floors[room] >= 1.0]
    # A scan with many rooms, or without a main one, shows a building.
    if len(others) >= 4 or others and weights[main] < 0.45 * weights.sum():
        remark = f'{len(others) + 1} rooms with openings between them: all are planned for'
        return replace(scene, remarks=(*scene.remarks, remark))
    places = scene.points - corner
    kept = ~np.isin(nearest(places), others)
    kept[~kept] = _facing_points(places[~kept], rooms == main, cell, tree, 0.6 * reach)
    if kept.all() or kept.sum() < MIN_POINTS:
        return scene
    note = (f'found {len(scene) - kept.sum():,} points of another room behind an opening; '
            'expected one room; that part of the scan is not planned for: --all-rooms includes it')
    return replace(scene.only(kept), notes=(*scene.notes, note))


def _room_finder(rooms: np.ndarray, cell: float) -> Callable[[np.ndarray], np.ndarray]:
    """
    Return a function that finds the nearest room of positions.

    :param rooms: (X, Y) room numbers on the plan.
    :returns: a function from positions (N, 3), metres from the corner of the plan, to room numbers
        (N,).
    """
    # The two faces of a wall belong to two rooms, so the cells are subdivided.
    finer = int(np.clip(np.sqrt(4_000_000 / rooms.size), 1, 4))
    fine = rooms.repeat(finer, axis=0).repeat(finer, axis=1)
    _, (x, y) = ndimage.distance_transform_edt(fine == 0, return_indices=True)
    fine = fine[x, y]

    def nearest(places: np.ndarray) -> np.ndarray:
        at = (places[:, :2] * (finer / cell)).astype(int)
        return fine[tuple(np.clip(at, 0, np.array(fine.shape) - 1).T)]
    return nearest


def _facing_points(points: np.ndarray, room: np.ndarray, cell: float, tree: cKDTree,
                   radius: float) -> np.ndarray:
    """
    Return which wall points beside a room have no points between them and the room.

    :param points: (N, 3) metres from the corner of the plan, in the frame of ``tree``.
    :param room: (X, Y) bool.
    """
    away, (x, y) = ndimage.distance_transform_edt(~room, return_indices=True)
    at = tuple(np.clip((points[:, :2] / cell).astype(int), 0, np.array(room.shape) - 1).T)
    # Points up to 3.5 cells from the room may be on its walls.
    found = away[at] <= 3.5
    way = np.column_stack([x[at], y[at]])[found] * cell + 0.5 * cell - points[found, :2]
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    way = np.column_stack([way, np.zeros(len(way))])
    open_to = np.ones(len(way), dtype=bool)
    # The largest thickness in metres of a wall whose two faces are separated.
    for step in np.arange(1.4 * radius, 0.3, radius):
        nearest, _ = tree.query(points[found] + step * way, distance_upper_bound=radius)
        open_to &= ~np.isfinite(nearest)
    found[found] = open_to
    return found


def _ceiling(height: np.ndarray) -> float:
    """Return the height of the ceiling, given heights of points above the floor, metres."""
    top = float(np.percentile(height, 99))
    layer_m = 0.1
    lowest_m = 1.9
    above = height[height > lowest_m] - lowest_m
    layers = np.bincount((above / layer_m).astype(int), minlength=2)
    # The ceiling may lie across the border of two layers.
    layers[1:] += layers[:-1].copy()
    # The layer of the ceiling has three times as many points as the median layer.
    if layers.max() <= 3.0 * np.median(layers):
        return top
    return min(top, lowest_m + layer_m * (int(layers.argmax()) + 0.5))


def _rooms(points: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """
    Separate rooms on a plan of points.

    :param points: (N, 3) metres, from the lowest corner of the plan, z above the floor.
    :returns: (X, Y) room numbers from 1, 0 in walls and outside; and per room the share of its
        border that is wall.
    """
    place = (points[:, :2] / cell).astype(int)
    shape = tuple(place.max(axis=0) + 1 + int(2.0 * MAX_FLOOR_GAP_M / cell))
    height, top = points[:, 2], _ceiling(points[:, 2])

    def occupied(low: float = -np.inf, high: float = np.inf) -> np.ndarray:
        cells = np.zeros(shape, dtype=bool)
        cells[tuple(place[(height >= low) & (height < high)].T)] = True
        return cells

    disc = _disc(1.0)
    # Walls have points 12 to 50 cm under the ceiling.
    high = ndimage.binary_dilation(occupied(top - 0.5, top - 0.12), disc)
    # A wall has points in three of the four bands that begin at these heights.
    bands_m = (0.9, 1.2, 1.5, 1.8)
    bands = [ndimage.binary_dilation(occupied(low, low + 0.3), disc) for low in bands_m]
    upright = np.sum(bands, axis=0) >= len(bands_m) - 1
    walls = upright & high
    wall_distance = ndimage.distance_transform_edt(~walls) * cell
    # The range above the floor that contains lintels but not beams.
    lintel_m = (2.0, 2.35)
    # Under a low ceiling lintels begin lower.
    lowest = min(lintel_m[0], top - 0.35)
    part = (height >= lowest) & (height < top - 0.03)
    ends = np.full((2, *shape), -np.inf)
    for end, way in zip(ends, (1.0, -1.0), strict=True):
        np.maximum.at(end, tuple(place[part].T), way * height[part])
    # In a high room lintels reach higher. A face is higher than a cell, since a ceiling is flat.
    faces = (occupied(lowest, max(lintel_m[1], 0.78 * top))
             & (ends.sum(axis=0) >= 1.3 * cell))
    # A lintel is at most a metre from the nearest wall.
    lintels = ndimage.binary_dilation(faces, disc) & high & ~upright & (wall_distance <= 1.0)
    floor = ndimage.binary_closing(occupied(), _disc(MAX_FLOOR_GAP_M / cell))
    holes, _ = ndimage.label(ndimage.binary_fill_holes(floor) & ~floor)
    # A hole of more than 1 m2 consists of walls and rooms that were not scanned.
    small = np.bincount(holes.ravel()) * cell * cell <= 1.0
    floor |= small[holes] & (holes > 0)
    barrier = walls | lintels
    free = floor & ~barrier
    barrier_distance = ndimage.distance_transform_edt(~barrier) * cell
    # Half the width of the narrowest opening up to the ceiling that still joins two spaces.
    min_half_opening_m = 0.25
    rooms, count = ndimage.label(free & (barrier_distance >= min_half_opening_m))
    half_width = ndimage.distance_transform_edt(floor & ~walls) * cell
    numbers = np.arange(1, count + 1)
    widths = np.append(0.0, ndimage.maximum(half_width, rooms, numbers))
    joined = _joined(rooms, lintels, half_width, widths, min_half_opening_m / cell + 1.5)
    # A part that is visible only through a door is narrower than the room that it belongs to.
    widths = np.append(0.0, ndimage.maximum(wall_distance, rooms, numbers))
    rooms = joined[rooms]
    wide = np.zeros(count + 1, dtype=bool)
    wide[joined[widths >= MIN_HALF_WIDTH_M]] = True
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


def _joined(rooms: np.ndarray, lintels: np.ndarray, half_width: np.ndarray, widths: np.ndarray,
            reach: float) -> np.ndarray:
    """
    Join spaces that are separated only by beams.

    :param rooms: (X, Y) room numbers.
    :param lintels: (X, Y) bool, cells of possible lintels or beams.
    :param half_width: (X, Y) metres to the nearest wall.
    :param widths: the largest value of ``half_width`` in each room, by room number.
    :param reach: the distance in cells from a lintel to the spaces that it separates.
    :returns: for each number, the number of the joined room.
    """
    joined = np.arange(len(widths))
    disc, margin = _disc(reach), int(reach) + 1
    # A beam has two faces and an underside between them; cells inside thick walls are excluded.
    inside = ndimage.binary_closing(half_width == 0.0, disc)
    between = ndimage.binary_closing(lintels, disc) & ~inside
    blobs, _ = ndimage.label(lintels | between)
    openings: dict[tuple[int, int], float] = {}
    for number, box in enumerate(ndimage.find_objects(blobs), start=1):
        around = tuple(slice(max(side.start - margin, 0), side.stop + margin) for side in box)
        blob = blobs[around] == number
        parted = np.setdiff1d(rooms[around][ndimage.binary_dilation(blob, disc)], [0])
        for pair in combinations(parted.tolist(), 2):
            # The openings of several beams between columns add up.
            opening = half_width[around][blob & lintels[around]].max(initial=0.0)
            openings[pair] = openings.get(pair, 0.0) + opening
    for pair, opening in openings.items():
        one, other = pair
        # The width of an opening, as a share of the narrower room, above which both are one room.
        if opening > widths[[one, other]].min() * (0.75 if opening <= MIN_HALF_WIDTH_M else 0.5):
            joined[joined == joined[other]] = joined[one]
    return joined


def _disc(radius: float) -> np.ndarray:
    """Return the mask of a disc with a radius in cells."""
    reach = np.arange(-int(radius), int(radius) + 1)
    return np.hypot(reach[:, None], reach) <= radius
