# SPDX-License-Identifier: Apache-2.0
"""
What a camera sees of a scene, by presets.

``fine``: surfels on a map of 144 x 288 cells, for scores and live planning. ``fast``: surfels on
64 x 128, for training. ``paper``: points as cubes and a constant compensation, as arXiv 2110.11106
describes it.
"""

from copy import copy

import numpy as np

from ocp_ros.geometry.cameras import Lens
from ocp_ros.geometry.shadow_maps import (
    CubeSettings,
    Pose,
    project,
    Projection,
    splat,
    visible,
)
from ocp_ros.geometry.surfels import (
    block_bounds,
    blocks_in_range,
    distances,
    project_surfels,
    spatial_order,
    splat_surfels,
    Surfels,
    SurfelSettings,
    SurfelView,
    visible_surfels,
)

FINE = SurfelSettings(rows=144, base=0.02, share=0.35, single=0.7, quad=1.5)
FAST = SurfelSettings(rows=64, base=0.02, share=0.25, single=1.0, quad=2.0)
#: The paper's cube of twice the spacing and a constant, for which it gives no figure.
PAPER = CubeSettings(rows=128, cube_scale=1.0, compensation=0.2)
PRESETS = {'fine': FINE, 'fast': FAST, 'paper': PAPER}
#: Radius of a surfel in multiples of the pitch: discs of 0.71 would just cover a square grid.
DISC_SCALE = 0.95


class _Sorted:
    """Surfels in spatial order, in blocks that can be passed over when they are out of range."""

    def __init__(self, points: np.ndarray, normals: np.ndarray, radius: np.ndarray) -> None:
        self.order = spatial_order(points)
        self.surfels = Surfels.of(points[self.order], normals[self.order], radius[self.order])
        self.bounds = block_bounds(points[self.order])

    def blocks_in_range(self, pose: Pose, lens: Lens) -> np.ndarray:
        """Return the blocks that a camera may measure some point of."""
        position = np.asarray(pose.position, dtype=np.float32)
        return blocks_in_range(self.bounds, position, np.float32(lens.max_range))


class SurfelVisibility:
    """
    Visibility of points as surfels, and of places in the air.

    :param points: (N, 3) float32, metres, map frame.
    :param normals: (N, 3) float32 unit vectors.
    :param pitch: (N,) float32, metres: edge of the square that each point stands for.
    :param places: (M, 3) float32, metres: places in the air, such as cells of a coverage grid.
    :param lens: the camera model.
    :param settings: rules.
    """

    def __init__(self, points: np.ndarray, normals: np.ndarray, pitch: np.ndarray,
                 places: np.ndarray, lens: Lens, settings: SurfelSettings) -> None:
        self.lens, self.settings = lens, settings
        # Without a normal a place has the same distance in every direction.
        self._points = _Sorted(points, normals, DISC_SCALE * pitch)
        self._places = _Sorted(places, np.zeros_like(places), np.zeros(len(places), np.float32))
        self._make_room()

    def _make_room(self) -> None:
        """Allocate the arrays that every look works in."""
        rows = self.settings.rows
        self._view = SurfelView.empty(len(self._points.order))
        self._place_view = SurfelView.empty(len(self._places.order))
        self._map = np.empty((rows + 2) * (2 * rows + 2), dtype=np.float32)

    def for_another_thread(self) -> 'SurfelVisibility':
        """Return one that shares the points but works in arrays of its own."""
        other = copy(self)
        other._make_room()
        return other

    def look(self, pose: Pose, seen: np.ndarray) -> None:
        """
        Add the points that a camera sees to those that others see.

        :param pose: the camera's pose.
        :param seen: (N,) bool, in and out.
        """
        points, view, settings = self._points, self._view, self.settings
        blocks = points.blocks_in_range(pose, self.lens)
        project_surfels(points.surfels, blocks, pose, self.lens, settings.rows, view)
        splat_surfels(view, points.surfels.radius, blocks, self.lens.max_range, settings,
                      self._map)
        visible_surfels(view, points.surfels.radius, blocks, points.order, settings, self._map,
                        seen)

    def cover(self, pose: Pose, covered: np.ndarray) -> None:
        """
        Add the places that the camera of the last look sees to those that others see.

        :param pose: the same pose.
        :param covered: (M,) bool, in and out.
        """
        places, view = self._places, self._place_view
        blocks = places.blocks_in_range(pose, self.lens)
        project_surfels(places.surfels, blocks, pose, self.lens, self.settings.rows, view)
        visible_surfels(view, places.surfels.radius, blocks, places.order, self.settings,
                        self._map, covered)

    def shadow_map(self) -> np.ndarray:
        """Return the map of the last look: (H, W) float32 distances, metres."""
        return distances(self._map, self.settings.rows)


class CubeVisibility:
    """
    Visibility of points as cubes, and of places in the air: the paper's rules.

    :param points: (N, 3) float32, metres, map frame.
    :param spacing: (N,) float32, metres: distance to the nearest neighbour.
    :param places: (M, 3) float32, metres.
    :param lens: the camera model.
    :param settings: rules.
    """

    def __init__(self, points: np.ndarray, spacing: np.ndarray, places: np.ndarray, lens: Lens,
                 settings: CubeSettings) -> None:
        self.lens, self.settings = lens, settings
        self._points, self._spacing, self._places = points, spacing, places
        self._make_room()

    def _make_room(self) -> None:
        """Allocate the arrays that every look works in."""
        rows = self.settings.rows
        self._view = Projection.empty(len(self._points))
        self._place_view = Projection.empty(len(self._places))
        self._map = np.empty((rows, 2 * rows), dtype=np.float32)

    def for_another_thread(self) -> 'CubeVisibility':
        """Return one that shares the points but works in arrays of its own."""
        other = copy(self)
        other._make_room()
        return other

    def look(self, pose: Pose, seen: np.ndarray) -> None:
        """Add the points that a camera sees; see :meth:`SurfelVisibility.look`."""
        project(self._points, pose, self.lens, self._view)
        splat(self._view, self._spacing, self.settings.cube_scale, self.lens.max_range, self._map)
        visible(self._view, self.settings.compensation, self._map, seen)

    def cover(self, pose: Pose, covered: np.ndarray) -> None:
        """Add the places that a camera sees; see :meth:`SurfelVisibility.cover`."""
        project(self._places, pose, self.lens, self._place_view)
        visible(self._place_view, self.settings.compensation, self._map, covered)

    def shadow_map(self) -> np.ndarray:
        """Return the map of the last look: (H, W) float32 distances, metres."""
        return self._map
