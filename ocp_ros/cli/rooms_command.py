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

"""``ocp rooms``: list, make and draw generated rooms."""

import argparse
from pathlib import Path

from ocp_ros.cli.arguments import add_overwrite, add_reading, whole
from ocp_ros.cli.common import claim_file, Commands, Found, LOOK, show_written
from ocp_ros.util.files import folder_to_write
from ocp_ros.util.terminal_text import printable


def add_arguments(commands: Commands) -> None:
    """Add ``ocp rooms`` and its actions."""
    rooms_parser = commands.add(LOOK, 'rooms', 'list, make and look at generated rooms')
    actions = rooms_parser.add_subparsers(title='actions', required=True, metavar='ACTION')
    command = commands.add_parser(actions, 'list', 'kinds and sizes', 'ocp rooms list --count 5')
    command.add_argument('--first', type=whole(0), default=0, help='first seed')
    command.add_argument('--count', type=whole(1), default=20, help='number of rooms')
    command.set_defaults(run=_list_rooms, show=_show_rooms)
    command = commands.add_parser(actions, 'make', 'write scans and meshes as PLY',
                                  'ocp rooms make 5 17 --out rooms')
    command.add_argument('seeds', type=whole(0), nargs='+', metavar='SEED')
    command.add_argument('--points', type=whole(1000), default=15000, help='points of each scan')
    command.add_argument('--out', type=Path, default=Path('out/rooms'), help='folder to write to')
    add_overwrite(command)
    command.set_defaults(run=_make_rooms, show=_show_made)
    command = commands.add_parser(actions, 'preview', 'draw rooms cut open',
                                  'ocp rooms preview 5 room.ply --out out/rooms.png')
    command.add_argument('rooms', nargs='+', metavar='ROOM', help='a seed or a scan')
    command.add_argument('--points', type=whole(1000), default=40000, help='points of each room')
    add_reading(command)
    command.add_argument('--out', type=Path, default=Path('out/rooms.png'), help='picture file')
    add_overwrite(command)
    command.set_defaults(run=_preview_rooms, show=show_written)


def _list_rooms(arguments: argparse.Namespace) -> Found:
    """Return kinds and sizes of generated rooms."""
    from ocp_ros.rooms.generator import plan_of
    seeds = range(arguments.first, arguments.first + arguments.count)
    plans = map(plan_of, seeds)
    return {'rooms': [{'seed': seed, 'kind': plan.kind, 'size': plan.size,
                       'solids': len(plan.solids)} for seed, plan in zip(seeds, plans)]}


def _show_rooms(result: Found) -> None:
    """Print kinds and sizes of generated rooms."""
    from ocp_ros.report.terminal import print_table
    from rich.console import Console
    print_table(Console(), None, ('seed', 'kind', 'size (m)', 'solids'), [
        (str(room['seed']), room['kind'].replace('_', ' '),
         ' x '.join(f'{edge:.1f}' for edge in room['size']), str(room['solids']))
        for room in result['rooms']])


def _make_rooms(arguments: argparse.Namespace) -> Found:
    """Write generated rooms and their meshes; return the paths of the rooms."""
    from ocp_ros.rooms.generator import generate_room
    from ocp_ros.scenes.scene_files import mesh_of, save_scene
    from rich.console import Console
    from rich.progress import track
    folder_to_write(arguments.out)
    paths = [arguments.out / f'room-{seed}.ply' for seed in arguments.seeds]
    for path in paths:
        for output in (path, mesh_of(path)):
            claim_file(arguments, output, 'a room')
    for seed, path in track(list(zip(arguments.seeds, paths)), 'making rooms',
                            console=Console(stderr=True)):
        save_scene(generate_room(seed, arguments.points), path)
    return {'folder': arguments.out, 'written': paths}


def _show_made(result: Found) -> None:
    """Print the number of rooms made, and their folder."""
    print(f'wrote {len(result["written"])} rooms and their meshes to '
          f'{printable(str(result["folder"]))}')


def _preview_rooms(arguments: argparse.Namespace) -> Found:
    """Draw generated rooms and scans in a picture, and return its path."""
    from ocp_ros.report.drawing.room_pictures import draw_rooms, titled_room
    from ocp_ros.rooms.scene_source import seed_named
    from ocp_ros.scenes.scene_cache import load_cached
    claim_file(arguments, arguments.out, 'a picture')
    scenes = []
    for name in arguments.rooms:
        if name.isdecimal():
            scenes.append(titled_room(seed_named(name), arguments.points))
        else:
            # The scale 0.0 and ``file`` mean the unit and the direction that the file says.
            scene = load_cached(name, max_points=arguments.points, scale=arguments.scale or 0.0,
                                up=arguments.up or 'file', drop_nonfinite=arguments.drop_nonfinite,
                                all_rooms=arguments.all_rooms)
            scenes.append((scene.name, scene))
    draw_rooms(arguments.out, scenes)
    return {'written': [arguments.out]}
