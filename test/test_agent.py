# SPDX-License-Identifier: Apache-2.0
"""The agent: sampling, observation cache, networks, checkpoints, policy."""

import json

from conftest import assert_same, random_checkpoint
from hypothesis import given
from hypothesis import settings as budget
from hypothesis import strategies as st
import numpy as np
import pytest
import torch

from ocp_ros.agent.checkpoint import Checkpoint, CheckpointError, KEY, write_atomically
from ocp_ros.agent.config import AgentConfig
from ocp_ros.agent.networks import Actor, ExtractionUnit
from ocp_ros.agent.observation import encode
from ocp_ros.agent.policy import Policy
from ocp_ros.agent.sampling import ball_query, farthest_points
from ocp_ros.resources import find_model

seeds = st.integers(0, 2 ** 32 - 1)


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


def observation(agent, cameras, seed=0, count=500):
    """Return an encoded observation of random points."""
    rng = np.random.default_rng(seed)
    cloud = rng.uniform([0, 0, 0], [8, 6, 3], (count, 3)).astype(np.float32)
    bounds = np.stack([cloud.min(0), cloud.max(0)])
    return encode(cloud, rng.uniform([2, 2, 1.9], [6, 4, 1.9], (cameras, 3)), bounds, agent)


def batch(encoded):
    """Give an observation a batch axis."""
    return {name: torch.from_numpy(value)[None] for name, value in encoded.items()}


def test_the_observation_cache_is_what_the_units_compute_on(small_agent):
    encoded = observation(small_agent, 3)
    points, keys = encoded['points'], encoded['keys_1']
    assert np.array_equal(keys, farthest_points(points, small_agent.keys_1))
    assert np.array_equal(encoded['groups_1'], ball_query(
        points, keys, small_agent.radius_1 / small_agent.length_scale, small_agent.group_1))
    assert_same(encoded, observation(small_agent, 3))


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
def test_one_set_of_weights_serves_any_number_of_cameras(small_agent, cameras):
    mean, log_std = Actor(small_agent)(batch(observation(small_agent, cameras)))
    assert mean.shape == log_std.shape == (1, cameras, 2)
    assert torch.isfinite(mean).all()


@given(seed=seeds)
@budget(max_examples=10, deadline=None)
def test_the_order_of_the_cameras_does_not_matter(small_agent, seed):
    torch.manual_seed(0)
    actor = Actor(small_agent)
    encoded = observation(small_agent, 4, seed)
    order = np.random.default_rng(seed).permutation(4)
    turned = {**encoded, 'cameras': encoded['cameras'][order]}
    torch.testing.assert_close(actor(batch(turned))[0][0], actor(batch(encoded))[0][0, order])


def test_where_the_other_cameras_are_matters(small_agent):
    torch.manual_seed(0)
    actor, encoded = Actor(small_agent), observation(small_agent, 3)
    moved = {**encoded, 'cameras': encoded['cameras'] + np.float32([[0], [0.1], [0.2]])}
    assert not torch.allclose(actor(batch(moved))[0][0, 0], actor(batch(encoded))[0][0, 0])


def test_where_the_room_lies_in_the_map_does_not_matter(checkpoint, room):
    policy = Policy(checkpoint)
    positions = room.bounds.mean(axis=0) + [[0, 0, 0.4], [1, 0, 0.4]]
    shift = np.array([64.0, -32.0, 0.0], np.float32)
    np.testing.assert_allclose(policy.act(room.points + shift, positions + shift),
                               policy.act(room.points, positions), atol=1e-4)


def test_moves_are_bounded_and_drawn_from_the_rng(checkpoint, room):
    policy, positions = Policy(checkpoint), room.bounds.mean(axis=0) + np.zeros((3, 3))
    still = policy.act(room.points, positions)
    one, two, three = (policy.act(room.points, positions, np.random.default_rng(seed))
                       for seed in (1, 1, 2))
    assert np.array_equal(one, two) and not np.array_equal(one, three)
    assert np.array_equal(still, policy.act(room.points, positions))
    assert all(np.abs(moves).max() <= 1.0 and moves.shape == (3, 2) for moves in (still, one))


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


def test_the_shipped_model_has_its_card():
    checkpoint = Checkpoint.load(find_model('default'))
    test = checkpoint.provenance['test']
    assert checkpoint.config == AgentConfig()
    assert test['policy']['depth_error_end'] < test['random_moves']['depth_error_end']
    assert {'seed', 'date', 'interactions', 'training', 'seconds', 'curve'} <= (
        checkpoint.provenance.keys())
