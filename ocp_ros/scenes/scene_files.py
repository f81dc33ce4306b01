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

"""Rooms from files: scans, S3DIS rooms as .txt, and meshes."""

from dataclasses import replace
import difflib
import io
import logging
from os import PathLike
from pathlib import Path
import warnings

import numpy as np
from ocp_ros.geometry.clouds import away_from, corners_of
from ocp_ros.geometry.voxels import MIN_VOXEL_M, voxel_downsample, voxel_size_for
from ocp_ros.scenes.file_formats import Declared, declared_by, MEASURED, READERS
from ocp_ros.scenes.inner_surface import inner_surface, without_outside
from ocp_ros.scenes.main_room import main_room
from ocp_ros.scenes.measured_room import CORNERS, room_between
from ocp_ros.scenes.mesh_files import MESH_SAMPLES, sampled
from ocp_ros.scenes.mirror_images import without_mirror_images
from ocp_ros.scenes.scene import (
    check_numbers,
    check_points,
    Mesh,
    MIN_POINTS,
    Scene,
    SceneError,
)
from ocp_ros.scenes.source_frame import SourceFrame
from ocp_ros.scenes.stray_points import isolated_points, stray_points
from ocp_ros.scenes.up_axis import (
    AUTO,
    axis_of,
    BY_FILE,
    likely_up,
    likely_up_axis,
    map_from_file,
    UP_CHOICES,
)
from ocp_ros.util.files import write_atomically
from ocp_ros.util.settings import UserError
from ocp_ros.util.terminal_text import printable
from plyfile import PlyData, PlyElement

#: The number of sample points on a mesh from which its size, axes and stray parts are found.
ROUGH_SAMPLES = 60_000

_log = logging.getLogger(__name__)


class SceneWarning(UserWarning):
    """Warn of a room that can be used but may be wrong."""


def load_scene(path, *, voxel_size: float = 0.0, max_points: int = 0, scale: float = 0.0,
               up: str = BY_FILE, drop_nonfinite: bool = False, all_rooms: bool = False) -> Scene:
    """
    Read a room from a file.

    Exact duplicates are removed, and stray points (see
    :func:`~ocp_ros.scenes.stray_points.stray_points`). Coordinates farther than 1 km from the
    origin, such as UTM, are moved near it by whole hundreds of metres, since float32 would round
    them. All changes are logged. ``source`` converts back to the file's coordinates, ``notes``
    list possible problems, and ``remarks`` list what was left out.
    Normals are kept if the file has them and no points are merged.

    From a mesh (.obj, .stl, .off, .glb, .gltf, and .ply with faces) 300,000 points, or
    ``max_points``, are sampled evenly by area and always the same. They lie on the sides of the
    faces that are visible from the air of the room, see :mod:`ocp_ros.scenes.inner_surface`, with
    the normals of these sides.

    :param path: a scan or mesh with a suffix of ``READERS``. The name of the room is the stem of
        the file, and ``Area_1_office_1`` for an S3DIS room ``Area_1/office_1/office_1.txt``.
    :param voxel_size: edge of the cubes whose points are merged, metres; 0 merges none.
    :param max_points: the largest number of points if no voxel size is given; 0 for all of them.
    :param scale: metres per unit of the file, such as 0.001 for millimetres; 0 for the unit that
        the file declares, or metres if it declares none.
    :param up: the direction of the file that points up, such as ``'z'`` or ``'-y'``; ``'auto'``
        for a guess, which the remarks name; ``'file'`` for the direction that its format declares
        (y for glTF), or z if it declares none.
    :param drop_nonfinite: leave out points with NaN or inf instead of refusing the file.
    :param all_rooms: keep the parts of other rooms that are visible through openings such as
        doors; see :mod:`ocp_ros.scenes.main_room`.
    :returns: the scene, in metres, z up.
    :raises SceneError: if the file or an option cannot be used; the message names the file.
    """
    if isinstance(path, bool) or not isinstance(path, (str, PathLike)):
        raise SceneError(f'path: found {type(path).__name__}; expected the path of a scan; of '
                         'points in memory scene_of makes a room')
    path = Path(path)
    _check_options(path.name, voxel_size, max_points, scale, up, by_file=True)
    rows, corners = _read(path)
    return _scene_from(rows, path.name, _scene_name(path), declared_by(path), corners,
                       voxel_size=voxel_size, max_points=max_points, scale=scale, up=up,
                       drop_nonfinite=drop_nonfinite, all_rooms=all_rooms)


def scene_of(points, *, name: str = 'points', voxel_size: float = 0.0, max_points: int = 0,
             scale: float = 1.0, up: str = 'z', drop_nonfinite: bool = False,
             all_rooms: bool = False) -> Scene:
    """
    Make a room of points in memory, as :func:`load_scene` does with the points of a file.

    :param points: (N, 3), in units of ``scale`` metres.
    :param name: the name of the room in messages and tables.
    :raises SceneError: if the points or an option cannot be used.
    """
    _check_options(name, voxel_size, max_points, scale, up)
    try:
        points = np.array(points, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise SceneError(f'{name}: found {type(points).__name__} that is no array of numbers; '
                         'expected (N, 3), one row x y z per point') from error
    if points.ndim != 2 or points.shape[1] != 3:
        check_numbers(points, name)
    return _scene_from(points, name, printable(name), Declared(), voxel_size=voxel_size,
                       max_points=max_points, scale=scale, up=up, drop_nonfinite=drop_nonfinite,
                       all_rooms=all_rooms)


def _scene_from(rows: np.ndarray, name: str, called: str, said: Declared,
                corners: np.ndarray | None = None, *, voxel_size: float, max_points: int,
                scale: float, up: str, drop_nonfinite: bool, all_rooms: bool) -> Scene:
    """
    Make a room of points in the unit and axes of a file; messages name the file.

    :param rows: (N, 3) points, or (N, 6) with their normals, overwritten.
    :param said: the unit and axes that the file declares.
    :param corners: (T, 3, 3) corners of the triangles of the mesh that the points lie on.
    """
    notes: list[str] = []
    if corners is None and len(rows) == CORNERS:
        rows, corners, notes = _between(rows[:, :3], name)
    remarks: tuple[str, ...] = ()
    if scale == 0.0 and said.metres != 1.0 or up == BY_FILE and said.up != 'z':
        remarks = (said.remark,)
    scale, up = scale or said.metres, said.up if up == BY_FILE else up
    if drop_nonfinite:
        rows = _without_nonfinite(rows, name)
    with np.errstate(over='ignore'):
        rows[:, :3] *= scale
    check_numbers(rows[:, :3], name)
    rows, strays = _without_strays(rows, name)
    remarks += strays
    points = rows[:, :3]
    check_points(points, name, 'z' if up == AUTO else up)
    if up == AUTO:
        up = likely_up(points)
        remarks += (f'up: {up}, a guess (--up)',)
    notes += _size_notes(points, up)
    rotation = map_from_file(up)
    points, shift = _near_origin(points @ rotation.T, name)
    source = SourceFrame(scale, rotation, shift)
    points, normals = _without_duplicates(points.astype(np.float32),
                                          _unit(rows[:, 3:], rotation), name)
    if axis_of(up) == 2 and (sideways := _up_notes(points)):
        notes += sideways
        all_rooms = True
    mesh = inner = None
    if corners is not None:
        mesh = _mesh_of(corners, source, corners_of(points))
        solids = None if said.solids is None else source.to_map(said.solids)
        inner = inner_surface(mesh, max_points or MESH_SAMPLES, voxel_size, name, solids)
    if mesh is not None and inner is None:
        remarks += ('no air is closed in: all faces count, from both sides',)
        if voxel_size:
            mesh = replace(mesh, exact=False)
        rows = sampled(mesh.corners, MESH_SAMPLES if voxel_size else max_points or MESH_SAMPLES)
        points, normals = (part.astype(np.float32) for part in np.hsplit(rows, 2))
    if inner is not None:
        scene = Scene(inner.points, called, inner.normals, mesh, source, tuple(notes),
                      remarks + inner.remarks)
        return _warned(scene if all_rooms else main_room(scene, inner.points), name)
    merged = _merge(points, voxel_size, max_points, name)
    if len(merged) < len(points):
        remarks += (f'{len(merged):,} of {len(points):,} points kept (--points)',)
        normals = None
    if (lone := isolated_points(merged)).any() and _is_room(merged[~lone], name):
        count = int(np.count_nonzero(lone))
        remarks += (f'{count:,} isolated point{"s" * (count > 1)} left out',)
        _log.warning('%s: %s', printable(name), remarks[-1])
        merged, normals = merged[~lone], None if normals is None else normals[~lone]
    scene = without_mirror_images(Scene(
        merged, called, normals, mesh, source, tuple(notes), remarks))
    if len(scene) < len(merged):
        # Points behind a mirror must not count as another room.
        points = scene.points
    scene = without_outside(scene)
    return _warned(scene if all_rooms else main_room(scene, points), name)


def _warned(scene: Scene, name: str) -> Scene:
    """Show the notes of a room as warnings, and return the room."""
    for note in scene.notes:
        warnings.warn(f'{name}: {note}', SceneWarning, stacklevel=4)
    return scene


def _between(points: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return points on the sides of the room with eight corners, its triangles, and notes."""
    found = room_between(points)
    if found is None:
        raise SceneError(f'{name}: found eight points that are not the corners of a convex room; '
                         'expected those, or at least 100 points of a scan; measure the corners '
                         'again')
    corners, flat = found
    return sampled(corners, ROUGH_SAMPLES), corners, [] if flat else [
        'found eight corners between which sides are not flat; expected six flat ones; measure '
        'the corners again unless the room is so']


def _mesh_of(corners: np.ndarray, source: SourceFrame, bounds: np.ndarray) -> Mesh:
    """
    Return triangles (T, 3, 3) of a file in the map frame, those with NaN left out.

    :param bounds: (2, 3) metres, the bounds of the kept points: triangles far outside are stray.
    """
    corners = source.to_map(corners[np.isfinite(corners).all(axis=(1, 2))])
    # Faces farther than this outside of the bounds of the kept points are stray.
    margin_m = 0.5
    inside = ((corners.min(axis=1) >= bounds[0] - margin_m)
              & (corners.max(axis=1) <= bounds[1] + margin_m))
    vertices = corners[inside.all(axis=1)].reshape(-1, 3)
    return Mesh(vertices.astype(np.float32),
                np.arange(len(vertices), dtype=np.int32).reshape(-1, 3), exact=True)


def load_cloud(path: str | Path) -> np.ndarray:
    """
    Read a cloud that is not a room, such as the points that one camera measured.

    :param path: a file of one of the formats of rooms.
    :returns: (N, 3) float64 finite points, in the file's unit and axes.
    :raises SceneError: if it cannot be read.
    """
    points = _read(Path(path))[0][:, :3]
    return points[np.isfinite(points).all(axis=1)]


def save_scene(scene: Scene, path: str | Path) -> None:
    """
    Write the points of a room as .ply, and its mesh, where it has one, as ``<stem>_mesh.ply``.

    :raises SceneError: if the files cannot be written.
    """
    path = Path(path)
    named = [('x', 'f4'), ('y', 'f4'), ('z', 'f4')]
    elements = {path: [PlyElement.describe(_rows(scene.points, named), 'vertex')]}
    if scene.mesh is not None:
        faces = np.empty(len(scene.mesh.triangles), dtype=[('vertex_indices', 'i4', (3,))])
        faces['vertex_indices'] = scene.mesh.triangles
        elements[mesh_of(path)] = [
            PlyElement.describe(_rows(scene.mesh.vertices, named), 'vertex'),
            PlyElement.describe(faces, 'face')]
    try:
        for name, parts in elements.items():
            content = io.BytesIO()
            PlyData(parts).write(content)
            write_atomically(name, content.getvalue())
    except OSError as error:
        raise SceneError(f'{path}: found a place that cannot be written to ({error.strerror}); '
                         'expected a folder that may be; name another one') from error


def mesh_of(path: Path) -> Path:
    """Return the path of the mesh of a room."""
    return path.with_name(f'{path.stem}_mesh.ply')


def scans_in(folder: str | Path) -> list[Path]:
    """
    List the scans of a folder by name.

    Meshes that :func:`save_scene` wrote beside their rooms and hidden files are left out.
    """
    found = sorted(path for path in Path(folder).glob('*')
                   if path.suffix.lower() in {*READERS}.difference(MEASURED)
                   and not path.name.startswith('.'))
    meshes = set(map(mesh_of, found))
    return [path for path in found if path not in meshes]


def check_file(path: Path) -> None:
    """
    Refuse a path that is not a file with content and a known suffix.

    :raises SceneError: if the path is not usable.
    """
    known = sorted(READERS)
    if not path.exists():
        raise SceneError(f'{path}: found no such file; expected one of {" ".join(known)}; check '
                         'the path')
    if not path.is_file():
        inside = [item.name for item in path.glob('*') if item.suffix.lower() in READERS]
        hint = f'such as {sorted(inside)[0]}' if inside else f'one of {" ".join(known)}'
        raise SceneError(f'{path}: found a folder or device; expected a file; give the path of a '
                         f'file, {hint}')
    if path.suffix.lower() not in READERS:
        near = difflib.get_close_matches(path.suffix.lower(), known, n=1)
        hint = f'did you mean {near[0]}?' if near else 'convert it, for example with CloudCompare'
        raise SceneError(f'{path.name}: found the suffix {path.suffix!r}; expected one of '
                         f'{" ".join(known)}; {hint}')
    if path.stat().st_size == 0:
        raise SceneError(f'{path.name}: found an empty file; expected a room of at least '
                         f'{MIN_POINTS} points; copy or export it again')


def _rows(values: np.ndarray, named: list[tuple[str, str]]) -> np.ndarray:
    """Return an array (N, C) as records."""
    return np.rec.fromarrays(values.T, dtype=named)


def _check_options(name: str, voxel_size: float, max_points: int, scale: float, up: str,
                   by_file: bool = False) -> None:
    """Refuse invalid options; points in memory have no file that gives their scale or up."""
    directions = [choice for choice in UP_CHOICES if by_file or choice != BY_FILE]
    for option, value in (('voxel_size', voxel_size), ('max_points', max_points),
                          ('scale', scale)):
        if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
            raise SceneError(f'{name}: found {option}={value!r}; expected a number')
    for option, value, usable, expected in (
            ('voxel_size', voxel_size, voxel_size == 0 or MIN_VOXEL_M <= voxel_size < np.inf,
             f'0 or at least {MIN_VOXEL_M} m'),
            ('max_points', max_points, max_points == 0 or max_points >= MIN_POINTS,
             f'0 or at least {MIN_POINTS}'),
            ('scale', scale, by_file and scale == 0 or 1e-6 <= scale <= 1e6,
             '0.000001 to 1000000, such as 0.001'),
            ('up', up, isinstance(up, str) and up in directions,
             f"one of {', '.join(directions)}")):
        if not usable:
            raise SceneError(f'{name}: found {option}={value!r}; expected {expected}')


def _scene_name(path: Path) -> str:
    """Return the stem of the file as the room's name, or area and room in S3DIS folders."""
    room, area = path.absolute().parent.name, path.absolute().parent.parent.name
    alike = room.replace('_', '') == path.stem.replace('_', '')
    s3dis = path.suffix == '.txt' and alike and area.startswith('Area_')
    return printable(f'{area}_{room}' if s3dis else path.stem)


def _read(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """
    Read a file with its reader in ``READERS``; turn all errors into a SceneError.

    :returns: points, with normals if there are any, and the corners (T, 3, 3) of the triangles of
        the mesh that they lie on, or None.
    """
    try:
        check_file(path)
        rows = READERS[path.suffix.lower()](path)
        if rows.shape[1] < 9:
            return rows, None
        corners = rows.reshape(-1, 3, 3)
        return sampled(corners, ROUGH_SAMPLES), corners
    except UserError as error:
        raise SceneError(str(error)) from error
    except ImportError as error:
        raise SceneError(f'{path.name}: found a {path.suffix} file and no package that reads it; '
                         f'expected {error}') from error
    except OSError as error:
        raise SceneError(f'{path.name}: found a file that cannot be read ({error}); expected one '
                         'that may be opened; check its permissions and the disk') from error
    except Exception as error:  # A broken file makes the libraries raise almost anything.
        reason = (str(error).splitlines() or [''])[0][:200] or type(error).__name__
        raise SceneError(f'{path.name}: found content that cannot be read ({reason}); expected a '
                         f'plain, complete {path.suffix} file; copy or export it again') from error


def _without_nonfinite(rows: np.ndarray, name: str) -> np.ndarray:
    """Leave out the points with NaN or inf, and their normals."""
    keep = np.isfinite(rows[:, :3]).all(axis=1)
    if not keep.all():
        _log.info('%s: %d of %d points kept, the others are NaN or inf',
                  name, keep.sum(), len(keep))
    return rows[keep]


def _without_strays(rows: np.ndarray, name: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """Leave out stray points and their normals; return a remark about them."""
    points = rows[:, :3]
    stray = stray_points(points)
    if not stray.any():
        return rows, ()
    away = away_from(points[stray], corners_of(points[~stray]))
    remark = (f'{len(away):,} stray point{"s" * (len(away) > 1)} left out, up to '
              f'{away.max():.3g} m outside of the rest')
    _log.warning('%s: %s', printable(name), remark)
    return rows[~stray], (remark,)


def _is_room(points: np.ndarray, name: str) -> bool:
    """Return whether the points pass the checks of a room."""
    try:
        check_points(points, name)
    except SceneError:
        return False
    return True


def _near_origin(points: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Move distant coordinates, which float32 would round; return the shift (3,), metres, too."""
    low, high = corners_of(points)
    if np.linalg.norm(np.maximum(abs(low), abs(high))) <= 1000.0:
        return points, np.zeros(3)
    offset = np.round(low, -2) + 0.0
    # This is a warning, since all placements found will be in the moved coordinates.
    _log.warning('%s: found coordinates far from the origin; subtracted (%.0f, %.0f, %.0f) m',
                 printable(name), *offset)
    return points - offset, offset


def _unit(normals: np.ndarray, rotation: np.ndarray) -> np.ndarray | None:
    """Return rotated unit normals; None if there are none, or some have length zero or NaN."""
    if not normals.size:
        return None
    normals = normals @ rotation.T
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    usable = np.isfinite(length).all() and (length > 0.0).all()
    return (normals / length).astype(np.float32) if usable else None


def _without_duplicates(points: np.ndarray, normals: np.ndarray | None, name: str):
    """Keep the first of equal float32 points: the others would have a spacing of zero."""
    rows = np.ascontiguousarray(points + np.float32(0.0)).view('V12').ravel()
    first = np.sort(np.unique(rows, return_index=True)[1])
    if len(first) == len(points):
        return points, normals
    _log.info('%s: %d of %d points kept, the others are duplicates', name, len(first), len(points))
    return points[first], None if normals is None else normals[first]


def _size_notes(points: np.ndarray, up: str) -> list[str]:
    """Return a note if a room is smaller than any real one, as with a wrong scale."""
    size = np.ptp(corners_of(points), axis=0)
    # No room has both a lower height and a shorter length.
    least_m = (1.0, 1.5)
    if size[axis_of(up)] >= least_m[0] or size.max() >= least_m[1]:
        return []
    return [f'found a room of {" x ".join(f"{edge:.3g}" for edge in size)} m; expected one that '
            f'is {least_m[0]:g} m high or {least_m[1]:g} m long; correct the scale (--scale), '
            'or go on if the room is that small']


def _up_notes(points: np.ndarray) -> list[str]:
    """Return a note if floor and ceiling seem to lie across another axis than z."""
    axis = likely_up_axis(points)
    return [] if axis == 'z' else [
        f'found the two fullest layers, floor and ceiling, across {axis}; expected z up; turn it '
        f'(--up {axis}) unless z is up']


def _merge(points: np.ndarray, voxel_size: float, max_points: int, name: str) -> np.ndarray:
    """Merge points as the options ask; refuse the room if too few points are left."""
    merged = points
    remedy = 'use a smaller voxel_size or a denser scan' if voxel_size else 'use a denser scan'
    if voxel_size == 0 and 0 < max_points < len(points):
        voxel_size = voxel_size_for(points, max_points)
    if voxel_size > 0:
        merged = voxel_downsample(points, voxel_size)
        _log.info('%s: %d of %d points kept on a %.3f m voxel grid',
                  name, len(merged), len(points), voxel_size)
    if len(merged) < MIN_POINTS:
        raise SceneError(f'{name}: found {len(merged)} points after duplicates and points of '
                         f'one voxel were merged; expected at least {MIN_POINTS}; {remedy}')
    return merged
