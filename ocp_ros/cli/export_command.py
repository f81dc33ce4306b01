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

"""``ocp export``: write a placement in the formats of other programs."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ocp_ros.cli.arguments import (
    add_frame,
    add_overwrite,
    add_placement,
    add_reading,
    read_names,
    room_asked,
)
from ocp_ros.cli.common import claim_folder, command_of, Commands, EVALUATE, Found, show_written
from ocp_ros.util.settings import ConfigurationError

if TYPE_CHECKING:
    from ocp_ros.report.assessment import Assessment
    from ocp_ros.rig.placement_file import Placement


def add_arguments(commands: Commands) -> None:
    """Add ``ocp export``."""
    command = commands.add(
        EVALUATE, 'export', 'write a placement for other programs',
        'ocp export placement.yaml --to colmap,nerfstudio,usd --out out/export')
    add_placement(command)
    command.add_argument('--to', type=read_names, required=True, metavar='FORMATS',
                         help='formats, with commas between, such as colmap,usd: '
                         'docs/reference/formats.md')
    command.add_argument('--room', metavar='ROOM', help='a scan, or the seed of a generated room, '
                         'for formats that show the room; default: as in the placement')
    command.add_argument('--out', type=Path, default=Path('out/export'), metavar='DIR',
                         help='folder for the files')
    add_frame(command)
    add_overwrite(command)
    add_reading(command)
    command.set_defaults(run=run, show=show_written)


def run(arguments: argparse.Namespace) -> Found:
    """Write the files of a placement, and return their paths."""
    from ocp_ros.formats.exported import Exported
    from ocp_ros.formats.exports import export_to, FORMATS, formats_named, MARK, WRITTEN
    from ocp_ros.rig.placement_file import data_of, load_placement
    from ocp_ros.rig.rig_file import load_rig
    from ocp_ros.util.files import folder_to_write
    formats = formats_named(arguments.to, '--to')
    claim_folder(arguments, arguments.out, WRITTEN, MARK)
    placement = load_placement(arguments.placement,
                               load_rig(arguments.rig) if arguments.rig else None)
    assessed = None
    if (arguments.room or arguments.frame == 'source'
            or any(FORMATS[name].room for name in formats)):
        assessed = _assessed(arguments, placement)
        placement = assessed.placement
    folder = folder_to_write(arguments.out)
    exported = Exported(placement, arguments.frame_prefix, assessed=assessed)
    return {'cameras': data_of(placement)['cameras'], **export_to(folder, exported, formats)}


def _assessed(arguments: argparse.Namespace, placement: 'Placement') -> 'Assessment':
    """Evaluate the placement in the room of the option, or in that of the placement file."""
    from ocp_ros.report.assessment import assess
    recorded = placement.room
    if arguments.room is None:
        if not {'file', 'seed'} & recorded.keys():
            raise ConfigurationError(f'{arguments.placement}: found no room; expected one for '
                                     'these formats; name it by --room')
        arguments.room = str(recorded.get('file', recorded.get('seed')))
    scene, room = room_asked(arguments, recorded)
    return assess(scene, placement, room, command_of(arguments.argv), arguments.frame)
