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

"""A node that watches a loop of sim and policy, for the demos."""

from collections.abc import Callable
import json
import os
from pathlib import Path
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.demo.node_processes import end_on_signals, free_domain, NodeProcess
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import (
    msg_to_cloud,
    msg_to_fields,
    msg_to_positions,
    ns_of,
    stamp_to_ns,
)
from ocp_ros.ros.interface.qos import LATCHED, RECORDER
from ocp_ros.ros.runtime.network import local_transport
from ocp_ros.util.files import folder_to_write, write_atomically
from ocp_ros.util.settings import ConfigurationError
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64MultiArray


class Watcher(Node):
    """Keep what a loop has published: the scene, every turn, the placement, the diagnostics."""

    def __init__(self, **kwargs) -> None:
        super().__init__('watcher', **kwargs)
        self.scene: np.ndarray | None = None
        self.placement: np.ndarray | None = None
        self.placement_stamp = 0
        #: Stamp in nanoseconds to positions (K, 3), and to the fields of the reward topic.
        self.positions: dict[int, np.ndarray] = {}
        self.rewards: dict[int, dict[str, float]] = {}
        #: Node to its diagnostic values.
        self.health: dict[str, dict[str, str]] = {}
        #: Node to when it said so, nanoseconds of its clock.
        self.said: dict[str, int] = {}
        self.create_subscription(PointCloud2, topics.SCENE, self._on_scene, LATCHED)
        self.create_subscription(PoseArray, topics.PLACEMENT, self._on_placement, LATCHED)
        self.create_subscription(PoseArray, topics.CAMERA_POSES, self._on_poses, RECORDER)
        self.create_subscription(Float64MultiArray, topics.REWARD, self._on_reward, RECORDER)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_health, 10)

    def _on_scene(self, message: PointCloud2) -> None:
        """Keep the scene's points."""
        self.scene = msg_to_cloud(message)

    def _on_placement(self, message: PoseArray) -> None:
        """Keep the final answer."""
        self.placement = msg_to_positions(message)
        self.placement_stamp = stamp_to_ns(message.header.stamp)

    def _on_poses(self, message: PoseArray) -> None:
        """Keep where the cameras are."""
        self.positions[stamp_to_ns(message.header.stamp)] = msg_to_positions(message)

    def _on_reward(self, message: Float64MultiArray) -> None:
        """Keep what the turn is worth."""
        fields = msg_to_fields(message, topics.REWARD_FIELDS)
        stamp = ns_of(fields, 'stamp')
        # A turn that is sent again is still the same turn.
        self.rewards.setdefault(stamp, {**fields, 'received': time.monotonic()})

    def _on_health(self, message: DiagnosticArray) -> None:
        """Keep each node's values."""
        for status in message.status:
            name = status.name.lstrip('/')
            self.health[name] = {v.key: v.value for v in status.values}
            self.said[name] = stamp_to_ns(message.header.stamp)

    def turns(self) -> list[tuple[np.ndarray, dict[str, float]]]:
        """Return every turn whose two messages are here, oldest first: positions and fields."""
        return [(self.positions[stamp], self.rewards[stamp])
                for stamp in sorted(self.rewards) if stamp in self.positions]

    def final_turn(self) -> int | None:
        """Return the index of the turn that the placement is of; None before both are here."""
        stamps = [stamp for stamp in sorted(self.rewards) if stamp in self.positions]
        return stamps.index(self.placement_stamp) if self.placement_stamp in stamps else None


class Watch:
    """
    A watcher with its own context and executor; use it in a ``with`` statement.

    :param domain: ROS domain id.
    """

    def __init__(self, domain: int) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = Watcher(context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def __enter__(self) -> 'Watch':
        """Return itself."""
        return self

    def __exit__(self, *exception) -> None:
        """Take everything down in the order that the middleware needs."""
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)

    def until(self, predicate: Callable[[], bool], timeout: float, what: str,
              processes: list[NodeProcess], step: float = 0.1) -> None:
        """
        Spin until something has happened.

        :param predicate: whether it has.
        :param timeout: seconds to wait for it.
        :param what: its name for the error message.
        :param processes: nodes that have to stay alive meanwhile.
        :param step: seconds after which it is looked again where nothing comes.
        :raises RuntimeError: if it does not happen in time or a node dies.
        """
        deadline = time.monotonic() + timeout
        while not predicate():
            for process in processes:
                process.check()
            if time.monotonic() > deadline:
                words = '; '.join(f'{process.name}: {process.tail()}' for process in processes)
                raise RuntimeError(
                    f'found no {what} within {timeout:.0f} s; last words: {words}')
            self.executor.spin_once(timeout_sec=step)


def run_watched(name: str, out: Path, play: Callable[[int, Watch], dict[str, Any]],
                show: Callable[[dict[str, Any]], None],
                errors: tuple[type[Exception], ...] = (RuntimeError,)) -> int:
    """
    Play with node processes in a ROS domain of their own, and write what was found.

    Nodes hear each other by UDP, so that one may be killed without harm to the others.

    :param name: of what is played, and of its JSON file.
    :param out: folder for the file.
    :param play: gets the domain id and who watches; returns plain data, among them ``faults``,
        sentences, where there are any.
    :param show: prints them.
    :param errors: what is told in one sentence.
    :returns: exit code: 2 after such an error or with faults, 130 after an interrupt.
    """
    end_on_signals()
    try:
        folder_to_write(out)
    except ConfigurationError as error:
        print(f'{name}: {error}', file=sys.stderr)
        return 2
    before = dict(os.environ)
    os.environ.update(local_transport())
    domain, holder = free_domain()
    try:
        with holder, Watch(domain) as watch:
            result = play(domain, watch)
    except errors as error:
        print(f'{name}: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    finally:
        os.environ.clear()
        os.environ.update(before)
    write_atomically(out / f'{name}.json', json.dumps(result, indent=2) + '\n')
    show(result)
    for fault in (faults := result.get('faults', [])):
        print(f'{name}: {fault}', file=sys.stderr)
    return 2 if faults else 0
