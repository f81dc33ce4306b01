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

"""Meshes and measures as rooms: their faces in every format, and the points on them."""

from base64 import b64encode
import json
import logging

from benchmarks.drills import file_fuzz as files
from conftest import for_any, made_room, refusal, refused
from hypothesis import strategies
import numpy as np
from ocp_ros.cli.main import main
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rig.structure import ceiling_of, floor_height, walls_of
from ocp_ros.scenes.measured_room import document_of, triangles_of
from ocp_ros.scenes.meshes import MESH_SAMPLES, read_mesh, sample_faces
from ocp_ros.scenes.scene import Mesh, Scene, SceneError
from ocp_ros.scenes.scene_files import load_scene, scans_in, scene_of, SceneWarning
from ocp_ros.scenes.source_frame import map_from_file
from ocp_ros.simulation.objective import Objective
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.util.settings import ConfigurationError
import pytest
from scipy.spatial import cKDTree

ROOM = made_room(7, 3000)
#: A floor of 2 m by 3 m, and a wall of 2 m by 1 m on its first edge.
VERTICES = np.array([[0, 0, 0], [2, 0, 0], [2, 3, 0], [0, 3, 0], [0, 0, 1], [2, 0, 1]], float)
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3], [0, 1, 5], [0, 5, 4]])
#: Corners of a room of 6 x 4.5 x 2.7 m.
CORNERS = np.array([(x, y, z) for x in (1.0, 7.0) for y in (0.0, 4.5) for z in (0.0, 2.7)])


def test_samples_lie_evenly_on_the_faces_and_have_their_normals():
    points, normals = np.hsplit(sample_faces(VERTICES[TRIANGLES], 8000), 2)
    np.testing.assert_array_equal(points, sample_faces(VERTICES[TRIANGLES], 8000)[:, :3])
    floor = abs(points[:, 2]) < 1e-9
    assert np.count_nonzero(floor) == pytest.approx(6000, abs=2)
    np.testing.assert_allclose(points[~floor, 1], 0.0, atol=1e-9)
    np.testing.assert_allclose(abs(normals[floor]), np.tile([0, 0, 1], (floor.sum(), 1)))
    np.testing.assert_allclose(abs(normals[~floor]), np.tile([0, 1, 0], ((~floor).sum(), 1)))
    # Chance would leave every fourth of these cells, which hold ten points each, below seven.
    counts = np.histogram2d(*points[floor, :2].T, bins=[20, 30], range=[[0, 2], [0, 3]])[0]
    assert counts.min() >= 6 and counts.max() <= 14


def test_small_faces_get_their_share():
    # Squares of 1 x 1 m, of two faces each.
    squares = np.stack(np.meshgrid(np.arange(100.0), np.arange(100.0)), -1).reshape(-1, 1, 1, 2)
    halves = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]])
    faces = np.pad((squares + halves).reshape(-1, 3, 2), ((0, 0), (0, 0), (0, 1)))
    points = sample_faces(np.random.default_rng(0).permutation(faces), 2000)
    counts = np.histogram2d(*points[:, :2].T, bins=10, range=[[0, 100], [0, 100]])[0]
    assert counts.min() >= 8 and counts.max() <= 36


def test_faces_that_are_none_are_refused():
    for corners, found in ((np.empty((0, 3, 3)), 'no faces'), (VERTICES[[[0, 1, 1]]], 'area')):
        with pytest.raises(ValueError, match=found):
            sample_faces(corners)


def test_a_face_with_nan_gives_a_point_of_nan():
    for bad in (np.nan, np.inf, 1e300):
        vertices = VERTICES.copy()
        vertices[5, 0] = bad
        points = sample_faces(vertices[TRIANGLES], 500)
        # The faces of that vertex are two, one of which it only stretches without end.
        assert 1 <= np.isnan(points).all(axis=1).sum() <= 2
        assert np.isfinite(points[:500]).all()


def test_faces_with_many_corners_are_whole(tmp_path):
    # As Blender writes them.
    path = tmp_path / 'room.obj'
    path.write_text('mtllib none.mtl\n' + ''.join(f'v {x} {y} {z}\n' for x, y, z in VERTICES)
                    + 'f 1 2 3 4\nf 1 2 6\nf 1 6 5\n')
    points = sample_faces(read_mesh(path).reshape(-1, 3, 3), 8000)[:, :3]
    np.testing.assert_allclose(np.ptp(points, axis=0), [2, 3, 1], atol=0.02)
    assert np.mean(points[:, 2] < 1e-6) == pytest.approx(0.75, abs=0.01)


def test_gltf_is_y_up_by_its_standard_and_shows_what_a_scan_of_the_room_shows(tmp_path):
    lying = Mesh(ROOM.mesh.vertices @ map_from_file('y'), ROOM.mesh.triangles)
    files.write_glb(tmp_path / 'room.glb', lying)
    scene = load_scene(tmp_path / 'room.glb')
    assert 'up: y (glTF)' in scene.remarks and len(scene) == MESH_SAMPLES
    distances, _ = cKDTree(scene.points).query(ROOM.points)
    assert np.quantile(distances, 0.99) < 0.04
    assert np.median(abs(scene.normals).max(axis=1)) > 0.999


@pytest.mark.parametrize('normalized', [False, True])
@pytest.mark.parametrize('kind', ['<i1', '<u1', '<i2', '<u2'])
def test_quantized_gltf_is_read_and_packed_gltf_refused_by_name(tmp_path, kind, normalized):
    path, mesh = tmp_path / 'room.gltf', Mesh(VERTICES.astype(np.float32), TRIANGLES)
    highest = np.iinfo(kind).max
    size = VERTICES.max()
    node = {'mesh': 0, 'scale': [size if normalized else size / highest] * 3}
    document, buffer = files.gltf_of(mesh, [node])
    # Each vertex has four numbers, the last of them padding.
    numbers = np.pad(np.round(VERTICES / size * highest), ((0, 0), (0, 1))).astype(kind).tobytes()
    triangles = TRIANGLES.astype('<u4').tobytes()
    document['accessors'][0] |= {
        'componentType': 5120 + ['<i1', '<u1', '<i2', '<u2'].index(kind), 'normalized': normalized}
    document['bufferViews'] = [
        {'buffer': 0, 'byteOffset': 0, 'byteStride': 4 * np.dtype(kind).itemsize,
         'byteLength': len(numbers)},
        {'buffer': 0, 'byteOffset': len(numbers), 'byteLength': len(triangles)}]
    document['buffers'][0]['uri'] = 'data:application/octet-stream;base64,' + b64encode(
        numbers + triangles).decode()
    document['extensionsRequired'] = ['KHR_texture_transform', 'KHR_mesh_quantization']
    path.write_text(json.dumps(document))
    np.testing.assert_allclose(read_mesh(path).reshape(-1, 3, 3), VERTICES[TRIANGLES],
                               atol=0.6 * size / highest)
    for extension in ('KHR_draco_mesh_compression', 'EXT_meshopt_compression'):
        document['extensionsRequired'].append(extension)
        path.write_text(json.dumps(document))
        assert extension in refusal(path)


@pytest.mark.parametrize('name', ['room.glb', 'room.gltf'])
def test_parts_of_a_scene_graph_stand_where_it_puts_them(tmp_path, name):
    half = np.sqrt(0.5)
    nodes = [{'children': [1, 2], 'translation': [10, 0, 0]}, {'mesh': 0, 'scale': [2, 2, 2]},
             {'mesh': 0, 'rotation': [0, 0, half, half], 'translation': [0, 0, 5]}]
    mesh, path = Mesh(VERTICES.astype(np.float32), TRIANGLES), tmp_path / name
    if name == 'room.glb':
        files.write_glb(path, mesh, nodes)
    else:
        document, buffer = files.gltf_of(mesh, nodes)
        document['buffers'][0]['uri'] = 'room.bin'
        path.write_text(json.dumps(document))
        (tmp_path / 'room.bin').write_bytes(buffer)
    # The second part is turned by 90 degrees: what was long along y is now along -x.
    expected = [2.0 * VERTICES + [10, 0, 0], VERTICES[:, [1, 0, 2]] * [-1, 1, 1] + [10, 0, 5]]
    np.testing.assert_allclose(read_mesh(path).reshape(-1, 3, 3),
                               np.concatenate([part[TRIANGLES] for part in expected]), atol=1e-5)


def test_faces_with_nan_are_refused_or_left_out(tmp_path, caplog):
    vertices = np.concatenate([ROOM.mesh.vertices, [[np.nan, 0.0, 0.0]]]).astype(np.float32)
    triangles = np.concatenate([ROOM.mesh.triangles, [[0, 1, len(vertices) - 1]]])
    path = tmp_path / 'room.ply'
    files.write_ply_mesh(path, Mesh(vertices, triangles.astype(np.int32)))
    assert 'NaN' in refusal(path)
    with caplog.at_level(logging.INFO):
        scene = load_scene(path, drop_nonfinite=True, max_points=20_000)
    assert len(scene) == 20_000
    np.testing.assert_allclose(scene.mesh.corners, ROOM.mesh.corners, atol=1e-5)
    assert '60000 of 60001' in caplog.text


@pytest.mark.system
@pytest.mark.parametrize(('name', 'text'), [
    ('room.obj', 'v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 1 1\n'),
    ('room.off', 'OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n'),
    ('room.off', 'OFF\n4000000000 1 0\n0 0 0\n'),
    ('room.stl', 'solid\nendsolid\n'), ('room.gltf', '{"asset": {}}'), ('room.glb', 'glTF')])
def test_meshes_that_are_none_are_refused(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text)
    refusal(path)


def test_a_mesh_that_its_reader_would_round_is_refused(tmp_path):
    files.write_obj(tmp_path / 'room.obj', Mesh(VERTICES + [389000.0, 3956000.0, 0.0], TRIANGLES))
    assert 'near the origin' in refusal(tmp_path / 'room.obj')


@pytest.mark.parametrize(('name', 'write'), [
    ('room.obj', files.write_obj), ('room.off', files.write_off), ('ROOM.STL', files.write_stl)])
def test_units_and_axes_are_those_asked_for(tmp_path, name, write):
    path = tmp_path / name
    write(path, Mesh(1000.0 * ROOM.mesh.vertices @ map_from_file('y'), ROOM.mesh.triangles))
    scene = load_scene(path, scale=0.001, up='y', max_points=20_000)
    np.testing.assert_allclose(scene.mesh.corners, ROOM.mesh.corners, atol=1e-5)
    # The room shows all of it but for a frame in a wall.
    np.testing.assert_allclose(scene.bounds, Scene(ROOM.mesh.vertices).bounds, atol=0.05)


def within(points, low, high):
    """Return which points are in a box, its faces included."""
    return ((points >= np.array(low) - 0.005) & (points <= np.array(high) + 0.005)).all(axis=1)


def test_a_room_from_a_tape_measure_has_its_measures(tmp_path):
    path = tmp_path / 'room.yaml'
    command = ('room 6 4.5 2.7 --door south 1 0.9 2.1 --window east 2 1.5 1.2 0.9 '
               '--box 2 1 0 4 2 0.75 --out')
    assert main([*command.split(), str(path)]) == 0
    scene = load_scene(path, max_points=20_000)
    np.testing.assert_allclose(scene.bounds, [(0, 0, 0), (6, 4.5, 2.7)], atol=0.01)
    assert floor_height(scene) == pytest.approx(0.0, abs=0.005)
    assert ceiling_of(scene).points[:, 2].mean() == pytest.approx(2.7, abs=0.005)
    points = scene.points
    for low, high in (((1.02, 0, 0.02), (1.88, 0, 2.08)), ((6, 2.02, 0.92), (6, 3.48, 2.08)),
                      # No camera sees what the box stands on, nor what is in it.
                      ((2.02, 1.02, 0), (3.98, 1.98, 0.73))):
        assert not within(points, low, high).any()
    top = within(points, (2, 1, 0.745), (4, 2, 0.755))
    assert top.sum() > 100 and (scene.normals[top][:, 2] > 0.99).mean() > 0.9
    # All surfaces are where walls are looked for, and nothing is outside of them.
    walls = walls_of(scene).points
    assert {round(float(edge), 1) for edge in np.ptp(walls[:, :2], axis=0)} == {6.0, 4.5}


@for_any(20, size=strategies.tuples(*[strategies.floats(1.0, 30.0)] * 3), data=strategies.data())
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

    def surface(x, y, z):
        return 2.0 * (x * y + y * z + z * x)
    assert area == pytest.approx(surface(*size) + surface(*(high - low)) - lost, rel=1e-6)


@pytest.mark.parametrize(('size', 'arguments', 'words'), [
    ('6 4.5 nan', '', 'size[2]'), ('6 4.5 2.7', '--door souht 1 1 2', "'south'"),
    ('6 4.5 2.7', '--door south 5.5 0.9 2.1', 'south wall'),
    ('6 4.5 2.7', '--door west 1 0.9 2.8', '4.5 x 2.7 m'),
    ('6 4.5 2.7', '--box 1 1 0 2 5 1', 'box'), ('6 4.5 2.7', '--box 1 1 0 1 2 1', 'box'),
    ('6 4.5 x', '', "'x'"), ('0.5 4 3', '', '1 to 100')])
def test_measures_that_cannot_be_are_refused(tmp_path, capsys, size, arguments, words):
    out = tmp_path / 'room.yaml'
    assert words in refused(capsys, 'room', *size.split(), *arguments.split(), '--out', out)
    assert not out.exists()


@pytest.mark.parametrize(('size', 'box', 'at'), [
    ('6 4 3', '0.6 0.6 0 5.4 3.4 2.6', 0.3),
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
    with pytest.raises(SceneError, match='rig.yaml: line 1, cameras'):
        load_scene(path)
    assert scans_in(tmp_path) == []


def test_eight_corners_are_a_room(tmp_path):
    turn = np.array([[0.8, 0.6, 0], [-0.6, 0.8, 0], [0, 0, 1]])
    np.savetxt(tmp_path / 'corners.txt', 1000.0 * (CORNERS @ turn)[[3, 0, 6, 1, 5, 2, 7, 4]])
    for scene in (load_scene(tmp_path / 'corners.txt', scale=0.001, max_points=10_000),
                  scene_of(CORNERS @ turn, max_points=10_000)):
        assert len(scene) > 9_000 and scene.mesh.exact
        assert floor_height(scene) == pytest.approx(0.0, abs=0.005)
        back = scene.points @ turn.T
        np.testing.assert_allclose([back.min(axis=0), back.max(axis=0)], CORNERS[[0, -1]],
                                   atol=0.01)


def test_eight_points_that_are_no_corners_of_a_room_are_noticed():
    corners = CORNERS.copy()
    corners[7, 1] = 9.0
    with pytest.warns(SceneWarning, match='flat'):
        assert len(scene_of(corners, max_points=10_000).notes) == 1
    corners[7] = [4.0, 2.0, 1.0]
    with pytest.raises(SceneError, match='corners'):
        scene_of(corners)
