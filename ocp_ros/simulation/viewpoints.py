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
Viewpoints of the depth error: positions spread over a room's air, or the paper's five.

The paper, arXiv 2110.11106, integrates over all positions of a room (eq. 3). A few viewpoints
approximate the integral best if they are spread evenly over the air. Then the error of a placement
does not change when the scan is rotated, moved or mirrored.

A search fits its placement to its viewpoints, so the error there is lower than elsewhere. Other
viewpoints, for validation, tell what the placement is worth.
"""

from collections.abc import Iterator
from functools import cached_property, lru_cache
from weakref import WeakKeyDictionary

import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.geometry.depth_error import five_viewpoints
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.structure import Air, MIN_BALL_M, STEEP
from ocp_ros.scenes.scene import Scene, turned
from scipy.spatial import distance

#: The least numbers of viewpoints in the air and of validation viewpoints, those of one room.
VIEWPOINTS, VALIDATION_VIEWPOINTS = 16, 64
#: Square metres: on a floor, the largest part of the air for which one viewpoint stands.
VIEWPOINT_AREA_M2 = 10.0

#: The viewpoints of each scene so far, by kind.
_cache: WeakKeyDictionary[Scene, dict[str, np.ndarray]] = WeakKeyDictionary()


def viewpoints_of(scene: Scene, kind: str = 'air') -> np.ndarray:
    """
    Return the V viewpoints of the depth error in a room; they are cached with the scene.

    :param kind: ``'air'``: 16 positions in the air; ``'validation'``: 64 others; ``'paper'``: the
        five of the paper, in the rectangle along the walls.
    :returns: (V, 3) float64, metres, map frame.
    """
    viewpoints = _cache.setdefault(scene, {})
    if kind not in viewpoints:
        make = {'air': air_viewpoints, 'validation': validation_viewpoints,
                'paper': paper_viewpoints}[kind]
        viewpoints[kind] = make(scene)
    return viewpoints[kind]


def air_viewpoints(scene: Scene) -> np.ndarray:
    """
    Return the centres (V, 3), metres, of 16 equal parts of the air at half height.

    If there is too little air at half height, all heights are used. If the whole room has fewer
    than 16 cells of air, the paper's five viewpoints are returned. On a floor of several rooms,
    each room has parts of its own, in number by its air: one at least, and 16 in all at least.
    """
    air = air_cells_of(scene)
    centres = [_part_centres(cells, air.parts(cells, count))
               for cells, count in air.by_room(VIEWPOINTS, air.at_half_height)]
    if not centres:
        return paper_viewpoints(scene)
    return np.concatenate(centres) @ air.map_from_walls


def validation_viewpoints(scene: Scene) -> np.ndarray:
    """
    Return 64 positions (V, 3), metres: one drawn in each of 64 equal parts of the air.

    They are at any height. If the room has fewer than 64 cells of air, all of them are returned,
    or the paper's five viewpoints if there is none. A floor of several rooms has about four times
    as many as :func:`air_viewpoints`, in each room.
    """
    air = air_cells_of(scene)
    if len(air.all) == 0:
        return paper_viewpoints(scene)
    if len(air.all) < VALIDATION_VIEWPOINTS:
        return air.all @ air.map_from_walls
    rng = np.random.default_rng(0)
    drawn = [cells[[rng.choice(part) for part in air.parts(cells, count)]]
             for cells, count in air.by_room(VALIDATION_VIEWPOINTS, air.all)]
    return np.concatenate(drawn) @ air.map_from_walls


class AirCells:
    """
    The cells of a room's air, in coordinates along its walls.

    Equal parts of them do not depend on random numbers or on the axes of the scan.

    :ivar at_half_height: (M, 3) metres, the cells of one layer.
    :ivar map_from_walls: (3, 3), for ``positions @ map_from_walls``.
    """

    def __init__(self, scene: Scene) -> None:
        angle = wall_direction(scene)
        aligned = turned(scene, -np.rad2deg(angle))
        self._rooms = aligned.rooms
        height = float(scene.bounds[:, 2].mean())
        air = Air(aligned, FreePlane.of(aligned.points, height, cameras=1, margin=0.0,
                                        clearance=0.0), centred=True)
        self.at_half_height, self._air = air.cells(height), air
        self.map_from_walls = rotation_matrix(angle).T
        # Each axis points to the end of the room with more points, so that a mirrored room gets
        # mirrored viewpoints.
        self._centre = aligned.bounds.mean(axis=0)
        self._signs = np.where(aligned.points.mean(axis=0) < self._centre, -1.0, 1.0)
        self._long_axis = int(aligned.size[1] > aligned.size[0])

    @cached_property
    def all(self) -> np.ndarray:
        """Return the cells of all heights: (A, 3) metres."""
        return self._air.cells()

    def by_room(self, least_count: int, cells: np.ndarray) -> Iterator[tuple[np.ndarray, int]]:
        """
        Yield some cells of each room, and the number of parts into which they are divided.

        :param least_count: the number of parts of a single room, and of all rooms at least.
        :param cells: (M, 3) metres, those to divide; in a room with too few of them, those of all
            heights are used. A room that still has too few yields nothing.
        """
        if self._rooms is None:
            cells = cells if len(cells) >= least_count else self.all
            if len(cells) >= least_count:
                yield cells, least_count
            return
        rooms, all_rooms = self._rooms.at(cells), self._rooms.at(self.all)
        areas = self._rooms.areas
        # More rooms have more viewpoints, since each stands for a part of the air in one room.
        part_area = min(areas.sum() / least_count,
                        VIEWPOINT_AREA_M2 * VIEWPOINTS / least_count)
        for room, area in enumerate(areas, start=1):
            count = int(np.ceil(area / part_area))
            chosen = cells[rooms == room]
            if len(chosen) < count:
                chosen = self.all[all_rooms == room]
            if len(chosen):
                yield chosen, min(count, len(chosen))

    def parts(self, cells: np.ndarray, count: int) -> list[np.ndarray]:
        """Divide cells (M, 3) into equal parts; see :func:`_equal_parts`."""
        return _equal_parts((cells - self._centre) * self._signs, self._long_axis, count)


@lru_cache(maxsize=1)
def air_cells_of(scene: Scene) -> AirCells:
    """Return the cells of a room's air; remember those of the last room."""
    return AirCells(scene)


def observed_viewpoints(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """
    Return viewpoints in a partially observed room, above the observed floor.

    In such a room, air cannot be distinguished yet from the space behind the walls, so viewpoints
    stand only above observed floor.

    :param points: (N, 3) metres, map frame: the observed points.
    :param corners: (4, 2) metres, the corners of the rectangle around them, from
        :func:`~ocp_ros.online.partial_map.smallest_rectangle`.
    :returns: (V, 3) float64, metres: 16 viewpoints, or the paper's five if the floor has fewer
        than 16 cells.
    """
    height = float(corners_of(points)[:, 2].mean())
    grid = FreePlane.of(points, height, cameras=1, margin=0.0, clearance=MIN_BALL_M).floor
    if grid is None or np.count_nonzero(grid.open) < VIEWPOINTS:
        return five_viewpoints(corners, height)
    # The centres of the open cells, which are over the observed floor.
    cells = grid.low + grid.edge * (np.argwhere(grid.open) + 0.5)
    # Corners 1 and 2 are the neighbours of corner 0.
    sides = corners[1:3] - corners[0]
    lengths = np.linalg.norm(sides, axis=1)
    along_sides = cells @ (sides / lengths[:, None]).T
    centres = _part_centres(cells, _equal_parts(along_sides, int(np.argmax(lengths)), VIEWPOINTS))
    return np.column_stack([centres, np.full(VIEWPOINTS, height)])


def _equal_parts(keys: np.ndarray, long_axis: int, count: int) -> list[np.ndarray]:
    """
    Divide cells into equal parts: in halves, again and again, across the largest variance.

    Ties are broken by the coordinates. An odd number of parts is divided into unequal halves.

    :param keys: (M, D) metres, the coordinates of M cells along the axes of the room.
    :param long_axis: the axis, 0 or 1, along which the room is longer.
    :param count: the number of parts, at most M.
    :returns: the indices of the cells of each part.
    """
    # Rounding errors must not decide between equal coordinates.
    sort_keys = keys.round(6)

    def divided(part: np.ndarray, count: int) -> list[np.ndarray]:
        if count == 1:
            return [part]
        variances = keys[part].var(axis=0)
        # The long axis is preferred: noise must not decide how square parts are cut.
        variances[long_axis] *= 1.3
        # Cells are sorted along the first of these axes; the next ones decide between cells
        # with equal coordinates.
        axes = [int(np.argmax(variances)), long_axis, 1 - long_axis, *range(2, keys.shape[1])]
        # lexsort takes the last key first.
        part = part[np.lexsort(sort_keys[part].T[axes[::-1]])]
        first_count = count // 2
        half = len(part) * first_count // count
        return divided(part[:half], first_count) + divided(part[half:], count - first_count)

    return divided(np.arange(len(keys)), count)


def _part_centres(cells: np.ndarray, parts: list[np.ndarray]) -> np.ndarray:
    """Return the cell (D,) nearest to the mean of each part of cells (M, D), metres."""
    means = [cells[part].mean(axis=0) for part in parts]
    return cells[np.argmin(distance.cdist(means, cells), axis=1)]


def paper_viewpoints(scene: Scene) -> np.ndarray:
    """Return the paper's viewpoints (5, 3), metres, in the rectangle along the room's walls."""
    angle = wall_direction(scene)
    axes = rotation_matrix(-angle)[:2, :2]
    # The rectangle in coordinates along the walls; ``@ axes`` leads back to the map frame.
    low, high = corners_of(scene.points[:, :2] @ axes.T)
    corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
    return five_viewpoints(corners @ axes, float(scene.bounds[:, 2].mean()))


def wall_direction(scene: Scene) -> float:
    """
    Return the angle of the walls to the x axis: radians, from about 0 to a right angle.

    It is 0 if no point is on a steep surface. Points on steep surfaces count as points of walls.
    """
    normals = scene.normals_or_estimate
    steep = np.abs(normals[:, 2]) <= STEEP
    if not steep.any():
        return 0.0
    angles = np.rad2deg(np.arctan2(normals[steep, 1], normals[steep, 0])) % 90.0
    # Each bin of the histogram of directions is a quarter of a degree wide.
    bin_deg, bin_count = 0.25, 360
    bins = np.round(angles / bin_deg).astype(int) % bin_count
    point_areas = scene.pitch[steep].astype(np.float64) ** 2
    bin_areas = np.bincount(bins, point_areas, bin_count)
    # A wall may fall into neighbouring bins; the last bin is a neighbour of the first.
    best = np.argmax(bin_areas + np.roll(bin_areas, 1) + np.roll(bin_areas, -1))
    # The result is the mean of the directions in these three bins: those within 1.5 bins of the
    # centre of the best bin. Offsets from it are wrapped to -45 up to 45 degrees.
    offsets = (angles - best * bin_deg + 45.0) % 90.0 - 45.0
    close = np.abs(offsets) <= 1.5 * bin_deg
    mean_offset = np.average(offsets[close], weights=point_areas[close])
    return float(np.deg2rad(best * bin_deg + mean_offset))
