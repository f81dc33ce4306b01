# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether somebody waits for a node that is busy."""

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node


def has_news(node: Node) -> bool:
    """Tell whether a message waits on a subscription of a node; it is not taken."""
    subscriptions = list(node.subscriptions)
    with node.context.handle:
        waiting = rclpy_implementation.WaitSet(len(subscriptions), 0, 0, 0, 0, 0,
                                               node.context.handle)
        waiting.clear_entities()
        for subscription in subscriptions:
            waiting.add_subscription(subscription.handle)
        waiting.wait(0)
        return bool(waiting.get_ready_entities('subscription'))
