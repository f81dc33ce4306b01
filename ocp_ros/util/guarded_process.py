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
TOO_SLOW_ERROR = 'it takes its reader too long'


class ReadingCost(NamedTuple):
    """
    The limits of reading a file of some kind.

    :ivar memory: bytes, for a file of any size.
    :ivar memory_per_byte: additional bytes for each byte of a file.
    :ivar seconds: seconds of all cores together, for a file of any size;
        :class:`GuardedProcess` adds seconds for each million bytes.
    """

    memory: int
    memory_per_byte: int
    seconds: int


class GuardedProcess:
    """
    A process that reads files and answers with bytes; use it in a ``with`` statement.

    Nothing is unpickled. The first arguments of the process are its limits: bytes of memory,
    seconds of all cores, and bytes of each file that it may write. The process has to apply these
    limits itself, see :mod:`~ocp_ros.util.confinement`.

    :param module: the module whose ``main(arguments)`` the process runs.
    :param arguments: the arguments of the module.
    :param cost: the limits for the kind of file.
    :param file_bytes: the size of the file that the process reads.
    :param max_written_bytes: the largest size of each file that the process may write, in bytes.
    :param more_environment: environment variables in addition to those of this process.
    """

    def __init__(self, module: str, arguments: list[str], cost: ReadingCost, file_bytes: int,
                 max_written_bytes: int = 1 << 20,
                 more_environment: Mapping[str, str] | None = None) -> None:
        # Seconds of all cores: 4 for each million bytes of a file.
        seconds = cost.seconds + 4 * file_bytes // 1_000_000
        limits = cost.memory + cost.memory_per_byte * file_bytes, seconds, max_written_bytes
        self._timeout_s = seconds + GRACE_SECONDS
        self._error_file = tempfile.TemporaryFile()  # noqa: SIM115
        # The process must not import modules from the user's current folder.
        program = ('import sys; sys.path = [folder for folder in sys.path if folder]; '
                   'from importlib import import_module; '
                   'sys.exit(import_module(sys.argv[1]).main(sys.argv[2:]))')
        self._process = subprocess.Popen(
            [sys.executable, '-c', program, module, *map(str, limits), *arguments],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._error_file,
            env={**_environment(), **(more_environment or {})})
        self._output_handle = self._process.stdout.fileno()

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
        self._error_file.close()

    def ask(self, line: str) -> None:
        """Send a line to the process; a dead process is noticed at the next read."""
        with suppress(BrokenPipeError):
            self._process.stdin.write(line.encode() + b'\n')
            self._process.stdin.flush()

    def read(self, count: int) -> bytearray:
        """
        Return the next ``count`` bytes of the output; fewer only at its end.

        :raises ValueError: if the process reports that it cannot read its file, has died, or takes
            too long.
        """
        blocks = []
        missing_bytes = count
        while missing_bytes:
            if not select.select([self._output_handle], [], [], self._timeout_s)[0]:
                raise ValueError(TOO_SLOW_ERROR)
            block = os.read(self._output_handle, min(missing_bytes, 1 << 20))
            if not block:
                self._check_exit()
                break
            blocks.append(block)
            missing_bytes -= len(block)
        return bytearray().join(blocks)

    def _check_exit(self) -> None:
        """Wait for the end of the process; raise a short ValueError if it failed or goes on."""
        try:
            code = self._process.wait(GRACE_SECONDS)
        except subprocess.TimeoutExpired:
            raise ValueError(TOO_SLOW_ERROR) from None
        # The kernel sends one of these signals if a process exceeds its processor time.
        if code in (-signal.SIGXCPU, -signal.SIGKILL):
            raise ValueError(TOO_SLOW_ERROR)
        if code < 0:
            raise ValueError('it makes its reader crash')
        if code:
            # Only the end of a long error output is read; its last line names the error.
            self._error_file.seek(max(self._error_file.seek(0, os.SEEK_END) - 4096, 0))
            lines = self._error_file.read().decode(errors='replace').splitlines()
            raise ValueError(lines[-1] if lines else f'its reader ended with {code}')


def _environment() -> dict[str, str]:
    """Return an environment in which the new process finds the modules of this process."""
    module_folders = [*filter(None, sys.path), str(Path(__file__).absolute().parents[2])]
    return {**os.environ, 'PYTHONPATH': os.pathsep.join(module_folders), 'OMP_NUM_THREADS': '1',
            'OPENBLAS_NUM_THREADS': '1'}
