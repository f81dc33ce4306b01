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

"""Files of rigs and of settings: read as written, or one sentence says what is wrong and where."""

from dataclasses import replace
import json
from pathlib import Path

from benchmarks.docs.schemas import FILES
from conftest import refused_in_one_sentence, ROOT
import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.rig.rig_file import Camera, load_rig, MUST_SEE_SHARE, rig_of, sensor_named
from ocp_ros.rig.sensors import PRICES, SENSORS
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.training.run_folder import read_config
from ocp_ros.training.training_config import TrainingConfig
from ocp_ros.util.settings import ConfigurationError, from_flat, from_nested, leaves, to_nested
import pytest
import yaml

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
    rig, d455 = rig_in(tmp_path, RIG), 'realsense_d455'
    wide = CameraModel(0.3, 5.0, np.deg2rad(90.0), np.deg2rad(60.0), (640, 480))
    assert rig.all_cameras[:3] == tuple(
        Camera(f'{d455}_{number}', d455, SENSORS[d455].model, price=PRICES[d455].amount)
        for number in (1, 2, 3))
    azure = 'azure_kinect_nfov'
    assert rig.all_cameras[3:] == (
        Camera('wide', '', wide),
        Camera('door', azure, SENSORS[azure].model, price=PRICES[azure].amount))
    np.testing.assert_allclose(rig.fixed_poses, [[1.0, 2.0, 2.2, np.pi / 2, np.pi / 9, 0.0]])
    assert rig.mount == ('walls', (1.8, 2.4), 0.0)
    assert rig.pitch + rig.rolls == pytest.approx((0.0, np.pi / 3, 0.0, np.pi / 2))
    assert (rig.keep_clear, rig.spacing, rig.seen_by) == (0.3, 0.5, 2)
    table, desk = rig.regions
    assert (table.name, table.weight, table.must_see) == ('table', 3.0, MUST_SEE_SHARE)
    assert (desk.name, desk.weight, desk.must_see) == ('desk', 1.0, 0.5)
    assert table.where == 'rig.yaml: line 15, regions[0]'


def test_a_plain_lens_is_a_pinhole(tmp_path):
    for more, most in (('max_range: 5', 5.0), ('sensor: kinect_v2', 4.5)):
        model = rig_in(tmp_path, 'cameras: [{focal_length: 4.0, sensor_size: [8.0, 6.0], '
                                 f'{more}}}]').models[0]
        # Half the edge over the focal length is the tangent of half the angle.
        half = [model.horizontal_fov / 2, model.vertical_fov / 2]
        assert np.tan(half) == pytest.approx([1.0, 0.75]) and model.max_range == most


def test_what_is_left_out_has_defaults(tmp_path):
    rig = rig_in(tmp_path, 'cameras: [{sensor: omnidirectional}]')
    assert rig.cameras == (Camera('omnidirectional', 'omnidirectional', CameraModel()),)
    assert len(rig.fixed_poses) == 0
    assert rig.mount == ('plane', (1.9, 1.9), 0.4)
    assert (rig.keep_clear, rig.spacing, rig.seen_by) == (0.2, 0.2, 1)
    assert rig.pitch == pytest.approx((0.0, np.pi / 2))
    # A rig may be JSON; a number beside a sensor takes the place of its own.
    rig = rig_in(tmp_path, json.dumps({
        'cameras': [{'sensor': 'kinect_v2', 'count': 2, 'max_range': 4}],
        'keep_clear': 1e-05, 'mount': {'on': 'ceiling'}}), 'rig.json')
    assert rig.models == 2 * (replace(SENSORS['kinect_v2'].model, max_range=4.0),)
    assert rig.keep_clear == 1e-05 and rig.mount == ('ceiling', None, 0.0)


def test_zones_are_boxes_and_polygons_between_heights_above_the_floor(tmp_path):
    box, polygon = rig_in(tmp_path, RIG).keep_out
    points = np.array([[0.5, 0.5, 0.1], [1.0, 1.0, 3.0], [1.9, 0.5, 2.0],
                       [1.9, 0.5, 0.4], [1.9, 0.97, 2.0], [1.1, 1.05, 1.0]])
    in_box, in_polygon = box.contains(points, 0.0), polygon.contains(points, 0.0)
    assert (in_box | in_polygon).tolist() == [True, True, True, False, False, False]
    # The floor is lower than the map frame: heights of polygons go with it, boxes stay.
    assert np.array_equal(polygon.contains(points - [0.0, 0.0, 7.0], -7.0), in_polygon)
    assert np.array_equal(box.contains(points, -7.0), in_box)


@pytest.mark.parametrize('corners', [
    [[0, 0], [2, 0], [2, 1]], [[0, 0], [4, 0], [4, 4], [2, 1], [0, 4]]])
def test_a_polygon_holds_as_many_places_as_its_area_says(tmp_path, corners):
    zone = rig_in(tmp_path, f'cameras: [{{sensor: kinect_v2}}]\nkeep_out: [{{polygon: {corners}}}]'
                  ).keep_out[0]
    points = np.random.default_rng(0).uniform(0.0, 4.0, (20000, 3))
    x, y = np.array(corners, dtype=float).T
    area = 0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))
    assert zone.contains(points, 0.0).mean() == pytest.approx(area / 16.0, abs=0.02)


#: What is changed in RIG, to what, where the error is said to be, and some rows: what is proposed.
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
    # Numbers that no camera has.
    ('horizontal_fov: 90', 'horizontal_fov: 1.0e-99', 'line 3, cameras[1].horizontal_fov'),
    ('vertical_fov: 60', 'vertical_fov: 0.001', 'line 3, cameras[1].vertical_fov'),
    ('max_range: 5.0', 'max_range: 1.0e-9', 'line 3, cameras[1].max_range'),
    ('max_range: 5.0', 'max_range: 1.0e+6', 'line 3, cameras[1].max_range'),
    ('min_range: 0.3', 'min_range: 1.0e+4', 'line 3, cameras[1].min_range'),
    ('[640, 480]', '[1000000000, 1]', 'line 4, cameras[1].resolution'),
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
    ('[1, 1, 3]]', '[1, 1, 3]], height: [0, 1]', 'line 12, keep_out[0].height'),
    ('box: [[0, 0, 0], [1, 1, 3]]', '', 'line 12, keep_out[0]'),
    ('[2, 1]], height', '[4, 0]], height', 'line 13, keep_out[1].polygon'),
    ('[2, 1]], height', '[0, 1], [2, 1.5]], height', 'line 13, keep_out[1].polygon'),
    ('height: [0.5, 3.0]', 'height: [3.0, 0.5]', 'line 13, keep_out[1].height'),
    ('weight: 3.0', 'weight: -3.0', 'line 15, regions[0].weight'),
    ('name: table, ', '', 'line 15, regions[0]'),
    ('must_see: true', 'must_see: yes', 'line 15, regions[0].must_see'),
    ('name: desk', 'name: table', 'line 16, regions[1].name'),
    # The text.
    ('seen_by: 2', 'seen_by: 6', 'line 17, seen_by'),
    ('seen_by: 2', 'pitch: 10', 'line 17'),
    ('seen_by: 2', 'seen_by: \0', 'line 17'),
    ('seen_by: 2', 'seen_by: !!python/name:os.system 2', 'line 17'),
    ('seen_by: 2', 'seen_by: !a%0Ab 2', 'line 17'),
    ('seen_by: 2', 'seen_by: [2', 'line 18'),
    ('seen_by: 2', 'seen_by: &a 2\nno:\n- 1\n- *a', 'line 20'),
    (RIG, '- 1\n- 2\n', 'line 1'), (RIG, '# nothing\n', 'line 1'),
    (RIG, '[' * 1000, 'line 1', 'lists in lists'),
    (RIG, f'cameras: [{"1, " * 20000}1]', 'line 1', 'more than'),
    # What was meant is named.
    ('cameras:', 'camera:', 'line 1, camera', "'cameras'"),
    ('realsense_d455', 'd455', 'line 2, cameras[0].sensor', "'realsense_d455'"),
    ('max_range', 'max_rang', 'line 3, cameras[1].max_rang', "'max_range'"),
    ('on: walls', 'on: wall', 'line 7, mount.on', "'walls'"),
    ('pitch: [0, 60]', 'pitch: [60, 0]', 'line 8, pitch', '[0, 60]'),
    # Keys and values that people write have their own remedy.
    ('spacing: 0.5', 'wall: D', 'line 10, wall', 'keep_in'),
    ('on: walls', 'on: walls, wall: 2', 'line 7, mount.wall', 'keep_in'),
    ('count: 3', 'count: 3, mount: {on: walls}', 'line 2, cameras[0].mount', 'beside cameras'),
    ('count: 3', 'count: auto', 'line 2, cameras[0].count', '--cameras auto'),
    ('horizontal_fov', 'hFOV', 'line 3, cameras[1].hFOV', "'horizontal_fov'"),
    ('vertical_fov', 'vfov', 'line 3, cameras[1].vfov', "'vertical_fov'"),
    ('horizontal_fov', 'fov', 'line 3, cameras[1].fov', "'vertical_fov'"),
    (RIG[:RIG.index('fixed')], '', 'line 1', 'ocp score'),
    (RIG[:RIG.index('fixed')], 'cameras: []\n', 'line 1', 'ocp score'),
    ('weight: 3.0', 'air: true', 'line 15, regions[0].air', 'air: {}'),
    ('weight: 3.0', 'air: free', 'line 15, regions[0].air', 'air: {}'),
    ('weight: 3.0', 'kind: air', 'line 15, regions[0].kind', 'air: {}'),
    ('spacing: 0.5', 'height: 2', 'line 10, height', 'mount: {'),
    ('spacing: 0.5', 'count: auto', 'line 10, count', "'cameras'"),
    ('on: walls', 'on: [walls, ceiling]', 'line 7, mount.on', 'on: free'),
    ('on: walls', 'on: walls, exclude: A', 'line 7, mount.exclude', 'keep_out'),
    ('count: 3', 'count: 1-5', 'line 2, cameras[0].count', '--cameras auto'),
    ('count: 3', 'keep_clear: 0.3', 'line 2, cameras[0].keep_clear', "beside 'cameras'"),
    ('count: 3', 'serial: 034422073314', 'line 2, cameras[0].serial', "serial: '034422073314'"),
    ('position:', 'xyz:', 'line 6, fixed[0].xyz', "'position: "),
    ('horizontal_fov', 'fovx', 'line 3, cameras[1].fovx', "'horizontal_fov'"),
    (RIG[:RIG.index('fixed')], 'cameras: {}\n', 'line 1', 'ocp score'),
    ('mount: {on: walls', 'mount: walls #', 'line 7, mount', 'mount: {on: walls}'),
]


@pytest.mark.parametrize('row', BAD, ids=[row[2] for row in BAD])
def test_a_bad_rig_file_is_refused_in_one_sentence(tmp_path, row):
    old, new, place, *remedy = row
    assert old in RIG
    with refused_in_one_sentence(f'rig.yaml: {place}', *remedy):
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


def test_part_of_a_name_is_enough():
    assert [sensor_named(name) for name in ('d455', 'VLP', 'omni', 'kinect_v2')] == [
        'realsense_d455', 'velodyne_vlp16', 'omnidirectional', 'kinect_v2']


@pytest.mark.parametrize(('name', 'words'), [
    ('kinect', 'azure_kinect_nfov and azure_kinect_wfov and kinect_v2'),
    ('d456', 'omnidirectional, '), ('realsense_d456', "'realsense_d455'"), ('', "''")])
def test_a_name_that_says_too_little_is_refused(name, words):
    with refused_in_one_sentence('', words):
        sensor_named(name)


@pytest.mark.parametrize('name', FILES)
def test_the_schemas_in_the_documentation_are_those_of_the_code(name):
    # Where they differ, python -m benchmarks.docs.schemas writes them.
    assert json.loads((ROOT / 'docs' / name).read_text()) == FILES[name]


@pytest.mark.parametrize('cls', [SimulationConfig, TrainingConfig])
def test_nested_form_comes_back_and_what_is_left_out_keeps_its_default(cls):
    assert from_nested(cls, to_nested(cls())) == cls() == from_nested(cls, {})
    # Whole numbers are accepted as floats.
    assert from_flat(SimulationConfig, {'rig.max_range': 5}).rig.max_range == 5.0


@pytest.mark.parametrize(('cls', 'values', 'words'), [
    (SimulationConfig, {'zzz': 2}, "'zzz'"),
    (SimulationConfig, {'rig': {'camera': 2}}, "'rig.camera'.*'rig.cameras'"),
    (SimulationConfig, {'rig': {'cameras': 0}}, 'rig.cameras: found 0.* 1 to 64'),
    (SimulationConfig, {'rig': {'cameras': '4'}}, "rig.cameras: found '4'.*int"),
    (SimulationConfig, {'rig': {'cameras': True}}, 'rig.cameras: found True'),
    (SimulationConfig, {'rig': {'height': float('nan')}}, 'rig.height: found nan'),
    (SimulationConfig, {'rig': {'min_range': 5.0}}, 'rig.min_range.*rig.max_range'),
    (SimulationConfig, {'reward': {'kind': 'papr'}}, "reward.kind: found 'papr'"),
    (TrainingConfig, {'fewest_cameras': 5}, 'fewest_cameras.*simulation.rig.cameras'),
    (TrainingConfig, {'agent': {'inputs': 'paper'}, 'fewest_cameras': 2}, 'agent.cameras')])
def test_a_bad_setting_is_named_with_what_was_expected(cls, values, words):
    with pytest.raises(ConfigurationError, match=words):
        from_nested(cls, values)


@pytest.mark.parametrize(('text', 'words'), [
    ('- 1\n- 2\n', 'c.yaml: found list'), ('a: [1, 2\nb: }', 'c.yaml: line 2')])
def test_a_file_without_a_mapping_is_refused_in_one_line(tmp_path, text, words):
    (tmp_path / 'c.yaml').write_text(text)
    with pytest.raises(ConfigurationError, match=words) as caught:
        read_config(tmp_path / 'c.yaml')
    assert '\n' not in str(caught.value)


def test_every_setting_has_a_default_in_its_own_range():
    for name, item in leaves(TrainingConfig).items():
        assert isinstance(item.default, item.type), name
        low = item.metadata['low']
        assert low is None or low <= item.default <= item.metadata['high'], name
        assert len(item.metadata['description']) > 5


@pytest.mark.parametrize('path', sorted((ROOT / 'config').glob('*/*.yaml')),
                         ids=lambda path: path.name)
def test_every_shipped_rig_and_training_configuration_is_valid(path):
    if path.parent.name == 'rig':
        assert len(load_rig(path).cameras) >= 4
    else:
        assert np.isfinite(read_config(path).sac.learning_rate)


@pytest.mark.parametrize('name', ['sim', 'policy', 'trainer', 'live'])
def test_every_shipped_parameter_file_is_valid(name):
    pytest.importorskip('rclpy', reason='node parameters need ROS 2 (rclpy)')
    from ocp_ros.ros.policy.policy_config import PolicyNodeConfig
    from ocp_ros.ros.sim_node import SimNodeConfig
    from ocp_ros.ros.trainer_node import TrainerNodeConfig
    # That of live cameras is read by a policy of any name.
    classes = {'sim_node': SimNodeConfig, 'policy_node': PolicyNodeConfig,
               'trainer_node': TrainerNodeConfig, '/**': PolicyNodeConfig}
    for key, value in yaml.safe_load((ROOT / 'config' / f'{name}.yaml').read_text()).items():
        from_nested(classes[key.removeprefix('/**/')], value['ros__parameters'], key)
