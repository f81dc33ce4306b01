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

"""``ocp score``: evaluate a placement of a rig in a room, and suggest improvements."""

import argparse
from pathlib import Path

from ocp_ros.cli.arguments import (
    add_export,
    add_frame,
    add_overwrite,
    add_placement,
    add_reading,
    add_room,
    room_and_placement,
)
from ocp_ros.cli.common import claim_folder, command_of, Commands, EVALUATE, Found, show_written
from ocp_ros.util.settings import ConfigurationError, need


def add_arguments(commands: Commands) -> None:
    """Add ``ocp score``."""
    command = commands.add(EVALUATE, 'score', 'evaluate a placement of cameras in a room',
                           'ocp score room.ply placement.yaml --rig rig.yaml --out out/hang-up')
    add_room(command)
    add_placement(command)
    command.add_argument('--out', type=Path, metavar='DIR', help='folder for report, placement, '
                         'CSV, launch file, xacro and more')
    add_export(command)
    add_frame(command)
    add_overwrite(command)
    add_reading(command)
    command.set_defaults(run=run, show=show)


def run(arguments: argparse.Namespace) -> Found:
    """Evaluate a placement, write its files if ``--out`` is given, and return the findings."""
    from ocp_ros.formats.exported import Exported
    from ocp_ros.formats.exports import export_to, formats_named, MARK, WRITTEN
    from ocp_ros.report.assessment import assess
    from ocp_ros.util.files import folder_to_write
    formats = formats_named(arguments.export, '--export')
    if arguments.out:
        need('ocp score --out', 'plotly')
        claim_folder(arguments, arguments.out, WRITTEN, MARK)
    elif arguments.export != ('default',):
        raise ConfigurationError(f'--export: found {",".join(arguments.export)} without --out; '
                                 'expected both; name a folder, or run ocp export')
    scene, placement, room = room_and_placement(arguments)
    folder = arguments.out and folder_to_write(arguments.out)
    assessed = assess(scene, placement, room, command_of(arguments.argv), arguments.frame)
    if folder is None:
        return assessed.found
    exported = Exported(assessed.placement, arguments.frame_prefix, assessed=assessed)
    return {**assessed.found, **export_to(folder, exported, formats)}


def show(result: Found) -> None:
    """Print the findings on the placement, and the names of the written files."""
    from ocp_ros.report.terminal import show_score, wide_console
    show_score(wide_console(), result)
    show_written(result)
