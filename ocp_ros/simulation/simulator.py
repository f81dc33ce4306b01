# SPDX-License-Identifier: Apache-2.0
"""The engine for one scene: what a placement sees, covers and misses."""

from typing import NamedTuple

import numpy as np

from ocp_ros.geometry.coverage import coverage_grid, space_coverage
from ocp_ros.geometry.depth_error import DepthError
from ocp_ros.geometry.shadow_maps import Pose, project, Projection, splat, visible
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.simulation.config import SimulationConfig

NO_NORMALS = np.empty((0, 3), dtype=np.float32)


class Evaluation(NamedTuple):
    """
    What a placement is worth.

    :ivar visible: (N,) bool, points that at least one camera sees.
    :ivar space_coverage: cubic metres.
    :ivar depth_error: metres.
    """

    visible: np.ndarray
    space_coverage: float
    depth_error: float


class Simulator:
    """
    Judge placements in one scene.

    :param scene: the room.
    :param config: the rig and the engine's settings.
    :raises SceneError: if the cameras' plane is not inside the room.
    """

    def __init__(self, scene: Scene, config: SimulationConfig) -> None:
        self.scene, self.config = scene, config
        self.settings = config.engine.settings
        self.lens = config.rig.model.lens
        self.height = float(scene.bounds[0, 2] + config.rig.height)
        if self.height >= scene.bounds[1, 2]:
            raise SceneError(
                f'{scene.name}: found a room {scene.size[2]:.2f} m high; expected more than the '
                f"cameras' height of {config.rig.height:.2f} m; lower rig.height")
        self.depth_error = DepthError(scene.points, scene.spacing, scene.bounds, self.settings)
        self.grid, self.cell_volume = coverage_grid(scene.bounds, config.engine.coverage_cell)
        self._no_spacing = np.zeros(len(self.grid), dtype=np.float32)
        self._points, self._cells = Projection.empty(len(scene)), Projection.empty(len(self.grid))
        self._map = np.empty((self.settings.rows, 2 * self.settings.rows), dtype=np.float32)

    @property
    def volume(self) -> float:
        """Return the volume of the bounding box in cubic metres."""
        return float(self.scene.size.prod())

    def look(self, pose: Pose, seen: np.ndarray) -> np.ndarray:
        """
        Add the points that one camera sees to those that others see.

        :param pose: the camera's pose.
        :param seen: (N,) bool, in and out.
        :returns: the camera's shadow map, (H, W) float32, metres; overwritten by the next call.
        """
        scene, settings = self.scene, self.settings
        project(scene.points, scene.normals_or_estimate, pose, self.lens, self._points)
        splat(self._points, scene.spacing, settings.cube_scale, self.lens.max_range, self._map)
        visible(self._points, scene.spacing, settings, self._map, seen)
        return self._map

    def evaluate(self, positions: np.ndarray) -> Evaluation:
        """
        Judge a placement.

        :param positions: (K, 3) float64, metres, map frame.
        """
        seen = np.zeros(len(self.scene), dtype=bool)
        covered = np.zeros(len(self.grid), dtype=bool)
        for position in np.asarray(positions, dtype=np.float64):
            pose = Pose(position, np.eye(3))
            shadow_map = self.look(pose, seen)
            project(self.grid, NO_NORMALS, pose, self.lens, self._cells)
            visible(self._cells, self._no_spacing, self.settings, shadow_map, covered)
        return Evaluation(seen, space_coverage(covered, self.cell_volume), self.depth_error(seen))
