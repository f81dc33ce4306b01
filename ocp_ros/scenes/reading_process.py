# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A process that reads a file with a library that hostile bytes can crash, hang or fill with memory.

:mod:`~ocp_ros.scenes.guarded_reading` starts it and says what it may use. It writes rows of
float64 numbers to its standard output, or one line about what is wrong to its standard error.
"""

from collections.abc import Iterator
import os
import resource
import sys

import numpy as np

#: Bytes of points that are unpacked at once.
PART = 1 << 25
#: Formats that Open3D reads better itself; all others go through the library Assimp, which holds
#: coordinates as float32.
OWN = ('.ply', '.off')
#: The largest step between two float32 coordinates, as a share of the extent of the mesh.
COARSE = 1e-4


def las_rows(path: str) -> Iterator[np.ndarray]:
    """Yield the points (N, 3) of a LAS or LAZ file, in the file's unit."""
    import laspy
    with laspy.open(path, read_evlrs=False) as file:
        for points in file.chunk_iterator(max(PART // file.header.point_format.size, 1)):
            yield np.stack([points.x, points.y, points.z], axis=1)


def e57_rows(path: str) -> Iterator[np.ndarray]:
    """Yield the valid points (N, 3) of each scan of an E57 file, in the file's frame."""
    from pye57 import E57
    with E57(path) as file:
        for index in range(file.scan_count):
            columns = file.read_scan(index, ignore_missing_fields=True)
            yield np.stack([columns[f'cartesian{axis}'] for axis in 'XYZ'], axis=1)


def mesh_rows(path: str) -> Iterator[np.ndarray]:
    """Yield points and normals (N, 6) on the faces of a mesh, in the file's unit and axes."""
    import open3d

    from ocp_ros.scenes.mesh_files import sampled
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    vertices, triangles = _mesh(open3d.io, path)
    yield sampled(vertices, triangles)


def _mesh(io, path: str) -> tuple[np.ndarray, np.ndarray]:
    """Read the vertices (V, 3) and triangles (T, 3) of a file, all its parts in one frame."""
    if path.lower().endswith(OWN):
        meshes = [io.read_triangle_mesh(path)]
    else:
        # Not read_triangle_mesh: it leaves out faces with more than three corners (0.20).
        meshes = [part.mesh for part in io.read_triangle_model(path).meshes]
    parts = [(np.asarray(mesh.vertices), np.asarray(mesh.triangles)) for mesh in meshes]
    if not parts:
        raise ValueError('no faces')
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    if not path.lower().endswith('.ply'):
        _check_rounding(vertices)
    return vertices, np.concatenate([
        start + triangles for start, (_, triangles) in zip(starts, parts)])


def _check_rounding(vertices: np.ndarray) -> None:
    """Refuse coordinates so far from the origin that float32 has rounded them."""
    vertices = vertices[np.isfinite(vertices).all(axis=1)]
    if len(vertices):
        step = abs(vertices).max() * np.finfo(np.float32).eps
        if step > COARSE * np.ptp(vertices, axis=0).max():
            raise ValueError('a mesh so far from the origin that its reader rounds it: move it '
                             'near the origin, or save it as .ply')


READ = {'e57': e57_rows, 'las': las_rows, 'mesh': mesh_rows}


def main(arguments: list[str]) -> int:
    """
    Read a file.

    :param arguments: key of ``READ``, path, and the most bytes of memory, seconds of all cores
        and bytes of output.
    :returns: the exit code: 1 if the file cannot be read.
    """
    kind, path, *most = arguments
    memory, seconds, output = map(int, most)
    for limit, value in ((resource.RLIMIT_DATA, memory), (resource.RLIMIT_CPU, seconds),
                         (resource.RLIMIT_FSIZE, output), (resource.RLIMIT_CORE, 0)):
        resource.setrlimit(limit, (value, value))
    with os.fdopen(os.dup(1), 'wb') as rows:
        # What libraries print is no row.
        os.dup2(2, 1)
        try:
            for part in READ[kind](path):
                rows.write(np.ascontiguousarray(part, dtype=np.float64))
        except MemoryError:
            print('more memory than such a file needs', file=sys.stderr)
            return 1
        except BaseException as error:  # Of broken files, and lazrs raises what is no Exception.
            print((str(error).splitlines() or [''])[0] or type(error).__name__, file=sys.stderr)
            return 1
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
