# SPDX-License-Identifier: Apache-2.0
"""
``trainer_node``: learns from the transitions that it overhears and publishes better weights.

It listens to observations, poses, commands and rewards, puts transitions together by stamp, and
trains in a thread of its own, so that no message waits for a gradient step.
"""

from dataclasses import dataclass
import sys
from typing import Any, NamedTuple

from geometry_msgs.msg import PoseArray
import numpy as np
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64MultiArray, UInt8MultiArray
import torch
import yaml

from ocp_ros.agent.checkpoint import Checkpoint
from ocp_ros.agent.config import AgentConfig
from ocp_ros.agent.encoder import Encoder
from ocp_ros.configuration import group, setting, to_nested
from ocp_ros.nodes import health, topics
from ocp_ros.nodes.conversions import (
    bytes_to_msg,
    MessageError,
    msg_to_cloud,
    msg_to_fields,
    msg_to_positions,
    ns_of,
    stamp_to_ns,
)
from ocp_ros.nodes.parameters import declare
from ocp_ros.nodes.qos import LATCHED, RECORDER
from ocp_ros.nodes.runner import run
from ocp_ros.resources import find_model
from ocp_ros.training.config import SacConfig
from ocp_ros.training.learner import Learner, LearnerConfig
from ocp_ros.training.transitions import Assembler, Bounded, Reward

REWARD_FIELDS = ('stamp_sec', 'stamp_nanosec', 'previous_sec', 'previous_nanosec', 'episode',
                 'step', 'reward', 'terminated')


@dataclass(frozen=True)
class TrainerNodeConfig(LearnerConfig):
    """Parameters of ``trainer_node``."""

    turns: int = setting(30, 'turns of an episode, as the policy has it', 1, 100000)
    max_step: float = setting(0.5, 'longest step of the policy, metres', 0.001, 10.0)
    max_range: float = setting(4.0, 'effective range of the cameras, metres', 0.1, 100.0)
    wall_margin: float = setting(
        0.1, 'cameras stay this far inside the observed bounding box, metres', 0.0, 5.0)
    agent: AgentConfig = group(AgentConfig)
    sac: SacConfig = group(SacConfig)


class Encoded(NamedTuple):
    """A turn as the network reads it, and where its cameras were: (K, 3) metres."""

    observation: dict[str, np.ndarray]
    positions: np.ndarray


class TurnEncoder:
    """
    Encode turns from parts that arrive on their own.

    Where the network reads what moves would change, a turn's inputs depend on what the cameras saw
    before: it waits for its step beside its cloud and its poses, and turns are encoded in the
    order of their stamps. One that lacks a part when a later one has all of them is left out; what
    its cameras covered is then not remembered. The cloud's inputs depend on the turn alone.

    :param encoder: encodes them.
    :param turns: of an episode.
    """

    def __init__(self, encoder: Encoder, turns: int) -> None:
        self.encoder, self.turns = encoder, turns
        self._ordered = encoder.config.world
        self._needed = {'cloud', 'positions'} | ({'number'} if self._ordered else set())
        self._waiting: Bounded = Bounded(16)
        self.clear()

    def clear(self) -> None:
        """Forget every turn that was encoded, as when the stamps begin anew."""
        self._latest, self._episode, self._step = -1, None, 0
        self.encoder.reset()

    def add(self, stamp: int, **parts: Any) -> Encoded | None:
        """
        Take parts of a turn.

        :param stamp: nanoseconds.
        :param parts: ``cloud`` (M, 3) float32 and ``positions`` (K, 3), metres, map frame, and
            ``number``, those of the episode and of the turn in it, from 0.
        :returns: the turn, if it can be encoded now.
        """
        have = self._waiting[stamp] = self._waiting.get(stamp, {}) | parts
        if not self._needed <= have.keys():
            return None
        del self._waiting[stamp]
        if self._ordered:
            if stamp <= self._latest:
                return None
            self._proceed(stamp, *have['number'])
        turn = min(self._step, self.turns)
        observation = self.encoder(have['cloud'], have['positions'], turn, self.turns)
        return Encoded(observation, have['positions'])

    def _proceed(self, stamp: int, episode: int, step: int) -> None:
        """Leave out the turns before, and forget their episode if another one has begun."""
        for other in [other for other in self._waiting if other < stamp]:
            del self._waiting[other]
        # The first turn may have been left out, and a restarted simulation counts from 1 again.
        if episode != self._episode or step <= self._step:
            self.encoder.reset()
        self._latest, self._episode, self._step = stamp, episode, step


class TrainerNode(Node):
    """Assemble transitions, train, publish weights."""

    def __init__(self, **kwargs) -> None:
        super().__init__('trainer_node', **kwargs)
        self.config = declare(self, TrainerNodeConfig)
        torch.set_num_threads(self.config.threads)
        start = Checkpoint.load(find_model(self.config.model)) if self.config.model else None
        self.learner = Learner(self.config, self.config.agent, self.config.sac, start)
        (self.learner.folder / 'config.yaml').write_text(
            yaml.safe_dump(to_nested(self.config), sort_keys=False))
        self.assembler = Assembler(self.config.max_step)
        self.turns = TurnEncoder(
            Encoder(self.config.agent, self.config.max_range, self.config.max_step,
                    self.config.wall_margin), self.config.turns)
        self._refused = self._published = self._newest = 0
        self._told = False
        self._weights = self.create_publisher(UInt8MultiArray, topics.POLICY_WEIGHTS, LATCHED)
        for kind, name, callback in (
                (Float64MultiArray, topics.REWARD, self._on_reward),
                (PoseArray, topics.CAMERA_POSES, self._on_turn_part),
                (PointCloud2, topics.OBSERVATION, self._on_turn_part),
                (PoseArray, topics.CAMERA_COMMANDS, self._on_command)):
            self.create_subscription(kind, name, self._guarded(callback), RECORDER)
        self.create_timer(0.1, self._publish_weights,
                          clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._health = health.Health(self, self._status)
        self.get_logger().info(f'run {self.learner.run}: {self.learner.updates} updates so far, '
                               f'checkpoints in {self.learner.folder}')

    def _guarded(self, callback):
        """Let a callback refuse its message with a reason; the node lives on."""
        def guarded(message):
            try:
                callback(message)
            except MessageError as error:
                self._refused += 1
                self.get_logger().warning(f'message refused: {error}', throttle_duration_sec=1.0)
        return guarded

    def _on_turn_part(self, message: PointCloud2 | PoseArray) -> None:
        """Keep an observation or its poses until the whole turn is here."""
        stamp = stamp_to_ns(message.header.stamp)
        if self.assembler.knows(stamp):
            return
        if isinstance(message, PointCloud2):
            cloud = msg_to_cloud(message)
            if len(cloud) == 0:
                raise MessageError('cloud: found no finite point; expected what the cameras see')
            self._take(stamp, cloud=cloud)
        else:
            self._take(stamp, positions=msg_to_positions(message, self.config.cameras))

    def _take(self, stamp: int, **parts: Any) -> None:
        """Take parts of a turn."""
        turn = self.turns.add(stamp, **parts)
        if turn is not None:
            self._learn(self.assembler.add_turn(stamp, *turn))

    def _on_command(self, message: PoseArray) -> None:
        """Take the command that answers a turn."""
        self._learn(self.assembler.add_command(
            stamp_to_ns(message.header.stamp), msg_to_positions(message, self.config.cameras)))

    def _on_reward(self, message: Float64MultiArray) -> None:
        """Take the number and the reward of a turn; the first one of an episode has none."""
        fields = msg_to_fields(message, REWARD_FIELDS)
        stamp, previous = ns_of(fields, 'stamp'), ns_of(fields, 'previous')
        if stamp < self._newest:
            # A restarted simulation on a clock that began anew: its stamps are other turns.
            self.assembler.clear()
            self.turns.clear()
        self._newest = stamp
        if not self.assembler.knows(stamp):
            self._take(stamp, number=(int(fields['episode']), int(fields['step'])))
        if fields['step'] > 0:
            self._learn(self.assembler.add_reward(
                Reward(previous, stamp, fields['reward'], bool(fields['terminated']))))

    def _learn(self, transitions: list) -> None:
        """Hand transitions over to the learner."""
        for transition in transitions:
            self.learner.add(transition)

    def _publish_weights(self) -> None:
        """Publish what the learner has made since the last look, or say why nothing comes."""
        if self.learner.failure is not None and not self._told:
            self._told = True
            self.get_logger().error(f'training stopped: {self.learner.failure!r}')
        checkpoint = self.learner.take_weights()
        if checkpoint is not None:
            self._published += 1
            self._weights.publish(bytes_to_msg(checkpoint.to_bytes()))

    def _status(self) -> health.Status:
        """Say how the training is."""
        learner, assembler = self.learner, self.assembler
        values = {'run': learner.run, 'transitions': assembler.assembled,
                  'incomplete': assembler.incomplete, 'inconsistent': assembler.inconsistent,
                  'refused_messages': self._refused, 'updates': learner.updates,
                  'weights_published': self._published}
        if learner.failure is not None:
            return health.ERROR, f'training stopped: {learner.failure!r}', values
        return health.OK, 'training', values

    def destroy_node(self) -> None:
        """Save before the node goes."""
        self.learner.close()
        super().destroy_node()


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(TrainerNode, args)


if __name__ == '__main__':
    sys.exit(main())
