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

from functools import partial
import os
from pathlib import Path
import sys
from typing import TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.online.online_planner import Online
from ocp_ros.policy.agent_config import CheckpointError
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import (
    MessageError,
    msg_to_bytes,
    msg_to_positions,
    shortened,
    stamp_to_ns,
)
from ocp_ros.ros.interface.frames import find_frame_prefix
from ocp_ros.ros.interface.qos import LATCHED
from ocp_ros.ros.interface.views import CloudView, observed_maps, PointMaps, RigView
from ocp_ros.ros.policy.convergence import Convergence
from ocp_ros.ros.policy.decider import Decider
from ocp_ros.ros.policy.live_turns import LiveTurns
from ocp_ros.ros.policy.policy_config import limits_of_turns, limits_text, PolicyNodeConfig
from ocp_ros.ros.policy.simulated_turns import SimulatedTurns
from ocp_ros.ros.policy.turn_source import Commander, TurnSource
from ocp_ros.ros.runtime.managed_node import ManagedNode, publish_diagnostics, Status
from ocp_ros.ros.runtime.node_main import run
from ocp_ros.scenes.scene import SceneError
from ocp_ros.search.plan import load_kernels
from ocp_ros.util.resources import find_model
from ocp_ros.util.threads import set_threads
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
        self._calibrator: Calibrator | None = None
        self.decider: Decider | None = None
        self._paused = False
        super().__init__('policy_node', PolicyNodeConfig, limits_of_turns, **kwargs)

    def configure(self) -> None:
        """Read the weights and the rig, and subscribe to the topics; send no command yet."""
        set_threads(self.config.threads)
        # The planner, and the state of the episode.
        path = None if self.config.needs_no_weights else find_model(self.config.model)
        self.decider = Decider(
            self.config, None if path is None else load_checkpoint(path), self.get_logger())
        # Otherwise the first turns would wait for them.
        load_kernels('lookahead' if path is None else 'learned')
        self._counts = {'turns_answered': 0, 'refused_messages': 0, 'weights_swapped': 0,
                        'weights_refused': 0}
        self._episode = 0
        self.commander = Commander(self)
        self.convergence = Convergence(self)
        self._experiences = None
        if self.config.explore:
            from ocp_ros.ros.policy.experiences import Experiences
            # With ``explore`` the policy records its choices.
            self._experiences = Experiences(self)
        # The source of the turns: live cameras or a simulation.
        self.source: TurnSource
        if self.config.live_topics:
            self.source = LiveTurns(self)
            from ocp_ros.ros.policy.calibrator import Calibrator
            self._calibrator = Calibrator(self, self.source)
        else:
            self.source = SimulatedTurns(self)
        #: The training run whose weights this node takes; empty until the first ones came.
        self._followed_run = ''
        if self.config.explore or self.config.follow_trainer:
            self.create_subscription(
                UInt8MultiArray, topics.POLICY_WEIGHTS, self._on_weights, LATCHED)
        # What a person sees and calls.
        self._make_views()
        self.create_service(SetBool, '~/pause', self._on_pause)
        self.create_service(Trigger, '~/reset', self._on_reset)
        self.create_service(Trigger, '~/arrived', partial(self._on_arrived, is_last=False))
        self.create_service(Trigger, '~/accept', partial(self._on_arrived, is_last=True))
        publish_diagnostics(self, self._status)
        weights = 'no weights' if path is None else \
            f'weights of {path.name}: {self.policy.checkpoint.origin}'
        live = self.config.live_topics
        cameras = f'live: {", ".join(live)}' if live else 'simulation'
        self.get_logger().info(f'{self._planner_name}, {weights}, {cameras}')
        if live:
            self.get_logger().info(limits_text(self.config))

    def _make_views(self) -> None:
        """Create the views; with a simulation, sim_node shows the rig."""
        #: Cloud and camera poses of the latest turn; None before the first one.
        self._shown_turn: tuple[np.ndarray, PoseArray] | None = None
        self._cloud_view = CloudView(
            self, topics.COVERAGE_CLOUD, topics.ERROR_CLOUD, self._observed_maps)
        self._rig_view = None
        if self.config.live_topics:
            self._rig_view = RigView(self, topics.RIG_MARKERS, self.decider.models,
                                     find_frame_prefix(self, self.config.frame_prefix))

    def activate(self) -> None:
        """Command the cameras as soon as no other node commands them."""
        self.commander.begin_checks()

    def deactivate(self) -> None:
        """Leave the cameras where they are, and let other nodes command them."""
        self._stop_cameras()
        self.commander.end_commands()

    def release(self) -> None:
        """Drop the weights, the rig and all observations."""
        if self._calibrator is not None:
            self._calibrator.close()
        if self.decider is not None:
            self.decider.close()
        self.decider = self.source = self._experiences = self._calibrator = None
        self._shown_turn = None
        self._paused = False

    @property
    def late_topics(self) -> list[str]:
        """Return the topics of commands and of live cameras."""
        live = self.config.live_topics
        return [topics.CAMERA_COMMANDS, *live, *map(topics.camera_info_of_image, live)]

    @property
    def planner(self) -> Online:
        """Return the planner that chooses the moves."""
        return self.decider.step.planner

    @property
    def policy(self) -> 'Policy | None':
        """Return the policy that runs, if any."""
        return None if self.decider.explorer is None else self.decider.explorer.policy

    @property
    def _planner_name(self) -> str:
        """Return what chooses the moves, in a word."""
        return 'exploring' if self.config.explore else self.config.planner

    def _begin_episode(self) -> None:
        """Begin an episode without the data of the last episode."""
        self.decider.reset()
        self.convergence.begin_episode()

    def apply_config(self, config: PolicyNodeConfig) -> None:
        """Continue with new parameters."""
        self.decider.apply_config(config)
        if self._rig_view is not None:
            self._rig_view.models = self.decider.models
        self.source.apply_config()

    def set_turn(self, episode: int, step: int, is_last: bool,
                 answered_poses: PoseArray | None = None) -> None:
        """
        Take the data of a turn from a simulation.

        :param episode: number of the episode.
        :param step: number of turns of the episode before this turn.
        :param is_last: whether this is the last turn of the episode.
        :param answered_poses: the camera poses, if the turn has been answered before its data
            came; else None.
        """
        # Step 0 always begins a new episode: a restarted simulation counts episodes from 1 again.
        if episode != self._episode or step == 0:
            self._episode = episode
            self._begin_episode()
        self.convergence.step = step
        self.convergence.simulation_ended = is_last
        if answered_poses is not None:
            if is_last:
                self.convergence.finish(answered_poses)
            # ``step`` does not count the answered turn.
            self.convergence.step += 1

    def _stop_cameras(self) -> None:
        """Command cameras that may be moving to stay where they are."""
        if self.active and not self.commander.must_wait:
            self.source.hold_cameras()

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Pause if the request has ``data: true``, else continue."""
        if request.data and not self._paused:
            self._stop_cameras()
        self._paused = request.data
        self.source.answer_if_ready()
        response.success = True
        response.message = 'paused' if self._paused else 'going on'
        return response

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Begin a new placement of live cameras from their present poses."""
        if not isinstance(self.source, LiveTurns):
            response.message = ('turns come from a simulation; expected live cameras; call '
                                '~/reset of sim_node')
            return response
        self._begin_episode()
        self.source.reset()
        response.success = True
        response.message = 'a new placement begins'
        return response

    def _on_arrived(self, request: Trigger.Request, response: Trigger.Response, is_last: bool
                    ) -> Trigger.Response:
        """End the turn of live cameras where they stand; it may be the last one."""
        if not isinstance(self.source, LiveTurns):
            response.message = 'turns come from a simulation; expected live cameras'
        elif self.convergence.is_final:
            response.message = 'the placement is final; expected one that is not; call ~/reset'
        elif not self.source.accept_arrival():
            response.message = 'found no targets yet; expected some; wait for the first command'
        else:
            # The turn is played by a timer, after this.
            self.convergence.accepted |= is_last
            response.success = True
            response.message = ('the placement becomes final' if is_last else 'the turn ends') + (
                ' where the cameras stand')
        return response

    @property
    def must_wait(self) -> bool:
        """Return whether this node must not command: it is not running, or waits for others."""
        return bool(not self.active or self._paused or self.commander.must_wait or (
            self._experiences and self._experiences.must_wait))

    def decide(self, cloud: np.ndarray, poses: PoseArray) -> PoseArray:
        """
        Return the command of a turn; publish a final placement, experience, views and status.

        :param cloud: the N points observed so far, (N, 3) float32, metres.
        :param poses: present poses of the cameras.
        :returns: the target poses of the cameras.
        :raises MessageError: if the turn cannot be used, see :meth:`Decider.check_turn`.
        """
        convergence = self.convergence
        self.decider.check_turn(cloud, poses)
        if convergence.reason_to_finish():
            convergence.finish(poses)
            if self._experiences:
                # The trainer needs the observation after the last choice: planning records it.
                self.decider.plan(cloud, poses, convergence.step)
        if convergence.final_poses is not None:
            # A final placement stays as it is, even if measured poses differ from it.
            answer = PoseArray(header=poses.header, poses=convergence.final_poses.poses)
        else:
            answer = self.decider.decide(cloud, poses, convergence.step)
            moves = msg_to_positions(answer) - msg_to_positions(poses)
            convergence.longest_move = np.linalg.norm(moves, axis=1).max()
        if self._experiences:
            # Fixed cameras come last; the policy chooses nothing for them.
            movable_targets = msg_to_positions(answer)[:self.decider.count_movable(poses)]
            self._experiences.publish(
                stamp_to_ns(poses.header.stamp), convergence.step, movable_targets)
        self.warn('turn', '')
        self._counts['turns_answered'] += 1
        convergence.step += 1
        self._show_turn(cloud, poses)
        convergence.publish_status()
        return answer

    def _show_turn(self, cloud: np.ndarray, poses: PoseArray) -> None:
        """Show a turn: the N points observed so far, (N, 3) metres, and the camera poses."""
        self._shown_turn = cloud, poses
        self._cloud_view.show_turn(poses.header)
        if self._rig_view is not None:
            self._rig_view.show_turn(poses.header, self.decider.all_poses(poses))

    def _observed_maps(self) -> PointMaps | None:
        """Return the maps of the latest turn; None if there is no turn or it cannot be used."""
        if self._shown_turn is None:
            return None
        cloud, poses = self._shown_turn
        try:
            return observed_maps(cloud, self.decider.all_poses(poses), self.decider.models)
        except (MessageError, SceneError):
            return None

    def _on_weights(self, message: UInt8MultiArray) -> None:
        """Use new weights if they fit the policy; else keep the present weights."""
        from ocp_ros.policy.checkpoint import Checkpoint
        running = self.policy.checkpoint
        try:
            checkpoint = Checkpoint.from_bytes(msg_to_bytes(message), topics.POLICY_WEIGHTS)
            checkpoint.check_replaces(running, self._followed_run)
        except CheckpointError as error:
            self._counts['weights_refused'] += 1
            self.get_logger().warning(
                f'weights refused: {shortened(error)}', throttle_duration_sec=1.0)
            return
        self.decider.explorer.use(self.policy.replaced(checkpoint))
        self._followed_run = checkpoint.run
        self._counts['weights_swapped'] += 1
        self.get_logger().info(
            f'weights swapped: {checkpoint.origin} in place of {running.origin}')

    def refuse(self, error: ValueError, source: str = 'turn') -> None:
        """Count a message that cannot be used, and warn why, until its source sends others."""
        self._counts['refused_messages'] += 1
        topic = '' if source in ('turn', topics.CAMERA_POSES) else f'{source}: '
        self.warn(source, f'message refused: {topic}{shortened(error)}')

    def _status(self) -> Status:
        """Return the status of the planner for diagnostics."""
        message = 'placement is final' if self.convergence.is_final else 'answering turns'
        missing_data = self.convergence.missing_data
        source_values = self.source.status()
        drift_warning, drift_values = self._calibrator.status() if self._calibrator else ('', {})
        # What is shown is the first of: another node commands, what the log warns of, cameras that
        # stay, drift, a final placement with gaps.
        is_running = self.active and not self._paused
        warning = (is_running and self.commander.conflict_warning()) or '; '.join(
            [*self.warnings.values()] or self.decider.stay_warnings) or drift_warning
        if not is_running:
            message = 'paused' if self.active else 'inactive'
        elif missing_data:
            warning = warning or f'placement is final, with gaps: {missing_data}'
        checkpoint = None if self.policy is None else self.policy.checkpoint
        level = DiagnosticStatus.WARN if warning else DiagnosticStatus.OK
        return level, warning or message, {
            'planner': self._planner_name,
            'weights_run': (checkpoint and checkpoint.run) or '-',
            'weights_updates': 0 if checkpoint is None else checkpoint.updates,
            **self.convergence.diagnostic_values(), **self._counts, **source_values,
            **drift_values}


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    # The network is small: more threads would only take cores from the rest of the robot. PyTorch
    # reads this variable when it is imported; lookahead alone does not import it.
    os.environ['OMP_NUM_THREADS'] = '1'
    return run(PolicyNode, args)


if __name__ == '__main__':
    sys.exit(main())
