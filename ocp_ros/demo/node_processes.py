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

"""Node processes for the demos: real nodes, each in its own process, over DDS."""

from collections.abc import Iterator
from contextlib import contextmanager
import json
import os
from pathlib import Path
import signal
import socket
import subprocess
import sys

from ocp_ros.ros.runtime.node_main import END_SIGNALS, PARENT_VARIABLE, undisturbed


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
