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

"""What all commands of ocp have in common: contents, examples, and JSON on stdout alone."""

import json
import os
import shlex
import subprocess
import sys

from conftest import made_room, ROOT
from hypothesis import given
from hypothesis import settings as budget
from hypothesis import strategies as st
import numpy as np
from ocp_ros.cli import main as cli
from ocp_ros.cli.common import document
from ocp_ros.scenes.scene_files import save_scene
from plyfile import PlyData, PlyElement
import pytest

PLACEMENT = """\
cameras:
  - {sensor: realsense_d455, position: [2.0, 2.0, 1.9], yaw: 45, pitch: 25}
"""


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Write a room and a placement to the folder that is worked in."""
    for name in ('room.ply', '<b>&.ply'):
        save_scene(made_room(8, 1500), tmp_path / name)
    (tmp_path / 'placement.yaml').write_text(PLACEMENT)
    (tmp_path / 'train.yaml').write_text('nonsense: 1\n')
    (tmp_path / 'good.yaml').write_text('seed: 1\n')
    points = made_room(8, 1500).points.copy()
    points[::7] = np.nan
    rows = np.rec.fromarrays(points.T, dtype=[(axis, 'f4') for axis in 'xyz'])
    PlyData([PlyElement.describe(rows, 'vertex')]).write(str(tmp_path / 'holes.ply'))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def printed(capsys, *arguments):
    """Return the exit code of a command and the one document that it prints."""
    code = cli.main([*arguments, '--json'])
    return code, json.loads(capsys.readouterr().out)


def test_help_lists_every_command_under_what_one_wants(capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(['--help'])
    out = capsys.readouterr().out
    assert end.value.code == 0 and out.startswith('usage: ocp COMMAND ...')
    listed = [line.split()[0] for line in out.splitlines() if line.startswith('  ')]
    for name in ('plan', 'score', 'calibrate', 'view', 'replay', 'rooms', 'train', 'evaluate',
                 'benchmark'):
        assert listed.count(name) == 1, name
    assert out.index('evaluate a placement:') < out.index('  score') < out.index('look at')


@pytest.mark.parametrize('example', cli.commands().examples)
def test_every_example_can_be_read_and_stands_in_the_help_of_its_command(example, capsys):
    words = shlex.split(example)
    assert words[0] == 'ocp'
    cli.parser().parse_args(words[1:])
    command = words[1:3] if words[1] == 'rooms' else words[1:2]
    with pytest.raises(SystemExit):
        cli.main([*command, '--help'])
    out = capsys.readouterr().out
    assert example in out and '--json' in out


@pytest.mark.parametrize(('arguments', 'keys'), [
    (['score', 'room.ply', 'placement.yaml'], {'room', 'cameras', 'scores', 'broken', 'missed',
                                               'one_more', 'expected', 'notes', 'remarks'}),
    (['view', 'room.ply'], {'room', 'written'}),
    (['view', 'holes.ply', '--drop-nonfinite'], {'room', 'written'}),
    (['rooms', 'preview', 'holes.ply', '--drop-nonfinite', '--scale', '1.1', '--points', '1000',
      '--out', 'b.png'], {'written'}),
    (['room', '6', '4', '3', '--out', 'made.yaml'], {'written', 'size', 'openings', 'boxes'}),
    (['rooms', 'list', '--count', '2'], {'rooms'}),
    (['rooms', 'make', '8', '--points', '1000', '--out', 'made'], {'folder', 'written'}),
    (['rooms', 'preview', '8', '--points', '1000', '--out', 'a.png'], {'written'}),
    (['evaluate', '--planners', 'regular_grid,random', '--budgets', '5', '--workers', '1',
      '--out', 'evaluation', '--rooms', 'room.ply'], {'command', 'date', 'model', 'rotations',
                                                      'seeds', 'cameras', 'written'})])
def test_json_is_all_that_a_command_prints(files, capsys, arguments, keys):
    code, found = printed(capsys, *arguments)
    assert code == 0 and set(found) == keys
    for path in found.get('written', ()):
        assert (files / path).is_file()


@pytest.mark.parametrize(('arguments', 'words'), [
    (['score', 'none.ply', 'placement.yaml'], 'none.ply: found no such file'),
    (['score', 'room.ply'], 'required: PLACEMENT'),
    (['score', '7' * 5000, 'placement.yaml'], '77777777777777777777...: found no seed of a room'),
    (['rooms', 'preview', '99999999999'], '99999999999: found no seed of a room'),
    (['view', 'room.ply', '--op'], 'unrecognized arguments: --op'),
    (['plan', '8', '--target', '0.5'], '--target: found it without --count auto'),
    (['plan', '8', '--cameras', '2', '--by', 'seen'], '--by: found it without --count auto'),
    (['view', 'room.ply', '--out', '.'], '--out: found ., which cannot be written'),
    (['view', 'room.ply', '--out', '/proc/a.html'], '--out: found /proc/a.html, which cannot be'),
    (['rooms', 'preview', '8', '--out', 'room.ply/a.png'], '--out: found room.ply/a.png, which'),
    (['rooms', 'make', '8', '--out', '/proc/rooms'], '--out: found /proc/rooms, where nothing'),
    (['score', 'room.ply', 'placement.yaml', '--out', '/proc/a'], '--out: found /proc/a, where'),
    (['train', '--config', 'good.yaml', '--out', 'room.ply'], '--out: found room.ply, where'),
    (['train', '--config', 'good.yaml', '--out', 'o', '--model', '/proc/a'],
     '--model: found /proc/a, which cannot be written'),
    (['evaluate', '--out', '/proc'], '--out: found /proc, where nothing can be written'),
    (['evaluate', '--rooms', 'room.ply', 'none.ply'], 'none.ply: found no such file'),
    (['benchmark', '--out', '/proc/a'], '--out: found /proc/a, where nothing can be written'),
    (['view', 'room.ply', '--rig', 'rig.yaml'], 'and no placement'),
    (['train', '--config', 'train.yaml', '--out', 'out'], 'nonsense'),
    (['evaluate', '--seeds', '0'], "found '0'; expected 1 or more"),
    (['evaluate', '--cameras', '4,0'], "found '0'; expected a number of cameras from 1 to 64"),
    (['train', '--config', 'train.yaml', '--out', 'out', '--seed', '202611212346'],
     'expected a whole number from 0 to 2147483648'),
    (['score', 'holes.ply', 'placement.yaml'], 'leave them out (--drop-nonfinite)'),
    (['score', '8', 'placement.yaml', '--drop-nonfinite'], '--drop-nonfinite: found it with'),
    (['benchmark', '--scale', '0.1'], 'found no --rooms'),
    (['rooms', 'list', '--count', 'x'], "found 'x'"),
    (['paint'], 'invalid choice'), ([], 'required: COMMAND')])
def test_errors_are_json_where_it_is_asked_for(files, capsys, arguments, words):
    code, found = printed(capsys, *arguments)
    assert code == 2 and set(found) == {'error'} and words in found['error']


def test_the_command_line_is_read_before_what_is_slow_to_import():
    code = 'import sys, ocp_ros.cli.main; ocp_ros.cli.main.commands(); print(*sys.modules)'
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True,
                          env={**os.environ, 'PYTHONPATH': str(ROOT)})
    assert not {'torch', 'numba', 'scipy', 'numpy', 'matplotlib', 'rich', 'yaml'} & set(
        done.stdout.split())


def test_a_plan_is_searched_before_what_draws_or_compares_is_imported():
    code = 'import sys, ocp_ros.cli.plan_command; print(*sys.modules)'
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True,
                          env={**os.environ, 'PYTHONPATH': str(ROOT)})
    assert not {'ocp_ros.compare', 'benchmarks', 'matplotlib', 'plotly', 'open3d', 'torch'} & set(
        done.stdout.split())


def test_ctrl_c_ends_quietly_whatever_is_going_on(files, capsys, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr('ocp_ros.rooms.scene_source.make_room', stop)
    assert cli.main(['score', 'room.ply', 'placement.yaml']) == 130
    assert capsys.readouterr() == ('', '')


def test_a_page_of_a_room_needs_no_placement_and_no_network(files, capsys):
    assert cli.main(['view', '<b>&.ply', 'placement.yaml', '--out', 'new/page.html']) == 0
    assert capsys.readouterr().out == 'wrote new/page.html\n'
    page = (files / 'new' / 'page.html').read_text()
    assert cli.main(['view', '8', '--out', 'bare.html']) == 0
    bare = (files / 'bare.html').read_text()
    for words in ('depth error', 'What is missed'.lower(), 'fields of view', 'above the floor'):
        assert words in page.split('</script>')[-2] + page.split('<aside>')[1], words
        assert words not in bare.split('<aside>')[1].split('<script>')[0]
    # Names are shown, not obeyed.
    assert '<b>&' not in page.split('<aside>')[1] and '&lt;b&gt;&amp;' in page
    assert '<script src=' not in page and '<link' not in page


def test_a_page_is_opened_where_that_is_wanted(files, capsys, monkeypatch):
    opened = []
    monkeypatch.setattr('webbrowser.open', lambda address: opened.append(address))
    assert cli.main(['view', 'room.ply', '--out', 'page.html', '--open']) == 0
    assert opened == [(files / 'page.html').resolve().as_uri()]
    assert 'no browser was found; open page.html' in capsys.readouterr().err


values = st.recursive(st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
                      lambda parts: st.lists(parts) | st.dictionaries(st.text(), parts))


@given(value=values)
@budget(max_examples=60, deadline=None)
def test_a_document_is_json_whatever_was_found(value):
    def refuse(word):
        raise AssertionError(word)
    found = json.loads(document({'value': value, 'array': np.array([1.0, np.nan])}),
                       parse_constant=refuse)
    assert found['array'] == [1.0, None] and set(found) == {'value', 'array'}


#: Ctrl-C at the moment at which a module is imported.
IMPORTING = """
import os, signal, sys
class Finder:
    def find_spec(self, name, *_):
        if name == sys.argv[1]:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder())
from ocp_ros.cli.start import main
sys.exit(main())
"""


@pytest.mark.parametrize('module', ['ocp_ros.cli.common', 'numba', 'ocp_ros.search.rig_plan'])
def test_an_early_ctrl_c_ends_a_command_without_a_traceback(tmp_path, module):
    ended = subprocess.run(
        [sys.executable, '-c', IMPORTING.replace('sys.argv[1]', repr(module)), 'plan', '8',
         '--evaluations', '5'], cwd=tmp_path, text=True, capture_output=True,
        env={**os.environ, 'PYTHONPATH': str(ROOT)})
    assert (ended.returncode, ended.stderr) == (130, '')
