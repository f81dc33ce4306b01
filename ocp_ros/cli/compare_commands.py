# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ocp benchmark`` and ``ocp evaluate``: planners, or weights, compared in the same rooms."""

import argparse
from collections import Counter
from dataclasses import replace
import json
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from ocp_ros.cli.common import claim_folder, Found, show_written
from ocp_ros.compare.comparison import compare, Comparison, RESULTS
from ocp_ros.compare.protocol import placing, PRESETS, Protocol, rooms_in, rooms_of_s3dis
from ocp_ros.compare.summary import budgets_of, last_runs, per_room
from ocp_ros.planning.rig_planning import CAMERAS, MOUNT
from ocp_ros.report.room_facts import show_notes
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rooms.splits import SETS
from ocp_ros.scenes.scene_files import check_file
from ocp_ros.search.rig_methods import planner_names
from ocp_ros.util.files import folder_to_write, write_atomically
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.yaml_files import timestamp, written

#: The rig of ``--sensor``, beside the results, and the file of ``ocp evaluate``.
RIG, EVALUATION = 'rig.yaml', 'evaluation.json'


def benchmark(arguments: argparse.Namespace, command: str) -> Found:
    """
    Compare planners, and write the results.

    :param arguments: of ``ocp benchmark``.
    :param command: the command line, for the record.
    :returns: the summary.
    """
    _check_cameras(arguments)
    claim_folder(arguments, arguments.out, RESULTS, 'protocol.json')
    rig = [] if arguments.sensor is None else [_write_rig(arguments)]
    protocol = protocol_of(arguments)
    folder = folder_to_write(arguments.out)
    summary = compare(protocol, folder, command, arguments.workers or 0, arguments.ray).summary
    return {**summary, 'written': [*rig, *(folder / name for name in RESULTS)]}


def protocol_of(arguments: argparse.Namespace) -> Protocol:
    """Return what a command line of ``ocp benchmark`` asks to compare."""
    changes: dict[str, Any] = {
        name: value for name in ('planners', 'budgets', 'seeds', 'scale', 'up')
        if (value := getattr(arguments, name)) is not None}
    if arguments.rooms is None and changes.keys() & {'scale', 'up'}:
        raise ConfigurationError('--scale and --up: found no --rooms; expected a folder of scans '
                                 'that they are about; generated rooms are in metres, z up')
    if arguments.rig is not None:
        changes = {'planners': planner_names(), **changes}
    protocol = replace(PRESETS[arguments.preset], **changes,
                       simulation=placing(arguments.cameras, arguments.rig))
    if arguments.rooms is not None:
        rooms = rooms_in(arguments.rooms, protocol.scale, protocol.up)
    else:
        rooms = [*protocol.rooms, *(rooms_of_s3dis() if arguments.preset == 'full' else ())]
    return replace(protocol, rooms=tuple(rooms))


def _check_cameras(arguments: argparse.Namespace) -> None:
    """Refuse options about cameras that contradict each other."""
    for option in ('cameras', 'sensor', 'mount'):
        if arguments.rig is not None and (value := getattr(arguments, option, None)) is not None:
            shown = ','.join(map(str, value)) if isinstance(value, tuple) else value
            raise ConfigurationError(
                f'--{option}: found {shown} with --rig; expected one of the two: the rig file '
                f'says its {option}; leave one out')
    if getattr(arguments, 'mount', None) is not None and arguments.sensor is None:
        raise ConfigurationError(
            f'--mount: found {arguments.mount} without --sensor; expected both: without a sensor '
            'omnidirectional cameras on a plane are compared; add --sensor omnidirectional')


def _write_rig(arguments: argparse.Namespace) -> Path:
    """Write the rig of ``--sensor`` beside the results, and go on as if it had been given."""
    rig = rig_of(arguments.cameras or CAMERAS, arguments.sensor,
                 mount={'on': arguments.mount or MOUNT})
    path = folder_to_write(arguments.out) / RIG
    write_atomically(path, written(rig.document.data, path.suffix))
    arguments.rig, arguments.cameras = path, None
    return path


def show_benchmark(summary: Found) -> None:
    """Print the sums, ratios and times of the largest budget and of online planners."""
    budget = int(budgets_of(summary)[-1])
    named = f'{budget:,} evaluations' if budget else 'the turns of online planners'
    table = Table('planner', 'delivered (m)', 'promised (m)', 'regret', 'wins', 'seconds',
                  title=f'{len(summary["rooms"])} rooms, {named}')
    for name, run in sorted(last_runs(summary).items(), key=lambda item: item[1]['sum']):
        regret = '-' if run['regret'] is None else f'{run["regret"]:.2f}'
        table.add_row(name, f'{run["sum"]:.2f}', f'{run["promised"]:.2f}', regret,
                      str(run['wins']), f'{run["seconds"]:.2f}')
    console = Console(width=100)
    console.print(table)
    show_notes(console, summary)
    show_written(summary)


def evaluate(arguments: argparse.Namespace, command: str) -> Found:
    """
    Compare weights with planners for each number of cameras, and write ``evaluation.json``.

    :param arguments: of ``ocp evaluate``.
    :param command: the command line, for the record.
    :returns: what is written: for each number of cameras the pairs and the errors by room.
    """
    protocols = protocols_of(arguments)
    path = folder_to_write(arguments.out) / EVALUATION
    claim_folder(arguments, arguments.out, [EVALUATION], '*-cameras')
    found: dict[str, Any] = {
        'command': command, 'date': timestamp(), 'model': arguments.model,
        'rotations': list(arguments.rotations), 'seeds': arguments.seeds, 'cameras': {}}
    for protocol in protocols:
        count = str(protocol.cameras)
        found['cameras'][count] = _by_room(protocol, compare(
            protocol, arguments.out / f'{count}-cameras', command, arguments.workers or 0,
            arguments.ray))
    write_atomically(path, json.dumps(found, indent=1) + '\n')
    return {**found, 'written': [path]}


def protocols_of(arguments: argparse.Namespace) -> list[Protocol]:
    """Return what a command line of ``ocp evaluate`` asks to compare, by number of cameras."""
    _check_cameras(arguments)
    for path in arguments.rooms or ():
        check_file(path)
    counts = (None,) if arguments.rig is not None else arguments.cameras or (None,)
    return [Protocol(
        rooms=tuple(str(path.resolve()) for path in arguments.rooms or ()) or tuple(
            map(str, SETS[arguments.set])),
        rotations=tuple(map(float, arguments.rotations)), planners=arguments.planners,
        budgets=arguments.budgets, seeds=arguments.seeds, model=arguments.model,
        scale=arguments.scale, up=arguments.up, simulation=placing(count, arguments.rig))
        for count in counts]


def _by_room(protocol: Protocol, comparison: Comparison) -> dict[str, Any]:
    """Return the pairs, the errors by room and the slowest turn of each online planner."""
    rows, planners = comparison.rows, comparison.summary['planners']
    stems = Counter(Path(room).stem for room in protocol.rooms)
    short = {room: Path(room).stem if stems[Path(room).stem] == 1 else room
             for room in protocol.rooms}
    return {
        'pairs': comparison.summary['pairs'],
        'rooms': {f'{planner}, {budget}': {
            short[room]: error
            for room, error in per_room(rows, planner, budget, 'depth_error').items()}
            for planner, budget in dict.fromkeys((row['planner'], row['budget']) for row in rows)},
        'slowest_turn': {name: run['seconds_at_most'] for name, runs in planners.items()
                         for run in runs.values() if 'seconds_at_most' in run}}


def show_evaluation(found: Found) -> None:
    """Print the pairs for each number of cameras."""
    for cameras, judged in found['cameras'].items():
        first = next(iter(judged['pairs'])).split(',')[0]
        table = Table('planner', 'sum (m)', f'{first} better in', 'its error : theirs', '95 %',
                      'p', title=f'{cameras} cameras')
        for name, pair in sorted(judged['pairs'].items(), key=lambda item: item[1]['sum']):
            low, high = pair['interval']
            compared = ('', '', '', '') if name == first else (
                f'{pair["wins"]} of {pair["rooms"]}', f'{pair["ratio"]:.3f}',
                f'{low:.3f} to {high:.3f}', '' if pair['p'] is None else f'{pair["p"]:.1e}')
            table.add_row(name, f'{pair["sum"]:.2f}', *compared)
        Console().print(table)
    show_written(found)
