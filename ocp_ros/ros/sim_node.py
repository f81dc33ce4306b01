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
``sim_node``: a simulated rig in a room, in lock-step with the node that commands it.

The stamp identifies a turn. The rig moves when a command with the stamp of its latest turn
arrives. It sends that turn again when no command comes, and ignores commands for older turns. So
either side can be killed and restarted, and the loop continues.
"""

from dataclasses import dataclass
import sys

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.geometry.cameras import heading_of, Pose
from ocp_ros.rig.motion import order_of
from ocp_ros.rooms.scene_source import make_scene, SceneConfig
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import (
    cloud_to_msg,
    fields_to_msg,
    MessageError,
    msg_to_positions,
    ns_to_stamp,
    positions_to_msg,
    rotation_of,
    shortened,
    stamp_to_ns,
)
from ocp_ros.ros.interface.frames import CameraFrames, find_frame_prefix, frame_prefix, publish_tf
from ocp_ros.ros.interface.qos import LATCHED, LOOP
from ocp_ros.ros.interface.views import CloudView, maps_of, RigView
from ocp_ros.ros.runtime.managed_node import (
    autostart,
    create_steady_timer,
    ManagedNode,
    ONE_SIMULATION,
    publish_diagnostics,
    Status,
    warn_of_crowd,
)
from ocp_ros.ros.runtime.node_main import run
from ocp_ros.scenes.scene import SceneError
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import make_problem
from ocp_ros.simulation.simulation_config import limits_by_rig, SimulationConfig
from ocp_ros.util.settings import group, MAX_SEED, setting
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64, Float64MultiArray, Header
from std_srvs.srv import Trigger


@dataclass(frozen=True)
class SimNodeConfig(SimulationConfig):
    """Parameters of ``sim_node``."""

    scene: SceneConfig = group(SceneConfig)
    seed: int = setting(0, 'seed of the start positions', 0, MAX_SEED)
    auto_reset: bool = setting(False, 'begin the next episode when one ends', running=True)
    resend_period: float = setting(0.5, 'time without a command after which the latest turn is '
                                   'sent again, seconds', 0.02, 60.0, running=True)
    frame_id: str = setting('map', 'frame of every message')
    publish_tf: bool = publish_tf()
    frame_prefix: str = frame_prefix()
    autostart: bool = autostart()


class SimNode(ManagedNode):
    """Publish a rig's observations, space coverage and depth error; move it as commanded."""

    def __init__(self, **kwargs) -> None:
        super().__init__('sim_node', SimNodeConfig, lambda given: {
            f'episode.{name}': limit
            for name, limit in limits_by_rig(given.get('rig_file', '')).items()}, **kwargs)

    def configure(self) -> None:
        """Read the room and place the cameras; send no turn yet."""
        self.problem = make_problem(make_scene(self.config.scene), self.config)
        self.simulator = self.problem.simulator
        self._rng = np.random.default_rng(self.config.seed)
        self._episodes = 0
        #: Stamps of the latest turn and of the turn before, nanoseconds; 0: no such turn.
        self._stamp = self._previous_stamp = 0
        self._counts = {'stale_commands': 0, 'refused_commands': 0, 'resent_turns': 0}
        self._make_publishers()
        self.create_subscription(PoseArray, topics.CAMERA_COMMANDS, self._on_command, LOOP)
        self.create_service(Trigger, '~/reset', self._on_reset)
        self._resend_timer = create_steady_timer(
            self, self.config.resend_period, self._on_command_timeout)
        publish_diagnostics(self, self._status)
        scene = self.simulator.scene
        models = self.problem.models
        self._scene_publisher.publish(cloud_to_msg(scene.points, self._header()))
        self.get_logger().info(
            f'{scene.name}: {len(scene)} points, ' + ' x '.join(f'{s:.1f}' for s in scene.size)
            + f' m, {len(models)} cameras')
        self._place_cameras()
        if not len(self.episode.observed):
            raise SceneError(
                f'{scene.name}: found no point within {max(m.max_range for m in models)} m of the '
                f'cameras at the centre, at {np.round(self.episode.placement[0, :3], 2).tolist()};'
                ' expected them inside the room; check scene.up, scene.scale and the height of '
                'the cameras')

    def activate(self) -> None:
        """Send the latest turn; the first time, begin the first turn."""
        if self._stamp:
            self._send_messages()
        else:
            self._publish_new_turn()

    def _make_publishers(self) -> None:
        """Create the publishers of the topics, of tf, and of the views."""
        self._observation_publisher = self.create_publisher(PointCloud2, topics.OBSERVATION, LOOP)
        self._poses_publisher = self.create_publisher(PoseArray, topics.CAMERA_POSES, LOOP)
        self._reward_publisher = self.create_publisher(Float64MultiArray, topics.REWARD, LOOP)
        self._coverage_publisher = self.create_publisher(Float64, topics.SPACE_COVERAGE, LOOP)
        self._error_publisher = self.create_publisher(Float64, topics.DEPTH_ERROR, LOOP)
        self._scene_publisher = self.create_publisher(PointCloud2, topics.SCENE, LATCHED)
        prefix = find_frame_prefix(self, self.config.frame_prefix)
        self._frames = CameraFrames(self, self.config.publish_tf, prefix)
        self._rig_view = RigView(self, topics.MARKERS, self.problem.models, prefix)
        self._cloud_view = CloudView(self, topics.TRUE_COVERAGE_CLOUD, topics.TRUE_ERROR_CLOUD,
                                     lambda: maps_of(self.simulator, self._camera_poses()))

    def _header(self) -> Header:
        """Return a header with the latest turn's stamp."""
        return Header(stamp=ns_to_stamp(self._stamp), frame_id=self.config.frame_id)

    def _place_cameras(self) -> None:
        """Place the cameras at the start poses of a new episode."""
        self.episode = Episode(self.problem, self._rng)
        self._episodes += 1
        self._rig_view.clear_trajectories()

    def _begin_episode(self) -> None:
        """Begin an episode and publish its first turn."""
        self._place_cameras()
        self._publish_new_turn()

    def _publish_new_turn(self) -> None:
        """Give the present turn of the episode a stamp, and publish it with its views."""
        self._previous_stamp = self._stamp
        # Strictly later than the last stamp, even if the clock stops or is set back.
        self._stamp = max(self.get_clock().now().nanoseconds, self._stamp + 1)
        self._turn_answered = False
        header = self._header()
        positions, headings = np.hsplit(self.episode.placement, [3])
        self._sent_poses = positions_to_msg(positions, header, headings)
        # The messages that are sent again if no command comes. The reward is the first: it shows a
        # policy that a new episode begins.
        self._turn_messages = (
            (self._reward_publisher, fields_to_msg(self._reward_fields())),
            (self._poses_publisher, self._sent_poses),
            (self._observation_publisher, cloud_to_msg(self.episode.observed_cloud, header)))
        self._send_messages()
        self._coverage_publisher.publish(Float64(data=self.episode.turn.space_coverage))
        self._error_publisher.publish(Float64(data=self.episode.turn.depth_error))
        self._rig_view.show_turn(header, self._camera_poses())
        self._frames.publish(header, self._camera_poses())
        self._cloud_view.show_turn(header)

    def _camera_poses(self) -> list[Pose]:
        """Return the poses of the cameras."""
        return [Pose.of(row) for row in self.episode.placement]

    def _reward_fields(self) -> dict[str, float]:
        """Return the fields of the reward topic, by name and in their order."""
        turn = self.episode.turn
        stamp, previous = ns_to_stamp(self._stamp), ns_to_stamp(self._previous_stamp)
        # Episodes end only at their turn limit.
        terminated = False
        # ``turn.terms`` has the reward, its two changes and its penalty.
        values = (stamp.sec, stamp.nanosec, previous.sec, previous.nanosec, self._episodes,
                  turn.step, *turn.terms, turn.space_coverage, turn.depth_error, terminated,
                  turn.truncated)
        # The order in which the policy chose the moves that led here; the first turn has none.
        order = order_of(turn.step - 1, len(turn.positions)) if turn.step else ()
        shares = {topics.share_field(number): share.reward
                  for number, share in enumerate(self.episode.shares(order))}
        return dict(zip(topics.REWARD_FIELDS, values, strict=True)) | shares

    def _send_messages(self) -> None:
        """Send the messages of the latest turn, and restart the timer for its command."""
        for publisher, message in self._turn_messages:
            publisher.publish(message)
        self._resend_timer.reset()

    def apply_config(self, config: SimNodeConfig) -> None:
        """Continue with new parameters, also within the episode."""
        self.simulator.config = config
        self.episode.config = config.episode
        self._resend_timer.timer_period_ns = int(config.resend_period * 1e9)
        self._resend_timer.reset()

    def _on_command_timeout(self) -> None:
        """Send the frames and the turn again: messages of the turn or its answer may be lost."""
        if self.active:
            now = Header(stamp=self.get_clock().now().to_msg(), frame_id=self.config.frame_id)
            self._frames.publish(now, self._camera_poses())
        # The last turn is sent until it is answered: the policy has to hear that it is the last.
        if self.active and not (self._turn_answered and self.episode.turn.truncated):
            self._counts['resent_turns'] += 1
            self._send_messages()

    def _on_command(self, message: PoseArray) -> None:
        """Move the cameras if the command answers the latest turn."""
        if not self.active or stamp_to_ns(message.header.stamp) != self._stamp:
            self._counts['stale_commands'] += 1
            return
        try:
            target = msg_to_positions(message, len(self.problem.models))
            headings = self._commanded_headings(message)
            if message.header.frame_id != self.config.frame_id:
                raise MessageError(f'command: found the frame {message.header.frame_id!r}; '
                                   f'expected {self.config.frame_id!r}')
        except MessageError as error:
            self._counts['refused_commands'] += 1
            self.warn('command', f'command refused: {shortened(error)}')
            return
        self.warn('command', '')
        self._turn_answered = True
        # The last turn of an episode needs an answer, but no camera moves any more.
        if self.episode.turn.truncated:
            return
        # Fixed cameras stay: their entries in a command are ignored.
        positions = self.episode.turn.positions
        self.episode.move(target[:len(positions)] - positions, headings)
        self._publish_new_turn()
        if self.episode.turn.truncated and self.config.auto_reset:
            self._begin_episode()

    def _commanded_headings(self, message: PoseArray) -> np.ndarray:
        """
        Return the headings of a command: (K, 3) yaw, pitch, roll in radians, K movable cameras.

        The orientation of an omnidirectional camera is ignored. A camera whose commanded
        quaternion equals the one that the turn sent keeps its heading exactly.
        """
        headings = self.episode.turn.headings.copy()
        poses = message.poses[:len(headings)]
        for camera, (pose, model) in enumerate(zip(poses, self.problem.models)):
            sent_pose = self._sent_poses.poses[camera]
            if not model.omnidirectional and pose.orientation != sent_pose.orientation:
                headings[camera] = heading_of(
                    rotation_of(pose.orientation, f'command: camera {camera}'))
        return headings

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Begin a new episode."""
        if not self.active:
            response.message = 'the node is inactive; expected it active; activate it'
            return response
        self._begin_episode()
        response.success = True
        response.message = f'episode {self._episodes}'
        return response

    def _status(self) -> Status:
        """Return the status of the loop for diagnostics."""
        turn = self.episode.turn
        message = 'episode over' if turn.truncated else 'waiting for commands'
        if not self.active:
            message = 'inactive'
        warn_of_crowd(self, topics.OBSERVATION, ONE_SIMULATION)
        warning = '; '.join(self.warnings.values())
        level = DiagnosticStatus.WARN if warning else DiagnosticStatus.OK
        return level, warning or message, {
            'episode': self._episodes, 'step': turn.step, **self._counts}


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(SimNode, args)


if __name__ == '__main__':
    sys.exit(main())
