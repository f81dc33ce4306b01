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

"""Files that lie about themselves: refused soon, in one sentence, and without much memory."""

from functools import partial
import os
import struct
import subprocess
import sys
import warnings

from benchmarks.drills import file_fuzz as files
from conftest import made_room, refusal, run_python
import numpy as np
from ocp_ros.rig.placement_file import load_placement
from ocp_ros.rig.rig_file import load_rig
from ocp_ros.ros.bags.bag_files import Bag
from ocp_ros.scenes.guarded_reading import read_guarded, READING_COSTS
from ocp_ros.scenes.scene_files import load_scene
from ocp_ros.training.run_folder import read_config
from ocp_ros.util.files import read_regular
import pytest

ROOM = made_room(3, 2500).points
#: How many spoilt files of a format are read here: of those that a process of its own reads only
#: one, since that takes long.
SPOILT = {**dict.fromkeys((
    'npy.npy', 'records.npy', 'pcd_ascii.pcd', 'pcd_binary.pcd', 'pcd_packed.pcd',
    'ply_ascii.ply', 'ply_binary.ply', 'txt.txt', 'xyz.xyz', 'rig.yaml', 'room.yaml',
    'placement.yaml', 'train.yaml'), 25), **dict.fromkeys((
        'las.las', 'laz.laz', 'e57.e57', 'mesh.ply', 'glb.glb', 'ros1.bag', 'mcap.mcap',
        'sqlite3.db3', 'metadata.yaml'), 1)}


@pytest.fixture
def laz(tmp_path):
    files.write_las(tmp_path / 'scan.laz', ROOM)
    return tmp_path / 'scan.laz'


def put(path, at, value):
    """Write a number of four bytes into a file."""
    with path.open('r+b') as file:
        file.seek(at)
        file.write(struct.pack('<I', value))


@pytest.mark.parametrize('at, value', [
    (107, 0xFFFFFFFF), (100, 0xFFFFFFFF), (96, 0xFFFFFFF0)])
def test_sizes_in_a_las_header_that_cannot_be_are_refused_before_anything_is_read(
        laz, monkeypatch, at, value):
    put(laz, at, value)
    monkeypatch.setattr(subprocess, 'Popen', lambda *_, **__: pytest.fail('a process was started'))
    assert 'cannot be read' in refusal(laz)


def test_a_laz_file_that_asks_for_all_memory_is_refused_and_nothing_ends(laz):
    content = laz.read_bytes()
    start, = struct.unpack_from('<I', content, 96)
    table, = struct.unpack_from('<q', content, start)
    # The number of chunks, 16 bytes of memory each.
    put(laz, table + 4, 0xFFFFFFFF)
    assert 'cannot be read' in refusal(laz)


def test_a_process_that_takes_too_much_is_stopped(laz, monkeypatch):
    assert read_guarded('las', laz, 4, len(ROOM)).shape == (len(ROOM), 4)
    for limits, rows in (({}, len(ROOM) // 2), ({'memory': 20_000_000}, len(ROOM)),
                         ({'seconds': 0}, len(ROOM))):
        with monkeypatch.context() as patch:
            patch.setitem(READING_COSTS, 'las', READING_COSTS['las']._replace(**limits))
            with pytest.raises(ValueError, match='too long' if 'seconds' in limits else '.'):
                read_guarded('las', laz, 4, rows)


def test_the_process_that_reads_imports_neither_learning_nor_ros(laz):
    ended = run_python(
        'import sys; from ocp_ros.scenes.guarded_reading import las_rows; '
        f'print(sum(map(len, las_rows({str(laz)!r})))); '
        "assert not {'torch', 'rclpy', 'numba', 'open3d'} & set(sys.modules)")
    assert ended.stdout.split() == [str(len(ROOM))], ended.stderr


def test_the_process_that_reads_imports_nothing_of_the_folder_around(laz, monkeypatch):
    (laz.parent / 'laspy.py').write_text('raise SystemExit(7)')
    monkeypatch.chdir(laz.parent)
    assert len(load_scene('scan.laz')) == len(ROOM)


@pytest.mark.parametrize(('name', 'header'), [
    ('scan.pcd', 'VERSION 0.7\nFIELDS x' + ' ' * 1_000_000), ('scan.pcd', '#\n' * 5000),
    ('scan.ply', 'ply\nformat ascii 1.0\n' + 'comment a\n' * 200_000),
    ('scan.ply', 'ply\nformat binary_little_endian 1.0\nelement a 4000000000\nend_header\n'),
    ('scan.ply', 'ply\nformat ascii 1.0\nelement vertex -1\nproperty float x\nend_header\n1\n')],
    ids=range(5))
def test_headers_that_lie_or_do_not_end_are_refused(tmp_path, name, header):
    (tmp_path / name).write_text(header)
    assert 'cannot be read' in refusal(tmp_path / name)


@pytest.mark.parametrize('target', [None, '/dev/zero'])
@pytest.mark.parametrize(('name', 'read'), [
    ('a.yaml', load_rig), ('a.yaml', load_placement), ('a.yaml', read_config),
    ('a.ply', load_scene), ('a.bag', Bag)])
def test_pipes_and_devices_are_refused(tmp_path, target, name, read):
    if target:
        (tmp_path / name).symlink_to(target)
    else:
        os.mkfifo(tmp_path / name)
    if read == Bag:
        pytest.importorskip('rosbags', reason='bags need rosbags (pip install rosbags)')
    refusal(tmp_path / name, read)


def test_a_packed_pcd_does_not_grow_beyond_what_it_says(tmp_path):
    path = tmp_path / 'scan.pcd'
    files.write_packed_pcd(path, ROOM)
    head, data, body = path.read_bytes().partition(b'DATA binary_compressed\n')
    # Copies of 264 bytes of the byte before: 23 MB, where 30 kB are said to be.
    bomb = b'\x00a' + b'\xe0\xff\x00' * 90_000
    path.write_bytes(head + data + struct.pack('<II', len(bomb), 12 * len(ROOM)) + bomb)
    message = refusal(path)
    assert f'of {12 * len(ROOM):,} bytes' in message
    assert int(message.partition('(')[2].split()[0].replace(',', '')) < 12 * len(ROOM) + 300
    path.write_bytes(head + data + struct.pack('<II', len(body) - 8, 0xFFFFFFFF) + body[8:])
    assert 'cannot be read' in refusal(path)


@pytest.mark.parametrize('ends', [b'\r\n', b'\r'])
def test_ply_headers_may_end_their_lines_as_other_systems_do(tmp_path, ends):
    path = tmp_path / 'scan.ply'
    files.write_ply(path, ROOM)
    header, end, body = path.read_bytes().partition(b'end_header\n')
    path.write_bytes((header + end).replace(b'\n', ends) + body)
    np.testing.assert_array_equal(load_scene(path).points, ROOM)


@pytest.fixture(scope='module')
def good(tmp_path_factory):
    folder = tmp_path_factory.mktemp('good')
    return folder, files.good_files(folder)


def test_metadata_of_a_bag_may_not_grow(good, tmp_path):
    folder, readers = good
    if 'metadata.yaml' not in readers:
        pytest.skip('bags need rosbags (pip install rosbags)')
    text = (folder / 'metadata.yaml').read_text()
    path = tmp_path / 'metadata.yaml'
    path.write_text(text.replace('custom_data: null', "custom_data: {note: a *star, '*b': 1}"))
    readers['metadata.yaml'](path)
    grown = ''.join(f'\n  x{k}: &a{k} [*a{k - 1}, *a{k - 1}]' for k in range(1, 40))
    path.write_text(text.replace("compression_format: ''", f'x0: &a0 [1]{grown}\n  '
                                 'compression_format: *a39').replace(
        "compression_mode: ''", 'compression_mode: file'))
    assert 'alias' in refusal(path, readers['metadata.yaml'])


def test_a_file_of_unknown_size_is_read_up_to_a_limit():
    # Files in /proc say that they have no bytes.
    assert read_regular('/proc/self/status', 100_000).startswith(b'Name:')
    with pytest.raises(OSError, match='11 bytes'):
        read_regular('/proc/self/status', 10)


@pytest.mark.parametrize(('text', 'found'), [
    ('a: &a [1]\nb: [*a, *a]\n', 'alias'), ('seed: ' + '[' * 3000, 'lists in lists'),
    ('seed: 2024-13-45\n', 'seed'), ('seed: ' + '9' * 6000 + '\n', 'seed'),
    (f'? {"s" * 6000}\n: 1', 'unknown name'), ('seed: !!python/name:os.system\n', 'tag'),
    ('seed: 1\nseed: 2\n', 'twice'), ('#' * 2_000_000, '2,000,000 bytes')])
def test_settings_of_a_training_that_are_no_plain_data_are_refused(tmp_path, text, found):
    (tmp_path / 'train.yaml').write_text(text)
    assert found in refusal(tmp_path / 'train.yaml', read_config)


@pytest.mark.parametrize('name', SPOILT)
def test_spoilt_files_are_read_or_refused_in_one_sentence(tmp_path, good, name):
    folder, readers = good
    if name not in readers:
        pytest.skip('bags need rosbags (pip install rosbags)')
    assert SPOILT[name] == 1 or files.read_one(readers[name], folder / name) == ('read', '')
    path, content = tmp_path / f'spoilt_{name}', (folder / name).read_bytes()
    for number in range(SPOILT[name]):
        path.write_bytes(files.spoilt(np.random.default_rng([1, number]), content))
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            # Few points: what counts is the reader.
            read = partial(load_scene, max_points=2000) if readers[name] is load_scene else None
            outcome, said = files.read_one(read or readers[name], path)
        assert outcome in ('read', 'refused'), f'{number}: {said}'


@pytest.mark.system
def test_many_spoilt_files_harm_no_process(tmp_path, monkeypatch):
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join(sys.path))
    assert files.main(['--mutations', '100', '--jobs', '2', '--out', str(tmp_path)]) == 0
    assert (tmp_path / 'file_fuzz.json').exists()
