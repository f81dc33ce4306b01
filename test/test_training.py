# SPDX-License-Identifier: Apache-2.0
"""Training: replay, augmentation, SAC, transitions, learner, evaluation and whole runs."""

from dataclasses import replace
import json
import time

from conftest import assert_same, random_checkpoint
import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.buffers import DictReplayBuffer
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
import torch

from ocp_ros.agent.checkpoint import Checkpoint, CheckpointError
from ocp_ros.agent.observation import encode
from ocp_ros.agent.policy import Policy
from ocp_ros.cli import main
from ocp_ros.configuration import from_nested
from ocp_ros.simulation.config import EngineConfig, EpisodeConfig, SimulationConfig
from ocp_ros.simulation.env import CameraPlacementEnv
from ocp_ros.training.augmentation import (
    SymmetricReplayBuffer,
    SYMMETRIES,
    turn,
    turn_observation,
)
from ocp_ros.training.config import SacConfig, TrainingConfig
from ocp_ros.training.evaluation import evaluate, play, random_moves, simulators
from ocp_ros.training.learner import Learner, LearnerConfig
from ocp_ros.training.sac import (
    actor_checkpoint,
    encoded_space,
    EncodedObservation,
    load_actor,
    make_sac,
)
from ocp_ros.training.state import load_state, save_state
from ocp_ros.training.train import act_of, make_rooms, train
from ocp_ros.training.transitions import Assembler, Reward, Transition

SIMULATION = SimulationConfig(engine=EngineConfig(preset='fast', error_rows=16, coverage_cell=1.0),
                              episode=EpisodeConfig(turns=6))
SAC = SacConfig(learning_starts=12, batch_size=8, buffer_size=400, device='cpu')


@pytest.fixture
def env(room, small_agent):
    """Return a small environment that encodes its observations."""
    return EncodedObservation(CameraPlacementEnv([room], SIMULATION, 128), small_agent)


def observation(agent, seed=0, cameras=4):
    """Return an encoded observation of random points in a room around the origin."""
    rng = np.random.default_rng(seed)
    cloud = rng.uniform([-3, -2, 0], [3, 2, 3], (300, 3)).astype(np.float32)
    cameras = rng.uniform([-1, -1, 1.9], [1, 1, 1.9], (cameras, 3))
    return encode(cloud, cameras, np.stack([cloud.min(0), cloud.max(0)]), agent)


def test_observations_fit_their_space(env):
    space = encoded_space(env.agent, 4)
    assert space.contains(env.reset(seed=0)[0])
    assert space.contains(env.step(env.action_space.sample())[0])


@pytest.mark.parametrize('number', range(8))
def test_a_symmetry_is_what_the_turned_room_would_have_given(small_agent, number):
    matrix = SYMMETRIES[number].numpy()
    rng = np.random.default_rng(1)
    cloud = rng.uniform([-3, -2, 0], [3, 2, 3], (300, 3)).astype(np.float32)
    cameras = rng.uniform([-1, -1, 1.9], [1, 1, 1.9], (4, 3))
    turned_cloud, turned_cameras = cloud.copy(), cameras.copy()
    turned_cloud[:, :2], turned_cameras[:, :2] = cloud[:, :2] @ matrix.T, cameras[:, :2] @ matrix.T

    def encoded(points, positions):
        return encode(points, positions, np.stack([points.min(0), points.max(0)]), small_agent)

    batch = {n: torch.from_numpy(v)[None] for n, v in encoded(cloud, cameras).items()}
    found = turn_observation(batch, SYMMETRIES[number][None])
    expected = encoded(turned_cloud, turned_cameras)
    for name, value in expected.items():
        np.testing.assert_allclose(found[name][0].numpy(), value, atol=1e-5, err_msg=name)


def test_symmetries_are_eight_and_keep_lengths():
    assert len({tuple(m.flatten().tolist()) for m in SYMMETRIES}) == 8
    vectors = torch.randn(8, 4, 2)
    torch.testing.assert_close(turn(vectors, SYMMETRIES).norm(dim=-1), vectors.norm(dim=-1))


def turned(encoded, matrix):
    """Apply a symmetry to one observation."""
    batch = {name: torch.from_numpy(value)[None] for name, value in encoded.items()}
    return turn_observation(batch, matrix[None])


def test_the_replay_gives_back_what_was_stored_but_for_a_symmetry(env, small_agent):
    model = make_sac(SAC, small_agent, 4, env)
    before, _ = env.reset(seed=0)
    action = np.linspace(-0.9, 0.8, 8, dtype=np.float32).reshape(4, 2)
    after, reward, _, _, info = env.step(action)
    model.replay_buffer.add(*({n: v[None] for n, v in o.items()} for o in (before, after)),
                            action[None], np.array([reward]), np.array([False]), [info])
    batch = model.replay_buffer.sample(16)
    assert (batch.rewards == np.float32(reward)).all()
    for index in range(16):
        # One and the same symmetry turns the observation, the action and what followed.
        assert any(
            torch.equal(batch.observations['points'][index], turned(before, matrix)['points'][0])
            and torch.equal(batch.next_observations['cameras'][index],
                            turned(after, matrix)['cameras'][0])
            and torch.allclose(batch.actions[index].view(4, 2),
                               torch.from_numpy(action) @ matrix.T)
            for matrix in SYMMETRIES)


def test_the_policy_gives_sacs_own_actions(env, small_agent, room):
    model = make_sac(SAC, small_agent, 4, env, seed=3)
    policy = Policy(actor_checkpoint(model, small_agent, 'r', {}))
    observation, _ = env.reset(seed=0)
    expected, _ = model.predict(observation, deterministic=True)
    episode = env.unwrapped.episode
    found = policy.act(episode.observed_cloud, episode.turn.positions)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_the_target_entropy_is_per_component_of_the_action(small_agent):
    assert make_sac(SAC, small_agent, 3).target_entropy == SAC.target_entropy * 6


def test_weights_go_into_sac_and_come_out(small_agent):
    model = make_sac(SAC, small_agent, 4)
    start = random_checkpoint(small_agent, seed=5)
    load_actor(model, start)
    found = actor_checkpoint(model, small_agent, 'r', {}).weights
    assert all(torch.equal(found[name], value) for name, value in start.weights.items())
    other = random_checkpoint(type(small_agent)())
    with pytest.raises(CheckpointError, match="expected the trainer's own agent settings"):
        load_actor(model, other)


def test_the_same_seed_is_the_same_training(room, small_agent):
    def run():
        env = EncodedObservation(CameraPlacementEnv([room], SIMULATION, 128), small_agent)
        model = make_sac(SAC, small_agent, 4, env, seed=9)
        model.learn(40)
        return actor_checkpoint(model, small_agent, 'r', {}).weights

    one, two = run(), run()
    assert all(torch.equal(one[name], value) for name, value in two.items())


def test_training_resumes_where_it_stopped(env, small_agent, tmp_path):
    model = make_sac(SAC, small_agent, 4, env, seed=1)
    model.learn(30)
    save_state(model, tmp_path / 's.safetensors', 'abc')
    other = make_sac(SAC, small_agent, 4, env, seed=2)
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
        load_state(make_sac(SAC, type(small_agent)(), 4), tmp_path / 's.safetensors')
    (tmp_path / 's.safetensors').write_bytes(b'torn')
    with pytest.raises(CheckpointError, match='no training state'):
        load_state(other, tmp_path / 's.safetensors')


class Bandit(gym.Env):
    """One turn; moving every camera towards +x is all that pays."""

    def __init__(self, agent):
        self.observation_space = encoded_space(agent, 2)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2, 2), np.float32)
        self.seen = observation(agent, cameras=2)

    def reset(self, *, seed=None, options=None):
        """Begin."""
        return self.seen, {}

    def step(self, action):
        """Pay and end."""
        return self.seen, float(action[:, 0].sum()), True, False, {}


def test_a_trivially_solvable_task_is_learned(small_agent, monkeypatch):
    sac = SacConfig(learning_starts=50, batch_size=32, buffer_size=1000, learning_rate=3e-3,
                    gamma=0.0, entropy=0.01, target_entropy=-3.0, device='cpu')
    env = Bandit(small_agent)
    model = make_sac(sac, small_agent, 2, env, seed=0)
    # The symmetries of a room are none of this task's.
    monkeypatch.setattr(SymmetricReplayBuffer, 'sample', DictReplayBuffer.sample)
    model.learn(400)
    action, _ = model.predict(env.seen, deterministic=True)
    assert action[:, 0].min() > 0.7


def transition(agent, seed=0, cameras=4):
    """Return a made-up transition."""
    return Transition(observation(agent, seed, cameras), np.zeros((cameras, 2), np.float32), 1.0,
                      observation(agent, seed + 1, cameras), False)


def until(predicate, learner, timeout=60.0):
    """Let a learner's thread work until something has happened."""
    deadline = time.monotonic() + timeout
    while not predicate():
        assert time.monotonic() < deadline, 'nothing happened within the time limit'
        learner._thread.join(timeout=0.05)


def test_a_learner_trains_from_transitions_and_leaves_whole_checkpoints(small_agent, tmp_path):
    config = LearnerConfig(folder=str(tmp_path), publish_every=4, save_every=8)
    learner = Learner(config, small_agent, SAC)
    for seed in range(40):
        learner.add(transition(small_agent, seed))
    until(lambda: learner.updates >= 28, learner)
    replay = learner.model.replay_buffer
    assert (replay.rewards[:40] == 1.0).all() and not replay.dones[:40].any()
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
    again = Learner(config, small_agent, SAC)
    assert (again.run, again.updates) == (learner.run, 28)
    again.close()


def test_a_learner_reports_its_failure(small_agent, tmp_path):
    learner = Learner(LearnerConfig(folder=str(tmp_path)), small_agent, SAC)
    learner.add(transition(type(small_agent)()))
    until(lambda: learner.failure is not None, learner)
    learner.close()


def test_transitions_are_assembled_in_any_order_of_their_parts(small_agent):
    positions = np.zeros((2, 3))
    after = positions + [0.25, 0.0, 0.0]
    parts = [lambda a: a.add_turn(1, {'n': 1}, positions),
             lambda a: a.add_turn(2, {'n': 2}, after), lambda a: a.add_command(1, after),
             lambda a: a.add_reward(Reward(1, 2, 0.5, False))]
    for order in ([0, 1, 2, 3], [3, 2, 1, 0], [2, 0, 3, 1]):
        assembler = Assembler(max_step=0.5)
        found = [t for k in order for t in parts[k](assembler)]
        assert len(found) == 1
        assert found[0].observation == {'n': 1} and found[0].next_observation == {'n': 2}
        np.testing.assert_allclose(found[0].actions, [[0.5, 0.0]] * 2)
        assert (found[0].reward, found[0].terminated) == (0.5, False)
        # Sent again, they make no second one.
        assert not [t for k in order for t in parts[k](assembler)]


def test_incomplete_transitions_are_dropped_and_counted():
    assembler = Assembler(max_step=0.5, patience=8)
    positions = np.zeros((2, 3))
    for stamp in range(1, 101):
        assembler.add_turn(stamp, {}, positions)
        if stamp % 5:
            assembler.add_command(stamp, positions)
        if stamp > 1:
            assembler.add_reward(Reward(stamp - 1, stamp, 0.0, False))
    # Every fifth command was lost; the last of those may still come.
    assert assembler.assembled == 80
    assert assembler.incomplete == 18
    assembler.clear()
    assert assembler.incomplete == 19


def test_a_turn_that_another_command_made_is_no_transition():
    assembler = Assembler(max_step=0.5)
    assembler.add_turn(1, {}, np.zeros((2, 3)))
    assembler.add_turn(2, {}, np.ones((2, 3)))
    assembler.add_command(1, np.zeros((2, 3)))
    assert assembler.add_reward(Reward(1, 2, 0.0, False)) == []
    assert assembler.inconsistent == 1


def test_evaluation_starts_everybody_from_the_same_place(room):
    engines = simulators([room], SIMULATION)
    still = play(lambda cloud, positions, rng: np.zeros((4, 2)), engines[0], seed=3)
    moved = play(random_moves, engines[0], seed=3)
    assert still.depth_error_start == still.depth_error_end == moved.depth_error_start
    assert moved.depth_error_end != moved.depth_error_start
    assert evaluate(random_moves, engines, 3)['depth_error_end'] == moved.depth_error_end


TINY = {'interactions': 48, 'environments': 2, 'evaluate_every': 24,
        'rooms': {'training': 1, 'validation': 1, 'test': 1, 'points': 1500},
        'simulation': {'engine': {'preset': 'fast', 'error_rows': 16, 'coverage_cell': 1.0},
                       'episode': {'turns': 6}},
        'agent': {'points': 64, 'keys_1': 8, 'group_1': 4, 'keys_2': 4, 'group_2': 4,
                  'channels': 8, 'hidden': 16},
        'sac': {'learning_starts': 12, 'batch_size': 8, 'buffer_size': 400, 'device': 'cpu'}}


def test_a_run_reports_on_rooms_it_never_saw_and_goes_on_when_it_is_started_again(tmp_path):
    config = from_nested(TrainingConfig, TINY)
    first = train(config, tmp_path)
    assert first.provenance['test']['rooms'] == 1
    config_of_test = replace(config.simulation, engine=replace(
        config.simulation.engine, preset='fine'))
    engines = simulators(make_rooms(config, 'test'), config_of_test)
    lines = first.provenance['curve']
    best = min(lines, key=lambda line: line['ratio'])
    assert first.provenance['interactions'] == best['interactions']
    figures = first.provenance['test']
    assert figures['policy'] == evaluate(act_of(Policy(first)), engines)
    assert figures['random_moves'] == evaluate(random_moves, engines)
    lines = [json.loads(line) for line in (tmp_path / 'progress.jsonl').read_text().splitlines()]
    assert [line['interactions'] for line in lines] == [24, 48]
    longer = train(from_nested(TrainingConfig, {**TINY, 'interactions': 80}), tmp_path)
    assert longer.run == first.run
    curve = longer.provenance['curve']
    assert [line['interactions'] for line in curve] == [24, 48, 72, 80]
    assert np.all(np.diff([line['seconds'] for line in curve]) >= 0.0)
    # After going on, the replay is filled anew before anything is learned from it.
    assert curve[-1]['updates'] == curve[1]['updates'] + (80 - 48 - 12)


def test_ocp_train_writes_a_model_that_runs(tmp_path, capsys, room):
    import yaml
    (tmp_path / 'c.yaml').write_text(yaml.safe_dump(TINY))
    model = tmp_path / 'm.safetensors'
    assert main(['train', '--config', str(tmp_path / 'c.yaml'), '--out', str(tmp_path / 'run'),
                 '--model', str(model)]) == 0
    assert 'random_moves' in capsys.readouterr().out
    moves = Policy(Checkpoint.load(model)).act(room.points, room.bounds.mean(0)[None])
    assert np.isfinite(moves).all()


@pytest.mark.parametrize(('text', 'words'), [
    ('interactionss: 3', "did you mean 'interactions'"),
    ('interactions: many', "found 'many'"),
    ('sac: {gamma: 1.5}', 'sac.gamma: found 1.5; expected 0.0 to 1.0')])
def test_ocp_tells_what_is_wrong_in_one_line(tmp_path, capsys, text, words):
    (tmp_path / 'c.yaml').write_text(text)
    code = main(['train', '--config', str(tmp_path / 'c.yaml'), '--out', str(tmp_path / 'run')])
    error = capsys.readouterr().err
    assert code == 2 and words in error and error.count('\n') == 1
    assert 'c.yaml' in error


def test_encoded_observations_are_equal_bit_for_bit(env, small_agent):
    seen, _ = env.reset(seed=4)
    episode = env.unwrapped.episode
    cloud = episode.observed_cloud
    again = encode(cloud, episode.turn.positions.astype(np.float32),
                   np.stack([cloud.min(0), cloud.max(0)]), small_agent)
    assert_same(seen, again)
