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

"""Soft actor-critic on the networks that read the cloud: what it is shown, stores and learns."""

from dataclasses import replace

from conftest import assert_same, batch, observation, random_checkpoint, ROOT, store
import gymnasium as gym
import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.policy.checkpoint import CheckpointError
from ocp_ros.policy.networks import Extractor, SYMMETRIES, turned_observation
from ocp_ros.policy.policy import Policy
from ocp_ros.simulation.environment import CameraPlacementEnv
from ocp_ros.simulation.simulation_config import EpisodeConfig, RewardConfig, SimulationConfig
from ocp_ros.training.encoded_environment import action_space, cameras_of, encoded_space, playable
from ocp_ros.training.sac import (
    actor_checkpoint,
    actor_weights,
    falling,
    load_actor,
    make_sac,
)
from ocp_ros.training.sac_state import (
    CloudReplayBuffer,
    load_replay,
    load_state,
    save_replay,
    save_state,
)
from ocp_ros.training.training_config import EpisodesConfig, SacConfig
import pytest
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.env_checker import check_env
import torch

SIMULATION = SimulationConfig(engine=EngineConfig(preset='fast', error_rows=16, coverage_cell=1.0),
                              episode=EpisodeConfig(turns=6))
SAC = SacConfig(learning_starts=12, batch_size=8, buffer_size=400, device='cpu')


def environment(room, agent, **options):
    """Return a small environment as training plays in it."""
    return playable(CameraPlacementEnv([room], options.pop('config', SIMULATION), 128, **options),
                    agent)


@pytest.fixture
def env(room, agent):
    """Return such an environment for each network."""
    return environment(room, agent)


def test_the_environment_is_one(env):
    check_env(env, warn=False)
    assert_same(env.reset(seed=5)[0], env.reset(seed=5)[0])


def test_the_replay_gives_back_what_was_stored_but_for_a_symmetry_and_noise(room, small_agent):
    env = environment(room, small_agent)
    model = make_sac(SAC, small_agent, env)
    before, _ = env.reset(seed=0)
    action = np.array([[-0.9, 0.8]], dtype=np.float32)
    after, reward, _, _, info = env.step(action)
    store(model, before, after, action, reward, info=info)
    drawn = model.replay_buffer.sample(40)
    assert (drawn.rewards == np.float32(reward)).all()

    def is_turned(found, encoded, matrix, index):
        expected = turned_observation(batch(encoded), matrix[None])
        # Points are moved by 2 cm (standard deviation), and some of a group are left out.
        return all(set(found[name][index].flatten().tolist()) <= set(value.flatten().tolist())
                   if name.startswith('groups') else torch.allclose(
                       found[name][index], value[0].to(found[name].dtype), rtol=0.0,
                       atol=0.03 if name == 'points' else 0.0)
                   for name, value in expected.items())

    numbers = set()
    for index in range(40):
        # One and the same symmetry turns the observation, the action and what followed.
        (fitting,) = [number for number, matrix in enumerate(SYMMETRIES)
                      if is_turned(drawn.observations, before, matrix, index)
                      and is_turned(drawn.next_observations, after, matrix, index)
                      and torch.allclose(drawn.actions[index],
                                         torch.from_numpy(action[0]) @ matrix.T)]
        numbers.add(fitting)
    assert len(numbers) > 5
    assert len(torch.unique(drawn.observations['points'].abs().sum(dim=(1, 2)))) > 30


def test_rewards_of_some_steps_are_summed_up_within_an_episode(small_agent, tmp_path):
    sac = replace(SAC, n_steps=3, gamma=0.5, buffer_size=100)
    model = make_sac(sac, small_agent)
    seen = observation(small_agent)
    for step in range(6):
        # The second episode begins with the fourth step; the third ends the first by its limit.
        before, after = (seen | {'turn': np.full_like(seen['turn'], turn)}
                         for turn in (step, step + 1))
        store(model, before, after, np.zeros((1, 2)), 10.0 ** step, step in (2, 5),
              {'TimeLimit.truncated': step == 2})
    drawn = DictReplayBuffer.sample(model.replay_buffer, 200)
    first, after = (one['turn'][:, 0].long() for one in (drawn.observations,
                                                         drawn.next_observations))
    sums = torch.tensor([1 + 5 + 25, 10 + 50, 100, 1e3 + 5e3 + 25e3, 1e4 + 5e4, 1e5])
    assert set(first.tolist()) == set(range(6))
    assert torch.equal(drawn.rewards[:, 0], sums[first])
    assert torch.equal(after, torch.where(first < 3, 3, 6))
    assert torch.equal(drawn.discounts[:, 0], 0.5 ** (after - first))
    assert torch.equal(drawn.dones[:, 0], (first > 2).float())
    # Who goes on with what was saved plays another episode.
    model.replay_buffer.dones[5] = 0.0
    save_replay(model.replay_buffer, tmp_path / 'replay.safetensors')
    again = make_sac(sac, small_agent)
    load_replay(again.replay_buffer, tmp_path / 'replay.safetensors')
    store(again, seen, seen, np.zeros((1, 2)), 1e9)
    drawn = DictReplayBuffer.sample(again.replay_buffer, 200)
    assert drawn.rewards[:, 0].unique().tolist() == [*sorted(sums.tolist()), 1e9]
    assert not drawn.dones.any()


def own_action(policy, seen):
    """Return the action of the network itself, without its mean over symmetries."""
    return torch.tanh(policy.actor(batch(seen))[0])[0].unflatten(0, (-1, 2)).detach().numpy()


def test_the_policy_gives_sacs_own_actions(env, agent):
    """In an environment in which a camera knows where those before it will be."""
    model = make_sac(SAC, agent, env, seed=3)
    policy = Policy(actor_checkpoint(model, 'r', {}))
    (seen, _), truncated, longest = env.reset(seed=0), False, 0.0
    episode = env.unwrapped.episode
    while not truncated:
        cloud, before, step = episode.observed_cloud, episode.turn.positions, episode.turn.step
        rng = np.random.default_rng(step)
        while episode.turn.step == step:
            np.testing.assert_allclose(own_action(policy, seen),
                                       model.predict(seen, deterministic=True)[0], atol=1e-5)
            seen, _, _, truncated, _ = env.step(policy.choose(seen, rng))
        expected = (episode.turn.positions - before)[:, :2] / episode.config.max_step
        found = policy.act(cloud, before, step, 6, np.random.default_rng(step))
        # What is longer than the longest step is shortened by the environment.
        length = np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1.0)
        np.testing.assert_allclose(found / length, expected, atol=1e-5)
        longest = max(longest, np.abs(expected).max())
    assert longest > 0.05


def test_cameras_choose_one_after_the_other_and_share_what_the_episode_gained(room, small_agent):
    env = environment(room, small_agent, fewest=2, config=replace(
        SIMULATION, reward=RewardConfig(explored=2.0)))
    env.reset(seed=2, options={'cameras': 3})
    episode, rng, asked, shares, gained = (
        env.unwrapped.episode, np.random.default_rng(0), [], [], 0.0)
    while not episode.turn.truncated:
        before = episode.turn.step
        asked.append(env.camera)
        seen, value, terminated, truncated, info = env.step(
            rng.uniform(-0.4, 0.4, (1, 2)).astype(np.float32))
        shares.append(value)
        assert info['reward'] == value and env.observation_space.contains(seen)
        # The turn is played when all have chosen.
        assert episode.turn.step - before == (len(asked) % 3 == 0)
        if episode.turn.step > before:
            gained += episode.turn.terms.reward
        assert not terminated and truncated == episode.turn.truncated
    turns = np.reshape(asked, (6, 3))
    # No camera is always the first.
    assert (np.sort(turns, axis=1) == [0, 1, 2]).all() and set(turns[:, 0]) == {0, 1, 2}
    assert sum(shares) == pytest.approx(gained, abs=1e-9)
    assert np.count_nonzero(shares) > 0.5 * len(shares)


def test_what_is_drawn_of_an_episode_lies_in_its_range_and_is_told(room, small_agent):
    """The cameras of a rig file play their share of the episodes, with a range of their own."""
    draws = EpisodesConfig(fewest_turns=3, longest_step=2.0, farthest_range=8.0, widest_start=1.5,
                           rig_share=0.4)
    rig = replace(SIMULATION, rig_file=str(ROOT / 'config' / 'rig' / 'four_d455.yaml'))
    env = playable(CameraPlacementEnv([room], SIMULATION, 128, fewest=2), small_agent, draws,
                   CameraPlacementEnv([room], rig, 128))

    def played(seed):
        for number in range(60):
            scalars = env.reset(seed=None if number else seed)[0]['turn']
            episode = env.unwrapped.episode
            now, limits = episode.turn, episode.config
            away = episode.observed_cloud[:, None] - now.positions
            assert np.linalg.norm(away, axis=2).min(axis=1).max() <= 4.0 * scalars[5] + 1e-6
            assert limits.max_turn == np.clip(limits.max_step, 0.5, 1.6)
            assert scalars[[1, 3]] == pytest.approx([len(now.positions) / 4, limits.max_step / 2])
            seen, value, *_ = env.step(np.ones((1, 2), np.float32))
            assert env.observation_space.contains(seen) and np.isfinite(value)
            yield (not episode.problem.rig.free, len(now.positions), limits.turns,
                   limits.max_step, limits.start_radius, 4.0 * scalars[5])

    first, again, other = (np.array(list(played(seed))) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    assert 0.3 < np.mean([first[:, 0], other[:, 0]]) < 0.5
    assert {6.0} == set(first[first[:, 0] == 1, 5])
    # The free cameras, their turns, steps, starts and ranges.
    free = first[first[:, 0] == 0, 1:]
    for values, low, high in zip(
            free.T, (2, 3, 0.5, 0.5, 4.0), (4, 6, 2.0, 1.5, 8.0), strict=True):
        assert low <= values.min() < low + 0.1 * (high - low)
        assert high >= values.max() > high - 0.1 * (high - low)


def test_the_critics_alone_train_the_one_extractor_of_the_cloud(agent):
    """In the network of the paper each trains its own, as stable-baselines3 does."""
    model, seen = make_sac(SAC, agent, seed=0), batch(observation(agent))
    actions = torch.ones(1, int(np.prod(model.action_space.shape)))

    def grown(network):
        return any(one.grad is not None and bool(one.grad.any())
                   for one in network.features_extractor.parameters())

    shared = model.actor.features_extractor is model.critic.features_extractor
    assert shared == agent.one_by_one
    (model.critic(seen, actions)[0] ** 2).sum().backward()
    assert grown(model.critic)
    model.policy.zero_grad()
    drawn, density = model.actor.action_log_prob(seen)
    (density.sum() - model.critic(seen, drawn)[0].sum()).backward()
    assert grown(model.actor) != agent.one_by_one
    assert shared == (id(next(model.actor.features_extractor.parameters())) in map(
        id, model.critic.optimizer.param_groups[0]['params']))


def test_a_gradient_step_reads_each_cloud_once(small_agent, monkeypatch):
    """The batch for all losses, and what followed for the actor and for the target."""
    model, read = make_sac(SAC, small_agent, Bandit(small_agent), seed=0), []
    model.learn(SAC.learning_starts + 2)
    monkeypatch.setattr(Extractor, 'forward', lambda self, seen, forward=Extractor.forward: (
        read.append(len(seen['points'])), forward(self, seen))[1])
    before = [value.clone() for value in model.actor.features_extractor.parameters()]
    model.train(2, SAC.batch_size)
    assert read == 6 * [SAC.batch_size]
    assert not all(map(torch.equal, before, model.actor.features_extractor.parameters()))


def test_residual_heads_act_as_they_were_trained(room, small_agent):
    config = replace(small_agent, blocks=2)
    env = environment(room, config)
    model = make_sac(replace(SAC, bfloat16=True), config, env, seed=3)
    model.learn(SAC.learning_starts + 5)
    seen, _ = env.reset(seed=0)
    np.testing.assert_allclose(own_action(Policy(actor_checkpoint(model, 'r', {})), seen),
                               model.predict(seen, deterministic=True)[0], atol=0.05)


def test_weights_go_into_sac_and_come_out(agent):
    model, start = make_sac(replace(SAC, averaging=9), agent), random_checkpoint(agent, seed=5)
    load_actor(model, start)
    for weights in (actor_weights(model), actor_checkpoint(model, 'r', {}).weights):
        assert_same(start.weights, weights)
    with pytest.raises(CheckpointError, match='agent settings'):
        load_actor(model, random_checkpoint(replace(agent, hidden=8)))


@pytest.mark.system
def test_training_resumes_where_it_stopped(env, agent, tmp_path):
    model, other = (make_sac(SAC, agent, env, seed=seed) for seed in (1, 2))
    model.learn(30)
    save_state(model, tmp_path / 's.safetensors', 'abc')
    assert load_state(other, tmp_path / 's.safetensors') == 'abc'
    assert (other._n_updates, other.num_timesteps) == (model._n_updates, 30)
    assert_same(model.policy.state_dict(), other.policy.state_dict())
    assert torch.equal(model.log_ent_coef, other.log_ent_coef)
    for get in (lambda m: m.critic.optimizer, lambda m: m.actor.optimizer,
                lambda m: m.ent_coef_optimizer):
        before, after = (get(m).state_dict()['state'] for m in (model, other))
        assert before.keys() == after.keys()
        for index, slots in before.items():
            assert_same(slots, after[index])
    other.learn(5, reset_num_timesteps=False)
    with pytest.raises(CheckpointError):
        load_state(make_sac(SAC, replace(agent, hidden=8)), tmp_path / 's.safetensors')


class Bandit(gym.Env):
    """One turn; moving every camera towards +x is all that pays."""

    def __init__(self, agent):
        self.observation_space = encoded_space(agent)
        self.action_space = action_space(cameras_of(agent))
        self.seen = observation(agent)

    def reset(self, *, seed=None, options=None):
        """Begin."""
        return self.seen, {}

    def step(self, action):
        """Pay and end."""
        return self.seen, float(action[:, 0].sum()), True, False, {}


@pytest.mark.system
def test_a_trivially_solvable_task_is_learned(agent, monkeypatch):
    sac = SacConfig(learning_starts=50, batch_size=32, buffer_size=1000, learning_rate=3e-3,
                    gamma=0.0, device='cpu')
    env = Bandit(agent)
    model = make_sac(sac, agent, env, seed=0)
    # The symmetries of a room are none of this task's.
    monkeypatch.setattr(CloudReplayBuffer, 'sample', DictReplayBuffer.sample)
    before, _ = model.predict(env.seen, deterministic=True)
    model.learn(400)
    action, _ = model.predict(env.seen, deterministic=True)
    assert before[:, 0].min() < 0.7 < action[:, 0].min()


def test_the_actor_rests_while_its_critics_burn_in(agent):
    """So does the extractor that they share."""
    model = make_sac(replace(SAC, burn_in=20), agent, Bandit(agent), seed=0, warm=True)
    before, critic = (actor_checkpoint(model, 'r', {}).weights,
                      [value.clone() for value in model.critic.qf0.parameters()])
    model.learn(SAC.learning_starts + 20)
    assert_same(before, actor_checkpoint(model, 'r', {}).weights)
    assert not any(map(torch.equal, critic, model.critic.qf0.parameters()))
    model.learn(10, reset_num_timesteps=False)
    after = actor_checkpoint(model, 'r', {}).weights
    assert not any(torch.equal(after[name], value) for name, value in before.items())


def test_the_weights_that_are_used_are_averaged_and_a_run_that_goes_on_keeps_them(
        small_agent, tmp_path):
    model, other = (make_sac(replace(SAC, averaging=1000), small_agent, Bandit(small_agent),
                             seed=seed) for seed in (0, 1))
    model.learn(SAC.learning_starts + 9)
    before = actor_checkpoint(model, 'r', {}).weights
    model.train(1, SAC.batch_size)
    last, after = actor_weights(model), actor_checkpoint(model, 'r', {}).weights
    # At first the mean is over a tenth of all steps, but one at least.
    share = 1.0 / (1.0 + 0.1 * model._n_updates)
    assert 0.4 < share < 0.6
    for name, value in after.items():
        torch.testing.assert_close(value, before[name].lerp(last[name], share))
        assert not torch.equal(value, last[name])
    save_state(model, tmp_path / 's.safetensors', 'abc')
    load_state(other, tmp_path / 's.safetensors')
    assert_same(after, actor_checkpoint(other, 'r', {}).weights)
    assert_same(last, actor_weights(other))


def test_the_step_size_falls_to_a_tenth_at_the_end():
    step_size = falling(1e-3, 0.6)
    assert [step_size(left) for left in (1.0, 0.4, 0.2, 0.0)] == pytest.approx(
        [1e-3, 1e-3, 5.5e-4, 1e-4])
    assert falling(1e-3, 1.0)(0.0) == 1e-3
