# SPDX-License-Identifier: Apache-2.0
"""``ocp``: the package's tools for people without a ROS graph."""

import argparse
from pathlib import Path
import sys

from ocp_ros.agent.checkpoint import CheckpointError
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


def _whole_numbers(text: str) -> tuple[int, ...]:
    """Read whole numbers with commas between."""
    try:
        return tuple(int(number) for number in text.split(','))
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f'found {text!r}; expected whole numbers with commas between') from error


def _workers(text: str) -> int:
    """Read how many processes to use."""
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f'found {text!r}; expected 1 or more')
    return int(text)


def parser() -> argparse.ArgumentParser:
    """Build the parser of all commands."""
    top = argparse.ArgumentParser(prog='ocp', description=__doc__)
    commands = top.add_subparsers(title='commands', required=True, metavar='COMMAND')
    train = commands.add_parser('train', help='train a policy in generated rooms')
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
    compare.add_argument('--planners', type=lambda text: tuple(text.split(',')),
                         help='names with commas between; all unless named')
    compare.add_argument('--budgets', type=_whole_numbers, help='evaluations, with commas between')
    compare.add_argument('--seeds', type=int, help='runs of each')
    compare.add_argument('--out', type=Path, default=Path('out/benchmark'),
                         help='folder of the results; an interrupted comparison goes on')
    compare.add_argument('--workers', type=_workers,
                         help='processes; one for each core unless named')
    compare.add_argument('--ray', metavar='ADDRESS', help='run on a Ray cluster, such as auto')
    compare.add_argument('--report', type=Path, nargs='?', const=Path('docs/benchmark'),
                         help='write tables and figures here')
    compare.set_defaults(run=_benchmark)
    return top


def main(argv: list[str] | None = None) -> int:
    """Run one command; bad input gets one sentence and exit code 2."""
    arguments = parser().parse_args(argv)
    arguments.argv = sys.argv[1:] if argv is None else argv
    try:
        arguments.run(arguments)
    except (SceneError, ConfigurationError, CheckpointError, OSError) as error:
        print(f'ocp: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == '__main__':
    sys.exit(main())
