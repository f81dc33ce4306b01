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

from dataclasses import replace
from itertools import combinations

import numpy as np
from ocp_ros.geometry.clouds import voxel_downsample
from ocp_ros.scenes.glass_walls import ceiling_height, glass_walls
from ocp_ros.scenes.scene import MIN_POINTS, Rooms, Scene
from scipy import ndimage
from scipy.spatial import cKDTree

#: Metres: edge of the voxels in which points for the plan are merged.
PLAN_VOXEL_M = 0.04
#: Metres: gaps in a floor up to this width are closed.
MAX_FLOOR_GAP_M = 0.4
#: Metres: half the least width of a main room, and of corridors and closets beside others.
MIN_HALF_WIDTH_M, MIN_HALF_CLOSET_M = 0.6, 0.3
#: Square metres: the least area of a room of a floor; that of a closet of 2 m2 without a cell at
#: its walls.
MIN_ROOM_M2 = 1.1
#: The largest share of the points of a scan that are seen through glass; in generated rooms it is
#: 0.14, and where no glass is, the others are 0.22 or more.
MAX_GLASS_SHARE = 0.18


def main_room(scene: Scene, points: np.ndarray, surfaces: np.ndarray, all_rooms: bool = False,
              may_have_glass: bool = True) -> Scene:
    """
    Leave out the points of other rooms and add a note, or find the rooms of a floor.

    :param points: (N, 3) metres, the points of the file before merging: the plan is made of these,
        since ``scene.points`` may be too far apart for fine cells.
    :param surfaces: (M, 3) metres, points on surfaces: those far from all of them do not count.
    :param all_rooms: whether other rooms are kept.
    :param may_have_glass: whether walls of glass are searched for.
    :returns: the same scene if there are no other rooms, or they cannot be separated. A scan of
        many rooms stays whole and gets a remark, and :attr:`~ocp_ros.scenes.scene.Scene.rooms`.
    """
    thin_points = _near_surfaces(points, surfaces)
    # The corner of the plan, at the height of the floor. The empty margin around the points is for
    # closing gaps in the floor, which fails at the edge of the plan.
    corner = np.append(thin_points[:, :2].min(axis=0) - 2.0 * MAX_FLOOR_GAP_M,
                       np.percentile(thin_points[:, 2], 1))
    thin_points = thin_points - corner
    tree = cKDTree(thin_points)
    neighbours = 9
    some_points = thin_points[::max(len(thin_points) // 2000, 1)]
    # The median distance to the eighth neighbour; the first found point is the point itself.
    neighbour_distance = float(np.median(tree.query(some_points, k=neighbours)[0][:, -1]))
    # A disc up to the eighth neighbour has the area of eight squares, one for each point. A cell
    # is 1.5 times as wide as such a square.
    cell = max(0.1, 1.5 * neighbour_distance * np.sqrt(np.pi / (neighbours - 1)))
    # Rooms cannot be separated with coarser cells, nor on a plan of more than 5000 m2.
    if cell > 0.2 or np.prod(np.ptp(thin_points[:, :2], axis=0)) > 5000.0:
        return scene
    glass = (glass_walls(scene, points) if may_have_glass else np.empty((0, 2))) - corner[:2]
    if all_rooms:
        return _with_rooms(scene, thin_points, cell, glass, corner)
    # A corridor behind glass is a room too.
    numbers, wall_shares = _separate_rooms(thin_points, cell, glass, MIN_HALF_CLOSET_M if len(
        glass) else MIN_HALF_WIDTH_M)
    rooms = Rooms(numbers, cell, np.zeros(2))
    if rooms.count < 2:
        return scene
    # ``at`` returns the nearest room, so number 0, which is no room, has no points.
    counts = np.bincount(rooms.at(thin_points), minlength=rooms.count + 1)
    # A room of which only a part is visible, through a door, has few walls around that part, so it
    # gets less weight.
    weights = counts * wall_shares
    main_number = int(weights.argmax())
    # A room has 2 % of the points and 1 m2 of floor at least.
    other_numbers = [number for number in np.flatnonzero(counts >= 0.02 * len(thin_points))
                     if number != main_number and rooms.areas[number - 1] >= 1.0]
    # A scan with many rooms, or without a main one, shows a building.
    if len(other_numbers) >= 4 or (other_numbers and weights.max() < 0.45 * weights.sum()):
        return _with_rooms(scene, thin_points, cell, glass, corner)
    if len(glass):
        # Of a room behind glass there may be less, and in parts, of 1 m2 together.
        others = np.setdiff1d(np.flatnonzero(counts), [main_number])
        other_numbers = others if rooms.areas[others - 1].sum() >= 1.0 else []
    positions = scene.points - corner
    is_kept = ~np.isin(rooms.at(positions), other_numbers)
    # Points beside the main room that face it are on its own walls, and are kept too.
    is_beside = ~is_kept
    if len(glass):
        # What is behind glass faces the room as well.
        is_beside &= cKDTree(glass).query(positions[:, :2])[0] > 1.0
    is_kept[is_beside] = _facing_points(positions[is_beside], numbers == main_number, cell, tree,
                                        0.6 * neighbour_distance)
    if len(glass) and is_kept.mean() < 1.0 - MAX_GLASS_SHARE:
        # The scanner stood there too.
        return main_room(scene, points, surfaces, may_have_glass=False)
    if is_kept.all() or is_kept.sum() < MIN_POINTS:
        return scene
    note = (f'found {len(scene) - is_kept.sum():,} points of another room behind an opening or '
            'glass; expected one room; that part of the scan is not planned for: --all-rooms '
            'includes it')
    return replace(scene.only(is_kept), notes=(*scene.notes, note))


def _with_rooms(scene: Scene, thin_points: np.ndarray, cell: float, glass: np.ndarray,
                corner: np.ndarray) -> Scene:
    """
    Return a scene with its rooms, if there are several, and a remark.

    :param thin_points: (N, 3) metres, from the corner (3,) of the plan; the other parameters are
        those of :func:`_separate_rooms`.
    """
    numbers, _ = _separate_rooms(thin_points, cell, glass, MIN_HALF_CLOSET_M)
    # The cells at walls count as walls; here they belong to the nearest room.
    distance, (x, y) = ndimage.distance_transform_edt(numbers == 0, return_indices=True)
    numbers = np.where(distance <= 1.0, numbers[x, y], 0)
    areas = np.bincount(numbers.ravel()) * cell * cell
    areas[0] = 0.0
    # The largest room is number 1.
    large = [number for number in np.argsort(-areas, kind='stable')
             if areas[number] >= MIN_ROOM_M2]
    if len(large) < 2:
        return scene
    new_numbers = np.zeros(len(areas), dtype=np.int16)
    new_numbers[large] = np.arange(len(large)) + 1
    remark = f'{len(large)} rooms with openings between them: all are planned for'
    return replace(scene, remarks=(*scene.remarks, remark),
                   rooms=Rooms(new_numbers[numbers], cell, corner[:2]))


def without_views_outside(scene: Scene, points: np.ndarray) -> tuple[Scene, np.ndarray]:
    """
    Leave out what a scanner saw through the windows of a room, and add a note.

    The room has a ceiling, and a part of the scan without one belongs to it only if the floor goes
    on where the ceiling ends. Under a lintel or behind a sill it ends at a wall.

    :param points: (N, 3) metres, the points of the file before merging.
    :returns: the room and its points; both the same if most points have no ceiling, as in a yard.
    """
    places = _RoofedPlaces(scene)
    is_outside = places.are_outside(scene.points)
    count = np.count_nonzero(is_outside)
    if count < 0.002 * len(scene) or len(scene) - count < MIN_POINTS:
        return scene, points
    is_kept = ~places.are_outside(points)
    if is_kept.mean() < 0.3:
        return scene, points
    note = (f'found {count:,} points outside, seen through windows or doors; expected one room; '
            'they are not planned for: --all-rooms includes them')
    return replace(scene.only(~is_outside), notes=(*scene.notes, note)), points[is_kept]


class _RoofedPlaces:
    """
    The places in the plan of a scan that have a ceiling, and those outside of them.

    :param scene: the scan; its largest roofed part is the room.
    """

    def __init__(self, scene: Scene) -> None:
        z = scene.points[:, 2]
        self._edge = max(0.2, 2.0 * float(np.median(scene.pitch)))
        self._low = scene.bounds[0, :2] - 2.0
        # Beyond the points there are empty cells, in which cells may grow.
        self._shape = tuple(np.floor((scene.size[:2] + 4.0) / self._edge).astype(int) + 1)
        cells = self._cells(scene.points)
        self._top, self._bottom = np.full(self._shape, -np.inf), np.full(self._shape, np.inf)
        np.maximum.at(self._top, cells, z)
        np.minimum.at(self._bottom, cells, z)
        is_occupied = np.isfinite(self._top)
        # A ceiling is the highest thing in its column; attics have steep ones. There is something
        # lower below it, or beside it if furniture hides the floor.
        is_lid = (np.abs(scene.normals_or_estimate[:, 2]) > 0.5) & (z > self._top[cells] - 0.1)
        lids = _occupied_cells(np.column_stack(cells)[is_lid], self._shape)
        lowest = ndimage.minimum_filter(self._bottom, size=5)
        roofs = ndimage.binary_closing(lids & (self._top - lowest > 1.5), self._near(0.5))
        roofs = ndimage.binary_fill_holes(roofs)
        counts = np.bincount((cells[0] * self._shape[1] + cells[1]), minlength=roofs.size)
        parts, _ = ndimage.label(roofs)
        sizes = np.bincount(parts.ravel(), counts)
        sizes[0] = 0
        # Rooms up to a metre apart, with walls between, are in one building.
        buildings, _ = ndimage.label(ndimage.binary_dilation(roofs, self._near(0.5)))
        core = parts == sizes.argmax()
        self._building = roofs & (buildings == buildings[core].max())
        self._floor = float(np.percentile(self._bottom[core & is_occupied], 30.0)) if (
            sizes.any()) else 0.0
        self._outside = np.zeros(self._shape, dtype=bool)
        if sizes.any():
            self._find_outside(scene, cells, is_occupied, roofs)

    def _find_outside(self, scene: Scene, cells: tuple[np.ndarray, ...], is_occupied: np.ndarray,
                      roofs: np.ndarray) -> None:
        """Find the cells that are outside, given those of the points."""
        z = scene.points[:, 2]
        # Walls reach up to half a metre out of the roofed cells.
        self._wall = ndimage.binary_dilation(self._building, self._near(0.5))
        is_beyond = is_occupied & ~self._wall
        border = self._building & ~ndimage.binary_erosion(self._building)
        ceiling = ndimage.maximum_filter(np.where(self._building, self._top, -np.inf), size=7)
        is_upper = (z > ceiling[cells] - 0.5) & (z < ceiling[cells] - 0.12)
        is_walled = ndimage.binary_dilation(
            _occupied_cells(np.column_stack(cells)[is_upper], self._shape), self._near(0.5))
        has_floor = is_beyond & (np.abs(self._bottom - self._floor) < 0.3)
        parts, count = ndimage.label(ndimage.binary_dilation(is_beyond, self._near(0.5)))
        floors = np.where(has_floor, parts, 0)
        reach = self._near(0.8 + self._edge)
        # The view reaches a metre below the floor or above the ceiling, or far without a roof; the
        # other parts are those of a room whose ceiling was not scanned whole, or in a mirror.
        is_far = is_beyond & ((self._bottom < self._floor - 1.0)
                              | (self._top > self._top[self._building].max() + 1.0))
        distance = self._edge * ndimage.distance_transform_edt(~self._building)
        roof_counts, distant_counts, far_counts = (
            np.bincount(parts[cells], minlength=count + 1)
            for cells in (roofs & is_beyond, is_beyond & (distance > 6.0), is_far))
        is_view = (far_counts >= 3) | ((distant_counts >= 3) & (roof_counts < distant_counts))
        # Single points far away belong to the view too.
        is_view |= is_view.any() & (distant_counts > 0) & (roof_counts == 0)
        for number, box in enumerate(ndimage.find_objects(parts), start=1):
            margin = len(reach)
            window = tuple(slice(max(side.start - margin, 0), side.stop + margin) for side in box)
            beside = border[window] & ndimage.binary_dilation(floors[window] == number, reach)
            # The floor goes on under the open edge of a ceiling that was not scanned whole.
            is_open = beside.any() and np.mean(~is_walled[window][beside]) > 0.5
            if is_open or not is_view[number]:
                parts[parts == number] = 0
        self._outside = is_beyond & (parts > 0)

    def _cells(self, points: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the cells of points (M, 3): their indices along x and y."""
        cells = np.floor((points[:, :2] - self._low) / self._edge).astype(int)
        return tuple(np.clip(cells, 0, np.array(self._shape) - 1).T)

    def _near(self, distance: float) -> np.ndarray:
        """Return the mask of a disc with a radius in metres."""
        return _disc(max(distance / self._edge, 1.0))

    def are_outside(self, points: np.ndarray) -> np.ndarray:
        """Return which points (M, 3) are outside: (M,) bool."""
        cells = self._cells(points)
        is_low = (points[:, 2] < self._floor - 0.3) & ~self._building[cells]
        return self._outside[cells] | (is_low & self._outside.any())


def _near_surfaces(points: np.ndarray, surfaces: np.ndarray) -> np.ndarray:
    """
    Return the points (N, 3) near points of ``surfaces`` (M, 3), both metres.

    Stray points in the air have few neighbours, and those lie on no plane. They must not count as
    walls and lintels, however many there are. Far from a scanner, surfaces have few points too.
    """
    tree = cKDTree(surfaces)
    distances, _ = tree.query(surfaces[::max(len(surfaces) // 2000, 1)], k=2)
    spacing = float(np.median(distances[:, 1]))
    thin_points = voxel_downsample(points, PLAN_VOXEL_M)
    count = min(9, len(surfaces))
    distances, indices = tree.query(thin_points, k=count)
    is_kept = distances[:, 0] <= max(0.1, 2.0 * spacing)
    # The eighth neighbour of a point of a dense surface is at most this far away.
    is_sparse = np.flatnonzero(is_kept & (distances[:, min(7, count - 1)]
                                          > max(0.15, 3.0 * spacing)))
    places = surfaces[indices[is_sparse]].astype(np.float64)
    places -= places.mean(axis=1, keepdims=True)
    variances = np.linalg.eigvalsh(np.einsum('mpi,mpj->mij', places, places))
    is_kept[is_sparse] = variances[:, 0] < 0.02 * variances[:, 1]
    return thin_points[is_kept]


def _facing_points(points: np.ndarray, is_room: np.ndarray, cell: float, tree: cKDTree,
                   radius: float) -> np.ndarray:
    """
    Return which points beside a room have no points between them and the room: (N,) bool.

    :param points: (N, 3) metres from the corner of the plan.
    :param is_room: (X, Y) bool, the cells of the room.
    :param cell: the edge of a cell, metres.
    :param tree: all points of the scan, in the same frame.
    :param radius: metres; points this near to the line to the room are between.
    """
    room_distance, (x, y) = ndimage.distance_transform_edt(~is_room, return_indices=True)
    last_cell = np.array(is_room.shape) - 1
    point_cells = tuple(np.clip((points[:, :2] / cell).astype(int), 0, last_cell).T)
    # Only points up to 3.5 cells from the room may be on its walls.
    is_facing = room_distance[point_cells] <= 3.5
    room_cells = np.column_stack([x[point_cells], y[point_cells]])[is_facing]
    # Level unit vectors to the middle of the nearest cell of the room.
    directions = room_cells * cell + 0.5 * cell - points[is_facing, :2]
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    directions = np.column_stack([directions, np.zeros(len(directions))])
    is_open = np.ones(len(directions), dtype=bool)
    # The two faces of a wall are at most 0.3 m apart. The first step is longer than the
    # radius, so that no point finds itself. A gap is inf if no point is within the radius.
    for step in np.arange(1.4 * radius, 0.3, radius):
        gaps, _ = tree.query(points[is_facing] + step * directions, distance_upper_bound=radius)
        is_open &= ~np.isfinite(gaps)
    is_facing[is_facing] = is_open
    return is_facing


def _separate_rooms(points: np.ndarray, cell: float, glass: np.ndarray, min_half_width: float
                    ) -> tuple[np.ndarray, np.ndarray]:
    """
    Separate rooms on a plan of X x Y cells.

    :param points: (N, 3) metres, from the lowest corner of the plan, z above the floor.
    :param cell: the edge of a cell, metres.
    :param glass: (G, 2) metres, places of walls that the points do not show.
    :param min_half_width: metres, half the least width of a room.
    :returns: (X, Y) room numbers from 1, 0 in walls and outside; and by room number the share of
        the room's border that is wall.
    """
    cells = (points[:, :2] / cell).astype(int)
    # The empty margin at the far sides is as wide as the one at the corner of the plan.
    shape = tuple(cells.max(axis=0) + 1 + int(2.0 * MAX_FLOOR_GAP_M / cell))
    walls, lintels = _walls_and_lintels(points[:, 2], cells, shape, cell)
    glass_cells = np.clip((glass / cell).astype(int), 0, np.array(shape) - 1)
    walls |= ndimage.binary_dilation(_occupied_cells(glass_cells, shape), _disc(1.0))
    floor_cells = _floor(_occupied_cells(cells, shape), cell)
    # Rooms are the parts of the free floor that are separate if narrow openings are closed.
    is_barrier = walls | lintels
    is_free = floor_cells & ~is_barrier
    barrier_distance = ndimage.distance_transform_edt(~is_barrier) * cell
    # Half the width of the narrowest opening up to the ceiling that still joins two spaces.
    min_half_opening_m = 0.25
    rooms, count = ndimage.label(is_free & (barrier_distance >= min_half_opening_m))
    # Join rooms that only a beam separates.
    half_width = ndimage.distance_transform_edt(floor_cells & ~walls) * cell
    # ``room_half_widths`` begins with a value for number 0, which is no room.
    numbers = np.arange(1, count + 1)
    room_half_widths = np.append(0.0, ndimage.maximum(half_width, rooms, numbers))
    # Rooms begin at ``min_half_opening_m`` from a lintel; 1.5 cells more are a margin.
    joined = _join_rooms(rooms, lintels, half_width, room_half_widths,
                         min_half_opening_m / cell + 1.5)
    # Leave out rooms that are too narrow. Only a strip of the floor behind a door may have been
    # scanned, so here the width is that between walls, not that of the floor.
    wall_distance = ndimage.distance_transform_edt(~walls) * cell
    max_wall_distances = np.append(0.0, ndimage.maximum(wall_distance, rooms, numbers))
    rooms = joined[rooms]
    # A joined room is wide if one of its parts is wide.
    is_wide = np.zeros(count + 1, dtype=bool)
    is_wide[joined[max_wall_distances >= min_half_width]] = True
    rooms[~is_wide[rooms]] = 0
    # All other free cells join the nearest room, except those that are not connected with a room,
    # such as the inside of a thick wall.
    _, (x, y) = ndimage.distance_transform_edt(rooms == 0, return_indices=True)
    spaces, _ = ndimage.label(is_free)
    rooms = np.where(np.isin(spaces, spaces[rooms > 0]) & is_free, rooms[x, y], 0)
    return rooms, _wall_shares(rooms, is_barrier)


def _occupied_cells(cells: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return a mask of a shape (X, Y) that is True in the given cells (N, 2)."""
    is_occupied = np.zeros(shape, dtype=bool)
    is_occupied[tuple(cells.T)] = True
    return is_occupied


def _walls_and_lintels(heights: np.ndarray, cells: np.ndarray, shape: tuple[int, ...], cell: float
                       ) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the cells (X, Y) bool of walls, and those of lintels (the walls above doors).

    :param heights: (N,) metres of points above the floor.
    :param cells: (N, 2) the cells of the points.
    :param shape: (X, Y).
    :param cell: the edge of a cell, metres.
    """
    def occupied_between(low: float, high: float) -> np.ndarray:
        return _occupied_cells(cells[(heights >= low) & (heights < high)], shape)

    ceiling = ceiling_height(heights)
    disc = _disc(1.0)
    # Walls have points 12 to 50 cm under the ceiling.
    is_high = ndimage.binary_dilation(occupied_between(ceiling - 0.5, ceiling - 0.12), disc)
    # A wall has points in three of the four bands of 0.3 m that begin at these heights.
    bands_m = (0.9, 1.2, 1.5, 1.8)
    bands = [ndimage.binary_dilation(occupied_between(low, low + 0.3), disc) for low in bands_m]
    is_upright = np.sum(bands, axis=0) >= len(bands_m) - 1
    walls = is_upright & is_high
    wall_distance = ndimage.distance_transform_edt(~walls) * cell
    # The range above the floor that contains lintels but not beams. Under a low ceiling lintels
    # begin lower, and in a high room they reach higher.
    lowest, highest = min(2.0, ceiling - 0.35), max(2.35, 0.78 * ceiling)
    # Faces are measured on all points from ``lowest`` to just under the ceiling.
    is_upper = (heights >= lowest) & (heights < ceiling - 0.03)
    # The highest point of each cell, and the negative of its lowest point.
    extremes = np.full((2, *shape), -np.inf)
    for extreme, sign in zip(extremes, (1.0, -1.0), strict=True):
        np.maximum.at(extreme, tuple(cells[is_upper].T), sign * heights[is_upper])
    # The sum is the height range of the points in a cell. It exceeds the edge of the cell on an
    # upright face, but not on a flat ceiling.
    faces = occupied_between(lowest, highest) & (extremes.sum(axis=0) >= 1.3 * cell)
    # A lintel is at most a metre from the nearest wall.
    is_near_wall = wall_distance <= 1.0
    return walls, ndimage.binary_dilation(faces, disc) & is_high & ~is_upright & is_near_wall


def _floor(is_occupied: np.ndarray, cell: float) -> np.ndarray:
    """Return the cells (X, Y) bool with points, with gaps and small holes filled."""
    is_floor = ndimage.binary_closing(is_occupied, _disc(MAX_FLOOR_GAP_M / cell))
    holes, _ = ndimage.label(ndimage.binary_fill_holes(is_floor) & ~is_floor)
    # A hole of more than 1 m2 consists of walls and rooms that were not scanned.
    is_small = np.bincount(holes.ravel()) * cell * cell <= 1.0
    return is_floor | (is_small[holes] & (holes > 0))


def _wall_shares(rooms: np.ndarray, is_barrier: np.ndarray) -> np.ndarray:
    """Return for each room number in ``rooms`` (X, Y) the share of its border that is barrier."""
    # In the first row the cells of the border that are barrier, in the second row all its cells.
    counts = np.zeros((2, rooms.max() + 1))
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        # The number of the room in the next cell on one side. The plan has an empty margin, so the
        # cells that ``roll`` moves to the other end have no room.
        next_rooms = np.roll(rooms, step, axis)
        is_border = (next_rooms > 0) & (next_rooms != rooms)
        counts += [np.bincount(next_rooms[is_counted], minlength=counts.shape[1])
                   for is_counted in (is_border & is_barrier, is_border)]
    return counts[0] / np.maximum(counts[1], 1.0)


def _join_rooms(rooms: np.ndarray, lintels: np.ndarray, half_width: np.ndarray,
                room_half_widths: np.ndarray, radius: float) -> np.ndarray:
    """
    Join rooms that are separated only by beams.

    :param rooms: (X, Y) room numbers.
    :param lintels: (X, Y) bool, cells of possible lintels or beams.
    :param half_width: (X, Y) metres to the nearest wall or end of the floor; 0 in walls and
        outside of the floor.
    :param room_half_widths: the largest value of ``half_width`` in each room, by room number.
    :param radius: the distance in cells from a lintel to the rooms that it separates.
    :returns: by room number, the number of the joined room.
    """
    joined = np.arange(len(room_half_widths))
    disc = _disc(radius)
    margin = int(radius) + 1
    # A beam has two faces and an underside between them; cells inside thick walls are excluded.
    is_inside_wall = ndimage.binary_closing(half_width == 0.0, disc)
    undersides = ndimage.binary_closing(lintels, disc) & ~is_inside_wall
    beams, _ = ndimage.label(lintels | undersides)
    half_openings: dict[tuple[int, int], float] = {}
    for number, box in enumerate(ndimage.find_objects(beams), start=1):
        window = tuple(slice(max(side.start - margin, 0), side.stop + margin) for side in box)
        is_beam = beams[window] == number
        separated = np.setdiff1d(rooms[window][ndimage.binary_dilation(is_beam, disc)], [0])
        # Half the width of the opening under this beam: the largest value, that in its middle.
        half_opening = half_width[window][is_beam & lintels[window]].max(initial=0.0)
        for pair in combinations(separated.tolist(), 2):
            # The openings under several beams between the same two rooms add up.
            half_openings[pair] = half_openings.get(pair, 0.0) + half_opening
    for (room, other), half_opening in half_openings.items():
        # Both are one room if the opening is wider than this share of the narrower room.
        share = 0.75 if half_opening <= MIN_HALF_WIDTH_M else 0.5
        if half_opening > room_half_widths[[room, other]].min() * share:
            # All rooms that were joined with ``other`` now belong to ``room``.
            joined[joined == joined[other]] = joined[room]
    return joined


def _disc(radius: float) -> np.ndarray:
    """Return the mask of a disc with a radius in cells: (D, D) bool, D = 2 int(radius) + 1."""
    offsets = np.arange(-int(radius), int(radius) + 1)
    return np.hypot(offsets[:, None], offsets) <= radius
