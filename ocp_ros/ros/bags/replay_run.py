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

"""Run ``ocp replay`` with the options of its command line."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager, suppress
import signal
from typing import Any

import numpy as np
from ocp_ros.ros.bags.bag_files import Bag
from ocp_ros.ros.bags.bag_replay import choose_topics, Replay, ReplayOptions
from ocp_ros.ros.runtime.node_main import END_SIGNALS, stay_local
from ocp_ros.util.settings import ConfigurationError
import rclpy
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions


def options_of(arguments: argparse.Namespace) -> ReplayOptions:
    """
    Read the options of the command line.

    :raises ConfigurationError: if a pose is malformed.
    """
    # TOPIC=FRAME names the frame of one topic, and FRAME that of all others.
    frames = [(topic, frame) for topic, _, frame in (
        text.rpartition('=') for text in arguments.frame)]
    return ReplayOptions(topics=tuple(arguments.topics), rate=arguments.rate, loop=arguments.loop,
                         start=arguments.start, duration=arguments.duration, frames=tuple(frames),
                         poses=tuple(map(pose_of, arguments.pose)),
                         fixed_frame=arguments.fixed_frame.lstrip('/'), wait=arguments.wait)


def pose_of(text: str) -> np.ndarray:
    """
    Read a pose from a text of three to six numbers, in metres and degrees.

    :param text: x, y, z and, if not 0, yaw, pitch, roll, with commas between.
    :returns: (6,) x, y, z, yaw, pitch, roll: metres and radians.
    :raises ConfigurationError: if the pose is malformed.
    """
    try:
        numbers = [float(number) for number in text.split(',')]
    except ValueError:
        numbers = []
    if not 3 <= len(numbers) <= 6 or not np.isfinite(numbers).all():
        raise ConfigurationError(f'--pose: found {text!r}; expected three to six numbers with '
                                 'commas between; write, for example, --pose 1.0,2.0,1.9,90,20,0')
    pose = np.zeros(6)
    pose[:len(numbers)] = numbers
    pose[3:] = np.deg2rad(pose[3:])
    return pose


def describe_topics(bag: Bag) -> list[dict[str, Any]]:
    """Return a description of each topic of a bag, with the name under which it is published."""
    # A bag without clouds, of which no topic would be published, is described too.
    chosen: dict[str, tuple[str, str]] = {}
    with suppress(ConfigurationError):
        chosen = choose_topics(bag, ())
    return [{'topic': topic.name, 'type': topic.kind.replace('/msg/', '/'),
             'messages': topic.count, 'frames': list(bag.frames(topic)),
             'published_as': chosen.get(topic.name, ('', None))[1]} for topic in bag.topics]


@contextmanager
def _record_signals(executor: Executor) -> Iterator[list[int]]:
    """
    Record the signals of ``END_SIGNALS`` in a list, and wake the executor at each.

    No error is raised: rclpy swallows errors at some moments, and would then continue for ever.

    :returns: the numbers of the signals received so far.
    """
    received: list[int] = []

    def record(signal_number, frame):
        received.append(signal_number)
        executor.wake()

    old_handlers = {number: signal.signal(number, record) for number in END_SIGNALS}
    try:
        yield received
    finally:
        for signal_number, handler in old_handlers.items():
            signal.signal(signal_number, handler)


def replay(arguments: argparse.Namespace) -> dict[str, Any]:
    """
    Publish the clouds of a bag; with the option ``list`` only describe its topics.

    :returns: numbers of messages, or, with ``list``, the topics; as plain data.
    :raises ConfigurationError: if the bag or an option cannot be used.
    """
    options = options_of(arguments)
    with Bag(arguments.bag) as bag:
        if arguments.list:
            return {'bag': bag.path.name, 'seconds': bag.seconds, 'topics': describe_topics(bag)}
        return _publish_bag(bag, options)


def _publish_bag(bag: Bag, options: ReplayOptions) -> dict[str, Any]:
    """Publish a bag to its end; return the numbers of messages published and left out."""
    stay_local()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    executor = SingleThreadedExecutor()
    node = None
    try:
        with _record_signals(executor) as received:
            node = Replay(bag, options)
            executor.add_node(node)
            while not (node.done.done() or received):
                executor.spin_once()
        if received:
            raise KeyboardInterrupt
        if node.done.exception() is not None:
            raise node.done.exception()
        node.flush()
        return {'left_out': node.left_out_count, 'published': {
            name: {'as': node.topics[name][1], 'messages': count}
            for name, count in node.counts.items()}}
    finally:
        executor.shutdown()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
