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

from ocp_ros.cli.arguments import add_units, camera_counts, names, whole, whole_numbers
from ocp_ros.cli.benchmark_command import add_comparison, check_cameras
from ocp_ros.cli.common import claim_folder, command_of, Commands, Found, LEARN, show_written
from ocp_ros.policy.shipped_models import DEFAULT_MODEL

if TYPE_CHECKING:
    from ocp_ros.compare.comparison import Comparison
    from ocp_ros.compare.protocol import Protocol

#: Name of the file that is written.
EVALUATION = 'evaluation.json'


def add_arguments(commands: Commands) -> None:
    """Add ``ocp evaluate``."""
    command = commands.add(LEARN, 'evaluate', 'evaluate a policy room by room',
                           'ocp evaluate --model models/mine.safetensors --set test')
    command.add_argument('--model', default=DEFAULT_MODEL, help='weights: a path, or a name')
    command.add_argument('--planners', type=names, default=('learned', 'greedy_step'),
                         help='names with commas between; the first is compared with the others')
    rooms = command.add_mutually_exclusive_group()
    rooms.add_argument('--set', choices=('fresh', 'test', 'training', 'validation'),
                       default='fresh', help='set of generated rooms; default: fresh')
    rooms.add_argument('--rooms', type=Path, nargs='+', metavar='SCAN',
                       help='scans, instead of generated rooms')
    add_units(command, 'of the scans')
    command.add_argument('--rotations', type=whole_numbers, default=(0,),
                         help='rotations of the rooms in degrees, with commas between')
    command.add_argument('--cameras', type=camera_counts, help='numbers of cameras, with commas '
                         'between; default: 4')
    command.add_argument('--budgets', type=whole_numbers, default=(1000,),
                         help='evaluations of offline planners, with commas between')
    command.add_argument('--seeds', type=whole(1), default=1, help='runs per planner, room and '
                         'budget')
    command.add_argument('--out', type=Path, default=Path('out/evaluation'),
                         help='folder of the results; an interrupted evaluation continues')
    add_comparison(command)
    command.set_defaults(run=run, show=show, scale=0.0, up='file')


def run(arguments: argparse.Namespace) -> Found:
    """Compare a policy with planners for each number of cameras; write ``evaluation.json``."""
    from ocp_ros.compare.comparison import compare
    from ocp_ros.util.files import folder_to_write, write_atomically
    from ocp_ros.util.yaml_files import timestamp
    command = command_of(arguments.argv)
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


def show(found: Found) -> None:
    """Print the pairwise results for each number of cameras."""
    from ocp_ros.report.terminal import print_table
    from rich.console import Console
    for cameras, result in found['cameras'].items():
        first = next(iter(result['pairs'])).split(',')[0]
        rows = []
        for name, pair in sorted(result['pairs'].items(), key=lambda item: item[1]['sum']):
            low, high = pair['interval']
            compared = ('', '', '', '') if name == first else (
                f'{pair["wins"]} of {pair["rooms"]}', f'{pair["ratio"]:.3f}',
                f'{low:.3f} to {high:.3f}', '' if pair['p'] is None else f'{pair["p"]:.1e}')
            rows.append((name, f'{pair["sum"]:.2f}', *compared))
        print_table(Console(), f'{cameras} cameras', (
            'planner', 'sum (m)', f'{first} better in', 'its error : theirs', '95 %', 'p'), rows)
    show_written(found)


def protocols_of(arguments: argparse.Namespace) -> 'list[Protocol]':
    """Return the comparisons of a command line of ``ocp evaluate``, one per number of cameras."""
    from ocp_ros.compare.protocol import placing, Protocol
    from ocp_ros.rooms.splits import SETS
    from ocp_ros.scenes.scene_files import check_file
    check_cameras(arguments)
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


def _by_room(protocol: 'Protocol', comparison: 'Comparison') -> dict[str, Any]:
    """Return pairwise results, errors by room, and the slowest turn of each online planner."""
    from ocp_ros.compare.summary import per_room
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
