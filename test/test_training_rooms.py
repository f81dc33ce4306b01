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

"""The rooms of a run: three sets that never share one, whatever they come from."""

from pathlib import Path

from benchmarks.room_sets import SEEDS
import numpy as np
from ocp_ros.compare.protocol import rooms_in
from ocp_ros.rooms.generator import generate_room
from ocp_ros.rooms.scene_source import make_room
from ocp_ros.rooms.splits import FRESH, TEST, TRAINING, VALIDATION
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.scenes.scene_files import save_scene
from ocp_ros.training import training_rooms
from ocp_ros.training.train import trials_of
from ocp_ros.training.training_config import RoomsConfig, TrainingConfig
from ocp_ros.training.training_rooms import PARTS, room_names, Rooms
from ocp_ros.training.validation import _prepared
from ocp_ros.util.settings import ConfigurationError, from_nested
import pytest

SETS = {'training': TRAINING, 'validation': VALIDATION, 'test': TEST, 'fresh': FRESH}


@pytest.mark.parametrize('name', SEEDS)
def test_a_set_is_as_large_as_it_says_and_in_its_own_range(name):
    first, count = SEEDS[name]
    seeds = SETS[name]
    assert len(seeds) == count and list(seeds) == sorted(set(seeds))
    # No other set begins between the first seed of this one and its last.
    assert min(seeds) >= first
    assert not any(first < other <= max(seeds) for other, _ in SEEDS.values())


def test_no_room_is_in_two_sets():
    everything = [seed for seeds in SETS.values() for seed in seeds]
    assert SETS.keys() == SEEDS.keys() and len(everything) == len(set(everything))


def test_generated_rooms_are_those_of_the_frozen_sets():
    config = RoomsConfig(training=5, validation=12, test=100)
    assert room_names(config, 'training') == [str(seed) for seed in TRAINING[:5]]
    assert room_names(config, 'validation') == [str(seed) for seed in VALIDATION[:12]]
    assert room_names(config, 'test') == [str(seed) for seed in TEST]
    scene = make_room(room_names(config, 'test')[0], 30.0, 2000)
    assert scene.name == f'room-{TEST[0]}@30'
    np.testing.assert_array_equal(scene.points, make_room(str(TEST[0]), 30.0, 2000).points)


def scans_in(folder, count):
    """Write so many scans, each of other content."""
    folder.mkdir(exist_ok=True)
    for number in range(count):
        points = np.random.default_rng(number).uniform(0.0, 4.0, (200, 3))
        np.save(folder / f'scan_{number}.npy', points.astype(np.float32))
    (folder / 'notes.md').write_text('no scan')
    return RoomsConfig(source='folder', folder=str(folder), training=1000, validation=1000,
                       test=1000)


def parts_of(config):
    """Return the names of the scans of each set."""
    return {part: set(room_names(config, part)) for part in PARTS}


def in_one_set_each(parts, folder):
    """Assert that each scan of a folder is in one set, and that no set is empty."""
    assert all(parts.values())
    names = [name for part in parts.values() for name in part]
    assert sorted(names) == sorted(str(path.resolve()) for path in folder.glob('*.npy'))


@pytest.mark.parametrize('count', [3, 4, 7, 60])
def test_the_scans_of_a_folder_are_in_one_set_each(tmp_path, count):
    config = scans_in(tmp_path, count)
    parts = parts_of(config)
    in_one_set_each(parts, tmp_path)
    assert len(parts['training']) == max(map(len, parts.values()))


def test_meshes_beside_their_rooms_are_no_scans(tmp_path):
    for seed in (8, 9, 10):
        save_scene(generate_room(seed, 1500), tmp_path / f'room-{seed}.ply')
    (tmp_path / '.draft.ply').write_text('')
    save_scene(Scene(generate_room(11, 1500).points, 'attic'), tmp_path / 'attic_mesh.ply')
    assert len(list(tmp_path.glob('*_mesh.ply'))) == 4
    config = RoomsConfig(source='folder', folder=str(tmp_path))
    names = sorted(Path(name).name for part in PARTS for name in room_names(config, part))
    assert names == ['attic_mesh.ply', 'room-10.ply', 'room-8.ply', 'room-9.ply']
    assert sorted(Path(name).name for name in rooms_in(tmp_path)) == names


def test_scans_in_other_units_are_read_alike_by_all_who_play_in_them(tmp_path):
    expected = generate_room(8, 1500)
    for number in range(3):
        # Millimetres, y up.
        points = 1000.0 * expected.points[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
        np.save(tmp_path / f'scan_{number}.npy', points + number)
    config = TrainingConfig(rooms=RoomsConfig(
        source='folder', folder=str(tmp_path), scale=0.001, up='y', rotations='0'))
    (name,) = room_names(config.rooms, 'training')
    (trial,) = trials_of(config, 'validation')
    scene = _prepared(
        trial.rooms, trial.room, trial.rotation, trial.simulation).simulator.scene
    for points in (Rooms([name], config.rooms)[0].points, scene.points):
        np.testing.assert_allclose(np.ptp(points, axis=0), expected.size, atol=1e-3)


def test_rooms_are_made_once_and_kept_while_there_is_memory(monkeypatch):
    made = []
    monkeypatch.setattr(training_rooms, 'make', lambda config, name: made.append(name) or name)
    monkeypatch.setattr(training_rooms, 'MAX_CACHED_POINTS', 2000)
    rooms = Rooms(['a', 'b', 'c'], RoomsConfig(points=1000))
    assert [rooms[index] for index in (0, 1, 2, 0, 1, 2)] == ['a', 'b', 'c'] * 2
    assert made == ['a', 'b', 'c', 'c']


def test_another_name_moves_no_scan_to_another_set(tmp_path):
    config = scans_in(tmp_path, 40)
    before = {part: {name: Path(name).read_bytes() for name in names}
              for part, names in parts_of(config).items()}
    for number, path in enumerate(sorted(tmp_path.glob('*.npy'), reverse=True)):
        path.rename(tmp_path / f'a{number}.npy')
    after = parts_of(config)
    in_one_set_each(after, tmp_path)
    for part, names in after.items():
        assert {Path(name).read_bytes() for name in names} == set(before[part].values())


def test_more_scans_move_none_to_another_set(tmp_path):
    before = parts_of(scans_in(tmp_path, 40))
    after = parts_of(scans_in(tmp_path, 60))
    in_one_set_each(after, tmp_path)
    for part, names in before.items():
        assert names < after[part]


def test_the_same_scan_twice_is_one_room(tmp_path):
    config = scans_in(tmp_path, 5)
    (tmp_path / 'copy.npy').write_bytes((tmp_path / 'scan_2.npy').read_bytes())
    parts = parts_of(config)
    names = [name for part in parts.values() for name in part]
    assert all(parts.values()) and len(names) == len(set(names)) == 5
    assert len({Path(name).read_bytes() for name in names}) == 5


def test_too_few_scans_are_refused(tmp_path):
    config = scans_in(tmp_path, 2)
    with pytest.raises(SceneError, match='found 2 scans; expected at least 3, one for each set'):
        room_names(config, 'training')


def test_three_copies_of_one_scan_are_refused(tmp_path):
    config = scans_in(tmp_path, 1)
    for number in (1, 2):
        (tmp_path / f'{number}.npy').write_bytes((tmp_path / 'scan_0.npy').read_bytes())
    with pytest.raises((SceneError, ConfigurationError), match='expected at least'):
        for part in PARTS:
            room_names(config, part)


def test_s3dis_is_refused_where_it_is_not(monkeypatch):
    monkeypatch.delenv('S3DIS_DIR', raising=False)
    with pytest.raises(SceneError, match='found s3dis but no S3DIS_DIR; expected .*; set'):
        room_names(RoomsConfig(source='s3dis'), 'training')


@pytest.mark.parametrize(('changes', 'words'), [
    ({'folder': 'scans'}, "rooms.folder: found 'scans' with rooms.source 'generated'"),
    ({'source': 'folder'}, "rooms.folder: found '' with rooms.source 'folder'"),
    ({'up': 'y'}, "rooms.scale and rooms.up: found 0 and 'y' with rooms.source 'generated'"),
    ({'scale': 0.001, 'source': 's3dis'}, "found 0.001 and 'file' with rooms.source 's3dis'"),
    ({'rotations': '0,many'}, "rooms.rotations: found '0,many'; expected degrees"),
    ({'rotations': ''}, "rooms.rotations: found ''")])
def test_sources_that_contradict_each_other_are_refused(changes, words):
    with pytest.raises(ConfigurationError, match=words):
        RoomsConfig(**changes)


def test_a_source_that_does_not_exist_is_refused():
    with pytest.raises(ConfigurationError, match="source: found 'moon'; expected one of"):
        from_nested(RoomsConfig, {'source': 'moon'})
