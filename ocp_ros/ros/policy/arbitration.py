# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Arbitration: of several policies for one rig, the one that came first commands it.

Each says twice a second since when it has been there, and all of them go by the same rule, so they
agree without asking anybody. Where the first one falls silent, the next one takes over. Words come
from a thread of their own: a node that thinks for long, as while kernels are compiled, is there.
"""

from contextlib import suppress
import threading
import time
import uuid

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.exceptions import InvalidHandle
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from std_msgs.msg import String

from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.qos import LOOP

#: Seconds between two words of a commander, how long one counts that says nothing more, and how
#: long a new node waits for the words of others whose commands could be meant.
PERIOD, EXPIRY, SETTLING = 0.5, 2.5, 1.5
#: Seconds after which a node that does nothing but think counts as stuck, and says no more.
STUCK = 180.0
#: The most others that are taken note of.
MOST = 100


class Arbitration:
    """
    Tell whether this node is the one that commands.

    :param node: sends commands on ``camera_commands``.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        #: Who was there first has the smaller name: since when, nanoseconds, and who it is.
        self._name = f'{time.time_ns():020} {uuid.uuid4().hex[:8]}'
        self._others: dict[str, tuple[str, float]] = {}
        self._began = time.monotonic()
        self._publisher = node.create_publisher(String, topics.COMMANDERS, LOOP)
        node.create_subscription(String, topics.COMMANDERS, self._on_word, LOOP)
        node.create_timer(PERIOD, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._word = String(data=f'{self._name} {node.get_fully_qualified_name()}')
        self._looked, self._end = self._began, threading.Event()
        self._thread = threading.Thread(target=self._talk, name='commander', daemon=True)
        self._publisher.publish(self._word)
        self._thread.start()

    def close(self) -> None:
        """Say no more; for good."""
        self._end.set()
        self._thread.join()

    def _talk(self) -> None:
        """Say again and again that this node is here."""
        # Where the ROS context is shut down nobody can be told anything.
        with suppress(InvalidHandle, rclpy_implementation.RCLError):
            while not self._end.wait(PERIOD):
                if time.monotonic() - self._looked < STUCK:
                    self._publisher.publish(self._word)

    def _look(self) -> None:
        """Forget those that are not here any more."""
        now = self._looked = time.monotonic()
        self._others = {other: (node, heard) for other, (node, heard) in self._others.items()
                        if now - heard < EXPIRY}

    def _on_word(self, message: String) -> None:
        """Take note of another node; what is no such word is nobody's."""
        since, _, rest = message.data.partition(' ')
        who, _, node = rest.partition(' ')
        name = f'{since} {who}'
        is_word = len(since) == 20 and since.isdecimal() and len(who) == 8
        if is_word and name != self._name and len(self._others) < MOST:
            self._others[name] = node[:200], time.monotonic()

    @property
    def first(self) -> str:
        """Return which other node commands, empty if this one does."""
        now = time.monotonic()
        before = {name: node for name, (node, heard) in self._others.items()
                  if name < self._name and now - heard < EXPIRY}
        return before[min(before)] if before else ''

    @property
    def settling(self) -> bool:
        """
        Return whether somebody else may have been there first who has not been heard yet.

        Whoever sends commands without a word, such as a person, is waited for no longer.
        """
        return (time.monotonic() - self._began < SETTLING
                and self._node.count_publishers(topics.COMMANDERS) > 1 + len(self._others))

    def wrong(self) -> str:
        """Return what is wrong, if anything."""
        return self.first and (
            f'found {self.first}, which commands these cameras already; expected one policy; '
            'this one holds still until the other ends')
