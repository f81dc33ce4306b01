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
Read a file in a separate process, since broken or hostile bytes can crash or hang a library.

:func:`read_guarded` starts the process with limits of memory, time and output. The process runs
:func:`main`, which writes rows of float64 numbers to its standard output, or one line about the
error to its standard error. It imports the library, then gives up all other rights
(:func:`~ocp_ros.util.guarded_process.confine`), and only then opens the file. The imports in the
functions below return what was imported before.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib import import_module
import os
from pathlib import Path
import sys
from types import SimpleNamespace

import numpy as np
from ocp_ros.scenes import building_files, gltf_files, usd_files
from ocp_ros.util.guarded_process import confine, GuardedProcess, limit, ReadingCost

#: The limits of each kind of file: bytes of memory, more bytes of memory per byte of the file, and
#: seconds.
READING_COSTS = {
    'dxf': ReadingCost(600_000_000, 60, 20), 'e57': ReadingCost(600_000_000, 20, 10),
    'gltf': ReadingCost(600_000_000, 40, 10), 'ifc': ReadingCost(800_000_000, 60, 60),
    'las': ReadingCost(600_000_000, 3, 10), 'mesh': ReadingCost(700_000_000, 40, 20),
    'ply': ReadingCost(400_000_000, 40, 10), 'usd': ReadingCost(800_000_000, 60, 20)}
#: The number of bytes of points that are processed at once.
BLOCK_BYTES = 1 << 25


def read_guarded(kind: str, path: Path, columns: int, max_rows: int,
                 reader_arguments: Sequence[str] = ()) -> np.ndarray:
    """
    Read a file in a separate process, which takes about half a second.

    :param kind: the kind of file, a key of ``READING_COSTS`` and of ``READERS``.
    :param columns: the number of columns of each row.
    :param max_rows: the largest number of rows accepted.
    :param reader_arguments: the arguments of the reader after the path.
    :returns: (N, columns) float64.
    :raises ValueError: if the file cannot be read, or exceeds a limit.
    """
    # Each number takes eight bytes.
    max_bytes = 8 * columns * max_rows
    arguments = [kind, str(path.absolute()), *reader_arguments]
    with GuardedProcess('ocp_ros.scenes.guarded_reading', arguments, READING_COSTS[kind],
                        path.stat().st_size) as process:
        # One byte more is read to notice too many rows.
        content = process.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise ValueError(f'more than {max_rows:,} points')
    return np.frombuffer(content).reshape(-1, columns)


def las_rows(path: str) -> Iterator[np.ndarray]:
    """
    Yield the points of a LAS or LAZ file as rows (N, 4): x, y, z in the unit of the file, a flag.

    The flag is 1 for points of a surface, 0 for noise and withheld points.
    """
    import laspy
    # Extended records at the end of the file (EVLRs) are not needed.
    with laspy.open(path, read_evlrs=False) as file:
        for points in file.chunk_iterator(max(BLOCK_BYTES // file.header.point_format.size, 1)):
            # Classes 7 and 18 are noise, not surfaces.
            is_kept = ~np.isin(points.classification, (7, 18)) & (np.asarray(points.withheld) == 0)
            yield np.stack([points.x, points.y, points.z, is_kept], axis=1)


def e57_rows(path: str) -> Iterator[np.ndarray]:
    """
    Yield the station and the valid points of each scan of an E57 file as rows (1 + N, 4).

    The columns are x, y and z in the frame of the file, and the number of the scan.
    """
    from pye57 import E57
    with E57(path) as file:
        for index in range(file.scan_count):
            columns = file.read_scan(index, ignore_missing_fields=True)
            points = np.stack([columns[f'cartesian{axis}'] for axis in 'XYZ'], axis=1)
            rows = np.concatenate([file.get_header(index).translation[None], points])
            yield np.insert(rows, 3, index, axis=1)


def mesh_rows(path: str) -> Iterator[np.ndarray]:
    """Yield the corners (T, 9) of triangles of a mesh, in the unit and the axes of the file."""
    # Dash, the web server of Open3D's viewer, is not used, and takes a third of the import time.
    # An empty stand-in replaces it.
    sys.modules['dash'] = SimpleNamespace(html=None, dcc=None, Dash=None)
    import open3d
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    vertices, triangles = _read_triangles(open3d.io, path)
    if len(triangles) and not 0 <= triangles.min() <= triangles.max() < len(vertices):
        raise ValueError('faces with vertices that are not there')
    yield from _corner_blocks(vertices, triangles)


def gltf_rows(path: str) -> Iterator[np.ndarray]:
    """Yield the corners (T, 9) of triangles of a glTF file, in metres, y up."""
    vertices, triangles, step = gltf_files.read_triangles(path)
    if not len(triangles):
        raise ValueError('no faces')
    _check_rounding(vertices, step)
    yield from _corner_blocks(vertices, triangles)


def _corner_blocks(vertices: np.ndarray, triangles: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the corners (T, 9) of triangles in blocks."""
    # A triangle is 9 numbers of 8 bytes.
    block_rows = BLOCK_BYTES // 72
    for start in range(0, len(triangles), block_rows):
        yield vertices[triangles[start:start + block_rows]].reshape(-1, 9)


def _read_triangles(open3d_io, path: str) -> tuple[np.ndarray, np.ndarray]:
    """Read the vertices (V, 3) and triangles (T, 3) of a mesh, all of its parts in one frame."""
    # Open3D reads these formats with its own, better reader, and all others with the library
    # Assimp, which stores coordinates as float32.
    if path.lower().endswith(('.ply', '.off')):
        meshes = [open3d_io.read_triangle_mesh(path)]
    else:
        # read_triangle_mesh is not used: it leaves out faces with more than three corners (0.20).
        meshes = [model_part.mesh for model_part in open3d_io.read_triangle_model(path).meshes]
    parts = [(np.asarray(mesh.vertices), np.asarray(mesh.triangles)) for mesh in meshes]
    if not parts:
        raise ValueError('no faces')
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    # Open3D's reader of .off files rounds to float32 too; only the one of .ply files does not.
    if not path.lower().endswith('.ply'):
        finite = vertices[np.isfinite(vertices)]
        _check_rounding(vertices, np.spacing(np.float32(abs(finite).max(initial=0.0))))
    return vertices, np.concatenate([
        offset + triangles for offset, (_, triangles) in zip(offsets, parts)])


def _check_rounding(vertices: np.ndarray, step: float) -> None:
    """Refuse vertices (V, 3) so far from the origin that float32 has rounded them to steps."""
    vertices = vertices[np.isfinite(vertices).all(axis=1)]
    # Steps of more than 1 mm for an extent of 10 m are too coarse.
    if len(vertices) and step > 1e-4 * np.ptp(vertices, axis=0).max():
        raise ValueError('a mesh so far from the origin that its reader rounds it: move it '
                         'near the origin, or save it as .ply')


def ply_rows(path: str, *columns: str) -> Iterator[np.ndarray]:
    """Yield the vertices of a PLY file as rows (N, C), with C columns of the given names."""
    from plyfile import PlyData
    vertices = PlyData.read(path)['vertex'].data
    yield np.stack([vertices[name] for name in columns], axis=1)


#: The reader of each kind, and the packages that it imports before the process gives up its
#: rights.
READERS = {'dxf': (building_files.dxf_rows, 'ezdxf', 'ezdxf.path', 'encodings', 'encodings.big5',
                   'encodings.cp932', 'encodings.cp949', 'encodings.gbk'),
           'e57': (e57_rows, 'pye57'),
           'gltf': (gltf_rows,),
           'ifc': (building_files.ifc_rows, 'ifcopenshell', 'ifcopenshell.geom',
                   'ifcopenshell.util.element', 'ifcopenshell.util.placement',
                   'ifcopenshell.util.unit'),
           'las': (las_rows, 'laspy', 'lazrs', 'laszip'),
           'mesh': (mesh_rows, 'open3d'),
           'ply': (ply_rows, 'plyfile', 'encodings.ascii'),
           'usd': (usd_files.usd_rows, 'pxr', 'pxr.UsdGeom')}


def main(arguments: list[str]) -> int:
    """
    Apply the limits, read a file and write its rows to the standard output.

    :param arguments: the limits (bytes of memory, seconds of all cores, bytes written), a key of
        ``READERS``, the path, and the other arguments of the reader.
    :returns: the exit status: 0, or 1 if the file cannot be read.
    """
    limit(*map(int, arguments[:3]))
    kind, path, *reader_arguments = arguments[3:]
    read_rows, *packages = READERS[kind]
    with os.fdopen(os.dup(1), 'wb') as output:
        # Text that libraries print must not mix with the rows, so it goes to the standard error.
        os.dup2(2, 1)
        try:
            # A missing package is reported by the reader if it needs the package.
            for package in packages:
                with suppress(ImportError):
                    import_module(package)
            # Some libraries read files of their own late. A stage may consist of several files.
            folders = [folder for package in packages
                       for folder in getattr(sys.modules.get(package), '__path__', ())]
            confine([path, *(gltf_files.buffer_files(path) if kind == 'gltf' else ())],
                    readable_folders=[*folders, *([Path(path).parent] if kind == 'usd' else ())])
            for block in read_rows(path, *reader_arguments):
                output.write(np.ascontiguousarray(block, dtype=np.float64))
        except MemoryError:
            print('more memory than such a file needs', file=sys.stderr)
            return 1
        except BaseException as error:  # Broken files; lazrs raises a BaseException.
            print((str(error).splitlines() or [''])[0] or type(error).__name__, file=sys.stderr)
            return 1
    return 0
