# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The comparison over lengths of episodes keeps what it has played and sums it up."""

import json

from conftest import Here, ROOT
import pytest

from benchmarks import few_turns
from ocp_ros.util.settings import ConfigurationError

COMMAND = ['--rooms', '8', '--lengths', '2x1,3x0.5', '--planners', 'greedy_step,lookahead',
           '--first', 'lookahead', '--cameras', '2', '--truths', '0']


@pytest.fixture
def played(monkeypatch):
    """Return what is played, in place of playing it."""
    done = []

    def play(protocol, task):
        episode = protocol.simulation.episode
        done.append((task.planner, episode.turns, episode.max_step))
        error = episode.turns + (task.planner == 'greedy_step')
        return [{'depth_error': float(error), 'seconds_per_turn': 0.01}]
    monkeypatch.setattr(few_turns, 'run_task', play)
    monkeypatch.setattr(few_turns, 'start_error', lambda protocol, room, rotation: 2.5)
    monkeypatch.setattr(few_turns, 'WorkerPool', Here)
    return done


def test_what_was_played_is_not_played_again(tmp_path, played):
    out = tmp_path / 'few.json'
    few_turns.main([*COMMAND, '--out', str(out)])
    assert played == [('greedy_step', 2, 1.0), ('lookahead', 2, 1.0),
                      ('greedy_step', 3, 0.5), ('lookahead', 3, 0.5)]
    record = json.loads(out.read_text())
    assert record['command'] == (
        'python -m benchmarks.few_turns --rooms SCAN ... --lengths 2x1,3x0.5 --planners '
        'greedy_step,lookahead --cameras 2 --truths 0')
    row = record['summary']['2x1']['greedy_step']
    assert (row['sum'], row['wins'], row['rooms']) == (3.0, 1, 1)
    # The cameras began at 2.5 m.
    assert {length: [planners[name]['worse'] for name in ('greedy_step', 'lookahead')]
            for length, planners in record['summary'].items()} == {'2x1': [1, 0], '3x0.5': [1, 1]}
    # The best known is that of lookahead after two turns.
    assert record['summary']['3x0.5']['lookahead']['ratio_to_best'] == pytest.approx(1.5)
    del record['rooms']['8, 0']['errors']['3x0.5']['lookahead']
    out.write_text(json.dumps(record))
    played.clear()
    few_turns.main([*COMMAND, '--out', str(out)])
    assert played == [('lookahead', 3, 0.5)]
    assert json.loads(out.read_text())['summary'] == record['summary']


def test_planners_are_compared_with_themselves_before():
    """Rooms and lengths that only one side has are left out."""
    rooms = {str(room): {'errors': {'8x2': {'learned': 2.0 + room}, '5x2': {'learned': 1.0}}}
             for room in range(6)}
    before = {str(room): {'errors': {'8x2': {'learned': 4.02 + 2.0 * room - 0.01}}}
              for room in range(1, 7)}
    found = few_turns.over_before(rooms, before)
    assert found['5x2'] == {}
    row = found['8x2']['learned']
    assert (row['rooms'], row['wins']) == (5, 5)
    assert row['ratio'] == pytest.approx(0.5)
    assert row['sum'] == pytest.approx(sum(4.01 + 2.0 * room for room in range(1, 6)))
    assert few_turns.over_before(rooms, {}) == {}


def test_another_comparison_is_not_mixed_in(tmp_path, played):
    out = tmp_path / 'few.json'
    few_turns.main([*COMMAND, '--out', str(out)])
    with pytest.raises(ConfigurationError, match="found .*'cameras': 2.*name another file"):
        few_turns.main([*COMMAND[:-4], '--cameras', '3', '--truths', '0', '--out', str(out)])


def test_rig_files_are_compared_over_the_turns_they_are_planned_with(tmp_path):
    with pytest.raises(ConfigurationError, match='lengths: found 8x2 with a rig file; expected '
                       '30x0.5'):
        few_turns.main(['--rig', str(ROOT / 'config/rig/four_d455.yaml'), '--lengths', '8x2',
                        '--out', str(tmp_path / 'few.json')])
