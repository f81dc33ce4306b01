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

"""One source of transitions for the trainer: the topics of one namespace, and its counts."""

from collections.abc import Callable
import time

from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.policy.agent_config import AgentConfig
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import (
    bytes_to_msg,
    fields_to_msg,
    MessageError,
    msg_to_bytes,
    msg_to_fields,
    msg_to_positions,
    ns_of,
    shortened,
    stamp_to_ns,
)
from ocp_ros.ros.interface.qos import LATCHED, RECORDER
from ocp_ros.training.encoded_environment import cameras_of, encoded_space
from ocp_ros.training.experience import Experience, ExperienceError, from_bytes
from ocp_ros.training.transitions import Assembler, Reward, Transition
from rclpy.node import Node
from rclpy.subscription import Subscription
from std_msgs.msg import Float64MultiArray, UInt8MultiArray


def arrays_of(agent: AgentConfig) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Return the shape and the type of each array of an observation."""
    return {name: (space.shape, space.dtype)
            for name, space in encoded_space(agent).spaces.items()}


def ends_of(agent: AgentConfig) -> dict[str, tuple[float, float]]:
    """Return the lowest and the highest value of each array of an experience."""
    # Moves are in units of the longest step, and random ones may be a little longer than 1.
    max_action = 10.0
    return {'actions': (-max_action, max_action), **{
        name: (space.low.min(), space.high.max())  # type: ignore[attr-defined]
        for name, space in encoded_space(agent).spaces.items()}}


def check_ends(experience: Experience, ends: dict[str, tuple[float, float]]) -> Experience:
    """
    Refuse values that no policy reads or chooses: one such value can ruin a whole training.

    :param ends: see :func:`ends_of`.
    :returns: the experience.
    :raises ExperienceError: if there is such a value.
    """
    for choice in experience.choices:
        for name, values in {**choice.observation, 'actions': choice.actions}.items():
            low, high = ends[name]
            if values.size and not (values.min() >= low and values.max() <= high):
                raise ExperienceError(
                    f'experience: found {name} from {values.min():g} to {values.max():g}; '
                    f'expected {low:g} to {high:g}; look who else publishes on this topic')
    return experience


def topic_of(namespace: str, name: str) -> str:
    """Return the full name of a topic in a namespace, such as ``/`` or ``/env_0``."""
    return f'{namespace.rstrip("/")}/{name}'


class Source:
    """
    Assemble the transitions of one namespace.

    :param node: gets the subscriptions and publishers; its log gets the warnings.
    :param namespace: full name.
    :param agent: defines the observations that the policies read.
    :param learn: takes a transition; returns whether there was room for it.
    :ivar counts: numbers of transitions that were taken, messages refused, transitions dropped.
    :ivar heard: when the last transition came, seconds of a steady clock.
    """

    def __init__(self, node: Node, namespace: str, agent: AgentConfig,
                 learn: Callable[[Transition], bool]) -> None:
        self._node = node
        self.namespace = namespace
        self._learn = learn
        self._expected, self._ends = arrays_of(agent), ends_of(agent)
        self._together = None if agent.map else cameras_of(agent)
        self.assembler = Assembler(last=agent.map)
        self.counts = {'transitions': 0, 'refused': 0, 'dropped': 0}
        self._newest = 0
        self.heard = time.monotonic()

        def topic(name: str) -> str:
            return topic_of(namespace, name)

        self._weights = node.create_publisher(
            UInt8MultiArray, topic(topics.POLICY_WEIGHTS), LATCHED)
        self._training = node.create_publisher(Float64MultiArray, topic(topics.TRAINING), LATCHED)
        self._subscriptions: list[Subscription] = []
        for kind, name, callback in (
                (Float64MultiArray, topics.REWARD, self._on_reward),
                (PoseArray, topics.CAMERA_POSES, self._on_poses),
                (UInt8MultiArray, topics.EXPERIENCE, self._on_experience)):
            self._subscriptions.append(node.create_subscription(
                kind, topic(name), self._guarded(callback), RECORDER))

    def _guarded(self, callback):
        """Wrap a callback: log why it refuses a message, so that the node continues."""
        def guarded(message):
            try:
                for transition in callback(message):
                    self.heard = time.monotonic()
                    self.counts['transitions' if self._learn(transition) else 'dropped'] += 1
            except (MessageError, ExperienceError) as error:
                self.counts['refused'] += 1
                self._node.get_logger().warning(
                    f'{self.namespace}: message refused: {shortened(error)}',
                    throttle_duration_sec=1.0)
        return guarded

    def _on_experience(self, message: UInt8MultiArray) -> list[Transition]:
        """Take the choices of the policy in a turn."""
        max_bytes = 1 << 24
        if len(message.data) > max_bytes:
            raise MessageError(f'experience: found {len(message.data)} bytes; expected at most '
                               f'{max_bytes}')
        found = from_bytes(msg_to_bytes(message), self._expected, self._together)
        return self.assembler.add_experience(check_ends(found, self._ends))

    def _on_poses(self, message: PoseArray) -> list[Transition]:
        """Take the camera positions of a turn."""
        return self.assembler.add_positions(
            stamp_to_ns(message.header.stamp), msg_to_positions(message))

    def _on_reward(self, message: Float64MultiArray) -> list[Transition]:
        """Take the reward of a turn; the first turn of an episode has no reward."""
        names = ('stamp_sec', 'stamp_nanosec', 'previous_sec', 'previous_nanosec', 'step',
                 'reward', 'terminated')
        fields = msg_to_fields(message, names)
        stamp, previous = ns_of(fields, 'stamp'), ns_of(fields, 'previous')
        if stamp < self._newest:
            # The simulation was restarted with a reset clock: equal stamps mean other turns now.
            self.assembler.clear()
        self._newest = stamp
        if fields['step'] < 1:
            return []
        shares = []
        while (name := topics.share_field(len(shares))) in fields:
            shares.append(fields[name])
        worth = [fields['reward'], *shares]
        # Comparisons with NaN are false, so NaN is refused as well.
        # The paper's penalty at its largest setting. Much larger rewards make the numbers of the
        # networks overflow, and the training is lost.
        max_reward = 1e9
        if not (np.abs(worth) <= max_reward).all():
            raise MessageError(
                f'reward: found reward and shares from {min(worth):g} to {max(worth):g}; expected '
                f'finite numbers within {max_reward:g}')
        return self.assembler.add_reward(Reward(
            previous, stamp, int(fields['step']), fields['reward'], tuple(shares),
            bool(fields['terminated'])))

    def close(self) -> None:
        """Destroy the subscriptions and publishers."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        for publisher in (self._weights, self._training):
            self._node.destroy_publisher(publisher)

    def send_weights(self, blob: bytes) -> None:
        """Publish weights."""
        self._weights.publish(bytes_to_msg(blob))

    def send_status(self, hold: bool, updates: int, behind: float) -> None:
        """Publish the state of the training, and the counts of this namespace."""
        self._training.publish(fields_to_msg(dict(zip(topics.TRAINING_FIELDS, (
            hold, updates, behind, *self.status().values()), strict=True))))

    def status(self) -> dict[str, int]:
        """Return the counts, in the order of ``TRAINING_FIELDS``."""
        assembler = self.assembler
        return {'turns': assembler.assembled, 'transitions': self.counts['transitions'],
                'incomplete': assembler.incomplete, 'inconsistent': assembler.inconsistent,
                'refused': self.counts['refused'], 'dropped': self.counts['dropped']}
