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
Build the fixed parts of a room: walls, columns, ceiling, doors and windows.

Each function draws sizes and positions from the generator of the plan and adds boxes to the plan.
All lengths are metres.
"""

from collections.abc import Sequence

import numpy as np
from ocp_ros.rooms.furniture import make_solid, moved_piece
from ocp_ros.rooms.room_plan import RoomPlan, RoomWall, WALL_GAP_M


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
