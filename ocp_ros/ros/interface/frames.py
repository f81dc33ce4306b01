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

"""Frames of cameras: transform clouds into the frame of the poses, and publish tf."""

from collections.abc import Callable, Mapping, Sequence
import re
from typing import Any, NamedTuple

from geometry_msgs.msg import Transform, TransformStamped, Vector3
import numpy as np
from ocp_ros.geometry.cameras import heading_of, OPTICAL_TO_BODY, Pose
from ocp_ros.ros.interface.conversions import (
    MessageError,
    quaternion_of,
    rotation_of,
    stamp_to_ns,
)
from ocp_ros.ros.interface.qos import LATCHED, LOOP
from ocp_ros.util.settings import setting
from rclpy.node import Node
from rclpy.time import Time
from std_msgs.msg import Header

#: Names of camera frames after their prefix, with the number of the camera among the poses (four
#: digits are enough for every rig). The groups of a match are this number, and ``_optical`` or
#: None. Body frames have x forward, y left, z up; optical frames have z forward, x right, y down
#: (REP-103).
CAMERA_FRAME = re.compile(r'camera_([0-9]{1,4})(_optical)?')
#: Endings of the names of optical frames.
OPTICAL_FRAME_ENDINGS = ('optical', 'optical_frame')


class LateTransformError(MessageError):
    """A transform is older than the arrival of the cameras; a newer transform may still come."""


class LiveRig(NamedTuple):
    """
    Poses of cameras that stand still.

    :ivar frame: frame of the poses, usually ``map``.
    :ivar poses: one pose per camera.
    :ivar standing_since_ns: stamp since which the cameras have been standing there, nanoseconds;
        0 if it is unknown: then no transform counts as late.
    :ivar prefix: prefix of the names of its camera frames.
    """

    frame: str
    poses: list[Pose]
    standing_since_ns: int = 0
    prefix: str = ''

    @property
    def positions(self) -> np.ndarray:
        """Return the positions of the cameras: (K, 3) float64, metres."""
        return np.array([pose.position for pose in self.poses])

    def match_frame(self, frame: str) -> re.Match | None:
        """Match a frame as that of a camera of this rig, also without the prefix."""
        match = CAMERA_FRAME.fullmatch(frame.lstrip('/').removeprefix(self.prefix))
        return match if match and int(match[1]) < len(self.poses) else None


class CameraClouds(NamedTuple):
    """
    The newest clouds of live cameras, with the reported poses of the cameras.

    :ivar rig: the poses.
    :ivar clouds: by the number of the camera: frames, each (N, 3) metres, in the body frame of the
        camera.
    """

    rig: LiveRig
    clouds: Mapping[int, Sequence[np.ndarray]]


class Transforms:
    """
    Look up frames in tf2; if tf2 is not installed, no frame is found.

    :param node: gets the subscriptions of ``/tf`` and ``/tf_static``.
    """

    def __init__(self, node: Node) -> None:
        try:
            import tf2_ros
        except ImportError:
            self._buffer = None
            return
        self._error = tf2_ros.TransformException
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)

    def clear(self) -> None:
        """Drop all transforms that are not static, for example because a clock was set."""
        if self._buffer is not None:
            self._buffer.clear()

    @property
    def installed(self) -> bool:
        """Return whether tf2 is installed."""
        return self._buffer is not None

    def has_transform(self, frame: str, parent: str) -> bool:
        """Return whether the transform from a frame to a parent frame is known."""
        return self._buffer is not None and self._buffer.can_transform(parent, frame, Time())

    def _look_up(self, frame: str, parent: str, expected: str) -> tuple[Pose, int]:
        """
        Return the newest pose of a frame in a parent frame, and its stamp (ns; 0 if it is static).

        :param expected: what is expected, for the error.
        """
        try:
            message = self._buffer.lookup_transform(parent.lstrip('/'), frame, Time())
        except self._error as error:
            raise MessageError(f'found the frame {frame!r} ({error}); {expected}; publish its '
                               'transform') from error
        position = np.array([getattr(message.transform.translation, axis) for axis in 'xyz'])
        if not np.isfinite(position).all():
            raise MessageError(f'found the frame {frame!r} at {position.tolist()}; expected '
                               'finite metres; mend its transform')
        rotation = rotation_of(message.transform.rotation, f'transform of {frame!r}')
        return Pose(position, rotation), stamp_to_ns(message.header.stamp)

    def look_up_pose(self, frame: str, rig: LiveRig) -> Pose:
        """
        Look up the pose of a frame in the frame of the rig.

        The newest transform is taken (time 0), not the one at the stamp of a cloud: transforms may
        arrive later than clouds, and cameras stand still while their clouds are used.

        :raises LateTransformError: if the newest transform is older than the arrival of the
            cameras.
        :raises MessageError: if there is no transform, or its numbers are not finite.
        """
        expected = (f'expected {rig.frame!r}, camera_<i> or camera_<i>_optical with i from 0 to '
                    f'{len(rig.poses) - 1}, or one that tf2 takes to {rig.frame!r}')
        if not self.installed:
            raise MessageError(f"cloud: found the frame {frame!r}; {expected}; set the driver's "
                               'frame, or install tf2_ros')
        pose, stamp = self._look_up(frame, rig.frame, expected)
        if 0 < stamp < rig.standing_since_ns:
            raise LateTransformError(
                f'cloud: found the frame {frame!r} with a transform '
                f'{(rig.standing_since_ns - stamp) * 1e-9:.3f} s older than the poses; expected '
                'one since the cameras stand; publish it as often as the poses')
        return pose

    def look_up_cameras(self, frames: Sequence[str], parent: str) -> tuple[list[Pose], int]:
        """
        Look up the newest poses of cameras.

        :param frames: a frame of each camera; the axes are optical if its name ends so, otherwise
            those of the body.
        :param parent: frame of the poses.
        :returns: the poses of the bodies, and the stamp of the oldest one, nanoseconds; 0 if all
            are static.
        :raises MessageError: if there is no transform, or its numbers are not finite.
        """
        poses, stamps = [], []
        for frame in frames:
            pose, stamp = self._look_up(
                frame, parent, f'expected one that tf2 takes to {parent!r}')
            to_body = OPTICAL_TO_BODY.T if frame.endswith(OPTICAL_FRAME_ENDINGS) else np.eye(3)
            poses.append(Pose(pose.position, pose.rotation @ to_body))
            stamps.append(stamp)
        # Static transforms have the stamp 0.
        return poses, min(filter(None, stamps), default=0)


def publish_tf() -> Any:
    """Declare the setting ``publish_tf`` of nodes that publish camera poses."""
    return setting(True, 'publish camera_<i>, camera_<i>_link and camera_<i>_optical on /tf and '
                         '/tf_static, where tf2_msgs is installed')


def frame_prefix() -> Any:
    """Declare the setting ``frame_prefix`` of nodes that publish camera poses."""
    return setting('auto', 'prefix of the frames camera_<i>, so that the frames of each rig have '
                           'their own names; auto: the namespace of the node and a slash')


def find_frame_prefix(node: Node, frame_prefix: str) -> str:
    """Return the prefix of camera frames, from the setting of a node."""
    namespace = node.get_namespace().strip('/')
    return frame_prefix if frame_prefix != 'auto' else namespace and f'{namespace}/'


class CameraFrames:
    """
    Publish the frames of cameras on tf; publish nothing if tf2_msgs is not installed.

    ``camera_<i>`` is the body frame of camera i; its parent is the frame of the poses. On
    ``/tf_static`` its children ``camera_<i>_optical`` and ``camera_<i>_link`` are published. The
    latter equals the body frame and is named as most drivers name their root frame.

    :param node: gets the publishers.
    :param enabled: the parameter ``publish_tf``.
    :param prefix: prefix of the names of the frames.
    :param is_published: is called with a frame and its parent; returns whether another node
        publishes this frame already.
    """

    def __init__(self, node: Node, enabled: bool, prefix: str,
                 is_published: Callable[[str, str], bool] = lambda frame, parent: False) -> None:
        #: Type of the messages; None: publish nothing.
        self._message_type = None
        if not enabled:
            return
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            return
        self._message_type = TFMessage
        self._is_published = is_published
        self._prefix = prefix
        self._log = node.get_logger()
        self._tf_publisher = node.create_publisher(TFMessage, '/tf', LOOP)
        self._static_publisher = node.create_publisher(TFMessage, '/tf_static', LATCHED)
        #: Number of cameras when the static frames were last published; 0 before that.
        self._camera_count = 0
        #: Cameras whose frames this node publishes.
        self._own_cameras = frozenset[int]()

    def publish(self, header: Header, poses: Sequence[Pose]) -> None:
        """
        Publish the poses of cameras; stamps have to increase.

        :param header: stamp and frame of the poses.
        :param poses: body pose of camera i at index i.
        """
        if self._message_type is None:
            return
        # The static frames are latched: they are published again only if the number of cameras has
        # changed.
        if len(poses) != self._camera_count:
            self._publish_static_frames(header, len(poses))
        self._tf_publisher.publish(self._message_type(transforms=[
            transform_to_msg(header, f'{self._prefix}camera_{camera}', poses[camera])
            for camera in sorted(self._own_cameras)]))

    def _publish_static_frames(self, header: Header, camera_count: int) -> None:
        """Publish the static frames of those cameras whose frames no other node publishes."""
        parent = header.frame_id.lstrip('/')
        # ``is_published`` also finds frames that this node has published: these are not foreign.
        foreign_cameras = {camera for camera in range(camera_count)
                           if camera not in self._own_cameras
                           and self._is_published(f'{self._prefix}camera_{camera}', parent)}
        if foreign_cameras:
            self._log.info(f'publish_tf: another node publishes {len(foreign_cameras)} of the '
                           f'{camera_count} frames camera_<i>; these are left to it')
        self._camera_count = camera_count
        self._own_cameras = frozenset(range(camera_count)) - foreign_cameras
        self._static_publisher.publish(self._message_type(transforms=[
            transform_to_msg(Header(stamp=header.stamp, frame_id=body),
                             f'{body}_{name}', Pose(np.zeros(3), rotation))
            for body in (f'{self._prefix}camera_{camera}' for camera in sorted(self._own_cameras))
            for name, rotation in (('link', np.eye(3)), ('optical', OPTICAL_TO_BODY))]))


def transform_to_msg(header: Header, child_frame: str, pose: Pose) -> TransformStamped:
    """Pack the pose of a child frame in its parent frame, which is the frame of the header."""
    x, y, z = map(float, pose.position)
    return TransformStamped(
        header=Header(stamp=header.stamp, frame_id=header.frame_id.lstrip('/')),
        child_frame_id=child_frame,
        transform=Transform(translation=Vector3(x=x, y=y, z=z),
                            rotation=quaternion_of(heading_of(pose.rotation))))


def transform_cloud(points: np.ndarray, frame: str, rig: LiveRig, transforms: Transforms
                    ) -> tuple[np.ndarray, np.ndarray]:
    """
    Transform a cloud into the frame of the poses.

    Points exactly at the origin of their frame mean "no return" and are left out. A frame that
    tf2 finds within 0.3 m of a camera counts as that camera's frame. For any other frame it is
    unknown which camera observed the points: then the positions of all cameras are returned.

    :param points: (N, 3) float32, metres, in ``frame``.
    :param frame: frame of the cloud.
    :param rig: poses of the cameras.
    :returns: the M <= N points that are left, (M, 3) float32, metres, in the frame of the poses,
        and the positions of the C cameras that may have observed them, (C, 3) metres.
    :raises MessageError: if the pose of the frame is unknown, or the points lie along the axes of
        the other camera frame (body instead of optical, or the reverse).
    """
    points = points[points.any(axis=1)]
    # Remove the leading slash, which frames of ROS 1 may have.
    frame = frame.lstrip('/')
    if frame == rig.frame.lstrip('/'):
        return points, rig.positions
    camera_positions = rig.positions
    match = rig.match_frame(frame)
    if match is None:
        pose = transforms.look_up_pose(frame, rig)
        if np.linalg.norm(rig.positions - pose.position, axis=1).min() <= 0.3:
            camera_positions = pose.position[None]
    else:
        pose = rig.poses[int(match[1])]
        camera_positions = pose.position[None]
        is_optical = match[2] is not None
        _check_axes(points, frame, is_optical)
        if is_optical:
            pose = Pose(pose.position, pose.rotation @ OPTICAL_TO_BODY)
    # Points too far away for float32 become inf or NaN: they are out of range in any case.
    with np.errstate(over='ignore', invalid='ignore'):
        rotated = points @ pose.rotation.T.astype(np.float32)
        return rotated + pose.position.astype(np.float32), camera_positions


def _check_axes(points: np.ndarray, frame: str, is_optical: bool) -> None:
    """Refuse a cloud (N, 3) that lies ahead of the camera only with the other frame's axes."""
    # Less than 100 points are no evidence.
    if len(points) < 100:
        return
    # A point lies ahead if it is within 66 degrees of the axis, whose cosine is 0.4.
    least_depth = 0.4 * np.linalg.norm(points.astype(np.float64), axis=1)
    shares_ahead = {axis: np.mean(points[:, 'xyz'.index(axis)] > least_depth) for axis in 'xz'}
    # The axis that is forward in the other frame, and in this one: x in body frames, z in optical.
    wrong_axis, right_axis = 'xz' if is_optical else 'zx'
    nearly_all = 0.999
    # A cloud is refused if nearly all points lie ahead along the wrong axis, but fewer along the
    # right one.
    if shares_ahead[wrong_axis] < nearly_all or shares_ahead[right_axis] >= nearly_all:
        return
    conventions = {'x': 'body', 'z': 'optical'}
    other_frame = frame.removesuffix('_optical') + ('' if is_optical else '_optical')
    raise MessageError(f'cloud: found points with {wrong_axis} forward ({conventions[wrong_axis]} '
                       f'axes) in the frame {frame!r}; expected them with {right_axis} forward; '
                       f'name the frame {other_frame!r}')


def points_in_range(points: np.ndarray, camera_positions: np.ndarray, min_range: float,
                    max_range: float) -> np.ndarray:
    """
    Return the points whose distance to the nearest camera is within a range.

    :param points: N points, (N, 3) float32, metres.
    :param camera_positions: C cameras, (C, 3) metres, in the frame of the points.
    :param min_range: least distance, metres.
    :param max_range: largest distance, metres.
    :returns: the M <= N points in range, (M, 3) float32, all finite.
    """
    # Squared distance of each point to its nearest camera.
    nearest_squared = np.full(len(points), np.inf, dtype=np.float32)
    # Points too far away for float32 get inf or NaN; fmin ignores NaN. Their distance stays inf,
    # which is out of range.
    with np.errstate(over='ignore', invalid='ignore'):
        for camera_position in camera_positions.astype(np.float32):
            offsets = points - camera_position
            nearest_squared = np.fmin(nearest_squared, np.einsum('ij,ij->i', offsets, offsets))
    keep = (nearest_squared >= min_range * min_range) & (nearest_squared <= max_range * max_range)
    return points if keep.all() else points[keep]


def points_in_body_frame(points: np.ndarray, pose: Pose) -> np.ndarray:
    """Transform points (N, 3) from the frame of a pose to the body frame of its camera."""
    return (points - pose.position) @ pose.rotation
