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

from collections.abc import Callable
import time

import numpy as np
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import bytes_to_msg, MessageError, msg_to_fields
from ocp_ros.ros.interface.qos import LATCHED, LOOP
from ocp_ros.ros.policy.recorded_policy import RecordedPolicy, RecordedValues
from ocp_ros.training.experience import Experience, to_bytes
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray, UInt8MultiArray

#: Seconds after which the policy stops waiting for a trainer that is silent.
MAX_SILENCE_S = 5.0


class Experiences:
    """
    Publish the observations and choices of a policy, and make it wait while a trainer is behind.

    :param node: gets the publisher and the subscription.
    :param policy: returns the policy that runs.
    :param go_on: is called when the trainer has caught up.
    """

    def __init__(self, node: Node, policy: Callable[[], RecordedPolicy | RecordedValues],
                 go_on: Callable[[], None]) -> None:
        self._policy, self._go_on = policy, go_on
        self._wait_began: float | None = None
        self._publisher = node.create_publisher(UInt8MultiArray, topics.EXPERIENCE, LOOP)
        node.create_subscription(Float64MultiArray, topics.TRAINING, self._on_training, LATCHED)
        node.create_timer(0.5, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    @property
    def must_wait(self) -> bool:
        """Return whether the next turn has to wait for the trainer."""
        return self._wait_began is not None and time.monotonic() - self._wait_began < MAX_SILENCE_S

    def _on_training(self, message: Float64MultiArray) -> None:
        """Read whether the trainer asks to wait; ignore a message that cannot be read."""
        try:
            hold = bool(msg_to_fields(message, ('hold',))['hold'])
        except MessageError:
            return
        before, self._wait_began = self._wait_began, time.monotonic() if hold else None
        if before is not None and not hold:
            self._go_on()

    def _look(self) -> None:
        """Continue without a trainer that has become silent."""
        if self._wait_began is not None and not self.must_wait:
            self._wait_began = None
            self._go_on()

    def publish(self, stamp: int, turn: int, targets: np.ndarray) -> None:
        """
        Publish the choices since the last call, if they are finite and for all cameras.

        With the map actor the choices of some cameras are enough: the others keep their targets.

        :param stamp: of the turn, nanoseconds.
        :param turn: number of turns of the episode before this one.
        :param targets: (K, 3) metres: commanded positions, without those of fixed cameras.
        """
        policy = self._policy()
        choices = policy.take()
        whole = policy.checkpoint.config.map or (
            sum(len(choice.actions) for choice in choices) == len(targets))
        if choices and whole and all(np.isfinite(choice.actions).all() for choice in choices):
            self._publisher.publish(bytes_to_msg(
                to_bytes(Experience(stamp, turn, targets, choices))))
