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

"""Cache the scenes that were read from scans in the cache folder of the user."""

import hashlib
import io
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from ocp_ros import __version__
from ocp_ros.scenes.scene import Mesh, Scene
from ocp_ros.scenes.scene_files import load_scene
from ocp_ros.scenes.source_frame import SourceFrame
from ocp_ros.util.files import cache_folder, write_atomically

#: The least size in bytes of a file whose scene is cached: smaller files are read as fast.
MIN_CACHED_BYTES = 4_000_000
#: The version of the cache format; raise it when reading a file gives another result.
CACHE_VERSION = 3


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
            source = SourceFrame(float(arrays['scale']), arrays['rotation'], arrays['shift'])
            mesh = None if 'vertices' not in arrays else Mesh(
                arrays['vertices'], arrays['triangles'], bool(arrays['exact']))
            return Scene(arrays['points'], str(arrays['name']), arrays.get('normals'), mesh,
                         source, notes=tuple(map(str, arrays['notes'])),
                         remarks=tuple(map(str, arrays['remarks'])))
    except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile):
        # The cached file is missing or incomplete.
        scene = load_scene(path, **options)
    _write_to_cache(cached_file, scene)
    return scene


def _write_to_cache(path: Path, scene: Scene) -> None:
    """Write a scene to the cache atomically; ignore errors such as a full disk."""
    # The fields of ``source`` are scale, rotation and shift.
    arrays = {'points': scene.points, 'name': np.array(scene.name),
              'notes': np.array(scene.notes, dtype=str),
              'remarks': np.array(scene.remarks, dtype=str), **vars(scene.source)}
    if scene.normals is not None:
        arrays['normals'] = scene.normals
    if scene.mesh is not None:
        arrays |= {'vertices': scene.mesh.vertices, 'triangles': scene.mesh.triangles,
                   'exact': np.array(scene.mesh.exact)}
    try:
        content = io.BytesIO()
        np.savez(content, **arrays)
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_atomically(path, content.getvalue(), private=True)
    except OSError:
        pass
