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

"""The depth error is looked at from all of a room's air, whatever the axes of the scan."""

from conftest import box_room, made_room
import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.geometry.depth_error import five_viewpoints
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rooms.generator import generate_room
from ocp_ros.scenes.scene import Scene, turned
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.simulation.viewpoints import paper_viewpoints, viewpoints_of
import pytest

FAST = SimulationConfig(engine=EngineConfig(preset='fast', error_rows=32))


@pytest.fixture(scope='module')
def suite():
    """Return four rooms of 4 x 4 m around a cross of walls, each with a door to the next."""
    room = box_room(4.0, 4.0).points
    rooms = np.concatenate([room + np.array([4.0 * i, 4.0 * j, 0.0], dtype=np.float32)
                            for i in (0, 1) for j in (0, 1)])
    x, y, z = rooms.T
    doors = (z < 2.1) & (z > 0.05) & (((abs(x - 4.0) < 0.01) & (abs(y % 4.0 - 0.7) < 0.45))
                                      | ((abs(y - 4.0) < 0.01) & (abs(x - 0.7) < 0.45)))
    return Scene(np.unique(rooms[~doors], axis=0), 'suite')


def test_all_rooms_have_viewpoints(suite):
    places = Problem.of(suite, rig_of(2), FAST).simulator.depth_error.viewpoints
    assert {tuple((place[:2] > 4.0).astype(int)) for place in places} == {
        (0, 0), (0, 1), (1, 0), (1, 1)}


def test_a_camera_in_any_of_several_rooms_takes_from_the_error(suite):
    simulator = Problem.of(suite, rig_of(2), FAST).simulator
    worst = simulator.depth_error.worst
    for place in ([2.0, 2.0, 1.9], [6.0, 2.0, 1.9], [2.0, 6.0, 1.9], [6.0, 6.0, 1.9]):
        error = simulator.evaluate(np.array([place])).depth_error
        assert error < 0.9 * worst
    everywhere = np.array([[x, y, 1.9] for x in (2.0, 6.0) for y in (2.0, 6.0)])
    assert simulator.judge([simulator.look(pose) for pose in everywhere]).depth_error < 0.1 * worst


def changes(scene, other, moved, kind='air'):
    """Return how much the errors of some placements change in another scan of the same room."""
    config = SimulationConfig(engine=EngineConfig('fine', 32, error_folds=2, viewpoints=kind))
    one, two = Simulator(scene, config), Simulator(other, config)
    rng, (low, high) = np.random.default_rng(0), scene.bounds
    found = []
    for _ in range(10):
        places = rng.uniform(low + 0.5, high - 0.5, (4, 3))
        found.append(two.evaluate(moved(places)).depth_error
                     / one.evaluate(places).depth_error - 1.0)
    return np.abs(found)


@pytest.mark.parametrize('kind', ['air', 'paper'])
@pytest.mark.parametrize('seed', [8, 501])
def test_the_error_is_that_of_the_room_however_it_was_scanned(seed, kind):
    scene = generate_room(seed, 12_000)
    found = []
    for angle in (17.0, 45.0):
        rotation = rotation_matrix(np.deg2rad(angle))
        found += [changes(scene, turned(scene, angle), lambda at, by=rotation: at @ by.T, kind)]
    far = np.array([1e5, -1e5, 0.0], dtype=np.float32)
    near = Scene(scene.points + far - far, 'near')
    found += [changes(near, Scene(scene.points + far, 'far'), lambda at: at + far, kind)]
    mirror = np.array([-1.0, 1.0, 1.0])
    found += [changes(scene, Scene(scene.points * mirror, 'mirrored'), lambda at: at * mirror,
                      kind)]
    assert np.mean(found) <= 0.02 and np.max(found) <= 0.15


@pytest.mark.parametrize('seed', [8, 12, 3001])
def test_the_five_of_the_paper_are_those_of_the_box_that_a_room_fills(seed):
    scene = made_room(seed, 2500)
    low, high = scene.bounds
    corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
    np.testing.assert_allclose(paper_viewpoints(scene),
                               five_viewpoints(corners, 0.5 * (low[2] + high[2])), atol=0.05)


def test_without_air_the_viewpoints_are_those_of_the_paper():
    # Too low for a ball that does not fit through gaps between points.
    points = box_room(4.0, 4.0).points * np.array([1.0, 1.0, 0.1], dtype=np.float32)
    scene = Scene(np.unique(points, axis=0), 'low')
    np.testing.assert_array_equal(viewpoints_of(scene), paper_viewpoints(scene))
