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

"""ocp score: what it says is so, in which frame, and what is wrong with its files."""

import csv
import json
from pathlib import Path

from conftest import made_room, printed, refused, write_half
import numpy as np
from ocp_ros.cli.main import main
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.geometry.engine_config import EngineConfig, PROMISING
from ocp_ros.report.findings import improvements
from ocp_ros.rig.placement_file import load_placement
from ocp_ros.rig.rig_file import load_rig, rig_of
from ocp_ros.scenes.scene_files import load_scene
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
import pytest
from scipy.spatial.transform import Rotation
import yaml

RIG = """\
cameras:
  - {sensor: realsense_d455, count: 2}
  - {sensor: kinect_v2}
fixed:
  - {sensor: realsense_d455, position: [6.5, 6.5, 2.2], yaw: 225, pitch: 25, name: door}
mount: {on: plane, height: 1.9, footprint: 0}
pitch: [0, 60]
spacing: 0.5
regions:
  - {name: table, box: [[2, 2, 0], [5, 5, 1.5]], weight: 2.0, must_see: true}
"""
PLACEMENT = """\
cameras:
  - {position: [1.0, 1.0, 1.9], yaw: 45, pitch: 25}
  - {position: [1.2, 1.2, 1.9], yaw: 100, pitch: 80}
  - {position: [3.0, 1.0, 1.9], yaw: 135, pitch: 25, name: kinect}
"""
SCORE = ['score', 'room.ply', 'placement.yaml', '--rig', 'rig.yaml']


@pytest.fixture
def files(room_folder, undrawn):
    """Write a rig and a placement of it beside the room."""
    (room_folder / 'rig.yaml').write_text(RIG)
    (room_folder / 'placement.yaml').write_text(PLACEMENT)
    return room_folder


def test_json_says_what_the_engine_says(files, capsys):
    found = printed(capsys, *SCORE)
    scene, rig = load_scene('room.ply'), load_rig('rig.yaml')
    objective = Problem.of(scene, rig, SimulationConfig(engine=PROMISING)).objective
    poses = np.array([[1.0, 1.0, 1.9, 45, 25, 0], [1.2, 1.2, 1.9, 100, 80, 0],
                      [3.0, 1.0, 1.9, 135, 25, 0]])
    poses[:, 3:] = np.deg2rad(poses[:, 3:])
    views = objective.look(poses)
    worth, scores = objective.evaluate_views(views), found['scores']
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
    assert pitch.startswith('realsense_d455_2: found a pitch of 80 degrees')
    assert near.startswith('realsense_d455_2: found 0.28 m to realsense_d455_1')
    assert region.startswith(f'table: found {100 * table["seen"]:.1f} %')
    assert found['notes'] == [] and found['room']['file'] == 'room.ply'


def test_one_more_camera_helps_as_much_as_it_says(files, capsys):
    found = printed(capsys, *SCORE)
    more, missed = found['one_more'], found['missed']
    gain = found['scores']['depth_error'] - more['depth_error']
    assert more['gain'] == pytest.approx(gain) and gain > 0.0
    place = {key: more[key] for key in ('position', 'yaw', 'pitch', 'roll')}
    (files / 'more.yaml').write_text(f'{PLACEMENT}  - {json.dumps(place)}\n')
    (files / 'more_rig.yaml').write_text(RIG.replace(
        'fixed:', f'  - {{sensor: {more["sensor"]}, name: added}}\nfixed:'))
    better = printed(capsys, 'score', 'room.ply', 'more.yaml', '--rig', 'more_rig.yaml')
    # Its pose is printed with three decimals.
    assert better['scores']['depth_error'] == pytest.approx(more['depth_error'], rel=0.02)
    assert len(better['broken']) <= len(found['broken'])
    assert missed['share'] == pytest.approx(1.0 - found['scores']['seen'])
    assert 0.0 <= missed['hopeless'] <= missed['share'] and len(missed['places']) == 3
    assert missed['places'][0]['share'] >= missed['places'][1]['share']


def test_what_is_printed_names_all_of_it(files, capsys):
    assert main(SCORE) == 0
    out = ' '.join(capsys.readouterr().out.split())
    for words in ('door (fixed)', 'depth error', 'seen by 0:', '3 or more:', 'table', '95.0 %',
                  'a pitch of 80 degrees', 'missed:', 'helps most at ('):
        assert words in out, words


def test_another_room_or_rig_than_that_of_the_scores_is_noted(files, capsys):
    first = printed(capsys, 'score', '8', *SCORE[2:], '--points', 1500, '--out', 'out')
    assert first['room']['seed'] == 8
    other = printed(capsys, 'score', 'room.ply', 'out/placement.yaml')
    assert 'another scan' in other['notes'][0]
    (files / 'rig.yaml').write_text(RIG.replace('weight: 2.0', 'weight: 5.0'))
    other = printed(capsys, 'score', '8', 'out/placement.yaml', '--rig', 'rig.yaml')
    assert 'objective value' in other['notes'][0]
    assert printed(capsys, 'score', '8', 'out/placement.yaml')['notes'] == []


def test_where_nothing_more_may_hang_no_camera_is_offered(room):
    rig = rig_of(1, 'd455', keep_out=[{'box': [[-9, -9, -9], [99, 99, 99]]}])
    problem = Problem.of(room, rig, SimulationConfig(engine=EngineConfig(preset='fast')))
    poses = np.array([[2.0, 2.0, 1.9, 0.0, 0.4, 0.0]])
    found = improvements(problem, poses, problem.look(poses))
    assert found['one_more'] is None
    assert found['missed']['hopeless'] == found['missed']['share'] > 0.5


@pytest.mark.parametrize(('arguments', 'words'), [
    (['broken.ply', *SCORE[2:]], 'broken.ply'),
    (['room.ply', 'placement.yaml'], 'placement.yaml: line 2, cameras[0]'),
    (['room.ply', 'placement.yaml', '--rig', 'none.yaml'], 'none.yaml'),
    (['room.ply', 'none.yaml'], 'none.yaml'), (['room.ply', 'room.ply'], 'room.ply: line'),
    (['room.ply', 'rig.yaml'], 'rig.yaml: line 2, cameras[0].count'),
    ([*SCORE[1:], '--scale', '1e9'], 'room.ply: found scale'),
    ([*SCORE[1:], '--out', 'rig.yaml'], '--out: found rig.yaml'),
    (['8', *SCORE[2:], '--up', 'y'], '--up'),
    (['room.ply', 'placement.yaml', '--rig', 'far.yaml'], 'far.yaml: line 10, regions[0]'),
    (['room.ply', 'placement.yaml', '--rig', 'high.yaml'], 'high.yaml: line 6, mount.height')])
def test_bad_input_ends_with_two_and_one_sentence(files, capsys, arguments, words):
    write_half(files / 'broken.ply')
    (files / 'far.yaml').write_text(RIG.replace('[5, 5, 1.5]', '[2.01, 2.01, 0.01]'))
    (files / 'high.yaml').write_text(RIG.replace('height: 1.9', 'height: 9'))
    assert words in refused(capsys, 'score', *arguments)


@pytest.mark.filterwarnings('default')
def test_a_room_that_lies_on_its_side_is_warned_of_in_one_line(files, capsys):
    np.save('side.npy', made_room(3, 8000).points[:, [0, 2, 1]])
    main(['score', 'side.npy', *SCORE[2:], '--json'])
    warning = capsys.readouterr().err
    assert warning.startswith('ocp: warning: side.npy: found') and warning.count('\n') == 1
    assert '--up y' in warning


@pytest.fixture
def export(tmp_path, monkeypatch, undrawn):
    """
    Return what exports two cameras in a scan in millimetres, y up and far from the origin.

    The function takes options and returns the written placement and the scan.
    """
    monkeypatch.chdir(tmp_path)
    points = 1000.0 * made_room(8, 2000).points.astype(np.float64)[:, [0, 2, 1]] * [1, 1, -1]
    np.save('utm.npy', points + [512_300_000.0, 0.0, -5_400_000_000.0])
    # The map's origin is whole hundreds of metres from that of the scan.
    scene = load_scene('utm.npy', scale=0.001, up='y')
    cameras = [{'sensor': 'kinect_v2', 'position': [1.0, 2.0, 2.0], 'yaw': 80, 'pitch': 30},
               {'sensor': 'realsense_d455', 'position': [6.0, 2.5, 1.9], 'yaw': 120, 'pitch': 20}]
    for camera in cameras:
        camera['position'] = np.round(scene.bounds[0] + camera['position'], 3).tolist()
    content = {'cameras': cameras, 'engine': {'preset': 'fast', 'error_rows': 32}}
    Path('cameras.yaml').write_text(yaml.safe_dump(content))

    def score(*options):
        assert main(['score', 'utm.npy', 'cameras.yaml', '--out', 'out', '--scale', '0.001',
                     '--up', 'y', *options]) == 0
        return load_placement('out/placement.yaml'), scene

    return score


def written(name):
    """Return the text of a file that was exported."""
    return Path('out', name).read_text()


def test_a_placement_by_hand_is_exported_with_what_it_asks_for_and_how_its_room_was_read(
        export, capsys):
    export('--json')
    first = json.loads(capsys.readouterr().out)
    assert first['room']['scale'] == 0.001 and first['room']['up'] == 'y'
    created = yaml.safe_load(written('placement.yaml'))['created']
    assert created['command'].startswith('ocp score utm.npy cameras.yaml --out')
    again = printed(capsys, 'score', 'utm.npy', 'out/placement.yaml')
    assert again['notes'] == []
    for key in ('scores', 'one_more', 'broken'):
        assert again[key] == first[key], key


def test_files_for_people_are_in_the_frame_of_the_scan_and_files_for_programs_in_the_map(export):
    placement, scene = export()
    row = next(csv.DictReader(written('cameras.csv').splitlines()))
    there = placement.cameras[0].position
    assert row['frame'] == 'map' and [float(row[axis]) for axis in 'xyz'] == pytest.approx(there)
    told = ', '.join(f'{value:.0f}' for value in scene.source.to_source(there))
    assert told in written('installer.md')
    assert 'units of the scan, millimetres' in written('installer.md')
    assert told in written('report.html')
    matrix = np.array(placement.room['source_from_map'])
    np.testing.assert_allclose((matrix @ [*there, 1.0])[:3], scene.source.to_source(there))
    launch = written('cameras.launch.py')
    assert "('map', 'scan'," in launch and "('map', 'camera_0'," in launch
    assert 'name="scan"' in written('cameras.urdf.xacro')


def test_everything_but_placements_can_be_in_the_frame_of_the_scan(export):
    placement, scene = export('--frame', 'source')
    rows = csv.DictReader(written('cameras.csv').splitlines())
    for row, placed in zip(rows, placement.cameras, strict=True):
        assert row['frame'] == 'scan'
        there = [float(row[axis]) for axis in 'xyz']
        np.testing.assert_allclose(scene.source.to_map(there), placed.position, atol=1e-5)
        angles = np.deg2rad([float(row[name]) for name in ('yaw', 'pitch', 'roll')])
        turned = scene.source.rotation @ rotation_matrix(*angles)
        np.testing.assert_allclose(turned, rotation_matrix(*np.deg2rad(placed.angles)), atol=1e-6)
    content, launch = {}, written('cameras.launch.py')
    exec(launch[launch.index('FRAMES'):launch.index('OPTIONS')], content)
    frames = {frame[1]: frame for frame in content['FRAMES']}
    # Transforms are in metres: a camera on the map and by way of the scan is in one place.
    turn = Rotation.from_euler('xyz', frames['map'][5:]).as_matrix()
    on_map = turn.T @ (np.array(frames['camera_0'][2:5]) - frames['map'][2:5])
    assert frames['camera_0'][0] == 'scan' == frames['map'][0]
    np.testing.assert_allclose(on_map, placement.cameras[0].position, atol=1e-5)


def test_pages_can_be_in_the_frame_of_the_map(export):
    x, y, z = export('--frame', 'map')[0].cameras[0].position
    assert f'{x:.3f}, {y:.3f}, {z:.3f}' in written('installer.md')
