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

"""Rooms that are not what they seem: stray points, lying down, tilted, in feet, of two storeys."""

from conftest import box_room, box_sides, made_room
import numpy as np
from ocp_ros.geometry.cameras import CameraModel, rotation_matrix
from ocp_ros.rig.plausibility import angle_notes, room_notes
from ocp_ros.rig.structure import ceiling_of
from ocp_ros.scenes.false_points import stray_points
from ocp_ros.scenes.scene import Scene
from ocp_ros.scenes.scene_files import load_scene
from ocp_ros.scenes.scene_files import scene_of as room_of
import pytest
from scipy.spatial import cKDTree


def scene_of(*parts):
    return Scene(np.concatenate(parts).astype(np.float32), 'room')


@pytest.mark.parametrize(('angles', 'fov_deg', 'count'), [
    ([0.785, 0.349, 0.0, -2.356], 87.0, 1), ([1.5708], 87.0, 1), ([0.785, 45.0], 87.0, 0),
    ([0.0, 0.0], 87.0, 0), ([2.0, 1.0], 87.0, 0), ([48.0, 20.0], 1.5, 1), ([0.5, 0.2], 1.2, 2)])
def test_angles_that_may_be_radians_are_noted(angles, fov_deg, count):
    model = CameraModel(0.1, 5.0, np.deg2rad(fov_deg), np.deg2rad(0.6 * fov_deg))
    assert len(angle_notes(angles, [model, model])) == count
    assert angle_notes([], [CameraModel(0.1, 9.0, 2.0 * np.pi, 0.1)]) == []


def of_kind(notes, words):
    return [note for note in notes if words in note]


@pytest.mark.parametrize('away', [3.0, 20.0, 1e4])
def test_a_stray_point_changes_nothing(tmp_path, away):
    points = made_room(8, 2000).points
    np.save(tmp_path / 'room.npy', points)
    np.save(tmp_path / 'stray.npy', np.vstack([points, points.max(axis=0) + [away, 0, 0]]))
    scene, stray = (load_scene(tmp_path / f'{name}.npy') for name in ('room', 'stray'))
    assert np.array_equal(stray.points, scene.points)
    assert scene.remarks == () and stray.remarks[0].startswith('1 stray point left out')


def test_groups_of_stray_points_are_found_and_rooms_are_whole():
    room = made_room(8, 2500).points
    rng = np.random.default_rng(0)
    far = room.max(axis=0) + [60.0, 5.0, 0.0] + rng.uniform(size=(100, 3))
    found = stray_points(np.vstack([room, far]))
    assert found[-100:].all() and not found[:-100].any()
    # A lamp in the air, and another room of the same size across a gap, are no strays.
    lamp = room.mean(axis=0) + 0.1 * rng.uniform(size=(3, 3))
    other = room + np.array([np.ptp(room[:, 0]) + 3.0, 0.0, 0.0], dtype=np.float32)
    # Nor is anything in other rooms, in any unit.
    whole = [np.vstack([room, lamp]), np.vstack([room, other])] + [
        unit * made_room(seed, 2500).points for seed in range(4)
        for unit in (1.0, 1000.0, 1 / 0.3048)]
    assert [k for k, points in enumerate(whole) if stray_points(points).any()] == []


def test_generated_rooms_are_plausible_and_many_upside_down_are_noticed():
    rooms = [made_room(seed, 4000).points for seed in range(7006, 7012)]
    assert [room_notes(scene_of(points)) for points in rooms] == [[]] * len(rooms)
    turned = [room_notes(scene_of(points * np.array([1, 1, -1], 'f4'))) for points in rooms]
    assert sum(bool(of_kind(notes, 'upside down')) for notes in turned) >= 3


def test_noise_that_fills_a_volume_is_noticed():
    rng = np.random.default_rng(0)
    for count in (1000, 20_000):
        for noise in (rng.uniform(0.0, [5.0, 4.0, 2.7], (count, 3)), rng.normal(size=(count, 3))):
            assert of_kind(room_notes(scene_of(noise)), 'as noise does')
    # Noise of a sensor across its surfaces is none.
    room = made_room(8, 20_000).points
    rough = room + rng.normal(0.0, 0.03, room.shape)
    assert not of_kind(room_notes(scene_of(rough)), 'as noise does')


def test_a_room_that_is_tilted_or_in_other_units_is_noticed():
    room = made_room(8, 3000).points
    for degrees in (5, 12, 25):
        tilted = room @ rotation_matrix(roll=np.deg2rad(degrees)).T
        note, = of_kind(room_notes(scene_of(tilted)), 'tilted')
        assert f'tilted by {degrees} degrees' in note
    for factor, unit in ((0.3048, 'feet'), (0.1, 'ten times smaller')):
        note, = of_kind(room_notes(scene_of(room / factor)), 'm high')
        assert unit in note and f'(--scale) by {factor}' in note


def test_a_floor_that_slopes_between_plumb_walls_is_no_tilted_scan():
    points = box_sides(np.array([8.0, 6.0, 4.0]), np.array([4.0, 3.0, 2.0])).astype(float)
    ramp = 0.14 * points[:, 0]
    points[:, 2] += np.where(points[:, 2] < 0.05, ramp, 0.0)
    note, = room_notes(scene_of(points[points[:, 2] >= ramp - 1e-6]))
    assert 'slopes by 8 degrees' in note


def test_an_attic_has_walls_and_a_ceiling_and_is_the_right_way_up():
    points = box_sides(np.array([6.0, 4.5, 3.0]), np.array([3.0, 2.25, 1.5])).astype(float)
    y, x = (axis.ravel() for axis in np.meshgrid(np.arange(0, 4.5, 0.07), np.arange(0, 6, 0.1)))
    below, roof = (3.0 - 1.8 * abs(along / 2.25 - 1.0) for along in (points[:, 1], y))
    attic = scene_of(points[points[:, 2] <= below], np.column_stack([x, y, roof]))
    assert room_notes(attic) == []


def test_an_attic_with_low_knee_walls_is_closed_and_a_low_ceiling_is_noticed():
    attic = box_sides(np.array([6.0, 4.5, 3.0]), np.array([3.0, 2.25, 1.5])).astype(float)
    y, x = (axis.ravel() for axis in np.meshgrid(np.arange(0, 4.5, 0.05), np.arange(0, 6, 0.1)))
    below, roof = (3.0 - 2.6 * abs(along / 2.25 - 1.0) for along in (attic[:, 1], y))
    scene = scene_of(attic[attic[:, 2] <= below], np.column_stack([x, y, roof]))
    assert room_notes(scene) == [] and len(ceiling_of(scene).points)
    low = box_sides(np.array([4.0, 3.0, 1.9]), np.array([2.0, 1.5, 0.95]))
    assert of_kind(room_notes(scene_of(low)), 'lower than 2 m')


def test_only_a_room_above_another_has_several_storeys():
    room = box_room().points
    for height in (0.0, 0.1, 1.5):
        assert not of_kind(room_notes(scene_of(room + np.array([0, 0, height], 'f4'))), 'storeys')
    two = scene_of(room, room + np.array([0.0, 0.0, 3.1], 'f4'))
    assert of_kind(room_notes(two), 'several storeys')


@pytest.mark.parametrize('keep, words', [
    (lambda points: points[:, 2] < 2.7, 'no ceiling'),
    (lambda points: points[:, 2] > 0.1, 'no floor'),
    (lambda points: points[:, 1] < 3.95, 'no wall')])
def test_a_missing_surface_is_noticed(keep, words):
    points = box_sides(np.array([6.0, 4.0, 2.8]), np.array([3.0, 2.0, 1.4]))
    assert of_kind(room_notes(scene_of(points[keep(points)])), words)


def test_a_field_is_no_room():
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0, 40, 0.4), np.arange(0, 30, 0.4)))
    field = np.column_stack([x, y, 0.1 * np.sin(x)])
    trees = box_sides(np.array([0.5, 0.5, 4.0]), np.array([20.0, 15.0, 2.0]))
    assert of_kind(room_notes(scene_of(field, trees)), 'outdoors')


@pytest.mark.parametrize('share', [0.002, 0.05])
def test_points_that_hang_alone_in_the_air_are_left_out_and_counted(share):
    room = made_room(501, 20_000)
    drawn = np.random.default_rng(0).uniform(*room.bounds, (round(share * len(room)), 3))
    drawn = drawn[cKDTree(room.points).query(drawn)[0] > 0.3]
    scene = room_of(np.concatenate([room.points, drawn]))
    left, kept = (np.mean(cKDTree(scene.points).query(points)[0] < 1e-4)
                  for points in (drawn, room.points))
    assert left < 0.3 and kept > 0.998
    assert any('isolated points left out' in remark for remark in scene.remarks)
