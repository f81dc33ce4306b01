# SPDX-License-Identifier: Apache-2.0
"""
``policy_node``: answers each observation with where the cameras shall go.

It starts without open3d, stable-baselines3 or matplotlib, and keeps nothing about an episode but
the number of its turns, so it can be killed and restarted at any time.
"""

from dataclasses import dataclass
import sys

from geometry_msgs.msg import PoseArray
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64MultiArray, UInt8MultiArray
import torch

from ocp_ros.agent.checkpoint import Checkpoint, CheckpointError
from ocp_ros.agent.policy import Policy
from ocp_ros.configuration import setting
from ocp_ros.nodes import health, topics
from ocp_ros.nodes.conversions import (
    MessageError,
    msg_to_bytes,
    msg_to_cloud,
    msg_to_fields,
    msg_to_positions,
    ns_of,
    ns_to_stamp,
    positions_to_msg,
)
from ocp_ros.nodes.parameters import declare
from ocp_ros.nodes.qos import LATCHED, LOOP
from ocp_ros.nodes.runner import run
from ocp_ros.resources import find_model
from ocp_ros.simulation.moves import bounded_moves, kept_inside
from ocp_ros.simulation.space import Space


@dataclass(frozen=True)
class PolicyNodeConfig:
    """Parameters of ``policy_node``."""

    model: str = setting('default', 'path to weights, or the name of a model of the package')
    turns: int = setting(30, 'turns until the placement is final', 1, 100000)
    max_step: float = setting(0.5, 'farthest a camera moves in one turn, metres', 0.001, 10.0)
    wall_margin: float = setting(
        0.1, 'cameras stay this far inside the observed bounding box, metres', 0.0, 5.0)
    convergence_distance: float = setting(
        0.02, 'moves shorter than this count as standing still, metres', 0.0, 1.0)
    convergence_turns: int = setting(
        3, 'turns of standing still that make the placement final', 1, 1000)
    explore: bool = setting(
        False, "draw moves from the policy's distribution and never settle: for training")
    seed: int = setting(0, 'seed of the exploration', 0, 1 << 31)


class PolicyNode(Node):
    """Run a trained actor on observations."""

    def __init__(self, **kwargs) -> None:
        super().__init__('policy_node', **kwargs)
        self.config = declare(self, PolicyNodeConfig)
        path = find_model(self.config.model)
        self.policy = Policy(Checkpoint.load(path))
        self._rng = np.random.default_rng(self.config.seed) if self.config.explore else None
        self._cloud: PointCloud2 | None = None
        self._poses: PoseArray | None = None
        self._answer: PoseArray | None = None
        self._counts = {'turns_answered': 0, 'refused_messages': 0, 'weights_swapped': 0,
                        'weights_refused': 0}
        self._start_episode(episode=0)
        self._commands = self.create_publisher(PoseArray, topics.CAMERA_COMMANDS, LOOP)
        self._placement = self.create_publisher(PoseArray, topics.PLACEMENT, LATCHED)
        # First, so that a new episode is known before its first turn is answered.
        self.create_subscription(Float64MultiArray, topics.REWARD, self._on_reward, LOOP)
        self.create_subscription(PoseArray, topics.CAMERA_POSES, self._on_poses, LOOP)
        self.create_subscription(PointCloud2, topics.OBSERVATION, self._on_cloud, LOOP)
        self.create_subscription(
            UInt8MultiArray, topics.POLICY_WEIGHTS, self._on_weights, LATCHED)
        self._health = health.Health(self, self._status)
        self.get_logger().info(f'{path.name}: {self.policy.checkpoint.updates} updates')

    def _start_episode(self, episode: int) -> None:
        """Forget the turns of the last episode."""
        self._episode, self._step, self._still = episode, 0, 0
        self._over = self._settled = False

    def _on_reward(self, message: Float64MultiArray) -> None:
        """Learn from a simulation which turn it is; real cameras have no such topic."""
        try:
            fields = msg_to_fields(
                message, ('stamp_sec', 'stamp_nanosec', 'episode', 'step', 'truncated'))
        except MessageError as error:
            self._refuse(error)
            return
        # Step 0 is a new episode in any case: a restarted simulation counts from 1 again.
        if int(fields['episode']) != self._episode or int(fields['step']) == 0:
            self._start_episode(int(fields['episode']))
        self._step, self._over = int(fields['step']), bool(fields['truncated'])
        stamp = ns_to_stamp(ns_of(fields, 'stamp'))
        if self._over and self._answer is not None and self._answer.header.stamp == stamp:
            self._settle(self._poses)

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
        if self._answer is None or self._answer.header.stamp != poses.header.stamp:
            try:
                if cloud.header.frame_id != poses.header.frame_id:
                    raise MessageError(f'cloud: found the frame {cloud.header.frame_id!r}; '
                                       f'expected that of the poses, {poses.header.frame_id!r}')
                self._answer = self._decide(msg_to_cloud(cloud), msg_to_positions(poses), poses)
            except MessageError as error:
                self._refuse(error)
                return
            self._counts['turns_answered'] += 1
            self._step += 1
        self._commands.publish(self._answer)

    def _decide(self, cloud: np.ndarray, positions: np.ndarray, poses: PoseArray) -> PoseArray:
        """Choose where the cameras go, and say so once it is where they stay."""
        if len(cloud) == 0:
            raise MessageError('cloud: found no finite point; expected what the cameras see')
        if self._over or not self.config.explore and (
                self._step >= self.config.turns or self._still >= self.config.convergence_turns):
            self._settle(poses)
        target = positions.copy()
        if not self._settled:
            actions = self.policy.act(cloud, positions, self._rng)
            moves = bounded_moves(actions, self.config.max_step)
            if not np.isfinite(moves).all():
                self.get_logger().error('the policy gave NaN or inf; cameras stay where they are')
                moves[:] = 0.0
            # Nobody leaves the floor that was seen: beyond a wall one looks through its back.
            space = Space.of(cloud, float(np.median(positions[:, 2])), len(positions),
                             self.config.wall_margin)
            target[:, :2] = space.moved(positions[:, :2], moves, self.config.max_step)
        bounds = np.stack([cloud.min(axis=0), cloud.max(axis=0)]).astype(np.float64)
        target, _ = kept_inside(target, bounds, self.config.wall_margin)
        moved = np.linalg.norm(target - positions, axis=1).max()
        self._still = self._still + 1 if moved < self.config.convergence_distance else 0
        return positions_to_msg(target, poses.header)

    def _settle(self, poses: PoseArray) -> None:
        """Publish the placement, once per episode."""
        if not self._settled:
            self._settled = True
            self._placement.publish(poses)
            self.get_logger().info(f'placement is final after {self._step} turns')

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
        self.policy = Policy(checkpoint)
        self._counts['weights_swapped'] += 1
        self.get_logger().info(
            f'weights swapped: {running.updates} -> {checkpoint.updates} updates')

    def _refuse(self, error: MessageError) -> None:
        """Count a message that cannot be used and say why."""
        self._counts['refused_messages'] += 1
        self.get_logger().warning(f'message refused: {error}', throttle_duration_sec=1.0)

    def _status(self) -> health.Status:
        """Say what the policy is doing."""
        message = 'placement is final' if self._settled else 'answering turns'
        return health.OK, message, {
            'weights_run': self.policy.checkpoint.run or '-',
            'weights_updates': self.policy.checkpoint.updates, 'step': self._step, **self._counts}


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    # The network is small: more threads would only take cores from the rest of the robot.
    torch.set_num_threads(1)
    return run(PolicyNode, args)


if __name__ == '__main__':
    sys.exit(main())
