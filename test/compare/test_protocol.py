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

"""Who judges: rays cast at the mesh, unseen points, and an error from all of a room's air."""


from conftest import box_room, made_room
import numpy as np
from ocp_ros.compare.protocol import judged_room, JudgedRoom, MOUNTING_ERRORS
from ocp_ros.geometry.cameras import CameraModel, Pose, rotation_matrix
from ocp_ros.geometry.depth_error import five_viewpoints
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.packed_bits import no_bits, unpack
from ocp_ros.geometry.visibility import MESH
from ocp_ros.rig.motion import mounted, MountingErrors
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.scenes.scene import Mesh, Scene, turned
from ocp_ros.scenes.scene_files import save_scene
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.ray_visibility import RayVisibility
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.simulation.viewpoints import paper_viewpoints, viewpoints_of
import pytest

SMALL = SimulationConfig(engine=EngineConfig(error_rows=32, coverage_cell=0.5, error_folds=2))
#: A square panel across x = 1, from -1 to 1 in y and z.
PANEL = Mesh(np.array([[1, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, 1]], dtype=np.float32),
             np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))


@pytest.mark.parametrize(('model', 'points', 'expected'), [
    # The panel hides what is behind it and nothing else.
    (CameraModel(max_range=6.0),
     [[1.0, 0.5, 0.0], [2.0, 0.5, 0.0], [2.0, 3.0, 0.0], [-1.0, 0.0, 0.0], [0.5, 0.0, 0.0]],
     [True, False, True, True, True]),
    # A camera has a range and a viewing cone.
    (CameraModel(0.5, 0.9, np.deg2rad(60.0), np.deg2rad(40.0)),
     [[0.8, 0.0, 0.0], [0.2, 0.0, 0.0], [-0.8, 0.0, 0.0], [0.8, 0.9, 0.0]],
     [True, False, False, False])])
def test_rays_reach_what_a_camera_sees_past_the_panel(model, points, expected):
    points = np.array(points, dtype=np.float32)
    visibility = RayVisibility(points, points, PANEL)
    seen, covered = no_bits(len(points)), no_bits(len(points))
    visibility.look(Pose.of(np.zeros(6)), model.lens, seen, covered)
    np.testing.assert_array_equal(seen, covered)
    np.testing.assert_array_equal(
        unpack(seen, len(points)), np.array(expected)[visibility.order])


def test_a_generated_room_is_judged_on_points_that_no_search_saw_and_a_little_off():
    room = JudgedRoom('7', 0.0, SMALL, 1500, 2000)
    simulator = room.judge_problem.simulator
    assert simulator.config.engine.preset == MESH
    assert room.search_problem.simulator.config.engine.preset == 'fine'
    points = set(map(tuple, room.search_scene.points))
    assert not points & set(map(tuple, room.judge_scene.points))
    np.testing.assert_array_equal(room.search_scene.mesh.vertices,
                                  room.judge_scene.mesh.vertices)
    # The judge takes the mean over cameras that are mounted a little off.
    placement = np.random.default_rng(0).uniform(*room.judge_scene.bounds, (4, 3))
    judged = room.judge(placement)
    assert judged['exact'] == simulator.evaluate(placement).depth_error
    off = mounted(placement, MOUNTING_ERRORS)
    assert judged['depth_error'] == pytest.approx(np.mean(
        [simulator.evaluate(moved).depth_error for moved in off]))
    assert judged['space_coverage'] == simulator.evaluate(placement).space_coverage


def test_a_scan_is_judged_on_points_that_are_held_out(tmp_path):
    path = str(tmp_path / 'scan.ply')
    save_scene(Scene(made_room(8, 2000).points, 'scan'), path)
    room = judged_room(path, 0.0, SMALL)
    assert judged_room(path, 0.0, SMALL) is room
    assert type(room.judge_problem.simulator) is Simulator
    searched, judged = (set(map(tuple, scene.points))
                        for scene in (room.search_scene, room.judge_scene))
    assert not searched & judged
    assert len(searched) + len(judged) == pytest.approx(2000, rel=0.1)
    assert abs(len(searched) - len(judged)) <= 1


def test_mounting_is_off_by_so_much_and_alike_for_all():
    placement = np.array([[1.0, 1.0, 1.9], [2.0, 3.0, 1.9], [4.0, 4.0, 1.9]])
    errors = MountingErrors(0.05, count=8, seed=0)
    moved = mounted(placement, errors)
    np.testing.assert_allclose(np.linalg.norm(moved - placement, axis=-1), 0.05)
    assert (moved[..., 2] == 1.9).all()
    np.testing.assert_allclose(mounted(placement - 0.5, errors) + 0.5, moved)


def test_a_camera_in_any_of_several_rooms_takes_from_the_error():
    """Four rooms of 4 x 4 m around a cross of walls, each with a door to the next."""
    room = box_room(4.0, 4.0).points
    rooms = np.concatenate([room + np.array([4.0 * i, 4.0 * j, 0.0], dtype=np.float32)
                            for i in (0, 1) for j in (0, 1)])
    x, y, z = rooms.T
    doors = (z < 2.1) & (z > 0.05) & (((abs(x - 4.0) < 0.01) & (abs(y % 4.0 - 0.7) < 0.45))
                                      | ((abs(y - 4.0) < 0.01) & (abs(x - 0.7) < 0.45)))
    suite = Scene(np.unique(rooms[~doors], axis=0), 'suite')
    simulator = Problem.of(suite, rig_of(2), SimulationConfig(
        engine=EngineConfig(preset='fast', error_rows=32))).simulator
    worst = simulator.depth_error.worst
    assert {tuple((place[:2] > 4.0).astype(int))
            for place in simulator.depth_error.viewpoints} == {(0, 0), (0, 1), (1, 0), (1, 1)}
    everywhere = np.array([[x, y, 1.9] for x in (2.0, 6.0) for y in (2.0, 6.0)])
    for place in everywhere:
        assert simulator.evaluate(place[None]).depth_error < 0.9 * worst
    views = [simulator.look(pose) for pose in everywhere]
    assert simulator.evaluate_views(views).depth_error < 0.1 * worst


def changes(scene, other, moved, kind):
    """Return how much the errors of some placements change in another scan of the same room."""
    config = SimulationConfig(engine=EngineConfig('fine', 32, error_folds=2, viewpoints=kind))
    one, two = Simulator(scene, config), Simulator(other, config)
    low, high = scene.bounds
    placements = np.random.default_rng(0).uniform(low + 0.5, high - 0.5, (10, 4, 3))
    return [abs(two.evaluate(moved(places)).depth_error / one.evaluate(places).depth_error - 1.0)
            for places in placements]


@pytest.mark.parametrize(('seed', 'kind'), [(501, 'air'), (8, 'paper'), (501, 'validation')])
def test_the_error_is_that_of_the_room_however_it_was_scanned(seed, kind):
    scene = made_room(seed, 12_000)
    found = []
    for angle in (17.0, 45.0):
        rotation = rotation_matrix(np.deg2rad(angle))
        found += changes(scene, turned(scene, angle), lambda at, by=rotation: at @ by.T, kind)
    far, mirror = np.array([1e5, -1e5, 0.0], dtype=np.float32), np.array([-1.0, 1.0, 1.0])
    near = Scene(scene.points + far - far, 'near')
    found += changes(near, Scene(scene.points + far, 'far'), lambda at: at + far, kind)
    mirrored = Scene(scene.points * mirror, 'mirrored')
    found += changes(scene, mirrored, lambda at: at * mirror, kind)
    assert np.mean(found) <= 0.02 and np.max(found) <= 0.15


@pytest.mark.parametrize('seed', [8, 3001])
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
