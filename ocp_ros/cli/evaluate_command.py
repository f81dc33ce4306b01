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

"""``ocp evaluate``: compare a policy with other planners, room by room."""

import argparse
from collections import Counter
import json
from pathlib import Path
from typing import Any, TYPE_CHECKING

from ocp_ros.cli.arguments import add_units, read_camera_counts, read_integers, read_names, whole
from ocp_ros.cli.benchmark_command import add_comparison, check_cameras
from ocp_ros.cli.common import claim_folder, command_of, Commands, Found, LEARN, show_written
from ocp_ros.policy.shipped_models import DEFAULT_MODEL

if TYPE_CHECKING:
    from ocp_ros.compare.comparison import Comparison
    from ocp_ros.compare.protocol import Protocol


def add_arguments(commands: Commands) -> None:
    """Add ``ocp evaluate``."""
    command = commands.add(LEARN, 'evaluate', 'evaluate a policy room by room',
                           'ocp evaluate --model models/mine.safetensors --set test')
    command.add_argument('--model', default=DEFAULT_MODEL, help='weights: a path, or a name')
    command.add_argument('--planners', type=read_names, default=('learned', 'greedy_step'),
                         help='names with commas between; the first is compared with the others')
    rooms = command.add_mutually_exclusive_group()
    rooms.add_argument('--set', choices=('fresh', 'test', 'training', 'validation'),
                       default='fresh', help='set of generated rooms; default: fresh')
    rooms.add_argument('--rooms', type=Path, nargs='+', metavar='SCAN',
                       help='scans, instead of generated rooms')
    add_units(command, 'scans')
    command.add_argument('--rotations', type=read_integers, default=(0,),
                         help='rotations of the rooms in degrees, with commas between')
    command.add_argument('--cameras', type=read_camera_counts, help='numbers of cameras, with '
                         'commas between; default: 4')
    command.add_argument('--budgets', type=read_integers, default=(1000,),
                         help='evaluations of offline planners, with commas between')
    command.add_argument('--seeds', type=whole(1), default=1, help='runs per planner, room and '
                         'budget')
    command.add_argument('--out', type=Path, default=Path('out/evaluation'),
                         help='folder of the results; an interrupted evaluation continues')
    add_comparison(command)
    # The scale 0.0 and ``file`` mean the unit and the direction that the file says.
    command.set_defaults(run=run, show=show, scale=0.0, up='file')


def run(arguments: argparse.Namespace) -> Found:
    """Compare a policy with planners for each number of cameras; write and return the results."""
    from ocp_ros.compare.comparison import compare
    from ocp_ros.util.files import folder_to_write, write_atomically
    from ocp_ros.util.yaml_files import timestamp
    command = command_of(arguments.argv)
    protocols = protocols_of(arguments)
    path = folder_to_write(arguments.out) / 'evaluation.json'
    claim_folder(arguments, arguments.out, [path.name], '*-cameras')
    results: dict[str, Any] = {
        'command': command, 'date': timestamp(), 'model': arguments.model,
        'rotations': list(arguments.rotations), 'seeds': arguments.seeds, 'cameras': {}}
    for protocol in protocols:
        count = str(protocol.cameras)
        results['cameras'][count] = _results_by_room(protocol, compare(
            protocol, arguments.out / f'{count}-cameras', command, arguments.workers or 0,
            arguments.ray))
    write_atomically(path, json.dumps(results, indent=1) + '\n')
    return {**results, 'written': [path]}


def show(result: Found) -> None:
    """Print the pairwise results for each number of cameras."""
    from ocp_ros.report.terminal import print_table
    from rich.console import Console
    for cameras, figures in result['cameras'].items():
        # The first planner is compared with all others. It has the first key, since the rows are
        # in the order of the planners. A key may end in a comma and the budget.
        first = next(iter(figures['pairs'])).split(',')[0]
        rows = []
        for name, pair in sorted(figures['pairs'].items(), key=lambda item: item[1]['sum']):
            low, high = pair['interval']
            comparison = ('', '', '', '') if name.split(',')[0] == first else (
                f'{pair["wins"]} of {pair["rooms"]}', f'{pair["ratio"]:.3f}',
                f'{low:.3f} to {high:.3f}', '' if pair['p'] is None else f'{pair["p"]:.1e}')
            rows.append((name, f'{pair["sum"]:.2f}', *comparison))
        print_table(Console(), f'{cameras} cameras', (
            'planner', 'sum (m)', f'{first} better in', 'its error : theirs', '95 %', 'p'), rows)
    show_written(result)


def protocols_of(arguments: argparse.Namespace) -> 'list[Protocol]':
    """Return the settings of a comparison for each number of cameras, from a command line."""
    from ocp_ros.compare.protocol import placement_settings, Protocol
    from ocp_ros.rooms.splits import SETS
    from ocp_ros.scenes.scene_files import check_file
    check_cameras(arguments)
    for path in arguments.rooms or ():
        check_file(path)
    # None: the number of cameras in the rig file, or the default one.
    counts = (None,) if arguments.rig is not None else (arguments.cameras or (None,))
    return [Protocol(
        rooms=tuple(str(path.resolve()) for path in arguments.rooms or ()) or tuple(
            map(str, SETS[arguments.set])),
        rotations=tuple(map(float, arguments.rotations)), planners=arguments.planners,
        budgets=arguments.budgets, seeds=arguments.seeds, model=arguments.model,
        scale=arguments.scale, up=arguments.up,
        simulation=placement_settings(count, arguments.rig))
        for count in counts]


def _results_by_room(protocol: 'Protocol', comparison: 'Comparison') -> dict[str, Any]:
    """Return results of pairs of planners, errors by room, and online planners' slowest turns."""
    from ocp_ros.compare.summary import per_room
    rows = comparison.rows
    stems = Counter(Path(room).stem for room in protocol.rooms)
    # Rooms whose files have the same stem are labelled by their paths.
    labels = {room: Path(room).stem if stems[Path(room).stem] == 1 else room
              for room in protocol.rooms}
    errors = {}
    # The keys of a dictionary are distinct, and keep their order.
    for planner, budget in dict.fromkeys((row['planner'], row['budget']) for row in rows):
        errors_by_room = per_room(rows, planner, budget, 'depth_error')
        errors[f'{planner}, {budget}'] = {labels[room]: error
                                          for room, error in errors_by_room.items()}
    planners = comparison.summary['planners']
    return {
        'pairs': comparison.summary['pairs'], 'rooms': errors,
        'slowest_turn': {name: run['seconds_at_most'] for name, runs in planners.items()
                         for run in runs.values() if 'seconds_at_most' in run}}
