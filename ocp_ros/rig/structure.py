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
from functools import cached_property
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.normals import LEVEL, STEEP
from ocp_ros.geometry.voxels import CellGrid
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.scenes.scene import Scene
from scipy import ndimage
from scipy.spatial import cKDTree

#: Metres: the largest distance from its surface at which a camera still counts as mounted there.
MAX_MOUNT_GAP_M = 0.25
#: Metres: the distance of a mounted camera from its surface.
STAND_OFF = 0.1
#: The number of points that define the plane of a surface.
PLANE_POINTS = 8
#: Metres: the thickness of a floor.
LAYER_M = 0.1
#: Metres: the least radius of the ball that is moved through the air of a room.
MIN_BALL_M = 0.2


class Contact(NamedTuple):
    """
    The location of positions relative to a surface.

    :ivar normals: (M, 3) unit vectors from the surface to the positions.
    :ivar distances: (M,) metres from the surface's plane; inf if there is no surface.
    """

    normals: np.ndarray
    distances: np.ndarray

    @property
    def on(self) -> np.ndarray:
        """Return which positions are near enough to be mounted on the surface: (M,) bool."""
        return self.distances <= MAX_MOUNT_GAP_M

    def own(self, which: np.ndarray, ways: np.ndarray) -> np.ndarray:
        """
        Return which points belong to the surface that a position is mounted on.

        :param which: (L,) positions by number.
        :param ways: (L, P, 3) metres, the vectors from each position to the points near it.
        :returns: (L, P) bool.
        """
        off = np.einsum('lpk,lk->lp', ways, self.normals[which]) + self.distances[which, None]
        # Points within 8 cm of the plane of a surface belong to the surface.
        return self.on[which, None] & (np.abs(off) <= 0.08)


@dataclass(frozen=True, eq=False)
class MountSurface:
    """
    The points of a ceiling or of walls.

    :ivar points: (P, 3) metres, map frame.
    :ivar normals: (P, 3) unit vectors of either sign.
    :ivar gap: the largest distance between neighbours, metres; where it is larger, the surface has
        a hole.
    """

    points: np.ndarray
    normals: np.ndarray
    gap: float

    @cached_property
    def _tree(self) -> cKDTree:
        """Return a tree of the points."""
        return cKDTree(self.points)

    def at(self, positions: np.ndarray) -> Contact:
        """Return the location of positions (M, 3), metres, relative to the surface."""
        if len(self.points) == 0:
            return Contact(np.zeros((len(positions), 3)), np.full(len(positions), np.inf))
        count = min(PLANE_POINTS, len(self.points))
        away, index = self._tree.query(positions, k=np.arange(1, count + 1))
        normals = self.normals[index].astype(np.float64)
        along = np.einsum('mvk,mk->mv', normals, normals[:, 0])
        # Only points with a similar normal define the plane.
        votes = (np.abs(along) >= 0.9) & (away <= away[:, :1] + self.gap)
        normal = np.einsum('mv,mvk->mk', np.sign(along) * votes, normals)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        ways = positions[:, None] - self.points[index]
        distances = np.einsum('mvk,mk,mv->m', ways, normal, votes) / votes.sum(axis=1)
        normal *= np.where(distances < 0.0, -1.0, 1.0)[:, None]
        # The surface that a camera is screwed to is behind it, not beside it.
        off = np.einsum('mk,mk->m', ways[:, 0], normal)
        hole = (away[:, 0] > np.hypot(MAX_MOUNT_GAP_M, self.gap)) | (
            away[:, 0] ** 2 - off ** 2 > (0.5 * self.gap) ** 2)
        return Contact(normal, np.where(hole, np.inf, np.abs(distances)))

    def height_above(self, places: np.ndarray) -> np.ndarray:
        """
        Return the height of the ceiling above positions.

        :param places: (M, 2) metres.
        :returns: (M,) z, metres; -inf if there is no ceiling.
        """
        count = min(PLANE_POINTS, len(self.points))
        away, index = self._plan.query(places, k=np.arange(1, count + 1))
        height = np.median(self.points[index, 2], axis=1)
        return np.where(away[:, 0] <= self.gap, height, -np.inf)

    @cached_property
    def _plan(self) -> cKDTree:
        """Return a tree of the points seen from above."""
        return cKDTree(self.points[:, :2])


def floor_height(scene: Scene) -> float:
    """
    Find the floor: the fullest level layer in the lower part of a room.

    The lowest point is not used, since scans contain stray points and reflections below the floor.

    :returns: z of the middle of this layer, metres, map frame.
    """
    z, level = scene.points[:, 2], np.abs(scene.normals_or_estimate[:, 2]) >= LEVEL
    low, high = np.percentile(z, [0.1, 99.9])
    # The floor is in the lower 40 % of the height of a room.
    level &= z <= low + 0.4 * (high - low)
    if not level.any():
        return float(scene.bounds[0, 2])
    heights, areas = np.sort(z[level]), scene.pitch[level][np.argsort(z[level])] ** 2
    above = np.searchsorted(heights, heights + LAYER_M, side='right')
    total = np.concatenate([[0.0], np.cumsum(areas)])
    first = int(np.argmax(total[above] - total[:-1]))
    return float(np.median(heights[first:above[first]]))


def gap_of(scene: Scene) -> float:
    """Return the largest distance of neighbouring points of a closed surface, metres."""
    # Metres: the least edge of the columns in which a ceiling or wall is searched for.
    return max(0.2, 2.0 * float(np.median(scene.pitch)))


class _Columns:
    """The highest points of a scene in square columns, which are as wide as the allowed gaps."""

    def __init__(self, scene: Scene) -> None:
        self.low = scene.bounds[0, :2]
        self.edge = gap_of(scene)
        self.shape = tuple(np.floor(scene.size[:2] / self.edge).astype(int) + 1)

    def of(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the column of each point: two arrays of indices (M,)."""
        cells = np.floor((points[:, :2] - self.low) / self.edge).astype(int)
        x, y = np.clip(cells, 0, np.array(self.shape) - 1).T
        return x, y

    def highest(self, points: np.ndarray) -> np.ndarray:
        """Return the highest z in each column; -inf where there are no points."""
        top = np.full(self.shape, -np.inf)
        np.maximum.at(top, self.of(points), points[:, 2])
        return top


def ceiling_of(scene: Scene) -> MountSurface:
    """
    Find the ceiling: level surfaces above head height with nothing higher around them.

    :returns: its points; empty if the scan has no ceiling.
    """
    points, columns = scene.points, _Columns(scene)
    top = ndimage.maximum_filter(columns.highest(points), 3)[columns.of(points)]
    floor = floor_height(scene)
    height = np.percentile(points[:, 2], 99.0) - floor
    # A ceiling is at least 2 m high, or as high as 80 % of the room.
    chosen = ((np.abs(scene.normals_or_estimate[:, 2]) >= LEVEL)
              & (points[:, 2] >= top - 0.25)
              & (points[:, 2] >= floor + min(2.0, 0.8 * height)))
    return _surface(scene, chosen, scene.normals_or_estimate)


def walls_of(scene: Scene) -> MountSurface:
    """
    Find the walls: upright surfaces up to the ceiling, which furniture hardly reaches.

    :returns: their points with level normals.
    """
    columns = _Columns(scene)
    around = int(np.ceil(0.4 / columns.edge))
    top = ndimage.maximum_filter(columns.highest(scene.points), 2 * around + 1)
    floor = floor_height(scene)
    # Walls reach at least 80 % of the height of the room.
    high = floor + 0.8 * (np.percentile(scene.points[:, 2], 99.0) - floor)
    # The top of a wall lies up to half a metre below the highest point around it.
    return _upright(scene, columns, np.maximum(top - 0.5, high))


def standing_of(scene: Scene) -> MountSurface:
    """
    Find standing obstacles of at least a metre: walls, fences, partitions, cupboards.

    :returns: their upright points with level normals.
    """
    # A standing obstacle is a metre high, such as a knee wall, a fence or a cupboard.
    high = min(floor_height(scene) + 1.0, np.percentile(scene.points[:, 2], 99.0))
    columns = _Columns(scene)
    return _upright(scene, columns, np.full(columns.shape, high))


def _upright(scene: Scene, columns: _Columns, least: np.ndarray) -> MountSurface:
    """Find upright surfaces that reach a height, given as z in metres by column."""
    steep = np.abs(scene.normals_or_estimate[:, 2]) <= STEEP
    high = columns.highest(scene.points[steep]) >= least
    chosen = steep & high[columns.of(scene.points)]
    return _surface(scene, chosen, scene.normals_or_estimate * np.array([1.0, 1.0, 0.0]))


def _surface(scene: Scene, chosen: np.ndarray, normals: np.ndarray) -> MountSurface:
    """Return some points of a scene as a surface; empty if their area is too small."""
    if (scene.pitch[chosen] ** 2).sum() < 1.0:
        chosen = np.zeros_like(chosen)
    normals = normals[chosen]
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return MountSurface(scene.points[chosen], normals, gap_of(scene))


class Air:
    """
    The air of a room: the largest connected space through which a ball can be moved.

    The remaining space is inside or behind furniture. The distance to the nearest point does not
    separate the two, since scans show only the outside of objects.

    :param scene: the room.
    :param space: the space with floor.
    :param centred: whether the grid is centred on the room, so that a mirrored room has mirrored
        cells.
    """

    def __init__(self, scene: Scene, space: FreePlane, centred: bool = False) -> None:
        self.grid = CellGrid.over(scene.bounds, centred)
        edge, shape = self.grid.edge, self.grid.shape
        # The ball must not fit through the gaps between the points of a surface.
        self.ball = max(MIN_BALL_M, 1.5 * float(np.median(scene.pitch)))
        free = ndimage.distance_transform_edt(~self.grid.taken(scene.points)) * edge > self.ball
        middles = [self.grid.low[k] + edge * (np.arange(shape[k]) + 0.5) for k in (0, 1)]
        columns = np.stack(np.meshgrid(*middles, indexing='ij'), axis=-1)
        free &= space.contains(columns)[..., None]
        parts, count = ndimage.label(free)
        #: Whether there is any free cell.
        self._found = count > 0
        largest = int(np.argmax(np.bincount(parts.ravel())[1:])) + 1 if count else 0
        self._away = edge * ndimage.distance_transform_edt(
            parts != largest) if count else np.zeros(shape)

    def cells(self, height: float | None = None) -> np.ndarray:
        """
        Return the centres of the cells of the air: (M, 3) metres.

        :param height: z of the cells, metres; None for the cells of all heights.
        """
        free = self._away == 0.0 if self._found else np.zeros(self._away.shape, dtype=bool)
        if height is None:
            return self.grid.middles(np.argwhere(free))
        low, edge = self.grid.low, self.grid.edge
        level = int(np.clip((height - low[2]) / edge, 0, free.shape[2] - 1))
        flat = low[:2] + edge * (np.argwhere(free[:, :, level]) + 0.5)
        return np.column_stack([flat, np.full(len(flat), height)])

    def closed(self, positions: np.ndarray) -> np.ndarray:
        """Return which positions (M, 3), metres, the ball does not come near: (M,) bool."""
        away = self._away[tuple(self.grid.cells(positions))]
        # In a corner of three walls the ball's centre stays root 3 radii away.
        corner = np.sqrt(3.0) * (self.ball - 0.5 * MIN_BALL_M)
        return away > max(self.ball + self.grid.edge, corner)
