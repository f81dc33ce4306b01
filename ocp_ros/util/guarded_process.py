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

"""
Run libraries that hostile bytes can crash or exploit in a confined process with limits.

Libraries that read scans, meshes and bags resolve references, and broken files can make some of
them execute anything. A :class:`GuardedProcess` calls :func:`limit` and :func:`confine` itself.
After that it cannot open other files (Landlock, Linux 5.13 and later) or sockets, and cannot start
programs (seccomp). If the kernel lacks Landlock or seccomp, the other one and the limits of
:func:`limit` remain.
"""

from collections.abc import Iterable, Mapping
from contextlib import suppress
import ctypes
import os
from pathlib import Path
import platform
import resource
import select
import signal
import struct
import subprocess
import sys
import tempfile
import time
from typing import NamedTuple

#: Seconds to wait for a process beyond its own time limit.
GRACE_SECONDS = 60
TOO_SLOW_ERROR = 'it takes its reader too long'
#: For each machine: its constant in seccomp(2); the numbers of the calls seccomp and tgkill (which
#: may only signal the process itself); and the numbers of the refused calls: socket, execve,
#: execveat, ptrace, process_vm_readv, process_vm_writev, kill, tkill, rt_sigqueueinfo,
#: rt_tgsigqueueinfo, pidfd_send_signal, pidfd_getfd, io_uring_setup (which could bypass the
#: filter), fchmod, fchmodat, fchmodat2, fchown, fchownat, utimensat, and older variants of these.
MACHINES = {
    'x86_64': (0xC000003E, 317, 234, (
        41, 59, 322, 101, 310, 311, 62, 200, 129, 297, 424, 438, 425, 91, 268, 452, 93, 260, 280,
        90, 92, 94, 132, 235, 261)),
    'aarch64': (0xC00000B7, 277, 131, (
        198, 221, 281, 117, 270, 271, 129, 130, 138, 240, 424, 438, 425, 52, 53, 452, 55, 54, 88))}

_libc = ctypes.CDLL(None, use_errno=True)


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
    limits itself, see :func:`limit`.

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


def limit(memory_bytes: int, processor_seconds: int, file_bytes: int) -> None:
    """
    Limit memory, time and files of this process; ignore Ctrl-C: the parent ends this process.

    :param memory_bytes: the largest memory.
    :param processor_seconds: seconds of all cores together; :func:`allow_seconds` allows more.
    :param file_bytes: the largest size of each file that this process writes.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for kind, maximum in ((resource.RLIMIT_DATA, memory_bytes),
                          (resource.RLIMIT_FSIZE, file_bytes), (resource.RLIMIT_CORE, 0)):
        resource.setrlimit(kind, (maximum, maximum))
    allow_seconds(processor_seconds)


def allow_seconds(seconds: int) -> None:
    """Allow this process ``seconds`` more seconds of all cores together, from now on."""
    hard_limit = resource.getrlimit(resource.RLIMIT_CPU)[1]
    resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time()) + seconds, hard_limit))


def confine(files: Iterable[str | Path], folder: str | Path | None = None,
            readable_folders: Iterable[str | Path] = ()) -> None:
    """
    Restrict this process to reading some files and folders, and writing to one folder.

    Open files and imported modules stay usable. Call this function while there is one thread.

    :param files: the files that may be read; the targets of links count.
    :param folder: the folder that may be written to; None if no folder may.
    :param readable_folders: folders of which all files may be read, such as those of libraries.
    """
    # Option 38 of prctl(2): started programs get no more rights than this process. Landlock and
    # seccomp require this option.
    _libc.prctl(38, 1, 0, 0, 0)
    # Rights of Landlock, see landlock(7). In a folder: write (bit 1) and read files, list (3),
    # remove folders (4) and files (5), make folders (7) and files (8), truncate files (14).
    read_file = 1 << 2
    use_folder = 1 << 1 | read_file | 1 << 3 | 1 << 4 | 1 << 5 | 1 << 7 | 1 << 8 | 1 << 14
    read_folder = read_file | 1 << 3
    _allow_files(dict.fromkeys(files, read_file) | dict.fromkeys(readable_folders, read_folder)
                 | ({folder: use_folder} if folder else {}))
    _refuse_calls()


def _allow_files(rights: dict[str | Path, int]) -> None:
    """Restrict file access with Landlock to some files and folders, each with its rights."""
    # System calls of Landlock, the same on all machines, see landlock(7).
    create_ruleset = 444
    # Flag 1 asks for the version of Landlock.
    version = _libc.syscall(create_ruleset, None, 0, 1)
    if version < 1:
        # The kernel lacks Landlock.
        return
    # The number of rights of each version, from the first on. Each right is one bit of a mask.
    rights_of_version = (13, 14, 15, 15, 16)
    known_rights = (1 << rights_of_version[min(version, len(rights_of_version)) - 1]) - 1
    # The rights in the first field are refused everywhere, except where a rule grants them.
    attribute = struct.pack('<Q', known_rights)
    # From version 6 on, there are two more fields: 0 leaves the network to seccomp, and flag 2
    # restricts signals to the process itself.
    if version >= 6:
        attribute = struct.pack('<QQQ', known_rights, 0, 2)
    ruleset = _libc.syscall(create_ruleset, attribute, len(attribute), 0)
    for path, path_rights in rights.items():
        handle = os.open(path, os.O_PATH | os.O_CLOEXEC)
        # Call 445 adds a rule of kind 1, for files below a path. A rule must not grant rights that
        # this version does not know.
        rule = struct.pack('<Qi', path_rights & known_rights, handle)
        _libc.syscall(445, ruleset, 1, rule, 0)
        os.close(handle)
    # Call 446 restricts this process.
    _libc.syscall(446, ruleset, 0)
    os.close(ruleset)


def _refuse_calls() -> None:
    """Refuse sockets, programs and access to other processes with seccomp."""
    if platform.machine() not in MACHINES:
        return
    architecture, seccomp, tgkill, refused = MACHINES[platform.machine()]
    # Instructions of a filter in classic BPF: load a word, compare it and jump, return an answer.
    # Each row has the instruction, the rows to skip if equal, those if not, and a value.
    load, equal, at_least, answer = 0x20, 0x15, 0x35, 0x06
    # The answers, see seccomp(2); a refused call fails with error 1, EPERM.
    allow = 0x7FFF0000
    refuse = 0x00050000 | 1
    kill = 0x80000000
    # Bytes in the filter's data: the call at 0, the architecture at 4, the first argument at 16.
    # Calls from 0x40000000 on are those of another ABI of x86_64.
    rows = [(load, 0, 0, 4), (equal, 1, 0, architecture), (answer, 0, 0, kill),
            (load, 0, 0, 0), (at_least, 0, 1, 0x40000000), (answer, 0, 0, refuse)]
    for number in refused:
        rows += [(equal, 0, 1, number), (answer, 0, 0, refuse)]
    # tgkill is allowed for this process only, every other call for all.
    rows += [(equal, 0, 3, tgkill), (load, 0, 0, 16), (equal, 1, 0, os.getpid()),
             (answer, 0, 0, refuse), (answer, 0, 0, allow)]
    code = ctypes.create_string_buffer(b''.join(struct.pack('<HBBI', *row) for row in rows))
    # A program is the number of its rows, six unused bytes, and the address of the rows.
    program = struct.pack('<HxxxxxxQ', len(rows), ctypes.addressof(code))
    # Operation 1 of seccomp(2) sets a filter; flag 1 sets it for all threads.
    _libc.syscall(seccomp, 1, 1, program)
