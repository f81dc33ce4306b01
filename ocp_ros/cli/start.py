# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the script ``ocp`` calls: a Ctrl-C ends it without a page of traceback, from the start."""

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

    # Nothing has begun yet that would have to be ended.
    signal.signal(signal.SIGINT, lambda *_: os._exit(STOPPED))
    from ocp_ros.cli.main import main as run
    signal.signal(signal.SIGINT, interrupt)
    try:
        return run()
    except Exception:
        # Some libraries take an interrupt for an error of their own.
        if noted:
            return STOPPED
        raise
