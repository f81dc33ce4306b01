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

"""Models of solid bodies: what their rooms show, and what hides what."""

from benchmarks.drills.spoilt_files import write_obj
from conftest import box_room
import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rig.structure import ceiling_of, floor_height, walls_of
from ocp_ros.rooms.generator import generate_room
from ocp_ros.scenes.mesh_files import sample_faces
from ocp_ros.scenes.scene import Mesh, SceneError
from ocp_ros.scenes.scene_files import load_scene, scene_of
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.util.settings import ConfigurationError
import pytest
from scipy.spatial import cKDTree

#: Corners of a box by number: x counts 1, y 2, z 4.
SIDES = np.array([[0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4], [2, 6, 7],
                  [2, 7, 3], [0, 4, 6], [0, 6, 2], [1, 3, 7], [1, 7, 5]])
#: A room of 5 x 4 x 2.7 m: its floor at z = 0.
SIZE = (5.0, 4.0, 2.7)
SMALL = EngineConfig('mesh', error_rows=24, coverage_cell=0.5)


def box(low, high):
    """Return the corners (12, 3, 3) of the faces of a solid box."""
    bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
    return np.where(bits, high, low).astype(float)[SIDES]


def solid_box(x, y, z, wall=0.3, slab=0.2):
    """Return floor, ceiling and four walls of a closed room: six parts."""
    return [box((-wall, -wall, -slab), (x + wall, y + wall, 0)),
            box((-wall, -wall, z), (x + wall, y + wall, z + slab)),
            box((-wall, -wall, 0), (0, y + wall, z)), box((0, -wall, 0), (x, 0, z)),
            box((0, y, 0), (x, y + wall, z)), box((x, -wall, 0), (x + wall, y + wall, z))]


def solid_room(door=False, at=(0.0, 0.0)):
    """Return a room of solid walls and slabs, with a way out where it has a door."""
    x, y, z = SIZE
    parts = solid_box(*SIZE)
    if door:
        parts[-1:] = [box((x, -0.3, 0), (x + 0.3, 1, z)), box((x, 2, 0), (x + 0.3, y + 0.3, z)),
                      box((x, 1, 2.1), (x + 0.3, 2, z))]
    return np.concatenate(parts) + [*at, 0.0]


def mesh_of(*parts):
    corners = np.concatenate(parts)
    return Mesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def read(folder, *parts, **options):
    write_obj(folder / 'room.obj', mesh_of(*parts))
    return load_scene(folder / 'room.obj', up='z', **{'max_points': 20_000, **options})


def assert_inside(scene):
    np.testing.assert_allclose(scene.bounds, [(0, 0, 0), SIZE], atol=0.02)
    assert floor_height(scene) == pytest.approx(0.0, abs=0.01)
    assert ceiling_of(scene).points[:, 2].mean() == pytest.approx(SIZE[2], abs=0.01)


@pytest.mark.parametrize('door', [False, True])
def test_only_what_the_room_shows_of_solid_walls_and_slabs_counts(tmp_path, door):
    ground = box((-8, -8, -0.5), (14, 12, -0.2))
    scene = read(tmp_path, solid_room(door=door), *[ground] * door)
    if not door:
        assert_inside(scene)
    assert floor_height(scene) == pytest.approx(0.0, abs=0.01)
    # All look into the room.
    middle = np.array(SIZE) / 2.0
    inwards = np.einsum('nk,nk->n', scene.normals, middle - scene.points)
    assert (inwards > 0.0).mean() > 0.97
    walls = walls_of(scene).points
    assert (walls[:, :2] > -0.01).all() and (walls[:, 1] < SIZE[1] + 0.01).all()
    assert 'left out' in scene.remarks[0]


def test_a_thin_panel_hides_what_is_behind_it_and_shows_its_own_two_sides(tmp_path):
    panel = box((2.5, 1.0, 0.0), (2.51, 3.0, 1.6))
    scene = read(tmp_path, solid_room(), panel)
    simulator = Simulator(scene, SimulationConfig(engine=SMALL))
    seen = simulator.evaluate(np.array([[1.0, 2.0, 0.8]])).visible
    x, y, z = scene.points.T
    of_panel = (abs(x - 2.505) < 0.01) & (abs(y - 2.0) < 0.9) & (z < 1.5) & (z > 0.1)
    front = of_panel & (x < 2.505)
    assert front.sum() > 50 and (of_panel & ~front).sum() > 50
    assert seen[front].all() and not seen[of_panel & ~front].any()
    shadow = (z < 0.05) & (x > 2.6) & (x < 3.4) & (abs(y - 2.0) < 0.8)
    assert shadow.sum() > 50 and not seen[shadow].any()


@pytest.mark.parametrize('seed', [3, 8])
def test_a_generated_room_with_an_outside_is_read_as_without_one(tmp_path, seed):
    room = generate_room(seed, 3000)
    low, high = room.bounds
    scene = read(tmp_path, room.mesh.corners, box(low - 0.25, high + 0.3))
    inner = cKDTree(sample_faces(room.mesh.corners, 60_000)[:, :3])
    away, _ = inner.query(scene.points)
    assert away.max() < 0.25 and np.quantile(away, 0.99) < 0.1
    missed, _ = cKDTree(scene.points).query(room.points)
    assert np.quantile(missed, 0.98) < 0.15
    assert floor_height(scene) == pytest.approx(floor_height(room), abs=0.02)


def test_cameras_hang_inside(tmp_path):
    scene = read(tmp_path, solid_room(door=True), box((-8, -8, -0.5), (14, 12, -0.2)),
                 max_points=8000)
    problem = Problem.of(scene, rig_of(2, 'realsense_d455', mount={'on': 'walls'}),
                         SimulationConfig(engine=SMALL))
    places, _ = problem.region.places(problem.rig.models[0], 200)
    # Not on the outer face of a wall; in the doorway they may.
    assert ((places.positions > 0.0) & (places.positions < np.add(SIZE, (0.3, 0.0, 0.0)))).all()


def test_the_largest_of_several_rooms_is_planned_for_and_the_others_are_named(tmp_path):
    scene = read(tmp_path, solid_room(), 0.8 * solid_room(at=(9.0, 0.0)))
    assert_inside(scene)
    assert '1 other' in scene.remarks[-1]


def test_a_hollow_machine_is_no_room_in_a_hall_without_a_ceiling(tmp_path):
    floor, _, *walls = np.split(solid_room(), 6)
    for machine in ([], [box((1.5, 1.0, 0.0), (3.5, 3.0, 2.0))]):
        scene = read(tmp_path, floor, *walls, *machine)
        np.testing.assert_allclose(scene.bounds[:, :2], [(0, 0), SIZE[:2]], atol=0.32)
        assert floor_height(scene) == pytest.approx(0.0, abs=0.01)
    x, y, z = scene.points.T
    assert (abs(x - 2.5) < 0.95).any() and not ((abs(x - 2.5) < 0.9) & (abs(y - 2.0) < 0.9)
                                                & (z > 0.1) & (z < 1.9)).any()


def test_a_large_building_keeps_its_walls(tmp_path):
    x, y, z = 60.0, 45.0, 9.0
    scene = read(tmp_path, *solid_box(x, y, z))
    share = (abs(scene.normals[:, 2]) < 0.3).mean()
    assert share == pytest.approx(2 * (x + y) * z / (2 * (x + y) * z + 2 * x * y), abs=0.02)


@pytest.mark.parametrize('stray', [box((300, 0, 0), (300.02, 0.02, 0.02)),
                                   [[(0, 0, 0), (0, 1e-6, 0), (3e6, 0, 0)]]])
def test_a_stray_part_of_a_model_does_not_matter(tmp_path, stray):
    assert_inside(read(tmp_path, solid_room(), stray))


def test_bodies_without_a_room_are_refused(tmp_path):
    canopy = [box((0, 0, 3), (6, 6, 3.3)), box((-5, -5, -0.3), (11, 11, 0)),
              *(box((x, y, 0), (x + 0.3, y + 0.3, 3)) for x in (0, 5.7) for y in (0, 5.7))]
    with pytest.raises(SceneError, match='room.obj: found solid bodies'):
        read(tmp_path, *canopy)
    with pytest.raises(ConfigurationError, match='engine.preset'):
        Simulator(scene_of(generate_room(3, 2000).points), SimulationConfig(engine=SMALL))


def test_a_mesh_of_one_layer_without_enclosed_air_is_kept_whole(tmp_path):
    floor = np.array([[[0, 0, 0], [4, 0, 0], [4, 3, 0]], [[0, 0, 0], [4, 3, 0], [0, 3, 0]]])
    wall = np.array([[[0, 0, 0], [4, 0, 0], [4, 0, 2.5]], [[0, 0, 0], [4, 0, 2.5], [0, 0, 2.5]]])
    scene = read(tmp_path, floor.astype(float), wall)
    np.testing.assert_allclose(scene.size, [4.0, 3.0, 2.5], atol=0.05)
    # Its points are on the faces, so that rays find them.
    simulator = Simulator(scene, SimulationConfig(engine=SMALL))
    seen = simulator.evaluate(np.array([[2.0, 1.5, 1.2]])).visible
    assert len(scene) == 20_000 and seen.mean() > 0.9


def test_points_of_a_solid_model_are_held_to_the_room_and_those_of_a_scan_are_kept():
    scene = scene_of(sample_faces(solid_room(), 12_000)[:, :3])
    assert floor_height(scene) == pytest.approx(0.0, abs=0.02)
    outer = ((scene.points < -0.1) | (scene.points > np.add(SIZE, 0.1))).any(axis=1)
    assert outer.mean() < 0.01 and 'solid model' in scene.remarks[-1]
    for seed in (3, 8):
        assert len(scene_of(generate_room(seed, 12_000).points)) > 11_900
    # A yard that was scanned as well is no outside of a model.
    x, y = np.random.default_rng(0).uniform((-1, -9), (11, -0.3), (8000, 2)).T
    yard = np.column_stack([x, y, 0.0 * x])
    room = box_room(8.0, 6.0).points
    assert len(scene_of(np.concatenate([room, yard]), all_rooms=True)) > 0.99 * (len(room) + 8000)
