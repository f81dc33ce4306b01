# SPDX-License-Identifier: Apache-2.0
"""
``policy_node``: answers each observation with where the cameras shall go.

The turns are those of a simulation, or of live cameras: see :mod:`ocp_ros.nodes.live`. It starts
without open3d, stable-baselines3 or matplotlib. Whatever it needs to know about an episode comes
with each turn, and what it remembers of the turns before only makes its answers better, so it can
be killed and restarted at any time.
"""

import sys

from geometry_msgs.msg import PoseArray
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64MultiArray, UInt8MultiArray
import torch

from ocp_ros.agent.checkpoint import Checkpoint, CheckpointError
from ocp_ros.agent.encoder import Encoder
from ocp_ros.agent.policy import Policy
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.nodes import health, topics
from ocp_ros.nodes.commander import Commander
from ocp_ros.nodes.conversions import (
    MessageError,
    moved_to,
    msg_to_bytes,
    msg_to_cloud,
    msg_to_fields,
    msg_to_positions,
    ns_of,
    stamp_to_ns,
)
from ocp_ros.nodes.experiences import Experiences, RecordedPolicy
from ocp_ros.nodes.finality import Finality
from ocp_ros.nodes.live import LiveTurns
from ocp_ros.nodes.parameters import declare, follow
from ocp_ros.nodes.policy_config import LEARNED, PolicyNodeConfig
from ocp_ros.nodes.policy_views import PolicyViews
from ocp_ros.nodes.qos import LATCHED, LOOP
from ocp_ros.nodes.rig_guard import RigGuard
from ocp_ros.nodes.runner import run
from ocp_ros.planners.lookahead import Lookahead
from ocp_ros.planners.online import Learned, Online, ThenLookahead
from ocp_ros.resources import find_model
from ocp_ros.scenes.scene import LARGEST
from ocp_ros.simulation.moves import bounded_moves, kept_inside
from ocp_ros.simulation.space import Space

#: Parameters that a planner is made with and that may change.
PLANNED_WITH = ('max_step', 'max_range', 'wall_margin')


class Exploring(Learned):
    """Moves drawn from the distribution of a trained policy."""

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Choose the next moves; see :meth:`~ocp_ros.planners.online.Online.move`."""
        actions = self.policy.act(cloud, positions, turn, turns, self.rng)
        return bounded_moves(actions, self.max_step)


def make_planner(config: PolicyNodeConfig, checkpoint: Checkpoint | None
                 ) -> tuple[Online, Learned | None]:
    """
    Build what chooses the moves.

    :param config: which planner, and what it is told of the rig.
    :param checkpoint: weights of the policy; None where none is asked.
    :returns: the planner, and its part that runs the policy.
    """
    rng = np.random.default_rng(config.seed)
    rig = config.max_range, config.max_step, config.wall_margin
    settings = rng, config.max_step, config.max_range, config.wall_margin
    if checkpoint is None:
        return Lookahead(*settings), None
    encoder = Encoder(checkpoint.config, *rig)
    if config.explore:
        exploring = Exploring(RecordedPolicy(checkpoint, encoder), *settings)
        return exploring, exploring
    learned = Learned(Policy(checkpoint, encoder), *settings)
    if config.planner == LEARNED:
        return learned, learned
    return ThenLookahead(learned, Lookahead(*settings)), learned


class PolicyNode(Node):
    """
    Answer turns with a planner.

    The placement is final when the turns are used up. A policy that plays alone can be done
    earlier, when its cameras stand still; where lookahead plays the last turns, they are all
    played, since it refines what the policy has settled on, and cameras that stand still for some
    turns of its search may yet move.
    """

    def __init__(self, **kwargs) -> None:
        super().__init__('policy_node', **kwargs)
        self.config = declare(self, PolicyNodeConfig)
        path = None if self.config.weightless else find_model(self.config.model)
        self.planner, self._learned = make_planner(
            self.config, None if path is None else Checkpoint.load(path))
        self._cloud: PointCloud2 | None = None
        self._poses: PoseArray | None = None
        self._answer: PoseArray | None = None
        #: Stamp of the latest reward, nanoseconds.
        self._told: int | None = None
        self._counts = {'turns_answered': 0, 'refused_messages': 0, 'weights_swapped': 0,
                        'weights_refused': 0}
        self._finality = Finality(self)
        self._guard = RigGuard(self.config.rig_file, self.config.wall_margin) \
            if self.config.rig_file else None
        self._start_episode(episode=0)
        self._commands = self.create_publisher(PoseArray, topics.CAMERA_COMMANDS, LOOP)
        self._placement = self.create_publisher(PoseArray, topics.PLACEMENT, LATCHED)
        self._commander = Commander(self)
        self._experiences = Experiences(self, lambda: self.policy, self._act) \
            if self.config.explore else None
        self._live: LiveTurns | None = None
        if self.config.clouds:
            self._live = LiveTurns(
                self, self.config, self._commands, self._play, lambda: self._settled,
                self._refuse, self._waits)
        else:
            # First, so that a new episode is known before its first turn is answered.
            self.create_subscription(Float64MultiArray, topics.REWARD, self._on_reward, LOOP)
            self.create_subscription(PoseArray, topics.CAMERA_POSES, self._on_poses, LOOP)
            self.create_subscription(PointCloud2, topics.OBSERVATION, self._on_cloud, LOOP)
        if self._learned is not None:
            self.create_subscription(
                UInt8MultiArray, topics.POLICY_WEIGHTS, self._on_weights, LATCHED)
        self._views = PolicyViews(self, self._models(), self._live is not None)
        follow(self, self._change)
        self._health = health.Health(self, self._status)
        weights = 'no weights' if path is None else \
            f'weights of {path.name}: {self.policy.checkpoint.updates} updates'
        planner = 'exploring' if self.config.explore else self.config.planner
        cameras = f'live: {", ".join(self.config.clouds)}' if self._live else 'simulation'
        self.get_logger().info(f'{planner}, {weights}, {cameras}')

    @property
    def policy(self) -> Policy | None:
        """Return the policy that runs, if any."""
        return None if self._learned is None else self._learned.policy

    def _models(self) -> tuple[CameraModel, ...]:
        """Return what each camera sees, or one model for all."""
        if self._guard is not None:
            return self._guard.models
        return (CameraModel(self.config.min_range, self.config.max_range),)

    def _start_episode(self, episode: int) -> None:
        """Forget the turns of the last episode."""
        self.planner.reset()
        self._episode, self._step = episode, 0
        self._over = self._settled = False
        self._finality.begin()
        self._finality.say(self._step, self.config)

    def _change(self, config: PolicyNodeConfig) -> None:
        """Go on with other parameters; a planner that begins anew knows what it needs."""
        before, self.config = self.config, config
        if any(getattr(before, name) != getattr(config, name) for name in PLANNED_WITH):
            checkpoint = None if self.policy is None else self.policy.checkpoint
            self.planner, self._learned = make_planner(config, checkpoint)
        if self._guard is not None:
            self._guard.change_margin(config.wall_margin)
        self._views.change(self._models())
        if self._live is not None:
            self._live.change(config)

    def _on_reward(self, message: Float64MultiArray) -> None:
        """Learn from a simulation which turn it is; real cameras have no such topic."""
        try:
            fields = msg_to_fields(
                message, ('stamp_sec', 'stamp_nanosec', 'episode', 'step', 'truncated'))
        except MessageError as error:
            self._refuse(error)
            return
        stamp = ns_of(fields, 'stamp')
        if stamp == self._told:
            # The turn was sent again: an episode that began with it goes on.
            return
        self._told = stamp
        # Step 0 is a new episode in any case: a restarted simulation counts from 1 again.
        if int(fields['episode']) != self._episode or int(fields['step']) == 0:
            self._start_episode(int(fields['episode']))
        self._step, self._over = int(fields['step']), bool(fields['truncated'])
        if self._answer is not None and stamp_to_ns(self._answer.header.stamp) == stamp:
            if self._over:
                self._settle(self._poses)
            self._step += 1

    def _on_cloud(self, message: PointCloud2) -> None:
        """Keep the observation; act when its poses are here."""
        self._cloud = message
        self._act()

    def _on_poses(self, message: PoseArray) -> None:
        """Keep the poses; act when their observation is here."""
        self._poses = message
        self._act()

    def _act(self) -> None:
        """Answer a turn once both its messages are here; the same turn gets the same answer."""
        cloud, poses = self._cloud, self._poses
        if cloud is None or poses is None or cloud.header.stamp != poses.header.stamp:
            return
        if self._waits():
            return
        if self._answer is None or self._answer.header.stamp != poses.header.stamp:
            try:
                if cloud.header.frame_id != poses.header.frame_id:
                    raise MessageError(f'cloud: found the frame {cloud.header.frame_id!r}; '
                                       f'expected that of the poses, {poses.header.frame_id!r}')
                self._play(msg_to_cloud(cloud), poses)
            except MessageError as error:
                self._refuse(error)
                return
        self._commands.publish(self._answer)

    def _waits(self) -> bool:
        """Tell whether others command, or have to catch up, before this turn is answered."""
        if self._commander.first:
            self.get_logger().error(self._commander.wrong(), throttle_duration_sec=5.0)
        return bool(self._commander.first or self._commander.settling or (
            self._experiences and self._experiences.held))

    def _play(self, cloud: np.ndarray, poses: PoseArray) -> PoseArray:
        """Answer a turn: the points (N, 3) seen so far, and where the cameras are."""
        self._answer = self._decide(cloud, msg_to_positions(poses), poses)
        if self._experiences:
            self._experiences.tell(stamp_to_ns(poses.header.stamp), self._step,
                                   msg_to_positions(self._answer))
        self._counts['turns_answered'] += 1
        self._step += 1
        self._views.turn(cloud, poses)
        self._finality.say(self._step, self.config)
        return self._answer

    def _decide(self, cloud: np.ndarray, positions: np.ndarray, poses: PoseArray) -> PoseArray:
        """Choose where the cameras go, and say so once it is where they stay."""
        if len(cloud) == 0:
            raise MessageError('cloud: found no finite point; expected what the cameras see')
        bounds = corners_of(cloud).astype(np.float64)
        if (size := np.ptp(np.concatenate([bounds, positions]), axis=0).max()) > LARGEST:
            raise MessageError(f'cloud: found points and cameras {size:.0f} m apart; expected '
                               f'those of a room, within {LARGEST:.0f} m')
        movable = positions if self._guard is None else self._guard.movable(positions)
        if self._done():
            self._settle(poses)
            if self._experiences:
                # What would be chosen now belongs to the choice before: see what it led to.
                self._moves(cloud, positions)
        target = positions.copy()
        if not self._settled:
            # Nobody leaves the floor that was seen: beyond a wall one looks through its back.
            space = Space.of(cloud, float(np.median(movable[:, 2])), len(movable),
                             self.config.wall_margin)
            target[:len(movable), :2] = space.moved(
                movable[:, :2], self._moves(cloud, movable), self.config.max_step)
        target = self._held(cloud, positions, target, bounds)
        self._finality.moved(np.linalg.norm(target - positions, axis=1).max(), self.config)
        return moved_to(poses, target)

    def _held(self, cloud: np.ndarray, positions: np.ndarray, target: np.ndarray,
              bounds: np.ndarray) -> np.ndarray:
        """Bring targets (K, 3) to where cameras may be."""
        if self._guard is None:
            return kept_inside(target, bounds, self.config.wall_margin)[0]
        if self._settled:
            return positions.copy()
        target, _ = kept_inside(target, bounds, self.config.wall_margin)
        target = self._guard.hold(cloud, positions, target, self.config.max_step)
        if self._guard.held:
            self.get_logger().warning('; '.join(self._guard.held), throttle_duration_sec=5.0)
        return target

    def _moves(self, cloud: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Ask the planner for the next moves, (K, 2) metres; where it fails, cameras stay."""
        turns = self.config.turns
        try:
            moves = self.planner.move(cloud, positions, min(self._step, turns), turns)
        except Exception as error:
            # Planners know what to do without a room. What else may happen, this node goes on.
            failure = f'{type(error).__name__}: {error}'
        else:
            if np.isfinite(moves).all():
                return moves
            failure = 'moves of NaN or inf'
        self.get_logger().error(
            f'{self.config.planner}: found {failure}; cameras stay where they are')
        return np.zeros((len(positions), 2))

    def _done(self) -> bool:
        """Tell whether the cameras shall stay where they are."""
        return bool(self._why())

    def _why(self) -> str:
        """Say why the cameras shall stay where they are; nothing while they shall not."""
        return self._finality.reason(
            self._step, self._over, self.planner is self._learned, self.config)

    def _settle(self, poses: PoseArray) -> None:
        """Publish the placement, once per episode, and say why it is final."""
        if not self._settled:
            self._settled, self._finality.why = True, self._why()
            self._placement.publish(poses)
            self.get_logger().info(
                f'placement is {self._finality.say(self._step, self.config)}')

    def _on_weights(self, message: UInt8MultiArray) -> None:
        """Check new weights and swap them in whole, or keep those that run."""
        running = self.policy.checkpoint
        try:
            checkpoint = Checkpoint.from_bytes(msg_to_bytes(message), topics.POLICY_WEIGHTS)
            checkpoint.check_replaces(running)
        except CheckpointError as error:
            self._counts['weights_refused'] += 1
            self.get_logger().warning(f'weights refused: {error}')
            return
        # What the encoder remembers is the episode's, not the weights'.
        self._learned.policy = type(self.policy)(checkpoint, self.policy.encoder)
        self._counts['weights_swapped'] += 1
        self.get_logger().info(
            f'weights swapped: {running.updates} -> {checkpoint.updates} updates')

    def _refuse(self, error: MessageError) -> None:
        """Count a message that cannot be used and say why."""
        self._counts['refused_messages'] += 1
        self.get_logger().warning(f'message refused: {error}', throttle_duration_sec=1.0)

    def _status(self) -> health.Status:
        """Say what the planner is doing."""
        message = 'placement is final' if self._settled else 'answering turns'
        wrong, live = ('', {}) if self._live is None else self._live.status()
        if self._guard is not None and self._guard.held:
            wrong = wrong or '; '.join(self._guard.held)
        wrong = self._commander.wrong() or wrong
        run, updates = '-', 0
        if self.policy is not None:
            run, updates = self.policy.checkpoint.run or '-', self.policy.checkpoint.updates
        return health.WARN if wrong else health.OK, wrong or message, {
            'planner': self.config.planner, 'weights_run': run, 'weights_updates': updates,
            'step': self._step, **self._finality.values(), **self._counts, **live}


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    # The network is small: more threads would only take cores from the rest of the robot.
    torch.set_num_threads(1)
    return run(PolicyNode, args)


if __name__ == '__main__':
    sys.exit(main())
