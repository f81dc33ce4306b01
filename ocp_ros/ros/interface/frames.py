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

"""Frames of cameras: where their clouds are in the frame of the poses, and tf for others."""

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

#: Frames of the cameras by their place among the poses: body (x forward, y left, z up) and
#: optical (z forward, x right, y down), as REP-103 has them.
SENSOR = re.compile(r'camera_([0-9]{1,4})(_optical)?')
#: Fewer points than these tell nothing of their axes; the least part of a point's distance that is
#: along the way ahead, and the share of the points of which that is so.
FEW, ALONG, NEARLY_ALL = 100, 0.4, 0.999
#: Metres from a camera within which a frame that tf2 knows is taken to be that camera's own.
OWN = 0.3


class LateTransformError(MessageError):
    """A transform is older than the arrival of the cameras: a newer one may be on its way."""


class LiveRig(NamedTuple):
    """
    Where cameras stand.

    :ivar frame: of the poses, usually ``map``.
    :ivar poses: one per camera.
    :ivar since: stamp in nanoseconds from which on they have been standing there.
    """

    frame: str
    poses: list[Pose]
    since: int = 0

    @property
    def positions(self) -> np.ndarray:
        """Return where the cameras are: (K, 3) float64, metres."""
        return np.array([pose.position for pose in self.poses])


class Sighting(NamedTuple):
    """
    What live cameras see, and from where they are said to see it.

    :ivar rig: their poses.
    :ivar clouds: (N, 3) metres, body frame, by the number of the camera.
    """

    rig: LiveRig
    clouds: Mapping[int, np.ndarray]


class Transforms:
    """
    What tf2 knows of frames, where it is installed: without it nothing.

    :param node: listens to ``/tf`` and ``/tf_static``.
    """

    def __init__(self, node: Node) -> None:
        try:
            import tf2_ros
        except ImportError:
            self._buffer = None
            return
        self._error, self._buffer = tf2_ros.TransformException, tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)

    def forget(self) -> None:
        """Forget what is not static: its stamps are those of a clock that has been set."""
        if self._buffer is not None:
            self._buffer.clear()

    def knows(self, frame: str, parent: str) -> bool:
        """Return whether any node publishes where a frame is in another."""
        return self._buffer is not None and self._buffer.can_transform(parent, frame, Time())

    def pose(self, frame: str, rig: LiveRig) -> Pose:
        """
        Look up where a frame is in that of the rig.

        The newest transform is taken, not that of a cloud's stamp, which transforms reach later
        than clouds do: cameras whose clouds count stand still.

        :raises MessageError: if nobody knows, or nothing newer than the arrival of the cameras.
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
    """Declare the setting of nodes that show where cameras are."""
    return setting(True, 'publish camera_<i>, camera_<i>_link and camera_<i>_optical on /tf and '
                         '/tf_static, where tf2_msgs is installed')


class CameraFrames:
    """
    Publish the frames of cameras for others, where tf2_msgs is installed: without it nothing.

    ``camera_<i>`` is the body of camera i in the frame of the poses. In it stand, by
    ``/tf_static``, ``camera_<i>_optical`` and ``camera_<i>_link``: the latter is the body again,
    by the name that the frames of most drivers begin with.

    :param node: publishes.
    :param wanted: the parameter ``publish_tf``.
    :param taken: returns whether another node publishes a frame in its parent already.
    """

    def __init__(self, node: Node, wanted: bool, taken: Callable[[str, str], bool]) -> None:
        self._message = None
        if not wanted:
            return
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            return
        self._message, self._taken, self._log = TFMessage, taken, node.get_logger()
        self._moving = node.create_publisher(TFMessage, '/tf', LOOP)
        self._static = node.create_publisher(TFMessage, '/tf_static', LATCHED)
        self._cameras, self._published = 0, frozenset[int]()

    def publish(self, header: Header, poses: Sequence[Pose]) -> None:
        """
        Publish where cameras are; stamps have to rise.

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
        """Publish the static frames of a number of cameras."""
        parent = header.frame_id.lstrip('/')
        others = {camera for camera in range(cameras) if camera not in self._published
                  and self._taken(f'camera_{camera}', parent)}
        if others:
            self._log.info(f'publish_tf: another node publishes {len(others)} of the '
                           f'{cameras} frames camera_<i>; these are left to it')
        self._cameras, self._published = cameras, frozenset(range(cameras)) - others
        own, body = np.zeros(3), np.eye(3)
        self._static.publish(self._message(transforms=[
            transform(Header(stamp=header.stamp, frame_id=f'camera_{camera}'),
                      f'camera_{camera}_{name}', Pose(own, rotation))
            for camera in sorted(self._published)
            for name, rotation in (('link', body), ('optical', OPTICAL_TO_BODY))]))


def transform(header: Header, child: str, pose: Pose) -> TransformStamped:
    """Return the transform from a frame to a child that has a pose in it."""
    row = positions_to_msg(pose.position[None], header, heading_of(pose.rotation)[None]).poses[0]
    at = row.position
    return TransformStamped(
        header=Header(stamp=header.stamp, frame_id=header.frame_id.lstrip('/')),
        child_frame_id=child,
        transform=Transform(translation=Vector3(x=at.x, y=at.y, z=at.z), rotation=row.orientation))


def placed(points: np.ndarray, frame: str, rig: LiveRig, transforms: Transforms
           ) -> tuple[np.ndarray, np.ndarray]:
    """
    Take a cloud into the frame of the poses.

    Points in the very origin of their frame are a sensor's word for "no return". A frame of tf2
    that is at a camera is that camera's; who has seen the points of any other, nobody knows.

    :param points: (N, 3) float32, metres, in ``frame``.
    :returns: (M, 3) float32, metres, in the frame of the poses, M <= N, and (C, 3) metres, where
        the cameras are that may have seen them.
    :raises MessageError: if nobody knows where the frame is.
    """
    points = points[points.any(axis=1)]
    # As in ROS 1.
    frame = frame.lstrip('/')
    if frame == rig.frame.lstrip('/'):
        return points, rig.positions
    found, seen_from = SENSOR.fullmatch(frame), rig.positions
    if found is None or int(found[1]) >= len(rig.poses):
        pose = transforms.pose(frame, rig)
        if np.linalg.norm(rig.positions - pose.position, axis=1).min() <= OWN:
            seen_from = pose.position[None]
    else:
        pose = rig.poses[int(found[1])]
        seen_from = pose.position[None]
        _check_axes(points, frame, bool(found[2]))
        if found[2]:
            pose = Pose(pose.position, pose.rotation @ OPTICAL_TO_BODY)
    # What is too far out for float32 is out of range in any case.
    with np.errstate(over='ignore', invalid='ignore'):
        moved = points @ pose.rotation.T.astype(np.float32) + pose.position.astype(np.float32)
    return moved, seen_from


def _check_axes(points: np.ndarray, frame: str, optical: bool) -> None:
    """Refuse points of a camera that all lie ahead by the other convention of axes."""
    if len(points) < FEW:
        return
    least = ALONG * np.linalg.norm(points.astype(np.float64), axis=1)
    ahead = [np.mean(points[:, axis] > least) for axis in (0, 2)]
    if ahead[not optical] < NEARLY_ALL or ahead[optical] >= NEARLY_ALL:
        return
    found, expected = ('x forward (body axes)', 'z') if optical else ('z forward (optical axes)',
                                                                      'x')
    other = frame.removesuffix('_optical') + ('' if optical else '_optical')
    raise MessageError(f'cloud: found points with {found} in the frame {frame!r}; expected them '
                       f'with {expected} forward; name the frame {other!r}')


def in_range(points: np.ndarray, cameras: np.ndarray, low: float, high: float) -> np.ndarray:
    """
    Keep the points whose nearest camera is neither too near nor too far.

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
    """Return points (N, 3) of the frame of a pose in that of the camera's body."""
    return (points - pose.position) @ pose.rotation
