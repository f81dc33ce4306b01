# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command line of ``ocp calibrate``."""

import argparse
from pathlib import Path

from ocp_ros.cli.arguments import add_overwrite, add_reading, frame_prefix
from ocp_ros.cli.common import command_of, Commands, Found, JUDGE
from ocp_ros.util.resources import find_config


def _calibrate(arguments: argparse.Namespace) -> Found:
    """Find where cameras hang."""
    from ocp_ros.cli.calibrate_command import calibrated
    return calibrated(arguments, command_of(arguments.argv))


def _show(found: Found) -> None:
    """Print what was found of each camera."""
    from ocp_ros.cli.calibrate_command import show
    show(found)


def add_calibrate(commands: Commands) -> None:
    """Add ``ocp calibrate``."""
    made = commands.add(
        JUDGE, 'calibrate', 'find where cameras hang by what they see',
        'ocp calibrate room.ply placement.yaml --clouds door.ply window.ply --out out/built')
    made.add_argument('room', metavar='ROOM', help='a scan, or the seed of a generated room')
    made.add_argument('placement', type=Path, metavar='PLACEMENT',
                      help='planned or measured poses of the cameras: docs/reference/placement.md')
    seen = made.add_mutually_exclusive_group(required=True)
    seen.add_argument('--clouds', nargs='+', metavar='[CAMERA=]FILE',
                      help='one cloud of each camera, in metres; without CAMERA=, the name of '
                      'the file is the name of the camera')
    seen.add_argument('--bag', type=Path, help='a ROS bag with a topic of clouds for each camera')
    made.add_argument('--topics', nargs='+', default=(), metavar='CAMERA=TOPIC',
                      help='topics of the bag; default: the topics whose names contain the names '
                      'of the cameras, otherwise all topics in their order')
    made.add_argument('--cloud-frame', choices=('optical', 'body'),
                      help='frame of the clouds: optical (z forward, x right, y down) or body (x '
                      'forward, y left, z up); default: optical for files, and the frame that '
                      'a bag names')
    made.add_argument('--rig', type=find_config,
                      help='constraints, instead of those in the placement: docs/reference/rig.md')
    made.add_argument('--out', type=Path, default=Path('out/built'), metavar='DIR',
                      help='write the placement as built, a launch file of static transforms and '
                      'the figures here')
    made.add_argument('--frame-prefix', type=frame_prefix, default='', metavar='NAME',
                      help='before the names of frames in the launch file')
    add_overwrite(made)
    add_reading(made)
    made.set_defaults(run=_calibrate, show=_show)
