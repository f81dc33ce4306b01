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

"""Build the fixed parts of a room: walls, columns, ceiling, doors and windows."""

import numpy as np
from ocp_ros.rooms.furniture import placed, solid
from ocp_ros.rooms.room_plan import RoomPlan, RoomWall, WALL_GAP_M


def shell(plan: RoomPlan, corner: float) -> None:
    """
    Build the walls of a rectangular or an L-shaped room.

    :param corner: the probability of an L-shape.
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
        plan.walls.append(RoomWall(start, (end - start) / length, length))


def _block(plan: RoomPlan, low, high, kind: str = 'wall', top: float | None = None) -> bool:
    """Build a box from the floor to the ceiling, or to ``top``, if the floor there is free."""
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    if not plan.claim(low, high, 0.0):
        return False
    plan.solids.append(solid(kind, (*low, 0.0), (*high, plan.size[2] if top is None else top)))
    return True


def niches(plan: RoomPlan) -> None:
    """Build projections along a wall, with niches between them."""
    wall = plan.walls[plan.rng.integers(len(plan.walls))]
    depth, shift = plan.rng.uniform(0.2, 0.7), plan.rng.uniform(0.0, 1.0)
    while shift + 0.5 < wall.length:
        width = min(plan.rng.uniform(0.4, 1.6), wall.length - shift)
        start = wall.start + shift * wall.along
        end = start + width * wall.along + depth * wall.inward
        _block(plan, np.minimum(start, end), np.maximum(start, end))
        shift += width + plan.rng.uniform(0.9, 2.5)


def columns(plan: RoomPlan, count: int) -> None:
    """Build columns at random positions."""
    for _ in range(count):
        side = plan.rng.uniform(0.3, 0.6)
        low = plan.rng.uniform(0.15, 0.85, 2) * (plan.size[:2] - side)
        _block(plan, low, low + side, 'column')


def partition(plan: RoomPlan, top: float | None = None) -> None:
    """Build a thin wall from one side of the room, across 35 to 65 per cent of it."""
    rng = plan.rng
    axis = int(rng.integers(2))
    length = rng.uniform(0.35, 0.65) * plan.size[1 - axis]
    at = rng.uniform(0.3, 0.7) * plan.size[axis]
    start = 0.0 if rng.random() < 0.5 else plan.size[1 - axis] - length
    low, high = np.zeros(2), np.zeros(2)
    low[axis], high[axis] = at - 0.05, at + 0.05
    low[1 - axis], high[1 - axis] = start, start + length
    _block(plan, low, high, top=top)


def ceiling(plan: RoomPlan) -> None:
    """Add beams, ducts and lamps to the ceiling."""
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
                                         (x + 0.6, y + 0.12, h - WALL_GAP_M)))


def openings(plan: RoomPlan, doors: int, windows: int, boards: int) -> None:
    """Add doors, some of them open, windows and boards."""
    rng = plan.rng
    for _ in range(doors):
        opened = rng.random() < 0.3
        angle = rng.uniform(1.0, 1.8) if opened else 0.0
        leaf = placed([solid('door', (0.0, -0.025, 0.01), (0.9, 0.025, rng.uniform(2.0, 2.15)))],
                      (-0.45, 0.0), angle)
        # Metres of floor in front of a door stay free.
        plan.lean(lambda leaf=leaf: leaf, 0.95, 0.05, 0.9)
    for _ in range(windows):
        wall = plan.walls[rng.integers(len(plan.walls))]
        wide, low = rng.uniform(1.0, 3.0), rng.uniform(0.7, 1.0)
        if wall.length < wide + 0.4:
            continue
        start = wall.start + rng.uniform(0.2, wall.length - wide - 0.2) * wall.along
        end = start + wide * wall.along
        high = min(low + rng.uniform(0.9, 1.6), plan.size[2] - 0.2)
        # Glass gives no returns; a blind, the sill and the frame do.
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


def fittings(plan: RoomPlan) -> None:
    """Add objects to the walls: panels, pictures, pipes, heaters, boxes."""
    rng = plan.rng
    for wall in plan.walls:
        for _ in range(rng.poisson(0.5 * wall.length)):
            wide, high, deep = rng.uniform([0.2, 0.2, 0.04], [1.3, 1.0, 0.3])
            if wide + 0.1 > wall.length:
                continue
            low = rng.uniform(0.1, plan.size[2] - high - 0.1)
            at = wall.start + rng.uniform(0.5 * wide, wall.length - 0.5 * wide) * wall.along
            box = solid('clutter', (-0.5 * wide, WALL_GAP_M, low),
                        (0.5 * wide, WALL_GAP_M + deep, low + high))
            plan.solids += placed([box], at, np.arctan2(wall.along[1], wall.along[0]))
