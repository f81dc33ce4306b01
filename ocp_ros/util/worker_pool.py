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
from multiprocessing import get_context, parent_process
import os
import signal
import threading
from typing import Any, TypeVar

from ocp_ros.util.settings import ConfigurationError
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
        self._ray = _connected(ray_address) if ray_address else None
        # Processes are spawned: a forked process would inherit locked locks of the parent's
        # threads.
        self._processes = None if ray_address else ProcessPoolExecutor(
            workers or cores(), mp_context=get_context('spawn'), initializer=_work_alone)

    def unordered(self, function: Callable[[T], U], tasks: Sequence[T]
                  ) -> Iterator[tuple[int, U]]:
        """Yield the number and the result of each task, in the order in which they end."""
        if self._ray is not None:
            yield from self._on_ray(function, tasks)
            return
        # Ctrl-C must not interrupt processes before they have set their signal handling.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            numbers = {self._processes.submit(function, task): number
                       for number, task in enumerate(tasks)}
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for future in as_completed(numbers):
            try:
                result = future.result()
            except BrokenProcessPool as error:
                raise ConfigurationError(
                    'workers: found that a process has ended in the middle of its work; expected '
                    'it to live; there may have been no memory left for it: use fewer, and start '
                    'again: what was saved is kept') from error
            yield numbers[future], result

    def map(self, function: Callable[[T], U], tasks: Sequence[T]) -> Iterator[U]:  # noqa: A003
        """Yield the results of a function for the tasks, in the order of the tasks."""
        waiting: dict[int, U] = {}
        due = 0
        for number, result in self.unordered(function, tasks):
            waiting[number] = result
            while due in waiting:
                yield waiting.pop(due)
                due += 1

    def _on_ray(self, function: Callable[[T], U], tasks: Sequence[T]) -> Iterator[tuple[int, U]]:
        """Run tasks on the cluster; a task whose machine is lost runs again on another."""
        # Ray accepts plain functions only, and the function may be a partial one.
        remote = self._ray.remote(num_cpus=1, max_retries=2)(_applied)
        numbers = {remote.remote(function, task): number for number, task in enumerate(tasks)}
        while numbers:
            for reference in self._ray.wait(list(numbers))[0]:
                yield numbers.pop(reference), self._ray.get(reference)

    def __enter__(self) -> 'WorkerPool':
        """Return the pool itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_) -> None:
        """End the processes, after an error immediately; tasks not yet begun are dropped."""
        if self._processes is None:
            return
        if kind is not None:
            # The attribute is None after they have ended.
            for process in (getattr(self._processes, '_processes', None) or {}).copy().values():
                process.terminate()
        self._processes.shutdown(wait=True, cancel_futures=True)


def _applied(function: Callable[[T], U], task: T) -> U:
    """Run a function on a task."""
    return function(task)


def _connected(address: str) -> Any:
    """Return the module ``ray``, connected to a cluster."""
    try:
        import ray
    except ImportError as error:
        raise ConfigurationError(
            '--ray: found no package ray; expected it; pip install "ocp_ros[ray]"') from error
    if not ray.is_initialized():
        ray.init(address=address, log_to_driver=False)
    return ray


def _work_alone() -> None:
    """
    Use one core only, since other processes use the others; end with the parent.

    A terminal interrupts all processes of a command, so these ignore Ctrl-C and the parent ends
    them. A process that ends by itself may hold the lock of the queue that the others wait for.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # PyTorch reads this variable when it is imported, which may be never.
    os.environ['OMP_NUM_THREADS'] = '1'
    threading.Thread(target=_end_with, args=(parent_process(),), daemon=True).start()


def _end_with(parent: Any) -> None:
    """End with the parent, also if it was killed."""
    parent.join()
    os._exit(1)
