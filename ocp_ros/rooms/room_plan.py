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
The plan of a room: its walls, its solids, and the free floor.

All lengths are metres; a room spans from the origin to its size.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from ocp_ros.rooms.furniture import make_solid, moved_piece, Piece, Solid

#: Metres between furniture and the wall behind it.
WALL_GAP_M = 0.03
#: The number of attempts to place a piece before it is left out.
MAX_ATTEMPTS = 25


class RoomWall(NamedTuple):
    """
    The inner side of a wall, seen from above.

    :ivar start: (2,) metres, one end of the wall.
    :ivar along: (2,) unit vector to the other end, with the room on its left.
    :ivar length: metres.
    """

    start: np.ndarray
    along: np.ndarray
    length: float

    @property
    def inward(self) -> np.ndarray:
        """Return the (2,) unit vector into the room."""
        return np.array([-self.along[1], self.along[0]])


@dataclass
class RoomPlan:
    """
    A room that is being built: functions add walls, solids and windows to it.

    :ivar kind: one of :data:`ocp_ros.rooms.room_kinds.ROOM_KINDS`.
    :ivar size: (3,) width along x, depth along y and height, metres.
    :ivar rng: the random generator for the contents of the room.
    :ivar solids: the boxes of the building and the furniture.
    :ivar windows: boxes (2, 3), lowest and highest corner, around parts of walls that return no
        light to a scanner.
    :ivar walls: the inner sides that pieces can stand against.
    """

    kind: str
    size: np.ndarray
    rng: np.random.Generator
    solids: list[Solid] = field(default_factory=list)
    windows: list[np.ndarray] = field(default_factory=list)
    walls: list[RoomWall] = field(default_factory=list)
    # Reserved rectangles of the floor: (2, 2) lowest and highest corner, metres.
    _taken: list[np.ndarray] = field(default_factory=list)

    def add_box(self, kind: str, low: Sequence[float], high: Sequence[float]) -> None:
        """Add an upright box from its lowest to its highest corner, both (3,), metres."""
        self.solids.append(make_solid(kind, low, high))

    def claim_floor(self, low: ArrayLike, high: ArrayLike, clearance: float = 0.12) -> bool:
        """
        Reserve a rectangle of the floor, unless it is outside the room or too near to another.

        :param low: (2,) metres, one corner.
        :param high: (2,) metres, the opposite corner.
        :param clearance: metres between this and all other reserved rectangles.
        :returns: whether the rectangle is now reserved.
        """
        low, high = np.minimum(low, high), np.maximum(low, high)
        # The tolerance of 1e-9 m is for rounding.
        if (low < -1e-9).any() or (high > self.size[:2] + 1e-9).any():
            return False
        for taken in self._taken:
            if (low - clearance < taken[1]).all() and (high + clearance > taken[0]).all():
                return False
        self._taken.append(np.stack([low, high]))
        return True

    def place_freestanding(self, build_piece: Callable[[], Piece], width: float, depth: float,
                           half_turns: tuple[float, ...] = (0.0, 0.5, 1.0, 1.5)) -> None:
        """
        Place a piece at a random free position, if one is found.

        :param build_piece: returns the piece; called only if a position is found.
        :param width: the extent of the floor below the piece along its own x axis, metres.
        :param depth: the extent along its own y axis, metres.
        :param half_turns: yaws to choose from, in units of pi radians.
        """
        for _ in range(MAX_ATTEMPTS):
            yaw = float(self.rng.choice(half_turns)) * np.pi
            half_extent = 0.5 * rotated_footprint(width, depth, yaw)
            # A piece stays 0.1 m away from the sides of the room.
            if (2.0 * half_extent > self.size[:2] - 0.2).any():
                continue
            position = self.rng.uniform(0.1 + half_extent, self.size[:2] - 0.1 - half_extent)
            if self.claim_floor(position - half_extent, position + half_extent):
                self.solids += moved_piece(build_piece(), position, yaw)
                return

    def place_at_wall(self, build_piece: Callable[[], Piece], width: float, depth: float,
                      front: float = 0.0) -> None:
        """
        Place a piece with its back to a random wall, if a free position is found.

        :param build_piece: returns the piece; called only if a position is found.
        :param width: the extent of the piece along the wall, metres.
        :param depth: the extent of the piece away from the wall, metres.
        :param front: metres of floor in front of the piece that stay free.
        """
        for _ in range(MAX_ATTEMPTS):
            wall = self.walls[self.rng.integers(len(self.walls))]
            if wall.length < width + 0.1:
                continue
            # A piece stays 5 cm away from both ends of its wall.
            distance = self.rng.uniform(0.05, wall.length - width - 0.05)
            corner = wall.start + distance * wall.along + WALL_GAP_M * wall.inward
            opposite = corner + width * wall.along + (depth + front) * wall.inward
            if self.claim_floor(corner, opposite, clearance=0.05):
                position = corner + 0.5 * width * wall.along + 0.5 * depth * wall.inward
                yaw = np.arctan2(wall.along[1], wall.along[0])
                self.solids += moved_piece(build_piece(), position, yaw)
                return


def rotated_footprint(width: float, depth: float, yaw: float) -> np.ndarray:
    """Return the extents (2,) along x and y of a rectangle that is rotated by a yaw, radians."""
    cosine, sine = abs(np.cos(yaw)), abs(np.sin(yaw))
    return np.array([cosine * width + sine * depth, sine * width + cosine * depth])


def mirrored_plan(plan: RoomPlan, is_mirrored: np.ndarray) -> RoomPlan:
    """
    Return a mirrored copy of a room, without walls and reserved floor, so it cannot be furnished.

    :param is_mirrored: (2,) bool, whether x and whether y are reversed.
    """
    size = plan.size[:2]
    # One mirror reverses the yaw of a box, two mirrors keep it.
    signs = np.where(is_mirrored, -1.0, 1.0)
    solids = []
    for box in plan.solids:
        centre = box.centre.copy()
        centre[:2] = np.where(is_mirrored, size - centre[:2], centre[:2])
        solids.append(box._replace(centre=centre, yaw=box.yaw * signs[0] * signs[1]))
    windows = []
    for window in plan.windows:
        corners = window.copy()
        corners[:, :2] = np.where(is_mirrored, size - corners[:, :2], corners[:, :2])
        windows.append(np.stack([corners.min(axis=0), corners.max(axis=0)]))
    return RoomPlan(plan.kind, plan.size, plan.rng, solids, windows)
