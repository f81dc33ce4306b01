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

"""Rays cast at a mesh, with Embree through Open3D: the reference for visibility."""

import numpy as np
from ocp_ros.scenes.scene import Mesh


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
