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

"""The rooms of a run: three sets that never share one; and S3DIS, read once."""

from dataclasses import replace
from pathlib import Path
import shutil

from benchmarks.drills.file_fuzz import write_ply
from benchmarks.room_sets import SEEDS
from conftest import box_sides, made_room
import numpy as np
from ocp_ros.cli.benchmark_command import protocol_of
from ocp_ros.cli.main import build_parser
from ocp_ros.compare.protocol import PRESETS, rooms_in, rooms_of_s3dis
from ocp_ros.rooms import scene_source
from ocp_ros.rooms.room_sets import chosen_rooms, FRESH, rooms_of_area, TEST, TRAINING, VALIDATION
from ocp_ros.rooms.scene_source import load_cached, make_room
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.scenes.scene_files import load_scene, save_scene
from ocp_ros.simulation import environment
from ocp_ros.simulation.environment import Rooms
from ocp_ros.training.train import trials_of
from ocp_ros.training.training_config import RoomsConfig, TrainingConfig
from ocp_ros.training.training_rooms import PARTS, room_names
from ocp_ros.training.validation import _cached_problem
from ocp_ros.util.files import cache_folder
from ocp_ros.util.settings import ConfigurationError, from_nested
import pytest

SETS = {'training': TRAINING, 'validation': VALIDATION, 'test': TEST, 'fresh': FRESH}


def test_no_room_is_in_two_sets():
    everything = [seed for seeds in SETS.values() for seed in seeds]
    assert SETS.keys() == SEEDS.keys() and len(everything) == len(set(everything))
    for name, (first, count) in SEEDS.items():
        seeds = SETS[name]
        assert len(seeds) == count and list(seeds) == sorted(set(seeds))
        # No other set begins between the first seed of this one and its last.
        assert min(seeds) >= first
        assert not any(first < other <= max(seeds) for other, _ in SEEDS.values())


def test_generated_rooms_are_those_of_the_frozen_sets():
    config = RoomsConfig(training=5, validation=12, test=100)
    assert room_names(config, 'training') == [str(seed) for seed in TRAINING[:5]]
    assert room_names(config, 'validation') == [str(seed) for seed in VALIDATION[:12]]
    assert room_names(config, 'test') == [str(seed) for seed in TEST]


def scans_in(folder, count):
    """Write so many scans, each of other content."""
    for number in range(count):
        points = np.random.default_rng(number).uniform(0.0, 4.0, (200, 3))
        np.save(folder / f'scan_{number}.npy', points.astype(np.float32))
    (folder / 'notes.md').write_text('no scan')
    return RoomsConfig(source='folder', folder=str(folder), training=1000, validation=1000,
                       test=1000)


def parts_of(config):
    """Return the names of the scans of each set; no set is empty, and no scan is in two."""
    parts = {part: set(room_names(config, part)) for part in PARTS}
    assert all(parts.values())
    assert len(set.union(*parts.values())) == sum(map(len, parts.values()))
    return parts


def paths_in(folder):
    return {str(path.resolve()) for path in folder.glob('*.npy')}


@pytest.mark.parametrize('count', [3, 4, 7])
def test_the_scans_of_a_folder_are_in_one_set_each(tmp_path, count):
    parts = parts_of(scans_in(tmp_path, count))
    assert set.union(*parts.values()) == paths_in(tmp_path)
    assert len(parts['training']) == max(map(len, parts.values()))


def test_meshes_beside_their_rooms_are_no_scans(tmp_path):
    room = made_room(8, 1500)
    for number in (8, 9, 10):
        save_scene(replace(room, points=room.points + number), tmp_path / f'room-{number}.ply')
    (tmp_path / '.draft.ply').write_text('')
    save_scene(Scene(room.points, 'attic'), tmp_path / 'attic_mesh.ply')
    assert len(list(tmp_path.glob('*_mesh.ply'))) == 4
    config = RoomsConfig(source='folder', folder=str(tmp_path))
    names = sorted(Path(name).name for part in PARTS for name in room_names(config, part))
    assert names == ['attic_mesh.ply', 'room-10.ply', 'room-8.ply', 'room-9.ply']
    assert sorted(Path(name).name for name in rooms_in([tmp_path])) == names


def test_scans_in_other_units_are_read_alike_by_all_who_play_in_them(tmp_path):
    expected = made_room(8, 1500)
    for number in range(3):
        # Millimetres, y up.
        points = 1000.0 * expected.points[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
        np.save(tmp_path / f'scan_{number}.npy', points + number)
    config = TrainingConfig(rooms=RoomsConfig(
        source='folder', folder=str(tmp_path), scale=0.001, up='y', rotations='0'))
    (name,) = room_names(config.rooms, 'training')
    (trial,) = trials_of(config, 'validation')
    scene = _cached_problem(
        trial.rooms, trial.room, trial.rotation, trial.simulation).simulator.scene
    for points in (Rooms([name], **config.rooms.reading)[0].points, scene.points):
        np.testing.assert_allclose(np.ptp(points, axis=0), expected.size, atol=1e-3)


def test_rooms_are_made_once_and_kept_while_there_is_memory(monkeypatch):
    made = []
    monkeypatch.setattr(environment, 'make_room', lambda name, *_: made.append(name) or name)
    monkeypatch.setattr(environment, 'MAX_CACHED_POINTS', 2000)
    rooms = Rooms(['a', 'b', 'c'], 1000)
    assert [rooms[index] for index in (0, 1, 2, 0, 1, 2)] == ['a', 'b', 'c'] * 2
    assert made == ['a', 'b', 'c', 'c']


def test_neither_another_name_nor_more_scans_move_a_scan_to_another_set(tmp_path):
    config = scans_in(tmp_path, 40)
    before = {part: {Path(name).read_bytes() for name in names}
              for part, names in parts_of(config).items()}
    scans_in(tmp_path, 60)
    for number, path in enumerate(sorted(tmp_path.glob('*.npy'), reverse=True)):
        path.rename(tmp_path / f'a{number}.npy')
    after = parts_of(config)
    assert set.union(*after.values()) == paths_in(tmp_path)
    for part, names in after.items():
        assert before[part] < {Path(name).read_bytes() for name in names}


def test_the_same_scan_twice_is_one_room(tmp_path):
    config = scans_in(tmp_path, 5)
    (tmp_path / 'copy.npy').write_bytes((tmp_path / 'scan_2.npy').read_bytes())
    names = set.union(*parts_of(config).values())
    assert len(names) == len({Path(name).read_bytes() for name in names}) == 5


@pytest.mark.parametrize(('scans', 'copies'), [(2, 0), (1, 2)])
def test_scans_too_few_for_three_sets_are_refused(tmp_path, scans, copies):
    config = scans_in(tmp_path, scans)
    for number in range(copies):
        (tmp_path / f'{number}.npy').write_bytes((tmp_path / 'scan_0.npy').read_bytes())
    with pytest.raises((SceneError, ConfigurationError), match='expected at least'):
        for part in PARTS:
            room_names(config, part)


@pytest.mark.parametrize(('changes', 'key'), [
    ({'folder': 'scans'}, 'rooms.folder'), ({'source': 'folder'}, 'rooms.folder'),
    ({'up': 'y'}, 'rooms.up'), ({'scale': 0.001, 'source': 's3dis'}, 'rooms.scale'),
    ({'rotations': '0,many'}, 'rooms.rotations'), ({'rotations': ''}, 'rooms.rotations'),
    ({'source': 'moon'}, 'source')])
def test_sources_that_contradict_each_other_are_refused(changes, key):
    with pytest.raises(ConfigurationError, match=key):
        from_nested(RoomsConfig, changes)


def test_s3dis_is_refused_where_it_is_not(monkeypatch):
    monkeypatch.delenv('S3DIS_DIR', raising=False)
    with pytest.raises(SceneError, match='S3DIS_DIR'):
        room_names(RoomsConfig(source='s3dis'), 'training')


def box(width, depth):
    return box_sides(np.array([width, depth, 2.8]), np.array([width, depth, 2.8]) / 2.0, 0.2)


@pytest.fixture(scope='module')
def s3dis(tmp_path_factory):
    """Write a small copy of the data set's folders."""
    folder = tmp_path_factory.mktemp('s3dis')
    rooms = {'office_2': box(6.0, 7.0), 'office_10': box(6.5, 7.0), 'WC_1': box(3.0, 3.0),
             'openspace_1': box(14.0, 12.0), 'stairs_1': box(6.0, 6.0),
             'hallway_1': box(5.0, 9.0)[box(5.0, 9.0)[:, 2] < 2.5]}
    for area in (1, 6):
        for name, points in rooms.items():
            path = folder / f'Area_{area}' / name / f'{name}.txt'
            (path.parent / 'Annotations').mkdir(parents=True)
            np.savetxt(path, np.hstack([points, np.full((len(points), 3), 128.0)]), '%.3f')
            (path.parent / 'Annotations' / 'wall_1.txt').write_text('0 0 0 1 1 1\n')
    return folder


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv('OCP_ROS_CACHE', str(tmp_path / 'cache'))
    monkeypatch.setattr(scene_source, 'MIN_CACHED_BYTES', 0)


def stems(paths):
    return [path.stem for path in paths]


def test_rooms_are_listed_in_their_natural_order_and_chosen_by_rule(s3dis, empty_cache):
    assert stems(rooms_of_area(s3dis, 1)) == \
        ['WC_1', 'hallway_1', 'office_2', 'office_10', 'openspace_1', 'stairs_1']
    # Rooms to learn from are flat, of some size and closed; those to be judged by may be open.
    assert stems(chosen_rooms(s3dis, 1)) == ['office_10', 'office_2']
    assert stems(chosen_rooms(s3dis, 6)) == ['office_10', 'hallway_1', 'office_2']


def test_the_misspelt_room_is_found(s3dis, empty_cache, tmp_path):
    there = tmp_path / 'Area_6' / 'copyRoom_1'
    shutil.copytree(s3dis / 'Area_6' / 'office_2', there)
    (there / 'office_2.txt').rename(there / 'copy_Room_1.txt')
    assert stems(chosen_rooms(tmp_path, 6)) == ['copy_Room_1']
    assert load_scene(there / 'copy_Room_1.txt').name == 'Area_6_copyRoom_1'


def test_the_folder_is_named_by_the_environment(s3dis, empty_cache, monkeypatch):
    monkeypatch.delenv('S3DIS_DIR', raising=False)
    arguments = build_parser().parse_args(['benchmark', '--preset', 'full'])
    assert rooms_of_s3dis() == [] and protocol_of(arguments).rooms == PRESETS['full'].rooms
    monkeypatch.setenv('S3DIS_DIR', str(s3dis))
    rooms = protocol_of(arguments).rooms
    assert rooms[:10] == PRESETS['full'].rooms and len(rooms) == 13
    assert make_room(rooms[10], 60).name == 'Area_6_office_10@60'
    monkeypatch.setenv('S3DIS_DIR', str(s3dis / 'Area_6'))
    with pytest.raises(SceneError, match='S3DIS_DIR'):
        rooms_of_s3dis()


def test_what_was_read_once_is_not_read_again(s3dis, empty_cache, monkeypatch):
    path = s3dis / 'Area_6' / 'office_2' / 'office_2.txt'
    first = load_cached(path, max_points=1000)
    monkeypatch.setattr(scene_source, 'load_scene', None)
    again = load_cached(path, max_points=1000)
    np.testing.assert_array_equal(first.points, again.points)
    assert again.name == 'Area_6_office_2' and again.normals is None
    monkeypatch.setattr(scene_source, 'load_scene', load_scene)
    # Other options, another file, or a cache that broke off are read anew.
    assert len(load_cached(path, max_points=500)) < len(first)
    for kept in (cache_folder() / 'scans').iterdir():
        kept.write_bytes(kept.read_bytes()[:100])
    np.testing.assert_array_equal(load_cached(path, max_points=1000).points, first.points)


def test_normals_are_kept_and_a_cache_that_cannot_be_written_does_not_matter(
        tmp_path, empty_cache, monkeypatch):
    room, path = made_room(30, 3000), tmp_path / 'a.ply'
    write_ply(path, room.points, **dict(zip(('nx', 'ny', 'nz'), room.normals_or_estimate.T)))
    expected = load_scene(path)
    assert expected.normals is not None
    (tmp_path / 'file').write_text('')
    for cache in (tmp_path / 'file', tmp_path / 'cache', tmp_path / 'cache'):
        monkeypatch.setenv('OCP_ROS_CACHE', str(cache))
        scene = load_cached(path)
        np.testing.assert_array_equal(scene.points, expected.points)
        np.testing.assert_array_equal(scene.normals, expected.normals)
    with pytest.raises(SceneError, match='none.ply'):
        load_cached(tmp_path / 'none.ply')


@pytest.mark.parametrize(('options', 'exact'), [
    ({'max_points': 20_000}, True), ({'voxel_size': 0.05}, False)])
def test_a_mesh_from_the_cache_is_as_exact_as_the_one_read(tmp_path, empty_cache, options, exact):
    path = tmp_path / 'open.obj'
    # A floor and a wall enclose no air.
    path.write_text(''.join(f'v {x} {y} {z}\n' for z in (0.0, 2.5) for y in (0.0, 3.0)
                            for x in (0.0, 4.0)) + 'f 1 2 4 3\nf 1 2 6 5\n')
    first, again = (load_cached(path, up='z', **options).mesh for _ in range(2))
    assert first.exact == again.exact == exact
