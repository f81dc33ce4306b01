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

"""``sim_node`` on real DDS."""

from copy import deepcopy

from conftest import counted, SMALL, warnings_of
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.rooms.generator import generate_room
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import (
    msg_to_cloud,
    msg_to_fields,
    msg_to_positions,
    positions_to_msg,
    stamp_to_ns,
)
from ocp_ros.ros.sim_node import SimNode
from ocp_ros.scenes.scene import SceneError
from ocp_ros.util.settings import ConfigurationError
import pytest
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64, Float64MultiArray
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker, MarkerArray


@pytest.fixture
def loop(graph, probe):
    """Return the probe, listening, and a function that starts a sim with a command publisher."""
    for kind, topic in ((PointCloud2, topics.OBSERVATION), (PoseArray, topics.CAMERA_POSES),
                        (Float64MultiArray, topics.REWARD), (Float64, topics.SPACE_COVERAGE),
                        (Float64, topics.DEPTH_ERROR)):
        probe.listen(kind, topic, qos.LOOP)

    def start(**parameters):
        sim = graph.add(SimNode, **{**SMALL, **parameters})
        probe.commands = probe.publisher(PoseArray, topics.CAMERA_COMMANDS, qos.LOOP)
        probe.last(topics.OBSERVATION)
        return sim

    probe.start = start
    return probe


def answer(loop, move=(0.3, 0.0)):
    """Command a move from the latest turn, wait until it has been played."""
    poses = loop.last(topics.CAMERA_POSES)
    target = msg_to_positions(poses)
    target[:, :2] += move
    loop.commands.publish(positions_to_msg(target, poses.header))
    loop.graph.until(
        lambda: loop.last(topics.CAMERA_POSES).header.stamp != poses.header.stamp)


def fields_of(loop):
    """Return the numbers of the latest reward."""
    return msg_to_fields(loop.last(topics.REWARD), topics.REWARD_FIELDS)


def test_poses_say_how_the_cameras_are_turned(loop, tmp_path):
    path = tmp_path / 'rig.yaml'
    path.write_text(f'cameras: [{{sensor: azure_kinect_wfov, count: 4}}]\n'
                    f'pitch: [{np.rad2deg(0.5)}, 60]')
    loop.start(rig_file=str(path))
    poses = loop.last(topics.CAMERA_POSES).poses
    assert len(poses) == 4
    for yaw, pose in zip(np.arange(4) * np.pi / 2, poses):
        q = pose.orientation
        np.testing.assert_allclose(
            Rotation.from_quat([q.x, q.y, q.z, q.w]).apply([1.0, 0.0, 0.0]),
            [np.cos(yaw) * np.cos(0.5), np.sin(yaw) * np.cos(0.5), -np.sin(0.5)], atol=1e-9)


def test_a_turn_is_published_with_one_stamp(loop):
    sim = loop.start()
    message = loop.last(topics.OBSERVATION)
    assert message.header.frame_id == 'map'
    assert [f.name for f in message.fields] == ['x', 'y', 'z']
    assert message.point_step == 12 and message.is_dense and not message.is_bigendian
    assert np.array_equal(msg_to_cloud(message), sim.episode.observed_cloud)
    assert 0 < message.width < len(sim.simulator.scene)
    previous = loop.last(topics.CAMERA_POSES).header.stamp
    answer(loop)
    stamp = loop.last(topics.CAMERA_POSES).header.stamp
    loop.graph.until(lambda: loop.last(topics.OBSERVATION).header.stamp == stamp)
    loop.graph.until(lambda: fields_of(loop)['step'] == 1)
    latest, turn = fields_of(loop), sim.episode.turn
    assert (latest['stamp_sec'], latest['stamp_nanosec']) == (stamp.sec, stamp.nanosec)
    assert (latest['previous_sec'], latest['previous_nanosec']) == (previous.sec, previous.nanosec)
    assert latest['episode'] == 1 and latest['reward'] == turn.terms.reward
    assert latest['depth_error'] == turn.depth_error
    # For plots.
    plots = topics.SPACE_COVERAGE, topics.DEPTH_ERROR
    while not all(loop.received[topic] for topic in plots):
        answer(loop)
    turn = sim.episode.turn
    loop.graph.until(lambda: [loop.last(topic).data for topic in plots] == [
        turn.space_coverage, turn.depth_error])


def test_a_turn_is_sent_again_until_a_command_can_be_used(loop):
    sim = loop.start(resend_period=0.05, episode__max_step=0.2)
    loop.graph.until(lambda: len(loop.received[topics.OBSERVATION]) >= 3)
    assert len({stamp_to_ns(m.header.stamp) for m in loop.received[topics.OBSERVATION]}) == 1
    old, warnings = loop.last(topics.CAMERA_POSES), warnings_of(sim)
    for count, (spoil, word) in enumerate((
            (lambda command: command.poses.pop(), 'cameras'),
            (lambda command: setattr(command.poses[1].position, 'x', np.nan), 'finite'),
            (lambda command: setattr(command.header, 'frame_id', 'elsewhere'), 'elsewhere')),
            start=1):
        command = deepcopy(old)
        spoil(command)
        loop.commands.publish(command)
        loop.graph.until(lambda: counted(sim, 'refused_commands') == count)
        assert 'command refused: ' in warnings[-1] and word in warnings[-1]
    # No camera moves farther than the longest step.
    for move, expected in (((0.1, -0.1), (0.1, -0.1)), ((3.0, 4.0), (0.12, 0.16))):
        before = sim.episode.turn.positions
        answer(loop, move)
        np.testing.assert_allclose(sim.episode.turn.positions - before, [[*expected, 0.0]] * 4,
                                   atol=1e-9)
    loop.commands.publish(old)
    loop.graph.until(lambda: counted(sim, 'stale_commands') == 1)
    assert sim.episode.turn.step == 2


def test_an_episode_ends_truncated_and_stays_there(loop):
    sim = loop.start(episode__turns=2, resend_period=0.05)
    answer(loop)
    answer(loop)
    assert sim.episode.turn.truncated
    loop.graph.until(lambda: fields_of(loop)['truncated'] == 1.0)
    assert fields_of(loop)['terminated'] == 0.0
    # Sent again until somebody knows that it is the last; an answer to it moves nothing.
    resent = counted(sim, 'resent_turns')
    loop.graph.until(lambda: counted(sim, 'resent_turns') > resent)
    poses = loop.last(topics.CAMERA_POSES)
    loop.commands.publish(positions_to_msg(msg_to_positions(poses) + 0.1, poses.header))
    loop.graph.until(lambda: sim._turn_answered)
    assert sim.episode.turn.step == 2


def test_the_next_episode_begins_by_itself_where_wanted_and_when_asked_for(loop):
    sim = loop.start(episode__turns=1, auto_reset=True)
    first = sim.episode
    answer(loop)
    loop.graph.until(lambda: sim.episode is not first)
    second = sim.episode
    assert second.turn.step == 0
    done = loop.call(Trigger, '/sim_node/reset')
    assert done.success and done.message == 'episode 3'
    assert sim.episode is not second
    loop.graph.until(lambda: fields_of(loop)['episode'] == 3.0)


def test_who_comes_late_gets_the_scene_and_the_markers(graph, probe):
    graph.add(SimNode, **SMALL)
    probe.listen(PointCloud2, topics.SCENE, qos.LATCHED)
    probe.listen(MarkerArray, topics.MARKERS, qos.LATCHED)
    assert np.array_equal(msg_to_cloud(probe.last(topics.SCENE)), generate_room(1, 2000).points)
    markers = probe.last(topics.MARKERS).markers
    ranges = [m for m in markers if m.ns == 'ranges']
    assert len(markers) == 12 and len(ranges) == 4
    assert all(m.type == Marker.SPHERE and m.scale.x == 8.0 for m in ranges)


@pytest.mark.parametrize(('parameters', 'error', 'words'), [
    ({'rig__camera': 3}, ConfigurationError, "'rig.camera'; did you mean 'rig.cameras'"),
    ({'rig__cameras': 0}, InvalidParameterValueException, 'rig.cameras'),
    ({'rig__max_range': 4}, InvalidParameterTypeException, 'rig.max_range'),
    ({'rig__height': 5.0, **SMALL}, SceneError, 'rig.height'),
    ({'rig__max_range': 0.2, **SMALL}, SceneError, 'no point within 0.2 m')])
def test_parameters_that_cannot_be_are_refused_by_name(graph, parameters, error, words):
    with pytest.raises(error, match=words):
        graph.add(SimNode, **parameters)
