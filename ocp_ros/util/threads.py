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

"""Spread work of the engine over threads; its kernels release the GIL."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
import ctypes
import os
from typing import TypeVar

T = TypeVar('T')
U = TypeVar('U')

#: The threads besides the calling thread; None if there is only that thread.
_helpers: ThreadPoolExecutor | None = None
_thread_count = 1


def return_freed_arrays() -> None:
    """Let the C library return large freed arrays to the system at once, if it is glibc."""
    # Otherwise each thread keeps freed arrays of up to 32 MB for itself. Those of the trees of one
    # viewpoint have about half a megabyte in a scan of 200,000 points.
    mmap_threshold, limit_bytes = -3, 1 << 18
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).mallopt(mmap_threshold, limit_bytes)


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


def set_threads(count: int) -> None:
    """
    Set the number of threads that this process uses for one task; the default is one.

    :param count: the number of threads; 0 for one per available core.
    """
    global _helpers, _thread_count
    count = count or cores()
    if count != _thread_count:
        if _helpers is not None:
            _helpers.shutdown()
        _helpers = ThreadPoolExecutor(count - 1) if count > 1 else None
        _thread_count = count


def _reset_after_fork() -> None:
    """Reset to one thread, since a forked process does not have the threads of its parent."""
    global _helpers, _thread_count
    _helpers = None
    _thread_count = 1


os.register_at_fork(after_in_child=_reset_after_fork)


def mapped(function: Callable[[T], U], items: Sequence[T]) -> list[U]:
    """
    Return the results of a function for items, in the order of the items.

    :param function: must not call ``mapped``: all threads might then wait for a free thread.
    """
    helpers = _helpers
    share_count = min(_thread_count, len(items))
    if helpers is None or share_count < 2:
        return [function(item) for item in items]
    # Share k has the items from bound k up to bound k + 1.
    bounds = [len(items) * share // share_count for share in range(share_count + 1)]

    def apply_to_share(share: int) -> list[U]:
        return [function(item) for item in items[bounds[share]:bounds[share + 1]]]

    # The calling thread takes the first share.
    futures = [helpers.submit(apply_to_share, share) for share in range(1, share_count)]
    return apply_to_share(0) + [result for future in futures for result in future.result()]
