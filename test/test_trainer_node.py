# SPDX-License-Identifier: Apache-2.0
"""``trainer_node`` on real DDS, and the loop of all three nodes."""

import threading

from conftest import random_checkpoint
import numpy as np
import pytest
from test_training import transition

pytest.importorskip('rclpy', reason='node tests need ROS 2 (rclpy)')

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64MultiArray, Header, UInt8MultiArray

from ocp_ros.agent.checkpoint import Checkpoint, CheckpointError
from ocp_ros.nodes import qos, topics
from ocp_ros.nodes.conversions import (
    cloud_to_msg,
    fields_to_msg,
    msg_to_bytes,
    ns_to_stamp,
    positions_to_msg,
)
from ocp_ros.nodes.policy_node import PolicyNode
from ocp_ros.nodes.sim_node import SimNode
from ocp_ros.nodes.trainer_node import TrainerNode

SIM = {'scene__points': 2000, 'engine__preset': 'fast', 'engine__error_rows': 32,
       'engine__coverage_cell': 0.5}
AGENT = {'agent__points': 64, 'agent__keys_1': 8, 'agent__group_1': 4, 'agent__keys_2': 4,
         'agent__group_2': 4, 'agent__channels': 8, 'agent__hidden': 16}
SAC = {'sac__learning_starts': 12, 'sac__batch_size': 8, 'sac__buffer_size': 400,
       'sac__device': 'cpu', 'publish_every': 8, 'save_every': 8}
POSITIONS = np.array([[4.0, 4.0, 1.9], [5.0, 4.0, 1.9]])


@pytest.fixture
def start(graph, tmp_path):
    """Return a function that starts a trainer of small networks."""
    def starter(**parameters):
        return graph.add(TrainerNode, folder=str(tmp_path / 'run'), **{
            **AGENT, **SAC, **parameters})
    return starter


@pytest.fixture
def topics_of_a_loop(probe, start, room):
    """Return the probe with publishers for the parts of a transition."""
    probe.trainer = start(cameras=2)
    clouds = probe.publisher(PointCloud2, topics.OBSERVATION, qos.LOOP)
    poses = probe.publisher(PoseArray, topics.CAMERA_POSES, qos.LOOP)
    commands = probe.publisher(PoseArray, topics.CAMERA_COMMANDS, qos.LOOP)
    rewards = probe.publisher(Float64MultiArray, topics.REWARD, qos.LOOP)

    def header(stamp):
        return Header(stamp=ns_to_stamp(stamp), frame_id='map')

    def reward(previous, stamp, step=1.0):
        values = dict.fromkeys(topics.REWARD_FIELDS, 0.0)
        values |= {'previous_nanosec': previous, 'stamp_nanosec': stamp, 'step': step,
                   'reward': 0.5}
        rewards.publish(fields_to_msg(values))

    probe.cloud = lambda stamp: clouds.publish(cloud_to_msg(room.points, header(stamp)))
    probe.pose = lambda stamp, at=POSITIONS: poses.publish(positions_to_msg(at, header(stamp)))
    probe.command = lambda stamp: commands.publish(positions_to_msg(POSITIONS, header(stamp)))
    probe.reward = reward
    return probe


def test_a_transition_is_assembled_by_stamp(topics_of_a_loop):
    loop, trainer = topics_of_a_loop, topics_of_a_loop.trainer
    loop.reward(1, 2)
    loop.command(1)
    for stamp in (2, 1):
        loop.cloud(stamp)
        loop.pose(stamp)
    loop.graph.until(lambda: trainer.assembler.assembled == 1)
    loop.graph.until(lambda: trainer.learner.transitions == 1)


def test_a_turn_without_its_command_is_no_transition(topics_of_a_loop):
    loop, trainer = topics_of_a_loop, topics_of_a_loop.trainer
    trainer.assembler.patience = 2
    for stamp in range(1, 6):
        loop.cloud(stamp)
        loop.pose(stamp)
        loop.reward(stamp - 1, stamp)
    loop.graph.until(lambda: trainer.assembler.incomplete >= 3)
    assert trainer.assembler.assembled == 0


def test_malformed_parts_are_refused_and_the_node_lives(topics_of_a_loop):
    loop, trainer = topics_of_a_loop, topics_of_a_loop.trainer
    loop.pose(1, POSITIONS[:1])
    loop.graph.until(lambda: trainer._refused == 1)
    loop.pose(2, np.full((2, 3), np.nan))
    loop.graph.until(lambda: trainer._refused == 2)
    loop.reward(np.nan, 3)
    loop.graph.until(lambda: trainer._refused == 3)
    test_a_transition_is_assembled_by_stamp(loop)


def test_weights_go_from_the_trainer_to_the_policy(graph, probe, start, small_agent, tmp_path):
    random_checkpoint(small_agent).save(tmp_path / 'm.safetensors')
    probe.listen(DiagnosticArray, '/diagnostics', 10)
    trainer = start(cameras=4)
    policy = graph.add(PolicyNode, model=str(tmp_path / 'm.safetensors'), explore=True)
    graph.add(SimNode, auto_reset=True, resend_period=0.1, episode__turns=5, **SIM)
    graph.until(lambda: policy._counts['weights_swapped'] >= 2, timeout=60.0)
    assert policy.policy.checkpoint.run == trainer.learner.run
    assert trainer.assembler.assembled >= 12
    assert trainer.assembler.inconsistent == 0 and trainer._refused == 0
    graph.until(lambda: any(
        status.name == '/trainer_node' and status.message == 'training'
        for message in probe.received['/diagnostics'] for status in message.status))
    graph.remove(trainer)
    saved = Checkpoint.load(tmp_path / 'run' / 'actor.safetensors')
    assert saved.updates == trainer.learner.updates > 0


def test_who_comes_late_gets_the_latest_weights(graph, probe, start):
    trainer = start(cameras=4)
    agent = trainer.config.agent
    for seed in range(30):
        trainer.learner.add(transition(agent, seed))
    graph.until(lambda: trainer._published >= 2, timeout=60.0)
    graph.until(lambda: trainer.learner.updates >= 16)
    probe.listen(UInt8MultiArray, topics.POLICY_WEIGHTS, qos.LATCHED)
    found = Checkpoint.from_bytes(msg_to_bytes(probe.last(topics.POLICY_WEIGHTS)))
    assert found.run == trainer.learner.run and found.updates >= 8


def test_messages_never_wait_for_a_gradient_step(topics_of_a_loop, monkeypatch):
    loop, trainer = topics_of_a_loop, topics_of_a_loop.trainer
    stuck, release = threading.Event(), threading.Event()

    def train(*arguments):
        stuck.set()
        release.wait(60.0)

    monkeypatch.setattr(trainer.learner.model, 'train', train)
    monkeypatch.setattr(trainer.learner, '_behind', lambda: not release.is_set())
    try:
        trainer.learner.add(transition(trainer.config.agent, cameras=2))
        assert stuck.wait(30.0)
        loop.command(1)
        for stamp in (1, 2):
            loop.cloud(stamp)
            loop.pose(stamp)
        loop.reward(1, 2)
        loop.graph.until(lambda: trainer.assembler.assembled == 1)
        assert trainer.learner.transitions == 1
    finally:
        release.set()


def test_a_trainer_starts_from_a_model_of_its_own_sizes(start):
    with pytest.raises(CheckpointError, match="expected the trainer's own agent settings"):
        start(model='default')
