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
Draw how training went: what was missed in rooms never seen, and the losses, against interactions.

``python -m benchmarks.training_curves RUN [RUN ...] --out docs/training.png`` reads
the folders that ``ocp train`` left; runs of the same settings with other seeds are drawn as one
band.
"""

import argparse
from pathlib import Path
import sys
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter
import numpy as np
from ocp_ros.report.drawing.saved_pictures import save_figure
from ocp_ros.training.run_folder import read_config, records

#: By name in the progress: what the legend calls it, and how its line is drawn.
LOSSES = {'actor_loss': ('actor', '--'), 'critic_loss': ('critic', '-')}


class Plain(LogFormatter):
    """Labels of a logarithmic axis without powers of ten."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        """Return the label of a tick, or nothing where there would be too many."""
        return f'{x:g}' if super().__call__(x, pos) else ''


def label_of(folder: Path) -> str:
    """Return what runs with the same settings, but for the seed, have in common."""
    settings = read_config(folder / 'config.yaml')
    return f'{settings.agent.inputs}, reward {settings.simulation.reward.kind}'


def grouped(folders: list[Path]) -> dict[str, list[list[dict[str, Any]]]]:
    """Return the lines of progress of some runs, by label."""
    found: dict[str, list[list[dict[str, Any]]]] = {}
    for folder in folders:
        found.setdefault(label_of(folder), []).append(records(folder))
    return found


def band(runs: list[list[dict[str, Any]]], figure: str) -> tuple[np.ndarray, np.ndarray]:
    """
    Put a figure of several runs on common numbers of interactions.

    :returns: interactions (T,), and the figure of each run (S, T).
    """
    lines = [[(line['interactions'], line[figure]) for line in run if figure in line]
             for run in runs]
    lines = [np.array(line).T for line in lines if line]
    if not lines:
        return np.empty(0), np.empty((0, 0))
    first, last = max(line[0, 0] for line in lines), min(line[0, -1] for line in lines)
    common = np.unique(np.concatenate([line[0] for line in lines]))
    common = common[(common >= first) & (common <= last)]
    return common, np.array([np.interp(common, *line) for line in lines])


def draw(path: Path, folders: list[Path]) -> None:
    """
    Draw some runs.

    :param path: of the picture.
    :param folders: of the runs.
    """
    figure = Figure(figsize=(11, 4.2), layout='constrained')
    performance, losses = figure.subplots(1, 2)
    drawn = set()
    for number, (label, runs) in enumerate(grouped(folders).items()):
        colour = f'C{number}'
        turns, values = band(runs, 'ratio')
        if len(turns):
            seeds = f' ({len(values)} seeds)' if len(values) > 1 else ''
            performance.plot(turns, values.mean(axis=0), color=colour, label=label + seeds,
                             marker='.')
            performance.fill_between(turns, values.min(axis=0), values.max(axis=0), alpha=0.2,
                                     color=colour, linewidth=0)
        for name, (_, style) in LOSSES.items():
            turns, values = band(runs, name)
            if len(turns):
                losses.plot(turns, np.abs(values).mean(axis=0), style, color=colour, marker='.')
                drawn.add(name)
    performance.set(yscale='log', xlabel='interactions', title='Rooms never seen',
                    ylabel='depth error at the end / at the start')
    losses.set(yscale='log', xlabel='interactions', ylabel='loss (absolute)', title='Losses')
    for name, (short, style) in LOSSES.items():
        if name in drawn:
            losses.plot([], [], style, color='black', label=short)
    losses.legend(fontsize=8)
    for axes in (performance, losses):
        axes.grid(alpha=0.3, which='both')
        axes.yaxis.set_major_formatter(Plain())
        axes.yaxis.set_minor_formatter(Plain(minor_thresholds=(1, 0.4)))
    figure.legend(*performance.get_legend_handles_labels(), loc='outside lower center', ncols=2,
                  fontsize=8)
    save_figure(figure, path, dpi=110, format=path.suffix[1:] or 'png')


def main(argv: list[str] | None = None) -> int:
    """Draw the runs that are named."""
    parser = argparse.ArgumentParser(description='Draw how training went.')
    parser.add_argument('runs', type=Path, nargs='+', help='folders of ocp train')
    parser.add_argument('--out', type=Path, default=Path('docs/training.png'))
    arguments = parser.parse_args(argv)
    draw(arguments.out, arguments.runs)
    print(f'wrote {arguments.out}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
