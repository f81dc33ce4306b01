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
import os
from typing import TypeVar

T = TypeVar('T')
U = TypeVar('U')

_helpers: ThreadPoolExecutor | None = None
_count = 1


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


def set_threads(count: int) -> None:
    """
    Set the number of threads that this process uses for one task; the default is one.

    :param count: the number of threads; 0 for one per available core.
    """
    global _helpers, _count
    count = count or cores()
    if count != _count:
        if _helpers is not None:
            _helpers.shutdown()
        _helpers, _count = ThreadPoolExecutor(count - 1) if count > 1 else None, count


def _forked() -> None:
    """Reset to one thread, since a forked process has no threads of its parent."""
    global _helpers, _count
    _helpers, _count = None, 1


os.register_at_fork(after_in_child=_forked)


def mapped(function: Callable[[T], U], items: Sequence[T]) -> list[U]:
    """Apply a function to all items in order; it must not call ``mapped`` itself."""
    helpers, count = _helpers, min(_count, len(items))
    if helpers is None or count < 2:
        return [function(item) for item in items]
    ends = [len(items) * k // count for k in range(count + 1)]

    def part(k: int) -> list[U]:
        return [function(item) for item in items[ends[k]:ends[k + 1]]]

    others = [helpers.submit(part, k) for k in range(1, count)]
    return part(0) + [result for other in others for result in other.result()]
