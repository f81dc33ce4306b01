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

from geometry_msgs.msg import Pose, PoseArray
import numpy as np
from ocp_ros.online.online_planner import Online
from ocp_ros.policy.agent_config import CheckpointError
from ocp_ros.policy.shipped_models import find_model
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
from ocp_ros.ros.interface.handles import CameraHandles
from ocp_ros.ros.interface.qos import LATCHED
from ocp_ros.ros.policy.commander import Commander
from ocp_ros.ros.policy.convergence import Convergence
from ocp_ros.ros.policy.decider import Decider
from ocp_ros.ros.policy.live_turns import LiveTurns
from ocp_ros.ros.policy.policy_config import BY_HAND, PolicyNodeConfig
from ocp_ros.ros.policy.policy_views import PolicyViews
from ocp_ros.ros.policy.simulated_turns import SimulatedTurns, TurnInfo
from ocp_ros.ros.runtime import diagnostics
from ocp_ros.ros.runtime.managed_node import ManagedNode
from ocp_ros.ros.runtime.node_main import run
from ocp_ros.util.threads import set_threads
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from std_msgs.msg import UInt8MultiArray
from std_srvs.srv import SetBool, Trigger

if TYPE_CHECKING:
    from ocp_ros.policy.checkpoint import Checkpoint
    from ocp_ros.policy.policy import Policy, ValuePolicy
    from ocp_ros.ros.policy.calibrator import Calibrator


def load_checkpoint(path: Path) -> 'Checkpoint':
    """Read weights; import PyTorch only now, since that takes long."""
    from ocp_ros.policy.checkpoint import Checkpoint
    return Checkpoint.load(path)


class PolicyNode(ManagedNode):
    """
    Answer turns with a planner.

    The placement is final when all turns are used up. A policy without lookahead can finish
    earlier, when its cameras stand still. With lookahead the node plays all turns: lookahead
    refines the placement that the policy has reached, and cameras that stand still for some turns
    of this search may still move later.
    """

    def __init__(self, **kwargs) -> None:
        self._turns: SimulatedTurns | None = None
        self._live: LiveTurns | None = None
        self._calibrator: Calibrator | None = None
        self._paused = False
        self._handles: CameraHandles | None = None
        super().__init__('policy_node', PolicyNodeConfig, {'manual': BY_HAND}, **kwargs)

    def configure(self) -> None:
        """Read the weights and the rig, and subscribe to the topics; send no command yet."""
        set_threads(self.config.threads)
        path = None if self.config.weightless else find_model(self.config.model)
        self._decider = Decider(
            self.config, None if path is None else load_checkpoint(path), self.get_logger())
        self._counts = {'turns_answered': 0, 'refused_messages': 0, 'weights_swapped': 0,
                        'weights_refused': 0}
        self._finality = Convergence(self)
        self._start_episode(episode=0)
        self._commands = Commander(self)
        self._placement = self.create_publisher(PoseArray, topics.PLACEMENT, LATCHED)
        self._experiences = None
        if self.config.explore:
            from ocp_ros.ros.policy.experiences import Experiences
            # With ``explore`` the policy is one that records its choices.
            self._experiences = Experiences(
                self, lambda: self.policy, self._go_on)  # type: ignore[return-value]
        if self.config.clouds:
            self._live = LiveTurns(
                self, self.config, self._commands, self._answer, lambda: self._is_final,
                self._refuse, self._waits, self._decider.expected, self._plan_ahead,
                self._decider.in_place)
        else:
            self._turns = SimulatedTurns(
                self, self._commands, self._answer, self._on_turn_info, self._refuse, self._waits,
                self._plan_ahead)
        if self._live is not None and self.config.scan:
            from ocp_ros.ros.policy.calibrator import Calibrator
            self._calibrator = Calibrator(self, self.config, self._decider, self._live.sighted,
                                          lambda: self._is_final)
        if self.policy is not None:
            self.create_subscription(
                UInt8MultiArray, topics.POLICY_WEIGHTS, self._on_weights, LATCHED)
        self._views = PolicyViews(self, self._decider.models, self._live is not None,
                                  self._decider.state if self._decider.rig else None)
        self._handles = CameraHandles(self, self._on_handle)
        self.create_service(SetBool, '~/pause', self._on_pause)
        self.create_service(Trigger, '~/reset', self._on_reset)
        self._health = diagnostics.Health(self, self._status)
        weights = 'no weights' if path is None else \
            f'weights of {path.name}: {self.policy.checkpoint.updates} updates'
        planner = 'exploring' if self.config.explore else self.config.planner
        cameras = f'live: {", ".join(self.config.clouds)}' if self._live else 'simulation'
        self.get_logger().info(f'{planner}, {weights}, {cameras}')

    def activate(self) -> None:
        """Command the cameras, unless another node does."""
        self._commands.begin(self._go_on)

    def deactivate(self) -> None:
        """Leave the cameras where they are, and let other nodes command them."""
        self._stop_cameras()
        self._commands.end()

    def release(self) -> None:
        """Drop the weights, the rig and all observations."""
        if self._calibrator is not None:
            self._calibrator.close()
        if self._handles is not None:
            self._handles.close()
        self._live = self._turns = self._experiences = self._calibrator = self._handles = None
        self._paused = False

    def _plan_ahead(self) -> None:
        """Let the planner plan ahead; after two seconds stop once a message waits."""
        # A planner needs a tenth of this time to plan ahead.
        undisturbed_until = time.monotonic() + 2.0
        self._decider.plan_ahead(lambda: time.monotonic() > undisturbed_until and has_news(self))

    @property
    def planner(self) -> Online:
        """Return the planner that chooses the moves."""
        return self._decider.planner

    @property
    def policy(self) -> 'Policy | ValuePolicy | None':
        """Return the policy that runs, if any."""
        return None if self._decider.learned is None else self._decider.learned.policy

    @property
    def _is_final(self) -> bool:
        """Return whether the placement is final."""
        return bool(self._finality.why)

    def _start_episode(self, episode: int) -> None:
        """Drop the data of the last episode and begin a new one."""
        self._decider.reset()
        self._episode = episode
        self._step = 0
        self._is_last_turn = False
        #: The final placement; None while there is none.
        self._final_poses: PoseArray | None = None
        self._finality.begin()
        self._finality.say(self._step, self.config)

    def change(self, config: PolicyNodeConfig) -> None:
        """Continue with other parameters."""
        self._decider.change(config)
        self._views.change(self._decider.models)
        if self._live is not None:
            self._live.change(config)
        if self._calibrator is not None:
            self._calibrator.change(config)

    def _on_turn_info(self, info: TurnInfo) -> None:
        """Take from a simulation which turn it is and whether it is the last."""
        # Step 0 always begins a new episode: a restarted simulation counts episodes from 1 again.
        if info.episode != self._episode or info.step == 0:
            self._start_episode(info.episode)
        self._step, self._is_last_turn = info.step, info.is_last
        if info.answered is not None:
            if self._is_last_turn:
                self._finish(info.answered)
            self._step += 1

    def _stop_cameras(self) -> None:
        """Command cameras that may be moving to stay where they are."""
        if self._live is not None and self.active and not self._commands.waits:
            self._live.hold()

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Pause or continue, as the request says."""
        if request.data and not self._paused:
            self._stop_cameras()
        self._paused = request.data
        self._go_on()
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
        response.success, response.message = True, 'a new placement begins'
        return response

    def _waits(self) -> bool:
        """Return whether an answer waits: node inactive or paused, other commander, or trainer."""
        return bool(not self.active or self._paused or self._commands.waits or (
            self._experiences and self._experiences.must_wait))

    def _go_on(self) -> None:
        """Answer the turn that waits, if there is one."""
        if self._turns is not None:
            self._turns.act()

    def _answer(self, cloud: np.ndarray, poses: PoseArray) -> PoseArray:
        """
        Answer a turn.

        :param cloud: (N, 3) float32, metres: the points observed so far.
        :param poses: of the cameras.
        :returns: the poses that the cameras are commanded to.
        """
        positions = msg_to_positions(poses)
        self._decider.check(cloud, poses)
        if self._final_reason():
            self._finish(poses)
            if self._experiences:
                # The last choice needs the observation that it led to: planning records it.
                self._decider.plan(cloud, poses, self._step)
        # A final placement stays as it is, even if measured poses differ from it.
        answer = self._decider.decide(cloud, poses, self._step) if self._final_poses is None else \
            PoseArray(header=poses.header, poses=self._final_poses.poses)
        target = msg_to_positions(answer)
        if self._final_poses is None:
            self._finality.moved(np.linalg.norm(target - positions, axis=1).max(),
                                 self._decider.widest, self.config)
        if self._experiences:
            # Fixed cameras come last; the policy chooses nothing for them.
            moved = target[:self._decider.movable(poses)]
            self._experiences.publish(stamp_to_ns(poses.header.stamp), self._step, moved)
        self._counts['turns_answered'] += 1
        self._step += 1
        self._views.turn(cloud, poses)
        self._handles.show(answer, self._decider.movable(poses))
        self._finality.say(self._step, self.config)
        return answer

    def _on_handle(self, camera: int, pose: Pose) -> None:
        """Command a camera to the pose to which a person has dragged its handle."""
        if not (self.active and not self._commands.waits) or self._is_final or self._experiences:
            return
        try:
            (self._live or self._turns).redirect(camera, pose)
        except MessageError as error:
            self._refuse(error)

    def _final_reason(self) -> str:
        """Return why the placement is final; empty while it is not."""
        return self._finality.reason(
            self._step, self._is_last_turn, self._decider.alone, self.config)

    def _finish(self, poses: PoseArray) -> None:
        """Publish the final placement, once per episode, and the reason why it is final."""
        if not self._is_final:
            self._finality.why = self._final_reason()
            self._final_poses = poses
            self._finality.gaps = self._live.gaps if self._live else ''
            self._placement.publish(poses)
            log = self.get_logger()
            (log.warning if self._finality.gaps else log.info)(
                f'placement is {self._finality.say(self._step, self.config)}')
            if self.config.placement_file:
                self._save(self.config.placement_file, poses)

    def _save(self, path: str, poses: PoseArray) -> None:
        """Write the placement to a file; log an error if that fails."""
        try:
            save_placement(path, placement_from(poses, self._decider, '; '.join(filter(None, (
                self._finality.why, self._finality.gaps)))))
        except OSError as error:
            self.get_logger().error(f'placement_file: found {path}, which cannot be written '
                                    f'({error.strerror}); expected a file in a folder that can')
        else:
            self.get_logger().info(f'wrote {path}')

    def _on_weights(self, message: UInt8MultiArray) -> None:
        """Check new weights and use them, or keep the weights that run."""
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
        self._decider.learned.policy = self.policy.replaced(checkpoint)
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
        message, gaps = 'answering turns', self._finality.gaps
        if self._is_final:
            message = 'placement is final'
        wrong, live = self._live.status() if self._live else (
            diagnostics.crowd(self, topics.OBSERVATION, diagnostics.ONE_SIMULATION), {})
        drifted, checks = self._calibrator.status() if self._calibrator else ('', {})
        wrong = wrong or '; '.join(self._decider.held) or drifted
        if not self.active or self._paused:
            message = 'paused' if self.active else 'inactive'
        else:
            wrong = self._commands.wrong() or wrong or (
                gaps and f'placement is final, with gaps: {gaps}')
        run, updates = '-', 0
        if self.policy is not None:
            run, updates = self.policy.checkpoint.run or '-', self.policy.checkpoint.updates
        return diagnostics.WARN if wrong else diagnostics.OK, wrong or message, {
            'planner': 'exploring' if self.config.explore else self.config.planner,
            'weights_run': run, 'weights_updates': updates,
            'step': self._step, **self._finality.values(), **self._counts, **live, **checks}


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    # The network is small: more threads would only take cores from the rest of the robot. PyTorch
    # reads this variable when it is imported; with lookahead alone it is not imported.
    os.environ['OMP_NUM_THREADS'] = '1'
    return run(PolicyNode, args)


if __name__ == '__main__':
    sys.exit(main())


def has_news(node: Node) -> bool:
    """Return whether a message waits on a subscription of a node; leave the message there."""
    subscriptions = list(node.subscriptions)
    with node.context.handle:
        waiting = rclpy_implementation.WaitSet(len(subscriptions), 0, 0, 0, 0, 0,
                                               node.context.handle)
        waiting.clear_entities()
        for subscription in subscriptions:
            waiting.add_subscription(subscription.handle)
        waiting.wait(0)
        return bool(waiting.get_ready_entities('subscription'))


def placement_from(poses: PoseArray, decider: Decider, why: str) -> Placement:
    """
    Make a placement from camera poses.

    :param poses: of the cameras, in the order of the rig.
    :param decider: has the rig of the rig file, or without one the camera model.
    :param why: reason why the placement is final.
    """
    created = {**created_by('policy_node'), 'final': why}
    frame = poses.header.frame_id
    if decider.rig is not None:
        state = decider.state(poses)
        return placement_of(decider.rig, state.placement[:state.movable], created=created,
                            frame=frame)
    model = decider.models[0]
    placed = tuple(Placed(Camera(f'camera_{number}', '', model), tuple(position), (0.0,) * 3,
                          'free')
                   for number, position in enumerate(msg_to_positions(poses).round(4).tolist()))
    return Placement(placed, created=created, frame=frame)
