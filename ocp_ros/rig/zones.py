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

"""Zones, which are parts of a room: boxes, and polygons between two heights."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from ocp_ros.util.yaml_files import describe, Document, Way

#: Metres: positions moved into a zone keep this distance from its faces, ten times the rounding of
#: files.
INSET_M = 0.001


@dataclass(frozen=True, eq=False)
class Zone:
    """
    A part of a room.

    :ivar low: (3,) metres, the lowest corner of the bounding box.
    :ivar high: (3,) metres, its highest corner.
    :ivar polygon: (P, 2) metres, the P corners seen from above; None for a box.
    :ivar above_floor: whether heights are relative to the floor instead of the map frame.
    """

    low: np.ndarray
    high: np.ndarray
    polygon: np.ndarray | None = None
    above_floor: bool = False

    def corners(self, floor: float) -> np.ndarray:
        """Return the bounding box (2, 3), metres, map frame, given z of the floor, metres."""
        return np.stack([self.low, self.high]) + [0.0, 0.0, floor if self.above_floor else 0.0]

    def contains(self, points: np.ndarray, floor: float) -> np.ndarray:
        """
        Return whether points are inside; the faces of a box belong to it.

        :param points: (M, 3), M points, metres, map frame.
        :param floor: z of the floor, metres, map frame.
        :returns: (M,) bool.
        """
        low, high = self.corners(floor)
        inside = ((points >= low) & (points <= high)).all(axis=1)
        if self.polygon is not None:
            inside[inside] = _in_polygon(points[inside, :2], self.polygon)
        return inside

    def nearest(self, points: np.ndarray, floor: float) -> np.ndarray:
        """
        Return points moved into the zone, each to about the nearest position there.

        :param points: (M, 3), M points, metres, map frame.
        :param floor: z of the floor, metres, map frame.
        :returns: (M, 3) metres, a millimetre from the faces; points farther inside stay.
        """
        low, high = self.corners(floor)
        inset = np.minimum(INSET_M, 0.5 * (high - low))
        moved = np.clip(points, low + inset, high - inset)
        if self.polygon is not None:
            outside = ~_in_polygon(moved[:, :2], self.polygon)
            moved[outside, :2] = _moved_across_edge(moved[outside, :2], self.polygon)
        return moved


def _moved_across_edge(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return points (M, 2) moved to the nearest edge of a polygon (P, 2), a millimetre across."""
    edges = np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(edges, axis=1)
    # The nearest position on each edge, as a share of the edge; k stands for x and y.
    share = np.einsum('mpk,pk->mp', points[:, None] - corners, edges) / length ** 2
    on_edges = corners + np.clip(share, 0.0, 1.0)[..., None] * edges
    edge = np.argmin(np.linalg.norm(on_edges - points[:, None], axis=2), axis=1)
    nearest = on_edges[np.arange(len(points)), edge]
    offset = nearest - points
    distance = np.linalg.norm(offset, axis=1, keepdims=True)
    # The maximum avoids a division by 0 for points on the edge.
    return nearest + INSET_M * offset / np.maximum(distance, INSET_M)


def moved_into_nearest(zones: Sequence[Zone], points: np.ndarray, floor: float) -> np.ndarray:
    """
    Return points moved into the nearest of some zones; see :meth:`Zone.nearest`.

    :param points: (M, 3), M points, metres, map frame.
    :param floor: z of the floor, metres, map frame.
    :returns: (M, 3) metres.
    """
    moved = np.stack([zone.nearest(points, floor) for zone in zones])
    distance = np.linalg.norm(moved - points, axis=2)
    return moved[np.argmin(distance, axis=0), np.arange(len(points))]


def grid_positions(zones: Sequence[Zone], low: np.ndarray, high: np.ndarray, floor: float,
                   max_count: int, one_level: bool) -> np.ndarray:
    """
    Return the positions of regular grids in the zones within a box.

    :param low: (3,) metres, map frame, the lowest corner of the box.
    :param high: (3,) metres, its highest corner.
    :param floor: z of the floor, metres, map frame.
    :param max_count: the largest number of positions; the grid of each zone has at most an equal
        share of it, or one position.
    :param one_level: whether all positions of a zone have the same height.
    :returns: (P, 3) metres.
    """
    positions = [np.empty((0, 3))]
    for zone in zones:
        lowest, highest = zone.corners(floor)
        lowest = np.maximum(lowest, low)
        size = np.minimum(highest, high) - lowest
        if (size < 0.0).any():
            continue
        # The step grows until the grid is small enough. The first counts only start the loop.
        step_m = 0.1
        counts = np.full(3, max_count)
        while counts.prod() > max(max_count / len(zones), 1):
            counts = np.maximum(np.ceil(size / step_m), 1).astype(int)
            counts[2] = 1 if one_level else counts[2]
            step_m *= 1.2
        cells = np.stack(np.meshgrid(*map(np.arange, counts), indexing='ij'), axis=-1)
        grid = lowest + size * (cells.reshape(-1, 3) + 0.5) / counts
        positions.append(grid[zone.contains(grid, floor)])
    return np.concatenate(positions)


def _in_polygon(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return whether points (M, 2) are in a polygon (P, 2): (M,) bool."""
    x, y = points[:, :1], points[:, 1:]
    (x0, y0), (x1, y1) = corners.T, np.roll(corners, -1, axis=0).T
    # The ray from an inner point along x crosses an odd number of edges.
    crosses_line = (y0 > y) != (y1 > y)
    # An edge along x divides by 0, but the ray does not cross it.
    with np.errstate(divide='ignore', invalid='ignore'):
        ahead = x < x0 + (y - y0) * (x1 - x0) / (y1 - y0)
    return np.count_nonzero(crosses_line & ahead, axis=1) % 2 == 1


def _crosses_itself(corners: np.ndarray) -> bool:
    """Return whether two edges of a polygon (P, 2) cross; touching is allowed."""
    edges = np.roll(corners, -1, axis=0) - corners
    offsets = corners[None] - corners[:, None]
    # For each edge, the side of its line on which each corner is.
    side = np.sign(edges[:, :1] * offsets[..., 1] - edges[:, 1:] * offsets[..., 0])
    # Whether the line of an edge separates the ends of another edge.
    separated = side * np.roll(side, -1, axis=1) < 0.0
    return bool((separated & separated.T).any())


def zones_of(document: Document, key: str) -> tuple[Zone, ...]:
    """Read the zones of the list under a key; empty if there is no such list."""
    return tuple(zone_of(document, (key, k)) for k in range(len(document.data.get(key, ()))))


def zone_of(document: Document, keys: Way) -> Zone:
    """
    Read a zone.

    :param keys: the keys that lead to the zone in the document.
    :raises ConfigurationError: if there is not exactly one box or polygon, or it has no inside.
    """
    data = document.value(*keys)
    if ('box' in data) == ('polygon' in data):
        found = 'a box and a polygon' if 'box' in data else 'no box and no polygon'
        raise document.error(keys, found, 'one of the two', 'write, for example, '
                             'box: [[0, 0, 0], [1, 1, 3]]')
    if 'box' in data:
        if 'height' in data:
            raise document.error((*keys, 'height'), 'a height beside a box', 'it for a polygon '
                                 'only', "remove it: a box's corners have z")
        low, high = np.array(data['box'], dtype=np.float64)
        if not (low < high).all():
            raise document.error((*keys, 'box'), describe(data['box']), 'the lowest corner first '
                                 'and the highest after it, all coordinates apart', 'exchange or '
                                 'correct those that are not')
        return Zone(low, high)
    corners = np.array(data['polygon'], dtype=np.float64)
    if _crosses_itself(corners):
        raise document.error((*keys, 'polygon'), 'edges that cross each other', 'a polygon whose '
                             'edges do not', 'write its corners one after the other, round it '
                             'once')
    x, y = corners.T
    # The area is half of this; below 1e-6 square metres, a polygon has no inside.
    if abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) < 2.0 * 1e-6:
        raise document.error((*keys, 'polygon'), 'corners on one line', 'a polygon with an area',
                             'write its corners one after the other, round it once')
    bottom, top = data.get('height', (-np.inf, np.inf))
    if not bottom < top:
        raise document.error((*keys, 'height'), describe(data['height']), 'the lower height first '
                             'and a greater one after it', f'write [{top:g}, {bottom:g}]'
                             if top < bottom else 'raise the second')
    return Zone(np.array([*corners.min(axis=0), bottom]), np.array([*corners.max(axis=0), top]),
                corners, above_floor=True)
