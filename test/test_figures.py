# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Each published figure comes from docs/figures.json, and pages show what is there."""

import json
import re
import shutil
import subprocess
import sys

from conftest import ROOT
from hypothesis import given
from hypothesis import strategies as st
import pytest

from ocp_ros.evaluation import published_figures
from ocp_ros.planners.registry import OFFLINE, ONLINE

#: Numbers with a unit, decimals, shares and counts: what is measured mostly looks so.
MEASURED = re.compile(
    r'(?<![\w.,/-])\d[\d,]*(?:\.\d+)?(?:e-?\d+)?\s?'
    r'(?:%|(?:m|cm|mm|ms|ns|s|MB|GB|minutes?|hours?|seconds?|times|per second)\b)'
    r'|(?<![\w.,])\d+\.\d+|\bp = ?\d\S*|(?<![\w.,])\d+ of \d+\b')
#: By page and section what is told to a program or given by others, and so is not measured.
GIVEN = {
    ('README.md', ''): [
        r'2110\.11106', r'Apache-2\.0', r'Python 3\.10 to 3\.13', r'range of 4 m',
        r'camera by 2 cm', r'turns of at most 2 m, or 0\.5\sm', r'3 turns of 2 m',
        r'30 of 0\.5 m'],
    ('docs/reference/models.md', ''): [
        r'2110\.11106', r'range 4 m', r'height 1\.9 m', r'at most 0\.5 m', r'\d\.\d x \d\.\d m',
        r'37 x 14 m', r'18 m from the\scentre', r'30 turns of 0\.5 m\slead 15 m',
        r'interval of 95 %', r'95 % from', r'moves by 0\.04, 0\.15 or 0\.5 m'],
    ('docs/reference/training_measured.md', 'Statistics'): [],
    ('docs/reference/training_measured.md', 'What it costs'): [],
    ('docs/reference/nodes_measured.md', 'Stress tests'): [
        r'grown by 20 MB', r'jump by 3 s', r'stop for 4 s', r'noise of 1 cm', r'noise of\s3 cm'],
    ('docs/reference/nodes_measured.md', 'How fast it is'): [r'commit 268318a'],
    ('docs/tasks/count_cameras.md', ''): [r'range of\s4 m', r'95 % of the error'],
    ('docs/explanation/comparison.md', 'BPSO compared with other planners'): [],
    ('docs/explanation/engine.md', 'Speed'): [],
}
WORDS = re.findall(r'\w+', """
    one two three four five six seven eight nine ten eleven twelve thirteen fourteen fifteen
    sixteen seventeen eighteen nineteen twenty""")


def tree(tmp_path):
    """Return a copy of all that has figures or shows them."""
    for path in [*published_figures.pages(ROOT), *ROOT.glob('docs/**/*.json'),
                 *ROOT.glob('models/*.json')]:
        copy = tmp_path / path.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, copy)
    return tmp_path


def tool(name, *arguments):
    """Run a tool of the repository."""
    return subprocess.run([sys.executable, str(ROOT / 'tools' / name), *arguments],
                          capture_output=True, text=True)


def change(path, old, new):
    """Change one place of a file."""
    text = path.read_text()
    assert old in text, old
    path.write_text(text.replace(old, new, 1))


def test_figures_and_pages_agree():
    # tools/figures check prints the same.
    assert published_figures.faults(ROOT) == []


def test_the_file_is_as_the_tool_writes_it(tmp_path):
    root = tree(tmp_path)
    published_figures.save(root, published_figures.load(root))
    before = (ROOT / published_figures.FILE).read_text()
    assert (root / published_figures.FILE).read_text() == before


@pytest.mark.parametrize(('page', 'section'), GIVEN)
def test_every_measured_number_has_a_figure(page, section):
    text = published_figures.unbound((ROOT / page).read_text(), published_figures.load(ROOT))
    if section:
        text = re.split(rf'^##+ {re.escape(section)}$', text, flags=re.M)[1].split('\n## ')[0]
    # Commands are what somebody types; their numbers are settings.
    text = re.sub(r'^    .*$|`[^`]*`|\]\([^)]*\)', '', text, flags=re.M)
    for pattern in GIVEN[page, section]:
        assert re.search(pattern, text), f'{page} no longer says {pattern}'
        text = re.sub(pattern, '', text)
    left = [found.group() for found in MEASURED.finditer(text)]
    assert left == [], 'bind them to docs/figures.json, or name them in GIVEN'


def test_a_new_number_is_found_by_the_sweep():
    for number in ('0.93', '12 ms', '3 %', '9 of 10', 'p = 0.04', '1.5 times', '4 minutes'):
        assert MEASURED.search(f'it takes {number} at most'), number
    for number in ('four cameras', 'room 3000', '30 turns', '2026-11-21', '10,000 evaluations'):
        assert not MEASURED.search(f'with {number} at most'), number


def test_the_generated_pages_are_what_their_files_say():
    from ocp_ros.cli import bench_command
    from ocp_ros.report import benchmark_report, room_sheet
    for page, write in (('docs/bench.md', bench_command.page), ('docs/rooms.md', room_sheet.page),
                        ('docs/benchmark/README.md', benchmark_report.page),
                        ('docs/benchmark/four_d455/README.md', benchmark_report.page)):
        data = page.replace('README.md', 'summary.json').replace('.md', '.json')
        assert write(json.loads((ROOT / data).read_text())) == (ROOT / page).read_text(), page


def test_rooms_are_measured_into_what_their_page_is_written_from(monkeypatch):
    from ocp_ros.report import room_sheet
    monkeypatch.setattr(room_sheet, 'MEASURED', range(4000, 4002))
    monkeypatch.setattr(room_sheet, 'POINTS', 1500)
    found = json.loads(json.dumps(room_sheet.measured([], 'a command')))
    kept = published_figures.read(ROOT, 'docs/rooms.json')
    assert list(found['generated']) == list(kept['generated'])
    assert list(found['kinds']) == list(kept['kinds'])
    assert '    a command\n' in room_sheet.page(found)


def test_every_page_counts_the_planners_as_the_registry_does():
    count = len(OFFLINE) + len(ONLINE)
    compared = len(published_figures.read(ROOT, 'docs/benchmark/summary.json')['planners'])
    stated = []
    for path in [*published_figures.pages(ROOT), ROOT / 'CHANGELOG.rst', ROOT / 'setup.py',
                 ROOT / 'package.xml', ROOT / 'Makefile']:
        if path.parent.name == 'four_d455':
            # A rig file has one more, the search of full poses; the page counts them itself.
            continue
        text = path.read_text().lower()
        for part, number in re.findall(
                rf'(?:\b({"|".join(WORDS)}|\d+) of (?:the |all )?)?'
                rf'\b({"|".join(WORDS)}|\d+) planners\b', text):
            stated.append(path.name)
            assert number in (WORDS[count - 1], str(count)), path
            assert part in ('', WORDS[compared - 1], str(compared)), path
    assert {'README.md', 'CHANGELOG.rst'} <= set(stated)


def test_what_room_3000_changes_follows_from_the_comparison():
    summary = published_figures.read(ROOT, 'docs/benchmark/summary.json')
    known = {room: figures['best_known'] for room, figures in summary['rooms'].items()}
    total, rest = sum(known.values()), sum(known.values()) - known['3000']
    changes = {(name, budget): abs((run['sum'] - run['rooms']['3000']) / rest - run['sum'] / total)
               for name, runs in summary['planners'].items() for budget, run in runs.items()}
    greedy = [change for (name, _), change in changes.items() if name == 'greedy_coverage']
    others = [change for (name, _), change in changes.items() if name != 'greedy_coverage']
    figures = published_figures.load(ROOT)
    for key, value in (('greedy_coverage', max(greedy)), ('most', max(others))):
        assert figures[f'without_room_3000.{key}']['value'] == pytest.approx(value, abs=1e-12)


def test_the_sizes_of_weights_are_those_of_the_files():
    for name in ('map', 'moves', 'paper'):
        size = (ROOT / 'models' / f'{name}.safetensors').stat().st_size
        figure = published_figures.load(ROOT)[f'{name}.size_mb']
        assert figure['value'] == pytest.approx(1e-6 * size)


@pytest.mark.parametrize(('page', 'old', 'new', 'says'), [
    ('README.md', '1.08<!--=benchmark.lookahead', '1.09<!--=benchmark.lookahead', 'found 1.09'),
    ('README.md', '<!--row=cma_es--> | 2.74', '<!--row=cma_es--> | 2.75', 'found 2.75'),
    ('README.md', '<!--row=cma_es-->', '', 'without a name'),
    ('README.md', '=benchmark.lookahead.over_cma_es_10000', '=benchmark.lookahead.over',
     'no such figure'),
    ('README.md', '<!--=benchmark.lookahead.over', ' times<!--=benchmark.lookahead.over',
     'right before the marker'),
    ('docs/reference/models.md', '0.86 to 1.11<!--', '0.85 to 1.11<!--', 'found 0.85'),
    ('docs/tasks/count_cameras.md', '0.639 0.962 0.985', '0.639 0.962 0.986', 'found 0.986'),
    ('docs/reference/training_measured.md', '| 0.061, 3,000 |', '| 0.061 |',
     'found 1 numbers; expected 2'),
    ('docs/figures.json', '"unit": "m", "command": "tools/', '"unit": "m", "order": "tools/',
     'found no command'),
    ('docs/figures.json', '\n "fuzz.lies"', '\n "Fuzz.lies"', 'letters that no key has'),
    ('docs/figures.json', '/planners/lookahead/0/sum', '/planners/nobody/0/sum',
     'correct the pointer'),
    ('docs/benchmark/summary.json', '"regret": 1.0', '"regret": 1.2',
     'run tools/figures derive'),
    ('docs/reference/training_measured.md', '<!--=sampling.all_100000_ms-->', '',
     'found on no page'),
])
def test_a_change_in_one_place_alone_is_found(tmp_path, page, old, new, says):
    root = tree(tmp_path)
    change(root / page, old, new)
    assert any(says in fault for fault in published_figures.faults(root))


def test_the_tool_says_what_changed_and_fails(tmp_path):
    root = tree(tmp_path)
    change(root / 'docs/reference/training_measured.md', '<!--=sampling.all_100000_ms-->', '')
    done = tool('figures', '--root', str(root), 'check')
    assert done.returncode == 1 and 'found on no page' in done.stdout


@given(value=st.floats(-1e7, 1e7), digits=st.integers(0, 6))
def test_a_number_agrees_with_the_value_that_it_rounds_and_with_no_other(value, digits):
    text = f'{value:,.{digits}f}'
    assert published_figures.agrees(text, value)
    assert not published_figures.agrees(text, value + 1.01 * 10.0 ** -digits + 1e-9)
    assert not published_figures.agrees(text, value - 1.01 * 10.0 ** -digits - 1e-9)


def repository(tmp_path):
    """Return a copy of the tree with a commit."""
    root = tree(tmp_path)
    for command in (['init', '-q'], ['add', '.'], [
            '-c', 'user.name=a', '-c', 'user.email=a@b', 'commit', '-q', '-m', 'a']):
        subprocess.run(['git', '-C', str(root), *command], check=True, capture_output=True)
    return root


def test_a_measured_figure_is_recorded(tmp_path):
    root = repository(tmp_path)
    done = tool('figures', '--root', str(root), 'set', 'fuzz.lies', '100019', '--unit', 'messages',
                '--command', 'make fuzz')
    assert done.returncode == 0, done.stderr
    figure = published_figures.load(root)['fuzz.lies']
    assert figure['value'] == 100019 and figure['commit'] == published_figures.commit(root)
    assert re.fullmatch(r'\d{4}-\d\d-\d\d', figure['date']) and figure['command'] == 'make fuzz'
    assert ['docs/reference/nodes_measured.md' in fault and '100,018' in fault
            for fault in published_figures.faults(root)] == [True]
    change(root / 'docs/reference/nodes_measured.md', '100,018', '100,019')
    assert published_figures.faults(root) == []
    published_figures.record(root, 'house.floors', 2, 'floors', 'a look', internal=True)
    published_figures.record(root, 'house.floors', [2, 3], 'floors', 'a look')
    assert published_figures.faults(root) == []


@pytest.mark.parametrize(('name', 'value', 'says'), [
    ('paper.turns', '7', 'follows from models/paper.json'),
    ('Fuzz', '7', 'expected small letters'),
    ('fuzz.lies', 'seven', 'expected a number'),
    ('fuzz.lies', '[]', 'expected a number')])
def test_what_cannot_be_recorded_is_refused(tmp_path, name, value, says):
    root = tree(tmp_path)
    done = tool('figures', '--root', str(root), 'set', name, value, '--unit', '1', '--command',
                'make fuzz')
    assert done.returncode == 2 and says in done.stderr
    assert published_figures.load(root) == published_figures.load(ROOT)


def test_derived_figures_follow_their_file(tmp_path):
    root = repository(tmp_path)
    change(root / 'models/paper.json', '"interactions": 10000', '"interactions": 12345')
    assert tool('figures', '--root', str(root), 'derive').returncode == 0
    assert published_figures.load(root)['paper.turns']['value'] == 12345
    assert any('expected 12345' in fault for fault in published_figures.faults(root))


def test_every_entry_of_a_table_of_the_bench_becomes_a_figure(tmp_path):
    root = repository(tmp_path)
    path = root / 'docs' / 'bench.json'
    bench = json.loads(path.read_text())
    table = {**bench['fused_f1'], 'fine.123': 0.75, 'mesh': 0.875}
    path.write_text(json.dumps({**bench, 'fused_f1': table}))
    assert tool('figures', '--root', str(root), 'derive').returncode == 0
    figures = published_figures.load(root)
    assert figures['bench.fused_f1.fine.123']['value'] == 0.75
    assert figures['bench.fused_f1.mesh']['value'] == 0.875
    assert figures['bench.fused_f1.mesh']['command'] == bench['command']
    assert not [fault for fault in published_figures.faults(root) if 'fused_f1.fine.123' in fault]


def test_the_house_is_measured(tmp_path):
    root = repository(tmp_path)
    (root / 'ocp_ros' / 'a').mkdir(parents=True)
    (root / 'ocp_ros' / 'a' / '__init__.py').write_text('')
    (root / 'ocp_ros' / '__init__.py').write_text('')
    (root / 'ocp_ros' / 'one.py').write_text('class A:\n\n    class B:\n        pass\n')
    (root / 'ocp_ros' / 'a' / 'one.py').write_text('class B: pass\n')
    done = tool('house', '--root', str(root))
    assert done.returncode == 0, done.stderr
    figures = published_figures.load(root)
    assert {key: figures[f'house.{key}']['value'] for key in (
        'lines', 'modules', 'base_name_collisions', 'class_name_collisions')} == {
            'lines': 5, 'modules': 4, 'base_name_collisions': 1, 'class_name_collisions': 1}
    assert published_figures.faults(root) == []
