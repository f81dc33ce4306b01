# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parts of a room: boxes, and polygons between two heights."""

from dataclasses import dataclass

import numpy as np

from ocp_ros.util.yaml_files import describe, Document, Way

#: Square metres: polygons of less have no inside.
LEAST_AREA = 1e-6


@dataclass(frozen=True, eq=False)
class Zone:
    """
    A part of a room.

    :ivar low: (3,) metres, lowest corner of the box around it.
    :ivar high: (3,) metres, highest corner.
    :ivar polygon: (P, 2) metres, its corners seen from above; None for a box.
    :ivar above_floor: whether its heights are above the floor, rather than in the map frame.
    """

    low: np.ndarray
    high: np.ndarray
    polygon: np.ndarray | None = None
    above_floor: bool = False

    def contains(self, points: np.ndarray, floor: float) -> np.ndarray:
        """
        Tell which points are inside; the faces of a box are.

        :param points: (M, 3) metres, map frame.
        :param floor: height of the floor, metres, map frame.
        :returns: (M,) bool.
        """
        lift = np.array([0.0, 0.0, floor if self.above_floor else 0.0])
        inside = ((points >= self.low + lift) & (points <= self.high + lift)).all(axis=1)
        if self.polygon is not None:
            inside[inside] = _in_polygon(points[inside, :2], self.polygon)
        return inside


def _in_polygon(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Tell which points (M, 2) a ray to the right leaves an odd number of times: (M,) bool."""
    x, y = points[:, :1], points[:, 1:]
    (x0, y0), (x1, y1) = corners.T, np.roll(corners, -1, axis=0).T
    crosses = (y0 > y) != (y1 > y)
    with np.errstate(divide='ignore', invalid='ignore'):
        right = x < x0 + (y - y0) * (x1 - x0) / (y1 - y0)
    return np.count_nonzero(crosses & right, axis=1) % 2 == 1


def _crosses_itself(corners: np.ndarray) -> bool:
    """Tell whether two edges of a polygon (P, 2) cross; that they touch does not matter."""
    along = np.roll(corners, -1, axis=0) - corners
    away = corners[None] - corners[:, None]
    # Of each edge: on which side of its line each corner is.
    side = np.sign(along[:, :1] * away[..., 1] - along[:, 1:] * away[..., 0])
    parted = side * np.roll(side, -1, axis=1) < 0.0
    return bool((parted & parted.T).any())


def zone_of(document: Document, way: Way) -> Zone:
    """
    Read a zone.

    :param way: where it stands in the document.
    :raises ConfigurationError: if it is no box and no polygon, or has no inside.
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
    if abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) < 2.0 * LEAST_AREA:
        raise document.error((*way, 'polygon'), 'corners on one line', 'a polygon with an area',
                             'write its corners one after the other, round it once')
    bottom, top = data.get('height', (-np.inf, np.inf))
    if not bottom < top:
        raise document.error((*way, 'height'), describe(data['height']), 'the lower height first '
                             'and a greater one after it', f'write [{top:g}, {bottom:g}]'
                             if top < bottom else 'raise the second')
    return Zone(np.array([*corners.min(axis=0), bottom]), np.array([*corners.max(axis=0), top]),
                corners, True)
