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

"""Scans and meshes, read by a library that hostile bytes can crash, in a process with limits."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from ocp_ros.util.guarded_process import GuardedProcess, ReadingCost

COSTS = {'e57': ReadingCost(600_000_000, 20, 10), 'las': ReadingCost(600_000_000, 3, 10),
         'mesh': ReadingCost(700_000_000, 40, 20), 'ply': ReadingCost(400_000_000, 40, 10)}


def read_guarded(kind: str, path: Path, columns: int, rows: int, more: Sequence[str] = ()
                 ) -> np.ndarray:
    """
    Read a file in a process of its own, which costs about half a second.

    :param kind: of file: a key of ``COSTS`` and ``READ`` in
        :mod:`~ocp_ros.scenes.reading_process`.
    :param columns: of each row.
    :param rows: how many there may be.
    :param more: arguments of what reads this kind.
    :returns: (N, columns) float64.
    :raises ValueError: if the file cannot be read, or needs more than it may.
    """
    most = 8 * columns * rows
    with GuardedProcess('ocp_ros.scenes.reading_process', [kind, str(path.absolute()), *more],
                        COSTS[kind], path.stat().st_size) as process:
        content = process.read(most + 1)
    if len(content) > most:
        raise ValueError(f'more than {rows:,} points')
    return np.frombuffer(content).reshape(-1, columns)
