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
from ocp_ros.geometry.clouds import CellGrid, corners_of, evenly
from ocp_ros.geometry.normals import STEEP
from ocp_ros.geometry.packed_bits import no_bits, unpack
from ocp_ros.geometry.visibility import FINE, SurfelVisibility
from ocp_ros.scenes.meshes import MeshRays, sample_faces
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


def inner_surface(mesh: Mesh, point_count: int, spacing: float, name: str,
                  solids: np.ndarray | None = None) -> InnerSurface | None:
    """
    Find the surface of a mesh that is visible from its enclosed air.

    :param mesh: metres, z up.
    :param point_count: the largest number of points.
    :param spacing: the distance between points, metres; 0 gives ``point_count`` points.
    :param name: the name of the room in messages.
    :param solids: (S, 2, 3) metres, two opposite corners of each solid box, if nothing else in the
        room is solid; None if the solids are not given.
    :returns: None if no air is enclosed, as in a mesh of one wall and the floor in front of it, or
        no face is visible from this air.
    :raises SceneError: if no air is enclosed and the mesh consists of solid bodies: these have
        only an outside.
    """
    rays = MeshRays(mesh)
    corners = mesh.corners
    area = _total_area(corners)
    max_points = 2_000_000
    # Find the air between points on the faces: 60 points per square metre, and 150,000 at least. A
    # row is a point on a face and the normal of the face.
    coarse_rows = sample_faces(corners, int(np.clip(60.0 * area, 150_000, max_points)))
    air = EnclosedAir.of(coarse_rows[:, :3], float(np.sqrt(area / len(coarse_rows))), solids)
    # About 4000 rows.
    test_rows = coarse_rows[::len(coarse_rows) // 4000]
    if air is None:
        if solids is None and _is_solid(test_rows, rays):
            raise SceneError(
                f'{name}: found solid bodies and no air that is closed in above, below and '
                'around; expected a room; cut the room out of the model, or add the walls and '
                'the ceiling that it lacks')
        return None
    # Estimate with the test rows how many rows give the wanted number of points.
    is_visible = air.visible_sides(test_rows, rays)
    # The mean number of visible sides per point on a face.
    sides_per_point = float(is_visible.sum(axis=1).mean())
    if sides_per_point == 0.0:
        return None
    # Each point stands for a square with the edge ``spacing``.
    if spacing:
        point_count = min(int(sides_per_point * area / spacing ** 2), point_count)
    # Take five per cent more rows than the estimate requires.
    rows = sample_faces(corners, int(min(1.05 * point_count / sides_per_point, max_points)))
    # A face that is visible from both sides gives two points.
    visible_rows = np.vstack([
        np.hstack([_start_points(rows[is_kept], sign), sign * rows[is_kept, 3:]])
        for is_kept, sign in zip(air.visible_sides(rows, rays).T, (1.0, -1.0))])
    # Thin evenly to the wanted number.
    points, normals = np.hsplit(visible_rows[evenly(len(visible_rows), point_count)], 2)
    # Hidden faces of given boxes, such as the underside of a cupboard, need no remark, nor does
    # less than half a per cent of hidden faces.
    invisible_share = 1.0 - float(is_visible.any(axis=1).mean())
    remarks = () if invisible_share < 0.005 or solids is not None else (
        f'{100.0 * invisible_share:.0f} % of the faces left out: the air of the room does not see '
        'them',)
    if volumes := air.other_volumes:
        remarks += (f'{len(volumes)} other closed space{"s" * (len(volumes) > 1)} left out, the '
                    f'largest of {volumes[0]:.1f} m³: no opening connects with the room',)
    return InnerSurface(points, normals, remarks)


def _total_area(corners: np.ndarray) -> float:
    """Return the area of triangles (T, 3, 3), square metres."""
    return 0.5 * float(np.linalg.norm(np.cross(
        corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum())


def _is_solid(rows: np.ndarray, rays: MeshRays) -> bool:
    """
    Return whether nearly all faces have a side from which every ray hits the mesh.

    :param rows: (N, 6) points on the faces, metres, and their normals.
    """
    is_closed_in = [
        np.all([np.isfinite(rays.lengths(_start_points(rows, sign),
                                         _ray_directions(rows, sign, *angles)))
                for angles in _test_angles()], axis=0) for sign in (1.0, -1.0)]
    return float(np.logical_or(*is_closed_in).mean()) >= 0.9


def _test_angles() -> list[tuple[float, float]]:
    """Return directions of rays: their angles to the normal of a face and around it, radians."""
    # The angle to the normal, and the number of directions at this angle.
    tilt_counts = ((0.0, 1), (np.deg2rad(35.0), 4), (np.deg2rad(65.0), 7))
    return [(tilt, 2.0 * np.pi * k / count) for tilt, count in tilt_counts for k in range(count)]


@njit(cache=True, nogil=True)
def _ray_directions(rows, sign, tilt, rotation):
    """
    Return the unit vectors (N, 3) of rays from one side of faces.

    :param rows: (N, 6) points on the faces, metres, and their normals.
    :param sign: 1 for the side of the normal, -1 for the other side.
    :param tilt: the angle to the normal, radians.
    :param rotation: the angle around the normal, radians.
    """
    directions = np.empty((len(rows), 3))
    along_normal = np.cos(tilt)
    along_first, along_second = np.sin(tilt) * np.cos(rotation), np.sin(tilt) * np.sin(rotation)
    for row in range(len(rows)):
        x, y, z = sign * rows[row, 3], sign * rows[row, 4], sign * rows[row, 5]
        # Two unit vectors along the face, at right angles. The first is at a right angle to z too,
        # or to x if the normal is nearly parallel to z.
        if abs(z) < 0.9:
            length = np.sqrt(x * x + y * y)
            first = (y / length, -x / length, 0.0)
        else:
            length = np.sqrt(y * y + z * z)
            first = (0.0, z / length, -y / length)
        second = (y * first[2] - z * first[1], z * first[0] - x * first[2],
                  x * first[1] - y * first[0])
        for axis, normal in enumerate((x, y, z)):
            directions[row, axis] = (along_normal * normal + along_first * first[axis]
                                     + along_second * second[axis])
    return directions


def _start_points(rows: np.ndarray, sign: float) -> np.ndarray:
    """Return points (N, 3) just in front of a side of faces, given points and normals (N, 6)."""
    # A millimetre separates the two sides of a thin face.
    return rows[:, :3] + sign * 0.001 * rows[:, 3:]


class EnclosedAir(NamedTuple):
    """
    The enclosed air of a room as cells of a grid of X x Y x Z cells.

    :ivar grid: the grid of the cells.
    :ivar cells: (X, Y, Z) bool, the cells of the largest connected part: the air of the room.
    :ivar column_distance: (X, Y) metres from each column of the grid to the nearest column that
        contains air of the room.
    :ivar other_cells: (X, Y, Z) bool, the cells of the other connected parts that are large enough
        for a room.
    :ivar other_volumes: the volume of each of these other parts, cubic metres, the largest first.
    :ivar is_roofed: whether the air of the room has a surface above it.
    :ivar min_distance: the least distance of the air from surfaces, metres.
    """

    grid: CellGrid
    cells: np.ndarray
    column_distance: np.ndarray
    other_cells: np.ndarray
    other_volumes: tuple[float, ...]
    is_roofed: bool
    min_distance: float

    @classmethod
    def of(cls, points: np.ndarray, spacing: float, solids: np.ndarray | None = None
           ) -> 'EnclosedAir | None':
        """
        Find the enclosed air between points on surfaces.

        :param points: (N, 3) metres.
        :param spacing: the distance between points, metres.
        :param solids: (S, 2, 3) metres or None, see :func:`inner_surface`.
        :returns: the air; None if no connected part of it is large enough for a room.
        """
        grid = CellGrid.over(corners_of(points))
        edge = grid.edge
        surface_distance = ndimage.distance_transform_edt(~grid.taken(points)) * edge
        # The air does not leak through the gaps between sparse points.
        min_distance = max(0.2, 1.5 * spacing)
        is_surface = surface_distance <= 1.5 * spacing
        is_air = surface_distance > min_distance
        # Air has a surface below it.
        is_air &= np.logical_or.accumulate(is_surface, axis=2)
        # The inside of a given solid is not air.
        for corners in () if solids is None else solids:
            low, high = grid.cells(np.sort(corners, axis=0)).T
            is_air[tuple(slice(a, b + 1) for a, b in zip(low, high))] = False
        # Roofed air has a surface above it too.
        roofed_air = is_air & np.logical_or.accumulate(is_surface[:, :, ::-1], axis=2)[:, :, ::-1]
        # Most of the eight level directions have to end at a surface.
        level_steps = tuple((x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y)
        is_enclosed = sum(
            _ends_at_surface(is_surface, x, y).astype(np.int8) for x, y in level_steps) >= 5
        candidates = [_label_parts(cells & is_enclosed, edge) for cells in (roofed_air, is_air)]
        # Roofed air is the room if its largest part has at least 0.4 of the volume of the largest
        # part of all air. Otherwise the room has no ceiling; roofed air may be inside furniture.
        largest_volumes = [volumes.max(initial=0.0) for _, volumes in candidates]
        is_roofed = bool(largest_volumes[0] >= 0.4 * largest_volumes[1])
        parts, volumes = candidates[0 if is_roofed else 1]
        part_numbers = np.argsort(-volumes, kind='stable')
        # The largest part comes first. A volume of less than 2 m3 is not a room, except in a room
        # file, which gives the solids. Number 0, which is no part, has no volume.
        part_numbers = part_numbers[volumes[part_numbers] > (2.0 if solids is None else 0.0)]
        if len(part_numbers) == 0:
            return None
        room = parts == part_numbers[0]
        column_distance = edge * ndimage.distance_transform_edt(~room.any(axis=2))
        others = part_numbers[1:]
        return cls(grid, room, column_distance, np.isin(parts, others),
                   tuple(volumes[others].tolist()), is_roofed, min_distance)

    def visible_sides(self, rows: np.ndarray, rays: MeshRays) -> np.ndarray:
        """
        Return which sides of faces are visible from the air of the room.

        :param rows: (N, 6) points on the faces, metres, and their unit normals.
        :param rays: casts rays at the mesh of the faces.
        :returns: (N, 2) bool: the side of the normal, and the opposite side.
        """
        is_visible = np.zeros((len(rows), 2), dtype=bool)
        cells = self.grid.cells(rows[:, :3])
        # Surfaces outside that are visible through doors and windows do not belong to the room, so
        # only faces above, below or near the air of the room are tested.
        max_distance_m = max(0.45, self.min_distance + 2.5 * self.grid.edge)
        near_rows = np.flatnonzero(self.column_distance[tuple(cells[:2])] <= max_distance_m)
        for side, sign in enumerate((1.0, -1.0)):
            remaining = near_rows
            for angles in _test_angles():
                test_rows = rows[remaining]
                directions = _ray_directions(test_rows, sign, *angles)
                air_distances = self._air_distance(test_rows[:, :3], directions)
                # A ray reaches the air if the air is nearer than the mesh. Ray casting is the
                # slowest step, so only rays towards air are cast.
                is_reached = np.isfinite(air_distances)
                is_reached[is_reached] = air_distances[is_reached] < rays.lengths(
                    _start_points(test_rows[is_reached], sign), directions[is_reached])
                is_visible[remaining[is_reached], side] = True
                remaining = remaining[~is_reached]
            # In a room with a ceiling, a side counts only if there is a surface above it.
            if self.is_roofed:
                is_visible[:, side] &= _is_below_surface(rows, sign, is_visible[:, side], rays)
        return is_visible

    def _air_distance(self, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the lengths (N,) of rays until they enter the air, metres; inf for no entry."""
        edge = self.grid.edge
        max_length = max(2.0, 3.0 * (self.min_distance + edge))
        return edge * _count_steps_into(
            self.cells, (points - self.grid.low) / edge, directions, max_length / edge)


@njit(cache=True, nogil=True)
def _count_steps_into(cells, points, directions, max_steps):
    """
    Count the steps along rays until they enter marked cells.

    :param cells: (X, Y, Z) bool.
    :param points: (N, 3) the start points, in cell edges from the lowest corner of the grid.
    :param directions: (N, 3) unit direction vectors; a step is one cell edge long.
    :param max_steps: the steps of a ray stay below this number.
    :returns: (N,) numbers of steps; inf for rays that do not enter a marked cell.
    """
    steps = np.full(len(points), np.inf)
    last = np.array(cells.shape) - 1
    for row in range(len(points)):
        step = 1.0
        while step < max_steps and steps[row] == np.inf:
            # Outside of the grid, the nearest cell of the grid counts.
            x = min(max(int(np.floor(points[row, 0] + step * directions[row, 0])), 0), last[0])
            y = min(max(int(np.floor(points[row, 1] + step * directions[row, 1])), 0), last[1])
            z = min(max(int(np.floor(points[row, 2] + step * directions[row, 2])), 0), last[2])
            if cells[x, y, z]:
                steps[row] = step
            step += 1.0
    return steps


def _is_below_surface(rows: np.ndarray, sign: float, is_tested: np.ndarray, rays: MeshRays
                      ) -> np.ndarray:
    """
    Return which faces have a surface above one of their sides: (N,) bool.

    :param rows: (N, 6) points on the faces, metres, and their normals.
    :param sign: 1 for the side of the normal, -1 for the other side.
    :param is_tested: (N,) bool, the faces to test; False is returned for the others.
    """
    starts = _start_points(rows[is_tested], sign)
    hit_counts = np.zeros(len(rows), int)
    for direction in np.array([(0, 0, 1), (0.5, 0, 1), (-0.5, 0, 1), (0, 0.5, 1), (0, -0.5, 1)]):
        lengths = rays.lengths(starts, np.broadcast_to(direction, starts.shape))
        hit_counts[is_tested] += np.isfinite(lengths)
    # Three of the five upward directions have to hit a surface.
    return hit_counts >= 3


def _label_parts(cells: np.ndarray, edge: float) -> tuple[np.ndarray, np.ndarray]:
    """
    Number the connected parts of cells.

    :param cells: (X, Y, Z) bool.
    :param edge: the edge of a cell, metres.
    :returns: (X, Y, Z) the number of the part of each cell, 0 for no part; and the volume of each
        part by its number, cubic metres, 0 for number 0.
    """
    parts, _ = ndimage.label(cells)
    volumes = np.bincount(parts.ravel()) * edge ** 3
    volumes[0] = 0.0
    return parts, volumes


def _ends_at_surface(is_surface: np.ndarray, x: int, y: int) -> np.ndarray:
    """
    Return from which cells a level path ends at a surface: (X, Y, Z) bool.

    :param is_surface: (X, Y, Z) bool.
    :param x: with ``y``, the step of the path in cells, each -1, 0 or 1.
    """
    # A path along y alone: swap the axes, since the loop below follows x.
    if x == 0:
        return _ends_at_surface(is_surface.transpose(1, 0, 2), y, 0).transpose(1, 0, 2)
    # A row is the cells with one x. Each row takes over the result of the next row on the path,
    # which is complete before it.
    is_ended = is_surface.copy()
    rows = range(1, len(is_surface)) if x < 0 else range(len(is_surface) - 2, -1, -1)
    for row in rows:
        next_row = is_ended[row + x]
        if y < 0:
            is_ended[row, 1:] |= next_row[:-1]
        elif y > 0:
            is_ended[row, :-1] |= next_row[1:]
        else:
            is_ended[row] |= next_row
    return is_ended


def without_outside(scene: Scene) -> Scene:
    """
    Leave out the points of a solid model that the air of the room does not see, and say so.

    :returns: the same scene if no air is enclosed, or if its points are those of a scan: a scanner
        stands in the air, so the air sees nearly all its points. A scan that has drifted shows its
        surfaces twice; it stays whole and gets a note.
    """
    points, areas = scene.points.astype(np.float64), scene.pitch.astype(np.float64) ** 2
    air = EnclosedAir.of(points, float(np.median(scene.pitch)))
    if air is None:
        return scene
    if drift := _drift_of(scene, air):
        return replace(scene, notes=(*scene.notes, drift))
    cells = np.argwhere(air.cells | air.other_cells)
    # One test position per cubic metre, but 40 at least and 300 at most.
    test_count = int(np.clip(len(cells) * air.grid.edge ** 3, 40, 300))
    test_cells = cells[np.random.default_rng(0).permutation(len(cells))[:test_count]]
    view_counts = _count_views(scene, air.grid.middles(test_cells))
    invisible_area = areas[view_counts == 0].sum()
    # A scene with less than 14 % of invisible surface is a scan: real scans had at most 8 %.
    if invisible_area < 0.14 * areas.sum():
        return scene
    is_hidden, is_behind_face = _find_occluded(scene, air)
    # A point that is visible from half of the test positions is not hidden.
    is_kept = ~(is_hidden & (view_counts < 0.5 * len(test_cells)))
    # In a model, hidden points behind a wall have at least 40 % of the invisible area. Points of a
    # yard that was scanned too are invisible as well, but do not lie behind a wall.
    back_area = areas[is_hidden & is_behind_face & (view_counts == 0)].sum()
    if back_area < 0.4 * invisible_area or np.count_nonzero(is_kept) < MIN_POINTS:
        return scene
    dropped = 1.0 - is_kept.mean()
    said = (f'{100.0 * dropped:.0f} % of the points left out: those of a solid model that the air '
            'of the room does not see')
    # What leaves out over a third of a file is a doubt.
    if dropped > 1.0 / 3.0:
        return replace(scene.only(is_kept), notes=(*scene.notes, said))
    return replace(scene.only(is_kept), remarks=(*scene.remarks, said))


def has_two_floors(scene: Scene) -> bool:
    """Return whether a scan has drifted in height, so that parts of it repeat others."""
    air = EnclosedAir.of(scene.points.astype(np.float64), float(np.median(scene.pitch)))
    return air is not None and 'two floors' in _drift_of(scene, air)


def _drift_of(scene: Scene, air: EnclosedAir) -> str:
    """
    Return a note if a scan shows its surfaces twice, since the scanner has lost its place; or ''.

    The points of a model are exact, or its slabs and its walls both have two sides. Drift in
    height doubles floors, drift on the level only walls. Walls between rooms have air on both
    sides.
    """
    normals, points = scene.normals_or_estimate.astype(np.float64), scene.points.astype(np.float64)
    tree, pitch = cKDTree(points), float(np.median(scene.pitch))
    some = np.random.default_rng(0).permutation(len(points))[:3000]
    offsets = points[tree.query(points[some], 9)[1]] - points[some, None]
    # The distances of the nearest points from the plane of each point.
    noise = np.median(np.abs(np.einsum('nkj,nj->nk', offsets[:, 1:], normals[some])))
    # Points too far apart do not show two surfaces beside each other.
    if noise < 0.0003 or pitch > 0.08:
        return ''
    is_level = np.abs(normals[some, 2]) > 0.9
    is_wall = np.abs(normals[some, 2]) < STEEP
    # Both are needed to tell drift from a model.
    if min(is_level.sum(), is_wall.sum()) < 100:
        return ''
    is_air = air.cells | air.other_cells
    found = {}
    for name, chosen in (('floors', some[is_level]), ('walls', some[is_wall])):
        gaps = np.full(len(chosen), np.nan)
        # Look for a parallel surface along the normal on both sides.
        for shift in np.concatenate([np.arange(0.1, 0.6, 0.05), np.arange(-0.1, -0.6, -0.05)]):
            distances, index = tree.query(points[chosen] + shift * normals[chosen],
                                          distance_upper_bound=max(1.2 * pitch, 0.03))
            near = np.flatnonzero(np.isfinite(distances) & np.isnan(gaps))
            here, there = chosen[near], index[near]
            gap = np.einsum('nj,nj->n', points[there] - points[here], normals[here])
            side = 0.4 * np.sign(shift) * normals[here]
            is_double = ((np.abs(gap) > 0.08)
                         & (np.abs(np.einsum('nj,nj->n', normals[there], normals[here])) > 0.95)
                         & ~(is_air[tuple(air.grid.cells(points[here] - side))]
                             & is_air[tuple(air.grid.cells(points[there] + side))]))
            gaps[near[is_double]] = np.abs(gap[is_double])
        found[name] = gaps
    shares = {name: float(np.mean(np.isfinite(gaps))) for name, gaps in found.items()}
    rarer, doubled = sorted(shares, key=shares.__getitem__)
    if shares[doubled] < 0.2 or shares[rarer] > 0.15:
        return ''
    # Where scans overlap only in part, fewer walls are doubled, but all by one distance, or by one
    # each way: count the gaps within 5 cm of each other, twice. Tops of furniture are like floors.
    gaps = np.sort(found[doubled][np.isfinite(found[doubled])])
    other_gaps = gaps
    for _ in range(2):
        counts = np.searchsorted(other_gaps, other_gaps + 0.05) - np.arange(len(other_gaps))
        first = int(counts.argmax()) if len(counts) else 0
        other_gaps = np.delete(other_gaps, slice(first, first + counts.max(initial=0)))
    if shares[doubled] < 0.33 and (doubled == 'floors' or len(other_gaps) > 0.1 * len(gaps)):
        return ''
    low, high = np.percentile(gaps, [10.0, 90.0])
    gap = f'{high:.2f} m' if high - low < 0.03 else f'{low:.2f} to {high:.2f} m'
    return (f'found two {doubled} {gap} apart along {100.0 * shares[doubled]:.0f} % of them; '
            'expected one of each; the scan has drifted: align its parts, or scan again')


def _count_views(scene: Scene, positions: np.ndarray) -> np.ndarray:
    """Return from how many of the positions (M, 3), metres, each point is visible: (N,)."""
    # Visibility of the points alone: there are no positions in the air (the empty array).
    visibility = SurfelVisibility(scene.points, scene.normals_or_estimate, scene.pitch,
                                  np.empty((0, 3), dtype=np.float32), FINE)
    # An omnidirectional camera whose range covers the room.
    lens = CameraModel(0.0, 2.0 * scene.diameter).lens
    counts = np.zeros(len(scene), dtype=int)
    for position in positions:
        visible_bits = no_bits(len(scene))
        visibility.look(Pose(position, LEVEL), lens, visible_bits)
        # The bits have the points in the order of ``visibility``.
        counts[visibility.order] += unpack(visible_bits, len(scene))
    return counts


def _find_occluded(scene: Scene, air: EnclosedAir) -> tuple[np.ndarray, np.ndarray]:
    """
    Find the points that other points separate from the nearest enclosed air.

    :returns: (N,) bool, whether each point is so occluded; and (N,) bool, whether the nearest air
        lies in front of or behind the surface of the point, not beside it.
    """
    points, pitch = scene.points.astype(np.float64), scene.pitch
    air_cells = ndimage.distance_transform_edt(
        ~(air.cells | air.other_cells), return_distances=False, return_indices=True)
    air_positions = air.grid.middles(air_cells[(slice(None), *air.grid.cells(points))].T)
    air_distances = np.linalg.norm(air_positions - points, axis=1)
    directions = (air_positions - points) / air_distances[:, None]
    # The nearest air is across the surface, not beside the point along the surface: within 45
    # degrees of the normal or of its opposite.
    is_across = np.abs(np.einsum('nk,nk->n', directions, scene.normals_or_estimate)) >= 0.7
    tree = cKDTree(points)
    is_hidden = np.zeros(len(points), dtype=bool)
    # Look for other points at growing distances along the line from each point to the air.
    distance = 0.05
    # The largest thickness of a wall or slab is 0.6 m.
    while distance < 0.6:
        remaining = np.flatnonzero(~is_hidden & (air_distances > distance + air.grid.edge))
        point_distances, _ = tree.query(points[remaining] + distance * directions[remaining],
                                        distance_upper_bound=2.0 * float(np.median(pitch)))
        # Another point hides a point if it is near to this place on the line: nearer than 0.6 of
        # the distance, and than the edge of the square that the hidden point stands for.
        is_hidden[remaining] = point_distances < np.minimum(0.6 * distance, pitch[remaining])
        distance *= 1.25
    # Some hidden points pass the test through gaps between the points in front of them, so a point
    # is hidden too if most of the nine points nearest to it (itself included) are.
    return is_hidden | (is_hidden[tree.query(points, 9)[1]].mean(axis=1) > 0.6), is_across
