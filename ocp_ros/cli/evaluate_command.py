# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ocp evaluate``: a policy against other planners, room by room."""

import argparse
from collections import Counter
from dataclasses import replace
import json
import os
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from ocp_ros.cli.common import claim_folder
from ocp_ros.evaluation.paired import pairs
from ocp_ros.evaluation.protocol import Protocol
from ocp_ros.evaluation.summary import per_room
from ocp_ros.evaluation.task_runner import run
from ocp_ros.rig.rig_file import load_rig
from ocp_ros.scenes.scene_files import check_file
from ocp_ros.scenes.splits import SETS
from ocp_ros.util.files import folder_to_write, write_atomically
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.shown_text import printable
from ocp_ros.util.yaml_files import timestamp

#: Numbers of cameras, where none is asked for.
CAMERAS = (4,)


def protocols_of(arguments: argparse.Namespace) -> dict[int, Protocol]:
    """Return what a command line asks to compare, by the number of cameras."""
    rooms = tuple(str(path.resolve()) for path in arguments.rooms or ()) or tuple(
        str(seed) for seed in SETS[arguments.set])
    if arguments.rig is not None and arguments.cameras is not None:
        raise ConfigurationError(f'--cameras: found {list(arguments.cameras)} with --rig; '
                                 'expected one of the two: the rig file lists its cameras')
    protocol = Protocol(
        rooms=rooms, rotations=tuple(map(float, arguments.rotations)),
        planners=arguments.planners, budgets=arguments.budgets, seeds=arguments.seeds,
        model=arguments.model, scale=arguments.scale, up=arguments.up)
    if arguments.rig is not None:
        simulation = replace(protocol.simulation, rig_file=str(arguments.rig))
        return {len(load_rig(arguments.rig).cameras): replace(protocol, simulation=simulation)}
    return {cameras: replace(protocol, simulation=replace(
        protocol.simulation, rig=replace(protocol.simulation.rig, cameras=cameras)))
        for cameras in arguments.cameras or CAMERAS}


def evaluate(arguments: argparse.Namespace, command: str) -> dict[str, Any]:
    """
    Play, print and keep what came of it in ``evaluation.json``.

    :param arguments: of ``ocp evaluate``.
    :param command: the command line, for the record.
    :returns: what is written: for each number of cameras the pairs and the errors by room.
    """
    protocols = protocols_of(arguments)
    for path in arguments.rooms or ():
        check_file(path)
    folder_to_write(arguments.out)
    path = arguments.out / 'evaluation.json'
    claim_folder(arguments, arguments.out, [path.name], '*-cameras')
    found: dict[str, Any] = {
        'command': command, 'date': timestamp(),
        'model': arguments.model, 'rotations': list(arguments.rotations),
        'seeds': arguments.seeds, 'cameras': {}}
    columns = (TextColumn('{task.description}'), BarColumn(), MofNCompleteColumn(),
               TimeRemainingColumn())
    for cameras, protocol in protocols.items():
        with Progress(*columns, console=Console(stderr=True)) as progress:
            bar = progress.add_task(f'{cameras} cameras')
            rows = run(protocol, arguments.out / f'{cameras}-cameras',
                       arguments.workers or os.cpu_count() or 1, arguments.ray,
                       progress=lambda done, total, bar=bar, progress=progress: progress.update(
                           bar, completed=done, total=total))
        compared = pairs(rows, arguments.planners[0])
        _show(compared, arguments.planners[0], cameras)
        names = dict.fromkeys((row['planner'], row['budget']) for row in rows)
        stems = Counter(Path(room).stem for room in protocol.rooms)
        short = {room: Path(room).stem if stems[Path(room).stem] == 1 else room
                 for room in protocol.rooms}
        found['cameras'][str(cameras)] = {'pairs': compared, 'rooms': {
            f'{planner}, {budget}': {
                short[room]: error
                for room, error in per_room(rows, planner, budget, 'depth_error').items()}
            for planner, budget in names},
            'slowest_turn': {planner: max(row['seconds_at_most'] for row in rows
                                          if row['planner'] == planner)
                             for planner in protocol.planners
                             if any('seconds_at_most' in row for row in rows
                                    if row['planner'] == planner)}}
    write_atomically(path, json.dumps(found, indent=1) + '\n')
    print(f'wrote {printable(str(path))}')
    return found


def _show(compared: dict[str, dict[str, Any]], first: str, cameras: int) -> None:
    """Print the pairs."""
    table = Table('planner', 'sum (m)', f'{first} better in', 'its error : theirs', '95 %', 'p',
                  title=f'{cameras} cameras')
    for name, pair in sorted(compared.items(), key=lambda item: item[1]['sum']):
        low, high = pair['interval']
        same = name == first
        table.add_row(name, f'{pair["sum"]:.2f}',
                      '' if same else f'{pair["wins"]} of {pair["rooms"]}',
                      '' if same else f'{pair["ratio"]:.3f}',
                      '' if same else f'{low:.3f} to {high:.3f}',
                      '' if same or pair['p'] is None else f'{pair["p"]:.1e}')
    Console().print(table)
