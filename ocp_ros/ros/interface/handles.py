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

"""Handles in RViz by which a person moves cameras, if interactive_markers is installed."""

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


class CameraHandles:
    """
    Offer arrows and rings at each camera, on the topics ``handles/*``.

    Without the package interactive_markers it offers nothing.

    :param node: gets the topics and the service.
    :param on_move: is called with the number of a camera and its new pose when a person lets go of
        the handle of this camera.
    """

    def __init__(self, node: Node, on_move: Callable[[int, Pose], None]) -> None:
        self._server = None
        self._on_move = on_move
        self._handle_count = 0
        try:
            from interactive_markers import InteractiveMarkerServer
        except ImportError:
            return
        self._server = InteractiveMarkerServer(node, topics.HANDLES)

    def show(self, poses: PoseArray, count: int) -> None:
        """
        Show handles at the first poses, and remove all other handles.

        :param poses: of the cameras.
        :param count: number of cameras that get a handle, from the first one.
        """
        if self._server is None:
            return
        for number, pose in enumerate(poses.poses[:count]):
            if number >= self._handle_count:
                self._server.insert(handle_of(number, pose, poses.header.frame_id),
                                    feedback_callback=partial(self._on_feedback, number))
            else:
                self._server.setPose(name_of(number), pose)
        for number in range(count, self._handle_count):
            self._server.erase(name_of(number))
        self._handle_count = count
        self._server.applyChanges()

    def _on_feedback(self, number: int, feedback: InteractiveMarkerFeedback) -> None:
        """Pass on the pose at which a person lets go of a handle."""
        if feedback.event_type == InteractiveMarkerFeedback.MOUSE_UP:
            self._on_move(number, feedback.pose)

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

    :param number: of the camera, from 0.
    :param pose: of the camera.
    :param frame: frame of the pose. RViz returns poses in this frame too, since the stamp is 0.
    """
    # A control moves along and rotates about its own x axis. Rotations of 90 degrees about x, y
    # and z make this axis parallel to x, z and y. In the quaternion of such a rotation, w and the
    # component of the axis are the root of 0.5. A control is named after this axis of rotation.
    half_root = 0.5 ** 0.5
    controls = [InteractiveMarkerControl(name=f'{axis}_{mode}', interaction_mode=mode,
                                         orientation=Quaternion(w=half_root, **{axis: half_root}))
                for axis in 'xyz' for mode in (InteractiveMarkerControl.MOVE_AXIS,
                                               InteractiveMarkerControl.ROTATE_AXIS)]
    return InteractiveMarker(header=Header(frame_id=frame), pose=pose, name=name_of(number),
                             description=name_of(number), scale=0.6, controls=controls)
