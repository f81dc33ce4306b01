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

"""Nodes turn cameras that look one way: commands, the loop with a simulation, live rigs, words."""

from copy import deepcopy

from benchmarks.drills.live_rig import BODY, OPTICAL, Rig
from conftest import box_room, counted, header_at, HUNG, SMALL
from geometry_msgs.msg import PoseArray, Quaternion
import numpy as np
from ocp_ros.geometry.cameras import (
    angle_between,
    heading_of,
    OPTICAL_TO_BODY,
    Pose,
    rotation_matrix,
)
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.packed_bits import Subset
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import (
    cloud_to_msg,
    move_poses,
    msg_to_cloud,
    msg_to_poses,
    msg_to_positions,
    positions_to_msg,
    stamp_to_ns,
)
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.ros.sim_node import SimNode
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import PlaneProblem
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.simulation.simulator import Simulator
import pytest
from scipy.spatial import cKDTree
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header, String

pytestmark = pytest.mark.usefixtures('quick_lookahead')
RIG = """
cameras: [{sensor: realsense_d455, count: 4}]
mount: {on: plane, height: 1.9}
keep_clear: 0.1
pitch: [10, 60]
"""
MIXED = """
cameras: [{sensor: realsense_d455}, {sensor: omnidirectional}]
fixed: [{sensor: realsense_d455, position: [1.0, 1.0, 1.9], yaw: 40}]
"""
LIMITS = np.deg2rad([10.0, 60.0])
HEADINGS = np.array([[0.4, 0.1, 0.0], [-2.0, 0.2, 0.1], [3.0, 1.2, -0.3]])
PLACES = np.array([[2.0, 2.0, 1.9], [3.0, 2.0, 1.9], [1.0, 1.0, 1.9]])


@pytest.fixture
def rig_file(tmp_path):
    """Return what writes a rig file and returns its path."""
    def write(text=RIG):
        (tmp_path / 'rig.yaml').write_text(text)
        return str(tmp_path / 'rig.yaml')
    return write


@pytest.fixture
def poses():
    """Return where three cameras are and how they are turned."""
    return positions_to_msg(PLACES, Header(), HEADINGS)


@pytest.fixture
def robot(probe):
    """Return the probe as a rig that sends turns and hears commands."""
    probe.send = lambda stamp, poses: probe.send_turn(stamp, box_room().points, poses)
    return probe


def test_a_command_turns_the_body_of_a_camera_and_its_optical_frame_with_it(poses):
    """Forward is x of the body and z of the optical frame, up is z and -y."""
    found = move_poses(poses, np.ones((3, 3)), {1: np.array([np.pi / 2, 0.3, 0.0])})
    for camera in (0, 2):
        assert found.poses[camera].orientation == poses.poses[camera].orientation
    body = msg_to_poses(found)[1].rotation
    optical = body @ OPTICAL_TO_BODY
    # To +y and down.
    np.testing.assert_allclose(body[:, 0], [0.0, np.cos(0.3), -np.sin(0.3)], atol=1e-9)
    np.testing.assert_allclose(body[:, 1], [-1.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(optical[:, 1:].T, [-body[:, 2], body[:, 0]], atol=1e-9)
    np.testing.assert_array_equal(msg_to_positions(found), np.ones((3, 3)))


def test_cameras_without_a_rig_file_stay_turned_as_they_are(robot, poses):
    robot.start_policy()
    robot.send(1, poses)
    assert [pose.orientation for pose in robot.command(1).poses] == [
        pose.orientation for pose in poses.poses]


def test_only_cameras_that_look_one_way_and_may_be_moved_are_turned(robot, rig_file, poses):
    robot.start_policy(rig_file=rig_file(MIXED), turns=2)
    for stamp in (1, 2, 3, 4):
        robot.send(stamp, poses)
        found = robot.command(stamp)
        # Once the placement is final, nobody is turned any more.
        if stamp != 2:
            assert (found.poses[0].orientation == poses.poses[0].orientation) == (stamp > 2)
        for camera in (1, 2):
            assert found.poses[camera].orientation == poses.poses[camera].orientation
        poses = found


def test_what_cameras_in_place_see_is_shown_although_nobody_sends_their_poses(
        graph, probe, robot, rig_file):
    probe.listen(PointCloud2, topics.COVERAGE_CLOUD, qos.LATCHED)
    policy = robot.start_policy(rig_file=rig_file(MIXED))
    seen = []
    for stamp, places in enumerate((PLACES[:2], PLACES), start=1):
        headings = HEADINGS[:len(places)].copy()
        if len(places) == 3:
            headings[2] = np.deg2rad([40.0, 0.0, 0.0])
        robot.send(stamp, positions_to_msg(places, Header(), headings))
        robot.graph.until(lambda at=stamp: [
            cloud for cloud in probe.received[topics.COVERAGE_CLOUD]
            if stamp_to_ns(cloud.header.stamp) == at])
        seen.append(bytes(probe.received[topics.COVERAGE_CLOUD][-1].data))
    assert seen[0] == seen[1] and counted(policy, 'turns_answered') == 2


def test_poses_without_a_direction_and_aiming_that_fails_turn_nobody_and_stop_nothing(
        robot, rig_file, poses, monkeypatch, capfd):
    policy = robot.start_policy(rig_file=rig_file(MIXED))
    # An omnidirectional camera needs no orientation.
    poses.poses[1].orientation = Quaternion(x=0.0, y=0.0, z=0.0, w=0.0)
    robot.send(1, poses)
    robot.command(1)
    for stamp, w in ((2, 0.0), (3, float('nan'))):
        spoilt = deepcopy(poses)
        spoilt.poses[0].orientation = Quaternion(x=0.0, y=0.0, z=0.0, w=w)
        robot.send(stamp, spoilt)
        robot.graph.until(lambda: counted(policy, 'refused_messages') == stamp - 1)
    assert 'camera 0' in capfd.readouterr().err

    def fail(*turn):
        raise ZeroDivisionError('by 0')

    with monkeypatch.context() as patched:
        patched.setattr(policy.decider.step, 'aim', fail)
        robot.send(4, poses)
        assert robot.command(4).poses[0].orientation == poses.poses[0].orientation
    assert 'by 0' in capfd.readouterr().err
    robot.send(5, poses)
    assert robot.command(5).poses[0].orientation != poses.poses[0].orientation


class TurnedRig(Rig):
    """A live rig of two cameras that also turn as they are commanded, at once."""

    def __init__(self, episode, **kwargs):
        super().__init__(episode, (BODY, OPTICAL), **{**kwargs, 'parameter_overrides': []})
        self.headings, self.trail = episode.turn.headings, []

    def go(self):
        """Carry out the latest command."""
        commanded = msg_to_poses(self.commands[-1])
        self.headings = np.array([heading_of(pose.rotation) for pose in commanded])
        self.trail.append(self.headings)
        self.episode.move((self.target - self.positions)[:, :2], self.headings)
        self.send()


def test_who_moves_cameras_by_hand_is_told_how_to_turn_them(graph, probe, rig_file):
    """The first pose of each camera is known, so the turn in the words leads to the command."""
    probe.listen(PoseArray, topics.CAMERA_COMMANDS, qos.LOOP)
    probe.listen(String, topics.INSTRUCTIONS, qos.LATCHED)
    graph.add(PolicyNode, cloud_topics='points', manual=True, max_turn=0.7,
              rig_file=rig_file('cameras: [{sensor: realsense_d455}]'))
    poses = probe.publisher(PoseArray, topics.CAMERA_POSES, qos.LOOP)
    clouds = probe.publisher(PointCloud2, 'points', qos.LOOP)
    header, now = header_at(5), np.array([1.0, 0.5, 0.0])
    points = box_room().points
    # All that is known is in front of the camera, so there is much to look around for.
    body = (points - PLACES[0]) @ Pose.of(np.append(PLACES[0], now)).rotation
    poses.publish(positions_to_msg(PLACES[:1], header, now[None]))
    clouds.publish(cloud_to_msg(points[body[:, 0] > 0.3], header))
    command, text = probe.last(topics.CAMERA_COMMANDS), probe.last(topics.INSTRUCTIONS).data
    yaw, pitch, _ = np.rad2deg(heading_of(msg_to_poses(command)[0].rotation) - now)
    assert np.hypot(yaw, pitch) > 10.0
    side = 'left' if yaw > 0 else 'right'
    assert f'{abs(yaw):.0f} degrees to the {side}' in text or abs(yaw) < 0.5
    assert f'{abs(pitch):.0f} degrees {"down" if pitch > 0 else "up"}' in text or abs(pitch) < 0.5


def test_live_cameras_are_turned_and_waited_for(graph, probe, rig_file, room):
    config = SimulationConfig(RigConfig(cameras=2), EngineConfig('fast', 32, 0.5),
                              EpisodeConfig(turns=1000))
    # Cameras that go wherever they are sent.
    simulator = Simulator(room, config, [SENSORS['realsense_d455'].model] * 2)
    episode = Episode(PlaneProblem(simulator), np.random.default_rng(0))
    # Both look the same way.
    first = episode.move(np.zeros((2, 2)), np.tile([0.5, 0.3, 0.0], (2, 1)))
    probe.listen(PoseArray, topics.PLACEMENT, qos.LATCHED)
    probe.listen(PointCloud2, topics.OBSERVATION, qos.LOOP)
    rig = graph.add(lambda **kwargs: TurnedRig(episode, **kwargs))
    policy = graph.add(
        PolicyNode, cloud_topics='points_0,points_1', turns=12, planner='lookahead',
        arrival_timeout=HUNG, cloud_timeout=HUNG,
        rig_file=rig_file(RIG.replace('count: 4', 'count: 2')))
    found = msg_to_poses(probe.last(topics.PLACEMENT))
    assert counted(policy, 'late_turns') == 0 and counted(policy, 'refused_messages') == 0
    assert episode.turn.depth_error < 0.97 * first.depth_error
    # A last command of a degree counts as carried out before the rig has heard of it.
    final = [heading_of(pose.rotation) for pose in found]
    graph.until(lambda: np.allclose(final, episode.turn.headings, rtol=1e-7, atol=1e-9))
    np.testing.assert_allclose(final, episode.turn.headings, atol=1e-9)
    assert np.abs(episode.turn.headings - first.headings).max() > 0.5
    # What was fused is where it is, whatever frame it came in and however that was turned.
    away, _ = cKDTree(room.points).query(msg_to_cloud(probe.last(topics.OBSERVATION)))
    assert away.max() < 1e-4
    # Once the placement is final, no camera is turned any more.
    turned = len(rig.trail)
    graph.until(lambda: len(rig.trail) >= turned + 2)
    np.testing.assert_allclose(rig.trail[-1], rig.trail[turned], atol=1e-9)


@pytest.mark.system
@pytest.mark.parametrize('max_turn', [0.0, 0.4])
def test_a_simulated_rig_ends_better_where_it_turns_and_stays_within_the_limits(
        graph, probe, rig_file, max_turn):
    for topic in (topics.CAMERA_COMMANDS, topics.CAMERA_POSES):
        probe.listen(PoseArray, topic, qos.LOOP)
    probe.listen(PoseArray, topics.PLACEMENT, qos.LATCHED)
    path = rig_file()
    sim = graph.add(SimNode, seed=3, scene__seed=8, episode__turns=10, episode__max_step=0.5,
                    resend_period=0.2, rig_file=path, **SMALL)
    first = sim.episode.turn
    graph.add(PolicyNode, turns=10, rig_file=path, max_turn=max_turn, max_step=0.5)
    placement = msg_to_poses(probe.last(topics.PLACEMENT))

    def farthest_from(headings):
        return max(angle_between(pose.rotation, rotation_matrix(*heading))
                   for pose, heading in zip(placement, headings, strict=True))

    # The placement has the directions that the simulation judged.
    assert farthest_from(sim.episode.turn.headings) < 1e-6
    poses = {stamp_to_ns(message.header.stamp): message
             for message in probe.received[topics.CAMERA_POSES]}
    steps = [(poses[stamp_to_ns(command.header.stamp)], command)
             for command in probe.received[topics.CAMERA_COMMANDS]
             if stamp_to_ns(command.header.stamp) in poses]
    assert len(steps) >= 8
    for step in steps:
        for now, goal in zip(*map(msg_to_poses, step), strict=True):
            assert np.linalg.norm(goal.position - now.position) <= 0.5 + 1e-6
            assert angle_between(now.rotation, goal.rotation) <= max_turn + 1e-6
            pitch = heading_of(goal.rotation)[1]
            assert LIMITS[0] - 1e-6 <= pitch <= LIMITS[1] + 1e-6
    turned = farthest_from(first.headings)
    assert turned > 0.4 if max_turn else turned < 1e-6
    # With the directions of the beginning, the placement is worse.
    still = sim.simulator.evaluate(np.hstack([sim.episode.turn.positions, first.headings]))
    assert not max_turn or sim.episode.turn.depth_error < 0.98 * still.depth_error


def test_a_simulation_turns_cameras_as_commanded_and_shows_what_they_then_see(
        graph, probe, rig_file, capfd):
    probe.listen(PoseArray, topics.CAMERA_POSES, qos.LOOP)
    node = graph.add(SimNode, rig_file=rig_file(MIXED.split('fixed')[0]), **SMALL)
    commands = probe.publisher(PoseArray, topics.CAMERA_COMMANDS, qos.LOOP)

    def play(message):
        message.header = probe.last(topics.CAMERA_POSES).header
        commands.publish(message)
        graph.until(lambda: probe.last(topics.CAMERA_POSES).header != message.header)
        return node.episode.turn

    before, poses = node.episode.turn, deepcopy(probe.last(topics.CAMERA_POSES))
    # A command without a direction is refused.
    for refused, (y, w) in enumerate([(0.0, 0.0), (float('nan'), 1.0)], start=1):
        spoilt = deepcopy(poses)
        spoilt.poses[0].orientation = Quaternion(x=0.0, y=y, z=0.0, w=w)
        commands.publish(spoilt)
        graph.until(lambda expected=refused: counted(node, 'refused_commands') == expected)
    assert 'camera 0' in capfd.readouterr().err and node.episode.turn.step == 0
    # A command that turns no camera changes no bit.
    np.testing.assert_array_equal(play(poses).headings, before.headings)
    headings = np.array([[2.0, 0.4, 0.1], [1.0, 0.0, 0.0]])
    turn = play(positions_to_msg(before.positions, Header(), headings))
    assert turn.step == 2
    np.testing.assert_allclose(turn.headings[0], headings[0], atol=1e-9)
    np.testing.assert_array_equal(turn.headings[1], before.headings[1])
    simulator = node.simulator
    expected = simulator.evaluate(np.hstack([turn.positions, headings]))
    assert turn.depth_error == expected.depth_error != before.depth_error
    view = Subset(simulator.look(np.append(turn.positions[0], headings[0]), 0).seen,
                  simulator.visibility.order)
    assert (node.episode.observed.mask | ~view.mask).all()
    # The poses of the next turn have them.
    found = msg_to_poses(probe.last(topics.CAMERA_POSES))
    np.testing.assert_allclose(found[0].rotation, rotation_matrix(*headings[0]), atol=1e-9)
