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

"""``ocp room``: make a room from tape measurements, without a scanner."""

import argparse
from pathlib import Path
import shlex

from ocp_ros.cli.arguments import add_overwrite
from ocp_ros.cli.common import claim_file, Commands, Found, LOOK
from ocp_ros.util.files import printable
from ocp_ros.util.settings import ConfigurationError


def add_arguments(commands: Commands) -> None:
    """Add ``ocp room``."""
    command = commands.add(LOOK, 'room', 'make a room from measures',
                           'ocp room 6 4.5 2.7 --door south 1 0.9 2.1 --box 2 1 0 4 2 0.75 '
                           '--out out/room.yaml')
    for name, axis in (('length', 'x'), ('width', 'y'), ('height', 'z')):
        command.add_argument(name, metavar=name.upper(), help=f'metres along {axis}')
    openings = {'action': 'append', 'default': []}
    command.add_argument('--door', nargs=4, metavar=('WALL', 'AT', 'WIDTH', 'HEIGHT'), **openings,
                         help='an open door in the south (y = 0), east, north or west (x = 0) '
                         'wall: metres along it from the corner with the lower x or y, width and '
                         'height')
    command.add_argument('--window', nargs=5, metavar=('WALL', 'AT', 'WIDTH', 'HEIGHT', 'SILL'),
                         help='the same, and the metres from the floor to its sill', **openings)
    command.add_argument('--box', nargs=6, metavar=('X', 'Y', 'Z', 'X2', 'Y2', 'Z2'), **openings,
                         help='furniture: its lowest and its highest corner')
    command.add_argument('--out', type=Path, default=Path('out/room.yaml'), metavar='FILE',
                         help='room file to write: docs/reference/room.md')
    add_overwrite(command)
    command.set_defaults(run=run, show=show)


def run(arguments: argparse.Namespace) -> Found:
    """Write a room file, and return its content."""
    from ocp_ros.scenes.file_formats import MEASURED
    from ocp_ros.scenes.measured_room import document_of, triangles_of
    from ocp_ros.util.files import write_atomically
    from ocp_ros.util.yaml_files import written
    if arguments.out.suffix.lower() not in MEASURED:
        raise ConfigurationError(
            f'--out: found {arguments.out.name}; expected a name that ends in '
            f'{" or ".join(MEASURED)}, as room files have it; name another')
    claim_file(arguments, arguments.out, 'a room file')
    document = document_of((arguments.length, arguments.width, arguments.height),
                           [*arguments.door, *arguments.window], arguments.box)
    triangles_of(document)  # Raises an error if doors, windows or boxes do not fit the room.
    write_atomically(arguments.out, written(document.data, arguments.out.suffix).encode())
    return {'written': [arguments.out], **document.data}


def show(result: Found) -> None:
    """Print the name of the room file, its content and the next command."""
    path = printable(str(result['written'][0]))
    print(f'wrote {path}: {" x ".join(f"{edge:g}" for edge in result["size"])} m, '
          f'{len(result["openings"])} doors and windows, {len(result["boxes"])} boxes\n'
          f'next: ocp plan {shlex.quote(path)}')
