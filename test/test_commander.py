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

"""Who commands and when: one of several policies, and managed nodes while they are active."""

from conftest import counted, SMALL, status
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
import numpy as np
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import (
    cloud_to_msg,
    ns_to_stamp,
    positions_to_msg,
    stamp_to_ns,
)
from ocp_ros.ros.policy.commander import Commander
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.ros.sim_node import SimNode
import pytest
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import Trigger

SIM = {**SMALL, 'resend_period': 0.05, 'auto_reset': True}


def held(node):
    """Return whether a policy says that it holds."""
    level, words, _ = status(node)
    return level == DiagnosticStatus.WARN and 'this one holds' in words


def test_the_second_policy_holds_and_takes_over_when_the_first_ends(graph, capfd):
    sim = graph.add(SimNode, **SIM)
    first = graph.add(PolicyNode)
    graph.until(lambda: counted(first, 'turns_answered') >= 1)
    second = graph.add(PolicyNode)
    graph.until(lambda: held(second))
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
    first = graph.add(PolicyNode)
    graph.until(lambda: not first._must_wait())
    second = graph.add(PolicyNode, cloud_topics='points')
    graph.until(lambda: held(second))
    probe.listen(PoseArray, topics.CAMERA_COMMANDS, qos.LOOP)
    poses = probe.publisher(PoseArray, topics.CAMERA_POSES, qos.LOOP)
    clouds = probe.publisher(PointCloud2, 'points', qos.LOOP)

    def send(stamp):
        header = Header(stamp=ns_to_stamp(stamp), frame_id='map')
        poses.publish(positions_to_msg(np.array([[4.0, 4.0, 1.9], [5.0, 4.0, 1.9]]), header))
        clouds.publish(cloud_to_msg(room.points, header))

    for stamp in range(10, 15):
        send(stamp)
        graph.until(lambda at=stamp: second._live._turns._newest_stamps.get('points') == at)
    assert not counted(second, 'turns_answered') and not probe.received[topics.CAMERA_COMMANDS]
    # What it has seen while it waited is long ago when it takes over.
    graph.until(lambda: not second._live._turns.is_due())
    graph.remove(first)
    graph.until(lambda: not second._must_wait())
    send(1000)
    graph.until(lambda: counted(second, 'turns_answered') == 1)
    command = probe.last(topics.CAMERA_COMMANDS)
    assert len(command.poses) == 2 and stamp_to_ns(command.header.stamp) == 1000


def test_a_policy_that_has_commanded_goes_on_beside_another_publisher(graph, probe):
    graph.add(SimNode, **SIM)
    policy = graph.add(PolicyNode)
    graph.until(lambda: counted(policy, 'turns_answered') >= 1)
    other = probe.node.create_publisher(PoseArray, topics.CAMERA_COMMANDS, qos.LOOP)
    graph.until(lambda: status(policy)[0] == DiagnosticStatus.WARN)
    assert '/camera_commands: /policy_node, /probe;' in status(policy)[1] and not held(policy)
    answered = counted(policy, 'turns_answered')
    graph.until(lambda: counted(policy, 'turns_answered') >= answered + 3)
    probe.node.destroy_publisher(other)
    graph.until(lambda: status(policy)[0] == DiagnosticStatus.OK)


def test_of_several_that_begin_at_once_one_commands(graph, monkeypatch):
    """Those that do not see each other in time give way, and look again."""
    with monkeypatch.context() as blind:
        blind.setattr(Commander, '_rival_count', 0)
        nodes = [graph.add(PolicyNode) for _ in range(3)]
    assert nodes[0].count_publishers(topics.CAMERA_COMMANDS) == 3
    graph.until(lambda: sum(not node._must_wait() for node in nodes) == 1)
    graph.until(lambda: sum(held(node) for node in nodes) == 2)


def test_two_simulations_on_the_same_topics_are_noticed(graph, probe, capfd):
    sim, policy = graph.add(SimNode, **SIM), graph.add(PolicyNode)
    graph.until(lambda: policy.count_publishers('/observation') == 1)
    assert (status(sim)[0], status(policy)[0]) == (DiagnosticStatus.OK, DiagnosticStatus.OK)
    other = probe.node.create_publisher(PointCloud2, topics.OBSERVATION, qos.LOOP)
    for node in (sim, policy):
        graph.until(lambda one=node: status(one)[0] == DiagnosticStatus.WARN)
        assert 'observation: /probe, /sim_node;' in status(node)[1]
    assert 'namespace' in capfd.readouterr().err
    probe.node.destroy_publisher(other)
    graph.until(lambda: status(policy)[0] == DiagnosticStatus.OK)


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
        return probe.call(ChangeState, f'{name}/change_state',
                          transition=Transition(id=transition)).success

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


def test_a_transition_that_cannot_be_ends_no_node(graph, manager, capfd):
    graph.add(PolicyNode, planner='lookahead')
    for transition in (ACTIVATE, CLEANUP, 77):
        assert not manager.change('policy_node', transition)
    assert manager.state('policy_node') == 'active'
    assert 'transition 77' in capfd.readouterr().err


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


def test_a_policy_of_a_simulation_is_not_what_begins_anew(graph, manager):
    graph.add(PolicyNode, planner='lookahead')
    answer = manager.call(Trigger, 'policy_node/reset')
    assert not answer.success and 'sim_node' in answer.message
