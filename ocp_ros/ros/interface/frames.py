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
    positions_to_msg,
    rotation_of,
    stamp_to_ns,
)
from ocp_ros.ros.interface.qos import LATCHED, LOOP
from ocp_ros.util.settings import setting
from rclpy.node import Node
from rclpy.time import Time
from std_msgs.msg import Header

#: Names of the camera frames with the camera's index among the poses: body (x forward, y left, z
#: up) and optical (z forward, x right, y down), as in REP-103.
CAMERA_FRAME = re.compile(r'camera_([0-9]{1,4})(_optical)?')


class LateTransformError(MessageError):
    """A transform is older than the arrival of the cameras: a newer one may still come."""


class LiveRig(NamedTuple):
    """
    Poses of cameras that stand still.

    :ivar frame: of the poses, usually ``map``.
    :ivar poses: one per camera.
    :ivar since: stamp in nanoseconds since which the cameras have been standing there.
    """

    frame: str
    poses: list[Pose]
    since: int = 0

    @property
    def positions(self) -> np.ndarray:
        """Return the positions of the cameras: (K, 3) float64, metres."""
        return np.array([pose.position for pose in self.poses])


class Sighting(NamedTuple):
    """
    The newest clouds of live cameras, with the reported poses of the cameras.

    :ivar rig: the poses.
    :ivar clouds: (N, 3) metres, body frame, by the number of the camera.
    """

    rig: LiveRig
    clouds: Mapping[int, np.ndarray]


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

    def forget(self) -> None:
        """Drop all transforms that are not static: the clock of their stamps has been set."""
        if self._buffer is not None:
            self._buffer.clear()

    def knows(self, frame: str, parent: str) -> bool:
        """Return whether a transform from a frame to a parent frame is known."""
        return self._buffer is not None and self._buffer.can_transform(parent, frame, Time())

    def pose(self, frame: str, rig: LiveRig) -> Pose:
        """
        Look up the pose of a frame in the frame of the rig.

        The newest transform is taken, not the one at the stamp of a cloud: transforms may arrive
        later than clouds, and cameras stand still while their clouds are used.

        :raises MessageError: if there is no transform, none newer than the arrival of the cameras
            (:class:`LateTransformError`), or one that is not finite.
        """
        expected = (f'expected {rig.frame!r}, camera_<i> or camera_<i>_optical with i from 0 to '
                    f'{len(rig.poses) - 1}, or one that tf2 takes to {rig.frame!r}')
        if self._buffer is None:
            raise MessageError(f"cloud: found the frame {frame!r}; {expected}; set the driver's "
                               'frame, or install tf2_ros')
        try:
            found = self._buffer.lookup_transform(rig.frame.lstrip('/'), frame, Time())
        except self._error as error:
            raise MessageError(f'cloud: found the frame {frame!r} ({error}); {expected}; publish '
                               'its transform') from error
        stamp, move = stamp_to_ns(found.header.stamp), found.transform
        # Static transforms have the stamp 0.
        if 0 < stamp < rig.since:
            raise LateTransformError(
                f'cloud: found the frame {frame!r} with a transform '
                f'{(rig.since - stamp) * 1e-9:.3f} s older than the poses; expected one since the '
                'cameras stand; publish it as often as the poses')
        position = np.array([move.translation.x, move.translation.y, move.translation.z])
        if not np.isfinite(position).all():
            raise MessageError(f'cloud: found the frame {frame!r} at {position.tolist()}; '
                               'expected finite metres; mend its transform')
        return Pose(position, rotation_of(move.rotation, f'transform of {frame!r}'))


def publish_tf() -> Any:
    """Declare the setting ``publish_tf`` of nodes that publish camera poses."""
    return setting(True, 'publish camera_<i>, camera_<i>_link and camera_<i>_optical on /tf and '
                         '/tf_static, where tf2_msgs is installed')


class CameraFrames:
    """
    Publish the frames of cameras on tf; publish nothing if tf2_msgs is not installed.

    ``camera_<i>`` is the body frame of camera i; its parent is the frame of the poses. On
    ``/tf_static`` its children ``camera_<i>_optical`` and ``camera_<i>_link`` are published. The
    latter equals the body frame and is named as most drivers name their root frame.

    :param node: gets the publishers.
    :param wanted: the parameter ``publish_tf``.
    :param taken: returns whether another node already publishes a frame in its parent.
    """

    def __init__(self, node: Node, wanted: bool, taken: Callable[[str, str], bool]) -> None:
        self._message = None
        if not wanted:
            return
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            return
        self._message = TFMessage
        self._taken = taken
        self._log = node.get_logger()
        self._moving = node.create_publisher(TFMessage, '/tf', LOOP)
        self._static = node.create_publisher(TFMessage, '/tf_static', LATCHED)
        self._cameras = 0
        self._published = frozenset[int]()

    def publish(self, header: Header, poses: Sequence[Pose]) -> None:
        """
        Publish the poses of cameras; stamps have to increase.

        :param header: stamp and frame of the poses.
        """
        if self._message is None:
            return
        if len(poses) != self._cameras:
            self._begin(header, len(poses))
        self._moving.publish(self._message(transforms=[
            transform(header, f'camera_{camera}', poses[camera])
            for camera in sorted(self._published)]))

    def _begin(self, header: Header, cameras: int) -> None:
        """Publish the static frames of all cameras whose frames no other node publishes."""
        parent = header.frame_id.lstrip('/')
        others = {camera for camera in range(cameras) if camera not in self._published
                  and self._taken(f'camera_{camera}', parent)}
        if others:
            self._log.info(f'publish_tf: another node publishes {len(others)} of the '
                           f'{cameras} frames camera_<i>; these are left to it')
        self._cameras = cameras
        self._published = frozenset(range(cameras)) - others
        own, body = np.zeros(3), np.eye(3)
        self._static.publish(self._message(transforms=[
            transform(Header(stamp=header.stamp, frame_id=f'camera_{camera}'),
                      f'camera_{camera}_{name}', Pose(own, rotation))
            for camera in sorted(self._published)
            for name, rotation in (('link', body), ('optical', OPTICAL_TO_BODY))]))


def transform(header: Header, child: str, pose: Pose) -> TransformStamped:
    """Return the transform message of a child frame, by its pose in the parent frame."""
    row = positions_to_msg(pose.position[None], header, heading_of(pose.rotation)[None]).poses[0]
    at = row.position
    return TransformStamped(
        header=Header(stamp=header.stamp, frame_id=header.frame_id.lstrip('/')),
        child_frame_id=child,
        transform=Transform(translation=Vector3(x=at.x, y=at.y, z=at.z), rotation=row.orientation))


def placed(points: np.ndarray, frame: str, rig: LiveRig, transforms: Transforms
           ) -> tuple[np.ndarray, np.ndarray]:
    """
    Transform a cloud into the frame of the poses.

    Points exactly at the origin of their frame mean "no return" and are left out. A frame of tf2
    at the position of a camera counts as that camera's frame. For any other frame it is unknown
    which camera observed the points: then all cameras are returned.

    :param points: (N, 3) float32, metres, in ``frame``.
    :returns: the points, (M, 3) float32, metres, in the frame of the poses, M <= N, and (C, 3)
        metres, the positions of the cameras that may have observed them.
    :raises MessageError: if the pose of the frame is unknown, or the points have other axes.
    """
    points = points[points.any(axis=1)]
    # Remove the leading slash, which frames of ROS 1 may have.
    frame = frame.lstrip('/')
    if frame == rig.frame.lstrip('/'):
        return points, rig.positions
    found, seen_from = CAMERA_FRAME.fullmatch(frame), rig.positions
    if found is None or int(found[1]) >= len(rig.poses):
        pose = transforms.pose(frame, rig)
        # A frame of tf2 within 0.3 m of a camera is that camera's frame.
        if np.linalg.norm(rig.positions - pose.position, axis=1).min() <= 0.3:
            seen_from = pose.position[None]
    else:
        pose = rig.poses[int(found[1])]
        seen_from = pose.position[None]
        _check_axes(points, frame, bool(found[2]))
        if found[2]:
            pose = Pose(pose.position, pose.rotation @ OPTICAL_TO_BODY)
    # Points too far away for float32 are out of range in any case.
    with np.errstate(over='ignore', invalid='ignore'):
        moved = points @ pose.rotation.T.astype(np.float32) + pose.position.astype(np.float32)
    return moved, seen_from


def _check_axes(points: np.ndarray, frame: str, optical: bool) -> None:
    """Refuse points that lie ahead of the camera only in the other convention of axes."""
    # Fewer points show nothing.
    if len(points) < 100:
        return
    least = 0.4 * np.linalg.norm(points.astype(np.float64), axis=1)
    ahead = [np.mean(points[:, axis] > least) for axis in (0, 2)]
    nearly_all = 0.999
    if ahead[not optical] < nearly_all or ahead[optical] >= nearly_all:
        return
    found, expected = ('x forward (body axes)', 'z') if optical else ('z forward (optical axes)',
                                                                      'x')
    other = frame.removesuffix('_optical') + ('' if optical else '_optical')
    raise MessageError(f'cloud: found points with {found} in the frame {frame!r}; expected them '
                       f'with {expected} forward; name the frame {other!r}')


def in_range(points: np.ndarray, cameras: np.ndarray, low: float, high: float) -> np.ndarray:
    """
    Keep the points whose distance to the nearest camera is within a range.

    :param points: (N, 3) float32, metres.
    :param cameras: (C, 3) metres, same frame.
    :param low: least distance, metres.
    :param high: largest distance, metres.
    :returns: (M, 3) float32, all finite, M <= N.
    """
    nearest = np.full(len(points), np.inf, dtype=np.float32)
    with np.errstate(over='ignore', invalid='ignore'):
        for camera in cameras.astype(np.float32):
            away = points - camera
            nearest = np.fmin(nearest, np.einsum('ij,ij->i', away, away))
    keep = (nearest >= low * low) & (nearest <= high * high)
    return points if keep.all() else points[keep]


def in_body(points: np.ndarray, pose: Pose) -> np.ndarray:
    """Transform points (N, 3) from the frame of a pose to the body frame of its camera."""
    return (points - pose.position) @ pose.rotation
