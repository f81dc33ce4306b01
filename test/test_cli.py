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
import shlex

from conftest import Here, made_room, rows_for, run_python
from hypothesis import given
from hypothesis import settings as budget
from hypothesis import strategies as st
import numpy as np
from ocp_ros.cli import main as cli
from ocp_ros.cli.common import json_text
from plyfile import PlyData, PlyElement
import pytest


@pytest.fixture
def files(room_folder):
    """Write a placement, settings and a scan with holes beside the room."""
    (room_folder / 'placement.yaml').write_text(
        'cameras: [{sensor: realsense_d455, position: [2.0, 2.0, 1.9], yaw: 45, pitch: 25}]')
    (room_folder / 'train.yaml').write_text('nonsense: 1\n')
    (room_folder / 'good.yaml').write_text('seed: 1\n')
    points = made_room(8, 1500).points.copy()
    points[::7] = np.nan
    rows = np.rec.fromarrays(points.T, dtype=[(axis, 'f4') for axis in 'xyz'])
    PlyData([PlyElement.describe(rows, 'vertex')]).write(str(room_folder / 'holes.ply'))
    return room_folder


def test_help_lists_every_command_once(capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(['--help'])
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines()
              if line.startswith('  ')]
    assert end.value.code == 0
    for name in ('plan', 'score', 'calibrate', 'view', 'replay', 'rooms', 'train', 'evaluate',
                 'benchmark'):
        assert listed.count(name) == 1, name


@pytest.mark.parametrize('example', cli.build_commands().examples)
def test_every_example_can_be_read_and_stands_in_the_help_of_its_command(example, capsys):
    words = shlex.split(example)
    assert words[0] == 'ocp'
    cli.build_parser().parse_args(words[1:])
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
    (['evaluate', '--planners', 'regular_grid,random', '--budgets', '5',
      '--out', 'evaluation', '--rooms', 'room.ply'], {'command', 'date', 'model', 'rotations',
                                                      'seeds', 'cameras', 'written'})])
def test_json_is_all_that_a_command_prints(files, capsys, monkeypatch, arguments, keys):
    monkeypatch.setattr('ocp_ros.compare.comparison.WorkerPool', Here)
    monkeypatch.setattr('ocp_ros.compare.comparison.run_task', rows_for)
    assert cli.main([*arguments, '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found) == keys
    for path in found.get('written', ()):
        assert (files / path).is_file()


@pytest.mark.parametrize(('arguments', 'words'), [
    ('score none.ply placement.yaml', 'none.ply'), ('score room.ply', 'PLACEMENT'),
    (f'score {"7" * 5000} placement.yaml', '777...'), ('rooms preview 99999999999', '99999999999'),
    ('view room.ply --op', '--op'), ('plan 8 --target 0.5', '--target'),
    ('plan 8 --cameras 2 --by seen', '--by'), ('view room.ply --out .', '--out'),
    ('view room.ply --out /proc/a.html', '--out'),
    ('rooms preview 8 --out room.ply/a.png', '--out'), ('rooms make 8 --out /proc/rooms', '--out'),
    ('score room.ply placement.yaml --out /proc/a', '--out'),
    ('train --config good.yaml --out room.ply', '--out'),
    ('train --config good.yaml --out o --model /proc/a', '--model'),
    ('evaluate --out /proc', '--out'), ('evaluate --rooms room.ply none.ply', 'none.ply'),
    ('benchmark --out /proc/a', '--out'), ('view room.ply --rig rig.yaml', 'placement'),
    ('train --config train.yaml --out out', 'nonsense'), ('evaluate --seeds 0', '--seeds'),
    ('evaluate --cameras 4,0', '--cameras'),
    ('train --config train.yaml --out out --seed 202611212346', '--seed'),
    ('score holes.ply placement.yaml', '--drop-nonfinite'),
    ('score 8 placement.yaml --drop-nonfinite', '--drop-nonfinite'),
    ('rooms list --count x', '--count'), ('paint', 'paint'), ('', 'COMMAND')])
def test_errors_are_json_where_it_is_asked_for(files, capsys, arguments, words):
    assert cli.main([*arguments.split(), '--json']) == 2
    found = json.loads(capsys.readouterr().out)
    assert set(found) == {'error'} and words in found['error']


@pytest.mark.parametrize(('module', 'heavy'), [
    ('ocp_ros.cli.main', 'torch numba scipy numpy matplotlib rich yaml'),
    ('ocp_ros.cli.plan_command', 'ocp_ros.compare benchmarks matplotlib plotly open3d torch')])
def test_what_is_slow_to_import_is_imported_when_it_is_needed(module, heavy):
    done = run_python(f'import sys, {module}, ocp_ros.cli.main as cli; cli.build_commands(); '
                      'print(*sys.modules)')
    assert module in done.stdout and not set(heavy.split()) & set(done.stdout.split())


def test_ctrl_c_ends_quietly_whatever_is_going_on(files, capsys, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr('ocp_ros.rooms.scene_source.make_room', stop)
    assert cli.main(['score', 'room.ply', 'placement.yaml']) == 130
    assert capsys.readouterr() == ('', '')


def test_a_page_of_a_room_needs_no_placement_and_no_network(files, capsys):
    assert cli.main(['view', 'room.ply', 'placement.yaml', '--out', 'new/page.html']) == 0
    page = (files / 'new' / 'page.html').read_text()
    assert cli.main(['view', '8', '--out', 'bare.html']) == 0
    bare = (files / 'bare.html').read_text().split('<aside>')[1].split('<script>')[0]
    assert 'depth error' in page.split('<aside>')[1] and 'depth error' not in bare
    assert '<script src=' not in page and '<link' not in page


def test_a_page_is_opened_where_that_is_wanted(files, capsys, monkeypatch):
    opened = []
    monkeypatch.setattr('webbrowser.open', lambda address: opened.append(address))
    assert cli.main(['view', 'room.ply', '--out', 'page.html', '--open']) == 0
    assert opened == [(files / 'page.html').resolve().as_uri()]
    assert 'page.html' in capsys.readouterr().err


values = st.recursive(st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
                      lambda parts: st.lists(parts) | st.dictionaries(st.text(), parts))


@given(value=values)
@budget(max_examples=25, deadline=None)
def test_a_document_is_json_whatever_was_found(value):
    def refuse(word):
        raise AssertionError(word)
    found = json.loads(json_text({'value': value, 'array': np.array([1.0, np.nan])}),
                       parse_constant=refuse)
    assert found['array'] == [1.0, None] and set(found) == {'value', 'array'}


#: Ctrl-C at the moment at which a module is imported.
IMPORTING = """
import os, signal, sys
class Finder:
    def find_spec(self, name, *_):
        if name == module:
            os.kill(os.getpid(), signal.SIGINT)
module = sys.argv.pop(1)
sys.meta_path.insert(0, Finder())
from ocp_ros.cli.start import main
sys.exit(main())
"""


@pytest.mark.parametrize('module', ['ocp_ros.cli.common', 'ocp_ros.cli.plan_command', 'numba',
                                    'ocp_ros.search.rig_plan'])
def test_an_early_ctrl_c_ends_a_command_without_a_traceback(tmp_path, monkeypatch, module):
    monkeypatch.chdir(tmp_path)
    ended = run_python(IMPORTING, module, 'plan', '8', '--evaluations', '5')
    assert (ended.returncode, ended.stderr) == (130, '')
