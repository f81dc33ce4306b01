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

from conftest import Here, made_room
import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.geometry.packed_bits import no_bits
from ocp_ros.online.partial_map import LookHistory, PartialMap
from ocp_ros.online.rig_state import RigState
from ocp_ros.policy.agent_config import AgentConfig, CheckpointError
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.policy.map_actor import MapActor, MIN_TURNS_FOR_HEADINGS
from ocp_ros.policy.observation_map import (
    CELLS,
    EDGE_M,
    interpolate_yaws,
    lens_features,
    NUMBERS,
    ObservationMap,
    OF_LENS,
    OF_OTHERS,
    OF_ROOM,
    Window,
    yaws_of,
)
from ocp_ros.policy.policy import ValuePolicy
from ocp_ros.policy.value_network import valued, ValueMapNetwork
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.ros.policy.policy_config import PolicyNodeConfig
from ocp_ros.ros.policy.policy_planners import make_planner
from ocp_ros.scenes.scene import turned
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.training import train as training
from ocp_ros.training import value_states
from ocp_ros.training.train import train
from ocp_ros.training.training_config import RoomsConfig, TrainingConfig, ValuesConfig
from ocp_ros.training.value_fit import (
    loss_of,
    turned_headings,
    turned_inputs,
    ValueFit,
    values_at,
    ValueSet,
)
from ocp_ros.training.value_states import play_states, shapes_of, StateTask, TrueRoom
from ocp_ros.util.settings import ConfigurationError, from_nested, UserError
import pytest
import torch

#: Agents for cameras that see all around, and for those that are aimed as well.
ROUND, AIMED = AgentConfig(inputs='map'), AgentConfig(inputs='map', headings=8)
AIMED_INPUTS = {'inputs': 'map', 'headings': 8}
RANGE = 4.0
D455 = SENSORS['realsense_d455'].model
TINY = {'interactions': 0, 'agent': {'inputs': 'map'}, 'workers': 1,
        'rooms': {'training': 2, 'validation': 1, 'test': 1, 'points': 1500, 'rotations': '0'},
        'simulation': {'engine': {'preset': 'fast', 'error_rows': 16, 'coverage_cell': 1.0},
                       'episode': {'turns': 3}},
        'values': {'rooms': 1, 'own_rooms': 1, 'steps': 2, 'own_steps': 2, 'batch_size': 2,
                   'evaluate_every': 2}}


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
    return play_states(StateTask(RoomsConfig(), '1000', (0, 0, 0)))


@pytest.fixture(scope='module')
def tiny_run(small, tmp_path_factory):
    """Return the folder and the weights of a run that is finished."""
    folder = tmp_path_factory.mktemp('run')
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, 'WorkerPool', Here)
        return folder, train(from_nested(TrainingConfig, TINY), folder, 'a command')


def drawn(agent):
    """Return a network whose every layer matters."""
    torch.manual_seed(0)
    network = ValueMapNetwork(agent)
    with torch.no_grad():
        for value in network.parameters():
            value.normal_(0.0, 0.05)
    return network


def drawn_inputs(count):
    """Return what the network reads, drawn."""
    rng = np.random.default_rng(0)
    maps = {name: rng.integers(0, 256, (count, channels, CELLS, CELLS), dtype=np.uint8)
            for name, channels in (('room', OF_ROOM), ('others', OF_OTHERS))}
    numbers = {'numbers': rng.random((count, NUMBERS), dtype=np.float32),
               'lens': rng.random((count, OF_LENS), dtype=np.float32)}
    return maps | numbers


def standing(room):
    """Return three cameras around the middle of a room."""
    middle = np.append(room.bounds.mean(axis=0)[:2], room.bounds[0, 2] + 1.9)
    return middle + np.array([[0.4, 0.1, 0.0], [-0.3, 0.5, 0.0], [0.1, -0.6, 0.0]])


def known_of(room, positions):
    """Return the model of a cloud and its map."""
    model, memory = PartialMap(room.points, positions, RANGE, 4000, 24), LookHistory()
    memory.visit(positions)
    return model, ObservationMap(model, memory.unseen(model), len(positions), RANGE,
                                 float(positions[0, 2]))


def test_the_map_tells_of_all_points_and_of_what_others_leave(room):
    positions = standing(room)
    model, known = known_of(room, positions)
    assert known.room.shape == (OF_ROOM, CELLS, CELLS) and known.room.dtype == np.uint8
    views = [model.look(position) for position in positions]
    nobody, numbers = known.others([], np.empty((0, 3)))
    some, fewer = known.others(views, positions)
    assert nobody.shape == (OF_OTHERS, CELLS, CELLS) and numbers.shape == (NUMBERS,)
    # Points that are left fall, the air that is covered grows, and the error is less.
    assert (some[:2] <= nobody[:2]).all() and (some[:2] < nobody[:2]).any()
    assert not nobody[4:].any() and some[4:].any()
    assert fewer[-1] < numbers[-1] == pytest.approx(np.log(1.005) / 5.0)


def test_a_room_that_is_turned_has_a_turned_map(room):
    positions, quarter = standing(room), turned(room, 90.0)
    turned_positions = positions.copy()
    turned_positions[:, 0], turned_positions[:, 1] = -positions[:, 1], positions[:, 0]
    known, other = known_of(room, positions)[1], known_of(quarter, turned_positions)[1]
    # The first axis of the map turns to where the second was.
    expected = np.rot90(known.room, 1, (1, 2)).astype(int)
    away = np.abs(expected - other.room)[:len(expected) - 1]
    assert np.mean(away > 60) < 0.02


def test_in_a_room_larger_than_the_grid_cells_are_larger():
    small = Window.around(np.array([[0.0, 0.0, 0.0], [5.0, 8.0, 3.0]]))
    large = Window.around(np.array([[0.0, 0.0, 0.0], [40.0, 10.0, 3.0]]))
    assert small.edge == EDGE_M and large.edge == pytest.approx(41.0 / CELLS)
    for window, bounds in ((small, (5.0, 8.0)), (large, (40.0, 10.0))):
        corners = np.array([[0.0, 0.0], bounds])
        assert (window.cell_of(corners) >= 0).all()
        assert window.cell_of(window.centres.reshape(-1, 2)).tolist() == list(range(CELLS ** 2))


def test_a_lens_is_told_by_its_angles():
    assert lens_features(None).tolist() == lens_features(CameraModel().lens).tolist() == [1.0, 1.0]
    assert lens_features(D455.lens) == pytest.approx([87.0 / 360.0, 58.0 / 180.0], abs=1e-6)
    lidar = SENSORS['velodyne_vlp16'].model.lens
    assert lens_features(lidar) == pytest.approx([1.0, 30.0 / 180.0], abs=1e-6)


def test_values_between_headings_are_between_them():
    values = np.array([[0.0, np.inf], [1.0, np.inf], [2.0, np.inf], [3.0, np.inf]])
    yaws = np.array([0.0, 0.25 * np.pi, -0.25 * np.pi, 2.0 * np.pi])
    assert interpolate_yaws(values, np.zeros(4, dtype=int), yaws) == pytest.approx(
        [0.0, 0.5, 1.5, 0.0])
    assert interpolate_yaws(values, np.ones(1, dtype=int), np.array([np.pi])) == [np.inf]
    # Where there is one heading, it is that of all.
    assert interpolate_yaws(values[1:2], np.array([0]), np.array([1.0])) == [1.0]


@pytest.mark.parametrize('number', range(8))
def test_maps_and_places_turn_together(number):
    torch.manual_seed(number)
    maps = torch.rand(2, 1, 24, 40)
    places = 1.0 + torch.rand(2, 50, 2) * torch.tensor([22.0, 38.0])
    changed, moved = turned_inputs({'room': maps, 'others': maps}, places, number)
    assert torch.allclose(values_at(changed['room'], moved), values_at(maps, places), atol=1e-4)


@pytest.mark.parametrize('number', range(8))
def test_a_mark_ahead_of_a_place_stays_ahead_of_it(number):
    """What a heading looks at is at the same heading when all is turned."""
    room = torch.zeros(1, OF_ROOM, CELLS, CELLS, dtype=torch.uint8)
    place, heading = torch.tensor([[[20.5, 40.5]]]), 3
    yaw = heading * 0.25 * math.pi
    mark = [round(20 + 10 * math.cos(yaw)), round(40 + 10 * math.sin(yaw))]
    room[0, 0, mark[0], mark[1]] = 255
    changed, places = turned_inputs({'room': room}, place, number)
    found = torch.nonzero(changed['room'][0, 0])[0] + 0.5 - places[0, 0]
    seen = torch.atan2(found[1], found[0]) / (0.25 * math.pi)
    assert round(float(seen)) % 8 == int(turned_headings(8, number)[heading])


def test_maps_of_headings_are_read_at_places():
    values = torch.arange(2.0 * 3 * 8 * 8).reshape(2, 3, 8, 8)
    places = torch.tensor([[[2.5, 4.5], [0.5, 7.5]]] * 2)
    expected = torch.stack([values[:, :, 2, 4], values[:, :, 0, 7]], dim=1)
    torch.testing.assert_close(values_at(values, places), expected)


def test_the_loss_is_least_at_the_labels():
    values = -torch.rand(3, 20, 2)
    values[:, 15:] = torch.nan
    assert float(loss_of(values.nan_to_num(0.0), values)) == pytest.approx(0.0, abs=1e-6)
    assert float(loss_of(values.nan_to_num(0.0) + 0.1 * torch.randn(3, 20, 2), values)) > 1e-4


def test_a_value_map_begins_as_that_of_cameras_that_see_all_around():
    network = drawn(AIMED)
    network.begin_aimed()
    seen = {name: torch.from_numpy(value) for name, value in drawn_inputs(2).items()}
    with torch.no_grad():
        whole, aimed = valued(network, seen), valued(network.aimed, seen)
    assert whole.shape == (2, 1, CELLS, CELLS) and aimed.shape == (2, 8, CELLS, CELLS)
    torch.testing.assert_close(aimed, whole.expand_as(aimed))


def test_each_camera_is_valued_by_the_map_of_its_kind():
    network = drawn(AIMED)
    policy = ValuePolicy(Checkpoint(AIMED, network.state_dict()))
    seen = {name: value[0] for name, value in drawn_inputs(1).items()}
    aimed = policy.values(**seen | {'lens': lens_features(D455.lens)})
    whole = policy.values(**seen | {'lens': lens_features(None)})
    assert aimed.shape == (8, CELLS, CELLS) and whole.shape == (1, CELLS, CELLS)
    plain = ValuePolicy(Checkpoint(ROUND, {
        name: value for name, value in network.state_dict().items()
        if not name.startswith('aimed.')}))
    for lens in (D455.lens, None):
        assert np.array_equal(plain.values(**seen | {'lens': lens_features(lens)}), whole)


class Valued:
    """A network that values the map alike for everybody, and keeps what lenses it was told of."""

    def __init__(self, values):
        self._values, self.lenses = values.astype(np.float32), []

    def values(self, room, others, numbers, lens):
        """Return the values."""
        self.lenses.append(lens)
        return self._values


def actor_to(window, lowest):
    """Return an actor whose values are least at a place."""
    away = np.linalg.norm(window.centres - lowest, axis=-1)
    return MapActor(Valued(10.0 * away ** 2), np.random.default_rng(0), 0.5, RANGE, 0.1, 0.0)


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
    best, values = 5, np.full((8, CELLS, CELLS), 1.0)
    values[best] = -1.0
    network, models = Valued(values), [replace(D455, max_range=RANGE)] * 2
    placement = np.zeros((2, 6))
    placement[:, :3] = np.append(room.bounds.mean(axis=0)[:2], 1.9) + [[-0.5, 0, 0], [0.5, 0, 0]]
    placement[:, 3:5] = [[0.0, 0.2], [3.0, 0.2]]
    actor = MapActor(network, np.random.default_rng(0), 0.5, RANGE, 0.1)
    actor.set_rig_state(RigState(placement, models, 2))
    for turns, lens in ((MIN_TURNS_FOR_HEADINGS - 1, None),
                        (MIN_TURNS_FOR_HEADINGS, models[0].lens)):
        network.lenses.clear()
        actor.reset()
        actor.move(room.points, placement[:, :3], 0, turns)
        assert np.allclose(np.stack(network.lenses), lens_features(lens))
    away = (actor.headings[:, 0] - yaws_of(8)[best] + np.pi) % (2.0 * np.pi) - np.pi
    assert np.abs(away).max() < 0.5 * np.pi


def loss_of_error(true, other, pose):
    """Return what the label of a pose is beside another one, by the depth error itself."""
    error = true.engine.depth_error
    seen = [true.engine.look(true.poses[number]).seen for number in (other, pose)]
    floor = 0.005 * error.worst
    return np.log((error(seen[0] | seen[1]) + floor) / (error(seen[0]) + floor))


def test_labels_are_what_the_true_room_loses(room, small):
    true = TrueRoom(room, SimulationConfig())
    values, error = true.values([3]), true.engine.depth_error
    assert values[8] == pytest.approx(loss_of_error(true, 3, 8), abs=1e-4)
    assert values[3] == pytest.approx(0.0, abs=1e-5) and (values <= 1e-6).all()
    assert true.values([]).max() <= 0.0
    assert error(no_bits(len(room))) == pytest.approx(error.worst)


def test_labels_of_headings_are_what_the_true_room_loses(room, small):
    true = TrueRoom(room, SimulationConfig(RigConfig(sensors='realsense_d455')), 8)
    assert len(true.poses) == 8 * len(true.places)
    assert np.allclose(true.poses[:8, :2], true.places[0])
    assert np.allclose(true.poses[:8, 3], yaws_of(8))
    assert np.allclose(true.poses[:, 4], value_states.TUNING.aimed_pitch)
    values = true.values([11])
    assert values[26] == pytest.approx(loss_of_error(true, 11, 26), abs=1e-4)
    assert np.ptp(values.reshape(-1, 8), axis=1).max() > 0.01
    pose = true.poses[[37, 5]]
    assert true.nearest_poses(pose[:, :2], pose[:, 3:] + [0.2, 0.3, 0.0]).tolist() == [37, 5]


@pytest.mark.parametrize('headings', [0, 8])
def test_the_same_seed_gives_the_same_states_of_their_shape(small, headings):
    task = StateTask(RoomsConfig(), '1000', (0, 0, 1), headings=headings)
    states, again = play_states(task), play_states(task)
    assert len(states['of']) and states['of'].max() == len(states['room']) - 1
    assert states.keys() == again.keys() == shapes_of(headings).keys()
    for name, (kind, shape) in shapes_of(headings).items():
        assert states[name].dtype == kind and states[name].shape[1:] == shape, name
        assert np.array_equal(states[name], again[name], equal_nan=kind is np.float16), name
    assert (states['lens'] < 1.0).all() == bool(headings)


def test_a_fit_that_was_interrupted_goes_on_as_if_not(states, tmp_path):
    choices = ValueSet([states, states])
    assert len(choices) == 2 * len(states['of'])

    def begun():
        torch.manual_seed(1)
        return ValueFit(ValueMapNetwork(ROUND), ValuesConfig(batch_size=4), 3)

    whole, half, later = begun(), begun(), begun()
    losses = []
    whole.run(choices, 4, 4, lambda step, loss: losses.append(loss))
    half.run(choices, 2, 4)
    (tmp_path / 'state').write_bytes(half.to_bytes('run'))
    assert later.load(tmp_path / 'state') == 'run' and later.step == 2
    later.run(choices, 4, 4)
    for name, value in whole.average.state_dict().items():
        assert torch.equal(value, later.average.state_dict()[name]), name
    assert np.isfinite(losses).all()
    (tmp_path / 'state').write_bytes(b'torn')
    with pytest.raises(CheckpointError):
        later.load(tmp_path / 'state')


def test_the_map_actor_is_trained_and_goes_on_where_it_stopped(tiny_run, here, tmp_path):
    (folder, first), config = tiny_run, from_nested(TrainingConfig, TINY)
    lines = first.provenance['curve']
    assert [line['updates'] for line in lines] == [2, 4, 4]
    assert {'policy', 'random_moves'} <= first.provenance['test'].keys()
    assert sorted(path.name for path in (folder / 'states').iterdir()) == [
        'own_00000.npz', 'validation_00000.npz', 'walked_00000.npz']
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    again = train(config, tmp_path, 'a command')
    assert again.run == first.run and again.provenance['curve'] == lines
    for name, value in first.weights.items():
        assert torch.equal(value, again.weights[name]), name
    (tmp_path / 'values_state.safetensors').unlink()
    (tmp_path / 'states' / 'walked_00000.npz').write_bytes(b'torn')
    with pytest.raises(UserError, match='walked_00000.npz'):
        train(config, tmp_path, 'a command')


def test_only_the_map_of_headings_is_learned_where_there_are_any(tiny_run, here, tmp_path,
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
    for name, value in first.weights.items():
        assert torch.equal(made.weights[name], value), name
    assert not torch.equal(made.weights['aimed.enter.weight'][:, :1],
                           first.weights['enter.weight'][:, :1])
    # It may be the start of another run, with headings or without; states were played before.
    made.save(tmp_path / 'second.safetensors')
    for agent, played in ((AIMED_INPUTS, tmp_path / 'run'), (TINY['agent'], tiny_run[0])):
        folder = tmp_path / f'from {played.name}'
        shutil.copytree(played / 'states', folder / 'states')
        again = from_nested(TrainingConfig, TINY | {
            'model': str(tmp_path / 'second.safetensors'), 'agent': agent})
        assert train(again, folder).config == AgentConfig(**agent)


def test_settings_that_mean_nothing_for_a_map_are_refused():
    with pytest.raises(ConfigurationError, match='interactions'):
        from_nested(TrainingConfig, TINY | {'values': {'steps': 0}})
    with pytest.raises(ConfigurationError, match='agent.headings'):
        AgentConfig('cloud', headings=8)
    with pytest.raises(ConfigurationError, match='model'):
        from_nested(TrainingConfig, TINY | {'agent': AIMED_INPUTS})
    with pytest.raises(CheckpointError):
        Checkpoint(AIMED, ValueMapNetwork(ROUND).state_dict())


def test_policy_node_runs_the_map_actor_and_takes_new_weights_of_it(room, tmp_path):
    Checkpoint(ROUND, drawn(ROUND).state_dict()).save(tmp_path / 'map.safetensors')
    checkpoint = Checkpoint.load(tmp_path / 'map.safetensors')
    planner, learned = make_planner(PolicyNodeConfig(planner='learned_lookahead'), checkpoint)
    assert planner.guide is learned and isinstance(learned, MapActor)
    # It draws nothing.
    moves = [MapActor(learned.policy, np.random.default_rng(seed), 0.5, RANGE, 0.1).move(
        room.points, standing(room), 0, 30) for seed in (0, 5)]
    assert moves[0].shape == (3, 2) and np.isfinite(moves[0]).all()
    np.testing.assert_array_equal(*moves)
    newer = Checkpoint(ROUND, ValueMapNetwork(ROUND).state_dict(), 1)
    assert learned.policy.replaced(newer).checkpoint is newer
