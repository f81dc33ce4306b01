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

"""
Views of the rig: markers, and clouds of its coverage and its depth error.

They are computed only while they have subscribers, and after the turn: no answer waits for them.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, PINHOLE, Pose
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import cloud_with
from ocp_ros.ros.interface.markers import rig_markers
from ocp_ros.ros.interface.qos import LATCHED
from ocp_ros.simulation.point_maps import PointMaps
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import PublisherEventCallbacks, QoSPublisherMatchedInfo
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray


class RigView:
    """
    Show a rig: markers, and a CameraInfo for each pinhole camera.

    :param node: gets the publishers.
    :param topic: of the markers.
    :param models: one camera model per camera, or one for all.
    :param cameras: number of cameras for which a CameraInfo is published.
    """

    def __init__(self, node: Node, topic: str, models: Sequence[CameraModel], cameras: int
                 ) -> None:
        self.models = models
        self._header = Header()
        self._poses: list[Pose] = []
        self._way: list[np.ndarray] = []
        self._views = [OnDemand(node, MarkerArray, topic, self._markers)]
        for camera in range(cameras):
            model = models[camera if len(models) > 1 else 0]
            if camera_info(model, Header()) is not None:
                self._views.append(OnDemand(node, CameraInfo, topics.camera_info(camera),
                                            partial(self._info, camera, model)))

    def forget(self) -> None:
        """Clear the trajectories of the cameras."""
        self._way.clear()

    def turn(self, header: Header, poses: list[Pose]) -> None:
        """Show the poses of the cameras in a turn."""
        self._header, self._poses = header, poses
        now = np.array([pose.position for pose in poses])
        if self._way and self._way[-1].shape != now.shape:
            self._way.clear()
        # A millimetre of movement makes a new row of the trajectories.
        if not self._way or np.abs(now - self._way[-1]).max() > 0.001:
            self._way.append(now)
        # Every second row of longer trajectories is dropped.
        if len(self._way) > 2000:
            self._way = self._way[::2] + self._way[-1:]
        for view in self._views:
            view.update()

    def _markers(self) -> MarkerArray | None:
        """Draw the rig."""
        if not self._poses:
            return None
        return rig_markers(np.array(self._way), self._poses, self.models, self._header)

    def _info(self, camera: int, model: CameraModel) -> CameraInfo | None:
        """Describe a camera."""
        if not self._poses:
            return None
        return camera_info(model, Header(stamp=self._header.stamp,
                                         frame_id=f'camera_{camera}_optical'))


class CloudView:
    """
    Show the coverage and the depth error of the cameras as two clouds.

    :param node: gets the publishers.
    :param coverage: topic of the points with ``count``: the number of cameras that see each point.
    :param error: topic of the points with a depth error, in the field ``error``: metres; their sum
        is the depth error.
    :param judge: computes both for the latest turn; returns None if this is not possible.
    """

    def __init__(self, node: Node, coverage: str, error: str, judge: Callable[[], PointMaps | None]
                 ) -> None:
        self._judge = judge
        self._maps: PointMaps | None = None
        self._header = Header()
        self._views = [OnDemand(node, PointCloud2, coverage, self._coverage),
                       OnDemand(node, PointCloud2, error, self._error)]
        # The timer publishes after the present callback has ended, which may answer a turn.
        self._soon = node.create_timer(
            1e-3, self._update, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._soon.cancel()

    def turn(self, header: Header) -> None:
        """Show a turn after the present callback has ended."""
        self._header = header
        self._maps = None
        if any(view.wanted for view in self._views):
            self._soon.reset()

    def _update(self) -> None:
        """Publish the clouds that have subscribers."""
        self._soon.cancel()
        for view in self._views:
            view.update()

    def _known(self) -> PointMaps | None:
        """Return the maps of the latest turn; compute them once."""
        if self._maps is None:
            self._maps = self._judge()
        return self._maps

    def _coverage(self) -> PointCloud2 | None:
        """Return the cloud of the number of cameras that see each point."""
        if (maps := self._known()) is None:
            return None
        return cloud_with(maps.points, 'count', maps.count.astype(np.uint32), self._header)

    def _error(self) -> PointCloud2 | None:
        """Return the cloud of the points with a depth error."""
        if (maps := self._known()) is None:
            return None
        lost = maps.error > 0.0
        return cloud_with(maps.points[lost], 'error', maps.error[lost].astype(np.float32),
                          self._header)


def camera_info(model: CameraModel, header: Header) -> CameraInfo | None:
    """
    Describe a camera without distortion whose optical axis is in the middle of its image.

    :param header: its frame is the optical frame of the camera: z forward, x right, y down.
    :returns: None for a camera that is no pinhole camera, or of unknown resolution.
    """
    if model.lens.kind != PINHOLE or model.resolution is None:
        return None
    width, height = model.resolution
    fx = 0.5 * width / float(model.lens.half_horizontal)
    fy = 0.5 * height / float(model.lens.half_vertical)
    cx, cy = 0.5 * (width - 1), 0.5 * (height - 1)
    return CameraInfo(
        header=header, width=width, height=height, distortion_model='plumb_bob', d=[0.0] * 5,
        k=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0])


class OnDemand:
    """
    Publish the latest state, latched, while there are subscribers, also for late subscribers.

    :param node: gets the publisher.
    :param kind: type of the messages.
    :param topic: their topic.
    :param make: makes the message of the latest state; returns None while there is no state.
    """

    def __init__(self, node: Node, kind: type, topic: str, make: Callable[[], Any]) -> None:
        self._make = make
        #: Number of messages that were made.
        self.made = 0
        self._publisher = node.create_publisher(
            kind, topic, LATCHED,
            event_callbacks=PublisherEventCallbacks(matched=self._on_matched))

    @property
    def wanted(self) -> bool:
        """Return whether there is a subscriber."""
        return self._publisher.get_subscription_count() > 0

    def update(self) -> None:
        """Publish the latest state if there is a subscriber."""
        if self.wanted and (message := self._make()) is not None:
            self.made += 1
            self._publisher.publish(message)

    def _on_matched(self, info: QoSPublisherMatchedInfo) -> None:
        """Publish the latest state for a new subscriber."""
        if info.current_count_change > 0:
            self.update()
