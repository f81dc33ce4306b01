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
The kinds of generated rooms: how each is built and furnished.

The kinds and the range of sizes are those of S3DIS rooms that four cameras can roughly cover. All
lengths are metres. All functions draw sizes and positions from the random generator of the plan,
and add boxes to the plan.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from ocp_ros.rooms import furniture
from ocp_ros.rooms.furniture import make_solid, moved_piece, Piece
from ocp_ros.rooms.room_plan import (
    mirrored_plan,
    RoomPlan,
    RoomWall,
    rotated_footprint,
    WALL_GAP_M,
)


def _add_chairs(plan: RoomPlan, count: int) -> None:
    """Place chairs at random positions."""
    for _ in range(count):
        plan.place_freestanding(lambda: moved_piece(
            furniture.build_chair(plan.rng), (0.0, 0.0), plan.rng.uniform(-1.0, 1.0)), 0.6, 0.6)


def _add_bookcases(plan: RoomPlan, count: int, min_height: float = 0.7) -> None:
    """Place bookcases along the walls."""
    _add_at_walls(plan, count, furniture.build_bookcase, [0.8, 0.28, min_height], [1.3, 0.42, 2.2])


def _add_cabinets(plan: RoomPlan, count: int) -> None:
    """Place cabinets along the walls."""
    _add_at_walls(plan, count, furniture.build_cabinet, [0.5, 0.4, 0.7], [1.8, 0.65, 2.1])


def _add_at_walls(plan: RoomPlan, count: int, build: Callable[..., Piece], low: list[float],
                  high: list[float]) -> None:
    """Place pieces of random width, depth and height from ``low`` to ``high`` along the walls."""
    for _ in range(count):
        size = plan.rng.uniform(low, high)
        plan.place_at_wall(partial(build, plan.rng, *size), *size[:2])


def _add_desks(plan: RoomPlan, count: int) -> None:
    """Place desks along the walls, each with its chair."""
    def build_workplace() -> Piece:
        # The chair stands 0.75 m before the middle of the desk and roughly faces it.
        moved_chair = moved_piece(
            furniture.build_chair(plan.rng), (plan.rng.uniform(-0.25, 0.25), 0.75),
            np.pi + plan.rng.normal(0.0, 0.5))
        return furniture.build_desk(plan.rng) + moved_chair
    for _ in range(count):
        plan.place_at_wall(build_workplace, width=1.6, depth=0.75, front=0.8)


def _add_clutter(plan: RoomPlan, count: int) -> None:
    """Place boxes, bins and bags on the floor."""
    for _ in range(count):
        edge = plan.rng.uniform(0.2, 0.6)
        build_box = partial(furniture.scatter_boxes, plan.rng, edge, edge, height=0.0, count=1)
        plan.place_freestanding(build_box, edge, edge)


def _add_pieces(plan: RoomPlan, **counts: tuple[int, int]) -> None:
    """Add pieces kind by kind: random counts from the first number to below the second."""
    functions = {'desks': _add_desks, 'shelves': _add_bookcases, 'cabinets': _add_cabinets,
                 'chairs': _add_chairs, 'clutter': _add_clutter}
    for kind, (low, high) in counts.items():
        functions[kind](plan, plan.rng.integers(low, high))


def _add_table_with_chairs(plan: RoomPlan, width: float, depth: float, chair_spacing: float
                           ) -> None:
    """Place a table with chairs on both long sides, one per ``chair_spacing`` metres."""
    def build_group() -> Piece:
        piece = furniture.build_table(plan.rng, width, depth)
        for side in (-1, 1):
            for x in np.arange(-0.5 * width + 0.5 * chair_spacing, 0.5 * width, chair_spacing):
                if plan.rng.random() < 0.85:
                    # Chairs roughly face the table.
                    yaw = (0.0 if side < 0 else np.pi) + plan.rng.normal(0.0, 0.3)
                    position = (x + plan.rng.normal(0, 0.05),
                                side * (0.5 * depth + plan.rng.uniform(0.0, 0.4)))
                    piece += moved_piece(furniture.build_chair(plan.rng), position, yaw)
        return piece
    plan.place_freestanding(build_group, width=width + 0.2, depth=depth + 1.3)


def furnish_office(plan: RoomPlan) -> None:
    """Furnish an office of one to four workplaces."""
    rng = plan.rng
    add_openings(plan, doors=rng.integers(1, 3), windows=rng.integers(0, 3),
                 boards=rng.integers(0, 2))
    _add_pieces(plan, desks=(1, 5), shelves=(2, 9), cabinets=(1, 5))
    if rng.random() < 0.5:
        _add_table_with_chairs(plan, rng.uniform(0.9, 1.4), 0.9, 0.7)
    _add_pieces(plan, chairs=(0, 4), clutter=(3, 10))


def furnish_conference(plan: RoomPlan) -> None:
    """Furnish a conference room: a long table, chairs, boards, cabinets, shelves."""
    rng = plan.rng
    add_openings(plan, doors=rng.integers(1, 4), windows=rng.integers(0, 4),
                 boards=rng.integers(1, 3))
    longer_side = max(plan.size[0], plan.size[1])
    _add_table_with_chairs(plan, rng.uniform(0.4, 0.65) * longer_side, rng.uniform(1.1, 1.8), 0.65)
    if rng.random() < 0.3:
        _add_table_with_chairs(plan, 1.6, 0.8, 0.7)
    _add_pieces(plan, chairs=(2, 12), cabinets=(1, 5), shelves=(0, 4), clutter=(1, 6))


def furnish_lounge(plan: RoomPlan) -> None:
    """Furnish a lounge: a counter, sofas, low tables, small tables with chairs, shelves."""
    rng = plan.rng
    add_openings(plan, doors=rng.integers(1, 5), windows=rng.integers(1, 4),
                 boards=rng.integers(0, 2))
    # A cabinet serves as the counter.
    width = rng.uniform(1.5, 3.5)
    plan.place_at_wall(partial(furniture.build_cabinet, rng, width, 0.62, 0.92), width, 0.62, 0.7)
    # Armchairs and sofas.
    for _ in range(rng.integers(2, 5)):
        width = rng.choice([0.85, 1.6, 2.1])
        plan.place_at_wall(partial(furniture.build_sofa, rng, width), width, depth=0.85, front=0.4)

    def build_sofa_with_table() -> Piece:
        sofa = furniture.build_sofa(rng, 1.6)
        # A low table: only the slab of a table, which is its first box, 0.3 m lower.
        slab = furniture.build_table(rng, 1.0, 0.6)[:1]
        return sofa + moved_piece(slab, (0.0, 1.1), 0.0, height=-0.3)
    for _ in range(rng.integers(0, 3)):
        plan.place_freestanding(build_sofa_with_table, width=1.7, depth=3.0)
    for _ in range(rng.integers(1, 5)):
        _add_table_with_chairs(plan, rng.uniform(0.8, 1.8), 0.8, 0.6)
    _add_pieces(plan, shelves=(1, 7), cabinets=(1, 6), chairs=(0, 6), clutter=(3, 12))


def furnish_hallway(plan: RoomPlan) -> None:
    """Furnish a hallway: doors, boards, a few cabinets and shelves."""
    rng = plan.rng
    add_openings(plan, doors=rng.integers(4, 9), windows=rng.integers(0, 2),
                 boards=rng.integers(0, 4))
    _add_pieces(plan, cabinets=(1, 6), shelves=(0, 6), clutter=(1, 8))


def furnish_storage(plan: RoomPlan) -> None:
    """Furnish a storage room: rows of bookcases with aisles, cabinets, boxes."""
    rng = plan.rng
    add_openings(plan, doors=1, windows=rng.integers(0, 2), boards=0)
    # Rows run along the longer axis; ``offset`` is the distance of a row from one long wall.
    axis = int(plan.size[1] > plan.size[0])
    length, breadth = plan.size[axis], plan.size[1 - axis]
    offset = rng.uniform(0.9, 1.6)
    while offset + 1.0 < breadth:
        depth, height = rng.uniform(0.4, 0.8), rng.uniform(1.2, 2.3)
        # A row leaves 1 m of floor at its start and at least 0.6 m at its end.
        position = 1.0
        while position + 1.0 < length - 0.8:
            width = rng.uniform(0.9, 1.2)
            centre = np.array([position + 0.5 * width, offset + 0.5 * depth])
            yaw = rng.choice([0.0, np.pi])
            # In a room that is longer along y, x and y are exchanged.
            if axis == 1:
                centre = centre[::-1]
                yaw += 0.5 * np.pi
            half_extent = 0.5 * rotated_footprint(width, depth, yaw)
            # A bookcase stands at 85 % of the positions, if ``claim_floor`` can reserve the floor.
            if rng.random() < 0.85 and plan.claim_floor(
                    centre - half_extent, centre + half_extent, clearance=0.0):
                bookcase = furniture.build_bookcase(rng, width, depth, height)
                plan.solids += moved_piece(bookcase, centre, yaw)
            position += width
        offset += depth + rng.uniform(0.9, 1.6)
    _add_bookcases(plan, rng.integers(1, 5), min_height=1.4)
    _add_pieces(plan, cabinets=(1, 6), clutter=(8, 20))


def furnish_open_office(plan: RoomPlan) -> None:
    """Furnish an open office: groups of desks between screens, other desks, shelves, cabinets."""
    rng = plan.rng
    add_openings(plan, doors=rng.integers(2, 7), windows=rng.integers(2, 6),
                 boards=rng.integers(0, 3))
    screen_height = rng.choice([1.1, 1.4, 1.7])

    def build_desk_group() -> Piece:
        """Build two crossing screens and four desks between them, most with a chair."""
        piece = [make_solid('wall', (-1.9, -0.03, 0.0), (1.9, 0.03, screen_height)),
                 make_solid('wall', (-0.03, -0.9, 0.0), (0.03, 0.9, screen_height))]
        for x in (-0.95, 0.95):
            for side in (-1, 1):
                yaw = 0.0 if side > 0 else np.pi
                piece += moved_piece(furniture.build_desk(rng), (x, side * 0.5), yaw)
                if rng.random() < 0.9:
                    piece += moved_piece(
                        furniture.build_chair(rng), (x, side * rng.uniform(1.15, 1.4)),
                        yaw + np.pi + rng.normal(0.0, 0.5))
        return piece
    # All groups have the same yaw, 0 or 90 degrees.
    half_turns = (0.0,) if rng.random() < 0.5 else (0.5,)
    # One group for 12.5 m2 of floor, if there is a free position for it.
    for _ in range(max(int(0.08 * np.prod(plan.size[:2])), 1)):
        plan.place_freestanding(build_desk_group, width=3.9, depth=3.0, half_turns=half_turns)
    _add_pieces(plan, shelves=(6, 18), cabinets=(3, 10), desks=(2, 8), chairs=(2, 10),
                clutter=(8, 25))


class RoomKind(NamedTuple):
    """
    A kind of room.

    :ivar share: the probability of the kind.
    :ivar low: the least width, depth and height, metres.
    :ivar high: the largest width, depth and height, metres.
    :ivar l_shape_probability: the probability of an L-shape.
    :ivar furnish: the function that furnishes the room.
    """

    share: float
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    l_shape_probability: float
    furnish: Callable[[RoomPlan], None]


ROOM_KINDS = {
    'office': RoomKind(0.25, (3.0, 3.5, 2.5), (7.0, 8.5, 3.2), 0.2, furnish_office),
    'conference': RoomKind(0.15, (4.0, 6.0, 2.6), (8.0, 12.0, 3.4), 0.15, furnish_conference),
    'lounge': RoomKind(0.15, (5.0, 5.0, 2.6), (11.0, 12.0, 3.5), 0.35, furnish_lounge),
    'hallway': RoomKind(0.15, (6.0, 8.0, 2.5), (12.0, 15.0, 3.1), 1.0, furnish_hallway),
    'storage': RoomKind(0.10, (4.0, 5.0, 2.5), (8.0, 11.0, 3.4), 0.2, furnish_storage),
    'open_office': RoomKind(0.20, (8.0, 8.0, 2.6), (12.0, 15.0, 3.5), 0.25, furnish_open_office),
}


def draw_plan(rng: np.random.Generator) -> RoomPlan:
    """Return a random room of a random kind."""
    name = str(rng.choice(list(ROOM_KINDS), p=[kind.share for kind in ROOM_KINDS.values()]))
    kind = ROOM_KINDS[name]
    plan = RoomPlan(name, rng.uniform(kind.low, kind.high), rng)
    # Two of five hallways are straight and narrow; the others are L-shaped.
    if name == 'hallway' and rng.random() < 0.4:
        plan.size[0] = rng.uniform(1.8, 3.2)
        build_walls(plan, l_shape_probability=0.0)
    else:
        build_walls(plan, kind.l_shape_probability)
    if name != 'hallway':
        if rng.random() < 0.3:
            build_niches(plan)
        build_columns(plan, rng.choice([0, 0, 1, 2]))
        if name != 'conference' and rng.random() < 0.35:
            build_partition(plan, None if rng.random() < 0.6 else rng.uniform(1.2, 2.0))
    add_beams_and_lamps(plan)
    kind.furnish(plan)
    add_fittings(plan)
    return mirrored_plan(plan, rng.random(2) < 0.5)


def build_walls(plan: RoomPlan, l_shape_probability: float) -> None:
    """Build the walls of a rectangular room, or at random of an L-shaped room."""
    width, depth, _ = plan.size
    rng = plan.rng
    if rng.random() < l_shape_probability:
        cut_width, cut_depth = rng.uniform(0.25, 0.6, 2) * (width, depth)
        if plan.kind == 'hallway':
            # The two arms of a hallway are 1.8 to 2.8 m wide.
            cut_width, cut_depth = np.array([width, depth]) - rng.uniform(1.8, 2.8, 2)
        # The inner corner of the L. A solid box fills the part that is cut out.
        x, y = width - cut_width, depth - cut_depth
        _build_box(plan, (x, y), (width, depth))
        corners = [(0, 0), (width, 0), (width, y), (x, y), (x, depth), (0, depth)]
    else:
        corners = [(0, 0), (width, 0), (width, depth), (0, depth)]
    # The corners are counter-clockwise, so that the room is on the left of each wall.
    corners = np.array(corners, dtype=np.float64)
    for start, end in zip(corners, np.roll(corners, -1, axis=0)):
        length = float(np.linalg.norm(end - start))
        plan.walls.append(RoomWall(start, (end - start) / length, length))


def _build_box(plan: RoomPlan, low: Sequence[float], high: Sequence[float], kind: str = 'wall',
               height: float | None = None) -> None:
    """
    Build a box on a rectangle of the floor, if the rectangle is free.

    :param low: (2,) the lowest corner of the rectangle.
    :param high: (2,) its highest corner.
    :param height: the height of the box; None for that of the room.
    """
    if plan.claim_floor(low, high, clearance=0.0):
        plan.add_box(kind, (*low, 0.0), (*high, plan.size[2] if height is None else height))


def build_niches(plan: RoomPlan) -> None:
    """Build boxes along one wall, with niches between them."""
    wall = plan.walls[plan.rng.integers(len(plan.walls))]
    # ``distance`` is that of the next box from the start of the wall.
    depth, distance = plan.rng.uniform(0.2, 0.7), plan.rng.uniform(0.0, 1.0)
    while distance + 0.5 < wall.length:
        width = min(plan.rng.uniform(0.4, 1.6), wall.length - distance)
        start = wall.start + distance * wall.along
        end = start + width * wall.along + depth * wall.inward
        _build_box(plan, np.minimum(start, end), np.maximum(start, end))
        distance += width + plan.rng.uniform(0.9, 2.5)


def build_columns(plan: RoomPlan, count: int) -> None:
    """Build up to ``count`` columns at random positions."""
    for _ in range(count):
        side = plan.rng.uniform(0.3, 0.6)
        low = plan.rng.uniform(0.15, 0.85, 2) * (plan.size[:2] - side)
        _build_box(plan, low, low + side, 'column')


def build_partition(plan: RoomPlan, height: float | None = None) -> None:
    """
    Build a wall 10 cm thick from a side of the room across 35 to 65 % of it.

    :param height: the height of the wall; None for that of the room.
    """
    rng = plan.rng
    # The wall is normal to this axis.
    axis = int(rng.integers(2))
    length = rng.uniform(0.35, 0.65) * plan.size[1 - axis]
    middle = rng.uniform(0.3, 0.7) * plan.size[axis]
    start = 0.0 if rng.random() < 0.5 else plan.size[1 - axis] - length
    low, high = np.zeros(2), np.zeros(2)
    low[axis], high[axis] = middle - 0.05, middle + 0.05
    low[1 - axis], high[1 - axis] = start, start + length
    _build_box(plan, low, high, height=height)


def add_beams_and_lamps(plan: RoomPlan) -> None:
    """Add beams, ducts and lamps to the ceiling."""
    room_width, room_depth, height = plan.size
    rng = plan.rng
    # Beams and ducts run along this axis.
    axis = int(rng.integers(2))
    for _ in range(rng.choice([0, 0, 1, 2, 3])):
        beam_width, beam_height = rng.uniform(0.2, 0.45, 2)
        offset = rng.uniform(0.1, 0.9) * (plan.size[1 - axis] - beam_width)
        low, high = np.array([0.0, 0.0, height - beam_height]), plan.size.copy()
        low[1 - axis], high[1 - axis] = offset, offset + beam_width
        plan.add_box('beam', low, high)
    # Lamps hang on a grid of 2.4 m; 40 % of its positions stay empty.
    for x in np.arange(1.2, room_width - 0.6, 2.4):
        for y in np.arange(1.2, room_depth - 0.3, 2.4):
            if rng.random() < 0.6:
                plan.add_box('clutter', (x - 0.6, y - 0.12, height - 0.11),
                             (x + 0.6, y + 0.12, height - WALL_GAP_M))


def add_openings(plan: RoomPlan, doors: int, windows: int, boards: int) -> None:
    """Add at most these numbers of doors, windows and boards; some doors are open."""
    for add, count in ((_add_door, doors), (_add_window, windows), (_add_board, boards)):
        for _ in range(count):
            add(plan)


def _add_door(plan: RoomPlan) -> None:
    """Add a door to a random wall; three of ten are open."""
    rng = plan.rng
    is_open = rng.random() < 0.3
    angle = rng.uniform(1.0, 1.8) if is_open else 0.0
    leaf = make_solid('door', (0.0, -0.025, 0.01), (0.9, 0.025, rng.uniform(2.0, 2.15)))
    # The leaf is rotated about its hinge, the origin, and then moved by half its width, so that a
    # closed leaf is centred.
    door = moved_piece([leaf], (-0.45, 0.0), angle)
    # place_at_wall expects a function that builds the piece: this one returns the finished door.
    plan.place_at_wall(lambda: door, width=0.95, depth=0.05, front=0.9)


def _add_window(plan: RoomPlan) -> None:
    """Add a window to a random wall: glass or a blind, a sill, a frame; none to a short wall."""
    rng = plan.rng
    wall = plan.walls[rng.integers(len(plan.walls))]
    width, low = rng.uniform(1.0, 3.0), rng.uniform(0.7, 1.0)
    if wall.length < width + 0.4:
        return
    start = wall.start + rng.uniform(0.2, wall.length - width - 0.2) * wall.along
    end = start + width * wall.along
    high = min(low + rng.uniform(0.9, 1.6), plan.size[2] - 0.2)

    def add_box(corner: np.ndarray, opposite: np.ndarray, bottom: float, top: float) -> None:
        plan.add_box('window', (*np.minimum(corner, opposite), bottom),
                     (*np.maximum(corner, opposite), top))

    # Glass gives no returns; a blind, the sill and the frame do. The box around the glass
    # reaches 1 cm out of the wall on both sides, since it has to contain points of the wall.
    if rng.random() < 0.4:
        plan.windows.append(np.array([[*(np.minimum(start, end) - 0.01), low],
                                      [*(np.maximum(start, end) + 0.01), high]]))
    else:
        add_box(start + 0.04 * wall.inward, end + 0.07 * wall.inward, low, high)
    # The sill, and the frame at one end of the window.
    add_box(start, end + 0.15 * wall.inward, low - 0.05, low)
    add_box(end - 0.06 * wall.along, end + 0.05 * wall.inward, low, high)


def _add_board(plan: RoomPlan) -> None:
    """Add a board to a random wall."""
    width = plan.rng.uniform(1.2, 3.0)
    board = make_solid('board', (-0.5 * width, -0.02, 0.85), (0.5 * width, 0.02, 2.05))
    plan.place_at_wall(lambda: [board], width, depth=0.04, front=0.2)


def add_fittings(plan: RoomPlan) -> None:
    """Add boxes to all walls, such as panels, pictures, pipes and heaters."""
    rng = plan.rng
    for wall in plan.walls:
        for _ in range(rng.poisson(0.5 * wall.length)):
            width, height, depth = rng.uniform([0.2, 0.2, 0.04], [1.3, 1.0, 0.3])
            if width + 0.1 > wall.length:
                continue
            low = rng.uniform(0.1, plan.size[2] - height - 0.1)
            distance = rng.uniform(0.5 * width, wall.length - 0.5 * width)
            position = wall.start + distance * wall.along
            box = make_solid('clutter', (-0.5 * width, WALL_GAP_M, low),
                             (0.5 * width, WALL_GAP_M + depth, low + height))
            plan.solids += moved_piece([box], position, np.arctan2(wall.along[1], wall.along[0]))
