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

"""ocp score: what it says is so, and what is wrong with its files it says in one sentence."""

import json

from conftest import BAD_ROOMS, made_room
import numpy as np
from ocp_ros.cli.main import main
from ocp_ros.geometry.engine_config import EngineConfig, PROMISING
from ocp_ros.report.findings import improvements
from ocp_ros.rig.rig_file import load_rig, rig_of
from ocp_ros.rooms.scene_source import room_named
from ocp_ros.scenes.scene_files import load_scene, save_scene
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
import pytest
import yaml

RIG = """\
cameras:
  - {sensor: realsense_d455, count: 2}
  - {sensor: kinect_v2}
fixed:
  - {sensor: realsense_d455, position: [6.5, 6.5, 2.2], yaw: 225, pitch: 25, name: door}
mount: {on: plane, height: 1.9}
pitch: [0, 60]
spacing: 0.5
regions:
  - {name: table, box: [[2, 2, 0], [5, 5, 1.5]], weight: 2.0, must_see: true}
"""
PLACEMENT = """\
cameras:
  - {position: [1.0, 1.0, 1.9], yaw: 45, pitch: 25}
  - {position: [1.2, 1.2, 1.9], yaw: 100, pitch: 80}
  - {position: [7.0, 1.0, 1.9], yaw: 135, pitch: 25, name: kinect}
"""


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Write a room, a rig and a placement of it to the folder that is worked in."""
    save_scene(made_room(8, 2500), tmp_path / 'room.ply')
    (tmp_path / 'rig.yaml').write_text(RIG)
    (tmp_path / 'placement.yaml').write_text(PLACEMENT)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def scored(capsys, *arguments):
    """Return what ocp score prints as JSON, and nothing else."""
    assert main(['score', *map(str, arguments), '--json']) == 0
    out, err = capsys.readouterr()
    assert err == ''
    return json.loads(out)


def test_json_says_what_the_engine_says(files, capsys):
    found = scored(capsys, 'room.ply', 'placement.yaml', '--rig', 'rig.yaml')
    scene, rig = load_scene('room.ply'), load_rig('rig.yaml')
    objective = Problem.of(scene, rig, SimulationConfig(engine=PROMISING)).objective
    poses = np.array([[1.0, 1.0, 1.9, 45, 25, 0], [1.2, 1.2, 1.9, 100, 80, 0],
                      [7.0, 1.0, 1.9, 135, 25, 0]])
    poses[:, 3:] = np.deg2rad(poses[:, 3:])
    views = objective.look(poses)
    worth, scores = objective.judge(views), found['scores']
    assert scores['depth_error'] == worth.depth_error and scores['loss'] == worth.loss
    assert scores['space_coverage'] == worth.space_coverage
    assert scores['seen'] == len(worth.seen) / len(scene)
    assert sum(scores['overlap'].values()) == scores['points'] == len(scene)
    assert scores['overlap']['0'] == len(scene) - len(worth.seen)
    assert [camera['name'] for camera in scores['cameras']] == [
        'realsense_d455_1', 'realsense_d455_2', 'kinect', 'door']
    for camera, added in zip(scores['cameras'], objective.contributions(views)):
        assert (camera['depth_error'], camera['only']) == added
    table, = scores['regions']
    assert table['seen'] == worth.regions[0] and not table['met']
    pitch, near, region = found['broken']
    assert pitch.startswith('realsense_d455_2: found a pitch of 80 degrees; expected 0 to 60')
    assert near.startswith('realsense_d455_2: found 0.28 m to realsense_d455_1; expected at least')
    assert region.startswith(f'table: found {100 * table["seen"]:.1f} % of its points seen; '
                             'expected 95.0 % (must_see)')
    assert found['notes'] == [] and found['room']['file'] == 'room.ply'


def test_one_more_camera_helps_as_much_as_it_says(files, capsys):
    found = scored(capsys, 'room.ply', 'placement.yaml', '--rig', 'rig.yaml')
    more, missed = found['one_more'], found['missed']
    assert more['gain'] == pytest.approx(
        found['scores']['depth_error'] - more['depth_error']) and more['gain'] > 0.0
    text = PLACEMENT.splitlines(keepends=True)
    place = {key: more[key] for key in ('position', 'yaw', 'pitch', 'roll')}
    index = 3 if more['sensor'] == 'realsense_d455' else 4
    (files / 'more.yaml').write_text(''.join(
        [*text[:index], f'  - {json.dumps(place)}\n', *text[index:]]))
    count = 'count: 3' if index == 3 else 'count: 2'
    second = '{sensor: kinect_v2}' if index == 3 else '{sensor: kinect_v2, count: 2}'
    (files / 'more_rig.yaml').write_text(
        RIG.replace('count: 2', count).replace('{sensor: kinect_v2}', second))
    better = scored(capsys, 'room.ply', 'more.yaml', '--rig', 'more_rig.yaml')
    # Its pose is printed with three decimals.
    assert better['scores']['depth_error'] == pytest.approx(more['depth_error'], rel=0.02)
    assert len(better['broken']) <= len(found['broken'])
    assert missed['share'] == pytest.approx(1.0 - found['scores']['seen'])
    assert 0.0 <= missed['hopeless'] <= missed['share'] and len(missed['places']) == 3
    assert missed['places'][0]['share'] >= missed['places'][1]['share']


def test_what_is_printed_names_all_of_it(files, capsys):
    assert main(['score', 'room.ply', 'placement.yaml', '--rig', 'rig.yaml']) == 0
    out = ' '.join(capsys.readouterr().out.split())
    for words in ('door (fixed)', 'depth error', 'seen by 0:', '3 or more:', 'table',
                  '95.0 %', 'constraints violated:', 'found a pitch of 80 degrees',
                  'missed:', 'no candidate sees', 'helps most at ('):
        assert words in out, words
    placement = '{cameras: [{sensor: realsense_d455, position: [4, 4, 1.9]}]}'
    (files / 'placement.yaml').write_text(placement)
    assert main(['score', 'room.ply', 'placement.yaml']) == 0
    assert 'all constraints are satisfied' in capsys.readouterr().out


def test_what_is_exported_has_the_same_scores(files, capsys):
    first = scored(capsys, 'room.ply', 'placement.yaml', '--rig', 'rig.yaml', '--out', 'out')
    written = {path.name for path in (files / 'out').glob('[!.]*')}
    assert written == {'placement.yaml', 'placement.json', 'cameras.csv', 'cameras.launch.py',
                       'cameras.urdf.xacro', 'cameras.rviz', 'installer.md', 'plan.png',
                       'report.png', 'report.html'}
    assert sorted(first['written']) == sorted(f'out/{name}' for name in written)
    content = yaml.safe_load((files / 'out' / 'placement.yaml').read_text())
    assert content['created']['command'].startswith('ocp score room.ply placement.yaml --rig')
    assert content['scores'] == first['scores'] and content['room'] == first['room']
    for suffix in ('yaml', 'json'):
        again = scored(capsys, 'room.ply', f'out/placement.{suffix}')
        assert again['scores'] == first['scores'] and again['broken'] == first['broken']
        assert again['one_more'] == first['one_more'] and again['notes'] == []


def test_a_placement_written_by_hand_is_exported_with_what_it_asks_for(files, capsys):
    (files / 'placement.yaml').write_text('cameras:\n' + ''.join(
        f'  - {{sensor: {sensor}, position: [{x}, 1.0, 2.0], yaw: 80, pitch: 30}}\n'
        for sensor, x in (('kinect_v2', 1.0), ('realsense_d455', 6.0))))
    first = scored(capsys, 'room.ply', 'placement.yaml', '--out', 'out')
    again = scored(capsys, 'room.ply', 'out/placement.yaml')
    assert again['scores'] == first['scores'] and again['notes'] == first['broken'] == []
    assert again['one_more'] == first['one_more']


def test_a_placement_remembers_how_its_room_was_read(files, capsys):
    points = made_room(8, 2500).points * 100.0
    np.save('turned.npy', points[:, [0, 2, 1]] * [1, 1, -1])
    first = scored(capsys, 'turned.npy', 'placement.yaml', '--rig', 'rig.yaml', '--scale', 0.01,
                   '--up', 'y', '--out', 'out')
    assert first['room']['scale'] == 0.01 and first['room']['up'] == 'y'
    again = scored(capsys, 'turned.npy', 'out/placement.yaml')
    assert again['scores'] == first['scores']
    upright = scored(capsys, 'room.ply', 'placement.yaml', '--rig', 'rig.yaml')
    assert first['scores']['loss'] == pytest.approx(upright['scores']['loss'], rel=0.05)


def test_another_room_or_rig_than_that_of_the_scores_is_noted(files, capsys):
    scored(capsys, '8', 'placement.yaml', '--rig', 'rig.yaml', '--out', 'out')
    other = scored(capsys, 'room.ply', 'out/placement.yaml')
    assert 'made for another scan' in other['notes'][0]
    (files / 'rig.yaml').write_text(RIG.replace('weight: 2.0', 'weight: 5.0'))
    other = scored(capsys, '8', 'out/placement.yaml', '--rig', 'rig.yaml')
    assert other['notes'][0].startswith('the file has the objective value ')
    assert scored(capsys, '8', 'out/placement.yaml')['notes'] == []


def test_a_generated_room_is_known_by_its_points():
    scene, record = room_named('8', 2500)
    assert record['seed'] == 8 and len(record['sha256']) == 64 and len(scene) > 2000
    assert room_named('8', 2500)[1] == record != room_named('9', 2500)[1]


def test_where_nothing_more_may_hang_no_camera_is_offered(room):
    rig = rig_of(1, 'd455', keep_out=[{'box': [[-9, -9, -9], [99, 99, 99]]}])
    problem = Problem.of(room, rig, SimulationConfig(engine=EngineConfig(preset='fast')))
    poses = np.array([[2.0, 2.0, 1.9, 0.0, 0.4, 0.0]])
    found = improvements(problem, poses, problem.look(poses))
    assert found['one_more'] is None
    assert found['missed']['hopeless'] == found['missed']['share'] > 0.5


def refused(capsys, *arguments):
    """Return the sentence that a command is refused with."""
    assert main(['score', *map(str, arguments)]) == 2
    out, err = capsys.readouterr()
    assert out == '' and err.startswith('ocp: ') and err.count('\n') == 1, err
    assert 'Traceback' not in err and 'found' in err and 'expected' in err, err
    return err


@pytest.mark.parametrize(('name', 'write', 'words', 'remedy'), BAD_ROOMS.values(), ids=BAD_ROOMS)
def test_a_bad_room_is_refused_in_one_sentence(files, capsys, name, write, words, remedy):
    write(files / name)
    sentence = refused(capsys, name, 'placement.yaml', '--rig', 'rig.yaml')
    assert words in sentence and remedy in sentence, sentence


@pytest.mark.parametrize(('arguments', 'words'), [
    (['room.ply', 'none.yaml'], 'none.yaml: found no file that can be read'),
    (['room.ply', 'placement.yaml'], 'placement.yaml: line 2, cameras[0]: found no horizontal_fov'
     ' and no sensor'),
    (['room.ply', 'placement.yaml', '--rig', 'none.yaml'], 'none.yaml: found no file'),
    (['room.ply', 'room.ply'], 'room.ply: line'),
    (['room.ply', 'rig.yaml'], 'rig.yaml: line 2, cameras[0].count: found the unknown key'),
    (['room.ply', 'placement.yaml', '--rig', 'rig.yaml', '--scale', '-1'],
     'room.ply: found scale'),
    (['room.ply', 'placement.yaml', '--rig', 'rig.yaml', '--out', 'rig.yaml'],
     '--out: found rig.yaml, where nothing can be written (it is a file)'),
    (['8', 'placement.yaml', '--rig', 'rig.yaml', '--up', 'y'],
     '--up: found it with the generated room 8; expected a scan'),
    (['room.ply', 'placement.yaml', '--rig', 'far.yaml'],
     'far.yaml: line 10, regions[0]: found no points of room in it'),
    (['room.ply', 'placement.yaml', '--rig', 'high.yaml'],
     'high.yaml: line 6, mount.height: found 9 m; expected less than the 3.')])
def test_bad_input_ends_with_two_and_one_sentence(files, capsys, arguments, words):
    (files / 'far.yaml').write_text(RIG.replace('[5, 5, 1.5]', '[2.01, 2.01, 0.01]'))
    (files / 'high.yaml').write_text(RIG.replace('height: 1.9', 'height: 9'))
    assert words in refused(capsys, *arguments)


@pytest.mark.filterwarnings('default')
def test_a_room_that_lies_on_its_side_is_warned_of_in_one_line(files, capsys):
    np.save('side.npy', made_room(3, 8000).points[:, [0, 2, 1]])
    main(['score', 'side.npy', 'placement.yaml', '--rig', 'rig.yaml', '--json'])
    warning = capsys.readouterr().err
    assert warning.startswith('ocp: warning: side.npy: found') and warning.count('\n') == 1
    assert 'turn it (--up y) unless z is up' in warning
