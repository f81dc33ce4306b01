# SPDX-License-Identifier: Apache-2.0
"""The engine for one scene: what a placement sees, covers and misses."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
import threading
from typing import NamedTuple

import numpy as np

from ocp_ros.geometry.coverage import coverage_grid, space_coverage
from ocp_ros.geometry.depth_error import DepthError
from ocp_ros.geometry.shadow_maps import Pose
from ocp_ros.geometry.visibility import CubeVisibility, PRESETS, SurfelVisibility
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.simulation.config import SimulationConfig

#: Half the side of a point's cube in the depth maps of the error, in multiples of its spacing:
#: the paper's. With less, the maps of a whole room have holes.
ERROR_CUBE = 1.0


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


class View(NamedTuple):
    """
    What one camera sees.

    :ivar visible: (N,) bool, points.
    :ivar covered: (M,) bool, cells of the coverage grid.
    """

    visible: np.ndarray
    covered: np.ndarray


class Simulator:
    """
    Judge placements in one scene; threads may share it, and the kernels run without the GIL.

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
        self._visibility = self._make_visibility()
        self._own = threading.local()
        self.depth_error = DepthError(scene.points, scene.spacing, scene.bounds,
                                      config.engine.error_rows, ERROR_CUBE)

    def _make_visibility(self) -> SurfelVisibility | CubeVisibility:
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

    @property
    def visibility(self) -> SurfelVisibility | CubeVisibility:
        """Return the visibility that belongs to the calling thread: it has arrays to work in."""
        if not hasattr(self._own, 'visibility'):
            self._own.visibility = self._visibility.for_another_thread()
        return self._own.visibility

    def look(self, position: np.ndarray) -> View:
        """
        Compute what one camera sees.

        :param position: (3,) metres, map frame.
        """
        view = View(np.zeros(len(self.scene), dtype=bool), np.zeros(len(self.grid), dtype=bool))
        pose, visibility = Pose(np.asarray(position, dtype=np.float64), np.eye(3)), self.visibility
        visibility.look(pose, view.visible)
        visibility.cover(pose, view.covered)
        return view

    def judge(self, views: Sequence[View]) -> Evaluation:
        """
        Judge cameras by what they see: where one of them moved, only its view is new.

        :param views: from :meth:`look`, one per camera.
        """
        seen = np.logical_or.reduce([view.visible for view in views])
        covered = np.logical_or.reduce([view.covered for view in views])
        return Evaluation(seen, space_coverage(covered, self.cell_volume), self.depth_error(seen))

    def evaluate(self, positions: np.ndarray) -> Evaluation:
        """
        Judge a placement.

        :param positions: (K, 3), metres, map frame, K >= 1.
        """
        return self.judge([self.look(position) for position in positions])

    def evaluate_many(self, placements: np.ndarray, threads: int = 1) -> np.ndarray:
        """
        Judge many placements.

        :param placements: (M, K, 3), metres, map frame.
        :param threads: how many to use.
        :returns: (M, 2) float64: space coverage in cubic metres and depth error in metres.
        """
        def scores(positions: np.ndarray) -> tuple[float, float]:
            result = self.evaluate(positions)
            return result.space_coverage, result.depth_error

        with ThreadPoolExecutor(threads) as pool:
            return np.array(list(pool.map(scores, placements))).reshape(-1, 2)
