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

"""``ocp rooms``: list generated rooms, or write them to files."""

import argparse
from pathlib import Path

from ocp_ros.cli.arguments import add_overwrite, read_room_points, read_seed
from ocp_ros.cli.common import claim_file, Commands, Found, LOOK, show_written


def add_arguments(commands: Commands) -> None:
    """Add ``ocp rooms``."""
    command = commands.add(LOOK, 'rooms', 'list generated rooms, or write them as PLY',
                           'ocp rooms 5 17 --out rooms')
    command.add_argument('seeds', type=read_seed, nargs='*', default=range(20), metavar='SEED',
                         help='seed of a room; default: 0 to 19')
    command.add_argument('--points', type=read_room_points, default=15000,
                         help='points of each scan')
    command.add_argument('--out', type=Path, metavar='DIR', help='folder for scans and meshes')
    add_overwrite(command)
    command.set_defaults(run=run, show=show)


def run(arguments: argparse.Namespace) -> Found:
    """Return kinds and sizes of generated rooms; write scans and meshes if ``--out`` is given."""
    from ocp_ros.rooms.generator import generate_room, plan_of
    from ocp_ros.scenes.scene_files import mesh_of, save_scene
    written = {}
    if arguments.out:
        written = {seed: arguments.out / f'room-{seed}.ply' for seed in arguments.seeds}
    for path in written.values():
        for output in (path, mesh_of(path)):
            claim_file(arguments, output, 'a room')
    for seed, path in written.items():
        save_scene(generate_room(seed, arguments.points), path)
    plans = {seed: plan_of(seed) for seed in arguments.seeds}
    return {'rooms': [{'seed': seed, 'kind': plan.kind, 'size': plan.size}
                      for seed, plan in plans.items()], 'written': list(written.values())}


def show(result: Found) -> None:
    """Print kinds and sizes of rooms, and the names of the written files."""
    for room in result['rooms']:
        size = ' x '.join(f'{edge:.1f}' for edge in room['size'])
        print(f'{room["seed"]}: {room["kind"].replace("_", " ")}, {size} m')
    show_written(result)
