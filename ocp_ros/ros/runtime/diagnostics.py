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
from ocp_ros.ros.runtime.managed_node import create_steady_timer
from rclpy.node import Node

#: Text for ``expected`` of :func:`warn_of_crowd` on a topic of turns.
ONE_SIMULATION = 'one simulation, or their turns get mixed up'
#: Level of a ``DiagnosticStatus``, short message, values to show by name.
Status = tuple[bytes, str, Mapping[str, object]]


def warn_of_crowd(node: Node, topic: str, expected: str, max_publishers: int = 1) -> str:
    """
    Log and return a warning if more nodes publish on a topic than expected.

    :param node: reads the ROS graph, and logs.
    :param topic: relative or full name.
    :param expected: which publishers are expected, in words for the warning.
    :param max_publishers: number of publishers that is expected at most.
    :returns: the warning; empty if there are not too many publishers.
    """
    publishers = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    if len(publishers) <= max_publishers:
        return ''
    names = sorted(f'{info.node_namespace.rstrip("/")}/{info.node_name}' for info in publishers)
    warning = (f'found publishers of {topic}: {", ".join(names)}; expected {expected}; end the '
               'others, or give each its own namespace (a node that was killed is found for up to '
               '20 s more)')
    node.get_logger().warning(warning, throttle_duration_sec=10.0)
    return warning


class StatusPublisher:
    """
    Publish a node's status on ``/diagnostics``.

    :param node: gets the publisher and a timer.
    :param make_status: is called once a second; returns the status.
    """

    def __init__(self, node: Node, make_status: Callable[[], Status]) -> None:
        self._node = node
        self._make_status = make_status
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        create_steady_timer(node, 1.0, self.publish)

    def publish(self) -> None:
        """Publish the status as it is now."""
        level, message, values = self._make_status()
        array = DiagnosticArray()
        array.header.stamp = self._node.get_clock().now().to_msg()
        array.status = [DiagnosticStatus(
            level=level, name=self._node.get_fully_qualified_name(), message=message,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])]
        self._publisher.publish(array)
