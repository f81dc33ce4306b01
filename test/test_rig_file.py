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
    rig = rig_in(tmp_path, 'cameras: [{sensor: kinect_v2, focal_length: 4.0, '
                           'sensor_size: [8.0, 6.0]}]')
    assert rig.models[0].max_range == 4.5 and rig.models[0].horizontal_fov == pytest.approx(
        np.pi / 2)


@pytest.mark.parametrize(('keys', 'place'), [
    ('focal_length: 4.0', 'focal_length'), ('sensor_size: [8, 6]', 'sensor_size'),
    ('focal_length: 4.0, sensor_size: [8, 6], vertical_fov: 60', 'vertical_fov'),
    ('focal_length: 4.0, sensor_size: [8, 0]', 'sensor_size')])
def test_half_a_lens_is_refused(tmp_path, keys, place):
    with refused_in_one_sentence(f'rig.yaml: line 1, cameras[0].{place}'):
        rig_in(tmp_path, f'cameras: [{{{keys}, max_range: 5}}]')


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


BAD = {
    'an unknown key': ('spacing: 0.5', 'spacings: 0.5', 'line 10, spacings'),
    'an empty list of cameras': (RIG[:RIG.index('fixed')], 'cameras: []\n', 'line 1, cameras'),
    'an unknown sensor': ('realsense_d455', 'realsense_d456', 'line 2, cameras[0].sensor'),
    'a count of none': ('count: 3', 'count: 0', 'line 2, cameras[0].count'),
    'a count of halves': ('count: 3', 'count: 2.5', 'line 2, cameras[0].count'),
    'too many': ('count: 3', 'count: 63', 'line 1, cameras'),
    'a unit': ('max_range: 5.0', 'max_range: 5 m', 'line 3, cameras[1].max_range'),
    'an angle of view of nothing': (
        'vertical_fov: 60', 'vertical_fov: 0', 'line 3, cameras[1].vertical_fov'),
    'an angle of view of too much': (
        'vertical_fov: 60', 'vertical_fov: 181', 'line 3, cameras[1].vertical_fov'),
    'no angle of view': ('vertical_fov: 60, ', '', 'line 3, cameras[1]'),
    'ranges that exclude each other': (
        'min_range: 0.3', 'min_range: 5.0', 'line 3, cameras[1].min_range'),
    'one number of pixels': ('[640, 480]', '640', 'line 4, cameras[1].resolution'),
    'no position': ('position: [1.0, 2.0, 2.2], ', '', 'line 6, fixed[0]'),
    'a flat position': ('[1.0, 2.0, 2.2]', '[1.0, 2.0]', 'line 6, fixed[0].position'),
    'radians for degrees, as it were': ('pitch: 20', 'pitch: 200', 'line 6, fixed[0].pitch'),
    'a name twice': ('name: door', 'name: wide', 'line 6, fixed[0].name'),
    'a name that breaks a table': ('name: door', 'name: "a;b"', 'line 6, fixed[0].name'),
    'an unknown mount': ('on: walls', 'on: wall', 'line 7, mount.on'),
    'a mount without what it is on': ('on: walls, ', '', 'line 7, mount'),
    'a range of heights for a plane': ('on: walls', 'on: plane', 'line 7, mount.height'),
    'a range the wrong way round': ('pitch: [0, 60]', 'pitch: [60, 0]', 'line 8, pitch'),
    'a pitch beyond straight down': ('pitch: [0, 60]', 'pitch: 91', 'line 8, pitch'),
    'nan': ('spacing: 0.5', 'spacing: .nan', 'line 10, spacing'),
    'nothing': ('spacing: 0.5', 'spacing:', 'line 10, spacing'),
    'infinity': ('spacing: 0.5', 'spacing: 1e99', 'line 10, spacing'),
    'a negative weight': ('weight: 3.0', 'weight: -3.0', 'line 15, regions[0].weight'),
    'a region without a name': ('name: table, ', '', 'line 15, regions[0]'),
    'a box inside out': (
        '[[0, 0, 0], [1, 1, 3]]', '[[0, 0, 5], [1, 1, 3]]', 'line 12, keep_out[0].box'),
    'a box with a height': (
        '[1, 1, 3]]', '[1, 1, 3]], height: [0, 1]', 'line 12, keep_out[0].height'),
    'a zone of nothing': ('box: [[0, 0, 0], [1, 1, 3]]', '', 'line 12, keep_out[0]'),
    'a polygon on a line': ('[2, 1]], height', '[4, 0]], height', 'line 13, keep_out[1].polygon'),
    'heights the wrong way round': (
        'height: [0.5, 3.0]', 'height: [3.0, 0.5]', 'line 13, keep_out[1].height'),
    'a name that ends with a line': ('name: wide', 'name: "wide\\n"', 'line 4, cameras[1].name'),
    'a box without an inside': ('[1, 1, 3]', '[1, 0, 3]', 'line 12, keep_out[0].box'),
    'a polygon that crosses itself': (
        '[[0, 0], [2, 0], [2, 1]], height', '[[0, 0], [2, 0], [0, 1], [2, 1.5]], height',
        'line 13, keep_out[1].polygon'),
    'a sensor as a camera': (
        '{sensor: realsense_d455, count: 3}', 'realsense_d455', 'line 2, cameras[0]'),
    'a number as a region': (
        '{name: desk, polygon: [[0, 0], [2, 0], [2, 1]], must_see: 0.5}', '3',
        'line 16, regions[1]'),
    'more groups than are read': (
        '  - {sensor: realsense_d455, count: 3}', '  - {sensor: kinect_v2}\n' * 65,
        'line 1, cameras'),
    'a key of two lines': ('spacing: 0.5', '"spa\\ncing": 0.5', "line 10, 'spa\\ncing': found"),
    'a key that does not end': ('spacing: 0.5', f'{"x" * 999}: 0.5', "line 10, 'xxx"),
    'a tag of two lines': ('seen_by: 2', 'seen_by: !a%0Ab 2', 'line 17'),
    'an alias in a list': ('seen_by: 2', 'seen_by: &a 2\nno:\n- 1\n- *a', 'line 20'),
    'more than one can read': (RIG, f'cameras: [{"1, " * 30000}1]', 'line 1'),
    'a region twice': ('name: desk', 'name: table', 'line 16, regions[1].name'),
    'a must that is a word': ('must_see: true', 'must_see: yes', 'line 15, regions[0].must_see'),
    'more cameras than there are': ('seen_by: 2', 'seen_by: 6', 'line 17, seen_by'),
    'a key twice': ('seen_by: 2', 'pitch: 10', 'line 17'),
    'an open bracket': ('seen_by: 2', 'seen_by: [2', 'line 18'),
    'a zero byte': ('seen_by: 2', 'seen_by: \0', 'line 17'),
    'a tab': ('seen_by: 2', '\tseen_by: 2', 'line 17'),
    'an alias': ('seen_by: 2', 'seen_by: &a 2\nkeep: *a', 'line 18'),
    'a tag': ('seen_by: 2', 'seen_by: !!python/name:os.system 2', 'line 17'),
    'a list': (RIG, '- 1\n- 2\n', 'line 1'),
    'an empty file': (RIG, '# nothing\n', 'line 1'),
    'lists without end': (RIG, '[' * 5000, 'line 1'),
}


@pytest.mark.parametrize(('old', 'new', 'place'), BAD.values(), ids=BAD)
def test_a_bad_rig_file_is_refused_in_one_sentence(tmp_path, old, new, place):
    assert old in RIG
    with refused_in_one_sentence(f'rig.yaml: {place}'):
        rig_in(tmp_path, RIG.replace(old, new))


@pytest.mark.parametrize(('old', 'new', 'remedy'), [
    ('spacing: 0.5', 'spacings: 0.5', "'spacing'"), ('max_range', 'max_rang', "'max_range'"),
    ('cameras:', 'camera:', "'cameras'"), ('realsense_d455', 'd455', "'realsense_d455'"),
    ('on: walls', 'on: wall', "'walls'"), ('pitch: [0, 60]', 'pitch: [60, 0]', '[0, 60]')])
def test_what_was_meant_is_named(tmp_path, old, new, remedy):
    with refused_in_one_sentence('rig.yaml: line', remedy):
        rig_in(tmp_path, RIG.replace(old, new))


@pytest.mark.parametrize(('content', 'place'), [
    (None, ''), (b'cameras:\n- \xff\xfe', 'line 2'), (b'#' * 5_000_000, '')])
def test_a_file_that_is_no_text_is_refused(tmp_path, content, place):
    path = tmp_path / 'rig.yaml'
    path.mkdir() if content is None else path.write_bytes(content)
    with refused_in_one_sentence('', f'rig.yaml: {place}'):
        load_rig(path)
    with refused_in_one_sentence('', 'none.yaml: '):
        load_rig(tmp_path / 'none.yaml')


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
    ('d456', 'omnidirectional, '), ('realsense_d456', "'realsense_d455'"), ('', 'expected one')])
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
