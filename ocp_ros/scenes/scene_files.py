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
import os
from os import PathLike
from pathlib import Path
import warnings

import numpy as np
from ocp_ros.geometry.clouds import (
    away_from,
    corners_of,
    evenly,
    MIN_VOXEL_M,
    thinned_to,
    voxel_downsample,
    voxel_size_for,
)
from ocp_ros.scenes.building_files import Building, EVERYTHING
from ocp_ros.scenes.false_points import (
    isolated_points,
    MAX_ISOLATED_SHARE,
    stray_points,
    without_mirror_images,
)
from ocp_ros.scenes.file_formats import Declared, read_file, READERS, SUFFIXES
from ocp_ros.scenes.inner_surface import has_two_floors, inner_surface, without_outside
from ocp_ros.scenes.main_room import main_room, without_views_outside
from ocp_ros.scenes.measured_room import CORNERS, room_between
from ocp_ros.scenes.meshes import MESH_SAMPLES, sample_faces
from ocp_ros.scenes.scene import (
    check_numbers,
    check_points,
    Mesh,
    MIN_POINTS,
    Scan,
    Scene,
    SceneError,
)
from ocp_ros.scenes.source_frame import (
    AUTO,
    axis_of,
    BY_FILE,
    likely_up,
    likely_up_axis,
    map_from_file,
    SourceFrame,
    UP_AXES,
    UP_CHOICES,
)
from ocp_ros.util.files import printable, write_atomically
from ocp_ros.util.settings import need, UserError
from scipy.spatial import cKDTree

#: The number of sample points on a mesh, to find its size, axes and stray parts.
COARSE_SAMPLES = 60_000
#: What to do with files of other suffixes.
OTHER_SUFFIXES = {
    'export it as STL or glTF (.glb) from the program that made it':
        '.3dm .3ds .3mf .blend .brep .c4d .catpart .catproduct .dae .dwg .f3d .fbx .fcstd .iges '
        '.igs .ipt .jt .ma .max .nwd .prt .rvt .sat .skp .sldasm .sldprt .step .stp .wrl .x3d '
        '.x_b .x_t',
    'export it as E57 from the program of the scanner':
        '.cl3 .clr .fls .fws .imp .lgs .lgsx .lsproj .pod .ptg .rcp .rcs .rdbx .zfs',
    'export the splats as .ply, for example with SuperSplat': '.ksplat .sog .splat .spz',
    'unpack it first': '.7z .bz2 .gz .rar .tar .tgz .xz .zip .zst',
    'export the floor plan as .dxf, or measure the room': '.jpeg .jpg .pdf .png .tif .tiff'}

#: The number of points on which a scan is measured, however many of them are asked for.
SURVEY_POINTS = 60_000

_log = logging.getLogger(__name__)


class SceneWarning(UserWarning):
    """Warn of a room that can be used but may be wrong."""


def load_scene(path, *, voxel_size: float = 0.0, max_points: int = 0, scale: float = 0.0,
               up: str = BY_FILE, drop_nonfinite: bool = False,
               all_rooms: bool = False, height: float = 0.0, layers: str = '', storey: str = '',
               space: str = '', open_doors: bool = False) -> Scene:
    """
    Read a room from a file.

    Exact duplicates are removed, and stray points (see
    :func:`~ocp_ros.scenes.false_points.stray_points`). Coordinates farther than 1 km from the
    origin, such as UTM, are moved near it by whole hundreds of metres, since float32 would round
    them. All changes are logged. ``source`` converts back to the file's coordinates, ``notes``
    list possible problems, and ``remarks`` list what was left out.
    Normals are kept if the file has them and no points are merged.

    Occupancy maps (.yaml), floor plans (.dxf), models of buildings (.ifc) and stages (.usd) are
    meshes, see docs/reference/room.md. From a mesh (also .obj, .stl, .off, .glb, .gltf, and .ply
    with faces) 300,000 points, or ``max_points``, are sampled evenly by area and always the same.
    They lie on the sides of the faces that are visible from the air of the room, see
    :mod:`ocp_ros.scenes.inner_surface`, with the normals of these sides.

    :param path: a scan or mesh with one of the ``SUFFIXES``. The name of the room is the stem of
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
    :param height: see :class:`~ocp_ros.scenes.building_files.Building`, as for the last four.
    :returns: the scene, in metres, z up.
    :raises SceneError: if the file or an option cannot be used; the message names the file.
    """
    if isinstance(path, bool) or not isinstance(path, (str, PathLike)):
        raise SceneError(f'path: found {type(path).__name__}; expected the path of a scan; of '
                         'points in memory scene_of makes a room')
    path = Path(path)
    _check_options(path.name, voxel_size, max_points, scale, up, from_file=True)
    rows, corners, declared = _read_rows(
        path, Building(height, layers, storey, space, open_doors), scale)
    return _make_scene(rows, path.name, _scene_name(path), declared, corners,
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
    # This check raises the error that describes a wrong shape.
    if points.ndim != 2 or points.shape[1] != 3:
        check_numbers(points, name)
    return _make_scene(points, name, printable(name), Declared(), voxel_size=voxel_size,
                       max_points=max_points, scale=scale, up=up, drop_nonfinite=drop_nonfinite,
                       all_rooms=all_rooms)


def _make_scene(rows: np.ndarray, name: str, scene_name: str, declared: Declared,
                triangle_corners: np.ndarray | None = None, *, voxel_size: float, max_points: int,
                scale: float, up: str, drop_nonfinite: bool, all_rooms: bool) -> Scene:
    """
    Make a room of points in the unit and axes of a file; options are those of ``load_scene``.

    :param rows: (N, 3) points, or (N, 6) points and normals; overwritten.
    :param name: the name of the file in messages.
    :param scene_name: the name of the room.
    :param declared: the unit, the axes and the solids that the file declares.
    :param triangle_corners: (T, 3, 3) corners of the triangles of the mesh that the points lie on;
        None if the file has points only.
    """
    notes: list[str] = []
    # A file with as many points as a room has corners contains these corners, not a scan.
    if triangle_corners is None and len(rows) == CORNERS:
        rows, triangle_corners, notes = _points_between_corners(rows[:, :3], name)
    # Use the unit and the up direction that the file declares, if the options leave them open.
    remarks: tuple[str, ...] = ()
    if (scale == 0.0 and set(declared.metres) != {1.0}) or (
            up == BY_FILE and declared.up != 'z'):
        remarks = (declared.remark,)
    if scale == 0.0 and declared.note:
        notes.append(declared.note)
    scales = np.full(3, scale) if scale else np.array(declared.metres)
    up = declared.up if up == BY_FILE else up
    # Convert to metres; numbers that overflow are refused like inf. Leave out stray points.
    if drop_nonfinite:
        rows = _without_nonfinite(rows, name)
    with np.errstate(over='ignore'):
        rows[:, :3] *= scales
    check_numbers(rows[:, :3], name)
    rows, stray_remarks = _without_strays(rows, name)
    remarks += stray_remarks
    points = rows[:, :3]
    # The check needs the up direction only to guess a wrong unit, so z will do until it is known.
    check_points(points, name, 'z' if up == AUTO else up)
    # Rotate z up, move the room near the origin and leave out duplicates.
    if up == AUTO:
        up = likely_up(points)
        remarks += (f'up: {up}, a guess (--up)',)
    notes += _notes_of_size(points, up)
    rotation = map_from_file(up)
    points, shift = _move_near_origin(points @ rotation.T, name)
    source = SourceFrame(scales, rotation, shift)
    points, normals = _without_duplicates(points.astype(np.float32),
                                          _unit_normals(rows[:, 3:], rotation), name)
    # The z axis may be vertical only by default. If the points suggest another axis, a note says
    # so, and all rooms are kept, since rooms are separated on a plan seen from above.
    if axis_of(up) == 2 and (up_notes := _notes_of_up(points)):
        notes += up_notes
        all_rooms = True
    # If a mesh encloses air, the sides of its faces that are visible from this air are the room.
    mesh = None
    if triangle_corners is not None:
        mesh = _mesh_in_map(triangle_corners, source, corners_of(points))
        solids = None if declared.solids is None else source.to_map(declared.solids)
        max_samples = max_points or MESH_SAMPLES
        inner = inner_surface(mesh, max(max_samples, SURVEY_POINTS), voxel_size, name, solids)
        if inner is not None:
            scene = Scene(inner.points, scene_name, inner.normals, mesh, source, tuple(notes),
                          remarks + inner.remarks)
            whole = scene.only(evenly(len(scene), SURVEY_POINTS))
            survey = main_room(whole, inner.points, whole.points, all_rooms)
            thinned = scene.only(evenly(len(scene), max_samples))
            return _warn_of_notes(survey if len(thinned) == len(whole) else
                                  _room_of_survey(thinned, whole, survey), name)
        # Without enclosed air, samples of all faces go on like the points of a scan.
        remarks += ('no air is closed in: all faces count, from both sides',)
        # Points that are merged in voxels lie near the faces, not on them. With a voxel size,
        # ``max_points`` does not apply.
        if voxel_size:
            mesh = replace(mesh, exact=False)
            max_samples = MESH_SAMPLES
        points, normals = (columns.astype(np.float32) for columns in
                           np.hsplit(sample_faces(mesh.corners, max_samples), 2))
    # Points of a scan, or of a mesh without enclosed air: merge them.
    merged = _merge_points(points, voxel_size, max_points, name)
    scans = tuple(Scan(*map(source.to_map, scan)) for scan in declared.scans)
    scene = Scene(merged, scene_name, normals if merged is points else None, mesh, source,
                  scans=scans)
    if len(merged) < len(points):
        remarks += (f'{len(merged):,} of {len(points):,} points kept '
                    f'({"merged in voxels" if voxel_size else "--points"})',)
    scene = replace(scene, notes=tuple(notes), remarks=remarks)
    # A scan is measured on a fixed number of points, so that no answer depends on ``max_points``.
    if len(points) <= SURVEY_POINTS if merged is points else (
            not voxel_size and max_points == SURVEY_POINTS):
        return _warn_of_notes(_room_in(scene, points, all_rooms), name)
    whole = replace(scene, points=thinned_to(points, SURVEY_POINTS), normals=None)
    return _warn_of_notes(
        _room_of_survey(scene, whole, _room_in(whole, points, all_rooms)), name)


def _room_in(scene: Scene, points: np.ndarray, all_rooms: bool) -> Scene:
    """
    Return the room in a scan: without isolated points, mirror images, outsides and other rooms.

    :param scene: the scan, thinned to the points that it is measured on.
    :param points: (N, 3) metres, all its points.
    :param all_rooms: whether other rooms are kept.
    """
    is_isolated = isolated_points(scene.points)
    surfaces = scene.points[~is_isolated]
    # Leave out isolated points if the others are still a room.
    if 0.0 < is_isolated.mean() <= MAX_ISOLATED_SHARE and _is_room(surfaces, scene.name):
        count = int(np.count_nonzero(is_isolated))
        remark = f'{count:,} isolated point{"s" * (count > 1)} left out'
        _log.warning('%s: %s', scene.name, remark)
        scene = replace(scene.only(~is_isolated), remarks=(*scene.remarks, remark))
    # Isolated points must not count as walls, however many there are.
    if is_isolated.all():
        surfaces = scene.points
    if not all_rooms:
        scene, points = without_views_outside(scene, points)
    unmirrored = without_mirror_images(scene)
    # What has drifted in height repeats other parts as a mirror does; mirrors keep the floor.
    if len(unmirrored) < len(scene) and not has_two_floors(scene):
        scene = unmirrored
        # ``main_room`` gets the points before merging. Some of them are behind the mirror and
        # must not count as another room, so it gets the remaining merged points instead.
        points = scene.points
    # Leave out what lies outside of the room.
    scene = without_outside(scene)
    return main_room(scene, points, surfaces, all_rooms)


def _room_of_survey(scene: Scene, whole: Scene, survey: Scene) -> Scene:
    """
    Return the part of a scan that was found to be the room.

    :param scene: the scan, thinned as asked for.
    :param whole: the scan, thinned to the points that it was measured on.
    :param survey: those of these points that are the room.
    """
    tree = cKDTree(whole.points)
    is_room = np.zeros(len(whole), dtype=bool)
    is_room[tree.query(survey.points)[1]] = True
    if not is_room.all():
        scene = scene.only(is_room[tree.query(scene.points)[1]])
    return replace(scene, notes=survey.notes, remarks=survey.remarks, survey=survey,
                   rooms=survey.rooms)


def _warn_of_notes(scene: Scene, name: str) -> Scene:
    """Show the notes of a room as warnings, and return the room."""
    # Level 4 is the caller of ``load_scene`` or ``scene_of``.
    for note in scene.notes:
        warnings.warn(f'{name}: {note}', SceneWarning, stacklevel=4)
    return scene


def _points_between_corners(points: np.ndarray, name: str
                            ) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """
    Make a room of its eight corners.

    :param points: (8, 3) the corners.
    :returns: points and normals (N, 6) on its sides; the corners (T, 3, 3) of the triangles of its
        sides; and notes.
    """
    surfaces = room_between(points)
    if surfaces is None:
        raise SceneError(f'{name}: found eight points that are not the corners of a convex room; '
                         'expected those, or at least 100 points of a scan; measure the corners '
                         'again')
    triangle_corners, is_flat = surfaces
    notes = [] if is_flat else [
        'found eight corners between which sides are not flat; expected six flat ones; measure '
        'the corners again unless the room is so']
    return sample_faces(triangle_corners, COARSE_SAMPLES), triangle_corners, notes


def _mesh_in_map(corners: np.ndarray, source: SourceFrame, bounds: np.ndarray) -> Mesh:
    """
    Return the mesh in the map frame, without faces that have NaN and without stray faces.

    :param corners: (T, 3, 3) the corners of triangles, in the frame of the file.
    :param bounds: (2, 3) metres, the bounding box of the points that were kept.
    """
    corners = source.to_map(corners[np.isfinite(corners).all(axis=(1, 2))])
    # Faces that reach farther than this out of the bounding box are stray.
    margin_m = 0.5
    is_inside = ((corners.min(axis=1) >= bounds[0] - margin_m)
                 & (corners.max(axis=1) <= bounds[1] + margin_m))
    vertices = corners[is_inside.all(axis=1)].reshape(-1, 3)
    return Mesh(vertices.astype(np.float32),
                np.arange(len(vertices), dtype=np.int32).reshape(-1, 3), exact=True)


def load_cloud(path: str | Path) -> np.ndarray:
    """
    Read a cloud that is not a room, such as the points that one camera measured.

    :param path: a file of one of the formats of rooms.
    :returns: (N, 3) float64 finite points, in the unit and axes of the file.
    :raises SceneError: if the file cannot be read.
    """
    points = _read_rows(Path(path))[0][:, :3]
    return points[np.isfinite(points).all(axis=1)]


def save_scene(scene: Scene, path: str | Path) -> None:
    """
    Write the points of a room as .ply, and its mesh, if it has one, as ``<stem>_mesh.ply``.

    :raises SceneError: if the files cannot be written.
    :raises ConfigurationError: if there is no plyfile.
    """
    path = Path(path)
    need(path.name, 'plyfile')
    from plyfile import PlyData, PlyElement
    columns = [('x', 'f4'), ('y', 'f4'), ('z', 'f4')]
    elements = {path: [PlyElement.describe(_records(scene.points, columns), 'vertex')]}
    if scene.mesh is not None:
        faces = np.empty(len(scene.mesh.triangles), dtype=[('vertex_indices', 'i4', (3,))])
        faces['vertex_indices'] = scene.mesh.triangles
        elements[mesh_of(path)] = [
            PlyElement.describe(_records(scene.mesh.vertices, columns), 'vertex'),
            PlyElement.describe(faces, 'face')]
    try:
        for file, ply_elements in elements.items():
            content = io.BytesIO()
            PlyData(ply_elements).write(content)
            write_atomically(file, content.getvalue())
    except OSError as error:
        raise SceneError(f'{path}: found a place that cannot be written to ({error.strerror}); '
                         'expected a folder that may be; name another one') from error


def mesh_of(path: Path) -> Path:
    """Return the path of the mesh that :func:`save_scene` writes beside the points at a path."""
    return path.with_name(f'{path.stem}_mesh.ply')


def scans_in(folder: str | Path) -> list[Path]:
    """
    List the files in a folder that are scans, sorted by name.

    Meshes that :func:`save_scene` wrote beside their rooms and hidden files are left out.
    """
    scans = sorted(path for path in Path(folder).glob('*')
                   if path.suffix.lower() in READERS and not path.name.startswith('.'))
    meshes = set(map(mesh_of, scans))
    return [path for path in scans if path not in meshes]


def check_file(path: Path) -> None:
    """
    Refuse a path that is not a file with content and a known suffix.

    :raises SceneError: if the path is something else.
    """
    suffixes = sorted(SUFFIXES)
    if not path.exists():
        raise SceneError(f'{path}: found no such file; expected one of {" ".join(suffixes)}; '
                         'check the path')
    if not path.is_file():
        scans = [item.name for item in path.glob('*') if item.suffix.lower() in SUFFIXES]
        hint = f'such as {min(scans)}' if scans else f'one of {" ".join(suffixes)}'
        raise SceneError(f'{path}: found a folder or device; expected a file; give the path of a '
                         f'file, {hint}')
    if path.suffix.lower() not in SUFFIXES:
        similar = difflib.get_close_matches(path.suffix.lower(), suffixes, n=1)
        hint = next((remedy for remedy, others in OTHER_SUFFIXES.items()
                     if path.suffix.lower() in others.split()),
                    f'did you mean {similar[0]}?' if similar else
                    'convert it, for example with CloudCompare')
        raise SceneError(f'{path.name}: found the suffix {path.suffix!r}; expected one of '
                         f'{" ".join(suffixes)}; {hint}')
    state = path.stat()
    if state.st_size == 0:
        raise SceneError(f'{path.name}: found an empty file; expected a room of at least '
                         f'{MIN_POINTS} points; copy or export it again')
    # Its blocks have 512 bytes. Where a file system knows no holes, the first one is at the end.
    written = 512 * state.st_blocks
    with path.open('rb') as file:
        if 10 * written < state.st_size != os.lseek(file.fileno(), 0, os.SEEK_HOLE):
            raise SceneError(f'{path.name}: found {state.st_size:,} bytes, of which {written:,} '
                             'were written; expected a whole file; copy or download it again')


def _records(values: np.ndarray, columns: list[tuple[str, str]]) -> np.ndarray:
    """Return an array (N, C) as N records; ``columns`` has the name and type of each column."""
    return np.rec.fromarrays(values.T, dtype=columns)


def _check_options(name: str, voxel_size: float, max_points: int, scale: float, up: str,
                   from_file: bool = False) -> None:
    """Refuse invalid options; only for a file may scale be 0 and up be ``file``."""
    directions = UP_CHOICES if from_file else (*UP_AXES, AUTO)
    numbers = {'voxel_size': voxel_size, 'max_points': max_points, 'scale': scale}
    for option, value in numbers.items():
        if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
            raise SceneError(f'{name}: found {option}={value!r}; expected a number')
    for option, value, is_usable, expected in (
            ('voxel_size', voxel_size, voxel_size == 0 or MIN_VOXEL_M <= voxel_size < np.inf,
             f'0 or at least {MIN_VOXEL_M} m'),
            ('max_points', max_points, max_points == 0 or max_points >= MIN_POINTS,
             f'0 or at least {MIN_POINTS}'),
            ('scale', scale, (from_file and scale == 0) or 1e-6 <= scale <= 1e6,
             '0.000001 to 1000000, such as 0.001'),
            ('up', up, isinstance(up, str) and up in directions,
             f"one of {', '.join(directions)}")):
        if not is_usable:
            raise SceneError(f'{name}: found {option}={value!r}; expected {expected}')


def _scene_name(path: Path) -> str:
    """Return the name of a room: the stem of its file, or area and room in S3DIS folders."""
    room, area = path.absolute().parent.name, path.absolute().parent.parent.name
    # A file of S3DIS has an underscore more than its folder: Area_6/copyRoom_1/copy_Room_1.txt.
    is_room_file = room.replace('_', '') == path.stem.replace('_', '')
    is_s3dis = path.suffix == '.txt' and is_room_file and area.startswith('Area_')
    return printable(f'{area}_{room}' if is_s3dis else path.stem)


def _read_rows(path: Path, building: Building = EVERYTHING, scale: float = 0.0
               ) -> tuple[np.ndarray, np.ndarray | None, Declared]:
    """
    Read a file; turn all errors into a SceneError.

    :returns: points (N, 3), or points and normals (N, 6); the corners (T, 3, 3) of the triangles
        of the mesh that the points lie on, or None; and what the file declares.
    """
    try:
        check_file(path)
        rows, declared = read_file(path, building, scale)
        # Nine columns are the corners of triangles.
        if rows.shape[1] < 9:
            return rows, None, declared
        corners = rows.reshape(-1, 3, 3)
        return sample_faces(corners, COARSE_SAMPLES), corners, declared
    except UserError as error:
        raise SceneError(str(error)) from error
    except OSError as error:
        raise SceneError(f'{path.name}: found a file that cannot be read ({error}); expected one '
                         'that may be opened; check its permissions and the disk') from error
    except Exception as error:  # A broken file makes the libraries raise almost anything.
        reason = (str(error).splitlines() or [''])[0][:200] or type(error).__name__
        raise SceneError(f'{path.name}: found content that cannot be read ({reason}); expected a '
                         f'plain, complete {path.suffix} file; copy or export it again') from error


def _without_nonfinite(rows: np.ndarray, name: str) -> np.ndarray:
    """Return the rows (points, perhaps with normals) whose points have no NaN or inf."""
    is_kept = np.isfinite(rows[:, :3]).all(axis=1)
    if not is_kept.all():
        _log.info('%s: %d of %d points kept, the others are NaN or inf',
                  name, is_kept.sum(), len(is_kept))
    return rows[is_kept]


def _without_strays(rows: np.ndarray, name: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the rows whose points are not stray, and a remark if there are stray points."""
    points = rows[:, :3]
    is_stray = stray_points(points)
    if not is_stray.any():
        return rows, ()
    distances = away_from(points[is_stray], corners_of(points[~is_stray]))
    remark = (f'{len(distances):,} stray point{"s" * (len(distances) > 1)} left out, up to '
              f'{distances.max():.3g} m outside of the rest: reflections, or seen through windows')
    _log.warning('%s: %s', printable(name), remark)
    return rows[~is_stray], (remark,)


def _is_room(points: np.ndarray, name: str) -> bool:
    """Return whether points pass the checks of a room in metres."""
    try:
        check_points(points, name)
    except SceneError:
        return False
    return True


def _move_near_origin(points: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, 3) near the origin, and the shift (3,) that was subtracted, metres."""
    low, high = corners_of(points)
    # float32 would round coordinates that are farther away.
    max_distance_m = 1000.0
    if np.linalg.norm(np.maximum(abs(low), abs(high))) <= max_distance_m:
        return points, np.zeros(3)
    # Whole hundreds of metres; adding 0.0 turns -0.0 into 0.0.
    shift = np.round(low, -2) + 0.0
    # This is a warning, since all placements found will be in the moved coordinates.
    _log.warning('%s: found coordinates far from the origin; subtracted (%.0f, %.0f, %.0f) m',
                 printable(name), *shift)
    return points - shift, shift


def _unit_normals(normals: np.ndarray, rotation: np.ndarray) -> np.ndarray | None:
    """Return rotated unit normals; None if there are none, or some have length zero or NaN."""
    if not normals.size:
        return None
    normals = normals @ rotation.T
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    is_usable = np.isfinite(lengths).all() and (lengths > 0.0).all()
    return (normals / lengths).astype(np.float32) if is_usable else None


def _without_duplicates(points: np.ndarray, normals: np.ndarray | None, name: str
                        ) -> tuple[np.ndarray, np.ndarray | None]:
    """Return points (float32) and normals without repeated points, whose spacing would be 0."""
    # The 12 bytes of each point are compared, so -0.0 has to become 0.0, by adding 0.0.
    rows = np.ascontiguousarray(points + np.float32(0.0)).view('V12').ravel()
    # The index of the first of equal points, in the order of the points.
    first = np.sort(np.unique(rows, return_index=True)[1])
    if len(first) == len(points):
        return points, normals
    _log.info('%s: %d of %d points kept, the others are duplicates', name, len(first), len(points))
    return points[first], None if normals is None else normals[first]


def _notes_of_size(points: np.ndarray, up: str) -> list[str]:
    """Return a note if a room is smaller than any real room, as with a wrong scale; else []."""
    size = np.ptp(corners_of(points), axis=0)
    min_height_m, min_length_m = 1.0, 1.5
    if size[axis_of(up)] >= min_height_m or size.max() >= min_length_m:
        return []
    return [f'found a room of {" x ".join(f"{edge:.3g}" for edge in size)} m; expected one that '
            f'is {min_height_m:g} m high or {min_length_m:g} m long; correct the scale (--scale), '
            'or go on if the room is that small']


def _notes_of_up(points: np.ndarray) -> list[str]:
    """Return a note if floor and ceiling seem to be normal to another axis than z; else []."""
    axis = likely_up_axis(points)
    return [] if axis == 'z' else [
        f'found the two fullest layers, floor and ceiling, across {axis}; expected z up; turn it '
        f'(--up {axis}) unless z is up']


def _merge_points(points: np.ndarray, voxel_size: float, max_points: int, name: str) -> np.ndarray:
    """Return points merged on a voxel grid, if the options ask for it; refuse too few points."""
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
