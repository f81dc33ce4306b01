# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A signal that comes while a node is imported ends it in peace."""

from pathlib import Path
import signal
import subprocess
import sys
import time

from conftest import HUNG
import pytest


def caught(process):
    """Return the numbers of the signals that a process handles, by what the kernel says."""
    status = Path(f'/proc/{process.pid}/status').read_text()
    mask = int(next(line for line in status.splitlines() if line.startswith('SigCgt')).split()[1],
               16)
    return {number for number in range(1, 32) if mask & 1 << number - 1}


@pytest.mark.skipif(not Path('/proc/self/status').exists(), reason='there is no /proc')
@pytest.mark.parametrize('node', ['sim_node', 'policy_node', 'trainer_node'])
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_an_early_signal_ends_a_node_with_0_and_without_a_traceback(node, number):
    process = subprocess.Popen(
        [sys.executable, '-c', f'import sys; from ocp_ros.ros.start import {node}; '
         f'sys.exit({node}())'], stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + HUNG
    # Python itself catches SIGINT, and nothing else.
    while signal.SIGTERM not in caught(process):
        assert process.poll() is None and time.monotonic() < deadline
    process.send_signal(number)
    assert process.communicate(timeout=HUNG)[1] == '' and process.returncode == 0
