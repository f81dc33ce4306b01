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

"""Visibility by rays cast at the mesh behind the points of a room."""

from copy import copy
from dataclasses import replace

import numpy as np
from ocp_ros.geometry.cameras import camera_of, CameraArrays, Frustum, Pose
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.packed_bits import pack, spatial_order
from ocp_ros.geometry.shadow_maps import in_reach
from ocp_ros.geometry.visibility import MESH, NO_BITS
from ocp_ros.scenes.meshes import MeshRays
from ocp_ros.scenes.scene import Mesh, Scene


class RayVisibility:
    """
    Visibility of points and of positions in the air by rays cast at a mesh.

    The class replaces :class:`~ocp_ros.geometry.visibility.SurfelVisibility`, and has the same
    methods ``look``, ``look_from_all`` and ``narrowed``.

    :param points: (N, 3) float32, metres, map frame: N points on surfaces.
    :param places: (M, 3) float32, metres, map frame: M positions in the air.
    :param mesh: the surfaces that block rays.
    :ivar order: (N,) int64, indices that sort ``points`` in spatial order, as in packed bits.
    :ivar place_order: (M,) int64, the same for ``places``.
    """

    def __init__(self, points: np.ndarray, places: np.ndarray, mesh: Mesh) -> None:
        self.order = spatial_order(points)
        self._points = points[self.order]
        self._rays = MeshRays(mesh)
        self._set_places(places)

    def _set_places(self, places: np.ndarray) -> None:
        """Set the positions in the air (M, 3), metres."""
        self.place_order = spatial_order(places)
        self._places = places[self.place_order]

    def with_places(self, places: np.ndarray) -> 'RayVisibility':
        """Return a copy with other positions; see ``SurfelVisibility.with_places``."""
        other = copy(self)
        other._set_places(places)
        return other

    def look(self, pose: Pose, lens: Frustum, seen: np.ndarray,
             covered: np.ndarray = NO_BITS) -> None:
        """Set the bits of visible points and positions; see ``SurfelVisibility.look``."""
        seen |= self._visible(self._points, pose, lens)
        # An empty array means that the caller needs no positions.
        if len(covered):
            covered |= self._visible(self._places, pose, lens)

    def look_from_all(self, cameras: CameraArrays, seen: np.ndarray, covered: np.ndarray) -> None:
        """Set the bits for K cameras; see ``SurfelVisibility.look_from_all``."""
        for camera in range(len(seen)):
            pose, lens = camera_of(cameras, camera)
            self.look(pose, lens, seen[camera], covered[camera])

    def narrowed(self, pose: Pose, lens: Frustum, seen: np.ndarray, covered: np.ndarray
                 ) -> tuple[np.ndarray, np.ndarray]:
        """Return both bit sets, clipped to a viewing cone; see ``SurfelVisibility.narrowed``."""
        return (seen & pack(in_reach(self._points, pose, lens)),
                covered & pack(in_reach(self._places, pose, lens)))

    def _visible(self, points: np.ndarray, pose: Pose, lens: Frustum) -> np.ndarray:
        """Return the packed bits of the points (N, 3) that a camera sees, within its range."""
        reachable = np.flatnonzero(in_reach(points, pose, lens))
        seen = np.zeros(len(points), dtype=bool)
        seen[reachable] = self._rays.visible(points[reachable], pose.position, lens.max_range)
        return pack(seen)


def with_rays(engine: EngineConfig, scene: Scene) -> EngineConfig:
    """Return the engine settings, with ray casting as preset if the scene has a mesh."""
    return engine if scene.mesh is None else replace(engine, preset=MESH)
