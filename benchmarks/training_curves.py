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

``python -m benchmarks.training_curves RUN [RUN ...] --out docs/training.png`` reads the folders
that ``ocp train`` left, and models, whose cards have the curve; runs of the same settings with
other seeds are drawn as one band. With ``--record`` the runs are seeds of the model that comes
first: the best of each goes to its card and to ``docs/results/training.json``, where ``--ros``
keeps the figures of a training by ``trainer_node`` (``train_demo.json``).
"""

import argparse
from dataclasses import replace
import json
from pathlib import Path
import sys
from typing import Any, NamedTuple

from benchmarks import results
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter
import numpy as np
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.report.drawing.saved_pictures import save_figure
from ocp_ros.training.run_folder import read_config, records

#: By name in the progress: what the legend calls it, and how its line is drawn.
LOSSES = {'actor_loss': ('actor', '--'), 'critic_loss': ('critic', '-')}


class Plain(LogFormatter):
    """Labels of a logarithmic axis without powers of ten."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        """Return the label of a tick, or nothing where there would be too many."""
        return f'{x:g}' if super().__call__(x, pos) else ''


class Run(NamedTuple):
    """
    A training.

    :ivar label: what runs with the same settings, but for the seed, have in common.
    :ivar seed: of the training.
    :ivar lines: the evaluations, see :func:`ocp_ros.training.run_folder.records`.
    """

    label: str
    seed: int
    lines: list[dict[str, Any]]

    @property
    def best(self) -> dict[str, float]:
        """Return the smallest error at the end / at the start, and when it was reached."""
        line = min(self.lines, key=lambda line: line['ratio'])
        return {'ratio': line['ratio'], 'interactions': line['interactions'],
                'of': self.lines[-1]['interactions']}


def run_of(path: Path) -> Run:
    """Return the run of a folder of ``ocp train``, or that which made a model."""
    if path.is_dir():
        settings = read_config(path / 'config.yaml')
        return Run(f'{settings.agent.inputs}, reward {settings.simulation.reward.kind}',
                   settings.seed, records(path))
    made = Checkpoint.load(path).provenance
    training = made['training']
    return Run(f'{training["agent"]["inputs"]}, reward {training["simulation"]["reward"]["kind"]}',
               training['seed'], made['curve'])


def record(model: Path, runs: list[Run], ros: Path | None, command: str) -> None:
    """Write the best of each seed to the card of a model and all figures to ``docs/results``."""
    seeds = {str(run.seed): run.best for run in runs}
    checkpoint = Checkpoint.load(model)
    replace(checkpoint, provenance={**checkpoint.provenance, 'seeds': seeds}).save(model)
    figures: dict[str, Any] = {'model': checkpoint.run, 'seeds': seeds}
    if ros is not None:
        found = json.loads(ros.read_bytes())
        for name, values in found.items():
            if name.endswith('_by_turns'):
                # Twenty values say how it goes.
                places = np.unique(np.linspace(0, len(values) - 1, 20).round().astype(int))
                found[name] = [values[place] for place in places if values]
        figures['over_ros'] = found
    results.write('training', figures, command)


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


def draw(path: Path, runs: list[Run]) -> None:
    """Draw some runs, in a picture with this path."""
    grouped: dict[str, list[list[dict[str, Any]]]] = {}
    for run in runs:
        grouped.setdefault(run.label, []).append(run.lines)
    figure = Figure(figsize=(11, 4.2), layout='constrained')
    performance, losses = figure.subplots(1, 2)
    drawn = set()
    for number, (label, lines) in enumerate(grouped.items()):
        colour = f'C{number}'
        turns, values = band(lines, 'ratio')
        if len(turns):
            seeds = f' ({len(values)} seeds)' if len(values) > 1 else ''
            performance.plot(turns, values.mean(axis=0), color=colour, label=label + seeds,
                             marker='.')
            performance.fill_between(turns, values.min(axis=0), values.max(axis=0), alpha=0.2,
                                     color=colour, linewidth=0)
        for name, (_, style) in LOSSES.items():
            turns, values = band(lines, name)
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
    parser.add_argument('runs', type=Path, nargs='+', help='folders of ocp train, models')
    parser.add_argument('--out', type=Path, default=Path('docs/training.png'))
    parser.add_argument('--record', action='store_true', help='the first run is a model: write '
                        'the best of each seed to its card and to docs/results/training.json')
    parser.add_argument('--ros', type=Path, help='train_demo.json of a training over ROS')
    arguments = parser.parse_args(argv)
    runs = [run_of(path) for path in arguments.runs]
    draw(arguments.out, runs)
    print(f'wrote {arguments.out}')
    if arguments.record:
        record(arguments.runs[0], runs, arguments.ros,
               results.command_of('training_curves', argv))
    return 0


if __name__ == '__main__':
    sys.exit(main())
