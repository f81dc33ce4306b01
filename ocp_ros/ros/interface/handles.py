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

"""Handles in RViz by which a person moves cameras; none if interactive_markers is not there."""

from collections.abc import Callable
from functools import partial

from geometry_msgs.msg import Pose, PoseArray, Quaternion
from ocp_ros.ros.interface import topics
from rclpy.node import Node
from std_msgs.msg import Header
from visualization_msgs.msg import (
    InteractiveMarker,
    InteractiveMarkerControl,
    InteractiveMarkerFeedback,
)

#: Size of a handle, metres, and the half of the square root of 2.
SIZE, HALF = 0.6, 0.5 ** 0.5


class CameraHandles:
    """
    Offer arrows and rings at each camera, as the topics ``handles/*``.

    :param node: gets the topics and the service.
    :param moved: is called with the number of a camera and its pose when a person lets go of it.
    """

    def __init__(self, node: Node, moved: Callable[[int, Pose], None]) -> None:
        self._server, self._moved, self._cameras = None, moved, 0
        try:
            from interactive_markers import InteractiveMarkerServer
        except ImportError:
            return
        self._server = InteractiveMarkerServer(node, topics.HANDLES)

    def show(self, poses: PoseArray, cameras: int) -> None:
        """Put the handles of the first cameras at their poses."""
        if self._server is None:
            return
        for number, pose in enumerate(poses.poses[:cameras]):
            if number >= self._cameras:
                self._server.insert(handle_of(number, pose, poses.header.frame_id),
                                    feedback_callback=partial(self._on_feedback, number))
            else:
                self._server.setPose(name_of(number), pose)
        for number in range(cameras, self._cameras):
            self._server.erase(name_of(number))
        self._cameras = cameras
        self._server.applyChanges()

    def _on_feedback(self, number: int, feedback: InteractiveMarkerFeedback) -> None:
        """Take the pose at which a person lets go of a handle."""
        if feedback.event_type == InteractiveMarkerFeedback.MOUSE_UP:
            self._moved(number, feedback.pose)

    def close(self) -> None:
        """Remove the handles, their topics and their service."""
        if self._server is not None:
            self._server.shutdown()
            self._server = None


def name_of(number: int) -> str:
    """Return the name of the handle of a camera."""
    return f'camera_{number}'


def handle_of(number: int, pose: Pose, frame: str) -> InteractiveMarker:
    """
    Return the handle of a camera: an arrow and a ring for each axis of its body.

    :param frame: of the pose. With the stamp 0, RViz sends poses in this frame too.
    """
    controls = [InteractiveMarkerControl(name=f'{axis}_{mode}', interaction_mode=mode,
                                         orientation=Quaternion(w=HALF, **{axis: HALF}))
                for axis in 'xyz' for mode in (InteractiveMarkerControl.MOVE_AXIS,
                                               InteractiveMarkerControl.ROTATE_AXIS)]
    return InteractiveMarker(header=Header(frame_id=frame), pose=pose, name=name_of(number),
                             description=name_of(number), scale=SIZE, controls=controls)
