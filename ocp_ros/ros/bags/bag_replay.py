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
from dataclasses import dataclass
import time
from typing import Any

from geometry_msgs.msg import PoseArray, Quaternion
import numpy as np
from ocp_ros.geometry.cameras import LEVEL, OPTICAL_TO_BODY, Pose
from ocp_ros.ros.bags.bag_files import (
    Bag,
    BrokenMessage,
    KINDS,
    Recorded,
    TRANSFORMS,
)
from ocp_ros.ros.bags.bag_process import CAMERA_INFO, CLOUD, POSES
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import (
    MessageError,
    ns_to_stamp,
    positions_to_msg,
    rotation_of,
    stamp_to_ns,
)
from ocp_ros.ros.interface.depth_images import POINT_SOURCES
from ocp_ros.ros.interface.frames import CAMERA_FRAME, OPTICAL_FRAME_ENDINGS
from ocp_ros.ros.interface.qos import LOOP
from ocp_ros.ros.runtime.managed_node import create_steady_timer
from ocp_ros.util.settings import check_known, ConfigurationError
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.task import Future
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

#: The types of recorded messages that are published.
TYPES = {**POINT_SOURCES, CAMERA_INFO: CameraInfo, POSES: PoseArray}


@dataclass(frozen=True)
class ReplayOptions:
    """
    Which topics to replay, and how.

    :ivar topics: names of topics, or ``name:=new_name``; empty: all clouds, or depth images if
        there are none, and the poses if any.
    :ivar rate: factor of the recorded speed.
    :ivar loop: whether to begin again at the end, without limit.
    :ivar start: seconds at the beginning of the recording to leave out.
    :ivar duration: seconds of the recording to replay; None: to its end.
    :ivar frames: pairs of a topic and the frame of its clouds, in place of the recorded one; the
        topic ``''`` stands for all others.
    :ivar poses: an array (6,) for each camera: x, y, z (metres), yaw, pitch, roll (radians).
    :ivar fixed_frame: frame of the poses.
    :ivar wait: longest time to wait for subscribers, seconds.
    """

    topics: tuple[str, ...] = ()
    rate: float = 1.0
    loop: bool = False
    start: float = 0.0
    duration: float | None = None
    frames: tuple[tuple[str, str], ...] = ()
    poses: tuple[np.ndarray, ...] = ()
    fixed_frame: str = 'map'
    wait: float = 10.0


def choose_topics(bag: Bag, requested: tuple[str, ...]) -> dict[str, tuple[str, str]]:
    """
    Choose the topics to replay.

    :param requested: see ``topics`` of :class:`ReplayOptions`.
    :returns: message type and published name by recorded name, in the order of ``requested``; if
        this is empty, the clouds sorted by name, then the poses. The CameraInfo of each depth
        image comes last.
    :raises ConfigurationError: if a topic is missing or of another type, or there is no cloud.
    """
    known = {topic.name: topic for topic in bag.topics}
    names = dict(name.split(':=', 1) if ':=' in name else (name, name) for name in requested)
    check_known(names, known, f'{bag.path}: topics')
    for name in names:
        if known[name].kind not in TYPES:
            raise ConfigurationError(f'{bag.path}: found {known[name].kind} on {name}; expected '
                                     f'{" or ".join(TYPES)}; leave it out')
    if names and not any(known[name].kind in POINT_SOURCES for name in names):
        raise ConfigurationError(f'{bag.path}: found no clouds among {", ".join(names)}; expected '
                                 f'one at least of {", ".join(bag.clouds)}; name it')
    if not names:
        names = {name: name for name in bag.clouds}
        if (poses := _find_poses_topic(list(known.values()))) is not None:
            names[poses] = topics.CAMERA_POSES
    for name, new_name in list(names.items()):
        info = topics.camera_info_of_image(name)
        if known[name].kind in POINT_SOURCES and known[name].kind != CLOUD and info in known:
            names.setdefault(info, topics.camera_info_of_image(new_name))
    return {name: (known[name].kind, new_name) for name, new_name in names.items()}


def _find_poses_topic(known: list) -> str | None:
    """Return the topic named as camera poses, else the only PoseArray topic; None if neither."""
    pose_topics = [topic.name for topic in known if topic.kind == POSES]
    named = [name for name in pose_topics if name.split('/')[-1] == topics.CAMERA_POSES]
    if named:
        return named[0]
    return pose_topics[0] if len(pose_topics) == 1 else None


class Replay(Node):
    """
    Publish a bag's messages when they are due.

    :param bag: the bag, open.
    :param options: which topics to publish, and how.
    :ivar done: future that is done when all messages are published; it holds the error, if any.
    :ivar topics: see :func:`choose_topics`.
    :ivar counts: number of published messages by recorded topic.
    :ivar left_out_count: number of messages that could not be published.
    :raises ConfigurationError: if the bag has none of the wanted topics.
    """

    def __init__(self, bag: Bag, options: ReplayOptions, **kwargs) -> None:
        super().__init__('replay', **kwargs)
        self.bag = bag
        self.options = options
        self.done = Future()
        self.topics = choose_topics(bag, options.topics)
        if options.poses and not options.topics:
            # Poses of the command line replace those of the bag.
            self.topics = {name: (kind, new_name) for name, (kind, new_name) in self.topics.items()
                           if kind != POSES}
        self.counts = dict.fromkeys(self.topics, 0)
        self.left_out_count = 0
        self._cloud_topics = [
            name for name, (kind, _) in self.topics.items() if kind in POINT_SOURCES]
        self._given_frames = dict(options.frames)
        # The name '' stands for all other topics.
        check_known([name for name in self._given_frames if name], self._cloud_topics, '--frame')
        has_poses = any(kind == POSES for kind, _ in self.topics.values())
        self._has_transforms = any(KINDS.get(t.kind) == TRANSFORMS for t in bag.topics)
        #: Whether this node publishes poses: from the command line, or from transforms.
        self._publishes_poses = bool(options.poses) or (self._has_transforms and not has_poses)
        self._check_poses(has_poses)
        self._tree = TransformTree()
        self._cloud_poses: dict[str, Pose] = {}
        self._make_publishers()
        self._scheduled_items = self._schedule()
        #: The next scheduled item; None until it is read.
        self._next_item: tuple[float, int, Recorded | BrokenMessage] | None = None
        #: Times of a steady clock: when the replay began, and when it begins even without
        #: subscribers.
        self._start_time: float | None = None
        self._wait_deadline = time.monotonic() + options.wait
        self._timer = create_steady_timer(self, 0.05, self._publish_next)

    def _check_poses(self, has_poses: bool) -> None:
        """Check that each camera has a pose; warn if there are neither poses nor transforms."""
        given, clouds = len(self.options.poses), len(self._cloud_topics)
        if given and has_poses:
            raise ConfigurationError('--pose: found it with recorded poses; expected one of the '
                                     'two; name with --topics the clouds alone')
        if given and given != clouds:
            raise ConfigurationError(
                f'--pose: found {given} for {clouds} topics of clouds; expected one for each, in '
                f'the order {", ".join(self._cloud_topics)}; add --pose or name fewer --topics')
        if not (given or has_poses or self._has_transforms):
            self.get_logger().warning(
                f'found neither poses nor transforms in {self.bag.path.name}; expected somebody '
                'to say where the cameras are, which policy_node waits for; add --pose for each '
                'cloud')

    def _make_publishers(self) -> None:
        """Create a publisher for each topic, and one for the poses if this node publishes them."""
        self._publishers_by_topic: dict[str, Any] = {
            name: self.create_publisher(TYPES[kind], new_name, LOOP)
            for name, (kind, new_name) in self.topics.items()}
        if self._publishes_poses:
            self._poses_publisher = self.create_publisher(PoseArray, topics.CAMERA_POSES, LOOP)

    def _schedule(self) -> Iterator[tuple[float, int, Recorded | BrokenMessage]]:
        """
        Yield the messages in the order of recording, again and again if ``loop`` is set.

        :returns: for each message its due time since the start of the replay (seconds), the shift
            of its stamp (nanoseconds), and the message.
        """
        options = self.options
        names = list(self.topics)
        if self._has_transforms:
            names += [t.name for t in self.bag.topics if KINDS.get(t.kind) == TRANSFORMS]
        begin_ns = self.bag.start + int(options.start * 1e9)
        end_ns = None if options.duration is None else begin_ns + int(options.duration * 1e9)
        remaining_s = self.bag.seconds - options.start
        length_s = remaining_s if options.duration is None else min(remaining_s, options.duration)
        # Static transforms may have been recorded before the part that is replayed.
        first_ns = self.bag.start if self._has_transforms else begin_ns
        stamp_shift = 0
        while True:
            cloud_count = 0
            # The time of the last message, which a broken message gets too, since it has none.
            last_ns = begin_ns
            for item in self.bag.messages(names, first_ns, end_ns):
                if isinstance(item, Recorded):
                    if item.time < begin_ns and item.kind != TRANSFORMS:
                        continue
                    last_ns = max(item.time, begin_ns)
                    cloud_count += item.kind in POINT_SOURCES
                yield (last_ns - begin_ns + stamp_shift) * 1e-9 / options.rate, stamp_shift, item
            if not cloud_count:
                raise ConfigurationError(
                    f'{self.bag.path}: found no cloud from {options.start:g} s on for '
                    f'{max(length_s, 0.0):g} s; expected some in a recording of '
                    f'{self.bag.seconds:.3g} s; change --start or --duration')
            if not options.loop:
                return
            # The gap between two loops is the mean time between two clouds, but at least 0.1 s.
            stamp_shift += int(1e9 * (length_s + max(length_s / cloud_count, 0.1)))

    def _publish_next(self) -> None:
        """Publish the next message if it is due; wait for subscribers before the first message."""
        try:
            if self._start_time is None:
                self._start_if_heard()
            if self._start_time is not None:
                self._publish_due()
        except ConfigurationError as error:
            self._finish(error)

    def _start_if_heard(self) -> None:
        """Start once all topics have subscribers, or the seconds to wait for them are over."""
        now = time.monotonic()
        publishers = list(self._publishers_by_topic.values())
        if self._publishes_poses:
            publishers.append(self._poses_publisher)
        unheard_topics = [publisher.topic_name for publisher in publishers
                          if not publisher.get_subscription_count()]
        if unheard_topics and now < self._wait_deadline:
            return
        if unheard_topics and self.options.wait:
            self.get_logger().warning(f'found no subscriber of {", ".join(unheard_topics)} after '
                                      f'{self.options.wait:g} s; expected policy_node with these '
                                      'cloud_topics; going on')
        # A subscriber may discover a publisher later than the publisher discovers the subscriber:
        # wait 0.3 s more.
        self._start_time = now + (0.0 if unheard_topics else 0.3)

    def _publish_due(self) -> None:
        """Publish one message if it is due, and set the timer for the next message."""
        if self._next_item is None:
            self._next_item = next(self._scheduled_items, None)
            if self._next_item is None:
                has_clouds = any(self.counts[name] for name in self._cloud_topics)
                self._finish(None if has_clouds else ConfigurationError(
                    f'{self.bag.path}: found no cloud that could be published; expected some; '
                    'the warnings say why'))
                return
        due_time, stamp_shift, item = self._next_item
        wait_s = self._start_time + due_time - time.monotonic()
        if wait_s <= 0.0:
            self._next_item = None
            self._publish(item, stamp_shift)
        # After a message was published, the next one is read at once.
        self._timer.timer_period_ns = int(1e9 * min(max(wait_s, 1e-4), 1.0))

    def flush(self) -> None:
        """Wait, for each publisher up to 2 s, until reliable subscribers have all messages."""
        for publisher in self.publishers:
            publisher.wait_for_all_acked(Duration(seconds=2.0))

    def _finish(self, error: ConfigurationError | None = None) -> None:
        """Stop the timer, and set the result of ``done`` or its error."""
        self._timer.cancel()
        if error is not None:
            self.done.set_exception(error)
        elif not self.done.done():
            self.done.set_result(None)

    def _publish(self, item: Recorded | BrokenMessage, stamp_shift: int) -> None:
        """Publish a message, its stamp later by ``stamp_shift``, or log why it is left out."""
        try:
            if isinstance(item, BrokenMessage):
                raise item
            if item.kind == TRANSFORMS:
                self._tree.add(self.bag.transforms(item.cdr))
                return
            message = self._deserialize(item)
            # A message without a stamp gets the time of its recording.
            stamp = stamp_to_ns(message.header.stamp) or item.time
            message.header.stamp = ns_to_stamp(stamp + stamp_shift)
            if item.kind in POINT_SOURCES:
                # The axes of images are optical.
                is_optical = item.kind != CLOUD or message.header.frame_id.endswith(
                    OPTICAL_FRAME_ENDINGS)
                self._place_cloud(item.topic, message.header, is_optical)
        except (BrokenMessage, MessageError) as error:
            self.left_out_count += 1
            self.get_logger().warning(str(error), throttle_duration_sec=1.0)
            return
        self._publishers_by_topic[item.topic].publish(message)
        self.counts[item.topic] += 1

    def _deserialize(self, item: Recorded) -> Any:
        """Return a recorded message as an rclpy message."""
        try:
            return deserialize_message(item.cdr, TYPES[item.kind])
        except Exception as error:
            raise BrokenMessage(f'{item.topic}: found a message that is no {item.kind} '
                                f'({error}); expected one; it is left out') from error

    def _place_cloud(self, topic: str, header: Header, is_optical: bool) -> None:
        """Set the frame in the header of a cloud, and publish the camera poses before it."""
        frame = header.frame_id.lstrip('/')
        if self._publishes_poses:
            if self.options.poses:
                self._cloud_poses = dict(zip(self._cloud_topics, map(Pose.of, self.options.poses)))
            else:
                self._cloud_poses[topic] = self._look_up_camera_pose(topic, frame, is_optical)
            # Poses are published for all cameras together, once each of them has a pose.
            if len(self._cloud_poses) == len(self._cloud_topics):
                self._publish_camera_poses(header)
            # With poses from the command line, two kinds of frame need no new name: the frame of
            # the poses, as these points are placed already, and ``camera_<i>``, which
            # ``policy_node`` knows. ``policy_node`` also rotates ``camera_<i>_optical``.
            if frame != self.options.fixed_frame and not (
                    self.options.poses and CAMERA_FRAME.fullmatch(frame)):
                number = self._cloud_topics.index(topic)
                header.frame_id = f'camera_{number}{"_optical" if is_optical else ""}'
        # A frame from the command line replaces this frame: that of the topic, or (as '') that of
        # all other topics.
        given_frame = self._given_frames.get(topic, self._given_frames.get('', ''))
        header.frame_id = given_frame or header.frame_id

    def _look_up_camera_pose(self, topic: str, frame: str, is_optical: bool) -> Pose:
        """Return the body pose of the camera of a topic from the recorded transforms."""
        fixed_frame = self.options.fixed_frame
        pose = None if frame == fixed_frame else self._tree.look_up_pose(frame, fixed_frame)
        if pose is None:
            found = f'clouds in {fixed_frame!r} itself' if frame == fixed_frame else (
                f'no transform from {frame!r} to {fixed_frame!r}')
            raise MessageError(f'{topic}: found {found}; expected one that says where the camera '
                               'is; name another --fixed-frame, or add --pose for each cloud')
        # The axes of a recorded optical frame are rotated to those of the body.
        return Pose(pose.position, pose.rotation @ OPTICAL_TO_BODY.T) if is_optical else pose

    def _publish_camera_poses(self, header: Header) -> None:
        """Publish the camera poses, with the stamp of a cloud (its header is given)."""
        poses = [self._cloud_poses[name] for name in self._cloud_topics]
        message = positions_to_msg(np.array([pose.position for pose in poses]),
                                   Header(stamp=header.stamp, frame_id=self.options.fixed_frame))
        for pose_message, pose in zip(message.poses, poses, strict=True):
            x, y, z, w = Rotation.from_matrix(pose.rotation).as_quat()
            pose_message.orientation = Quaternion(x=x, y=y, z=z, w=w)
        self._poses_publisher.publish(message)


class TransformTree:
    """The latest pose of each frame in its parent."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Pose]] = {}

    def add(self, transforms: Iterable) -> None:
        """
        Add transforms, or replace older ones.

        :param transforms: messages with ``header.frame_id``, ``child_frame_id`` and ``transform``.
        :raises MessageError: if a rotation is invalid or a number is not finite.
        """
        for transform in transforms:
            name = transform.child_frame_id.lstrip('/')
            position = np.array([getattr(transform.transform.translation, axis) for axis in 'xyz'])
            if not np.isfinite(position).all():
                raise MessageError(f'transform of {name!r}: found {position.tolist()}; expected '
                                   'finite metres')
            self._parents[name] = (transform.header.frame_id.lstrip('/'), Pose(
                position, rotation_of(transform.transform.rotation, f'transform of {name!r}')))

    def look_up_pose(self, frame: str, ancestor: str) -> Pose | None:
        """
        Return the pose of a frame in one of its ancestors; None if it has no such ancestor.

        Neither name begins with a slash.
        """
        pose = Pose(np.zeros(3), LEVEL)
        # Limit the number of steps: the recorded transforms may form a cycle.
        for _ in range(len(self._parents) + 1):
            if frame == ancestor:
                return pose
            if frame not in self._parents:
                return None
            frame, pose_in_parent = self._parents[frame]
            pose = pose.within(pose_in_parent)
        return None
