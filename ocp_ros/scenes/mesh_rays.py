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

"""Rays against a mesh, with Embree behind Open3D: the truth for visibility."""

import numpy as np
from ocp_ros.scenes.scene import Mesh

#: A ray that ends this near to a point has reached it, metres: three times the noise of a scan,
#: and rounding where the points lie on the mesh.
TOLERANCE, ROUNDING = 0.03, 0.0005

#: A point that is no farther from a camera has no direction, metres.
TINY = 1e-9


class MeshRays:
    """
    Cast rays at a mesh.

    :param mesh: the surfaces.
    """

    def __init__(self, mesh: Mesh) -> None:
        # Open3D takes long to import, and what only reads scenes does without it.
        import open3d as o3d
        self._tensor = o3d.core.Tensor
        self._tolerance = ROUNDING if mesh.exact else TOLERANCE
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(self._tensor(mesh.vertices),
                                  self._tensor(mesh.triangles.astype(np.uint32)))

    def lengths(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """
        Measure how far rays go until they hit the mesh.

        :param origin: (3,), metres, or (..., 3), one for each.
        :param directions: (..., 3).
        :returns: (...) float32, in lengths of the directions: metres where those are unit
            vectors; inf where there is nothing.
        """
        rays = np.empty((*directions.shape[:-1], 6), dtype=np.float32)
        rays[..., :3], rays[..., 3:] = origin, directions
        return self._scene.cast_rays(self._tensor(rays))['t_hit'].numpy()

    def visible(self, points: np.ndarray, position: np.ndarray, max_range: float) -> np.ndarray:
        """
        Tell which points nothing of the mesh hides from a camera.

        :param points: (N, 3) float32, metres.
        :param position: (3,), metres.
        :param max_range: metres.
        :returns: (N,) bool.
        """
        offset = points - np.asarray(position, dtype=np.float32)
        distance = np.linalg.norm(offset, axis=1)
        hit = self.lengths(position, offset / np.maximum(distance, TINY)[:, None])
        return (hit >= distance - self._tolerance) & (distance <= max_range)
