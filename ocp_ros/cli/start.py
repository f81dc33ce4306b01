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

"""Entry point of the script ``ocp``: a signal ends a command without a traceback, at any time."""

import atexit
from contextlib import suppress
import gc
import os
import signal
import sys
from typing import NoReturn

from ocp_ros.cli import EXIT_STOPPED


def main() -> int:
    """Run one command of ``ocp`` and return its exit code."""
    interrupts: list[int] = []

    def interrupt(signal_number, _) -> NoReturn:
        interrupts.append(signal_number)
        raise KeyboardInterrupt

    # During imports the process may end at once, because no work has begun.
    signal.signal(signal.SIGINT, _stop)
    # A plain ``kill`` does what Ctrl-C does, whatever handles that at the time.
    signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))
    from ocp_ros.cli.main import main as run
    signal.signal(signal.SIGINT, interrupt)
    try:
        code = run()
    except BaseException:
        # An interrupt may come before the command runs, and a library may turn it into another
        # error. Errors without an interrupt are raised again.
        if not interrupts:
            raise
        code = EXIT_STOPPED
    if interrupts:
        _exit_now(code)
    # Avoid the garbage collection at exit, which takes half a second.
    gc.freeze()
    gc.disable()
    return code


def _stop(*_: object) -> NoReturn:
    """End the process at once."""
    os._exit(EXIT_STOPPED)


def _exit_now(code: int) -> NoReturn:
    """
    End the process after its exit functions, without the cleanup of the interpreter.

    An interrupted thread may still import a compiled library, which sometimes crashes in that
    cleanup.
    """
    signal.signal(signal.SIGINT, _stop)
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        # The reader of a pipe may be gone.
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)
