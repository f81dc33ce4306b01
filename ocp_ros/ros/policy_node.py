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
``policy_node``: answer each observation with the target poses of the cameras.

The turns come from a simulation or from live cameras: see
:mod:`ocp_ros.ros.policy.simulated_turns` and :mod:`ocp_ros.ros.policy.live_turns`. The node does
not import open3d, stable-baselines3 or matplotlib; with lookahead alone it does not import PyTorch
either. Each turn brings all the data that the node needs about the episode. Data from earlier
turns only improve its answers, so the node can be killed and restarted at any time.
"""

import os
from pathlib import Path
import sys
import time
from typing import TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.online.online_planner import Online
from ocp_ros.policy.agent_config import CheckpointError
from ocp_ros.rig.placement_file import created_by, Placed, Placement, placement_of, save_placement
from ocp_ros.rig.rig_file import Camera
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import (
    MessageError,
    msg_to_bytes,
    msg_to_positions,
    shortened,
    stamp_to_ns,
)
from ocp_ros.ros.interface.qos import LATCHED
from ocp_ros.ros.policy.commander import Commander
from ocp_ros.ros.policy.convergence import Convergence
from ocp_ros.ros.policy.decider import Decider
from ocp_ros.ros.policy.live_turns import LiveTurns
from ocp_ros.ros.policy.policy_config import MANUAL_DEFAULTS, PolicyNodeConfig
from ocp_ros.ros.policy.policy_views import PolicyViews
from ocp_ros.ros.policy.simulated_turns import SimulatedTurns, TurnInfo
from ocp_ros.ros.runtime import diagnostics
from ocp_ros.ros.runtime.managed_node import ManagedNode
from ocp_ros.ros.runtime.node_main import run
from ocp_ros.util.resources import find_model
from ocp_ros.util.threads import set_threads
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from std_msgs.msg import UInt8MultiArray
from std_srvs.srv import SetBool, Trigger

if TYPE_CHECKING:
    from ocp_ros.policy.checkpoint import Checkpoint
    from ocp_ros.policy.policy import Policy
    from ocp_ros.ros.policy.calibrator import Calibrator


def load_checkpoint(path: Path) -> 'Checkpoint':
    """Read weights; import PyTorch only here, since that takes long."""
    from ocp_ros.policy.checkpoint import Checkpoint
    return Checkpoint.load(path)


class PolicyNode(ManagedNode):
    """
    Answer turns with a planner.

    The placement is final when all turns are used up: cameras that stand still for some turns of
    the search may still move later.
    """

    def __init__(self, **kwargs) -> None:
        # Set before the constructor of the base class, which may configure the node.
        self._turns: SimulatedTurns | None = None
        self._live: LiveTurns | None = None
        self._calibrator: Calibrator | None = None
        self._paused = False
        super().__init__('policy_node', PolicyNodeConfig, {'manual': MANUAL_DEFAULTS}, **kwargs)

    def configure(self) -> None:
        """Read the weights and the rig, and subscribe to the topics; send no command yet."""
        set_threads(self.config.threads)
        # The planner, and the state of the episode.
        path = None if self.config.needs_no_weights else find_model(self.config.model)
        self._decider = Decider(
            self.config, None if path is None else load_checkpoint(path), self.get_logger())
        self._counts = {'turns_answered': 0, 'refused_messages': 0, 'weights_swapped': 0,
                        'weights_refused': 0}
        self._convergence = Convergence(self)
        self._start_episode(episode=0)
        self._commander = Commander(self)
        self._placement_publisher = self.create_publisher(PoseArray, topics.PLACEMENT, LATCHED)
        self._experiences = None
        if self.config.explore:
            from ocp_ros.ros.policy.experiences import Experiences
            # With ``explore`` the policy records its choices.
            self._experiences = Experiences(
                self, lambda: self.policy, self._answer_if_ready)  # type: ignore[return-value]
        # The source of the turns: live cameras or a simulation.
        if self.config.live_topics:
            self._live = LiveTurns(
                self, self.config, self._commander, self._decide, lambda: self._is_final,
                self._refuse, self._must_wait, self._decider.describe_gain, self._plan_ahead,
                self._decider.add_fixed_poses, lambda: self._decider.ranges)
        else:
            self._turns = SimulatedTurns(self, self._commander, self._decide, self._on_turn_info,
                                         self._refuse, self._must_wait, self._plan_ahead)
        if self._live is not None and self.config.scan:
            from ocp_ros.ros.policy.calibrator import Calibrator
            self._calibrator = Calibrator(self, self.config, self._decider,
                                          self._live.latest_clouds, lambda: self._is_final)
        if self.policy is not None:
            self.create_subscription(
                UInt8MultiArray, topics.POLICY_WEIGHTS, self._on_weights, LATCHED)
        # What a person sees and calls.
        self._views = PolicyViews(self, self._decider.models, live=self._live is not None,
                                  rig_state=self._decider.state if self._decider.rig else None)
        self.create_service(SetBool, '~/pause', self._on_pause)
        self.create_service(Trigger, '~/reset', self._on_reset)
        self._status_publisher = diagnostics.StatusPublisher(self, self._status)
        weights = 'no weights' if path is None else \
            f'weights of {path.name}: {self.policy.checkpoint.updates} updates'
        planner = 'exploring' if self.config.explore else self.config.planner
        cameras = f'live: {", ".join(self.config.live_topics)}' if self._live else 'simulation'
        self.get_logger().info(f'{planner}, {weights}, {cameras}')

    def activate(self) -> None:
        """Command the cameras as soon as no other node commands them."""
        self._commander.begin_checks(self._answer_if_ready)

    def deactivate(self) -> None:
        """Leave the cameras where they are, and let other nodes command them."""
        self._stop_cameras()
        self._commander.end_commands()

    def release(self) -> None:
        """Drop the weights, the rig and all observations."""
        if self._calibrator is not None:
            self._calibrator.close()
        self._live = self._turns = self._experiences = self._calibrator = None
        self._paused = False

    def _plan_ahead(self) -> None:
        """Let the planner plan ahead; after two seconds, stop it once a message waits."""
        # Planners need about a tenth of this time.
        checked_from = time.monotonic() + 2.0
        self._decider.plan_ahead(lambda: time.monotonic() > checked_from and has_message(self))

    @property
    def planner(self) -> Online:
        """Return the planner that chooses the moves."""
        return self._decider.planner

    @property
    def policy(self) -> 'Policy | None':
        """Return the policy that runs, if any."""
        return None if self._decider.explorer is None else self._decider.explorer.policy

    @property
    def _is_final(self) -> bool:
        """Return whether the placement is final."""
        return bool(self._convergence.final_reason)

    def _start_episode(self, episode: int) -> None:
        """Begin an episode without the data of the last episode."""
        self._decider.reset()
        self._episode = episode
        self._step = 0
        self._is_last_turn = False
        #: The final placement; None while there is none.
        self._final_poses: PoseArray | None = None
        self._convergence.begin_episode()
        self._convergence.publish_status(self._step, self.config)

    def apply_config(self, config: PolicyNodeConfig) -> None:
        """Continue with new parameters."""
        self._decider.apply_config(config)
        self._views.apply_models(self._decider.models)
        if self._live is not None:
            self._live.apply_config(config)
        if self._calibrator is not None:
            self._calibrator.apply_config(config)

    def _on_turn_info(self, info: TurnInfo) -> None:
        """Take the number of the turn, and whether it is the last, from a simulation."""
        # Step 0 always begins a new episode: a restarted simulation counts episodes from 1 again.
        if info.episode != self._episode or info.step == 0:
            self._start_episode(info.episode)
        self._step = info.step
        self._is_last_turn = info.is_last
        if info.answered_poses is not None:
            # The turn was answered before its data came; ``info.step`` does not count it.
            if self._is_last_turn:
                self._publish_placement(info.answered_poses)
            self._step += 1

    def _stop_cameras(self) -> None:
        """Command cameras that may be moving to stay where they are."""
        if self._live is not None and self.active and not self._commander.must_wait:
            self._live.hold_cameras()

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Pause if the request has ``data: true``, else continue."""
        if request.data and not self._paused:
            self._stop_cameras()
        self._paused = request.data
        self._answer_if_ready()
        response.success = True
        response.message = 'paused' if self._paused else 'going on'
        return response

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Begin a new placement of live cameras from their present poses."""
        if self._live is None:
            response.message = ('turns come from a simulation; expected live cameras; call '
                                '~/reset of sim_node')
            return response
        self._start_episode(self._episode + 1)
        self._live.reset()
        response.success = True
        response.message = 'a new placement begins'
        return response

    def _must_wait(self) -> bool:
        """Return whether this node must not command: it is not running, or waits for others."""
        return bool(not self.active or self._paused or self._commander.must_wait or (
            self._experiences and self._experiences.must_wait))

    def _answer_if_ready(self) -> None:
        """Answer the turn that waits, if there is one."""
        if self._turns is not None:
            self._turns.answer_if_ready()

    def _decide(self, cloud: np.ndarray, poses: PoseArray) -> PoseArray:
        """
        Return the command of a turn; publish a final placement, experience, views and status.

        :param cloud: the N points observed so far, (N, 3) float32, metres.
        :param poses: present poses of the cameras.
        :returns: the target poses of the cameras.
        :raises MessageError: if the turn cannot be used, see :meth:`Decider.check_turn`.
        """
        positions = msg_to_positions(poses)
        self._decider.check_turn(cloud, poses)
        if self._reason_to_finish():
            self._publish_placement(poses)
            if self._experiences:
                # The trainer needs the observation after the last choice: planning records it.
                self._decider.plan(cloud, poses, self._step)
        # A final placement stays as it is, even if measured poses differ from it.
        answer = self._decider.decide(cloud, poses, self._step) if self._final_poses is None else \
            PoseArray(header=poses.header, poses=self._final_poses.poses)
        target = msg_to_positions(answer)
        if self._final_poses is None:
            longest_move = np.linalg.norm(target - positions, axis=1).max()
            self._convergence.longest_move = longest_move
        if self._experiences:
            # Fixed cameras come last; the policy chooses nothing for them.
            movable_targets = target[:self._decider.count_movable(poses)]
            self._experiences.publish(stamp_to_ns(poses.header.stamp), self._step, movable_targets)
        self._counts['turns_answered'] += 1
        self._step += 1
        self._views.show_turn(cloud, poses)
        self._convergence.publish_status(self._step, self.config)
        return answer

    def _reason_to_finish(self) -> str:
        """Return why the placement is final; empty if it is not final yet."""
        return self._convergence.reason_to_finish(self._step, self._is_last_turn, self.config)

    def _publish_placement(self, poses: PoseArray) -> None:
        """Publish the final placement and why it is final; do nothing if that has been done."""
        if not self._is_final:
            self._convergence.final_reason = self._reason_to_finish()
            self._final_poses = poses
            self._convergence.missing_data = self._live.missing_data if self._live else ''
            self._placement_publisher.publish(poses)
            text = f'placement is {self._convergence.publish_status(self._step, self.config)}'
            if self._convergence.missing_data:
                self.get_logger().warning(text)
            else:
                self.get_logger().info(text)
            if self.config.placement_file:
                self._save_placement(self.config.placement_file, poses)

    def _save_placement(self, path: str, poses: PoseArray) -> None:
        """Write the placement to a file; log an error if that fails."""
        reasons = filter(None, (self._convergence.final_reason, self._convergence.missing_data))
        try:
            save_placement(path, make_placement(poses, self._decider, '; '.join(reasons)))
        except OSError as error:
            self.get_logger().error(f'placement_file: found {path}, which cannot be written '
                                    f'({error.strerror}); expected a file in a folder that can')
        else:
            self.get_logger().info(f'wrote {path}')

    def _on_weights(self, message: UInt8MultiArray) -> None:
        """Use new weights if they fit the policy; else keep the present weights."""
        from ocp_ros.policy.checkpoint import Checkpoint
        running = self.policy.checkpoint
        try:
            checkpoint = Checkpoint.from_bytes(msg_to_bytes(message), topics.POLICY_WEIGHTS)
            checkpoint.check_replaces(running)
        except CheckpointError as error:
            self._counts['weights_refused'] += 1
            self.get_logger().warning(
                f'weights refused: {shortened(error)}', throttle_duration_sec=1.0)
            return
        self._decider.explorer.use(self.policy.replaced(checkpoint))
        self._counts['weights_swapped'] += 1
        self.get_logger().info(
            f'weights swapped: {running.updates} -> {checkpoint.updates} updates')

    def _refuse(self, error: MessageError) -> None:
        """Count a message that cannot be used, and log why."""
        self._counts['refused_messages'] += 1
        self.get_logger().warning(
            f'message refused: {shortened(error)}', throttle_duration_sec=1.0)

    def _status(self) -> diagnostics.Status:
        """Return the status of the planner for diagnostics."""
        message = 'placement is final' if self._is_final else 'answering turns'
        missing_data = self._convergence.missing_data
        # One warning is shown, the first of: another node commands, the turns, cameras that stay,
        # drift, a final placement with gaps.
        warning, live_values = self._live.status() if self._live else (
            diagnostics.warn_of_crowd(self, topics.OBSERVATION, diagnostics.ONE_SIMULATION), {})
        drift_warning, drift_values = self._calibrator.status() if self._calibrator else ('', {})
        warning = warning or '; '.join(self._decider.stay_warnings) or drift_warning
        if not self.active or self._paused:
            message = 'paused' if self.active else 'inactive'
        else:
            warning = self._commander.conflict_warning() or warning or (
                missing_data and f'placement is final, with gaps: {missing_data}')
        checkpoint = None if self.policy is None else self.policy.checkpoint
        level = DiagnosticStatus.WARN if warning else DiagnosticStatus.OK
        return level, warning or message, {
            'planner': 'exploring' if self.config.explore else self.config.planner,
            'weights_run': (checkpoint and checkpoint.run) or '-',
            'weights_updates': 0 if checkpoint is None else checkpoint.updates, 'step': self._step,
            **self._convergence.diagnostic_values(), **self._counts, **live_values, **drift_values}


def has_message(node: Node) -> bool:
    """Return whether a message waits on a subscription of a node; do not read the message."""
    subscriptions = list(node.subscriptions)
    # As the executor of rclpy does it, but with subscriptions alone and without waiting. The zeros
    # are the numbers of guard conditions, timers, clients, services and events.
    with node.context.handle:
        wait_set = rclpy_implementation.WaitSet(len(subscriptions), 0, 0, 0, 0, 0,
                                                node.context.handle)
        wait_set.clear_entities()
        for subscription in subscriptions:
            wait_set.add_subscription(subscription.handle)
        wait_set.wait(0)
        return bool(wait_set.get_ready_entities('subscription'))


def make_placement(poses: PoseArray, decider: Decider, reason: str) -> Placement:
    """
    Make a placement from camera poses.

    :param poses: poses of the cameras, in the order of the rig.
    :param decider: has the rig of the rig file, or, without a rig file, the camera model.
    :param reason: why the placement is final.
    """
    created = {**created_by('policy_node'), 'final': reason}
    frame = poses.header.frame_id
    if decider.rig is not None:
        state = decider.state(poses)
        return placement_of(decider.rig, state.placement[:state.movable], created=created,
                            frame=frame)
    # Without a rig file the cameras are omnidirectional: their angles, degrees, have no meaning.
    model = decider.models[0]
    placed = tuple(Placed(Camera(f'camera_{number}', '', model), tuple(position), (0.0,) * 3,
                          'free')
                   for number, position in enumerate(msg_to_positions(poses).round(4).tolist()))
    return Placement(placed, created=created, frame=frame)


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    # The network is small: more threads would only take cores from the rest of the robot. PyTorch
    # reads this variable when it is imported; lookahead alone does not import it.
    os.environ['OMP_NUM_THREADS'] = '1'
    return run(PolicyNode, args)


if __name__ == '__main__':
    sys.exit(main())
