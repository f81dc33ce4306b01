# SPDX-License-Identifier: Apache-2.0
"""Quality of service: both ends of every topic, and the tests, take it from here."""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

#: Turns, commands and rewards: every one counts.
LOOP = QoSProfile(
    reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE,
    history=HistoryPolicy.KEEP_LAST, depth=10)

#: The latest state for whoever comes late: scene, placement, weights, markers.
LATCHED = QoSProfile(
    reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL,
    history=HistoryPolicy.KEEP_LAST, depth=1)

#: The loop's topics for somebody who must not miss a turn while the loop does not wait for them.
RECORDER = QoSProfile(
    reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE,
    history=HistoryPolicy.KEEP_LAST, depth=1000)
