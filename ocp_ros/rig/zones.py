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

#: Metres: positions moved into a zone keep this distance from its faces; files round to a tenth of
#: it.
INSET_M = 0.001


@dataclass(frozen=True, eq=False)
class Zone:
    """
    A part of a room.

    :ivar low: (3,) metres, lowest corner of the box around it.
    :ivar high: (3,) metres, highest corner.
    :ivar polygon: (P, 2) metres, its corners seen from above; None for a box.
    :ivar above_floor: whether its heights are relative to the floor instead of the map frame.
    """

    low: np.ndarray
    high: np.ndarray
    polygon: np.ndarray | None = None
    above_floor: bool = False

    def corners(self, floor: float) -> np.ndarray:
        """Return its bounding box, given the height of the floor: (2, 3) metres, map frame."""
        return np.stack([self.low, self.high]) + [0.0, 0.0, floor if self.above_floor else 0.0]

    def contains(self, points: np.ndarray, floor: float) -> np.ndarray:
        """
        Return which points are inside; the faces of a box belong to it.

        :param points: (M, 3) metres, map frame.
        :param floor: height of the floor, metres, map frame.
        :returns: (M,) bool.
        """
        low, high = self.corners(floor)
        inside = ((points >= low) & (points <= high)).all(axis=1)
        if self.polygon is not None:
            inside[inside] = _in_polygon(points[inside, :2], self.polygon)
        return inside

    def nearest(self, points: np.ndarray, floor: float) -> np.ndarray:
        """
        Move points into the zone, each to approximately the nearest position there.

        :param points: (M, 3) metres, map frame.
        :param floor: height of the floor, metres, map frame.
        :returns: (M, 3), a millimetre from the faces; points inside stay.
        """
        low, high = self.corners(floor)
        inset = np.minimum(INSET_M, 0.5 * (high - low))
        moved = np.clip(points, low + inset, high - inset)
        if self.polygon is not None:
            out = ~_in_polygon(moved[:, :2], self.polygon)
            moved[out, :2] = _onto_edge(moved[out, :2], self.polygon)
        return moved


def _onto_edge(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Move points (M, 2) to the nearest edge of a polygon, and a millimetre across it."""
    along = np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(along, axis=1)
    share = np.einsum('mpk,pk->mp', points[:, None] - corners, along) / length ** 2
    on_edge = corners + np.clip(share, 0.0, 1.0)[..., None] * along
    edge = np.argmin(np.linalg.norm(on_edge - points[:, None], axis=2), axis=1)
    found = on_edge[np.arange(len(points)), edge]
    way = found - points
    return found + INSET_M * way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), INSET_M)


def nearest_of(zones: Sequence[Zone], points: np.ndarray, floor: float) -> np.ndarray:
    """Move points (M, 3), metres, into the nearest of some zones; see :meth:`Zone.nearest`."""
    moved = np.stack([zone.nearest(points, floor) for zone in zones])
    away = np.linalg.norm(moved - points, axis=2)
    return moved[np.argmin(away, axis=0), np.arange(len(points))]


def lattice_of(zones: Sequence[Zone], low: np.ndarray, high: np.ndarray, floor: float, most: int,
               flat: bool) -> np.ndarray:
    """
    Fill the zones within a box with positions: (P, 3) metres, about ``most`` of them.

    :param low: (3,) metres, map frame, lowest corner of the box.
    :param high: (3,) metres, its highest corner.
    :param flat: whether one level is enough.
    """
    found = [np.empty((0, 3))]
    for zone in zones:
        lowest, highest = zone.corners(floor)
        lowest = np.maximum(lowest, low)
        size = np.minimum(highest, high) - lowest
        if (size < 0.0).any():
            continue
        step, count = 0.1, np.full(3, most)
        while count.prod() > max(most / len(zones), 1):
            count = np.maximum(np.ceil(size / step), 1).astype(int)
            count[2] = 1 if flat else count[2]
            step *= 1.2
        places = lowest + size * (np.stack(np.meshgrid(*map(np.arange, count), indexing='ij'),
                                           axis=-1).reshape(-1, 3) + 0.5) / count
        found.append(places[zone.contains(places, floor)])
    return np.concatenate(found)


def _in_polygon(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return which points (M, 2) are inside: a ray crosses an odd number of edges: (M,) bool."""
    x, y = points[:, :1], points[:, 1:]
    (x0, y0), (x1, y1) = corners.T, np.roll(corners, -1, axis=0).T
    crosses = (y0 > y) != (y1 > y)
    with np.errstate(divide='ignore', invalid='ignore'):
        right = x < x0 + (y - y0) * (x1 - x0) / (y1 - y0)
    return np.count_nonzero(crosses & right, axis=1) % 2 == 1


def _crosses_itself(corners: np.ndarray) -> bool:
    """Return whether two edges of a polygon (P, 2) cross; touching is allowed."""
    along = np.roll(corners, -1, axis=0) - corners
    away = corners[None] - corners[:, None]
    # For each edge, the side of its line on which each corner is.
    side = np.sign(along[:, :1] * away[..., 1] - along[:, 1:] * away[..., 0])
    parted = side * np.roll(side, -1, axis=1) < 0.0
    return bool((parted & parted.T).any())


def zones_of(document: Document, key: str) -> tuple[Zone, ...]:
    """Read the zones of a list; empty if there is no list."""
    return tuple(zone_of(document, (key, k)) for k in range(len(document.data.get(key, ()))))


def zone_of(document: Document, way: Way) -> Zone:
    """
    Read a zone.

    :param way: the path of the zone in the document.
    :raises ConfigurationError: if it is not exactly one box or polygon, or has no inside.
    """
    data = document.value(*way)
    if ('box' in data) == ('polygon' in data):
        found = 'a box and a polygon' if 'box' in data else 'no box and no polygon'
        raise document.error(way, found, 'one of the two', 'write, for example, '
                             'box: [[0, 0, 0], [1, 1, 3]]')
    if 'box' in data:
        if 'height' in data:
            raise document.error((*way, 'height'), 'a height beside a box', 'it for a polygon '
                                 'only', "remove it: a box's corners have z")
        low, high = np.array(data['box'], dtype=np.float64)
        if not (low < high).all():
            raise document.error((*way, 'box'), describe(data['box']), 'the lowest corner first '
                                 'and the highest after it, all coordinates apart', 'exchange or '
                                 'correct those that are not')
        return Zone(low, high)
    corners = np.array(data['polygon'], dtype=np.float64)
    if _crosses_itself(corners):
        raise document.error((*way, 'polygon'), 'edges that cross each other', 'a polygon whose '
                             'edges do not', 'write its corners one after the other, round it '
                             'once')
    x, y = corners.T
    # Smaller polygons have no inside.
    if abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) < 2.0 * 1e-6:
        raise document.error((*way, 'polygon'), 'corners on one line', 'a polygon with an area',
                             'write its corners one after the other, round it once')
    bottom, top = data.get('height', (-np.inf, np.inf))
    if not bottom < top:
        raise document.error((*way, 'height'), describe(data['height']), 'the lower height first '
                             'and a greater one after it', f'write [{top:g}, {bottom:g}]'
                             if top < bottom else 'raise the second')
    return Zone(np.array([*corners.min(axis=0), bottom]), np.array([*corners.max(axis=0), top]),
                corners, True)
