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

"""Several policies on one topic: one commands, the others hold and say so."""

from conftest import counted, SMALL, status
from geometry_msgs.msg import PoseArray
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
from ocp_ros.ros.runtime import diagnostics
from ocp_ros.ros.sim_node import SimNode
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

SIM = {**SMALL, 'resend_period': 0.05, 'auto_reset': True}


def held(node):
    """Return whether a policy says that it holds."""
    level, words, _ = status(node)
    return level == diagnostics.WARN and 'this one holds' in words


def test_the_second_policy_holds_and_takes_over_when_the_first_ends(graph, capfd):
    sim = graph.add(SimNode, **SIM)
    first = graph.add(PolicyNode)
    graph.until(lambda: counted(first, 'turns_answered') >= 1)
    second = graph.add(PolicyNode)
    graph.until(lambda: held(second))
    assert '/camera_commands: /policy_node;' in status(second)[1]
    assert status(first)[0] == diagnostics.OK
    answered = counted(first, 'turns_answered')
    graph.until(lambda: counted(first, 'turns_answered') >= answered + 3)
    assert counted(second, 'turns_answered') == 0
    assert 'this one holds' in capfd.readouterr().err
    graph.remove(first)
    graph.until(lambda: counted(second, 'turns_answered') >= 2)
    assert counted(sim, 'refused_commands') == 0 and not held(second)


def test_a_live_policy_that_is_not_the_first_sends_nothing(graph, probe, room):
    first = graph.add(PolicyNode)
    graph.until(lambda: not first._waits())
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
        graph.until(lambda at=stamp: second._live._turns._heard.get('points') == at)
    assert not counted(second, 'turns_answered') and not probe.received[topics.CAMERA_COMMANDS]
    # What it has seen while it waited is long ago when it takes over.
    graph.until(lambda: not second._live._turns.due())
    graph.remove(first)
    graph.until(lambda: not second._waits())
    send(1000)
    graph.until(lambda: counted(second, 'turns_answered') == 1)
    command = probe.last(topics.CAMERA_COMMANDS)
    assert len(command.poses) == 2 and stamp_to_ns(command.header.stamp) == 1000


def test_a_policy_that_has_commanded_goes_on_beside_another_publisher(graph, probe):
    graph.add(SimNode, **SIM)
    policy = graph.add(PolicyNode)
    graph.until(lambda: counted(policy, 'turns_answered') >= 1)
    other = probe.node.create_publisher(PoseArray, topics.CAMERA_COMMANDS, qos.LOOP)
    graph.until(lambda: status(policy)[0] == diagnostics.WARN)
    assert '/camera_commands: /policy_node, /probe;' in status(policy)[1] and not held(policy)
    answered = counted(policy, 'turns_answered')
    graph.until(lambda: counted(policy, 'turns_answered') >= answered + 3)
    probe.node.destroy_publisher(other)
    graph.until(lambda: status(policy)[0] == diagnostics.OK)


def test_of_several_that_begin_at_once_one_commands(graph, monkeypatch):
    """Those that do not see each other in time give way, and look again."""
    with monkeypatch.context() as blind:
        blind.setattr(Commander, '_others', 0)
        nodes = [graph.add(PolicyNode) for _ in range(3)]
    assert nodes[0].count_publishers(topics.CAMERA_COMMANDS) == 3
    graph.until(lambda: sum(not node._waits() for node in nodes) == 1)
    graph.until(lambda: sum(held(node) for node in nodes) == 2)


def test_two_simulations_on_the_same_topics_are_noticed(graph, probe, capfd):
    sim, policy = graph.add(SimNode, **SIM), graph.add(PolicyNode)
    graph.until(lambda: policy.count_publishers('/observation') == 1)
    assert (status(sim)[0], status(policy)[0]) == (diagnostics.OK, diagnostics.OK)
    other = probe.node.create_publisher(PointCloud2, topics.OBSERVATION, qos.LOOP)
    for node in (sim, policy):
        graph.until(lambda one=node: status(one)[0] == diagnostics.WARN)
        assert 'observation: /probe, /sim_node;' in status(node)[1]
    assert 'namespace' in capfd.readouterr().err
    probe.node.destroy_publisher(other)
    graph.until(lambda: status(policy)[0] == diagnostics.OK)
