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

"""The laboratory: every module can be imported, and a tiny case of the largest ones runs."""

import json

from benchmarks import (
    benchmark_report,
    engine,
    engine_bench,
    few_turns,
    fused_bench,
    results,
)
from conftest import Here, rows_for
from ocp_ros.compare import comparison
from ocp_ros.compare.protocol import Protocol
from ocp_ros.util.settings import ConfigurationError
import pytest


@pytest.fixture
def recorded(tmp_path, monkeypatch):
    """Return what reads a result that was recorded, in a folder of its own."""
    monkeypatch.setattr(results, 'FOLDER', tmp_path / 'results')
    return lambda name: json.loads((tmp_path / 'results' / f'{name}.json').read_text())


def test_the_engine_is_measured(recorded, monkeypatch, capsys):
    monkeypatch.setattr(engine_bench, 'MIDDLE', 2000)
    # It plays for seconds, however small the room is.
    monkeypatch.setattr(engine_bench, 'speed', lambda: dict.fromkeys(engine_bench.SPEEDS, 1.0))
    monkeypatch.setitem(engine.EXTENTS, 'smoke', engine_bench.Extent((2000,), 1, 1, (2000,)))
    monkeypatch.setitem(engine.FUSED_EXTENTS, 'smoke', fused_bench.FusedExtent((2000,), 1, 40, 3))
    assert engine.main(['--preset', 'smoke', '--record']) == 0
    found = recorded('engine')
    assert found['command'] == 'python -m benchmarks.engine --preset smoke --record'
    rows = {row['method'].split()[0]: row for row in found['visibility']}
    assert rows.keys() == {'fine', 'fast', 'paper', 'embree', 'numpy', 'hidden_point_removal'}
    assert rows['embree']['f1'] == 1.0 and rows['numpy']['f1'] == rows['fast']['f1'] > 0.6
    assert [row['method'] for row in found['fused'][:4]] == ['fine', 'fast', 'paper', 'mesh']
    assert 'evaluations_per_s: ' in capsys.readouterr().out


def test_few_turns_are_played_once_and_summed_up(tmp_path, monkeypatch):
    played = []

    def play(protocol, task):
        episode = protocol.simulation.episode
        played.append((task.planner, episode.turns, episode.max_step))
        error = episode.turns + (task.planner == 'greedy_step')
        return [{'depth_error': float(error), 'seconds_per_turn': 0.01}]

    monkeypatch.setattr(few_turns, 'run_task', play)
    monkeypatch.setattr(few_turns, 'start_error', lambda protocol, room, rotation: 2.5)
    monkeypatch.setattr(few_turns, 'WorkerPool', Here)
    out = tmp_path / 'few.json'
    command = ['--rooms', '8', '--lengths', '2x1,3x0.5', '--planners', 'greedy_step,lookahead',
               '--first', 'lookahead', '--truths', '0', '--out', str(out), '--cameras']
    few_turns.main([*command, '2'])
    assert played == [('greedy_step', 2, 1.0), ('lookahead', 2, 1.0),
                      ('greedy_step', 3, 0.5), ('lookahead', 3, 0.5)]
    record = json.loads(out.read_text())
    assert record['command'] == (
        'python -m benchmarks.few_turns --rooms SCAN ... --lengths 2x1,3x0.5 --planners '
        'greedy_step,lookahead --cameras 2 --truths 0')
    # The cameras began at 2.5 m.
    assert record['summary']['2x1']['greedy_step']['worse'] == 1
    assert record['summary']['3x0.5']['lookahead']['ratio_to_best'] == pytest.approx(1.5)
    del record['rooms']['8, 0']['errors']['3x0.5']['lookahead']
    out.write_text(json.dumps(record))
    played.clear()
    few_turns.main([*command, '2'])
    assert played == [('lookahead', 3, 0.5)]
    with pytest.raises(ConfigurationError, match="found .*'cameras': 2.*name another file"):
        few_turns.main([*command, '3'])


def test_a_comparison_is_reported(tmp_path, recorded, monkeypatch):
    monkeypatch.setattr(comparison, 'run_task', rows_for)
    monkeypatch.setattr(comparison, 'WorkerPool', Here)
    protocol = Protocol(rooms=('8',), planners=('random', 'tdsa', 'greedy_step'), budgets=(5, 30),
                        seeds=1, points=2000, judged_points=2500)
    comparison.compare(protocol, tmp_path, 'ocp benchmark')
    assert benchmark_report.main([str(tmp_path), '--record', 'benchmark']) == 0
    text = (tmp_path / 'README.md').read_text()
    assert '    ocp benchmark\n' in text and '| random | scores | 2.10 |' in text
    for picture in ('rooms.png', 'anytime.png', 'placements.png'):
        assert f'({picture})' in text
        assert (tmp_path / picture).stat().st_size > 10000
    assert 'depth error' in (tmp_path / 'placements.html').read_text()
    found = recorded('benchmark')
    assert found['command'] == 'ocp benchmark' and found['commit'] and found['points'] == 2000
