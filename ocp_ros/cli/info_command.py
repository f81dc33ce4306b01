# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ocp info``: what a room is like, before cameras are planned for it."""

import argparse
from pathlib import Path

from ocp_ros.cli.arguments import add_overwrite, add_points, add_reading
from ocp_ros.cli.common import claim_file, Commands, Found, LOOK, show_written


def run(arguments: argparse.Namespace) -> Found:
    """Measure a room, and draw it cut open."""
    from ocp_ros.cli.placement_files import room_asked
    from ocp_ros.report.drawing.room_pictures import draw_rooms
    from ocp_ros.report.room_facts import facts_of
    claim_file(arguments, arguments.out, 'a picture')
    scene, room = room_asked(arguments, {})
    found = facts_of(scene)
    size = ' x '.join(f'{edge:.1f}' for edge in found['size'])
    draw_rooms(arguments.out, [(f'{scene.name}: {size} m', scene)])
    return {'room': room, **found, 'written': [arguments.out]}


def show(found: Found) -> None:
    """Print what was measured."""
    from rich.console import Console

    from ocp_ros.report.room_facts import show_facts
    show_facts(Console(width=100), found)
    show_written(found)


def add_arguments(commands: Commands) -> None:
    """Add ``ocp info``."""
    asked = commands.add(LOOK, 'info', 'measure a room: size, floor, ceiling, openings, unit',
                         'ocp info room.ply --out out/info.png')
    asked.add_argument('room', metavar='ROOM', help='a scan, or the seed of a generated room')
    asked.add_argument('--out', type=Path, default=Path('out/info.png'), help='picture to write')
    add_overwrite(asked)
    add_points(asked)
    add_reading(asked)
    asked.set_defaults(run=run, show=show)
