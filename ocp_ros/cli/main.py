# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ocp``: the package's tools for people without a ROS graph."""

import argparse
from dataclasses import replace
from pathlib import Path
import sys

from ocp_ros.cli.arguments import (
    add_frame,
    add_overwrite,
    add_points,
    add_reading,
    add_units,
    at_least,
    camera_counts,
    cameras,
    names,
    seed,
    whole_numbers,
)
from ocp_ros.cli.calibrate_parser import add_calibrate
from ocp_ros.cli.common import (
    claim_file,
    command_of,
    Commands,
    COMPARE,
    Found,
    JUDGE,
    LEARN,
    LOOK,
    run,
    show_written,
)
from ocp_ros.cli.info_command import add_info
from ocp_ros.cli.plan_parser import add_plan
from ocp_ros.cli.replay_command import add_replay
from ocp_ros.cli.rooms_command import add_rooms
from ocp_ros.util.files import folder_to_write
from ocp_ros.util.resources import DEFAULT_MODEL, find_config
from ocp_ros.util.shown_text import printable


def _train(arguments: argparse.Namespace) -> Found:
    """Train a policy, and say what it does in rooms it has never seen."""
    from ocp_ros.policy.checkpoint import card_of
    from ocp_ros.training.run_folder import read_config
    from ocp_ros.training.train import train
    config, command = read_config(arguments.config), f'ocp train --config {arguments.config}'
    if arguments.seed is not None:
        config = replace(config, seed=arguments.seed)
        command += f' --seed {arguments.seed}'
    folder_to_write(arguments.out)
    written = [arguments.model, card_of(arguments.model)] if arguments.model else []
    for path in written:
        claim_file(arguments, path, 'weights and their card', '--model')
    try:
        checkpoint = train(config, arguments.out, command)
    except KeyboardInterrupt:
        print(f'ocp: stopped; the same command continues with what is saved in '
              f'{printable(str(arguments.out))}', file=sys.stderr)
        raise
    if arguments.model:
        checkpoint.save(arguments.model)
    return {'test': checkpoint.provenance['test'],
            'written': [arguments.model] if arguments.model else []}


def _show_training(found: Found) -> None:
    """Print what a policy does in rooms it has never seen."""
    for name in ('random_moves', 'policy'):
        figures = found['test'][name]
        print(f'{name:>12}: depth error {figures["depth_error_start"]:.2f} m -> '
              f'{figures["depth_error_end"]:.2f} m ({figures["ratio"]:.3f})')
    show_written(found)


def _benchmark(arguments: argparse.Namespace) -> Found:
    """Compare planners, and write the results."""
    from ocp_ros.cli.compare_commands import benchmark
    return benchmark(arguments, command_of(arguments.argv))


def _show_benchmark(found: Found) -> None:
    """Print what planners deliver."""
    from ocp_ros.cli.compare_commands import show_benchmark
    show_benchmark(found)


def _evaluate(arguments: argparse.Namespace) -> Found:
    """Compare a policy with other planners, room by room."""
    from ocp_ros.cli.compare_commands import evaluate
    return evaluate(arguments, command_of(arguments.argv))


def _show_evaluation(found: Found) -> None:
    """Print how a policy compares with other planners."""
    from ocp_ros.cli.compare_commands import show_evaluation
    show_evaluation(found)


def _score(arguments: argparse.Namespace) -> Found:
    """Judge a placement of a rig in a room."""
    from ocp_ros.cli.score_command import score
    return score(arguments, command_of(arguments.argv))


def _show_score(found: Found) -> None:
    """Print a verdict."""
    from ocp_ros.cli.score_command import show
    show(found)


def _view(arguments: argparse.Namespace) -> Found:
    """Write a page of a room that can be turned around, and open it where that is wanted."""
    from ocp_ros.cli.view_command import view
    claim_file(arguments, arguments.out, 'a page')
    return view(arguments, command_of(arguments.argv))


def _add_train(commands: Commands) -> None:
    """Add ``ocp train``."""
    train = commands.add(
        LEARN, 'train', 'train a policy',
        'ocp train --config config/train/map.yaml --out out/train --model mine.safetensors')
    train.add_argument('--config', type=find_config, required=True,
                       help='YAML of training settings')
    train.add_argument('--out', type=Path, required=True,
                       help='folder of the run; an interrupted run continues')
    train.add_argument('--model', type=Path, help='also write the best weights to this file')
    train.add_argument('--seed', type=seed, help='random seed; replaces the one in the settings')
    add_overwrite(train)
    train.set_defaults(run=_train, show=_show_training)


def _add_comparison(command: argparse.ArgumentParser) -> None:
    """Add what all comparisons have: a rig file, and where they run."""
    command.add_argument('--rig', type=find_config, help='rig file, instead of omnidirectional '
                                                         'cameras: docs/reference/rig.md')
    command.add_argument('--workers', type=at_least(1),
                         help='number of processes; default: one per core')
    command.add_argument('--ray', metavar='ADDRESS', help='run on a Ray cluster, such as auto')
    add_overwrite(command)


def _add_benchmark(commands: Commands) -> None:
    """Add ``ocp benchmark``."""
    compare = commands.add(
        COMPARE, 'benchmark', 'compare planners under equal budgets',
        'ocp benchmark --rooms my_scans --planners tdsa,cma_es --budgets 1000 --seeds 5')
    compare.add_argument('--preset', choices=('smoke', 'full'), default='smoke',
                         help='smoke: two rooms, under two minutes; full: ten rooms, up to '
                         '10,000 evaluations')
    compare.add_argument('--rooms', type=Path, help='folder of scans, instead of generated rooms')
    add_units(compare, 'of the scans')
    compare.add_argument('--cameras', type=cameras, metavar='N',
                         help='number of cameras, without a rig file; default: 4')
    compare.add_argument('--sensor', metavar='SENSOR',
                         help='sensor of all cameras, without a rig file, or a part of its name '
                              'such as d455; without it omnidirectional cameras on a plane are '
                              'compared')
    compare.add_argument('--mount', choices=('walls', 'ceiling', 'plane', 'free'),
                         help='with --sensor: mount of all cameras; default: walls')
    compare.add_argument('--planners', type=names,
                         help='names with commas between; default: all')
    compare.add_argument('--budgets', type=whole_numbers, help='numbers of evaluations, with '
                                                               'commas between')
    compare.add_argument('--seeds', type=int, help='runs per planner, room and budget')
    compare.add_argument('--out', type=Path, default=Path('out/benchmark'),
                         help='folder of the results; an interrupted comparison continues')
    _add_comparison(compare)
    compare.set_defaults(run=_benchmark, show=_show_benchmark)


def _add_evaluate(commands: Commands) -> None:
    """Add ``ocp evaluate``."""
    judged = commands.add(LEARN, 'evaluate', 'evaluate a policy room by room',
                          'ocp evaluate --model models/mine.safetensors --set test')
    judged.add_argument('--model', default=DEFAULT_MODEL, help='weights: a path, or a name')
    judged.add_argument('--planners', type=names, default=('learned', 'greedy_step'),
                        help='names with commas between; the first is compared with the others')
    rooms = judged.add_mutually_exclusive_group()
    rooms.add_argument('--set', choices=('fresh', 'test', 'training', 'validation'),
                       default='fresh', help='set of generated rooms; default: fresh')
    rooms.add_argument('--rooms', type=Path, nargs='+', metavar='SCAN', help='scans, instead of '
                                                                             'generated rooms')
    add_units(judged, 'of the scans')
    judged.add_argument('--rotations', type=whole_numbers, default=(0,),
                        help='rotations of the rooms in degrees, with commas between')
    judged.add_argument('--cameras', type=camera_counts,
                        help='numbers of cameras, with commas between; default: 4')
    judged.add_argument('--budgets', type=whole_numbers, default=(1000,),
                        help='evaluations of offline planners, with commas between')
    judged.add_argument('--seeds', type=at_least(1), default=1, help='runs per planner, room and '
                                                                     'budget')
    judged.add_argument('--out', type=Path, default=Path('out/evaluation'),
                        help='folder of the results; an interrupted evaluation continues')
    _add_comparison(judged)
    judged.set_defaults(run=_evaluate, show=_show_evaluation, scale=1.0, up='z')


def _add_score(commands: Commands) -> None:
    """Add ``ocp score``."""
    judged = commands.add(JUDGE, 'score', 'evaluate a placement of cameras in a room',
                          'ocp score room.ply placement.yaml --rig rig.yaml --out out/hang-up')
    judged.add_argument('room', metavar='ROOM', help='a scan, or the seed of a generated room')
    judged.add_argument('placement', type=Path, metavar='PLACEMENT',
                        help='placement file, YAML or JSON: docs/reference/placement.md')
    judged.add_argument('--rig', type=find_config,
                        help='rig file, used instead of the one in the placement: '
                        'docs/reference/rig.md')
    judged.add_argument('--out', type=Path, metavar='DIR',
                        help='folder for report, placement, CSV, launch file, xacro and more')
    add_frame(judged)
    add_overwrite(judged)
    add_points(judged)
    add_reading(judged)
    judged.set_defaults(run=_score, show=_show_score)


def _add_view(commands: Commands) -> None:
    """Add ``ocp view``."""
    seen = commands.add(LOOK, 'view', 'write a 3D page of a room and a placement',
                        'ocp view room.ply placement.yaml --out out/view.html')
    seen.add_argument('room', metavar='ROOM', help='a scan, or the seed of a generated room')
    seen.add_argument('placement', type=Path, nargs='?', metavar='PLACEMENT',
                      help='placement file: docs/reference/placement.md')
    seen.add_argument('--rig', type=find_config,
                      help='rig file, used instead of the one in the placement: '
                      'docs/reference/rig.md')
    seen.add_argument('--out', type=Path, default=Path('out/view.html'), help='page to write')
    seen.add_argument('--open', action='store_true', help='open the page in a browser')
    add_overwrite(seen)
    add_points(seen)
    add_reading(seen)
    seen.set_defaults(run=_view, show=show_written)


def commands() -> Commands:
    """Build all commands."""
    made = Commands('ocp', 'Where do I put my depth cameras? Tools that need no ROS graph.')
    for add in (add_plan, _add_score, add_calibrate, add_info, _add_view, add_rooms, _add_train,
                _add_evaluate, _add_benchmark, add_replay):
        add(made)
    return made


def parser() -> argparse.ArgumentParser:
    """Build the parser of all commands."""
    return commands().parser


def main(argv: list[str] | None = None) -> int:
    """Run one command; bad input gets one sentence and exit code 2."""
    return run(parser(), sys.argv[1:] if argv is None else argv)


if __name__ == '__main__':
    sys.exit(main())
