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
What a process gives up before it reads a file of somebody else.

Libraries that read scans, meshes and bags resolve references, and broken files make some of them
do anything at all. A process that calls :func:`confine` opens no other file (Landlock, Linux 5.13
and later), no socket, and starts no program (seccomp). Where the kernel lacks one of the two, the
other one and the limits remain.
"""

from collections.abc import Iterable
import ctypes
import os
from pathlib import Path
import platform
import resource
import signal
import struct
import time

#: Of prctl(2): no program that is started may do more than this one, as both below ask for.
NO_NEW_PRIVILEGES = 38
#: System calls of Landlock, the same on all machines; numbers of landlock(7).
CREATE_RULESET, ADD_RULE, RESTRICT_SELF = 444, 445, 446
VERSION_FLAG, PATH_RULE, O_PATH = 1, 1, 0o10000000
READ_FILE = 1 << 2
#: Write, read, list, remove and make files, and truncate them, in a folder of its own.
USE_FOLDER = 1 << 1 | READ_FILE | 1 << 3 | 1 << 4 | 1 << 5 | 1 << 7 | 1 << 8
TRUNCATE = 1 << 14
#: How many rights each version of Landlock knows, from the first on.
RIGHTS = (13, 14, 15, 15, 16)
#: The version from which on Landlock keeps signals to the process itself, and that.
SCOPED, SCOPE_SIGNALS = 6, 2
#: Of seccomp(2): for all threads, and what a filter answers.
FILTER, ALL_THREADS, ALLOW, REFUSE, KILL = 1, 1, 0x7FFF0000, 0x00050000 | 1, 0x80000000
#: Of each kind of machine: its mark, the numbers of seccomp and of tgkill, which is only allowed
#: to end the process itself, and those of what is refused: socket, execve, execveat, ptrace,
#: process_vm_readv, process_vm_writev, kill, tkill, rt_sigqueueinfo, rt_tgsigqueueinfo,
#: pidfd_send_signal, pidfd_getfd, io_uring_setup, which could do what others may not, fchmod,
#: fchmodat, fchmodat2, fchown, fchownat, utimensat, and what is older of these.
MACHINES = {
    'x86_64': (0xC000003E, 317, 234,
               (41, 59, 322, 101, 310, 311, 62, 200, 129, 297, 424, 438, 425, 91, 268, 452, 93,
                260, 280, 90, 92, 94, 132, 235, 261)),
    'aarch64': (0xC00000B7, 277, 131,
                (198, 221, 281, 117, 270, 271, 129, 130, 138, 240, 424, 438, 425, 52, 53, 452, 55,
                 54, 88))}
#: System calls from here on are those of another ABI of x86_64.
X32 = 0x40000000

_libc = ctypes.CDLL(None, use_errno=True)


def limit(memory: int, seconds: int, written: int) -> None:
    """
    Let this process have no more than so much, and end with its parent rather than by Ctrl-C.

    :param memory: bytes.
    :param seconds: of all cores together; :func:`allow_seconds` allows more.
    :param written: bytes of each file that it writes.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for kind, value in ((resource.RLIMIT_DATA, memory), (resource.RLIMIT_FSIZE, written),
                        (resource.RLIMIT_CORE, 0)):
        resource.setrlimit(kind, (value, value))
    allow_seconds(seconds)


def allow_seconds(seconds: int) -> None:
    """Let this process have so many seconds of all cores together from now on."""
    most = resource.getrlimit(resource.RLIMIT_CPU)[1]
    resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time()) + seconds, most))


def confine(files: Iterable[str | Path], folder: str | Path | None = None) -> None:
    """
    Let this process read some files, write to one folder, and have nothing else of the machine.

    What it has open or imported already stays. Call it while there is one thread.

    :param files: that may be read; what they link to counts.
    :param folder: that may be written to, if any.
    """
    _libc.prctl(NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    _allow_files(dict.fromkeys(files, READ_FILE) | ({folder: USE_FOLDER} if folder else {}))
    _refuse_calls()


def _allow_files(rights: dict[str | Path, int]) -> None:
    """Have Landlock refuse all files but some."""
    version = _libc.syscall(CREATE_RULESET, None, 0, VERSION_FLAG)
    if version < 1:
        return
    known = (1 << RIGHTS[min(version, len(RIGHTS)) - 1]) - 1
    attribute = struct.pack('<Q', known)
    if version >= SCOPED:
        attribute = struct.pack('<QQQ', known, 0, SCOPE_SIGNALS)
    rules = _libc.syscall(CREATE_RULESET, attribute, len(attribute), 0)
    for path, right in rights.items():
        handle = os.open(path, O_PATH | os.O_CLOEXEC)
        right |= TRUNCATE if right == USE_FOLDER else 0
        _libc.syscall(ADD_RULE, rules, PATH_RULE, struct.pack('<Qi', right & known, handle), 0)
        os.close(handle)
    _libc.syscall(RESTRICT_SELF, rules, 0)
    os.close(rules)


def _refuse_calls() -> None:
    """Have seccomp refuse sockets, programs and other processes."""
    if platform.machine() not in MACHINES:
        return
    mark, seccomp, signal_thread, refused = MACHINES[platform.machine()]
    # A filter of classic BPF: load a word, jump by its value, return.
    load, equal, at_least, answer = 0x20, 0x15, 0x35, 0x06
    rows = [(load, 0, 0, 4), (equal, 1, 0, mark), (answer, 0, 0, KILL), (load, 0, 0, 0),
            (at_least, 0, 1, X32), (answer, 0, 0, REFUSE)]
    for number in refused:
        rows += [(equal, 0, 1, number), (answer, 0, 0, REFUSE)]
    # The first argument stands behind number, machine and address.
    rows += [(equal, 0, 3, signal_thread), (load, 0, 0, 16), (equal, 1, 0, os.getpid()),
             (answer, 0, 0, REFUSE), (answer, 0, 0, ALLOW)]
    code = ctypes.create_string_buffer(b''.join(struct.pack('<HBBI', *row) for row in rows))
    program = struct.pack('<HxxxxxxQ', len(rows), ctypes.addressof(code))
    _libc.syscall(seccomp, FILTER, ALL_THREADS, program)
