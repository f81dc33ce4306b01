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
Reference walls: the walls near a camera from which an installer measures its position.

Walls A to D are the sides of the rectangle around the room, lettered clockwise. E, F and so on are
other walls near a camera, such as those of a niche, a partition or another room.
"""

from collections.abc import Sequence
from operator import itemgetter
from string import ascii_uppercase
from typing import NamedTuple

import numpy as np
from ocp_ros.rig.structure import standing_of, STEEP
from ocp_ros.scenes.scene import Scene

#: Percentage of points that may lie outside the room, seen through doors and windows.
STRAY_PERCENT = 0.3
#: Thickness of a wall's points, metres.
SHEET = 0.1
#: Largest distance of a wall from the edge of the scan, metres.
LARGEST_INSET = 1.5
#: Number of histogram bins of wall directions in 90 degrees.
DIRECTION_BINS = 90
#: Largest angle between the points' normals and the direction of their wall, degrees.
NORMAL_TOLERANCE_DEGREES = 5.0
#: Length of the parts of a side, metres.
PART_LENGTH = 0.25
#: Smallest share of parts with points for a wall.
LEAST_WALL_SHARE = 0.3
#: Largest distance of a reference wall, metres.
LONGEST_DISTANCE = 15.0
#: Half the width of the strip in which a reference wall is searched, metres.
STRIP = 0.5
#: Largest gap between the end of a wall and the line of measurement, metres.
END_TOLERANCE = 0.05
#: Largest distance of a camera's front behind its wall, by the noise of the scan, metres.
BEHIND_TOLERANCE = 0.03
#: A surface below a camera is the reference if it is nearer than the wall at the camera's height
#: by more than this, metres: it is reached by a plumb line.
PLUMB_GAIN = 1.0
#: Smallest area of a wall in the strip, square metres.
LEAST_WALL_AREA = 0.15
#: Smallest number of points of a wall in the strip.
LEAST_WALL_POINTS = 3
#: Height above and below a camera in which points of a wall count, metres: the beam of a level
#: laser does not meet beams or cupboards at other heights.
LEVEL = 0.3
#: Smallest cosine between the normals of a wall and the direction to it.
FACING_COSINE = 0.94
#: Smallest cosine between the normals of parts of the same wall.
SAME_WALL_COSINE = 0.98
#: Largest unevenness of a wall, metres.
UNEVENNESS = 0.15


class ReferenceWall(NamedTuple):
    """
    A side of the rectangle around a room.

    :ivar letter: A to D, clockwise seen from above; the outward direction of A is nearest to +y.
    :ivar outward: (2,) unit vector out of the room.
    :ivar offset: metres; the wall is the line outward . (x, y) = offset.
    :ivar length: metres.
    :ivar stands: whether there is a wall; otherwise the side is the edge of the scan.
    """

    letter: str
    outward: np.ndarray
    offset: float
    length: float
    stands: bool

    @property
    def description(self) -> str:
        """Return the letter and the length, with a remark if most of the side is no wall."""
        return f'{self.letter} {self.length:.2f} m' + (
            '' if self.stands else f' (less than {100.0 * LEAST_WALL_SHARE:.0f} % of it is wall)')


class Corner(NamedTuple):
    """
    A corner of the rectangle around a room.

    :ivar letters: of its two walls.
    :ivar at: (2,) metres, map frame.
    """

    letters: str
    at: np.ndarray


def nearest_corner(sides: Sequence[ReferenceWall], place: np.ndarray) -> Corner:
    """Return the corner nearest to a place (2,), preferably one between two real walls."""
    corners = []
    for one, other in zip(sides, [*sides[1:], sides[0]]):
        at = one.offset * one.outward + other.offset * other.outward
        corners.append((not (one.stands and other.stands), np.linalg.norm(at - place),
                        Corner(f'{one.letter} and {other.letter}', at)))
    return min(corners, key=itemgetter(0, 1))[2]


def walls_around(scene: Scene) -> list[ReferenceWall]:
    """
    Fit a rectangle around a room, parallel to its walls.

    :returns: its four sides, A to D.
    """
    upright = np.abs(scene.normals_or_estimate[:, 2]) <= STEEP
    normals, areas = scene.normals_or_estimate[upright], scene.pitch[upright] ** 2
    turn = np.deg2rad(_direction(normals, areas))
    ahead = np.array([-np.sin(turn), np.cos(turn)])
    right = np.array([np.cos(turn), np.sin(turn)])
    flat = scene.points[:, :2].astype(np.float64)
    outwards = [ahead, right, -ahead, -right]
    edges = [np.percentile(flat @ outward, 100.0 - STRAY_PERCENT) for outward in outwards]
    spans = [edges[1] + edges[3], edges[0] + edges[2]] * 2
    sides = [_side(flat[upright], outward, edge, span)
             for outward, edge, span in zip(outwards, edges, spans)]
    offsets = [offset for offset, _ in sides]
    lengths = [offsets[1] + offsets[3], offsets[0] + offsets[2]] * 2
    return [ReferenceWall(letter, outward, offset, length, stands) for letter, outward, length,
            (offset, stands) in zip('ABCD', outwards, lengths, sides)]


def _direction(normals: np.ndarray, areas: np.ndarray) -> float:
    """Return the rotation of walls with normals (M, 3) to the axes: degrees from -45 to 45."""
    angles = np.rad2deg(np.arctan2(normals[:, 1], normals[:, 0])) % 90.0
    counts, _ = np.histogram(angles, DIRECTION_BINS, (0.0, 90.0), weights=areas)
    best = np.argmax(counts + np.roll(counts, 1) + np.roll(counts, -1))
    found = (best + 0.5) * 90.0 / DIRECTION_BINS
    off = (angles - found + 45.0) % 90.0 - 45.0
    near = np.abs(off) <= NORMAL_TOLERANCE_DEGREES
    if near.any():
        found += np.average(off[near], weights=areas[near])
    return float((found + 45.0) % 90.0 - 45.0)


def _side(upright: np.ndarray, outward: np.ndarray, edge: float, span: float
          ) -> tuple[float, bool]:
    """
    Find the outermost wall of a side.

    :param upright: (M, 2) metres, points of walls and furniture.
    :param edge: offset of the edge of the scan, metres.
    :param span: length of the side, metres.
    :returns: the offset of the wall, metres, and True; or the edge and False without a wall.
    """
    out = upright @ outward
    parts = np.floor(upright @ [-outward[1], outward[0]] / PART_LENGTH)
    for offset in np.arange(edge + SHEET, edge - LARGEST_INSET, -0.5 * SHEET):
        near = np.abs(out - offset) <= 0.5 * SHEET
        if len(np.unique(parts[near])) >= LEAST_WALL_SHARE * span / PART_LENGTH:
            # The points of the wall may extend farther inwards than this step.
            return float(np.median(out[np.abs(out - np.median(out[near])) <= 0.5 * SHEET])), True
    return float(edge), False


class InnerWall(NamedTuple):
    """
    A wall that is not a side of the rectangle around the room.

    :ivar letter: E, F and so on.
    :ivar outward: (2,) unit vector from the camera near it to the wall.
    :ivar offset: metres; the wall is the line outward . (x, y) = offset.
    :ivar at: (2,) metres, a place on it.
    :ivar top: height of its upper end there, metres, map frame.
    """

    letter: str
    outward: np.ndarray
    offset: float
    at: np.ndarray
    top: float

    def description(self, sides: Sequence[ReferenceWall], floor: float) -> str:
        """Return its position relative to the sides of a room and its height, in words."""
        top = f'{self.letter} (up to {100.0 * (self.top - floor):.0f} cm high'
        along = max(sides, key=lambda side: float(side.outward @ self.outward))
        if float(along.outward @ self.outward) < SAME_WALL_COSINE:
            return f'{top}, at an angle)'
        away = 100.0 * (along.offset - along.outward @ self.at)
        return f'{top}, parallel to wall {along.letter} and {away:.0f} cm from it)'


class Distance(NamedTuple):
    """
    Distance of a camera from a wall.

    :ivar letter: of the wall.
    :ivar away: metres, perpendicular to the wall.
    :ivar at: (2,) metres, the foot of the perpendicular.
    :ivar beyond: whether the camera is on the far side of a side of the room.
    """

    letter: str
    away: float
    at: np.ndarray
    beyond: bool = False


class WallReferences:
    """
    The reference walls of all cameras.

    :param scene: the room.
    :param positions: (K, 3) metres, map frame, of the cameras.
    :ivar sides: of the rectangle around the room, A to D.
    :ivar inner: other walls, E and so on.
    :ivar distances: of each camera, the nearest first: at most two, to perpendicular walls.
    """

    def __init__(self, scene: Scene, positions: np.ndarray) -> None:
        self.sides = walls_around(scene)
        self.inner: list[InnerWall] = []
        self._surface = standing_of(scene)
        self._least_points = max(
            LEAST_WALL_POINTS, int(LEAST_WALL_AREA / float(np.median(scene.pitch)) ** 2))
        self.distances = [self._around(np.asarray(position)) for position in positions]

    def _around(self, position: np.ndarray) -> list[Distance]:
        """Measure from the wall of a camera's mount, or a near one, and a perpendicular one."""
        contact = self._surface.at(position[None])
        ahead = self.sides[0].outward
        mounted_on = []
        if contact.on[0]:
            ahead = -contact.normals[0, :2]
            mounted_on = [(float(contact.distances[0]), ahead)]
        across = self._either(position, np.array([ahead[1], -ahead[0]]))
        nearest = [min(walls, key=itemgetter(0))
                   for walls in (mounted_on or self._either(position, ahead), across) if walls]
        return [self._distance(position, *one) for one in sorted(nearest, key=itemgetter(0))]

    def _either(self, position: np.ndarray, way: np.ndarray) -> list[tuple[float, np.ndarray]]:
        """
        Return the distances to walls in a direction and its opposite, with these directions.

        A wall at the camera's height is used, or a surface below it that is much nearer. Without
        both, surfaces at any height are used. A direction without a surface is left out.
        """
        found = []
        for outward in (way, -way):
            level, under = (self._away(position, outward, *band) for band in (
                (-LEVEL, LEVEL), (-np.inf, LEVEL)))
            if level is None or under is not None and under < level - PLUMB_GAIN:
                level = under if under is not None else self._away(
                    position, outward, -np.inf, np.inf)
            if level is not None:
                found.append((level, outward))
        return found

    def _distance(self, position: np.ndarray, away: float, outward: np.ndarray) -> Distance:
        """Return the distance to the wall ``away`` metres in a direction, with its letter."""
        at = position[:2] + away * outward
        wall = self._wall(outward, at)
        beyond = isinstance(wall, ReferenceWall) and float(wall.outward @ outward) < 0.0
        return Distance(wall.letter, max(away, 0.0), at, beyond)

    def _away(self, position: np.ndarray, outward: np.ndarray, low: float, high: float
              ) -> float | None:
        """
        Return the distance to the first wall in a direction, metres; None if none is near.

        :param low: lower limit of the points that count, metres above the position.
        :param high: upper limit of the points that count, metres above the position.
        """
        ways = self._surface.points[:, :2] - position[:2]
        above = self._surface.points[:, 2] - position[2]
        level = (low <= above) & (above <= high)
        facing = level & (np.abs(self._surface.normals[:, :2] @ outward) >= FACING_COSINE)
        aside, away = ways @ [-outward[1], outward[0]], ways @ outward
        strip = np.flatnonzero(facing & (np.abs(aside) <= STRIP) & (away >= -BEHIND_TOLERANCE)
                               & (away <= LONGEST_DISTANCE + SHEET))
        strip = strip[np.argsort(away[strip], kind='stable')]
        aside, away = aside[strip], away[strip]
        ends = np.searchsorted(away, away + SHEET, side='right')
        for first in np.flatnonzero(ends - np.arange(len(away)) >= self._least_points):
            sheet = slice(first, ends[first])
            # Skip a wall that ends beside the line of measurement.
            if aside[sheet].min() <= END_TOLERANCE and aside[sheet].max() >= -END_TOLERANCE:
                found = float(np.median(away[sheet]))
                return found if found <= LONGEST_DISTANCE else None
        return None

    def _wall(self, outward: np.ndarray, at: np.ndarray) -> ReferenceWall | InnerWall:
        """Return the wall at a place; add a new one with the next letter if there is none."""
        known: list[ReferenceWall | InnerWall] = [*self.sides, *self.inner]
        for wall in known:
            if (abs(float(wall.outward @ outward)) >= SAME_WALL_COSINE
                    and abs(wall.offset - wall.outward @ at) <= UNEVENNESS):
                return wall
        letter = letter_of(len(self.sides) + len(self.inner))
        away = np.linalg.norm(self._surface.points[:, :2] - at, axis=1)
        top = float(self._surface.points[away <= max(STRIP, away.min()), 2].max())
        self.inner.append(InnerWall(letter, outward, float(outward @ at), at, top))
        return self.inner[-1]


def letter_of(number: int) -> str:
    """Return the letter of a wall, counted from 0: A to Z, then AA, AB and so on."""
    more, last = divmod(number, len(ascii_uppercase))
    return (letter_of(more - 1) if more else '') + ascii_uppercase[last]
