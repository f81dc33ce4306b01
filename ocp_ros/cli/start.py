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

"""Entry point of the script ``ocp``: Ctrl-C ends a command without a traceback, at any time."""

import gc
import os
import signal
from typing import NoReturn

#: Exit code of a program that Ctrl-C has ended.
EXIT_STOPPED = 130


def main() -> int:
    """Run one command of ``ocp`` and return its exit code."""
    interrupts: list[int] = []

    def interrupt(signal_number, _) -> NoReturn:
        interrupts.append(signal_number)
        raise KeyboardInterrupt

    # During imports the process may end at once: no work has begun.
    signal.signal(signal.SIGINT, lambda *_: os._exit(EXIT_STOPPED))
    from ocp_ros.cli.main import main as run
    signal.signal(signal.SIGINT, interrupt)
    try:
        return _skip_cleanup(run())
    except Exception:
        # Some libraries turn an interrupt into another error.
        if interrupts:
            return EXIT_STOPPED
        raise


def _skip_cleanup(code: int) -> int:
    """Return an exit code, and turn off garbage collection, which takes half a second at exit."""
    gc.freeze()
    gc.disable()
    return code
