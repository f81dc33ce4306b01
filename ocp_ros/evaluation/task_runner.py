# SPDX-License-Identifier: Apache-2.0
"""Run a comparison: all tasks, on all cores or on a Ray cluster, once each, interrupted or not."""

from collections.abc import Callable, Iterator
from concurrent.futures import as_completed, ProcessPoolExecutor
from dataclasses import asdict
import hashlib
import json
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from ocp_ros import __version__
from ocp_ros.evaluation.protocol import BenchmarkTask, Protocol, run_task
from ocp_ros.planners.registry import PAPER
from ocp_ros.util.files import write_atomically
from ocp_ros.util.resources import find_model
from ocp_ros.util.settings import ConfigurationError

Rows = list[dict[str, Any]]
#: Runs tasks, leaves the rows of each in its file, and yields those that are done.
Execute = Callable[[Protocol, dict[BenchmarkTask, Path]], Iterator[BenchmarkTask]]


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
    execute = _on_ray(ray_address) if ray_address else _in_processes(workers)
    done = len(tasks) - len(left)
    if progress is not None:
        progress(done, len(tasks))
    for _ in execute(protocol, {task: files[task] for task in left}):
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
    common = {'ocp_ros': __version__, 'weights': _weights(protocol.model), **{
        name: value for name, value in asdict(protocol).items()
        if name not in ('rooms', 'rotations', 'planners')}}
    path, text = folder / 'protocol.json', json.dumps(common, indent=2) + '\n'
    if path.exists() and path.read_text() != text:
        raise ConfigurationError(
            f'{folder}: found the results of another comparison; expected the same budgets, '
            'seeds, rig, weights and version; name another folder or remove this one')
    write_atomically(path, text)


def _weights(model: str) -> dict[str, str]:
    """Return the SHA-256 of the weights that may play: under the same name there may be others."""
    return {name: hashlib.sha256(find_model(name).read_bytes()).hexdigest()
            for name in dict.fromkeys((model, PAPER))}


def keep_task(protocol: Protocol, task: BenchmarkTask, path: Path) -> None:
    """Run a task and leave its rows in a file, whatever becomes of the other tasks."""
    write_atomically(path, json.dumps(run_task(protocol, task)))


def _in_processes(workers: int) -> Execute:
    """Run tasks in processes of this machine."""
    def execute(protocol: Protocol, tasks: dict[BenchmarkTask, Path]) -> Iterator[BenchmarkTask]:
        # Forked, threads of the parent would leave locks that nobody opens.
        with ProcessPoolExecutor(workers, mp_context=get_context('spawn')) as pool:
            futures = {pool.submit(keep_task, protocol, task, path): task
                       for task, path in tasks.items()}
            try:
                for future in as_completed(futures):
                    future.result()
                    yield futures[future]
            finally:
                pool.shutdown(wait=True, cancel_futures=True)
    return execute


def _on_ray(address: str) -> Execute:
    """Run tasks on a Ray cluster; each of its machines needs this package and the scans."""
    try:
        import ray
    except ImportError as error:
        raise ConfigurationError(
            '--ray: found no package ray; expected it; pip install "ocp_ros[ray]"') from error

    def execute(protocol: Protocol, tasks: dict[BenchmarkTask, Path]) -> Iterator[BenchmarkTask]:
        if not ray.is_initialized():
            ray.init(address=address, log_to_driver=False)
        remote = ray.remote(num_cpus=1, max_retries=2)(run_task)
        waiting = {remote.remote(protocol, task): task for task in tasks}
        while waiting:
            ready, _ = ray.wait(list(waiting))
            for reference in ready:
                task = waiting.pop(reference)
                write_atomically(tasks[task], json.dumps(ray.get(reference)))
                yield task
    return execute
