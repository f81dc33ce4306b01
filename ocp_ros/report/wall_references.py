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
Reference walls: the walls near a camera from which an installer measures the camera's position.

Walls A to D are the sides of the rectangle around the room, lettered clockwise. Walls E, F and so
on are other walls near a camera, such as those of a niche, a partition or another room.
"""

from collections.abc import Sequence
from operator import itemgetter
from string import ascii_uppercase
from typing import NamedTuple

import numpy as np
from ocp_ros.rig.structure import floors_of, standing_of, STEEP, WALL_SHARE
from ocp_ros.scenes.scene import Scene

#: Thickness of a sheet: the points of a wall, metres.
SHEET_M = 0.1
#: Smallest share of a side's parts that must have points for a wall.
MIN_WALL_SHARE = 0.3
#: Largest distance of a reference wall from its camera, metres.
MAX_DISTANCE_M = 15.0
#: Half the width of the strip in which a reference wall is searched, metres.
STRIP_M = 0.5
#: Smallest width of a reference wall, to which a tape measure is held, metres.
MIN_WIDTH_M = 0.25
#: Smallest cosine between the normals of parts of the same wall.
SAME_WALL_COSINE = 0.98


class ReferenceWall(NamedTuple):
    """
    A side of the rectangle around a room.

    :ivar letter: A to D, clockwise seen from above; the outward direction of A is nearest to +y.
    :ivar outward: (2,) unit vector out of the room.
    :ivar offset: metres; the wall is the line outward . (x, y) = offset, map frame.
    :ivar length: length of the side, metres.
    :ivar stands: whether the scan has a wall here; otherwise the side is the edge of the scan.
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
            '' if self.stands else f' (less than {100.0 * MIN_WALL_SHARE:.0f} % of it is wall)')


class Corner(NamedTuple):
    """
    A corner of the rectangle around a room.

    :ivar letters: letters of its two walls.
    :ivar position: (2,) metres, map frame.
    """

    letters: str
    position: np.ndarray


def nearest_corner(sides: Sequence[ReferenceWall], place: np.ndarray) -> Corner:
    """
    Return the corner nearest to a place, among corners of two real walls if there are any.

    :param sides: the four sides of the room, A to D.
    :param place: (2,) metres, map frame.
    """
    corners = []
    for first, second in zip(sides, [*sides[1:], sides[0]]):
        # Neighbouring sides are perpendicular, so this place is on both.
        position = first.offset * first.outward + second.offset * second.outward
        is_incomplete = not (first.stands and second.stands)
        corners.append((is_incomplete, np.linalg.norm(position - place),
                        Corner(f'{first.letter} and {second.letter}', position)))
    return min(corners, key=itemgetter(0, 1))[2]


def walls_around(scene: Scene) -> list[ReferenceWall]:
    """
    Return the four sides, A to D, of a rectangle around a room, parallel to its walls.

    :param scene: the room.
    """
    is_upright = np.abs(scene.normals_or_estimate[:, 2]) <= STEEP
    normals, areas = scene.normals_or_estimate[is_upright], scene.pitch[is_upright] ** 2
    rotation = np.deg2rad(_wall_direction(normals, areas))
    forward = np.array([-np.sin(rotation), np.cos(rotation)])
    right = np.array([np.cos(rotation), np.sin(rotation)])
    plan_points = scene.points[:, :2].astype(np.float64)
    outwards = [forward, right, -forward, -right]
    # 0.3 % of the points may lie outside the room, seen through doors and windows.
    edges = [np.percentile(plan_points @ outward, 100.0 - 0.3) for outward in outwards]
    # Opposite sides have opposite outward directions, so the sum of their offsets is the distance
    # between them, which is the length of the other two sides.
    spans = [edges[1] + edges[3], edges[0] + edges[2]] * 2
    sides = [_outermost_wall(plan_points[is_upright], outward, edge, span)
             for outward, edge, span in zip(outwards, edges, spans)]
    offsets = [offset for offset, _ in sides]
    # As for ``spans``, but with the offsets of the walls.
    lengths = [offsets[1] + offsets[3], offsets[0] + offsets[2]] * 2
    return [ReferenceWall(letter, outward, offset, length, stands) for letter, outward, length,
            (offset, stands) in zip('ABCD', outwards, lengths, sides)]


def _wall_direction(normals: np.ndarray, areas: np.ndarray) -> float:
    """
    Return the direction of most wall area, relative to the axes: degrees from -45 to 45.

    :param normals: (M, 3) unit normals of M points on walls.
    :param areas: (M,) area of the wall around each point, square metres.
    """
    bins = 90
    angles = np.rad2deg(np.arctan2(normals[:, 1], normals[:, 0])) % 90.0
    bin_areas, _ = np.histogram(angles, bins, (0.0, 90.0), weights=areas)
    # Two bins may share a peak, so sum three neighbouring bins; 90 degrees are the same as 0.
    best = np.argmax(bin_areas + np.roll(bin_areas, 1) + np.roll(bin_areas, -1))
    # The middle of the best bin.
    direction = (best + 0.5) * 90.0 / bins
    # Differences of directions that repeat every 90 degrees, from -45 to 45.
    deviations = (angles - direction + 45.0) % 90.0 - 45.0
    tolerance_degrees = 5.0
    aligned = np.abs(deviations) <= tolerance_degrees
    if aligned.any():
        direction += np.average(deviations[aligned], weights=areas[aligned])
    return float((direction + 45.0) % 90.0 - 45.0)


def _outermost_wall(points: np.ndarray, outward: np.ndarray, edge: float, span: float
                    ) -> tuple[float, bool]:
    """
    Find the outermost wall of a side of the room.

    The side is divided into parts of 0.25 m. A wall is a sheet parallel to the side, of thickness
    :data:`SHEET_M`, that has points in at least the share :data:`MIN_WALL_SHARE` of these parts.

    :param points: (M, 2) metres, map frame, M points of walls and furniture.
    :param outward: (2,) unit vector out of the room.
    :param edge: offset of the edge of the scan, metres.
    :param span: length of the side, metres.
    :returns: the offset of the wall, metres, and True; or ``edge`` and False if there is no wall.
    """
    part_length_m, max_inset_m = 0.25, 1.5
    depths = points @ outward
    # The number of each point's part, along the side.
    parts = np.floor(points @ [-outward[1], outward[0]] / part_length_m)
    # Move a sheet inwards from outside the edge of the scan.
    for offset in np.arange(edge + SHEET_M, edge - max_inset_m, -0.5 * SHEET_M):
        in_sheet = np.abs(depths - offset) <= 0.5 * SHEET_M
        if len(np.unique(parts[in_sheet])) >= MIN_WALL_SHARE * span / part_length_m:
            # The first sheet that is a wall may have only the outer points of this wall, so take
            # the points of a second sheet around their median.
            in_wall = np.abs(depths - np.median(depths[in_sheet])) <= 0.5 * SHEET_M
            return float(np.median(depths[in_wall])), True
    return float(edge), False


class InnerWall(NamedTuple):
    """
    A wall that is not a side of the rectangle around the room.

    :ivar letter: E, F and so on.
    :ivar outward: (2,) unit vector from a near camera to the wall.
    :ivar offset: metres; the wall is the line outward . (x, y) = offset, map frame.
    :ivar position: (2,) metres, map frame, a place on the wall.
    :ivar top: height of the wall's upper end at this place, metres, map frame.
    """

    letter: str
    outward: np.ndarray
    offset: float
    position: np.ndarray
    top: float

    def description(self, sides: Sequence[ReferenceWall], floor: float) -> str:
        """
        Return the wall's height, and its position relative to a side of the room, in words.

        :param sides: the four sides of the room.
        :param floor: height of the floor, metres, map frame.
        """
        text = f'{self.letter} (up to {100.0 * (self.top - floor):.0f} cm high'
        parallel = max(sides, key=lambda side: float(side.outward @ self.outward))
        if float(parallel.outward @ self.outward) < SAME_WALL_COSINE:
            return f'{text}, at an angle)'
        distance_cm = 100.0 * (parallel.offset - parallel.outward @ self.position)
        return f'{text}, parallel to wall {parallel.letter} and {distance_cm:.0f} cm from it)'


class Distance(NamedTuple):
    """
    Distance of a camera from a wall.

    :ivar letter: letter of the wall.
    :ivar metres: length of the perpendicular from the camera to the wall.
    :ivar foot: (2,) metres, map frame, end of the perpendicular on the wall.
    :ivar beyond: whether the wall is a side of the room, and the camera is outside this side.
    """

    letter: str
    metres: float
    foot: np.ndarray
    beyond: bool = False


class WallReferences:
    """
    The reference walls of all cameras.

    :param scene: the room.
    :param positions: (K, 3) metres, map frame, of the K cameras.
    :ivar sides: sides of the rectangle around the room, A to D.
    :ivar inner: other walls near cameras, E and so on.
    :ivar distances: for each camera its distances to at most two walls that are perpendicular to
        each other, the nearest wall first.
    """

    def __init__(self, scene: Scene, positions: np.ndarray) -> None:
        self.sides = walls_around(scene)
        self.inner: list[InnerWall] = []
        self._standing_points = standing_of(scene)
        self._floors = floors_of(scene)
        # Each point stands for a square of this edge, metres.
        self._pitch = float(np.median(scene.pitch))
        # A wall beside a camera has at least three points and an area of 0.15 square metres.
        self._min_points = max(3, int(0.15 / self._pitch ** 2))
        # This also collects the inner walls.
        self.distances = [self._near_walls(np.asarray(position)) for position in positions]

    def _near_walls(self, position: np.ndarray) -> list[Distance]:
        """
        Return a camera's distances to at most two perpendicular walls, the nearest first.

        One of them is the wall that the camera is mounted on. If there is none, it is the nearer
        of the walls in the directions of side A and of its opposite side.
        """
        contact = self._standing_points.at(position[None])
        # The normal points from the wall to the camera.
        outward = -contact.normals[0, :2] if contact.on[0] else self.sides[0].outward
        groups = [self._opposite_walls(position, direction)
                  for direction in (outward, np.array([outward[1], -outward[0]]))]
        nearest = [min(group, key=itemgetter(0)) for group in groups if group]
        if contact.on[0] and nearest and nearest[0][0] <= contact.distances[0] + SHEET_M:
            # The plane of the wall is known better than the sheet.
            nearest[0] = float(contact.distances[0]), outward
        return [self._distance_to(position, *wall) for wall in sorted(nearest, key=itemgetter(0))]

    def _opposite_walls(self, position: np.ndarray, direction: np.ndarray
                        ) -> list[tuple[float, np.ndarray]]:
        """
        Return the distances to walls in a direction and its opposite, with these directions.

        A wall reaches the camera's height. If there is none in both directions, a wall that
        reaches most of this height is used, which a plumb line reaches.

        :param position: (3,) metres, map frame, of the camera.
        :param direction: (2,) unit vector.
        """
        # A level laser measures to points at most ``level_m`` above or below the camera.
        level_m = 0.3
        plumb_m = (1.0 - WALL_SHARE) * float(position[2] - self._floors.under(position[None])[0])
        for low in (-level_m, -plumb_m):
            walls = [(distance, outward) for outward in (direction, -direction)
                     if (distance := self._wall_distance(position, outward, low, level_m))
                     is not None]
            if walls:
                break
        return walls

    def _distance_to(self, position: np.ndarray, metres: float, outward: np.ndarray) -> Distance:
        """Return the distance to the wall that is ``metres`` away in a direction (2,)."""
        foot = position[:2] + metres * outward
        wall = self._find_wall(outward, foot)
        beyond = isinstance(wall, ReferenceWall) and float(wall.outward @ outward) < 0.0
        return Distance(wall.letter, max(metres, 0.0), foot, beyond)

    def _wall_distance(self, position: np.ndarray, outward: np.ndarray, low: float, high: float
                       ) -> float | None:
        """
        Return the distance to the first wall in a direction, metres; None if no wall is near.

        :param position: (3,) metres, map frame, of the camera.
        :param outward: (2,) unit vector, the direction.
        :param low: lower limit of the points that count, metres above the position.
        :param high: upper limit of the points that count, metres above the position.
        """
        # The normal of the wall is within 20 degrees of the direction or its opposite.
        min_cosine = 0.94
        # With noise in the scan, the front of a mounted camera may lie this far behind its wall.
        behind_m = 0.03
        # A wall may end this far beside the line of measurement.
        end_tolerance_m = 0.05
        vectors = self._standing_points.points[:, :2] - position[:2]
        heights = self._standing_points.points[:, 2] - position[2]
        facing = np.abs(self._standing_points.normals[:, :2] @ outward) >= min_cosine
        facing &= (low <= heights) & (heights <= high)
        offsets, depths = vectors @ [-outward[1], outward[0]], vectors @ outward
        # The points in a strip along the line of measurement, the nearest first.
        strip = np.flatnonzero(facing & (np.abs(offsets) <= STRIP_M) & (depths >= -behind_m)
                               & (depths <= MAX_DISTANCE_M + SHEET_M))
        strip = strip[np.argsort(depths[strip], kind='stable')]
        offsets, depths = offsets[strip], depths[strip]
        # A sheet begins at each point; ``ends`` is the index after its last point. The wall is the
        # first sheet that has enough points and that the line of measurement meets.
        ends = np.searchsorted(depths, depths + SHEET_M, side='right')
        for first in np.flatnonzero(ends - np.arange(len(depths)) >= self._min_points):
            sheet = slice(first, ends[first])
            # The parts of the sheet between holes: the first and the last offset of each.
            sorted_offsets = np.sort(offsets[sheet])
            breaks = np.flatnonzero(np.diff(sorted_offsets) > self._standing_points.gap)
            starts = sorted_offsets[np.append(0, breaks + 1)]
            stops = sorted_offsets[np.append(breaks, -1)]
            if np.any((starts <= end_tolerance_m) & (stops >= -end_tolerance_m)
                      & (stops - starts + self._pitch >= MIN_WIDTH_M)):
                distance = float(np.median(depths[sheet]))
                return distance if distance <= MAX_DISTANCE_M else None
        return None

    def _find_wall(self, outward: np.ndarray, place: np.ndarray) -> ReferenceWall | InnerWall:
        """
        Return the wall at a place; if none is known there, add one with the next letter.

        :param outward: (2,) unit vector from the camera to the wall.
        :param place: (2,) metres, map frame.
        """
        max_unevenness_m = 0.15
        walls: list[ReferenceWall | InnerWall] = [*self.sides, *self.inner]
        for wall in walls:
            if (abs(float(wall.outward @ outward)) >= SAME_WALL_COSINE
                    and abs(wall.offset - wall.outward @ place) <= max_unevenness_m):
                return wall
        letter = letter_of(len(walls))
        distances = np.linalg.norm(self._standing_points.points[:, :2] - place, axis=1)
        # The limit includes at least the nearest point.
        is_near = distances <= max(STRIP_M, distances.min())
        top = float(self._standing_points.points[is_near, 2].max())
        self.inner.append(InnerWall(letter, outward, float(outward @ place), place, top))
        return self.inner[-1]


def letter_of(number: int) -> str:
    """Return the letter of a wall by its number from 0: A to Z, then AA, AB and so on."""
    prefix, last = divmod(number, len(ascii_uppercase))
    return (letter_of(prefix - 1) if prefix else '') + ascii_uppercase[last]
