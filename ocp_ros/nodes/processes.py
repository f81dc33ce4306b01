# SPDX-License-Identifier: Apache-2.0
"""Node processes for the demos: real nodes, each in a process of its own, over DDS."""

import os
from pathlib import Path
import signal
import socket
import subprocess
import sys

LOCALHOST = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}


def free_domain() -> tuple[int, socket.socket]:
    """
    Find a ROS domain that no other process of this kind uses.

    :returns: the domain id, and a bound socket that keeps it taken while it is open.
    """
    for domain in range(1, 101):
        holder = socket.socket()
        try:
            holder.bind(('127.0.0.1', 32768 + domain))
        except OSError:
            holder.close()
            continue
        return domain, holder
    raise RuntimeError('found no free ROS domain between 1 and 100; stop some running demos')


class NodeProcess:
    """
    One node in a process of its own; its output goes to a file.

    :param name: the node's module in ``ocp_ros.nodes``.
    :param domain: ROS domain id.
    :param log: file for its output.
    :param parameters: dotted name to value.
    """

    def __init__(self, name: str, domain: int, log: Path, parameters: dict) -> None:
        self.name, self.log = name, log
        arguments = [sys.executable, '-m', f'ocp_ros.nodes.{name}', '--ros-args']
        for key, value in parameters.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            arguments += ['-p', f'{key}:={text}']
        log.parent.mkdir(parents=True, exist_ok=True)
        with open(log, 'wb') as file:
            self.process = subprocess.Popen(
                arguments, stdout=file, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
                env={**os.environ, **LOCALHOST, 'ROS_DOMAIN_ID': str(domain),
                     'PYTHONUNBUFFERED': '1'})

    def check(self) -> None:
        """
        Make sure that the node still runs.

        :raises RuntimeError: with the end of its output if it does not.
        """
        if self.process.poll() is not None:
            raise RuntimeError(f'{self.name} ended with code {self.process.returncode}: '
                               f'{self.tail()}')

    def tail(self) -> str:
        """Return the last line of the node's output."""
        lines = self.log.read_text(errors='replace').strip().splitlines()
        return lines[-1] if lines else 'no output'

    def stop(self) -> int:
        """Ask the node to end, insist after 15 s, and return its exit code."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        try:
            return self.process.wait(timeout=15.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()
