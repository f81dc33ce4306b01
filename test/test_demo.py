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

"""The main jobs, as a user starts them: node processes over DDS."""

import json
import os
import signal
import subprocess
import sys

from conftest import HUNG, ROOT
import numpy as np
from ocp_ros.demo import demo, train_demo
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.rooms.generator import generate_room
import pytest


def check(out, turns, cameras):
    """Return the demo's result after checking what always holds."""
    result = json.loads((out / 'demo.json').read_text())
    assert (result['cameras'], np.shape(result['positions'])) == (cameras, (cameras, 3))
    assert 0 < result['turns'] <= turns
    for name in ('depth_error_start', 'depth_error_end', 'space_coverage_start',
                 'space_coverage_end'):
        assert np.isfinite(result[name]) and result[name] >= 0.0
    assert (out / 'demo.png').stat().st_size > 50_000
    return result


@pytest.mark.system
def test_the_demo_places_cameras_in_the_default_room(tmp_path, capsys):
    assert demo.main(['--out', str(tmp_path)]) == 0
    result = check(tmp_path, 30, 4)
    assert result['depth_error_end'] < 0.8 * result['depth_error_start']
    assert 'depth error' in capsys.readouterr().out
    room = generate_room(1)
    low, high = room.bounds
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
        try:
            running.wait(timeout=0.05)
        except subprocess.TimeoutExpired:
            continue
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
    # How many transitions a busy trainer misses depends on the machine; it never makes one up.
    assert result['inconsistent'] == 0 and result['transitions'] > 0


def test_a_bad_parameter_ends_a_node_with_one_sentence(domain):
    done = subprocess.run(
        [sys.executable, '-m', 'ocp_ros.ros.policy_node', '--ros-args', '-p', 'turnz:=3'],
        env={**os.environ, 'ROS_DOMAIN_ID': str(domain)}, capture_output=True, text=True,
        timeout=HUNG, check=False)
    assert done.returncode == 2
    assert "'turnz'; did you mean 'turns'" in done.stderr and 'Traceback' not in done.stderr


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
