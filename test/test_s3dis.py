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

"""Rooms of S3DIS: found in its folders, chosen by rule, and read once."""

import numpy as np
from ocp_ros.cli.benchmark_command import protocol_of
from ocp_ros.cli.main import parser
from ocp_ros.compare.protocol import PRESETS, rooms_of_s3dis
from ocp_ros.rooms.generator import generate_room
from ocp_ros.rooms.scene_source import make_room
from ocp_ros.scenes import scene_cache
from ocp_ros.scenes.s3dis import chosen_rooms, rooms_of_area
from ocp_ros.scenes.scene import SceneError
from ocp_ros.scenes.scene_cache import load_cached
from ocp_ros.scenes.scene_files import load_scene
from ocp_ros.util.files import cache_folder
from plyfile import PlyData, PlyElement
import pytest


def box(width, depth, height=2.8):
    """Return points on the floor, the walls and the ceiling of a room."""
    axes = [np.linspace(0.0, size, 25) for size in (width, depth, height)]
    points = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)
    edge = (points == 0.0) | (points == [width, depth, height])
    return points[edge.any(axis=1)]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Make a small copy of the data set's folders, and a cache."""
    monkeypatch.setenv('OCP_ROS_CACHE', str(tmp_path / 'cache'))
    monkeypatch.setattr(scene_cache, 'MIN_CACHED_BYTES', 0)
    rooms = {'office_2': box(6.0, 7.0), 'office_10': box(6.5, 7.0), 'WC_1': box(3.0, 3.0),
             'openspace_1': box(14.0, 12.0), 'stairs_1': box(6.0, 6.0),
             'hallway_1': box(5.0, 9.0)[box(5.0, 9.0)[:, 2] < 2.5]}
    for area in (1, 6):
        for name, points in rooms.items():
            path = tmp_path / 's3dis' / f'Area_{area}' / name / f'{name}.txt'
            path.parent.mkdir(parents=True)
            np.savetxt(path, np.hstack([points, np.full((len(points), 3), 128.0)]), '%.3f')
            (path.parent / 'Annotations').mkdir()
            (path.parent / 'Annotations' / 'wall_1.txt').write_text('0 0 0 1 1 1\n')
    return tmp_path / 's3dis'


def names(paths):
    """Return the names of rooms."""
    return [path.stem for path in paths]


def test_rooms_are_listed_in_their_natural_order(folder):
    assert names(rooms_of_area(folder, 1)) == \
        ['WC_1', 'hallway_1', 'office_2', 'office_10', 'openspace_1', 'stairs_1']


def test_rooms_to_learn_from_are_flat_of_some_size_and_closed(folder):
    assert names(chosen_rooms(folder, 1)) == ['office_10', 'office_2']
    # Those to be judged by may be open.
    assert names(chosen_rooms(folder, 6)) == ['office_10', 'hallway_1', 'office_2']


def test_the_misspelt_room_is_found(folder):
    (folder / 'Area_6' / 'office_2').rename(folder / 'Area_6' / 'copyRoom_1')
    there = folder / 'Area_6' / 'copyRoom_1'
    (there / 'office_2.txt').rename(there / 'copy_Room_1.txt')
    assert names(chosen_rooms(folder, 6)) == ['office_10', 'hallway_1', 'copy_Room_1']
    assert load_scene(there / 'copy_Room_1.txt').name == 'Area_6_copyRoom_1'


def test_the_folder_is_named_by_the_environment(folder, monkeypatch):
    monkeypatch.delenv('S3DIS_DIR', raising=False)
    arguments = parser().parse_args(['benchmark', '--preset', 'full'])
    assert rooms_of_s3dis() == [] and protocol_of(arguments).rooms == PRESETS['full'].rooms
    monkeypatch.setenv('S3DIS_DIR', str(folder))
    rooms = protocol_of(arguments).rooms
    assert rooms[:10] == PRESETS['full'].rooms and len(rooms) == 13
    assert make_room(rooms[10], 60).name == 'Area_6_office_10@60'
    monkeypatch.setenv('S3DIS_DIR', str(folder / 'Area_6'))
    with pytest.raises(SceneError, match='no rooms such as Area_6/office_1.*set S3DIS_DIR to'):
        rooms_of_s3dis()


def test_what_was_read_once_is_not_read_again(folder, monkeypatch):
    path = folder / 'Area_6' / 'office_2' / 'office_2.txt'
    first = load_cached(path, max_points=1000)
    monkeypatch.setattr(scene_cache, 'load_scene', None)
    again = load_cached(path, max_points=1000)
    np.testing.assert_array_equal(first.points, again.points)
    assert again.name == 'Area_6_office_2' and again.normals is None
    monkeypatch.setattr(scene_cache, 'load_scene', load_scene)
    # Other options, another file, or a cache that broke off are read anew.
    assert len(load_cached(path, max_points=500)) < len(first)
    for kept in (cache_folder() / 'scans').iterdir():
        kept.write_bytes(kept.read_bytes()[:100])
    np.testing.assert_array_equal(load_cached(path, max_points=1000).points, first.points)


def test_normals_are_kept_and_a_cache_that_cannot_be_written_does_not_matter(
        tmp_path, monkeypatch):
    monkeypatch.setattr(scene_cache, 'MIN_CACHED_BYTES', 0)
    room = generate_room(30, 3000)
    path = tmp_path / 'a.ply'
    columns = np.hstack([room.points, room.normals_or_estimate]).astype(np.float32)
    table = np.rec.fromarrays(columns.T, names='x,y,z,nx,ny,nz')
    PlyData([PlyElement.describe(np.asarray(table), 'vertex')]).write(path)
    expected = load_scene(path)
    assert expected.normals is not None
    (tmp_path / 'file').write_text('')
    for cache in (tmp_path / 'file', tmp_path / 'cache', tmp_path / 'cache'):
        monkeypatch.setenv('OCP_ROS_CACHE', str(cache))
        scene = load_cached(path)
        np.testing.assert_array_equal(scene.points, expected.points)
        np.testing.assert_array_equal(scene.normals, expected.normals)


def test_a_file_that_is_not_there_is_refused_as_ever(tmp_path):
    with pytest.raises(SceneError, match='found no such file'):
        load_cached(tmp_path / 'none.ply')
