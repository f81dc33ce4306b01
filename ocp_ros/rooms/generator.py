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
Generate rooms such as offices and hallways as scans, with the mesh behind the points.

A scan is simulated by a depth camera on a few tripods, with occlusion. The density of points falls
with distance and slant, returns have errors along the ray, and glass and dark surfaces give no
returns.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.rooms.furniture import SOLID_KINDS
from ocp_ros.rooms.room_kinds import draw_plan
from ocp_ros.rooms.room_plan import RoomPlan, WALL_GAP_M
from ocp_ros.scenes.scene import Mesh, MIN_POINTS, Scene
from ocp_ros.util.kernels import njit
from ocp_ros.util.settings import check_whole

#: (12, 3) the triangles of a box. A corner's number is 1 (x high) + 2 (y high) + 4 (z high).
BOX_TRIANGLES = np.array([(0, 2, 1), (1, 2, 3), (4, 5, 6), (5, 7, 6), (0, 1, 4), (1, 5, 4),
                          (2, 6, 3), (3, 6, 7), (0, 4, 2), (2, 4, 6), (1, 3, 5), (3, 7, 5)])


def plan_of(seed: int) -> RoomPlan:
    """Return the plan of the room that :func:`generate_room` scans."""
    return draw_plan(np.random.default_rng(seed))


def generate_room(seed: int, n_points: int = 15000, scanned: bool = True) -> Scene:
    """
    Generate an office, a conference room, a lounge, a hallway, a storage room or an open office.

    The same seed gives the same room for any number of points.

    :param seed: any non-negative integer.
    :param n_points: the number of points, to a few per cent.
    :param scanned: whether the points are those of a scan, with noise and occlusion, or lie
        exactly and evenly on all surfaces.
    :returns: a scene that is called ``room-<seed>`` and has the mesh of the room.
    :raises ConfigurationError: for a seed below 0 or too few points.
    """
    check_whole('seed', seed, 0)
    check_whole('n_points', n_points, MIN_POINTS)
    plan = plan_of(seed)
    # Random numbers of the scan are independent of those of the plan.
    rng = np.random.default_rng([seed, 1])
    points = scan(plan, n_points, rng)[0] if scanned else sample_surfaces(plan, n_points, rng)
    return Scene(points, f'room-{seed}', mesh=mesh_of(plan))


def stations_of(seed: int) -> np.ndarray:
    """Return where the scanner of :func:`generate_room` stands: (T, 3) metres."""
    return _place_tripods(plan_of(seed), np.random.default_rng([seed, 1]))


def mesh_of(plan: RoomPlan) -> Mesh:
    """Return the mesh of a room: its shell (floor, walls, ceiling) and all solids in it."""
    # The corners of a cube around the origin, in the order of ``BOX_TRIANGLES``.
    unit_corners = np.array([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)]) - 0.5
    # The shell begins at the origin.
    vertices = [(unit_corners + 0.5) * plan.size]
    for box in plan.solids:
        vertices.append(unit_corners * box.size @ rotation_matrix(box.yaw).T + box.centre)
    # Each box has eight vertices.
    triangles = BOX_TRIANGLES + 8 * np.arange(len(vertices))[:, None, None]
    return Mesh(np.concatenate(vertices).astype(np.float32),
                triangles.reshape(-1, 3).astype(np.int32))


class ScannedSurface(NamedTuple):
    """
    Points on the surfaces of a plan.

    :ivar points: (N, 3) float64, metres.
    :ivar normals: (N, 3) unit vectors.
    :ivar solid_numbers: (N,) int64, indices into the plan's solids; -1 for the shell of the room.
    :ivar kinds: (N,) int64, indices into ``SOLID_KINDS``.
    """

    points: np.ndarray
    normals: np.ndarray
    solid_numbers: np.ndarray
    kinds: np.ndarray

    def only(self, is_kept: np.ndarray) -> 'ScannedSurface':
        """Return the surface with only the points that a mask (N,) bool marks."""
        return ScannedSurface(*(values[is_kept] for values in self))


class Boxes(NamedTuple):
    """
    The B solids of a plan as arrays, for the kernels below.

    :ivar centres: (B, 3) metres.
    :ivar half_sizes: (B, 3) metres, half the edges along the axes of each box.
    :ivar yaw_vectors: (B, 2) cosine and sine of the yaw of each box.
    """

    centres: np.ndarray
    half_sizes: np.ndarray
    yaw_vectors: np.ndarray


def boxes_of(plan: RoomPlan) -> Boxes:
    """Return the solids of a plan as arrays."""
    yaws = np.array([solid.yaw for solid in plan.solids])
    return Boxes(np.array([solid.centre for solid in plan.solids]).reshape(-1, 3),
                 0.5 * np.array([solid.size for solid in plan.solids]).reshape(-1, 3),
                 np.stack([np.cos(yaws), np.sin(yaws)], axis=1))


def scan(plan: RoomPlan, n_points: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the points that a scan of a room measures.

    :param plan: the room.
    :param n_points: the number of returns wanted, to a few per cent.
    :param rng: the random generator for tripods, patches and noise.
    :returns: (N, 3) float32, metres, and (N,) the kind of surface, an index into ``SOLID_KINDS``.
    """
    tripods = _place_tripods(plan, rng)
    patches = _draw_patches(plan, rng)
    surface = _sample_about(n_points, rng, partial(_scanned_surface, plan, tripods, patches))
    # Errors lie along the ray from the nearest tripod.
    offsets = surface.points[:, None] - tripods[None]
    nearest_tripods = np.argmin((offsets ** 2).sum(axis=2), axis=1)
    rays = offsets[np.arange(len(nearest_tripods)), nearest_tripods]
    distances = np.linalg.norm(rays, axis=1, keepdims=True)
    # The standard deviation along a ray: 2 mm, and 1 mm per metre.
    noise = rng.normal(0.0, 0.002 + 0.001 * distances)
    points = surface.points + noise * rays / np.maximum(distances, 1e-9)
    return points.astype(np.float32), surface.kinds


def sample_surfaces(plan: RoomPlan, n_points: int, rng: np.random.Generator) -> np.ndarray:
    """
    Sample all exposed surfaces of a room evenly, without noise and occlusion.

    :param n_points: the number of points wanted, to a few per cent.
    :returns: (N, 3) float32, metres.
    """
    surface = _sample_about(n_points, rng, partial(_exposed_surface, plan))
    return surface.points.astype(np.float32)


def _sample_about(n_points: int, rng: np.random.Generator,
                  sample_at_pitch: Callable[..., ScannedSurface]) -> ScannedSurface:
    """Find the pitch (distance of points, metres) that gives about ``n_points``; sample at it."""
    pitch = 0.2
    for _ in range(4):
        # Trials do not draw from ``rng``. The number of points falls with the squared pitch.
        surface = sample_at_pitch(pitch, np.random.default_rng(0))
        pitch *= np.sqrt(max(len(surface.points), 1) / n_points)
    return sample_at_pitch(pitch, rng)


def _exposed_surface(plan: RoomPlan, pitch: float, rng: np.random.Generator) -> ScannedSurface:
    """Sample the surfaces at a pitch, except where another solid or the shell touches them."""
    surface = surface_of(plan, pitch, rng)
    return surface.only(exposed_points(surface.points, surface.solid_numbers, plan.size,
                                       *boxes_of(plan), WALL_GAP_M))


def _scanned_surface(plan: RoomPlan, tripods: np.ndarray, patches: np.ndarray, pitch: float,
                     rng: np.random.Generator) -> ScannedSurface:
    """
    Sample the surfaces at a pitch and keep the points that return a signal to a tripod.

    :param tripods: (T, 3) metres.
    :param patches: (P, 4) metres, centre and radius of the spheres without returns.
    :param pitch: the distance between points, metres.
    """
    surface = _exposed_surface(plan, pitch, rng)
    densities = sampling_densities(surface.points, surface.normals, tripods, *boxes_of(plan))
    # Windows in the shell and dark patches return no signal.
    for lowest, highest in plan.windows:
        densities[(surface.solid_numbers < 0)
                  & ((surface.points > lowest) & (surface.points < highest)).all(axis=1)] = 0.0
    for *centre, radius in patches:
        densities[((surface.points - centre) ** 2).sum(axis=1) < radius ** 2] = 0.0
    # The densest 40 % of the points are all kept. The probability of the others falls with the
    # root of their density, to 0.4.
    full_density = np.percentile(densities[densities > 0.0], 60.0) if densities.any() else 1.0
    probabilities = np.clip(np.sqrt(densities / full_density), 0.4, 1.0)
    return surface.only((densities > 0.0) & (rng.random(len(probabilities)) < probabilities))


def surface_of(plan: RoomPlan, pitch: float, rng: np.random.Generator) -> ScannedSurface:
    """
    Return points on all faces of the shell and of the solids, on grids with jitter.

    :param pitch: the distance between points, metres.
    :param rng: the generator for the jitter.
    """
    faces = []
    # The number -1 stands for the shell of the room.
    for solid_number in range(-1, len(plan.solids)):
        for axis in range(3):
            # The axes along the two faces that are normal to this axis.
            u, v = (axis + 1) % 3, (axis + 2) % 3
            size = plan.size if solid_number < 0 else plan.solids[solid_number].size
            # Faces narrower than the pitch get a row of points with a probability below 1.
            counts = [int(size[edge] / pitch + rng.random()) for edge in (u, v)]
            if 0 in counts:
                continue
            for side in (-1.0, 1.0):
                cells = np.stack(np.meshgrid(*map(np.arange, counts), indexing='ij'), axis=-1)
                # Positions on the face from -0.5 to 0.5 along both edges.
                shares = (cells.reshape(-1, 2)
                          + rng.uniform(0.15, 0.85, (counts[0] * counts[1], 2))) / counts - 0.5
                points = np.empty((len(shares), 3))
                points[:, axis] = 0.5 * side * size[axis]
                points[:, [u, v]] = shares * size[[u, v]]
                normals = np.zeros((len(shares), 3))
                normals[:, axis] = side
                if solid_number < 0:
                    points += 0.5 * plan.size
                    kind = 'wall' if axis < 2 else 'floor' if side < 0 else 'ceiling'
                else:
                    solid = plan.solids[solid_number]
                    # The points are rows, so that the transposed matrix is multiplied from the
                    # right.
                    rotation = rotation_matrix(solid.yaw).T
                    points, normals = points @ rotation + solid.centre, normals @ rotation
                    kind = solid.kind
                faces.append((points, normals, np.full(len(points), solid_number),
                              np.full(len(points), SOLID_KINDS.index(kind))))
    return ScannedSurface(*(np.concatenate(values) for values in zip(*faces)))


def _place_tripods(plan: RoomPlan, rng: np.random.Generator) -> np.ndarray:
    """Return random positions (T, 3) of tripods, metres, in free air and apart from each other."""
    # One tripod for 10 m2 of floor, from 2 to 10.
    count = int(np.clip(np.prod(plan.size[:2]) / 10.0, 2, 10))
    boxes = boxes_of(plan)
    tripods: list[np.ndarray] = []
    free_air_m = 0.3
    for trial in range(200 * count):
        margin = min(free_air_m, 0.4 * plan.size[:2].min())
        position = np.append(rng.uniform(margin, plan.size[:2] - margin), rng.uniform(1.3, 1.7))
        # The required distances decrease with the attempts, for rooms that are crowded.
        relaxation = 1.0 - trial / (200.0 * count)
        distances = [np.linalg.norm(position[:2] - tripod[:2]) for tripod in tripods]
        if (is_position_free(position, free_air_m * relaxation, *boxes)
                and min(distances, default=np.inf) > 1.2 * relaxation):
            tripods.append(position)
            if len(tripods) == count:
                break
    return np.array(tripods).reshape(-1, 3)


def _draw_patches(plan: RoomPlan, rng: np.random.Generator) -> np.ndarray:
    """Return random patches that give no returns: (P, 4) centre and radius, metres."""
    surface = surface_of(plan, 0.3, rng)
    # One dark or shiny patch for 12 m2 of floor.
    count = rng.poisson(np.prod(plan.size[:2]) / 12.0)
    centres = surface.points[rng.integers(len(surface.points), size=count)]
    return np.column_stack([centres, rng.uniform(0.12, 0.45, count)])


@njit(cache=True, nogil=True)
def exposed_points(points, solid_numbers, room_size, centres, half_sizes, yaw_vectors, gap):
    """
    Return which surface points are not close to another solid, nor to the shell: (N,) bool.

    :param points: (N, 3) metres.
    :param solid_numbers: (N,) the solid of each point, -1 for the shell.
    :param room_size: (3,) metres.
    :param centres: with ``half_sizes`` and ``yaw_vectors``, see :class:`Boxes`.
    :param gap: metres; points within this distance are close.
    """
    # 1e-6 m are added for rounding, so that points at exactly the distance ``gap`` are close.
    is_exposed = np.ones(len(points), dtype=np.bool_)
    for i in range(len(points)):
        x, y, z = points[i]
        # A point of a solid has to be away from all sides of the room, which are the shell.
        if solid_numbers[i] >= 0:
            margin = gap + 1e-6
            if not (margin < x < room_size[0] - margin and margin < y < room_size[1] - margin
                    and margin < z < room_size[2] - margin):
                is_exposed[i] = False
                continue
        for k in range(len(centres)):
            if k == solid_numbers[i] or abs(z - centres[k, 2]) > half_sizes[k, 2] + gap + 1e-6:
                continue
            # Offsets from the centre along the horizontal axes of the box.
            dx, dy = x - centres[k, 0], y - centres[k, 1]
            along = dx * yaw_vectors[k, 0] + dy * yaw_vectors[k, 1]
            across = dy * yaw_vectors[k, 0] - dx * yaw_vectors[k, 1]
            if (abs(along) < half_sizes[k, 0] + gap + 1e-6
                    and abs(across) < half_sizes[k, 1] + gap + 1e-6):
                is_exposed[i] = False
                break
    return is_exposed


@njit(cache=True, nogil=True)
def is_position_free(position, distance, centres, half_sizes, yaw_vectors):
    """
    Return whether a position is outside all solids when ``distance`` is added to each side.

    :param position: (3,) metres.
    :param distance: metres.
    :param centres: with ``half_sizes`` and ``yaw_vectors``, see :class:`Boxes`.
    """
    for k in range(len(centres)):
        dx, dy = position[0] - centres[k, 0], position[1] - centres[k, 1]
        along = abs(dx * yaw_vectors[k, 0] + dy * yaw_vectors[k, 1]) - half_sizes[k, 0]
        across = abs(dy * yaw_vectors[k, 0] - dx * yaw_vectors[k, 1]) - half_sizes[k, 1]
        height = abs(position[2] - centres[k, 2]) - half_sizes[k, 2]
        if max(along, max(across, height)) < distance:
            return False
    return True


@njit(cache=True, nogil=True)
def sampling_densities(points, normals, tripods, centres, half_sizes, yaw_vectors):
    """
    Return the density of scan points at each surface point: (N,).

    The density is the sum, over the tripods that see the point, of the distance along the normal
    over the third power of the distance: the cosine of the angle between them over the squared
    distance. In the power, distances below half a metre count as half a metre. Terms below 1e-4
    count as 0.

    :param points: (N, 3) metres.
    :param normals: (N, 3) unit vectors.
    :param tripods: (T, 3) metres.
    :param centres: with ``half_sizes`` and ``yaw_vectors``, see :class:`Boxes`.
    """
    densities = np.zeros(len(points))
    # Radii of the bounding spheres of the solids.
    radii = np.sqrt((half_sizes ** 2).sum(axis=1))
    directions = np.empty_like(centres)
    centre_distances, cone_cosines = np.empty(len(centres)), np.empty(len(centres))
    for t in range(len(tripods)):
        for k in range(len(centres)):
            directions[k] = centres[k] - tripods[t]
            centre_distances[k] = np.sqrt((directions[k] ** 2).sum())
            # The cone from the tripod around the bounding sphere. For a tripod in the sphere, the
            # cosine -1 stands for all directions.
            cone_cosines[k] = -1.0
            if centre_distances[k] > radii[k]:
                cone_cosines[k] = np.sqrt(1.0 - (radii[k] / centre_distances[k]) ** 2)
            directions[k] /= max(centre_distances[k], 1e-9)
        for i in range(len(points)):
            x, y = points[i, 0] - tripods[t, 0], points[i, 1] - tripods[t, 1]
            z = points[i, 2] - tripods[t, 2]
            length = np.sqrt(x * x + y * y + z * z)
            # The length times the cosine of the angle to the normal.
            slant = abs(x * normals[i, 0] + y * normals[i, 1] + z * normals[i, 2])
            density = slant / max(length, 0.5) ** 3
            if density <= 1e-4:
                continue
            is_occluded = False
            for k in range(len(centres)):
                projection = x * directions[k, 0] + y * directions[k, 1] + z * directions[k, 2]
                distance = centre_distances[k]
                # The ray misses the bounding sphere, or ends before it.
                if projection < cone_cosines[k] * length or distance - radii[k] > length:
                    continue
                # The centre of the box and the ray, from the tripod, in the axes of the box.
                cosine, sine = yaw_vectors[k]
                along = directions[k, 0] * cosine + directions[k, 1] * sine
                across = directions[k, 1] * cosine - directions[k, 0] * sine
                centre = along * distance, across * distance, directions[k, 2] * distance
                ray = x * cosine + y * sine, y * cosine - x * sine, z
                # An object within 0.01 m of the end of a ray does not occlude it.
                if _enters_box(ray, centre, half_sizes[k], 1.0 - 0.01 / length):
                    is_occluded = True
                    break
            if not is_occluded:
                densities[i] += density
    return densities


@njit(cache=True, nogil=True)
def _enters_box(ray, centre, half_size, end):
    """
    Return whether a ray from the origin enters a box before ``end``, a share of its length.

    :param ray: (3,) metres, in the axes of the box.
    :param centre: (3,) metres, the centre of the box, in the same axes.
    :param half_size: (3,) metres.
    """
    # The ray is inside the box where it is between all three pairs of faces.
    begin = 0.0
    for axis in range(3):
        # A ray that is parallel to a pair of faces is always or never between them.
        if abs(ray[axis]) < 1e-12:
            if abs(centre[axis]) > half_size[axis]:
                return False
            continue
        low_face = (centre[axis] - half_size[axis]) / ray[axis]
        high_face = (centre[axis] + half_size[axis]) / ray[axis]
        begin = max(begin, min(low_face, high_face))
        end = min(end, max(low_face, high_face))
    return begin < end
