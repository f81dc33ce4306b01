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

"""Entry point of the script ``ocp``: a Ctrl-C ends it without a traceback, even at the start."""

import gc
import os
import signal
from typing import NoReturn

#: Exit code of a program that Ctrl-C has ended.
STOPPED = 130


def main() -> int:
    """Run one command of ``ocp``."""
    noted: list[int] = []

    def interrupt(number, _) -> NoReturn:
        noted.append(number)
        raise KeyboardInterrupt

    # During imports nothing has started that would have to be ended.
    signal.signal(signal.SIGINT, lambda *_: os._exit(STOPPED))
    from ocp_ros.cli.main import main as run
    signal.signal(signal.SIGINT, interrupt)
    try:
        return _ending(run())
    except Exception:
        # Some libraries turn an interrupt into another error.
        if noted:
            return STOPPED
        raise


def _ending(code: int) -> int:
    """Let the system free the memory at once: Python would take half a second."""
    gc.freeze()
    gc.disable()
    return code
