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

"""``ocp info``: measure and draw a room, before cameras are planned for it."""

import argparse
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from ocp_ros.cli.arguments import add_overwrite, add_reading, add_room, room_asked
from ocp_ros.cli.common import claim_file, Commands, Found, LOOK, show_written


def add_arguments(commands: Commands) -> None:
    """Add ``ocp info``."""
    command = commands.add(LOOK, 'info', 'measure a room: size, floor, ceiling, openings, unit',
                           'ocp info room.ply --out out/info.png')
    add_room(command)
    command.add_argument('--out', type=Path, default=Path('out/info.png'), help='picture to write')
    add_overwrite(command)
    add_reading(command)
    command.set_defaults(run=run, show=show)


def run(arguments: argparse.Namespace) -> Found:
    """Measure a room, draw it without front walls, and return the measurements."""
    from ocp_ros.report.drawing.room_pictures import draw_rooms
    from ocp_ros.report.room_facts import facts_of
    claim_file(arguments, arguments.out, 'a picture')
    scene, room = room_asked(arguments, {})
    size = ' x '.join(f'{edge:.1f}' for edge in scene.size)
    # The room is measured in a thread while the picture is drawn.
    with ThreadPoolExecutor(1) as executor:
        facts = executor.submit(facts_of, scene)
        draw_rooms(arguments.out, [(f'{scene.name}: {size} m', scene)])
    return {'room': room, **facts.result(), 'written': [arguments.out]}


def show(result: Found) -> None:
    """Print the measurements."""
    from ocp_ros.report.terminal import show_room, wide_console
    show_room(wide_console(), result)
    show_written(result)
