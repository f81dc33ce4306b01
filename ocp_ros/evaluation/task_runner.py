# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run a comparison: all tasks, on all cores or on a Ray cluster, once each, interrupted or not."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
import hashlib
import json
import logging
import os
from pathlib import Path
from typing import Any

from ocp_ros import __version__
from ocp_ros.evaluation.protocol import BenchmarkTask, Protocol, run_task
from ocp_ros.evaluation.task_rows import check_rows
from ocp_ros.util.files import write_atomically
from ocp_ros.util.resources import find_model
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.shown_text import printable
from ocp_ros.util.worker_pool import WorkerPool

Rows = list[dict[str, Any]]
_log = logging.getLogger(__name__)


def run(protocol: Protocol, folder: Path, workers: int, ray_address: str | None = None,
        progress: Callable[[int, int], None] | None = None) -> Rows:
    """
    Run what has not been run yet.

    :param protocol: what to compare.
    :param folder: each task leaves a file here as soon as it is done.
    :param workers: processes on this machine.
    :param ray_address: a Ray cluster to run on instead, such as ``auto``.
    :param progress: called with the tasks done and all of them.
    :returns: the rows of all tasks.
    :raises ConfigurationError: if the folder belongs to another comparison.
    """
    tasks = protocol.tasks
    files = {task: folder / 'tasks' / f'{name_of(task)}.json' for task in tasks}
    _claim(folder, protocol)
    found = {task: rows for task in tasks
             if (rows := _kept(files[task], protocol, task)) is not None}
    left = [task for task in tasks if task not in found]
    done = len(tasks) - len(left)
    if progress is not None:
        progress(done, len(tasks))
    with WorkerPool(workers, ray_address) as pool:
        for number, rows in pool.unordered(partial(run_task, protocol), left):
            text = json.dumps(rows)
            write_atomically(files[left[number]], text)
            found[left[number]] = json.loads(text)
            done += 1
            if progress is not None:
                progress(done, len(tasks))
    return [row for task in tasks for row in found[task]]


def _kept(path: Path, protocol: Protocol, task: BenchmarkTask) -> Rows | None:
    """Return the rows of a task that was run before; None if there are none, or no whole ones."""
    try:
        rows = json.loads(path.read_bytes())
        check_rows(rows, protocol, task)
    except FileNotFoundError:
        return None
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        _log.warning('%s: found no whole result (%s: %s); expected the runs of one planner in one '
                     'room; running them again, nothing else is lost', printable(str(path)),
                     type(error).__name__, error)
        return None
    return rows


def name_of(task: BenchmarkTask) -> str:
    """Return a name for the file of a task."""
    stem = Path(task.room).stem
    if not task.room.isdecimal():
        # Another scan under the same name is another room.
        state = Path(task.room).stat()
        known = f'{Path(task.room).resolve()} {state.st_size} {state.st_mtime_ns}'
        stem += '-' + hashlib.sha256(os.fsencode(known)).hexdigest()[:8]
    return f'{stem}-{task.rotation:g}-{task.planner}'


def _claim(folder: Path, protocol: Protocol) -> None:
    """Write down what all results here have in common, or check that it is the same."""
    common = {'ocp_ros': __version__, 'weights': _weights(protocol.model), **_rig(protocol), **{
        name: value for name, value in asdict(protocol).items()
        if name not in ('rooms', 'rotations', 'planners')}}
    path, text = folder / 'protocol.json', json.dumps(common, indent=2) + '\n'
    if not path.exists():
        write_atomically(path, text)
    elif path.read_bytes() != text.encode():
        _check_protocol(path)
        raise ConfigurationError(
            f'{folder}: found the results of another comparison; expected the same budgets, '
            'seeds, rig, weights and version; name another folder or remove this one')


def _check_protocol(path: Path) -> None:
    """Refuse a damaged record of what results have in common, and say how to go on."""
    try:
        found = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict) or not found:
        raise ConfigurationError(
            f'{path}: found no record of a comparison; expected budgets, seeds, rig, weights and '
            'version of the results beside it; these are not lost: remove the file if they are '
            'those that are asked for now, or name another folder')


def _rig(protocol: Protocol) -> dict[str, str]:
    """Return the SHA-256 of the rig file, if there is one: under the same name may be another."""
    if not protocol.simulation.rig_file:
        return {}
    return {'rig': hashlib.sha256(Path(protocol.simulation.rig_file).read_bytes()).hexdigest()}


def _weights(model: str) -> dict[str, str]:
    """Return the SHA-256 of the weights that may play: under the same name there may be others."""
    return {model: hashlib.sha256(find_model(model).read_bytes()).hexdigest()}
