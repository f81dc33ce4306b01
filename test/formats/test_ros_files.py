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

"""The exported launch file starts the drivers that a rig names, and joins their frames."""

import re
import sys
from types import SimpleNamespace

from conftest import refused_in_one_sentence
import numpy as np
from ocp_ros.formats.exported import Exported, pose_matrix
from ocp_ros.formats.ros_files import launch_of
from ocp_ros.geometry.cameras import OPTICAL_TO_BODY
from ocp_ros.rig.placement_file import load_placement, placement_of, save_placement
from ocp_ros.rig.rig_file import rig_from, with_count
from ocp_ros.rig.schemas import RIG
from ocp_ros.util.yaml_files import document_of
import pytest
from scipy.spatial.transform import Rotation

POSES = np.array([[2.0, 2.0, 2.2, 0.3, 0.4, 0.1], [1.0, 3.0, 1.7, 3.5, 0.5, 0.0],
                  [1.0, 1.0, 1.8, 1.5, 0.2, 0.0], [3.0, 1.0, 1.9, 2.5, 0.3, 0.0],
                  [3.0, 2.0, 1.9, -2.5, 0.3, 0.0]])


def rig_with(cameras):
    """Return a rig with cameras as a rig file has them."""
    return rig_from(document_of('rig', {'cameras': cameras, 'mount': {'on': 'free'}}, RIG))


@pytest.fixture
def rig():
    """Return five cameras with four drivers."""
    return rig_with([
        {'sensor': 'realsense_d455', 'count': 2, 'serial': ['0344', '0345'],
         'driver': 'realsense2_camera', 'namespace': 'hall', 'host': 'pc1'},
        {'sensor': 'femto_bolt_wfov', 'driver': 'orbbec_camera', 'serial': 'AY1',
         'name': 'by the door'},
        {'horizontal_fov': 80, 'vertical_fov': 55, 'max_range': 8, 'name': '2nd oak',
         'driver': 'depthai_ros_driver', 'serial': '14442C'},
        {'sensor': 'azure_kinect_wfov', 'driver': 'azure_kinect', 'serial': '000123'}])


def launched(exported, monkeypatch):
    """Return the nodes that a launch file starts: their arguments."""
    for name, contents in (('launch', {'LaunchDescription': list}),
                           ('launch_ros.actions', {'Node': dict})):
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(**contents))
    content = {}
    exec(launch_of(exported), content)
    return content['generate_launch_description']()


def transforms_of(nodes):
    """Return the static transforms by child frame: parent and matrix (4, 4)."""
    found = {}
    for node in nodes:
        if node['executable'] == 'static_transform_publisher':
            parent, child, *numbers = node['arguments'][1::2]
            matrix = np.eye(4)
            matrix[:3, 3] = np.array(numbers[:3], dtype=float)
            matrix[:3, :3] = Rotation.from_euler('xyz', np.array(numbers[3:], dtype=float)
                                                 ).as_matrix()
            found[child] = parent, matrix
    return found


def in_map(found, frame):
    """Return the pose (4, 4) of a frame in the map."""
    matrix = np.eye(4)
    while frame != 'map':
        frame, step = found[frame]
        matrix = step @ matrix
    return matrix


def test_each_driver_gets_its_camera_and_its_depth_image_is_where_the_camera_looks(
        rig, monkeypatch):
    placement = placement_of(rig, POSES)
    nodes = launched(Exported(placement), monkeypatch)
    drivers = {node['name']: node for node in nodes if 'parameters' in node}
    policy, = drivers.pop('policy_node')['parameters']
    assert [(node['package'], node['namespace']) for node in drivers.values()] == [
        ('realsense2_camera', '/hall'), ('realsense2_camera', '/hall'),
        ('orbbec_camera', '/by_the_door'), ('depthai_ros_driver', ''),
        ('azure_kinect_ros_driver', '/azure_kinect_wfov')]
    parameters = [node['parameters'][0] for node in drivers.values()]
    assert [parameters[0]['serial_no'], parameters[2]['serial_number'],
            parameters[3]['camera.i_mx_id'], parameters[4]['sensor_sn']] == [
                '_0344', 'AY1', '14442C', '000123']
    # Otherwise the driver takes any device, and another field of view.
    assert [parameters[2][key] for key in ('device_num', 'depth_width', 'ir_height')] == [
        2, 512, 512]
    assert policy['cloud_topics'].split(',') == [
        '/hall/realsense_d455_1/depth/color/points', '/hall/realsense_d455_2/depth/color/points',
        '/by_the_door/depth/points', '/camera_3_2nd_oak/stereo/image_raw',
        '/azure_kinect_wfov/points2']
    assert policy['camera_frames'] == ','.join(f'camera_{k}' for k in range(5))
    # What the drivers publish between their first frame and that of the depth image.
    optical = np.eye(4)
    optical[:3, :3] = OPTICAL_TO_BODY
    kinect = np.eye(4)
    kinect[:3, :3] = (Rotation.from_euler('YXZ', [-90.0, 180.0, 90.0], degrees=True)
                      * Rotation.from_euler('x', -7.3, degrees=True)).as_matrix()
    kinect[2, 3] = 0.0018
    found = transforms_of(nodes)
    for placed, frame, inner in zip(placement.cameras, (
            'realsense_d455_1_link', 'realsense_d455_2_link', 'by_the_door_link',
            'camera_3_2nd_oak_rgb_camera_optical_frame', 'azure_kinect_wfov_camera_base'), (
                optical, optical, optical, np.eye(4), kinect), strict=True):
        np.testing.assert_allclose(in_map(found, frame) @ inner, pose_matrix(placed, 'optical'),
                                   atol=1e-6)


def test_nodes_have_names_that_ros_accepts_whatever_the_prefix(rig, monkeypatch):
    nodes = launched(Exported(placement_of(rig, POSES), 'hall/left_'), monkeypatch)
    names = [node['name'] for node in nodes]
    assert all(re.fullmatch('[A-Za-z_][A-Za-z0-9_]*', name) for name in names)
    assert len(set(names)) == len(names)


def test_the_parameters_of_policy_node_are_some_that_it_has(rig, monkeypatch):
    pytest.importorskip('rclpy', reason='node parameters need ROS 2 (rclpy)')
    from ocp_ros.ros.policy.policy_config import PolicyNodeConfig
    *_, node = launched(Exported(placement_of(rig, POSES)), monkeypatch)
    config = PolicyNodeConfig(**node['parameters'][0])
    assert len(config.live_topics) == 5


def test_without_drivers_for_all_cameras_no_policy_starts(monkeypatch):
    rig = rig_with([{'sensor': 'realsense_d455', 'driver': 'realsense2_camera', 'count': 2},
                    {'sensor': 'kinect_v2'}])
    with pytest.warns(UserWarning, match='found no serial number'):
        nodes = launched(Exported(placement_of(rig, POSES[:3])), monkeypatch)
    assert [node['package'] for node in nodes if 'parameters' in node] == ['realsense2_camera'] * 2


def test_devices_are_read_again_and_a_placement_may_change_them(rig, tmp_path):
    path = tmp_path / 'placement.yaml'
    save_placement(path, placement_of(rig, POSES))
    read = load_placement(path)
    assert [placed.camera for placed in read.cameras] == list(rig.all_cameras)
    path.write_text(path.read_text().replace('serial: "0344"', 'serial: "0999"', 1))
    assert load_placement(path).cameras[0].camera.device.serial == '0999'
    assert load_placement(path).cameras[0].camera.device.namespace == 'hall'


@pytest.mark.parametrize(('cameras', 'words'), [
    ([{'sensor': 'kinect_v2', 'count': 2, 'serial': 'a'}], 'rig: cameras[0].serial: found 1 for'),
    ([{'sensor': 'kinect_v2', 'count': 2, 'serial': ['a', 'a']}], 'rig: cameras[0].serial'),
    ([{'sensor': 'kinect_v2', 'serial': 34422073314}], 'rig: cameras[0].serial'),
    ([{'sensor': 'kinect_v2', 'driver': 'openni'}], 'rig: cameras[0].driver'),
    ([{'sensor': 'kinect_v2', 'namespace': '/hall'}], 'rig: cameras[0].namespace')])
def test_a_bad_device_is_refused_in_one_sentence(cameras, words):
    with refused_in_one_sentence(words):
        rig_with(cameras)


def test_another_number_of_cameras_has_no_serial_numbers():
    rig = rig_with([{'sensor': 'kinect_v2', 'count': 2, 'serial': ['a', 'b']}])
    assert [one.device.serial for one in with_count(rig, 2).cameras] == ['a', 'b']
    assert [one.device.serial for one in with_count(rig, 3).cameras] == ['', '', '']
