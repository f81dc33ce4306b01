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

"""
The map actor: what it reads, its network, how it chooses, its labels and its training.

Cameras that see all around have one value at each place, aimed cameras one for each heading.
"""

from dataclasses import replace
import math
import shutil
from types import SimpleNamespace

from conftest import assert_same, batch, Here, made_room
import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.online.partial_map import LookHistory, PartialMap
from ocp_ros.online.rig_state import RigState
from ocp_ros.policy import observation_map
from ocp_ros.policy.agent_config import AgentConfig, CheckpointError
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.policy.map_actor import MapActor, MIN_TURNS_FOR_HEADINGS
from ocp_ros.policy.observation_map import CELLS, EDGE_M, lens_features, OF_OTHERS, OF_ROOM
from ocp_ros.policy.policy import ValuePolicy
from ocp_ros.policy.value_network import valued, ValueMapNetwork
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.scenes.scene import turned
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.training import value_fit, value_states
from ocp_ros.training.run_folder import records
from ocp_ros.training.train import train
from ocp_ros.training.training_config import RoomsConfig, TrainingConfig, ValuesConfig
from ocp_ros.training.value_states import play_states, shapes_of, StateTask, TrueRoom
from ocp_ros.training.value_training import ValueRun
from ocp_ros.util.settings import ConfigurationError, from_nested, UserError
import pytest
from rich.progress import Progress
import torch

#: Agents for cameras that see all around, and for those that are aimed as well.
ROUND, AIMED = AgentConfig(inputs='map'), AgentConfig(inputs='map', headings=8)
AIMED_INPUTS = {'inputs': 'map', 'headings': 8}
RANGE = 4.0
D455 = SENSORS['realsense_d455'].model
TINY = {'interactions': 0, 'environments': 1, 'workers': 1, 'evaluate_every': 8,
        'updates_per_turn': 0.25, 'agent': {'inputs': 'map'}, 'fewest_cameras': 2,
        'rooms': {'training': 2, 'validation': 1, 'test': 1, 'points': 1500, 'rotations': '0'},
        'simulation': {'engine': {'preset': 'fast', 'error_rows': 16, 'coverage_cell': 1.0},
                       'rig': {'cameras': 2}, 'episode': {'turns': 3}},
        'values': {'rooms': 1, 'own_rooms': 1, 'steps': 2, 'own_steps': 2, 'batch_size': 2,
                   'evaluate_every': 2},
        'sac': {'learning_starts': 4, 'batch_size': 4, 'buffer_size': 100, 'device': 'cpu'}}
TASK = StateTask(RoomsConfig(), '1000', (0, 0, 1))


@pytest.fixture(scope='module')
def room():
    """Return a room that has been seen whole."""
    return made_room(7, 4000)


@pytest.fixture(scope='module')
def small(small):
    """Label few places in those few states."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(value_states, 'TUNING', replace(
            value_states.TUNING, places=60, aimed_places=30))
        yield


@pytest.fixture(scope='module')
def states(small):
    """Return the states of a room."""
    return play_states(TASK)


@pytest.fixture(scope='module')
def tiny_run(small, tmp_path_factory):
    """Return the folder and the weights of a run that is finished."""
    folder = tmp_path_factory.mktemp('run')
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('ocp_ros.training.train.WorkerPool', Here)
        return folder, train(from_nested(TrainingConfig, TINY), folder, 'a command')


def drawn(agent):
    """Return a network whose every layer matters."""
    torch.manual_seed(0)
    network = ValueMapNetwork(agent)
    with torch.no_grad():
        for value in network.parameters():
            value.normal_(0.0, 0.05)
    return network


def drawn_inputs():
    """Return what the network reads, drawn."""
    rng = np.random.default_rng(0)
    return {'room': rng.integers(0, 256, (OF_ROOM, CELLS, CELLS), dtype=np.uint8),
            'others': rng.integers(0, 256, (OF_OTHERS, CELLS, CELLS), dtype=np.uint8),
            'numbers': rng.random(observation_map.NUMBERS, dtype=np.float32),
            'lens': rng.random(observation_map.OF_LENS, dtype=np.float32)}


def standing(room):
    """Return three cameras around the middle of a room."""
    middle = np.append(room.bounds.mean(axis=0)[:2], room.bounds[0, 2] + 1.9)
    return middle + np.array([[0.4, 0.1, 0.0], [-0.3, 0.5, 0.0], [0.1, -0.6, 0.0]])


def known_of(room, positions):
    """Return the model of a cloud and its map."""
    model, memory = PartialMap(room.points, positions, RANGE, 4000, 24), LookHistory()
    memory.visit(positions)
    return model, observation_map.ObservationMap(
        model, memory.unseen(model), len(positions), RANGE, float(positions[0, 2]))


def test_the_map_tells_of_all_points_and_of_what_others_leave(room):
    positions = standing(room)
    model, known = known_of(room, positions)
    nobody, numbers = known.others([], np.empty((0, 3)))
    some, fewer = known.others([model.look(position) for position in positions], positions)
    for found, channels in ((known.room, OF_ROOM), (nobody, OF_OTHERS)):
        assert found.shape == (channels, CELLS, CELLS) and found.dtype == np.uint8
    # Points that are left fall, the air that is covered grows, and the error is less.
    assert (some[:2] <= nobody[:2]).all() and (some[:2] < nobody[:2]).any()
    assert not nobody[4:].any() and some[4:].any()
    assert fewer[-1] < numbers[-1] == pytest.approx(np.log(1.005) / 5.0)


def test_a_room_that_is_turned_has_a_turned_map(room):
    positions = standing(room)
    x, y, z = positions.T
    known = known_of(room, positions)[1]
    other = known_of(turned(room, 90.0), np.column_stack([-y, x, z]))[1]
    # The first axis of the map turns to where the second was.
    expected = np.rot90(known.room, 1, (1, 2)).astype(int)
    assert np.mean(np.abs(expected - other.room)[:-1] > 60) < 0.02


def test_in_a_room_larger_than_the_grid_cells_are_larger():
    for size, edge in (([5.0, 8.0], EDGE_M), ([40.0, 10.0], 41.0 / CELLS)):
        window = observation_map.Window.around(np.array([[0.0, 0.0, 0.0], [*size, 3.0]]))
        assert window.edge == pytest.approx(edge)
        assert (window.cell_of(np.array([[0.0, 0.0], size])) >= 0).all()
        assert window.cell_of(window.centres.reshape(-1, 2)).tolist() == list(range(CELLS ** 2))


def test_a_lens_is_told_by_its_angles():
    assert lens_features(None).tolist() == lens_features(CameraModel().lens).tolist() == [1.0, 1.0]
    assert lens_features(D455.lens) == pytest.approx([87.0 / 360.0, 58.0 / 180.0], abs=1e-6)
    lidar = SENSORS['velodyne_vlp16'].model.lens
    assert lens_features(lidar) == pytest.approx([1.0, 30.0 / 180.0], abs=1e-6)


def test_values_between_headings_are_between_them():
    at = observation_map.interpolate_yaws
    values = np.array([[0.0, np.inf], [1.0, np.inf], [2.0, np.inf], [3.0, np.inf]])
    yaws = np.array([0.0, 0.25 * np.pi, -0.25 * np.pi, 2.0 * np.pi])
    assert at(values, np.zeros(4, dtype=int), yaws) == pytest.approx([0.0, 0.5, 1.5, 0.0])
    assert at(values, np.ones(1, dtype=int), np.array([np.pi])) == [np.inf]
    # Where there is one heading, it is that of all.
    assert at(values[1:2], np.array([0]), np.array([1.0])) == [1.0]


@pytest.mark.parametrize('number', range(8))
def test_maps_places_and_headings_turn_together(number):
    torch.manual_seed(number)
    maps = torch.rand(2, 1, 24, 40)
    places = 1.0 + torch.rand(2, 50, 2) * torch.tensor([22.0, 38.0])
    changed, moved = value_fit.turned_inputs({'room': maps, 'others': maps}, places, number)
    expected = value_fit.values_at(maps, places)
    assert torch.allclose(value_fit.values_at(changed['room'], moved), expected, atol=1e-4)
    # What a heading looks at is at the same heading when all is turned.
    room = torch.zeros(1, OF_ROOM, CELLS, CELLS, dtype=torch.uint8)
    place, heading = torch.tensor([[[20.5, 40.5]]]), 3
    yaw = heading * 0.25 * math.pi
    room[0, 0, round(20 + 10 * math.cos(yaw)), round(40 + 10 * math.sin(yaw))] = 255
    changed, places = value_fit.turned_inputs({'room': room}, place, number)
    found = torch.nonzero(changed['room'][0, 0])[0] + 0.5 - places[0, 0]
    seen = torch.atan2(found[1], found[0]) / (0.25 * math.pi)
    assert round(float(seen)) % 8 == int(value_fit.turned_headings(8, number)[heading])


def test_maps_of_headings_are_read_at_places():
    values = torch.arange(2.0 * 3 * 8 * 8).reshape(2, 3, 8, 8)
    places = torch.tensor([[[2.5, 4.5], [0.5, 7.5]]] * 2)
    expected = torch.stack([values[:, :, 2, 4], values[:, :, 0, 7]], dim=1)
    torch.testing.assert_close(value_fit.values_at(values, places), expected)


def test_the_loss_is_least_at_the_labels():
    labels = -torch.rand(3, 20, 2)
    labels[:, 15:] = torch.nan
    found = labels.nan_to_num(0.0)
    assert float(value_fit.loss_of(found, labels)) == pytest.approx(0.0, abs=1e-6)
    assert float(value_fit.loss_of(found + 0.1 * torch.randn(3, 20, 2), labels)) > 1e-4


def test_each_camera_is_valued_by_the_map_of_its_kind_and_these_begin_alike():
    network, seen = drawn(AIMED), drawn_inputs()
    policy = ValuePolicy(Checkpoint(AIMED, network.state_dict()))
    plain = ValuePolicy(Checkpoint(ROUND, {
        name: value for name, value in network.state_dict().items()
        if not name.startswith('aimed.')}))
    whole = policy.values(**seen | {'lens': lens_features(None)})
    assert whole.shape == (1, CELLS, CELLS)
    for lens, shape in ((D455.lens, (8, CELLS, CELLS)), (None, whole.shape)):
        given = seen | {'lens': lens_features(lens)}
        assert policy.values(**given).shape == shape
        assert np.array_equal(plain.values(**given), whole)
    network.begin_aimed()
    with torch.no_grad():
        whole, aimed = (valued(one, batch(seen)) for one in (network, network.aimed))
    torch.testing.assert_close(aimed, whole.expand(1, 8, CELLS, CELLS))


def actor_to(window, lowest):
    """Return an actor whose values are least at a place."""
    values = 10.0 * np.linalg.norm(window.centres - lowest, axis=-1).astype(np.float32) ** 2
    return MapActor(SimpleNamespace(values=lambda **seen: values), np.random.default_rng(0), 0.5,
                    RANGE, 0.1, 0.0)


def test_a_camera_goes_where_the_map_says_and_no_farther_than_it_can(room):
    start = position = standing(room)[:1]
    window = known_of(room, start)[1].window
    space = FreePlane.around(room.points, start, 0.1, 0.0)
    lowest = space.inside(start[0, :2] + np.array([0.9, 1.3]))
    actor = actor_to(window, lowest)
    for turn in range(6):
        move = actor.move(room.points, position, turn, 6)
        assert np.linalg.norm(move, axis=1).max() <= 0.5 + 1e-9
        position = position + np.append(move, [[0.0]], axis=1)
    # The parabola through cells finds the place between them.
    assert np.linalg.norm(position[0, :2] - lowest) < 0.1
    # In two turns it is sent no farther than it gets.
    actor = actor_to(window, start[0, :2] + np.array([2.5, 0.0]))
    actor.move(room.points, start, 0, 2)
    assert np.linalg.norm(actor.targets[0] - start[0, :2]) <= 1.0 + EDGE_M


def test_the_actor_turns_cameras_as_the_map_says_unless_there_are_few_turns(room):
    """Of all headings at each place the network finds one best, and nothing else matters."""
    best, values, lenses = 5, np.ones((8, CELLS, CELLS), np.float32), []
    values[best] = -1.0
    network = SimpleNamespace(values=lambda lens, **seen: lenses.append(lens) or values)
    placement, models = np.zeros((2, 6)), [replace(D455, max_range=RANGE)] * 2
    placement[:, :3] = standing(room)[:2]
    placement[:, 3:5] = [[0.0, 0.2], [3.0, 0.2]]
    actor = MapActor(network, np.random.default_rng(0), 0.5, RANGE, 0.1)
    actor.set_rig_state(RigState(placement, models, 2))
    for turns, lens in ((MIN_TURNS_FOR_HEADINGS - 1, None),
                        (MIN_TURNS_FOR_HEADINGS, models[0].lens)):
        lenses.clear()
        actor.reset()
        actor.move(room.points, placement[:, :3], 0, turns)
        assert np.allclose(np.stack(lenses), lens_features(lens))
    away = (actor.headings[:, 0] - best * 0.25 * np.pi + np.pi) % (2.0 * np.pi) - np.pi
    assert np.abs(away).max() < 0.5 * np.pi


@pytest.mark.parametrize(('rig', 'headings'), [
    (RigConfig(), 0), (RigConfig(sensors='realsense_d455'), 8)])
def test_labels_are_what_the_true_room_loses(room, small, rig, headings):
    true = TrueRoom(room, SimulationConfig(rig), headings)
    values, error = true.values([3]), true.engine.depth_error
    floor = 0.005 * error.worst
    seen = [true.engine.look(pose).seen for pose in true.poses[:30]]
    for pose in (3, 8, 26):
        expected = np.log((error(seen[3] | seen[pose]) + floor) / (error(seen[3]) + floor))
        assert values[pose] == pytest.approx(expected, abs=1e-4)
    assert (values <= 1e-6).all() and true.values([]).max() <= 0.0


def test_all_headings_of_a_place_are_labelled_one_after_the_other(room, small):
    true = TrueRoom(room, SimulationConfig(RigConfig(sensors='realsense_d455')), 8)
    assert len(true.poses) == 8 * len(true.places)
    assert np.allclose(true.poses[:8, :2], true.places[0])
    assert np.allclose(true.poses[:8, 3], observation_map.yaws_of(8))
    assert np.allclose(true.poses[:, 4], value_states.TUNING.aimed_pitch)
    assert np.ptp(true.values([11]).reshape(-1, 8), axis=1).max() > 0.01
    pose = true.poses[[37, 5]]
    assert true.nearest_poses(pose[:, :2], pose[:, 3:] + [0.2, 0.3, 0.0]).tolist() == [37, 5]


@pytest.mark.parametrize('headings', [0, 8])
def test_the_same_seed_gives_the_same_states_of_their_shape(states, headings):
    task, shapes = replace(TASK, headings=headings), shapes_of(headings)
    found, again = play_states(task) if headings else states, play_states(task)
    assert len(found['of']) and found['of'].max() == len(found['room']) - 1
    assert found.keys() == again.keys() == shapes.keys()
    for name, (kind, shape) in shapes.items():
        assert found[name].dtype == kind and found[name].shape[1:] == shape, name
        assert np.array_equal(found[name], again[name], equal_nan=kind is np.float16), name
    assert (found['lens'] < 1.0).all() == bool(headings)


def test_a_fit_that_was_interrupted_goes_on_as_if_not(states, tmp_path):
    choices, losses, path = value_fit.ValueSet([states, states]), [], tmp_path / 'state'
    assert len(choices) == 2 * len(states['of'])

    def begun():
        torch.manual_seed(1)
        return value_fit.ValueFit(ValueMapNetwork(ROUND), ValuesConfig(batch_size=4), 3)

    whole, half, later = begun(), begun(), begun()
    whole.run(choices, 4, 4, lambda step, loss: losses.append(loss))
    half.run(choices, 2, 4)
    path.write_bytes(half.to_bytes('run'))
    assert later.load(path) == 'run' and later.step == 2
    later.run(choices, 4, 4)
    assert_same(whole.average.state_dict(), later.average.state_dict())
    assert len(losses) == 4 and np.isfinite(losses).all()
    path.write_bytes(b'torn')
    with pytest.raises(CheckpointError):
        later.load(path)


@pytest.fixture
def run_copy(tiny_run, here, tmp_path):
    """Return a copy of that folder, and the weights."""
    return shutil.copytree(tiny_run[0], tmp_path / 'copy'), tiny_run[1]


def test_the_map_actor_is_trained_and_goes_on_where_it_stopped(run_copy):
    (folder, first), config = run_copy, from_nested(TrainingConfig, TINY)
    assert [line['updates'] for line in first.provenance['curve']] == [2, 4, 4]
    assert first.config == ROUND
    assert {'policy', 'random_moves'} <= first.provenance['test'].keys()
    assert sorted(path.name for path in (folder / 'states').iterdir()) == [
        'own_00000.npz', 'validation_00000.npz', 'walked_00000.npz']
    again = train(config, folder, 'a command')
    assert again.run == first.run and again.provenance['curve'] == first.provenance['curve']
    assert_same(first.weights, again.weights)
    (folder / 'values_state.safetensors').unlink()
    (folder / 'states' / 'walked_00000.npz').write_bytes(b'torn')
    with pytest.raises(UserError, match='walked_00000.npz'):
        train(config, folder, 'a command')


def test_soft_actor_critic_goes_on_from_dense_values_and_from_itself(run_copy):
    folder, values = run_copy
    runs = [train(from_nested(TrainingConfig, {**TINY, 'interactions': count}), folder)
            for count in (8, 16)]
    assert runs[0].run == runs[1].run
    lines = [(line['phase'], line['interactions']) for line in records(folder)]
    assert lines == [('values', 0), ('values', 0), ('values', 0), ('sac', 8), ('sac', 16)]


def test_only_the_map_of_headings_is_learned_where_there_are_any(small, here, tmp_path,
                                                                 monkeypatch):
    # At first cameras that are aimed see too little of a thinner scan to tell that it is a room.
    monkeypatch.setattr(value_states, 'TUNING', replace(
        value_states.TUNING, scan_points=(8000,)))
    first = Checkpoint(ROUND, drawn(ROUND).state_dict(), 3, 'first', {'seed': 5})
    first.save(tmp_path / 'first.safetensors')
    made = train(from_nested(TrainingConfig, TINY | {
        'model': str(tmp_path / 'first.safetensors'), 'agent': AIMED_INPUTS}), tmp_path / 'run')
    assert made.config.headings == 8
    assert made.provenance['began_with'] == {'run': 'first', 'updates': 3, 'seed': 5}
    assert_same(first.weights, {name: made.weights[name] for name in first.weights})
    assert not torch.equal(made.weights['aimed.enter.weight'][:, :1],
                           first.weights['enter.weight'][:, :1])
    # It may be the start of another run, with headings or without.
    made.save(tmp_path / 'second.safetensors')
    for agent in (AIMED_INPUTS, TINY['agent']):
        config = from_nested(TrainingConfig, TINY | {
            'model': str(tmp_path / 'second.safetensors'), 'agent': agent})
        weights = ValueRun(config, tmp_path, Here(), Progress()).checkpoint().weights
        assert_same(weights, {name: made.weights[name] for name in weights})
        assert ('aimed.enter.weight' in weights) == ('headings' in agent)


def test_settings_that_mean_nothing_or_do_not_fit_the_network_are_refused():
    for changes, key in (({'values': {'steps': 0}}, 'interactions'),
                         ({'agent': AIMED_INPUTS}, 'model'),
                         ({'simulation': {'rig': {'sensors': 'realsense_d455'}}}, 'rig.sensors'),
                         ({'agent': {'inputs': 'cloud', 'headings': 8}}, 'agent.headings')):
        with pytest.raises(ConfigurationError, match=key):
            from_nested(TrainingConfig, TINY | changes)
    with pytest.raises(CheckpointError):
        Checkpoint(AIMED, ValueMapNetwork(ROUND).state_dict())
