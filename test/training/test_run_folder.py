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

"""Runs whose files were damaged: they go on, or say what is damaged, what is lost, what to do."""

from contextlib import suppress
from dataclasses import replace
from functools import partial
import json
import os
from pathlib import Path
import re
from shutil import copytree
import signal
import subprocess
import sys
import time

from conftest import assert_same, Here, HUNG, rows_for, TINY
import numpy as np
from ocp_ros.compare import comparison
from ocp_ros.compare.protocol import Protocol
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.training import train as training
from ocp_ros.training.run_folder import BEST, CONFIG, PROGRESS, records, REPLAY, ROOMS, STATE
from ocp_ros.training.training_config import TrainingConfig
from ocp_ros.util.settings import ConfigurationError, from_nested, UserError
from ocp_ros.util.worker_pool import WorkerPool
import pytest
import safetensors.numpy
import safetensors.torch
import torch

SETTINGS = {**TINY, 'interactions': 24}
#: What may befall any file.
DAMAGES = {
    'empty': lambda content: b'',
    'half': lambda content: content[:len(content) // 2],
    'a number': lambda content: b'7\n',
    'deep': lambda content: b'[' * 20000,
    'no text': lambda content: bytes(range(256)) * 8}


def replaced(old, new):
    """Return a damage: a text in place of another."""
    def damage(content):
        assert old in content
        return content.replace(old, new)
    return damage


def tensors(start, change):
    """Return a damage: tensors in place of the first one of a name, made of name and value."""
    def damage(content):
        found = safetensors.torch.load(content)
        name = next(name for name in sorted(found) if name.startswith(start))
        found |= change(name, found.pop(name))
        return safetensors.torch.save(found, {'run': 'as before'})
    return damage


def filled(start, value):
    """Return a damage: a value in place of all numbers of the first tensor of a name."""
    return tensors(start, lambda name, old: {name: torch.full_like(old, value)})


#: What is damaged, and how: the run goes on.
HARMLESS = [(PROGRESS, 'no text', DAMAGES['no text']),
            *((name, 'gone', None) for name in (CONFIG, ROOMS, 'best.json', BEST, REPLAY))]
#: What is damaged, how, and a word of what has to be said of it. Of weights see test_agent.py.
HARMFUL = [
    *((name, what, damage, 'remove') for name in (CONFIG, ROOMS)
      for what, damage in DAMAGES.items() if (name, what) != (CONFIG, 'half')),
    # Of tensors nothing else is read: what has no header of theirs is refused by the library.
    *((name, what, DAMAGES[what], remedy) for what in ('half', 'no text')
      for name, remedy in ((BEST, 'remove'), (STATE, 'copy'), (REPLAY, 'remove'))),
    *((name, 'missing', tensors(part, lambda name, old: {}), part) for name, part in (
        (STATE, 'policy'), (STATE, 'optimizer'), (REPLAY, 'rewards'))),
    *((name, 'another type', tensors(part, lambda name, old: {name: old.double()}), part)
      for name, part in ((STATE, 'policy'), (REPLAY, 'rewards'))),
    (STATE, 'gone', None, 'copy'),
    (CONFIG, 'half', DAMAGES['half'], 'found'),
    (CONFIG, 'NaN', replaced(b'gamma: 0.95', b'gamma: .nan'), 'sac.gamma'),
    (ROOMS, 'another type', lambda content: b'{"training": 3}', 'remove'),
    (ROOMS, 'other rooms', replaced(b'"test": ["', b'"test": ["9'), 'other rooms'),
    (STATE, 'NaN', filled('optimizer', float('nan')), 'optimizer'),
    (STATE, 'huge', filled('policy', 3e38), 'policy'),
    (STATE, 'a count below 0', filled('counter', -5), 'counter'),
    (STATE, 'a huge count', filled('counter.num', 1 << 60), 'counter.num'),
    (STATE, 'an odd key', tensors('optimizer', lambda name, old: {
        name: old, 'optimizer.actor.x.y.z': torch.zeros(1)}), 'x.y.z'),
    (REPLAY, 'an odd key', tensors('rewards', lambda name, old: {
        name: old, 'odd': torch.zeros(1)}), 'odd'),
    (STATE, 'another shape', tensors('policy', lambda name, old: {
        name: old.reshape(-1)[:1].clone()}), 'not torch'),
    (REPLAY, 'fewer moves', tensors('rewards', lambda name, old: {
        name: old[:-1].clone()}), 'rewards'),
    (REPLAY, 'huge', filled('rewards', float('inf')), 'rewards'),
    (REPLAY, 'filled too far', filled('filled', 1 << 40), 'found')]


def named(cases):
    """Return cases as parameters that are named by what is damaged, and how."""
    return [pytest.param(name, *rest, id=f'{name}: {what}') for name, what, *rest in cases]


def spoil(path, damage):
    """Damage a file, or remove it where there is no damage."""
    if damage is None:
        path.unlink()
    else:
        path.write_bytes(damage(path.read_bytes()))


@pytest.fixture(scope='module')
def begun(tmp_path_factory):
    """Return the folder of a run that has ended, and its checkpoint."""
    folder = tmp_path_factory.mktemp('begun') / 'run'
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, 'WorkerPool', Here)
        return folder, training.train(from_nested(TrainingConfig, SETTINGS), folder)


@pytest.fixture
def run(begun, here, tmp_path):
    """Return a copy of that folder."""
    return copytree(begun[0], tmp_path / 'run')


@pytest.mark.parametrize(('name', 'damage'), named(HARMLESS))
def test_a_run_goes_on_where_what_is_damaged_can_be_made_again(begun, run, name, damage):
    _, first = begun
    spoil(run / name, damage)
    again = training.train(from_nested(TrainingConfig, SETTINGS), run)
    assert again.run == first.run and again.updates > 0
    # Nothing was left to learn: the best weights are those there were, or the last ones.
    if name != BEST:
        assert again.updates == first.updates
        assert_same(again.weights, first.weights)


@pytest.mark.parametrize(('name', 'damage', 'words'), named(HARMFUL))
def test_a_run_that_cannot_go_on_says_what_is_lost_and_what_to_do(run, name, damage, words):
    spoil(run / name, damage)
    before = {one: one.read_bytes() for one in run.rglob('*')
              if one.is_file() and 'tensorboard' not in one.parts}
    with pytest.raises(UserError) as caught:
        training.train(from_nested(TrainingConfig, SETTINGS), run)
    sentence = str(caught.value)
    assert words in sentence and 'found' in sentence and 'expected' in sentence, sentence
    assert '\n' not in sentence and str(run) in sentence
    assert all(one.read_bytes() == content for one, content in before.items())


def test_lines_of_progress_that_cannot_be_read_are_left_out_with_a_warning(tmp_path, caplog):
    line = {'interactions': 24, 'updates': 12, 'seconds': 3.5, 'ratio': 0.8}
    whole = json.dumps(line).encode()
    bad = [b'null', b'7', b'[' * 20000, bytes(range(256)), b'{"ratio": 0.8}', *(
        json.dumps({**line, **change}).encode() for change in (
            {'interactions': '3'}, {'seconds': 10 ** 400}, {'ratio': float('nan')},
            {'seconds': 'long'}, {'updates': -1}))]
    (tmp_path / PROGRESS).write_bytes(b'\n'.join([whole, *bad, whole, whole[:-20]]))
    assert records(tmp_path) == [line, line] and PROGRESS in caplog.text


def test_a_run_that_goes_on_has_the_moves_that_it_had(run, monkeypatch):
    models = []
    monkeypatch.setattr(training.AgentSac, 'learn', lambda model, *_, **__: models.append(model))
    longer = from_nested(TrainingConfig, {**SETTINGS, 'interactions': 48})
    training.train(longer, run)
    buffer = models[0].replay_buffer
    # A run is saved before the moves of its last step are stored.
    count = (24 - SETTINGS['environments']) // SETTINGS['environments']
    saved = safetensors.numpy.load_file(run / REPLAY)
    assert buffer.pos == count and not buffer.full
    np.testing.assert_array_equal(buffer.rewards[:count], saved['rewards'])
    np.testing.assert_array_equal(buffer.observations['points'][:count],
                                  saved['observations.points'])
    assert torch.isfinite(buffer.sample(8).rewards).all()
    # Without the file some moves are played first.
    (run / REPLAY).unlink()
    training.train(longer, run)
    assert models[1].replay_buffer.pos == 0
    assert models[1].learning_starts == models[0].learning_starts + 24


@pytest.mark.parametrize('ratio', [0.0, 1e9])
def test_a_line_with_another_ratio_does_not_change_which_weights_are_best(begun, run, ratio):
    best = Checkpoint.load(run / BEST)
    lines = [{**line, 'ratio': ratio} for line in records(run)]
    (run / PROGRESS).write_text(''.join(json.dumps(line) + '\n' for line in lines))
    longer = training.train(from_nested(TrainingConfig, {**SETTINGS, 'interactions': 26}), run)
    known = begun[1].provenance['curve'] + longer.provenance['curve'][len(lines):]
    assert longer.updates == min(known, key=lambda line: line['ratio'])['updates']
    assert best.provenance['ratio'] >= longer.provenance['ratio']


def test_best_weights_that_no_line_tells_of_are_judged_anew(begun, run):
    """As after a kill between the weights and their line."""
    (run / PROGRESS).write_text('')
    longer = training.train(from_nested(TrainingConfig, {**SETTINGS, 'interactions': 26}), run)
    known = begun[1].provenance['curve'] + longer.provenance['curve']
    assert longer.updates == min(known, key=lambda line: line['ratio'])['updates']


PROTOCOL = Protocol(rooms=('3',), rotations=(0.0,), planners=('random', 'tdsa'),
                    budgets=(5, 30), seeds=2)
TASK = 'tasks/3-0-tdsa.json'
TASK_DAMAGES = {**DAMAGES, 'gone': None, 'a mapping': lambda content: b'{}',
                'NaN': replaced(b'"depth_error": 2.1', b'"depth_error": NaN')}


@pytest.fixture
def compared(tmp_path, monkeypatch):
    """Return what makes a comparison in a folder, and the names of what was run."""
    played = []

    def run_here(protocol, task):
        played.append(task.planner)
        return rows_for(protocol, task)

    monkeypatch.setattr(comparison, 'run_task', run_here)
    monkeypatch.setattr(comparison, 'WorkerPool', Here)
    return lambda: comparison.run_tasks(PROTOCOL, tmp_path, 1), played


@pytest.mark.parametrize('damage', TASK_DAMAGES.values(), ids=TASK_DAMAGES)
def test_a_damaged_result_is_found_again_and_the_others_stay(compared, tmp_path, caplog, damage):
    run, played = compared
    expected = run()
    spoil(tmp_path / TASK, damage)
    played.clear()
    assert run() == expected and played == ['tdsa']
    assert ('found no whole result' in caplog.text) == (damage is not None)
    assert run() == expected and played == ['tdsa']


def test_a_result_of_another_task_or_comparison_is_not_taken(compared, tmp_path):
    run, played = compared
    run()
    task = tmp_path / TASK
    kept = task.read_bytes()
    task.write_bytes((tmp_path / TASK.replace('tdsa', 'random')).read_bytes())
    played.clear()
    run()
    assert played == ['tdsa'] and task.read_bytes() == kept
    comparison.run_tasks(replace(PROTOCOL, seeds=3), tmp_path / 'other')
    (tmp_path / 'other' / TASK).replace(task)
    run()
    assert task.read_bytes() == kept


def test_a_damaged_record_of_a_comparison_is_said_to_be_so(compared, tmp_path):
    run, played = compared
    expected, path = run(), tmp_path / 'protocol.json'
    spoil(path, DAMAGES['half'])
    with pytest.raises(UserError, match='protocol.json'):
        run()
    path.unlink()
    played.clear()
    assert run() == expected and not played


def test_a_process_that_dies_while_it_works_is_told_of():
    with WorkerPool(1) as pool, pytest.raises(ConfigurationError, match='what was saved is kept'):
        list(pool.map(os._exit, [1]))


def ignores_interrupts(process):
    """Return whether a process ignores what Ctrl-C sends, by what the kernel says."""
    (ignored,) = re.findall(r'SigIgn:\s*(\w+)', Path(f'/proc/{process}/status').read_text())
    return bool(int(ignored, 16) >> signal.SIGINT - 1 & 1)


@pytest.mark.system
@pytest.mark.parametrize('times', [1, 2])
def test_a_training_that_is_interrupted_once_or_twice_ends_and_says_how_to_go_on(tmp_path, times):
    """All processes get what a terminal sends; those who are impatient send it again."""
    # The first evaluation, in processes, is soon due and takes long.
    settings = {**TINY, 'workers': 2, 'evaluate_every': 2,
                'rooms': {**TINY['rooms'], 'validation': 36}}
    (tmp_path / 'long.yaml').write_text(json.dumps(settings))
    process = subprocess.Popen(
        [sys.executable, '-m', 'ocp_ros.cli.main', 'train', '--config', 'long.yaml', '--out',
         'run'], cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True,
        # Tests that run in the background are started so that they ignore it.
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL))
    try:
        deadline = time.monotonic() + HUNG
        children = Path(f'/proc/{process.pid}/task/{process.pid}/children')
        # Two workers, and the process that watches over what they share: they have begun when they
        # ignore the signal.
        while sum(ignores_interrupts(child) for child in children.read_text().split()) < 3:
            assert process.poll() is None and time.monotonic() < deadline
        for _ in range(times):
            os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=HUNG)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 130, said
    assert 'ocp: stopped; the same command continues with what is saved in run' in said
