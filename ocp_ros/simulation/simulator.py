# SPDX-License-Identifier: Apache-2.0
"""The engine for one scene: what a placement sees, covers and misses."""

from typing import NamedTuple

import numpy as np

from ocp_ros.geometry.coverage import coverage_grid, space_coverage
from ocp_ros.geometry.depth_error import DepthError
from ocp_ros.geometry.shadow_maps import Pose
from ocp_ros.geometry.visibility import CubeVisibility, PAPER, PRESETS, SurfelVisibility
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.simulation.config import SimulationConfig

#: Half the side of a point's cube in the depth maps of the error, in multiples of its spacing.
ERROR_CUBE = 0.75


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
        self.height = float(scene.bounds[0, 2] + config.rig.height)
        if self.height >= scene.bounds[1, 2]:
            raise SceneError(
                f'{scene.name}: found a room {scene.size[2]:.2f} m high; expected more than the '
                f"cameras' height of {config.rig.height:.2f} m; lower rig.height")
        self.grid, self.cell_volume = coverage_grid(scene.bounds, config.engine.coverage_cell)
        self.visibility = self._visibility()
        cube = PAPER.cube_scale if config.engine.preset == 'paper' else ERROR_CUBE
        self.depth_error = DepthError(scene.points, scene.spacing, scene.bounds,
                                      config.engine.error_rows, cube)

    def _visibility(self) -> SurfelVisibility | CubeVisibility:
        """Build what the preset asks for."""
        scene, lens = self.scene, self.config.rig.model.lens
        settings = PRESETS[self.config.engine.preset]
        if self.config.engine.preset == 'paper':
            return CubeVisibility(scene.points, scene.spacing, self.grid, lens, settings)
        return SurfelVisibility(scene.points, scene.normals_or_estimate, scene.pitch, self.grid,
                                lens, settings)

    @property
    def volume(self) -> float:
        """Return the volume of the bounding box in cubic metres."""
        return float(self.scene.size.prod())

    def evaluate(self, positions: np.ndarray) -> Evaluation:
        """
        Judge a placement.

        :param positions: (K, 3) float64, metres, map frame.
        """
        seen = np.zeros(len(self.scene), dtype=bool)
        covered = np.zeros(len(self.grid), dtype=bool)
        for position in np.asarray(positions, dtype=np.float64):
            pose = Pose(position, np.eye(3))
            self.visibility.look(pose, seen)
            self.visibility.cover(pose, covered)
        return Evaluation(seen, space_coverage(covered, self.cell_volume), self.depth_error(seen))
