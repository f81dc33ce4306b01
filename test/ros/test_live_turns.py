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
from functools import partial
from itertools import count
import json
import re
import threading

from benchmarks.calibration_bench import cast
from benchmarks.drills.live_rig import BODY, CAMERAS, episode_in, MAP, OPTICAL, Rig, S
from builtin_interfaces.msg import Time
from conftest import counted, farthest_distance, header_at, HUNG, SMALL, status, warnings_of
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.geometry.cameras import OPTICAL_TO_BODY, Pose
from ocp_ros.online.step import OnlineStep
from ocp_ros.registration.steady_cloud import steady_cloud
from ocp_ros.rig.placement_file import load_placement
from ocp_ros.rooms.generator import generate_room, mesh_of, plan_of
from ocp_ros.ros.bags.recorded_clouds import topics_of_cameras
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import (
    cloud_to_msg,
    msg_to_cloud,
    msg_to_positions,
    ns_to_stamp,
    positions_to_msg,
    stamp_to_ns,
)
from ocp_ros.ros.policy import live_turns
from ocp_ros.ros.policy.instructions import FINAL, instructions, STAY
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.ros.sim_node import SimNode
from ocp_ros.scenes.meshes import MeshRays
from ocp_ros.scenes.scene_files import save_scene
from ocp_ros.util.settings import ConfigurationError
import pytest
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker, MarkerArray


@pytest.fixture
def live(graph, probe, room, monkeypatch):
    """Return what starts a rig and a node, which is in a hurry, and records what it says."""
    monkeypatch.setattr(live_turns, 'RESEND_S', 0.1)
    probe.listen(PoseArray, topics.CAMERA_COMMANDS, qos.LOOP)
    probe.listen(PointCloud2, topics.OBSERVATION, qos.LOOP)
    for kind, topic in ((PoseArray, topics.PLACEMENT), (String, topics.INSTRUCTIONS),
                        (MarkerArray, topics.MARKERS)):
        probe.listen(kind, topic, qos.LATCHED)

    def start(frames=(BODY, OPTICAL, MAP), **parameters):
        probe.rig = graph.add(partial(Rig, episode_in(room), frames))
        probe.policy = graph.add(PolicyNode, **{
            'cloud_topics': ', '.join(f'points_{k}' for k in range(len(frames))),
            'planner': 'lookahead', 'arrival_timeout': HUNG, 'cloud_timeout': HUNG,
            'voxel_size': 0.001, **parameters})
        return probe.rig, probe.policy

    def wait_for_turns(count):
        graph.until(lambda: counted(probe.policy, 'turns_answered') >= count)

    def wait(seconds):
        end = probe.rig.stamp + seconds * S
        graph.until(lambda: probe.rig.stamp > end)

    probe.start, probe.wait_for_turns, probe.wait = start, wait_for_turns, wait
    return probe


def assert_is_placed(live):
    """Assert that the final placement is where the cameras are."""
    np.testing.assert_allclose(
        msg_to_positions(live.last(topics.PLACEMENT)), live.rig.positions, atol=1e-6)


@pytest.mark.system
def test_a_live_rig_comes_to_its_final_placement(live, room):
    rig, policy = live.start(planner='learned', turns=6)
    first = rig.episode.turn
    placement = live.last(topics.PLACEMENT)
    assert placement.header.frame_id == 'map'
    assert_is_placed(live)
    assert rig.episode.turn.depth_error < 0.8 * first.depth_error
    live.wait_for_turns(10)
    level, message, values = status(policy)
    assert (level, message) == (DiagnosticStatus.OK, 'placement is final')
    assert [values[name] for name in ('refused_messages', 'silent_topics', 'late_turns',
                                      'clock_jumps')] == [0, '', 0, 0]
    # It holds the cameras.
    np.testing.assert_allclose(msg_to_positions(live.last(topics.CAMERA_COMMANDS)),
                               msg_to_positions(placement), atol=1e-6)
    # Six turns, and the one that was the last: each with the cloud it was decided on.
    observations = live.received[topics.OBSERVATION]
    commanded, seen = ([stamp_to_ns(message.header.stamp) for message in messages]
                       for messages in (live.received[topics.CAMERA_COMMANDS], observations))
    assert len(seen) == 7 and seen == sorted(set(commanded))[:7]
    assert {message.header.frame_id for message in observations} == {'map'}
    clouds = [msg_to_cloud(message) for message in observations]
    assert all(len(more) >= len(less) for less, more in zip(clouds, clouds[1:]))
    # What the cameras see is where it is, and the sensors' word for nothing is not among it.
    assert farthest_distance(clouds[-1], room.points) < 1e-4
    assert values['fused_points'] == len(clouds[-1])


def test_the_fused_cloud_is_what_cameras_see_whatever_the_frames_of_their_clouds(live, room):
    rig, policy = live.start()
    expected = rig.episode.observed_cloud
    found = msg_to_cloud(live.last(topics.OBSERVATION))
    assert farthest_distance(found, expected) < 1e-4 and farthest_distance(expected, found) < 1e-4
    # One that is no room is begun anew.
    live.wait_for_turns(1)
    policy.source._fused_cloud.add(np.array([[900.0, 0.0, 0.0]]))
    live.graph.until(lambda: counted(policy, 'refused_messages') == 1)
    live.received[topics.OBSERVATION].clear()
    assert farthest_distance(msg_to_cloud(live.last(topics.OBSERVATION)), room.points) < 1e-4


@pytest.mark.parametrize('has_rig_file', [False, True])
def test_points_out_of_range_of_their_camera_and_stray_ones_are_left_out(
        live, tmp_path, has_rig_file):
    # The ranges of a rig file replace the parameters.
    parameters = {'min_range': 1.0, 'max_range': 2.0}
    if has_rig_file:
        path = tmp_path / 'rig.yaml'
        path.write_text('cameras: [{sensor: omnidirectional, min_range: 1.0, max_range: 2.0, '
                        f'count: {CAMERAS}}}]')
        parameters = {'rig_file': str(path)}

    def stray(cloud):
        cloud.data[:4] = array('B', np.float32(3e38).tobytes())

    rig, policy = live.start(**parameters)
    rig.spoil, positions = dict.fromkeys(range(CAMERAS), stray), rig.positions
    found = msg_to_cloud(live.last(topics.OBSERVATION))
    away = np.linalg.norm(found[:, None] - positions[None], axis=2)
    assert ((away > 0.999) & (away < 2.001)).any(axis=1).all()
    assert 0 < len(found) < len(rig.episode.observed_cloud)
    assert counted(policy, 'refused_messages') == 0


def test_a_command_goes_out_by_the_plan_so_far_while_messages_are_handled(live, monkeypatch):
    """The planner would go on for ever; it is interrupted soon after the clouds of each turn."""
    plan_ahead, interruptions = OnlineStep.plan_ahead, []

    def plan_for_ever(step, interrupted=lambda: False):
        plan_ahead(step, interrupted)
        if threading.current_thread() is not threading.main_thread():
            while not interrupted():
                released.wait(0.001)
            interruptions.append(counted(live.policy, 'turns_answered'))

    released = threading.Event()
    monkeypatch.setattr(OnlineStep, 'plan_ahead', plan_for_ever)
    rig, policy = live.start(turns=5, think_seconds=0.02)
    live.wait_for_turns(2)
    rig.obeys = False
    live.wait(0.5)
    before = len(interruptions)
    assert before >= 1 and before == counted(policy, 'turns_answered') - 1
    rig.obeys = True
    rig.go()
    live.last(topics.PLACEMENT)
    # A new placement waits for no plan of the last one.
    policy.decider.plan_ahead()
    policy.decider.reset()
    assert len(interruptions) > before


def test_one_silent_camera_does_not_stop_the_others(live, capfd):
    rig, policy = live.start(cloud_timeout=0.1, turns=3)
    rig.silent = {1}
    live.last(topics.PLACEMENT)
    live.graph.until(lambda: 'no clouds: points_1' in status(policy)[1])
    live.listen(DiagnosticArray, '/diagnostics', 10)
    assert live.last('/diagnostics').status[0].level == DiagnosticStatus.WARN
    assert counted(policy, 'silent_topics') == 'points_1'
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
    rig, policy = live.start(arrival_timeout=0.1, turns=2, max_step=0.5)
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
    rig, policy = live.start(turns=2)
    live.wait_for_turns(1)
    rig.stamp += jump
    live.last(topics.PLACEMENT)
    assert bool(counted(policy, 'clock_jumps')) == (jump < 0)


def test_cameras_that_send_nonsense_do_not_stop_the_others(live):
    rig, policy = live.start(cloud_timeout=0.1)
    warnings = warnings_of(policy)
    rig.spoil = {0: lambda cloud: setattr(cloud, 'data', cloud.data[:-5]),
                 1: lambda cloud: setattr(cloud.header, 'frame_id', 'kitchen')}
    live.wait_for_turns(2)
    # The diagnostics say the same as the log, which says each thing once.
    words = ('row_step', "'kitchen'")
    live.graph.until(lambda: all(word in status(policy)[1] for word in words))
    assert status(policy)[0] == DiagnosticStatus.WARN
    assert counted(policy, 'refused_messages') >= 4
    assert all(sum(word in line for line in warnings) == 1 for word in words)
    # When they send what can be used, that is over.
    rig.spoil = {}
    live.graph.until(lambda: status(policy)[0] == DiagnosticStatus.OK)


def test_without_a_rig_file_no_camera_is_sent_over_furniture(live, room):
    rig, policy = live.start(turns=6, cloud_timeout=1.0)
    start = rig.positions
    live.last(topics.PLACEMENT)
    # Not the first two: the few points seen by then hardly show furniture. Commands come again.
    commands = {stamp_to_ns(message.header.stamp): msg_to_positions(message)[:, :2]
                for message in live.received[topics.CAMERA_COMMANDS]}
    targets = np.concatenate([commands[stamp] for stamp in sorted(commands)[2:]])
    furniture = room.points[(room.points[:, 2] > 0.2) & (room.points[:, 2] < 1.8), :2]
    assert np.linalg.norm(targets[:, None] - furniture[None], axis=2).min() > 0.35
    # Next come other cameras.
    live.graph.remove(rig)
    assert live.call(Trigger, 'policy_node/reset').success
    poses = live.publisher(PoseArray, topics.CAMERA_POSES, qos.LOOP)
    cloud = live.publisher(PointCloud2, 'points_2', qos.LOOP)
    answered = counted(policy, 'turns_answered')

    def answers():
        rig.stamp += S // 50
        poses.publish(positions_to_msg(start[:2], header_at(rig.stamp)))
        cloud.publish(cloud_to_msg(room.points, header_at(rig.stamp)))
        return counted(policy, 'turns_answered') > answered

    live.graph.until(answers)


def test_turns_that_cannot_be_answered_are_named_once(live, tmp_path):
    path = tmp_path / 'rig.yaml'
    path.write_text(f'cameras: [{{sensor: omnidirectional, count: {CAMERAS + 1}}}]')
    rig, policy = live.start(cloud_timeout=1.0, rig_file=str(path))
    warnings = warnings_of(policy)
    live.wait(2.0)
    live.graph.until(lambda: counted(policy, 'refused_messages') >= 20)
    # Each turn waits for all of its clouds: no topic is said to be silent meanwhile.
    assert len([line for line in warnings if 'found 3 cameras; expected 4' in line]) == 1
    assert not [line for line in warnings if 'no clouds' in line]


def test_a_wrong_clock_is_named_once_with_the_seconds_by_which_it_leads(live):
    def delay(cloud):
        cloud.header.stamp = ns_to_stamp(stamp_to_ns(cloud.header.stamp) - 30 * S)

    rig, policy = live.start(cloud_timeout=0.1)
    rig.spoil = dict.fromkeys(range(CAMERAS), delay)
    warnings = warnings_of(policy)
    live.graph.until(lambda: all(f'leads that of points_{camera} by 30.0 s' in status(policy)[1]
                                 for camera in range(CAMERAS)))
    before = len(warnings)
    live.wait(0.5)
    assert before == len(warnings) and sum('by 30.0 s' in line for line in warnings) <= CAMERAS
    live.listen(DiagnosticArray, '/diagnostics', 10)
    assert live.last('/diagnostics').status[0].hardware_id


def test_poses_that_cannot_be_are_refused_and_the_turns_go_on(live):
    rig, policy = live.start()
    live.wait_for_turns(1)
    poses = live.publisher(PoseArray, topics.CAMERA_POSES, qos.LOOP)
    warnings = warnings_of(policy)
    for number, (spoil, word) in enumerate((
            (lambda message: setattr(message.poses[1].position, 'x', np.nan), 'finite'),
            (lambda message: setattr(message.header, 'stamp', Time()), 'stamp'),
            (lambda message: setattr(message.header, 'frame_id', 'odom'), 'odom'),
            (lambda message: message.poses.pop(), '2 cameras')), start=1):
        message = positions_to_msg(rig.positions, header_at(rig.stamp))
        spoil(message)
        poses.publish(message)
        live.graph.until(lambda: counted(policy, 'refused_messages') == number)
        assert word in [line for line in warnings if 'refused' in line][-1]
    live.wait_for_turns(counted(policy, 'turns_answered') + 1)


def test_nobody_says_where_the_cameras_are(live, capfd):
    rig, policy = live.start(cloud_timeout=0.1)
    live.graph.remove(rig)
    live.call(Trigger, 'policy_node/reset')
    live.graph.until(lambda: 'nothing new on /camera_poses' in status(policy)[1])
    assert status(policy)[0] == DiagnosticStatus.WARN
    assert 'nothing new on /camera_poses' in capfd.readouterr().err


def arrows_of(drawn):
    """Return where the arrows of the last of some marker messages end, by their cameras."""
    return {f'camera {arrow.id}': [arrow.points[1].x, arrow.points[1].y]
            for arrow in (drawn[-1].markers if drawn else [])
            if (arrow.action, arrow.type) == (Marker.ADD, Marker.ARROW)}


def moves_in(text):
    """Return the lines of instructions that say what to do."""
    return '\n'.join(line for line in text.splitlines() if not line.startswith('expected'))


def test_a_person_is_told_what_to_do_and_has_time(live):
    rig, policy = live.start(manual=True, turns=1, max_step=0.5, arrival_timeout=0.1,
                             cloud_timeout=0.1)
    rig.obeys = False
    text, drawn = live.received[topics.INSTRUCTIONS], live.received[topics.MARKERS]
    live.graph.until(lambda: rig.target is not None and text)
    latest = text[-1].data
    assert moves_in(latest) == instructions(rig.positions, rig.target, 0.05) != STAY
    assert latest.splitlines()[-1].startswith('expected: ')
    goals = {line.split(':')[0]: rig.target[int(line[7]), :2].tolist()
             for line in moves_in(latest).splitlines()}
    live.graph.until(lambda: arrows_of(drawn) == goals)
    # Nothing happens while the cameras stay, however long it takes.
    live.wait(0.3)
    assert counted(policy, 'turns_answered') == 1
    rig.go()
    live.graph.until(lambda: text[-1].data == FINAL)
    live.graph.until(lambda: {arrow.action for arrow in drawn[-1].markers} == {Marker.DELETE})
    assert_is_placed(live)


def test_nobody_is_asked_for_a_height_that_no_command_changes(live):
    rig, _ = live.start(manual=True, turns=2, max_step=0.5)
    rig.obeys = False
    sent = live.received[topics.INSTRUCTIONS]
    live.graph.until(lambda: rig.target is not None and sent)
    # From now on all heights are measured 6 cm too low.
    rig.offset = np.array([0.0, 0.0, -0.06])
    rig.episode.move(0.5 * (rig.target - rig.positions)[:, :2])
    count = len(sent)
    live.graph.until(lambda: len(sent) > count)
    assert 'camera' in sent[-1].data and 'higher' not in sent[-1].data


def test_a_person_ends_a_turn_or_the_placement_where_the_cameras_stand(live):
    rig, policy = live.start(manual=True, turns=5, max_step=0.5)
    rig.obeys = False
    live.graph.until(lambda: rig.target is not None)
    rig.episode.move(0.5 * (rig.target - rig.positions)[:, :2])
    live.wait(0.3)
    assert counted(policy, 'turns_answered') == 1
    assert live.call(Trigger, 'policy_node/arrived').success
    live.wait_for_turns(2)
    # It was for one turn.
    live.wait(0.3)
    assert counted(policy, 'turns_answered') == 2
    assert live.call(Trigger, 'policy_node/accept').success
    assert_is_placed(live)
    assert not live.call(Trigger, 'policy_node/accept').success


def test_a_person_hears_nothing_of_noise_and_what_is_left_of_a_move(live):
    rig, policy = live.start(manual=True, turns=2, max_step=0.5)
    rig.obeys = False
    sent = live.received[topics.INSTRUCTIONS]
    live.graph.until(lambda: rig.target is not None and sent)
    before, rng, where = len(sent), np.random.default_rng(0), rig.positions
    for _ in range(3):
        rig.episode.move((where - rig.positions + rng.normal(0.0, 0.004, where.shape))[:, :2])
        commands = len(rig.commands)
        live.graph.until(lambda sent=commands: len(rig.commands) > sent + 1)
    assert len(sent) == before
    # One camera hangs 7 cm beside its target.
    goal = rig.target.copy()
    rig.episode.move((goal + [[0.07, 0.0, 0.0], *np.zeros((2, 3))] - rig.positions)[:, :2])
    expected = instructions(rig.positions, goal, 0.05)
    assert expected.count('camera') == 1
    live.graph.until(lambda: moves_in(sent[-1].data) == expected)
    assert status(policy)[0] == DiagnosticStatus.OK
    rig.go()
    live.wait_for_turns(2)


@pytest.mark.parametrize(('move', 'turn', 'words'), [
    ((0.4, -0.1, 0.0), (0, 0), r'0\.40 m → and 0\.10 m ↓, to \(1\.40, 1\.90\)$'),
    # Parts below the limits are not asked for; if all are, the largest one is.
    ((-0.304, 0.04, 0.0), (2, 0), r': 0\.30 m ←, to [^;]*$'),
    ((0.04, -0.041, 0.0), (0, 0), r': 0\.04 m ↓, to'),
    ((0.0, 0.0, 0.5), (0, 0), r'0\.50 m higher.*\(1\.00, 2\.00, 2\.40\)'),
    ((0.0, 0.2, -0.1), (0, 0), r'0\.20 m ↑ and 0\.10 m lower'),
    ((0.01, 0.0, 0.0), (40, 0), r'camera 0: turn 40 degrees to the left$'),
    ((0.0, 0.0, 0.0), (-30, 20), r'30 degrees to the right .*20 degrees down'),
    ((0.0, -0.3, 0.0), (2, -8), r'0\.30 m ↓.*; turn 8 degrees up$'),
    ((0.03, 0.0, 0.02), (4, -2), STAY)])
def test_instructions_say_how_far_and_in_which_direction(move, turn, words):
    here = np.array([[1.0, 2.0, 1.9]])
    assert re.search(words, instructions(here, here + move, 0.05, np.deg2rad([turn]), 0.1))


@pytest.mark.parametrize(('given', 'turns', 'max_step', 'max_turn'), [
    ({'cloud_topics': ''}, 30, 0.5, 0.5), ({}, 12, 1.5, 1.6),
    ({'manual': True}, 5, 2.0, 1.6),
    ({'manual': True, 'turns': 9, 'max_turn': 0.0}, 9, 2.0, 0.0),
    ({'rig_file': 'rig.yaml'}, 12, 0.8, np.pi / 4),
    ({'rig_file': 'rig.yaml', 'max_step': 0.7}, 12, 0.7, np.pi / 4),
    ({'rig_file': 'rig.yaml', 'manual': True}, 5, 2.0, 1.6)])
def test_live_cameras_move_far_unless_the_rig_or_the_user_says_otherwise(
        graph, tmp_path, monkeypatch, given, turns, max_step, max_turn):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'rig.yaml').write_text(
        'cameras: [{sensor: realsense_d455}]\nmotion: {max_step: 0.8, max_turn: 45}')
    policy = graph.add(PolicyNode, **{'planner': 'lookahead', 'cloud_topics': 'points', **given})
    config = policy.config
    assert (config.turns, config.max_step, config.max_turn) == (
        turns, max_step, pytest.approx(max_turn))
    assert policy.get_parameter('turns').value == turns


@pytest.mark.parametrize('rig, turns, max_step', [
    ('mount: {on: plane, height: 1.9}', 12, 1.5), ('mount: {on: ceiling}', 30, 0.5),
    ('mount: {on: ceiling}\nmotion: {turns: 7}', 7, 0.5)])
def test_simulated_cameras_move_as_their_rig_does_on_both_sides(graph, tmp_path, rig, turns,
                                                                max_step):
    (tmp_path / 'rig.yaml').write_text(f'cameras: [{{sensor: realsense_d455}}]\n{rig}')
    given = {'rig_file': str(tmp_path / 'rig.yaml')}
    for limits in (graph.add(PolicyNode, planner='lookahead', **given).config,
                   graph.add(SimNode, **SMALL, **given).config.episode):
        assert (limits.turns, limits.max_step) == (turns, max_step)


def reliabilities(node):
    """Return the reliability of all subscriptions of the clouds."""
    found = node.get_subscriptions_info_by_topic('/points')
    return {subscription.qos_profile.reliability for subscription in found}


def test_clouds_are_received_reliably_where_all_drivers_offer_it(graph):
    policy = graph.add(PolicyNode, planner='lookahead', cloud_topics='points')
    driver = graph.add(partial(Node, 'driver'))
    driver.create_publisher(PointCloud2, 'points', qos.LOOP)
    graph.until(lambda: reliabilities(policy) == {ReliabilityPolicy.RELIABLE})
    # A driver with best effort, which appears later, is heard too.
    driver.create_publisher(PointCloud2, 'points', qos.SENSOR)
    graph.until(lambda: reliabilities(policy) == {ReliabilityPolicy.BEST_EFFORT})
    graph.remove(policy)
    policy = graph.add(PolicyNode, planner='lookahead', cloud_topics='points', **{
        'qos_overrides./points.subscription.reliability': 'reliable'})
    graph.until(lambda: reliabilities(policy) == {ReliabilityPolicy.RELIABLE})


def test_noise_of_poses_neither_stops_turns_nor_moves_what_was_decided(live):
    rig, policy = live.start(turns=2, cloud_timeout=0.3)
    rig.noise = 0.03
    placement = live.last(topics.PLACEMENT)
    first = len(rig.commands)
    live.graph.until(lambda: len(rig.commands) >= first + 3)
    assert all(command.poses == placement.poses for command in rig.commands[first:])
    # A mean is nearer than what it is the mean of, and heights do not wander.
    assert np.abs(msg_to_positions(placement) - rig.positions).max() < 0.6 * rig.noise + 1e-3
    assert counted(policy, 'late_turns') == 0


def test_a_new_placement_begins_without_a_restart(live):
    rig, policy = live.start(turns=1)
    live.graph.until(lambda: status(policy)[1] == 'placement is final')
    placements = len(live.received[topics.PLACEMENT])
    rig.episode.move(np.full((CAMERAS, 2), 0.3))
    assert live.call(Trigger, 'policy_node/reset').success
    assert counted(policy, 'fused_points') == 0
    live.graph.until(lambda: len(live.received[topics.PLACEMENT]) > placements)
    assert_is_placed(live)


@pytest.mark.parametrize(('parameters', 'words'), [
    ({'cloud_topics': 'a b'}, 'cloud_topics'), ({'cloud_topics': 'points,points'}, 'each once'),
    ({'cloud_topics': 'points,/points'}, 'each once'), ({'rig_file': 'nowhere.yaml'}, 'nowhere'),
    ({'cloud_topics': 'observation'}, 'cloud_topics: .*/observation'),
    ({'manual': True}, 'manual: .*cloud_topics'),
    ({'camera_frames': ['a']}, 'camera_frames: .*cloud_topics'),
    ({'min_range': 5.0}, 'min_range: .*max_range'),
    ({'scan': 'none.ply'}, 'scan: .*cloud_topics'),
    ({'scan': 'none.ply', 'cloud_topics': 'a'}, 'none.ply')])
def test_settings_that_cannot_be_are_refused(graph, parameters, words):
    with pytest.raises(ConfigurationError, match=words):
        graph.add(PolicyNode, planner='lookahead', **parameters)


@pytest.mark.parametrize('profile', [qos.LOOP, qos.SENSOR])
def test_poses_that_come_while_the_node_is_busy_are_of_one_clock(graph, probe, profile):
    policy = graph.add(PolicyNode, planner='lookahead', cloud_topics='points')
    poses = probe.publisher(PoseArray, topics.CAMERA_POSES, profile)
    # Five a second, while the node is busy.
    for stamp in range(1, 21):
        poses.publish(positions_to_msg(np.zeros((2, 3)), header_at(200_000_000 * stamp)))
    graph.until(lambda: policy.source._turns.positions is not None)
    for _ in range(20):
        graph.executor.spin_once(timeout_sec=0.01)
    assert counted(policy, 'clock_jumps') == 0 == counted(policy, 'refused_messages')


def test_clouds_that_come_while_the_node_is_busy_are_dropped_but_the_newest(graph, probe, room):
    policy = graph.add(PolicyNode, planner='lookahead', cloud_topics='points')
    heard = []
    policy.source._turns.on_cloud = lambda topic, stamp, cloud: heard.append(stamp)
    clouds = probe.publisher(PointCloud2, 'points', qos.LOOP)
    # Nobody spins meanwhile, as in a long turn.
    for stamp in range(1, 41):
        clouds.publish(cloud_to_msg(room.points, header_at(stamp)))
    graph.until(lambda: heard and heard[-1] == 40)
    assert len(heard) < 40


@pytest.mark.parametrize('how', ['pause', 'deactivation'])
def test_cameras_on_their_way_stop_where_they_are_and_go_on_later(live, how):
    rig, policy = live.start(turns=50)

    def stop(wanted):
        if how == 'pause':
            assert live.call(SetBool, 'policy_node/pause', data=wanted).success
        else:
            change = policy.trigger_deactivate if wanted else policy.trigger_activate
            assert change() == TransitionCallbackReturn.SUCCESS

    rig.obeys = False
    live.graph.until(lambda: rig.target is not None)
    assert not policy.source._turns.cameras_stand
    # Half of the way is behind them.
    rig.episode.move(0.5 * (rig.target - rig.positions)[:, :2])
    here = rig.positions.copy()
    live.wait(0.25)
    stop(True)
    live.graph.until(lambda: np.allclose(rig.target, here, atol=1e-6))
    commands, turns = len(rig.commands), counted(policy, 'turns_answered')
    live.wait(0.3)
    assert len(rig.commands) == commands and status(policy)[1] in ('paused', 'inactive')
    stop(False)
    live.graph.until(lambda: not np.allclose(rig.target, here, atol=1e-6))
    rig.obeys = True
    rig.go()
    live.wait_for_turns(turns + 1)


SEED = 501
TRUE = np.array([0.4, 0.5, 2.2, 0.7, 0.4, 0.0])
#: Metres that the camera is said to be away from where it is.
AWAY = np.array([0.06, -0.03, 0.02])


def hang_elsewhere(probe, shown):
    """Start a camera that sends each of some clouds for a second; it is said to hang elsewhere."""
    poses = probe.node.create_publisher(PoseArray, topics.CAMERA_POSES, qos.LOOP)
    clouds = probe.node.create_publisher(PointCloud2, 'points_0', qos.SENSOR)
    stamps = count(1000 * S, S // 20)

    def send():
        stamp = next(stamps)
        poses.publish(positions_to_msg(
            (TRUE[:3] + AWAY)[None], header_at(stamp), TRUE[None, 3:]))
        cloud = shown[stamp // S % len(shown)]
        clouds.publish(cloud_to_msg(cloud, header_at(stamp, OPTICAL.format(0))))

    probe.node.create_timer(0.05, send)


def calibrated(probe, holds):
    """Call the service, which may be too early, until its answer is as expected; return it."""
    answers = []

    def answered():
        answers.append(probe.call(Trigger, '/policy_node/calibrate'))
        return holds(answers[-1])

    probe.graph.until(answered)
    return answers[-1]


def test_the_service_says_where_a_camera_hangs_and_drift_is_a_warning(graph, probe, tmp_path):
    rays = MeshRays(mesh_of(plan_of(SEED)))
    seen = steady_cloud(cast(rays, Pose.of(TRUE), 'realsense_d455', frames=6))[::2]
    hang_elsewhere(probe, [seen @ OPTICAL_TO_BODY])
    scan = tmp_path / 'room.ply'
    scan.write_text('no scan')
    node = graph.add(PolicyNode, planner='lookahead', cloud_topics='points_0', turns=1,
                     max_range=6.0, arrival_timeout=0.1, scan=str(scan),
                     placement_file=str(tmp_path / 'placement.yaml'))
    assert not calibrated(probe, lambda answer: 'room.ply' in answer.message).success
    # A broken scan has ended nothing, and can be mended.
    save_scene(generate_room(SEED, 40_000), scan)
    answer = calibrated(probe, lambda answer: answer.success)
    line, wrote = answer.message.splitlines()
    assert abs(float(line.split()[1]) - np.linalg.norm(AWAY)) < 0.01
    built = load_placement(tmp_path / 'placement_as_built.yaml')
    assert str(tmp_path / 'placement_as_built.yaml') in wrote
    assert np.linalg.norm(np.array(built.cameras[0].position) - TRUE[:3]) < 0.01
    # Turns go on.
    turns = counted(node, 'turns_answered')
    graph.until(lambda: counted(node, 'turns_answered') > turns)
    assert node.set_parameters([Parameter('drift_seconds', value=0.5)])[0].successful
    graph.until(lambda: counted(node, 'drift_checks'))
    level, message, _ = status(node)
    assert level == DiagnosticStatus.WARN and 'camera_0 hangs 0.0' in message


def test_a_camera_that_moves_while_the_node_is_off_is_named_with_its_new_pose(
        graph, probe, tmp_path):
    rays = MeshRays(mesh_of(plan_of(SEED)))
    turned = [TRUE + [0.0, 0.0, 0.0, np.deg2rad(degrees), 0.0, 0.0] for degrees in (0.0, 2.0)]
    before, after = (cast(rays, Pose.of(pose), 'realsense_d455', rng=np.random.default_rng(seed),
                          device=0)[0][::4] @ OPTICAL_TO_BODY for seed, pose in enumerate(turned))
    shown = [before]
    hang_elsewhere(probe, shown)
    start = partial(graph.add, PolicyNode, planner='lookahead', cloud_topics='points_0', turns=1,
                    max_range=6.0, arrival_timeout=0.1, drift_seconds=0.5,
                    placement_file=str(tmp_path / 'placement.yaml'))
    node = start()
    graph.until(lambda: counted(node, 'drift_checks') > 1)
    assert status(node)[0] == DiagnosticStatus.OK and counted(node, 'moved_cameras') == '{}'
    graph.remove(node)
    shown[:] = [after]
    node = start()
    graph.until(lambda: counted(node, 'drift_checks'))
    assert re.search(r'turn it (1\.[89]|2\.[012]) degrees to the right', status(node)[1])
    pose = json.loads(counted(node, 'moved_cameras'))['camera_0']
    assert pose['yaw'] == pytest.approx(np.rad2deg(TRUE[3]) + 2.0, abs=0.25)
    np.testing.assert_allclose(pose['position'], TRUE[:3] + AWAY, atol=0.01)
    assert f'{pose["position"][0]:.3f}' in status(node)[1]
    # It is put back. Until then, some of the last ten clouds are of before.
    shown[:] = [before]
    graph.until(lambda: status(node)[0] == DiagnosticStatus.OK)
    # It moves to and fro.
    shown[:] = [before, after]
    assert node.set_parameters([Parameter('drift_seconds', value=0.0)])[0].successful
    answer = calibrated(probe, lambda answer: 'does not move' in answer.message)
    assert not answer.success and re.search(r'camera_0: found that .* cloud \d', answer.message)


def test_recorded_topics_are_those_of_cameras_by_name_or_in_order():
    for given, found in (
            (['/door/p', '/shelf/p'], {'door': '/door/p', 'shelf': '/shelf/p'}),
            (['/b', '/a'], {'door': '/b', 'shelf': '/a'}),
            (['/a/door', '/x'], {'door': '/a/door'})):
        assert topics_of_cameras('a.bag', ['door', 'shelf'], given) == found
    with pytest.raises(ConfigurationError, match='3 topics .* 2 cameras'):
        topics_of_cameras('a.bag', ['door', 'shelf'], ['/a', '/b', '/c'])
