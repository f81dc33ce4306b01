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

"""Views of ``policy_node``: the rig, and its coverage and error on the observed points."""

from collections.abc import Callable, Sequence

from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.geometry.cameras import CameraModel, Pose
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.online.partial_map import thinned
from ocp_ros.online.rig_state import RigState
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import MessageError, msg_to_poses
from ocp_ros.ros.interface.views import CloudView, RigView
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.simulation.point_maps import maps_of, PointMaps
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from rclpy.node import Node


class PolicyViews:
    """
    Show the turns of ``policy_node``.

    :param node: gets the publishers.
    :param models: one camera model per camera, or a single model for all cameras.
    :param live: whether the cameras are live. With a simulation, sim_node shows the rig instead.
    :param rig_state: returns, for the poses of a turn, the state of all cameras of the rig file,
        fixed cameras included; None without a rig file.
    """

    def __init__(self, node: Node, models: Sequence[CameraModel], live: bool,
                 rig_state: Callable[[PoseArray], RigState] | None) -> None:
        self._models = models
        self._rig_state = rig_state
        #: Cloud and camera poses of the latest turn; None before the first one.
        self._turn: tuple[np.ndarray, PoseArray] | None = None
        self._cloud_view = CloudView(node, topics.COVERAGE_CLOUD, topics.ERROR_CLOUD, self._maps)
        # Without a rig file the cameras are omnidirectional and have no CameraInfo.
        camera_infos = 0 if rig_state is None else len(models)
        self._rig_view = RigView(node, topics.RIG_MARKERS, models, camera_infos) if live else None

    def apply_models(self, models: Sequence[CameraModel]) -> None:
        """Use other camera models from now on."""
        self._models = models
        if self._rig_view is not None:
            self._rig_view.models = models

    def show_turn(self, cloud: np.ndarray, poses: PoseArray) -> None:
        """Show a turn: the N points observed so far, (N, 3) metres, and the camera poses."""
        self._turn = cloud, poses
        self._cloud_view.show_turn(poses.header)
        if self._rig_view is not None:
            self._rig_view.show_turn(poses.header, self._camera_poses(poses))

    def _camera_poses(self, poses: PoseArray) -> list[Pose]:
        """Return the poses of all cameras in a turn; fixed cameras are known from a rig file."""
        if self._rig_state is None:
            return msg_to_poses(poses)
        return [Pose.of(row) for row in self._rig_state(poses).placement]

    def _maps(self) -> PointMaps | None:
        """Return the maps of the latest turn; None if there is no turn or it cannot be used."""
        if self._turn is None:
            return None
        try:
            return observed_maps(self._turn[0], self._camera_poses(self._turn[1]), self._models)
        except (MessageError, SceneError):
            return None


def observed_maps(cloud: np.ndarray, poses: list[Pose],
                  models: Sequence[CameraModel]) -> PointMaps:
    """
    Return the coverage and the error on the points observed so far, as if they were the room.

    :param cloud: N observed points, (N, 3) float32, metres.
    :param poses: poses of the cameras.
    :param models: one camera model per camera, or a single model for all cameras.
    :raises SceneError: if the cloud cannot be a room, for example because it is too small.
    """
    # Fewer points, rows and cells than by default, since a node computes the maps after each turn.
    scene = Scene(thinned(cloud, 15000), 'observed cloud')
    # The simulator does not use the rig of its configuration, since models and poses are given.
    config = SimulationConfig(RigConfig(cameras=len(poses), height=0.5 * float(scene.size[2])),
                              EngineConfig(preset='fast', error_rows=64, coverage_cell=0.5))
    return maps_of(Simulator(scene, config, models), poses)
