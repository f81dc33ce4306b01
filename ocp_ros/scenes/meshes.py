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

"""Meshes: read them, sample points on their faces evenly, and cast rays at them."""

from contextlib import suppress
from importlib import import_module
from pathlib import Path
from threading import Thread

import numpy as np
from ocp_ros.scenes.guarded_reading import read_guarded
from ocp_ros.scenes.scene import Mesh
from ocp_ros.util.settings import need

#: Suffixes of meshes. PLY files with faces are meshes too.
MESHES = ('.glb', '.gltf', '.obj', '.off', '.stl')
#: The default number of sample points on a mesh of any size: 2 cm apart in an office, 5 cm in a
#: hall.
MESH_SAMPLES = 300_000


def read_mesh(path: Path) -> np.ndarray:
    """
    Read the faces of a mesh as triangles.

    All parts are placed as the scene graph says; textures are ignored. A separate process reads
    the file. With Open3D, for all formats but glTF, it takes about two seconds.

    :returns: (T, 9) float64, the three corners of each triangle in the unit and axes of the file;
        for an OBJ file without faces, the vertices (N, 3).
    :raises ValueError: if the file is broken or has no faces.
    :raises ConfigurationError: if Open3D is not installed.
    """
    if path.suffix.lower() == '.obj' and (vertices := _vertices_without_faces(path)) is not None:
        return vertices
    need(path.name, 'open3d')
    # This process casts rays at the faces later, so it imports Open3D while the other process
    # reads.
    import_thread = Thread(target=_import_open3d)
    import_thread.start()
    try:
        # The largest number of faces: each takes a byte or more of the file, but a small file may
        # place one part many times.
        kind = 'gltf' if path.suffix.lower() in ('.glb', '.gltf') else 'mesh'
        return read_guarded(kind, path, 9, max(path.stat().st_size, 2_000_000))
    finally:
        import_thread.join()


def _import_open3d() -> None:
    """Import Open3D; ignore errors, since the later import reports them."""
    with suppress(Exception):
        import_module('open3d')


def _vertices_without_faces(path: Path) -> np.ndarray | None:
    """Return the vertices (N, 3) of an OBJ file; None if it has faces, lines or no vertices."""
    vertices = []
    with path.open('rb') as file:
        for line in file:
            if line[:2] in (b'f ', b'f\t', b'l '):
                return None
            if line[:2] == b'v ':
                vertices.append(line.split()[1:4])
    if not vertices:
        return None
    return np.array(vertices, dtype=np.float64).reshape(-1, 3)


def sample_faces(corners: np.ndarray, count: int = MESH_SAMPLES) -> np.ndarray:
    """
    Sample points evenly by area over the faces of a mesh; the same mesh gives the same points.

    A face with NaN or inf gives one row of NaN, which the caller refuses or leaves out.

    :param corners: (T, 3, 3), the corners of the triangles, in any unit.
    :param count: the number of points, without the rows of NaN.
    :returns: (N, 6) float64, the points and the unit normals of their faces.
    :raises ValueError: if there are no faces, or none of the finite faces has an area.
    """
    if len(corners) == 0:
        raise ValueError('no faces')
    corners = np.asarray(corners, dtype=np.float64)
    with np.errstate(over='ignore', invalid='ignore'):
        # The length of this normal is twice the area; only the ratios of areas are used.
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.linalg.norm(normals, axis=1)
    is_finite = np.isfinite(areas)
    has_area = is_finite & (areas > 0.0)
    if is_finite.any() and not has_area.any():
        raise ValueError('faces without area')
    points, point_faces = _spread_points(corners[has_area], areas[has_area], count)
    normals = (normals[has_area] / areas[has_area, None])[point_faces]
    nan_rows = np.full((np.count_nonzero(~is_finite), 6), np.nan)
    return np.concatenate([np.hstack([points, normals]), nan_rows])


def _spread_points(corners: np.ndarray, areas: np.ndarray, count: int
                   ) -> tuple[np.ndarray, np.ndarray]:
    """
    Spread points over triangles, evenly by area.

    :param corners: (T, 3, 3), the corners of the triangles.
    :param areas: (T,) their areas, in any unit.
    :returns: (N, 3) the points, and (N,) the index of the triangle of each point.
    """
    if len(areas) == 0:
        return np.empty((0, 3)), np.empty(0, dtype=np.int64)
    area_sums = np.cumsum(areas / areas.max())
    # The total area is split, in the order of the faces, into ``count`` equal parts with one
    # point each.
    offsets = np.random.default_rng(0).random(count)
    positions = (np.arange(count) + offsets) * (area_sums[-1] / count)
    # Rounding may put the last position behind the last face.
    faces = np.minimum(np.searchsorted(area_sums, positions, side='right'), len(area_sums) - 1)
    # The multiples of these increments fill the unit square evenly (M. Roberts, 2018: R2).
    increments = np.array([0.7548776662466927, 0.5698402909980532])
    shares = np.arange(count)[:, None] * increments % 1.0
    # Points beyond the diagonal of the square are mirrored into the triangle.
    shares = np.where(shares.sum(axis=1, keepdims=True) > 1.0, 1.0 - shares, shares)
    first, second, third = (corners[faces, corner] for corner in range(3))
    return (first + shares[:, :1] * (second - first) + shares[:, 1:] * (third - first)), faces


class MeshRays:
    """
    Cast rays at the triangles of a mesh.

    :param mesh: metres, map frame.
    """

    def __init__(self, mesh: Mesh) -> None:
        # Open3D takes long to import, and code that only reads scenes does not need it.
        import open3d as o3d
        self._tensor = o3d.core.Tensor
        # A ray that ends this much before a point still reaches it. The tolerance allows for
        # rounding on an exact mesh, otherwise for three times the noise of a scan.
        self._tolerance_m = 0.0005 if mesh.exact else 0.03
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(self._tensor(mesh.vertices),
                                  self._tensor(mesh.triangles.astype(np.uint32)))

    def lengths(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """
        Measure the lengths of rays until they hit the mesh.

        :param origin: (3,) metres, or (..., 3) with one origin for each direction.
        :param directions: (..., 3), of any length.
        :returns: (...) float32, in multiples of the length of the direction, so metres for unit
            vectors; inf if nothing is hit.
        """
        rays = np.empty((*directions.shape[:-1], 6), dtype=np.float32)
        rays[..., :3], rays[..., 3:] = origin, directions
        return self._scene.cast_rays(self._tensor(rays))['t_hit'].numpy()

    def visible(self, points: np.ndarray, position: np.ndarray, max_range: float) -> np.ndarray:
        """
        Return which points the mesh does not occlude from a camera position.

        :param points: (N, 3) float32, metres.
        :param position: (3,), metres.
        :param max_range: metres.
        :returns: (N,) bool.
        """
        offsets = points - np.asarray(position, dtype=np.float32)
        distances = np.linalg.norm(offsets, axis=1)
        hit_distances = self.lengths(position, offsets / np.maximum(distances, 1e-9)[:, None])
        return (hit_distances >= distances - self._tolerance_m) & (distances <= max_range)
