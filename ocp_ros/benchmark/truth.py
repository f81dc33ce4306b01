# SPDX-License-Identifier: Apache-2.0
"""Truth for visibility: ray casting of the mesh behind a generated room."""

import numpy as np
import open3d as o3d

from ocp_ros.scenes.scene import Mesh

#: A ray that ends this near to a point has reached it, metres.
TOLERANCE = 0.01


def ray_cast(mesh: Mesh, points: np.ndarray, position: np.ndarray, max_range: float) -> np.ndarray:
    """
    Tell which points nothing of a mesh hides from a camera.

    :param mesh: the surfaces.
    :param points: (N, 3) float32, metres.
    :param position: (3,), metres.
    :param max_range: metres.
    :returns: (N,) bool.
    """
    caster = o3d.t.geometry.RaycastingScene()
    caster.add_triangles(o3d.core.Tensor(mesh.vertices),
                         o3d.core.Tensor(mesh.triangles.astype(np.uint32)))
    offset = points - np.asarray(position, dtype=np.float32)
    distance = np.linalg.norm(offset, axis=1)
    origins = np.broadcast_to(np.asarray(position, dtype=np.float32), offset.shape)
    rays = np.concatenate([origins, offset / distance[:, None]], axis=1).astype(np.float32)
    hit = caster.cast_rays(o3d.core.Tensor(rays))['t_hit'].numpy()
    return (hit >= distance - TOLERANCE) & (distance <= max_range)
