# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Quality of service: both ends of every topic, and the tests, take it from here."""

from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)


def _profile(reliability: ReliabilityPolicy, durability: DurabilityPolicy, depth: int
             ) -> QoSProfile:
    """Return a profile that keeps the last few messages."""
    return QoSProfile(
        reliability=reliability, durability=durability, history=HistoryPolicy.KEEP_LAST,
        depth=depth, liveliness=LivelinessPolicy.AUTOMATIC)


def _reliable(durability: DurabilityPolicy, depth: int) -> QoSProfile:
    """Return a reliable profile that keeps the last few messages."""
    return _profile(ReliabilityPolicy.RELIABLE, durability, depth)


#: Turns, commands and rewards: every one counts.
LOOP = _reliable(DurabilityPolicy.VOLATILE, 10)

#: The same for somebody who must not miss a turn while the loop does not wait for them.
RECORDER = _reliable(DurabilityPolicy.VOLATILE, 200)

#: The latest state for whoever comes late: scene, placement, weights, markers.
LATCHED = _reliable(DurabilityPolicy.TRANSIENT_LOCAL, 1)

#: Where live cameras are, from rigs of any profile: one subscription, so that none comes late.
POSES = _profile(ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE, 10)

#: Clouds of live cameras, from drivers of any profile: the newest counts, and no other.
SENSOR = _profile(ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE, 1)
