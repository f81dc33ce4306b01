# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The replay of turns: what is rebuilt, what belongs together and what it takes."""

from dataclasses import replace

from conftest import made_room
import gymnasium as gym
import numpy as np
import pytest
import torch

from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.packed_bits import no_bits
from ocp_ros.scenes.scene import turned
from ocp_ros.simulation.environment import CameraPlacementEnv
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.training import replay_buffer
from ocp_ros.training.augmentation import SYMMETRIES, Symmetries, turn_observation
from ocp_ros.training.encoded_environment import (
    action_space,
    encoded_space,
    EncodedObservation,
    Known,
)
from ocp_ros.training.replay_buffer import Rebuild, TurnReplay

SIMULATION = SimulationConfig(engine=EngineConfig(preset='fast', error_rows=16, coverage_cell=1.0),
                              episode=EpisodeConfig(turns=6))
ROTATIONS = (0.0, 30.0)
#: Made-up observations: everything is the number of the turn, told by the bits alone.
SPACE = gym.spaces.Dict({name: gym.spaces.Box(-1e9, 1e9, shape, np.float32) for name, shape in (
    ('points', (5, 3)), ('cameras', (2, 3)), ('half_size', (3,)))})


@pytest.fixture(scope='module')
def cloud_agent(small_agent):
    """Return a small agent that reads the cloud."""
    return replace(small_agent, inputs='cloud')


@pytest.fixture
def unturned(monkeypatch):
    """Switch the symmetries off."""
    monkeypatch.setattr(replay_buffer, 'symmetric', lambda batch: batch)


def numbered(known):
    """Rebuild a made-up observation."""
    number = float(known.observed[0])
    assert known.scene == number % 7 and len(known.observed) == 1 + number % 3
    assert (known.positions == number).all()
    return {name: np.full(space.shape, number, np.float32) for name, space in SPACE.items()}


def made_up(number):
    """Return what is known at a made-up turn."""
    return Known(number % 7, np.full(1 + number % 3, number, np.uint64),
                 np.full((2, 3), float(number)))


def made_up_replay(size, envs=1, **kwargs):
    """Return a replay of made-up turns."""
    return TurnReplay(size, SPACE, action_space(2), 'cpu', envs, **{
        'rebuild': numbered, 'words': 3, **kwargs})


class Play:
    """
    Made-up turns, played until told otherwise.

    :ivar played: per environment its transitions, as (before, after, done).
    """

    def __init__(self, buffer, envs=1):
        self.buffer, self.played, self.count = buffer, [[] for _ in range(envs)], 0
        self.turns = [self.fresh() for _ in range(envs)]

    def fresh(self):
        """Return the number of a new turn."""
        self.count += 1
        return self.count

    def step(self, done, cut=None, timeout=False):
        """Play a turn in all environments; after ``cut`` a new run begins without an end."""
        before, after = self.turns, [self.fresh() for _ in self.turns]
        infos = [{'before': made_up(b), 'after': made_up(a), 'TimeLimit.truncated': timeout}
                 for b, a in zip(before, after)]
        number = np.array(before, dtype=np.float32)
        self.buffer.add({}, {}, np.tile(number[:, None, None], (1, 2, 2)), number, done, infos)
        for env, transition in enumerate(zip(before, after, done)):
            self.played[env].append(tuple(int(value) for value in transition))
        self.turns = [self.fresh() if ended or (cut is not None and cut[env]) else turn
                      for env, (turn, ended) in enumerate(zip(after, done))]


def drawn(batch):
    """Return the made-up transitions of a batch, each checked to be of one piece."""
    rows = []
    for index in range(len(batch.rewards)):
        before, after = ({float(value) for values in observation.values()
                          for value in values[index].flatten()}
                         for observation in (batch.observations, batch.next_observations))
        (before,), (after,) = before, after
        assert (batch.actions[index] == before).all() and batch.rewards[index] == before
        rows.append((int(before), int(after), int(batch.dones[index])))
    return rows


@pytest.mark.parametrize('envs', [1, 3])
def test_no_sample_mixes_turns_however_often_the_ring_wraps_round(envs, unturned):
    rng = np.random.default_rng(envs)
    np.random.seed(0)
    buffer = made_up_replay(20 * envs, envs, cache_bytes=2000)
    play = Play(buffer, envs)
    for _ in range(150):
        play.step(rng.random(envs) < 0.2, rng.random(envs) < 0.1)
        found = set(drawn(buffer.sample(12 * envs)))
        # What a ring holds is the newest of its environment, without a gap.
        newest = [transition for played in play.played for transition in played[-buffer.slots:]]
        assert found <= set(newest)
        assert buffer.size() == sum(
            len(held(played, buffer.slots)) for played in play.played)
    expected = {row for played in play.played for row in held(played, buffer.slots)}
    assert set(drawn(buffer.sample(2000))) == expected
    assert buffer.full.all()
    buffer.reset()
    assert buffer.size() == len(buffer.cache) == buffer.cache.nbytes == 0


def held(played, slots):
    """Return the transitions that a ring holds, counted from the newest."""
    used, rows, follower = 0, [], None
    # A transition that the next one goes on from shares its final turn with it.
    for before, after, done in reversed(played):
        used += 1 if after == follower else 2
        if used > slots:
            break
        rows.append((before, after, done))
        follower = before
    return rows


def test_the_final_turn_is_stored_but_begins_nothing(unturned):
    buffer = made_up_replay(100)
    play = Play(buffer)
    for _ in range(3):
        for turn in range(5):
            play.step([turn == 4])
    finals = {after for _, after, done in play.played[0] if done}
    found = drawn(buffer.sample(500))
    assert len(finals) == 3 and set(found) == set(play.played[0])
    assert not finals & {before for before, _, _ in found}
    assert (int(buffer.pos[0]), buffer.size()) == (18, 15)
    # Nor does it where the next episode begins just as the last one ended.
    play.step([True])
    play.turns = [play.played[0][-1][1]]
    play.step([False])
    assert (int(buffer.pos[0]), buffer.size()) == (22, 17)


def test_every_transition_is_as_likely(unturned):
    np.random.seed(1)
    play = Play(made_up_replay(8, 2), 2)
    for turn in range(4):
        play.step([turn == 1, turn == 2])
    _, counts = np.unique([row[0] for row in drawn(play.buffer.sample(8000))], return_counts=True)
    assert len(counts) == 8 and abs(counts - 1000).max() < 150


@pytest.mark.parametrize(('envs', 'size'), [(1, 1), (1, 30), (1, 100), (4, 310)])
def test_it_holds_as_many_transitions_as_promised(envs, size):
    play = Play(made_up_replay(size, envs), envs)
    for turn in range(500):
        play.step([turn % 30 == 29] * envs)
        assert play.buffer.size() >= min(envs * (turn + 1), size)
    assert play.buffer.size() < size * 1.2 + 4 * envs


@pytest.mark.parametrize(('handled', 'expected'), [(True, 0.0), (False, 1.0)])
def test_the_end_of_the_time_is_no_end(handled, expected, unturned):
    play = Play(made_up_replay(10, handle_timeout_termination=handled))
    play.step([True], timeout=True)
    play.step([True])
    batch = play.buffer.sample(40)
    ends = dict(zip(batch.rewards[:, 0].tolist(), batch.dones[:, 0].tolist()))
    assert list(ends.items()) in ([(1, expected), (3, 1)], [(3, 1), (1, expected)])


@pytest.mark.parametrize('limit', [0, 95, 96, 1000, 1 << 29])
def test_the_cache_keeps_to_its_bytes_and_changes_nothing(limit):
    calls, samples, rebuilt = [], [], []

    def counted(known):
        calls.append(known)
        return numbered(known)

    for cache_bytes in (limit, 0):
        np.random.seed(3)
        play = Play(made_up_replay(15, cache_bytes=cache_bytes, rebuild=counted))
        samples.append([])
        for turn in range(60):
            play.step([turn % 6 == 5])
            samples[-1].append(play.buffer.sample(8))
            assert play.buffer.cache.nbytes <= cache_bytes
            assert play.buffer.cache.nbytes == 96 * len(play.buffer.cache)
        assert (len(play.buffer.cache) > 0) == (cache_bytes >= 96)
        rebuilt.append(len(calls))
    # With room for all of them, each turn is rebuilt once; with none, whenever it is asked for.
    assert rebuilt[0] <= (70 if limit == 1 << 29 else 960) and rebuilt[1] - rebuilt[0] == 960
    for one, two in zip(*samples):
        assert torch.equal(one.actions, two.actions) and torch.equal(one.rewards, two.rewards)
        for name in SPACE:
            assert torch.equal(one.observations[name], two.observations[name])
            assert torch.equal(one.next_observations[name], two.next_observations[name])


def test_a_million_transitions_and_the_cache_fit_in_two_gigabytes(small_agent):
    words = len(no_bits(12000))
    buffer = TurnReplay(1_000_000, encoded_space(small_agent, 4), action_space(4), 'cpu', 16,
                        rebuild=lambda known: {}, words=words)
    assert words == 188
    assert buffer.slots * 16 * words * 8 < buffer.nbytes
    assert 0 < buffer.cache.limit < 2e9 - buffer.nbytes
    assert buffer.slots * 16 >= 1_000_000 * 31 / 30


def test_stored_keys_come_back_with_half_precision(unturned):
    space = gym.spaces.Dict({
        **SPACE.spaces, 'extra': gym.spaces.Box(-9.0, 9.0, (4, 2), np.float32),
        'index': gym.spaces.Box(0, 30000, (3,), np.int16)})
    buffer = TurnReplay(50, space, action_space(2), 'cpu', 2, rebuild=numbered, words=3,
                        stored=('extra', 'index'))
    rng = np.random.default_rng(0)
    extra = rng.normal(size=(12, 2, 4, 2)).astype(np.float32)
    index = rng.integers(30000, size=(12, 2, 3)).astype(np.int16)
    for turn in range(11):
        before, after = ({'extra': extra[t], 'index': index[t]} for t in (turn, turn + 1))
        number = 2 * turn + np.arange(2)
        buffer.add(before, after, np.zeros((2, 4)), number, [False] * 2, [
            {'before': made_up(n), 'after': made_up(n + 2)} for n in number.tolist()])
    assert buffer.pos.tolist() == [12, 12]
    batch = buffer.sample(60)
    for row, number in enumerate(batch.rewards[:, 0].long().tolist()):
        for moment, observation in enumerate((batch.observations, batch.next_observations)):
            turn, env = number // 2 + moment, number % 2
            np.testing.assert_allclose(observation['extra'][row], extra[turn, env], rtol=1e-3)
            assert np.array_equal(observation['index'][row], index[turn, env])
    assert batch.observations['extra'].dtype == torch.float32
    assert buffer.stored['extra'].dtype == np.float16


@pytest.mark.parametrize(('kwargs', 'message'), [
    ({'stored': ('pints',)}, r"stored: found \['pints'\]; expected keys of the observation"),
    ({'optimize_memory_usage': True}, 'optimize_memory_usage: found True; expected False')])
def test_settings_that_contradict_each_other_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        made_up_replay(10, **kwargs)


def test_what_does_not_fit_is_refused_and_nothing_is_written():
    buffer = made_up_replay(10)
    with pytest.raises(ValueError, match='replay: found no transition'):
        buffer.sample(1)
    good = made_up(1)
    for info, message in [
            ({'before': good}, r"infos: found \['before'\]; expected before and after"),
            ({'before': good, 'after': good._replace(positions=np.zeros((3, 3)))},
             r'positions: found shape \(3, 3\); expected \(2, 3\)')]:
        with pytest.raises(ValueError, match=message):
            buffer.add({}, {}, np.zeros((1, 4)), [0.0], [False], [info])
    assert buffer.pos[0] == 0
    odd = Play(made_up_replay(10, rebuild=lambda known: {'points': np.zeros(3)}))
    odd.step([False])
    with pytest.raises(ValueError, match=r"rebuild: found the keys \['points'\]; expected "):
        odd.buffer.sample(1)


class Recorded:
    """
    An encoded environment that is played at random and records what there was to know.

    :ivar played: by its reward's and action's bytes, each transition: the encoded observations
        before and after, and whether it was the last.
    """

    def __init__(self, scenes, turns, agent, played):
        config = replace(SIMULATION, episode=EpisodeConfig(turns=turns))
        self.env = EncodedObservation(CameraPlacementEnv(
            scenes, config, 128, fewest=2, rotations=ROTATIONS), agent)
        self.played, self.episodes = played, 0
        self.env.action_space.seed(turns)
        self.begin()

    def begin(self):
        """Begin an episode, in each scene in its turn."""
        options = {'scene': self.episodes % 2, 'cameras': 2 + self.episodes % 3}
        self.seen, _ = self.env.reset(seed=self.episodes, options=options)
        self.episodes += 1

    def step(self):
        """Play a turn: return action, reward, whether it was the last, and the info."""
        action, before = self.env.action_space.sample(), self.seen
        self.seen, reward, _, done, info = self.env.step(action)
        self.played[key(action, reward)] = before, self.seen, done
        if done:
            self.begin()
        return action, reward, done, info


def key(action, reward):
    """Return by what a transition is found again."""
    return np.asarray(action, np.float32).tobytes() + np.float32(reward).tobytes()


@pytest.fixture(scope='module')
def rooms(room):
    """Return two rooms with different numbers of points."""
    return [room, made_room(9, 1200)]


def recorded(rooms, agent, size=400, steps=40):
    """
    Return a replay of two environments with episodes of 6 and 4 turns, and what was played.

    It has to make room for the scenes: it begins with a single word for each turn.
    """
    played = {}
    environments = [Recorded(rooms, turns, agent, played) for turns in (6, 4)]
    rebuild = Rebuild(lambda number: turned(rooms[number // 2], ROTATIONS[number % 2]), agent)
    buffer = TurnReplay(size, encoded_space(agent, 4), action_space(4), 'cpu', 2, rebuild=rebuild,
                        words=1)
    for _ in range(steps):
        action, reward, done, infos = zip(*[env.step() for env in environments])
        buffer.add({}, {}, np.stack(action), np.array(reward), np.array(done), list(infos))
    return buffer, played


@pytest.mark.parametrize('size', [400, 30])
def test_rebuilt_observations_are_equal_bit_for_bit(rooms, cloud_agent, size, unturned):
    buffer, played = recorded(rooms, cloud_agent, size)
    if size == 400:
        assert buffer.size() == len(played) == 80
    batch = buffer.sample(300)
    found = set()
    for row in range(300):
        name = key(batch.actions[row].numpy(), batch.rewards[row].item())
        before, after, done = played[name]
        found.add(name)
        assert bool(batch.dones[row]) == done
        for observation, expected in ((batch.observations, before),
                                      (batch.next_observations, after)):
            assert observation.keys() == expected.keys()
            for part, value in expected.items():
                assert observation[part][row].numpy().dtype == value.dtype
                assert np.array_equal(observation[part][row].numpy(), value), part
    assert len(found) > 0.9 * buffer.size()


def test_each_sample_is_what_was_played_but_for_one_symmetry(rooms, cloud_agent):
    buffer, played = recorded(rooms, cloud_agent, steps=1)
    batch = buffer.sample(16)
    stored = {float(buffer.rewards[0, env]): buffer.actions[0, env] for env in range(2)}
    seen = {float(np.frombuffer(name[-4:], np.float32)[0]): known
            for name, known in played.items()}
    for row, reward in enumerate(batch.rewards[:, 0].tolist()):
        before, after = ({name: torch.from_numpy(value)[None] for name, value in known.items()}
                         for known in seen[reward][:2])
        assert any(
            torch.equal(batch.observations['points'][row],
                        turn_observation(before, maps)['points'][0])
            and torch.equal(batch.next_observations['cameras'][row],
                            turn_observation(after, maps)['cameras'][0])
            and torch.allclose(batch.actions[row].view(4, 2),
                               torch.from_numpy(stored[reward]).view(4, 2) @ maps.matrices[0].T)
            for maps in (Symmetries.of(torch.tensor([number]))
                         for number in range(len(SYMMETRIES))))
