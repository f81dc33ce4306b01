# SPDX-License-Identifier: Apache-2.0
"""
Plans of generated rooms: the building and what stands in it, by the kind of room.

The kinds and the range of sizes are those of S3DIS that four cameras can cover roughly. All
lengths are metres; a room spans from the origin to its size.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ocp_ros.scenes.furniture import (
    bookcase,
    cabinet,
    chair,
    desk,
    Piece,
    placed,
    sofa,
    Solid,
    solid,
    table,
    things,
)

#: Free floor around what stands in the room, and air between furniture and the wall behind it.
CLEARANCE, WALL_GAP = 0.12, 0.03
#: How often a place is sought before a piece is left out.
TRIES = 25
#: The floor in front of a door that stays free.
DOORWAY = 0.9


class Wall(NamedTuple):
    """
    An inner side of a wall.

    :ivar start: (2,) where it begins.
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
class Plan:
    """
    A room.

    :ivar kind: one of ``ROOMS``.
    :ivar size: (3,) metres.
    :ivar rng: draws what is put into it.
    :ivar solids: what is built and stands in it.
    :ivar windows: (2, 3) boxes around parts of walls that return no light.
    :ivar walls: inner sides to lean things against.
    """

    kind: str
    size: np.ndarray
    rng: np.random.Generator
    solids: list[Solid] = field(default_factory=list)
    windows: list[np.ndarray] = field(default_factory=list)
    walls: list[Wall] = field(default_factory=list)
    _taken: list[np.ndarray] = field(default_factory=list)

    def claim(self, low: np.ndarray, high: np.ndarray, clearance: float = CLEARANCE) -> bool:
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
        Stand a piece somewhere free.

        :param make: builds it.
        :param width: of its footprint along its own x, metres.
        :param depth: the same along y.
        :param turns: yaws to choose from, in units of pi.
        """
        for _ in range(TRIES):
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
        Stand a piece with its back to a wall.

        :param make: builds it.
        :param width: along the wall, metres.
        :param depth: away from it.
        :param front: metres of floor before it that stay free.
        """
        for _ in range(TRIES):
            wall = self.walls[self.rng.integers(len(self.walls))]
            if wall.length < width + 0.1:
                continue
            shift = self.rng.uniform(0.05, wall.length - width - 0.05)
            corner = wall.start + shift * wall.along + WALL_GAP * wall.inward
            far = corner + width * wall.along + (depth + front) * wall.inward
            if self.claim(corner, far, 0.05):
                at = corner + 0.5 * width * wall.along + 0.5 * depth * wall.inward
                self.solids += placed(make(), at, np.arctan2(wall.along[1], wall.along[0]))
                return True
        return False


def footprint(width: float, depth: float, yaw: float) -> np.ndarray:
    """Return the edges (2,) of the axis-aligned rectangle around a turned one."""
    c, s = abs(np.cos(yaw)), abs(np.sin(yaw))
    return np.array([c * width + s * depth, s * width + c * depth])


def _shell(plan: Plan, corner: float) -> None:
    """
    Build the walls, perhaps with a corner taken away.

    :param corner: the chance of an L-shape.
    """
    (w, d, _), rng = plan.size, plan.rng
    if rng.random() < corner:
        bw, bd = rng.uniform(0.25, 0.6, 2) * (w, d)
        if plan.kind == 'hallway':
            bw, bd = np.array([w, d]) - rng.uniform(1.8, 2.8, 2)
        _block(plan, (w - bw, d - bd), (w, d))
        corners = [(0, 0), (w, 0), (w, d - bd), (w - bw, d - bd), (w - bw, d), (0, d)]
    else:
        corners = [(0, 0), (w, 0), (w, d), (0, d)]
    corners = np.array(corners, dtype=np.float64)
    for start, end in zip(corners, np.roll(corners, -1, axis=0)):
        length = float(np.linalg.norm(end - start))
        plan.walls.append(Wall(start, (end - start) / length, length))


def _block(plan: Plan, low, high, kind: str = 'wall', top: float | None = None) -> bool:
    """Build something from the floor to the ceiling, or to a top, if the place is free."""
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    if not plan.claim(low, high, 0.0):
        return False
    plan.solids.append(solid(kind, (*low, 0.0), (*high, plan.size[2] if top is None else top)))
    return True


def _niches(plan: Plan) -> None:
    """Let pieces of a wall stand forward, with niches between them."""
    wall = plan.walls[plan.rng.integers(len(plan.walls))]
    depth, shift = plan.rng.uniform(0.2, 0.7), plan.rng.uniform(0.0, 1.0)
    while shift + 0.5 < wall.length:
        width = min(plan.rng.uniform(0.4, 1.6), wall.length - shift)
        start = wall.start + shift * wall.along
        end = start + width * wall.along + depth * wall.inward
        _block(plan, np.minimum(start, end), np.maximum(start, end))
        shift += width + plan.rng.uniform(0.9, 2.5)


def _columns(plan: Plan, count: int) -> None:
    """Stand columns."""
    for _ in range(count):
        side = plan.rng.uniform(0.3, 0.6)
        low = plan.rng.uniform(0.15, 0.85, 2) * (plan.size[:2] - side)
        _block(plan, low, low + side, 'column')


def _partition(plan: Plan, top: float | None = None) -> None:
    """Stand a thin wall on one side of the room, across 35 to 65 per cent of it."""
    rng = plan.rng
    axis = int(rng.integers(2))
    length = rng.uniform(0.35, 0.65) * plan.size[1 - axis]
    at = rng.uniform(0.3, 0.7) * plan.size[axis]
    start = 0.0 if rng.random() < 0.5 else plan.size[1 - axis] - length
    low, high = np.zeros(2), np.zeros(2)
    low[axis], high[axis] = at - 0.05, at + 0.05
    low[1 - axis], high[1 - axis] = start, start + length
    _block(plan, low, high, top=top)


def _ceiling(plan: Plan) -> None:
    """Hang beams, ducts and lamps."""
    (w, d, h), rng = plan.size, plan.rng
    along = int(rng.integers(2))
    for _ in range(rng.choice([0, 0, 1, 2, 3])):
        wide, deep = rng.uniform(0.2, 0.45, 2)
        at = rng.uniform(0.1, 0.9) * (plan.size[1 - along] - wide)
        low, high = np.array([0.0, 0.0, h - deep]), plan.size.copy()
        low[1 - along], high[1 - along] = at, at + wide
        plan.solids.append(solid('beam', low, high))
    for x in np.arange(1.2, w - 0.6, 2.4):
        for y in np.arange(1.2, d - 0.3, 2.4):
            if rng.random() < 0.6:
                plan.solids.append(solid('clutter', (x - 0.6, y - 0.12, h - 0.11),
                                         (x + 0.6, y + 0.12, h - WALL_GAP)))


def _openings(plan: Plan, doors: int, windows: int, boards: int) -> None:
    """Hang doors, some of them open, windows and boards."""
    rng = plan.rng
    for _ in range(doors):
        opened = rng.random() < 0.3
        angle = rng.uniform(1.0, 1.8) if opened else 0.0
        leaf = placed([solid('door', (0.0, -0.025, 0.01), (0.9, 0.025, rng.uniform(2.0, 2.15)))],
                      (-0.45, 0.0), angle)
        plan.lean(lambda leaf=leaf: leaf, 0.95, 0.05, DOORWAY)
    for _ in range(windows):
        wall = plan.walls[rng.integers(len(plan.walls))]
        wide, low = rng.uniform(1.0, 3.0), rng.uniform(0.7, 1.0)
        if wall.length < wide + 0.4:
            continue
        start = wall.start + rng.uniform(0.2, wall.length - wide - 0.2) * wall.along
        end = start + wide * wall.along
        high = min(low + rng.uniform(0.9, 1.6), plan.size[2] - 0.2)
        # Glass returns nothing, a blind does, and so do sill and frame.
        if rng.random() < 0.4:
            plan.windows.append(np.array([[*(np.minimum(start, end) - 0.01), low],
                                          [*(np.maximum(start, end) + 0.01), high]]))
        else:
            near, far = start + 0.04 * wall.inward, end + 0.07 * wall.inward
            plan.solids.append(solid('window', (*np.minimum(near, far), low),
                                     (*np.maximum(near, far), high)))
        sill = end + 0.15 * wall.inward
        plan.solids.append(solid('window', (*np.minimum(start, sill), low - 0.05),
                                 (*np.maximum(start, sill), low)))
        post = end + 0.05 * wall.inward
        back = end - 0.06 * wall.along
        plan.solids.append(solid('window', (*np.minimum(back, post), low),
                                 (*np.maximum(back, post), high)))
    for _ in range(boards):
        wide = rng.uniform(1.2, 3.0)
        board = solid('board', (-0.5 * wide, -0.02, 0.85), (0.5 * wide, 0.02, 2.05))
        plan.lean(lambda board=board: [board], wide, 0.04, 0.2)


def _fittings(plan: Plan) -> None:
    """Fix to the walls what is found on walls: panels, pictures, pipes, heaters, boxes."""
    rng = plan.rng
    for wall in plan.walls:
        for _ in range(rng.poisson(0.5 * wall.length)):
            wide, high, deep = rng.uniform([0.2, 0.2, 0.04], [1.3, 1.0, 0.3])
            if wide + 0.1 > wall.length:
                continue
            low = rng.uniform(0.1, plan.size[2] - high - 0.1)
            at = wall.start + rng.uniform(0.5 * wide, wall.length - 0.5 * wide) * wall.along
            box = solid('clutter', (-0.5 * wide, WALL_GAP, low),
                        (0.5 * wide, WALL_GAP + deep, low + high))
            plan.solids += placed([box], at, np.arctan2(wall.along[1], wall.along[0]))


def _chairs(plan: Plan, count: int) -> None:
    """Leave chairs anywhere."""
    for _ in range(count):
        plan.stand(lambda: placed(chair(plan.rng), (0.0, 0.0), plan.rng.uniform(-1.0, 1.0)),
                   0.6, 0.6)


def _shelves(plan: Plan, count: int, low: float = 0.7, high: float = 2.2) -> None:
    """Stand bookcases along the walls."""
    for _ in range(count):
        width, depth, height = plan.rng.uniform([0.8, 0.28, low], [1.3, 0.42, high])
        plan.lean(lambda w=width, d=depth, h=height: bookcase(plan.rng, w, d, h), width, depth)


def _cabinets(plan: Plan, count: int) -> None:
    """Stand cabinets along the walls."""
    for _ in range(count):
        width, depth, height = plan.rng.uniform([0.5, 0.4, 0.7], [1.8, 0.65, 2.1])
        plan.lean(lambda w=width, d=depth, h=height: cabinet(plan.rng, w, d, h), width, depth)


def _desks(plan: Plan, count: int) -> None:
    """Stand desks along the walls, each with its chair."""
    def workplace() -> Piece:
        seat = placed(chair(plan.rng), (plan.rng.uniform(-0.25, 0.25), 0.75),
                      np.pi + plan.rng.normal(0.0, 0.5))
        return desk(plan.rng) + seat
    for _ in range(count):
        plan.lean(workplace, 1.6, 0.75, 0.8)


def _clutter(plan: Plan, count: int) -> None:
    """Leave boxes, bins and bags on the floor."""
    for _ in range(count):
        size = plan.rng.uniform(0.2, 0.6)
        plan.stand(lambda s=size: things(plan.rng, s, s, 0.0, 1), size, size)


def _seated_table(plan: Plan, width: float, depth: float, every: float) -> None:
    """Stand a table with chairs on both long sides."""
    def group() -> Piece:
        piece = table(plan.rng, width, depth)
        for side in (-1, 1):
            for x in np.arange(-0.5 * width + 0.5 * every, 0.5 * width, every):
                if plan.rng.random() < 0.85:
                    yaw = (0.0 if side < 0 else np.pi) + plan.rng.normal(0.0, 0.3)
                    at = (x + plan.rng.normal(0, 0.05),
                          side * (0.5 * depth + plan.rng.uniform(0.0, 0.4)))
                    piece += placed(chair(plan.rng), at, yaw)
        return piece
    plan.stand(group, width + 0.2, depth + 1.3)


def office(plan: Plan) -> None:
    """Furnish an office of one to four workplaces."""
    rng = plan.rng
    _openings(plan, rng.integers(1, 3), rng.integers(0, 3), rng.integers(0, 2))
    _desks(plan, rng.integers(1, 5))
    _shelves(plan, rng.integers(2, 9))
    _cabinets(plan, rng.integers(1, 5))
    if rng.random() < 0.5:
        _seated_table(plan, rng.uniform(0.9, 1.4), 0.9, 0.7)
    _chairs(plan, rng.integers(0, 4))
    _clutter(plan, rng.integers(3, 10))


def conference(plan: Plan) -> None:
    """Furnish a conference room: a long table, chairs, boards."""
    rng = plan.rng
    _openings(plan, rng.integers(1, 4), rng.integers(0, 4), rng.integers(1, 3))
    long = max(plan.size[0], plan.size[1])
    _seated_table(plan, rng.uniform(0.4, 0.65) * long, rng.uniform(1.1, 1.8), 0.65)
    if rng.random() < 0.3:
        _seated_table(plan, 1.6, 0.8, 0.7)
    _chairs(plan, rng.integers(2, 12))
    _cabinets(plan, rng.integers(1, 5))
    _shelves(plan, rng.integers(0, 4))
    _clutter(plan, rng.integers(1, 6))


def lounge(plan: Plan) -> None:
    """Furnish a lounge: sofas around low tables, a counter, small tables."""
    rng = plan.rng
    _openings(plan, rng.integers(1, 5), rng.integers(1, 4), rng.integers(0, 2))
    counter = rng.uniform(1.5, 3.5)
    plan.lean(lambda: cabinet(rng, counter, 0.62, 0.92), counter, 0.62, 0.7)
    for _ in range(rng.integers(2, 5)):
        width = rng.choice([0.85, 1.6, 2.1])
        plan.lean(lambda w=width: sofa(rng, w), width, 0.85, 0.4)
    for _ in range(rng.integers(0, 3)):
        plan.stand(lambda: sofa(rng, 1.6) + placed(table(rng, 1.0, 0.6)[:1], (0.0, 1.1), 0.0,
                                                   -0.3), 1.7, 3.0)
    for _ in range(rng.integers(1, 5)):
        _seated_table(plan, rng.uniform(0.8, 1.8), 0.8, 0.6)
    _shelves(plan, rng.integers(1, 7))
    _cabinets(plan, rng.integers(1, 6))
    _chairs(plan, rng.integers(0, 6))
    _clutter(plan, rng.integers(3, 12))


def hallway(plan: Plan) -> None:
    """Furnish a hallway: doors, boards and a few cabinets."""
    rng = plan.rng
    _openings(plan, rng.integers(4, 9), rng.integers(0, 2), rng.integers(0, 4))
    _cabinets(plan, rng.integers(1, 6))
    _shelves(plan, rng.integers(0, 6))
    _clutter(plan, rng.integers(1, 8))


def storage(plan: Plan) -> None:
    """Fill a storage room: rows of shelves with aisles, cabinets, boxes."""
    rng = plan.rng
    _openings(plan, 1, rng.integers(0, 2), 0)
    along = int(plan.size[1] > plan.size[0])
    length, across = plan.size[along], plan.size[1 - along]
    at = rng.uniform(0.9, 1.6)
    while at + 1.0 < across:
        depth, height, start = rng.uniform(0.4, 0.8), rng.uniform(1.2, 2.3), 1.0
        while start + 1.0 < length - 0.8:
            width = rng.uniform(0.9, 1.2)
            middle = np.array([start + 0.5 * width, at + 0.5 * depth])
            yaw = rng.choice([0.0, np.pi])
            if along:
                middle, yaw = middle[::-1], yaw + 0.5 * np.pi
            half = 0.5 * footprint(width, depth, yaw)
            if rng.random() < 0.85 and plan.claim(middle - half, middle + half, 0.0):
                plan.solids += placed(bookcase(rng, width, depth, height), middle, yaw)
            start += width
        at += depth + rng.uniform(0.9, 1.6)
    _shelves(plan, rng.integers(1, 5), 1.4)
    _cabinets(plan, rng.integers(1, 6))
    _clutter(plan, rng.integers(8, 20))


def open_office(plan: Plan) -> None:
    """Furnish an open office: groups of desks between screens, columns, shelves."""
    rng = plan.rng
    _openings(plan, rng.integers(2, 7), rng.integers(2, 6), rng.integers(0, 3))
    tall = rng.choice([1.1, 1.4, 1.7])

    def group() -> Piece:
        """Build four desks back to back with a screen between them."""
        piece = [solid('wall', (-1.9, -0.03, 0.0), (1.9, 0.03, tall)),
                 solid('wall', (-0.03, -0.9, 0.0), (0.03, 0.9, tall))]
        for x in (-0.95, 0.95):
            for side in (-1, 1):
                yaw = 0.0 if side > 0 else np.pi
                piece += placed(desk(rng), (x, side * 0.5), yaw)
                if rng.random() < 0.9:
                    piece += placed(chair(rng), (x, side * rng.uniform(1.15, 1.4)),
                                    yaw + np.pi + rng.normal(0.0, 0.5))
        return piece
    turns = (0.0,) if rng.random() < 0.5 else (0.5,)
    for _ in range(max(int(0.08 * np.prod(plan.size[:2])), 1)):
        plan.stand(group, 3.9, 3.0, turns)
    _shelves(plan, rng.integers(6, 18))
    _cabinets(plan, rng.integers(3, 10))
    _desks(plan, rng.integers(2, 8))
    _chairs(plan, rng.integers(2, 10))
    _clutter(plan, rng.integers(8, 25))


class Kind(NamedTuple):
    """
    A kind of room.

    :ivar share: how often it is drawn, relative to the others.
    :ivar low: least width, depth and height, metres.
    :ivar high: the largest.
    :ivar corner: chance of an L-shape.
    :ivar furnish: fills it.
    """

    share: float
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    corner: float
    furnish: Callable[[Plan], None]


ROOMS = {
    'office': Kind(0.25, (3.0, 3.5, 2.5), (7.0, 8.5, 3.2), 0.2, office),
    'conference': Kind(0.15, (4.0, 6.0, 2.6), (8.0, 12.0, 3.4), 0.15, conference),
    'lounge': Kind(0.15, (5.0, 5.0, 2.6), (11.0, 12.0, 3.5), 0.35, lounge),
    'hallway': Kind(0.15, (6.0, 8.0, 2.5), (12.0, 15.0, 3.1), 1.0, hallway),
    'storage': Kind(0.10, (4.0, 5.0, 2.5), (8.0, 11.0, 3.4), 0.2, storage),
    'open_office': Kind(0.20, (8.0, 8.0, 2.6), (12.0, 15.0, 3.5), 0.25, open_office),
}


def draw_plan(rng: np.random.Generator) -> Plan:
    """Draw a room of any kind."""
    name = str(rng.choice(list(ROOMS), p=[kind.share for kind in ROOMS.values()]))
    kind = ROOMS[name]
    plan = Plan(name, rng.uniform(kind.low, kind.high), rng)
    if name == 'hallway' and rng.random() < 0.4:
        plan.size[0] = rng.uniform(1.8, 3.2)
        _shell(plan, 0.0)
    else:
        _shell(plan, kind.corner)
    if name != 'hallway':
        if rng.random() < 0.3:
            _niches(plan)
        _columns(plan, rng.choice([0, 0, 1, 2]))
        if name != 'conference' and rng.random() < 0.35:
            _partition(plan, None if rng.random() < 0.6 else rng.uniform(1.2, 2.0))
    _ceiling(plan)
    kind.furnish(plan)
    _fittings(plan)
    return mirrored(plan, rng.random(2) < 0.5)


def mirrored(plan: Plan, flip: np.ndarray) -> Plan:
    """Return a finished room mirrored along x, y or both, (2,) bool; nothing can be added."""
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
    return Plan(plan.kind, plan.size, plan.rng, solids, windows)
