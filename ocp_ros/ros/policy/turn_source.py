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

"""
Where the turns of ``policy_node`` come from, and its commands to the cameras.

One policy alone sends commands: nodes count the publishers in the ROS graph.

A node creates its publisher only if the graph has no other publisher of the topic. It commands
once its publisher has been the only one for a while, since discovery takes time. If several nodes
create publishers at the same moment, each discovers the others, destroys its publisher and checks
again, each at its own interval, which is drawn at random. So one of them is the first to find no
other publisher. A node that has commanded continues, even if another publisher appears.
"""

import random
import time
from typing import TYPE_CHECKING

from geometry_msgs.msg import PoseArray
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.qos import LOOP
from ocp_ros.ros.runtime.managed_node import create_steady_timer, warn_of_crowd
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.timer import Timer

if TYPE_CHECKING:
    from ocp_ros.ros.policy_node import PolicyNode

#: Seconds until a new node has discovered all others: with config/fastdds_local.xml nodes announce
#: themselves once a second.
DISCOVERY_S = 1.5
#: Seconds for which a new publisher is visible before it is used.
PUBLISHER_AGE_S = 0.5


class Commander:
    """
    Publish commands, as long as no other node publishes them.

    :param node: gets the publisher while it is active.
    """

    def __init__(self, node: 'PolicyNode') -> None:
        self._node = node
        self._topic = node.resolve_topic_name(topics.CAMERA_COMMANDS)
        self._publisher: Publisher | None = None
        self._timer: Timer | None = None
        self._has_commanded = False
        #: Time from which on this node may command.
        self._use_time = time.monotonic() + DISCOVERY_S

    def begin_checks(self) -> None:
        """
        Check at intervals whether this node may command; the interval is drawn at random once.

        At each check at which it may, until it has commanded, the turn that waits is answered.
        """
        # The graph is checked every 0.15 to 0.35 s.
        self._timer = create_steady_timer(
            self._node, random.uniform(0.15, 0.35), self._check_graph)
        self._check_graph()

    def end_commands(self) -> None:
        """Stop commanding, so that other nodes may."""
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
        if self._publisher is not None:
            # The last command must not get lost.
            self._publisher.wait_for_all_acked(Duration(seconds=0.5))
            self._node.destroy_publisher(self._publisher)
        self._publisher = self._timer = None
        self._has_commanded = False

    def publish(self, message: PoseArray) -> None:
        """Command the cameras; not allowed while ``must_wait`` is True."""
        self._has_commanded = True
        self._publisher.publish(message)

    @property
    def must_wait(self) -> bool:
        """Return whether this node may not command yet."""
        return not self._has_commanded and (
            self._publisher is None or time.monotonic() < self._use_time or self._rival_count > 0)

    @property
    def _rival_count(self) -> int:
        """Return the number of publishers of commands that other nodes have."""
        return self._node.count_publishers(self._topic) - (self._publisher is not None)

    def _check_graph(self) -> None:
        """Create or destroy the publisher as the graph allows; report if this node may command."""
        if self._has_commanded:
            return
        if self._rival_count > 0:
            if self._publisher is not None:
                self._node.destroy_publisher(self._publisher)
                self._publisher = None
        elif self._publisher is None:
            self._publisher = self._node.create_publisher(PoseArray, self._topic, LOOP)
            self._use_time = max(self._use_time, time.monotonic() + PUBLISHER_AGE_S)
        elif not self.must_wait:
            self._node.convergence.publish_status()
            self._node.source.answer_if_ready()

    def conflict_warning(self) -> str:
        """Warn if other nodes command too, and return the warning; else return an empty text."""
        if self._publisher is None:
            return warn_of_crowd(
                self._node, self._topic, 'one policy, so this one holds', max_publishers=0)
        return warn_of_crowd(self._node, self._topic, 'one policy')


class TurnSource:
    """
    A source of turns: live cameras or a simulation.

    It calls the methods ``decide`` and ``refuse`` of the node, and ``plan_ahead`` of its decider,
    and publishes the commands with the node's ``commander``.

    :param node: gets the subscriptions and timers, and answers the turns.
    """

    #: Topics that brought no cloud in many turns, in words; empty if there are none.
    missing_data = ''

    def __init__(self, node: 'PolicyNode') -> None:
        self._node = node

    def answer_if_ready(self) -> None:
        """Answer the turn that waits, if there is one."""

    def hold_cameras(self) -> None:
        """Command cameras that may be moving to stay where they are."""

    def apply_config(self) -> None:
        """Continue with the node's new parameters."""

    def status(self) -> dict[str, object]:
        """Update the warnings of the node, and return values to show in its diagnostics."""
        return {}
