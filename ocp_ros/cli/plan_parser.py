# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ocp plan``: find where to hang cameras."""

import argparse
from pathlib import Path

from ocp_ros.cli.arguments import (
    add_frame,
    add_overwrite,
    add_points,
    add_reading,
    at_least,
    cameras,
    count,
    seconds,
    seed,
    share,
)
from ocp_ros.cli.common import command_of, Commands, Found, PLAN
from ocp_ros.util.resources import find_config
from ocp_ros.util.settings import ConfigurationError

#: Defaults of counting cameras.
COUNTING = {'target': 0.95, 'by': 'error', 'most': 12}


def _plan(arguments: argparse.Namespace) -> Found:
    """Find where to hang the cameras of a rig, and how many are needed."""
    from ocp_ros.cli.plan_command import plan
    for name, default in COUNTING.items():
        if getattr(arguments, name) is None:
            setattr(arguments, name, default)
        elif arguments.count != 0:
            raise ConfigurationError(f'--{name}: found it without --count auto; expected it where '
                                     'cameras are counted; leave it out, or add --count auto')
    return plan(arguments, command_of(arguments.argv))


def _show(found: Found) -> None:
    """Print a plan."""
    from ocp_ros.cli.plan_command import show
    show(found)


def add_plan(commands: Commands) -> None:
    """Add ``ocp plan``."""
    planned = commands.add(PLAN, 'plan', 'find the best poses of cameras in a room',
                           'ocp plan room.ply --cameras 4 --model d455 --out out/plan')
    planned.add_argument('room', metavar='ROOM', help='a scan, or the seed of a generated room')
    rig = planned.add_mutually_exclusive_group()
    rig.add_argument('--rig', type=find_config,
                     help='rig file with cameras and constraints: docs/reference/rig.md')
    rig.add_argument('--model', metavar='SENSOR', default='omnidirectional',
                     help='sensor of all cameras, or a part of its name such as d455')
    planned.add_argument('--mount', choices=('walls', 'ceiling', 'plane', 'free'),
                         help='mount of all cameras: walls (1.5 to 2.5 m above the floor), '
                              'ceiling (below it), plane (1.9 m above the floor) or free (1.5 to '
                              '2.5 m); default: walls, or the mount in the rig file')
    planned.add_argument('--cameras', '--count', dest='count', type=count, metavar='N',
                         help='number of cameras, or auto; default: 4, or the number in the rig '
                              'file')
    planned.add_argument('--target', type=share,
                         help='with auto: share to reach of what all candidates reach together; '
                              'default: 0.95')
    planned.add_argument('--by', choices=('error', 'seen', 'coverage'),
                         help='with auto: share of the error reduction, of the seen points or of '
                              'the space coverage')
    planned.add_argument('--most', type=cameras,
                         help='with auto: largest number of cameras; default: 12')
    planned.add_argument('--planner', default='rig_search', metavar='NAME',
                         help='planner that searches: rig_search (default) or a name of '
                         'docs/reference/planners.md, such as cma_es or lookahead')
    planned.add_argument('--seconds', type=seconds, help='seconds of search for each number of '
                                                         'cameras; default: 60, or 15 with auto; '
                                                         'without limit if --evaluations is given')
    planned.add_argument('--evaluations', type=at_least(1),
                         help='number of placements to evaluate; the same seed gives the same '
                              'result')
    planned.add_argument('--seed', type=seed, default=0, help='random seed')
    planned.add_argument('--out', type=Path, default=Path('out/plan'), metavar='DIR',
                         help='folder for report, placement, CSV, launch file, xacro and more')
    add_frame(planned)
    add_overwrite(planned)
    add_points(planned)
    add_reading(planned)
    planned.set_defaults(run=_plan, show=_show)
