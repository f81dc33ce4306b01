# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several policies on one topic: the first commands, the others hold still and say so."""

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='node tests need ROS 2 (rclpy)')

from geometry_msgs.msg import PoseArray
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header, String

from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import (
    cloud_to_msg,
    ns_to_stamp,
    positions_to_msg,
    stamp_to_ns,
)
from ocp_ros.ros.policy import arbitration
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.ros.runtime import diagnostics
from ocp_ros.ros.sim_node import SimNode

SMALL = {'scene__points': 2000, 'engine__preset': 'fast', 'engine__error_rows': 32,
         'engine__coverage_cell': 0.5, 'resend_period': 0.05, 'auto_reset': True}


@pytest.fixture
def hurried(monkeypatch):
    """Let who falls silent be forgotten soon."""
    monkeypatch.setattr(arbitration, 'PERIOD', 0.1)
    monkeypatch.setattr(arbitration, 'EXPIRY', 2.0)


def test_the_second_policy_refuses_and_takes_over_when_the_first_ends(graph, hurried, capfd):
    sim = graph.add(SimNode, **SMALL)
    first = graph.add(PolicyNode)
    graph.until(lambda: first._counts['turns_answered'] >= 1)
    second = graph.add(PolicyNode)
    graph.until(lambda: second._commander.first)
    level, words, _ = second._status()
    assert level == diagnostics.WARN
    assert 'found /policy_node, which commands these cameras' in words
    assert first._status()[0] == diagnostics.OK
    answered = first._counts['turns_answered']
    graph.until(lambda: first._counts['turns_answered'] >= answered + 3)
    assert second._counts['turns_answered'] == 0
    assert 'expected one policy; this one holds still' in capfd.readouterr().err
    graph.remove(first)
    graph.until(lambda: second._counts['turns_answered'] >= 2)
    assert sim._counts['refused_commands'] == 0 and not second._commander.wrong()


def test_a_live_policy_that_is_not_the_first_sends_nothing(graph, probe, room, hurried):
    first = graph.add(PolicyNode)
    second = graph.add(PolicyNode, cloud_topics='points')
    graph.until(lambda: second._commander.first)
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
    assert not second._counts['turns_answered'] and not probe.received[topics.CAMERA_COMMANDS]
    # What it has seen while it waited is long ago when it takes over.
    graph.until(lambda: not second._live._turns.due())
    graph.remove(first)
    graph.until(lambda: not second._commander.first)
    send(1000)
    graph.until(lambda: second._counts['turns_answered'] == 1)
    command = probe.last(topics.CAMERA_COMMANDS)
    assert len(command.poses) == 2 and stamp_to_ns(command.header.stamp) == 1000


def test_words_that_are_none_are_nobody(graph, probe):
    policy = graph.add(PolicyNode)
    words = probe.publisher(String, topics.COMMANDERS, qos.LOOP)
    for text in ('', ' ', '0 0 /x', f'{0:020}', f'{0:020} short /x', f'{0:019}x 12345678 /x',
                 '\0' * 40, 'é' * 20 + ' 12345678 /x'):
        words.publish(String(data=text))
    words.publish(String(data=f'{1 << 62:020} 12345678 /late'))
    graph.until(lambda: policy._commander._others)
    assert list(policy._commander._others) == [f'{1 << 62:020} 12345678']
    assert not policy._commander.first


def test_all_agree_whoever_hears_whom_first(graph):
    nodes = [graph.add(PolicyNode) for _ in range(3)]
    graph.until(lambda: all(len(node._commander._others) == 2 for node in nodes))
    assert [bool(node._commander.first) for node in nodes] == [False, True, True]


def test_a_node_that_thinks_goes_on_saying_that_it_is_there(graph, probe, monkeypatch):
    """Its executor gets round to nothing meanwhile."""
    monkeypatch.setattr(arbitration, 'PERIOD', 0.02)
    probe.listen(String, topics.COMMANDERS, qos.LOOP)
    words = probe.received[topics.COMMANDERS]
    thinks = PolicyNode(context=graph.context)
    thread = thinks._commander._thread
    try:
        count = len(words)
        graph.until(lambda: len(words) >= count + 5)
    finally:
        thinks.destroy_node()
    assert not thread.is_alive()


def test_two_simulations_on_the_same_topics_are_noticed(graph, probe, capfd):
    sim, policy = graph.add(SimNode, **SMALL), graph.add(PolicyNode)
    graph.until(lambda: policy.count_publishers('/observation') == 1)
    assert (sim._status()[0], policy._status()[0]) == (diagnostics.OK, diagnostics.OK)
    other = probe.node.create_publisher(PointCloud2, topics.OBSERVATION, qos.LOOP)
    for node in (sim, policy):
        graph.until(lambda one=node: one._status()[0] == diagnostics.WARN)
        assert 'found 2 nodes that publish observation; expected one' in node._status()[1]
    assert 'give each its own namespace' in capfd.readouterr().err
    probe.node.destroy_publisher(other)
    graph.until(lambda: policy._status()[0] == diagnostics.OK)
