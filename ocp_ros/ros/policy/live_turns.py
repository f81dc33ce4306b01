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

Of each topic only the newest cloud is stored, unread, and each turn reads one of each topic. So
the executor is busy with one cloud or one answer at a time, however fast the cameras are.
"""

from collections import Counter
from collections.abc import Callable
from functools import partial
import math

from geometry_msgs.msg import Pose as PoseMsg
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.geometry.cameras import angle_between, heading_of, Pose
from ocp_ros.online.cloud_fusion import FusedCloud
from ocp_ros.rig.motion import way_between
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import (
    cloud_to_msg,
    MessageError,
    msg_to_cloud,
    msg_to_poses,
    msg_to_positions,
    ns_to_stamp,
    positions_to_msg,
    replaced,
    rotation_of,
    stamp_to_ns,
)
from ocp_ros.ros.interface.frames import (
    CAMERA_FRAME,
    CameraFrames,
    in_body,
    in_range,
    LateTransformError,
    LiveRig,
    placed,
    Sighting,
    Transforms,
)
from ocp_ros.ros.interface.markers import move_markers
from ocp_ros.ros.interface.qos import LATCHED, LOOP, POSES, SENSOR
from ocp_ros.ros.policy.commander import Commander
from ocp_ros.ros.policy.instructions import FINAL, instructions, moving
from ocp_ros.ros.policy.policy_config import PolicyNodeConfig
from ocp_ros.ros.policy.turns import Turns
from ocp_ros.util.settings import ConfigurationError
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header, String
from visualization_msgs.msg import MarkerArray

#: Seconds after which a command is sent again to cameras that have not arrived: it may have been
#: lost.
RESEND_S = 1.0
#: Metres and radians: a measured pose that differs more from its target is not noise, whatever the
#: limits of arrival are.
MAX_NOISE = 0.1, 0.2


class LiveTurns:
    """
    Fuse the clouds of cameras that stand still, and ask for the next command.

    :param node: gets the subscriptions; its log gets the warnings.
    :param config: of the node.
    :param commands: publishes the commands.
    :param answer: is called once per turn with the fused cloud (N, 3) float32, metres, and the
        camera poses; returns the command.
    :param final: returns whether the placement is final: then clouds are no longer read.
    :param refuse: counts and logs a message that cannot be used.
    :param waits: returns whether this node may not command now.
    :param expect: is called with the fused cloud, the camera poses and the command; returns a
        sentence on the expected gain, for a person.
    :param plan_ahead: is called after each command, to plan while the cameras move.
    :param in_place: poses of the fixed cameras of a rig file, and the number of cameras to place.
    :raises ConfigurationError: if the name of a topic is invalid, is given twice or is that of the
        fused cloud.
    """

    def __init__(self, node: Node, config: PolicyNodeConfig, commands: Commander,
                 answer: Callable[[np.ndarray, PoseArray], PoseArray], final: Callable[[], bool],
                 refuse: Callable[[ValueError], None], waits: Callable[[], bool],
                 expect: Callable[[np.ndarray, PoseArray, PoseArray], str],
                 plan_ahead: Callable[[], None], in_place: tuple[list[Pose], int]) -> None:
        self._waits = waits
        self._expect = expect
        self._plan_ahead = plan_ahead
        self._node = node
        self._config = config
        self._commands = commands
        self._answer = answer
        self._final = final
        self._refuse = refuse
        self._fused = FusedCloud(config.voxel_size, config.most_points)
        self._transforms = Transforms(node)
        self._in_place = in_place
        self._frames = CameraFrames(node, config.publish_tf, self._transforms.knows)
        self._await_turns()
        #: The newest cloud of each topic, unread.
        self._newest: dict[str, PointCloud2] = {}
        #: The newest poses, as a message and as a rig.
        self._poses: PoseArray | None = None
        self._rig: LiveRig | None = None
        #: The number of cameras and the frame of their poses, once a turn was answered.
        self._rig_size: tuple[int, str] | None = None
        self._command: PoseArray | None = None
        #: Of the command: targets, (K, 3) metres, and rotations (3, 3) of cameras that it rotates.
        self._sent: tuple[np.ndarray, dict[int, np.ndarray]] = np.empty((0, 3)), {}
        #: The poses at which the cameras stood when the turn was answered.
        self._began = PoseArray()
        self._instruction = self._expected = ''
        #: Of the last instruction: targets, positions and rotations, (K, 8) metres and radians.
        self._instructed = np.empty((0, 8))
        #: Number of turns that were decided, and for each topic the number of them with a cloud.
        self._decided = 0
        self._with_cloud = Counter[str]()
        self._observation = node.create_publisher(PointCloud2, topics.OBSERVATION, LOOP)
        if config.manual:
            self._instructions = node.create_publisher(String, topics.INSTRUCTIONS, LATCHED)
            self._markers = node.create_publisher(MarkerArray, topics.MARKERS, LATCHED)
        node.create_subscription(PoseArray, topics.CAMERA_POSES, self._on_poses, POSES)
        for topic, name in self._names(config.clouds).items():
            node.create_subscription(PointCloud2, name, partial(self._on_cloud, topic), SENSOR)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        # It is checked ten times a second whether a turn is due, also without messages.
        node.create_timer(0.1, self._act, clock=steady)
        self._resend_timer = node.create_timer(RESEND_S, self._resend, clock=steady)

    def _await_turns(self) -> None:
        """Begin to wait for cameras and clouds, without any data of earlier turns."""
        self._turns: Turns[PointCloud2] = Turns(self._config.clouds, *self._wait_limits()[:3])
        self._turns.change(*self._wait_limits())
        self._jumps = self._turns.jumps

    def _wait_limits(self) -> tuple[float, float, float, float, float]:
        """Return the arguments of ``Turns.change``: distance (m), three times (s), angle (rad)."""
        config = self._config
        return (config.arrival_distance,
                math.inf if config.manual else config.arrival_timeout, config.cloud_timeout,
                # With a final placement the same command need not be sent for every cloud.
                max(config.turn_seconds, RESEND_S if self._final() else 0.0), config.arrival_angle)

    def hold(self) -> None:
        """Command cameras that may be moving to stay where they are."""
        if self._poses is not None and self._command is not None and not self._turns.standing:
            self._commands.publish(self._poses)

    def reset(self) -> None:
        """Drop the fused cloud, the poses and the last command."""
        self._fused.clear()
        self._rig_size = self._command = self._poses = self._rig = None
        self._instruction = ''
        self._instructed = np.empty((0, 8))
        self._expected = ''
        self._decided = 0
        self._with_cloud = Counter()
        self._await_turns()

    def change(self, config: PolicyNodeConfig) -> None:
        """Continue with other parameters."""
        self._config = config
        self._turns.change(*self._wait_limits())

    def _names(self, clouds: list[str]) -> dict[str, str]:
        """Return the full names of the cloud topics, by their given names."""
        try:
            names = {topic: self._node.resolve_topic_name(topic) for topic in clouds}
        except rclpy_implementation.RCLError as error:
            raise ConfigurationError(f'cloud_topics: found {clouds}; expected names of topics '
                                     f'with commas between; {" ".join(str(error).split())}'
                                     ) from error
        own = self._node.resolve_topic_name(topics.OBSERVATION)
        if len(set(names.values())) < len(clouds) or own in names.values():
            raise ConfigurationError(
                f'cloud_topics: found {clouds}; expected each once, and not {own}, which is '
                'where the fused cloud goes')
        return names

    def _on_cloud(self, topic: str, message: PointCloud2) -> None:
        """Store a cloud, and play the turn if it is due."""
        self._newest[topic] = message
        self._turns.on_cloud(topic, stamp_to_ns(message.header.stamp), message)
        self._act()

    def _on_poses(self, message: PoseArray) -> None:
        """Store the camera poses, and play the turn if it is due."""
        try:
            rig = LiveRig(message.header.frame_id, msg_to_poses(message))
            self._check_same_rig(rig)
            if not stamp_to_ns(message.header.stamp):
                raise MessageError('poses: found the stamp 0; expected when the cameras were '
                                   'there, by the clock of the clouds')
        except MessageError as error:
            self._refuse(error)
            return
        if self._turns.on_poses(stamp_to_ns(message.header.stamp), rig.positions,
                                [pose.rotation for pose in rig.poses]):
            self._poses, self._rig = message, rig
            fixed, movable = self._in_place
            self._frames.publish(message.header, rig.poses + fixed[len(rig.poses) - movable:])
        self._act()

    def _check_same_rig(self, rig: LiveRig) -> None:
        """Refuse poses of another rig than the one that has been commanded."""
        found = len(rig.poses), rig.frame
        if self._rig_size not in (None, found):
            raise MessageError(
                f'poses: found {found[0]} cameras in the frame {found[1]!r}; expected '
                f'{self._rig_size[0]} in {self._rig_size[1]!r}, as before; for another rig start '
                f'{self._node.get_name()} again')

    def _act(self) -> None:
        """Read the clouds that this turn can use, and play the turn once it is due."""
        if self._jumps != self._turns.jumps:
            # The clock was set: the stamps of the transforms received so far are invalid.
            self._jumps = self._turns.jumps
            self._transforms.forget()
        late: list[str] = []
        while (taken := self._turns.take(late)) is not None:
            topic, message = taken
            try:
                self._fuse(message)
            except LateTransformError as error:
                # Transforms come on another topic than poses, and may still arrive.
                if self._turns.wait_on(topic, stamp_to_ns(message.header.stamp), message):
                    late.append(topic)
                else:
                    self._turns.refuse(topic)
                    self._refuse(error)
            except ValueError as error:
                self._turns.refuse(topic)
                self._refuse(error)
        if self._turns.due() and not self._waits():
            self._answer_turn()
        elif self._turns.stuck and not self._waits():
            self._node.get_logger().warning(
                f'{self._no_clouds()}; expected a cloud since the cameras stand, by the clock of '
                'the poses; waiting', throttle_duration_sec=5.0)
        elif self._turns.poses_missing and self._command is None and not self._waits():
            name = self._node.resolve_topic_name(topics.CAMERA_POSES)
            self._node.get_logger().warning(
                f'poses: found nothing on {name}; expected where the cameras are '
                '(geometry_msgs/msg/PoseArray); publish it, see docs/tasks/live_cameras.md; '
                'waiting', throttle_duration_sec=10.0)

    def _fuse(self, message: PointCloud2) -> None:
        """Add a camera's cloud to the fused cloud."""
        if self._final():
            return
        rig = self._rig._replace(poses=list(map(Pose, *self._turns.measured)),
                                 since=self._turns.since)
        points, cameras = placed(msg_to_cloud(message), message.header.frame_id, rig,
                                 self._transforms)
        self._fused.add(in_range(points, cameras, self._config.min_range, self._config.max_range))

    def _answer_turn(self) -> None:
        """Ask for the command of this turn, send it, and begin to wait for the cameras."""
        self._log_missing()
        header = Header(stamp=ns_to_stamp(self._turns.stamp), frame_id=self._rig.frame)
        poses = self._standing_poses(header)
        before = self._final()
        try:
            self._command = self._answer(self._fused.points, poses)
        except MessageError as error:
            # The fused points do not belong to one room any more, or there are none.
            self._fused.clear()
            self._turns.restarted()
            self._refuse(error)
            return
        if not self._final():
            self._decided += 1
            self._with_cloud.update(self._turns.used)
        if not before:
            self._observation.publish(cloud_to_msg(self._fused.points, header))
        self._began = poses
        self._send()
        if self._final():
            self._turns.change(*self._wait_limits())
        self._plan_ahead()

    def redirect(self, camera: int, pose: PoseMsg) -> None:
        """Send one camera to another pose in this turn; the others keep their targets."""
        if self._command is not None:
            self._command = replaced(self._command, camera, pose)
            # Since the last command no poses may have come.
            self._turns.positions = self._rig.positions
            self._send()

    def _send(self) -> None:
        """Send the command of this turn, and begin to wait for the cameras."""
        poses = self._began
        self._commands.publish(self._command)
        self._resend_timer.reset()
        targets = msg_to_positions(self._command)
        self._rig_size = len(targets), poses.header.frame_id
        turned = self._target_rotations(poses)
        if self._config.manual:
            self._expected = self._expect(self._fused.points, poses, self._command)
            self._instruct(self._rig.positions, targets, turned, poses.header)
        self._turns.sent(targets, turned, targets[:, 2] != msg_to_positions(poses)[:, 2])
        self._sent = targets, turned

    @property
    def gaps(self) -> str:
        """Return which topics brought clouds in less than half of the turns, in words."""
        return ', '.join(f'{topic} brought a cloud in {self._with_cloud[topic]} of '
                         f'{self._decided} turns' for topic in self._config.clouds
                         if 2 * self._with_cloud[topic] < self._decided)

    def _standing_poses(self, header: Header) -> PoseArray:
        """
        Return the poses at which the cameras stand.

        The pose of a camera that arrived is the commanded one: the measured pose has noise, and
        heights and headings copied from measurements would drift from turn to turn.
        """
        message = PoseArray(header=header)
        for camera, measured in enumerate(map(Pose, *self._turns.measured)):
            message.poses.append(self._reached_command(camera, measured)
                                 or self._measured(camera, measured))
        return message

    def _measured(self, camera: int, mean: Pose) -> PoseMsg:
        """Return a mean pose as a message; the newest pose unchanged if it equals the mean."""
        if all(map(np.array_equal, mean, self._rig.poses[camera])):
            return self._poses.poses[camera]
        return positions_to_msg(mean.position[None], Header(),
                                heading_of(mean.rotation)[None]).poses[0]

    def _reached_command(self, camera: int, measured: Pose) -> PoseMsg | None:
        """Return the commanded pose of a camera if the camera has arrived there; else None."""
        if self._command is None:
            return None
        sent = self._command.poses[camera]
        rotation = rotation_of(sent.orientation, f'command: camera {camera}')
        away = measured.position - [sent.position.x, sent.position.y, sent.position.z]
        near, turned = (min(limit, most) for limit, most in zip(
            (self._config.arrival_distance, self._config.arrival_angle), MAX_NOISE))
        there = (np.linalg.norm(away) <= near
                 and angle_between(measured.rotation, rotation) <= turned)
        return sent if there else None

    def _target_rotations(self, poses: PoseArray) -> dict[int, np.ndarray]:
        """Return the commanded rotations, (3, 3), of the cameras that the command rotates."""
        return {camera: rotation_of(goal.orientation, f'command: camera {camera}')
                for camera, (goal, now) in enumerate(zip(self._command.poses, poses.poses))
                if goal.orientation != now.orientation}

    def _resend(self) -> None:
        """Send the command again to cameras that have not arrived; update the instructions."""
        if self._waits():
            # These clouds will be old once other nodes stop commanding: wait for new ones then.
            self._turns.restarted()
        elif self._command is not None and not self._turns.standing:
            self._commands.publish(self._command)
            if self._config.manual and self._turns.positions is not None:
                self._instruct(self._turns.positions, *self._sent, self._poses.header)

    def _instruct(self, positions: np.ndarray, targets: np.ndarray,
                  turned: dict[int, np.ndarray], header: Header) -> None:
        """
        Publish which cameras a person has to move or rotate.

        :param positions: (K, 3) metres, present positions.
        :param targets: (K, 3) metres, target positions.
        :param turned: target rotations, (3, 3), of the cameras that are rotated.
        :param header: of the markers.
        """
        least = self._config.arrival_distance
        turns = np.zeros((len(targets), 2))
        for camera, rotation in turned.items():
            turns[camera] = way_between(heading_of(self._rig.poses[camera].rotation),
                                        heading_of(rotation))
        text = FINAL if self._final() else instructions(
            positions, targets, least, turns, self._config.arrival_angle, self._expected)
        # Publish new instructions only if the remaining moves changed by more than pose noise.
        left = np.column_stack([targets, positions, turns])
        # Poses that change by less than 5 cm and 0.05 radians need no new instructions.
        same = (self._instructed.shape == left.shape
                and (np.abs(left - self._instructed) < 0.05).all()
                and _asked(text) == _asked(self._instruction))
        if text != self._instruction and not same:
            self._instruction, self._instructed = text, left
            self._instructions.publish(String(data=text))
            self._markers.publish(
                move_markers(positions, targets, moving(positions, targets, least), header))
            self._node.get_logger().info(text)

    def _log_missing(self) -> None:
        """Log which data this turn lacks."""
        log = self._node.get_logger()
        if self._turns.silent():
            log.warning(f'{self._no_clouds()}; expected a cloud since the cameras stand; going on '
                        'without', throttle_duration_sec=1.0)
        if self._turns.overdue and self._turns.no_command_sent:
            log.warning('cameras: found them moving, or their poses noisy, ever since this node '
                        'began; expected them to stand still before the first turn; going on '
                        'from the mean of their poses', throttle_duration_sec=1.0)
        elif self._turns.overdue:
            log.warning('cameras: found that they have not arrived after '
                        f'{self._config.arrival_timeout:.1f} s; expected them within '
                        f'{self._config.arrival_distance} m of the commanded positions; the next '
                        'turn begins at their present positions', throttle_duration_sec=1.0)

    def _no_clouds(self) -> str:
        """Return which topics are silent, and why, in words."""
        return 'no clouds: ' + ', '.join(
            f'{topic} ({why})' for topic, why in self._turns.silent().items())

    def sighted(self) -> Sighting:
        """
        Return the newest cloud by camera: topic i is of camera i, unless its frame names another.

        :raises MessageError: if poses or clouds are missing or cannot be used.
        """
        if self._rig is None or not self._newest:
            what = topics.CAMERA_POSES if self._rig is None else 'a cloud'
            raise MessageError(f'cameras: found nothing on {what} yet; expected poses and clouds; '
                               'call it again when the cameras run')
        clouds = {}
        for number, topic in enumerate(self._config.clouds):
            if topic in self._newest:
                message = self._newest[topic]
                own = CAMERA_FRAME.fullmatch(message.header.frame_id)
                camera = int(own[1]) if own else number
                if camera < len(self._rig.poses):
                    points, _ = placed(msg_to_cloud(message), message.header.frame_id, self._rig,
                                       self._transforms)
                    clouds[camera] = in_body(points, self._rig.poses[camera])
        return Sighting(self._rig, clouds)

    def status(self) -> tuple[str, dict[str, object]]:
        """Return a warning, empty if all is well, and values to show."""
        silent, wrong = self._turns.silent(), ''
        if self._turns.poses_missing and not (
                self._config.manual and self._command is not None):
            wrong = f'nothing on {topics.CAMERA_POSES}'
        elif self._turns.backward():
            wrong = (f'stamps of {self._turns.backward()} go back: found two clocks, or one that '
                     'was set')
        elif silent:
            wrong = self._no_clouds()
        elif self._turns.overdue:
            wrong = 'the cameras do not stand still' if self._turns.no_command_sent else \
                'the cameras do not arrive'
        return wrong, {
            'silent_topics': ','.join(silent), 'late_turns': self._turns.late,
            'turns_with_clouds': ', '.join(f'{topic} {self._with_cloud[topic]}/{self._decided}'
                                           for topic in self._config.clouds),
            'clock_jumps': self._turns.jumps, 'fused_points': len(self._fused),
            'voxel_size': self._fused.edge}


def _asked(text: str) -> list[str]:
    """Return what an instruction asks for, without distances: the cameras, or to leave them."""
    return [line.partition(':')[0] for line in text.splitlines()]
