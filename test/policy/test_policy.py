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

"""The agents that read the observed cloud: observations, networks, policy, weights in files."""

from dataclasses import replace
import json
from unittest.mock import Mock

from conftest import around_z, assert_same, batch, for_any, made_room, random_checkpoint, ROOT
from hypothesis import strategies as st
import numpy as np
from ocp_ros.online.rig_state import RigState
from ocp_ros.policy.agent_config import AgentConfig, CLOUD, PAPER
from ocp_ros.policy.checkpoint import Checkpoint, CheckpointError, METADATA_KEY, write_atomically
from ocp_ros.policy.cloud_encoder import (
    ball_query,
    encode,
    Encoder,
    farthest_points,
    features_of_air,
    LENGTH_SCALE,
    MAX_OTHERS,
    nearest_in_ball,
)
from ocp_ros.policy.networks import ExtractionUnit, Extractor, SYMMETRIES, turned_observation
from ocp_ros.policy.policy import Policy
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.rooms.scene_source import make_room
from ocp_ros.training.encoded_environment import encoded_space
from ocp_ros.training.run_folder import read_config
from ocp_ros.util.resources import find_model
from ocp_ros.util.settings import ConfigurationError
import pytest
import torch

AGENT = AgentConfig(CLOUD, points=128, keys_1=16, group_1=8, radius_1=2.0, keys_2=8, group_2=8,
                    radius_2=4.0, channels=16, hidden=32, pooled=24)
seeds = st.integers(0, 2 ** 32 - 1)


@pytest.fixture(scope='module')
def cloud():
    """Return the points of a room that is longer than cameras see."""
    return made_room(8, 3000).points


def turn_of(cloud, positions, rig_state=None):
    """Return an encoded turn of cameras that see 2 m far, or of those of a rig."""
    encoder = Encoder(AGENT, 2.0, 0.5)
    encoder.partial_maps.rig_state = rig_state
    return encoder.turn(cloud, np.array(positions), 3, 30)


def corners(cloud):
    """Return places near two corners of a room, and at both its height."""
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    return [[*(low + 0.8)[:2], 1.5], [*(high - 0.8)[:2], 1.5]]


@for_any(25, seed=seeds, count=st.integers(1, 60), wanted=st.integers(1, 40))
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


@pytest.mark.parametrize('query', [ball_query, nearest_in_ball])
@for_any(25, seed=seeds, radius=st.floats(0.1, 3.0), size=st.integers(1, 12))
def test_the_points_of_a_ball_agree_with_their_twin(query, seed, radius, size):
    points = np.random.default_rng(seed).normal(size=(50, 3)).astype(np.float32)
    keys = np.arange(0, 50, 7)
    for key, group in zip(keys, query(points, keys, radius, size), strict=True):
        away = np.linalg.norm((points - points[key]).astype(np.float64), axis=1)
        order = np.argsort(away) if query is nearest_in_ball else np.arange(50)
        near = order[away[order] <= radius][:size].tolist()
        # Points on the very rim may fall to either side in single precision.
        if not (np.abs(away - radius) < 1e-5).any():
            assert group.tolist() == near + near[:1] * (size - len(near))


def test_sampling_and_grouping_count_beyond_sixteen_bits():
    points = np.zeros((40000, 3), dtype=np.float32)
    points[-2:, 0] = 7.0, 9.0
    keys = farthest_points(points, 3)
    assert keys.tolist() == [0, 39999, 39998]
    assert ball_query(points, keys, 1.0, 2).tolist() == [[0, 1], [39999] * 2, [39998] * 2]
    assert nearest_in_ball(points, keys, 3.0, 2).tolist() == [
        [0, 1], [39999, 39998], [39998, 39999]]


def test_the_network_of_the_paper_reads_groups_of_points_box_and_all_cameras(small_agent, cloud):
    agent = replace(small_agent, inputs=PAPER)
    places = np.array(corners(cloud) + corners(cloud))
    encoded = encode(cloud, places, agent)
    points, keys = encoded['points'], encoded['keys_1']
    assert np.array_equal(keys, farthest_points(points, agent.keys_1))
    assert np.array_equal(encoded['groups_1'], ball_query(
        points, keys, agent.radius_1 / LENGTH_SCALE, agent.group_1))
    assert_same(encoded, encode(cloud, places, agent))
    seen = batch(encoded)
    features = Extractor(agent)(seen)
    assert features.shape == (1, agent.pooled + 3 + 3 + 3 * 4)
    torch.testing.assert_close(features[0, -12:], seen['cameras'].flatten())
    torch.testing.assert_close(features[0, -15:-12], seen['half_size'][0])


def test_an_extraction_unit_is_a_shared_perceptron_and_a_maximum():
    torch.manual_seed(0)
    unit = ExtractionUnit(0, 8, False)
    points, centres = torch.randn(1, 20, 3), torch.randn(1, 2, 3)
    groups = torch.randint(20, (1, 2, 5))
    expected = torch.stack([
        torch.stack([unit.layers(points[0, i] - centres[0, k]) for i in groups[0, k]]).amax(0)
        for k in range(2)])
    torch.testing.assert_close(unit(points, None, centres, groups)[0], expected)


@pytest.mark.parametrize('cameras', [1, 7])
def test_one_set_of_weights_serves_any_number_of_cameras(small_agent, cloud, cameras):
    places = cloud.mean(axis=0) + np.random.default_rng(0).uniform(-1.0, 1.0, (cameras, 3))
    moves = Policy(random_checkpoint(small_agent)).act(cloud, places)
    assert moves.shape == (cameras, 2) and np.isfinite(moves).all()


def test_where_the_room_lies_in_the_map_does_not_matter(agent, room):
    policy = Policy(random_checkpoint(agent))
    positions = room.bounds.mean(axis=0) + [[0, 0, .4], [1, 0, .4], [0, 1, .4], [-1, 0, .4]]
    shift = np.array([64.0, -32.0, 0.0], np.float32)
    there = policy.act(room.points + shift, positions + shift)
    policy.reset()
    np.testing.assert_allclose(there, policy.act(room.points, positions), atol=1e-4)


def test_moves_are_bounded_and_drawn_from_the_rng_alone(agent, room):
    policy = Policy(random_checkpoint(agent))
    positions = room.bounds.mean(axis=0) + np.zeros((4, 3))

    def act(*seed):
        policy.reset()
        return policy.act(room.points, positions, 2, 30, *map(np.random.default_rng, seed))

    torch.manual_seed(4)
    before = torch.get_rng_state()
    still, one, two, three = act(), act(1), act(1), act(2)
    assert torch.equal(torch.get_rng_state(), before)
    assert np.array_equal(one, two) and not np.array_equal(one, three)
    assert np.array_equal(still, act())
    assert max(np.abs(still).max(), np.abs(one).max()) <= 1.0


def test_points_are_marked_by_who_sees_them_now(cloud):
    places = corners(cloud)
    told = turn_of(cloud, places)
    for camera in (0, 1):
        seen = told.inputs(camera)
        points = LENGTH_SCALE * (seen['points'] - seen['cameras'][0])
        way = LENGTH_SCALE * seen['others'][0, :3]
        np.testing.assert_allclose(way, np.subtract(places[1 - camera], places[camera]), atol=1e-5)
        assert set(np.unique(seen['marks'])) == {0, 1}
        for marks, place in zip(seen['marks'].T, (np.zeros(3), way)):
            # No camera sees farther than the range; next to a camera nothing hides a wall.
            away = np.linalg.norm(points - place, axis=1)
            assert not marks[away > 2.05].any() and marks[away < 1.2].mean() > 0.8


def test_a_camera_is_told_what_those_before_it_will_do(cloud):
    told = turn_of(cloud, corners(cloud))
    before = told.inputs(1)
    made = told.move(0, np.array([1.0, 0.0]))
    after = told.inputs(1)
    assert made[0] > 0.5
    np.testing.assert_allclose(after['others'][0, :2] - before['others'][0, :2],
                               made * 0.5 / LENGTH_SCALE, atol=1e-5)
    assert before['others'][0].tolist()[3:] == [1.0, 0.0]
    assert after['others'][0].tolist()[3:] == [1.0, 1.0]
    assert not before['others'][1:].any()
    np.testing.assert_array_equal(before['marks'][:, 0], after['marks'][:, 0])
    assert (before['marks'][:, 1] != after['marks'][:, 1]).any()
    for name in ('points', 'groups_1', 'cameras', 'half_size', 'turn'):
        np.testing.assert_array_equal(before[name], after[name])


def test_the_turn_is_told_and_the_nearest_of_more_cameras_than_there_is_room_for(cloud):
    (x, y, z), far = corners(cloud)
    ways = np.random.default_rng(0).permutation(0.1 * np.arange(1, MAX_OTHERS + 1))
    seen = turn_of(cloud, [[x, y, z], *([x + way, y, z] for way in ways), far]).inputs(0)
    np.testing.assert_allclose(LENGTH_SCALE * seen['others'][:, 0], np.sort(ways), atol=1e-5)
    assert seen['turn'][:2] == pytest.approx([0.1, (MAX_OTHERS + 2) / 4.0])
    assert 0.0 < seen['turn'][2] < 1.0
    # Steps, the path that is left and the range, each in its unit, and a view all around.
    assert seen['turn'][3:].tolist() == pytest.approx([0.25, 27 * 0.5 / 8.0, 0.5, 1, 1, 0, 0])
    assert not seen['heading'].any()


def test_where_nothing_is_seen_nothing_is_marked():
    seen = turn_of(np.zeros((1, 3), np.float32), [[0.0, 0.0, 1.5], [0.5, 0.0, 1.5]]).inputs(0)
    assert not seen['marks'].any() and seen['turn'][2] == 1.0
    assert encoded_space(AGENT).contains(seen)


def test_nearly_every_point_reaches_a_group():
    """In the network of the paper most do not, which is one of its flaws."""
    scene = make_room('1000', 0.0, 6000)
    middle = np.array([[*scene.bounds.mean(axis=0)[:2], 1.9]])
    for name, least, most in (('paper', 0.0, 0.4), ('actor', 0.85, 1.0)):
        agent = read_config(ROOT / 'config' / 'train' / f'{name}.yaml').agent
        groups = encode(scene.points, middle, agent)['groups_1']
        assert least < len(np.unique(groups)) / agent.points <= most


@for_any(20, seed=seeds, count=st.integers(0, 60))
def test_unseen_air_is_told_by_sectors_that_turn_with_the_room(seed, count):
    rng = np.random.default_rng(seed)
    place, centres = rng.uniform(-1.0, 1.0, 2), rng.uniform(-4.0, 4.0, (count, 2))
    unseen = rng.random(count) < 0.6
    features = features_of_air(place, centres, unseen)
    x, y = (centres - place).T
    sectors = (np.arctan2(y, x) % (2.0 * np.pi) // (0.25 * np.pi)).astype(int)
    for sector, row in enumerate(features):
        own = unseen[sectors == sector]
        ways = (centres - place)[unseen & (sectors == sector)] / LENGTH_SCALE
        expected = [*ways.mean(axis=0), len(ways) / unseen.sum(), own.mean()] if len(ways) else 0.0
        np.testing.assert_allclose(row, expected, atol=1e-5)
    quarter, mirror = around_z(90.0), np.diag([1.0, -1.0])
    for matrix, rows in ((quarter, np.roll(features, 2, axis=0)), (mirror, features[::-1])):
        turned = features_of_air(matrix @ place, centres @ matrix.T, unseen)
        expected = np.hstack([rows[:, :2] @ matrix.T, rows[:, 2:]])
        np.testing.assert_allclose(turned, expected, atol=1e-5)


def test_symmetries_turn_all_ways_and_directions_and_the_move(cloud):
    places = corners(cloud)
    model = SENSORS['realsense_d455'].model
    state = RigState(np.column_stack([places, [[0.4, 0.3, 0.0]] * 2]), [model] * 2, 2, (0.1, 0.6))
    seen, policy = turn_of(cloud, places, state).inputs(0), Policy(random_checkpoint(AGENT))
    assert seen['turn'][5:] == pytest.approx([
        model.max_range / 4, 87 / 360, 58 / 180, *np.array([0.1, 0.6]) / (0.5 * np.pi)], abs=1e-6)
    np.testing.assert_allclose(
        seen['heading'][0], [np.cos(0.3) * np.cos(0.4), np.cos(0.3) * np.sin(0.4), -np.sin(0.3)],
        atol=1e-6)
    (move,) = policy.choose(seen)
    assert np.linalg.norm(move) > 1e-3 and seen['air'][:, 2].sum() == pytest.approx(1.0)
    for name in ('heading', 'air'):
        other = {**seen, name: 0.0 * seen[name]}
        assert np.abs(policy.choose(other) - move).max() > 1e-4
    for matrix in SYMMETRIES:
        turned = turned_observation(batch(seen), matrix[None])
        for name in ('others', 'heading', 'air'):
            expected = seen[name].copy()
            expected[:, :2] = expected[:, :2] @ matrix.numpy().T
            np.testing.assert_allclose(turned[name][0], expected, atol=1e-6)
        np.testing.assert_array_equal(turned['marks'][0], seen['marks'])
        (found,) = policy.choose({name: value[0].numpy() for name, value in turned.items()})
        np.testing.assert_allclose(found, matrix.numpy() @ move, atol=1e-5)


def test_one_head_serves_one_number_of_cameras_and_tells_them_apart(small_agent, cloud):
    """Two cameras that read the same get moves of their own; a head of each cannot do this."""
    policy = Policy(random_checkpoint(replace(small_agent, inputs=PAPER, cameras=2)))
    one, other = policy.act(cloud, np.array([[1.0, 0.5, 1.9]] * 2))
    assert np.abs(one - other).max() > 1e-3
    with pytest.raises(ConfigurationError, match='2 cameras.* 3 cameras'):
        policy.act(cloud, np.zeros((3, 3)))


def test_a_checkpoint_comes_back_as_it_went(small_agent, tmp_path):
    before = random_checkpoint(small_agent, updates=7, run='r', provenance={'seed': 3})
    before.save(tmp_path / 'm.safetensors')
    after = Checkpoint.load(tmp_path / 'm.safetensors')
    assert after.card() == before.card() and after.config == small_agent
    assert_same(after.weights, before.weights)
    assert json.loads((tmp_path / 'm.json').read_text()) == before.card()
    assert sorted(p.name for p in tmp_path.iterdir()) == ['m.json', 'm.safetensors']


@pytest.fixture(scope='module')
def blob(small_agent):
    """Return random weights as bytes."""
    return random_checkpoint(small_agent, updates=1).to_bytes()


@for_any(40, data=st.data())
def test_a_damaged_blob_is_refused_and_nothing_else_happens(blob, data):
    blob = bytearray(blob)
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
    ('updates', 'Infinity'), ('updates', '-1'), ('updates', 'true'), ('updates', '1' + 300 * '0'),
    ('run', f'"{"x" * 101}"'), ('run', 'null'), ('provenance', '7'), ('config', '[]'),
    ('format', 'null'), ('config', '{"points": 1e999}'), ('config', '{"hidden": 4096}'),
    ('provenance', '[' * 5000 + ']' * 5000)])
def test_a_card_with_odd_values_is_refused(blob, name, value):
    body = 8 + int.from_bytes(blob[:8], 'little')
    header = json.loads(blob[8:body])
    card = json.loads(header['__metadata__'][METADATA_KEY])
    parts = [f'"{key}": {value if key == name else json.dumps(item)}'
             for key, item in card.items()]
    header['__metadata__'][METADATA_KEY] = '{' + ', '.join(parts) + '}'
    text = json.dumps(header).encode()
    with pytest.raises(CheckpointError, match='found .*expected'):
        Checkpoint.from_bytes(len(text).to_bytes(8, 'little') + text + blob[body:])


@pytest.mark.parametrize('bias', [
    None, torch.zeros(5), *(torch.full((2,), wrong) for wrong in (torch.nan, -torch.inf, -1e5))])
def test_weights_of_another_network_are_refused(small_agent, bias):
    weights = random_checkpoint(small_agent).weights | {'mu.bias': bias}
    if bias is None:
        del weights['mu.bias']
    with pytest.raises(CheckpointError, match='mu.bias'):
        Checkpoint(small_agent, weights)


def test_an_interrupted_write_leaves_the_old_file(tmp_path, monkeypatch):
    write_atomically(tmp_path / 'f', b'old')
    monkeypatch.setattr('os.replace', Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        write_atomically(tmp_path / 'f', b'new')
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [('f', b'old')]


def test_the_shipped_model_has_its_card_and_a_missing_one_is_named():
    checkpoint, config = (Checkpoint.load(find_model('actor')),
                          read_config(ROOT / 'config' / 'train' / 'actor.yaml'))
    ratios = {line['updates']: line['ratio'] for line in checkpoint.provenance['curve']}
    assert checkpoint.config == config.agent
    assert checkpoint.domain == {name: tuple(ends) for name, ends in config.domain.items()}
    assert config.domain == {'cameras': [2, 6], 'turns': [5, 30], 'max_step': [0.5, 2.0],
                             'max_range': [3.0, 6.0]}
    # The best weights of the curve, which leave less than half of the first error.
    assert ratios[checkpoint.updates] == min(ratios.values()) < 0.5
    assert {'seed', 'date', 'interactions', 'training', 'seconds', 'curve'} <= (
        checkpoint.provenance.keys())
    with pytest.raises(CheckpointError, match='none.safetensors'):
        Checkpoint.load('none.safetensors')
    with pytest.raises(FileNotFoundError, match="'none'.*'actor'"):
        find_model('none')
