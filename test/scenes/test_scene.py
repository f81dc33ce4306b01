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

"""Scenes: size, spacing, normals, voxels, and units and axes that look wrong."""

from conftest import for_any, made_room
from hypothesis import strategies
from hypothesis.extra import numpy as arrays
import numpy as np
from ocp_ros.geometry.clouds import voxel_downsample, voxel_size_for
from ocp_ros.rooms.scene_source import room_named
from ocp_ros.scenes.neighbours import nearest
from ocp_ros.scenes.scene import check_points, Scene, SceneError, turned
from ocp_ros.scenes.scene_files import load_scene, SceneWarning
from ocp_ros.scenes.source_frame import (
    likely_up,
    likely_up_axis,
    map_from_file,
    SourceFrame,
    UP_AXES,
)
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

ROOM = made_room(3, 2500).points


def test_a_scene_refuses_what_is_not_points():
    for points in (ROOM[:, :2], ROOM[:0], ROOM[0]):
        with pytest.raises(SceneError, match='here: found'):
            Scene(points, 'here')
    with pytest.raises(SceneError, match='NaN'):
        Scene(np.concatenate([ROOM, [[np.nan, 0.0, 0.0]]]))


def test_spacing_is_the_distance_to_the_nearest_other_point():
    points = ROOM[::10]
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    np.testing.assert_allclose(Scene(points).spacing, distance.min(axis=1), rtol=1e-4)


def test_a_turned_room_keeps_the_distances_of_the_room():
    rotated = turned(Scene(ROOM), 30.0)
    np.testing.assert_array_equal(rotated.spacing, Scene(ROOM).spacing)
    assert rotated.diameter == Scene(ROOM).diameter


def test_normals_are_estimated_only_where_none_are_given():
    given_normals = np.tile(np.float32([0.0, 0.0, 1.0]), (len(ROOM), 1))
    scene = Scene(ROOM, normals=given_normals)
    np.testing.assert_array_equal(scene.normals_or_estimate, given_normals)


def test_estimated_normals_stand_on_the_surface_and_are_sharp_at_edges():
    points = np.random.default_rng(0).uniform(0.0, 2.0, (3000, 3))
    # A floor and a wall, tilted.
    points[:1500, 2] = points[1500:, 0] = 0.0
    turn = Rotation.from_euler('xyz', [20.0, 37.0, 50.0], degrees=True).as_matrix()
    normals = Scene(points @ turn.T).normals_or_estimate
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
    away = abs(normals @ turn)[np.arange(3000), np.repeat([2, 0], 1500)]
    assert (away > 0.98).mean() > 0.97
    # Far from the edge they are exact.
    flat = points[:, [0, 2]].sum(axis=1) > 0.5
    np.testing.assert_allclose(away[flat], 1.0, atol=1e-4)


def slow_voxels(points, voxel_size):
    cells = {}
    low = points.min(axis=0)
    for point in points:
        key = tuple(int(np.floor(number)) for number in (point - low) / voxel_size)
        cells.setdefault(key, []).append(point.astype(np.float64))
    return np.array([np.mean(cells[key], axis=0) for key in sorted(cells)])


@for_any(40, voxel_size=strategies.floats(0.01, 12.0), points=arrays.arrays(
    strategies.sampled_from([np.float32, np.float64]),
    strategies.tuples(strategies.integers(1, 40), strategies.just(3)),
    elements=strategies.floats(-5.0, 5.0, width=32)))
def test_voxels_agree_with_a_dictionary(points, voxel_size):
    fast, slow = voxel_downsample(points, voxel_size), slow_voxels(points, voxel_size)
    assert fast.dtype == np.float32 and fast.shape == slow.shape
    np.testing.assert_allclose(fast, slow, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize('voxel_size', [0.0, np.nan])
def test_a_voxel_needs_a_size(voxel_size):
    with pytest.raises(ValueError, match='voxel_size'):
        voxel_downsample(ROOM, voxel_size)


@for_any(8, seed=strategies.integers(4, 11), max_points=strategies.integers(600, 3900))
def test_the_voxel_size_found_keeps_its_promise(seed, max_points):
    points = made_room(seed, 4000).points
    kept = len(voxel_downsample(points, voxel_size_for(points, max_points)))
    assert 0.75 * min(max_points, len(points)) < kept <= max_points


@for_any(60, seed=strategies.integers(0, 2 ** 32 - 1),
         kind=strategies.sampled_from(['even', 'clustered', 'line', 'stray', 'lattice']),
         count=strategies.integers(1, 400), neighbours=strategies.integers(1, 20))
def test_nearest_points_are_those_of_a_tree(seed, kind, count, neighbours):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-3.0, 3.0, (count, 3))
    # Points on the sides of a box, as a scan of a room has them.
    points[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-3.0, 3.0], count)
    if kind == 'clustered':
        points[:count // 2] *= 1e-3
    elif kind == 'line':
        points[:, :2] = 0.0
    elif kind == 'stray':
        points[0] = 1e4
    elif kind == 'lattice':
        points = np.round(points)
    points = points.astype(np.float32)
    distances, indices = nearest(points, neighbours)
    expected, _ = cKDTree(points.astype(np.float64)).query(
        points, k=np.arange(1, neighbours + 1))
    np.testing.assert_array_equal(distances, expected)
    # Of points that are equally far, any may be named; none twice.
    found = np.isfinite(distances)
    assert (indices[~found] == count).all()
    for row, others in enumerate(indices):
        named = others[found[row]]
        assert len(set(named)) == len(named)
        away = np.linalg.norm(points[named].astype(np.float64) - points[row], axis=1)
        np.testing.assert_allclose(away, distances[row, found[row]], rtol=1e-12)


def test_which_way_most_generated_rooms_were_saved_is_found_and_no_other_way():
    rooms = [made_room(seed, 4000).points for seed in range(4, 12)]
    for up in ('x', 'y', '-y', 'z'):
        saved = [points @ map_from_file(up) for points in rooms]
        axes = [likely_up_axis(points) for points in saved]
        assert axes.count(up[-1]) > (7 if up == 'z' else 6) and set(axes) <= {up[-1], 'z'}
        assert [likely_up(points) for points in saved].count(up) >= 6


@pytest.mark.parametrize('size', [(1.5, 15.0, 2.7), (1.9, 12.0, 3.2), (3.0, 3.0, 3.0)])
def test_corridors_and_cubes_do_not_warn(size):
    rng = np.random.default_rng(0)
    areas = np.repeat(np.prod(size) / np.array(size), 2)
    face = rng.choice(6, 20000, p=areas / areas.sum())
    points = rng.random((20000, 3)) * size
    points[np.arange(20000), face // 2] = np.array(size)[face // 2] * (face % 2)
    assert likely_up_axis(points) == 'z'


@pytest.mark.parametrize('up', UP_AXES)
def test_each_direction_that_may_be_up_is_turned_to_z(tmp_path, up):
    rotation, path = map_from_file(up), tmp_path / 'room.npy'
    upwards = np.eye(3)['xyz'.index(up[-1])] * (-1.0 if up[0] == '-' else 1.0)
    np.testing.assert_allclose(rotation @ upwards, [0.0, 0.0, 1.0])
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert SourceFrame(rotation=rotation).up == up
    np.save(path, ROOM.astype(np.float64) @ rotation)
    scene = load_scene(path, up=up)
    assert np.allclose(scene.points, ROOM, atol=1e-6) and scene.source.up == up
    assert np.allclose(scene.source.to_source(scene.points), scene.points @ rotation)


def test_a_guess_is_named_and_recorded(tmp_path):
    path = tmp_path / 'room.npy'
    np.save(path, made_room(5, 4000).points.astype(np.float64) @ map_from_file('y'))
    scene = load_scene(path, up='auto')
    assert scene.source.up == 'y' and scene.remarks[0] == 'up: y, a guess (--up)'
    assert room_named(str(path), up='auto')[1]['up'] == 'y'


@pytest.mark.parametrize(('size', 'remedy'), [
    ((7960, 7930, 3250), r'\(--scale 0.001\)'), ((796, 793, 325), '0.01 or --scale 0.0254'),
    ((300, 250, 500), r'\(--scale 0.01\)'), ((314, 312, 105), r'\(--scale 0.0254\)'),
    ((700, 5, 5), 'cut one room'), ((1e308, 1e308, 1e307), 'cut one room')])
def test_the_unit_is_the_one_that_makes_a_room(size, remedy):
    points = (ROOM - ROOM.min(axis=0)).astype(np.float64) / np.ptp(ROOM, axis=0) * size
    with pytest.raises(SceneError, match=remedy):
        Scene(points)
    with pytest.raises(SceneError, match=remedy):
        check_points(np.roll(points, 1, axis=1), 'lying', up='x')


def test_a_room_that_a_wrong_scale_makes_small_is_warned_of(tmp_path):
    path = tmp_path / 'room.npy'
    np.save(path, ROOM / ROOM.max() * 800.0)
    with pytest.warns(SceneWarning, match=r'^room.npy: .*--scale'):
        load_scene(path, scale=0.001)


@pytest.mark.parametrize('extent', [(0.0, 4.0, 3.0), (0.0, 0.0, 5.0)])
def test_a_wall_or_a_line_is_refused_however_it_is_turned(extent):
    points = np.random.default_rng(0).random((500, 3)) * extent
    for turn in Rotation.random(5, random_state=0):
        with pytest.raises(SceneError, match='flat'):
            Scene(turn.apply(points))
    assert len(Scene(points + np.random.default_rng(1).random((500, 3)) * 0.2)) == 500


def test_a_stray_point_is_not_taken_for_millimetres():
    with pytest.raises(SceneError, match='stray'):
        Scene(np.concatenate([ROOM, [[9000.0, 0.0, 0.0]]]))


def test_an_isolated_point_hides_no_wall():
    room = made_room(5, 8000)
    stray = room.bounds.mean(axis=0)[None].astype(np.float32)
    scene = Scene(np.concatenate([room.points, stray]))
    assert scene.pitch[-1] <= 4.0 * np.median(scene.pitch) < 1.0


def test_the_pitch_is_that_of_a_grid():
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0, 4, 0.1), np.arange(0, 4, 0.1)))
    scene = Scene(np.stack([x, y, 0.05 * np.sin(x)], axis=1))
    assert np.median(scene.pitch) == pytest.approx(0.1, rel=0.4)
    assert np.median(scene.spacing) == pytest.approx(0.1, rel=0.02)
