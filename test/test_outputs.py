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

"""What commands write: nobody loses a file, files are whole, names are shown and not obeyed."""

from contextlib import contextmanager
from html.parser import HTMLParser
import io
import json
import os
import resource
import sys

from conftest import random_checkpoint, refused
from markdown_it import MarkdownIt
from matplotlib.figure import Figure
from ocp_ros.cli import main as cli
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
import pytest

PLACEMENT = """\
# Where I hung them.
cameras:
  - {sensor: realsense_d455, position: [2.0, 2.0, 1.9], yaw: 45, pitch: 25}
"""
#: A name that would be obeyed where it is not only shown.
HOSTILE = 'a\x1b[31m\n# b <img src=x onerror=alert(1)>|`$x$[l](javascript:1)_c_\u202e'


@pytest.fixture
def files(room_folder, undrawn):
    """Write a placement and settings beside the room."""
    (room_folder / 'placement.yaml').write_text(PLACEMENT)
    (room_folder / 'config.yaml').write_text('interactions: 24  # few\n')
    return room_folder


def contents(folder):
    """Return what is in all files of a folder."""
    return {path: path.read_bytes() for path in folder.rglob('*') if path.is_file()}


SCORE = ['score', 'room.ply', 'placement.yaml', '--out']


@pytest.mark.parametrize(('taken', 'arguments', 'words'), [
    ('placement.yaml', [*SCORE, '.', '--overwrite'], 'placement.yaml'),
    ('room.ply', ['view', 'room.ply', '--out', 'room.ply', '--overwrite'], 'room.ply'),
    ('out/rig.yaml', ['view', 'room.ply', 'placement.yaml', '--rig', 'out/rig.yaml', '--out',
                      'out/rig.yaml'], 'rig.yaml'),
    ('room.ply', ['rooms', 'preview', '8', 'room.ply', '--out', 'room.ply'], 'room.ply'),
    ('new/installer.md', [*SCORE, 'new'], 'new/installer.md, and no placement.json'),
    ('new/placement.yaml', ['plan', 'room.ply', '--out', 'new'], 'no placement.json'),
    ('new/placement.yaml', ['calibrate', 'room.ply', 'placement.yaml', '--clouds', 'room.ply',
                            '--out', 'new'], 'no calibration.json'),
    ('new/results.csv', ['benchmark', '--out', 'new'], 'no protocol.json'),
    ('new/evaluation.json', ['evaluate', '--out', 'new'], 'no *-cameras'),
    ('page.html', ['view', 'room.ply', '--out', 'page.html'], 'page.html'),
    ('a.png', ['rooms', 'preview', '8', '--out', 'a.png'], 'a.png'),
    ('room-8_mesh.ply', ['rooms', 'make', '8', '--out', '.'], 'room-8_mesh.ply'),
    ('room.json', ['train', '--config', 'config.yaml', '--out', 'run', '--model',
                   'room.safetensors'], '--model: found room.json'),
    ('run/best.safetensors', ['train', '--config', 'config.yaml', '--out', 'run'],
     'found best.safetensors'),
    ('rooms.json', ['train', '--config', 'config.yaml', '--out', '.'], 'rooms.json')])
def test_what_somebody_wrote_is_not_replaced(files, capsys, monkeypatch, taken, arguments, words):
    path = files / taken
    path.parent.mkdir(exist_ok=True)
    if not path.exists():
        path.write_text('mine')
    before = contents(files)
    # Refused before any work is done.
    monkeypatch.setattr('ocp_ros.rooms.scene_source.load_cached', None)
    monkeypatch.setattr('ocp_ros.rooms.scene_source.generate_room', None)
    assert words in refused(capsys, *arguments)
    assert {path: content for path, content in contents(files).items() if path in before} == before


def test_other_files_are_replaced_where_that_is_asked_for_and_own_files_always(files):
    installer, curve, notes = (files / 'new' / name
                               for name in ('installer.md', 'curve.png', 'notes.md'))
    (files / 'new').mkdir()
    for path in (installer, notes):
        path.write_text('mine')
    assert cli.main([*SCORE, 'new', '--overwrite']) == 0
    assert installer.read_text() != 'mine'
    curve.write_text('of an earlier run')
    assert cli.main([*SCORE, 'new']) == 0
    assert not curve.exists() and notes.read_text() == 'mine'
    for command in (['view', 'room.ply'],
                    ['rooms', 'make', '8', '--points', '1000'],
                    ['rooms', 'preview', '8', '--points', '1000', '--out', 'out/b.png']):
        assert cli.main(command) == cli.main(command) == 0


def test_settings_that_stand_in_the_folder_of_a_run_stay_as_they_are(files):
    claim(files, TrainingConfig(interactions=24))
    assert (files / 'config.yaml').read_text() == 'interactions: 24  # few\n'
    with pytest.raises(ConfigurationError, match='seed 0'):
        claim(files, TrainingConfig(interactions=24, seed=1))
    assert (files / 'config.yaml').read_text() == 'interactions: 24  # few\n'


def test_a_link_is_not_followed_to_what_is_read(files, capsys):
    (files / 'a.html').symlink_to('room.ply')
    (files / 'b.html').symlink_to('gone')
    view = ['view', 'room.ply', '--out']
    assert 'a.html' in refused(capsys, *view, 'a.html', '--overwrite')
    assert 'b.html' in refused(capsys, *view, 'b.html')


@contextmanager
def full_disk(size=2000):
    """Let no file grow beyond so many bytes."""
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
    ('a.png', lambda path, room, agent: save_figure(Figure(), path)),
    ('a.html', lambda path, room, agent: write_view(path, room)),
    ('a.ply', lambda path, room, agent: save_scene(room, path)),
    ('a.safetensors', lambda path, room, agent: random_checkpoint(agent).save(path)),
    ('progress.jsonl', lambda path, room, agent: add_record(path.parent, {
        'phase': 'x' * 9000, 'interactions': 1, 'updates': 1, 'seconds': 1.0})),
    ('replay.safetensors', lambda path, room, agent: save_full_replay(path, agent))])
def test_a_full_disk_leaves_what_was_there(room, small_agent, tmp_path, name, write):
    path = tmp_path / name
    path.write_text('')
    with full_disk(), pytest.raises((OSError, ConfigurationError, ValueError)):
        write(path, room, small_agent)
    assert [one.name for one in tmp_path.iterdir()] == [name] and path.read_bytes() == b''
    write(path, room, small_agent)
    assert path.stat().st_size > 2000


def test_a_full_disk_leaves_no_files_of_two_placements(files, capsys):
    command = [*SCORE, 'out']
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


def test_a_name_that_is_no_utf8_is_shown_as_it_is(files, capsys):
    name, out = (os.fsdecode(part) for part in (b'caf\xe9.ply', b'out\xe9'))
    (files / 'room.ply').rename(files / name)
    assert load_scene(name).name == r'caf\udce9'
    assert cli.main(['score', name, 'placement.yaml', '--out', out]) == 0
    assert r'wrote out\udce9/installer.md' in capsys.readouterr().out
    assert r'caf\\udce9' in (files / out / 'installer.md').read_text()
    assert cli.main(['score', name, f'{out}/placement.yaml']) == 0
    assert task_file_stem(BenchmarkTask(str(files / name), 0.0, 'random')).startswith('caf')
    capsys.readouterr()
    assert 'found no such file' in refused(capsys, 'score', f'{name}x.ply', 'placement.yaml')
    with pytest.raises(ConfigurationError, match='TensorBoard'):
        claim(files / out, TrainingConfig())


@pytest.mark.parametrize('name', ['=1+1', '+1', '-1', '@a', 'a\x1b', 'a\n', 'a"', '<b>', '${a}'])
@pytest.mark.parametrize('key', ['name', 'sensor'])
def test_names_of_cameras_are_words(files, capsys, key, name):
    """No name begins a formula in a table, nor is it obeyed anywhere else."""
    (files / 'placement.yaml').write_text(PLACEMENT.replace(
        'yaw: 45', f'{key}: {json.dumps(name)}'))
    assert 'placement.yaml: line 3' in refused(capsys, *SCORE[:3])


def test_letters_that_the_terminal_lacks_are_shown_as_escapes(files, monkeypatch):
    (files / 'room.ply').rename(files / 'Café.ply')
    shown = io.BytesIO()
    monkeypatch.setattr(sys, 'stdout', io.TextIOWrapper(shown, 'ascii', write_through=True))
    assert cli.main(['score', 'Café.ply', 'placement.yaml', '--out', 'Büro']) == 0
    assert rb'wrote B\xfcro/installer.md' in shown.getvalue()


def test_a_folder_that_was_removed_is_said_to_be_so(files, capsys, monkeypatch):
    (files / 'gone').mkdir()
    monkeypatch.chdir('gone')
    (files / 'gone').rmdir()
    for arguments in (['rooms', 'list'], ['score', str(files / 'room.ply'), 'placement.yaml']):
        assert 'no longer exists' in refused(capsys, *arguments)
