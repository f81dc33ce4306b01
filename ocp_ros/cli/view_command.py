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

"""``ocp view``: show a room, with or without a placement, as a 3D page."""

import argparse
from pathlib import Path
import sys
import webbrowser

from ocp_ros.cli.arguments import (
    add_overwrite,
    add_placement,
    add_reading,
    add_room,
    room_and_placement,
    room_asked,
)
from ocp_ros.cli.common import claim_file, command_of, Commands, Found, LOOK, show_written
from ocp_ros.util.files import printable
from ocp_ros.util.settings import ConfigurationError, need


def add_arguments(commands: Commands) -> None:
    """Add ``ocp view``."""
    command = commands.add(LOOK, 'view', 'write a 3D page of a room and a placement',
                           'ocp view room.ply placement.yaml --out out/view.html')
    add_room(command)
    add_placement(command, nargs='?')
    command.add_argument('--out', type=Path, default=Path('out/view.html'), help='page to write')
    command.add_argument('--open', action='store_true', help='open the page in a browser')
    add_overwrite(command)
    add_reading(command)
    command.set_defaults(run=run, show=show_written)


def run(arguments: argparse.Namespace) -> Found:
    """Write the page, and open it with ``--open``."""
    need('ocp view', 'plotly')
    from ocp_ros.report.assessment import assess
    from ocp_ros.report.viewer import write_view
    claim_file(arguments, arguments.out, 'a page')
    if arguments.rig and not arguments.placement:
        raise ConfigurationError(f'--rig: found {arguments.rig} and no placement; expected a '
                                 'placement that it is about; name one, or leave it out')
    if arguments.placement is None:
        scene, room = room_asked(arguments, {})
        write_view(arguments.out, scene)
    else:
        scene, placement, room = room_and_placement(arguments)
        write_view(arguments.out, scene, assess(scene, placement, room,
                                                command_of(arguments.argv)))
    if arguments.open and not webbrowser.open(arguments.out.resolve().as_uri()):
        print(f'no browser was found; open {printable(str(arguments.out))} in one',
              file=sys.stderr)
    return {'room': room, 'written': [str(arguments.out)]}
