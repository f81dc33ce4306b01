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

"""A signal ends a node in peace, while it is imported and later."""

from contextlib import nullcontext
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from conftest import HUNG
from ocp_ros.ros.runtime import node_main
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


@pytest.mark.parametrize('node', ['sim_node', 'trainer_node'])
def test_a_node_that_runs_ends_with_0_and_has_said_all(node, domain, tmp_path):
    folder = ['--ros-args', '-p', f'folder:={tmp_path / "run"}'] if node == 'trainer_node' else []
    with (tmp_path / 'log').open('w+') as log:
        process = subprocess.Popen(
            [sys.executable, '-c', f'from ocp_ros.ros.start import {node}; {node}()', *folder],
            stderr=log, stdout=log, env={**os.environ, 'ROS_DOMAIN_ID': str(domain)})
        deadline = time.monotonic() + HUNG
        while '[INFO]' not in (tmp_path / 'log').read_text():
            assert process.poll() is None and time.monotonic() < deadline
            try:
                process.wait(timeout=0.1)
            except subprocess.TimeoutExpired:
                continue
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=HUNG) == 0
    assert 'Traceback' not in (tmp_path / 'log').read_text()
    if node == 'trainer_node':
        assert (tmp_path / 'run' / 'config.yaml').exists()


@pytest.mark.parametrize('package, raised', [('llvmlite.binding', False), ('numba', False),
                                             ('numbats', True), ('ocp_ros.ros', True)])
def test_nothing_is_raised_while_kernels_are_made(package, raised):
    before = {number: signal.getsignal(number) for number in node_main.END_SIGNALS}
    names = {'__name__': package}
    try:
        received = node_main.interrupt_on_signals()
        exec('def made(call):\n    call()', names)
        with pytest.raises(KeyboardInterrupt) if raised else nullcontext():
            names['made'](lambda: signal.raise_signal(signal.SIGTERM))
        assert received == [signal.SIGTERM]
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_what_a_node_cannot_use_is_its_exit_code(domain):
    done = subprocess.run(
        [sys.executable, '-c', 'from ocp_ros.ros.start import sim_node; sim_node()',
         '--ros-args', '-p', 'scene.points:=-5'], capture_output=True, text=True, timeout=HUNG,
        env={**os.environ, 'ROS_DOMAIN_ID': str(domain)})
    assert done.returncode == 2 and 'Invalid parameter value (-5)' in done.stderr
