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

"""Managed nodes send nothing before they are active, and can be put away and brought back."""

from conftest import SMALL, status
from geometry_msgs.msg import PoseArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.ros.sim_node import SimNode
import pytest
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

SIM = {**SMALL, 'resend_period': 0.1}
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
    """Wait until so many more messages have come."""
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


def test_a_policy_of_a_simulation_is_not_what_begins_anew(graph, manager):
    graph.add(PolicyNode, planner='lookahead')
    answer = manager.call(Trigger, 'policy_node/reset')
    assert not answer.success and 'sim_node' in answer.message
