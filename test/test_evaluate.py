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

"""Policies judged room by room: pairs and ``ocp evaluate``."""

import json

import numpy as np
from ocp_ros.cli.main import main
from ocp_ros.compare.protocol import RANDOM_PLACEMENT
from ocp_ros.compare.summary import LOG_OFFSET_M, pairs
from ocp_ros.rooms.generator import generate_room
from ocp_ros.scenes.scene_files import save_scene
import pytest


def rows(errors):
    """Return rows of planners from their errors by room: {(planner, budget): (R,)}."""
    return [{'planner': planner, 'budget': budget, 'room': str(room), 'rotation': 0.0, 'seed': 0,
             'depth_error': float(error)}
            for (planner, budget), values in errors.items() for room, error in enumerate(values)]


def test_pairs_say_who_is_better_and_whether_it_is_chance():
    rng = np.random.default_rng(0)
    hard = rng.lognormal(0.0, 2.0, 40)
    found = pairs(rows({
        ('mine', 0): 0.8 * hard, ('worse', 0): hard, ('same', 0): 0.8 * hard,
        ('noise', 0): 0.8 * hard * rng.lognormal(0.0, 0.3, 40),
        (RANDOM_PLACEMENT, 1): hard}), 'mine')
    assert set(found) == {'mine', 'worse', 'same', 'noise'}
    worse = found['worse']
    assert worse['wins'] == worse['rooms'] == 40 and worse['p'] < 1e-6
    expected = np.exp(np.mean(np.log(0.8 * hard + LOG_OFFSET_M) - np.log(hard + LOG_OFFSET_M)))
    assert worse['ratio'] == pytest.approx(expected) and 0.79 < worse['ratio'] < 0.9
    low, high = worse['interval']
    assert low <= worse['ratio'] <= high < 1.0
    assert found['same']['p'] is None and found['same']['ratio'] == 1.0
    low, high = found['noise']['interval']
    assert low < 1.0 < high and found['noise']['p'] > 0.05
    assert found['worse']['sum'] == pytest.approx(hard.sum())


def test_planners_with_several_budgets_are_named_by_them():
    found = pairs(rows({('mine', 0): [1.0, 2.0], ('tdsa', 100): [2.0, 1.0],
                        ('tdsa', 1000): [1.0, 1.0]}), 'mine')
    assert set(found) == {'mine', 'tdsa, 100', 'tdsa, 1,000'}
    assert found['tdsa, 100']['wins'] == 1 and found['tdsa, 100']['p'] is None


@pytest.mark.system
def test_evaluate_plays_scans_with_each_number_of_cameras(tmp_path, capsys):
    scans = []
    for seed in (8, 9):
        save_scene(generate_room(seed, 1500), tmp_path / f'{seed}.ply')
        scans.append(str(tmp_path / f'{seed}.ply'))
    command = ['evaluate', '--planners', 'greedy_step,greedy_coverage', '--budgets', '20',
               '--cameras', '1,2', '--workers', '1', '--out', str(tmp_path / 'out'), '--rooms']
    assert main([*command, *scans]) == 0
    found = json.loads((tmp_path / 'out' / 'evaluation.json').read_text())
    assert set(found['cameras']) == {'1', '2'} and found['model'] == 'map'
    for judged in found['cameras'].values():
        assert set(judged['pairs']) == {'greedy_step', 'greedy_coverage'}
        assert set(judged['rooms']['greedy_step, 0']) == {'8', '9'}
        assert 0.0 < judged['slowest_turn']['greedy_step'] < 60.0
    one, two = (found['cameras'][count]['pairs']['greedy_step']['sum'] for count in '12')
    assert two < one
    assert '1 cameras' in capsys.readouterr().out


@pytest.mark.system
def test_evaluate_takes_a_rig_file_and_weights(tmp_path, capsys):
    rig, scan = tmp_path / 'rig.yaml', tmp_path / '8.ply'
    rig.write_text('cameras: [{sensor: realsense_d455}]\nmount: {on: ceiling}\n')
    save_scene(generate_room(8, 1500), scan)
    command = ['evaluate', '--rig', str(rig), '--workers', '1', '--budgets', '5', '--out',
               str(tmp_path / 'out'), '--rooms', str(scan), '--planners']
    assert main([*command, 'greedy_step,random']) == 0
    found = json.loads((tmp_path / 'out' / 'evaluation.json').read_text())
    assert set(found['cameras']) == {'1'}
    assert set(found['cameras']['1']['pairs']) == {'greedy_step', 'random'}
    assert main([*command, 'random', '--cameras', '2']) == 2
    assert '--cameras: found 2 with --rig; expected one of the two' in capsys.readouterr().err
    again = [*command, 'learned', '--model', 'nowhere', '--out', str(tmp_path / 'other')]
    assert main(again) == 2
    assert 'nowhere' in capsys.readouterr().err
