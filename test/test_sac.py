# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Soft actor-critic: what it is shown, what it stores, what it learns."""

from dataclasses import replace
import os
import subprocess
import sys

from conftest import assert_same, batch, HUNG, made_room, observation, random_checkpoint, ROOT
import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv
import torch

from ocp_ros.agent.checkpoint import CheckpointError
from ocp_ros.agent.encoder import Encoder
from ocp_ros.agent.move_effects import WAYS
from ocp_ros.agent.policy import Policy
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.simulation.environment import CameraPlacementEnv
from ocp_ros.simulation.reward import potential
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.training.augmentation import (
    symmetric,
    SymmetricReplayBuffer,
    SYMMETRIES,
    Symmetries,
    turn,
    turn_observation,
)
from ocp_ros.training.encoded_environment import (
    CameraByCamera,
    encoded_space,
    EncodedObservation,
    padded,
)
from ocp_ros.training.sac import actor_checkpoint, load_actor, make_sac
from ocp_ros.training.sac_state import load_state, save_state
from ocp_ros.training.training_config import SacConfig

SIMULATION = SimulationConfig(engine=EngineConfig(preset='fast', error_rows=16, coverage_cell=1.0),
                              episode=EpisodeConfig(turns=6))
SAC = SacConfig(learning_starts=12, batch_size=8, buffer_size=400, device='cpu')


def environment(room, agent, **options):
    """Return a small environment that encodes its observations."""
    return EncodedObservation(CameraPlacementEnv([room], SIMULATION, 128, **options), agent)


@pytest.fixture(autouse=True)
def logs(tmp_path, monkeypatch):
    """Let stable-baselines3 leave its logs where they are cleared away."""
    monkeypatch.setenv('SB3_LOGDIR', str(tmp_path / 'sb3'))


@pytest.fixture
def env(room, agent):
    """Return such an environment for each kind of inputs."""
    return environment(room, agent)


@pytest.mark.parametrize('fewest', [1, 4])
def test_observations_fit_their_space(room, agent, fewest):
    env = environment(room, agent, fewest=fewest)
    space = encoded_space(agent, 4)
    counts = set()
    for seed in range(8):
        found, _ = env.reset(seed=seed)
        counts.add(int(found['present'].sum()))
        assert space.contains(found) and space.contains(env.step(env.action_space.sample())[0])
        missing = found['present'] == 0.0
        for name in {'cameras', 'directions', 'own'} & found.keys():
            assert not found[name][missing].any() and found[name][~missing].any()
    assert counts == {4} if fewest == 4 else len(counts) > 2


def seen_turned(scene, agent, matrix):
    """Encode the second turn of an episode in a room that was turned or mirrored."""
    whole = np.eye(3)
    whole[:2, :2] = matrix
    middle = np.append(scene.bounds.mean(axis=0)[:2], 0.0)
    cloud = ((scene.points - middle) @ whole.T).astype(np.float32)
    positions = np.array([[0.0, 0.0, 1.9], [1.0, 0.3, 1.9], [-0.8, 0.5, 1.9], [0.3, -0.9, 1.9]])
    moves = np.array([[0.1, 0.2, 0.0], [-0.3, 0.1, 0.0], [0.0, 0.4, 0.0], [0.0, 0.0, 0.0]])
    encoder = Encoder(agent)
    encoder(cloud, positions @ whole.T, 0, 30)
    return encoder(cloud, (positions + moves) @ whole.T, 1, 30)


@pytest.mark.system
@pytest.mark.parametrize('number', range(8))
def test_a_symmetry_is_what_the_turned_room_would_have_given(agent, number):
    scene = made_room(8, 5000)
    straight = seen_turned(scene, agent, np.eye(2))
    found = turn_observation(batch(straight), Symmetries.of(torch.tensor([number])))
    expected = seen_turned(scene, agent, SYMMETRIES[number].numpy())
    assert found.keys() == expected.keys()
    for name in expected.keys() - {'directions', 'own'}:
        np.testing.assert_allclose(found[name][0].numpy(), expected[name], atol=1e-5,
                                   err_msg=name)
    if agent.world:
        one, other = found['directions'][0].numpy(), expected['directions']
        # Where others are and how cameras moved is exact; the rest is asked on grids.
        for column in (-4, -3, -1):
            np.testing.assert_allclose(one[..., column], other[..., column], atol=1e-5)
        for column in (0, 1, 3):
            pair = one[..., column:-4:4].ravel(), other[..., column:-4:4].ravel()
            assert np.corrcoef(*pair)[0, 1] > 0.9
        assert (one[..., 2:-4:4] == other[..., 2:-4:4]).mean() > 0.95
        np.testing.assert_allclose(one[..., -2], other[..., -2], atol=0.1)
        np.testing.assert_allclose(found['own'][0].numpy(), expected['own'], atol=0.05)


def test_symmetries_are_eight_and_keep_lengths():
    assert len({tuple(m.flatten().tolist()) for m in SYMMETRIES}) == 8
    vectors = torch.randn(8, 4, 2)
    torch.testing.assert_close(turn(vectors, SYMMETRIES).norm(dim=-1), vectors.norm(dim=-1))


@pytest.mark.parametrize('number', range(8))
def test_directions_are_shifted_as_the_plane_is_turned(number):
    maps, ways = Symmetries.of(torch.tensor([number])), torch.tensor(WAYS, dtype=torch.float32)
    # What is told of a direction is told of the direction that the symmetry makes of it.
    told = turn_observation({'directions': turn(ways[None, None], maps.matrices)}, maps)
    torch.testing.assert_close(told['directions'][0, 0], ways)


def turned(encoded, number):
    """Apply a symmetry to one observation."""
    return turn_observation(batch(encoded), Symmetries.of(torch.tensor([number])))


def test_the_replay_gives_back_what_was_stored_but_for_a_symmetry(env, agent):
    model = make_sac(SAC, agent, 4, env)
    before, _ = env.reset(seed=0)
    action = np.linspace(-0.9, 0.8, 8, dtype=np.float32).reshape(4, 2)
    after, reward, _, _, info = env.step(action)
    model.replay_buffer.add(*({n: v[None] for n, v in o.items()} for o in (before, after)),
                            action[None], np.array([reward]), np.array([False]), [info])
    drawn = model.replay_buffer.sample(40)
    assert (drawn.rewards == np.float32(reward)).all()

    def is_turned(found, encoded, number, index):
        expected = turned(encoded, number)
        return all(torch.equal(found[name][index], value[0].to(found[name].dtype))
                   for name, value in expected.items())

    numbers = set()
    for index in range(40):
        # One and the same symmetry turns the observation, the action and what followed.
        fitting = [number for number in range(8)
                   if is_turned(drawn.observations, before, number, index)
                   and is_turned(drawn.next_observations, after, number, index)
                   and torch.allclose(drawn.actions[index].view(4, 2),
                                      torch.from_numpy(action) @ SYMMETRIES[number].T)]
        assert len(fitting) == 1
        numbers.update(fitting)
    assert len(numbers) > 5


def test_an_expert_would_say_the_same_in_the_turned_room(agent):
    """A symmetry maps the actions of a batch as it maps where the cameras are."""
    rng = np.random.default_rng(0)
    encoded = batch(*[padded(observation(agent, 3, seed), 4) for seed in range(16)])
    actions = torch.from_numpy(rng.uniform(-1.0, 1.0, (16, 8)).astype(np.float32))

    class Batch:
        """What a replay buffer draws."""

        def __init__(self, **parts):
            self.__dict__.update(parts)

        def _replace(self, **parts):
            return Batch(**{**self.__dict__, **parts})

    np.random.seed(0)
    drawn = symmetric(Batch(observations=encoded, next_observations=encoded, actions=actions))
    for index in range(16):
        fitting = [matrix for matrix in SYMMETRIES if torch.allclose(
            drawn.actions[index].view(4, 2), actions[index].view(4, 2) @ matrix.T)]
        assert len(fitting) == 1
        if agent.cloud:
            torch.testing.assert_close(
                drawn.observations['cameras'][index, :, :2],
                encoded['cameras'][index, :, :2] @ fitting[0].T)


def wrapped(room, agent, simulation=SIMULATION, **options):
    """Return an environment as training plays in it, and how many cameras it shows at once."""
    env = CameraPlacementEnv([room], simulation, 128, **options)
    if agent.world:
        return CameraByCamera(env, agent), 1
    return EncodedObservation(env, agent), simulation.rig.cameras


def played_by_sac(model, env, seen):
    """Play a turn; return what was seen and the moves made, in units of the longest step."""
    episode = env.unwrapped.episode
    cloud, positions, step = episode.observed_cloud, episode.turn.positions, episode.turn.step
    while episode.turn.step == step:
        action, _ = model.predict(seen, deterministic=True)
        seen, _, _, truncated, _ = env.step(action)
    moves = (episode.turn.positions - positions)[:, :2] / episode.config.max_step
    return (cloud, positions, step), moves, seen, truncated


def test_the_policy_gives_sacs_own_actions(room, agent):
    env, cameras = wrapped(room, agent)
    model = make_sac(SAC, agent, cameras, env, seed=3)
    policy = Policy(actor_checkpoint(model, 'r', {}))
    (seen, _), truncated, longest = env.reset(seed=0), False, 0.0
    while not truncated:
        one = {name: value for name, value in seen.items() if name != 'present'}
        np.testing.assert_allclose(policy.choose(one), model.predict(seen, deterministic=True)[0],
                                   atol=1e-5)
        drawn = torch.rand(1, cameras, 2) - 0.5
        own, moves = policy.actor(batch(one)), model.policy.actor.moves(batch(seen))[0]
        torch.testing.assert_close(moves.log_prob(drawn), own.log_prob(drawn), rtol=1e-4,
                                   atol=1e-4)
        (cloud, positions, step), expected, seen, truncated = played_by_sac(model, env, seen)
        found = policy.act(cloud, positions, step, 6)
        # What is longer than the longest step is shortened by the environment.
        length = np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1.0)
        np.testing.assert_allclose(found / length, expected, atol=1e-5)
        longest = max(longest, np.abs(expected).max())
    assert longest > 0.05


ALONE = """
import sys
import numpy as np
from ocp_ros.agent.checkpoint import Checkpoint
from ocp_ros.agent.policy import Policy
for name in sys.argv[1:]:
    told = np.load(name + '.npz')
    policy = Policy(Checkpoint.load(name + '.safetensors'))
    found = policy.act(told['cloud'], told['positions'], 0, 6)
    found /= np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1.0)
    assert np.abs(found - told['expected']).max() <= 1e-5, (name, found, told['expected'])
assert 'stable_baselines3' not in sys.modules and 'gymnasium' not in sys.modules
print('the same without')
"""


@pytest.mark.system
def test_weights_run_without_what_trained_them(room, small_agent, tmp_path):
    names = []
    for inputs in ('world', 'cloud', 'both'):
        agent = replace(small_agent, inputs=inputs)
        env, cameras = wrapped(room, agent)
        model = make_sac(SAC, agent, cameras, env, seed=3)
        seen, _ = env.reset(seed=1)
        names.append(str(tmp_path / inputs))
        actor_checkpoint(model, 'r', {}).save(tmp_path / f'{inputs}.safetensors')
        (cloud, positions, _), expected, *_ = played_by_sac(model, env, seen)
        np.savez(names[-1], cloud=cloud, positions=positions, expected=expected)
    done = subprocess.run([sys.executable, '-c', ALONE, *names], capture_output=True, text=True,
                          cwd=ROOT, env={**os.environ, 'PYTHONPATH': str(ROOT)}, timeout=HUNG)
    assert done.stdout == 'the same without\n', done.stderr


@pytest.fixture
def one_by_one(room, small_agent):
    """Return an environment of two to four cameras that choose one after the other."""
    return CameraByCamera(CameraPlacementEnv([room], SIMULATION, 128, fewest=2), small_agent)


def test_cameras_choose_one_after_the_other_and_nobody_is_always_the_first(one_by_one):
    env, episode = one_by_one, None
    seen, _ = env.reset(seed=2, options={'cameras': 3})
    episode, asked = env.unwrapped.episode, []
    while not episode.turn.truncated:
        before = episode.turn.step
        asked.append(env.camera)
        assert env.observation_space.contains(seen)
        seen, _, terminated, truncated, _ = env.step(env.action_space.sample())
        # The turn is played when all have chosen.
        assert episode.turn.step - before == (len(asked) % 3 == 0)
        assert not terminated and truncated == episode.turn.truncated
    assert len(asked) == 6 * 3
    turns = np.reshape(asked, (6, 3))
    assert (np.sort(turns, axis=1) == [0, 1, 2]).all() and set(turns[:, 0]) == {0, 1, 2}


def test_a_camera_is_told_where_those_before_it_will_be(one_by_one):
    seen = []
    for action in ([1.0, 0.0], [-1.0, 0.0], [-1.0, 0.0]):
        first, _ = one_by_one.reset(seed=2, options={'cameras': 2})
        episode, camera = one_by_one.unwrapped.episode, one_by_one.camera
        before = episode.turn.positions.copy()
        after, *_ = one_by_one.step(np.array([action], dtype=np.float32))
        seen.append(after)
        other = one_by_one.encoded.positions
        np.testing.assert_allclose(other[camera] - before[camera], [0.5 * action[0], 0.0, 0.0],
                                   atol=1e-6)
        np.testing.assert_array_equal(other[1 - camera], before[1 - camera])
    assert_same(seen[1], seen[2])
    assert not np.allclose(seen[0]['directions'][..., -4], seen[1]['directions'][..., -4])
    assert not np.allclose(seen[0]['own'], seen[1]['own'])


def test_the_rewards_of_single_cameras_add_up_to_that_of_the_turn(one_by_one):
    one_by_one.reset(seed=5)
    episode, rng, total, shares = one_by_one.unwrapped.episode, np.random.default_rng(0), 0.0, []

    def worth(turn):
        simulator = episode.simulator
        return potential(turn.space_coverage, turn.depth_error, simulator.volume,
                         simulator.depth_error.worst)

    first = worth(episode.turn)
    while not episode.turn.truncated:
        _, value, *_, info = one_by_one.step(rng.uniform(-0.4, 0.4, (1, 2)).astype(np.float32))
        total += value
        shares.append(value)
        assert info['reward'] == value
    assert total == pytest.approx(worth(episode.turn) - first, abs=1e-9)
    assert np.count_nonzero(shares) > 0.5 * len(shares)


def test_the_density_is_scaled_to_that_of_all_cameras(agent):
    model = make_sac(SAC, agent, 4, seed=0)
    for count in (1, 3, 4):
        encoded = observation(agent, count)
        torch.manual_seed(5)
        drawn, density = model.policy.actor.action_log_prob(batch(padded(encoded, 4)))
        moves = model.policy.actor.moves(batch(padded(encoded, 4)))[0]
        each = moves.log_prob(drawn.unflatten(1, (4, 2)))[0, :count]
        torch.testing.assert_close(density, each.mean()[None] * 4.0)


def test_cameras_that_there_are_not_are_worth_nothing(agent):
    model = make_sac(SAC, agent, 4, seed=0)
    encoded, actions = padded(observation(agent, 2), 4), torch.rand(1, 8)
    values = model.critic(batch(encoded), actions)
    other = actions.clone()
    other[:, 4:] = -1.0
    for value, same in zip(values, model.critic(batch(encoded), other), strict=True):
        torch.testing.assert_close(value, same)
    other[:, :4] = -1.0
    assert not torch.allclose(values[0], model.critic(batch(encoded), other)[0])


def test_the_target_entropy_is_per_component_of_the_action(small_agent):
    assert make_sac(SAC, small_agent, 3).target_entropy == SAC.target_entropy * 6


def test_weights_go_into_sac_and_come_out(agent):
    model = make_sac(SAC, agent, 4)
    start = random_checkpoint(agent, seed=5)
    load_actor(model, start)
    found = actor_checkpoint(model, 'r', {}).weights
    assert all(torch.equal(found[name], value) for name, value in start.weights.items())
    other = random_checkpoint(replace(agent, hidden=8))
    with pytest.raises(CheckpointError, match="expected the trainer's own agent settings"):
        load_actor(model, other)


@pytest.mark.system
@pytest.mark.parametrize('inputs', ['world', 'cloud'])
def test_the_same_seed_is_the_same_training(room, small_agent, inputs):
    """The same seed, the same training: the replay is filled, and learned from in ten episodes."""
    agent = replace(small_agent, inputs=inputs)
    pair = replace(SIMULATION, rig=RigConfig(cameras=2))

    def run():
        env, cameras = wrapped(room, agent, pair, fewest=1, rotations=(0.0, 30.0))
        model = make_sac(SAC, agent, cameras, DummyVecEnv([lambda: env]), seed=9)
        before = actor_checkpoint(model, 'r', {}).weights
        model.learn(60)
        return before, actor_checkpoint(model, 'r', {}).weights

    (before, one), (_, two) = run(), run()
    assert all(torch.equal(one[name], value) for name, value in two.items())
    assert not any(torch.equal(one[name], value) for name, value in before.items())


@pytest.mark.system
def test_training_resumes_where_it_stopped(env, agent, tmp_path):
    model = make_sac(SAC, agent, 4, env, seed=1)
    model.learn(30)
    save_state(model, tmp_path / 's.safetensors', 'abc')
    other = make_sac(SAC, agent, 4, env, seed=2)
    assert load_state(other, tmp_path / 's.safetensors') == 'abc'
    assert (other._n_updates, other.num_timesteps) == (model._n_updates, 30)
    before, after = model.policy.state_dict(), other.policy.state_dict()
    assert all(torch.equal(after[name], value) for name, value in before.items())
    assert torch.equal(model.log_ent_coef, other.log_ent_coef)
    for get in (lambda m: m.critic.optimizer, lambda m: m.actor.optimizer,
                lambda m: m.ent_coef_optimizer):
        before, after = (get(m).state_dict()['state'] for m in (model, other))
        assert before.keys() == after.keys()
        assert all(torch.equal(after[index][slot], value)
                   for index, slots in before.items() for slot, value in slots.items())
    other.learn(5, reset_num_timesteps=False)
    with pytest.raises(CheckpointError, match='no training state for this network'):
        load_state(make_sac(SAC, replace(agent, hidden=8), 4), tmp_path / 's.safetensors')
    (tmp_path / 's.safetensors').write_bytes(b'torn')
    with pytest.raises(CheckpointError, match='no training state'):
        load_state(other, tmp_path / 's.safetensors')


class Bandit(gym.Env):
    """One turn; moving every camera towards +x is all that pays."""

    def __init__(self, agent):
        self.observation_space = encoded_space(agent, 2)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2, 2), np.float32)
        self.seen = padded(observation(agent, cameras=2), 2)

    def reset(self, *, seed=None, options=None):
        """Begin."""
        return self.seen, {}

    def step(self, action):
        """Pay and end."""
        return self.seen, float(action[:, 0].sum()), True, False, {}


@pytest.mark.system
@pytest.mark.parametrize('inputs', ['world', 'cloud'])
def test_a_trivially_solvable_task_is_learned(small_agent, inputs, monkeypatch):
    """Both heads learn it; choices need critics that know something before they settle."""
    agent = replace(small_agent, inputs=inputs)
    sac = SacConfig(learning_starts=50, batch_size=32, buffer_size=1000, learning_rate=3e-3,
                    gamma=0.0, entropy=0.01, target_entropy=-3.0, device='cpu', burn_in=150)
    env = Bandit(agent)
    model = make_sac(sac, agent, 2, env, seed=0, warm=agent.world)
    # The symmetries of a room are none of this task's.
    monkeypatch.setattr(SymmetricReplayBuffer, 'sample', DictReplayBuffer.sample)
    before, _ = model.predict(env.seen, deterministic=True)
    model.learn(450 if agent.world else 400)
    action, _ = model.predict(env.seen, deterministic=True)
    assert before[:, 0].min() < 0.7 < action[:, 0].min()


def test_the_actor_rests_while_its_critics_burn_in(small_agent):
    env = Bandit(small_agent)
    sac = replace(SAC, burn_in=20)
    model = make_sac(sac, small_agent, 2, env, seed=0, warm=True)
    before = actor_checkpoint(model, 'r', {}).weights
    critic = [value.clone() for value in model.critic.parameters()]
    model.learn(SAC.learning_starts + 20)
    rested = actor_checkpoint(model, 'r', {}).weights
    assert model.own_updates == 20
    assert all(torch.equal(rested[name], value) for name, value in before.items())
    assert not all(map(torch.equal, critic, model.critic.parameters()))
    model.learn(10, reset_num_timesteps=False)
    moved = actor_checkpoint(model, 'r', {}).weights
    assert not any(torch.equal(moved[name], value) for name, value in before.items())


def test_encoded_observations_are_equal_bit_for_bit(env, agent):
    encoder = Encoder(agent)
    seen, _ = env.reset(seed=4)
    for _ in range(2):
        episode = env.unwrapped.episode
        again = encoder(episode.observed_cloud, episode.turn.positions, episode.turn.step,
                        episode.config.turns)
        assert_same(seen, padded(again, 4))
        seen, *_ = env.step(env.action_space.sample())
    # The next episode knows nothing of this one.
    other = environment(env.unwrapped.scenes[0], agent)
    assert_same(env.reset(seed=5)[0], other.reset(seed=5)[0])
