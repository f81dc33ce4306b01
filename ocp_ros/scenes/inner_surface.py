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
What a model shows to its room: the surface that the enclosed air sees.

Models of buildings and robot cells are made of solid bodies. Walls have two faces, slabs an
underside, and outside there may be ground. A scan of the same room would show none of these. The
air of a room has something below and above it and hardly a level way out. The largest part of it
that hangs together is the room of a mesh, and a side of a face counts where this air is seen from
it. Of points that were taken from such a model those are left out that others hide from the air.
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

#: Points on the faces that the air is looked for between: at least, and for each square metre.
PILOT, DENSE = 150_000, 60.0
#: Points that are taken at most.
MOST = 2_000_000
#: Metres: the ball that has to fit in the air.
BALL = 0.2
#: Of eight level directions from a cell, how many have to end at a surface.
SHUT = 5
#: Ways up from what has a roof, and how many of them have to end at it.
UP, ROOFED = np.array([(0, 0, 1), (0.5, 0, 1), (-0.5, 0, 1), (0, 0.5, 1), (0, -0.5, 1)]), 3
WAYS = tuple((x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y)
#: Cubic metres: what is smaller is no room.
LEAST = 2.0
#: Share of the largest air with or without a ceiling that the largest air with one has at least.
ROOFED_SHARE = 0.4
#: Metres: how far from a side the air is looked for, and how far beside the air a face may be.
#: What doors and windows show of the world outside is not of the room.
REACH, BESIDE = 2.0, 0.45
#: Metres: points are this far before their face, so that the sides of a thin one differ.
BEFORE = 0.001
#: Angles to the normal, and how many directions at each, in which a side looks for the air.
TILTS = ((0.0, 1), (np.deg2rad(35.0), 4), (np.deg2rad(65.0), 7))
#: How many more points are taken than seem to be needed.
ENOUGH = 1.05
#: Share of the faces of which one side is shut in, from which on a model is made of solid bodies.
SOLID = 0.9
#: Share of the faces that is not worth a remark.
NONE = 0.005
#: Looks around in a cloud, by the cubic metre of air at least and at most, and the share of the
#: surface that all of them miss from which on it is no scan; real ones were at 8 % or less.
LOOKS, MISSED = (40, 300), 0.14
#: Metres from a point at which others before it begin to hide it, and by how much the next place
#: that is tried is farther; shares of that distance, and multiples of the edge of the square that
#: the point stands for, within which there has to be one.
HIDING, NEXT, ASIDE, SQUARE = 0.05, 1.25, 0.6, 1.0
#: Least cosine between the normal of a point and the way to the air across its plane.
ACROSS = 0.7
#: Points, itself included, among which one is hidden where more than such a share of them are.
AMONG, MOST_OF = 9, 0.6
#: Metres that a wall or a slab is thick at most, and the share of what is missed that is behind
#: one.
THICK, BACKS = 0.6, 0.4
#: Of the looks, the share by which a point is no longer hidden.
OFTEN = 0.5


class InnerSurface(NamedTuple):
    """
    What a room shows.

    :ivar points: (N, 3) float64, metres, a millimetre before the faces.
    :ivar normals: (N, 3), unit vectors into the air.
    :ivar remarks: what was left out, a sentence each.
    """

    points: np.ndarray
    normals: np.ndarray
    remarks: tuple[str, ...]


def inner_surface(mesh: Mesh, samples: int, apart: float, name: str,
                  solids: np.ndarray | None = None) -> InnerSurface | None:
    """
    Find what the enclosed air of a mesh sees.

    :param mesh: metres, z up.
    :param samples: points wanted.
    :param apart: metres between them; 0 for as many as are wanted.
    :param name: what the message calls it.
    :param solids: (S, 2, 3) metres, two opposite corners of boxes that hold no air, of a room of
        which nothing else is solid; None where that is not known.
    :returns: None where no air is enclosed, as in a mesh of one wall and the floor before it.
    :raises SceneError: if that is so of solid bodies: they have an outside alone.
    """
    rays, corners = MeshRays(mesh), mesh.corners
    area = _area(corners)
    pilot = sampled(corners, int(np.clip(DENSE * area, PILOT, MOST)))
    air = EnclosedAir.of(pilot[:, :3], float(np.sqrt(area / len(pilot))), solids)
    some = pilot[::len(pilot) // 4000]
    if air is None:
        if solids is None and _solid(some, rays):
            raise SceneError(
                f'{name}: found solid bodies and no air that is closed in above, below and '
                'around; expected a room; cut the room out of the model, or add the walls and '
                'the ceiling that it lacks')
        return None
    seen = air.seen_from(some, rays)
    # Sides that are seen for each point on a face.
    share = float(seen.sum(axis=1).mean())
    if share == 0.0:
        return None
    if apart:
        samples = min(int(share * area / apart ** 2), samples)
    rows = sampled(corners, int(min(ENOUGH * samples / share, MOST)))
    hidden, seen = 1.0 - float(seen.any(axis=1).mean()), air.seen_from(rows, rays)
    sides = [np.hstack([_before(rows[kept], sign), sign * rows[kept, 3:]])
             for kept, sign in zip(seen.T, (1.0, -1.0))]
    found = np.vstack(sides)
    count = min(samples, len(found))
    points, normals = np.hsplit(found[np.arange(count) * len(found) // count], 2)
    # Nobody needs to be told that a cupboard stands on the floor.
    remarks = () if hidden < NONE or solids is not None else (
        f'{100.0 * hidden:.0f} % of the faces left out: the air of the room does not see them',)
    if air.rooms:
        remarks += (f'{len(air.rooms)} other closed space{"s" * (len(air.rooms) > 1)} left out, '
                    f'the largest of {air.rooms[0]:.0f} m3: no opening connects with the room',)
    return InnerSurface(points, normals, remarks)


def _area(corners: np.ndarray) -> float:
    """Return the area of triangles (T, 3, 3), square metres."""
    return 0.5 * float(np.linalg.norm(np.cross(
        corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum())


def _solid(rows: np.ndarray, rays: MeshRays) -> bool:
    """Return whether one side of most faces is shut in, given points and normals (N, 6)."""
    shut = [np.all([np.isfinite(rays.lengths(_before(rows, sign), _ways(rows, sign, *way)))
                    for way in _directions()], axis=0) for sign in (1.0, -1.0)]
    return float(np.logical_or(*shut).mean()) >= SOLID


def _directions() -> list[tuple[float, float]]:
    """Return directions to one side of a face: angles to the normal and around it, radians."""
    return [(tilt, 2.0 * np.pi * k / count) for tilt, count in TILTS for k in range(count)]


@njit(cache=True, nogil=True)
def _ways(rows, sign, tilt, turn):
    """Return unit vectors (N, 3) from one side of faces, given points and normals (N, 6)."""
    ways = np.empty((len(rows), 3))
    up, one, two = np.cos(tilt), np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn)
    for row in range(len(rows)):
        x, y, z = sign * rows[row, 3], sign * rows[row, 4], sign * rows[row, 5]
        # Any direction along the face will do as long as it is not the normal.
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


def _before(rows: np.ndarray, sign: float) -> np.ndarray:
    """Return the places (N, 3) before one side of faces, given points and normals (N, 6)."""
    return rows[:, :3] + sign * BEFORE * rows[:, 3:]


class EnclosedAir(NamedTuple):
    """
    The enclosed air.

    :ivar grid: of its cells.
    :ivar cells: (X, Y, Z) bool, those of the largest part that hangs together.
    :ivar beside: (X, Y) metres from each column to the nearest one with such cells.
    :ivar others: (X, Y, Z) bool, the cells of the other parts that are large enough for a room.
    :ivar rooms: cubic metres of each of these, the largest first.
    :ivar roofed: whether there is a ceiling.
    :ivar ball: metres that all of it is from surfaces.
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
        Find it between points (N, 3) of surfaces, a spacing apart, metres.

        :param solids: see :func:`inner_surface`.
        :returns: None where none is large enough for a room.
        """
        grid = CellGrid.over(corners_of(points))
        edge = grid.edge
        away = ndimage.distance_transform_edt(~grid.taken(points)) * edge
        # However few points there are, they shut what is between them.
        ball = max(BALL, 1.5 * spacing)
        taken, free = away <= 1.5 * spacing, away > ball
        free &= np.logical_or.accumulate(taken, axis=2)
        for corners in () if solids is None else solids:
            low, high = grid.cells(np.sort(corners, axis=0)).T
            free[tuple(slice(a, b + 1) for a, b in zip(low, high))] = False
        roofed = free & np.logical_or.accumulate(taken[:, :, ::-1], axis=2)[:, :, ::-1]
        shut = sum(_ends(taken, x, y).astype(np.int8) for x, y in WAYS) >= SHUT
        found = [_parts(cells & shut, edge) for cells in (roofed, free)]
        # A room without a ceiling is closed in around, and furniture in it may be hollow.
        most = [volumes.max(initial=0.0) for _, volumes in found]
        parts, volumes = found[0 if most[0] >= ROOFED_SHARE * most[1] else 1]
        order = np.argsort(-volumes, kind='stable')
        order = order[volumes[order] > (LEAST if solids is None else 0.0)]
        if len(order) == 0:
            return None
        room = parts == order[0]
        beside = edge * ndimage.distance_transform_edt(~room.any(axis=2))
        return cls(grid, room, beside, np.isin(parts, order[1:]),
                   tuple(volumes[order[1:]].tolist()), parts is found[0][0], ball)

    def seen_from(self, rows: np.ndarray, rays: MeshRays) -> np.ndarray:
        """
        Tell from which sides of faces the air is seen.

        :param rows: (N, 6) metres: points on the faces, and their unit normals.
        :returns: (N, 2) bool: the side of the normal, and the other one.
        """
        found = np.zeros((len(rows), 2), dtype=bool)
        column = self.grid.cells(rows[:, :3])
        near = np.flatnonzero(self.beside[tuple(column[:2])] <= max(
            BESIDE, self.ball + 2.5 * self.grid.edge))
        for side, sign in enumerate((1.0, -1.0)):
            left = near
            for way in _directions():
                some = rows[left]
                ways = _ways(some, sign, *way)
                first = self._first(some[:, :3], ways)
                # Rays cost most: only those are cast that would come into the air.
                reached = np.isfinite(first)
                reached[reached] = first[reached] < rays.lengths(
                    _before(some[reached], sign), ways[reached])
                found[left[reached], side] = True
                left = left[~reached]
            if self.roofed:
                found[:, side] &= _under_a_roof(rows, sign, found[:, side], rays)
        return found

    def _first(self, points: np.ndarray, ways: np.ndarray) -> np.ndarray:
        """Return after how many metres ways from points (N, 3) come into the air; inf: never."""
        reach = max(REACH, 3.0 * (self.ball + self.grid.edge))
        return self.grid.edge * _steps_into(
            self.cells, (points - self.grid.low) / self.grid.edge, ways, reach / self.grid.edge)


@njit(cache=True, nogil=True)
def _steps_into(cells, points, ways, most):
    """
    Count the steps until ways come into some cells.

    :param cells: (X, Y, Z) bool.
    :param points: (N, 3) where they begin, in edges of a cell from the lowest corner.
    :param ways: (N, 3) unit vectors; a step is an edge of a cell long.
    :param most: fewer steps than this are taken.
    :returns: (N,) steps; inf where they do not come into one.
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
    """Tell which sides of faces (N, 6) have something above them; only some are asked."""
    starts, count = _before(rows[asked], sign), np.zeros(len(rows), int)
    for way in UP:
        count[asked] += np.isfinite(rays.lengths(starts, np.broadcast_to(way, starts.shape)))
    return count >= ROOFED


def _parts(cells: np.ndarray, edge: float) -> tuple[np.ndarray, np.ndarray]:
    """Give numbers to the parts of cells that hang together; return their volumes too, 0 for 0."""
    parts, _ = ndimage.label(cells)
    volumes = np.bincount(parts.ravel()) * edge ** 3
    volumes[0] = 0.0
    return parts, volumes


def _ends(taken: np.ndarray, x: int, y: int) -> np.ndarray:
    """Tell from which cells a level way in steps of (x, y) cells ends at one that is taken."""
    if x == 0:
        return _ends(taken.transpose(1, 0, 2), y, 0).transpose(1, 0, 2)
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
    Leave out what the air of a room does not see of points that were taken from a solid model.

    :returns: the same scene where its points are those of a scan: a scanner stood in the air.
    """
    points, area = scene.points.astype(np.float64), scene.pitch.astype(np.float64) ** 2
    air = EnclosedAir.of(points, float(np.median(scene.pitch)))
    if air is None:
        return scene
    cells = np.argwhere(air.cells | air.others)
    looks = int(np.clip(len(cells) * air.grid.edge ** 3, *LOOKS))
    chosen = cells[np.random.default_rng(0).permutation(len(cells))[:looks]]
    count = _counted(scene, air.grid.middles(chosen))
    missed = area[count == 0].sum()
    if missed < MISSED * area.sum():
        return scene
    hidden, across = _hidden(scene, air)
    kept = ~(hidden & (count < OFTEN * len(chosen)))
    # What is missed in a yard that was scanned too is not behind a wall's other face.
    backs = area[hidden & across & (count == 0)].sum()
    if backs < BACKS * missed or np.count_nonzero(kept) < MIN_POINTS:
        return scene
    remark = (f'{100.0 * (1.0 - kept.mean()):.0f} % of the points left out: those of a solid '
              'model that the air of the room does not see')
    return replace(scene.only(kept), remarks=(*scene.remarks, remark))


def _counted(scene: Scene, places: np.ndarray) -> np.ndarray:
    """Return from how many places (M, 3), metres, each point of a scene is seen: (N,)."""
    visibility = SurfelVisibility(scene.points, scene.normals_or_estimate, scene.pitch,
                                  np.empty((0, 3), dtype=np.float32), FINE)
    lens, count = CameraModel(0.0, 2.0 * scene.diameter).lens, np.zeros(len(scene), dtype=int)
    for place in places:
        seen = no_bits(len(scene))
        visibility.look(Pose(place, LEVEL), lens, seen)
        count[visibility.order] += unpack(seen, len(scene))
    return count


def _hidden(scene: Scene, air: EnclosedAir) -> tuple[np.ndarray, np.ndarray]:
    """
    Tell which points have others between them and the nearest enclosed air.

    :returns: (N,) bool, and (N,) bool, whether that air lies across the plane of each.
    """
    points, pitch = scene.points.astype(np.float64), scene.pitch
    index = ndimage.distance_transform_edt(
        ~(air.cells | air.others), return_distances=False, return_indices=True)
    goals = air.grid.middles(index[(slice(None), *air.grid.cells(points))].T)
    length = np.linalg.norm(goals - points, axis=1)
    ways, tree = (goals - points) / length[:, None], cKDTree(points)
    hidden, away = np.zeros(len(points), dtype=bool), HIDING
    across = np.abs(np.einsum('nk,nk->n', ways, scene.normals_or_estimate)) >= ACROSS
    while len(left := np.flatnonzero(~hidden & (length > away + air.grid.edge))) and away < THICK:
        nearest, _ = tree.query(points[left] + away * ways[left],
                                distance_upper_bound=2.0 * float(np.median(pitch)))
        hidden[left] = nearest < np.minimum(ASIDE * away, SQUARE * pitch[left])
        away *= NEXT
    # Some look through the gaps between the points before them.
    return hidden | (hidden[tree.query(points, AMONG)[1]].mean(axis=1) > MOST_OF), across
