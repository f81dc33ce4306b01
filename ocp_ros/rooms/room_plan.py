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

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from ocp_ros.rooms.furniture import Piece, placed, Solid

#: Metres between furniture and the wall behind it.
WALL_GAP_M = 0.03
#: Metres of free floor around objects.
CLEARANCE_M = 0.12
#: The number of attempts to place a piece before it is left out.
MAX_ATTEMPTS = 25


class RoomWall(NamedTuple):
    """
    An inner side of a wall.

    :ivar start: (2,) the start of the wall.
    :ivar along: (2,) unit vector; the room is on its left.
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
    A room.

    :ivar kind: one of :data:`ocp_ros.rooms.room_kinds.ROOMS`.
    :ivar size: (3,) metres.
    :ivar rng: the random generator for the contents of the room.
    :ivar solids: the boxes of the building and the furniture.
    :ivar windows: (2, 3) boxes around parts of walls that return no light.
    :ivar walls: inner sides to lean things against.
    """

    kind: str
    size: np.ndarray
    rng: np.random.Generator
    solids: list[Solid] = field(default_factory=list)
    windows: list[np.ndarray] = field(default_factory=list)
    walls: list[RoomWall] = field(default_factory=list)
    _taken: list[np.ndarray] = field(default_factory=list)

    def claim(self, low: np.ndarray, high: np.ndarray, clearance: float = CLEARANCE_M) -> bool:
        """Reserve a rectangle of the floor if it is in the room and free."""
        low, high = np.minimum(low, high), np.maximum(low, high)
        if (low < -1e-9).any() or (high > self.size[:2] + 1e-9).any():
            return False
        for other in self._taken:
            if (low - clearance < other[1]).all() and (high + clearance > other[0]).all():
                return False
        self._taken.append(np.stack([low, high]))
        return True

    def stand(self, make: Callable[[], Piece], width: float, depth: float,
              turns: tuple[float, ...] = (0.0, 0.5, 1.0, 1.5)) -> bool:
        """
        Place a piece at a random free position.

        :param make: builds it.
        :param width: the extent of its footprint along its own x, metres.
        :param depth: the same along y.
        :param turns: yaws to choose from, in units of pi.
        """
        for _ in range(MAX_ATTEMPTS):
            yaw = float(self.rng.choice(turns)) * np.pi
            half = 0.5 * footprint(width, depth, yaw)
            if (2.0 * half > self.size[:2] - 0.2).any():
                continue
            at = self.rng.uniform(0.1 + half, self.size[:2] - 0.1 - half)
            if self.claim(at - half, at + half):
                self.solids += placed(make(), at, yaw)
                return True
        return False

    def lean(self, make: Callable[[], Piece], width: float, depth: float,
             front: float = 0.0) -> bool:
        """
        Place a piece with its back to a wall.

        :param make: builds it.
        :param width: along the wall, metres.
        :param depth: the extent away from the wall, metres.
        :param front: metres of floor in front of it that stay free.
        """
        for _ in range(MAX_ATTEMPTS):
            wall = self.walls[self.rng.integers(len(self.walls))]
            if wall.length < width + 0.1:
                continue
            shift = self.rng.uniform(0.05, wall.length - width - 0.05)
            corner = wall.start + shift * wall.along + WALL_GAP_M * wall.inward
            far = corner + width * wall.along + (depth + front) * wall.inward
            if self.claim(corner, far, 0.05):
                at = corner + 0.5 * width * wall.along + 0.5 * depth * wall.inward
                self.solids += placed(make(), at, np.arctan2(wall.along[1], wall.along[0]))
                return True
        return False


def footprint(width: float, depth: float, yaw: float) -> np.ndarray:
    """Return the edges (2,) of the axis-aligned rectangle around a rotated rectangle."""
    c, s = abs(np.cos(yaw)), abs(np.sin(yaw))
    return np.array([c * width + s * depth, s * width + c * depth])


def mirrored(plan: RoomPlan, flip: np.ndarray) -> RoomPlan:
    """Return a room mirrored along x, y or both, (2,) bool; nothing can be added to it."""
    size, sign = plan.size[:2], np.where(flip, -1.0, 1.0)
    solids = []
    for part in plan.solids:
        centre = part.centre.copy()
        centre[:2] = np.where(flip, size - centre[:2], centre[:2])
        solids.append(part._replace(centre=centre, yaw=part.yaw * sign[0] * sign[1]))
    windows = []
    for window in plan.windows:
        corners = window.copy()
        corners[:, :2] = np.where(flip, size - corners[:, :2], corners[:, :2])
        windows.append(np.stack([corners.min(axis=0), corners.max(axis=0)]))
    return RoomPlan(plan.kind, plan.size, plan.rng, solids, windows)
