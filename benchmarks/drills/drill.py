# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What drills with nodes have in common: run, show and record."""

import argparse
from collections.abc import Callable, Sequence
import json
from typing import Any

from benchmarks import results
from ocp_ros.demo.watcher import run_watched, show_json, Watch


def run_drill(name: str, options: argparse.Namespace, argv: Sequence[str] | None,
              play: Callable[[argparse.Namespace, int, Watch], dict[str, Any]]) -> int:
    """
    Run a drill, write ``NAME.json`` into its folder, and record it where that is asked for.

    :param name: of the drill, which is its module in ``benchmarks.drills``.
    :param options: of the command line, with ``out`` and ``record``.
    :param argv: the command line, None for that of this process.
    :param play: gets the options, the ROS domain and who watches; returns the figures, with the
        key ``faults`` for what went wrong.
    :returns: the exit code: 2 if something went wrong.
    """
    code = run_watched(name, options.out, lambda domain, watch: play(options, domain, watch),
                       show_json)
    if options.record and code == 0:
        figures = json.loads((options.out / f'{name}.json').read_bytes())
        results.write(name, figures, results.command_of(f'drills.{name}', argv))
    return code
