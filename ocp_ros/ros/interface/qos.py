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

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING

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

if TYPE_CHECKING:
    from ocp_ros.ros.runtime.managed_node import ManagedNode


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
    A subscription of sensor data that has the type of the publishers, and is reliable if they are.

    It is created once there is a publisher: until then the type is not known.
    A large message consists of many packets, of which a receive buffer of the usual size loses
    some. A reliable subscription asks for these again, but it receives nothing from publishers
    with best effort. Call :meth:`match` at intervals: publishers may come and go.

    :param node: gets the subscription.
    :param message_types: the types that can be received, by their names.
    :param topic: full name of the topic.
    :param callback: is called with the type and the bytes of each message, not deserialised.
    """

    def __init__(self, node: 'ManagedNode', message_types: Mapping[str, type], topic: str,
                 callback: Callable[[type, bytes], None]) -> None:
        self._node = node
        self._message_types = message_types
        self._topic = topic
        self._callback = callback
        #: Name of the present message type, and whether the subscription is reliable.
        self._kind, self._is_reliable = '', False
        self._subscription: Subscription | None = None
        #: The subscription before the last change: until the next check, both receive.
        self._replaced: Subscription | None = None
        override = f'qos_overrides.{topic}.subscription.reliability'
        #: Whether the user has set the reliability; then it stays.
        self._is_fixed = override in node._parameter_overrides
        self.match()

    def _create(self) -> Subscription:
        """Create the subscription."""
        message_type = self._message_types[self._kind]
        kinds = [QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH]
        if self._is_fixed:
            kinds.append(QoSPolicyKind.RELIABILITY)
        return self._node.create_subscription(
            message_type, self._topic, partial(self._callback, message_type),
            RELIABLE_SENSOR if self._is_reliable else SENSOR, raw=True,
            qos_overriding_options=QoSOverridingOptions(kinds))

    def match(self) -> None:
        """Change the type and the reliability if the present publishers ask for that."""
        if self._replaced is not None:
            self._node.destroy_subscription(self._replaced)
            self._replaced = None
        publishers = self._node.get_publishers_info_by_topic(self._topic)
        if not publishers:
            return
        found = {publisher.topic_type for publisher in publishers}
        kind = next((kind for kind in self._message_types if kind in found), '')
        self._node.warn(f'type of {self._topic}', '' if kind else (
            f'{self._topic}: found {", ".join(found)}; expected one of '
            f'{", ".join(self._message_types)}; name another topic'))
        offered = {publisher.qos_profile.reliability for publisher in publishers}
        is_reliable = not self._is_fixed and offered == {ReliabilityPolicy.RELIABLE}
        if not kind or (kind, is_reliable) == (self._kind, self._is_reliable):
            return
        reliability = 'reliable' if is_reliable else 'best effort'
        self._node.get_logger().info(
            f'{self._topic}: found {kind} with {reliability}; receiving the same way')
        if kind == self._kind:
            self._replaced = self._subscription
        elif self._subscription is not None:
            # Subscriptions of two types cannot exist at the same time.
            self._node.destroy_subscription(self._subscription)
        self._kind, self._is_reliable = kind, is_reliable
        self._subscription = self._create()

    @property
    def message_type(self) -> type | None:
        """Return the type of its messages; None while there is no subscription."""
        return self._message_types.get(self._kind)
