# SPDX-License-Identifier: Apache-2.0
"""Run a comparison: all tasks, on all cores or on a Ray cluster, once each, interrupted or not."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
import hashlib
import json
from pathlib import Path
from typing import Any

from ocp_ros import __version__
from ocp_ros.evaluation.protocol import BenchmarkTask, Protocol, run_task
from ocp_ros.planners.registry import PAPER
from ocp_ros.util.files import write_atomically
from ocp_ros.util.resources import find_model
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.worker_pool import WorkerPool

Rows = list[dict[str, Any]]


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
    left = [task for task in tasks if not files[task].exists()]
    done = len(tasks) - len(left)
    if progress is not None:
        progress(done, len(tasks))
    with WorkerPool(workers, ray_address) as pool:
        for number, rows in pool.unordered(partial(run_task, protocol), left):
            write_atomically(files[left[number]], json.dumps(rows))
            done += 1
            if progress is not None:
                progress(done, len(tasks))
    return [row for task in tasks for row in json.loads(files[task].read_text())]


def name_of(task: BenchmarkTask) -> str:
    """Return a name for the file of a task."""
    stem = Path(task.room).stem
    if not task.room.isdecimal():
        # Another scan under the same name is another room.
        state = Path(task.room).stat()
        known = f'{Path(task.room).resolve()} {state.st_size} {state.st_mtime_ns}'
        stem += '-' + hashlib.sha256(known.encode()).hexdigest()[:8]
    return f'{stem}-{task.rotation:g}-{task.planner}'


def _claim(folder: Path, protocol: Protocol) -> None:
    """Write down what all results here have in common, or check that it is the same."""
    common = {'ocp_ros': __version__, 'weights': _weights(protocol.model), **_rig(protocol), **{
        name: value for name, value in asdict(protocol).items()
        if name not in ('rooms', 'rotations', 'planners')}}
    path, text = folder / 'protocol.json', json.dumps(common, indent=2) + '\n'
    if path.exists() and path.read_text() != text:
        raise ConfigurationError(
            f'{folder}: found the results of another comparison; expected the same budgets, '
            'seeds, rig, weights and version; name another folder or remove this one')
    write_atomically(path, text)


def _rig(protocol: Protocol) -> dict[str, str]:
    """Return the SHA-256 of the rig file, if there is one: under the same name may be another."""
    if not protocol.simulation.rig_file:
        return {}
    return {'rig': hashlib.sha256(Path(protocol.simulation.rig_file).read_bytes()).hexdigest()}


def _weights(model: str) -> dict[str, str]:
    """Return the SHA-256 of the weights that may play: under the same name there may be others."""
    return {name: hashlib.sha256(find_model(name).read_bytes()).hexdigest()
            for name in dict.fromkeys((model, PAPER))}
