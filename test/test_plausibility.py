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
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.rig.plausibility import room_notes
from ocp_ros.scenes.scene import Scene
from ocp_ros.scenes.scene_files import load_scene
from ocp_ros.scenes.scene_files import scene_of as room_of
from ocp_ros.scenes.stray_points import stray_points
import pytest
from scipy.spatial import cKDTree


def scene_of(*parts):
    return Scene(np.concatenate(parts).astype(np.float32), 'room')


def of_kind(notes, words):
    return [note for note in notes if words in note]


@pytest.mark.parametrize('away', [3.0, 20.0, 300.0, 1e4])
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
    assert stray_points(np.vstack([room, far]))[-100:].all()
    assert not stray_points(np.vstack([room, far]))[:-100].any()
    # A lamp in the air, and another room of the same size across a gap, are no strays.
    lamp = room.mean(axis=0) + 0.1 * rng.uniform(size=(3, 3))
    assert not stray_points(np.vstack([room, lamp])).any()
    other = room + np.array([np.ptp(room[:, 0]) + 3.0, 0.0, 0.0], dtype=np.float32)
    assert not stray_points(np.vstack([room, other])).any()


@pytest.mark.parametrize('unit', [1.0, 1000.0, 1 / 0.3048])
def test_generated_rooms_have_no_strays_in_any_unit(unit):
    for seed in range(4):
        assert not stray_points(unit * made_room(seed, 2500).points).any()


def test_generated_rooms_are_plausible_and_many_upside_down_are_noticed():
    rooms = {seed: made_room(seed, 4000).points for seed in range(7006, 7012)}
    notes = {seed: room_notes(scene_of(points)) for seed, points in rooms.items()}
    assert notes == dict.fromkeys(rooms, [])
    turned = [room_notes(scene_of(points * np.array([1, 1, -1], 'f4')))
              for points in rooms.values()]
    assert sum(bool(of_kind(notes, 'upside down')) for notes in turned) >= 3


@pytest.mark.parametrize('degrees', [5.0, 12.0, 25.0])
def test_a_tilted_room_is_noticed(degrees):
    points = made_room(8, 3000).points @ rotation_matrix(roll=np.deg2rad(degrees)).T
    note, = of_kind(room_notes(scene_of(points)), 'tilted')
    assert f'tilted by {degrees:.0f} degrees' in note


@pytest.mark.parametrize('factor, words', [(1 / 0.3048, 'feet'), (10.0, 'ten times smaller')])
def test_a_room_in_other_units_is_noticed_and_the_unit_is_named(factor, words):
    note, = of_kind(room_notes(scene_of(factor * made_room(8, 3000).points)), 'm high')
    assert words in note and f'{1 / factor:.3g}'[:4] in note


def test_a_floor_that_slopes_between_plumb_walls_is_no_tilted_scan():
    points = box_sides(np.array([8.0, 6.0, 4.0]), np.array([4.0, 3.0, 2.0])).astype(float)
    x, z = points[:, 0], points[:, 2]
    ramp = points + np.column_stack([0 * x, 0 * x, np.where(z < 0.05, 0.14 * x, 0.0)])
    notes = room_notes(scene_of(ramp[ramp[:, 2] >= 0.14 * ramp[:, 0] - 1e-6]))
    note, = of_kind(notes, 'slopes by 8 degrees')
    assert notes == [note]


def test_an_attic_has_walls_and_a_ceiling_and_is_the_right_way_up():
    points = box_sides(np.array([6.0, 4.5, 3.0]), np.array([3.0, 2.25, 1.5])).astype(float)
    roof = 1.2 + 1.8 * (1.0 - abs(points[:, 1] / 2.25 - 1.0))
    under = points[points[:, 2] <= roof]
    y, x = (axis.ravel() for axis in np.meshgrid(np.arange(0, 4.5, 0.07), np.arange(0, 6, 0.1)))
    sloped = np.column_stack([x, y, 1.2 + 1.8 * (1.0 - abs(y / 2.25 - 1.0))])
    assert room_notes(scene_of(under, sloped)) == []


@pytest.mark.parametrize('height', [0.0, 0.1, 1.5, 3.0])
def test_only_a_room_above_another_has_several_storeys(height):
    room = box_room().points
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


@pytest.mark.parametrize('share', [0.002, 0.01, 0.05])
def test_points_that_hang_alone_in_the_air_are_left_out_and_counted(share):
    room = made_room(501, 20_000)
    drawn = np.random.default_rng(0).uniform(*room.bounds, (round(share * len(room)), 3))
    drawn = drawn[cKDTree(room.points).query(drawn)[0] > 0.3]
    scene = room_of(np.concatenate([room.points, drawn]))
    left = cKDTree(scene.points).query(drawn)[0] < 1e-4
    assert left.mean() < 0.3
    kept = cKDTree(scene.points).query(room.points)[0] < 1e-4
    assert kept.mean() > 0.998
    assert any('isolated points left out' in remark for remark in scene.remarks)
