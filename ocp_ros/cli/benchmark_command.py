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

"""``ocp benchmark``: compare planners in the same rooms."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any, TYPE_CHECKING
import warnings

from ocp_ros.cli.arguments import (
    add_overwrite,
    add_units,
    read_cameras,
    read_integers,
    read_names,
    whole,
)
from ocp_ros.cli.common import claim_folder, command_of, Commands, COMPARE, Found, show_written
from ocp_ros.util.resources import find_config
from ocp_ros.util.settings import ConfigurationError

if TYPE_CHECKING:
    from ocp_ros.compare.protocol import Protocol


def add_arguments(commands: Commands) -> None:
    """Add ``ocp benchmark``."""
    command = commands.add(
        COMPARE, 'benchmark', 'compare planners under equal budgets',
        'ocp benchmark --rooms my_scans --planners learned,tdsa --budgets 1000 --seeds 5')
    command.add_argument('--preset', choices=('smoke', 'full'), default='smoke',
                         help='smoke: two rooms, about two minutes; full: ten rooms, up to 1,000 '
                         'evaluations')
    rooms = command.add_mutually_exclusive_group()
    rooms.add_argument('--set', choices=('fresh', 'test', 'training', 'validation'),
                       help='set of generated rooms; default: the rooms of --preset, of test')
    rooms.add_argument('--rooms', type=Path, nargs='+', metavar='SCAN',
                       help='scans, or folders of scans, instead of generated rooms')
    add_units(command, 'scans')
    command.add_argument('--rotations', type=read_integers, help='rotations of the rooms in '
                         'degrees, with commas between')
    command.add_argument('--model', help='weights of the planner learned: a path, or a name')
    command.add_argument('--policy', metavar='[ALGORITHM:]FILE.zip', help='your agent of '
                         'stable-baselines3, by default PPO, or MODULE:FUNCTION, as the planner '
                         'own_policy; the file is code: name only files that you trust')
    command.add_argument('--observation', metavar='KIND', help='with --policy: observation of '
                         'the agent: dict (default) of the environment, flat, or MODULE:FUNCTION')
    command.add_argument('--cameras', type=read_cameras, metavar='N', help='number of cameras, '
                         'without a rig file; default: 4')
    command.add_argument('--sensor', metavar='SENSOR', help='sensor of all cameras, without a rig '
                         'file, or a part of its name such as d455')
    command.add_argument('--mount', choices=('walls', 'ceiling', 'plane', 'free'),
                         help='with --sensor: mount of all cameras; default: walls')
    command.add_argument('--planners', type=read_names, help='names with commas between; the '
                         'first is compared with the others; default: all')
    command.add_argument('--budgets', type=read_integers, help='numbers of evaluations, with '
                         'commas between')
    command.add_argument('--seeds', type=whole(1), help='runs per planner, room and budget')
    command.add_argument('--out', type=Path, default=Path('out/benchmark'),
                         help='folder of the results; an interrupted comparison continues')
    command.add_argument('--rig', type=find_config, help='rig file: docs/reference/rig.md; '
                         'default: config/rig/plane.yaml, omnidirectional cameras on a plane')
    command.add_argument('--workers', type=whole(1), help='number of processes; default: one per '
                         'core')
    command.add_argument('--ray', metavar='ADDRESS', help='run on a Ray cluster, such as auto')
    add_overwrite(command)
    command.set_defaults(run=run, show=show)


def run(arguments: argparse.Namespace) -> Found:
    """Compare planners, write the results and return their summary."""
    from ocp_ros.compare.comparison import compare, RESULTS
    from ocp_ros.util.files import folder_to_write
    check_cameras(arguments)
    claim_folder(arguments, arguments.out, RESULTS, 'protocol.json')
    if arguments.policy is not None:
        _add_policy(arguments)
    elif arguments.observation is not None:
        raise ConfigurationError('--observation: found it without --policy; expected both; name '
                                 'the agent')
    # This also sets the option --rig, which ``protocol_of`` reads.
    rig_files = [_write_rig(arguments)] if arguments.sensor or arguments.cameras else []
    protocol = protocol_of(arguments)
    folder = folder_to_write(arguments.out)
    summary = compare(protocol, folder, command_of(arguments.argv), arguments.workers or 0,
                      arguments.ray)
    return {**summary, 'written': [*rig_files, *(folder / name for name in RESULTS)]}


def show(summary: Found) -> None:
    """
    Print the results of planners at the largest budget; online planners have no budget.

    ``ratio`` is the error of the first planner divided by that of the row, as geometric mean, with
    its 95 % interval.
    """
    from ocp_ros.compare.summary import budgets_of, last_runs
    from ocp_ros.report.terminal import print_table, show_notes, wide_console
    # The largest budget is 0 if all planners are online.
    budget = int(budgets_of(summary)[-1])
    runs = f'{budget:,} evaluations' if budget else 'the turns of online planners'
    console = wide_console()
    print_table(console, f'{len(summary["rooms"])} rooms, {runs}', (
        'planner', 'delivered (m)', 'promised (m)', 'regret', 'wins', 'ratio',
        'seconds'), [
        (name, f'{run["sum"]:.2f}', f'{run["promised"]:.2f}',
         '-' if run['regret'] is None else f'{run["regret"]:.2f}', str(run['wins']),
         _compared(summary['pairs'], name), f'{run["seconds"]:.2f}')
        for name, run in sorted(last_runs(summary).items(), key=lambda item: item[1]['sum'])])
    show_notes(console, summary)
    show_written(summary)


def _compared(pairs: dict[str, Any], planner: str) -> str:
    """Return how the first planner compares with a planner at its largest budget, for a table."""
    # The first planner has the first key. A key may end in a comma and the budget.
    first, names = next(iter(pairs)), [key for key in pairs if key.split(',')[0] == planner]
    if first in names:
        return ''
    low, high = pairs[names[-1]]['interval']
    return f'{pairs[names[-1]]["ratio"]:.2f} ({low:.2f} to {high:.2f})'


def protocol_of(arguments: argparse.Namespace) -> 'Protocol':
    """Return the settings of the comparison from a command line of ``ocp benchmark``."""
    from ocp_ros.compare.protocol import placement_settings, PRESETS, rooms_in, rooms_of_s3dis
    from ocp_ros.rooms.room_sets import SETS
    changes: dict[str, Any] = {
        name: value for name in ('planners', 'budgets', 'seeds', 'scale', 'up', 'model', 'policy',
                                 'observation')
        if (value := getattr(arguments, name)) is not None}
    if arguments.rotations is not None:
        changes['rotations'] = tuple(map(float, arguments.rotations))
    if arguments.rooms is None and changes.keys() & {'scale', 'up'}:
        raise ConfigurationError('--scale and --up: found no --rooms; expected the scans that '
                                 'they are about; generated rooms are in metres, z up')
    if arguments.rig is not None:
        changes['simulation'] = placement_settings(arguments.rig)
    protocol = replace(PRESETS[arguments.preset], **changes)
    if arguments.rooms is not None:
        rooms = rooms_in(arguments.rooms, protocol.scale, protocol.up)
    elif arguments.set is not None:
        rooms = [str(seed) for seed in SETS[arguments.set]]
    else:
        rooms = [*protocol.rooms, *(rooms_of_s3dis() if arguments.preset == 'full' else ())]
    return replace(protocol, rooms=tuple(rooms))


def _add_policy(arguments: argparse.Namespace) -> None:
    """Load the agent of the user, with a warning, and compare it unless it is named already."""
    from ocp_ros.search.registry import planner_names
    from ocp_ros.util.settings import need
    need('ocp benchmark --policy', 'stable_baselines3', 'gymnasium')
    from ocp_ros.training.saved_agents import DICT, OWN_POLICY, register_policy
    warnings.warn(f'--policy: found {arguments.policy}, which can run any code; expected one that '
                  'you trust', stacklevel=2)
    # By default it is compared with all planners.
    names = arguments.planners or planner_names()
    register_policy(arguments.policy, arguments.observation or DICT)
    arguments.planners = names if OWN_POLICY in names else (OWN_POLICY, *names)


def check_cameras(arguments: argparse.Namespace) -> None:
    """Raise an error if options about cameras contradict each other."""
    for option in ('cameras', 'sensor', 'mount'):
        if arguments.rig is not None and (value := getattr(arguments, option)) is not None:
            raise ConfigurationError(
                f'--{option}: found {value} with --rig; expected one of the two: the rig file '
                f'says its {option}; leave one out')
    if arguments.mount is not None and arguments.sensor is None:
        raise ConfigurationError(
            f'--mount: found {arguments.mount} without --sensor; expected both: without a sensor '
            'the cameras of config/rig/plane.yaml are compared; add --sensor omnidirectional')


def _write_rig(arguments: argparse.Namespace) -> Path:
    """Write the rig of the options to ``rig.yaml``, and set this file as the option ``--rig``."""
    from ocp_ros.compare.protocol import PLANE_RIG
    from ocp_ros.report.rig_planning import CAMERAS, MOUNT
    from ocp_ros.rig.rig_file import load_rig, rig_of, with_count
    from ocp_ros.util.files import folder_to_write, write_atomically
    from ocp_ros.util.yaml_files import written
    count = arguments.cameras or CAMERAS
    rig = with_count(load_rig(find_config(PLANE_RIG)), count) if arguments.sensor is None else \
        rig_of(count, arguments.sensor, mount={'on': arguments.mount or MOUNT})
    path = folder_to_write(arguments.out) / 'rig.yaml'
    write_atomically(path, written(rig.document.data, path.suffix))
    arguments.rig = path
    return path
