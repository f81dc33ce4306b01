# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The inputs of the paper, repaired: what is told of points and cameras, and what is learned."""

from dataclasses import replace
import json

from conftest import assert_same, batch, made_room, ROOT
import numpy as np
import pytest
import torch

from ocp_ros.agent.agent_config import AgentConfig
from ocp_ros.agent.checkpoint import Checkpoint
from ocp_ros.agent.distributions import Choices
from ocp_ros.agent.encoder import Encoder
from ocp_ros.agent.networks import Actor
from ocp_ros.agent.policy import Policy
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.scenes.scene_source import make_room
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.training.augmentation import SYMMETRIES, Symmetries, turn_observation
from ocp_ros.training.demonstration_rounds import ENDS, load_rounds, MOVES, save_round
from ocp_ros.training.demonstrations import demonstrate, fit, Imitation, tasks_of
from ocp_ros.training.encoded_environment import encoded_space, padded
from ocp_ros.training.run_folder import read_config
from ocp_ros.training.sac import actor_checkpoint, make_sac, start_critics
from ocp_ros.training.train import train
from ocp_ros.training.training_config import (
    DemonstrationsConfig,
    RoomsConfig,
    SacConfig,
    TrainingConfig,
)
from ocp_ros.util.settings import ConfigurationError

AGENT = AgentConfig(
    inputs='cloud', others=3, marks=True, centred=True, normed=True, choices=True, points=128,
    keys_1=16, group_1=8, radius_1=2.0, keys_2=8, group_2=8, radius_2=4.0, channels=16, hidden=32,
    pooled=24)
SIMULATION = SimulationConfig(rig=RigConfig(cameras=2), episode=EpisodeConfig(turns=6),
                              engine=EngineConfig(preset='fast', error_rows=16, coverage_cell=1.0))
SAC = SacConfig(learning_starts=12, batch_size=8, buffer_size=400, device='cpu')
CONFIG = TrainingConfig(
    seed=1, fewest_cameras=2, interactions=24, environments=1, updates_per_turn=0.5, workers=1,
    evaluate_every=12, agent=AGENT, simulation=SIMULATION, sac=SAC,
    rooms=RoomsConfig(points=1500, rotations='0', training=2, validation=1, test=1),
    demonstrations=DemonstrationsConfig(rounds=2, episodes=2, expert='lookahead', batch_size=16,
                                        epochs=1, last_epochs=2))


@pytest.fixture(autouse=True)
def logs(tmp_path, monkeypatch):
    """Let stable-baselines3 leave its logs where they are cleared away."""
    monkeypatch.setenv('SB3_LOGDIR', str(tmp_path / 'sb3'))


@pytest.fixture(scope='module')
def cloud():
    """Return the points of a room that is longer than cameras see."""
    return made_room(8, 3000).points


@pytest.fixture(scope='module')
def steps(tmp_path_factory):
    """Return a round of demonstrations."""
    path = tmp_path_factory.mktemp('rounds') / '0000.npz'
    save_round(path, [demonstrate(task) for task in tasks_of(CONFIG, ['1000', '1002'], 0, b'')])
    return load_rounds(path.parent, 1, AGENT)


def turn_of(cloud, positions, agent=AGENT, max_range=2.0):
    """Return an encoded turn of cameras that see so far."""
    return Encoder(agent, max_range, 0.5).turn(cloud, np.array(positions), 3, 30)


def corners(cloud):
    """Return places near two corners of a room, and at both its height."""
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    return [[*(low + 0.8)[:2], 1.5], [*(high - 0.8)[:2], 1.5]]


def test_points_are_marked_by_who_sees_them_now(cloud):
    places = corners(cloud)
    told = turn_of(cloud, places)
    for camera, other in ((0, 1), (1, 0)):
        seen = told.inputs(camera)
        points = AGENT.length_scale * (seen['points'] - seen['cameras'][0])
        away = np.linalg.norm(points, axis=1)
        away_other = np.linalg.norm(points - AGENT.length_scale * seen['others'][0, :3], axis=1)
        own, others = seen['marks'].T
        # Nobody sees farther than the range; next to a camera nothing hides a wall.
        assert not own[away > 2.05].any() and not others[away_other > 2.05].any()
        assert own[away < 1.2].mean() > 0.8 and others[away_other < 1.2].mean() > 0.8
        assert set(np.unique(seen['marks'])) == {0, 1}
        np.testing.assert_allclose(
            AGENT.length_scale * seen['others'][0, :3], np.subtract(places[other], places[camera]),
            atol=1e-5)


def test_a_camera_is_told_what_those_before_it_will_do(cloud):
    places = corners(cloud)
    told = turn_of(cloud, places)
    before = told.inputs(1)
    made = told.move(0, np.array([1.0, 0.0]))
    after = told.inputs(1)
    assert made[0] > 0.5
    np.testing.assert_allclose(after['others'][0, :2] - before['others'][0, :2],
                               made * 0.5 / AGENT.length_scale, atol=1e-5)
    assert before['others'][0].tolist()[3:] == [1.0, 0.0]
    assert after['others'][0].tolist()[3:] == [1.0, 1.0]
    assert not before['others'][1:].any()
    np.testing.assert_array_equal(before['marks'][:, 0], after['marks'][:, 0])
    assert (before['marks'][:, 1] != after['marks'][:, 1]).any()
    for name in ('points', 'groups_1', 'cameras', 'half_size', 'turn'):
        np.testing.assert_array_equal(before[name], after[name])


def test_the_turn_is_told_and_the_nearest_of_more_cameras_than_there_is_room_for(cloud):
    (x, y, z), far = corners(cloud)
    places = [[x + away, y, z] for away in (0.0, 0.9, 0.3, 0.6)] + [far]
    seen = turn_of(cloud, places).inputs(0)
    np.testing.assert_allclose(AGENT.length_scale * seen['others'][:, 0], [0.3, 0.6, 0.9],
                               atol=1e-5)
    time, count, unseen = seen['turn']
    assert (time, count) == (pytest.approx(0.1), pytest.approx(1.25)) and 0.0 < unseen < 1.0


def test_where_nothing_is_seen_nothing_is_marked():
    seen = turn_of(np.zeros((1, 3), np.float32), [[0.0, 0.0, 1.5], [0.5, 0.0, 1.5]]).inputs(0)
    assert not seen['marks'].any() and seen['turn'][2] == 1.0
    assert encoded_space(AGENT, 1).contains(padded(seen, 1))


@pytest.mark.parametrize('seed', [1000, 1002])
def test_nearly_every_point_reaches_a_group(seed):
    scene = make_room(str(seed), 0.0, 6000)
    repaired = read_config(ROOT / 'config' / 'train' / 'cloud.yaml').agent
    shares = []
    for agent in (AgentConfig(inputs='cloud'), repaired):
        place = [*scene.bounds.mean(axis=0)[:2], 1.9]
        seen = turn_of(scene.points, [place], agent, 4.0).inputs(0)
        shares.append(len(np.unique(seen['groups_1'])) / agent.points)
    assert shares[0] < 0.4 and shares[1] > 0.95


def test_the_last_unit_groups_around_the_camera(cloud):
    torch.manual_seed(0)
    # Its head reads the same of the room wherever it is, but for what the units found.
    (one, _), marked = corners(cloud), {}
    for centred in (False, True):
        actor = Actor(replace(AGENT, centred=centred))
        seen = turn_of(cloud, [one, one]).inputs(0)
        moved = seen | {'cameras': seen['cameras'] + np.float32(0.2)}
        features = [actor.extractor.rig.cloud(batch(each)) for each in (seen, moved)]
        marked[centred] = not torch.allclose(*features)
    assert marked == {False: False, True: True}


def test_symmetries_turn_the_ways_to_other_cameras(cloud):
    seen = turn_of(cloud, corners(cloud)).inputs(0)
    for number, matrix in enumerate(SYMMETRIES):
        turned = turn_observation(batch(seen), Symmetries.of(torch.tensor([number])))
        expected = seen['others'].copy()
        expected[:, :2] = expected[:, :2] @ matrix.numpy().T
        np.testing.assert_allclose(turned['others'][0], expected, atol=1e-6)
        np.testing.assert_array_equal(turned['marks'][0], seen['marks'])


def test_a_policy_plays_camera_by_camera_as_it_was_trained(cloud):
    torch.manual_seed(3)
    checkpoint = Checkpoint(AGENT, Actor(AGENT).state_dict())
    policy, places = Policy(checkpoint), np.array(corners(cloud))
    moves = policy.act(cloud, places, 1, 30)
    told = Encoder(AGENT).turn(cloud, places, 1, 30)
    expected = np.zeros_like(moves)
    for camera in (1, 0):
        expected[camera] = told.move(camera, policy.choose(told.inputs(camera))[0])
    np.testing.assert_allclose(moves, expected, atol=1e-6)
    assert isinstance(policy.actor(batch(told.inputs(0))), Choices)


def test_weights_from_before_the_repairs_run_as_they_did(cloud):
    checkpoint = Checkpoint.load(ROOT / 'models' / 'paper.safetensors')
    told = checkpoint.card()['config']
    assert (told['others'], told['marks'], told['choices'], told['normed']) == (0,) + (False,) * 3
    assert not checkpoint.config.one_by_one
    moves = Policy(checkpoint).act(cloud, np.array(corners(cloud)))
    assert moves.shape == (2, 2) and np.isfinite(moves).all()


def test_the_imitation_loss_falls(steps):
    model = make_sac(SAC, AGENT, 1, seed=0)
    shown = Imitation(steps, model.device)

    def loss():
        np.random.seed(0)
        with torch.no_grad():
            return float(shown.loss(model.actor, torch.arange(len(shown))))

    before = loss()
    settings = replace(CONFIG.demonstrations, learning_rate=3e-3)
    fit(model, steps, settings, 40)
    assert loss() < 0.8 * before


def test_the_critics_begin_with_the_features_of_the_actor_and_may_train_them():
    def features(network):
        return network.features_extractor.state_dict()

    model = make_sac(SAC, AGENT, 1, seed=0)
    start_critics(model)
    for critic in (model.critic, model.critic_target):
        assert_same(features(model.actor), features(critic))
    for trains in (False, True):
        sac = replace(SAC, shared_extractor=True, critics_train=trains)
        model = make_sac(sac, AGENT, 1, seed=0)
        assert model.actor.features_extractor is model.critic.features_extractor
        read = torch.ones(1, 1, 2)
        seen = {name: torch.as_tensor(value)[None] for name, value in
                encoded_space(AGENT, 1).sample().items()}
        seen |= {name: torch.zeros_like(seen[name]) for name in seen if seen[name].dtype
                 == torch.int16}
        (model.critic(seen, read.flatten(1))[0] ** 2).sum().backward()
        grown = [one.grad is not None and bool(one.grad.any()) for one in
                 model.critic.features_extractor.parameters()]
        assert any(grown) == trains
        model.policy.zero_grad()
        # The actor's loss reaches the features where the critics' does not.
        model.actor.action_log_prob(seen)[1].sum().backward()
        assert trains != any(one.grad is not None for one in
                             model.actor.features_extractor.parameters())


@pytest.mark.system
def test_a_run_imitates_learns_and_goes_on(tmp_path):
    config = replace(CONFIG, sac=replace(SAC, shared_extractor=True, critics_train=True))
    first = train(config, tmp_path / 'run')
    more = train(replace(config, interactions=48), tmp_path / 'run')
    lines = [json.loads(line) for line in
             (tmp_path / 'run' / 'progress.jsonl').read_text().splitlines()]
    shown = 2 * 2 * 6 * 2
    assert [line['interactions'] for line in lines if line['phase'] == 'sac'] == [
        shown + 12, shown + 24, shown + 36, shown + 48]
    assert lines[-1]['updates'] > lines[0]['updates'] > 0
    assert first.config == more.config == AGENT
    assert actor_checkpoint(make_sac(SAC, AGENT, 1), '', {}).weights.keys() == more.weights.keys()


@pytest.mark.parametrize('changes, words', [
    ({'inputs': 'world', 'marks': False}, "agent.others: found 3 with agent.inputs 'world'"),
    ({'others': 0}, 'agent.marks: found true with agent.others 0')])
def test_settings_that_are_never_read_are_refused(changes, words):
    with pytest.raises(ConfigurationError, match=words):
        replace(AGENT, **changes)


def test_the_greedy_step_shows_a_cloud_the_same_as_what_moves_change():
    """What it says follows from what was seen, whatever the policy reads of it."""
    shown = []
    for agent in (AGENT, AgentConfig()):
        config = replace(CONFIG, agent=agent, demonstrations=replace(
            CONFIG.demonstrations, expert='greedy_step', stray=0.0))
        shown.append(demonstrate(tasks_of(config, ['1000'], 0, b'')[0]))
    np.testing.assert_allclose(shown[0][ENDS], shown[1][ENDS], rtol=0.02)
    assert (np.linalg.norm(shown[0][MOVES] - shown[1][MOVES], axis=-1) < 0.01).mean() > 0.9


JOINT = replace(AgentConfig(), inputs='cloud', joint=2, points=128, keys_1=16, keys_2=8, hidden=32)


def test_a_joint_head_tells_cameras_in_one_place_apart(cloud):
    """Two cameras that read the same get moves of their own; the shared head cannot do this."""
    torch.manual_seed(0)
    together = np.array([[1.0, 0.5, 1.9]] * 2)
    moves = {}
    for joint in (0, 2):
        agent = replace(JOINT, joint=joint)
        policy = Policy(Checkpoint(agent, Actor(agent).state_dict()))
        moves[joint] = policy.act(cloud, together)
    np.testing.assert_array_equal(moves[0][0], moves[0][1])
    assert np.abs(moves[2][0] - moves[2][1]).max() > 1e-3


def test_a_joint_head_serves_one_number_of_cameras(cloud):
    policy = Policy(Checkpoint(JOINT, Actor(JOINT).state_dict()))
    with pytest.raises(ConfigurationError, match='found weights for 2 cameras, and 3 cameras'):
        policy.act(cloud, np.zeros((3, 3)))
    with pytest.raises(ConfigurationError, match='found weights for 2 cameras, and 4 cameras'):
        replace(CONFIG, agent=JOINT, fewest_cameras=2, simulation=SimulationConfig(),
                demonstrations=DemonstrationsConfig())
    for wrong in ({'inputs': 'world'}, {'others': 1}, {'choices': True}):
        with pytest.raises(ConfigurationError, match='agent.joint'):
            replace(JOINT, **wrong)


def test_soft_actor_critic_trains_a_joint_head(tmp_path):
    config = replace(CONFIG, agent=JOINT, demonstrations=DemonstrationsConfig(),
                     evaluate_every=24, sac=replace(SAC, learning_starts=4))
    trained = train(config, tmp_path)
    first = actor_checkpoint(make_sac(SAC, JOINT, 2, seed=1), '', {})
    assert trained.updates > 0
    assert not torch.equal(first.weights['head.out.weight'], trained.weights['head.out.weight'])
