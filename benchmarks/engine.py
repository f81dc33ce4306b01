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
Measure how true the engine's visibility is and how fast it is: ``python -m benchmarks.engine``.

:mod:`benchmarks.engine_bench` measures in scans of tripods, :mod:`benchmarks.fused_bench` in scans
of a camera in the hand.
"""

import argparse
from collections.abc import Sequence
import sys
from typing import Any

from benchmarks import results
from benchmarks.engine_bench import EXTENTS, FIGURES, measure_engine
from benchmarks.fused_bench import EXTENTS as FUSED_EXTENTS
from benchmarks.fused_bench import measure_fused
from rich.console import Console
from rich.table import Table


def show(figures: dict[str, Any]) -> None:
    """Print the figures."""
    table = Table('points', 'method', 'precision', 'recall', 'F1', 'ms', 'ns per point',
                  title='Visibility from one camera against ray casting, one thread')
    for row in figures['visibility']:
        table.add_row(f'{row["density"]:,}', row['method'], f'{row["precision"]:.3f}',
                      f'{row["recall"]:.3f}', f'{row["f1"]:.3f}', f'{row["ms"]:.2f}',
                      f'{row["ns_per_point_camera"]:.1f}')
    fused = Table('points', 'method', 'precision', 'recall', 'F1',
                  title='Frames predicted from scans that were fused of other frames')
    for row in figures['fused']:
        fused.add_row(f'{row["density"]:,}', row['method'],
                      *(f'{row[name]:.3f}' for name in ('precision', 'recall', 'f1')))
    console = Console(width=110)
    console.print(table, fused)
    for name in FIGURES:
        console.print(f'{name}: {figures[name]:.1f}')


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, and print the figures."""
    parser = argparse.ArgumentParser(description='Measure the engine on this machine.')
    parser.add_argument('--preset', choices=('smoke', 'full'), default='smoke',
                        help='smoke: under a minute; full: a quarter of an hour')
    results.add_record(parser, 'engine')
    options = parser.parse_args(argv)
    figures = {**measure_engine(EXTENTS[options.preset]),
               **measure_fused(FUSED_EXTENTS[options.preset])}
    show(figures)
    if options.record:
        results.write('engine', figures, results.command_of('engine', argv))
    return 0


if __name__ == '__main__':
    sys.exit(main())
