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

"""No file reads another one, calls out, runs code or takes the machine; nor does a folder."""

import json
import os
from pathlib import Path
import socket
import stat
import sys

from benchmarks.drills.file_fuzz import read_one
from benchmarks.drills.hostile_files import hostile_files, Listener, outcome_of, SECRET
from conftest import box_room, made_room, run_python
import numpy as np
from ocp_ros.report.rig_planning import PlannedRig, PlanTask
from ocp_ros.rig.rig_file import load_rig, rig_of
from ocp_ros.rooms import scene_source
from ocp_ros.rooms.scene_source import load_cached
from ocp_ros.ros.bags.bag_files import Bag
from ocp_ros.scenes.scene_files import load_scene, save_scene
from ocp_ros.search import rig_search
from ocp_ros.search.budget import Budget
from ocp_ros.util.files import file_set, sha256_of_file, write_atomically
from ocp_ros.util.settings import ConfigurationError
import pytest

#: What takes long to be refused, or has a reader that is slow to start.
SLOW = ('glTF', 'OBJ')
SLOW_BAGS = ('bag_message_bomb', 'bag_file_bomb', 'bag_chunk_bomb')


@pytest.fixture(scope='module')
def listener():
    made = Listener()
    yield made
    made.close()


@pytest.fixture(scope='module')
def hostile(listener, tmp_path_factory):
    return hostile_files(tmp_path_factory.mktemp('hostile'), listener.port)


def test_no_file_reads_another_or_calls_out(hostile, listener):
    outcomes = {}
    for one in hostile:
        if one.kind not in SLOW and one.path.name not in SLOW_BAGS:
            outcome, said = read_one(one.read, one.path)
            assert outcome in ('read', 'refused') and SECRET not in said, (one.path.name, said)
            outcomes.setdefault(one.kind, set()).add(outcome)
    assert outcomes['E57'] == outcomes['bag'] == outcomes['text'] == {'refused'}
    assert not listener.calls


@pytest.mark.system
def test_no_file_of_any_kind_does_harm(hostile, listener):
    assert len(hostile) > 30
    for one in hostile:
        assert outcome_of(one, listener) in ('read', 'refused'), one.path


CONFINED = """
import os, signal, socket, sys
from ocp_ros.util.guarded_process import confine, limit
limit(1 << 30, 10, 1000)
handle = os.pidfd_open(os.getppid())
confine([sys.argv[1]], sys.argv[3])
assert open(sys.argv[1]).read() == 'mine'
open(sys.argv[3] + '/made', 'w').write('new')
for deed in (lambda: open(sys.argv[2]), lambda: os.listdir('/'), lambda: open('/etc/passwd'),
             lambda: socket.socket(), lambda: os.execv(sys.executable, ['python']),
             lambda: os.symlink('a', 'b'), lambda: open(sys.argv[1], 'w'),
             lambda: os.kill(os.getppid(), 0), lambda: os.chmod(sys.argv[2], 0o777),
             lambda: os.utime(sys.argv[2]), lambda: signal.pidfd_send_signal(handle, 0)):
    try:
        deed()
    except OSError:
        continue
    sys.exit('it could')
"""


def test_a_process_that_reads_has_its_file_and_nothing_else(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'mine').write_text('mine')
    (tmp_path / 'other').write_text('secret')
    (tmp_path / 'folder').mkdir()
    known = Path('/sys/kernel/security/lsm')
    if known.exists() and 'landlock' not in known.read_text():
        pytest.skip('this kernel has no Landlock')
    ended = run_python(CONFINED, *(tmp_path / name for name in ('mine', 'other', 'folder')))
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / 'folder' / 'made').read_text() == 'new'


SCORED = """
import sys
from ocp_ros.cli.main import main
from ocp_ros.util.kernels import njit
assert hasattr(njit(lambda x: x), 'py_func'), 'kernels are not compiled'
sys.exit(main(['score', 'room.ply', 'p.yaml', '--out', 'made']))
"""


def test_a_folder_with_a_scan_says_nothing_to_libraries(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_scene(made_room(8, 1500), tmp_path / 'room.ply')
    (tmp_path / 'p.yaml').write_text(
        'cameras: [{sensor: realsense_d455, position: [2, 2, 1.9], yaw: 45, pitch: 25}]')
    (tmp_path / 'planted').mkdir()
    (tmp_path / '.numba_config.yaml').write_text(
        'cache_dir: planted\nDISABLE_JIT: 1\nCACHE_LOCATOR_CLASSES: harm.Locator\n')
    (tmp_path / 'harm.py').write_text('raise SystemExit(7)')
    # A process that opens this pipe waits for ever.
    os.mkfifo(tmp_path / 'matplotlibrc')
    (tmp_path / 'DEFAULT_FASTRTPS_PROFILES.xml').write_text('no profile')
    ended = run_python(SCORED)
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / 'made' / 'report.png').exists()
    assert not list((tmp_path / 'planted').iterdir())


def test_a_node_takes_no_profile_from_the_current_folder(domain, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'DEFAULT_FASTRTPS_PROFILES.xml').write_text('no profile at all')
    ended = run_python(
        'from ocp_ros.ros.runtime.node_main import stay_local; stay_local(); import rclpy; '
        "rclpy.init(); rclpy.create_node('a')", ROS_DOMAIN_ID=str(domain))
    assert ended.returncode == 0 and 'XML' not in ended.stderr + ended.stdout


NAMES = ('a', 'b', 'c', 'mark')
OLD, NEW = dict.fromkeys(('a', 'b', 'mark'), 'old'), dict.fromkeys(('a', 'c', 'mark'), 'new')


def write_set(folder, text, names):
    """Write a set of files with the same text."""
    with file_set(folder, NAMES, 'mark') as unfinished:
        for name in names:
            write_atomically(unfinished / name, text)


def recover(folder):
    """Begin another set of files, and write none."""
    write_set(folder, '', ())


def killed_at(moment, folder):
    """Write a second set of files in a process that ends at some change; return whether it did."""
    child = os.fork()
    if child == 0:
        moments = iter(range(1, moment))

        def watch(event, _):
            # The event of os.replace has the first name too.
            if event in ('os.rename', 'os.remove', 'os.rmdir') and next(moments, None) is None:
                os._exit(9)

        sys.addaudithook(watch)
        write_set(folder, 'new', NEW)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9


def test_a_kill_leaves_one_set_of_files_or_the_other(tmp_path):
    found = set()
    for moment in range(1, 40):
        folder = tmp_path / str(moment)
        folder.mkdir()
        (folder / 'mine').write_text('stays')
        write_set(folder, 'old', OLD)
        killed = killed_at(moment, folder)
        recover(folder)
        texts = {path.name: path.read_text() for path in folder.iterdir()}
        assert texts.pop('mine') == 'stays' and texts in (OLD, NEW)
        found.add((killed, texts['mark']))
        if not killed:
            break
    assert found == {(True, 'old'), (True, 'new'), (False, 'new')}


@pytest.mark.parametrize('plant', ['pipe', 'file', 'link', 'folder'])
def test_what_somebody_has_left_in_a_folder_of_results_does_no_harm(tmp_path, plant):
    folder = tmp_path / 'folder'
    folder.mkdir()
    write_set(folder, 'old', OLD)
    complete = folder / '.ocp_complete'
    if plant == 'pipe':
        os.mkfifo(complete)
        os.mkfifo(folder / '.ocp_unfinished')
    elif plant == 'file':
        complete.write_text('')
    elif plant == 'link':
        complete.symlink_to(tmp_path)
    else:
        complete.mkdir()
        (complete / 'mine').write_text('')
    (tmp_path / 'mark').write_text('stays')
    recover(folder)
    assert {name: (folder / name).read_text() for name in OLD} == OLD
    write_set(folder, 'new', ('c', 'mark'))
    assert not complete.exists() and (folder / 'c').read_text() == 'new'
    assert not (folder / 'a').exists() and (tmp_path / 'mark').read_text() == 'stays'


def test_files_are_as_open_as_the_user_says_and_copies_of_scans_are_private(
        tmp_path, monkeypatch):
    def mode(path):
        return stat.S_IMODE(path.stat().st_mode)

    for umask, expected in ((0o077, 0o600), (0o022, 0o644), (0o002, 0o664)):
        before = os.umask(umask)
        try:
            write_atomically(tmp_path / 'a', 'x')
        finally:
            os.umask(before)
        assert mode(tmp_path / 'a') == expected
    monkeypatch.setenv('OCP_ROS_CACHE', str(tmp_path / 'cache'))
    monkeypatch.setattr(scene_source, 'MIN_CACHED_BYTES', 0)
    save_scene(made_room(8, 1500), tmp_path / 'room.ply')
    load_cached(tmp_path / 'room.ply')
    kept, = (tmp_path / 'cache' / 'scans').iterdir()
    assert (mode(kept), mode(kept.parent), mode(kept.parent.parent)) == (0o600, 0o700, 0o700)


def test_a_pipe_has_no_checksum(tmp_path):
    os.mkfifo(tmp_path / 'pipe')
    with pytest.raises(OSError, match='not a regular file'):
        sha256_of_file(tmp_path / 'pipe')


@pytest.mark.parametrize(('nearest', 'farthest', 'width', 'height'), [
    (30, 40, 90, 60), (30, 40, 360, 180), (0, 0.06, 90, 60)])
def test_a_camera_that_sees_nothing_is_refused_before_the_search(
        tmp_path, nearest, farthest, width, height):
    blind = {'name': 'blind', 'min_range': nearest, 'max_range': farthest,
             'horizontal_fov': width, 'vertical_fov': height}
    (tmp_path / 'rig.json').write_text(json.dumps({
        'cameras': [{'sensor': 'realsense_d455'}, blind], 'keep_clear': 0.1,
        'mount': {'on': 'walls', 'height': 2.0}}))
    with pytest.raises(ConfigurationError, match=f'blind.* {farthest:g} m'):
        PlannedRig(made_room(8, 1500), load_rig(tmp_path / 'rig.json'),
                   PlanTask(evaluations=20), Budget(None, 20))


def test_a_proof_that_fails_does_not_lose_the_plan(monkeypatch):
    def fail(*_):
        raise ZeroDivisionError('by zero')

    monkeypatch.setattr(rig_search, 'Certificate', fail)
    planned = PlannedRig(made_room(8, 1500), rig_of(2, 'd455', mount={'on': 'walls'}),
                         PlanTask(evaluations=20), Budget(None, 20), 1.0)
    assert len(planned.best.answer.poses) == 2 and planned.best.certificate is None
    assert 'by zero' in planned.best.uncertain


AXES, INDICES = ('float x', 'float y', 'float z'), 'list uchar int i'


def ply_of(form, *elements):
    """Return a PLY file of elements: name, rows, body, properties."""
    head, bodies = f'ply\nformat {form} 1.0\n', b''
    for name, rows, body, *properties in elements:
        head += f'element {name} {rows}\n' + ''.join(f'property {one}\n' for one in properties)
        bodies += body
    return f'{head}end_header\n'.encode() + bodies


def test_lists_of_a_ply_file_are_skipped_or_read_with_care(tmp_path):
    points = box_room(4.0, 3.0).points.astype('<f4')
    text = '\n'.join(' '.join(map(repr, map(float, point))) for point in points).encode() + b'\n'
    vertices, words = (('vertex', len(points), body, *AXES) for body in (points.tobytes(), text))
    rows = np.zeros(len(points), dtype=[('xyz', '<f4', 3), ('n', 'u1'), ('i', '<i4', 2)])
    rows['xyz'], rows['n'] = points, 2
    path = tmp_path / 'lists.ply'
    for form, *elements in (
            # What is after the vertices is not even looked at.
            ('binary_little_endian', vertices, ('strip', 3, b'\xff\xff\xff', INDICES)),
            ('binary_little_endian',
             ('strip', 3, b'\1\0\0\0\7\0\1\0\0\0\7', INDICES), vertices),
            ('binary_little_endian', ('vertex', len(points), rows.tobytes(), *AXES, INDICES)),
            ('ascii', ('strip', 1, b'2 1 2\n', INDICES), words),
            ('ascii', words, ('strip', 1, b'2 a b\n', INDICES))):
        path.write_bytes(ply_of(form, *elements))
        np.testing.assert_array_equal(load_scene(path).points, points)


def test_a_bag_that_is_left_half_read_is_read_again(tmp_path):
    pytest.importorskip('rosbags', reason='bags need rosbags (pip install rosbags)')
    from benchmarks.drills.file_fuzz import good_files
    good_files(tmp_path)
    (tmp_path / 's' / 's.db3').write_bytes((tmp_path / 'sqlite3.db3').read_bytes())
    with Bag(tmp_path / 's') as bag:
        assert next(iter(bag.messages(['/poses']))).topic == '/poses'
        assert len(list(bag.messages(['/poses']))) == 20
        assert bag.frames(bag.topics[0]) == ['map']


def test_the_listener_listens(listener):
    """The tests above would notice a call."""
    with socket.create_connection(('127.0.0.1', listener.port)):
        while not listener.calls:
            pass
    listener.calls = 0
