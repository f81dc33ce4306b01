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

"""Managed nodes: who commands, life cycles, and parameters that change while a node runs."""

from functools import partial
import gc

from conftest import box_sides, counted, header_at, SMALL, status
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
import numpy as np
from ocp_ros.geometry.cameras import angle_between
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import (
    cloud_to_msg,
    fields_to_msg,
    msg_to_poses,
    msg_to_positions,
    positions_to_msg,
    stamp_to_ns,
)
from ocp_ros.ros.policy.policy_config import PolicyNodeConfig
from ocp_ros.ros.policy.turn_source import Commander
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.ros.sim_node import SimNode, SimNodeConfig
from ocp_ros.util.settings import ConfigurationError, leaves
import pytest
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from scipy.spatial import cKDTree
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64MultiArray, Header, String
from std_srvs.srv import Trigger

SIM = {**SMALL, 'resend_period': 0.05, 'auto_reset': True}


def held(node):
    """Return whether a policy says that it holds."""
    level, words, _ = status(node)
    return level == DiagnosticStatus.WARN and 'this one holds' in words


def test_the_second_policy_holds_and_takes_over_when_the_first_ends(graph, probe, capfd):
    probe.listen(String, topics.PLACEMENT_STATUS, qos.LATCHED)
    sim = graph.add(SimNode, **SIM)
    first = graph.add(PolicyNode, planner='lookahead')
    graph.until(lambda: counted(first, 'turns_answered') >= 1)
    probe.received[topics.PLACEMENT_STATUS].clear()
    second = graph.add(PolicyNode, planner='lookahead')
    graph.until(lambda: held(second))
    # It says nothing of a placement that is not its own.
    graph.until(lambda: len(probe.received[topics.PLACEMENT_STATUS]) > 5)
    assert not any('turn 0' in text.data for text in probe.received[topics.PLACEMENT_STATUS])
    assert '/camera_commands: /policy_node;' in status(second)[1]
    assert status(first)[0] == DiagnosticStatus.OK
    answered = counted(first, 'turns_answered')
    graph.until(lambda: counted(first, 'turns_answered') >= answered + 3)
    assert counted(second, 'turns_answered') == 0
    assert 'this one holds' in capfd.readouterr().err
    graph.remove(first)
    graph.until(lambda: counted(second, 'turns_answered') >= 2)
    assert counted(sim, 'refused_commands') == 0 and not held(second)


def test_a_live_policy_that_is_not_the_first_sends_nothing(graph, probe, room):
    first = graph.add(PolicyNode, planner='lookahead')
    graph.until(lambda: not first.must_wait)
    second = graph.add(PolicyNode, planner='lookahead', cloud_topics='points')
    graph.until(lambda: held(second))
    probe.listen(PoseArray, topics.CAMERA_COMMANDS, qos.LOOP)
    poses = probe.publisher(PoseArray, topics.CAMERA_POSES, qos.LOOP)
    clouds = probe.publisher(PointCloud2, 'points', qos.LOOP)

    def send(stamp):
        poses.publish(positions_to_msg(
            np.array([[4.0, 4.0, 1.9], [5.0, 4.0, 1.9]]), header_at(stamp)))
        clouds.publish(cloud_to_msg(room.points, header_at(stamp)))

    for stamp in (10, 11, 12):
        send(stamp)
        graph.until(lambda at=stamp: second.source._turns._newest_stamps.get('points') == at)
    assert not counted(second, 'turns_answered') and not probe.received[topics.CAMERA_COMMANDS]
    # What it has seen while it waited is long ago when it takes over.
    graph.until(lambda: not second.source._turns.is_due())
    graph.remove(first)
    graph.until(lambda: not second.must_wait)
    send(1000)
    graph.until(lambda: counted(second, 'turns_answered') == 1)
    command = probe.last(topics.CAMERA_COMMANDS)
    assert len(command.poses) == 2 and stamp_to_ns(command.header.stamp) == 1000


def test_others_on_the_same_topics_are_noticed_and_commands_go_on(graph, probe, capfd):
    sim, policy = graph.add(SimNode, **SIM), graph.add(PolicyNode, planner='lookahead')

    def goes_on():
        answered = counted(policy, 'turns_answered')
        graph.until(lambda: counted(policy, 'turns_answered') >= answered + 3)
        return (status(sim)[0], status(policy)[0]) == (DiagnosticStatus.OK, DiagnosticStatus.OK)

    assert goes_on()
    other = probe.node.create_publisher(PoseArray, topics.CAMERA_COMMANDS, qos.LOOP)
    graph.until(lambda: status(policy)[0] == DiagnosticStatus.WARN)
    assert '/camera_commands: /policy_node, /probe;' in status(policy)[1] and not held(policy)
    assert not goes_on()
    probe.node.destroy_publisher(other)
    graph.until(goes_on)
    # Two simulations.
    other = probe.node.create_publisher(PointCloud2, topics.OBSERVATION, qos.LOOP)
    for node in (sim, policy):
        graph.until(lambda one=node: status(one)[0] == DiagnosticStatus.WARN)
        assert 'observation: /probe, /sim_node;' in status(node)[1]
    assert 'namespace' in capfd.readouterr().err
    probe.node.destroy_publisher(other)
    graph.until(lambda: status(policy)[0] == DiagnosticStatus.OK)


def test_of_several_that_begin_at_once_one_commands(graph, monkeypatch):
    """Those that do not see each other in time give way, and look again."""
    with monkeypatch.context() as blind:
        blind.setattr(Commander, '_rival_count', 0)
        nodes = [graph.add(PolicyNode, planner='lookahead') for _ in range(3)]
    assert nodes[0].count_publishers(topics.CAMERA_COMMANDS) == 3
    graph.until(lambda: sum(not node.must_wait for node in nodes) == 1)
    graph.until(lambda: sum(held(node) for node in nodes) == 2)


CONFIGURE, ACTIVATE, DEACTIVATE, CLEANUP, SHUTDOWN = (
    Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE,
    Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP,
    Transition.TRANSITION_ACTIVE_SHUTDOWN)


@pytest.fixture
def manager(graph, probe):
    """Return the probe as who manages life cycles."""
    probe.listen(PoseArray, topics.CAMERA_COMMANDS, qos.LOOP)
    probe.listen(PointCloud2, topics.OBSERVATION, qos.LOOP)

    def change(name, transition):
        lost = probe.lost_answers
        answer = probe.call(ChangeState, f'{name}/change_state',
                            transition=Transition(id=transition))
        # If the answer got lost, the second one refuses what is done already.
        return answer.success or (probe.lost_answers > lost
                                  and probe.state(name) in ('active', 'inactive', 'unconfigured'))

    probe.change = change
    probe.state = lambda name: probe.call(GetState, f'{name}/get_state').current_state.label
    return probe


def hears(manager, topic, times=3):
    """Wait until this number of further messages has come."""
    count = len(manager.received[topic])
    manager.graph.until(lambda: len(manager.received[topic]) >= count + times)


def test_nothing_is_commanded_before_somebody_says_so(graph, manager):
    graph.add(SimNode, **SIM)
    policy = graph.add(PolicyNode, planner='lookahead', turns=100, autostart=False)
    hears(manager, topics.OBSERVATION)
    assert manager.state('policy_node') == 'unconfigured'
    assert manager.node.count_publishers(topics.CAMERA_COMMANDS) == 0
    assert manager.change('policy_node', CONFIGURE)
    hears(manager, topics.OBSERVATION, 5)
    assert not manager.received[topics.CAMERA_COMMANDS] and status(policy)[1] == 'inactive'
    # A node that commands nothing keeps no other one from it.
    assert manager.node.count_publishers(topics.CAMERA_COMMANDS) == 0
    assert manager.change('policy_node', ACTIVATE)
    hears(manager, topics.CAMERA_COMMANDS)


def test_a_node_is_put_away_and_brought_back(graph, manager):
    sim = graph.add(SimNode, **SIM)
    policy = graph.add(PolicyNode, planner='lookahead', turns=100)
    hears(manager, topics.CAMERA_COMMANDS)
    assert manager.state('sim_node') == manager.state('policy_node') == 'active'
    assert manager.change('policy_node', DEACTIVATE)

    def quiet():
        count = len(manager.received[topics.CAMERA_COMMANDS])
        hears(manager, topics.OBSERVATION, 5)
        return len(manager.received[topics.CAMERA_COMMANDS]) == count

    # Commands that were sent before may still be on their way.
    assert quiet() or quiet() or quiet()
    assert manager.node.count_publishers(topics.CAMERA_COMMANDS) == 0
    assert manager.change('policy_node', CLEANUP)
    assert not policy.configured
    assert not {one.topic_name for one in policy.publishers} & {'/camera_commands', '/placement'}
    # Parameters that are read once can be changed now.
    assert policy.set_parameters([Parameter('seed', value=7)])[0].successful
    assert manager.change('policy_node', CONFIGURE) and manager.change('policy_node', ACTIVATE)
    assert policy.config.seed == 7
    hears(manager, topics.CAMERA_COMMANDS)
    assert manager.change('sim_node', DEACTIVATE)
    step = sim.episode.turn.step
    for _ in range(20):
        graph.executor.spin_once(timeout_sec=0.02)
    assert sim.episode.turn.step == step
    assert not manager.call(Trigger, 'sim_node/reset').success
    assert manager.change('sim_node', ACTIVATE)
    graph.until(lambda: sim.episode.turn.step > step)
    assert manager.change('sim_node', SHUTDOWN) and manager.state('sim_node') == 'finalized'


def test_what_cannot_be_asked_of_a_policy_ends_no_node(graph, manager, capfd):
    graph.add(PolicyNode, planner='lookahead')
    for transition in (ACTIVATE, CLEANUP, 77):
        assert not manager.change('policy_node', transition)
    assert manager.state('policy_node') == 'active'
    assert 'transition 77' in capfd.readouterr().err
    # The turns of a simulation begin anew where they come from.
    answer = manager.call(Trigger, 'policy_node/reset')
    assert not answer.success and 'sim_node' in answer.message


@pytest.mark.parametrize('autostart', [True, False])
def test_defaults_suit_what_is_given_when_a_node_is_configured(
        graph, manager, tmp_path, autostart):
    path = tmp_path / 'rig.yaml'
    path.write_text('cameras: [{sensor: omnidirectional, count: 3}]\nmotion: {max_step: 0.7}')

    def configured_again(**values):
        if policy.configured:
            manager.change('policy_node', DEACTIVATE)
            assert manager.change('policy_node', CLEANUP)
        assert all(result.successful for result in policy.set_parameters(
            [Parameter(name, value=value) for name, value in values.items()]))
        assert manager.change('policy_node', CONFIGURE)
        return [policy.config.turns, policy.config.max_step, policy.config.max_turn]

    policy = graph.add(PolicyNode, planner='lookahead', autostart=autostart)
    assert configured_again() == [30, 0.5, 0.5]
    assert configured_again(cloud_topics='points') == [12, 1.5, 1.6]
    assert configured_again(rig_file=str(path)) == [12, 0.7, 1.6]
    # What a person has set stays.
    assert configured_again(rig_file='', turns=12) == [12, 1.5, 1.6]
    assert configured_again(cloud_topics='') == [12, 0.5, 0.5]


@pytest.mark.parametrize('autostart', [True, False])
def test_a_node_that_cannot_be_configured_says_why_and_tries_again(
        graph, manager, capfd, autostart):
    policy = graph.add(PolicyNode, planner='lookahead', autostart=autostart)
    if autostart:
        assert manager.change('policy_node', DEACTIVATE) and manager.change('policy_node', CLEANUP)
    policy.set_parameters([Parameter('planner', value='learned'),
                           Parameter('model', value='nowhere')])
    assert not manager.change('policy_node', CONFIGURE)
    assert "'nowhere'" in capfd.readouterr().err
    assert manager.state('policy_node') == 'unconfigured'
    assert policy.set_parameters([Parameter('planner', value='lookahead')])[0].successful
    assert manager.change('policy_node', CONFIGURE) and manager.change('policy_node', ACTIVATE)


def test_a_node_that_has_ended_leaves_the_graph_at_once(graph, manager):
    """Also while Python collects no garbage: what it is collected beside would be disturbed."""
    def known():
        return ('policy_node', '/ended') in manager.node.get_node_names_and_namespaces()

    gc.disable()
    try:
        policy = graph.add(partial(PolicyNode, namespace='ended'), planner='lookahead')
        graph.until(known)
        graph.remove(policy)
        graph.until(lambda: not known(), timeout=15.0)
    finally:
        gc.enable()


POSITIONS = np.array([[2.0, 2.0, 1.9], [3.0, 2.0, 1.9], [2.0, 3.0, 1.9]])
#: The floor, ceiling and walls of an empty room.
CLOUD = box_sides(np.array([6.0, 4.0, 2.8]), np.array([3.0, 2.0, 1.4]), 0.2).astype(np.float32)


@pytest.fixture
def change(probe):
    """Return what sets parameters of a node over a service and returns why not, if not."""
    def set_all(node, together=False, **values):
        parameters = [Parameter(name.replace('__', '.'), value=value).to_parameter_msg()
                      for name, value in values.items()]
        kind, name = (SetParametersAtomically, 'set_parameters_atomically') if together else (
            SetParameters, 'set_parameters')
        answer = probe.call(kind, f'/{node.get_name()}/{name}', parameters=parameters)
        results = [answer.result] if together else answer.results
        return '; '.join(result.reason for result in results if not result.successful)

    return set_all


@pytest.fixture
def robot(probe):
    """Return the probe as a rig that sends turns and hears commands."""
    probe.listen(PoseArray, topics.PLACEMENT, qos.LATCHED)
    probe.listen(String, topics.PLACEMENT_STATUS, qos.LATCHED)

    def turn(stamp, positions=POSITIONS):
        probe.send_turn(stamp, CLOUD, positions_to_msg(positions, Header()))
        return msg_to_positions(probe.command(stamp))

    def until_status(*words):
        probe.graph.until(lambda: all(
            word in probe.last(topics.PLACEMENT_STATUS).data for word in words))

    probe.turn, probe.until_status = turn, until_status
    return probe


def test_parameters_that_are_changed_hold_from_the_next_turn_on(robot, change, monkeypatch):
    policy = robot.start_policy(planner='lookahead', max_step=0.5, turns=30)
    far = np.full((3, 2), 0.3)
    monkeypatch.setattr(type(policy.planner), 'move', lambda *turn: far)
    # Places are a micrometre inside the cells of the floor.
    for stamp, step, expected in ((1, 0.5, np.hypot(0.3, 0.3)), (2, 0.1, 0.1)):
        assert change(policy, max_step=step) == ''
        moved = np.linalg.norm(robot.turn(stamp) - POSITIONS, axis=1)
        assert moved.max() == pytest.approx(expected, abs=1e-5)
    # Fewer turns make a placement final, and it is said why.
    assert change(policy, turns=2) == ''
    robot.turn(3)
    assert stamp_to_ns(robot.last(topics.PLACEMENT).header.stamp) == 3
    robot.until_status('final after 2 turns', 'turns are used up')
    assert 'turns are used up' in counted(policy, 'final')


def test_the_status_tells_how_cameras_move_until_they_are_final(robot, monkeypatch):
    policy = robot.start_policy(turns=2)
    monkeypatch.setattr(type(policy.planner), 'move', lambda *turn: np.zeros((3, 2)))
    robot.turn(1)
    robot.until_status('turn 1 of 2', 'longest move 0.000 m')
    for stamp in (2, 3):
        robot.turn(stamp)
    robot.until_status('final after 2 turns', 'turns are used up')
    # A subscriber that comes late gets it too, and a new episode takes it back.
    robot.listen(String, topics.PLACEMENT_STATUS, qos.LATCHED)
    assert robot.last(topics.PLACEMENT_STATUS).data.startswith('final after 2 turns')
    robot.publisher(Float64MultiArray, topics.REWARD, qos.LOOP).publish(fields_to_msg({
        'stamp_sec': 0, 'stamp_nanosec': 4, 'episode': 5, 'step': 0, 'truncated': False}))
    robot.turn(4)
    robot.until_status('turn 1 of 2')


def test_what_cannot_be_changed_is_refused_with_a_reason(graph, change):
    policy = graph.add(PolicyNode, planner='lookahead')
    before = policy.config
    for values, words in (
            ({'planner': 'learned'}, 'planner'), ({'rig_file': 'rig.yaml'}, 'rig_file'),
            ({'turns': 0}, 'turns out of range'), ({'max_step': 99.0}, 'max_step out of range'),
            ({'max_step': 1}, 'Wrong parameter type'), ({'min_range': 5.0}, 'min_range')):
        assert words in change(policy, **values)
        assert policy.config is before
        assert all(policy.get_parameter(name).value == getattr(before, name) for name in values)
    # Some go together, and then it is all or none.
    assert change(policy, together=True, min_range=5.0, max_range=8.0) == ''
    assert (policy.config.min_range, policy.config.max_range) == (5.0, 8.0)
    answer = change(policy, together=True, turns=7, seed=5)
    assert all(word in answer for word in ('read once', 'cleanup', 'configure'))
    assert policy.config.turns == policy.get_parameter('turns').value == 30


def test_live_turns_follow(graph, change):
    policy = graph.add(PolicyNode, planner='lookahead', cloud_topics='points')
    assert change(policy, arrival_distance=0.2, arrival_timeout=3.0, cloud_timeout=1.0,
                  turn_seconds=4.0, min_range=0.4) == ''
    assert policy.source._turns.limits[:4] == (0.2, 3.0, 1.0, 4.0)
    assert policy.config.min_range == 0.4


def test_a_simulation_follows(graph, probe, change):
    probe.listen(PoseArray, topics.CAMERA_POSES, qos.LOOP)
    sim = graph.add(SimNode, resend_period=60.0, **SMALL)
    assert change(sim, resend_period=0.05) == ''
    resent = counted(sim, 'resent_turns')
    graph.until(lambda: counted(sim, 'resent_turns') > resent + 2)
    assert change(sim, episode__turns=1, episode__max_step=0.2, auto_reset=True) == ''
    commands = probe.publisher(PoseArray, topics.CAMERA_COMMANDS, qos.LOOP)
    episode, played = sim.episode, []
    first, move = episode.turn.positions, episode.move
    episode.move = lambda *moves: played.append(move(*moves)) or played[-1]
    header = probe.last(topics.CAMERA_POSES).header
    commands.publish(positions_to_msg(first + [1.0, 0.0, 0.0], header))
    graph.until(lambda: sim.episode is not episode)
    assert np.abs(played[0].positions - first).max() <= 0.2 + 1e-9
    assert 'rig.cameras' in change(sim, rig__cameras=2)


def test_each_parameter_says_what_it_is_and_whether_it_can_be_changed(graph):
    for kind, cls in ((SimNode, SimNodeConfig), (PolicyNode, PolicyNodeConfig)):
        node = graph.add(kind, **(SMALL if kind is SimNode else {}))
        for name, item in leaves(cls).items():
            descriptor = node.describe_parameter(name)
            assert len(descriptor.description) > 5, name
            assert ('read once' in descriptor.additional_constraints) != item.metadata['running']


def rig_file(tmp_path, text):
    """Write a rig file and return its path."""
    (tmp_path / 'rig.yaml').write_text(text)
    return str(tmp_path / 'rig.yaml')


def test_commands_are_held_to_a_rig_file(robot, tmp_path, monkeypatch):
    """Cameras that are sent to and fro by no planner at all keep out of where they must not be."""
    policy = robot.start_policy(planner='lookahead', turns=1000, max_step=0.5, rig_file=rig_file(
        tmp_path, """
        cameras: [{sensor: omnidirectional, count: 2}]
        fixed: [{sensor: omnidirectional, position: [3.0, 2.0, 1.9]}]
        mount: {on: plane, height: 1.9}
        keep_clear: 0.4
        spacing: 0.7
        keep_out: [{box: [[3.5, 0.0, 0.0], [4.5, 4.0, 3.0]]}]"""))
    rng = np.random.default_rng(0)
    monkeypatch.setattr(policy.planner, 'move', lambda *turn: rng.normal(0.0, 0.5, (2, 2)))
    positions = np.array([[1.5, 1.0, 1.9], [1.5, 3.0, 1.9], [3.0, 2.0, 1.9]])
    for stamp in range(1, 13):
        found = robot.turn(stamp, positions)
        assert np.linalg.norm(found - positions, axis=1).max() <= 0.5 + 1e-6
        np.testing.assert_array_equal(found[2], positions[2])
        apart = np.linalg.norm(found[:, None] - found, axis=2)[np.triu_indices(3, 1)]
        assert apart.min() >= 0.7 - 1e-6
        assert not ((found[:2, 0] >= 3.5) & (found[:2, 0] <= 4.5)).any()
        assert cKDTree(CLOUD).query(found[:2])[0].min() >= 0.399
        positions = found
    assert not policy.decider.stay_warnings


def test_cameras_are_turned_as_far_as_they_may_be_while_the_node_runs(robot, tmp_path, change):
    policy = robot.start_policy(planner='lookahead', turns=1000, rig_file=rig_file(
        tmp_path, 'cameras: [{sensor: realsense_d455, count: 3}]'))
    assert 'max_turn' in change(policy, max_turn=4.0) and policy.config.max_turn == 1.6
    # All three look the same way, so there is much to turn for.
    for stamp, most in ((1, 0.5), (2, 0.2), (3, 0.0), (4, 3.0)):
        assert change(policy, max_turn=most) == ''
        robot.turn(stamp)
        command = robot.received[topics.CAMERA_COMMANDS][-1]
        widest = max(angle_between(pose.rotation, np.eye(3)) for pose in msg_to_poses(command))
        assert widest <= most + 1e-9 and (widest > 0.0) == (most > 0.0)
    assert widest > 0.5


def test_another_rig_is_refused_and_a_camera_that_may_go_nowhere_is_a_warning(
        robot, tmp_path, capfd):
    policy = robot.start_policy(planner='lookahead', rig_file=rig_file(tmp_path, """
        cameras: [{sensor: omnidirectional, count: 3}]
        keep_out: [{box: [[0, 0, 0], [6, 4, 3]]}]"""))
    robot.send_turn(1, CLOUD, positions_to_msg(POSITIONS[:2], Header()))
    robot.graph.until(lambda: counted(policy, 'refused_messages') >= 1)
    assert 'poses: found 2 cameras; expected 3' in capfd.readouterr().err
    np.testing.assert_array_equal(robot.turn(2), POSITIONS)
    level, message, _ = status(policy)
    assert level == DiagnosticStatus.WARN and 'omnidirectional_1 stays at' in message


def test_a_planner_has_the_range_of_the_rig_file_also_after_a_change(graph, tmp_path, change):
    policy = graph.add(PolicyNode, planner='lookahead', rig_file=rig_file(
        tmp_path, 'cameras: [{sensor: omnidirectional, max_range: 6.0, count: 3}]'))
    assert policy.planner.max_range == 6.0
    assert change(policy, max_step=0.3) == ''
    assert (policy.planner.max_step, policy.planner.max_range) == (0.3, 6.0)


def test_quality_of_service_follows_parameters_also_when_configured_again(graph):
    name = 'qos_overrides./camera_commands.publisher.depth'
    policy = graph.add(PolicyNode, planner='lookahead', **{name: 3})

    def depth():
        return next(one.qos_profile.depth for one in policy.publishers
                    if one.topic_name == '/camera_commands')

    assert depth() == policy.get_parameter(name).value == 3 and qos.LOOP.depth == 10
    assert policy.has_parameter('qos_overrides./observation.subscription.reliability')
    for trigger in ('deactivate', 'cleanup', 'configure', 'activate'):
        getattr(policy, f'trigger_{trigger}')()
    assert depth() == 3
    assert status(policy)[0] == DiagnosticStatus.OK


def test_an_override_of_a_topic_that_no_node_has_is_a_warning(graph):
    policy = graph.add(PolicyNode, planner='lookahead', cloud_topics='points', **{
        'qos_overrides./pionts.subscription.depth': 3})
    level, message, _ = status(policy)
    assert level == DiagnosticStatus.WARN and '/pionts' in message and '/points' in message


def test_a_parameter_that_does_not_exist_is_refused(graph):
    with pytest.raises(ConfigurationError, match="'turnz'; did you mean 'turns'"):
        graph.add(PolicyNode, planner='lookahead', turnz=5)
