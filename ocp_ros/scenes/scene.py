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

"""A scene: the points of a room and their properties that the engine needs."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.geometry.normals import edge_aware_normals
from ocp_ros.scenes.neighbours import nearest
from ocp_ros.scenes.source_frame import axis_of, SourceFrame
from ocp_ros.util.settings import UserError
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import pdist

#: The least number of points of a scene.
MIN_POINTS = 100
#: The number of nearest points, with the point itself, to which the plane at a point is fitted.
PLANE_NEIGHBOURS = 14
#: Metres: the upper limit of the largest extent of a scene.
MAX_EXTENT_M = 500.0
#: The length in metres of the other units of length that scanners export.
UNITS_M = {'millimetres': 0.001, 'centimetres': 0.01, 'inches': 0.0254}


class SceneError(UserError):
    """Report a room that cannot be used; the message says what was found and what to do."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """
    A triangle mesh: the surfaces that the points of a room lie on.

    :ivar vertices: (V, 3) float32, metres, map frame.
    :ivar triangles: (T, 3) int32, indices into the vertices.
    :ivar exact: whether the points lie exactly on the mesh, without measurement errors of a
        scanner.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    exact: bool = False

    @property
    def corners(self) -> np.ndarray:
        """Return the corners of the triangles: (T, 3, 3), metres."""
        return self.vertices[self.triangles]


@dataclass(frozen=True, eq=False)
class Rooms:
    """
    The R rooms of a floor, on a plan of X x Y square cells.

    :ivar numbers: (X, Y) int, the room of each cell, from 1 to R; 0 in walls and outside.
    :ivar edge: the edge of a cell, metres.
    :ivar corner: (2,) metres, the lowest corner of the plan.
    :ivar axes: (2, 2), the directions of the plan: ``places @ axes`` leads from the map to them.
    """

    numbers: np.ndarray
    edge: float
    corner: np.ndarray
    axes: np.ndarray = field(default_factory=lambda: np.eye(2))

    @property
    def count(self) -> int:
        """Return the number of rooms, R."""
        return int(self.numbers.max())

    @property
    def areas(self) -> np.ndarray:
        """Return the area of each room, square metres: (R,)."""
        return np.bincount(self.numbers.ravel(), minlength=self.count + 1)[1:] * self.edge ** 2

    @property
    def middles(self) -> np.ndarray:
        """Return the place in each room that is farthest from its walls: (R, 2) metres."""
        depths = ndimage.distance_transform_edt(self.numbers > 0)
        cells = ndimage.maximum_position(depths, self.numbers, np.arange(self.count) + 1)
        return (self.corner + self.edge * (np.array(cells) + 0.5)) @ self.axes.T

    @cached_property
    def _nearest(self) -> np.ndarray:
        """Return the nearest room of each part of a cell."""
        # The two faces of a wall belong to two rooms, so the cells are subdivided, into about four
        # million cells at most.
        subdivisions = int(np.clip(np.sqrt(4_000_000 / self.numbers.size), 1, 4))
        fine = self.numbers.repeat(subdivisions, axis=0).repeat(subdivisions, axis=1)
        _, (x, y) = ndimage.distance_transform_edt(fine == 0, return_indices=True)
        return fine[x, y]

    def at(self, places: np.ndarray) -> np.ndarray:
        """Return the room nearest to each place (M, 2 or 3), metres, map frame: (M,)."""
        fine_edge = self.edge * len(self.numbers) / len(self._nearest)
        cells = ((places[:, :2] @ self.axes - self.corner) / fine_edge).astype(int)
        return self._nearest[tuple(np.clip(cells, 0, np.array(self._nearest.shape) - 1).T)]

    def turned(self, rotation: np.ndarray) -> 'Rooms':
        """Return the rooms of the floor after a rotation (3, 3) about the vertical."""
        return replace(self, axes=rotation[:2, :2] @ self.axes)


class Scan(NamedTuple):
    """
    A scan from one place.

    :ivar station: (3,) metres, where the scanner stood.
    :ivar points: (M, 3) metres, the points that it measured, perhaps thinned.
    """

    station: np.ndarray
    points: np.ndarray


@dataclass(frozen=True, eq=False)
class Scene:
    """
    A room as points.

    :ivar points: (N, 3) float32, metres, map frame, z up.
    :ivar name: the name in tables and file names.
    :ivar normals: (N, 3) float32 unit vectors, or None if they are not known.
    :ivar mesh: the surfaces that the points lie on, or None if they are not known.
    :ivar source: the frame of the file that the points were read from.
    :ivar notes: problems that reading the file found, one sentence each.
    :ivar remarks: corrections that reading the file made, one sentence each.
    :ivar survey: the same room with the points that it was measured on, if they are others: an
        answer about the scan does not depend on how far it is thinned.
    :ivar rooms: the rooms of a floor; None for one room.
    :ivar scans: of which the room was merged; empty if they are not known.
    :raises SceneError: if the points are not a room (see :func:`check_points`).
    """

    points: np.ndarray
    name: str = 'scene'
    normals: np.ndarray | None = None
    mesh: Mesh | None = field(default=None, repr=False)
    source: SourceFrame = field(default_factory=SourceFrame, repr=False)
    notes: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    survey: 'Scene | None' = field(default=None, repr=False)
    rooms: Rooms | None = field(default=None, repr=False)
    scans: tuple[Scan, ...] = field(default=(), repr=False)

    def __post_init__(self) -> None:
        """Convert the points to float32 in C order and refuse points that are not a room."""
        check_points(self.points, self.name)
        object.__setattr__(self, 'points', np.ascontiguousarray(self.points, dtype=np.float32))
        if self.normals is not None:
            if np.shape(self.normals) != self.points.shape:
                raise SceneError(f'{self.name}: found normals of shape {np.shape(self.normals)}; '
                                 f'expected {self.points.shape}, one per point')
            object.__setattr__(
                self, 'normals', np.ascontiguousarray(self.normals, dtype=np.float32))

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points)

    def only(self, is_kept: np.ndarray) -> 'Scene':
        """Return the room with only the points that ``is_kept`` (N,) bool marks."""
        return replace(self, points=self.points[is_kept],
                       normals=None if self.normals is None else self.normals[is_kept])

    @property
    def surveyed(self) -> 'Scene':
        """Return the room with the points that it was measured on."""
        return self if self.survey is None else self.survey

    @cached_property
    def bounds(self) -> np.ndarray:
        """Return the bounding box: (2, 3) float64, lowest and highest corner, metres."""
        return corners_of(self.points).astype(np.float64)

    @property
    def size(self) -> np.ndarray:
        """Return the extent of the bounding box: (3,) float64, metres."""
        return self.bounds[1] - self.bounds[0]

    @cached_property
    def diameter(self) -> float:
        """Return the largest distance between two points, metres."""
        try:
            corners = self.points[ConvexHull(self.points).vertices]
        except QhullError:
            # The points nearly lie in a plane: use the diagonal of their box.
            return float(np.linalg.norm(self.size))
        return float(pdist(corners.astype(np.float64)).max())

    @cached_property
    def _neighbours(self) -> tuple[np.ndarray, np.ndarray]:
        """Return distances and indices (N, K) of the nearest points; the first is the point."""
        return nearest(self.points, PLANE_NEIGHBOURS)

    @cached_property
    def normals_or_estimate(self) -> np.ndarray:
        """Return the normals (N, 3), or those of planes fitted to neighbours if none are known."""
        if self.normals is not None:
            return self.normals
        return edge_aware_normals(self.points, self._neighbours[1])

    @cached_property
    def spacing(self) -> np.ndarray:
        """Return the distance from each point to its nearest neighbour: (N,) float32, metres."""
        return self._neighbours[0][:, 1].astype(np.float32)

    @cached_property
    def pitch(self) -> np.ndarray:
        """
        Return the edge of the square of surface that each point stands for: (N,) float32, metres.

        The edge is at most four times the median, since an isolated point is a speck, not a wall.
        """
        # A disc up to the eighth neighbour has the area of the squares of eight points.
        pitch = self._neighbours[0][:, 8] * np.sqrt(np.pi / 8.0)
        return np.minimum(pitch, 4.0 * np.median(pitch)).astype(np.float32)


def turned(scene: Scene, degrees: float) -> Scene:
    """
    Return a room that is rotated about the vertical axis through the origin.

    :param degrees: counter-clockwise seen from above.
    """
    rotation = rotation_matrix(np.deg2rad(degrees))
    mesh = scene.mesh
    if mesh is not None:
        mesh = replace(mesh, vertices=(mesh.vertices @ rotation.T).astype(np.float32))
    normals = None if scene.normals is None else scene.normals @ rotation.T
    rotated = Scene(scene.points @ rotation.T, f'{scene.name}@{degrees:g}', normals, mesh,
                    scene.source.rotated(rotation), scene.notes, scene.remarks,
                    None if scene.survey is None else turned(scene.survey, degrees),
                    scene.rooms and scene.rooms.turned(rotation),
                    tuple(Scan(*(part @ rotation.T for part in scan)) for scan in scene.scans))
    # A rotation keeps distances, but distances of the rotated points would differ by rounding. So
    # the properties with distances are copied.
    rotated.__dict__.update((name, getattr(scene, name))
                            for name in ('_neighbours', 'spacing', 'pitch', 'diameter'))
    return rotated


def check_points(points: np.ndarray, name: str, up: str = 'z') -> None:
    """
    Refuse points that are not a room in metres.

    :param points: (N, 3) array.
    :param name: the name of the points in the message.
    :param up: the direction that points up, one of
        :data:`~ocp_ros.scenes.source_frame.UP_AXES`; the message guesses a wrong unit from the
        height.
    :raises SceneError: for a wrong shape, fewer than 100 points, NaN or inf, a flat cloud, or a
        size that no room in metres has.
    """
    check_numbers(points, name)
    # Coordinates such as 1e308 are refused as too large, without a NumPy warning.
    with np.errstate(over='ignore', invalid='ignore'):
        _check_extent(np.asarray(points, dtype=np.float64), name, axis_of(up))


def check_numbers(points: np.ndarray, name: str) -> None:
    """
    Refuse an array that is not at least 100 finite points.

    :param points: (N, 3) array.
    :param name: the name of the points in the message.
    :raises SceneError: for a wrong shape, fewer than 100 points, NaN or inf.
    """
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise SceneError(f'{name}: found an array of shape {points.shape}; expected (N, 3), '
                         'one row x y z per point')
    if len(points) == 0:
        raise SceneError(f'{name}: found no points; expected a room of at least {MIN_POINTS}; '
                         'check that the file was written completely')
    broken_count = int(np.count_nonzero(~np.isfinite(points).all(axis=1)))
    if broken_count:
        raise SceneError(
            f'{name}: found {broken_count:,} of {len(points):,} points with NaN or inf; expected '
            'finite metres; remove them first or leave them out (--drop-nonfinite)')
    if len(points) < MIN_POINTS:
        raise SceneError(f'{name}: found {len(points)} points; expected at least {MIN_POINTS} to '
                         'describe a room; use a denser scan')


def _check_extent(points: np.ndarray, name: str, up: int) -> None:
    """Refuse points (N, 3) that are flat or not of the size of a room; axis ``up`` is vertical."""
    size = np.ptp(corners_of(points), axis=0)
    found = f'{name}: found a bounding box of ' + ' x '.join(f'{s:.4g}' for s in size)
    # The smallest extent of a room, its height or its width, is at most 40 m.
    if size.max() > MAX_EXTENT_M or size.min() > 40.0:
        # The size without two per cent of the points at either end of each axis.
        core = np.subtract(*np.percentile(points, [98, 2], axis=0))
        if size.max() > MAX_EXTENT_M and core.max() <= 0.1 * size.max():
            raise SceneError(f'{found} m around points that mostly lie within {core.max():.3g}; '
                             'expected one room; remove the stray points')
        units = _likely_units(core, up)
        if not units:
            raise SceneError(f'{found}; expected metres, and no room is that large, nor in '
                             f'{", ".join(UNITS_M)}; scale it to metres (--scale), or cut one '
                             'room out of it')
        scales = ' or '.join(f'--scale {UNITS_M[unit]:g}' for unit in units)
        raise SceneError(f'{found}; expected metres, and no room is that large: these look like '
                         f'{" or ".join(units)}; scale it ({scales})')
    if size.max() < 0.5:
        raise SceneError(f'{found}; expected a room of at least 0.5 m: the unit may not be the '
                         'metre; correct it (--scale, 1000 for kilometres), or check the export')
    min_thickness_m = 0.05
    if size.min() < min_thickness_m or _thickness(points) < min_thickness_m:
        raise SceneError(f'{found} m; expected a room with volume: the cloud is flat; use a scan '
                         'that shows more than one wall')


def _likely_units(size: np.ndarray, up: int) -> list[str]:
    """Return the units in which ``size`` (3,) is that of a room, the most likely first, or []."""
    heights = {unit: scale * size[up] for unit, scale in UNITS_M.items()
               if scale * size.max() <= MAX_EXTENT_M}
    # A room is usually 2.7 m high, and always 1.5 to 12 m.
    return sorted((unit for unit, height in heights.items() if 1.5 <= height <= 12.0),
                  key=lambda unit: abs(np.log(heights[unit] / 2.7)))


def _thickness(points: np.ndarray) -> float:
    """Return the extent of points (N, 3) in the direction of least variance, metres."""
    centred = points - points.mean(axis=0)
    return float(np.ptp(centred @ np.linalg.eigh(centred.T @ centred)[1][:, 0]))
