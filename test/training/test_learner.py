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

"""What a policy tells, transitions made of it, and the learner that is fed with them."""

from contextlib import suppress
from dataclasses import replace
from shutil import copytree, ignore_patterns
import threading

from conftest import assert_same, HUNG, observation, wait_until
import numpy as np
from ocp_ros.policy.checkpoint import Checkpoint, CheckpointError
from ocp_ros.training.encoded_environment import encoded_space
from ocp_ros.training.experience import (
    Assembler,
    Choice,
    Experience,
    ExperienceError,
    from_bytes,
    Reward,
    to_bytes,
    Transition,
)
from ocp_ros.training.learner import BURST_STEPS, Learner, LearnerConfig
from ocp_ros.training.training_config import SacConfig
import pytest
from safetensors.numpy import load_file
from stable_baselines3.common.buffers import DictReplayBuffer
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

SAC = SacConfig(learning_starts=12, batch_size=8, buffer_size=400, device='cpu')


def transition(agent, seed=0):
    """Return a made-up transition."""
    before, after = (observation(agent, number) for number in (seed, seed + 1))
    cameras = 1 if agent.one_by_one else agent.cameras
    return Transition(before, np.zeros((cameras, 2), np.float32), 1.0, after, False)


def filled(learner, agent, count):
    """Give a learner some made-up transitions."""
    for seed in range(count):
        learner.add(transition(agent, seed))
    return learner


def test_a_learner_trains_from_transitions_and_leaves_whole_checkpoints(agent, tmp_path):
    config = LearnerConfig(updates_per_turn=1.0, folder=str(tmp_path), publish_every=4)
    learner = filled(Learner(config, agent, SAC), agent, 40)
    wait_until(lambda: learner.updates >= 28)
    replay = learner.model.replay_buffer
    # None of them follows another, and no state is terminal.
    assert (replay.rewards[:40] == 1.0).all()
    np.testing.assert_array_equal(replay.dones[:40], replay.timeouts[:40])
    weights = learner.take_weights()
    assert weights.run == learner.run and 0 < weights.updates <= 28
    assert learner.take_weights() is None
    learner.close()
    assert learner.failure is None and learner.updates == 28
    assert Checkpoint.load(tmp_path / 'actor.safetensors').updates == 28
    events = EventAccumulator(str(tmp_path / 'tensorboard')).Reload()
    assert {'train/critic_loss', 'train/actor_loss', 'train/transitions'} <= set(
        events.Tags()['scalars'])
    assert events.Scalars('train/transitions')[-1].value == 40
    again = Learner(config, agent, SAC)
    assert (again.run, again.updates, again.transitions) == (learner.run, 28, 40)
    assert again.model.replay_buffer.size() == 40
    again.close()


def test_a_learner_reports_its_failure(small_agent, tmp_path):
    learner = Learner(LearnerConfig(updates_per_turn=1.0, folder=str(tmp_path)), small_agent,
                      SAC)
    learner.add(transition(replace(small_agent, points=32)))
    wait_until(lambda: learner.failure is not None)
    learner.close()


def experience(stamp, turn=0, targets=0.0, choices=2):
    """Return a made-up experience of two cameras, whose observations tell stamp and choice."""
    return Experience(stamp, turn, np.full((2, 3), targets), [
        Choice({'n': (stamp, number)}, np.full((1, 2), 0.1 * number, np.float32))
        for number in range(choices)])


def test_every_choice_of_a_turn_is_a_transition_in_any_order_of_the_parts():
    parts = [lambda a: a.add_experience(experience(1, targets=0.25)),
             lambda a: a.add_experience(experience(2, 1)),
             lambda a: a.add_positions(2, np.full((2, 3), 0.25)),
             lambda a: a.add_reward(Reward(1, 2, 1, 0.5, (0.2, 0.3), True))]
    for order in ([0, 1, 2, 3], [3, 2, 1, 0], [2, 0, 3, 1]):
        assembler = Assembler()
        found = [t for k in order for t in parts[k](assembler)]
        assert [(t.observation['n'], t.next_observation['n']) for t in found] == [
            ((1, 0), (1, 1)), ((1, 1), (2, 0))]
        assert [(t.reward, t.terminated) for t in found] == [(0.2, False), (0.3, True)]
        np.testing.assert_allclose([t.actions[0, 0] for t in found], [0.0, 0.1])
        # Sent again, they make none more.
        assert not [t for k in order for t in parts[k](assembler)]
        assert assembler.assembled == 1


def test_the_only_choice_of_all_cameras_gets_the_reward_of_the_turn():
    assembler = Assembler()
    assembler.add_experience(experience(1, 0, choices=1))
    assembler.add_experience(experience(2, 1))
    assembler.add_positions(2, np.zeros((2, 3)))
    (found,) = assembler.add_reward(Reward(1, 2, 1, 0.5, (0.2, 0.3), False))
    assert found.reward == 0.5 and found.next_observation['n'] == (2, 0)


def test_incomplete_turns_are_dropped_and_counted():
    assembler = Assembler(patience=8)
    for stamp in range(1, 101):
        assembler.add_positions(stamp, np.zeros((2, 3)))
        if stamp % 5:
            assembler.add_experience(experience(stamp, stamp - 1))
        if stamp > 1:
            assembler.add_reward(Reward(stamp - 1, stamp, stamp - 1, 0.0, (0.0, 0.0), False))
    # Of every fifth turn it was lost what was chosen, so it is missing as the next one, too. The
    # last ones may still be completed.
    assert (assembler.assembled, assembler.incomplete) == (60, 36)
    assembler.clear()
    assert assembler.incomplete == 39


@pytest.mark.parametrize(('change', 'found'), [
    # Cameras in place come behind those that move.
    ({'positions': [[0.0] * 3, [0.0] * 3, [5.0] * 3]}, 2),
    ({'positions': np.ones((2, 3))}, 0), ({'positions': np.zeros((1, 3))}, 0),
    ({'positions': np.zeros((3, 3)), 'shares': (0.0,) * 3}, 0), ({'step': 2}, 0),
    ({'shares': (0.1,)}, 0)])
def test_a_turn_that_something_else_made_is_no_transition(change, found):
    given = {'positions': np.zeros((2, 3)), 'step': 1, 'shares': (0.0, 0.0)} | change
    assembler = Assembler()
    for stamp in (1, 2):
        assembler.add_experience(experience(stamp, stamp - 1))
    assembler.add_positions(2, np.array(given['positions']))
    made = assembler.add_reward(Reward(1, 2, given['step'], 0.0, given['shares'], False))
    assert len(made) == found
    assert (assembler.assembled, assembler.inconsistent) == ((1, 0) if found else (0, 1))


@pytest.mark.system
def test_a_learner_that_was_killed_loses_only_what_came_since_it_saved(small_agent, tmp_path):
    """What a killed process leaves is what is in its folder, copied while it works."""
    config = LearnerConfig(updates_per_turn=1.0, folder=str(tmp_path / 'a'), publish_every=4,
                           save_seconds=0.0)
    learner = filled(Learner(config, small_agent, SAC), small_agent, 37)
    wait_until(lambda: learner.updates >= 24)
    # Files that are being written have other names until they are whole, which may go meanwhile.
    copytree(tmp_path / 'a', tmp_path / 'b', ignore=ignore_patterns('.*'))
    (tmp_path / 'b' / '.state.safetensors.abc').write_bytes(b'torn')
    again = Learner(replace(config, folder=str(tmp_path / 'b')), small_agent, SAC)
    assert again.run == learner.run and 28 <= again.transitions <= 37
    assert again.updates >= 16 and again.updates % BURST_STEPS == 0
    mine, theirs = again.model.replay_buffer, learner.model.replay_buffer
    kept = mine.pos
    assert kept >= 28 and np.array_equal(mine.rewards[:kept], theirs.rewards[:kept])
    for name, values in mine.observations.items():
        assert np.array_equal(values[:kept], theirs.observations[name][:kept])
    assert not list((tmp_path / 'b').rglob('*.abc'))
    # It publishes its weights, and goes on.
    assert again.take_weights().updates >= 16
    wait_until(lambda: again.behind < BURST_STEPS)
    most = max(kept, again.transitions) - SAC.learning_starts
    assert kept - SAC.learning_starts - 4 < again.updates <= most
    for one in (learner, again):
        one.close()
        assert one.failure is None


def test_transitions_are_saved_in_time_without_any_gradient_step(small_agent, tmp_path):
    config = LearnerConfig(folder=str(tmp_path / 'a'), save_seconds=0.05)
    replay = tmp_path / 'a' / 'replay.safetensors'
    learner = filled(Learner(config, small_agent, SAC), small_agent, 5)
    wait_until(lambda: replay.exists() and len(load_file(replay)['rewards']) == 5)
    wait_until(lambda: (tmp_path / 'a' / 'state.safetensors').exists())
    copytree(tmp_path / 'a', tmp_path / 'b', ignore=ignore_patterns('.*'))
    again = Learner(replace(config, folder=str(tmp_path / 'b')), small_agent, SAC)
    assert (again.run, again.transitions, again.updates) == (learner.run, 5, 0)
    for one in (learner, again):
        one.close()
        assert one.failure is None


def test_a_learner_says_so_when_there_is_no_room(small_agent, tmp_path, monkeypatch):
    monkeypatch.setattr('ocp_ros.training.learner.INBOX_SIZE', 5)
    learner = Learner(LearnerConfig(updates_per_turn=1.0, folder=str(tmp_path)), small_agent,
                      SAC)
    stuck, release = threading.Event(), threading.Event()
    monkeypatch.setattr(learner, '_store', lambda one: stuck.set() or release.wait(HUNG))
    assert learner.add(transition(small_agent)) and stuck.wait(HUNG)
    taken = [learner.add(transition(small_agent, seed)) for seed in range(8)]
    assert taken == [True] * 5 + [False] * 3 and learner.dropped == 3
    release.set()
    learner.close()


def test_a_learner_whose_transitions_are_lost_waits_for_new_ones(small_agent, tmp_path):
    config = LearnerConfig(updates_per_turn=1.0, folder=str(tmp_path))
    learner = filled(Learner(config, small_agent, SAC), small_agent, 24)
    wait_until(lambda: learner.updates >= 12)
    learner.close()
    (tmp_path / 'replay.safetensors').unlink()
    again = Learner(config, small_agent, SAC)
    assert (again.transitions, again.updates, again.behind) == (24, 12, -12)
    filled(again, small_agent, 16)
    wait_until(lambda: again.updates >= 16)
    again.close()
    assert again.failure is None and (again.transitions, again.updates) == (40, 16)


def test_rewards_are_summed_up_while_one_transition_follows_another(small_agent, tmp_path):
    """The third one is of another rig; the last one comes after a restart."""
    sac = replace(SAC, n_steps=3, gamma=0.5, learning_starts=100)
    config = LearnerConfig(updates_per_turn=1.0, folder=str(tmp_path))
    states = [observation(small_agent, seed) for seed in range(5)]
    chain = [Transition(before, np.zeros((1, 2), np.float32), reward, after, False)
             for before, reward, after in zip(states, (1.0, 10.0, 1e3, 1e4), states[1:])]
    for parts in ([*chain[:2], transition(small_agent)._replace(reward=100.0), chain[2]],
                  chain[3:]):
        learner = Learner(config, small_agent, sac)
        assert all(map(learner.add, parts))
        learner.close()
    drawn = DictReplayBuffer.sample(learner.model.replay_buffer, 200)
    assert drawn.rewards[:, 0].unique().tolist() == [6.0, 10.0, 100.0, 1e3, 1e4]
    # None of these sums ends at a terminal state, so the critics value what follows.
    assert not drawn.dones.any()


def test_a_learner_of_other_transitions_is_refused(small_agent, tmp_path):
    config = LearnerConfig(updates_per_turn=1.0, folder=str(tmp_path))
    filled(Learner(config, small_agent, SAC), small_agent, 1).close()
    (tmp_path / 'state.safetensors').unlink()
    with pytest.raises(CheckpointError, match='no moves of this run'):
        Learner(config, replace(small_agent, points=32), SAC)


def test_an_experience_comes_back_and_one_that_lies_is_refused(agent):
    together = 1 if agent.one_by_one else 4
    made = Experience(7, 3, np.ones((4, 3)), [
        Choice(observation(agent, seed), np.full((together, 2), 0.5, np.float32))
        for seed in range(4 // together)])
    expected = {name: (space.shape, space.dtype)
                for name, space in encoded_space(agent).spaces.items()}
    blob, rng = to_bytes(made), np.random.default_rng(0)
    found = from_bytes(blob, expected, together)
    assert found[:2] == (7, 3) and np.array_equal(found.targets, made.targets)
    for one, other in zip(found.choices, made.choices, strict=True):
        assert_same(one.observation, other.observation)
        assert np.array_equal(one.actions, other.actions)
    first = made.choices[0]
    points = first.observation['points']
    spoilt = [{'targets': np.ones((2, 3))}, {'targets': np.full((4, 3), np.nan)}, *(
        {'choices': [Choice({**first.observation, 'points': value}, first.actions)] * len(
            made.choices)}
        for value in (points[..., :-1], points.astype(np.float64), np.full_like(points, np.inf)))]
    for wrong in (blob[:-5], b'', blob[8:], *(to_bytes(made._replace(**one)) for one in spoilt)):
        with pytest.raises(ExperienceError, match='experience: found .*; expected'):
            from_bytes(wrong, expected, together)
    for _ in range(300):
        torn = bytearray(blob)
        for at in rng.integers(len(blob) if rng.random() < 0.5 else 400, size=3):
            torn[at] = rng.integers(256)
        with suppress(ExperienceError):
            found = from_bytes(bytes(torn), expected, together)
            assert all(np.isfinite(choice.actions).all() for choice in found.choices)
