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
``ocp replay``: publish the clouds of a bag, as input for ``policy_node``.

The poses of the cameras come from the command line, from recorded ``camera_poses`` or from
recorded transforms. In the first and the last case cloud topic i is camera i, and its clouds are
published in the frame ``camera_<i>``. ``policy_node`` places that frame by the poses, without tf2.
"""

from collections.abc import Iterable, Iterator
import time
from typing import Any

from geometry_msgs.msg import PoseArray, Quaternion
import numpy as np
from ocp_ros.geometry.cameras import LEVEL, OPTICAL_TO_BODY, Pose
from ocp_ros.ros.bags.bag_files import Bag, BrokenMessage, CLOUD, KINDS, Recorded, TRANSFORMS
from ocp_ros.ros.bags.replay_options import chosen_topics, ReplayOptions, TYPES
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import (
    MessageError,
    ns_to_stamp,
    positions_to_msg,
    rotation_of,
    stamp_to_ns,
)
from ocp_ros.ros.interface.frames import CAMERA_FRAME
from ocp_ros.ros.interface.qos import LOOP
from ocp_ros.util.settings import check_known, ConfigurationError
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.task import Future
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

#: Endings of the names of optical frames, in which z is forward, x right and y down.
OPTICAL_ENDS = ('optical', 'optical_frame')


class Replay(Node):
    """
    Publish a bag's messages when they are due.

    :param bag: open.
    :param options: which topics to publish, and how.
    :ivar done: is done when all messages are published; its exception is the error, if any.
    :raises ConfigurationError: if the bag has none of the wanted topics.
    """

    def __init__(self, bag: Bag, options: ReplayOptions, **kwargs) -> None:
        super().__init__('replay', **kwargs)
        self.bag = bag
        self.options = options
        self.done = Future()
        self.topics = chosen_topics(bag, options.topics)
        if options.poses and not options.topics:
            # Poses of the command line replace those of the bag.
            self.topics = {name: one for name, one in self.topics.items() if one[0] == CLOUD}
        self.counts = dict.fromkeys(self.topics, 0)
        self.left_out = 0
        self._clouds = [name for name, (kind, _) in self.topics.items() if kind == CLOUD]
        self._frames_given = dict(options.frames)
        check_known([name for name in self._frames_given if name], self._clouds, '--frame')
        has_poses = len(self._clouds) < len(self.topics)
        self._has_transforms = any(KINDS.get(t.kind) == TRANSFORMS for t in bag.topics)
        #: Whether this node publishes poses: from the command line, or from transforms.
        self._posing = bool(options.poses) or (self._has_transforms and not has_poses)
        self._check_poses(has_poses)
        self._tree = TransformTree()
        self._cloud_poses: dict[str, Pose] = {}
        self._make_publishers()
        self._upcoming = self._schedule()
        self._next: tuple[float, int, Recorded | BrokenMessage] | None = None
        self._began: float | None = None
        self._patience = time.monotonic() + options.wait
        self._timer = self.create_timer(
            0.05, self._on_time, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _check_poses(self, has_poses: bool) -> None:
        """Check that each camera has a pose; warn if there are neither poses nor transforms."""
        given, clouds = len(self.options.poses), len(self._clouds)
        if given and has_poses:
            raise ConfigurationError('--pose: found it with recorded poses; expected one of the '
                                     'two; name with --topics the clouds alone')
        if given and given != clouds:
            raise ConfigurationError(
                f'--pose: found {given} for {clouds} topics of clouds; expected one for each, in '
                f'the order {", ".join(self._clouds)}; add --pose or name fewer --topics')
        if not (given or has_poses or self._has_transforms):
            self.get_logger().warning(
                f'found neither poses nor transforms in {self.bag.path.name}; expected somebody '
                'to say where the cameras are, which policy_node waits for; add --pose for each '
                'cloud')

    def _make_publishers(self) -> None:
        """Create a publisher for each topic, and one for the poses if this node publishes them."""
        self._publishers_of: dict[str, Any] = {
            name: self.create_publisher(TYPES[kind], new, LOOP)
            for name, (kind, new) in self.topics.items()}
        if self._posing:
            self._poses = self.create_publisher(PoseArray, topics.CAMERA_POSES, LOOP)

    def _schedule(self) -> Iterator[tuple[float, int, Recorded | BrokenMessage]]:
        """Yield each message with its due time (s) and the shift of its stamps (ns)."""
        options, names = self.options, list(self.topics)
        if self._has_transforms:
            names += [t.name for t in self.bag.topics if KINDS.get(t.kind) == TRANSFORMS]
        begin = self.bag.start + int(options.start * 1e9)
        end = None if options.duration is None else begin + int(options.duration * 1e9)
        left = self.bag.seconds - options.start
        length = left if options.duration is None else min(left, options.duration)
        moved = 0
        while True:
            count, last = 0, begin
            # Static transforms may have been recorded before the part that is replayed.
            since = self.bag.start if self._has_transforms else begin
            for item in self.bag.messages(names, since, end):
                if isinstance(item, Recorded):
                    if item.time < begin and item.kind != TRANSFORMS:
                        continue
                    last = max(item.time, begin)
                    count += item.kind == CLOUD
                yield (last - begin + moved) * 1e-9 / options.rate, moved, item
            if not count:
                raise ConfigurationError(
                    f'{self.bag.path}: found no cloud from {options.start:g} s on for '
                    f'{max(length, 0.0):g} s; expected some in a recording of '
                    f'{self.bag.seconds:.3g} s; change --start or --duration')
            if not options.loop:
                return
            # The gap between two loops is the mean time between two clouds, at least ``GAP``.
            moved += int(1e9 * (length + max(length / count, 0.1)))

    def _on_time(self) -> None:
        """Publish the next message if it is due, and set the timer for the one after it."""
        try:
            if self._began is None and not self._has_subscribers():
                return
            self._publish_due()
        except ConfigurationError as error:
            self._end(error)

    def _has_subscribers(self) -> bool:
        """Return whether to begin: all topics have subscribers, or ``wait`` seconds are over."""
        now, mine = time.monotonic(), list(self._publishers_of.values())
        if self._posing:
            mine.append(self._poses)
        deaf = [one.topic_name for one in mine if not one.get_subscription_count()]
        if deaf and now < self._patience:
            return False
        if deaf and self.options.wait:
            self.get_logger().warning(f'found no subscriber of {", ".join(deaf)} after '
                                      f'{self.options.wait:g} s; expected policy_node with these '
                                      'cloud_topics; going on')
        # Subscribers discover the publisher a little later.
        self._began = now + (0.0 if deaf else 0.3)
        return True

    def _publish_due(self) -> None:
        """Publish one message if it is due."""
        if self._next is None:
            self._next = next(self._upcoming, None)
            if self._next is None:
                self._end(self._nothing_placed())
                return
        wait = self._began + self._next[0] - time.monotonic()
        if wait <= 0.0:
            (_, moved, item), self._next = self._next, None
            self._publish(item, moved)
        self._timer.timer_period_ns = int(1e9 * min(max(wait, 1e-4), 1.0))

    def flush(self) -> None:
        """Wait until reliable subscribers have all messages, at most ``FLUSH`` seconds."""
        for publisher in self.publishers:
            publisher.wait_for_all_acked(Duration(seconds=2.0))

    def _nothing_placed(self) -> ConfigurationError | None:
        """Return an error if no cloud was published."""
        if any(self.counts[name] for name in self._clouds):
            return None
        return ConfigurationError(f'{self.bag.path}: found no cloud that could be published; '
                                  'expected some; the warnings say why')

    def _end(self, error: ConfigurationError | None = None) -> None:
        """Stop, with an error if there is one."""
        self._timer.cancel()
        if error is not None:
            self.done.set_exception(error)
        elif not self.done.done():
            self.done.set_result(None)

    def _publish(self, item: Recorded | BrokenMessage, moved: int) -> None:
        """Publish a message, or log why it is left out."""
        try:
            if isinstance(item, BrokenMessage):
                raise item
            if item.kind == TRANSFORMS:
                self._tree.add(self.bag.transforms(item.cdr))
                return
            message = self._message(item)
            stamp = stamp_to_ns(message.header.stamp) or item.time
            message.header.stamp = ns_to_stamp(stamp + moved)
            if item.kind == CLOUD:
                self._place(item.topic, message)
        except (BrokenMessage, MessageError) as error:
            self.left_out += 1
            self.get_logger().warning(str(error), throttle_duration_sec=1.0)
            return
        self._publishers_of[item.topic].publish(message)
        self.counts[item.topic] += 1

    def _message(self, item: Recorded):
        """Return a recorded message as an rclpy message."""
        try:
            return deserialize_message(item.cdr, TYPES[item.kind])
        except Exception as error:
            raise BrokenMessage(f'{item.topic}: found a message that is no {item.kind} '
                                f'({error}); expected one; it is left out') from error

    def _place(self, topic: str, cloud: PointCloud2) -> None:
        """Set the frame of a cloud, and publish the camera poses before it."""
        frame, number = cloud.header.frame_id, self._clouds.index(topic)
        optical = frame.endswith(OPTICAL_ENDS)
        if self._posing:
            if self.options.poses:
                at = self.options.poses
                self._cloud_poses = {name: Pose.of(at[k]) for k, name in enumerate(self._clouds)}
            else:
                self._cloud_poses[topic] = self._looked_up(topic, frame, optical)
            if len(self._cloud_poses) == len(self._clouds):
                self._say_where(cloud.header)
            if frame != self.options.fixed_frame and not (
                    self.options.poses and CAMERA_FRAME.fullmatch(frame)):
                cloud.header.frame_id = f'camera_{number}' + optical * '_optical'
        given = self._frames_given.get(topic, self._frames_given.get('', ''))
        cloud.header.frame_id = given or cloud.header.frame_id

    def _looked_up(self, topic: str, frame: str, optical: bool) -> Pose:
        """Return the pose (body axes) of the camera of a cloud from the recorded transforms."""
        fixed = self.options.fixed_frame
        found = None if frame == fixed else self._tree.pose(frame, fixed)
        if found is None:
            what = f'clouds in {fixed!r} itself' if frame == fixed else (
                f'no transform from {frame!r} to {fixed!r}')
            raise MessageError(f'{topic}: found {what}; expected one that says where the camera '
                               'is; name another --fixed-frame, or add --pose for each cloud')
        return Pose(found.position, found.rotation @ OPTICAL_TO_BODY.T) if optical else found

    def _say_where(self, header: Header) -> None:
        """Publish the camera poses, with the stamp of a cloud."""
        posed = [self._cloud_poses[name] for name in self._clouds]
        message = positions_to_msg(
            np.array([pose.position for pose in posed]),
            Header(stamp=header.stamp, frame_id=self.options.fixed_frame))
        for pose_message, pose in zip(message.poses, posed, strict=True):
            x, y, z, w = Rotation.from_matrix(pose.rotation).as_quat()
            pose_message.orientation = Quaternion(x=x, y=y, z=z, w=w)
        self._poses.publish(message)


class TransformTree:
    """The latest pose of each frame in its parent."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Pose]] = {}

    def add(self, transforms: Iterable) -> None:
        """
        Add transforms, or replace older ones.

        :param transforms: each with ``header.frame_id``, ``child_frame_id`` and ``transform``.
        :raises MessageError: if a rotation is invalid or a number is not finite.
        """
        for one in transforms:
            move, name = one.transform, one.child_frame_id.lstrip('/')
            position = np.array([move.translation.x, move.translation.y, move.translation.z])
            if not np.isfinite(position).all():
                raise MessageError(f'transform of {name!r}: found {position.tolist()}; expected '
                                   'finite metres')
            self._parents[name] = (one.header.frame_id.lstrip('/'), Pose(
                position, rotation_of(move.rotation, f'transform of {name!r}')))

    def pose(self, frame: str, fixed: str) -> Pose | None:
        """Return the pose of a frame in one of its ancestors; None if there is no chain."""
        frame, fixed = frame.lstrip('/'), fixed.lstrip('/')
        position, rotation = np.zeros(3), LEVEL
        # Limit the number of steps: the recorded transforms may form a cycle.
        for _ in range(len(self._parents) + 1):
            if frame == fixed:
                return Pose(position, rotation)
            if frame not in self._parents:
                return None
            frame, step = self._parents[frame]
            position = step.rotation @ position + step.position
            rotation = step.rotation @ rotation
        return None
