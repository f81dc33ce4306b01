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

"""Experiences that an exploring policy publishes for a trainer, and its wait for the trainer."""

import time
from typing import TYPE_CHECKING

import numpy as np
from ocp_ros.policy.policy import Policy
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import bytes_to_msg, MessageError, msg_to_fields
from ocp_ros.ros.interface.qos import LATCHED, LOOP
from ocp_ros.ros.runtime.managed_node import create_steady_timer
from ocp_ros.training.experience import Choice, Experience, to_bytes
from std_msgs.msg import Float64MultiArray, UInt8MultiArray

if TYPE_CHECKING:
    from ocp_ros.ros.policy_node import PolicyNode

#: Seconds after which the policy stops waiting for a trainer that is silent.
MAX_SILENCE_S = 5.0


class RecordedPolicy(Policy):
    """A policy that records its observations and choices until they are taken."""

    def __init__(self, *args) -> None:
        super().__init__(*args)
        self._choices: list[Choice] = []

    def take_choices(self) -> list[Choice]:
        """Return the choices since the last call, in their order, and clear them."""
        choices = self._choices
        self._choices = []
        return choices

    def choose(self, encoded: dict[str, np.ndarray], rng: np.random.Generator | None = None
               ) -> np.ndarray:
        """Choose the next moves; see :meth:`~ocp_ros.policy.policy.Policy.choose`."""
        moves = super().choose(encoded, rng)
        self._choices.append(Choice(encoded, moves))
        return moves


class Experiences:
    """
    Publish the observations and choices of a policy, and make it wait while a trainer is behind.

    :param node: gets the publisher and the subscription; its policy is a recorded one.
    """

    def __init__(self, node: 'PolicyNode') -> None:
        self._node = node
        #: Time at which the trainer last asked the policy to wait (``hold``), by a steady clock;
        #: None if its last message did not ask for that.
        self._hold_time: float | None = None
        self._publisher = node.create_publisher(UInt8MultiArray, topics.EXPERIENCE, LOOP)
        node.create_subscription(Float64MultiArray, topics.TRAINING, self._on_training, LATCHED)
        create_steady_timer(node, 0.5, self._check_silence)

    @property
    def must_wait(self) -> bool:
        """Return whether the next turn has to wait for the trainer."""
        return self._hold_time is not None and time.monotonic() - self._hold_time < MAX_SILENCE_S

    def _on_training(self, message: Float64MultiArray) -> None:
        """Read whether the trainer asks to wait; ignore a message that cannot be read."""
        try:
            hold = bool(msg_to_fields(message, ('hold',))['hold'])
        except MessageError:
            return
        had_to_wait = self._hold_time is not None
        self._hold_time = time.monotonic() if hold else None
        if had_to_wait and not hold:
            self._node.source.answer_if_ready()

    def _check_silence(self) -> None:
        """Continue without a trainer that has become silent."""
        if self._hold_time is not None and not self.must_wait:
            self._hold_time = None
            self._node.source.answer_if_ready()

    def publish(self, stamp: int, turn: int, targets: np.ndarray) -> None:
        """
        Publish the choices of the policy since the last call, if they are complete and finite.

        :param stamp: stamp of the turn, nanoseconds.
        :param turn: number of turns of the episode before this one.
        :param targets: commanded positions of the K movable cameras, (K, 3) metres.
        """
        choices = self._node.policy.take_choices()  # type: ignore[attr-defined]
        complete = sum(len(choice.actions) for choice in choices) == len(targets)
        if choices and complete and all(np.isfinite(choice.actions).all() for choice in choices):
            self._publisher.publish(bytes_to_msg(
                to_bytes(Experience(stamp, turn, targets, choices))))
