# SPDX-License-Identifier: Apache-2.0
"""Truth for visibility: ray casting of the mesh behind a generated room."""

import numpy as np
import open3d as o3d

from ocp_ros.scenes.scene import Mesh

#: A ray that ends this near to a point has reached it, metres: three times the noise of a scan.
TOLERANCE = 0.03


class RayCaster:
    """
    Cast rays at a mesh, with Embree behind Open3D.

    :param mesh: the surfaces.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(o3d.core.Tensor(mesh.vertices),
                                  o3d.core.Tensor(mesh.triangles.astype(np.uint32)))

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
        rays = np.empty((len(points), 6), dtype=np.float32)
        rays[:, :3] = position
        np.divide(offset, distance[:, None], out=rays[:, 3:])
        hit = self._cast(rays)
        return (hit >= distance - TOLERANCE) & (distance <= max_range)

    def distance(self, position: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """
        Measure how far the mesh is.

        :param position: (3,), metres.
        :param directions: (R, 3) unit vectors.
        :returns: (R,) float32, metres; inf where there is nothing.
        """
        return self._cast(np.hstack([np.broadcast_to(position, directions.shape), directions]))

    def _cast(self, rays: np.ndarray) -> np.ndarray:
        """Return the distance to the first hit of rays (R, 6): origin and direction."""
        rays = np.ascontiguousarray(rays, dtype=np.float32)
        return self._scene.cast_rays(o3d.core.Tensor(rays))['t_hit'].numpy()
