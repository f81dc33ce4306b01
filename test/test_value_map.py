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

"""The map actor: what it reads, its network, how it chooses, its labels and its fit."""

from types import SimpleNamespace

import numpy as np
from ocp_ros.geometry.depth_error import DepthError
from ocp_ros.geometry.packed_bits import no_bits
from ocp_ros.online.partial_map import LookHistory, PartialMap
from ocp_ros.policy.agent_config import AgentConfig, CheckpointError
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.policy.map_actor import MapActor
from ocp_ros.policy.observation_map import (
    CELLS,
    EDGE_M,
    NUMBERS,
    ObservationMap,
    OF_OTHERS,
    OF_ROOM,
    Window,
)
from ocp_ros.policy.value_network import ValueMapNetwork
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rooms.generator import generate_room
from ocp_ros.ros.policy.policy_config import PolicyNodeConfig
from ocp_ros.ros.policy.policy_planners import make_planner
from ocp_ros.scenes.scene import turned
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.training.train import train
from ocp_ros.training.training_config import RoomsConfig, TrainingConfig, ValuesConfig
from ocp_ros.training.value_fit import loss_of, turned_inputs, ValueFit, values_at, ValueSet
from ocp_ros.training.value_states import play_states, StateTask, TrueRoom
from ocp_ros.util.settings import ConfigurationError, from_nested, UserError
import pytest
import torch

AGENT = AgentConfig(inputs='map')
RANGE = 4.0


@pytest.fixture(scope='module')
def room():
    """Return a room that has been seen whole."""
    return generate_room(7, 4000)


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


@pytest.mark.parametrize('number', range(8))
def test_maps_and_places_turn_together(number):
    torch.manual_seed(number)
    maps = torch.rand(2, 1, 24, 40)
    places = 1.0 + torch.rand(2, 50, 2) * torch.tensor([22.0, 38.0])
    observation = {'room': maps, 'others': maps}
    changed, moved = turned_inputs(observation, places, number)
    assert torch.allclose(values_at(changed['room'], moved), values_at(maps, places),
                          atol=1e-4)


def test_the_loss_is_least_at_the_labels():
    values = -torch.rand(3, 20, 2)
    values[:, 15:] = torch.nan
    assert float(loss_of(values.nan_to_num(0.0), values)) == pytest.approx(0.0, abs=1e-6)
    assert float(loss_of(values.nan_to_num(0.0) + 0.1 * torch.randn(3, 20, 2), values)) > 1e-4


class Bowl:
    """Values that are least at one place of the map frame, whatever has been seen."""

    def __init__(self, window, lowest):
        away = np.linalg.norm(window.centres - lowest, axis=-1)
        self._values = (10.0 * away ** 2).astype(np.float32)

    def values(self, room, others, numbers, lens):
        """Return the same for everybody."""
        return self._values


def actor_to(window, lowest):
    """Return an actor whose values are least at a place."""
    return MapActor(Bowl(window, lowest), np.random.default_rng(0), 0.5, RANGE, 0.1, 0.0)


def test_a_camera_goes_where_the_map_says_and_no_farther_than_it_can(room):
    position = standing(room)[:1]
    model, known = known_of(room, position)
    space = FreePlane.around(room.points, position, 0.1, 0.0)
    lowest = space.inside(position[0, :2] + np.array([0.9, 1.3]))
    actor = actor_to(known.window, lowest)
    for turn in range(12):
        move = actor.move(room.points, position, turn, 12)
        assert np.linalg.norm(move, axis=1).max() <= 0.5 + 1e-9
        position = position + np.append(move, [[0.0]], axis=1)
    # The parabola through cells finds the place between them.
    assert np.linalg.norm(position[0, :2] - lowest) < 0.1
    # In two turns it is sent no farther than it gets.
    position = standing(room)[:1]
    actor = actor_to(known.window, position[0, :2] + np.array([2.5, 0.0]))
    actor.move(room.points, position, 0, 2)
    assert np.linalg.norm(actor.targets[0] - position[0, :2]) <= 1.0 + EDGE_M


def test_what_is_seen_of_nothing_is_no_room():
    actor = MapActor(SimpleNamespace(), np.random.default_rng(0), 0.5, RANGE, 0.1)
    moves = actor.move(np.empty((0, 3), dtype=np.float32), np.zeros((2, 3)), 0, 5)
    assert moves.shape == (2, 2) and np.linalg.norm(moves, axis=1).max() <= 0.5


def test_labels_are_what_the_true_room_loses(room, small):
    true = TrueRoom(room, SimulationConfig())
    values = true.values([3])
    error: DepthError = true.engine.depth_error
    seen = [true.engine.look(place).seen for place in true.space.placement(true.places[[3, 8]])]
    floor = 0.005 * error.worst
    expected = np.log((error(seen[0] | seen[1]) + floor) / (error(seen[0]) + floor))
    assert values[8] == pytest.approx(expected, abs=1e-4)
    assert values[3] == pytest.approx(0.0, abs=1e-5) and (values <= 1e-6).all()
    assert true.values([]).max() <= 0.0
    assert error(no_bits(len(room))) == pytest.approx(error.worst)


@pytest.fixture(scope='module')
def states(small):
    """Return the states of a room."""
    return play_states(StateTask(RoomsConfig(), '1000', (0, 0, 0)))


def test_the_same_seed_gives_the_same_states(small, states):
    again = play_states(StateTask(RoomsConfig(), '1000', (0, 0, 0)))
    assert states.keys() == again.keys()
    for name, value in states.items():
        assert np.array_equal(value, again[name], equal_nan=value.dtype.kind == 'f'), name
    assert states['of'].max() == len(states['room']) - 1
    assert states['places'].shape[:2] == (len(states['room']), states['values'].shape[1])


def test_a_fit_that_was_interrupted_goes_on_as_if_not(states, tmp_path):
    choices = ValueSet([states, states])
    assert len(choices) == 2 * len(states['of'])
    config = ValuesConfig(batch_size=4)

    def begun():
        torch.manual_seed(1)
        return ValueFit(ValueMapNetwork(AGENT), config, 3)

    whole, half = begun(), begun()
    losses = []
    whole.run(choices, 6, 6, lambda step, loss: losses.append(loss))
    half.run(choices, 3, 6)
    (tmp_path / 'state').write_bytes(half.to_bytes('run'))
    later = begun()
    assert later.load(tmp_path / 'state') == 'run' and later.step == 3
    later.run(choices, 6, 6)
    for name, value in whole.average.state_dict().items():
        assert torch.equal(value, later.average.state_dict()[name]), name
    assert np.isfinite(losses).all()
    (tmp_path / 'state').write_bytes(b'torn')
    with pytest.raises(CheckpointError):
        later.load(tmp_path / 'state')


TINY = {'interactions': 0, 'agent': {'inputs': 'map'}, 'workers': 1,
        'rooms': {'training': 2, 'validation': 1, 'test': 1, 'points': 1500, 'rotations': '0'},
        'simulation': {'engine': {'preset': 'fast', 'error_rows': 16, 'coverage_cell': 1.0},
                       'episode': {'turns': 3}},
        'values': {'rooms': 1, 'own_rooms': 1, 'steps': 2, 'own_steps': 2, 'batch_size': 2,
                   'evaluate_every': 2}}


def test_the_map_actor_is_trained_and_goes_on_where_it_stopped(small, here, tmp_path):
    config = from_nested(TrainingConfig, TINY)
    first = train(config, tmp_path, 'a command')
    lines = first.provenance['curve']
    assert [line['updates'] for line in lines] == [2, 4, 4]
    assert {'policy', 'random_moves'} <= first.provenance['test'].keys()
    assert sorted(path.name for path in (tmp_path / 'states').iterdir()) == [
        'own_00000.npz', 'validation_00000.npz', 'walked_00000.npz']
    again = train(config, tmp_path, 'a command')
    assert again.run == first.run and again.provenance['curve'] == lines
    for name, value in first.weights.items():
        assert torch.equal(value, again.weights[name]), name
    (tmp_path / 'values_state.safetensors').unlink()
    (tmp_path / 'states' / 'walked_00000.npz').write_bytes(b'torn')
    with pytest.raises(UserError, match='walked_00000.npz'):
        train(config, tmp_path, 'a command')
    with pytest.raises(ConfigurationError, match='interactions'):
        from_nested(TrainingConfig, {**TINY, 'values': {'steps': 0}})


def test_policy_node_runs_the_map_actor_and_takes_new_weights_of_it(room, tmp_path):
    torch.manual_seed(0)
    Checkpoint(AGENT, ValueMapNetwork(AGENT).state_dict()).save(tmp_path / 'map.safetensors')
    checkpoint = Checkpoint.load(tmp_path / 'map.safetensors')
    planner, learned = make_planner(PolicyNodeConfig(planner='learned_lookahead'), checkpoint)
    assert planner.guide is learned and isinstance(learned, MapActor)
    # It draws nothing.
    moves = [MapActor(learned.policy, np.random.default_rng(seed), 0.5, RANGE, 0.1).move(
        room.points, standing(room), 0, 30) for seed in (0, 5)]
    assert moves[0].shape == (3, 2) and np.isfinite(moves[0]).all()
    np.testing.assert_array_equal(*moves)
    newer = Checkpoint(AGENT, ValueMapNetwork(AGENT).state_dict(), 1)
    assert learned.policy.replaced(newer).checkpoint is newer
