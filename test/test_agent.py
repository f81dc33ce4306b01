# SPDX-License-Identifier: Apache-2.0
"""The agent: sampling, observation cache, networks, checkpoints, policy."""

import json

from conftest import (
    around_z,
    assert_same,
    batch,
    box_room,
    observation,
    random_checkpoint,
)
from hypothesis import given
from hypothesis import settings as budget
from hypothesis import strategies as st
import numpy as np
import pytest
import torch

from ocp_ros.agent.checkpoint import Checkpoint, CheckpointError, KEY, write_atomically
from ocp_ros.agent.config import AgentConfig
from ocp_ros.agent.distributions import Choices, NEAR, SquashedGaussian
from ocp_ros.agent.encoder import Encoder, order_of
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
from ocp_ros.agent.world import CHOICES, DIRECTIONS, LONGEST, MOVES
from ocp_ros.resources import find_model
from ocp_ros.simulation.moves import bounded_moves

seeds = st.integers(0, 2 ** 32 - 1)
#: The moves that the network chooses among, in units of the longest step.
CENTRES = torch.tensor(CHOICES / LONGEST, dtype=torch.float32)
#: What has a row for each camera.
PER_CAMERA = ('cameras', 'directions', 'own')


@given(seed=seeds, count=st.integers(1, 60), wanted=st.integers(1, 40))
@budget(max_examples=40, deadline=None)
def test_farthest_points_agree_with_their_twin(seed, count, wanted):
    points = np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)
    chosen = [0]
    for _ in range(wanted - 1):
        nearest = ((points[:, None] - points[chosen][None]) ** 2).sum(-1).min(axis=1)
        chosen.append(int(nearest.argmax()))
    found = farthest_points(points, wanted)
    distances = ((points[:, None] - points[found][None]) ** 2).sum(-1)
    expected = ((points[:, None] - points[chosen][None]) ** 2).sum(-1)
    # Equal distances may be chosen in either order; how far apart the choices are may not differ.
    np.testing.assert_allclose(np.sort(distances.min(1)), np.sort(expected.min(1)), atol=1e-5)


@given(seed=seeds, radius=st.floats(0.1, 3.0), size=st.integers(1, 12))
@budget(max_examples=40, deadline=None)
def test_ball_query_agrees_with_its_twin(seed, radius, size):
    points = np.random.default_rng(seed).normal(size=(50, 3)).astype(np.float32)
    keys = np.arange(0, 50, 7)
    groups = ball_query(points, keys, radius, size)
    for key, group in zip(keys, groups, strict=True):
        difference = (points - points[key]).astype(np.float64)
        near = np.flatnonzero((difference ** 2).sum(axis=1) <= radius ** 2)
        # Points on the very rim may fall to either side in single precision.
        rim = np.abs(np.linalg.norm(difference, axis=1) - radius) < 1e-5
        if not rim.any():
            expected = np.full(size, near[0])
            expected[:min(size, len(near))] = near[:size]
            assert group.tolist() == expected.tolist()


def test_sampling_and_grouping_count_beyond_sixteen_bits():
    points = np.zeros((40000, 3), dtype=np.float32)
    points[-2:, 0] = 7.0, 9.0
    keys = farthest_points(points, 3)
    assert keys.tolist() == [0, 39999, 39998]
    assert ball_query(points, keys, 1.0, 2).tolist() == [[0, 1], [39999] * 2, [39998] * 2]


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
    policy, twin = (Policy(Checkpoint.load(find_model('default'))) for _ in range(2))
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


def test_a_checkpoint_comes_back_as_it_went(small_agent, tmp_path):
    before = random_checkpoint(small_agent, updates=7, run='r', provenance={'seed': 3})
    before.save(tmp_path / 'm.safetensors')
    after = Checkpoint.load(tmp_path / 'm.safetensors')
    assert (after.config, after.updates, after.run, after.provenance) == (
        small_agent, 7, 'r', {'seed': 3})
    assert all(torch.equal(after.weights[name], value) for name, value in before.weights.items())
    assert '"updates": 7' in (tmp_path / 'm.json').read_text()
    assert sorted(p.name for p in tmp_path.iterdir()) == ['m.json', 'm.safetensors']


@given(data=st.data())
@budget(max_examples=60, deadline=None)
def test_a_damaged_blob_is_refused_and_nothing_else_happens(small_agent, data):
    blob = bytearray(random_checkpoint(small_agent, updates=1).to_bytes())
    if data.draw(st.booleans()):
        blob = blob[:data.draw(st.integers(0, len(blob) - 1))]
    else:
        header = int.from_bytes(blob[:8], 'little') + 8
        blob[data.draw(st.integers(0, header - 1))] ^= data.draw(st.integers(1, 255))
    try:
        found = Checkpoint.from_bytes(bytes(blob))
    except CheckpointError as error:
        assert 'found' in str(error) and 'expected' in str(error)
    else:
        # A digit of the provenance, of the count or of a radius may have changed unnoticed.
        assert all(torch.isfinite(value).all() for value in found.weights.values())


@pytest.mark.parametrize(('name', 'value'), [
    ('updates', 'Infinity'), ('updates', 'NaN'), ('updates', '"many"'), ('updates', '[1]'),
    ('run', 'null'), ('provenance', '7'), ('config', '[]'), ('format', 'null'),
    ('config', '{"points": 1e999}'), ('provenance', '[' * 5000 + ']' * 5000)])
def test_a_card_with_odd_values_is_refused_and_nothing_else_happens(small_agent, name, value):
    blob = random_checkpoint(small_agent).to_bytes()
    header = json.loads(blob[8:8 + int.from_bytes(blob[:8], 'little')])
    card = json.loads(header['__metadata__'][KEY])
    parts = [f'"{key}": {value if key == name else json.dumps(item)}'
             for key, item in card.items()]
    header['__metadata__'][KEY] = '{' + ', '.join(parts) + '}'
    text = json.dumps(header).encode()
    body = blob[8 + int.from_bytes(blob[:8], 'little'):]
    crafted = len(text).to_bytes(8, 'little') + text + body
    try:
        found = Checkpoint.from_bytes(crafted)
    except CheckpointError as error:
        assert 'found' in str(error) and 'expected' in str(error)
    else:
        assert (name, found.run) == ('run', 'None')


def test_weights_of_another_network_are_refused(small_agent):
    good = random_checkpoint(small_agent)
    with pytest.raises(CheckpointError, match='missing .*head.out.bias'):
        Checkpoint(small_agent, {n: v for n, v in good.weights.items() if n != 'head.out.bias'})
    with pytest.raises(CheckpointError, match='head.out.bias as .*expected float32'):
        Checkpoint(small_agent, {**good.weights, 'head.out.bias': torch.zeros(5)})
    with pytest.raises(CheckpointError, match='NaN or inf in head.out.bias'):
        Checkpoint(small_agent, {**good.weights, 'head.out.bias': torch.full((4,), torch.nan)})


def test_huge_sizes_in_a_card_cost_nothing(small_agent):
    text = random_checkpoint(small_agent).to_bytes()
    start = text.index(KEY.encode())
    end = text.index(b'hidden', start)
    blob = text[:end] + text[end:].replace(b'16', b'4096', 1)
    length = int.from_bytes(blob[:8], 'little') + 2
    with pytest.raises(CheckpointError):
        Checkpoint.from_bytes(length.to_bytes(8, 'little') + blob[8:])


def test_an_interrupted_write_leaves_the_old_file(tmp_path, monkeypatch):
    write_atomically(tmp_path / 'f', b'old')

    def fail(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr('os.replace', fail)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(tmp_path / 'f', b'new')
    assert (tmp_path / 'f').read_bytes() == b'old'
    assert [p.name for p in tmp_path.iterdir()] == ['f']


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(CheckpointError, match='none.safetensors: found no file'):
        Checkpoint.load(tmp_path / 'none.safetensors')
    with pytest.raises(FileNotFoundError, match="'none'.*expected a path .*'default'"):
        find_model('none')


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


def choices(seed, batch_size=2, cameras=3, log_std=-2.0):
    """Return random choices among the moves that the network has."""
    torch.manual_seed(seed)
    logits = 2.0 * torch.randn(batch_size, cameras, len(CENTRES))
    return Choices(logits.requires_grad_(), torch.full((1,), log_std), CENTRES)


def test_the_density_of_choices_is_one_altogether():
    axis = torch.linspace(-2.0, 2.0, 321)
    grid = torch.stack(torch.meshgrid(axis, axis, indexing='ij'), dim=-1).reshape(-1, 1, 2)
    moves = choices(0, 1, 1)
    density = moves.log_prob(grid).detach().exp().sum() * float(axis[1] - axis[0]) ** 2
    assert float(density) == pytest.approx(1.0, abs=1e-3)


@given(seed=seeds, log_std=st.floats(-4.0, -1.0))
@budget(max_examples=15, deadline=None)
def test_the_density_of_choices_agrees_with_its_twin(seed, log_std):
    moves = choices(seed % 1000, log_std=log_std)
    made = np.random.default_rng(seed).uniform(-1.0, 1.0, (2, 3, 2))
    logits, width = moves.logits.detach().double().numpy(), np.exp(log_std)
    expected = np.empty((2, 3))
    for index in np.ndindex(2, 3):
        weights = np.exp(logits[index]) / np.exp(logits[index]).sum()
        away = ((made[index] - CENTRES.double().numpy()) ** 2).sum(axis=1)
        # Far from all choices the density itself would not be a number.
        terms = np.log(weights) - away / (2.0 * width ** 2) - np.log(2.0 * np.pi * width ** 2)
        expected[index] = terms.max() + np.log(np.exp(terms - terms.max()).sum())
    found = moves.log_prob(torch.tensor(made, dtype=torch.float32)).detach()
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)


def test_choices_are_drawn_as_often_as_their_logits_say():
    logits = torch.zeros(1, 1, len(CENTRES))
    logits[0, 0, [0, 3, 11]] = torch.tensor([4.0, 5.0, 4.5])
    torch.manual_seed(0)
    moves = Choices(logits.expand(20000, 1, -1), torch.full((1,), -5.0), CENTRES)
    nearest = torch.cdist(moves.sample()[:, 0], CENTRES).argmin(dim=1)
    shares = torch.bincount(nearest, minlength=len(CENTRES)) / len(nearest)
    np.testing.assert_allclose(shares, logits.softmax(-1)[0, 0], atol=0.012)
    assert torch.equal(moves.best()[0, 0], CENTRES[3])
    # Around a choice, moves have the width they are said to have.
    wide = Choices(20.0 * logits.expand(20000, 1, -1), torch.full((1,), -2.0), CENTRES)
    spread = (wide.sample()[:, 0] - CENTRES[3]).std(dim=0)
    np.testing.assert_allclose(spread, np.exp(-2.0), rtol=0.05)


def test_the_best_choice_is_the_likeliest():
    # Narrow ones: wide ones that overlap share what they are worth.
    moves = choices(3, 4, 5, log_std=-4.0)
    at_best = moves.log_prob(moves.best())
    for centre in CENTRES:
        assert (at_best >= moves.log_prob(centre.expand(4, 5, 2)) - 1e-3).all()


def test_gradients_flow_through_drawn_choices():
    moves = choices(5)
    moves.sample()[..., 0].sum().backward()
    assert moves.logits.grad.abs().sum() > 0.0
    # Making a choice with a larger x likelier makes the drawn x larger.
    likeliest, least = CENTRES[:, 0].argmax(), CENTRES[:, 0].argmin()
    mean = torch.zeros(len(CENTRES))
    torch.manual_seed(0)
    for _ in range(50):
        moves = choices(5)
        Choices(moves.logits, moves.log_std, CENTRES).sample()[..., 0].sum().backward()
        mean += moves.logits.grad.sum(dim=(0, 1))
    assert mean[likeliest] > 0.0 > mean[least]


@given(seed=seeds)
@budget(max_examples=10, deadline=None)
def test_the_squashed_gaussian_is_that_of_stable_baselines3(seed):
    from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
    torch.manual_seed(seed)
    mean, log_std = torch.randn(3, 2, 2), 0.5 * torch.randn(3, 2, 2) - 1.0
    ours = SquashedGaussian(mean, log_std)
    made = 0.95 * torch.tanh(torch.randn(3, 2, 2))
    # Theirs sums over the second axis: one row for each camera.
    theirs = SquashedDiagGaussianDistribution(2).proba_distribution(
        mean.flatten(0, 1), log_std.flatten(0, 1))
    torch.testing.assert_close(ours.log_prob(made).flatten(),
                               theirs.log_prob(made.flatten(0, 1)), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(ours.best().flatten(0, 1), theirs.mode())


@pytest.mark.parametrize('number', range(len(CENTRES)))
def test_imitation_costs_least_where_the_expert_goes(number):
    wanted = CENTRES[number].view(1, 1, 2)
    sure = 12.0 * torch.eye(len(CENTRES))
    losses = torch.cat([
        Choices(logits.view(1, 1, -1), torch.full((1,), -2.0), CENTRES).imitation(wanted)[0]
        for logits in sure])
    assert int(losses.argmin()) == number
    gaussian = torch.cat([SquashedGaussian(
        torch.atanh(0.99 * centre).view(1, 1, 2), torch.zeros(1, 1, 2)).imitation(wanted)[0]
        for centre in CENTRES])
    assert int(gaussian.argmin()) == number


def test_what_imitation_wants_is_nearest_to_the_move():
    """Minimising the loss over the logits gives choices that count the more the nearer."""
    move, logits = torch.tensor([[[0.5, 0.1]]]), torch.zeros(1, 1, len(CENTRES))
    logits.requires_grad_()
    optimizer = torch.optim.Adam([logits], 0.2)
    for _ in range(300):
        optimizer.zero_grad()
        Choices(logits, torch.full((1,), -2.0), CENTRES).imitation(move).sum().backward()
        optimizer.step()
    away = (CENTRES - move[0, 0]).norm(dim=1)
    order = away.argsort()[:6]
    shares = logits.softmax(-1)[0, 0].detach()
    assert (shares[order].diff() <= 1e-3).all() and shares[order[0]] > 0.2
    # Where all count as NEAR says, the loss is the entropy of it.
    expected = torch.softmax(-0.5 * (away / NEAR) ** 2, dim=0)
    np.testing.assert_allclose(shares, expected, atol=0.01)


def test_the_shipped_model_has_its_card():
    checkpoint = Checkpoint.load(find_model('default'))
    test = checkpoint.provenance['test']
    assert checkpoint.config == AgentConfig()
    assert test['policy']['depth_error_end'] < test['random_moves']['depth_error_end']
    assert {'seed', 'date', 'interactions', 'training', 'seconds', 'curve'} <= (
        checkpoint.provenance.keys())


def test_a_gaussian_head_that_wants_too_much_stays_a_density():
    head = GaussianHead(3, 8)
    with torch.no_grad():
        head.out.weight.mul_(1e6)
        moves = head(torch.randn(64, 2, 3))
        drawn = moves.sample()
    assert (drawn.abs() <= 1.0).all() and (moves.best().abs() < 1.0).all()
    # Where it is drawn from its density is neither nothing nor endless.
    assert (moves.log_prob(drawn).abs() < 60.0).all()
