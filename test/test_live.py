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

"""``policy_node`` with live cameras on real DDS: a rig that carries out commands, or does not."""

from array import array
import re

from benchmarks.drills.live_rig import BODY, CAMERAS, episode_in, MAP, OPTICAL, Rig, S
from builtin_interfaces.msg import Time
from conftest import counted, HUNG, status
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import (
    cloud_to_msg,
    msg_to_cloud,
    msg_to_positions,
    ns_to_stamp,
    positions_to_msg,
    stamp_to_ns,
)
from ocp_ros.ros.policy.decider import Decider
from ocp_ros.ros.policy.instructions import FINAL, instructions, STAY
from ocp_ros.ros.policy.policy_config import PolicyNodeConfig
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.util.settings import ConfigurationError
import pytest
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.logging import get_logger
from scipy.spatial import cKDTree
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header, String
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker, MarkerArray


@pytest.fixture
def live(graph, probe, room):
    """Return what starts a rig and a node, which is in a hurry, and records what it says."""
    probe.listen(PoseArray, topics.CAMERA_COMMANDS, qos.LOOP)
    probe.listen(PointCloud2, topics.OBSERVATION, qos.LOOP)
    for kind, topic in ((PoseArray, topics.PLACEMENT), (String, topics.INSTRUCTIONS),
                        (MarkerArray, topics.MARKERS)):
        probe.listen(kind, topic, qos.LATCHED)

    def start(frames=(BODY, OPTICAL, MAP), **parameters):
        probe.rig = graph.add(lambda **kwargs: Rig(
            episode_in(room), frames, **{**kwargs, 'parameter_overrides': []}))
        probe.policy = graph.add(PolicyNode, **{
            'cloud_topics': ', '.join(f'points_{k}' for k in range(len(frames))),
            'arrival_timeout': HUNG, 'cloud_timeout': HUNG, 'voxel_size': 0.001, **parameters})
        return probe.rig, probe.policy

    def wait_for_turns(count):
        graph.until(lambda: counted(probe.policy, 'turns_answered') >= count)

    probe.start, probe.wait_for_turns = start, wait_for_turns
    return probe


def off(points, others):
    """Return how far the farthest of some points is from its nearest among others."""
    return cKDTree(others).query(points)[0].max()


@pytest.mark.system
def test_a_live_rig_comes_to_its_final_placement(live, room):
    rig, policy = live.start(turns=6)
    first = rig.episode.turn
    placement = live.last(topics.PLACEMENT)
    assert placement.header.frame_id == 'map'
    np.testing.assert_allclose(msg_to_positions(placement), rig.positions, atol=1e-6)
    assert rig.episode.turn.depth_error < 0.8 * first.depth_error
    assert counted(policy, 'refused_messages') == 0
    live.wait_for_turns(10)
    level, message, values = status(policy)
    assert (level, message) == (DiagnosticStatus.OK, 'placement is final')
    assert (values['silent_topics'], values['late_turns'], values['clock_jumps']) == ('', 0, 0)
    # It holds the cameras.
    np.testing.assert_allclose(msg_to_positions(live.last(topics.CAMERA_COMMANDS)),
                               msg_to_positions(placement), atol=1e-6)
    # Six turns, and the one that was the last: each with the cloud it was decided on.
    observations, stamps = live.received[topics.OBSERVATION], [
        stamp_to_ns(message.header.stamp) for message in live.received[topics.CAMERA_COMMANDS]]
    assert len(observations) == 7
    assert [stamp_to_ns(message.header.stamp) for message in observations] == sorted(
        set(stamps))[:7]
    assert {message.header.frame_id for message in observations} == {'map'}
    clouds = [msg_to_cloud(message) for message in observations]
    assert all(len(more) >= len(less) for less, more in zip(clouds, clouds[1:]))
    # What the cameras see is where it is, and the sensors' word for nothing is not among it.
    assert off(clouds[-1], room.points) < 1e-4
    assert values['fused_points'] == len(clouds[-1])


@pytest.mark.parametrize('frames', [(MAP,) * 3, (BODY,) * 3, (OPTICAL,) * 3])
def test_clouds_of_any_frame_make_the_same_fused_cloud(live, frames):
    rig, _ = live.start(frames)
    expected = rig.episode.observed_cloud
    found = msg_to_cloud(live.last(topics.OBSERVATION))
    assert off(found, expected) < 1e-4 and off(expected, found) < 1e-4


def test_points_out_of_range_of_their_camera_are_left_out(live):
    rig, _ = live.start((BODY,) * 3, min_range=1.0, max_range=2.0)
    positions = rig.positions
    found = msg_to_cloud(live.last(topics.OBSERVATION))
    away = np.linalg.norm(found[:, None] - positions[None], axis=2)
    assert ((away > 0.999) & (away < 2.001)).any(axis=1).all()
    assert 0 < len(found) < len(rig.episode.observed_cloud)


def test_one_silent_camera_does_not_stop_the_others(live, capfd):
    rig, policy = live.start(cloud_timeout=0.1, turns=3)
    rig.silent = {1}
    live.last(topics.PLACEMENT)
    live.graph.until(lambda: 'no clouds: points_1' in status(policy)[1])
    assert status(policy)[0] == DiagnosticStatus.WARN
    assert counted(policy, 'silent_topics') == 'points_1'
    live.listen(DiagnosticArray, '/diagnostics', 10)
    assert live.last('/diagnostics').status[0].level == DiagnosticStatus.WARN
    assert 'points_1' in capfd.readouterr().err
    # The final placement says which clouds it is based on.
    live.listen(String, topics.PLACEMENT_STATUS, qos.LATCHED)
    assert counted(policy, 'turns_with_clouds') == 'points_0 3/3, points_1 0/3, points_2 3/3'
    assert 'points_1 brought a cloud in 0 of 3 turns' in live.last(topics.PLACEMENT_STATUS).data
    # Its clouds are used again when they come again.
    rig.silent = set()
    live.graph.until(lambda: 'with gaps: points_1' in status(policy)[1])
    assert status(policy)[0] == DiagnosticStatus.WARN


def test_a_rig_that_does_not_arrive_is_commanded_from_where_it_is(live, capfd):
    rig, policy = live.start(arrival_timeout=0.1, turns=3)
    rig.obeys = False
    where = rig.positions
    live.last(topics.PLACEMENT)
    # Camera moves that are too short to matter are not waited for.
    assert counted(policy, 'late_turns') > 0
    for command in live.received[topics.CAMERA_COMMANDS]:
        assert np.linalg.norm(msg_to_positions(command) - where, axis=1).max() < 0.5 + 1e-6
    assert 'not arrived' in capfd.readouterr().err


@pytest.mark.parametrize('jump', [-500 * S, 500 * S])
def test_a_clock_that_jumps_stops_nothing(live, jump):
    rig, policy = live.start(turns=4)
    live.wait_for_turns(2)
    rig.stamp += jump
    live.last(topics.PLACEMENT)
    assert bool(counted(policy, 'clock_jumps')) == (jump < 0)


def _short(cloud):
    cloud.data = cloud.data[:-5]


def _nowhere(cloud):
    cloud.header.frame_id = 'kitchen'


def _far_away(cloud):
    cloud.data[:4] = array('B', np.float32(3e38).tobytes())


@pytest.mark.parametrize(('spoil', 'word'), [(_short, 'cloud:'), (_nowhere, "'kitchen'")])
def test_a_camera_that_sends_nonsense_does_not_stop_the_others(live, capfd, spoil, word):
    rig, policy = live.start(cloud_timeout=0.1)
    rig.spoil = {0: spoil}
    live.wait_for_turns(3)
    assert counted(policy, 'refused_messages') >= 3
    live.graph.until(lambda: 'points_0 (nothing usable)' in status(policy)[1])
    assert status(policy)[0] == DiagnosticStatus.WARN and word in capfd.readouterr().err


@pytest.mark.parametrize(('spoil', 'word'), [
    (lambda message: setattr(message.poses[1].position, 'x', np.nan), 'finite'),
    (lambda message: setattr(message.poses[1].position, 'x', np.inf), 'finite'),
    (lambda message: setattr(message.poses[1].orientation, 'w', 0.0), 'quaternion'),
    (lambda message: setattr(message.header, 'stamp', Time()), 'stamp'),
    (lambda message: setattr(message.header, 'frame_id', 'odom'), 'odom'),
    (lambda message: message.poses.pop(), '2 cameras')])
def test_poses_that_cannot_be_are_refused_and_the_turns_go_on(live, capfd, spoil, word):
    rig, policy = live.start()
    live.wait_for_turns(1)
    poses = live.publisher(PoseArray, topics.CAMERA_POSES, qos.LOOP)
    header = Header(stamp=ns_to_stamp(rig.stamp), frame_id='map')
    message = positions_to_msg(rig.positions, header)
    spoil(message)
    poses.publish(message)
    live.graph.until(lambda: counted(policy, 'refused_messages') == 1)
    assert word in capfd.readouterr().err
    live.wait_for_turns(counted(policy, 'turns_answered') + 2)


def test_a_stray_point_is_left_out(live, room):
    rig, policy = live.start()
    rig.spoil = dict.fromkeys(range(CAMERAS), _far_away)
    assert off(msg_to_cloud(live.last(topics.OBSERVATION)), room.points) < 1e-4
    assert counted(policy, 'refused_messages') == 0


def test_a_fused_cloud_that_is_no_room_is_begun_anew(live, room):
    rig, policy = live.start()
    live.wait_for_turns(1)
    policy._live._fused_cloud.add(np.array([[900.0, 0.0, 0.0]]))
    live.graph.until(lambda: counted(policy, 'refused_messages') == 1)
    live.received[topics.OBSERVATION].clear()
    assert off(msg_to_cloud(live.last(topics.OBSERVATION)), room.points) < 1e-4


def test_nobody_says_where_the_cameras_are(live, capfd):
    rig, policy = live.start(cloud_timeout=0.1)
    graph = live.graph
    graph.remove(rig)
    graph.until(lambda: status(policy)[:2] == (DiagnosticStatus.WARN, 'nothing on camera_poses'))
    live.call(Trigger, 'policy_node/reset')
    graph.until(lambda: 'nothing on /camera_poses' in capfd.readouterr().err)


def added(drawn):
    """Return the arrows that the last of some marker messages adds."""
    return [arrow for arrow in drawn[-1].markers if arrow.action == Marker.ADD] if drawn else []


def leads_to(drawn, target):
    """Return whether the arrows of the last of some marker messages end at targets (K, 3)."""
    arrows = added(drawn)
    return bool(arrows) and np.allclose(
        [(arrow.points[1].x, arrow.points[1].y) for arrow in arrows],
        target[[arrow.id for arrow in arrows], :2])


def moves_in(text):
    """Return the lines of instructions that say what to do."""
    return '\n'.join(line for line in text.splitlines() if not line.startswith('expected'))


def test_a_person_is_told_what_to_do_and_has_time(live):
    rig, policy = live.start(manual=True, turns=2, max_step=0.5, arrival_timeout=0.1,
                             cloud_timeout=0.1)
    rig.obeys = False
    for turn in range(2):
        live.wait_for_turns(turn + 1)
        text, drawn = live.received[topics.INSTRUCTIONS], live.received[topics.MARKERS]
        # Who has arrived is told to stay where the clouds are late, so words are not counted.
        live.graph.until(lambda turn=turn: rig.turns == turn + 1 and text and moves_in(
            text[-1].data) == instructions(rig.positions, rig.target, 0.05) != STAY)
        assert text[-1].data.splitlines()[-1].startswith('expected: ')
        live.graph.until(lambda: leads_to(drawn, rig.target))
        arrows = added(drawn)
        assert {arrow.type for arrow in arrows} == {Marker.ARROW}
        assert [f'camera {arrow.id}' for arrow in arrows] == [
            line.split(':')[0] for line in moves_in(text[-1].data).splitlines()]
        # Nothing happens while nobody moves, however long it takes.
        stamp = rig.stamp
        live.graph.until(lambda: rig.stamp > stamp + S // 2)
        assert counted(policy, 'turns_answered') == turn + 1
        rig.go()
    live.graph.until(lambda: text[-1].data == FINAL)
    live.graph.until(lambda: {arrow.action for arrow in drawn[-1].markers} == {Marker.DELETE})
    np.testing.assert_allclose(
        msg_to_positions(live.last(topics.PLACEMENT)), rig.positions, atol=1e-6)


def test_a_person_hears_nothing_of_noise_and_what_is_left_of_a_move(live):
    rig, policy = live.start(manual=True, turns=2, max_step=0.5)
    rig.obeys = False
    live.wait_for_turns(1)
    live.last(topics.INSTRUCTIONS)
    live.graph.until(lambda: rig.target is not None)
    before, rng = len(live.received[topics.INSTRUCTIONS]), np.random.default_rng(0)
    where = rig.positions
    for _ in range(5):
        rig.episode.move((where - rig.positions + rng.normal(0.0, 0.004, where.shape))[:, :2])
        policy._live._resend()
        for _ in range(5):
            live.graph.executor.spin_once(timeout_sec=0.02)
    assert len(live.received[topics.INSTRUCTIONS]) == before
    # One camera hangs 7 cm beside its target.
    goal = rig.target.copy()
    rig.episode.move((goal + [[0.07, 0.0, 0.0], *np.zeros((2, 3))] - rig.positions)[:, :2])
    expected = instructions(rig.positions, goal, 0.05)
    assert expected.count('camera') == 1
    live.graph.until(
        lambda: moves_in(live.received[topics.INSTRUCTIONS][-1].data) == expected)
    assert status(policy)[0] == DiagnosticStatus.OK
    rig.go()
    live.wait_for_turns(2)


@pytest.mark.parametrize(('move', 'turn', 'words'), [
    ((0.0, 0.5, 0.0), (0, 0), r'camera 0: 0\.50 m .*\+y.*\(1\.00, 2\.50\)'),
    ((0.4, -0.1, 0.0), (0, 0), r'0\.40 m .*\+x .*0\.10 m .*-y.*\(1\.40, 1\.90\)'),
    ((-0.304, 0.04, 0.0), (2, 0), r'0\.30 m .*-x'),
    ((0.0, 0.0, 0.5), (0, 0), r'0\.50 m up.*\(1\.00, 2\.00, 2\.40\)'),
    ((0.0, 0.2, -0.1), (0, 0), r'0\.20 m .*\+y .*0\.10 m down'),
    ((0.01, 0.0, 0.0), (40, 0), r'camera 0: turn 40 degrees to the left$'),
    ((0.0, 0.0, 0.0), (-30, 20), r'30 degrees to the right .*20 degrees down'),
    ((0.0, -0.3, 0.0), (2, -8), r'0\.30 m .*-y.*2 degrees to the left .*8 degrees up'),
    ((0.03, 0.0, 0.02), (4, -2), STAY)])
def test_instructions_say_how_far_and_in_which_direction(move, turn, words):
    here = np.array([[1.0, 2.0, 1.9]])
    assert re.search(words, instructions(here, here + move, 0.05, np.deg2rad([turn]), 0.1))


@pytest.mark.parametrize(('given', 'turns', 'max_step', 'max_turn'), [
    ({}, 30, 0.5, 0.5), ({'manual': True}, 5, 2.0, 1.6),
    ({'manual': True, 'turns': 9, 'max_turn': 0.0}, 9, 2.0, 0.0)])
def test_a_person_moves_cameras_seldom_and_far_unless_told_otherwise(
        graph, given, turns, max_step, max_turn):
    policy = graph.add(PolicyNode, planner='lookahead', cloud_topics='points', **given)
    config = policy.config
    assert (config.turns, config.max_step, config.max_turn) == (turns, max_step, max_turn)
    assert policy.get_parameter('turns').value == turns


@pytest.mark.parametrize('noise', [0.01, 0.03])
def test_noise_of_poses_neither_stops_turns_nor_moves_what_was_decided(live, noise):
    rig, policy = live.start(turns=3, cloud_timeout=0.3)
    rig.noise = noise
    live.graph.until(lambda: live.received[topics.PLACEMENT])
    placement = live.last(topics.PLACEMENT)
    decided, first = msg_to_positions(placement), len(rig.commands)
    live.graph.until(lambda: len(rig.commands) >= first + 3)
    for command in rig.commands[first:]:
        assert command.poses == placement.poses
    # A mean is nearer than what it is the mean of, and heights do not wander.
    assert np.abs(decided - rig.positions).max() < 0.6 * noise + 1e-3
    assert counted(policy, 'late_turns') == 0


def test_a_new_placement_begins_without_a_restart(live):
    rig, policy = live.start(turns=3)
    live.graph.until(lambda: status(policy)[1] == 'placement is final')
    placements = len(live.received[topics.PLACEMENT])
    rig.episode.move(np.full((CAMERAS, 2), 0.3))
    assert live.call(Trigger, 'policy_node/reset').success
    assert counted(policy, 'fused_points') == 0
    live.graph.until(lambda: len(live.received[topics.PLACEMENT]) > placements)
    np.testing.assert_allclose(
        msg_to_positions(live.last(topics.PLACEMENT)), rig.positions, atol=1e-6)


def test_a_camera_outside_of_what_it_sees_comes_no_faster_than_it_may():
    # Two cameras look at a wall 3.5 m ahead and see nothing else.
    wall = np.stack([axis.ravel() for axis in np.meshgrid(
        np.linspace(2.5, 3.5, 30), np.linspace(-1.5, 1.5, 30), [0.5, 1.5, 2.5])], axis=1)
    poses = positions_to_msg(np.array([[0.0, 0.0, 1.5], [0.0, 1.0, 1.5]]), Header(frame_id='map'))
    decider = Decider(PolicyNodeConfig(max_step=0.05), None, get_logger('decider'))
    answer = decider.decide(wall.astype(np.float32), poses, 0)
    away = msg_to_positions(answer) - msg_to_positions(poses)
    assert 0.0 < np.linalg.norm(away, axis=1).max() <= 0.05 + 1e-9


@pytest.mark.parametrize(('parameters', 'words'), [
    ({'cloud_topics': 'a b'}, 'cloud_topics'), ({'cloud_topics': 'points,points'}, 'each once'),
    ({'cloud_topics': 'points,/points'}, 'each once'),
    ({'cloud_topics': 'observation'}, 'cloud_topics: .*/observation'),
    ({'manual': True}, 'manual: .*cloud_topics'), ({'min_range': 5.0}, 'min_range: .*max_range')])
def test_settings_that_cannot_be_are_refused(graph, parameters, words):
    with pytest.raises(ConfigurationError, match=words):
        graph.add(PolicyNode, **parameters)


@pytest.mark.parametrize('profile', [qos.LOOP, qos.SENSOR])
def test_poses_that_come_while_the_node_is_busy_are_of_one_clock(graph, probe, profile):
    policy = graph.add(PolicyNode, cloud_topics='points')
    poses = probe.publisher(PoseArray, topics.CAMERA_POSES, profile)
    # Five a second, while the node is busy.
    for stamp in range(1, 21):
        poses.publish(positions_to_msg(np.zeros((2, 3)), Header(
            stamp=ns_to_stamp(200_000_000 * stamp), frame_id='map')))
    graph.until(lambda: policy._live._turns.positions is not None)
    for _ in range(20):
        graph.executor.spin_once(timeout_sec=0.01)
    assert counted(policy, 'clock_jumps') == 0 == counted(policy, 'refused_messages')


def test_clouds_that_come_while_the_node_is_busy_are_dropped_but_the_newest(graph, probe, room):
    policy, heard = graph.add(PolicyNode, cloud_topics='points'), []
    policy._live._turns.on_cloud = lambda topic, stamp, cloud: heard.append(stamp)
    clouds = probe.publisher(PointCloud2, 'points', qos.LOOP)
    # Nobody spins meanwhile, as in a long turn.
    for stamp in range(1, 41):
        clouds.publish(cloud_to_msg(
            room.points, Header(stamp=ns_to_stamp(stamp), frame_id='map')))
    graph.until(lambda: heard and heard[-1] == 40)
    assert len(heard) < 40


@pytest.mark.parametrize('how', ['pause', 'deactivation'])
def test_cameras_on_their_way_stop_where_they_are_and_go_on_later(live, how):
    rig, policy = live.start(turns=50)
    live.wait_for_turns(2)
    rig.obeys = False
    live.wait_for_turns(counted(policy, 'turns_answered'))
    live.graph.until(lambda: not policy._live._turns.cameras_stand)
    # Half of the way is behind them.
    rig.episode.move(0.5 * (rig.target - rig.positions)[:, :2])
    stamp, here = rig.stamp, rig.positions.copy()
    live.graph.until(lambda: rig.stamp > stamp + S // 4)
    if how == 'pause':
        assert live.call(SetBool, 'policy_node/pause', data=True).success
    else:
        assert policy.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
    live.graph.until(lambda: np.allclose(rig.target, here, atol=1e-6))
    commands, turns = len(rig.commands), counted(policy, 'turns_answered')
    live.graph.until(lambda: rig.stamp > stamp + 2 * S)
    assert len(rig.commands) == commands and status(policy)[1] in ('paused', 'inactive')
    if how == 'pause':
        assert live.call(SetBool, 'policy_node/pause', data=False).success
    else:
        assert policy.trigger_activate() == TransitionCallbackReturn.SUCCESS
    live.graph.until(lambda: not np.allclose(rig.target, here, atol=1e-6))
    rig.obeys = True
    rig.go()
    live.wait_for_turns(turns + 1)
