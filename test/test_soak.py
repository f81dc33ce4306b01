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

"""Nodes that are killed at random times; ``make soak`` does it for long."""

import json
import time
from types import SimpleNamespace

from benchmarks.drills import hold_soak, soak, soak_watch
from benchmarks.drills.drill import grown
from conftest import random_checkpoint
import numpy as np
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.ros.interface.conversions import ns_to_stamp, positions_to_msg
from ocp_ros.training.learner import ACTOR, STATE
import pytest
from std_msgs.msg import Header


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
        for second in range(since, until):
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
        take(positions_to_msg(np.ones((2, 3)), Header(stamp=ns_to_stamp(stamp), frame_id=frame)))

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
