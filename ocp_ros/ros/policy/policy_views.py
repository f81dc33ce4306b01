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
    :param models: one camera model per camera, or one for all.
    :param live: whether cameras are live: then this node shows the rig, otherwise the simulation.
    :param rig_state: converts the poses of a turn to the state of all cameras of a rig file, fixed
        cameras included; None without a rig file.
    """

    def __init__(self, node: Node, models: Sequence[CameraModel], live: bool,
                 rig_state: Callable[[PoseArray], RigState] | None) -> None:
        self._models, self._rig_state = models, rig_state
        self._turn: tuple[np.ndarray, PoseArray] | None = None
        self._clouds = CloudView(node, topics.COVERAGE_CLOUD, topics.ERROR_CLOUD, self._judge)
        known = 0 if rig_state is None else len(models)
        self._rig = RigView(node, topics.RIG_MARKERS, models, known) if live else None

    def change(self, models: Sequence[CameraModel]) -> None:
        """Use other camera models from now on."""
        self._models = models
        if self._rig is not None:
            self._rig.models = models

    def turn(self, cloud: np.ndarray, poses: PoseArray) -> None:
        """Show a turn: the points (N, 3) observed so far, metres, and the camera poses."""
        self._turn = cloud, poses
        self._clouds.turn(poses.header)
        if self._rig is not None:
            self._rig.turn(poses.header, self._standing(poses))

    def _standing(self, poses: PoseArray) -> list[Pose]:
        """Return the poses of all known cameras in a turn."""
        if self._rig_state is None:
            return msg_to_poses(poses)
        return [Pose.of(row) for row in self._rig_state(poses).placement]

    def _judge(self) -> PointMaps | None:
        """Return the maps of the latest turn; None if there is no turn or it cannot be used."""
        if self._turn is None:
            return None
        try:
            return observed_maps(self._turn[0], self._standing(self._turn[1]), self._models)
        except (MessageError, SceneError):
            return None


def observed_maps(cloud: np.ndarray, poses: list[Pose],
                  models: Sequence[CameraModel]) -> PointMaps:
    """
    Evaluate cameras on the points observed so far, as if they were the whole room.

    :param cloud: (N, 3) float32, metres.
    :param poses: of the cameras.
    :param models: one camera model per camera, or one for all.
    :raises SceneError: if the cloud is no room.
    """
    scene = Scene(thinned(cloud, 15000), 'observed cloud')
    config = SimulationConfig(RigConfig(cameras=len(poses), height=0.5 * float(scene.size[2])),
                              EngineConfig(preset='fast', error_rows=64, coverage_cell=0.5))
    return maps_of(Simulator(scene, config, models), poses)
