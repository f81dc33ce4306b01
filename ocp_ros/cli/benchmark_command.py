# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ocp benchmark``: run a comparison, keep its results, print and report them."""

import argparse
import csv
from dataclasses import replace
from importlib.metadata import version
import io
import json
import os
from pathlib import Path
import platform
import shlex
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from ocp_ros.cli.common import claim_folder
from ocp_ros.evaluation.benchmark_rooms import rooms_in, rooms_of_s3dis
from ocp_ros.evaluation.protocol import PRESETS, Protocol
from ocp_ros.evaluation.summary import summarise
from ocp_ros.evaluation.task_runner import run
from ocp_ros.planners.registry import OFFLINE, ONLINE
from ocp_ros.planners.rig_methods import planner_names
from ocp_ros.report.benchmark_report import (
    budget_named,
    budgets_of,
    last_runs,
    shown,
    spaced,
    write_report,
)
from ocp_ros.report.comparison_page import write_page
from ocp_ros.report.drawing.placement_picture import draw_examples, Example
from ocp_ros.report.rig_planning import CAMERAS, MOUNT
from ocp_ros.rig.rig_file import load_rig, rig_of
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.util.files import folder_to_write, write_atomically
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.shown_text import printable
from ocp_ros.util.yaml_files import timestamp, written

#: Files of the results, those of a report, and those of them that rig files have none of.
RESULTS = ('results.csv', 'results.json', 'summary.json')
#: The rig of ``--sensor``, beside the results.
RIG = 'rig.yaml'
OF_PLACEMENTS = ('anytime.png', 'placements.html', 'placements.png')
REPORTED = ('README.md', 'rooms.png', 'summary.json', *OF_PLACEMENTS)
#: Rooms on the page that can be turned around.
PAGE_ROOMS = 3
Rows = list[dict[str, Any]]
#: By name, the engine of a room and the best run of each planner in it.
Shown = dict[str, tuple[Simulator, dict[str, dict[str, Any]]]]
PACKAGES = ('ocp_ros', 'numpy', 'numba', 'scipy', 'cma')


def protocol_of(arguments: argparse.Namespace) -> Protocol:
    """Return what a command line asks to compare."""
    changes: dict[str, Any] = {
        name: value for name in ('planners', 'budgets', 'seeds', 'scale', 'up')
        if (value := getattr(arguments, name)) is not None}
    if arguments.rooms is None and changes.keys() & {'scale', 'up'}:
        raise ConfigurationError('--scale and --up: found no --rooms; expected a folder of scans '
                                 'that they are about; generated rooms are in metres, z up')
    if arguments.cameras is not None:
        simulation = PRESETS[arguments.preset].simulation
        changes['simulation'] = replace(
            simulation, rig=replace(simulation.rig, cameras=arguments.cameras))
    if arguments.rig is not None:
        # Read now: a file that cannot be used is refused before anything runs.
        load_rig(arguments.rig)
        # Zones and cameras in place have coordinates of the room as it is.
        simulation = replace(PRESETS[arguments.preset].simulation, rig_file=str(arguments.rig))
        changes = {'planners': planner_names(), 'rotations': (0.0,), **changes,
                   'simulation': simulation}
    protocol = replace(PRESETS[arguments.preset], **changes)
    if arguments.rooms is not None:
        rooms = rooms_in(arguments.rooms, protocol.scale, protocol.up)
        return replace(protocol, rooms=tuple(rooms))
    if arguments.preset == 'full':
        return replace(protocol, rooms=(*protocol.rooms, *rooms_of_s3dis()))
    return protocol


def compare(arguments: argparse.Namespace, command: str) -> dict[str, Any]:
    """
    Run a comparison and write ``results.csv``, ``results.json`` and ``summary.json``.

    :param arguments: of ``ocp benchmark``.
    :param command: the command line, for the record.
    :returns: the summary.
    """
    _check_cameras(arguments)
    claim_folder(arguments, arguments.out, RESULTS, 'protocol.json')
    if arguments.sensor is not None:
        _write_rig(arguments)
    protocol = protocol_of(arguments)
    folder_to_write(arguments.out)
    if arguments.report:
        folder_to_write(arguments.report, '--report')
        claim_folder(arguments, arguments.report, REPORTED, 'summary.json', option='--report')
    columns = (TextColumn('comparing planners'), BarColumn(), MofNCompleteColumn(),
               TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        bar = progress.add_task('')
        rows = run(protocol, arguments.out, arguments.workers or os.cpu_count() or 1,
                   arguments.ray,
                   lambda done, total: progress.update(bar, completed=done, total=total))
    summary = {
        'command': command, 'date': timestamp(),
        'versions': {'python': platform.python_version(),
                     **{name: version(name) for name in PACKAGES}},
        'rotations': len(protocol.rotations), 'points': protocol.points,
        'judged_points': protocol.judged_points, **_cameras(protocol), **summarise(rows)}
    _write(arguments.out, rows, summary)
    if arguments.report:
        write_report(arguments.report, summary, rows)
        if arguments.rig is None:
            _show_placements(arguments.report, protocol, summary, rows)
        write_atomically(arguments.report / 'summary.json', json.dumps(summary, indent=1) + '\n')
        if arguments.rig is not None:
            for name in OF_PLACEMENTS:
                (arguments.report / name).unlink(missing_ok=True)
    show(summary)
    print('wrote ' + printable(f'{arguments.out / "summary.json"}' + (
        f' and {arguments.report / "README.md"}' if arguments.report else '')))
    return summary


def _check_cameras(arguments: argparse.Namespace) -> None:
    """Refuse options about cameras that contradict each other."""
    for option in ('cameras', 'sensor', 'mount'):
        if arguments.rig is not None and (value := getattr(arguments, option)) is not None:
            raise ConfigurationError(
                f'--{option}: found {value} with --rig; expected one of the two: the rig file '
                f'says its {option}; leave one out')
    if arguments.mount is not None and arguments.sensor is None:
        raise ConfigurationError(
            f'--mount: found {arguments.mount} without --sensor; expected both: without a sensor '
            'omnidirectional cameras on a plane are compared; add --sensor omnidirectional')


def _write_rig(arguments: argparse.Namespace) -> None:
    """Write the rig of ``--sensor`` beside the results, and go on as if it had been given."""
    rig = rig_of(arguments.cameras or CAMERAS, arguments.sensor,
                 mount={'on': arguments.mount or MOUNT})
    path = folder_to_write(arguments.out) / RIG
    write_atomically(path, written(rig.document.data, path.suffix))
    arguments.rig, arguments.cameras = path, None


def _cameras(protocol: Protocol) -> dict[str, Any]:
    """Say what was placed: the rig file if there is one, and how many cameras."""
    if protocol.simulation.rig_file:
        return {'rig': Path(protocol.simulation.rig_file).name,
                'cameras': len(load_rig(protocol.simulation.rig_file).cameras)}
    return {'cameras': protocol.simulation.rig.cameras}


def _show_placements(folder: Path, protocol: Protocol, summary: dict[str, Any], rows: Rows
                     ) -> None:
    """Draw the best placements in some rooms, and write a page to turn around."""
    chosen = _shown(protocol, rows)
    write_page(folder / 'placements.html', 'Planners compared', {
        name: (simulator, {planner: np.array(row['placement']) for planner, row in best.items()})
        for name, (simulator, best) in chosen.items()})
    _draw(folder / 'placements.png', summary, chosen)


def _shown(protocol: Protocol, rows: Rows) -> Shown:
    """Return some rooms, and each planner's best run in them, the best first."""
    found, rotation = {}, protocol.rotations[0]
    for room in protocol.rooms[:PAGE_ROOMS]:
        best: dict[str, dict[str, Any]] = {}
        for row in rows:
            if (row['room'], row['rotation']) == (room, rotation):
                rival = best.setdefault(row['planner'], row)
                if row['depth_error'] < rival['depth_error']:
                    best[row['planner']] = row
        simulator = protocol.room(room, rotation).fine
        name = simulator.scene.name
        # Scans of several folders may have one name.
        name = f'{name} ({len(found) + 1})' if name in found else name
        found[name] = simulator, dict(
            sorted(best.items(), key=lambda item: item[1]['depth_error']))
    return found


def _draw(path: Path, summary: dict[str, Any], chosen: Shown) -> None:
    """Draw what the best planner made of some rooms, and below it the best online one."""
    ranked = sorted(last_runs(summary).items(), key=lambda item: item[1]['sum'])
    offline = [name for name, _ in ranked if name in OFFLINE][:1]
    online = [name for name, _ in ranked if name in ONLINE][:1]
    examples = []
    for planner in offline + online:
        examples.append([])
        for name, (simulator, best) in chosen.items():
            row = best[planner]
            # What counts is where the cameras are hung up, which may be a step from the last turn.
            paths = np.array([*row.get('trajectory', []), row['placement']])
            examples[-1].append(Example(
                f'{name}: {spaced(planner)}, depth error {row["depth_error"]:.2f} m',
                simulator.scene.points, simulator.evaluate(paths[-1]).visible, paths))
    reach = float(next(iter(chosen.values()))[0].config.rig.ranges.max())
    draw_examples(path, examples, reach, 'Where the best planners put the cameras')


def command_of(argv: list[str]) -> str:
    """Return a command line as one types it."""
    return shlex.join(['ocp', *argv])


def _write(folder: Path, rows: Rows, summary: dict[str, Any]) -> None:
    """Keep the runs as a table and whole, and their summary."""
    names = list(dict.fromkeys(name for row in rows for name in row
                               if name not in ('placement', 'trace', 'trajectory')))
    lines = io.StringIO()
    table = csv.DictWriter(lines, names, extrasaction='ignore')
    table.writeheader()
    table.writerows({name: printable(value) if isinstance(value, str) else value
                     for name, value in row.items()} for row in rows)
    write_atomically(folder / 'results.csv', lines.getvalue())
    write_atomically(folder / 'results.json', json.dumps(rows))
    write_atomically(folder / 'summary.json', json.dumps(summary, indent=1) + '\n')


def show(summary: dict[str, Any]) -> None:
    """Print the sums, ratios and times of the largest budget and of online planners."""
    budget = budgets_of(summary)[-1]
    table = Table('planner', 'delivered (m)', 'promised (m)', 'regret', 'wins', 'seconds',
                  title=f'{len(summary["rooms"])} rooms, {budget_named(budget)}')
    for name, run_ in sorted(last_runs(summary).items(), key=lambda item: item[1]['sum']):
        table.add_row(name, f'{run_["sum"]:.2f}', f'{run_["promised"]:.2f}',
                      shown(run_['regret'], 2), str(run_['wins']), f'{run_["seconds"]:.2f}')
    console = Console(width=100)
    console.print(table)
    for note in summary['notes']:
        console.print(f'note: {note}', style='yellow', markup=False, highlight=False)
