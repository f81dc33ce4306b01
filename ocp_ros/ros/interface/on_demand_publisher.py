# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Publishers of what is only made while somebody looks at it."""

from collections.abc import Callable
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks, QoSPublisherMatchedInfo
from rclpy.node import Node

from ocp_ros.ros.interface.qos import LATCHED


class OnDemand:
    """
    Publish the latest state, latched, while there are subscribers; who comes late gets it too.

    :param node: gets the publisher.
    :param kind: type of the messages.
    :param topic: their topic.
    :param make: makes the message of the latest state; None where there is nothing yet.
    """

    def __init__(self, node: Node, kind: type, topic: str, make: Callable[[], Any]) -> None:
        self._make = make
        #: Messages that were made.
        self.made = 0
        self._publisher = node.create_publisher(
            kind, topic, LATCHED,
            event_callbacks=PublisherEventCallbacks(matched=self._on_matched))

    @property
    def wanted(self) -> bool:
        """Return whether anybody listens."""
        return self._publisher.get_subscription_count() > 0

    def update(self) -> None:
        """Publish the latest state if anybody listens."""
        if self.wanted and (message := self._make()) is not None:
            self.made += 1
            self._publisher.publish(message)

    def _on_matched(self, info: QoSPublisherMatchedInfo) -> None:
        """Publish for somebody who has just come."""
        if info.current_count_change > 0:
            self.update()
