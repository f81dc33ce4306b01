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

"""Frames of the cameras on /tf, for RViz, drivers and whoever looks them up."""

from benchmarks.drills.live_rig import BODY, episode_in, Rig
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.geometry.cameras import OPTICAL_TO_BODY, Pose, rotation_matrix
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import rotation_of
from ocp_ros.ros.interface.frames import transform
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.ros.sim_node import SimNode
import pytest
from rclpy.time import Time
from std_msgs.msg import Header

REASON = 'ROS without tf2_msgs'


@pytest.fixture
def tf(probe):
    """Return a probe that listens to frames."""
    message = pytest.importorskip('tf2_msgs.msg', reason=REASON).TFMessage
    probe.listen(message, '/tf', qos.LOOP)
    probe.listen(message, '/tf_static', qos.LATCHED)
    probe.kind = message
    return probe


def frames(message):
    """Return where each child is: (parent, position, rotation)."""
    return {one.child_frame_id: (
        one.header.frame_id, np.array([getattr(one.transform.translation, axis)
                                       for axis in 'xyz']),
        rotation_of(one.transform.rotation, 'a frame')) for one in message.transforms}


def test_a_frame_is_where_its_camera_is():
    pose = Pose(np.array([1.0, -2.0, 0.5]), rotation_matrix(0.7, -0.3, 0.2) @ OPTICAL_TO_BODY)
    made = transform(Header(frame_id='/map'), 'camera_3', pose)
    assert (made.header.frame_id, made.child_frame_id) == ('map', 'camera_3')
    np.testing.assert_allclose(rotation_of(made.transform.rotation, ''), pose.rotation, atol=1e-9)
    assert made.transform.translation.y == -2.0


def test_a_simulation_publishes_the_frames_of_its_cameras(tf, graph):
    sim = graph.add(SimNode, scene__points=2000, engine__preset='fast', rig__cameras=2,
                    resend_period=0.05)
    found, fixed = frames(tf.last('/tf')), frames(tf.last('/tf_static'))
    assert set(found) == {'camera_0', 'camera_1'}
    for camera, row in enumerate(sim.episode.placement):
        parent, position, rotation = found[f'camera_{camera}']
        assert parent == 'map'
        np.testing.assert_allclose(position, row[:3], atol=1e-9)
        np.testing.assert_allclose(rotation, Pose.of(row).rotation, atol=1e-9)
        np.testing.assert_array_equal(fixed[f'camera_{camera}_link'][2], np.eye(3))
        np.testing.assert_allclose(fixed[f'camera_{camera}_optical'][2], OPTICAL_TO_BODY,
                                   atol=1e-12)
    # Between turns time goes on, and a stamp comes once.
    graph.until(lambda: len(tf.received['/tf']) > 3)
    stamps = [Time.from_msg(one.transforms[0].header.stamp).nanoseconds
              for one in tf.received['/tf']]
    assert (np.diff(stamps) > 0).all()


def test_who_wants_none_gets_none(tf, graph):
    graph.add(SimNode, scene__points=2000, engine__preset='fast', publish_tf=False)
    graph.until(lambda: tf.node.get_publishers_info_by_topic('/markers'))
    assert not tf.node.get_publishers_info_by_topic('/tf')


@pytest.mark.parametrize('known', [False, True])
def test_live_cameras_have_frames_unless_somebody_else_publishes_them(tf, graph, room, known):
    if known:
        tf2_ros = pytest.importorskip('tf2_ros', reason='ROS without tf2')
        tf2_ros.StaticTransformBroadcaster(tf.node).sendTransform(
            transform(Header(frame_id='map'), 'camera_1', Pose(np.zeros(3), np.eye(3))))
        tf.last('/tf_static')
    tf.listen(PoseArray, topics.CAMERA_COMMANDS, qos.LOOP)
    policy = graph.add(PolicyNode, planner='lookahead', cloud_topics='points_0,points_1,points_2')
    if known:
        listener = policy._live._transforms
        graph.until(lambda: listener.knows('camera_1', 'map'))
    rig = graph.add(lambda **kwargs: Rig(episode_in(room), (BODY,) * 3, **{
        **kwargs, 'parameter_overrides': []}))
    tf.received['/tf'].clear()
    start = rig.positions.copy()
    tf.last(topics.CAMERA_COMMANDS)
    own = [0, 2] if known else [0, 1, 2]
    found = frames(tf.last('/tf'))
    assert sorted(found) == [f'camera_{camera}' for camera in own]
    # They follow the poses, not the turns.
    graph.until(lambda: not np.allclose(rig.positions, start, atol=0.01) and all(
        np.allclose(frames(tf.received['/tf'][-1])[f'camera_{k}'][1], rig.positions[k], atol=1e-6)
        for k in own))
