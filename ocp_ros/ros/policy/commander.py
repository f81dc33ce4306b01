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
Commands to the cameras, sent by one policy alone: nodes count the publishers in the ROS graph.

A node creates its publisher only if the graph has no other publisher of the topic. It commands
once it has been the only one for a while, since discovery takes time. If several nodes create
publishers at the same moment, each discovers the others, destroys its publisher and checks again,
each at an interval of its own, drawn at random, so that one of them is the next to be alone. A
node that has commanded continues, even if another publisher appears.
"""

from collections.abc import Callable
import random
import time

from geometry_msgs.msg import PoseArray
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.qos import LOOP
from ocp_ros.ros.runtime import diagnostics
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode
from rclpy.publisher import Publisher

#: Seconds until a new node has discovered all others: with config/fastdds_local.xml nodes announce
#: themselves once a second.
DISCOVERY_S = 1.5
#: Seconds for which a new publisher is visible before it is used.
PUBLISHER_AGE_S = 0.5


class Commander:
    """
    Publish commands while no other node does.

    :param node: gets the publisher while it is active.
    """

    def __init__(self, node: LifecycleNode) -> None:
        self._node = node
        self._topic = node.resolve_topic_name(topics.CAMERA_COMMANDS)
        self._publisher: Publisher | None = None
        self._commanded = False
        self._ready = time.monotonic() + DISCOVERY_S

    def begin(self, go_on: Callable[[], None]) -> None:
        """
        Check until this node may command, at an interval that is drawn at random once.

        :param go_on: is called while this node may command and has not commanded yet.
        """
        self._go_on = go_on
        # The graph is checked every 0.15 to 0.35 s.
        self._node.create_timer(random.uniform(0.15, 0.35), self._look,
                                clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._look()

    def end(self) -> None:
        """Let other nodes command; the node destroys the entities created since :meth:`begin`."""
        if self._publisher is not None:
            # The longest wait for the acknowledgement of a node's last command.
            self._publisher.wait_for_all_acked(Duration(seconds=0.5))
        self._publisher, self._commanded = None, False

    def publish(self, message: PoseArray) -> None:
        """Command the cameras; call it only if ``waits`` is False."""
        self._commanded = True
        self._publisher.publish(message)

    @property
    def waits(self) -> bool:
        """Return whether this node may not command yet."""
        return not self._commanded and (
            self._publisher is None or time.monotonic() < self._ready or self._others > 0)

    @property
    def _others(self) -> int:
        """Return the number of other publishers of commands."""
        return self._node.count_publishers(self._topic) - (self._publisher is not None)

    def _look(self) -> None:
        """Create the publisher if there is no other, or destroy it if there is one."""
        if self._commanded:
            return
        if self._others > 0:
            if self._publisher is not None:
                self._node.destroy_publisher(self._publisher)
                self._publisher = None
        elif self._publisher is None:
            self._publisher = self._node.create_publisher(PoseArray, self._topic, LOOP)
            self._ready = max(self._ready, time.monotonic() + PUBLISHER_AGE_S)
        elif not self.waits:
            self._go_on()

    def wrong(self) -> str:
        """Return and log a warning if other nodes command; else return an empty text."""
        if self._publisher is None:
            return diagnostics.crowd(self._node, self._topic, 'one policy, so this one holds', 0)
        return diagnostics.crowd(self._node, self._topic, 'one policy')
