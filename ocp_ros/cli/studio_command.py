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

"""``ocp studio``: move cameras in a room and see at once what they see, in a browser."""

import argparse
from pathlib import Path

from ocp_ros.cli.arguments import add_export, add_reading, room_and_placement, room_asked, whole
from ocp_ros.cli.common import command_of, Commands, Found, LOOK
from ocp_ros.studio import FIRST_PORT, LOCAL_ADDRESS
from ocp_ros.util.resources import find_config
from ocp_ros.util.settings import need


def add_arguments(commands: Commands) -> None:
    """Add ``ocp studio``."""
    studio = commands.add(LOOK, 'studio', 'edit a placement in a browser and see what it sees',
                          'ocp studio room.ply --rig rig.yaml --out out/studio')
    studio.add_argument('room', metavar='ROOM', help='a scan, or the seed of a generated room')
    studio.add_argument('--rig', type=find_config,
                        help='rig file with cameras and constraints: docs/reference/rig.md; '
                             'default: 4 realsense_d455 on the walls')
    studio.add_argument('--placement', type=Path,
                        help='placement file to begin with: docs/reference/placement.md')
    studio.add_argument('--out', type=Path, default=Path('out/studio'), metavar='DIR',
                        help='folder for files; the page reads and writes no others')
    studio.add_argument('--host', default=LOCAL_ADDRESS,
                        help=f'address to listen on; default: {LOCAL_ADDRESS}, which only this '
                             'machine reaches; any other gets a random token in the URL')
    studio.add_argument('--port', type=whole(0, 65535, 'a number'), default=FIRST_PORT,
                        help='port, or the first one to try; 0: any free one; default: '
                             f'{FIRST_PORT}')
    add_export(studio)
    add_reading(studio)
    studio.set_defaults(run=run, show=lambda found: None)


def run(arguments: argparse.Namespace) -> Found:
    """Serve the page until Ctrl-C; return an empty result."""
    from ocp_ros.report.rig_planning import CAMERAS, MOUNT
    from ocp_ros.rig.rig_file import load_rig, rig_of
    need('ocp studio', 'viser')
    from ocp_ros.studio.folder import Folder
    from ocp_ros.studio.model import Studio
    from ocp_ros.studio.page import Page
    from ocp_ros.studio.server import start_server
    if arguments.placement:
        scene, placement, room = room_and_placement(arguments)
        studio = Studio(scene, room, placement.rig_in(scene), placement.poses, placement.engine,
                        command_of(arguments.argv))
    else:
        rig = load_rig(arguments.rig) if arguments.rig else rig_of(
            CAMERAS, 'realsense_d455', mount={'on': MOUNT})
        scene, room = room_asked(arguments, {})
        studio = Studio(scene, room, rig, command=command_of(arguments.argv))
    folder = Folder(arguments.out, arguments.export)
    server, url = start_server(arguments.host, arguments.port)
    page = Page(server, studio, folder)
    print(f'the studio is at {url} (Ctrl-C ends it); files: {folder.path}', flush=True)
    try:
        page.wait()
    finally:
        page.close()
    return {}
