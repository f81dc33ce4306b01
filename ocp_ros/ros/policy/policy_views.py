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

"""What ``policy_node`` has to show: what it knows, judged on what has been seen so far."""

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

#: Points of an observed cloud that is judged, and rows of the depth maps of its error.
MOST, ROWS = 15000, 64


class PolicyViews:
    """
    Show the turns of ``policy_node``.

    :param node: publishes.
    :param models: what each camera sees, or one model for all.
    :param live: whether nobody else shows the rig, as a simulation does.
    :param rig_state: tells of a turn's poses how the cameras of a rig file stand, those in place
        included; None where there is no rig file.
    """

    def __init__(self, node: Node, models: Sequence[CameraModel], live: bool,
                 rig_state: Callable[[PoseArray], RigState] | None) -> None:
        self._models, self._sight = models, rig_state
        self._turn: tuple[np.ndarray, PoseArray] | None = None
        self._clouds = CloudView(node, topics.COVERAGE_CLOUD, topics.ERROR_CLOUD, self._judge)
        known = 0 if rig_state is None else len(models)
        self._rig = RigView(node, topics.RIG_MARKERS, models, known) if live else None

    def change(self, models: Sequence[CameraModel]) -> None:
        """Show what other cameras see from now on."""
        self._models = models
        if self._rig is not None:
            self._rig.models = models

    def turn(self, cloud: np.ndarray, poses: PoseArray) -> None:
        """Show a turn: the points (N, 3) seen so far, metres, and where the cameras are."""
        self._turn = cloud, poses
        self._clouds.turn(poses.header)
        if self._rig is not None:
            self._rig.turn(poses.header, self._standing(poses))

    def _standing(self, poses: PoseArray) -> list[Pose]:
        """Return where the cameras of a turn are and how they are turned, all that are known."""
        if self._sight is None:
            return msg_to_poses(poses)
        return [Pose.of(row) for row in self._sight(poses).placement]

    def _judge(self) -> PointMaps | None:
        """Judge the latest turn; None where there is none, or nothing that can be judged."""
        if self._turn is None:
            return None
        try:
            return observed_maps(self._turn[0], self._standing(self._turn[1]), self._models)
        except (MessageError, SceneError):
            return None


def observed_maps(cloud: np.ndarray, poses: list[Pose],
                  models: Sequence[CameraModel]) -> PointMaps:
    """
    Judge cameras on what has been seen so far, as if it were the room.

    :param cloud: (N, 3) float32, metres.
    :param poses: of the cameras.
    :param models: what each sees, or one model for all.
    :raises SceneError: if the cloud is no room.
    """
    scene = Scene(thinned(cloud, MOST), 'observed cloud')
    config = SimulationConfig(RigConfig(cameras=len(poses), height=0.5 * float(scene.size[2])),
                              EngineConfig(preset='fast', error_rows=ROWS, coverage_cell=0.5))
    return maps_of(Simulator(scene, config, models), poses)
