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

"""``trainer_node`` on real DDS, and the loop of all three nodes."""

from dataclasses import asdict, replace
import re
import threading

from conftest import (
    assert_same,
    counted,
    header_at,
    HUNG,
    observation,
    random_checkpoint,
    SMALL,
    warnings_of,
)
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.policy.agent_config import AgentConfig, CLOUD, PAPER
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.policy.policy import Policy
from ocp_ros.rig.free_plane import CLEARANCE
from ocp_ros.ros import trainer_node
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import (
    bytes_to_msg,
    fields_to_msg,
    msg_to_bytes,
    msg_to_fields,
    positions_to_msg,
)
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.ros.runtime.managed_node import create_steady_timer
from ocp_ros.ros.sim_node import SimNode
from ocp_ros.ros.trainer_node import TrainerNode
from ocp_ros.ros.training_source import topic_of
from ocp_ros.simulation.environment import CameraPlacementEnv
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import PlaneProblem
from ocp_ros.training.encoded_environment import playable
from ocp_ros.training.experience import Choice, Experience, to_bytes, Transition
from ocp_ros.util.settings import ConfigurationError
import pytest
from std_msgs.msg import Float64MultiArray, UInt8MultiArray
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

SAC = {'sac__learning_starts': 12, 'sac__batch_size': 8, 'sac__buffer_size': 400,
       'sac__device': 'cpu', 'updates_per_turn': 1.0, 'publish_every': 8}
POSITIONS = np.array([[4.0, 4.0, 1.9], [5.0, 4.0, 1.9]])


@pytest.fixture
def start(graph, tmp_path, small_agent, monkeypatch):
    """Return a function that starts a trainer of small networks, which looks round often."""
    monkeypatch.setattr(trainer_node, 'create_steady_timer', lambda node, seconds, tick: (
        create_steady_timer(node, seconds / 10.0, tick)))
    agent = {f'agent__{name}': value for name, value in asdict(small_agent).items()}

    def starter(**parameters):
        return graph.add(TrainerNode, **{
            'folder': str(tmp_path / 'run'), **agent, **SAC, **parameters})
    return starter


def made_up(agent, seed=0):
    """Return a transition between random observations."""
    before, after = (observation(agent, seed + turn) for turn in (0, 1))
    return Transition(before, np.zeros((1, 2), np.float32), 1.0, after, False)


class Loop:
    """What a rig and its policy publish in a namespace, made up by hand."""

    def __init__(self, probe, agent, namespace='/'):
        def publisher(kind, name):
            return probe.publisher(kind, topic_of(namespace, name), qos.LOOP)

        self.agent = agent
        self.experiences = publisher(UInt8MultiArray, topics.EXPERIENCE)
        self.poses = publisher(PoseArray, topics.CAMERA_POSES)
        self.rewards = publisher(Float64MultiArray, topics.REWARD)

    def experience(self, stamp, turn, /, **lies):
        """Send what a policy chose; lies replace what the second camera has seen and done."""
        choices = [Choice(observation(self.agent, 10 * stamp + number),
                          np.full((1, 2), 0.1 * number, np.float32))
                   for number in range(len(POSITIONS))]
        arrays = {**choices[1].observation, 'actions': choices[1].actions}
        for name, wrong in lies.items():
            arrays[name].flat[0] = wrong
        self.experiences.publish(bytes_to_msg(to_bytes(
            Experience(stamp, turn, POSITIONS, choices))))

    def pose(self, stamp, at=POSITIONS):
        """Send where the cameras are."""
        self.poses.publish(positions_to_msg(at, header_at(stamp)))

    def reward(self, previous, stamp, step=1.0, shares=(0.2, 0.3), **others):
        """Send what a turn was worth; fields that are None are left out."""
        values = dict.fromkeys(topics.REWARD_FIELDS, 0.0)
        values |= {'previous_nanosec': previous, 'stamp_nanosec': stamp, 'step': step,
                   'reward': sum(shares)}
        values |= {topics.share_field(number): share for number, share in enumerate(shares)}
        values = {key: value for key, value in {**values, **others}.items() if value is not None}
        self.rewards.publish(fields_to_msg(values))

    def turn(self, stamp, first=1):
        """Send all parts of the turn that ends with a stamp, given that of the first turn."""
        self.reward(stamp - 1, stamp, stamp - first)
        self.experience(stamp, stamp - first)
        self.pose(stamp)


@pytest.fixture
def loop(probe, start):
    """Return what a trainer hears, and the trainer."""
    trainer = start()
    made = Loop(probe, trainer.config.agent)
    made.trainer, made.graph, made.source = trainer, probe.graph, trainer.sources['/']
    return made


@pytest.mark.parametrize('inputs', [CLOUD, PAPER])
def test_what_is_learned_over_ros_is_what_is_learned_in_one_process(
        graph, start, tmp_path, small_agent, inputs):
    cameras = turns = 3
    weights = random_checkpoint(replace(small_agent, inputs=inputs, cameras=cameras))
    weights.save(tmp_path / 'm.safetensors')
    trainer = start(agent__inputs=inputs, agent__cameras=cameras)
    learned = []
    trainer.sources['/']._store_transition = lambda one: learned.append(one) or True
    # The policy of the paper knows of no clearance: its commands would be changed.
    graph.add(PolicyNode, model=str(tmp_path / 'm.safetensors'), explore=True, turns=turns,
              clearance=0.0 if inputs == PAPER else CLEARANCE)
    sim = graph.add(SimNode, seed=3, rig__cameras=cameras, episode__turns=turns, **SMALL)
    count = turns * (1 if inputs == PAPER else cameras)
    graph.until(lambda: len(learned) >= count)
    assert trainer.sources['/'].status() == {
        'turns': turns, 'transitions': count, 'incomplete': 0, 'inconsistent': 0, 'refused': 0,
        'dropped': 0}
    env = CameraPlacementEnv([sim.simulator.scene], sim.config)
    wrapped = playable(env, weights.config)
    wrapped.reset()
    # The same episode: where it starts is drawn as the node draws it.
    env.episode = Episode(PlaneProblem(sim.simulator), np.random.default_rng(3))
    if inputs == CLOUD:
        wrapped._encoder.partial_maps.reset()
    before = wrapped.observation(None) if inputs == PAPER else wrapped._begin()
    policy, rng = Policy(weights), np.random.default_rng(0)
    for found in learned:
        action = policy.choose(before, rng)
        after, reward, terminated, _, _ = wrapped.step(action)
        np.testing.assert_allclose(found.actions, action, atol=1e-4)
        for name, value in found.observation.items():
            np.testing.assert_allclose(value, before[name], atol=1e-3, err_msg=name)
            np.testing.assert_allclose(found.next_observation[name], after[name], atol=1e-3)
        assert found.reward == pytest.approx(reward, abs=1e-3)
        assert found.terminated == terminated
        before = after


def test_turns_of_a_rig_file_are_learned_from(graph, start, model, tmp_path):
    rig_file = str(tmp_path / 'rig.yaml')
    (tmp_path / 'rig.yaml').write_text("""
        cameras: [{sensor: realsense_d455, count: 2}]
        fixed: [{sensor: realsense_d455, position: [1.0, 1.0, 1.9], yaw: 45, pitch: 25}]""")
    trainer = start()
    graph.add(PolicyNode, model=model, explore=True, turns=4, rig_file=rig_file)
    sim = graph.add(SimNode, scene__seed=12, episode__turns=4, rig_file=rig_file, **SMALL)
    graph.until(lambda: sim.episode.turn.truncated)
    assembler = trainer.sources['/'].assembler
    graph.until(lambda: assembler.assembled + assembler.inconsistent == 4)
    # What the room stops, which nobody had seen, is no answer to what was chosen.
    assert assembler.assembled >= 2
    graph.until(lambda: trainer.learner.transitions == 2 * assembler.assembled)
    # How the episode has ended is in the log and in the diagnostics.
    assert 0.0 < trainer.error_ratio == round(trainer.sources['/'].error_ratios[0], 3)


def test_parts_that_cannot_be_are_refused_and_the_training_goes_on(loop, probe):
    # Numbers that no policy reads or chooses.
    lies = (('keys_1', 64), ('groups_1', -1), ('keys_2', 8), ('groups_2', 500), ('points', 3e38),
            ('others', 1e20), ('turn', -3e38), ('actions', 1e30), ('actions', -20.0))
    other = Loop(probe, AgentConfig(CLOUD))
    cases = [(lambda: other.experience(1, 0), 'agent settings'),
             (lambda: loop.pose(2, np.full((2, 3), np.nan)), 'poses'),
             (lambda: loop.reward(np.nan, 3), 'nan')]
    cases += [(lambda wrong=wrong: loop.reward(0, 1, shares=(wrong, 0.3)), 'reward')
              for wrong in (1e308, -3e38, np.nan, np.inf, -np.inf)]
    cases += [(lambda blob=blob: loop.experiences.publish(bytes_to_msg(blob)), 'experience')
              for blob in (b'', b'\xff' * 64, b'\x80\x04K\x01.')]
    cases += [(lambda lie={name: wrong}: loop.experience(1, 0, **lie), f'found {name}')
              for name, wrong in lies]
    warnings = warnings_of(loop.trainer)
    for count, (send, word) in enumerate(cases, start=1):
        send()
        loop.graph.until(lambda: loop.source.counts['refused'] == count)
        assert 'refused' in warnings[-1] and word in warnings[-1]
    for stamp in range(1, 12):
        loop.turn(stamp)
    loop.graph.until(lambda: loop.trainer.learner.transitions == 20)
    loop.graph.until(lambda: loop.trainer.learner.updates >= 4)
    assert loop.source.counts['refused'] == len(cases) and loop.trainer.learner.failure is None


def test_stamps_may_begin_anew(loop):
    for stamp in (101, 102, 103):
        loop.turn(stamp, first=101)
    loop.graph.until(lambda: loop.source.assembler.assembled == 2)
    for stamp in (1, 2):
        # One after the other: a first turn that came before its reward would be forgotten.
        loop.reward(stamp - 1, stamp, stamp - 1)
        loop.graph.until(lambda at=stamp: loop.source._newest_stamp == at)
        loop.experience(stamp, stamp - 1)
        loop.pose(stamp)
    loop.graph.until(lambda: loop.source.assembler.assembled == 3)


def test_the_errors_of_an_episode_may_be_missing(loop):
    errors = ((1.0, None), (0.5, np.inf), (np.nan, 1.0), (None, 1.0), (2.0, 1.0))
    for stamp, error in enumerate(np.ravel(errors), start=1):
        loop.reward(stamp - 1, stamp, (stamp - 1) % 2, depth_error=error, truncated=1.0)
        loop.graph.until(lambda at=stamp: loop.source._newest_stamp == at)
    assert list(loop.source.error_ratios) == [0.5]


def test_many_policies_are_learned_from_counted_and_told(graph, probe, start):
    trainer = start(updates_per_turn=4.0)
    # What else has the name of the topic is not listened to.
    probe.node.create_publisher(PoseArray, '/wrong/experience', qos.LOOP)
    loops = {name: Loop(probe, trainer.config.agent, name)
             for name in ('/', '/env_0', '/far/env_1')}
    assert set(trainer.sources) == set(loops)
    weights, status = ([topic_of(name, topic) for name in loops]
                       for topic in (topics.POLICY_WEIGHTS, topics.TRAINING))
    for topic in (*weights, *status):
        kind = UInt8MultiArray if topic in weights else Float64MultiArray
        probe.listen(kind, topic, qos.LATCHED)
    for number, loop in enumerate(loops.values()):
        for stamp in range(1, 5 + number):
            loop.turn(stamp)
    graph.until(lambda: trainer.learner.transitions == 2 * (3 + 4 + 5))
    assert [counted(trainer, name) for name in (
        *(f'turns {name}' for name in loops), 'turns', 'sources')] == [3, 4, 5, 12, 3]
    # The same weights for all.
    graph.until(lambda: all(probe.received[topic] for topic in weights))
    assert len({Checkpoint.from_bytes(msg_to_bytes(probe.received[topic][0])).updates
                for topic in weights}) == 1
    graph.until(lambda: all(
        msg_to_fields(probe.last(topic), topics.TRAINING_FIELDS)['turns'] == turns
        for topic, turns in zip(status, (3, 4, 5))))


def test_sources_that_are_silent_make_room_for_others(graph, probe, start, monkeypatch):
    monkeypatch.setattr(trainer_node, 'MAX_SOURCES', 3)
    trainer = start()
    fakes = [probe.node.create_publisher(UInt8MultiArray, f'/fake_{number}/experience', qos.LOOP)
             for number in range(4)]
    graph.until(lambda: len(trainer.sources) == 3)
    first, second = list(trainer.sources)[1:]
    # Both go, and the others have their turn.
    monkeypatch.setattr(trainer_node, 'MAX_SILENCE_S', 0.0)
    graph.until(lambda: {first, second}.isdisjoint(trainer.sources) and len(trainer.sources) == 3)
    assert '/' in trainer.sources and trainer.totals()['transitions'] == 0
    for fake in fakes:
        probe.node.destroy_publisher(fake)
    graph.until(lambda: list(trainer.sources) == ['/'])


def test_only_the_sources_that_are_named_are_learned_from(graph, probe, start):
    trainer = start(sources='env_1, /a/env_2/')
    probe.node.create_publisher(UInt8MultiArray, '/env_3/experience', qos.LOOP)
    probe.publisher(UInt8MultiArray, '/a/env_2/experience', qos.LOOP)
    graph.until(lambda: trainer.count_publishers('/env_3/experience'))
    trainer._discover()
    assert set(trainer.sources) == {'/env_1', '/a/env_2'}


def test_policies_wait_while_the_trainer_is_behind(graph, start, model, monkeypatch):
    # A trainer that a busy machine holds up is not one that has fallen silent.
    monkeypatch.setattr('ocp_ros.ros.policy.experiences.MAX_SILENCE_S', HUNG)
    trainer = start(most_behind=8)
    release, train = threading.Event(), trainer.learner.model.train

    def wait_and_train(*arguments):
        release.wait(HUNG)
        train(*arguments)

    monkeypatch.setattr(trainer.learner.model, 'train', wait_and_train)
    policy = graph.add(PolicyNode, model=model, explore=True)
    sim = graph.add(SimNode, auto_reset=True, resend_period=0.05, episode__turns=5, **SMALL)
    try:
        graph.until(lambda: policy._experiences.must_wait)
        answered = counted(policy, 'turns_answered')
        resent = counted(sim, 'resent_turns')
        # The simulation goes on asking, and the policy on waiting.
        graph.until(lambda: counted(sim, 'resent_turns') >= resent + 3)
        assert counted(policy, 'turns_answered') <= answered + 1
    finally:
        release.set()
    graph.until(lambda: counted(policy, 'turns_answered') >= answered + 3)
    assert trainer.learner.dropped == 0


def test_a_trainer_that_falls_silent_holds_nobody(graph, probe, model, monkeypatch):
    monkeypatch.setattr('ocp_ros.ros.policy.experiences.MAX_SILENCE_S', HUNG)
    policy = graph.add(PolicyNode, model=model, explore=True)
    training = probe.publisher(Float64MultiArray, topics.TRAINING, qos.LATCHED)
    training.publish(Float64MultiArray(data=[1.0]))
    training.publish(fields_to_msg({'hold': 1.0}))
    graph.until(lambda: policy._experiences.must_wait)
    # Only now: a busy machine may get round to asking whether it holds long after it was told.
    monkeypatch.setattr('ocp_ros.ros.policy.experiences.MAX_SILENCE_S', 0.2)
    graph.until(lambda: not policy._experiences.must_wait)
    graph.add(SimNode, resend_period=0.05, **SMALL)
    graph.until(lambda: counted(policy, 'turns_answered') >= 1)


def test_weights_go_from_the_trainer_to_the_policy(graph, probe, start, model, tmp_path):
    probe.listen(DiagnosticArray, '/diagnostics', 10)
    trainer = start()
    assert (tmp_path / 'run' / 'config.yaml').exists()
    policy = graph.add(PolicyNode, model=model, explore=True)
    graph.add(SimNode, auto_reset=True, resend_period=0.1, episode__turns=5, **SMALL)
    graph.until(lambda: counted(policy, 'weights_swapped') >= 2)
    assert policy.policy.checkpoint.run == trainer.learner.run
    assert trainer.learner.transitions >= 12
    assert [counted(trainer, name) for name in ('inconsistent', 'refused')] == [0, 0]
    graph.until(lambda: any(
        status.name == '/trainer_node' and status.message == 'training'
        for message in probe.received['/diagnostics'] for status in message.status))
    graph.remove(trainer)
    saved = Checkpoint.load(tmp_path / 'run' / 'actor.safetensors')
    assert saved.updates == trainer.learner.updates > 0


def test_progress_is_in_the_log_and_in_tensorboard(graph, start, tmp_path, monkeypatch):
    monkeypatch.setattr(trainer_node, 'LOG_INTERVAL_S', 1)
    trainer, said = start(), []
    trainer.get_logger().info = said.append
    trainer.learner.add(made_up(trainer.config.agent))
    # The first checkpoint comes at once, the next one five minutes later.
    graph.until(lambda: any(re.search(
        '0 turns, 1 transitions, 0 gradient steps.* (29[0-9]|300) s', line) for line in said))
    events = EventAccumulator(str(tmp_path / 'run' / 'tensorboard')).Reload()
    assert [events.Scalars(f'progress/{name}')[-1].value for name in (
        'turns', 'transitions', 'gradient_steps')] == [0.0, 1.0, 0.0]
    assert events.Scalars('progress/seconds_to_checkpoint')[-1].value > 200.0


def test_who_comes_late_gets_the_latest_weights(graph, probe, start):
    def latest(topic):
        probe.listen(UInt8MultiArray, topic, qos.LATCHED)
        found = Checkpoint.from_bytes(msg_to_bytes(probe.last(topic)))
        return found.run, found.updates

    trainer = start()
    # Enough for eight gradient steps, then for eight more.
    for published, seeds in enumerate((range(20), range(20, 30)), start=1):
        for seed in seeds:
            trainer.learner.add(made_up(trainer.config.agent, seed))
        graph.until(lambda: trainer._published_weights == published)
    assert latest(topics.POLICY_WEIGHTS) == (trainer.learner.run, 16)
    # Also in a namespace that is found later.
    probe.node.create_publisher(UInt8MultiArray, '/late/experience', qos.LOOP)
    assert latest('/late/policy_weights') == (trainer.learner.run, 16)
    # A trainer that is started again continues and publishes its weights.
    graph.remove(trainer)
    again = start()
    assert (again.learner.run, again.learner.transitions) == (trainer.learner.run, 30)
    assert latest(topics.POLICY_WEIGHTS) == (trainer.learner.run, trainer.learner.updates)


def test_messages_never_wait_for_a_gradient_step(loop, monkeypatch):
    trainer = loop.trainer
    stuck, release = threading.Event(), threading.Event()

    def train(*arguments):
        stuck.set()
        release.wait(HUNG)

    monkeypatch.setattr(trainer.learner.model, 'train', train)
    monkeypatch.setattr(trainer.learner, '_burst_is_due', lambda: not release.is_set())
    try:
        trainer.learner.add(made_up(trainer.config.agent))
        assert stuck.wait(HUNG)
        for stamp in (1, 2):
            loop.turn(stamp)
        loop.graph.until(lambda: loop.source.assembler.assembled == 1)
        assert trainer.learner.transitions == 1
    finally:
        release.set()


def test_a_folder_that_cannot_be_written_is_named(graph, tmp_path):
    (tmp_path / 'taken').write_text('')
    with pytest.raises(ConfigurationError, match='folder: found .*taken/run'):
        graph.add(TrainerNode, folder=str(tmp_path / 'taken' / 'run'))


def test_a_trainer_that_starts_from_a_model_has_its_sizes(start, small_agent, tmp_path):
    path = tmp_path / 'm.safetensors'
    random_checkpoint(replace(small_agent, points=32, hidden=8), updates=5, run='a').save(path)
    learned, saved = start(model=str(path)).learner.checkpoint(), Checkpoint.load(path)
    assert_same(*({name: value.numpy() for name, value in one.weights.items()}
                  for one in (learned, saved)))


def test_quality_of_service_follows_parameters(start, capfd):
    known = 'qos_overrides./training.publisher.depth'
    trainer = start(**{known: 3, 'qos_overrides./later/reward.subscription.depth': 3})
    assert {one.topic_name: one.qos_profile.depth for one in trainer.publishers}['/training'] == 3
    assert 'qos_overrides' not in capfd.readouterr().err
    start(**{'qos_overrides./trianing.publisher.depth': 3})
    assert "'/trianing'; did you mean '/training'" in capfd.readouterr().err
