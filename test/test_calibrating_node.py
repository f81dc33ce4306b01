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

"""``policy_node`` with a scan: where live cameras hang, on real DDS, and bags of what they see."""

from benchmarks.calibration_bench import cast
from conftest import counted, status
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.geometry.cameras import OPTICAL_TO_BODY, Pose
from ocp_ros.rig.placement_file import load_placement
from ocp_ros.rooms.generator import generate_room, mesh_of, plan_of
from ocp_ros.ros.bags.recorded_clouds import topics_of_cameras
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import cloud_to_msg, ns_to_stamp, positions_to_msg
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.ros.runtime import diagnostics
from ocp_ros.scenes.mesh_rays import MeshRays
from ocp_ros.scenes.scene_files import save_scene
from ocp_ros.util.settings import ConfigurationError
import pytest
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import Trigger

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
def policy(graph, tmp_path):
    """Return what starts a camera and a node that has the scan."""
    save_scene(generate_room(SEED, 60_000), tmp_path / 'room.ply')

    def start(**parameters):
        graph.add(lambda **kwargs: OffCamera(**{**kwargs, 'parameter_overrides': []}))
        return graph.add(PolicyNode, **{
            'planner': 'lookahead', 'cloud_topics': 'points_0', 'turns': 1, 'max_range': 6.0,
            'arrival_timeout': 0.1, 'scan': str(tmp_path / 'room.ply'),
            'placement_file': str(tmp_path / 'placement.yaml'), **parameters})
    return start


def test_the_service_says_where_a_camera_hangs_while_turns_go_on(graph, policy, probe, tmp_path):
    node = policy()
    # Called before anything has been seen, it ends nothing.
    probe.call(Trigger, '/policy_node/calibrate')
    graph.until(lambda: node._live._rig is not None and node._live._newest)
    answer = probe.call(Trigger, '/policy_node/calibrate')
    assert answer.success, answer.message
    line, wrote = answer.message.splitlines()
    assert abs(float(line.split()[1]) - np.linalg.norm(AWAY)) < 0.005
    built = load_placement(tmp_path / 'placement_as_built.yaml')
    assert str(tmp_path / 'placement_as_built.yaml') in wrote
    assert np.linalg.norm(np.array(built.cameras[0].position) - TRUE[:3]) < 0.01
    before = counted(node, 'turns_answered')
    graph.until(lambda: counted(node, 'turns_answered') > before)


def test_a_camera_that_drifts_is_a_warning(graph, policy):
    node = policy(drift_seconds=0.5)
    graph.until(lambda: counted(node, 'drift_checks'))
    level, message, _ = status(node)
    assert level == diagnostics.WARN and 'camera_0 hangs 0.0' in message


@pytest.mark.parametrize('live', [{'cloud_topics': 'a'}, {}])
def test_a_scan_that_is_not_there_or_not_for_live_cameras_is_refused(graph, live):
    with pytest.raises(ConfigurationError, match='scan: .*' + ('' if live else 'cloud_topics')):
        graph.add(PolicyNode, planner='lookahead', scan='none.ply', **live)


def test_a_broken_scan_ends_nothing(graph, policy, probe, tmp_path):
    node = policy()
    (tmp_path / 'room.ply').write_text('no scan')
    graph.until(lambda: node._live._rig is not None and node._live._newest)
    answer = probe.call(Trigger, '/policy_node/calibrate')
    assert not answer.success and 'room.ply' in answer.message


@pytest.mark.parametrize(('topics_there', 'found'), [
    (['/door/points', '/shelf/points'], {'door': '/door/points', 'shelf': '/shelf/points'}),
    (['/b', '/a'], {'door': '/b', 'shelf': '/a'}), (['/a/door', '/x'], {'door': '/a/door'})])
def test_topics_are_those_of_cameras_by_name_or_in_order(topics_there, found):
    assert topics_of_cameras('a.bag', ['door', 'shelf'], topics_there) == found


def test_topics_that_may_be_anybodys_are_refused():
    with pytest.raises(ConfigurationError, match='3 topics .* 2 cameras'):
        topics_of_cameras('a.bag', ['door', 'shelf'], ['/a', '/b', '/c'])
