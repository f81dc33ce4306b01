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

"""Run tasks in parallel: in processes of this machine, or on a Ray cluster if one is given."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
import os
import signal
import threading
from typing import Any, TypeVar

from ocp_ros.util.settings import ConfigurationError, need
from ocp_ros.util.threads import cores

T = TypeVar('T')
U = TypeVar('U')


class WorkerPool:
    """
    Run functions on tasks in parallel; use it in a ``with`` statement.

    :param workers: the number of processes of this machine; 0 for one per core.
    :param ray_address: a Ray cluster to run on instead, such as ``auto``; each of its machines
        needs this package and the files that tasks name.
    :raises ConfigurationError: if Ray is not installed.
    """

    def __init__(self, workers: int = 0, ray_address: str | None = None) -> None:
        self._ray = _connect_to_ray(ray_address) if ray_address else None
        # Processes are spawned: a forked process would inherit locked locks of the parent's
        # threads.
        self._processes = None if ray_address else ProcessPoolExecutor(
            workers or cores(), mp_context=get_context('spawn'), initializer=_prepare_worker)

    def unordered(self, function: Callable[[T], U], tasks: Sequence[T]
                  ) -> Iterator[tuple[int, U]]:
        """Yield the index and the result of each task, in the order in which the tasks end."""
        if self._ray is not None:
            yield from self._on_ray(function, tasks)
            return
        with _interrupts_later():
            task_indices = {self._processes.submit(function, task): index
                            for index, task in enumerate(tasks)}
        for future in as_completed(task_indices):
            try:
                result = future.result()
            except BrokenProcessPool as error:
                raise ConfigurationError(
                    'workers: found that a process has ended in the middle of its work; expected '
                    'it to live; there may have been no memory left for it: use fewer, and start '
                    'again: what was saved is kept') from error
            yield task_indices[future], result

    def map(self, function: Callable[[T], U], tasks: Sequence[T]) -> Iterator[U]:  # noqa: A003
        """Yield the results of a function for the tasks, in the order of the tasks."""
        finished_results: dict[int, U] = {}
        next_index = 0
        for index, result in self.unordered(function, tasks):
            finished_results[index] = result
            while next_index in finished_results:
                yield finished_results.pop(next_index)
                next_index += 1

    def _on_ray(self, function: Callable[[T], U], tasks: Sequence[T]) -> Iterator[tuple[int, U]]:
        """Do the work of ``unordered`` on Ray; tasks of a lost machine run again on another."""
        # Ray accepts plain functions only, and ``function`` may be a functools.partial.
        remote_apply = self._ray.remote(num_cpus=1, max_retries=2)(_apply)
        indices = {remote_apply.remote(function, task): index for index, task in enumerate(tasks)}
        # ``wait`` returns when a task has ended: references of finished tasks, and of the others.
        while indices:
            for reference in self._ray.wait(list(indices))[0]:
                yield indices.pop(reference), self._ray.get(reference)

    def __enter__(self) -> 'WorkerPool':
        """Return the pool itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_) -> None:
        """End the processes, immediately after an error; drop the tasks that have not begun."""
        if self._processes is None:
            return
        if kind is not None:
            # The attribute of the executor is None after its processes have ended.
            for process in (getattr(self._processes, '_processes', None) or {}).copy().values():
                process.terminate()
        self._processes.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _interrupts_later() -> Iterator[None]:
    """
    Let Ctrl-C take effect at the end of the block, in which processes start.

    The new processes inherit that the signal is blocked, until they have set their own signal
    handling. In this process another thread may take the signal, so its handler waits too.
    """
    signal_mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    received: list[int] = []
    # Only the main thread may set handlers, and only there do they run.
    handler = None
    if threading.current_thread() is threading.main_thread():
        handler = signal.signal(signal.SIGINT, lambda number, frame: received.append(number))
    try:
        yield
    finally:
        if handler is not None:
            signal.signal(signal.SIGINT, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, signal_mask)
    if received:
        signal.raise_signal(signal.SIGINT)


def _apply(function: Callable[[T], U], task: T) -> U:
    """Return the result of a function for a task."""
    return function(task)


def _connect_to_ray(address: str) -> Any:
    """Connect to a Ray cluster; return the module ``ray``."""
    need('--ray', 'ray')
    import ray
    if not ray.is_initialized():
        ray.init(address=address, log_to_driver=False)
    return ray


def _prepare_worker() -> None:
    """
    Set up a worker process: use one core, ignore Ctrl-C, end when the parent process ends.

    A terminal sends Ctrl-C to all processes of a command. If a worker ended by itself, it might
    hold the lock of the queue that other workers wait for; so only the parent ends workers.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # PyTorch reads this variable when it is imported, which may be never.
    os.environ['OMP_NUM_THREADS'] = '1'
    threading.Thread(target=_exit_with_parent, args=(parent_process(),), daemon=True).start()


def _exit_with_parent(parent: Any) -> None:
    """Wait until the parent process ends, also if it is killed; then end this process."""
    parent.join()
    os._exit(1)
