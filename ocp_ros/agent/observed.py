# SPDX-License-Identifier: Apache-2.0
"""
The engine on what has been seen, and which parts of the air nobody has looked into yet.

Whoever decides online, a planner or a policy, knows the room through this alone.
"""

import numpy as np

from ocp_ros.geometry.blocks import no_bits, pack, unpack
from ocp_ros.geometry.cameras import CameraModel, Pose
from ocp_ros.geometry.clouds import fixed_size
from ocp_ros.geometry.depth_error import DepthError
from ocp_ros.geometry.surfels import SurfelSettings
from ocp_ros.geometry.visibility import FAST, SurfelVisibility
from ocp_ros.scenes.scene import Scene, voxel_downsample, voxel_size_for
from ocp_ros.simulation.simulator import ERROR_CUBE, View

#: Metres: edge of the cells of the air. They are anchored to the map frame's origin, so that they
#: stay the same while the observed bounding box grows.
CELL = 0.5
#: The most cells of the air: where there are more, their edge is doubled until there are not.
MOST_CELLS = 20_000
#: Cells are numbered by three numbers of 21 bits each.
BITS, OFFSET = 21, 1 << 20
#: Points of a cloud per point wanted: of what is denser, points are left out before voxels are
#: sought, which takes long.
DENSE = 4
#: Points and rows of depth maps of a model for quick decisions.
QUICK_POINTS, QUICK_ROWS = 6000, 32


class Observed:
    """
    The engine on what has been seen, and the cells of the air within its bounding box.

    :param cloud: (M, 3) float32, metres, map frame: the points seen so far.
    :param max_range: of the cameras, metres.
    :param most: a cloud of more points is thinned to at most as many.
    :param rows: rows of the depth maps of the error.
    :param settings: rules of visibility.
    :ivar cells: (C,) int64, the number of each cell, in the order of the bits of a view.
    :raises SceneError: if the points are too few or too flat to be a room.
    """

    def __init__(self, cloud: np.ndarray, max_range: float, most: int, rows: int,
                 settings: SurfelSettings = FAST) -> None:
        scene = Scene(thinned(cloud, most), 'observed cloud')
        centres, numbers = cells_of_the_air(scene.bounds)
        self.visibility = SurfelVisibility(scene.points, scene.normals_or_estimate, scene.pitch,
                                           centres, settings)
        order = self.visibility.order
        self.cells = numbers[self.visibility.place_order]
        self.depth_error = DepthError(scene.points[order], scene.spacing[order], scene.bounds,
                                      rows, ERROR_CUBE)
        self._lens = CameraModel(max_range=max_range).lens

    def look(self, position: np.ndarray) -> View:
        """Compute what a camera at a position (3,) would see of what is known."""
        view = View(no_bits(len(self.visibility.order)), no_bits(len(self.cells)))
        self.visibility.look(Pose.of(position), self._lens, *view)
        return view

    def error(self, views: list[View]) -> float:
        """Return the depth error of some views together, metres."""
        return self.depth_error(np.bitwise_or.reduce([view.seen for view in views]))

    def covered(self, positions: np.ndarray) -> np.ndarray:
        """Return the numbers of the cells that cameras at positions (K, 3) cover together."""
        bits = np.bitwise_or.reduce([self.look(position).covered for position in positions])
        return self.cells[unpack(bits, len(self.cells))]


class Memory:
    """Which cells of the air some camera has covered since the episode began."""

    def __init__(self) -> None:
        self._seen = np.empty(0, dtype=np.int64)
        self._visited: list[np.ndarray] = []

    def visit(self, positions: np.ndarray) -> None:
        """Remember where the cameras were at a turn: (K, 3) metres."""
        self._visited.append(positions.copy())

    def unseen(self, model: Observed) -> np.ndarray:
        """Return packed bits of a model's cells: those that no camera covered, as far as known."""
        covered = [model.covered(positions) for positions in self._visited]
        self._seen = np.unique(np.concatenate([self._seen, *covered]))
        self._visited.clear()
        return pack(~np.isin(model.cells, self._seen))


def thinned(cloud: np.ndarray, most: int) -> np.ndarray:
    """Return at most so many points of a cloud (M, 3), evenly spread where there are more."""
    if len(cloud) <= most:
        return cloud
    if len(cloud) > DENSE * most:
        cloud = fixed_size(cloud, DENSE * most)
    return voxel_downsample(cloud, voxel_size_for(cloud, most))


def cells_of_the_air(bounds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    List the cells of a grid whose centres are inside a bounding box.

    :param bounds: (2, 3) metres.
    :returns: centres (C, 3) float32, metres, and numbers (C,) int64 that name the cells in any
        bounding box.
    """
    edge = CELL
    while np.prod(np.ptp(bounds, axis=0) / edge) > MOST_CELLS:
        edge *= 2.0
    first = np.ceil(bounds[0] / edge - 0.5).astype(np.int64)
    last = np.floor(bounds[1] / edge - 0.5).astype(np.int64)
    axes = [np.arange(first[k], last[k] + 1) for k in range(3)]
    index = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)
    shifted = index + OFFSET
    numbers = (shifted[:, 0] << 2 * BITS) | (shifted[:, 1] << BITS) | shifted[:, 2]
    return ((index + 0.5) * edge).astype(np.float32), numbers
