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

"""What drills with nodes have in common: they run, are recorded, and watch the memory of nodes."""

import argparse
from collections.abc import Callable, Mapping, Sequence
import json
from pathlib import Path
import re
from typing import Any

from benchmarks import results
from ocp_ros.demo.watched_nodes import run_watched, Watch

#: MB that the memory of a node may grow by, once it has done all that it does.
MOST_GROWTH = 20.0


def grown(growth: Mapping[str, float]) -> list[str]:
    """Return a sentence for each node whose memory has grown, MB by name, by more than it may."""
    return [f'{name}: found that its memory has grown by {mb:.1f} MB; expected less than '
            f'{MOST_GROWTH:g}' for name, mb in growth.items() if mb >= MOST_GROWTH]


def rss_of(pid: int) -> float:
    """
    Return the resident memory of a process, MB; 0 if there is none.

    Pages of files are left out: the system takes those of libraries back, and gives them again, as
    other programs need room.
    """
    try:
        status = Path(f'/proc/{pid}/status').read_text()
    except OSError:
        return 0.0
    sizes = re.findall(r'^Rss(?:Anon|Shmem):\s+(\d+) kB$', status, re.MULTILINE)
    return sum(map(int, sizes)) * 1024 / 1e6


def run_drill(name: str, options: argparse.Namespace, argv: Sequence[str] | None,
              play: Callable[[argparse.Namespace, int, Watch], dict[str, Any]],
              part: str = '') -> int:
    """
    Run a drill, write ``NAME.json`` into its folder, and record it where that is asked for.

    :param name: of the drill, which is its module in ``benchmarks.drills``.
    :param options: of the command line, with ``out`` and ``record``.
    :param argv: the command line, None for that of this process.
    :param play: gets the options, the ROS domain and who watches; returns the figures, with the
        key ``faults`` for what went wrong.
    :param part: key of the figures in ``docs/results/drills.json``; the name if empty.
    :returns: the exit code: 2 if something went wrong.
    """
    code = run_watched(name, options.out, lambda domain, watch: play(options, domain, watch),
                       lambda figures: print(json.dumps(figures, indent=2)))
    if options.record and code == 0:
        figures = json.loads((options.out / f'{name}.json').read_bytes())
        results.write('drills', figures, results.command_of(f'drills.{name}', argv), part or name)
    return code
