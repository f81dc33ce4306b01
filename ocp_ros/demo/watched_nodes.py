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

"""Node processes of the demos, over DDS, and a node that records the topics of these nodes."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import json
import os
from pathlib import Path
import signal
import socket
import subprocess
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import (
    msg_to_cloud,
    msg_to_fields,
    msg_to_positions,
    ns_of,
    stamp_to_ns,
)
from ocp_ros.ros.interface.qos import LATCHED, RECORDER
from ocp_ros.ros.runtime.node_main import (
    END_SIGNALS,
    local_transport,
    PARENT_VARIABLE,
    undisturbed,
)
from ocp_ros.util.files import folder_to_write, write_atomically
from ocp_ros.util.settings import ConfigurationError
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64MultiArray


def free_domain() -> tuple[int, socket.socket]:
    """
    Find a ROS domain that no other demo uses.

    :returns: the domain id, and a bound socket that reserves the domain while it is open. Node
        processes inherit the socket: a node that outlives its parent keeps the domain reserved.
    :raises RuntimeError: if all domains are in use.
    """
    # A demo reserves domain d by the port first_port + d, which only one process can bind.
    first_port = 32768
    for domain in range(1, 101):
        reservation = socket.socket()
        try:
            reservation.bind(('127.0.0.1', first_port + domain))
        except OSError:
            reservation.close()
            continue
        reservation.set_inheritable(True)
        return domain, reservation
    raise RuntimeError('found no free ROS domain between 1 and 100; stop some running demos')


class NodeProcess:
    """
    One node in its own process; its output goes to a file.

    The node ends when the parent process ends, even if the parent is killed.

    :param name: the node's module in ``ocp_ros.ros``.
    :param domain: ROS domain id.
    :param log: file for its output.
    :param parameters: values of ROS parameters by dotted name.
    :param namespace: ROS namespace of the node, such as ``env_0``; empty for none.
    """

    def __init__(self, name: str, domain: int, log: Path, parameters: dict,
                 namespace: str = '') -> None:
        self.name = f'{namespace}/{name}'.lstrip('/')
        self.log = log
        arguments = [sys.executable, '-m', f'ocp_ros.ros.{name}', '--ros-args']
        if namespace:
            arguments += ['-r', f'__ns:=/{namespace}']
        for key, value in parameters.items():
            # ROS reads values as YAML; JSON is valid YAML and escapes all characters of a path.
            arguments += ['-p', f'{key}:={json.dumps(value, default=str)}']
        variables = {'ROS_DOMAIN_ID': str(domain), PARENT_VARIABLE: str(os.getpid()),
                     'PYTHONUNBUFFERED': '1', 'PYTHONFAULTHANDLER': '1'}
        log.parent.mkdir(parents=True, exist_ok=True)
        # With close_fds=False the node inherits the socket that reserves the domain.
        with open(log, 'wb') as file:
            self.process = subprocess.Popen(
                arguments, stdout=file, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
                close_fds=False, env={**os.environ, **variables})

    def check_running(self) -> None:
        """
        Check that the node still runs.

        :raises RuntimeError: if the node has ended; the text has the last line of its output.
        """
        if self.process.poll() is not None:
            raise RuntimeError(f'{self.name} ended with code {self.process.returncode}: '
                               f'{self.last_line()}')

    def last_line(self) -> str:
        """Return the last line of the node's output."""
        lines = self.log.read_text(errors='replace').strip().splitlines()
        return lines[-1] if lines else 'no output'

    def warnings(self) -> list[str]:
        """Return the node's warnings so far."""
        lines = self.log.read_text(errors='replace').splitlines()
        return [line for line in lines if line.startswith('[WARN')]

    def interrupt(self) -> None:
        """Send SIGINT to the node, unless the node has ended."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)

    def wait(self) -> int:
        """Wait for the node to end, and return its exit code; after a minute, kill the node."""
        try:
            # A minute is enough also on a busy machine.
            return self.process.wait(timeout=60.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()


@contextmanager
def stopped_at_the_end(processes: list[NodeProcess]) -> Iterator[None]:
    """
    Stop node processes when a block ends, also after an error.

    :param processes: list to which the block adds the processes that it starts.
    :raises RuntimeError: if the block succeeded and a node ended with another code than 0.
    """
    try:
        yield
    finally:
        # A Ctrl-C or another signal to end must not interrupt the wait for the nodes.
        with undisturbed():
            for process in processes:
                process.interrupt()
            codes = {process.name: process.wait() for process in processes}
    if any(codes.values()):
        raise RuntimeError(f'found the exit codes {codes}; expected 0 from every node')


def end_on_signals() -> None:
    """Let SIGTERM and a closed terminal end this process as Ctrl-C does."""
    for number in END_SIGNALS:
        signal.signal(number, signal.default_int_handler)


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
