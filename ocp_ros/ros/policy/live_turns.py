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
Turns of real cameras: clouds arrive at any time, and a rig or a person carries out commands.

Of each topic only the newest cloud is stored, as it was received, and each turn reads one of each
topic. So the executor is busy with one cloud or one answer at a time, however fast cameras are.
"""

from collections import Counter, defaultdict, deque
from functools import partial
import math
from typing import TYPE_CHECKING

from geometry_msgs.msg import Pose as PoseMsg
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.geometry.cameras import angle_between, heading_of, Pose
from ocp_ros.geometry.clouds import FusedCloud
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import (
    cloud_to_msg,
    MessageError,
    msg_to_poses,
    msg_to_positions,
    ns_to_stamp,
    positions_to_msg,
    RawMessage,
    rotation_of,
    shortened,
    stamp_to_ns,
)
from ocp_ros.ros.interface.depth_images import PointSubscription
from ocp_ros.ros.interface.frames import (
    CameraClouds,
    CameraFrames,
    find_frame_prefix,
    LateTransformError,
    LiveRig,
    points_in_body_frame,
    points_in_range,
    transform_cloud,
    Transforms,
)
from ocp_ros.ros.interface.qos import LOOP, POSES
from ocp_ros.ros.policy.instructions import Instructor
from ocp_ros.ros.policy.policy_config import names_in
from ocp_ros.ros.policy.turn_source import TurnSource
from ocp_ros.ros.policy.turns import Turns, WaitLimits
from ocp_ros.ros.runtime.managed_node import create_steady_timer
from ocp_ros.util.settings import ConfigurationError
from rclpy.impl.implementation_singleton import rclpy_implementation
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

if TYPE_CHECKING:
    from ocp_ros.ros.policy_node import PolicyNode

#: Largest number of points of the fused cloud; beyond it the voxels grow.
MAX_FUSED_POINTS = 100_000
#: Largest number of clouds of a topic that are kept for calibration, and nanoseconds between them.
MAX_FRAMES, FRAME_INTERVAL_NS = 10, 300_000_000
#: Seconds after which a command, which may be lost, is sent again to cameras that are under way.
RESEND_S = 1.0


class LiveTurns(TurnSource):
    """
    Fuse the clouds of cameras that stand still, and ask for the next command.

    :param node: gets the subscriptions, and answers the turns.
    :raises ConfigurationError: if the name of a topic is invalid, is given twice or is that of the
        fused cloud, or if tf2 is needed and not installed.
    """

    def __init__(self, node: 'PolicyNode') -> None:
        super().__init__(node)
        config = node.config
        self._fused_cloud = FusedCloud(config.voxel_size, MAX_FUSED_POINTS)
        self._transforms = Transforms(node)
        self._frame_prefix = find_frame_prefix(node, config.frame_prefix)
        self._frames = CameraFrames(
            node, config.publish_tf, self._frame_prefix, self._transforms.has_transform)
        #: The newest clouds of each topic, unread: several if cameras are to be calibrated.
        frames = MAX_FRAMES if config.calibrates else 1
        self._newest_clouds: dict[str, deque[RawMessage]] = defaultdict(
            lambda: deque(maxlen=frames))
        #: Targets of the last command: positions of the K cameras, (K, 3) metres, and rotations,
        #: (3, 3), of the cameras that the command rotates.
        self._targets = np.empty((0, 3))
        self._target_rotations: dict[int, np.ndarray] = {}
        #: (K,) bool, whether the last command changes the height of each camera.
        self._height_changes = np.zeros(0, dtype=bool)
        #: Instructs a person who moves the cameras, if one does.
        self._instructor = Instructor(node) if config.manual else None
        self.reset()
        self._observation_publisher = node.create_publisher(PointCloud2, topics.OBSERVATION, LOOP)
        self._camera_frames = names_in(config.camera_frames)
        #: Stamp of the newest poses from tf, nanoseconds, and why there are none.
        self._tf_stamp, self._tf_error = 0, ''
        if not self._camera_frames:
            node.create_subscription(PoseArray, topics.CAMERA_POSES, self._on_poses, POSES)
        elif self._transforms.installed:
            create_steady_timer(node, 0.05, self._read_poses)
        else:
            raise ConfigurationError('camera_frames: found no tf2_ros; expected it installed; '
                                     'install it, or publish camera_poses')
        self._subscriptions = {
            topic: PointSubscription(node, name, partial(self._on_cloud, topic))
            for topic, name in self._full_topic_names(config.live_topics).items()}

        def match_publishers() -> None:
            for subscription in self._subscriptions.values():
                subscription.match()

        create_steady_timer(node, 0.5, match_publishers)
        # A turn can become due without a message: this is checked ten times a second.
        create_steady_timer(node, 0.1, self._play_turn)
        self._resend_timer = create_steady_timer(node, RESEND_S, self._resend)

    @property
    def _is_final(self) -> bool:
        """Return whether the placement is final: then clouds are no longer read."""
        return self._node.convergence.is_final

    def _wait_limits(self) -> WaitLimits:
        """Return the limits of waiting for cameras and clouds."""
        config = self._node.config
        arrival_timeout = math.inf if config.manual else config.arrival_timeout
        # Each turn of a final placement sends the same command: it need not do so for every cloud.
        min_duration = max(config.turn_seconds, RESEND_S if self._is_final else 0.0)
        return WaitLimits(config.arrival_distance, arrival_timeout, config.cloud_timeout,
                          min_duration, config.arrival_angle)

    def hold_cameras(self) -> None:
        """Command cameras that may be moving to stay where they are."""
        if self._poses_message is not None and self._command is not None and (
                not self._turns.cameras_stand):
            self._node.commander.publish(self._poses_message)

    def reset(self) -> None:
        """Drop the data of earlier turns, and begin to wait for cameras and clouds."""
        self._fused_cloud.clear()
        #: The newest poses, as a message and as a rig.
        self._poses_message: PoseArray | None = None
        self._rig: LiveRig | None = None
        #: The number of cameras and the frame of their poses; None before the first answer.
        self._rig_size: tuple[int, str] | None = None
        self._command: PoseArray | None = None
        self._gain_text = ''
        if self._instructor is not None:
            self._instructor.reset()
        #: Number of turns that were decided, and by topic the number of these turns in which the
        #: topic brought a cloud.
        self._decided_turns = 0
        self._turns_with_cloud = Counter[str]()
        self._turns: Turns[RawMessage] = Turns(
            self._node.config.live_topics, self._wait_limits())
        #: The value of ``_turns.stamp_jumps`` when the transforms were last dropped.
        self._seen_jumps = 0

    def accept_arrival(self) -> bool:
        """End this turn where the cameras stand; return False before the first command."""
        if self._command is None:
            return False
        self._turns.accept_arrival()
        return True

    def apply_config(self) -> None:
        """Continue with the node's new parameters."""
        self._turns.limits = self._wait_limits()

    def _full_topic_names(self, names: list[str]) -> dict[str, str]:
        """Return the full names of the cloud topics, by their names in the parameter."""
        try:
            full_names = {topic: self._node.resolve_topic_name(topic) for topic in names}
        except rclpy_implementation.RCLError as error:
            raise ConfigurationError(f'cloud_topics: found {names}; expected names of topics '
                                     f'with commas between; {" ".join(str(error).split())}'
                                     ) from error
        fused_topic = self._node.resolve_topic_name(topics.OBSERVATION)
        if len(set(full_names.values())) < len(names) or fused_topic in full_names.values():
            raise ConfigurationError(f'cloud_topics: found {names}; expected each once, and not '
                                     f'{fused_topic}, which is where the fused cloud goes')
        return full_names

    def _on_cloud(self, topic: str, message_type: type, data: bytes) -> None:
        """Store a cloud or a depth image, and play the turn if it is due."""
        try:
            cloud = RawMessage.of(message_type, data)
        except MessageError as error:
            self._node.refuse(error, topic)
            return
        frames = self._newest_clouds[topic]
        # The newest cloud replaces one that has come shortly before; a clock may be set back.
        if len(frames) > 1 and 0 <= cloud.stamp - frames[-2].stamp < FRAME_INTERVAL_NS:
            frames.pop()
        frames.append(cloud)
        self._turns.on_cloud(topic, cloud.stamp, cloud)
        self._play_turn()

    def _read_poses(self) -> None:
        """Read the camera poses from tf, and use them if they are new."""
        frame = self._node.config.fixed_frame
        try:
            poses, stamp = self._transforms.look_up_cameras(self._camera_frames, frame)
        except MessageError as error:
            self._tf_error = str(error)
            return
        # Static transforms hold now.
        stamp = stamp or self._node.get_clock().now().nanoseconds
        if stamp != self._tf_stamp:
            self._tf_stamp, self._tf_error = stamp, ''
            self._on_poses(positions_to_msg(
                np.array([pose.position for pose in poses]),
                Header(stamp=ns_to_stamp(stamp), frame_id=frame),
                np.array([heading_of(pose.rotation) for pose in poses])))

    def _on_poses(self, message: PoseArray) -> None:
        """Store the camera poses, and play the turn if it is due."""
        try:
            rig = LiveRig(
                message.header.frame_id, msg_to_poses(message), prefix=self._frame_prefix)
            self._check_same_rig(rig)
            if not stamp_to_ns(message.header.stamp):
                raise MessageError('poses: found the stamp 0; expected when the cameras were '
                                   'there, by the clock of the clouds')
        except MessageError as error:
            self._node.refuse(error, topics.CAMERA_POSES)
            return
        self._node.warn(topics.CAMERA_POSES, '')
        if self._turns.on_poses(stamp_to_ns(message.header.stamp), rig.positions,
                                [pose.rotation for pose in rig.poses]):
            self._poses_message = message
            self._rig = rig
            self._frames.publish(message.header, self._node.decider.add_fixed_poses(rig.poses))
        self._play_turn()

    def _check_same_rig(self, rig: LiveRig) -> None:
        """Refuse poses of another rig than the one that has been commanded."""
        found = len(rig.poses), rig.frame
        if self._rig_size not in (None, found):
            raise MessageError(f'poses: found {found[0]} cameras in the frame {found[1]!r}; '
                               f'expected {self._rig_size[0]} in {self._rig_size[1]!r}, as '
                               f'before; for another rig start {self._node.get_name()} again')

    def _play_turn(self) -> None:
        """Read the clouds that this turn can use, and play the turn once it is due."""
        if self._seen_jumps != self._turns.stamp_jumps:
            # The clock was set: the stamps of the transforms received so far are invalid.
            self._seen_jumps = self._turns.stamp_jumps
            self._transforms.clear()
        # Topics whose cloud waits for its CameraInfo, or was put back in this call: it is taken in
        # a later call.
        waiting_topics = [topic for topic, subscription in self._subscriptions.items()
                          if subscription.lacks_info]
        while (topic_and_cloud := self._turns.take_cloud(waiting_topics)) is not None:
            topic, cloud = topic_and_cloud
            try:
                self._fuse_cloud(topic, cloud)
                self._node.warn(topic, '')
            except LateTransformError as error:
                # Transforms come on another topic than poses, and may still arrive.
                if self._turns.put_back(topic, cloud.stamp, cloud):
                    waiting_topics.append(topic)
                else:
                    self._turns.refuse_cloud(topic)
                    self._node.refuse(error, topic)
            except ValueError as error:
                self._turns.refuse_cloud(topic)
                self._node.refuse(error, topic)
        is_due = self._turns.is_due()
        if not self._node.must_wait:
            self._update_warnings()
            if is_due:
                self._answer_turn()

    def _fuse_cloud(self, topic: str, cloud: RawMessage) -> None:
        """Add a cloud of a topic to the fused cloud, unless the placement is final."""
        if self._is_final:
            return
        # ``mean_poses`` are all positions and all rotations: each pose gets one of both. When a
        # cloud is taken, the cameras stand: ``standing_begin`` is not None.
        rig = self._rig._replace(poses=list(map(Pose, *self._turns.mean_poses)),
                                 standing_since_ns=self._turns.standing_begin.stamp)
        points, camera_positions = transform_cloud(
            *self._subscriptions[topic].read(cloud), rig, self._transforms)
        self._fused_cloud.add(points_in_range(
            points, camera_positions, *self._node.decider.ranges))

    def _answer_turn(self) -> None:
        """Ask for the command of this turn, send it, and begin to wait for the cameras."""
        # The turn gets the stamp of its newest cloud; a turn that is due has used one at least.
        stamp = ns_to_stamp(max(self._turns.used_stamps.values()))
        header = Header(stamp=stamp, frame_id=self._rig.frame)
        poses = self._standing_poses(header)
        was_final = self._is_final
        try:
            self._command = self._node.decide(self._fused_cloud.points, poses)
        except MessageError as error:
            # For example, the fused cloud has no points, or points of more than one room.
            self._fused_cloud.clear()
            self._turns.repeat_turn()
            self._node.refuse(error)
            return
        # If the answer has made the placement final, this turn decided nothing, but its cloud is
        # published.
        if not self._is_final:
            self._decided_turns += 1
            self._turns_with_cloud.update(self._turns.used_stamps.keys())
        if not was_final:
            self._observation_publisher.publish(cloud_to_msg(self._fused_cloud.points, header))
        self._send_command(poses)
        # Turns of a final placement last longer.
        if self._is_final:
            self._turns.limits = self._wait_limits()
        self._node.decider.plan_ahead()

    def _send_command(self, poses: PoseArray) -> None:
        """Send the command of this turn, and begin to wait for the cameras, now at ``poses``."""
        self._node.commander.publish(self._command)
        self._resend_timer.reset()
        self._targets = targets = msg_to_positions(self._command)
        # A command repeats the orientation of a camera that does not rotate.
        self._target_rotations = {
            camera: rotation_of(goal.orientation, f'command: camera {camera}')
            for camera, (goal, present) in enumerate(zip(self._command.poses, poses.poses))
            if goal.orientation != present.orientation}
        self._height_changes = targets[:, 2] != msg_to_positions(poses)[:, 2]
        self._rig_size = len(targets), poses.header.frame_id
        if self._instructor is not None:
            self._gain_text = self._node.decider.describe_gain(
                self._fused_cloud.points, poses, self._command)
            self._instruct()
        self._turns.on_command(targets, self._target_rotations, self._height_changes)

    def _instruct(self) -> None:
        """Tell the person who moves the cameras, if one does, what is left to do."""
        if self._instructor is not None:
            # Measured heights vary: only a command that changes the height asks for it.
            targets = self._targets.copy()
            targets[~self._height_changes, 2] = self._rig.positions[~self._height_changes, 2]
            self._instructor.publish(
                self._rig, targets, self._target_rotations, self._poses_message.header,
                self._node.config, self._gain_text, self._is_final)

    @property
    def missing_data(self) -> str:
        """Return in words the topics with clouds in less than half of the turns; '' if none."""
        return ', '.join(f'{topic} brought a cloud in {self._turns_with_cloud[topic]} of '
                         f'{self._decided_turns} turns' for topic in self._node.config.live_topics
                         if 2 * self._turns_with_cloud[topic] < self._decided_turns)

    def _standing_poses(self, header: Header) -> PoseArray:
        """
        Return the poses at which the cameras stand.

        For a camera that arrived this is the commanded pose: measured poses have noise, and
        heights and headings copied from them would drift from turn to turn. For other cameras it
        is the mean of the measured poses.
        """
        message = PoseArray(header=header)
        # ``mean_poses`` are all positions and all rotations: each pose gets one of both.
        for camera, measured in enumerate(map(Pose, *self._turns.mean_poses)):
            message.poses.append(self._reached_command(camera, measured)
                                 or self._pose_message(camera, measured))
        return message

    def _pose_message(self, camera: int, mean: Pose) -> PoseMsg:
        """Return a mean pose as a message: the newest message if it has exactly this pose."""
        if all(map(np.array_equal, mean, self._rig.poses[camera])):
            return self._poses_message.poses[camera]
        return positions_to_msg(mean.position[None], Header(),
                                heading_of(mean.rotation)[None]).poses[0]

    def _reached_command(self, camera: int, measured: Pose) -> PoseMsg | None:
        """Return the commanded pose of a camera if the camera has arrived there; else None."""
        if self._command is None:
            return None
        sent = self._command.poses[camera]
        rotation = rotation_of(sent.orientation, f'command: camera {camera}')
        offset = measured.position - [sent.position.x, sent.position.y, sent.position.z]
        # A larger offset from the target is more than noise, even within wider arrival limits.
        max_noise_m, max_noise_radians = 0.1, 0.2
        is_near = np.linalg.norm(offset) <= min(self._node.config.arrival_distance, max_noise_m)
        angle = angle_between(measured.rotation, rotation)
        is_aligned = angle <= min(self._node.config.arrival_angle, max_noise_radians)
        return sent if is_near and is_aligned else None

    def _resend(self) -> None:
        """Send the command and the instructions again while cameras have not arrived."""
        if self._node.must_wait:
            # When this node may command again, the present clouds will be old.
            self._turns.drop_clouds()
        elif self._command is not None and not self._turns.cameras_stand:
            self._node.commander.publish(self._command)
            # After a command the positions are unknown until the next poses.
            if self._turns.positions is not None:
                self._instruct()

    def _update_warnings(self) -> None:
        """Warn of what keeps the turns waiting, and end the warnings of what does not any more."""
        turns, warn = self._turns, self._node.warn
        source = turns.jumped_source()
        warn('jump', source and f'stamps of {source} went back: found two clocks, or one that was '
             'set; expected one for poses and clouds')
        leads = turns.clock_leads()
        clocks = ', '.join(
            f'{"leads" if seconds > 0.0 else "follows"} that of {topic} by {abs(seconds):.1f} s'
            for topic, seconds in leads.items())
        warn('clocks', clocks and f"found that the poses' clock {clocks}; expected one clock for "
             'poses and clouds; synchronise the clocks of their machines')
        silent = {topic: f'{topic} ({reason})' for topic, reason in turns.silent_topics().items()
                  if topic not in leads}
        for topic, subscription in self._subscriptions.items():
            if topic in silent and subscription.lacks_info:
                silent[topic] = f'{topic} (nothing on {subscription.info_topic})'
        reaction = 'waiting' if turns.lacks_clouds else 'going on without'
        warn('silence', f'no clouds: {", ".join(silent.values())}; expected a cloud since the '
             f'cameras stand; {reaction}' if silent else '', news=','.join(silent))
        if turns.poses_missing and (self._instructor is None or self._command is None):
            name = self._node.resolve_topic_name(topics.CAMERA_POSES)
            reason = f'found nothing new on {name}; expected where the cameras are ' \
                '(geometry_msgs/msg/PoseArray); publish it, see docs/tasks/live_cameras.md'
            if self._camera_frames:
                reason = self._tf_error or 'found no newer transforms; expected where the ' \
                    'cameras are; publish the transforms of camera_frames'
            warn('cameras', f'poses: {shortened(reason)}; waiting')
        elif turns.overdue and turns.no_command_sent:
            warn('cameras', 'cameras: found them moving, or their poses noisy, ever since this '
                 'node began; expected them to stand still before the first turn; going on from '
                 'the mean of their poses')
        elif turns.overdue:
            config = self._node.config
            warn('cameras', 'cameras: found that they have not arrived after '
                 f'{config.arrival_timeout:.1f} s; expected them within '
                 f'{config.arrival_distance} m of the commanded positions; the next '
                 'turn begins at their present positions')
        elif turns.cameras_stand:
            warn('cameras', '')

    def latest_clouds(self) -> CameraClouds:
        """
        Return the clouds of each camera, the newest last, since the cameras stand.

        Topic i has the clouds of camera i, unless their frame names another camera.

        :raises MessageError: if poses or clouds are missing or cannot be used.
        """
        if self._rig is None or not self._newest_clouds:
            missing = topics.CAMERA_POSES if self._rig is None else 'a cloud'
            raise MessageError(f'cameras: found nothing on {missing} yet; expected poses and '
                               'clouds; call it again when the cameras run')
        clouds: dict[int, list[np.ndarray]] = {}
        for number, topic in enumerate(self._node.config.live_topics):
            frames = list(self._newest_clouds[topic]) if topic in self._newest_clouds else []
            since = self._turns.standing_begin.stamp if self._turns.standing_begin else math.inf
            # Without clouds since then, the newest one is used.
            for message in [one for one in frames if one.stamp >= since] or frames[-1:]:
                points, frame = self._subscriptions[topic].read(message)
                match = self._rig.match_frame(frame)
                camera = int(match[1]) if match else number
                if camera < len(self._rig.poses):
                    points, _ = transform_cloud(points, frame, self._rig, self._transforms)
                    clouds.setdefault(camera, []).append(
                        points_in_body_frame(points, self._rig.poses[camera]))
        return CameraClouds(self._rig, clouds)

    def status(self) -> dict[str, object]:
        """Return values to show in the diagnostics."""
        return {
            'silent_topics': ','.join(self._turns.silent_topics()),
            'late_turns': self._turns.overdue_turns,
            'turns_with_clouds': ', '.join(
                f'{topic} {self._turns_with_cloud[topic]}/{self._decided_turns}'
                for topic in self._node.config.live_topics),
            'clock_jumps': self._turns.stamp_jumps, 'fused_points': len(self._fused_cloud),
            'voxel_size': self._fused_cloud.edge}
