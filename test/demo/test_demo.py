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

"""Whole processes: nodes start and end, demos play, drills kill; and what watches the drills."""

from contextlib import nullcontext
import json
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

from benchmarks.drills import hold_soak, soak, soak_watch
from benchmarks.drills.drill import grown
from conftest import header_at, HUNG, random_checkpoint, ROOT
import numpy as np
from ocp_ros.demo import demo, train_demo
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.rooms.generator import generate_room
from ocp_ros.ros.interface.conversions import positions_to_msg
from ocp_ros.ros.runtime import node_main
from ocp_ros.training.learner import ACTOR, STATE
import pytest


def caught(process):
    """Return the numbers of the signals that a process handles, by what the kernel says."""
    status = Path(f'/proc/{process.pid}/status').read_text()
    mask = int(re.search(r'^SigCgt:\s*(\w+)', status, re.M).group(1), 16)
    return {number for number in range(1, 32) if mask & 1 << number - 1}


@pytest.mark.skipif(not Path('/proc/self/status').exists(), reason='there is no /proc')
@pytest.mark.parametrize('node', ['sim_node', 'policy_node', 'trainer_node'])
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_an_early_signal_ends_a_node_with_0_and_without_a_traceback(node, number):
    process = subprocess.Popen(
        [sys.executable, '-c', f'import sys; from ocp_ros.ros.start import {node}; '
         f'sys.exit({node}())'], stderr=subprocess.PIPE, text=True)
    # Python itself catches SIGINT, and nothing else.
    while signal.SIGTERM not in caught(process):
        assert process.poll() is None
    process.send_signal(number)
    assert process.communicate(timeout=HUNG)[1] == '' and process.returncode == 0


SIM_NODE = [sys.executable, '-c', 'from ocp_ros.ros.start import sim_node; sim_node()']


def test_a_node_that_runs_ends_with_0_and_has_said_all(domain):
    with subprocess.Popen(SIM_NODE, stderr=subprocess.STDOUT, stdout=subprocess.PIPE, text=True,
                          env={**os.environ, 'ROS_DOMAIN_ID': str(domain)}) as process:
        killer = threading.Timer(HUNG, process.kill)
        killer.start()
        while '[INFO]' not in (line := process.stdout.readline()):
            assert line
        process.send_signal(signal.SIGINT)
        assert 'Traceback' not in process.stdout.read()
        assert process.wait(timeout=HUNG) == 0
        killer.cancel()


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


@pytest.mark.parametrize(('parameter', 'words'), [
    ('scene.points:=-5', 'Invalid parameter value (-5)'),
    ('scene.pointz:=3', "'scene.pointz'; did you mean 'scene.points'")])
def test_what_a_node_cannot_use_ends_it_with_2_and_a_reason(domain, parameter, words):
    done = subprocess.run(
        [*SIM_NODE, '--ros-args', '-p', parameter], capture_output=True, text=True, timeout=HUNG,
        env={**os.environ, 'ROS_DOMAIN_ID': str(domain)})
    assert done.returncode == 2 and words in done.stderr and 'Traceback' not in done.stderr


def check(out, turns, cameras):
    """Return the demo's result after checking what always holds."""
    result = json.loads((out / 'demo.json').read_text())
    assert (result['cameras'], np.shape(result['positions'])) == (cameras, (cameras, 3))
    assert 0 < result['turns'] <= turns
    for name in ('depth_error', 'space_coverage'):
        for when in ('start', 'end'):
            assert 0.0 <= result[f'{name}_{when}'] < np.inf
    assert (out / 'demo.png').stat().st_size > 50_000
    return result


@pytest.mark.system
def test_the_demo_places_cameras_in_the_default_room(tmp_path, capsys):
    assert demo.main(['--out', str(tmp_path)]) == 0
    result = check(tmp_path, 30, 4)
    assert result['depth_error_end'] < 0.8 * result['depth_error_start']
    assert 'depth error' in capsys.readouterr().out
    low, high = generate_room(1).bounds
    assert ((result['positions'] >= low) & (result['positions'] <= high)).all()


@pytest.mark.system
def test_a_scan_in_millimetres_in_an_awkward_path_is_scaled(tmp_path):
    path = tmp_path / 'my room #1: final.npy'
    np.save(path, 1000.0 * generate_room(1, 3000).points)
    arguments = ['--out', str(tmp_path), '--room', str(path), '--turns', '2', '--cameras', '2']
    assert demo.main(arguments) == 2
    assert demo.main([*arguments, '--scale', '0.001']) == 0
    result = check(tmp_path, 2, 2)
    assert result['room'] == path.name
    assert result['config']['sim_node']['scene']['scale'] == 0.001
    assert result['config']['policy_node']['turns'] == 2


@pytest.mark.system
@pytest.mark.parametrize('how', [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_demo_leaves_no_node_behind(tmp_path, how):
    command = [sys.executable, '-m', 'ocp_ros.demo.demo', '--out', str(tmp_path)]
    running = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    log = tmp_path / 'logs' / 'policy_node.log'
    while not (log.exists() and 'weights' in log.read_text()):
        assert running.poll() is None, running.stderr.read()
        time.sleep(0.05)
    children = subprocess.run(['ps', '-o', 'pid=', '--ppid', str(running.pid)], check=True,
                              capture_output=True, text=True).stdout.split()
    assert len(children) == 2
    running.send_signal(how)
    # Once more, as an impatient user would, while the nodes are being stopped.
    running.send_signal(how)
    _, error = running.communicate(timeout=HUNG)
    assert running.returncode == 130 and 'Traceback' not in error, error
    left = subprocess.run(['ps', '-o', 'pid=', '-p', ','.join(children)], check=False,
                          capture_output=True, text=True).stdout.split()
    assert not left


@pytest.mark.system
@pytest.mark.parametrize(('arguments', 'words'), [
    (['--room', 'nowhere.ply'], 'nowhere.ply'), (['--cameras', '0'], 'rig.cameras'),
    (['--height', '9.0'], 'rig.height')])
def test_bad_input_gets_a_reason_and_code_2(tmp_path, capsys, arguments, words):
    assert demo.main(['--out', str(tmp_path), *arguments]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize('program', [demo, train_demo])
def test_a_place_where_nothing_can_be_written_is_named(tmp_path, capsys, program):
    (tmp_path / 'taken').write_text('')
    for out in (tmp_path / 'taken', tmp_path / 'taken' / 'out'):
        assert program.main(['--out', str(out)]) == 2
        error = capsys.readouterr().err
        assert f'--out: found {out}' in error and error.count('\n') == 1


@pytest.mark.system
def test_trained_weights_arrive_in_every_policy(tmp_path):
    assert train_demo.main(['--out', str(tmp_path), '--turns', '100', '--pairs', '2']) == 0
    result = json.loads((tmp_path / 'train_demo.json').read_text())
    assert result['turns'] >= 100 and result['weights_arrived'] >= 1
    assert len(result['turns_by_source']) == 2 and all(result['turns_by_source'].values())
    saved = Checkpoint.load(tmp_path / 'trainer' / 'actor.safetensors')
    assert saved.run == result['run'] and 0 < result['policy_updates'] <= saved.updates
    # How many transitions a busy trainer misses depends on the machine. A policy waits 0.25 s for
    # the reward of a turn; if it comes later, the turn is inconsistent and left out.
    assert result['inconsistent'] < 0.02 * result['turns'] and result['transitions'] > 0


@pytest.mark.system
def test_nodes_that_end_in_any_way_end_with_0(tmp_path):
    command = [sys.executable, '-m', 'benchmarks.drills.endings', '--endings', '3', '--kinds',
               'together,terminated,impatient,bereaved', '--jobs', '1', '--busy', '0', '--out',
               str(tmp_path / 'endings')]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / 'endings' / 'endings.json').read_text())
    assert {kind: one['codes'] for kind, one in found['kinds'].items()} == {
        'together': {'0': 3}, 'terminated': {'0': 3}, 'impatient': {'0': 3}, 'bereaved': {'0': 4}}
    assert found['faults'] == []


@pytest.mark.system
def test_the_loop_goes_on_whichever_node_is_killed_and_no_file_is_torn(tmp_path, capsys):
    assert soak.main(['--out', str(tmp_path), '--kills', '3']) == 0, capsys.readouterr().err
    result = json.loads((tmp_path / 'soak.json').read_text())
    assert result['kills'] == {
        'trainer_node': 1, 'env_0/policy_node': 1, 'env_0/sim_node': 1}
    assert result['restarts_survived'] == 3 and result['turns'] > 6
    assert 0 < result['malformed_messages_refused'] <= result['malformed_messages_sent'] * 2
    assert 0.0 < result['turn_latency_p50_ms'] <= result['turn_latency_p99_ms']
    # Who was killed has gone on from what it had saved, if anything.
    if (tmp_path / 'soak_trainer' / ACTOR).exists():
        assert Checkpoint.load(tmp_path / 'soak_trainer' / ACTOR).updates > 0


@pytest.mark.system
def test_a_placement_is_held_while_poses_are_noisy_and_clocks_jump(tmp_path, capsys):
    command = ['--out', str(tmp_path), '--minutes', '0.6', '--noise', '0.03']
    assert hold_soak.main(command) == 0, capsys.readouterr().err
    result = json.loads((tmp_path / 'hold_soak.json').read_text())
    assert all(result['faults_made'].values()) and result['commands'] > 10
    assert result['worst_m'] < 1e-3 and result['off_m'] < 1e-3


def test_a_torn_file_is_noticed(tmp_path, small_agent):
    assert soak_watch.check_files(tmp_path) == 0
    random_checkpoint(small_agent).save(tmp_path / ACTOR)
    assert soak_watch.check_files(tmp_path) == 1
    (tmp_path / STATE).write_bytes((tmp_path / ACTOR).read_bytes()[:-1])
    with pytest.raises(RuntimeError, match='found a torn file'):
        soak_watch.check_files(tmp_path)


def test_memory_is_compared_within_one_life(monkeypatch):
    now, held = [0.0], {}
    monkeypatch.setattr(soak_watch.time, 'monotonic', lambda: now[0])
    monkeypatch.setattr(soak_watch, 'rss_of', held.get)
    processes = [SimpleNamespace(name=name, process=SimpleNamespace(pid=pid))
                 for pid, name in enumerate('abc', 1)]
    memory = soak_watch.MemoryWatch()

    def live(since, until):
        for second in range(since, until, 2):
            now[0] = float(second)
            # One leaks 6 MB an hour, one only has more now and then, one starts up.
            held.update({1: 100.0 + second / 600.0, 2: 50.0 + 20.0 * (second % 10 == 0),
                         3: 10.0 + min(second, soak_watch.WARM)})
            memory.look(processes)

    live(0, 3600)
    assert memory.growth == {'a': pytest.approx(5.8, abs=0.2), 'b': 0.0, 'c': 0.0}
    assert memory.peak == {'a': pytest.approx(5.9, abs=0.2), 'b': 20.0, 'c': 0.0}
    # Growth beyond 20 MB is a fault.
    assert grown(memory.growth) == [] and len(grown({'/policy_node': 31.4, '/b': -5.0})) == 1
    # A new life begins anew.
    processes[0].process.pid, held[4] = 4, 500.0
    live(3600, 3700)
    assert memory.growth['a'] == pytest.approx(5.8, abs=0.2)


def test_a_turn_is_timed_from_when_it_was_sent_first_and_a_dead_node_recovers_nothing(
        probe, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(soak_watch.time, 'monotonic', lambda: now[0])
    latency = soak_watch.Latency(probe.node, '/env_0')

    def hear(second, take, stamp, frame='map'):
        now[0] = second
        take(positions_to_msg(np.ones((2, 3)), header_at(stamp, frame)))

    poses, command = latency._on_poses, latency._on_command
    for turn in ((1.0, poses, 5), (2.0, poses, 5), (2.5, poses, 9, 'lies'), (3.0, command, 4),
                 (4.0, command, 5), (5.0, command, 5), (6.0, poses, 6)):
        hear(*turn)
    latency.interrupt()
    hear(6.0, command, 6)
    assert (latency.turns, latency.seconds) == (1, [3.0])
    # What was sent before a node was killed is no sign that it works again.
    for stamp, recovered in ((7, 0), (time.time_ns(), 1)):
        hear(7.0, poses, stamp)
        hear(7.5, command, stamp)
        assert latency.recovered == recovered
