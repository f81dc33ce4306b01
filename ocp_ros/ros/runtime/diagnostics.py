# SPDX-License-Identifier: Apache-2.0
"""Diagnostics: each node says once a second how it is."""

from collections.abc import Callable, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

#: Level, message in a few words, values to show.
Status = tuple[bytes, str, Mapping[str, object]]


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
