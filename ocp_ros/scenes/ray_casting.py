# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Truth for visibility: ray casting of the mesh behind a generated room."""

import numpy as np

from ocp_ros.scenes.mesh_rays import MeshRays
from ocp_ros.scenes.scene import Mesh

#: A ray that ends this near to a point has reached it, metres: three times the noise of a scan.
TOLERANCE = 0.03

#: A point that is no farther from a camera has no direction, metres.
TINY = 1e-9


class RayCaster:
    """
    Cast rays at a mesh, one for each point.

    :param mesh: the surfaces.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._rays = MeshRays(mesh)

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
        hit = self._rays.lengths(position, offset / np.maximum(distance, TINY)[:, None])
        return (hit >= distance - TOLERANCE) & (distance <= max_range)

    def distance(self, position: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """
        Measure how far the mesh is.

        :param position: (3,), metres.
        :param directions: (R, 3) unit vectors.
        :returns: (R,) float32, metres; inf where there is nothing.
        """
        return self._rays.lengths(position, directions)
