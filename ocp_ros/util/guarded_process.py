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

"""Run libraries that hostile bytes can crash or exploit in a process with limits."""

from collections.abc import Mapping
from contextlib import suppress
import os
from pathlib import Path
import select
import signal
import subprocess
import sys
import tempfile
from typing import NamedTuple

#: Seconds to wait for a process beyond its own time limit.
GRACE_SECONDS = 60
#: The default largest size in bytes of a file that it writes.
MAX_WRITTEN_BYTES = 1 << 20
TOO_SLOW = 'it takes its reader too long'


class ReadingCost(NamedTuple):
    """
    The limits of reading a file of some kind.

    :ivar memory: bytes, independent of the file.
    :ivar memory_per_byte: bytes for each byte of a file.
    :ivar seconds: seconds of all cores together, independent of the file; ``SECONDS_PER_MB`` is
        added.
    """

    memory: int
    memory_per_byte: int
    seconds: int


class GuardedProcess:
    """
    A process that reads files and answers with bytes; use it in a ``with`` statement.

    Nothing is unpickled. The first arguments of the process are its limits: bytes of memory,
    seconds of all cores, and bytes of each file that it may write. It has to apply them itself,
    see :mod:`~ocp_ros.util.confinement`.

    :param module: the module whose ``main`` it runs.
    :param arguments: the arguments of the module.
    :param cost: the limits for the kind of file.
    :param size: the size of the file in bytes.
    :param written: bytes of each file that it may write.
    :param more: more environment variables.
    """

    def __init__(self, module: str, arguments: list[str], cost: ReadingCost, size: int,
                 written: int = MAX_WRITTEN_BYTES, more: Mapping[str, str] | None = None) -> None:
        # Seconds of all cores: 4 for each million bytes of a file.
        seconds = cost.seconds + 4 * size // 1_000_000
        limits = cost.memory + cost.memory_per_byte * size, seconds, written
        self._patience = seconds + GRACE_SECONDS
        self._words = tempfile.TemporaryFile()  # noqa: SIM115
        # The process must not import modules from the user's current folder.
        program = ('import sys; sys.path = [folder for folder in sys.path if folder]; '
                   'from importlib import import_module; '
                   'sys.exit(import_module(sys.argv[1]).main(sys.argv[2:]))')
        self._process = subprocess.Popen(
            [sys.executable, '-c', program, module, *map(str, limits), *arguments],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._words,
            env={**_environment(), **(more or {})})
        self._out = self._process.stdout.fileno()

    def __enter__(self) -> 'GuardedProcess':
        """Return itself."""
        return self

    def __exit__(self, *exception) -> None:
        """Kill the process."""
        self._process.kill()
        self._process.wait()
        self._process.stdout.close()
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        self._words.close()

    def ask(self, line: str) -> None:
        """Send a line to the process; a dead process is noticed at the next read."""
        with suppress(BrokenPipeError):
            self._process.stdin.write(line.encode() + b'\n')
            self._process.stdin.flush()

    def read(self, count: int) -> bytearray:
        """
        Return the next bytes: fewer than ``count`` only at the end.

        :raises ValueError: if the process reports that it cannot read its file, has died, or takes
            too long.
        """
        parts, left = [], count
        while left:
            if not select.select([self._out], [], [], self._patience)[0]:
                raise ValueError(TOO_SLOW)
            part = os.read(self._out, min(left, 1 << 20))
            if not part:
                self._check_end()
                break
            parts.append(part)
            left -= len(part)
        return bytearray().join(parts)

    def _check_end(self) -> None:
        """Raise a short error if the process failed."""
        try:
            code = self._process.wait(GRACE_SECONDS)
        except subprocess.TimeoutExpired:
            raise ValueError(TOO_SLOW) from None
        if code in (-signal.SIGXCPU, -signal.SIGKILL):
            raise ValueError(TOO_SLOW)
        if code < 0:
            raise ValueError('it makes its reader crash')
        if code:
            # The last 4096 bytes of the error output.
            self._words.seek(-min(4096, self._words.seek(0, os.SEEK_END)), os.SEEK_END)
            lines = self._words.read().decode(errors='replace').splitlines()
            raise ValueError(lines[-1] if lines else f'its reader ended with {code}')


def _environment() -> dict[str, str]:
    """Return an environment in which the process finds the modules of this one."""
    places = [*filter(None, sys.path), str(Path(__file__).absolute().parents[2])]
    return {**os.environ, 'PYTHONPATH': os.pathsep.join(places), 'OMP_NUM_THREADS': '1',
            'OPENBLAS_NUM_THREADS': '1'}
