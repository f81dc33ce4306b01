# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Libraries that hostile bytes can crash, asked to read a file in a process with limits."""

import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
from typing import NamedTuple

import numpy as np

#: Seconds to wait for a process that uses no core, beyond those that it may use one; and seconds
#: of all cores for each million bytes of a file.
PATIENCE, SECONDS_PER_MB = 60, 4
#: Bytes of its last words that are read.
WORDS = 4096
READER = 'ocp_ros.scenes.reading_process'


class ReadingCost(NamedTuple):
    """
    What reading a file of some kind may take.

    :ivar memory: bytes that it takes with any file.
    :ivar memory_per_byte: bytes for each byte of a file.
    :ivar seconds: of all cores together with any file; ``SECONDS_PER_MB`` come on top.
    """

    memory: int
    memory_per_byte: int
    seconds: int


COSTS = {'e57': ReadingCost(600_000_000, 20, 10), 'las': ReadingCost(600_000_000, 3, 10),
         'mesh': ReadingCost(700_000_000, 40, 20)}


def read_guarded(kind: str, path: Path, columns: int, rows: int) -> np.ndarray:
    """
    Read a file in a process of its own, which costs about half a second.

    Nothing is unpickled: the process answers with bare numbers.

    :param kind: of file: a key of ``COSTS`` and ``READ`` in
        :mod:`~ocp_ros.scenes.reading_process`.
    :param columns: of each row.
    :param rows: how many there may be.
    :returns: (N, columns) float64.
    :raises ValueError: if the file cannot be read, or needs more than it may.
    """
    cost, size = COSTS[kind], path.stat().st_size
    seconds = cost.seconds + SECONDS_PER_MB * size // 1_000_000
    limits = cost.memory + cost.memory_per_byte * size, seconds, 8 * columns * rows + WORDS
    command = [sys.executable, '-m', READER, kind, str(path.absolute()), *map(str, limits)]
    with tempfile.TemporaryFile() as found, tempfile.TemporaryFile() as words:
        try:
            code = subprocess.run(command, stdin=subprocess.DEVNULL, stdout=found, stderr=words,
                                  env=_environment(), check=False,
                                  timeout=seconds + PATIENCE).returncode
        except subprocess.TimeoutExpired:
            code = -signal.SIGXCPU
        if code:
            raise ValueError(_reason(code, words))
        found.seek(0)
        return np.fromfile(found, dtype=np.float64).reshape(-1, columns)


def _environment() -> dict[str, str]:
    """Return an environment in which the process finds what this one has imported."""
    path = os.pathsep.join(folder or os.getcwd() for folder in sys.path)
    # Modules of the folder that a user happens to be in are not to be imported.
    return {**os.environ, 'PYTHONPATH': path, 'PYTHONSAFEPATH': '1', 'OMP_NUM_THREADS': '1',
            'OPENBLAS_NUM_THREADS': '1'}


def _reason(code: int, words) -> str:
    """Say in a few words why a process ended with a code."""
    if code in (-signal.SIGXCPU, -signal.SIGKILL):
        return 'it takes its reader too long'
    if code < 0:
        return 'it makes its reader crash'
    words.seek(-min(WORDS, words.seek(0, os.SEEK_END)), os.SEEK_END)
    lines = words.read().decode(errors='replace').splitlines()
    return lines[-1] if lines else f'its reader ended with {code}'
