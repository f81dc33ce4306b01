# SPDX-License-Identifier: Apache-2.0
"""``ocp``: the package's tools for people without a ROS graph."""

import argparse
import os
from pathlib import Path
import sys

from ocp_ros.agent.checkpoint import CheckpointError
from ocp_ros.arguments import at_least, count, names, seconds, share, whole_numbers
from ocp_ros.configuration import ConfigurationError
from ocp_ros.scenes.scene import SceneError


def _train(arguments: argparse.Namespace) -> None:
    """Train a policy and print what it does in rooms it has never seen."""
    from ocp_ros.training.train import read_config, train
    config = read_config(arguments.config)
    checkpoint = train(config, arguments.out, f'ocp train --config {arguments.config}')
    test = checkpoint.provenance['test']
    for name in ('random_moves', 'policy'):
        figures = test[name]
        print(f'{name:>12}: depth error {figures["depth_error_start"]:.2f} m -> '
              f'{figures["depth_error_end"]:.2f} m ({figures["ratio"]:.3f})')
    if arguments.model:
        checkpoint.save(arguments.model)
        print(f'wrote {arguments.model}')


def _benchmark(arguments: argparse.Namespace) -> None:
    """Compare planners, write the results and, where it is wanted, a report."""
    from ocp_ros.report.compare import command_of, compare
    compare(arguments, command_of(arguments.argv))


def _evaluate(arguments: argparse.Namespace) -> None:
    """Compare a policy with other planners, room by room."""
    from ocp_ros.report.compare import command_of
    from ocp_ros.report.evaluate import evaluate
    evaluate(arguments, command_of(arguments.argv))


def _score(arguments: argparse.Namespace) -> None:
    """Judge a placement of a rig in a room."""
    from ocp_ros.report.compare import command_of
    from ocp_ros.report.score import score
    score(arguments, command_of(arguments.argv))


def _plan(arguments: argparse.Namespace) -> None:
    """Find where to hang the cameras of a rig, and how many are needed."""
    from ocp_ros.report.compare import command_of
    from ocp_ros.report.plan import plan
    plan(arguments, command_of(arguments.argv))


def _list_rooms(arguments: argparse.Namespace) -> None:
    """Print kinds and sizes of generated rooms."""
    from rich.console import Console
    from rich.table import Table

    from ocp_ros.scenes.rooms import plan_of
    table = Table('seed', 'kind', 'size (m)', 'solids')
    for seed in range(arguments.first, arguments.first + arguments.count):
        plan = plan_of(seed)
        table.add_row(str(seed), plan.kind.replace('_', ' '),
                      ' x '.join(f'{edge:.1f}' for edge in plan.size), str(len(plan.solids)))
    Console().print(table)


def _make_rooms(arguments: argparse.Namespace) -> None:
    """Write generated rooms and their meshes."""
    from rich.console import Console
    from rich.progress import track

    from ocp_ros.scenes.files import save_scene
    from ocp_ros.scenes.rooms import generate_room
    for seed in track(arguments.seeds, 'making rooms', console=Console(stderr=True)):
        save_scene(generate_room(seed, arguments.points), arguments.out / f'room-{seed}.ply')
    print(f'wrote {len(arguments.seeds)} rooms and their meshes to {arguments.out}')


def _preview_rooms(arguments: argparse.Namespace) -> None:
    """Draw generated rooms and scans."""
    from ocp_ros.report.rooms import draw_sheet, titled
    from ocp_ros.scenes.cached import load_cached
    scenes = []
    try:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        if arguments.out.is_dir():
            raise IsADirectoryError(0, 'it is a folder')
    except OSError as error:
        raise ConfigurationError(f'--out: found {arguments.out}, which cannot be written '
                                 f'({error.strerror}); expected a file to write a picture to'
                                 ) from error
    for name in arguments.rooms:
        if name.isdecimal():
            scenes.append(titled(int(name), arguments.points))
        else:
            scene = load_cached(name, max_points=arguments.points)
            scenes.append((scene.name, scene))
    draw_sheet(arguments.out, scenes)
    print(f'wrote {arguments.out}')


def _add_rooms(commands) -> None:
    """Add ``ocp rooms`` and what it can do."""
    rooms = commands.add_parser('rooms', help='list, make and look at generated rooms')
    actions = rooms.add_subparsers(title='actions', required=True, metavar='ACTION')
    listed = actions.add_parser('list', help='kinds and sizes')
    listed.add_argument('--first', type=at_least(0), default=0, help='first seed')
    listed.add_argument('--count', type=at_least(1), default=20, help='how many')
    listed.set_defaults(run=_list_rooms)
    made = actions.add_parser('make', help='write scans and meshes as PLY')
    made.add_argument('seeds', type=at_least(0), nargs='+', metavar='SEED')
    made.add_argument('--points', type=at_least(1000), default=15000, help='of each scan')
    made.add_argument('--out', type=Path, default=Path('out/rooms'), help='folder to write to')
    made.set_defaults(run=_make_rooms)
    seen = actions.add_parser('preview', help='draw rooms cut open')
    seen.add_argument('rooms', nargs='+', metavar='ROOM', help='a seed or a scan')
    seen.add_argument('--points', type=at_least(1000), default=40000, help='of each room')
    seen.add_argument('--out', type=Path, default=Path('out/rooms.png'), help='picture to write')
    seen.set_defaults(run=_preview_rooms)


def _add_evaluate(commands) -> None:
    """Add ``ocp evaluate``."""
    judged = commands.add_parser('evaluate', help='judge a policy room by room')
    judged.add_argument('--model', default='default', help='weights: a path, or a name')
    judged.add_argument('--planners', type=names, default=('learned', 'hand_rule'),
                        help='names with commas between; the first is compared with the others')
    rooms = judged.add_mutually_exclusive_group()
    rooms.add_argument('--set', choices=('fresh', 'test', 'training', 'validation'),
                       default='fresh', help='which generated rooms; fresh ones unless named')
    rooms.add_argument('--rooms', type=Path, nargs='+', metavar='SCAN', help='scans instead')
    judged.add_argument('--scale', type=float, default=1.0, help='metres per unit of the scans')
    judged.add_argument('--up', choices=('x', 'y', 'z'), default='z',
                        help='axis of the scans that points up')
    judged.add_argument('--rotations', type=whole_numbers, default=(0,),
                        help='degrees, with commas between')
    judged.add_argument('--cameras', type=whole_numbers, default=(4,),
                        help='how many, with commas between')
    judged.add_argument('--budgets', type=whole_numbers, default=(1000,),
                        help='evaluations of offline planners, with commas between')
    judged.add_argument('--seeds', type=at_least(1), default=1, help='runs of each')
    judged.add_argument('--workers', type=at_least(1),
                        help='processes; one for each core unless named')
    judged.add_argument('--out', type=Path, default=Path('out/evaluation'),
                        help='folder of the results; an interrupted evaluation goes on')
    judged.set_defaults(run=_evaluate)


def _add_score(commands) -> None:
    """Add ``ocp score``."""
    judged = commands.add_parser('score', help='judge cameras that hang, or shall hang, in a room')
    judged.add_argument('room', metavar='ROOM', help='a scan, or the seed of a generated room')
    judged.add_argument('placement', type=Path, metavar='PLACEMENT',
                        help='YAML or JSON: docs/placement.md')
    judged.add_argument('--rig', type=Path,
                        help='what is asked for, in place of what the placement says: docs/rig.md')
    judged.add_argument('--json', action='store_true', help='print JSON and nothing else')
    judged.add_argument('--export', type=Path, metavar='DIR',
                        help='write placement, CSV, launch file, xacro and installer page here')
    judged.add_argument('--scale', type=float, help='metres per unit of the scan')
    judged.add_argument('--up', choices=('x', 'y', 'z'), help='axis of the scan that points up')
    judged.set_defaults(run=_score)


def _add_plan(commands) -> None:
    """Add ``ocp plan``."""
    planned = commands.add_parser('plan', help='find where to hang cameras in a room')
    planned.add_argument('room', metavar='ROOM', help='a scan, or the seed of a generated room')
    rig = planned.add_mutually_exclusive_group()
    rig.add_argument('--rig', type=Path, help='cameras and what is asked of them: docs/rig.md')
    rig.add_argument('--model', metavar='SENSOR', default='omnidirectional',
                     help='the sensor of all cameras, or a part of its name such as d455')
    planned.add_argument('--cameras', '--count', dest='count', type=count, metavar='N',
                         help='how many, or auto; 4 or what the rig file says unless named')
    planned.add_argument('--target', type=share, default=0.95,
                         help='with auto: share of what can be reached at all, 0.95 unless named')
    planned.add_argument('--by', choices=('error', 'seen', 'coverage'), default='error',
                         help='with auto, share of what: depth error taken away, points seen, or '
                         'space covered')
    planned.add_argument('--most', type=at_least(1), default=12,
                         help='with auto: the most cameras to try')
    planned.add_argument('--seconds', type=seconds, help='of search for each number of cameras; '
                         '60, or 15 with auto, unless evaluations are named')
    planned.add_argument('--evaluations', type=at_least(1),
                         help='judge so many placements; the same seed finds the same answer')
    planned.add_argument('--seed', type=at_least(0), default=0, help='of all chance')
    planned.add_argument('--out', type=Path, default=Path('out/plan'), metavar='DIR',
                         help='write placement, CSV, launch file, xacro and installer page here')
    planned.add_argument('--json', action='store_true', help='print JSON and nothing else')
    planned.add_argument('--scale', type=float, help='metres per unit of the scan')
    planned.add_argument('--up', choices=('x', 'y', 'z'), help='axis of the scan that points up')
    planned.set_defaults(run=_plan)


def parser() -> argparse.ArgumentParser:
    """Build the parser of all commands."""
    top = argparse.ArgumentParser(prog='ocp', description=__doc__)
    commands = top.add_subparsers(title='commands', required=True, metavar='COMMAND')
    train = commands.add_parser('train', help='train a policy')
    train.add_argument('--config', type=Path, required=True, help='YAML of training settings')
    train.add_argument('--out', type=Path, required=True,
                       help='folder of the run; an interrupted one goes on')
    train.add_argument('--model', type=Path, help='write the best weights here as well')
    train.set_defaults(run=_train)
    compare = commands.add_parser('benchmark', help='compare planners under equal budgets')
    compare.add_argument('--preset', choices=('smoke', 'full'), default='smoke',
                         help='smoke: two rooms, under two minutes; full: ten rooms, three '
                         'rotations, up to 10,000 evaluations')
    compare.add_argument('--rooms', type=Path, help='folder of scans to take instead')
    compare.add_argument('--scale', type=float, help='metres per unit of the scans')
    compare.add_argument('--up', choices=('x', 'y', 'z'), help='axis of the scans that points up')
    compare.add_argument('--planners', type=names,
                         help='names with commas between; all unless named')
    compare.add_argument('--budgets', type=whole_numbers, help='evaluations, with commas between')
    compare.add_argument('--seeds', type=int, help='runs of each')
    compare.add_argument('--out', type=Path, default=Path('out/benchmark'),
                         help='folder of the results; an interrupted comparison goes on')
    compare.add_argument('--workers', type=at_least(1),
                         help='processes; one for each core unless named')
    compare.add_argument('--ray', metavar='ADDRESS', help='run on a Ray cluster, such as auto')
    compare.add_argument('--report', type=Path, nargs='?', const=Path('docs/benchmark'),
                         help='write tables and figures here')
    compare.set_defaults(run=_benchmark)
    _add_evaluate(commands)
    _add_score(commands)
    _add_plan(commands)
    _add_rooms(commands)
    return top


def main(argv: list[str] | None = None) -> int:
    """Run one command; bad input gets one sentence and exit code 2."""
    arguments = parser().parse_args(argv)
    arguments.argv = sys.argv[1:] if argv is None else argv
    try:
        arguments.run(arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        # Whoever reads has seen enough, such as head; nobody is left to be told.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (SceneError, ConfigurationError, CheckpointError, OSError) as error:
        print(f'ocp: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == '__main__':
    sys.exit(main())
