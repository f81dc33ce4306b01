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
Simulate a scan of a plan by a depth camera on a few tripods, with occlusion.

The density of points falls with distance and slant, returns have errors along the ray, and glass
and dark surfaces give no returns.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.rooms.furniture import KINDS
from ocp_ros.rooms.room_plan import RoomPlan, WALL_GAP_M
from ocp_ros.util.kernels import njit

#: Metres: an object this near to the end of a ray does not occlude it.
OCCLUSION_TOLERANCE_M = 0.01


class ScannedSurface(NamedTuple):
    """
    Points on the surfaces of a plan.

    :ivar points: (N, 3) float64, metres.
    :ivar normals: (N, 3) unit vectors.
    :ivar owner: (N,) int64, the number of the solid; -1 for the shell.
    :ivar kind: (N,) int64, index into ``KINDS``.
    """

    points: np.ndarray
    normals: np.ndarray
    owner: np.ndarray
    kind: np.ndarray

    def only(self, keep: np.ndarray) -> 'ScannedSurface':
        """Return the part that a mask keeps."""
        return ScannedSurface(*(values[keep] for values in self))


class Boxes(NamedTuple):
    """
    Solids as arrays.

    :ivar centre: (B, 3) metres.
    :ivar half: (B, 3) half their edges.
    :ivar turn: (B, 2) cosine and sine of their yaw.
    """

    centre: np.ndarray
    half: np.ndarray
    turn: np.ndarray


def boxes_of(plan: RoomPlan) -> Boxes:
    """Return the solids of a plan as arrays."""
    yaw = np.array([part.yaw for part in plan.solids])
    return Boxes(np.array([part.centre for part in plan.solids]).reshape(-1, 3),
                 0.5 * np.array([part.size for part in plan.solids]).reshape(-1, 3),
                 np.stack([np.cos(yaw), np.sin(yaw)], axis=1))


def scan(plan: RoomPlan, n_points: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """
    Scan a room.

    :param plan: the room.
    :param n_points: the number of returns wanted, to a few per cent.
    :param rng: the random generator for tripods, patches and noise.
    :returns: (N, 3) float32, metres, and (N,) the kind of surface, an index into ``KINDS``.
    """
    boxes = boxes_of(plan)
    tripods = _tripods(plan, boxes, rng)
    patches = _patches(plan, rng)
    found = _near_count(n_points, rng, lambda pitch, rng: _returns(
        plan, boxes, tripods, patches, pitch, rng))
    offset = found.points[:, None] - tripods[None]
    nearest = np.argmin((offset ** 2).sum(axis=2), axis=1)
    ray = offset[np.arange(len(nearest)), nearest]
    distance = np.linalg.norm(ray, axis=1, keepdims=True)
    # The standard deviation along a ray: 2 mm, and 1 mm per metre.
    noise = rng.normal(0.0, 0.002 + 0.001 * distance)
    points = found.points + noise * ray / np.maximum(distance, 1e-9)
    return points.astype(np.float32), found.kind


def sample(plan: RoomPlan, n_points: int, rng: np.random.Generator) -> np.ndarray:
    """
    Sample all exposed surfaces of a room evenly and exactly.

    :returns: (N, 3) float32, metres.
    """
    boxes = boxes_of(plan)
    found = _near_count(n_points, rng, lambda pitch, rng: _outside(plan, boxes, pitch, rng))
    return found.points.astype(np.float32)


def _near_count(n_points: int, rng: np.random.Generator,
                take: Callable[[float, np.random.Generator], ScannedSurface]) -> ScannedSurface:
    """Sample points at the pitch that gives about ``n_points`` of them."""
    pitch = 0.2
    for _ in range(4):
        found = take(pitch, np.random.default_rng(0))
        pitch *= np.sqrt(max(len(found.points), 1) / n_points)
    return take(pitch, rng)


def _outside(plan: RoomPlan, boxes: Boxes, pitch: float,
             rng: np.random.Generator) -> ScannedSurface:
    """Sample the surfaces at a pitch, except parts inside or against another solid."""
    surface = surface_of(plan, pitch, rng)
    return surface.only(exposed(surface.points, surface.owner, plan.size, *boxes, WALL_GAP_M))


def _returns(plan: RoomPlan, boxes: Boxes, tripods: np.ndarray, patches: np.ndarray, pitch: float,
             rng: np.random.Generator) -> ScannedSurface:
    """Sample the surfaces at a pitch and keep the points that return a signal to a tripod."""
    surface = _outside(plan, boxes, pitch, rng)
    density = densities(surface.points, surface.normals, surface.owner, tripods, *boxes)
    for low, high in plan.windows:
        density[(surface.owner < 0)
                & ((surface.points > low) & (surface.points < high)).all(axis=1)] = 0.0
    for *centre, radius in patches:
        density[((surface.points - centre) ** 2).sum(axis=1) < radius ** 2] = 0.0
    well = np.percentile(density[density > 0.0], 60.0) if density.any() else 1.0
    chance = np.clip(np.sqrt(density / well), 0.4, 1.0)
    return surface.only((density > 0.0) & (rng.random(len(chance)) < chance))


def surface_of(plan: RoomPlan, pitch: float, rng: np.random.Generator) -> ScannedSurface:
    """Sample the shell and all faces of all solids on jittered grids."""
    index = {kind: k for k, kind in enumerate(KINDS)}
    parts = []
    for owner in range(-1, len(plan.solids)):
        for axis in range(3):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            size = plan.size if owner < 0 else plan.solids[owner].size
            # Faces narrower than the pitch get a row of points with a probability below 1.
            count = [int(size[k] / pitch + rng.random()) for k in (u, v)]
            if not count[0] * count[1]:
                continue
            for sign in (-1.0, 1.0):
                cells = np.stack(np.meshgrid(*map(np.arange, count), indexing='ij'), axis=-1)
                unit = (cells.reshape(-1, 2)
                        + rng.uniform(0.15, 0.85, (count[0] * count[1], 2))) / count - 0.5
                points, normals = np.empty((len(unit), 3)), np.zeros((len(unit), 3))
                points[:, axis], normals[:, axis] = 0.5 * sign * size[axis], sign
                points[:, u], points[:, v] = unit[:, 0] * size[u], unit[:, 1] * size[v]
                if owner < 0:
                    points += 0.5 * plan.size
                    kind = 'wall' if axis < 2 else 'floor' if sign < 0 else 'ceiling'
                else:
                    part = plan.solids[owner]
                    turn = rotation_matrix(part.yaw).T
                    points, normals = points @ turn + part.centre, normals @ turn
                    kind = part.kind
                parts.append((points, normals, np.full(len(points), owner),
                              np.full(len(points), index[kind])))
    return ScannedSurface(*(np.concatenate(values) for values in zip(*parts)))


def _tripods(plan: RoomPlan, boxes: Boxes, rng: np.random.Generator) -> np.ndarray:
    """Place tripods where there is room for them: (T, 3) metres."""
    # One tripod for 10 m2 of floor.
    count = int(np.clip(np.prod(plan.size[:2]) / 10.0, 2, 10))
    found: list[np.ndarray] = []
    free_air_m = 0.3
    for trial in range(200 * count):
        low = min(free_air_m, 0.4 * plan.size[:2].min())
        at = np.append(rng.uniform(low, plan.size[:2] - low), rng.uniform(1.3, 1.7))
        # In a crowded room the required free air decreases with the attempts.
        air = free_air_m * (1.0 - trial / (200.0 * count))
        apart = min((np.linalg.norm(at[:2] - other[:2]) for other in found), default=np.inf)
        if free(at, air, *boxes) and apart > 1.2 * (1.0 - trial / (200.0 * count)):
            found.append(at)
            if len(found) == count:
                break
    return np.array(found).reshape(-1, 3)


def _patches(plan: RoomPlan, rng: np.random.Generator) -> np.ndarray:
    """Draw patches that give no returns: (P, 4) centre and radius, metres."""
    surface = surface_of(plan, 0.3, rng)
    # One dark or shiny patch for 12 m2 of floor.
    count = rng.poisson(np.prod(plan.size[:2]) / 12.0)
    centres = surface.points[rng.integers(len(surface.points), size=count)]
    # The radius of a patch, metres.
    return np.column_stack([centres, rng.uniform(0.12, 0.45, count)])


@njit(cache=True, nogil=True)
def exposed(points, owner, size, centre, half, turn, gap):
    """Return which points (N, 3) are more than ``gap`` metres from other solids and the shell."""
    keep = np.ones(len(points), dtype=np.bool_)
    for i in range(len(points)):
        x, y, z = points[i]
        if owner[i] >= 0:
            margin = gap + 1e-6
            if not (margin < x < size[0] - margin and margin < y < size[1] - margin
                    and margin < z < size[2] - margin):
                keep[i] = False
                continue
        for k in range(len(centre)):
            if k == owner[i] or abs(z - centre[k, 2]) > half[k, 2] + gap + 1e-6:
                continue
            dx, dy = x - centre[k, 0], y - centre[k, 1]
            along = dx * turn[k, 0] + dy * turn[k, 1]
            across = dy * turn[k, 0] - dx * turn[k, 1]
            if abs(along) < half[k, 0] + gap + 1e-6 and abs(across) < half[k, 1] + gap + 1e-6:
                keep[i] = False
                break
    return keep


@njit(cache=True, nogil=True)
def free(at, air, centre, half, turn):
    """Return whether a position (3,) is farther than ``air`` metres from all solids."""
    for k in range(len(centre)):
        dx, dy = at[0] - centre[k, 0], at[1] - centre[k, 1]
        along = abs(dx * turn[k, 0] + dy * turn[k, 1]) - half[k, 0]
        across = abs(dy * turn[k, 0] - dx * turn[k, 1]) - half[k, 1]
        up = abs(at[2] - centre[k, 2]) - half[k, 2]
        if max(along, max(across, up)) < air:
            return False
    return True


@njit(cache=True, nogil=True)
def densities(points, normals, owner, tripods, centre, half, turn):
    """
    Return the sampling density of each point (N,): the sum of cosine over squared distance.

    Distances below half a metre count as half a metre. Points that are occluded from all tripods,
    or nearly invisible to them, have 0.
    """
    density = np.zeros(len(points))
    reach = np.sqrt((half ** 2).sum(axis=1))
    way, far, cone = np.empty_like(centre), np.empty(len(centre)), np.empty(len(centre))
    for t in range(len(tripods)):
        for k in range(len(centre)):
            way[k] = centre[k] - tripods[t]
            far[k] = np.sqrt((way[k] ** 2).sum())
            # The cosine of the cone around the bounding sphere of the solid.
            cone[k] = -1.0 if far[k] <= reach[k] else np.sqrt(1.0 - (reach[k] / far[k]) ** 2)
            way[k] /= max(far[k], 1e-9)
        for i in range(len(points)):
            d0, d1 = points[i, 0] - tripods[t, 0], points[i, 1] - tripods[t, 1]
            d2 = points[i, 2] - tripods[t, 2]
            distance = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
            cosine = abs(d0 * normals[i, 0] + d1 * normals[i, 1] + d2 * normals[i, 2])
            value = cosine / max(distance, 0.5) ** 3
            if value <= 1e-4:
                continue
            hidden = False
            for k in range(len(centre)):
                ahead = (d0 * way[k, 0] + d1 * way[k, 1] + d2 * way[k, 2])
                if ahead < cone[k] * distance or far[k] - reach[k] > distance:
                    continue
                # The ray is inside the solid where it is between all three pairs of faces.
                along = way[k, 0] * turn[k, 0] + way[k, 1] * turn[k, 1]
                across = way[k, 1] * turn[k, 0] - way[k, 0] * turn[k, 1]
                start = (along * far[k], across * far[k], way[k, 2] * far[k])
                step = (d0 * turn[k, 0] + d1 * turn[k, 1], d1 * turn[k, 0] - d0 * turn[k, 1], d2)
                enter, leave = 0.0, 1.0 - OCCLUSION_TOLERANCE_M / distance
                for axis in range(3):
                    if abs(step[axis]) < 1e-12:
                        if abs(start[axis]) > half[k, axis]:
                            leave = -1.0
                        continue
                    one = (start[axis] - half[k, axis]) / step[axis]
                    other = (start[axis] + half[k, axis]) / step[axis]
                    enter, leave = max(enter, min(one, other)), min(leave, max(one, other))
                if enter < leave:
                    hidden = True
                    break
            if not hidden:
                density[i] += value
    return density
