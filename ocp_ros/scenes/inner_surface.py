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
The inner surface of a model: the surface that is visible from the enclosed air.

Models of buildings and robot cells consist of solid bodies. Walls have two faces, slabs have an
underside, and there may be ground outside. A scan of the same room contains none of these outer
surfaces. Air belongs to a room if it has a surface below and above it, and surfaces in most level
directions. The room of a mesh is the largest connected part of this air. A side of a face is kept
if this air is visible from it. Of points sampled from such a model, those are left out that other
points hide from the air.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, LEVEL, Pose
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.geometry.packed_bits import no_bits, unpack
from ocp_ros.geometry.visibility import FINE, SurfelVisibility
from ocp_ros.geometry.voxels import CellGrid
from ocp_ros.scenes.mesh_files import sampled
from ocp_ros.scenes.mesh_rays import MeshRays
from ocp_ros.scenes.scene import Mesh, MIN_POINTS, Scene, SceneError
from ocp_ros.util.kernels import njit
from scipy import ndimage
from scipy.spatial import cKDTree


class InnerSurface(NamedTuple):
    """
    The surface points that are visible from the air of a room.

    :ivar points: (N, 3) float64, metres, a millimetre in front of the faces.
    :ivar normals: (N, 3), unit vectors into the air.
    :ivar remarks: what was left out, one sentence each.
    """

    points: np.ndarray
    normals: np.ndarray
    remarks: tuple[str, ...]


def inner_surface(mesh: Mesh, samples: int, apart: float, name: str,
                  solids: np.ndarray | None = None) -> InnerSurface | None:
    """
    Find the surface of a mesh that is visible from its enclosed air.

    :param mesh: metres, z up.
    :param samples: the number of points wanted.
    :param apart: the distance between points, metres; 0 uses ``samples`` alone.
    :param name: the name of the room in messages.
    :param solids: (S, 2, 3) metres, two opposite corners of each solid box, if nothing else in the
        room is solid; None if the solids are not given.
    :returns: None if no air is enclosed, as in a mesh of one wall and the floor in front of it.
    :raises SceneError: if no air is enclosed and the mesh consists of solid bodies: these have
        only an outside.
    """
    rays, corners = MeshRays(mesh), mesh.corners
    area = _area(corners)
    max_points = 2_000_000
    # The air is found between 60 points per square metre, and 150,000 at least.
    pilot = sampled(corners, int(np.clip(60.0 * area, 150_000, max_points)))
    air = EnclosedAir.of(pilot[:, :3], float(np.sqrt(area / len(pilot))), solids)
    some = pilot[::len(pilot) // 4000]
    if air is None:
        if solids is None and _is_solid(some, rays):
            raise SceneError(
                f'{name}: found solid bodies and no air that is closed in above, below and '
                'around; expected a room; cut the room out of the model, or add the walls and '
                'the ceiling that it lacks')
        return None
    seen = air.seen_from(some, rays)
    # Mean number of visible sides per point on a face.
    share = float(seen.sum(axis=1).mean())
    if share == 0.0:
        return None
    if apart:
        samples = min(int(share * area / apart ** 2), samples)
    # Five per cent more than the estimate requires.
    rows = sampled(corners, int(min(1.05 * samples / share, max_points)))
    hidden, seen = 1.0 - float(seen.any(axis=1).mean()), air.seen_from(rows, rays)
    sides = [np.hstack([_in_front(rows[kept], sign), sign * rows[kept, 3:]])
             for kept, sign in zip(seen.T, (1.0, -1.0))]
    found = np.vstack(sides)
    count = min(samples, len(found))
    points, normals = np.hsplit(found[np.arange(count) * len(found) // count], 2)
    # Hidden faces of given boxes, such as the underside of a cupboard, need no remark.
    remarks = () if hidden < 0.005 or solids is not None else (
        f'{100.0 * hidden:.0f} % of the faces left out: the air of the room does not see them',)
    if air.rooms:
        remarks += (f'{len(air.rooms)} other closed space{"s" * (len(air.rooms) > 1)} left out, '
                    f'the largest of {air.rooms[0]:.0f} m3: no opening connects with the room',)
    return InnerSurface(points, normals, remarks)


def _area(corners: np.ndarray) -> float:
    """Return the area of triangles (T, 3, 3), square metres."""
    return 0.5 * float(np.linalg.norm(np.cross(
        corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum())


def _is_solid(rows: np.ndarray, rays: MeshRays) -> bool:
    """Return whether most faces have a closed-in side, given points and normals (N, 6)."""
    enclosed = [
        np.all([np.isfinite(rays.lengths(_in_front(rows, sign), _ray_directions(rows, sign, *way)))
                for way in _test_angles()], axis=0) for sign in (1.0, -1.0)]
    return float(np.logical_or(*enclosed).mean()) >= 0.9


def _test_angles() -> list[tuple[float, float]]:
    """Return directions from one side of a face: angles to the normal and around it, radians."""
    # Radians to the normal, and the number of directions at this angle.
    tilts = ((0.0, 1), (np.deg2rad(35.0), 4), (np.deg2rad(65.0), 7))
    return [(tilt, 2.0 * np.pi * k / count) for tilt, count in tilts for k in range(count)]


@njit(cache=True, nogil=True)
def _ray_directions(rows, sign, tilt, turn):
    """Return unit vectors (N, 3) from one side of faces, given points and normals (N, 6)."""
    ways = np.empty((len(rows), 3))
    up, one, two = np.cos(tilt), np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn)
    for row in range(len(rows)):
        x, y, z = sign * rows[row, 3], sign * rows[row, 4], sign * rows[row, 5]
        # Any vector that is not parallel to the normal gives a direction along the face.
        if abs(z) < 0.9:
            level = np.sqrt(x * x + y * y)
            along = (y / level, -x / level, 0.0)
        else:
            level = np.sqrt(y * y + z * z)
            along = (0.0, z / level, -y / level)
        across = (y * along[2] - z * along[1], z * along[0] - x * along[2],
                  x * along[1] - y * along[0])
        for axis, normal in enumerate((x, y, z)):
            ways[row, axis] = up * normal + one * along[axis] + two * across[axis]
    return ways


def _in_front(rows: np.ndarray, sign: float) -> np.ndarray:
    """Return points (N, 3) in front of one side of faces, given points and normals (N, 6)."""
    # A millimetre separates the two sides of a thin face.
    return rows[:, :3] + sign * 0.001 * rows[:, 3:]


class EnclosedAir(NamedTuple):
    """
    The enclosed air of a room as cells of a grid.

    :ivar grid: the grid of the cells.
    :ivar cells: (X, Y, Z) bool, the cells of the largest connected part.
    :ivar beside: (X, Y) metres from each column to the nearest column that contains such cells.
    :ivar others: (X, Y, Z) bool, the cells of the other connected parts that are large enough for
        a room.
    :ivar rooms: the volume of each of these other parts, cubic metres, the largest first.
    :ivar roofed: whether the air was found under a ceiling.
    :ivar ball: the least distance of the air from surfaces, metres.
    """

    grid: CellGrid
    cells: np.ndarray
    beside: np.ndarray
    others: np.ndarray
    rooms: tuple[float, ...]
    roofed: bool
    ball: float

    @classmethod
    def of(cls, points: np.ndarray, spacing: float, solids: np.ndarray | None = None
           ) -> 'EnclosedAir | None':
        """
        Find the enclosed air between surface points (N, 3) with a given spacing, metres.

        :param solids: see :func:`inner_surface`.
        :returns: None if no part is large enough for a room.
        """
        grid = CellGrid.over(corners_of(points))
        edge = grid.edge
        away = ndimage.distance_transform_edt(~grid.taken(points)) * edge
        # Sparse points still close the gaps between them.
        ball = max(0.2, 1.5 * spacing)
        taken, free = away <= 1.5 * spacing, away > ball
        free &= np.logical_or.accumulate(taken, axis=2)
        for corners in () if solids is None else solids:
            low, high = grid.cells(np.sort(corners, axis=0)).T
            free[tuple(slice(a, b + 1) for a, b in zip(low, high))] = False
        roofed = free & np.logical_or.accumulate(taken[:, :, ::-1], axis=2)[:, :, ::-1]
        # Most of the eight level directions have to end at a surface.
        level_steps = tuple((x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y)
        enclosed = sum(_ends_at_surface(taken, x, y).astype(np.int8) for x, y in level_steps) >= 5
        found = [_connected_parts(cells & enclosed, edge) for cells in (roofed, free)]
        # Without the roof condition, rooms without a ceiling are found. With it, hollow furniture
        # in such a room could count as the room: hence the comparison of volumes.
        most = [volumes.max(initial=0.0) for _, volumes in found]
        parts, volumes = found[0 if most[0] >= 0.4 * most[1] else 1]
        order = np.argsort(-volumes, kind='stable')
        # A volume of less than 2 m3 is not a room.
        order = order[volumes[order] > (2.0 if solids is None else 0.0)]
        if len(order) == 0:
            return None
        room = parts == order[0]
        beside = edge * ndimage.distance_transform_edt(~room.any(axis=2))
        return cls(grid, room, beside, np.isin(parts, order[1:]),
                   tuple(volumes[order[1:]].tolist()), parts is found[0][0], ball)

    def seen_from(self, rows: np.ndarray, rays: MeshRays) -> np.ndarray:
        """
        Return from which sides of faces the air is visible.

        :param rows: (N, 6) metres: points on the faces and their unit normals.
        :returns: (N, 2) bool: the side of the normal, and the opposite side.
        """
        found = np.zeros((len(rows), 2), dtype=bool)
        column = self.grid.cells(rows[:, :3])
        # Surfaces outside that are visible through doors and windows do not belong to the room.
        near = np.flatnonzero(self.beside[tuple(column[:2])] <= max(
            0.45, self.ball + 2.5 * self.grid.edge))
        for side, sign in enumerate((1.0, -1.0)):
            left = near
            for way in _test_angles():
                some = rows[left]
                ways = _ray_directions(some, sign, *way)
                first = self._air_distance(some[:, :3], ways)
                # Ray casting is the slowest step: only rays that would reach the air are cast.
                reached = np.isfinite(first)
                reached[reached] = first[reached] < rays.lengths(
                    _in_front(some[reached], sign), ways[reached])
                found[left[reached], side] = True
                left = left[~reached]
            if self.roofed:
                found[:, side] &= _under_a_roof(rows, sign, found[:, side], rays)
        return found

    def _air_distance(self, points: np.ndarray, ways: np.ndarray) -> np.ndarray:
        """Return how far rays from points (N, 3) go until they enter the air, metres; else inf."""
        reach = max(2.0, 3.0 * (self.ball + self.grid.edge))
        return self.grid.edge * _steps_into(
            self.cells, (points - self.grid.low) / self.grid.edge, ways, reach / self.grid.edge)


@njit(cache=True, nogil=True)
def _steps_into(cells, points, ways, most):
    """
    Count the steps along rays until they enter marked cells.

    :param cells: (X, Y, Z) bool.
    :param points: (N, 3) the start points, in cell edges from the lowest corner of the grid.
    :param ways: (N, 3) unit direction vectors; a step is one cell edge long.
    :param most: the steps of a ray stay below this number.
    :returns: (N,) steps; inf for rays that do not enter a marked cell.
    """
    steps = np.full(len(points), np.inf)
    shape = np.array(cells.shape)
    for row in range(len(points)):
        step = 1.0
        while step < most and steps[row] == np.inf:
            x = min(max(int(np.floor(points[row, 0] + step * ways[row, 0])), 0), shape[0] - 1)
            y = min(max(int(np.floor(points[row, 1] + step * ways[row, 1])), 0), shape[1] - 1)
            z = min(max(int(np.floor(points[row, 2] + step * ways[row, 2])), 0), shape[2] - 1)
            if cells[x, y, z]:
                steps[row] = step
            step += 1.0
    return steps


def _under_a_roof(rows: np.ndarray, sign: float, asked: np.ndarray, rays: MeshRays) -> np.ndarray:
    """Return which of the sides of faces (N, 6) that ``asked`` marks have a surface above them."""
    starts, count = _in_front(rows[asked], sign), np.zeros(len(rows), int)
    upwards = np.array([(0, 0, 1), (0.5, 0, 1), (-0.5, 0, 1), (0, 0.5, 1), (0, -0.5, 1)])
    for way in upwards:
        count[asked] += np.isfinite(rays.lengths(starts, np.broadcast_to(way, starts.shape)))
    # Three of the five upward directions have to hit a surface.
    return count >= 3


def _connected_parts(cells: np.ndarray, edge: float) -> tuple[np.ndarray, np.ndarray]:
    """Number the connected parts of cells; return the numbers and the volumes, 0 for number 0."""
    parts, _ = ndimage.label(cells)
    volumes = np.bincount(parts.ravel()) * edge ** 3
    volumes[0] = 0.0
    return parts, volumes


def _ends_at_surface(taken: np.ndarray, x: int, y: int) -> np.ndarray:
    """Return from which cells a level path in steps of (x, y) cells ends at a taken cell."""
    if x == 0:
        return _ends_at_surface(taken.transpose(1, 0, 2), y, 0).transpose(1, 0, 2)
    ends = taken.copy()
    rows = range(1, len(taken)) if x < 0 else range(len(taken) - 2, -1, -1)
    for row in rows:
        before = ends[row + x]
        if y < 0:
            ends[row, 1:] |= before[:-1]
        elif y > 0:
            ends[row, :-1] |= before[1:]
        else:
            ends[row] |= before
    return ends


def without_outside(scene: Scene) -> Scene:
    """
    Leave out points of a solid model that are not visible from the air of the room.

    :returns: the same scene if its points are those of a scan, since a scanner stands in the air.
    """
    points, area = scene.points.astype(np.float64), scene.pitch.astype(np.float64) ** 2
    air = EnclosedAir.of(points, float(np.median(scene.pitch)))
    if air is None:
        return scene
    cells = np.argwhere(air.cells | air.others)
    # One test position per cubic metre.
    test_count = int(np.clip(len(cells) * air.grid.edge ** 3, 40, 300))
    chosen = cells[np.random.default_rng(0).permutation(len(cells))[:test_count]]
    count = _view_counts(scene, air.grid.middles(chosen))
    invisible_area = area[count == 0].sum()
    # From real scans, 8 % of the surface or less was invisible.
    if invisible_area < 0.14 * area.sum():
        return scene
    hidden, across = _occluded(scene, air)
    # A point that is visible from half of the test positions is not hidden.
    kept = ~(hidden & (count < 0.5 * len(chosen)))
    # Points of a yard that was scanned too are invisible from the air, but do not lie behind a
    # wall.
    back_area = area[hidden & across & (count == 0)].sum()
    if back_area < 0.4 * invisible_area or np.count_nonzero(kept) < MIN_POINTS:
        return scene
    remark = (f'{100.0 * (1.0 - kept.mean()):.0f} % of the points left out: those of a solid '
              'model that the air of the room does not see')
    return replace(scene.only(kept), remarks=(*scene.remarks, remark))


def _view_counts(scene: Scene, places: np.ndarray) -> np.ndarray:
    """Return the number of positions (M, 3), metres, from which each point is visible: (N,)."""
    visibility = SurfelVisibility(scene.points, scene.normals_or_estimate, scene.pitch,
                                  np.empty((0, 3), dtype=np.float32), FINE)
    lens, count = CameraModel(0.0, 2.0 * scene.diameter).lens, np.zeros(len(scene), dtype=int)
    for place in places:
        seen = no_bits(len(scene))
        visibility.look(Pose(place, LEVEL), lens, seen)
        count[visibility.order] += unpack(seen, len(scene))
    return count


def _occluded(scene: Scene, air: EnclosedAir) -> tuple[np.ndarray, np.ndarray]:
    """
    Return which points have other points between them and the nearest enclosed air.

    :returns: (N,) bool, and (N,) bool: whether that air lies across the plane of the point.
    """
    points, pitch = scene.points.astype(np.float64), scene.pitch
    index = ndimage.distance_transform_edt(
        ~(air.cells | air.others), return_distances=False, return_indices=True)
    goals = air.grid.middles(index[(slice(None), *air.grid.cells(points))].T)
    length = np.linalg.norm(goals - points, axis=1)
    ways, tree = (goals - points) / length[:, None], cKDTree(points)
    hidden, away = np.zeros(len(points), dtype=bool), 0.05
    across = np.abs(np.einsum('nk,nk->n', ways, scene.normals_or_estimate)) >= 0.7
    # The largest thickness of a wall or slab is 0.6 m.
    while len(left := np.flatnonzero(~hidden & (length > away + air.grid.edge))) and away < 0.6:
        nearest, _ = tree.query(points[left] + away * ways[left],
                                distance_upper_bound=2.0 * float(np.median(pitch)))
        # A point hides another if it is near the line to the air, in proportion to its distance,
        # and within the square that the hidden point stands for.
        hidden[left] = nearest < np.minimum(0.6 * away, pitch[left])
        away *= 1.25
    # Some hidden points pass the test through gaps between the points in front of them.
    return hidden | (hidden[tree.query(points, 9)[1]].mean(axis=1) > 0.6), across
