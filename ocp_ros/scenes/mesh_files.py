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

"""Read meshes with Open3D and sample points on their faces, evenly like a careful scan."""

from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from threading import Thread

import numpy as np
from ocp_ros.scenes.guarded_reading import read_guarded

#: Suffixes of meshes. PLY files with faces are meshes too.
MESHES = ('.glb', '.gltf', '.obj', '.off', '.stl')
#: The default number of sample points on a mesh of any size: 2 cm apart in an office, 5 cm in a
#: hall.
MESH_SAMPLES = 300_000


def read_mesh(path: Path) -> np.ndarray:
    """
    Read the faces of a mesh as triangles.

    All parts are placed as the scene graph says; textures are ignored. Open3D runs in a separate
    process, which takes about two seconds.

    :returns: (T, 9) float64, the three corners of each triangle in the file's unit and axes; for
        an OBJ file without faces, its vertices (N, 3).
    :raises ValueError: if the file is broken or has no faces.
    :raises ImportError: if there is no Open3D.
    """
    if path.suffix.lower() == '.obj' and (vertices := _bare_vertices(path)) is not None:
        return vertices
    if not find_spec('open3d'):
        raise ImportError('open3d; pip install open3d')
    # This process casts rays at the faces later, so it imports Open3D while the other process
    # reads.
    ahead = Thread(target=_import_open3d)
    ahead.start()
    try:
        # A face takes a byte or more, unless one part is placed many times.
        return read_guarded('mesh', path, 9, max(path.stat().st_size, 2_000_000))
    finally:
        ahead.join()


def _import_open3d() -> None:
    """Import Open3D; ignore errors, since the later import reports them."""
    with suppress(Exception):
        import_module('open3d')


def _bare_vertices(path: Path) -> np.ndarray | None:
    """Return the vertices (N, 3) of an OBJ file without faces or lines; None if it has any."""
    found = []
    with path.open('rb') as file:
        for line in file:
            if line[:2] in (b'f ', b'f\t', b'l '):
                return None
            if line[:2] == b'v ':
                found.append(line.split()[1:4])
    if not found:
        return None
    return np.array(found, dtype=np.float64).reshape(-1, 3)


def sampled(corners: np.ndarray, samples: int = MESH_SAMPLES) -> np.ndarray:
    """
    Sample points evenly by area over the faces of a mesh; the same mesh gives the same points.

    A face with NaN or inf gives one point of NaN, which the caller refuses or leaves out.

    :param corners: (T, 3, 3), the corners of the triangles, in any unit.
    :param samples: the number of points.
    :returns: (N, 6) float64, points and the unit normals of their faces.
    :raises ValueError: if there are no faces, or no face has an area.
    """
    if len(corners) == 0:
        raise ValueError('no faces')
    corners = np.asarray(corners, dtype=np.float64)
    with np.errstate(over='ignore', invalid='ignore'):
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.linalg.norm(normals, axis=1)
    finite = np.isfinite(areas)
    kept = finite & (areas > 0.0)
    if finite.any() and not kept.any():
        raise ValueError('faces without area')
    points, faces = _spread(corners[kept], areas[kept], samples)
    normals = (normals[kept] / areas[kept, None])[faces]
    broken = np.full((np.count_nonzero(~finite), 6), np.nan)
    return np.concatenate([np.hstack([points, normals]), broken])


def _spread(corners: np.ndarray, areas: np.ndarray, samples: int
            ) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, 3) on triangles with areas (T,), and the triangle of each point."""
    if len(areas) == 0:
        return np.empty((0, 3)), np.empty(0, dtype=np.int64)
    ends = np.cumsum(areas / areas.max())
    # The area is split into ``samples`` equal shares in the order of the faces, with one point in
    # each.
    within = np.random.default_rng(0).random(samples)
    places = (np.arange(samples) + within) * (ends[-1] / samples)
    faces = np.minimum(np.searchsorted(ends, places, side='right'), len(ends) - 1)
    # The multiples fill the unit square evenly (M. Roberts, 2018: the sequence R2).
    increments = np.array([0.7548776662466927, 0.5698402909980532])
    shares = np.arange(samples)[:, None] * increments % 1.0
    # Points beyond the diagonal of the square are mirrored into the triangle.
    shares = np.where(shares.sum(axis=1, keepdims=True) > 1.0, 1.0 - shares, shares)
    first, second, third = (corners[faces, corner] for corner in range(3))
    return (first + shares[:, :1] * (second - first) + shares[:, 1:] * (third - first)), faces
