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

"""Diagnostics: each node publishes its status once a second."""

from collections.abc import Callable, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

#: What is expected on a topic of turns: only one simulation sends them.
ONE_SIMULATION = 'one simulation, or their turns get mixed up'
#: Level, short message, values to show.
Status = tuple[bytes, str, Mapping[str, object]]


def crowd(node: Node, topic: str, expected: str, most: int = 1) -> str:
    """
    Return and log a warning if too many nodes publish on a topic.

    :param node: its ROS graph is read.
    :param topic: relative or full name.
    :param expected: the publishers that are expected, in words.
    :param most: largest number of publishers.
    :returns: the warning; empty if there are not too many publishers.
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
    :param status: is called once a second and returns the status.
    """

    def __init__(self, node: Node, status: Callable[[], Status]) -> None:
        self._node, self._status = node, status
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        # Steady time: the status is published even if /clock stops.
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
