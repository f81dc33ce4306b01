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
The kinds of generated rooms, and how each is furnished.

The kinds and the range of sizes are those of S3DIS rooms that four cameras can roughly cover. All
lengths are metres.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from ocp_ros.rooms.building import (
    ceiling,
    columns,
    fittings,
    niches,
    openings,
    partition,
    shell,
)
from ocp_ros.rooms.furniture import (
    bookcase,
    cabinet,
    chair,
    desk,
    Piece,
    placed,
    sofa,
    solid,
    table,
    things,
)
from ocp_ros.rooms.room_plan import footprint, mirrored, RoomPlan


def _chairs(plan: RoomPlan, count: int) -> None:
    """Place chairs at random positions."""
    for _ in range(count):
        plan.stand(lambda: placed(chair(plan.rng), (0.0, 0.0), plan.rng.uniform(-1.0, 1.0)),
                   0.6, 0.6)


def _shelves(plan: RoomPlan, count: int, low: float = 0.7, high: float = 2.2) -> None:
    """Place bookcases along the walls."""
    for _ in range(count):
        width, depth, height = plan.rng.uniform([0.8, 0.28, low], [1.3, 0.42, high])
        plan.lean(lambda w=width, d=depth, h=height: bookcase(plan.rng, w, d, h), width, depth)


def _cabinets(plan: RoomPlan, count: int) -> None:
    """Place cabinets along the walls."""
    for _ in range(count):
        width, depth, height = plan.rng.uniform([0.5, 0.4, 0.7], [1.8, 0.65, 2.1])
        plan.lean(lambda w=width, d=depth, h=height: cabinet(plan.rng, w, d, h), width, depth)


def _desks(plan: RoomPlan, count: int) -> None:
    """Place desks along the walls, each with its chair."""
    def workplace() -> Piece:
        seat = placed(chair(plan.rng), (plan.rng.uniform(-0.25, 0.25), 0.75),
                      np.pi + plan.rng.normal(0.0, 0.5))
        return desk(plan.rng) + seat
    for _ in range(count):
        plan.lean(workplace, 1.6, 0.75, 0.8)


def _clutter(plan: RoomPlan, count: int) -> None:
    """Place boxes, bins and bags on the floor."""
    for _ in range(count):
        size = plan.rng.uniform(0.2, 0.6)
        plan.stand(lambda s=size: things(plan.rng, s, s, 0.0, 1), size, size)


def _fill(plan: RoomPlan, **counts: tuple[int, int]) -> None:
    """Add pieces kind by kind; each count is drawn from the first to below the second number."""
    pieces = {'desks': _desks, 'shelves': _shelves, 'cabinets': _cabinets, 'chairs': _chairs,
              'clutter': _clutter}
    for kind, (low, high) in counts.items():
        pieces[kind](plan, plan.rng.integers(low, high))


def _seated_table(plan: RoomPlan, width: float, depth: float, every: float) -> None:
    """Place a table with chairs on both long sides."""
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


def office(plan: RoomPlan) -> None:
    """Furnish an office of one to four workplaces."""
    rng = plan.rng
    openings(plan, rng.integers(1, 3), rng.integers(0, 3), rng.integers(0, 2))
    _fill(plan, desks=(1, 5), shelves=(2, 9), cabinets=(1, 5))
    if rng.random() < 0.5:
        _seated_table(plan, rng.uniform(0.9, 1.4), 0.9, 0.7)
    _fill(plan, chairs=(0, 4), clutter=(3, 10))


def conference(plan: RoomPlan) -> None:
    """Furnish a conference room: a long table, chairs, boards."""
    rng = plan.rng
    openings(plan, rng.integers(1, 4), rng.integers(0, 4), rng.integers(1, 3))
    long = max(plan.size[0], plan.size[1])
    _seated_table(plan, rng.uniform(0.4, 0.65) * long, rng.uniform(1.1, 1.8), 0.65)
    if rng.random() < 0.3:
        _seated_table(plan, 1.6, 0.8, 0.7)
    _fill(plan, chairs=(2, 12), cabinets=(1, 5), shelves=(0, 4), clutter=(1, 6))


def lounge(plan: RoomPlan) -> None:
    """Furnish a lounge: sofas around low tables, a counter, small tables."""
    rng = plan.rng
    openings(plan, rng.integers(1, 5), rng.integers(1, 4), rng.integers(0, 2))
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
    _fill(plan, shelves=(1, 7), cabinets=(1, 6), chairs=(0, 6), clutter=(3, 12))


def hallway(plan: RoomPlan) -> None:
    """Furnish a hallway: doors, boards and a few cabinets."""
    rng = plan.rng
    openings(plan, rng.integers(4, 9), rng.integers(0, 2), rng.integers(0, 4))
    _fill(plan, cabinets=(1, 6), shelves=(0, 6), clutter=(1, 8))


def storage(plan: RoomPlan) -> None:
    """Fill a storage room: rows of shelves with aisles, cabinets, boxes."""
    rng = plan.rng
    openings(plan, 1, rng.integers(0, 2), 0)
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
    _fill(plan, cabinets=(1, 6), clutter=(8, 20))


def open_office(plan: RoomPlan) -> None:
    """Furnish an open office: groups of desks between screens, columns, shelves."""
    rng = plan.rng
    openings(plan, rng.integers(2, 7), rng.integers(2, 6), rng.integers(0, 3))
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
    _fill(plan, shelves=(6, 18), cabinets=(3, 10), desks=(2, 8), chairs=(2, 10), clutter=(8, 25))


class RoomKind(NamedTuple):
    """
    A kind of room.

    :ivar share: the probability of the kind, relative to the others.
    :ivar low: the least width, depth and height, metres.
    :ivar high: the largest width, depth and height, metres.
    :ivar corner: the probability of an L-shape.
    :ivar furnish: the function that furnishes the room.
    """

    share: float
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    corner: float
    furnish: Callable[[RoomPlan], None]


ROOMS = {
    'office': RoomKind(0.25, (3.0, 3.5, 2.5), (7.0, 8.5, 3.2), 0.2, office),
    'conference': RoomKind(0.15, (4.0, 6.0, 2.6), (8.0, 12.0, 3.4), 0.15, conference),
    'lounge': RoomKind(0.15, (5.0, 5.0, 2.6), (11.0, 12.0, 3.5), 0.35, lounge),
    'hallway': RoomKind(0.15, (6.0, 8.0, 2.5), (12.0, 15.0, 3.1), 1.0, hallway),
    'storage': RoomKind(0.10, (4.0, 5.0, 2.5), (8.0, 11.0, 3.4), 0.2, storage),
    'open_office': RoomKind(0.20, (8.0, 8.0, 2.6), (12.0, 15.0, 3.5), 0.25, open_office),
}


def draw_plan(rng: np.random.Generator) -> RoomPlan:
    """Draw a room of any kind."""
    name = str(rng.choice(list(ROOMS), p=[kind.share for kind in ROOMS.values()]))
    kind = ROOMS[name]
    plan = RoomPlan(name, rng.uniform(kind.low, kind.high), rng)
    if name == 'hallway' and rng.random() < 0.4:
        plan.size[0] = rng.uniform(1.8, 3.2)
        shell(plan, 0.0)
    else:
        shell(plan, kind.corner)
    if name != 'hallway':
        if rng.random() < 0.3:
            niches(plan)
        columns(plan, rng.choice([0, 0, 1, 2]))
        if name != 'conference' and rng.random() < 0.35:
            partition(plan, None if rng.random() < 0.6 else rng.uniform(1.2, 2.0))
    ceiling(plan)
    kind.furnish(plan)
    fittings(plan)
    return mirrored(plan, rng.random(2) < 0.5)
