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
Visibility of the points of a scene from a camera, by presets.

``fine``: surfels on a map of 160 x 320 cells, for scores and live planning. ``fast``: surfels on
64 x 128, for training. ``paper``: points as cubes and a constant compensation, as arXiv 2110.11106
describes it.

Both classes store their points in spatial order, and packed bits are in that order; see
:mod:`ocp_ros.geometry.packed_bits`. Threads may share an instance: each call of ``look`` uses its
own memory.
"""

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy

import numpy as np
from ocp_ros.geometry.cameras import CameraArrays, Frustum, Pose
from ocp_ros.geometry.packed_bits import block_bounds, no_bits, spatial_order
from ocp_ros.geometry.shadow_maps import CubeSettings, look_at_cubes, look_at_cubes_from_all
from ocp_ros.geometry.surfels import (
    kept_in_cone,
    look_at_surfels,
    look_at_surfels_from_all,
    SurfelPlaces,
    Surfels,
    SurfelSettings,
    Workspace,
)

FINE = SurfelSettings(rows=160, base_tolerance=0.01, radius_tolerance=0.35, single_limit=0.85,
                      quad_limit=1.5)
FAST = SurfelSettings(rows=64, base_tolerance=0.02, radius_tolerance=0.15, single_limit=0.8,
                      quad_limit=2.0, setback=0.25)
#: The cube of arXiv 2110.11106, twice as wide as the spacing (``cube_scale`` sets half its side),
#: and a constant compensation, for which the paper gives no value.
PAPER = CubeSettings(rows=128, cube_scale=1.0, compensation=0.2)
#: The preset for scenes with a mesh: rays are cast instead of filling maps.
MESH = 'mesh'
PRESETS = {'fine': FINE, 'fast': FAST, 'paper': PAPER}
#: Radius of a surfel in multiples of the pitch: discs of 0.71 would just cover a square grid.
DISC_SCALE = 0.9
#: Packed bits of no points.
NO_BITS = no_bits(0)


class SurfelVisibility:
    """
    Visibility of points as surfels, and of positions in the air.

    :param points: (N, 3) float32, N points, metres, map frame.
    :param normals: (N, 3) float32, the unit normal of each point.
    :param pitch: (N,) float32, metres: edge of the square that each point stands for.
    :param places: (M, 3) float32, metres: M positions in the air, such as the centres of the cells
        of a coverage grid.
    :param settings: the rules of the maps.
    :ivar order: (N,) int64: index of each point of the spatial order among the given points.
    :ivar place_order: (M,) int64: the same for the positions.
    """

    def __init__(self, points: np.ndarray, normals: np.ndarray, pitch: np.ndarray,
                 places: np.ndarray, settings: SurfelSettings) -> None:
        self.order = spatial_order(points)
        points, radius = points[self.order], (DISC_SCALE * pitch)[self.order]
        self._surfels = Surfels.of(points, normals[self.order], radius)
        self._bounds = block_bounds(points, radius)
        self.settings = settings
        self._set_places(places)

    def _set_places(self, places: np.ndarray) -> None:
        """Set the positions in the air (M, 3), metres."""
        self.place_order = spatial_order(places)
        self._places = SurfelPlaces.of(places[self.place_order])
        self._place_bounds = block_bounds(places[self.place_order], self._places.radius)
        #: Workspaces that are not in use; a look makes a new one if there is none.
        self._free_workspaces: deque[Workspace] = deque()

    def with_places(self, places: np.ndarray) -> 'SurfelVisibility':
        """Return a copy with other positions (M, 3), metres, which shares the points."""
        other = copy(self)
        other._set_places(places)
        return other

    def by(self, settings: SurfelSettings) -> 'SurfelVisibility':
        """Return a copy with other rules, which shares the points and the positions."""
        other = copy(self)
        other.settings = settings
        # The size of a workspace depends on the rules.
        other._free_workspaces = deque()
        return other

    def look(self, pose: Pose, lens: Frustum, seen: np.ndarray,
             covered: np.ndarray = NO_BITS) -> None:
        """
        Set the bits of the points and positions that are visible to a camera.

        :param pose: the camera's pose.
        :param lens: the camera model.
        :param seen: (W,) uint64, packed bits of the points, in and out.
        :param covered: (V,) uint64, packed bits of the positions, in and out; ``NO_BITS`` to leave
            them out.
        """
        with self._workspace() as work:
            look_at_surfels(self._surfels, self._bounds, self._places, self._place_bounds, pose,
                            lens, self.settings, work, seen, covered)

    def look_from_all(self, cameras: CameraArrays, seen: np.ndarray, covered: np.ndarray) -> None:
        """
        Do :meth:`look` for K cameras, with no Python between them.

        :param seen: (K, W) uint64, packed bits of the points, a row for each camera, in and out.
        :param covered: (K, V) uint64, packed bits of the positions, in and out.
        """
        with self._workspace() as work:
            look_at_surfels_from_all(self._surfels, self._bounds, self._places,
                                     self._place_bounds, cameras, self.settings, work, seen,
                                     covered)

    @contextmanager
    def _workspace(self) -> Iterator[Workspace]:
        """Lend a workspace to a look."""
        try:
            work = self._free_workspaces.pop()
        except IndexError:
            work = Workspace.of(self.settings.rows, max(len(self.order), len(self.place_order)))
        yield work
        self._free_workspaces.append(work)

    def narrowed(self, pose: Pose, lens: Frustum, seen: np.ndarray, covered: np.ndarray
                 ) -> tuple[np.ndarray, np.ndarray]:
        """
        Clip what an omnidirectional camera sees to the frustum of a camera at the same position.

        So one call of :meth:`look` serves many viewing directions from one position.

        :param pose: the camera's pose.
        :param lens: the camera model.
        :param seen: (W,) uint64, packed bits of the points that the omnidirectional camera sees.
        :param covered: (V,) uint64, packed bits of the positions that this camera sees.
        :returns: copies of both, without the points and positions outside the frustum.
        """
        return (kept_in_cone(self._surfels, self._bounds, pose, lens, seen),
                kept_in_cone(self._places, self._place_bounds, pose, lens, covered))


class CubeVisibility:
    """
    Visibility of points as cubes, and of positions in the air, as in arXiv 2110.11106.

    :param points: (N, 3) float32, N points, metres, map frame.
    :param spacing: (N,) float32, metres: distance of each point to its nearest neighbour.
    :param places: (M, 3) float32, metres: M positions in the air.
    :param settings: the rules of the maps.
    :ivar order: (N,) int64: index of each point of the spatial order among the given points.
    :ivar place_order: (M,) int64: the same for the positions.
    """

    def __init__(self, points: np.ndarray, spacing: np.ndarray, places: np.ndarray,
                 settings: CubeSettings) -> None:
        self.settings = settings
        self.order = spatial_order(points)
        self._points = np.ascontiguousarray(points[self.order].T)
        self._half_sides = (settings.cube_scale * spacing[self.order]).astype(np.float32)
        self._set_places(places)

    def _set_places(self, places: np.ndarray) -> None:
        """Set the positions in the air (M, 3), metres."""
        self.place_order = spatial_order(places)
        self._places = np.ascontiguousarray(places[self.place_order].T)

    def with_places(self, places: np.ndarray) -> 'CubeVisibility':
        """Return a copy with other positions; see :meth:`SurfelVisibility.with_places`."""
        other = copy(self)
        other._set_places(places)
        return other

    def look(self, pose: Pose, lens: Frustum, seen: np.ndarray,
             covered: np.ndarray = NO_BITS) -> None:
        """Set the bits of what is visible to a camera; see :meth:`SurfelVisibility.look`."""
        look_at_cubes(self._points, self._half_sides, self._places, pose, lens, self.settings,
                      seen, covered)

    def look_from_all(self, cameras: CameraArrays, seen: np.ndarray, covered: np.ndarray) -> None:
        """Set the bits for K cameras; see :meth:`SurfelVisibility.look_from_all`."""
        look_at_cubes_from_all(self._points, self._half_sides, self._places, cameras,
                               self.settings, seen, covered)
