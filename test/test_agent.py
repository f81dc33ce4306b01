# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The agent: observation cache, networks, policy."""

from conftest import around_z, assert_same, batch, box_room, observation, random_checkpoint
from hypothesis import given
from hypothesis import settings as budget
from hypothesis import strategies as st
import numpy as np
import pytest
import torch

from ocp_ros.agent.checkpoint import Checkpoint
from ocp_ros.agent.distributions import Choices
from ocp_ros.agent.encoder import Encoder, order_of
from ocp_ros.agent.move_effects import CHOICES, DIRECTIONS, LONGEST, MOVES
from ocp_ros.agent.networks import (
    Actor,
    CriticHead,
    ExtractionUnit,
    Extractor,
    GaussianHead,
    WIDTH_FIRST,
)
from ocp_ros.agent.observation import encode
from ocp_ros.agent.policy import Policy
from ocp_ros.agent.sampling import ball_query, farthest_points
from ocp_ros.rig.motion import bounded_moves
from ocp_ros.util.resources import find_model

seeds = st.integers(0, 2 ** 32 - 1)
#: The moves that the network chooses among, in units of the longest step.
CENTRES = torch.tensor(CHOICES / LONGEST, dtype=torch.float32)
#: What has a row for each camera.
PER_CAMERA = ('cameras', 'directions', 'own')


def cloud_observation(agent, cameras, seed=0, count=500):
    """Return an encoded cloud of random points."""
    rng = np.random.default_rng(seed)
    cloud = rng.uniform([0, 0, 0], [8, 6, 3], (count, 3)).astype(np.float32)
    bounds = np.stack([cloud.min(0), cloud.max(0)])
    return encode(cloud, rng.uniform([2, 2, 1.9], [6, 4, 1.9], (cameras, 3)), bounds, agent)


def parameters(moves):
    """Return all that a distribution of moves is made of."""
    if isinstance(moves, Choices):
        return torch.cat([moves.logits, moves.log_std.expand(*moves.logits.shape[:2], 1)], dim=-1)
    return torch.cat([moves.mean, moves.log_std], dim=-1)


def seeded_actor(agent, seed=0):
    """Return a network with random weights."""
    torch.manual_seed(seed)
    return Actor(agent)


def test_the_observation_cache_is_what_the_units_compute_on(small_agent):
    encoded = cloud_observation(small_agent, 3)
    points, keys = encoded['points'], encoded['keys_1']
    assert np.array_equal(keys, farthest_points(points, small_agent.keys_1))
    assert np.array_equal(encoded['groups_1'], ball_query(
        points, keys, small_agent.radius_1 / small_agent.length_scale, small_agent.group_1))
    assert_same(encoded, cloud_observation(small_agent, 3))


def test_an_extraction_unit_is_a_shared_perceptron_and_a_maximum():
    torch.manual_seed(0)
    unit = ExtractionUnit(0, 8)
    points, centres = torch.randn(1, 20, 3), torch.randn(1, 2, 3)
    groups = torch.randint(20, (1, 2, 5))
    expected = torch.stack([
        torch.stack([unit.layers(points[0, i] - centres[0, k]) for i in groups[0, k]]).amax(0)
        for k in range(2)])
    torch.testing.assert_close(unit(points, None, centres, groups)[0], expected)


@pytest.mark.parametrize('cameras', [1, 2, 4, 7])
def test_one_set_of_weights_serves_any_number_of_cameras(agent, cameras):
    moves = seeded_actor(agent)(batch(observation(agent, cameras)))
    for made in (moves.best(), moves.sample()):
        assert made.shape == (1, cameras, 2) and torch.isfinite(made).all()
    assert moves.log_prob(made).shape == (1, cameras)
    assert torch.isfinite(parameters(moves)).all()


@given(seed=seeds)
@budget(max_examples=10, deadline=None)
def test_the_order_of_the_cameras_does_not_matter(agent, seed):
    actor, encoded = seeded_actor(agent), observation(agent, 4, seed)
    order = np.random.default_rng(seed).permutation(4)
    turned = {name: value[order] if name in PER_CAMERA else value
              for name, value in encoded.items()}
    one, other = actor(batch(turned)), actor(batch(encoded))
    torch.testing.assert_close(parameters(one)[0], parameters(other)[0, order])
    torch.testing.assert_close(one.best()[0], other.best()[0, order])


def test_where_the_other_cameras_are_matters(agent, room):
    actor, centre = seeded_actor(agent), room.bounds.mean(axis=0)
    places = centre + [[0, 0, 0.4], [0.5, 0, 0.4], [0, 0.5, 0.4]]
    moved = places + np.array([[0], [0.1], [0.2]])
    one, other = (parameters(actor(batch(Encoder(agent)(room.points, positions, 0, 30))))
                  for positions in (places, moved))
    assert not torch.allclose(one[0, 0], other[0, 0], atol=1e-4)


def test_where_the_room_lies_in_the_map_does_not_matter(agent, room):
    policy = Policy(random_checkpoint(agent))
    positions = room.bounds.mean(axis=0) + [[0, 0, 0.4], [1, 0, 0.4]]
    shift = np.array([64.0, -32.0, 0.0], np.float32)
    there = policy.act(room.points + shift, positions + shift)
    policy.reset()
    np.testing.assert_allclose(there, policy.act(room.points, positions), atol=1e-4)


def test_moves_are_bounded_and_drawn_from_the_rng(agent, room):
    policy = Policy(random_checkpoint(agent))
    positions = room.bounds.mean(axis=0) + np.zeros((3, 3))

    def act(*seed):
        policy.reset()
        return policy.act(room.points, positions, 2, 30, *map(np.random.default_rng, seed))

    still, one, two, three = act(), act(1), act(1), act(2)
    assert np.array_equal(one, two) and not np.array_equal(one, three)
    assert np.array_equal(still, act())
    assert np.abs(still).max() <= 1.0 and still.shape == one.shape == (3, 2)
    # A drawn move lies around a choice, whose width is at most exp(WIDTH_MAX).
    assert np.abs(one).max() <= (1.0 + 5.0 * np.exp(WIDTH_FIRST) if agent.world else 1.0)


@pytest.mark.parametrize('max_step', [0.1, 0.5, 2.0])
def test_moves_are_those_it_was_told_of_however_long_the_longest_step(agent, max_step):
    policy = Policy(random_checkpoint(agent), Encoder(agent, max_step=max_step))
    cloud, positions = box_room().points, np.array([[3.0, 2.0, 1.9]])
    for choice, centre in zip(CHOICES[::5], CENTRES[::5, None].numpy(), strict=True):
        policy.choose = lambda encoded, rng, centre=centre: centre
        found = bounded_moves(policy.act(cloud, positions), max_step)[0]
        expected = max_step * centre[0]
        if agent.world:
            expected = choice * min(max_step / max(np.linalg.norm(choice), 1e-9), 1.0)
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_in_steps_as_long_as_in_training_the_answers_of_the_network_are_the_moves(room):
    policy, twin = (Policy(Checkpoint.load(find_model('moves'))) for _ in range(2))
    positions = room.bounds.mean(axis=0) + [[0, 0, 0.4], [0.5, 0, 0.4], [0, 0.5, 0.4]]
    for turn in range(3):
        encoded, expected = twin.encoder.turn(room.points, positions, turn, 30), {}
        for camera in order_of(turn, 3):
            (answer,) = twin.choose(encoded.inputs(camera))
            expected[camera] = encoded.move(camera, answer).astype(np.float32)
        found = policy.act(room.points, positions, turn, 30)
        assert np.array_equal(found, [expected[camera] for camera in range(3)])
        positions[:, :2] += bounded_moves(found, 0.5)


def test_drawing_leaves_the_global_generator_alone(agent, room):
    policy = Policy(random_checkpoint(agent))
    torch.manual_seed(4)
    before = torch.get_rng_state()
    policy.act(room.points, room.bounds.mean(axis=0)[None], rng=np.random.default_rng(0))
    assert torch.equal(torch.get_rng_state(), before)


def with_absent(encoded, cameras, rng):
    """Add rows of noise for cameras that there are not."""
    filled, count = dict(encoded), 0
    for name in PER_CAMERA:
        if name in encoded:
            count = len(encoded[name])
            noise = rng.normal(size=(cameras - count, *encoded[name].shape[1:]))
            filled[name] = np.concatenate([encoded[name], noise.astype(np.float32)])
    return {**filled, 'present': (np.arange(cameras) < count).astype(np.float32)}


def test_cameras_that_there_are_not_change_nothing(agent):
    actor, encoded = seeded_actor(agent), observation(agent, 3)
    full = batch(with_absent(encoded, 6, np.random.default_rng(0)))
    torch.testing.assert_close(parameters(actor(full))[:, :3], parameters(actor(batch(encoded))))
    torch.manual_seed(1)
    extractor = Extractor(agent)
    critic, moves = CriticHead(extractor.width, 16), torch.rand(1, 6, 2)
    value = critic(extractor(full), moves, full['present'])
    torch.testing.assert_close(value, critic(extractor(batch(encoded)), moves[:, :3],
                                             torch.ones(1, 3)))
    # It does depend on the moves of those that there are.
    moves[0, 1] += 0.5
    assert not torch.allclose(critic(extractor(full), moves, full['present']), value)


def test_a_shift_of_the_directions_turns_the_moves(small_agent):
    actor, encoded = seeded_actor(small_agent), batch(observation(small_agent, 5))
    straight = actor(encoded)
    assert len({tuple(move) for move in straight.best()[0].tolist()}) > 1
    for shift in range(1, DIRECTIONS):
        turned = actor({**encoded, 'directions': encoded['directions'].roll(shift, dims=2)})
        matrix = torch.tensor(around_z(360.0 * shift / DIRECTIONS), dtype=torch.float32)
        torch.testing.assert_close(turned.best(), straight.best() @ matrix.T)
        stay, moves = turned.logits.split([1, DIRECTIONS * MOVES], dim=-1)
        torch.testing.assert_close(stay, straight.logits[..., :1])
        torch.testing.assert_close(
            moves.unflatten(-1, (DIRECTIONS, MOVES)),
            straight.logits[..., 1:].unflatten(-1, (DIRECTIONS, MOVES)).roll(shift, dims=2))


def test_a_gaussian_head_that_wants_too_much_stays_a_density():
    head = GaussianHead(3, 8)
    with torch.no_grad():
        head.out.weight.mul_(1e6)
        moves = head(torch.randn(64, 2, 3))
        drawn = moves.sample()
    assert (drawn.abs() <= 1.0).all() and (moves.best().abs() < 1.0).all()
    # Where it is drawn from its density is neither nothing nor endless.
    assert (moves.log_prob(drawn).abs() < 60.0).all()
