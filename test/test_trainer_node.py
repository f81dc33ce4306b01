# SPDX-License-Identifier: Apache-2.0
"""``trainer_node`` on real DDS, and the loop of all three nodes."""

import threading

from conftest import assert_same, observation, random_checkpoint
import numpy as np
import pytest

pytest.importorskip('rclpy', reason='node tests need ROS 2 (rclpy)')

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64MultiArray, Header, UInt8MultiArray

from ocp_ros.agent.checkpoint import Checkpoint, CheckpointError
from ocp_ros.agent.config import AgentConfig
from ocp_ros.agent.encoder import Encoder
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
from ocp_ros.nodes.trainer_node import TrainerNode, TrainerNodeConfig, TurnEncoder
from ocp_ros.training.transitions import Transition

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


def made_up(agent, seed=0, cameras=4):
    """Return a transition between random observations."""
    before, after = (observation(agent, cameras, seed + turn) for turn in (0, 1))
    return Transition(before, np.zeros((cameras, 2), np.float32), 1.0, after, False)


@pytest.fixture
def listen(probe, start, room):
    """Return a function that starts a trainer and gives the probe publishers for its topics."""
    def header(stamp):
        return Header(stamp=ns_to_stamp(stamp), frame_id='map')

    def listener(**parameters):
        probe.trainer = start(cameras=2, **parameters)
        clouds = probe.publisher(PointCloud2, topics.OBSERVATION, qos.LOOP)
        poses = probe.publisher(PoseArray, topics.CAMERA_POSES, qos.LOOP)
        commands = probe.publisher(PoseArray, topics.CAMERA_COMMANDS, qos.LOOP)
        rewards = probe.publisher(Float64MultiArray, topics.REWARD, qos.LOOP)

        def reward(previous, stamp, step=1.0, episode=1.0):
            values = dict.fromkeys(topics.REWARD_FIELDS, 0.0)
            values |= {'previous_nanosec': previous, 'stamp_nanosec': stamp, 'step': step,
                       'episode': episode, 'reward': 0.5}
            rewards.publish(fields_to_msg(values))

        def cloud(stamp, points=room.points):
            clouds.publish(cloud_to_msg(points, header(stamp)))

        def pose(stamp, at=POSITIONS):
            poses.publish(positions_to_msg(at, header(stamp)))

        def command(stamp, at=POSITIONS):
            commands.publish(positions_to_msg(at, header(stamp)))

        probe.cloud, probe.pose, probe.command, probe.reward = cloud, pose, command, reward
        return probe

    return listener


@pytest.fixture
def topics_of_a_loop(listen):
    """Return the probe with publishers for the parts of a transition."""
    return listen()


def one_turn(loop, clouds=(1, 2), poses=(1, 2)):
    """Send all parts of a transition; clouds and poses in an order of their own."""
    loop.reward(0, 1, 0.0)
    loop.command(1)
    loop.reward(1, 2)
    for stamp in clouds:
        loop.cloud(stamp)
    for stamp in poses:
        loop.pose(stamp)
    loop.graph.until(lambda: loop.trainer.assembler.assembled == 1)
    loop.graph.until(lambda: loop.trainer.learner.transitions == 1)


@pytest.mark.parametrize('inputs', ['world', 'both'])
def test_a_transition_is_assembled_by_stamp(listen, inputs):
    one_turn(listen(agent__inputs=inputs))


def test_turns_may_come_in_any_order_where_each_is_encoded_on_its_own(listen):
    loop = listen(agent__inputs='cloud')
    loop.reward(1, 2)
    loop.command(1)
    for stamp in (2, 1):
        loop.cloud(stamp)
        loop.pose(stamp)
    loop.graph.until(lambda: loop.trainer.assembler.assembled == 1)
    loop.graph.until(lambda: loop.trainer.learner.transitions == 1)


def seen(room, turn):
    """Return what has been seen, and where two cameras are, at a turn of a made-up episode."""
    return room.points[:1200 + 150 * turn], POSITIONS + [0.2 * turn, -0.1 * turn, 0.0]


def test_turns_are_encoded_as_the_policy_encodes_them(listen, room, monkeypatch):
    loop = listen(turns=4, max_range=3.0, wall_margin=0.2)
    trainer, learned = loop.trainer, []
    monkeypatch.setattr(trainer.learner, 'add', learned.append)
    number, last = 0, {1: 3, 2: 5}
    for episode in last:
        for turn in range(last[episode] + 1):
            cloud, positions = seen(room, turn)
            number += 1
            loop.pose(number, positions)
            loop.cloud(number, cloud)
            loop.reward(number - 1, number, turn, episode)
            if turn < last[episode]:
                loop.command(number, seen(room, turn + 1)[1])
            loop.graph.until(lambda at=number: trainer.assembler.knows(at))
    loop.graph.until(lambda: len(learned) == 3 + 5)
    encoder = Encoder(trainer.config.agent, 3.0, 0.5, 0.2)
    transitions = iter(learned)
    for turns in last.values():
        encoder.reset()
        # A simulation that plays more turns than the policy: those count as its last.
        encoded = [encoder(*seen(room, turn), min(turn, 4), 4) for turn in range(turns + 1)]
        for before, after in zip(encoded, encoded[1:]):
            found = next(transitions)
            assert_same(found.observation, before)
            assert_same(found.next_observation, after)


@pytest.fixture
def turn_encoder(small_agent):
    """Return what encodes turns, and a function that encodes some turns of an episode by hand."""
    return TurnEncoder(Encoder(small_agent), 30)


def add(encoder, room, stamp, step, episode=1):
    """Hand over a whole turn, part after part; the encoded observation or None."""
    cloud, positions = seen(room, step)
    assert encoder.add(stamp, cloud=cloud) is None
    assert encoder.add(stamp, positions=positions) is None
    turn = encoder.add(stamp, number=(episode, step))
    return None if turn is None else turn.observation


def by_hand(agent, room, *steps):
    """Return the last of some turns of an episode, encoded by hand."""
    encoder = Encoder(agent)
    return [encoder(*seen(room, step), step, 30) for step in steps][-1]


def test_a_turn_that_lacks_a_part_is_left_out(turn_encoder, small_agent, room):
    add(turn_encoder, room, 10, 0)
    for part in ({'cloud': seen(room, 1)[0]}, {'positions': POSITIONS}):
        assert turn_encoder.add(11, **part) is None
    assert_same(add(turn_encoder, room, 12, 2), by_hand(small_agent, room, 0, 2))
    # Too late: the turns after it are encoded.
    assert turn_encoder.add(11, number=(1, 1)) is None
    assert add(turn_encoder, room, 11, 1) is None
    assert_same(add(turn_encoder, room, 13, 3), by_hand(small_agent, room, 0, 2, 3))


@pytest.mark.parametrize(('episode', 'step'), [(2, 0), (2, 2), (1, 0), (1, 1)])
def test_another_episode_forgets_the_last_one(turn_encoder, small_agent, room, episode, step):
    add(turn_encoder, room, 10, 0)
    add(turn_encoder, room, 11, 1)
    found = add(turn_encoder, room, 12, step, episode)
    assert_same(found, by_hand(small_agent, room, step))


def test_stamps_may_begin_anew(turn_encoder, small_agent, room):
    add(turn_encoder, room, 10, 0)
    cloud, positions = seen(room, 1)
    for part in ({'cloud': cloud}, {'positions': positions}):
        assert turn_encoder.add(5, **part) is None
    turn_encoder.clear()
    found = turn_encoder.add(5, number=(1, 1)).observation
    assert_same(found, by_hand(small_agent, room, 1))


def test_what_stays_incomplete_is_forgotten(turn_encoder):
    for stamp in range(100):
        turn_encoder.add(stamp, positions=POSITIONS)
    assert len(turn_encoder._waiting) < 20


def test_the_default_trainer_fits_models_of_the_default_sizes():
    assert TrainerNodeConfig().agent == AgentConfig()


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
    loop.cloud(3, np.full((5, 3), np.nan))
    loop.graph.until(lambda: trainer._refused == 4)
    one_turn(loop)


def test_weights_go_from_the_trainer_to_the_policy(graph, probe, start, agent, tmp_path):
    random_checkpoint(agent).save(tmp_path / 'm.safetensors')
    probe.listen(DiagnosticArray, '/diagnostics', 10)
    trainer = start(cameras=4, agent__inputs=agent.inputs)
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
    # Enough for eight gradient steps, then for eight more.
    for published, seeds in enumerate((range(20), range(20, 30)), start=1):
        for seed in seeds:
            trainer.learner.add(made_up(trainer.config.agent, seed))
        graph.until(lambda at=published: trainer._published == at, timeout=60.0)
    probe.listen(UInt8MultiArray, topics.POLICY_WEIGHTS, qos.LATCHED)
    found = Checkpoint.from_bytes(msg_to_bytes(probe.last(topics.POLICY_WEIGHTS)))
    assert found.run == trainer.learner.run and found.updates == 16


def test_messages_never_wait_for_a_gradient_step(topics_of_a_loop, monkeypatch):
    loop, trainer = topics_of_a_loop, topics_of_a_loop.trainer
    stuck, release = threading.Event(), threading.Event()

    def train(*arguments):
        stuck.set()
        release.wait(60.0)

    monkeypatch.setattr(trainer.learner.model, 'train', train)
    monkeypatch.setattr(trainer.learner, '_behind', lambda: not release.is_set())
    try:
        trainer.learner.add(made_up(trainer.config.agent, cameras=2))
        assert stuck.wait(30.0)
        loop.command(1)
        for stamp in (1, 2):
            loop.cloud(stamp)
            loop.pose(stamp)
            loop.reward(stamp - 1, stamp, stamp - 1)
        loop.graph.until(lambda: trainer.assembler.assembled == 1)
        assert trainer.learner.transitions == 1
    finally:
        release.set()


def test_a_trainer_starts_from_a_model_of_its_own_sizes(start, small_agent, tmp_path):
    path = tmp_path / 'm.safetensors'
    random_checkpoint(AgentConfig()).save(path)
    with pytest.raises(CheckpointError, match="expected the trainer's own agent settings"):
        start(model=str(path))
    random_checkpoint(small_agent, updates=5, run='a').save(path)
    weights = start(model=str(path)).learner.checkpoint().weights
    assert_same({name: value.numpy() for name, value in weights.items()},
                {name: value.numpy() for name, value in Checkpoint.load(path).weights.items()})
