# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where a scan is several rooms, each of them counts; one room has the viewpoints of the paper."""

from conftest import box_room, made_room
import numpy as np
import pytest

from ocp_ros.geometry.depth_error import viewpoints
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.scenes.scene import Scene
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig

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


def test_every_surface_point_counts_in_several_rooms(suite):
    simulator = Problem.of(suite, rig_of(2), FAST).simulator
    places = simulator.depth_error.viewpoints
    quarter = {tuple((place[:2] > 4.0).astype(int)) for place in places}
    assert quarter == {(0, 0), (0, 1), (1, 0), (1, 1)}
    seen = np.bitwise_or.reduce([simulator._seen_from(place) for place in places])
    everywhere = [simulator._seen_from(np.array([x, y, 1.4])) for x in np.arange(0.5, 8.0, 1.0)
                  for y in np.arange(0.5, 8.0, 1.0)]
    whole = np.bitwise_or.reduce(everywhere)
    assert np.bitwise_count(seen & whole).sum() >= 0.97 * np.bitwise_count(whole).sum()


def test_a_camera_in_any_of_several_rooms_takes_from_the_error(suite):
    simulator = Problem.of(suite, rig_of(2), FAST).simulator
    worst = simulator.depth_error.worst
    for place in ([2.0, 2.0, 1.9], [6.0, 2.0, 1.9], [2.0, 6.0, 1.9], [6.0, 6.0, 1.9]):
        error = simulator.evaluate(np.array([place])).depth_error
        assert error < 0.9 * worst
    everywhere = np.array([[x, y, 1.9] for x in (2.0, 6.0) for y in (2.0, 6.0)])
    assert simulator.judge([simulator.look(pose) for pose in everywhere]).depth_error < 0.1 * worst


@pytest.mark.parametrize('seed', [8, 12, 3001])
def test_one_room_has_the_viewpoints_of_the_paper(seed):
    scene = made_room(seed, 2500)
    found = Problem.of(scene, rig_of(2), FAST).simulator.depth_error.viewpoints
    assert np.array_equal(found, viewpoints(scene.bounds))
