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

from collections import deque
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
from ocp_ros.training.experience import (
    Assembler,
    Experience,
    ExperienceError,
    from_bytes,
    Reward,
    Transition,
)
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray, UInt8MultiArray


def array_types(agent: AgentConfig) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Return the shape and the type of each array of an observation, by its name."""
    return {name: (space.shape, space.dtype)
            for name, space in encoded_space(agent).spaces.items()}


def value_limits(agent: AgentConfig) -> dict[str, tuple[float, float]]:
    """Return the lowest and the highest value of each array of an experience, by its name."""
    # Random actions may be a little longer than 1, the longest step; much longer ones are refused.
    max_action = 10.0
    return {'actions': (-max_action, max_action), **{
        name: (space.low.min(), space.high.max())  # type: ignore[attr-defined]
        for name, space in encoded_space(agent).spaces.items()}}


def check_values(experience: Experience, limits: dict[str, tuple[float, float]]) -> Experience:
    """
    Refuse values that no policy can observe or choose: one such value can ruin a whole training.

    :param limits: see :func:`value_limits`.
    :returns: the experience.
    :raises ExperienceError: if there is such a value.
    """
    for choice in experience.choices:
        for name, values in {**choice.observation, 'actions': choice.actions}.items():
            low, high = limits[name]
            # Comparisons with NaN are false: NaN is refused as well.
            if values.size and not (values.min() >= low and values.max() <= high):
                raise ExperienceError(
                    f'experience: found {name} from {values.min():g} to {values.max():g}; '
                    f'expected {low:g} to {high:g}; look who else publishes on this topic')
    return experience


def topic_of(namespace: str, name: str) -> str:
    """Return the full name of a topic in a namespace, such as ``/`` or ``/env_0``."""
    return f'{namespace.rstrip("/")}/{name}'


class TransitionSource:
    """
    Assemble the transitions of one namespace from its messages.

    :param node: gets the subscriptions and publishers; its log gets the warnings.
    :param namespace: full name of the namespace.
    :param agent: defines the observations that the policies read.
    :param store_transition: stores a transition; returns False if it is dropped for lack of room.
    :ivar assembler: matches the messages of a turn.
    :ivar counts: numbers of transitions stored, messages refused, transitions dropped.
    :ivar error_ratios: of the last episodes: depth error at the end / at the start.
    :ivar idle_since: time of the last transition, seconds of a steady clock.
    """

    def __init__(self, node: Node, namespace: str, agent: AgentConfig,
                 store_transition: Callable[[Transition], bool]) -> None:
        self._node = node
        self.namespace = namespace
        self._store_transition = store_transition
        self._array_types = array_types(agent)
        self._value_limits = value_limits(agent)
        #: Number of cameras that choose together.
        self._cameras_per_choice = cameras_of(agent)
        self.assembler = Assembler()
        self.counts = {'transitions': 0, 'refused': 0, 'dropped': 0}
        #: Stamp of the latest reward, nanoseconds.
        self._newest_stamp = 0
        self.error_ratios: deque[float] = deque(maxlen=10)
        #: Depth error at the start of the present episode, metres; None if it is not known.
        self._first_error: float | None = None
        self.idle_since = time.monotonic()
        self._weights_publisher = node.create_publisher(
            UInt8MultiArray, topic_of(namespace, topics.POLICY_WEIGHTS), LATCHED)
        self._status_publisher = node.create_publisher(
            Float64MultiArray, topic_of(namespace, topics.TRAINING), LATCHED)
        self._subscriptions = [
            node.create_subscription(message_type, topic_of(namespace, name),
                                     self._store_transitions_of(callback), RECORDER)
            for message_type, name, callback in (
                (Float64MultiArray, topics.REWARD, self._on_reward),
                (PoseArray, topics.CAMERA_POSES, self._on_poses),
                (UInt8MultiArray, topics.EXPERIENCE, self._on_experience))]

    @property
    def topics(self) -> list[str]:
        """Return the full names of its topics."""
        return [self._weights_publisher.topic_name, self._status_publisher.topic_name,
                *(subscription.topic_name for subscription in self._subscriptions)]

    def _store_transitions_of(self, callback):
        """
        Return a callback that stores transitions, and that counts and logs messages it refuses.

        :param callback: returns the transitions that a message completes.
        """
        def store_or_refuse(message):
            try:
                for transition in callback(message):
                    self.idle_since = time.monotonic()
                    is_stored = self._store_transition(transition)
                    self.counts['transitions' if is_stored else 'dropped'] += 1
            except (MessageError, ExperienceError) as error:
                self.counts['refused'] += 1
                self._node.get_logger().warning(
                    f'{self.namespace}: message refused: {shortened(error)}',
                    throttle_duration_sec=1.0)
        return store_or_refuse

    def _on_experience(self, message: UInt8MultiArray) -> list[Transition]:
        """Add the choices of the policy in a turn; return the transitions that are complete."""
        # The choices of 64 cameras have less than 1 MB with the shipped network.
        max_bytes = 1 << 24
        if len(message.data) > max_bytes:
            raise MessageError(f'experience: found {len(message.data)} bytes; expected at most '
                               f'{max_bytes}')
        experience = from_bytes(msg_to_bytes(message), self._array_types, self._cameras_per_choice)
        return self.assembler.add_experience(check_values(experience, self._value_limits))

    def _on_poses(self, message: PoseArray) -> list[Transition]:
        """Add the camera positions of a turn; return the transitions that are complete."""
        return self.assembler.add_positions(
            stamp_to_ns(message.header.stamp), msg_to_positions(message))

    def _on_reward(self, message: Float64MultiArray) -> list[Transition]:
        """Add the reward of a turn; return the transitions that are complete."""
        names = ('stamp_sec', 'stamp_nanosec', 'previous_sec', 'previous_nanosec', 'step',
                 'reward', 'terminated')
        fields = msg_to_fields(message, names)
        stamp, previous = ns_of(fields, 'stamp'), ns_of(fields, 'previous')
        if stamp < self._newest_stamp:
            # The clock of the simulation was set back: another turn may get the stamp of a stored
            # one.
            self.assembler.clear()
        self._newest_stamp = stamp
        if fields['step'] < 1:
            # The first turn of an episode has no reward.
            self._first_error = fields.get('depth_error')
            return []
        # The message has share_0, share_1 and so on, up to the last camera.
        shares = []
        while (name := topics.share_field(len(shares))) in fields:
            shares.append(fields[name])
        rewards = [fields['reward'], *shares]
        # The largest penalty that can be configured. Much larger rewards would make the numbers of
        # the networks overflow.
        max_reward = 1e9
        # Comparisons with NaN are false: NaN is refused as well.
        if not (np.abs(rewards) <= max_reward).all():
            raise MessageError(f'reward: found reward and shares from {min(rewards):g} to '
                               f'{max(rewards):g}; expected finite numbers within {max_reward:g}')
        if fields.get('truncated') and self._first_error:
            ratio = fields.get('depth_error', np.nan) / self._first_error
            # These fields are not needed for the training, so they may be missing or wrong.
            if np.isfinite(ratio):
                self.error_ratios.append(ratio)
            # The last turn may be sent again.
            self._first_error = None
        return self.assembler.add_reward(Reward(
            previous, stamp, int(fields['step']), fields['reward'], tuple(shares),
            terminated=bool(fields['terminated'])))

    def close(self) -> None:
        """Destroy the subscriptions and publishers."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        for publisher in (self._weights_publisher, self._status_publisher):
            self._node.destroy_publisher(publisher)

    def send_weights(self, content: bytes) -> None:
        """Publish weights: the bytes of a checkpoint."""
        self._weights_publisher.publish(bytes_to_msg(content))

    def send_status(self, hold: bool, updates: int, behind: float) -> None:
        """
        Publish the state of the training, and the counts of this namespace.

        :param hold: whether policies have to wait.
        :param updates: number of gradient steps so far.
        :param behind: number of gradient steps that are due.
        """
        self._status_publisher.publish(fields_to_msg(dict(zip(topics.TRAINING_FIELDS, (
            hold, updates, behind, *self.status().values()), strict=True))))

    def status(self) -> dict[str, int]:
        """Return the counts by their names in ``TRAINING_FIELDS``, in this order."""
        assembler = self.assembler
        return {'turns': assembler.assembled, 'transitions': self.counts['transitions'],
                'incomplete': assembler.incomplete, 'inconsistent': assembler.inconsistent,
                'refused': self.counts['refused'], 'dropped': self.counts['dropped']}
