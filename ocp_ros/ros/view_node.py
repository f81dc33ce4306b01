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

"""``ocp view --ros``: a room and a placement in RViz, where cameras are moved by handles."""

from geometry_msgs.msg import Pose, PoseArray
import numpy as np
from ocp_ros.geometry.cameras import heading_of
from ocp_ros.geometry.cameras import Pose as CameraPose
from ocp_ros.report.facts import metres
from ocp_ros.ros.interface import conversions, topics
from ocp_ros.ros.interface.handles import CameraHandles
from ocp_ros.ros.interface.qos import LATCHED, LOOP
from ocp_ros.ros.interface.views import CloudView, RigView
from ocp_ros.ros.runtime.node_main import run
from ocp_ros.simulation.objective import Objective
from ocp_ros.simulation.point_maps import maps_of_views
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header


class ViewNode(Node):
    """
    Show a room and a placement; commands and handles in RViz move the cameras.

    :param objective: the rig in the room.
    :param poses: (K, 6) poses of the K cameras to be placed, metres, map frame, and radians.
    """

    def __init__(self, objective: Objective, poses: np.ndarray, **kwargs) -> None:
        super().__init__('ocp_view', **kwargs)
        self.objective = objective
        self._header = Header(frame_id='map', stamp=self.get_clock().now().to_msg())
        points = objective.simulator.scene.points
        self._scene_publisher = self.create_publisher(PointCloud2, topics.SCENE, LATCHED)
        self._scene_publisher.publish(conversions.cloud_to_msg(points, self._header))
        self._pose_publisher = self.create_publisher(PoseArray, topics.CAMERA_POSES, LATCHED)
        models = [camera.model for camera in objective.rig.all_cameras]
        self._rig_view = RigView(self, topics.MARKERS, models, len(models))
        self._cloud_view = CloudView(
            self, topics.TRUE_COVERAGE_CLOUD, topics.TRUE_ERROR_CLOUD,
            lambda: maps_of_views(objective.simulator, [*self._views, *objective.fixed]))
        self._handles = CameraHandles(self, self._on_handle)
        self.create_subscription(PoseArray, topics.CAMERA_COMMANDS, self._on_command, LOOP)
        self._move_cameras(poses)

    def _on_handle(self, camera: int, pose: Pose) -> None:
        """Move the camera of a handle to the pose at which a person lets go of the handle."""
        message = conversions.positions_to_msg(self.poses[:, :3], self._header, self.poses[:, 3:])
        message.poses[camera] = pose
        self._on_command(message)

    def _on_command(self, message: PoseArray) -> None:
        """Move the cameras, or log why the command cannot be used."""
        try:
            poses = conversions.msg_to_poses(message, len(self.poses))
        except conversions.MessageError as error:
            self.get_logger().warning(f'command refused: {conversions.shortened(error)}',
                                      throttle_duration_sec=1.0)
            return
        self._move_cameras(np.array(
            [[*pose.position, *heading_of(pose.rotation)] for pose in poses]))

    def _move_cameras(self, poses: np.ndarray) -> None:
        """Move the cameras to poses (K, 6), metres and radians, and publish what they see."""
        self.poses = poses
        self._views = self.objective.look(poses)
        all_poses = np.vstack([poses, self.objective.rig.fixed_poses])
        self._rig_view.show_turn(self._header, list(map(CameraPose.of, all_poses)))
        self._cloud_view.show_turn(self._header)
        message = conversions.positions_to_msg(poses[:, :3], self._header, poses[:, 3:])
        self._pose_publisher.publish(message)
        self._handles.show(message, len(poses))
        evaluation = self.objective.judge(self._views)
        self.get_logger().info(f'depth error {metres(evaluation.depth_error)}, space coverage '
                               f'{evaluation.space_coverage:.1f} m³')

    def destroy_node(self) -> None:
        """Remove the handles, and end the node."""
        self._handles.close()
        super().destroy_node()


def show_placement(objective: Objective, poses: np.ndarray) -> int:
    """Show a placement in RViz until Ctrl-C, and return the exit status; see :class:`ViewNode`."""
    return run(lambda: ViewNode(objective, poses), [])
