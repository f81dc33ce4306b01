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
