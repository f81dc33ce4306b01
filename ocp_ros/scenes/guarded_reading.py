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

"""Read scans and meshes in a process with limits, since bad files can crash libraries."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from ocp_ros.util.guarded_process import GuardedProcess, ReadingCost

#: The limits of each kind of file: bytes of memory, more bytes of memory per byte of the file, and
#: seconds.
READING_COSTS = {
    'e57': ReadingCost(600_000_000, 20, 10), 'las': ReadingCost(600_000_000, 3, 10),
    'mesh': ReadingCost(700_000_000, 40, 20), 'ply': ReadingCost(400_000_000, 40, 10)}


def read_guarded(kind: str, path: Path, columns: int, max_rows: int,
                 reader_arguments: Sequence[str] = ()) -> np.ndarray:
    """
    Read a file in a separate process, which takes about half a second.

    :param kind: the kind of file, a key of ``READING_COSTS`` and of ``READERS`` in
        :mod:`~ocp_ros.scenes.reading_process`.
    :param columns: the number of columns of each row.
    :param max_rows: the largest number of rows accepted.
    :param reader_arguments: the arguments of the reader after the path.
    :returns: (N, columns) float64.
    :raises ValueError: if the file cannot be read, or exceeds a limit.
    """
    # Each number takes eight bytes.
    max_bytes = 8 * columns * max_rows
    arguments = [kind, str(path.absolute()), *reader_arguments]
    with GuardedProcess('ocp_ros.scenes.reading_process', arguments, READING_COSTS[kind],
                        path.stat().st_size) as process:
        # One byte more is read to notice too many rows.
        content = process.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise ValueError(f'more than {max_rows:,} points')
    return np.frombuffer(content).reshape(-1, columns)
