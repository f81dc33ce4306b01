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

"""The value map of cameras that do not see all around: labels, symmetries, training, acting."""

from dataclasses import replace
import math

import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.online.rig_state import RigState
from ocp_ros.policy.agent_config import AgentConfig, CheckpointError
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.policy.map_actor import MapActor, MIN_TURNS_FOR_HEADINGS
from ocp_ros.policy.observation_map import (
    CELLS,
    interpolate_yaws,
    lens_features,
    NUMBERS,
    OF_LENS,
    OF_OTHERS,
    OF_ROOM,
    yaws_of,
)
from ocp_ros.policy.policy import ValuePolicy
from ocp_ros.policy.value_network import valued, ValueMapNetwork
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.rooms.generator import generate_room
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.training import value_states
from ocp_ros.training.train import train
from ocp_ros.training.training_config import RoomsConfig, TrainingConfig
from ocp_ros.training.value_fit import turned_headings, turned_inputs, values_at
from ocp_ros.training.value_states import play_states, shapes_of, StateTask, TrueRoom, TUNING
from ocp_ros.util.settings import ConfigurationError, from_nested
import pytest
from test_value_map import TINY
import torch

ROUND, AIMED = AgentConfig(inputs='map'), AgentConfig(inputs='map', headings=8)
D455 = SENSORS['realsense_d455'].model


def observation(seed=0, count=2):
    """Return what the network reads, drawn."""
    rng = np.random.default_rng(seed)
    maps = {name: rng.integers(0, 256, (count, channels, CELLS, CELLS), dtype=np.uint8)
            for name, channels in (('room', OF_ROOM), ('others', OF_OTHERS))}
    numbers = {'numbers': rng.random((count, NUMBERS), dtype=np.float32),
               'lens': rng.random((count, OF_LENS), dtype=np.float32)}
    return {name: torch.from_numpy(value) for name, value in (maps | numbers).items()}


def drawn(agent, seed=0):
    """Return a network whose every layer matters."""
    torch.manual_seed(seed)
    network = ValueMapNetwork(agent)
    with torch.no_grad():
        for value in network.parameters():
            value.normal_(0.0, 0.05)
    return network


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
def test_a_mark_ahead_of_a_place_stays_ahead_of_it(number):
    """What a heading looks at is at the same heading when all is turned."""
    room = torch.zeros(1, OF_ROOM, CELLS, CELLS, dtype=torch.uint8)
    place, heading = torch.tensor([[[20.5, 40.5]]]), 3
    yaw = heading * 0.25 * math.pi
    mark = [round(20 + 10 * math.cos(yaw)), round(40 + 10 * math.sin(yaw))]
    room[0, 0, mark[0], mark[1]] = 255
    turned, places = turned_inputs({'room': room}, place, number)
    found = torch.nonzero(turned['room'][0, 0])[0] + 0.5 - places[0, 0]
    seen = torch.atan2(found[1], found[0]) / (0.25 * math.pi)
    assert round(float(seen)) % 8 == int(turned_headings(8, number)[heading])


def test_maps_of_headings_are_read_at_places():
    values = torch.arange(2.0 * 3 * 8 * 8).reshape(2, 3, 8, 8)
    places = torch.tensor([[[2.5, 4.5], [0.5, 7.5]]] * 2)
    expected = torch.stack([values[:, :, 2, 4], values[:, :, 0, 7]], dim=1)
    torch.testing.assert_close(values_at(values, places), expected)


def test_a_value_map_begins_as_that_of_cameras_that_see_all_around():
    network = drawn(AIMED)
    network.begin_aimed()
    seen = observation()
    with torch.no_grad():
        whole, aimed = valued(network, seen), valued(network.aimed, seen)
    assert whole.shape == (2, 1, CELLS, CELLS) and aimed.shape == (2, 8, CELLS, CELLS)
    torch.testing.assert_close(aimed, whole.expand_as(aimed))


def test_each_camera_is_valued_by_the_map_of_its_kind():
    network = drawn(AIMED)
    policy = ValuePolicy(Checkpoint(AIMED, network.state_dict()))
    seen = {name: value[0].numpy() for name, value in observation(count=1).items()}
    aimed = policy.values(**seen | {'lens': lens_features(D455.lens)})
    whole = policy.values(**seen | {'lens': lens_features(None)})
    assert aimed.shape == (8, CELLS, CELLS) and whole.shape == (1, CELLS, CELLS)
    plain = ValuePolicy(Checkpoint(ROUND, {
        name: value for name, value in network.state_dict().items()
        if not name.startswith('aimed.')}))
    for lens in (D455.lens, None):
        assert np.array_equal(plain.values(**seen | {'lens': lens_features(lens)}), whole)


@pytest.fixture(scope='module')
def room():
    """Return a small room."""
    return generate_room(7, 3000)


def test_labels_of_headings_are_what_the_true_room_loses(room):
    rig = RigConfig(sensors='realsense_d455')
    true = TrueRoom(room, SimulationConfig(rig), 8)
    assert len(true.poses) == 8 * len(true.places)
    assert np.allclose(true.poses[:8, :2], true.places[0])
    assert np.allclose(true.poses[:8, 3], yaws_of(8))
    assert np.allclose(true.poses[:, 4], TUNING.aimed_pitch)
    values = true.values([11])
    error = true.engine.depth_error
    seen = [true.engine.look(true.poses[pose]).seen for pose in (11, 26)]
    floor = 0.005 * error.worst
    expected = np.log((error(seen[0] | seen[1]) + floor) / (error(seen[0]) + floor))
    assert values[26] == pytest.approx(expected, abs=1e-4)
    assert np.ptp(values.reshape(-1, 8), axis=1).max() > 0.01
    pose = true.poses[[37, 5]]
    turned = pose[:, 3:] + [[0.2, 0.3, 0.0]]
    assert true.nearest_poses(pose[:, :2], turned).tolist() == [37, 5]


def test_states_of_headings_are_played_alike_and_of_their_shape(small):
    task = StateTask(RoomsConfig(), '1000', (0, 0, 1), headings=8)
    states, again = play_states(task), play_states(task)
    for name, (kind, shape) in shapes_of(8).items():
        assert states[name].dtype == kind and states[name].shape[1:] == shape, name
        assert np.array_equal(states[name], again[name], equal_nan=kind in (np.float16,)), name
    assert (states['lens'] < 1.0).all()


def test_only_the_map_of_headings_is_learned_where_there_are_any(small, here, tmp_path,
                                                                 monkeypatch):
    # At first cameras that are aimed see too little of a thinner scan to tell that it is a room.
    monkeypatch.setattr(value_states, 'TUNING', replace(
        value_states.TUNING, scan_points=(8000,)))
    first = Checkpoint(ROUND, drawn(ROUND).state_dict(), 3, 'first', {'seed': 5})
    first.save(tmp_path / 'first.safetensors')
    config = from_nested(TrainingConfig, TINY | {
        'model': str(tmp_path / 'first.safetensors'), 'agent': {'inputs': 'map', 'headings': 8}})
    made = train(config, tmp_path / 'run', 'a command')
    assert made.config.headings == 8
    assert made.provenance['began_with'] == {'run': 'first', 'updates': 3, 'seed': 5}
    for name, value in first.weights.items():
        assert torch.equal(made.weights[name], value), name
    assert not torch.equal(made.weights['aimed.enter.weight'][:, :1],
                           first.weights['enter.weight'][:, :1])
    # It may be the start of another run, with headings or without.
    made.save(tmp_path / 'second.safetensors')
    for number, headings in enumerate((8, 0)):
        agent = {'inputs': 'map', 'headings': headings}
        again = from_nested(TrainingConfig, TINY | {
            'model': str(tmp_path / 'second.safetensors'), 'agent': agent})
        assert train(again, tmp_path / str(number), 'a command').config.headings == headings


def test_headings_are_refused_where_they_mean_nothing():
    with pytest.raises(ConfigurationError, match='agent.headings'):
        AgentConfig('cloud', headings=8)
    with pytest.raises(ConfigurationError, match='model'):
        from_nested(TrainingConfig, TINY | {'agent': {'inputs': 'map', 'headings': 8}})
    with pytest.raises(CheckpointError):
        Checkpoint(AIMED, ValueMapNetwork(ROUND).state_dict())


def test_the_actor_turns_cameras_as_the_map_says(room):
    """Of all headings at each place the network finds one best, and nothing else matters."""
    best, asked = 5, []

    class Looking:

        def values(self, room, others, numbers, lens):
            asked.append(lens)
            values = np.full((8, CELLS, CELLS), 1.0, dtype=np.float32)
            values[best] = -1.0
            return values

    models = [replace(D455, max_range=4.0)] * 2
    middle = room.bounds.mean(axis=0)
    placement = np.array([[middle[0] - 0.5, middle[1], 1.9, 0.0, 0.2, 0.0],
                          [middle[0] + 0.5, middle[1], 1.9, 3.0, 0.2, 0.0]])
    actor = MapActor(Looking(), np.random.default_rng(0), 0.5, 4.0, 0.1)
    actor.set_rig_state(RigState(placement, models, 2))
    actor.move(room.points, placement[:, :3], 0, MIN_TURNS_FOR_HEADINGS - 1)
    # In few turns headings are not valued.
    assert (np.stack(asked) == 1.0).all()
    asked.clear()
    actor.reset()
    actor.move(room.points, placement[:, :3], 0, MIN_TURNS_FOR_HEADINGS)
    assert np.allclose(np.stack(asked), lens_features(models[0].lens))
    away = (actor.headings[:, 0] - yaws_of(8)[best] + np.pi) % (2.0 * np.pi) - np.pi
    assert np.abs(away).max() < 0.5 * np.pi
