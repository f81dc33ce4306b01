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

"""Rooms from measures: what is written down is the room that is planned for."""

from hypothesis import given, settings, strategies
import numpy as np
from ocp_ros.cli.main import main
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rig.structure import ceiling_of, floor_height, walls_of
from ocp_ros.scenes.measured_room import document_of, triangles_of
from ocp_ros.scenes.scene import SceneError
from ocp_ros.scenes.scene_files import load_scene, scans_in, scene_of, SceneWarning
from ocp_ros.simulation.objective import Objective
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.util.settings import ConfigurationError
import pytest

SIZE = (6.0, 4.5, 2.7)


def made(folder, *arguments):
    """Return what ``ocp room`` makes of a room of 6 x 4.5 x 2.7 m."""
    path = folder / 'room.yaml'
    assert main(['room', *map(str, SIZE), *arguments, '--out', str(path)]) == 0
    return path


def within(points, low, high):
    """Return which points are in a box, its faces included."""
    return ((points >= np.array(low) - 0.005) & (points <= np.array(high) + 0.005)).all(axis=1)


def test_a_room_from_a_tape_measure_has_its_measures(tmp_path):
    scene = load_scene(made(
        tmp_path, '--door', *['south', '1', '0.9', '2.1'],
        '--window', *['east', '2', '1.5', '1.2', '0.9'],
        *['--box', '2', '1', '0', '4', '2', '0.75']), max_points=20_000)
    np.testing.assert_allclose(scene.bounds, [(0, 0, 0), SIZE], atol=0.01)
    assert floor_height(scene) == pytest.approx(0.0, abs=0.005)
    assert ceiling_of(scene).points[:, 2].mean() == pytest.approx(SIZE[2], abs=0.005)
    points = scene.points
    for low, high in (((1.02, 0, 0.02), (1.88, 0, 2.08)), ((6, 2.02, 0.92), (6, 3.48, 2.08)),
                      # Nobody sees what the box stands on, nor what is in it.
                      ((2.02, 1.02, 0), (3.98, 1.98, 0.73))):
        assert not within(points, low, high).any()
    top = within(points, (2, 1, 0.745), (4, 2, 0.755))
    assert top.sum() > 100 and (scene.normals[top][:, 2] > 0.99).mean() > 0.9
    # All surfaces are where walls are looked for, and nothing is outside of them.
    walls = walls_of(scene).points
    assert {round(float(edge), 1) for edge in np.ptp(walls[:, :2], axis=0)} == {6.0, 4.5}


@settings(deadline=None, max_examples=50)
@given(size=strategies.tuples(*[strategies.floats(1.0, 30.0)] * 3), data=strategies.data())
def test_openings_take_their_area_from_the_walls_and_boxes_add_theirs(size, data):
    shares = strategies.floats(0.05, 0.9)
    openings, lost = [], 0.0
    for wall, length in (('south', size[0]), ('west', size[1])):
        at, width, sill, height = (data.draw(shares) for _ in range(4))
        at, width = at * length, width * (1.0 - at) * length
        sill, height = sill * size[2], height * (1.0 - sill) * size[2]
        openings.append((wall, at, width, height, sill))
        lost += width * height
    low = np.array(size) * [data.draw(shares) for _ in range(3)]
    high = low + (np.array(size) - low) * data.draw(shares)
    corners = triangles_of(document_of(size, openings, [[*low, *high]]))
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0],
                                         corners[:, 2] - corners[:, 0]), axis=1).sum()

    def surface(edges):
        return 2.0 * (edges[0] * edges[1] + edges[1] * edges[2] + edges[2] * edges[0])
    assert area == pytest.approx(surface(size) + surface(high - low) - lost, rel=1e-6)


@pytest.mark.parametrize(('size', 'arguments', 'words'), [
    ('6 4.5 nan', '', "size[2]: found 'nan'; expected length, width and height in metres"),
    ('6 4.5 2.7', '--door souht 1 1 2', "did you mean 'south'?"),
    ('6 4.5 2.7', '--door south 5.5 0.9 2.1', 'up to 6.4 m along the south wall'),
    ('6 4.5 2.7', '--door west 1 0.9 2.8', 'one within its 4.5 x 2.7 m'),
    ('6 4.5 2.7', '--box 1 1 0 2 5 1', 'the highest within [6.0, 4.5, 2.7]'),
    ('6 4.5 2.7', '--box 1 1 0 1 2 1', 'the lowest corner first'),
    ('6 4.5 x', '', "found 'x'"), ('0.5 4 3', '', 'each from 1 to 100')])
def test_measures_that_cannot_be_are_refused(tmp_path, capsys, size, arguments, words):
    out = tmp_path / 'room.yaml'
    assert main(['room', *size.split(), *arguments.split(), '--out', str(out)]) == 2
    assert words in capsys.readouterr().err and not out.exists()


@pytest.mark.parametrize(('size', 'box', 'at'), [
    ('10 10 3', '1 1 0 9 9 2', 0.5), ('6 4 3', '0.6 0.6 0 5.4 3.4 2.6', 0.3),
    ('8 6 2.7', '3 3 0 8 6 2.7', 1.0), ('1.2 1.2 2', '0 0 0 0.3 0.3 1', 0.8)])
def test_what_a_box_holds_is_never_the_room(tmp_path, size, box, at):
    path = tmp_path / 'room.yaml'
    assert main(['room', *size.split(), '--box', *box.split(), '--out', str(path)]) == 0
    scene = load_scene(path, max_points=20_000)
    np.testing.assert_allclose(scene.size, list(map(float, size.split())), atol=0.05)
    problem = Problem.of(scene, rig_of(1, 'omnidirectional', keep_clear=0.1, mount={
        'on': 'free', 'height': [0.5, 1.9]}))
    low, high = np.array(box.split(), dtype=float).reshape(2, 3)
    places = problem.region.candidates(problem.rig.models[0], 500)[:, :3]
    # Points that are far apart let a camera dip into a face.
    assert not ((places > low + 0.1) & (places < high - 0.1)).all(axis=1).any()
    assert scene.remarks == ()
    # Nor is it air that cameras could watch.
    rig = rig_of(1, 'omnidirectional', regions=[{'name': 'all', 'air': {}, 'box': [
        [0, 0, 0], [float(edge) for edge in size.split()]]}])
    simulator = Simulator(scene, SimulationConfig(), rig.models)
    assert Objective(simulator, rig).evaluate(np.array([[at, at, 1.0]])).regions[0] > 0.05
    inside = [{'name': 'box', 'air': {}, 'box': [(low + 0.05).tolist(), (high - 0.05).tolist()]}]
    with pytest.raises(ConfigurationError, match='found no air of room in it'):
        Objective(simulator, rig_of(1, 'omnidirectional', regions=inside))


def test_another_yaml_file_is_no_room_and_no_scan_of_a_folder(tmp_path):
    path = tmp_path / 'rig.yaml'
    path.write_text('cameras: [{sensor: kinect_v2}]\n')
    with pytest.raises(SceneError, match='rig.yaml: line 1, cameras: found the unknown key'):
        load_scene(path)
    assert scans_in(tmp_path) == []


@pytest.mark.parametrize('scale', [1.0, 0.001])
def test_eight_corners_are_a_room(tmp_path, scale):
    corners = np.array([(x, y, z) for x in (1.0, 7.0) for y in (0.0, 4.5) for z in (0.0, 2.7)])
    turned = corners @ [[0.8, 0.6, 0], [-0.6, 0.8, 0], [0, 0, 1]]
    np.savetxt(tmp_path / 'corners.txt', turned[[3, 0, 6, 1, 5, 2, 7, 4]] / scale)
    scene = load_scene(tmp_path / 'corners.txt', scale=scale, max_points=10_000)
    assert len(scene) > 9_000 and scene.mesh.exact
    assert floor_height(scene) == pytest.approx(0.0, abs=0.005)
    back = scene.points @ np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]])
    np.testing.assert_allclose([back.min(axis=0), back.max(axis=0)], [corners[0], corners[-1]],
                               atol=0.01)
    np.testing.assert_allclose(scene_of(turned).size, scene.size, atol=0.02)
    wrong = corners.copy()
    wrong[7, 1] = 9.0
    with pytest.warns(SceneWarning, match='sides are not flat'):
        assert len(scene_of(wrong).notes) == 1
    with pytest.raises(SceneError, match='found eight points that are not the corners'):
        scene_of(np.vstack([corners[:-1], [[4.0, 2.0, 1.0]]]))
