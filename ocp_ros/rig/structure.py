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

"""Find the structure of a room in its points: floor, ceiling, walls and free space."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.clouds import CellGrid
from ocp_ros.geometry.normals import LEVEL, STEEP
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.scenes.scene import Scene
from scipy import ndimage
from scipy.spatial import cKDTree

#: Metres: the largest distance from its surface at which a camera still counts as mounted there.
MAX_MOUNT_GAP_M = 0.25
#: Metres: the distance of a mounted camera from the surface that it is mounted on.
STAND_OFF = 0.1
#: The number of points that define the plane of a surface.
PLANE_POINTS = 8
#: Metres: the thickness of a layer of points at the height of a floor.
LAYER_M = 0.1
#: The share of the height of a room from which an upright surface is a wall, which ends at the
#: ceiling even where the scan does not show its upper part.
WALL_SHARE = 0.75
#: Metres: the least radius of the ball that is moved through the air of a room.
MIN_BALL_M = 0.2


class Contact(NamedTuple):
    """
    The location of M positions relative to a surface.

    :ivar normals: (M, 3) unit vectors from the surface to the positions.
    :ivar distances: (M,) metres from the surface's plane; inf if there is no surface.
    """

    normals: np.ndarray
    distances: np.ndarray

    @property
    def on(self) -> np.ndarray:
        """Return whether positions are near enough to be mounted on the surface: (M,) bool."""
        return self.distances <= MAX_MOUNT_GAP_M

    def are_on_surface(self, indices: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        """
        Return whether points belong to the surface that a position is mounted on.

        :param indices: (L,) the indices of L of the positions.
        :param offsets: (L, P, 3) metres, the vectors from each of these positions to P points.
        :returns: (L, P) bool.
        """
        # The distance from the surface's plane, with a sign; k stands for x, y and z.
        plane_distance = (np.einsum('lpk,lk->lp', offsets, self.normals[indices])
                          + self.distances[indices, None])
        # Points within 8 cm of the plane of a surface belong to the surface.
        return self.on[indices, None] & (np.abs(plane_distance) <= 0.08)


@dataclass(frozen=True, eq=False)
class MountSurface:
    """
    The P points of a ceiling or of walls.

    :ivar points: (P, 3) metres, map frame.
    :ivar normals: (P, 3) unit vectors of either sign.
    :ivar gap: the largest distance between neighbouring points, metres; where neighbours are
        farther apart, the surface has a hole.
    """

    points: np.ndarray
    normals: np.ndarray
    gap: float

    @cached_property
    def _tree(self) -> cKDTree:
        """Return a search tree of the points."""
        return cKDTree(self.points)

    def at(self, positions: np.ndarray) -> Contact:
        """Return the location of M positions (M, 3), metres, relative to the surface."""
        if len(self.points) == 0:
            return Contact(np.zeros((len(positions), 3)), np.full(len(positions), np.inf))
        # V neighbours of each position. With k as an array, V is an axis also if it is 1.
        count = min(PLANE_POINTS, len(self.points))
        point_distance, index = self._tree.query(positions, k=np.arange(1, count + 1))
        # In subscripts: m is a position, v a neighbour, and k one of x, y and z.
        point_normals = self.normals[index].astype(np.float64)
        cosine = np.einsum('mvk,mk->mv', point_normals, point_normals[:, 0])
        # Only points with a normal similar to that of the nearest point define the plane. The
        # normal of the plane is the mean of their normals, all turned to the same side.
        used = (np.abs(cosine) >= 0.9) & (point_distance <= point_distance[:, :1] + self.gap)
        normals = np.einsum('mv,mvk->mk', np.sign(cosine) * used, point_normals)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        offsets = positions[:, None] - self.points[index]
        # The mean distance along the normal from the points that define the plane, with a sign.
        distances = np.einsum('mvk,mk,mv->m', offsets, normals, used) / used.sum(axis=1)
        # From now on, the normals point to the positions.
        normals *= np.where(distances < 0.0, -1.0, 1.0)[:, None]
        # There is a hole if the nearest point is too far away, or if its distance along the
        # surface (here squared, by Pythagoras) is more than half a gap.
        nearest = point_distance[:, 0]
        normal_distance = np.einsum('mk,mk->m', offsets[:, 0], normals)
        hole = (nearest > np.hypot(MAX_MOUNT_GAP_M, self.gap)) | (
            nearest ** 2 - normal_distance ** 2 > (0.5 * self.gap) ** 2)
        return Contact(normals, np.where(hole, np.inf, np.abs(distances)))

    def height_above(self, places: np.ndarray) -> np.ndarray:
        """
        Return the height of the ceiling above positions; the ceiling must have points.

        :param places: (M, 2), x and y of M positions, metres.
        :returns: (M,) z of the ceiling, metres; -inf where there is none.
        """
        # With k as an array, the results are (M, count) also if the count is 1.
        count = min(PLANE_POINTS, len(self.points))
        distance, index = self._plan_tree.query(places, k=np.arange(1, count + 1))
        height = np.median(self.points[index, 2], axis=1)
        return np.where(distance[:, 0] <= self.gap, height, -np.inf)

    @cached_property
    def _plan_tree(self) -> cKDTree:
        """Return a search tree of the points seen from above."""
        return cKDTree(self.points[:, :2])


def floor_height(scene: Scene) -> float:
    """
    Return the height of the floor: the level layer with the largest area low in a room.

    The lowest point is not used, since scans contain stray points and reflections below the floor.

    :returns: the median z of the points of this layer, metres, map frame; the lowest z of the room
        if no low point is level.
    """
    scene = scene.surveyed
    z = scene.points[:, 2]
    level = np.abs(scene.normals_or_estimate[:, 2]) >= LEVEL
    low, high = np.percentile(z, [0.1, 99.9])
    # The floor is in the lower 40 % of the height of a room.
    level &= z <= low + 0.4 * (high - low)
    if not level.any():
        return float(scene.bounds[0, 2])
    return _largest_layer(z[level], scene.pitch[level] ** 2)[0]


def _largest_layer(z: np.ndarray, areas: np.ndarray) -> tuple[float, float]:
    """
    Find the layer of thickness :data:`LAYER_M` with the largest area.

    :param z: (M,) the heights of level points, metres; one at least.
    :param areas: (M,) the area of each point, square metres.
    :returns: the median z of the layer's points, metres, and their area.
    """
    order = np.argsort(z)
    heights = z[order]
    # A layer begins at each point: ``ends`` is the index after the layer's last point.
    # ``area_below[i]`` is the area of the first i points.
    ends = np.searchsorted(heights, heights + LAYER_M, side='right')
    area_below = np.concatenate([[0.0], np.cumsum(areas[order])])
    layers = area_below[ends] - area_below[:-1]
    first = int(np.argmax(layers))
    return float(np.median(heights[first:ends[first]])), float(layers[first])


def gap_of(scene: Scene) -> float:
    """Return the largest distance of neighbouring points of a surface without holes, metres."""
    # Smaller gaps than 0.2 m are no holes, even in dense scans.
    return max(0.2, 2.0 * float(np.median(scene.pitch)))


class _Columns:
    """
    Square vertical columns of a scene, as wide as the gaps allowed in surfaces.

    :ivar low: (2,) metres, the lowest corner of the first column.
    :ivar edge: the edge of a column, metres.
    :ivar shape: (X, Y), the numbers of columns along x and y.
    """

    def __init__(self, scene: Scene) -> None:
        self.low = scene.bounds[0, :2]
        self.edge = gap_of(scene)
        self.shape = tuple(np.floor(scene.size[:2] / self.edge).astype(int) + 1)

    def indices(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the columns of points (M, 3): their indices along x (M,) and along y (M,)."""
        cells = np.floor((points[:, :2] - self.low) / self.edge).astype(int)
        x, y = np.clip(cells, 0, np.array(self.shape) - 1).T
        return x, y

    def highest(self, points: np.ndarray) -> np.ndarray:
        """Return the highest z of points (M, 3) in each column: (X, Y); -inf without points."""
        top = np.full(self.shape, -np.inf)
        np.maximum.at(top, self.indices(points), points[:, 2])
        return top


class FloorLevel(NamedTuple):
    """
    A floor at one height.

    :ivar z: metres, map frame.
    :ivar area: square metres that the scan shows.
    """

    z: float
    area: float


@dataclass(frozen=True, eq=False)
class Floors:
    """
    The floors of a room: one, or several as in a split level, with a stage or with a sunken part.

    :ivar levels: the floors from the lowest to the highest.
    :ivar height: z of the largest floor, metres, map frame.
    :ivar columns: the columns of the room.
    :ivar under_columns: (X, Y) z of the floor in each column, metres.
    """

    levels: tuple[FloorLevel, ...]
    height: float
    columns: _Columns
    under_columns: np.ndarray

    def under(self, positions: np.ndarray) -> np.ndarray:
        """Return z of the floor below positions (M, 2 or 3), metres: (M,) metres."""
        return self.under_columns[self.columns.indices(positions)]


@lru_cache(maxsize=1)
def floors_of(scene: Scene) -> Floors:
    """
    Find the floors of a room; remember those of the last room.

    A floor beside the largest one has at least 5 square metres, is at least 1.8 m wide and has no
    other level surface below it, contrary to tables and shelves. On a slope there is one floor.
    """
    # Heights that differ less are the unevenness of one floor.
    min_step_m, min_area_m2, min_width_m, max_hidden_share = 1.5 * LAYER_M, 5.0, 1.8, 0.3
    columns, height = _Columns(scene), floor_height(scene)
    low, high = np.percentile(scene.points[:, 2], [0.1, 99.9])
    used = np.abs(scene.normals_or_estimate[:, 2]) >= LEVEL
    # Floors are in the lower half of the height of a room.
    used &= scene.points[:, 2] <= low + 0.5 * (high - low)
    points, areas = scene.points[used], scene.pitch[used] ** 2
    x, y = columns.indices(points)

    def columns_with(chosen: np.ndarray) -> np.ndarray:
        """Return which columns have chosen points: (X, Y) bool."""
        cells = np.zeros(columns.shape, dtype=bool)
        cells[x[chosen], y[chosen]] = True
        return cells

    at_height = np.abs(points[:, 2] - height) <= LAYER_M
    levels = [FloorLevel(height, float(areas[at_height].sum()))]
    # In columns: z of the floor; NaN where it is not known yet.
    floor = np.where(columns_with(at_height), height, np.nan)
    rest = np.abs(points[:, 2] - height) > min_step_m
    radius = 0.5 * min_width_m / columns.edge
    offsets = np.arange(-int(radius), int(radius) + 1)
    disc = np.hypot.outer(offsets, offsets) <= radius
    while rest.any():
        z, area = _largest_layer(points[rest, 2], areas[rest])
        if area < min_area_m2:
            break
        distance = np.abs(points[:, 2] - z)
        layer = distance <= 0.5 * LAYER_M
        # A slope has as much area just above and below as in the layer itself.
        is_level = area > 0.6 * areas[rest & (distance <= min_step_m)].sum()
        cells = ndimage.binary_closing(columns_with(layer), np.ones((3, 3)))
        parts, count = ndimage.label(cells)
        wide = ndimage.binary_opening(cells, disc)
        others = columns_with((points[:, 2] < z - min_step_m) | at_height)
        for part in range(1, count + 1 if is_level else 1):
            cells = parts == part
            part_area = float(areas[layer & cells[x, y]].sum())
            if (part_area >= min_area_m2 and wide[cells].any()
                    and others[cells].mean() <= max_hidden_share):
                levels.append(FloorLevel(z, part_area))
                floor[cells] = z
        rest &= distance > LAYER_M
    # Elsewhere, as below furniture, the nearest floor counts.
    nearest = ndimage.distance_transform_edt(np.isnan(floor), return_distances=False,
                                             return_indices=True)
    floor = np.full(columns.shape, height) if len(levels) == 1 else floor[tuple(nearest)]
    return Floors(tuple(sorted(levels)), height, columns, floor)


def ceiling_of(scene: Scene) -> MountSurface:
    """
    Find the ceiling: level surfaces above head height with nothing higher around them.

    :returns: the points of the ceiling; empty if the scan has none.
    """
    columns = _Columns(scene)
    # For each point, the highest point in its column and in the eight columns around.
    top = ndimage.maximum_filter(columns.highest(scene.points), 3)[columns.indices(scene.points)]
    z = scene.points[:, 2]
    floor = floor_height(scene)
    height = np.percentile(z, 99.0) - floor
    # Level points count as ceiling if they are at most 25 cm below the highest point around, and
    # at least 2 m above the floor; in rooms lower than 2.5 m, 80 % of the height is enough.
    upward = np.abs(scene.normals_or_estimate[:, 2])
    highest = (z >= top - 0.25) & (z >= floor + min(2.0, 0.8 * height))
    chosen = highest & (upward >= LEVEL)
    # Under a steep roof most of what is highest is steeper.
    if np.count_nonzero(chosen) < 0.3 * np.count_nonzero(highest & (upward >= 0.5)):
        chosen = highest & (upward >= 0.5)
    return _surface(scene, chosen, scene.normals_or_estimate)


def walls_of(scene: Scene) -> MountSurface:
    """
    Find the walls: upright surfaces up to the ceiling, which furniture hardly reaches.

    :returns: the points of the walls with level normals; empty if the scan has no walls.
    """
    columns = _Columns(scene)
    # In columns: the highest point around a wall is searched for within about 0.4 m.
    radius = int(np.ceil(0.4 / columns.edge))
    top = ndimage.maximum_filter(columns.highest(scene.points), 2 * radius + 1)
    floor = floor_height(scene)
    # Only surfaces that reach 80 % of the height of the room count as walls.
    min_top = floor + 0.8 * (np.percentile(scene.points[:, 2], 99.0) - floor)
    # The top of a wall may lie up to half a metre below the highest point around it.
    return _upright_surfaces(scene, columns, np.maximum(top - 0.5, min_top))


def standing_of(scene: Scene) -> MountSurface:
    """
    Find standing obstacles of at least a metre: walls, fences, partitions, cupboards.

    :returns: the upright points of the obstacles with level normals; empty if there are none.
    """
    # In a room lower than a metre, obstacles reach the top of the room.
    min_top = min(floor_height(scene) + 1.0, np.percentile(scene.points[:, 2], 99.0))
    columns = _Columns(scene)
    return _upright_surfaces(scene, columns, np.full(columns.shape, min_top))


def hidden_walls(scene: Scene) -> np.ndarray:
    """
    Return points of the parts of walls below the ceiling that the scan does not show.

    An upright surface that reaches :data:`WALL_SHARE` of the height of the ceiling above it is
    taken for a wall, which reaches the ceiling itself.

    :returns: (H, 3) metres, points above the scanned ones, 0.1 m apart; there may be none.
    """
    step_m, floor, columns = 0.1, floor_height(scene), _Columns(scene)
    points = scene.points[np.abs(scene.normals_or_estimate[:, 2]) <= STEEP]
    # For each point, the upper end of its wall, and the highest point around it.
    top = columns.highest(points)[columns.indices(points)]
    ceiling = ndimage.maximum_filter(columns.highest(scene.points), 3)[columns.indices(points)]
    # The points of the uppermost 0.3 m of each wall are repeated above it.
    chosen = ((top - floor >= WALL_SHARE * (ceiling - floor)) & (top < ceiling - 2.0 * step_m)
              & (points[:, 2] >= top - 0.3))
    counts = np.floor((ceiling - points[:, 2])[chosen] / step_m).astype(int)
    repeated = np.repeat(points[chosen], counts, axis=0)
    numbers = np.arange(len(repeated)) - np.repeat(np.cumsum(counts) - counts, counts)
    repeated[:, 2] += step_m * (numbers + 1)
    return repeated


def _upright_surfaces(scene: Scene, columns: _Columns, min_top: np.ndarray) -> MountSurface:
    """Find upright surfaces that reach a height in their column: ``min_top`` (X, Y), z, metres."""
    steep = np.abs(scene.normals_or_estimate[:, 2]) <= STEEP
    high_enough = columns.highest(scene.points[steep]) >= min_top
    chosen = steep & high_enough[columns.indices(scene.points)]
    return _surface(scene, chosen, scene.normals_or_estimate * np.array([1.0, 1.0, 0.0]))


def _surface(scene: Scene, chosen: np.ndarray, normals: np.ndarray) -> MountSurface:
    """
    Return chosen points of a scene as a surface; empty if their area is below a square metre.

    :param chosen: (N,) bool, for the N points of the scene.
    :param normals: (N, 3) their normals, of any length.
    """
    if (scene.pitch[chosen] ** 2).sum() < 1.0:
        chosen = np.zeros_like(chosen)
    normals = normals[chosen]
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return MountSurface(scene.points[chosen], normals, gap_of(scene))


class Air:
    """
    The air of a room: the largest connected space through which a ball can be moved.

    The air of a floor is that of all its rooms, since doors may be closed.

    The remaining space is inside or behind furniture. The distance to the nearest point does not
    separate inside from outside, since scans show only the outside of objects.

    :param scene: the room.
    :param space: the positions over the floor.
    :param centred: whether the grid is centred on the room, so that a mirrored room has mirrored
        cells.
    :ivar grid: the cells of the room.
    :ivar ball: the radius of the ball, metres.
    """

    def __init__(self, scene: Scene, space: FreePlane, centred: bool = False) -> None:
        self.grid = CellGrid.over(scene.bounds, centred)
        edge, shape = self.grid.edge, self.grid.shape
        # The ball must not fit through the gaps between the points of a surface.
        self.ball = max(MIN_BALL_M, 1.5 * float(np.median(scene.pitch)))
        free = ndimage.distance_transform_edt(~self.grid.taken(scene.points)) * edge > self.ball
        # Only cells over the floor are air.
        centres = [self.grid.low[k] + edge * (np.arange(shape[k]) + 0.5) for k in (0, 1)]
        centres_xy = np.stack(np.meshgrid(*centres, indexing='ij'), axis=-1)
        free &= space.contains(centres_xy)[..., None]
        # Label 0 is that of the cells that are not free; it is left out of the sizes, so that 1 is
        # added to the index of the largest. No cell has the label -1.
        parts, count = ndimage.label(free)
        largest = int(np.argmax(np.bincount(parts.ravel())[1:])) + 1 if count else -1
        self._free = parts == largest
        if scene.rooms is not None and count:
            columns = scene.rooms.at(centres_xy.reshape(-1, 2)).reshape(shape[:2])
            for room in range(1, scene.rooms.count + 1):
                sizes = np.bincount(parts[columns == room].ravel(), minlength=2)
                # The largest part in the room; 0 is what is not free.
                self._free |= parts == int(np.argmax(sizes[1:])) + 1
        # The distance of each cell from the air, metres; 0 if there is no air, so that no position
        # counts as closed.
        self._distance = (edge * ndimage.distance_transform_edt(~self._free) if count
                          else np.zeros(shape))

    def cells(self, height: float | None = None) -> np.ndarray:
        """
        Return the centres of the cells of the air.

        :param height: z, metres, for the cells at this height only; None for all cells.
        :returns: (M, 3) metres; z is ``height`` if it is given.
        """
        if height is None:
            return self.grid.middles(np.argwhere(self._free))
        low, edge = self.grid.low, self.grid.edge
        level = int(np.clip((height - low[2]) / edge, 0, self._free.shape[2] - 1))
        centres_xy = low[:2] + edge * (np.argwhere(self._free[:, :, level]) + 0.5)
        return np.column_stack([centres_xy, np.full(len(centres_xy), height)])

    def closed(self, positions: np.ndarray) -> np.ndarray:
        """Return whether positions (M, 3), metres, are out of reach of the ball: (M,) bool."""
        distance = self._distance[tuple(self.grid.cells(positions))]
        # In a corner of three surfaces, a position that is 0.5 * MIN_BALL_M away from each of them
        # is this far from the nearest centre of a ball that fits there.
        corner_distance = np.sqrt(3.0) * (self.ball - 0.5 * MIN_BALL_M)
        # A cell is added to the ball's radius, since distances are known to about a cell.
        return distance > max(self.ball + self.grid.edge, corner_distance)
