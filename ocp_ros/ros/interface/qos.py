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

"""Quality of service profiles of all topics, for publishers, subscriptions and tests."""

from collections.abc import Callable

from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription


def _make_profile(reliability: ReliabilityPolicy, durability: DurabilityPolicy, depth: int
                  ) -> QoSProfile:
    """Return a profile that keeps the last ``depth`` messages."""
    return QoSProfile(
        reliability=reliability, durability=durability, history=HistoryPolicy.KEEP_LAST,
        depth=depth, liveliness=LivelinessPolicy.AUTOMATIC)


#: Turns, commands and rewards: no message may be lost.
LOOP = _make_profile(ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE, 10)

#: Turns and rewards for a recorder: it must not miss a turn, and the loop does not wait for it.
RECORDER = _make_profile(ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE, 200)

#: The latest state (scene, placement, weights, markers), also sent to late subscribers.
LATCHED = _make_profile(ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL, 1)

#: Poses of live cameras: a subscription with this profile matches publishers of any profile.
POSES = _make_profile(ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE, 10)

#: Clouds of live cameras: only the newest cloud is used. With this profile a subscription matches
#: drivers of any profile; see :class:`SensorSubscription`.
SENSOR = _make_profile(ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE, 1)
#: The same, for drivers that are all reliable.
RELIABLE_SENSOR = _make_profile(ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE, 1)


class SensorSubscription:
    """
    A subscription of sensor data that is reliable if all publishers are.

    A large message consists of many packets, of which a receive buffer of the usual size loses
    some. A reliable subscription asks for these again, but it receives nothing from publishers
    with best effort. Call :meth:`match` at intervals: publishers may come and go.

    :param node: gets the subscription.
    :param message_type: the type of its messages.
    :param topic: full name of the topic.
    :param callback: is called with the bytes of each message, not deserialised.
    """

    def __init__(self, node: Node, message_type: type, topic: str,
                 callback: Callable[[bytes], None]) -> None:
        self._node = node
        self._message_type = message_type
        self._topic = topic
        self._callback = callback
        self._is_reliable = False
        #: The subscription before the last change: until the next check, both receive.
        self._replaced: Subscription | None = None
        override = f'qos_overrides.{topic}.subscription.reliability'
        #: Whether the user has set the reliability; then it stays.
        self._is_fixed = override in node._parameter_overrides
        self._subscription = self._create(SENSOR)

    def _create(self, profile: QoSProfile) -> Subscription:
        """Create the subscription."""
        kinds = [QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH]
        if self._is_fixed:
            kinds.append(QoSPolicyKind.RELIABILITY)
        return self._node.create_subscription(
            self._message_type, self._topic, self._callback, profile, raw=True,
            qos_overriding_options=QoSOverridingOptions(kinds))

    def match(self) -> None:
        """Change the reliability if the present publishers ask for that."""
        if self._replaced is not None:
            self._node.destroy_subscription(self._replaced)
            self._replaced = None
        publishers = self._node.get_publishers_info_by_topic(self._topic)
        if self._is_fixed or not publishers:
            return
        is_reliable = all(publisher.qos_profile.reliability == ReliabilityPolicy.RELIABLE
                          for publisher in publishers)
        if is_reliable != self._is_reliable:
            self._is_reliable = is_reliable
            kind = 'reliable' if is_reliable else 'best effort'
            self._node.get_logger().info(
                f'{self._topic}: found publishers with {kind}; receiving the same way')
            self._replaced = self._subscription
            self._subscription = self._create(RELIABLE_SENSOR if is_reliable else SENSOR)
