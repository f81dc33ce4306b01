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

"""Make scenes from a file, with a cache in the cache folder of the user, or by the generator."""

from dataclasses import dataclass, replace
import hashlib
import io
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from ocp_ros import __version__
from ocp_ros.rooms.generator import generate_room
from ocp_ros.scenes.building_files import Building
from ocp_ros.scenes.scene import Mesh, Rooms, Scan, Scene, SceneError, turned
from ocp_ros.scenes.scene_files import load_scene
from ocp_ros.scenes.source_frame import BY_FILE, SourceFrame, UP_CHOICES
from ocp_ros.util.files import cache_folder, sha256_of_file, write_atomically
from ocp_ros.util.settings import MAX_ROOM_POINTS, MAX_SEED, MIN_ROOM_POINTS, setting

#: The names of the options of reading a scan, in commands, parameters and placement files.
READING = ('scale', 'up', 'drop_nonfinite', 'all_rooms', *Building._fields)
#: The default number of points of a room in which placements are evaluated.
ROOM_POINTS = 60_000
#: The least size in bytes of a file whose scene is cached: smaller files are read as fast.
MIN_CACHED_BYTES = 4_000_000
#: The version of the cache format; raise it when reading a file gives another result.
CACHE_VERSION = 6


@dataclass(frozen=True)
class SceneConfig:
    """Settings of a room: a scan in a file, or a generated room if no file is named."""

    file: str = setting('', 'scan to read; empty for a generated room')
    seed: int = setting(1, 'seed of the generated room', 0, MAX_SEED)
    points: int = setting(15000, 'points of a generated room; a larger scan is thinned to this '
                                 'number',
                          MIN_ROOM_POINTS, MAX_ROOM_POINTS)
    voxel_size: float = setting(
        0.0, 'edge of the grid that thins a scan, metres; 0: use scene.points', 0.0, 10.0)
    scale: float = setting(0.0, 'metres per unit of the file; 0: as the file says, otherwise 1',
                           0.0, 1e6)
    up: str = setting(BY_FILE, 'direction of the file that points up; auto: guess it; file: as '
                               'its format says, otherwise z', choices=UP_CHOICES)
    drop_nonfinite: bool = setting(False, 'leave out points with NaN or inf')
    all_rooms: bool = setting(False, 'keep other rooms of the file that are seen through openings')
    height: float = setting(0.0, 'height of the walls of a map or a DXF floor plan, metres',
                            0.0, 100.0)
    layers: str = setting('', 'layers of walls of a DXF floor plan, with commas; empty: those '
                              'named like walls')
    storey: str = setting('', 'storey of an IFC model; empty: all')
    space: str = setting('', 'space of an IFC model; empty: all')
    open_doors: bool = setting(False, 'leave out the doors of an IFC model')


def make_scene(config: SceneConfig) -> Scene:
    """
    Read or generate a room.

    :raises SceneError: if the file cannot be used.
    """
    if not config.file:
        return generate_room(config.seed, config.points)
    return load_scene(config.file, voxel_size=config.voxel_size, max_points=config.points,
                      **{option: getattr(config, option) for option in READING})


def seed_named(name: str) -> int:
    """
    Return the seed of a generated room, given its decimal digits.

    :raises SceneError: if the seed is too large.
    """
    # Python refuses to convert numbers of thousands of digits.
    if len(name) > 20 or int(name) > MAX_SEED:
        short_name = name if len(name) <= 20 else f'{name[:20]}...'
        raise SceneError(f'{short_name}: found no seed of a room; expected one of at most '
                         f'{MAX_SEED}, or the path of a scan; name another')
    return int(name)


def make_room(name: str, rotation: float, points: int = 15000, **reading: Any) -> Scene:
    """
    Read or generate the room with a name.

    :param name: the seed of a generated room, or the path of a scan.
    :param rotation: degrees by which the room is rotated about the vertical axis.
    :param points: the number of points of a generated room; larger scans are thinned to it.
    :param reading: options of a scan, those of ``READING``; see
        :func:`~ocp_ros.scenes.scene_files.load_scene`.
    :raises SceneError: if the scan cannot be used.
    """
    if name.isdecimal():
        scene = generate_room(seed_named(name), points)
    else:
        scene = load_cached(name, max_points=points, **reading)
    return turned(scene, rotation) if rotation else scene


def room_named(name: str, points: int = ROOM_POINTS, **reading: Any
               ) -> tuple[Scene, dict[str, Any]]:
    """
    Read or generate the room with a name; return it and its entry in placement files.

    :param name: the path of a scan, or the seed of a generated room.
    :param points: the number of points, as for :func:`make_room`.
    :param reading: options of a scan, as for :func:`make_room`.
    :returns: the room, and the data under the key ``room`` of a placement file.
    :raises SceneError: if the scan cannot be used.
    """
    scene = make_room(name, 0.0, points, **reading)
    if name.isdecimal():
        return scene, {'seed': int(name), 'points': points, 'sha256': sha256_of(scene)}
    entry = {'file': name, 'sha256': sha256_of_file(name), 'points': points, **reading,
             'scale': scene.source.scale, 'up': scene.source.up}
    if scene.source.scale is None:
        # The axes have different units, which the file declares.
        del entry['scale']
    if not scene.source.is_map:
        entry['source_from_map'] = scene.source.matrix.tolist()
    return scene, entry


def sha256_of(scene: Scene) -> str:
    """Return the SHA-256 of a room's points, as 64 hexadecimal digits."""
    return hashlib.sha256(scene.points.tobytes()).hexdigest()


def load_cached(path: str | Path, **options) -> Scene:
    """
    Read a room from a file, or from the cache if the file was read before.

    The result is that of :func:`~ocp_ros.scenes.scene_files.load_scene`. The file is read again if
    the file, the options or the version of the package have changed. Warnings are shown only when
    the file is read; the notes of the scene contain them.

    :param options: the options of ``load_scene``.
    :raises SceneError: if the file or an option cannot be used.
    """
    path = Path(path)
    try:
        file_state = path.stat()
    except OSError:
        return load_scene(path, **options)
    if file_state.st_size < MIN_CACHED_BYTES or (folder := cache_folder()) is None:
        return load_scene(path, **options)
    identity = [__version__, CACHE_VERSION, path.absolute(), file_state.st_size,
                file_state.st_mtime_ns, sorted(options.items())]
    digest = hashlib.sha256(str(identity).encode()).hexdigest()
    cached_file = folder / 'scans' / f'{digest[:24]}.npz'
    try:
        with cached_file.open('rb') as file, np.load(file, allow_pickle=False) as arrays:
            source = SourceFrame(arrays['scales'], arrays['rotation'], arrays['shift'])
            mesh = None if 'vertices' not in arrays else Mesh(
                arrays['vertices'], arrays['triangles'], bool(arrays['exact']))
            rooms = None if 'rooms' not in arrays else Rooms(
                arrays['rooms'], float(arrays['rooms_edge']), arrays['rooms_corner'])
            scene = Scene(arrays['points'], str(arrays['name']), arrays.get('normals'), mesh,
                          source, notes=tuple(map(str, arrays['notes'])),
                          remarks=tuple(map(str, arrays['remarks'])), rooms=rooms,
                          scans=tuple(map(Scan, arrays['stations'], np.split(
                              arrays['scan_points'], arrays['scan_ends'][:-1]))))
            return scene if 'survey_points' not in arrays else replace(scene, survey=replace(
                scene, points=arrays['survey_points'], normals=arrays.get('survey_normals')))
    except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile):
        # The cached file is missing or incomplete.
        scene = load_scene(path, **options)
    _write_to_cache(cached_file, scene)
    return scene


def _write_to_cache(path: Path, scene: Scene) -> None:
    """Write a scene to the cache atomically; ignore errors such as a full disk."""
    # The fields of ``source`` are scales, rotation and shift.
    arrays = {'name': np.array(scene.name), 'notes': np.array(scene.notes, dtype=str),
              'remarks': np.array(scene.remarks, dtype=str), **vars(scene.source),
              'stations': np.array([scan.station for scan in scene.scans]),
              'scan_points': np.concatenate([np.empty((0, 3)), *(
                  scan.points for scan in scene.scans)]),
              'scan_ends': np.cumsum([len(scan.points) for scan in scene.scans])}
    for prefix, part in (('', scene), ('survey_', scene.survey)):
        if part is not None:
            arrays[f'{prefix}points'] = part.points
            if part.normals is not None:
                arrays[f'{prefix}normals'] = part.normals
    if scene.mesh is not None:
        arrays |= {'vertices': scene.mesh.vertices, 'triangles': scene.mesh.triangles,
                   'exact': np.array(scene.mesh.exact)}
    if scene.rooms is not None:
        # The plan of rooms that are read lies along the axes of the map.
        arrays |= {'rooms': scene.rooms.numbers, 'rooms_edge': np.array(scene.rooms.edge),
                   'rooms_corner': scene.rooms.corner}
    try:
        content = io.BytesIO()
        np.savez(content, **arrays)
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_atomically(path, content.getvalue(), private=True)
    except OSError:
        pass
