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

"""What all commands of ocp have in common: JSON, exit codes, whole files, names only shown."""

from contextlib import contextmanager
from html.parser import HTMLParser
import io
import json
import os
import resource
import shlex
import signal
import sys

from conftest import for_any, made_room, refused, run_python
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from matplotlib.figure import Figure
import numpy as np
from ocp_ros.cli import main as cli
from ocp_ros.cli.common import json_text
from ocp_ros.compare.comparison import task_file_stem
from ocp_ros.compare.protocol import BenchmarkTask
from ocp_ros.report.drawing.saved_pictures import save_figure
from ocp_ros.report.viewer import write_view
from ocp_ros.scenes.scene_files import load_scene, save_scene
from ocp_ros.training.run_folder import add_record, claim
from ocp_ros.training.sac import make_sac
from ocp_ros.training.sac_state import save_replay
from ocp_ros.training.training_config import SacConfig, TrainingConfig
from ocp_ros.util.settings import ConfigurationError
from plyfile import PlyData, PlyElement
import pytest

PLACEMENT = """\
# Where I hung them.
cameras:
  - {sensor: realsense_d455, position: [2.0, 2.0, 1.9], yaw: 45, pitch: 25}
"""
#: A name that would be obeyed where it is not only shown.
HOSTILE = 'a\x1b[31m\n# b <img src=x onerror=alert(1)>|`$x$[l](javascript:1)_c_\u202e'
SCORE = 'score room.ply placement.yaml --out'
TRAIN = 'train --config config.yaml --out'


@pytest.fixture
def files(room_folder, undrawn):
    """Write a placement, settings and a scan with holes beside the room."""
    for name, text in (('placement.yaml', PLACEMENT), ('train.yaml', 'nonsense: 1\n'),
                       ('config.yaml', 'interactions: 24  # few\n')):
        (room_folder / name).write_text(text)
    points = made_room(8, 1500).points.copy()
    points[::7] = np.nan
    rows = np.rec.fromarrays(points.T, dtype=[(axis, 'f4') for axis in 'xyz'])
    PlyData([PlyElement.describe(rows, 'vertex')]).write(str(room_folder / 'holes.ply'))
    return room_folder


def help_of(capsys, *command):
    """Return the help of a command, or that of all of them."""
    with pytest.raises(SystemExit, match='0'):
        cli.main([*command, '--help'])
    return capsys.readouterr().out


@pytest.mark.parametrize('example', cli.build_commands().examples)
def test_every_example_can_be_read_and_stands_in_the_help_of_its_command(example, capsys):
    program, name, *words = shlex.split(example)
    assert program == 'ocp'
    cli.build_parser().parse_args([name, *words])
    text = help_of(capsys, name)
    assert example in text and '--json' in text
    lines = [line.split() for line in help_of(capsys).splitlines() if line.startswith('  ')]
    assert [first for first, *_ in lines].count(name) == 1


@pytest.mark.parametrize(('command', 'keys'), [
    ('score room.ply placement.yaml',
     'room cameras scores broken missed one_more expected notes remarks bill'),
    ('view holes.ply --drop-nonfinite', 'room written'),
    ('room 6 4 3 --out made.yaml', 'written size openings boxes'),
    ('rooms 3 4', 'rooms written'), ('rooms 8 --points 1000 --out made', 'rooms written')])
def test_json_is_all_that_a_command_prints(files, capsys, command, keys):
    assert cli.main([*command.split(), '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found) == set(keys.split())
    for path in found.get('written', ()):
        assert (files / path).is_file()


@pytest.mark.parametrize(('arguments', 'words'), [
    ('score none.ply placement.yaml', 'none.ply'), ('score room.ply', 'PLACEMENT'),
    (f'score {"7" * 5000} placement.yaml', '777...'), ('rooms 99999999999', '99999999999'),
    ('view room.ply --op', '--op'), ('plan 8 --target 0.5', '--target'),
    ('plan 8 --cameras 2 --by seen', '--by'), ('view room.ply --out .', '--out'),
    ('view room.ply --out /proc/a.html', '--out'),
    ('info 8 --out room.ply/a.png', '--out'), ('rooms 8 --out /proc/rooms', '--out'),
    (f'{SCORE} /proc/a', '--out'), (f'{TRAIN} room.ply', '--out'),
    (f'{TRAIN} o --model /proc/a', '--model'), ('benchmark --out /proc/a', '--out'),
    ('benchmark --rooms room.ply none.ply', 'none.ply'),
    ('view room.ply --rig rig.yaml', 'placement'),
    ('train --config train.yaml --out out', 'nonsense'), ('benchmark --seeds 0', '--seeds'),
    ('train --config train.yaml --out out --seed 202611212346', '--seed'),
    ('score holes.ply placement.yaml', '--drop-nonfinite'), ('info room.ply --scale mm', "'mm'"),
    ('score 8 placement.yaml --drop-nonfinite', '--drop-nonfinite'),
    ('score room.ply placement.yaml --export usd', '--export'),
    ('calibrate room.ply placement.yaml --clouds a.ply --export pdf', '--export'),
    # Frames of ROS have names that begin with a letter.
    ('score 7 placement.yaml --frame-prefix 1st_', "'1st_'"),
    ('score 7 placement.yaml --frame-prefix ../x', "'../x'"),
    ('paint', 'paint'), ('', 'COMMAND')])
def test_errors_are_json_where_it_is_asked_for(files, capsys, arguments, words):
    assert cli.main([*arguments.split(), '--json']) == 2
    found = json.loads(capsys.readouterr().out)
    assert set(found) == {'error'} and words in found['error']


@pytest.mark.parametrize(('module', 'heavy'), [
    ('ocp_ros.cli.main', 'torch numba scipy numpy matplotlib gymnasium rich yaml'),
    ('ocp_ros.cli.plan_command', 'ocp_ros.compare benchmarks matplotlib plotly open3d torch')])
def test_what_is_slow_to_import_is_imported_when_it_is_needed(module, heavy):
    done = run_python(f'import sys, {module}, ocp_ros.cli.main as cli; cli.build_commands(); '
                      'print(*sys.modules)')
    assert module in done.stdout and not set(heavy.split()) & set(done.stdout.split())


def test_a_page_needs_no_placement_and_no_network_and_is_opened_where_that_is_wanted(
        files, capsys, monkeypatch):
    opened = []
    monkeypatch.setattr('webbrowser.open', opened.append)
    assert cli.main(['view', 'room.ply', 'placement.yaml', '--out', 'new/page.html']) == 0
    assert opened == []
    assert cli.main(['view', '8', '--out', 'bare.html', '--open']) == 0
    assert opened == [(files / 'bare.html').resolve().as_uri()]
    assert 'bare.html' in capsys.readouterr().err
    page = (files / 'new' / 'page.html').read_text()
    bare = (files / 'bare.html').read_text().split('<aside>')[1].split('<script>')[0]
    assert 'depth error' in page.split('<aside>')[1] and 'depth error' not in bare
    assert '<script src=' not in page and '<link' not in page


values = st.recursive(st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
                      lambda parts: st.lists(parts) | st.dictionaries(st.text(), parts))


@for_any(examples=25, value=values)
def test_a_document_is_json_whatever_was_found(value):
    def refuse(word):
        raise AssertionError(word)
    found = json.loads(json_text({'value': value, 'array': np.array([1.0, np.nan])}),
                       parse_constant=refuse)
    assert found['array'] == [1.0, None] and set(found) == {'value', 'array'}


#: A signal at the moment at which a module is imported.
IMPORTING = """
import os, signal, sys
class Finder:
    def find_spec(self, name, *_):
        if name == module:
            os.kill(os.getpid(), number)
module, number = sys.argv.pop(1), int(sys.argv.pop(1))
sys.meta_path.insert(0, Finder())
from ocp_ros.cli.start import main
sys.exit(main())
"""


@pytest.mark.parametrize(('module', 'number'), [
    ('ocp_ros.cli.common', signal.SIGTERM), ('ocp_ros.cli.plan_command', signal.SIGINT),
    ('numba', signal.SIGINT), ('ocp_ros.search.rig_plan', signal.SIGINT),
    ('ocp_ros.search.rig_plan', signal.SIGTERM)])
def test_an_early_signal_ends_a_command_without_a_traceback(
        tmp_path, monkeypatch, module, number):
    monkeypatch.chdir(tmp_path)
    ended = run_python(IMPORTING, module, str(int(number)), 'plan', '8', '--evaluations', '5')
    assert (ended.returncode, ended.stderr) == (130, '')


def contents(folder):
    """Return what is in all files of a folder."""
    return {path: path.read_bytes() for path in folder.rglob('*') if path.is_file()}


@pytest.mark.parametrize(('taken', 'command', 'words'), [
    ('placement.yaml', f'{SCORE} . --overwrite', 'placement.yaml'),
    ('room.ply', 'view room.ply --out room.ply --overwrite', 'room.ply'),
    ('out/rig.yaml', 'view room.ply placement.yaml --rig out/rig.yaml --out out/rig.yaml',
     'rig.yaml'),
    ('room.ply', 'info room.ply --out room.ply', 'room.ply'),
    ('new/installer.md', f'{SCORE} new', 'new/installer.md, and no placement.json'),
    ('new/placement.yaml', 'plan room.ply --out new', 'no placement.json'),
    ('new/placement.yaml', 'calibrate room.ply placement.yaml --clouds room.ply --out new',
     'no calibration.json'),
    ('new/results.csv', 'benchmark --out new', 'no protocol.json'),
    ('page.html', 'view room.ply --out page.html', 'page.html'),
    ('a.png', 'info 8 --out a.png', 'a.png'),
    ('room-8_mesh.ply', 'rooms 8 --out .', 'room-8_mesh.ply'),
    ('room.json', f'{TRAIN} run --model room.safetensors', '--model: found room.json'),
    ('run/best.safetensors', f'{TRAIN} run', 'found best.safetensors'),
    ('rooms.json', f'{TRAIN} .', 'rooms.json')])
def test_what_somebody_wrote_is_not_replaced(files, capsys, monkeypatch, taken, command, words):
    path = files / taken
    path.parent.mkdir(exist_ok=True)
    if not path.exists():
        path.write_text('mine')
    before = contents(files)
    # Refused before any work is done.
    monkeypatch.setattr('ocp_ros.rooms.scene_source.load_cached', None)
    monkeypatch.setattr('ocp_ros.rooms.scene_source.generate_room', None)
    assert words in refused(capsys, *command.split())
    assert {path: content for path, content in contents(files).items() if path in before} == before


def test_other_files_are_replaced_where_that_is_asked_for_and_own_files_always(files):
    new = files / 'new'
    new.mkdir()
    for name in ('installer.md', 'notes.md'):
        (new / name).write_text('mine')
    assert cli.main(f'{SCORE} new --overwrite'.split()) == 0
    assert (new / 'installer.md').read_text() != 'mine'
    (new / 'curve.png').write_text('of an earlier run')
    assert cli.main(f'{SCORE} new'.split()) == 0
    assert not (new / 'curve.png').exists() and (new / 'notes.md').read_text() == 'mine'
    for command in ('view room.ply', 'rooms 8 --points 1000 --out out/rooms',
                    'info 8 --points 1000 --out out/b.png'):
        assert cli.main(command.split()) == cli.main(command.split()) == 0


def test_settings_that_stand_in_the_folder_of_a_run_stay_as_they_are(files):
    claim(files, TrainingConfig(interactions=24))
    with pytest.raises(ConfigurationError, match='seed 0'):
        claim(files, TrainingConfig(interactions=24, seed=1))
    assert (files / 'config.yaml').read_text() == 'interactions: 24  # few\n'


def test_a_link_is_not_followed_to_what_is_read(files, capsys):
    for name, target in (('a.html', 'room.ply'), ('b.html', 'gone')):
        (files / name).symlink_to(target)
        overwrite = ['--overwrite'] * (target == 'room.ply')
        assert name in refused(capsys, 'view', 'room.ply', '--out', name, *overwrite)


@contextmanager
def full_disk(size=2000):
    """Limit the size of each written file to a number of bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def save_full_replay(path, agent):
    """Write a replay buffer that is full."""
    buffer = make_sac(SacConfig(buffer_size=100, device='cpu'), agent).replay_buffer
    buffer.pos, buffer.full = 0, True
    save_replay(buffer, path)


@pytest.mark.parametrize(('name', 'write'), [
    ('a.png', lambda path, *_: save_figure(Figure(), path)),
    ('a.html', lambda path, room, _: write_view(path, room)),
    ('a.ply', lambda path, room, _: save_scene(room, path)),
    ('a.safetensors', lambda path, _, checkpoint: checkpoint.save(path)),
    ('progress.jsonl', lambda path, *_: add_record(path.parent, {
        'task': 'x' * 9000, 'interactions': 1, 'updates': 1, 'seconds': 1.0})),
    ('replay.safetensors', lambda path, _, checkpoint: save_full_replay(path, checkpoint.config))])
def test_a_full_disk_leaves_what_was_there(room, checkpoint, tmp_path, name, write):
    path = tmp_path / name
    path.write_text('')
    with full_disk(), pytest.raises((OSError, ConfigurationError, ValueError)):
        write(path, room, checkpoint)
    assert [one.name for one in tmp_path.iterdir()] == [name] and path.read_bytes() == b''
    write(path, room, checkpoint)
    assert path.stat().st_size > 2000


def test_a_full_disk_leaves_no_files_of_two_placements(files, capsys):
    command = f'{SCORE} out'.split()
    assert cli.main(command) == 0
    whole = contents(files / 'out')
    with full_disk(100):
        assert cli.main(command) == 2
    assert contents(files / 'out') == whole
    capsys.readouterr()
    with full_disk(15000):
        assert cli.main(command) == 2
    out, err = capsys.readouterr()
    assert 'File too large' in err and 'cameras:' in out
    assert (files / 'out/installer.md').exists() and not (files / 'out/plan.png').exists()
    assert cli.main(command) == 0
    assert contents(files / 'out').keys() == whole.keys()


def elements_of(text):
    """Return the elements that a page is made of, of which none may run a script."""
    found = []

    def note(tag, attributes):
        found.append(tag)
        assert not any(name.startswith('on') or str(value).startswith('javascript:')
                       for name, value in attributes), attributes

    parser = HTMLParser()
    parser.handle_starttag = note
    parser.feed(text)
    return found


def test_names_are_shown_and_not_obeyed(files, capsys):
    name = f'{HOSTILE}.ply'
    (files / 'room.ply').rename(files / name)
    planner = json.dumps(HOSTILE)
    (files / 'placement.yaml').write_text(f'{PLACEMENT}created: {{planner: {planner}}}\n')
    assert cli.main(['score', name, 'placement.yaml', '--out', f'out {HOSTILE}']) == 0
    assert not {'\x1b', '\u202e'} & set(''.join(capsys.readouterr()))
    folder = files / f'out {HOSTILE}'
    page = (folder / 'installer.md').read_text()
    made = MarkdownIt('commonmark').enable('table').render(page)
    assert sorted(set(elements_of(made))) == [
        'h1', 'img', 'li', 'p', 'strong', 'table', 'tbody', 'td', 'th', 'thead', 'tr', 'ul']
    assert made.count('<h1>') == made.count('<img') == 1
    assert '&lt;img src=x onerror=alert(1)&gt;|`$x$[l](javascript:1)_c_' in made
    html = (folder / 'report.html').read_text()
    assert '&lt;img src=x' in html
    for part in (html.split('</script>')[0], html.split('<aside>')[1]):
        assert 'img' not in elements_of(part)
    for path in folder.iterdir():
        if path.suffix != '.png':
            assert not {'\x1b', '\u202e'} & set(path.read_text()), path.name
    # Both files say how the room is called, and are read again.
    for suffix in ('yaml', 'json'):
        assert cli.main(['score', name, f'{folder}/placement.{suffix}', '--json']) == 0
        assert json.loads(capsys.readouterr().out)['room']['file'] == name


def test_a_name_that_is_no_utf8_or_that_the_terminal_lacks_is_shown_by_escapes(
        files, capsys, monkeypatch):
    name, out = (os.fsdecode(part) for part in (b'caf\xe9.ply', b'B\xc3\xbcro\xe9'))
    (files / 'room.ply').rename(files / name)
    assert load_scene(name).name == r'caf\udce9'
    terminal = io.TextIOWrapper(io.BytesIO(), 'ascii', write_through=True)
    with monkeypatch.context() as patch:
        patch.setattr(sys, 'stdout', terminal)
        assert cli.main(['score', name, 'placement.yaml', '--out', out]) == 0
    assert rb'wrote B\xfcro\udce9/installer.md' in terminal.buffer.getvalue()
    assert r'caf\\udce9' in (files / out / 'installer.md').read_text()
    assert cli.main(['score', name, f'{out}/placement.yaml', '--out', f'{out}_b']) == 0
    assert r'wrote Büro\udce9_b/installer.md' in capsys.readouterr().out
    assert task_file_stem(BenchmarkTask(str(files / name), 0.0, 'random')).startswith('caf')
    assert 'found no such file' in refused(capsys, 'score', f'{name}x.ply', 'placement.yaml')
    with pytest.raises(ConfigurationError, match='TensorBoard'):
        claim(files / out, TrainingConfig())


@pytest.mark.parametrize('name', ['=1+1', '+1', '-1', '@a', 'a\x1b', 'a\n', 'a"', '<b>', '${a}'])
@pytest.mark.parametrize('key', ['name', 'sensor'])
def test_names_of_cameras_are_words(files, capsys, key, name):
    """No name begins a formula in a table, nor is it obeyed anywhere else."""
    (files / 'placement.yaml').write_text(PLACEMENT.replace(
        'yaw: 45', f'{key}: {json.dumps(name)}'))
    assert 'placement.yaml: line 3' in refused(capsys, 'score', 'room.ply', 'placement.yaml')


def test_a_folder_that_was_removed_is_said_to_be_so(files, capsys, monkeypatch):
    (files / 'gone').mkdir()
    monkeypatch.chdir('gone')
    (files / 'gone').rmdir()
    for arguments in (['rooms'], ['score', str(files / 'room.ply'), 'placement.yaml']):
        assert 'no longer exists' in refused(capsys, *arguments)
