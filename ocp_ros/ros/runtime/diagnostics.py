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

"""Diagnostics: each node says once a second how it is."""

from collections.abc import Callable, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

#: Why only one simulation sends turns.
ONE_SIMULATION = 'one simulation, or their turns get mixed up'
#: Level, message in a few words, values to show.
Status = tuple[bytes, str, Mapping[str, object]]


def crowd(node: Node, topic: str, expected: str, most: int = 1) -> str:
    """
    Say so, here and in the log, if too many nodes publish on a topic.

    :param node: knows who is there.
    :param topic: relative or full name.
    :param expected: who should publish there.
    :param most: how many publishers there may be.
    :returns: a sentence, empty if there are not too many.
    """
    found = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    if len(found) <= most:
        return ''
    names = sorted(f'{one.node_namespace.rstrip("/")}/{one.node_name}' for one in found)
    wrong = (f'found publishers of {topic}: {", ".join(names)}; expected {expected}; end the '
             'others, or give each its own namespace (a node that was killed is found for up to '
             '20 s more)')
    node.get_logger().warning(wrong, throttle_duration_sec=10.0)
    return wrong


class Health:
    """
    Publish a node's status on ``/diagnostics``.

    :param node: the node.
    :param status: asked once a second.
    """

    def __init__(self, node: Node, status: Callable[[], Status]) -> None:
        self._node, self._status = node, status
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        # Steady time: a stopped /clock is no reason to fall silent.
        node.create_timer(1.0, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def publish(self) -> None:
        """Publish the status as it is now."""
        level, message, values = self._status()
        array = DiagnosticArray()
        array.header.stamp = self._node.get_clock().now().to_msg()
        array.status = [DiagnosticStatus(
            level=level, name=self._node.get_fully_qualified_name(), message=message,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])]
        self._publisher.publish(array)
