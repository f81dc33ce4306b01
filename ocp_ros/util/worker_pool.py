# SPDX-License-Identifier: Apache-2.0
"""Processes that play episodes, each on a core of its own."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context, parent_process
import os
import threading
from typing import TypeVar

from ocp_ros.util.threads import cores

T, U = TypeVar('T'), TypeVar('U')


class WorkerPool:
    """
    Play many episodes at once.

    :param workers: how many processes; 0 for one on each core.
    """

    def __init__(self, workers: int = 0) -> None:
        # Forked, threads of the parent would leave locks that nobody opens.
        self._pool = ProcessPoolExecutor(workers or cores(), mp_context=get_context('spawn'),
                                         initializer=_alone)

    def play(self, function: Callable[[T], U], tasks: Sequence[T]) -> Iterator[U]:
        """Yield what a function returns for each task, in their order."""
        return self._pool.map(function, tasks)

    def __enter__(self) -> 'WorkerPool':
        """Return the crew itself."""
        return self

    def __exit__(self, *_) -> None:
        """Send everybody home."""
        self._pool.shutdown(wait=True, cancel_futures=True)


def _alone() -> None:
    """Use one core only, since the others have their own work; go when nobody waits any more."""
    import torch
    torch.set_num_threads(1)
    threading.Thread(target=_follow, args=(parent_process(),), daemon=True).start()


def _follow(parent) -> None:
    """End with the parent, however it ended: a killed one tells nobody."""
    parent.join()
    os._exit(1)
