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

"""Comparisons of planners by ``ocp benchmark``, and the laboratory."""

from dataclasses import replace
import json

from benchmarks import agent, benchmark_report, engine, results
from conftest import Here, made_room, rows_for
import numpy as np
from ocp_ros.cli import main as cli
from ocp_ros.compare import comparison
from ocp_ros.compare.protocol import (
    BenchmarkTask,
    placement_settings,
    Protocol,
    RANDOM_PLACEMENTS,
    rooms_in,
    run_task,
)
from ocp_ros.compare.summary import interval, LOG_OFFSET_M, pairs, ranks, summarise
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.rig.rig_file import load_rig
from ocp_ros.rooms.scene_source import make_room
from ocp_ros.scenes.scene import SceneError
from ocp_ros.scenes.scene_files import save_scene
from ocp_ros.search.registry import REFERENCES
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.util.settings import ConfigurationError
import pytest

SMALL = Protocol(rooms=('3',), rotations=(0.0,), planners=('random', 'tdsa'), budgets=(5, 30),
                 seeds=2, points=3000, judged_points=4000, truth_budget=300,
                 simulation=replace(placement_settings(), engine=EngineConfig(
                     error_rows=32, coverage_cell=0.5, error_folds=2)))
RANDOM_PLACEMENT, RAY_SEARCH = REFERENCES
D455 = 'cameras: [{sensor: realsense_d455, count: 2}]\nmount: {on: walls, height: [1.6, 2.2]}\n'


def test_a_turned_room_is_the_room_turned():
    scene, quarter = made_room(8, 2000), make_room('8', 90, 2000)
    np.testing.assert_allclose(quarter.points[:, 0], -scene.points[:, 1], atol=1e-5)
    np.testing.assert_allclose(quarter.mesh.vertices[:, 1], scene.mesh.vertices[:, 0], atol=1e-5)


def test_a_folder_of_scans_is_a_set_of_rooms(tmp_path):
    with pytest.raises(SceneError, match='found no scans'):
        rooms_in([tmp_path])
    np.save(tmp_path / 'b.npy', made_room(8, 2000).points)
    (tmp_path / 'notes.md').write_text('nothing')
    name, = rooms_in([tmp_path])
    assert name.endswith('b.npy') and len(make_room(name, 0)) > 1000
    (tmp_path / 'notes.txt').write_text('scanned on monday')
    with pytest.raises(SceneError, match='notes.txt'):
        rooms_in([tmp_path])


@pytest.mark.system
def test_a_task_runs_every_budget_and_seed():
    rows = run_task(SMALL, BenchmarkTask('3', 0.0, 'tdsa'))
    assert [(row['budget'], row['seed']) for row in rows] == [(5, 0), (5, 1), (30, 0), (30, 1)]
    for row in rows:
        assert row['evaluations'] <= row['budget'] and np.shape(row['placement']) == (4, 6)
    again = run_task(SMALL, BenchmarkTask('3', 0.0, 'tdsa'))
    assert [row['placement'] for row in again] == [row['placement'] for row in rows]
    control = run_task(SMALL, BenchmarkTask('3', 0.0, RANDOM_PLACEMENT))
    best, best_of_control = (min(row['depth_error'] for row in found) for found in (rows, control))
    assert all(row['lower_bound'] <= min(best, best_of_control) for row in control)
    truth = run_task(SMALL, BenchmarkTask('3', 0.0, RAY_SEARCH))
    assert [(row['budget'], row['seed']) for row in truth] == [(300, 0)]
    assert truth[0]['depth_error'] < 1.1 * best_of_control and 0.0 <= truth[0]['gap'] <= 1.0


def test_an_online_planner_plays_an_episode_with_every_seed():
    protocol = replace(SMALL, planners=('lookahead',), simulation=replace(
        SMALL.simulation, episode=EpisodeConfig(turns=3)))
    rows = run_task(protocol, BenchmarkTask('8', 0.0, 'lookahead'))
    assert [(row['budget'], row['seed']) for row in rows] == [(0, 0), (0, 1)]
    for row in rows:
        trajectory = np.array(row['trajectory'])
        assert trajectory.shape == (4, 4, 3)
        # The cameras are mounted where they ended, rounded as in files.
        assert np.abs(np.array(row['placement'])[:, :3] - trajectory[-1]).max() < 0.1
        assert np.linalg.norm(np.diff(trajectory, axis=0), axis=2).max() <= 0.5 + 1e-9
        assert 0.0 < row['seconds_per_turn'] <= row['seconds_at_most'] <= row['seconds']


@pytest.mark.parametrize(('changes', 'words'), [
    ({'planners': ('tdsa', 'magic')}, 'planners: .*magic'), ({'rooms': ()}, 'rooms'),
    ({'budgets': (0,)}, r'budgets \[0\]'), ({'budgets': (5, 5)}, r'budgets: .*\[5, 5\]'),
    ({'seeds': 0}, 'seeds'), ({'scale': -1.0}, 'scale=-1.0'), ({'up': 'w'}, "up='w'"),
    ({'simulation': SimulationConfig()}, 'no rig file')])
def test_what_cannot_be_compared_is_refused(changes, words):
    with pytest.raises(ConfigurationError, match=words):
        replace(SMALL, **changes)


def test_an_interrupted_comparison_goes_on(tmp_path, monkeypatch):
    done = []

    def run_here(protocol, task):
        done.append(task.planner)
        if len(done) == 3:
            raise KeyboardInterrupt
        return rows_for(protocol, task)

    monkeypatch.setattr(comparison, 'run_task', run_here)
    monkeypatch.setattr(comparison, 'WorkerPool', Here)
    with pytest.raises(KeyboardInterrupt):
        comparison.run_tasks(SMALL, tmp_path, 1)
    rows = comparison.run_tasks(SMALL, tmp_path, 1)
    played = list(dict.fromkeys(row['planner'] for row in rows))
    assert played == [*REFERENCES, 'random', 'tdsa']
    assert len(rows) == RANDOM_PLACEMENTS + 1 + 4 + 4
    assert done == [*REFERENCES, 'random', 'random', 'tdsa']
    with pytest.raises(ConfigurationError, match='another comparison'):
        comparison.run_tasks(replace(SMALL, seeds=1), tmp_path, 1)
    # A model of the same name with other weights.
    monkeypatch.setattr(comparison, 'find_model', lambda name: tmp_path / 'protocol.json')
    with pytest.raises(ConfigurationError, match='weights'):
        comparison.run_tasks(SMALL, tmp_path, 1)


def test_a_room_of_which_nothing_is_missed_is_noted_and_has_no_ratios():
    rows = rows_of({'one': {('easy', 0): [0.07], ('b', 0): [4.0]},
                    'other': {('easy', 0): [2.5], ('b', 0): [4.0]}})
    for row in rows:
        if row['planner'] == RAY_SEARCH and row['room'] == 'easy':
            row['depth_error'] = 0.07
    assert [note.partition(':')[0] for note in summarise(rows)['notes']] == ['easy']
    summary = summarise([{**row, 'depth_error': 0.0, 'promised': 0.0} for row in rows])
    assert summary['planners']['one']['100']['regret'] is None
    assert summary['rooms']['easy']['share'] is None
    json.dumps(summary, allow_nan=False)


def rows_of(errors):
    """Return rows of planners with given errors: {planner: {(room, rotation): [by seed]}}."""
    rows = [{'planner': planner, 'room': room, 'rotation': rotation, 'budget': 100,
             'seed': seed, 'depth_error': error, 'exact': error, 'promised': 0.5 * error,
             'seconds': 1.0, 'evaluations': 10}
            for planner, cases in errors.items() for (room, rotation), found in cases.items()
            for seed, error in enumerate(found)]
    for room, rotation in {(row['room'], row['rotation']) for row in rows}:
        row = {'room': room, 'rotation': rotation, 'seconds': 9.0, 'evaluations': 3000}
        rows.append({**row, 'planner': RANDOM_PLACEMENT, 'budget': 1, 'seed': 0,
                     'depth_error': 10.0, 'lower_bound': 0.1})
        rows.append({**row, 'planner': RAY_SEARCH, 'budget': 3000, 'seed': 0,
                     'depth_error': 1.0, 'promised': 1.0})
    return rows


def test_the_summary_is_what_its_words_say():
    rows = rows_of({
        'good': {('a', 0): [1.0, 3.0], ('a', 60): [2.0, 2.0], ('b', 0): [4.0, 4.0]},
        'bad': {('a', 0): [5.0, 5.0], ('a', 60): [1.0, 9.0], ('b', 0): [3.0, 3.0]}})
    for row, gap in zip([row for row in rows if row['planner'] == 'good'], (0.1, 0.2, 0.3)):
        row['gap'] = gap
    summary = summarise(rows)
    good, bad = (summary['planners'][name]['100'] for name in ('good', 'bad'))
    assert good['rooms'] == {'a': 2.0, 'b': 4.0}
    assert (good['sum'], bad['sum'], good['wins'], bad['wins']) == (6.0, 8.0, 1, 1)
    # Best known: the search with the truth.
    assert summary['rooms']['a'] == {'best_known': 1.0, 'random_placement': 10.0,
                                     'share': 0.1, 'lower_bound': 0.1}
    assert good['regret'] == pytest.approx(6.0 / 2.0)
    assert good['regret_geometric'] == pytest.approx((2.0 * 4.0) ** 0.5)
    assert good['gap_closed'] == pytest.approx((20.0 - 6.0) / (20.0 - 2.0))
    assert good['promised'] == 3.0 and good['promise_over_delivered'] == 0.5
    assert good['promise_worst_room'] == 0.5
    assert summary['truth']['sum'] == 2.0 and summary['truth']['regret'] == 1.0
    assert good['interval'][0] <= 6.0 <= good['interval'][1] and good['seeds'] == 2
    assert good['gap'] == pytest.approx(0.2) and 'gap' not in bad


def test_intervals_and_ranks_tell_planners_apart():
    assert tuple(interval(np.full(10, 2.0))) == (20.0, 20.0)
    rng = np.random.default_rng(0)
    base = rng.uniform(1.0, 2.0, 12)
    test = ranks({'best': base, 'worse': base + 1.0, 'alike': base + rng.normal(0, 1e-3, 12)})
    assert test['leader'] in ('best', 'alike') and test['friedman_p'] < 0.01
    assert test['against_leader']['worse'] < 0.01
    assert max(test['against_leader'].values()) > 0.01
    assert ranks({'a': base[:2], 'b': base[:2]})['friedman_p'] is None


@pytest.mark.parametrize(('arguments', 'words'), [
    (['--rig', 'rig.yaml', '--cameras', '3'], '--cameras: found 3 with --rig'),
    (['--rig', 'rig.yaml', '--sensor', 'd455'], '--sensor: found d455 with --rig'),
    (['--mount', 'walls'], '--mount: found walls without --sensor'),
    (['--sensor', 'd4'], 'd4'), (['--scale', '0.001'], '--rooms'),
    (['--planners', 'magic'], 'magic'),
    (['--planners', 'learned', '--model', 'nowhere'], 'nowhere'), (['--out', 'rig.yaml'], '--out'),
    (['--workers', '0'], '--workers'), (['--budgets', 'many'], '--budgets')])
def test_options_that_cannot_be_are_refused(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'rig.yaml').write_text(D455)
    assert cli.main(['benchmark', *arguments, '--json']) == 2
    assert words in json.loads(capsys.readouterr().out)['error']


def test_weights_that_are_too_large_are_refused_before_they_are_read(
        tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with open('sparse.safetensors', 'wb') as file:
        file.truncate(8 << 30)
    assert cli.main(['benchmark', '--model', 'sparse.safetensors', '--json']) == 2
    assert 'bytes at most' in json.loads(capsys.readouterr().out)['error']


def test_another_scan_under_the_same_name_is_another_room(tmp_path):
    task, stems = BenchmarkTask(str(tmp_path / 'a.npy'), 0.0, 'random'), []
    for points in (20, 30):
        np.save(task.room, np.zeros((points, 3)))
        stems.append(comparison.task_file_stem(task))
        assert comparison.task_file_stem(task) == stems[-1]
    assert stems[0] != stems[1]


@pytest.mark.parametrize(('arguments', 'cameras', 'mount'), [
    ([], 4, 'plane'), (['--cameras', '2'], 2, 'plane'),
    (['--cameras', '3', '--sensor', 'd455'], 3, 'walls')])
def test_cameras_and_sensor_say_what_is_compared(tmp_path, monkeypatch, arguments, cameras, mount):
    monkeypatch.chdir(tmp_path)
    asked = []

    def stop(protocol, *_):
        asked.append(protocol)
        raise ConfigurationError('enough')

    monkeypatch.setattr(comparison, 'compare', stop)
    assert cli.main(['benchmark', *arguments]) == 2
    rig = load_rig(asked[0].simulation.rig_file)
    assert (asked[0].cameras, rig.mount.on, len(rig.cameras)) == (cameras, mount, cameras)
    assert rig.farthest == (4.0 if mount == 'plane' else 6.0)


# Two nodes are a dozen processes to start, on however few cores.
@pytest.mark.system
def test_a_ray_cluster_of_two_nodes_does_the_same(tmp_path):
    ray = pytest.importorskip('ray', reason='comparing on a cluster needs ocp_ros[ray]')
    from ray.cluster_utils import Cluster
    cluster = Cluster(initialize_head=True, head_node_args={'num_cpus': 1})
    try:
        cluster.add_node(num_cpus=1)
        rows = comparison.run_tasks(SMALL, tmp_path / 'ray', 1, cluster.address)
    finally:
        ray.shutdown()
        cluster.shutdown()
    there = [row['placement'] for row in rows if row['planner'] == 'tdsa']
    here = run_task(SMALL, BenchmarkTask('3', 0.0, 'tdsa'))
    assert there == [row['placement'] for row in here]


@pytest.mark.system
def test_planners_are_compared_for_a_rig_file(tmp_path, capsys):
    rig, rooms, out = (tmp_path / name for name in ('rig.yaml', 'rooms', 'out'))
    rig.write_text(D455)
    save_scene(made_room(3, 8000), rooms / 'room.ply')
    assert cli.main(['benchmark', '--rig', str(rig), '--rooms', str(rooms), '--planners',
                     'rig_search,random,lookahead', '--budgets', '100', '--seeds', '1',
                     '--workers', '1', '--out', str(out)]) == 0, capsys.readouterr().err
    rows = json.loads((out / 'results.json').read_text())
    errors = {row['planner']: row['depth_error'] for row in rows}
    assert set(errors) == {RANDOM_PLACEMENT, RAY_SEARCH, 'rig_search', 'random', 'lookahead'}
    assert all(np.shape(row['placement']) == (2, 6) for row in rows)
    control = [row for row in rows if row['planner'] == RANDOM_PLACEMENT]
    assert errors['rig_search'] < np.median([row['depth_error'] for row in control])
    assert all(control[0]['lower_bound'] <= row['exact'] + 1e-9 for row in control)
    summary = json.loads((out / 'summary.json').read_text())
    assert (summary['rig'], summary['cameras']) == ('rig.yaml', 2)
    assert benchmark_report.main([str(out)]) == 0
    written = (out / 'README.md').read_text()
    assert 'rig.yaml' in written and '| rig search | ' in written
    assert (out / 'rooms.png').exists()


def rows_by_room(errors):
    """Return rows of planners from their errors by room: {(planner, budget): (R,)}."""
    return [{'planner': planner, 'budget': budget, 'room': str(room), 'rotation': 0.0, 'seed': 0,
             'depth_error': float(error)}
            for (planner, budget), values in errors.items() for room, error in enumerate(values)]


def test_pairs_say_who_is_better_and_whether_it_is_chance():
    rng = np.random.default_rng(0)
    hard = rng.lognormal(0.0, 2.0, 40)
    found = pairs(rows_by_room({
        ('mine', 0): 0.8 * hard, ('worse', 0): hard, ('same', 0): 0.8 * hard,
        ('noise', 0): 0.8 * hard * rng.lognormal(0.0, 0.3, 40),
        (RANDOM_PLACEMENT, 1): hard}), 'mine')
    assert set(found) == {'mine', 'worse', 'same', 'noise'}
    worse = found['worse']
    assert worse['wins'] == worse['rooms'] == 40 and worse['p'] < 1e-6
    expected = np.exp(np.log((0.8 * hard + LOG_OFFSET_M) / (hard + LOG_OFFSET_M)).mean())
    assert worse['ratio'] == pytest.approx(expected) and 0.79 < worse['ratio'] < 0.9
    assert worse['interval'][0] <= worse['ratio'] <= worse['interval'][1] < 1.0
    assert found['same']['p'] is None and found['same']['ratio'] == 1.0
    low, high = found['noise']['interval']
    assert low < 1.0 < high and found['noise']['p'] > 0.05
    assert worse['sum'] == pytest.approx(hard.sum())
    # Planners with several budgets are named by them.
    found = pairs(rows_by_room({('mine', 100): [1.0, 2.0], ('mine', 1000): [1.0, 1.0],
                                ('tdsa', 100): [2.0, 1.0], ('tdsa', 1000): [1.0, 1.0]}), 'mine')
    assert set(found) == {f'{name}, {budget}' for name in ('mine', 'tdsa')
                          for budget in ('100', '1,000')}
    assert found['tdsa, 100']['wins'] == 1 and found['tdsa, 100']['p'] is None


def test_cameras_that_cannot_keep_their_spacing_are_refused(tmp_path):
    (tmp_path / 'rig.yaml').write_text(f'{D455}spacing: 90\n')
    protocol = replace(SMALL, simulation=placement_settings(tmp_path / 'rig.yaml'))
    with pytest.raises(ConfigurationError, match='spacing'):
        run_task(protocol, BenchmarkTask('3', 0.0, RANDOM_PLACEMENT))


@pytest.fixture
def recorded(tmp_path, monkeypatch):
    """Return what reads a result that was recorded, in a folder of its own."""
    monkeypatch.setattr(results, 'FOLDER', tmp_path / 'results')
    return lambda name: json.loads((tmp_path / 'results' / f'{name}.json').read_text())


def test_the_engine_is_measured(recorded, monkeypatch, capsys):
    monkeypatch.setattr(engine, 'MIDDLE', 2000)
    # It plays for seconds, however small the room is.
    monkeypatch.setattr(engine, 'speed', lambda: dict.fromkeys(engine.SPEEDS, 1.0))
    monkeypatch.setattr(engine, 'training_speed', lambda *interactions: 1.0)
    monkeypatch.setitem(engine.EXTENTS, 'smoke', engine.Extent((2000,), 1, 1, (2000,)))
    assert engine.main(['--preset', 'smoke', '--record']) == 0
    found = recorded('engine')
    assert found['command'] == 'python -m benchmarks.engine --preset smoke --record'
    assert found['f1'].keys() == found['ms'].keys() == {
        f'{name}.2000' for name in ('fine', 'fast', 'paper', 'embree', 'hidden_point_removal')}
    assert found['f1']['embree.2000'] == 1.0 > found['f1']['fast.2000'] > 0.6
    assert 'evaluations_per_s: ' in capsys.readouterr().out


def test_the_agent_is_compared_room_by_room(tmp_path, monkeypatch, capsys):
    played = []

    def play(planners, baselines, seeds, model, task):
        played.append(task.name)
        errors = {'learned': 1.0, 'lookahead': 2.0 if task.room == '501' else 0.5}
        return {name: {'log_error': np.log(errors[name]), 'seen': 0.9, 'ms': 1.0}
                for name in planners}

    monkeypatch.setattr(agent, 'play_task', play)
    monkeypatch.setattr(agent, 'WorkerPool', Here)
    out = tmp_path / 'agent.json'
    command = ['--cameras', '2', '4', '--lengths', '8x2', '--planners', 'learned', 'lookahead',
               '--out', str(out), '--most-rooms']
    agent.main([*command, '1'])
    assert played == ['2_8x2, 501, 0', '4_8x2, 501, 0']
    agent.main([*command, '2'])
    assert played[2:] == ['2_8x2, 503, 0', '4_8x2, 503, 0']
    found = json.loads(out.read_text())['summary']
    for pair in (found['pooled']['lookahead'], found['settings']['4_8x2']['lookahead']):
        assert pair['ratio'] == pytest.approx(1.0) and pair['won'] == 1 and pair['rooms'] == 2
        assert pair['interval'] == pytest.approx([0.5, 2.0])
    with pytest.raises(ConfigurationError, match='name another file'):
        agent.main([*command, '2', '--seeds', '3'])


def test_a_comparison_is_written_shown_and_reported(tmp_path, recorded, monkeypatch, capsys):
    monkeypatch.setattr(comparison, 'run_task', rows_for)
    monkeypatch.setattr(comparison, 'WorkerPool', Here)
    np.save(tmp_path / 'small.npy', made_room(8, 2000).points)
    out = tmp_path / 'out'
    command = ['benchmark', '--rooms', str(tmp_path), '--planners', 'random,tdsa,lookahead',
               '--budgets', '5,30', '--seeds', '1', '--out', str(out)]
    assert cli.main(command) == 0
    printed = capsys.readouterr().out
    assert 'lookahead' in printed and str(out / 'results.csv') in printed
    summary = json.loads((out / 'summary.json').read_text())
    assert set(summary['planners']) == {'random', 'tdsa', 'lookahead'}
    # The first planner against each of the others, and not against itself.
    assert set(summary['pairs']) == {'random, 5', 'random, 30', 'tdsa, 5', 'tdsa, 30',
                                     'lookahead'}
    shown = {name: line for line in printed.splitlines() for name in summary['planners']
             if f' {name} ' in line}
    assert ' to ' in shown['tdsa'] and ' to ' not in shown['random']
    lines = (out / 'results.csv').read_text().splitlines()
    assert len(lines) == 1 + RANDOM_PLACEMENTS + 1 + 4 + 1
    assert benchmark_report.main([str(out), '--record', 'benchmark']) == 0
    text = (out / 'README.md').read_text()
    assert '    ocp benchmark --rooms ' in text and '| random | scores | 2.10 |' in text
    assert '(rooms.png)' in text and (out / 'rooms.png').stat().st_size > 10000
    found = recorded('benchmark')
    assert found['command'] == summary['command'] and found['commit']
    assert found['points'] == summary['points']
