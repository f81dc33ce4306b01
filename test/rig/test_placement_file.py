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

"""Placement files come back as they were, and what is exported says the same in other words."""

import argparse
import csv
from dataclasses import replace
import io
import json
import re
import sys
from types import SimpleNamespace
import xml.etree.ElementTree as ElementTree

from conftest import box_room, l_shaped, made_room, panel, refused_in_one_sentence
import numpy as np
from ocp_ros.formats.exported import Exported
from ocp_ros.formats.exports import csv_of
from ocp_ros.formats.ros_files import launch_of, rviz_of, xacro_of
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.report.assessment import assess
from ocp_ros.report.camera_words import instructions_for
from ocp_ros.report.facts import facts_of, metres
from ocp_ros.report.findings import scores_of
from ocp_ros.report.installer_page import installer_page
from ocp_ros.report.wall_references import WallReferences, walls_around
from ocp_ros.rig.feasible_region import FeasibleRegion
from ocp_ros.rig.placement_file import load_placement, placement_of, save_placement
from ocp_ros.rig.rig_file import load_rig, rig_of
from ocp_ros.scenes.scene import Scene, turned
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
import pytest
from scipy.spatial.transform import Rotation
import yaml

MIXED = """\
cameras:
  - {sensor: azure_kinect_nfov}
  - {horizontal_fov: 91.3, vertical_fov: 60.7, max_range: 5.1, name: wide, count: 2}
fixed:
  - {sensor: realsense_d455, position: [1.23456789, 2.0, 2.2], yaw: 33.3333333, pitch: 20, name: x}
mount: {on: free, height: [1.5, 2.3]}
regions: [{name: "1e5", box: [[0, 0, 0], [8, 8, 1]], must_see: 0.1}]
seen_by: 2
"""
POSES = np.array([[2.0, 2.00004, 1.9, 0.3, 0.4, 0.0], [1 / 3, 2.0, 1.7, 3.5, 0.5, 0.1],
                  [1.0, 3.0, 2.1, -1.5, 0.6, -3.1]])
HAND = """\
cameras:
  - {sensor: realsense_d455, position: [1, 1, 2.2], yaw: 45, pitch: 25}
  - {horizontal_fov: 90, vertical_fov: 60, max_range: 5, position: [3, 2, 2.0]}
  - {sensor: kinect_v2, position: [2, 2, 2.2], mount: fixed, name: door}
"""


@pytest.fixture
def mixed(tmp_path):
    """Return a rig of three kinds of cameras."""
    (tmp_path / 'rig.yaml').write_text(MIXED)
    return load_rig(tmp_path / 'rig.yaml')


def placement_in(tmp_path, text):
    """Read a placement from a text."""
    (tmp_path / 'placement.yaml').write_text(text)
    return load_placement(tmp_path / 'placement.yaml')


def judged(scene, rig, placement):
    """Return the scores of a placement."""
    objective = Problem.of(scene, rig, SimulationConfig(engine=placement.engine)).objective
    return scores_of(objective, objective.look(placement.poses))


@pytest.mark.parametrize(('suffix', 'preset'), [('yaml', 'fine'), ('json', 'fast')])
def test_a_placement_comes_back_with_the_same_scores(room, mixed, tmp_path, suffix, preset):
    placement = placement_of(mixed, POSES, engine=EngineConfig(preset=preset, error_rows=32),
                             room={'seed': 8, 'points': 2000},
                             created={'date': '2026-11-21', 'command': 'ocp plan: x # y'})
    scores = judged(room, mixed, placement)
    assert 0.0 < scores['seen'] < 1.0 and scores['regions'][0]['seen'] > 0.0
    path = tmp_path / f'placement.{suffix}'
    save_placement(path, replace(placement, scores=scores))
    read, again = load_placement(path), load_placement(path, mixed)
    assert judged(room, read.rig_in(room), read) == scores == read.scores
    assert judged(room, again.rig, again) == scores
    assert np.array_equal(read.poses, placement.poses) and len(read.cameras) == 4
    assert read.cameras[:3] == placement.cameras[:3]
    for field in ('room', 'created', 'engine'):
        assert getattr(read, field) == getattr(placement, field)
    assert [camera.name for camera in read.rig.all_cameras] == [
        'azure_kinect_nfov', 'wide_1', 'wide_2', 'x']


def test_a_placement_of_any_rig_is_read_again(tmp_path):
    numbers = {'horizontal_fov': 91.123456789123, 'vertical_fov': 1.234567890123, 'max_range': 5.1}
    (tmp_path / 'rig.json').write_text(json.dumps({
        'cameras': [{**numbers, 'name': 'n' * 60, 'count': 2}],
        'fixed': [{**numbers, 'position': [1.0, 2.0, 2.2]}]}))
    rig, path = load_rig(tmp_path / 'rig.json'), tmp_path / 'placement.yaml'
    save_placement(path, placement_of(rig, POSES[:2]))
    read = load_placement(path)
    assert [placed.camera.name for placed in read.cameras] == [
        f'{"n" * 58}_1', f'{"n" * 58}_2', 'camera']
    assert read.rig.models == rig.models and np.array_equal(
        load_placement(path, rig).poses, read.poses)
    save_placement(path, replace(read, rig=None))
    bare = load_placement(path)
    assert bare.rig is None
    for placed in bare.cameras:
        for key in ('horizontal_fov', 'vertical_fov'):
            assert np.rad2deg(getattr(placed.camera.model, key)) == pytest.approx(
                numbers[key], rel=1e-11)


def test_poses_are_rounded_to_what_can_be_mounted(mixed):
    placement = placement_of(mixed, POSES)
    assert np.abs(placement.poses[:, :3] - POSES[:, :3]).max() <= 0.5e-4
    turn = np.sin(placement.poses[:, 3:] - POSES[:, 3:])
    assert np.abs(np.rad2deg(turn)).max() <= 0.6e-3
    assert placement.cameras[1].angles[0] == pytest.approx(np.rad2deg(3.5) - 360.0, abs=1e-3)
    assert placement.cameras[0].position == (2.0, 2.0, 1.9)
    with pytest.raises(ValueError, match='poses: found 2'):
        placement_of(mixed, POSES[:2])
    # Cameras without a heading need none.
    level = placement_of(rig_of(2), POSES[:2, :3]).poses
    assert level.shape == (2, 6) and not level[:, 3:].any()


def test_a_placement_written_by_hand_needs_little(room, tmp_path):
    placement = placement_in(tmp_path, HAND)
    assert [placed.camera.name for placed in placement.cameras] == [
        'realsense_d455', 'camera', 'door']
    assert placement.poses.shape == (2, 6) and placement.rig is None
    rig = placement.rig_in(room)
    assert len(rig.cameras) == 2 and len(rig.fixed) == 1
    assert rig.mount.on == 'free' and rig.mount.heights == pytest.approx((2.0, 2.2), abs=0.02)
    assert np.rad2deg(rig.pitch) == pytest.approx((0.0, 60.0)) and not rig.regions
    assert FeasibleRegion(room, rig).broken(placement.poses) == []


@pytest.mark.parametrize('mount', ['plane', 'ceiling'])
def test_a_placement_without_its_rig_keeps_its_mount(room, tmp_path, mount):
    rig = rig_of(2, 'd455', mount={'on': mount})
    placement = placement_of(rig, [[2.0, 2.0, 1.9], [4.0, 4.0, 1.9]])
    save_placement(tmp_path / 'placement.yaml', replace(placement, rig=None))
    found = load_placement(tmp_path / 'placement.yaml').rig_in(room).mount
    assert found.on == mount and (found.heights is None) == (mount == 'ceiling')


#: The cameras to be placed of HAND, as a rig has them.
TWO = '[{sensor: realsense_d455}, {horizontal_fov: 90, vertical_fov: 60, max_range: 5}]'
#: What is changed in HAND, to what, and where the error is said to be.
BAD = [
    ('position: [1, 1, 2.2], ', '', 'line 2, cameras[0]'),
    ('sensor: realsense_d455, ', '', 'line 2, cameras[0]'),
    ('cameras:', 'version: 2\ncameras:', 'line 1, version'),
    ('cameras:', 'frame: a b\ncameras:', 'line 1, frame'),
    ('mount: fixed', 'mount: fix', 'line 4, cameras[2].mount'),
    ('cameras:', 'room: {sha256: abc}\ncameras:', 'line 1, room.sha256'),
    ('cameras:', 'engine: {preset: fin}\ncameras:', 'line 1, engine.preset'),
    # Nothing to move, and two of one name.
    (HAND[9:HAND.index('  - {sensor: kin')], '', 'line 1, cameras'),
    ('pitch: 25', 'name: door', 'line 4, cameras[2].name'),
    # A rig that is bad, of more cameras, of others, without those in place, with their names.
    ('cameras:', 'rig:\n  cameras: [{sensor: kinect_v2, count: 2}]\n  seen_by: 9\ncameras:',
     'line 3, seen_by'),
    ('cameras:', 'rig: {cameras: [{sensor: kinect_v2, count: 3}]}\ncameras:', 'line 2, cameras'),
    ('cameras:', 'rig: {cameras: [{sensor: kinect_v2, count: 2}]}\ncameras:',
     'line 3, cameras[0]'),
    ('cameras:', f'rig: {{cameras: {TWO}}}\ncameras:', 'line 5, cameras[2]'),
    ('cameras:\n  - {sensor: realsense_d455',
     f'rig: {{cameras: {TWO}, fixed: [{{sensor: kinect_v2, position: [2, 2, 2.2], name: gate}}]}}'
     '\ncameras:\n  - {name: gate', 'line 3, cameras[0]'),
]


@pytest.mark.parametrize(('old', 'new', 'place'), BAD, ids=[place for *_, place in BAD])
def test_a_bad_placement_is_refused_in_one_sentence(tmp_path, old, new, place):
    assert old in HAND
    with refused_in_one_sentence(f'placement.yaml: {place}'):
        placement_in(tmp_path, HAND.replace(old, new, 1))


@pytest.mark.parametrize(('old', 'new', 'place'), [
    ('position: [3, 2, 2.0]', 'position: [3, 2, 5.9]', 'line 3, cameras[1].position'),
    ('position: [2, 2, 2.2]', 'position: [2, 99, 2.2]', 'line 4, cameras[2].position')])
def test_what_a_room_refuses_is_what_the_file_says(room, tmp_path, old, new, place):
    assert old in HAND
    text = HAND.replace(old, new).replace('[1, 1, 2.2]', '[1, 1, 6.9]')
    placement = placement_in(tmp_path, text)
    with refused_in_one_sentence(f'placement.yaml: {place}'):
        FeasibleRegion(room, placement.rig_in(room))


def frames_of(arguments):
    """Read the arguments of static_transform_publisher: frames, position and rotation."""
    parser = argparse.ArgumentParser()
    for name in ('frame-id', 'child-frame-id', 'x', 'y', 'z', 'roll', 'pitch', 'yaw'):
        parser.add_argument(f'--{name}')
    parent, child, *numbers = vars(parser.parse_args(arguments)).values()
    numbers = np.array(numbers, dtype=float)
    return parent, child, numbers[:3], Rotation.from_euler('xyz', numbers[3:])


def check_frames(frames, placement):
    """Assert that transforms put bodies and pictures where the cameras are."""
    assert [(parent, child) for parent, child, *_ in frames] == [
        pair for k in range(4)
        for pair in (('map', f'camera_{k}'), (f'camera_{k}', f'camera_{k}_optical'))]
    for placed, body, optical in zip(placement.cameras, frames[::2], frames[1::2]):
        ahead, left, up = rotation_matrix(*np.deg2rad(placed.angles)).T
        np.testing.assert_allclose(body[2], placed.position, atol=1e-8)
        np.testing.assert_allclose(body[3].as_matrix().T, [ahead, left, up], atol=1e-8)
        # The picture's x goes right, its y down, and its z looks ahead.
        picture = (body[3] * optical[3]).as_matrix()
        np.testing.assert_allclose(picture.T, [-left, -up, ahead], atol=1e-8)


def test_the_launch_file_publishes_the_cameras_frames(mixed, monkeypatch):
    # As much of ROS's launch system as the file needs.
    for name, contents in (('launch', {'LaunchDescription': list}),
                           ('launch_ros.actions', {'Node': dict})):
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(**contents))
    placement, content = placement_of(mixed, POSES), {}
    exec(launch_of(Exported(placement)), content)
    nodes = content['generate_launch_description']()
    assert {node['executable'] for node in nodes} == {'static_transform_publisher'}
    assert len({node['name'] for node in nodes}) == 8
    # Numbers that begin with a minus would be taken for options where they are no numbers.
    check_frames([frames_of(node['arguments']) for node in nodes], placement)


def test_the_xacro_file_has_the_same_frames(mixed):
    placement, frames = placement_of(mixed, POSES), []
    macro, = ElementTree.fromstring(xacro_of(Exported(placement)))
    assert macro.tag == '{http://www.ros.org/wiki/xacro}macro'
    assert macro.get('params') == 'parent gazebo:=false'
    for joint in macro.iter('joint'):
        parent, child = (joint.find(end).get('link') for end in ('parent', 'child'))
        xyz, rpy = (np.array(joint.find('origin').get(key).split(), dtype=float)
                    for key in ('xyz', 'rpy'))
        frames.append((parent.replace('${parent}', 'map'), child, xyz,
                       Rotation.from_euler('xyz', rpy)))
    check_frames(frames, placement)
    assert [link.get('name') for link in macro.iter('link')] == [child for _, child, *_ in frames]


def test_the_table_has_a_row_for_each_camera(mixed):
    rows = list(csv.DictReader(io.StringIO(csv_of(Exported(placement_of(mixed, POSES))))))
    assert [row['name'] for row in rows] == ['azure_kinect_nfov', 'wide_1', 'wide_2', 'x']
    assert [row['mount'] for row in rows] == ['free', 'free', 'free', 'fixed']
    assert float(rows[2]['yaw']) == pytest.approx(np.rad2deg(-1.5), abs=1e-3)
    # The nodes count from 0, and read clouds in these frames.
    assert [row['link'] for row in rows] == [f'camera_{k}' for k in range(4)]
    assert float(rows[1]['horizontal_fov']) == 91.3 and rows[1]['sensor'] == ''


def told(room, placed, floor):
    """Return what an installer is told of one camera."""
    references = WallReferences(room, np.array([placed.position]))
    return instructions_for(placed, references.distances[0], references.sides, floor, room.source)


def page_of(room, placement, **found):
    """Return the installer's page of a placement, and what is found in it."""
    engine = EngineConfig(preset='fast', error_rows=32)
    assessed = assess(room, replace(placement, engine=engine), {'sha256': ''}, 'ocp score x')
    assessed.found.update(found)
    return installer_page(assessed, 'plan.png'), assessed.found


def heading_of(wall):
    """Return where the outside of a wall looks, degrees from the x axis."""
    return np.rad2deg(np.arctan2(wall.outward[1], wall.outward[0]))


def test_the_rectangle_is_that_of_the_walls_however_the_room_stands():
    room = made_room(3, 8000)
    size = np.ptp(np.percentile(room.points[:, :2], [0.3, 99.7], axis=0), axis=0)
    walls = walls_around(turned(room, -40.0))
    assert [wall.letter for wall in walls] == ['A', 'B', 'C', 'D']
    assert [wall.length for wall in walls] == pytest.approx([*size, *size], abs=0.05)
    assert heading_of(walls[0]) == pytest.approx(50.0, abs=0.3)
    # It lies along the walls, and not along the edge of the scan.
    points = box_room(4.0, 4.0).points
    corner = Scene(points[points[:, :2].sum(axis=1) < 4.05], 'corner')
    assert heading_of(walls_around(turned(corner, 10.0))[0]) == pytest.approx(100.0, abs=0.2)


def test_neither_stray_points_nor_a_side_without_a_wall_move_the_others():
    points = box_room().points
    stray = np.array([[9.0, 7.0, 1.0]]) + np.random.default_rng(0).uniform(size=(20, 3))
    through_a_window = Scene(np.concatenate([points, stray]).astype('f4'), 'box')
    is_open = Scene(points[(points[:, 0] < 5.95) | (points[:, 2] < 0.05)], 'open')
    for room, standing in ((through_a_window, 'ABCD'), (is_open, 'ACD')):
        walls = walls_around(room)
        assert [wall.length for wall in walls] == pytest.approx([6, 4, 6, 4], abs=0.02)
        assert ''.join(wall.letter for wall in walls if wall.stands) == standing
    page, _ = page_of(is_open, placement_of(rig_of(1), np.array([[3.0, 2.0, 1.9]])))
    assert 'B 4.00 m (less than 30 % of it is wall)' in page
    # A camera that sees all around has no picture.
    assert 'long side' not in page


@pytest.mark.parametrize(('sensor', 'pose', 'words'), [
    ('d455', [5.8, 3.5, 2.0, 120, 25, 0], (
        '20 cm from wall B, 50 cm from wall A', '200 cm above the floor',
        'face wall A squarely, then turn 30 degrees to the left', '25 degrees down')),
    ('d455', [5.8, 3.5, 2.0, -20, -10, 5], (
        '20 cm from wall B, 50 cm from wall A', '200 cm above the floor',
        'face wall B squarely, then turn 20 degrees to the right',
        '10 degrees up, rolled 5 degrees clockwise seen from behind')),
    ('d455', [3.1, 1.0, 2.7, 90, 90, 0], (
        '100 cm from wall C, 290 cm from wall B', '270 cm above the floor',
        'top of the picture to wall A', '90 degrees down')),
    ('omni', [2.9, -0.2, 1.9, 90, 10, 0], (
        '20 cm beyond wall C, no other wall within 15 m: use x, y, z', '190 cm above the floor',
        'any heading', 'upright'))])
def test_an_installer_is_told_in_words(sensor, pose, words):
    pose = np.array([*pose[:3], *np.deg2rad(pose[3:])])
    placed, = placement_of(rig_of(1, sensor), pose[None]).cameras
    assert told(box_room(), placed, 0.0)[2:6] == words
    # A room that stands elsewhere and otherwise on the map is hung up alike.
    angle = np.deg2rad(20.0)
    moved = np.array([*rotation_matrix(angle) @ pose[:3] + [5, 7, 2], pose[3] + angle, *pose[4:]])
    placed, = placement_of(rig_of(1, sensor), moved[None]).cameras
    room = Scene(turned(box_room(), 20.0).points + np.array([5, 7, 2], dtype='f4'), 'moved')
    assert told(room, placed, 2.0)[2:6] == words


def with_panel(room, x, low, high):
    """Return a room with an upright panel across it."""
    points = [room.points, panel(x, (0.0, room.size[1]), (low, high))]
    return Scene(np.concatenate(points), 'panel')


#: A beam under the ceiling of a room, a fence in a hall, a post, and walls that are seen in part.
BEAM, FENCE = with_panel(box_room(), 5.0, 2.2, 3.0), with_panel(box_room(14.0, 12.0), 7.8, 0, 1.8)
POST = Scene(np.concatenate([box_room().points, panel(4.5, (1.47, 1.53), (0.0, 3.0))]), 'post')
LOW_WALLS = Scene(box_room().points[np.abs(box_room().points[:, 2] - 2.5) > 0.25], 'low walls')


@pytest.mark.parametrize(('room', 'place', 'words'), [
    # A wall of a niche is no side of the rectangle around the room.
    (l_shaped(), [2.9, 2.8, 1.9], '10 cm from wall E, 120 cm from wall A'),
    (box_room(34.0, 4.0), [17.0, 0.1, 1.9],
     '10 cm from wall C, no other wall within 15 m: use x, y, z'),
    # Distances are those that a level laser measures: it meets a beam at the camera's height.
    (BEAM, [4.0, 1.5, 1.5], '150 cm from wall C, 200 cm from wall B'),
    (BEAM, [4.0, 1.5, 2.6], '100 cm from wall E, 150 cm from wall C'),
    # A fence that ends far below the camera is no wall to measure from, and a post is too narrow.
    (FENCE, [7.0, 6.0, 2.5], '600 cm from wall A, 700 cm from wall B'),
    (POST, [4.0, 1.5, 1.5], '150 cm from wall C, 200 cm from wall B'),
    # Without a wall at the camera's height, one that a plumb line reaches has to do.
    (LOW_WALLS, [4.0, 1.5, 2.7], '150 cm from wall C, 200 cm from wall B')])
def test_cameras_are_measured_from_walls_that_are_near(room, place, words):
    placed, = placement_of(rig_of(1), np.array([place])).cameras
    assert told(room, placed, 0.0).place == words


def test_two_cameras_at_one_inner_wall_are_told_the_same_letter():
    references = WallReferences(l_shaped(), np.array([[2.9, 2.8, 1.9], [2.8, 2.6, 1.9]]))
    assert [[one.letter for one in distances] for distances in references.distances] == [
        ['E', 'A'], ['E', 'A']]
    wall, = references.inner
    assert wall.letter == 'E' and wall.position[0] == pytest.approx(3.0, abs=0.03)


def test_the_installers_page_has_what_was_found_and_where_cameras_hang_and_look(mixed):
    room = Scene(box_room().points + np.array([1.0, 1.0, -1.0], dtype='f4'), 'hall')
    poses = np.array([[1.5, 3.0, 0.5, 0.0, 0.0, 0.0], [1.5, 2.0, 0.5, 0.0, np.pi / 4.0, 0.0],
                      POSES[2]])
    page, found = page_of(room, placement_of(mixed, poses), search={
        'certificate': {'sentence': 'No placement is better.', 'gap': None}})
    expected = found['expected']
    for fact in (f'{100 * found["scores"]["seen"]:.1f} %', 'No placement is better.',
                 'ocp score x', f'{metres(expected["low"])} to {metres(expected["high"])}',
                 'long side of the camera level', '](plan.png)',
                 'A 6.00 m, B 4.00 m, C 6.00 m, D 4.00 m',
                 '| 4 | x (fixed) | realsense_d455 |', '320 cm above the floor',
                 '87 x 58 degrees', '150 cm above the floor, 0 cm from wall B, 200 cm',
                 'on the floor, 100 cm from wall C, 200 cm from wall D', '1.00, 1.00, -1.00'):
        assert fact in page, fact


def test_the_verdict_says_what_is_doubtful_and_space_is_that_of_the_room():
    room = l_shaped()
    _, found = page_of(room, placement_of(rig_of(1), np.array([[2.0, 1.0, 1.9]])))
    assert found['scores']['volume'] == pytest.approx((6.0 * 4.0 - 3.0 * 2.0) * 2.8, rel=0.08)
    assert facts_of(found).verdict == 'all constraints are satisfied'
    open_room = Scene(room.points[room.points[:, 2] < 2.7], 'open')
    _, found = page_of(open_room, placement_of(rig_of(1), np.array([[2.0, 1.0, 1.9]])))
    assert facts_of(found).verdict.endswith('found no ceiling')


def test_rviz_shows_the_frame_that_the_launch_file_publishes_in():
    poses = np.array([[1.0, 2.0, 2.0], [3.0, 4.0, 2.0]])
    placement = Exported(replace(placement_of(rig_of(2), poses), frame='hall'))
    manager = yaml.safe_load(rviz_of(placement))['Visualization Manager']
    assert manager['Global Options']['Fixed Frame'] == 'hall'
    assert "('hall', 'camera_0'" in launch_of(placement)
    assert 'rviz_default_plugins/TF' in {display['Class'] for display in manager['Displays']
                                         if display['Enabled']}
    assert manager['Views']['Current']['Focal Point'] == {'X': 2.0, 'Y': 3.0, 'Z': 2.0}


@pytest.mark.parametrize('text_of', [launch_of, xacro_of, csv_of])
def test_frames_of_two_rigs_are_told_apart(mixed, text_of):
    text = text_of(Exported(placement_of(mixed, POSES), 'a_'))
    assert 'a_camera_0' in text and not re.search(r'(?<!a_)camera_[0-9]', text)
    assert text_of is csv_of or 'a_camera_0_optical' in text
