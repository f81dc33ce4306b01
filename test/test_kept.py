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

"""Files of ``policy_node``: its final placement, and the placement as built by a scan."""

from benchmarks.calibration_bench import cast
from conftest import counted, status
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.cli import main as cli
from ocp_ros.geometry.cameras import CameraModel, OPTICAL_TO_BODY, Pose
from ocp_ros.rig.placement_file import load_placement
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.rooms.generator import generate_room, mesh_of, plan_of
from ocp_ros.ros.bags.recorded_clouds import topics_of_cameras
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import cloud_to_msg, ns_to_stamp, positions_to_msg
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.scenes.mesh_rays import MeshRays
from ocp_ros.scenes.scene_files import save_scene
from ocp_ros.util.settings import ConfigurationError
import pytest
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import Trigger

POSITIONS = np.array([[4.0, 4.0, 1.9], [5.0, 4.0, 1.9], [4.0, 5.0, 1.9]])
HEADINGS = np.deg2rad([[30.0, 10.0, 0.0], [-100.0, 20.0, 90.0], [40.0, 0.0, 0.0]])
RIG = """
cameras: [{sensor: realsense_d455}, {sensor: omnidirectional}]
fixed: [{sensor: realsense_d455, position: [4.0, 5.0, 1.9], yaw: 40}]
"""


@pytest.fixture
def played(probe, room, tmp_path):
    """Return what plays the only turn of an episode, and asks once more: it is over."""
    def play(name, **parameters):
        probe.listen(PoseArray, topics.PLACEMENT, qos.LATCHED)
        probe.start_policy(turns=1, placement_file=str(tmp_path / name), **parameters)
        for stamp in (1, 2):
            probe.send_turn(stamp, room.points, positions_to_msg(POSITIONS, Header(), HEADINGS))
            probe.command(stamp)
        return probe.last(topics.PLACEMENT)
    return play


@pytest.mark.parametrize('name', ['new/placement.yaml', 'placement.json'])
def test_the_final_placement_is_a_file_that_can_be_judged(played, room, tmp_path, name):
    played(name, max_range=3.0)
    placement = load_placement(tmp_path / name)
    np.testing.assert_allclose(placement.poses[:, :3], POSITIONS)
    assert {placed.camera.model for placed in placement.cameras} == {CameraModel(max_range=3.0)}
    assert 'turns' in placement.created['final']
    save_scene(room, tmp_path / 'room.ply')
    assert cli.main(['score', str(tmp_path / 'room.ply'), str(tmp_path / name)]) == 0


def test_the_final_placement_has_the_rig_and_how_its_cameras_are_turned(played, tmp_path):
    (tmp_path / 'rig.yaml').write_text(RIG)
    played('placement.yaml', rig_file=str(tmp_path / 'rig.yaml'))
    placement = load_placement(tmp_path / 'placement.yaml')
    assert [placed.mount for placed in placement.cameras] == ['plane', 'plane', 'fixed']
    np.testing.assert_allclose(placement.poses[0], [*POSITIONS[0], *HEADINGS[0]], atol=1e-4)
    assert placement.cameras[0].camera.model == SENSORS['realsense_d455'].model
    assert placement.rig.fixed_poses.shape == (1, 6)


def test_a_placement_that_cannot_be_written_is_published_all_the_same(played, tmp_path, capfd):
    (tmp_path / 'file').write_text('')
    assert len(played('file/placement.yaml').poses) == 3
    assert 'file/placement.yaml' in capfd.readouterr().err


SEED = 501
TRUE = np.array([0.4, 0.5, 2.2, 0.7, 0.4, 0.0])
#: Metres that the camera is said to be away from where it is.
AWAY = np.array([0.06, -0.03, 0.02])


class OffCamera(Node):
    """A camera that stays, and of which others say that it hangs elsewhere."""

    def __init__(self, **kwargs):
        super().__init__('camera', **kwargs)
        points = cast(MeshRays(mesh_of(plan_of(SEED))), Pose.of(TRUE), 'realsense_d455',
                      np.random.default_rng(0))[::4]
        self.points, self.stamp = points @ OPTICAL_TO_BODY, 1_000_000_000_000
        self.poses = self.create_publisher(PoseArray, topics.CAMERA_POSES, qos.LOOP)
        self.clouds = self.create_publisher(PointCloud2, 'points_0', qos.SENSOR)
        self.create_timer(0.05, self.send)

    def send(self):
        """Send where it is said to be, and what it sees."""
        self.stamp += 50_000_000
        header = Header(stamp=ns_to_stamp(self.stamp), frame_id='map')
        self.poses.publish(positions_to_msg((TRUE[:3] + AWAY)[None], header, TRUE[None, 3:]))
        header = Header(stamp=ns_to_stamp(self.stamp), frame_id='camera_0_optical')
        self.clouds.publish(cloud_to_msg(self.points, header))


@pytest.fixture
def scanned(graph, tmp_path):
    """Return what starts a camera and a node that has the scan."""
    save_scene(generate_room(SEED, 60_000), tmp_path / 'room.ply')

    def start(**parameters):
        graph.add(lambda **kwargs: OffCamera(**{**kwargs, 'parameter_overrides': []}))
        return graph.add(PolicyNode, **{
            'planner': 'lookahead', 'cloud_topics': 'points_0', 'turns': 1, 'max_range': 6.0,
            'arrival_timeout': 0.1, 'scan': str(tmp_path / 'room.ply'),
            'placement_file': str(tmp_path / 'placement.yaml'), **parameters})
    return start


def calibrated(probe, holds):
    """Call the service, which may be too early, until its answer is as expected; return it."""
    answers = []

    def answered():
        answers.append(probe.call(Trigger, '/policy_node/calibrate'))
        return holds(answers[-1])

    probe.graph.until(answered)
    return answers[-1]


def test_the_service_says_where_a_camera_hangs_while_turns_go_on(graph, scanned, probe, tmp_path):
    node = scanned()
    answer = calibrated(probe, lambda answer: answer.success)
    line, wrote = answer.message.splitlines()
    assert abs(float(line.split()[1]) - np.linalg.norm(AWAY)) < 0.005
    built = load_placement(tmp_path / 'placement_as_built.yaml')
    assert str(tmp_path / 'placement_as_built.yaml') in wrote
    assert np.linalg.norm(np.array(built.cameras[0].position) - TRUE[:3]) < 0.01
    before = counted(node, 'turns_answered')
    graph.until(lambda: counted(node, 'turns_answered') > before)


def test_a_camera_that_drifts_is_a_warning(graph, scanned):
    node = scanned(drift_seconds=0.5)
    graph.until(lambda: counted(node, 'drift_checks'))
    level, message, _ = status(node)
    assert level == DiagnosticStatus.WARN and 'camera_0 hangs 0.0' in message


@pytest.mark.parametrize('live', [{'cloud_topics': 'a'}, {}])
def test_a_scan_that_is_not_there_or_not_for_live_cameras_is_refused(graph, live):
    with pytest.raises(ConfigurationError, match='scan: .*' + ('' if live else 'cloud_topics')):
        graph.add(PolicyNode, planner='lookahead', scan='none.ply', **live)


def test_a_broken_scan_ends_nothing(scanned, probe, tmp_path):
    scanned()
    (tmp_path / 'room.ply').write_text('no scan')
    assert not calibrated(probe, lambda answer: 'room.ply' in answer.message).success


@pytest.mark.parametrize(('topics_there', 'found'), [
    (['/door/points', '/shelf/points'], {'door': '/door/points', 'shelf': '/shelf/points'}),
    (['/b', '/a'], {'door': '/b', 'shelf': '/a'}), (['/a/door', '/x'], {'door': '/a/door'})])
def test_topics_are_those_of_cameras_by_name_or_in_order(topics_there, found):
    assert topics_of_cameras('a.bag', ['door', 'shelf'], topics_there) == found
    with pytest.raises(ConfigurationError, match='3 topics .* 2 cameras'):
        topics_of_cameras('a.bag', ['door', 'shelf'], ['/a', '/b', '/c'])
