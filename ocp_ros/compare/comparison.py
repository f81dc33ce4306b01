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

"""
Run a comparison of planners, on all cores or on a Ray cluster, and write its results.

The rows of a task are written as soon as the task is done, so an interrupted comparison continues
with the other tasks.
"""

from collections.abc import Callable
import csv
from dataclasses import asdict
from functools import partial
import hashlib
from importlib.metadata import version
import io
import json
import logging
import os
from pathlib import Path
import platform
from typing import Any

from ocp_ros import __version__
from ocp_ros.compare.protocol import BenchmarkTask, Protocol, run_task
from ocp_ros.compare.summary import pairs, Rows, summarise
from ocp_ros.util.files import MAX_BYTES, printable, read_regular, sha256_of_file, write_atomically
from ocp_ros.util.resources import find_model
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.worker_pool import WorkerPool
from ocp_ros.util.yaml_files import timestamp
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

#: Files that a comparison writes.
RESULTS = ('results.csv', 'results.json', 'summary.json')
_log = logging.getLogger(__name__)


def compare(protocol: Protocol, folder: Path, command: str, workers: int = 0,
            ray_address: str | None = None) -> dict[str, Any]:
    """
    Run the tasks without results, with progress on stderr, and write :data:`RESULTS`.

    :param protocol: what to compare.
    :param folder: of the results.
    :param command: the command line, for the record.
    :param workers: number of processes on this machine; 0 for one on each core.
    :param ray_address: of a Ray cluster that runs the tasks instead, such as ``auto``.
    :returns: the summary: settings, date and versions; the figures of
        :func:`~ocp_ros.compare.summary.summarise`; and ``pairs``, the comparison of the first
        planner with each other planner, see :func:`~ocp_ros.compare.summary.pairs`.
    :raises ConfigurationError: if the folder belongs to another comparison.
    """
    columns = (TextColumn(f'comparing planners, {protocol.cameras} cameras'), BarColumn(),
               MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        bar = progress.add_task('')
        rows = run_tasks(protocol, folder, workers, ray_address,
                         lambda done, total: progress.update(bar, completed=done, total=total))
    libraries = ('ocp_ros', 'numpy', 'numba', 'scipy', 'cma')
    summary = {
        'command': command, 'date': timestamp(), 'versions': {
            'python': platform.python_version(), **{name: version(name) for name in libraries}},
        'rotations': len(protocol.rotations), 'points': protocol.points,
        'judged_points': protocol.judged_points,
        'rig': Path(protocol.simulation.rig_file).name, 'cameras': protocol.cameras,
        **summarise(rows), 'pairs': pairs(rows, protocol.planners[0])}
    _write_results(folder, rows, summary)
    return summary


def run_tasks(protocol: Protocol, folder: Path, workers: int = 0, ray_address: str | None = None,
              progress: Callable[[int, int], None] = lambda done, total: None) -> Rows:
    """
    Run the tasks without results; return the rows of all tasks.

    :param folder: the rows of each task are written to a file here as soon as it is done.
    :param workers: number of processes on this machine; 0 for one on each core.
    :param ray_address: of a Ray cluster that runs the tasks instead, such as ``auto``.
    :param progress: called with the number of finished tasks and the number of all tasks.
    :raises ConfigurationError: if the folder belongs to another comparison.
    """
    tasks = protocol.tasks
    files = {task: folder / 'tasks' / f'{task_file_stem(task)}.json' for task in tasks}
    record = _write_or_check_record(folder, protocol)
    rows_by_task = {task: rows for task in tasks
                    if (rows := _stored_rows(files[task], record, task)) is not None}
    open_tasks = [task for task in tasks if task not in rows_by_task]
    progress(len(rows_by_task), len(tasks))
    with WorkerPool(workers, ray_address) as pool:
        for number, rows in pool.unordered(partial(run_task, protocol), open_tasks):
            task = open_tasks[number]
            text = json.dumps(rows)
            write_atomically(files[task], json.dumps(
                {'sha256': _checksum(record, task, text), 'rows': rows}))
            # As read from the file, so that an interrupted comparison has the same results.
            rows_by_task[task] = json.loads(text)
            progress(len(rows_by_task), len(tasks))
    return [row for task in tasks for row in rows_by_task[task]]


def task_file_stem(task: BenchmarkTask) -> str:
    """Return the file name of a task, without extension."""
    stem = Path(task.room).stem
    if not task.room.isdecimal():
        # A scan with the same file name may be in another folder or may have changed.
        state = Path(task.room).stat()
        version_text = f'{Path(task.room).resolve()} {state.st_size} {state.st_mtime_ns}'
        stem += '-' + hashlib.sha256(os.fsencode(version_text)).hexdigest()[:8]
    return f'{stem}-{task.rotation:g}-{task.planner}'


def _checksum(record: str, task: BenchmarkTask, rows_json: str) -> str:
    """Return the SHA-256 of the record of a comparison, a task and the rows of the task."""
    return hashlib.sha256(f'{record} {task!r} {rows_json}'.encode()).hexdigest()


def _stored_rows(path: Path, record: str, task: BenchmarkTask) -> Rows | None:
    """Return the stored rows of a task; None if there are no rows or they are damaged."""
    try:
        stored = json.loads(read_regular(path))
        if stored['sha256'] == _checksum(record, task, json.dumps(stored['rows'])):
            return stored['rows']
        reason = 'the checksum is another'
    except FileNotFoundError:
        return None
    except (OSError, KeyError, TypeError, ValueError, RecursionError) as error:
        reason = f'{type(error).__name__}: {error}'
    _log.warning('%s: found no whole result (%s); expected the runs of one planner in one room; '
                 'running them again, nothing else is lost', printable(str(path)), reason)
    return None


def _write_or_check_record(folder: Path, protocol: Protocol) -> str:
    """Return the record of a comparison; write it, or check it if the folder has a record."""
    files = {protocol.model: find_model(protocol.model),
             'rig': Path(protocol.simulation.rig_file)}
    if protocol.policy.endswith('.zip'):
        files['policy'] = Path(protocol.policy.rpartition(':')[2])
    try:
        # The contents of files with the same name may differ.
        hashes = {name: sha256_of_file(path, MAX_BYTES) for name, path in files.items()}
    except OSError as error:
        raise ConfigurationError(
            f'--model, --rig: found {", ".join(map(str, files.values()))}, of which one cannot be '
            f'read ({error.strerror}); expected weights and a rig file of {MAX_BYTES:,} bytes at '
            'most; name the right files') from error
    settings = {
        'ocp_ros': __version__,
        'files': hashes,
        # Other rooms, rotations and planners are other tasks, whose files have other names.
        **{name: value for name, value in asdict(protocol).items()
           if name not in ('rooms', 'rotations', 'planners')}}
    path = folder / 'protocol.json'
    text = json.dumps(settings, indent=2) + '\n'
    if not path.exists():
        write_atomically(path, text)
    elif read_regular(path) != text.encode():
        raise ConfigurationError(
            f'{path}: found the record of another comparison, or a damaged one; expected the '
            'budgets, seeds, rig, weights and version that are asked for; name another folder, '
            'or remove a damaged record: the results beside it are not lost')
    return text


def _write_results(folder: Path, rows: Rows, summary: dict[str, Any]) -> None:
    """Write the runs as CSV and as JSON, and their summary."""
    csv_text = io.StringIO()
    # The CSV table leaves lists out.
    columns = dict.fromkeys(name for row in rows for name in row
                            if name not in ('placement', 'trajectory'))
    table = csv.DictWriter(csv_text, list(columns), extrasaction='ignore')
    table.writeheader()
    table.writerows({name: printable(value) if isinstance(value, str) else value
                     for name, value in row.items()} for row in rows)
    write_atomically(folder / 'results.csv', csv_text.getvalue())
    write_atomically(folder / 'results.json', json.dumps(rows))
    write_atomically(folder / 'summary.json', json.dumps(summary, indent=1) + '\n')
