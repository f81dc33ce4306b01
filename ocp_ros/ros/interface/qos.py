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

from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)


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

#: Clouds of live cameras, from drivers of any profile: only the newest cloud is used.
SENSOR = _make_profile(ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE, 1)
