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

"""A node that records the topics of a simulation and a policy, for the demos."""

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
    """
    Record the scene, every turn, the placement and the diagnostics of a simulation and a policy.

    :ivar scene: (N, 3) points, metres, map frame; None until they come.
    :ivar placement: (K, 3) final positions, metres, map frame; None until they come.
    :ivar placement_stamp: nanoseconds.
    :ivar positions: (K, 3) of each turn, by stamp in nanoseconds.
    :ivar rewards: fields of the reward topic of each turn, by stamp in nanoseconds.
    :ivar diagnostics: latest diagnostic values by node.
    :ivar diagnostics_stamps: stamp of these values by node, nanoseconds.
    """

    def __init__(self, **kwargs) -> None:
        super().__init__('watcher', **kwargs)
        self.scene: np.ndarray | None = None
        self.placement: np.ndarray | None = None
        self.placement_stamp = 0
        self.positions: dict[int, np.ndarray] = {}
        self.rewards: dict[int, dict[str, float]] = {}
        self.diagnostics: dict[str, dict[str, str]] = {}
        self.diagnostics_stamps: dict[str, int] = {}
        self.create_subscription(PointCloud2, topics.SCENE, self._on_scene, LATCHED)
        self.create_subscription(PoseArray, topics.PLACEMENT, self._on_placement, LATCHED)
        self.create_subscription(PoseArray, topics.CAMERA_POSES, self._on_poses, RECORDER)
        self.create_subscription(Float64MultiArray, topics.REWARD, self._on_reward, RECORDER)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)

    def _on_scene(self, message: PointCloud2) -> None:
        """Store the points of the scene."""
        self.scene = msg_to_cloud(message)

    def _on_placement(self, message: PoseArray) -> None:
        """Store the final placement."""
        self.placement = msg_to_positions(message)
        self.placement_stamp = stamp_to_ns(message.header.stamp)

    def _on_poses(self, message: PoseArray) -> None:
        """Store the positions of the cameras."""
        self.positions[stamp_to_ns(message.header.stamp)] = msg_to_positions(message)

    def _on_reward(self, message: Float64MultiArray) -> None:
        """Store the reward of the turn."""
        fields = msg_to_fields(message, topics.REWARD_FIELDS)
        stamp = ns_of(fields, 'stamp')
        # A turn that is sent again keeps its first time of arrival.
        self.rewards.setdefault(stamp, {**fields, 'received': time.monotonic()})

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        """Store the diagnostic values of each node."""
        for status in message.status:
            name = status.name.lstrip('/')
            self.diagnostics[name] = {item.key: item.value for item in status.values}
            self.diagnostics_stamps[name] = stamp_to_ns(message.header.stamp)

    def turns(self) -> list[tuple[np.ndarray, dict[str, float]]]:
        """Return positions and fields of every complete turn, oldest first."""
        return [(self.positions[stamp], self.rewards[stamp])
                for stamp in sorted(self.rewards) if stamp in self.positions]

    def final_turn(self) -> int | None:
        """Return the index of the turn with the stamp of the placement; None if there is none."""
        stamps = [stamp for stamp in sorted(self.rewards) if stamp in self.positions]
        return stamps.index(self.placement_stamp) if self.placement_stamp in stamps else None


class Watch:
    """
    A watcher with its own ROS context and executor; use it in a ``with`` statement.

    :param domain: ROS domain id.
    :ivar node: the watcher.
    """

    def __init__(self, domain: int) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = Watcher(context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def __enter__(self) -> 'Watch':
        """Return this object."""
        return self

    def __exit__(self, *exception) -> None:
        """Shut everything down in the order that the middleware needs."""
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)

    def spin_until(self, predicate: Callable[[], bool], timeout_s: float, condition: str,
                   processes: list[NodeProcess], step_s: float = 0.1) -> None:
        """
        Receive messages until a condition holds.

        :param predicate: returns whether the condition holds.
        :param timeout_s: longest wait, seconds.
        :param condition: name of the condition for the error message.
        :param processes: nodes that have to run during the wait.
        :param step_s: seconds between two checks if no message comes.
        :raises RuntimeError: if the time is over or a node has ended.
        """
        deadline = time.monotonic() + timeout_s
        while not predicate():
            for process in processes:
                process.check_running()
            if time.monotonic() > deadline:
                lines = '; '.join(f'{node.name}: {node.last_line()}' for node in processes)
                raise RuntimeError(
                    f'found no {condition} within {timeout_s:.0f} s; last lines: {lines}')
            self.executor.spin_once(timeout_sec=step_s)


def run_watched(name: str, out: Path, play: Callable[[int, Watch], dict[str, Any]],
                show: Callable[[dict[str, Any]], None],
                errors: tuple[type[Exception], ...] = (RuntimeError,)) -> int:
    """
    Run a demo with node processes in a separate ROS domain, and write the result.

    Nodes communicate by UDP, so that a node may be killed without harm to the others.

    :param name: of the demo, and of its JSON file.
    :param out: folder for the file.
    :param play: runs the demo: receives the domain id and the watch, and returns the result as
        plain data, with sentences under ``faults`` if anything failed.
    :param show: prints the result.
    :param errors: types of errors that are printed as one sentence.
    :returns: exit code: 2 after such an error or with faults, 130 after an interrupt, otherwise 0.
    """
    end_on_signals()
    try:
        folder_to_write(out)
    except ConfigurationError as error:
        print(f'{name}: {error}', file=sys.stderr)
        return 2
    environment = dict(os.environ)
    os.environ.update(local_transport())
    domain, reservation = free_domain()
    try:
        with reservation, Watch(domain) as watch:
            result = play(domain, watch)
    except errors as error:
        print(f'{name}: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    finally:
        os.environ.clear()
        os.environ.update(environment)
    write_atomically(out / f'{name}.json', json.dumps(result, indent=2) + '\n')
    show(result)
    for fault in (faults := result.get('faults', [])):
        print(f'{name}: {fault}', file=sys.stderr)
    return 2 if faults else 0
