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

"""The number of cameras that reaches a target: errors and shares as table and picture."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ocp_ros.report.key_figures import percent
from rich.console import Console
from rich.table import Table

#: Column head of each share; none of them is a share of all points.
HEADS = {'seen': 'of visible points', 'coverage': 'of reachable space',
         'error': 'of error reduction'}
#: Denominator of each share, in words.
SHARES = {'seen': 'points that can be seen', 'coverage': 'space that can be covered',
          'error': 'possible error reduction'}


def show_curve(console: Console, rows: Sequence[dict[str, Any]], count: dict[str, Any]) -> None:
    """Print the scores of each number of cameras, and the number that reaches the target."""
    table = Table('cameras', 'objective value', 'depth error', *HEADS.values(),
                  title='Number of cameras')
    for row in rows:
        table.add_row(str(row['cameras']), f'{row["loss"]:.4f}', f'{row["depth_error"]:.3f} m',
                      *(percent(row[f'share_{name}']) for name in SHARES))
    console.print(table)
    console.print(sentence(count), highlight=False)


def sentence(count: dict[str, Any]) -> str:
    """Return the number of cameras that reaches the target, in words, without claiming a proof."""
    asked, cameras = f'{percent(count["target"])} of the {SHARES[count["by"]]}', count['cameras']
    several = f'{cameras} camera{"s" * (cameras > 1)}'
    if not count['reached']:
        return f'{several}, the largest number planned, did not reach {asked} in this search'
    fewer = count.get('fewer')
    return f'{several} reach{"es" * (cameras == 1)} {asked}' + (
        f'; {fewer} did not in this search' if fewer else '')


def draw_curve(path: Path, rows: Sequence[dict[str, Any]], count: dict[str, Any]) -> Path:
    """Draw shares and depth error against the number of cameras as PNG."""
    # The import of the drawing modules is slow, and most plans draw no curve.
    from ocp_ros.report.drawing.figures import Figure, save_figure
    from ocp_ros.report.drawing.room_drawing import INK, PALE_INK
    figure = Figure(figsize=(7.0, 4.5), dpi=100, facecolor='white')
    axes = figure.add_subplot()
    cameras = [row['cameras'] for row in rows]
    for name, style in zip(SHARES, ('o-', 's--', '^:')):
        axes.plot(cameras, [100.0 * row[f'share_{name}'] for row in rows], style,
                  color=INK if name == count['by'] else PALE_INK, label=SHARES[name])
    axes.axhline(100.0 * count['target'], color=INK, lw=0.8, ls=':')
    axes.set(xlabel='cameras', ylabel='per cent', xticks=cameras, ylim=(0.0, 102.0))
    error = axes.twinx()
    error.plot(cameras, [row['depth_error'] for row in rows], 'x-', color='tab:red',
               label='depth error')
    error.set_ylim(bottom=0.0)
    error.set_ylabel('depth error (m)', color='tab:red')
    axes.legend(loc='center right', fontsize=8)
    axes.set_title(sentence(count), fontsize=9)
    figure.tight_layout()
    save_figure(figure, path, dpi=100)
    return path
