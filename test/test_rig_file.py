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

"""Rig files: read as written, or one sentence says what is wrong, where, and what to do."""

from dataclasses import replace
import json
from pathlib import Path

from benchmarks.docs.schemas import FILES
from conftest import refused_in_one_sentence, ROOT
import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.rig.rig_file import load_rig, MUST_SEE_SHARE, rig_of, sensor_named
from ocp_ros.rig.sensors import SENSORS
import pytest

RIG = """\
cameras:
  - {sensor: realsense_d455, count: 3}
  - {horizontal_fov: 90, vertical_fov: 60, min_range: 0.3, max_range: 5.0,
     resolution: [640, 480], name: wide}
fixed:
  - {sensor: azure_kinect_nfov, position: [1.0, 2.0, 2.2], yaw: 90, pitch: 20, name: door}
mount: {on: walls, height: [1.8, 2.4]}
pitch: [0, 60]
keep_clear: 0.3
spacing: 0.5
keep_out:
  - {box: [[0, 0, 0], [1, 1, 3]]}
  - {polygon: [[0, 0], [2, 0], [2, 1]], height: [0.5, 3.0]}
regions:
  - {name: table, box: [[1, 1, 0.5], [2, 2, 1.2]], weight: 3.0, must_see: true}
  - {name: desk, polygon: [[0, 0], [2, 0], [2, 1]], must_see: 0.5}
seen_by: 2
roll: [0, 90]
"""


def rig_in(tmp_path, text, name='rig.yaml'):
    """Read a rig from a text."""
    (tmp_path / name).write_text(text)
    return load_rig(tmp_path / name)


def test_every_key_arrives_in_metres_and_radians(tmp_path):
    rig = rig_in(tmp_path, RIG)
    assert [camera.name for camera in rig.cameras] == [
        'realsense_d455_1', 'realsense_d455_2', 'realsense_d455_3', 'wide']
    assert [camera.sensor for camera in rig.all_cameras] == [
        *['realsense_d455'] * 3, '', 'azure_kinect_nfov']
    assert rig.models[0] == SENSORS['realsense_d455'].model
    assert rig.models[3] == CameraModel(0.3, 5.0, np.deg2rad(90.0), np.deg2rad(60.0), (640, 480))
    assert rig.models[4] == SENSORS['azure_kinect_nfov'].model
    assert rig.all_cameras[4].name == 'door'
    np.testing.assert_allclose(rig.fixed_poses, [[1.0, 2.0, 2.2, np.pi / 2, np.pi / 9, 0.0]])
    assert rig.mount == ('walls', (1.8, 2.4), 0.0)
    assert rig.pitch == pytest.approx((0.0, np.pi / 3))
    assert rig.rolls == pytest.approx((0.0, np.pi / 2))
    assert (rig.keep_clear, rig.spacing, rig.seen_by) == (0.3, 0.5, 2)
    table, desk = rig.regions
    assert (table.name, table.weight, table.must_see) == ('table', 3.0, MUST_SEE_SHARE)
    assert (desk.name, desk.weight, desk.must_see) == ('desk', 1.0, 0.5)
    assert table.where == 'rig.yaml: line 15, regions[0]'


def test_a_plain_lens_is_a_pinhole(tmp_path):
    model = rig_in(tmp_path, 'cameras: [{focal_length: 4.0, sensor_size: [8.0, 6.0], '
                             'max_range: 5}]').models[0]
    # Half the edge over the focal length is the tangent of half the angle.
    assert np.tan([model.horizontal_fov / 2, model.vertical_fov / 2]) == pytest.approx([1.0, 0.75])
    model = rig_in(tmp_path, 'cameras: [{sensor: kinect_v2, focal_length: 4.0, '
                             'sensor_size: [8.0, 6.0]}]').models[0]
    assert model.max_range == 4.5 and model.horizontal_fov == pytest.approx(np.pi / 2)


def test_what_is_left_out_has_defaults(tmp_path):
    rig = rig_in(tmp_path, 'cameras: [{sensor: omnidirectional}]')
    assert [camera.name for camera in rig.cameras] == ['omnidirectional']
    assert rig.models == (CameraModel(),) and len(rig.fixed_poses) == 0
    assert rig.mount == ('plane', (1.9, 1.9), 0.0) and rig.seen_by == 1
    assert (rig.keep_clear, rig.spacing) == (0.2, 0.2)
    assert rig.pitch == pytest.approx((0.0, np.pi / 2))
    assert rig_in(tmp_path, 'cameras: [{sensor: kinect_v2}]\nmount: {on: ceiling}').mount == (
        'ceiling', None, 0.0)


def test_numbers_beside_a_sensor_take_the_place_of_its_own(tmp_path):
    rig = rig_in(tmp_path, 'cameras: [{sensor: realsense_d455, max_range: 4}]')
    assert rig.models == (replace(SENSORS['realsense_d455'].model, max_range=4.0),)


def test_a_rig_may_be_json(tmp_path):
    text = json.dumps({'cameras': [{'sensor': 'kinect_v2', 'count': 2}], 'keep_clear': 1e-05})
    rig = rig_in(tmp_path, text, 'rig.json')
    assert len(rig.cameras) == 2 and rig.keep_clear == 1e-05


@pytest.mark.parametrize(('point', 'inside'), [
    ((0.5, 0.5, 0.1), True), ((1.0, 1.0, 3.0), True), ((1.9, 0.5, 2.0), True),
    ((1.9, 0.5, 0.4), False), ((1.9, 0.97, 2.0), False), ((1.1, 1.05, 1.0), False)])
def test_zones_are_boxes_and_polygons_between_heights_above_the_floor(tmp_path, point, inside):
    box, polygon = rig_in(tmp_path, RIG).keep_out
    points = np.array([point])
    assert (box.contains(points, 0.0) | polygon.contains(points, 0.0))[0] == inside
    # The floor is lower than the map frame: heights of polygons go with it, boxes stay.
    lowered = points - [0.0, 0.0, 7.0]
    assert polygon.contains(lowered, -7.0)[0] == polygon.contains(points, 0.0)[0]
    assert box.contains(points, -7.0)[0] == box.contains(points, 0.0)[0]


@pytest.mark.parametrize('corners', [
    [[0, 0], [2, 0], [2, 1]], [[0, 0], [4, 0], [4, 4], [2, 1], [0, 4]]])
def test_a_polygon_holds_as_many_places_as_its_area_says(tmp_path, corners):
    zone = rig_in(tmp_path, f'cameras: [{{sensor: kinect_v2}}]\nkeep_out: [{{polygon: {corners}}}]'
                  ).keep_out[0]
    points = np.random.default_rng(0).uniform(0.0, 4.0, (20000, 3))
    x, y = np.array(corners, dtype=float).T
    area = 0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))
    assert zone.contains(points, 0.0).mean() == pytest.approx(area / 16.0, abs=0.02)


#: What is changed in RIG, to what, and where the error is said to be.
BAD = [
    ('spacing: 0.5', 'spacing: .nan', 'line 10, spacing'),
    ('spacing: 0.5', 'spacing:', 'line 10, spacing'),
    ('spacing: 0.5', 'spacing: 1e99', 'line 10, spacing'),
    ('spacing: 0.5', '"spa\\ncing": 0.5', "line 10, 'spa\\ncing': found"),
    ('spacing: 0.5', f'{"x" * 999}: 0.5', "line 10, 'xxx"),
    # Cameras.
    (RIG[:RIG.index('fixed')], 'cameras: []\n', 'line 1, cameras'),
    ('{sensor: realsense_d455, count: 3}', 'realsense_d455', 'line 2, cameras[0]'),
    ('count: 3', 'count: 0', 'line 2, cameras[0].count'),
    ('count: 3', 'count: 2.5', 'line 2, cameras[0].count'),
    ('count: 3', 'count: 63', 'line 1, cameras'),
    ('  - {sensor: realsense_d455, count: 3}', '  - {sensor: kinect_v2}\n' * 65,
     'line 1, cameras'),
    ('max_range: 5.0', 'max_range: 5 m', 'line 3, cameras[1].max_range'),
    ('vertical_fov: 60', 'vertical_fov: 0', 'line 3, cameras[1].vertical_fov'),
    ('vertical_fov: 60', 'vertical_fov: 181', 'line 3, cameras[1].vertical_fov'),
    ('vertical_fov: 60, ', '', 'line 3, cameras[1]'),
    # Half a lens, a lens and its angle, a flat sensor.
    ('vertical_fov: 60', 'focal_length: 4', 'line 3, cameras[1].focal_length'),
    ('vertical_fov: 60', 'sensor_size: [8, 6]', 'line 3, cameras[1].sensor_size'),
    ('horizontal_fov: 90', 'focal_length: 4, sensor_size: [8, 6]',
     'line 3, cameras[1].vertical_fov'),
    ('horizontal_fov: 90, vertical_fov: 60', 'focal_length: 4, sensor_size: [8, 0]',
     'line 3, cameras[1].sensor_size'),
    ('min_range: 0.3', 'min_range: 5.0', 'line 3, cameras[1].min_range'),
    ('[640, 480]', '640', 'line 4, cameras[1].resolution'),
    ('name: wide', 'name: "wide\\n"', 'line 4, cameras[1].name'),
    # Cameras in place.
    ('position: [1.0, 2.0, 2.2], ', '', 'line 6, fixed[0]'),
    ('[1.0, 2.0, 2.2]', '[1.0, 2.0]', 'line 6, fixed[0].position'),
    ('pitch: 20', 'pitch: 200', 'line 6, fixed[0].pitch'),
    ('name: door', 'name: wide', 'line 6, fixed[0].name'),
    # Mount and pitch.
    ('on: walls, ', '', 'line 7, mount'),
    ('on: walls', 'on: plane', 'line 7, mount.height'),
    ('pitch: [0, 60]', 'pitch: 91', 'line 8, pitch'),
    # Zones and regions.
    ('[[0, 0, 0], [1, 1, 3]]', '[[0, 0, 5], [1, 1, 3]]', 'line 12, keep_out[0].box'),
    ('[1, 1, 3]', '[1, 0, 3]', 'line 12, keep_out[0].box'),
    ('[1, 1, 3]]', '[1, 1, 3]], height: [0, 1]', 'line 12, keep_out[0].height'),
    ('box: [[0, 0, 0], [1, 1, 3]]', '', 'line 12, keep_out[0]'),
    ('[2, 1]], height', '[4, 0]], height', 'line 13, keep_out[1].polygon'),
    ('[2, 1]], height', '[0, 1], [2, 1.5]], height', 'line 13, keep_out[1].polygon'),
    ('height: [0.5, 3.0]', 'height: [3.0, 0.5]', 'line 13, keep_out[1].height'),
    ('weight: 3.0', 'weight: -3.0', 'line 15, regions[0].weight'),
    ('name: table, ', '', 'line 15, regions[0]'),
    ('must_see: true', 'must_see: yes', 'line 15, regions[0].must_see'),
    ('name: desk', 'name: table', 'line 16, regions[1].name'),
    ('{name: desk, polygon: [[0, 0], [2, 0], [2, 1]], must_see: 0.5}', '3',
     'line 16, regions[1]'),
    # The text.
    ('seen_by: 2', 'seen_by: 6', 'line 17, seen_by'),
    ('seen_by: 2', 'pitch: 10', 'line 17'),
    ('seen_by: 2', 'seen_by: \0', 'line 17'),
    ('seen_by: 2', '\tseen_by: 2', 'line 17'),
    ('seen_by: 2', 'seen_by: !!python/name:os.system 2', 'line 17'),
    ('seen_by: 2', 'seen_by: !a%0Ab 2', 'line 17'),
    ('seen_by: 2', 'seen_by: [2', 'line 18'),
    ('seen_by: 2', 'seen_by: &a 2\nno:\n- 1\n- *a', 'line 20'),
    (RIG, '- 1\n- 2\n', 'line 1'), (RIG, '# nothing\n', 'line 1'), (RIG, '[' * 5000, 'line 1'),
    (RIG, f'cameras: [{"1, " * 20000}1]', 'line 1'),
]


@pytest.mark.parametrize(('old', 'new', 'place'), BAD, ids=[place for *_, place in BAD])
def test_a_bad_rig_file_is_refused_in_one_sentence(tmp_path, old, new, place):
    assert old in RIG
    with refused_in_one_sentence(f'rig.yaml: {place}'):
        rig_in(tmp_path, RIG.replace(old, new))


@pytest.mark.parametrize(('old', 'new', 'place', 'remedy'), [
    ('cameras:', 'camera:', 'line 1, camera', "'cameras'"),
    ('realsense_d455', 'd455', 'line 2, cameras[0].sensor', "'realsense_d455'"),
    ('max_range', 'max_rang', 'line 3, cameras[1].max_rang', "'max_range'"),
    ('on: walls', 'on: wall', 'line 7, mount.on', "'walls'"),
    ('pitch: [0, 60]', 'pitch: [60, 0]', 'line 8, pitch', '[0, 60]'),
    ('spacing: 0.5', 'spacings: 0.5', 'line 10, spacings', "'spacing'")])
def test_what_was_meant_is_named(tmp_path, old, new, place, remedy):
    with refused_in_one_sentence(f'rig.yaml: {place}', remedy):
        rig_in(tmp_path, RIG.replace(old, new))


@pytest.mark.parametrize(('write', 'place'), [
    (Path.mkdir, ''), (lambda path: path.write_bytes(b'cameras:\n- \xff\xfe'), 'line 2'),
    (lambda path: path.write_bytes(b'#' * 1_000_001), ''), (lambda path: None, '')],
    ids=['a folder', 'bytes', 'a long file', 'nothing'])
def test_a_file_that_is_no_text_is_refused(tmp_path, write, place):
    path = tmp_path / 'rig.yaml'
    write(path)
    with refused_in_one_sentence('', f'rig.yaml: {place}'):
        load_rig(path)


def test_a_rig_needs_no_file():
    rig = rig_of(4, 'd455', mount={'on': 'ceiling'}, spacing=0.5)
    assert rig.models == (SENSORS['realsense_d455'].model,) * 4
    assert rig.mount.on == 'ceiling' and rig.spacing == 0.5
    with refused_in_one_sentence('rig: cameras[0].count'):
        rig_of(0)


@pytest.mark.parametrize(('name', 'found'), [
    ('d455', 'realsense_d455'), ('VLP', 'velodyne_vlp16'), ('omni', 'omnidirectional'),
    ('kinect_v2', 'kinect_v2')])
def test_part_of_a_name_is_enough(name, found):
    assert sensor_named(name) == found


@pytest.mark.parametrize(('name', 'words'), [
    ('kinect', 'azure_kinect_nfov and azure_kinect_wfov and kinect_v2'),
    ('d456', 'omnidirectional, '), ('realsense_d456', "'realsense_d455'"), ('', "''")])
def test_a_name_that_says_too_little_is_refused(name, words):
    with refused_in_one_sentence('', words):
        sensor_named(name)


@pytest.mark.parametrize('path', sorted((ROOT / 'config' / 'rig').glob('*.yaml')),
                         ids=lambda path: path.name)
def test_every_shipped_rig_is_valid(path):
    assert len(load_rig(path).cameras) >= 4


@pytest.mark.parametrize('name', FILES)
def test_the_schemas_in_the_documentation_are_those_of_the_code(name):
    # Where they differ, python -m benchmarks.docs.schemas writes them.
    assert json.loads((ROOT / 'docs' / name).read_text()) == FILES[name]
