# SPDX-License-Identifier: Apache-2.0
"""Generated furnished rooms: the mesh and the points sampled from it, by seed."""

from dataclasses import dataclass, field

import numpy as np

from ocp_ros.scenes.scene import Mesh, Scene

CLEARANCE = 0.15
WALL_GAP = 0.03


@dataclass
class RoomPlan:
    """
    An axis-aligned room of boxes.

    :ivar size: (3,) metres; the room spans from the origin to it.
    :ivar boxes: solid boxes inside, each (2, 3): lowest and highest corner, metres.
    """

    size: np.ndarray
    boxes: list[np.ndarray] = field(default_factory=list)
    _taken: list[np.ndarray] = field(default_factory=list)

    def add(self, low, high) -> None:
        """Add a solid box."""
        self.boxes.append(np.array([low, high], dtype=np.float64))

    def claim(self, low, high) -> bool:
        """Reserve a footprint (x, y) on the floor if it is free with some clearance."""
        low, high = np.array(low[:2]), np.array(high[:2])
        for other in self._taken:
            if (low - CLEARANCE < other[1]).all() and (high + CLEARANCE > other[0]).all():
                return False
        self._taken.append(np.stack([low, high]))
        return True


def generate_room(seed: int, n_points: int = 15000) -> Scene:
    """
    Make a furnished room: walls, floor, ceiling, partition, pillar, cabinets and tables.

    The floor measures 15 to 85 square metres. The same seed gives the same room.

    :param seed: any non-negative integer.
    :param n_points: how many points to sample, to a few per cent.
    :returns: a scene with its mesh, called ``room-<seed>``.
    """
    rng = np.random.default_rng(seed)
    plan = RoomPlan(_room_size(rng))
    _add_partition(plan, rng)
    _add_pillar(plan, rng)
    for _ in range(rng.integers(2, 6)):
        _add_cabinet(plan, rng)
    for _ in range(rng.integers(1, 5)):
        _add_table(plan, rng)
    return Scene(points=_sample(plan, n_points, rng), name=f'room-{seed}', mesh=_mesh(plan))


def _room_size(rng) -> np.ndarray:
    """Draw width, depth and height of a room of 15 to 85 square metres."""
    while True:
        size = rng.uniform([4.0, 3.5, 2.6], [12.0, 9.0, 3.3])
        if 15.0 <= size[0] * size[1] <= 85.0:
            return size


def _add_partition(plan: RoomPlan, rng) -> None:
    """Stand a thin wall on one side of the room, across 35 to 65 per cent of it."""
    axis = int(rng.integers(2))
    length = rng.uniform(0.35, 0.65) * plan.size[1 - axis]
    at = rng.uniform(0.3, 0.7) * plan.size[axis]
    start = 0.0 if rng.random() < 0.5 else plan.size[1 - axis] - length
    low, high = np.zeros(3), np.array([0.0, 0.0, plan.size[2]])
    low[axis], high[axis] = at - 0.05, at + 0.05
    low[1 - axis], high[1 - axis] = start, start + length
    plan.claim(low, high)
    plan.add(low, high)


def _add_pillar(plan: RoomPlan, rng) -> None:
    """Stand a square pillar from floor to ceiling somewhere free."""
    side = rng.uniform(0.3, 0.6)
    for _ in range(20):
        low = rng.uniform(0.15, 0.85, 2) * (plan.size[:2] - side)
        if plan.claim(low, low + side):
            plan.add([*low, 0.0], [*(low + side), plan.size[2]])
            return


def _add_cabinet(plan: RoomPlan, rng) -> None:
    """Stand a cabinet with its back to one of the four walls."""
    width, depth, height = rng.uniform([0.8, 0.35, 1.0], [2.0, 0.6, 2.2])
    for _ in range(20):
        axis, far_side = int(rng.integers(2)), rng.random() < 0.5
        low = np.zeros(2)
        low[axis] = plan.size[axis] - WALL_GAP - depth if far_side else WALL_GAP
        low[1 - axis] = rng.uniform(0.05, plan.size[1 - axis] - width - 0.05)
        extent = np.array([depth, width] if axis == 0 else [width, depth])
        if plan.claim(low, low + extent):
            plan.add([*low, 0.0], [*(low + extent), height])
            return


def _add_table(plan: RoomPlan, rng) -> None:
    """Stand a table, a slab on four legs, somewhere free."""
    extent = rng.uniform([1.0, 0.6], [2.0, 1.0])
    if rng.random() < 0.5:
        extent = extent[::-1]
    for _ in range(20):
        low = rng.uniform(0.3, plan.size[:2] - extent - 0.3)
        if not plan.claim(low, low + extent):
            continue
        top = rng.uniform(0.70, 0.78)
        plan.add([*low, top - 0.04], [*(low + extent), top])
        for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
            foot = low + corner * (extent - 0.05)
            plan.add([*foot, 0.0], [*(foot + 0.05), top - 0.04])
        return


def _faces(low, high):
    """Yield the six faces of a box: (axis, coordinate, outward sign)."""
    for axis in range(3):
        yield axis, low[axis], -1
        yield axis, high[axis], 1


def _all_faces(plan: RoomPlan):
    """Yield (box index or -1 for the room, axis, coordinate, low, high) of every face."""
    corners = [(-1, np.zeros(3), plan.size)]
    corners += [(i, box[0], box[1]) for i, box in enumerate(plan.boxes)]
    for index, low, high in corners:
        for axis, coordinate, _ in _faces(low, high):
            yield index, axis, coordinate, low, high


def _sample(plan: RoomPlan, n_points: int, rng) -> np.ndarray:
    """Sample the exposed surfaces on jittered grids of one pitch: about (n_points, 3) float32."""
    pitch = 0.1
    for _ in range(6):
        points = _sample_at(plan, pitch, np.random.default_rng(0))
        pitch *= np.sqrt(len(points) / n_points)
    return _sample_at(plan, pitch, rng).astype(np.float32)


def _sample_at(plan: RoomPlan, pitch: float, rng) -> np.ndarray:
    """Sample every face at a pitch in metres and drop what is buried in another solid."""
    parts = []
    for index, axis, coordinate, low, high in _all_faces(plan):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        count = [max(int(round((high[k] - low[k]) / pitch)), 1) for k in (u, v)]
        grid = np.stack(np.meshgrid(np.arange(count[0]), np.arange(count[1]), indexing='ij'), -1)
        unit = (grid.reshape(-1, 2) + rng.uniform(0.15, 0.85, (count[0] * count[1], 2))) / count
        points = np.empty((len(unit), 3))
        points[:, axis] = coordinate
        points[:, u] = low[u] + unit[:, 0] * (high[u] - low[u])
        points[:, v] = low[v] + unit[:, 1] * (high[v] - low[v])
        parts.append(points[_exposed(points, plan, index)])
    return np.concatenate(parts)


def _exposed(points: np.ndarray, plan: RoomPlan, own: int) -> np.ndarray:
    """Tell which points a scan could see: not in or against another solid or the shell."""
    keep = np.ones(len(points), dtype=bool)
    for index, (low, high) in enumerate(plan.boxes):
        if index != own:
            touch = ((points > low - WALL_GAP - 1e-6) & (points < high + WALL_GAP + 1e-6))
            keep &= ~touch.all(axis=1)
    if own >= 0:
        margin = WALL_GAP + 1e-6
        keep &= ((points > margin) & (points < plan.size - margin)).all(axis=1)
    return keep


def _mesh(plan: RoomPlan) -> Mesh:
    """Build the triangles of the room's shell and of every box in it."""
    vertices, triangles = [], []
    for _, axis, coordinate, low, high in _all_faces(plan):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        corners = np.empty((4, 3))
        corners[:, axis] = coordinate
        corners[:, u] = [low[u], high[u], high[u], low[u]]
        corners[:, v] = [low[v], low[v], high[v], high[v]]
        first = 4 * len(vertices)
        vertices.append(corners)
        triangles += [(first, first + 1, first + 2), (first, first + 2, first + 3)]
    return Mesh(np.concatenate(vertices).astype(np.float32), np.array(triangles, dtype=np.int32))
