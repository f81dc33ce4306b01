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
from typing import Any, NamedTuple

from geometry_msgs.msg import Point, Vector3
import numpy as np
from ocp_ros.geometry.cameras import CameraModel, PINHOLE, Pose
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.packed_bits import unpack
from ocp_ros.online.partial_map import thinned
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import value_cloud
from ocp_ros.ros.interface.qos import LATCHED
from ocp_ros.ros.runtime.managed_node import create_steady_timer
from ocp_ros.scenes.scene import Scene
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from rclpy.event_handler import PublisherEventCallbacks, QoSPublisherMatchedInfo
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, PointCloud2
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

#: Colours by the namespace of the markers.
COLOURS = {'cameras': ColorRGBA(r=0.84, g=0.15, b=0.16, a=1.0),
           'trajectories': ColorRGBA(r=1.0, g=1.0, b=1.0, a=0.9),
           'ranges': ColorRGBA(r=0.4, g=0.65, b=1.0, a=0.08),
           'frusta': ColorRGBA(r=0.4, g=0.65, b=1.0, a=0.8),
           'moves': ColorRGBA(r=1.0, g=0.75, b=0.1, a=1.0)}


class RigView:
    """
    Show a rig: markers, and a CameraInfo for each pinhole camera.

    :param node: gets the publishers.
    :param topic: topic of the markers.
    :param models: one camera model per camera, or the single model of all cameras if it is
        omnidirectional.
    :param frame_prefix: prefix of the names of the camera frames.
    """

    def __init__(self, node: Node, topic: str, models: Sequence[CameraModel],
                 frame_prefix: str = '') -> None:
        self.models = models
        self._node = node
        self._frame_prefix = frame_prefix
        self._header = Header()
        self._poses: list[Pose] = []
        #: Positions of the K cameras, (K, 3) metres, at each time at which any has moved.
        self._trajectories: list[np.ndarray] = []
        self._publishers = [LazyPublisher(node, MarkerArray, topic, self._markers)]
        for camera, model in enumerate(models):
            # Leave out cameras that have no CameraInfo.
            if camera_info(model, Header()) is not None:
                self._publishers.append(LazyPublisher(
                    node, CameraInfo, topics.camera_info_topic(camera),
                    partial(self._camera_info_message, camera, model)))

    def clear_trajectories(self) -> None:
        """Clear the trajectories of the cameras."""
        self._trajectories.clear()

    def show_turn(self, header: Header, poses: list[Pose]) -> None:
        """Show the poses of the cameras in a turn; the header has their stamp and frame."""
        self._header = header
        self._poses = poses
        positions = np.array([pose.position for pose in poses])
        # With another number of cameras the trajectories begin again.
        if self._trajectories and self._trajectories[-1].shape != positions.shape:
            self._trajectories.clear()
        # A millimetre of movement adds a point to each trajectory.
        if not self._trajectories or np.abs(positions - self._trajectories[-1]).max() > 0.001:
            self._trajectories.append(positions)
        # Every second point of longer trajectories is dropped, but never the last.
        if len(self._trajectories) > 2000:
            self._trajectories = self._trajectories[::2] + self._trajectories[-1:]
        for publisher in self._publishers:
            publisher.publish_latest()

    def _markers(self) -> MarkerArray | None:
        """Return the markers of the rig; None before the first turn."""
        if not self._poses:
            return None
        return rig_markers(np.array(self._trajectories), self._poses, self.models, self._header)

    def _camera_info_message(self, camera: int, model: CameraModel) -> CameraInfo | None:
        """Return the CameraInfo of a camera; None before the first turn, or if a driver has it."""
        if not self._poses or self._node.count_publishers(topics.camera_info_topic(camera)) > 1:
            return None
        return camera_info(model, Header(stamp=self._header.stamp,
                                         frame_id=f'{self._frame_prefix}camera_{camera}_optical'))


class PointMaps(NamedTuple):
    """
    The number of cameras and the error at each point.

    :ivar points: (N, 3) float32, metres, map frame: the N points of the scene.
    :ivar count: (N,) int64, the number of cameras that see each point.
    :ivar error: (N,) float64, metres, the contribution of each point to the depth error; the sum
        is the depth error.
    """

    points: np.ndarray
    count: np.ndarray
    error: np.ndarray


def maps_of(simulator: Simulator, poses: Sequence[Pose]) -> PointMaps:
    """
    Compute the maps of a placement.

    :param simulator: the engine for the room; its model k belongs to camera k, or its only model
        to all cameras.
    :param poses: the poses of K cameras, K >= 1.
    """
    views = [simulator.look(pose, camera) for camera, pose in enumerate(poses)]
    order = simulator.visibility.order
    count, error = np.empty(len(order), dtype=np.int64), np.empty(len(order))
    # Views are in the engine's order; the maps are in the order of the scene.
    count[order] = np.sum([unpack(view.seen, len(order)) for view in views], axis=0)
    error[order] = simulator.depth_error.error_by_point(
        np.bitwise_or.reduce([view.seen for view in views]))
    return PointMaps(simulator.scene.points, count, error)


class CloudView:
    """
    Show the coverage and the depth error of the cameras as two clouds.

    :param node: gets the publishers.
    :param coverage_topic: topic of the points with the field ``count``: the number of cameras that
        see each point.
    :param error_topic: topic of the points that have a depth error, with the field ``error``: this
        error in metres. The sum over all points is the depth error of the rig.
    :param evaluate: returns the maps of coverage and error in the latest turn, or None if they
        cannot be computed.
    """

    def __init__(self, node: Node, coverage_topic: str, error_topic: str,
                 evaluate: Callable[[], PointMaps | None]) -> None:
        self._evaluate = evaluate
        #: The maps of the latest turn; None until they are computed.
        self._maps: PointMaps | None = None
        self._header = Header()
        self._publishers = [LazyPublisher(node, PointCloud2, coverage_topic, self._coverage_cloud),
                            LazyPublisher(node, PointCloud2, error_topic, self._error_cloud)]
        # The timer publishes once the present callback, which may answer a turn, has ended.
        self._update_timer = create_steady_timer(node, 1e-3, self._update)
        self._update_timer.cancel()

    def show_turn(self, header: Header) -> None:
        """Show a turn, once the present callback has ended."""
        self._header = header
        self._maps = None
        if any(publisher.has_subscribers for publisher in self._publishers):
            self._update_timer.reset()

    def _update(self) -> None:
        """Publish the clouds that have subscribers."""
        self._update_timer.cancel()
        for publisher in self._publishers:
            publisher.publish_latest()

    def _latest_maps(self) -> PointMaps | None:
        """Return the maps of the latest turn, computed once; None if they cannot be computed."""
        if self._maps is None:
            self._maps = self._evaluate()
        return self._maps

    def _coverage_cloud(self) -> PointCloud2 | None:
        """Return the cloud with the number of cameras that see each point."""
        if (maps := self._latest_maps()) is None:
            return None
        return value_cloud(maps.points, 'count', maps.count.astype(np.uint32), self._header)

    def _error_cloud(self) -> PointCloud2 | None:
        """Return the cloud of the points that have a depth error, with this error."""
        if (maps := self._latest_maps()) is None:
            return None
        has_error = maps.error > 0.0
        return value_cloud(maps.points[has_error], 'error',
                           maps.error[has_error].astype(np.float32), self._header)


def rig_markers(trajectories: np.ndarray, poses: Sequence[Pose], models: Sequence[CameraModel],
                header: Header) -> MarkerArray:
    """
    Return the markers of a rig: position, trajectory and field of view of each camera.

    The field of view is a frustum for a pinhole camera, and a sphere of its range for others.

    :param trajectories: (T, K, 3), metres: positions of K cameras at T times, the present last.
    :param poses: K present poses.
    :param models: one camera model per camera, or a single model for all cameras.
    :param header: stamp of the markers, and frame of the positions and poses.
    """
    markers = []
    for camera, pose in enumerate(poses):
        model = models[camera if len(models) > 1 else 0]
        trajectory = _point_messages(trajectories[:, camera])
        markers.append(_sphere_marker(header, 'cameras', camera, trajectory[-1], diameter=0.2))
        if model.lens.kind == PINHOLE:
            markers.append(_line_marker(header, 'frusta', camera, Marker.LINE_LIST, width=0.015,
                                        points=_point_messages(frustum_edges(pose, model))))
        else:
            markers.append(_sphere_marker(header, 'ranges', camera, trajectory[-1],
                                          diameter=2.0 * model.max_range))
        markers.append(_line_marker(header, 'trajectories', camera, Marker.LINE_STRIP, width=0.03,
                                    points=trajectory))
    return MarkerArray(markers=markers)


def frustum_edges(pose: Pose, model: CameraModel) -> np.ndarray:
    """
    Return the edges of a viewing pyramid; its corners are at the maximum range of the camera.

    :param model: a pinhole camera.
    :returns: (16, 3) metres, in the frame of the pose: the two ends of each of eight edges, four
        from the camera and four of the base.
    """
    lens = model.lens
    # The lens of a pinhole camera has tangents of half its field of view: these corners, in their
    # order around the base, are 1 m ahead.
    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]], dtype=np.float64)
    corners = np.column_stack([np.ones(4), signs * [lens.half_horizontal, lens.half_vertical]])
    corners *= model.max_range / np.linalg.norm(corners, axis=1, keepdims=True)
    corners = corners @ pose.rotation.T + pose.position
    edges = [(pose.position, corner) for corner in corners]
    edges += list(zip(corners, np.roll(corners, -1, axis=0)))
    return np.array(edges).reshape(-1, 3)


def move_markers(positions: np.ndarray, targets: np.ndarray, moving: np.ndarray, header: Header
                 ) -> MarkerArray:
    """
    Return an arrow for each camera that is to be moved, and delete the arrows of the others.

    :param positions: (K, 3) metres, present positions.
    :param targets: (K, 3) metres, target positions.
    :param moving: (K,) bool, whether each camera is to be moved.
    :param header: stamp of the markers, and frame of the positions.
    """
    markers = []
    for camera, moves in enumerate(moving):
        # The scale has the diameters of shaft and head, and the length of the head.
        arrow = Marker(header=header, ns='moves', id=camera, type=Marker.ARROW,
                       action=Marker.ADD if moves else Marker.DELETE,
                       scale=Vector3(x=0.04, y=0.1, z=0.1), color=COLOURS['moves'],
                       points=_point_messages(np.array([positions[camera], targets[camera]])))
        arrow.pose.orientation.w = 1.0
        markers.append(arrow)
    return MarkerArray(markers=markers)


def _point_messages(positions: np.ndarray) -> list[Point]:
    """Return positions, (N, 3) metres, as messages."""
    return [Point(x=float(x), y=float(y), z=float(z)) for x, y, z in positions]


def _line_marker(header: Header, namespace: str, marker_id: int, line_type: int, width: float,
                 points: list[Point]) -> Marker:
    """Return a marker of lines; with less than two points, one that deletes the old lines."""
    # RViz would warn about a line of one point.
    marker = Marker(header=header, ns=namespace, id=marker_id, type=line_type,
                    action=Marker.ADD if len(points) > 1 else Marker.DELETE,
                    scale=Vector3(x=width), color=COLOURS[namespace], points=points)
    marker.pose.orientation.w = 1.0
    return marker


def _sphere_marker(header: Header, namespace: str, marker_id: int, centre: Point, diameter: float
                   ) -> Marker:
    """Return a marker of a sphere; the diameter is in metres."""
    sphere = Marker(header=header, ns=namespace, id=marker_id, type=Marker.SPHERE,
                    action=Marker.ADD, color=COLOURS[namespace],
                    scale=Vector3(x=diameter, y=diameter, z=diameter))
    sphere.pose.position = centre
    sphere.pose.orientation.w = 1.0
    return sphere


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


def camera_info(model: CameraModel, header: Header) -> CameraInfo | None:
    """
    Return the CameraInfo of a camera without distortion, its optical axis in the image centre.

    :param header: has the optical frame of the camera: z forward, x right, y down.
    :returns: None for a camera that is no pinhole camera, or has an unknown resolution.
    """
    if model.lens.kind != PINHOLE or model.resolution is None:
        return None
    width, height = model.resolution
    # The lens of a pinhole camera has tangents of half its field of view.
    fx = 0.5 * width / float(model.lens.half_horizontal)
    fy = 0.5 * height / float(model.lens.half_vertical)
    # The first pixel has its centre at 0 and the last one at size - 1: the centre of the image is
    # between them.
    cx, cy = 0.5 * (width - 1), 0.5 * (height - 1)
    return CameraInfo(header=header, width=width, height=height, distortion_model='plumb_bob',
                      d=[0.0] * 5, k=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
                      r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
                      p=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0])


class LazyPublisher:
    """
    Publish the latest state (latched) while there are subscribers, also for late subscribers.

    :param node: gets the publisher.
    :param message_type: type of the messages.
    :param topic: topic of the messages.
    :param make_message: returns the message of the latest state, or None while there is no state.
    """

    def __init__(self, node: Node, message_type: type, topic: str,
                 make_message: Callable[[], Any]) -> None:
        self._make_message = make_message
        #: Number of messages that were made.
        self.messages_made = 0
        self._publisher = node.create_publisher(
            message_type, topic, LATCHED,
            event_callbacks=PublisherEventCallbacks(matched=self._on_matched))

    @property
    def has_subscribers(self) -> bool:
        """Return whether there is a subscriber."""
        return self._publisher.get_subscription_count() > 0

    def publish_latest(self) -> None:
        """Publish the latest state if there is a subscriber."""
        if self.has_subscribers and (message := self._make_message()) is not None:
            self.messages_made += 1
            self._publisher.publish(message)

    def _on_matched(self, info: QoSPublisherMatchedInfo) -> None:
        """Publish the latest state for a new subscriber."""
        if info.current_count_change > 0:
            self.publish_latest()
