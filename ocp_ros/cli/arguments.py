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

"""Options of command lines, and readers of their values, whose errors say what was expected."""

import argparse
from collections.abc import Callable, Sequence
import math
from pathlib import Path
import re
from typing import Any, TYPE_CHECKING

from ocp_ros.util.resources import find_config
from ocp_ros.util.settings import (
    ConfigurationError,
    MAX_CAMERAS,
    MAX_ROOM_POINTS,
    MAX_SEED,
    MIN_ROOM_POINTS,
)

if TYPE_CHECKING:
    from ocp_ros.rig.placement_file import Placement
    from ocp_ros.scenes.scene import Scene


def whole(low: int, high: int | None = None, name: str = 'a whole number') -> Callable[[str], int]:
    """
    Return a function that reads a whole number from a text.

    :param low: smallest number.
    :param high: largest number; None for no limit.
    :param name: what the number is, for errors; without ``high`` the error does not need it.
    """
    expected = f'{low} or more' if high is None else f'{name} from {low} to {high}'

    def read(text: str) -> int:
        # -1 stands for a text that is no number, and is always refused: ``low`` is 0 or more.
        # A number of more than 18 digits, which may not fit into 64 bits, is refused too.
        value = int(text) if text.isdecimal() and len(text) < 19 else -1
        if value < low or (high is not None and value > high):
            raise argparse.ArgumentTypeError(f'found {text!r}; expected {expected}')
        return value
    return read


read_cameras = whole(1, MAX_CAMERAS, 'a number of cameras')
read_room_points = whole(MIN_ROOM_POINTS, MAX_ROOM_POINTS)
read_seed = whole(0, MAX_SEED)


def read_count(text: str) -> int:
    """Read a number of cameras; return 0 for ``auto``."""
    return 0 if text == 'auto' else read_cameras(text)


def number(expected: str, low: float = 5e-324, high: float = math.inf) -> Callable[[str], float]:
    """
    Return a function that reads a number from a text.

    :param expected: description of a valid number, for the error.
    :param low: smallest number; by default the smallest one above 0.
    :param high: largest number.
    """
    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (low <= value <= high and math.isfinite(value)):
            raise argparse.ArgumentTypeError(f'found {text!r}; expected {expected}')
        return value
    return read


read_positive = number('a number above 0', low=1e-6)
read_seconds = number('seconds above 0')
read_delay = number('seconds, 0 or more', low=0.0)
read_distance = number('metres above 0', high=math.nextafter(1000.0, 0.0))
read_share = number('a share above 0, at most 1', high=1.0)
read_price = number('a price above 0')
#: In settings 0 means the unit of the file.
read_scale = number('metres per unit, above 0')


def read_names(text: str) -> tuple[str, ...]:
    """Read names separated by commas."""
    return tuple(text.split(','))


def read_integers(text: str) -> tuple[int, ...]:
    """Read whole numbers separated by commas."""
    try:
        return tuple(int(number) for number in text.split(','))
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f'found {text!r}; expected whole numbers with commas between') from error


def add_units(command: argparse.ArgumentParser, files: str = 'scan') -> None:
    """
    Add the options ``--scale`` and ``--up`` for the units and axes of scans.

    :param files: ``'scan'`` or ``'scans'``, for the help.
    """
    command.add_argument('--scale', type=read_scale,
                         help=f'metres per unit of the {files}; default: as the file says, '
                              'otherwise 1')
    command.add_argument('--up', type=read_direction, metavar='AXIS',
                         help=f'direction of the {files} that points up: x, y, z, -x, -y, -z, or '
                              'auto for a guess; default: as its format says, otherwise z')


def read_direction(text: str) -> str:
    """Read the direction of a scan that points up."""
    # Imported only here, so that a command line is read without importing NumPy.
    from ocp_ros.scenes.source_frame import UP_CHOICES
    if text not in UP_CHOICES:
        raise argparse.ArgumentTypeError(
            f'found {text!r}; expected one of {", ".join(UP_CHOICES)}')
    return text


def join_up_option(argv: Sequence[str]) -> list[str]:
    """Return arguments with ``--up -y`` as ``--up=-y``: argparse reads ``-y`` as an option."""
    joined: list[str] = []
    for argument in argv:
        if joined and joined[-1] == '--up' and argument.startswith('-'):
            argument = f'{joined.pop()}={argument}'
        joined.append(argument)
    return joined


def add_frame(command: argparse.ArgumentParser) -> None:
    """Add the options for the frame of written files and the prefix of camera frames."""
    command.add_argument('--frame', choices=('map', 'source'), help='frame of the written files: '
                         'map (metres, z up) or source (axes and units of the scan); default: '
                         'source for pages for installers, map for files for programs')
    command.add_argument('--frame-prefix', type=read_frame_prefix, default='', metavar='NAME',
                         help='prefix of the camera frames in files for ROS 2, such as rig_a_, so '
                         'that two rigs have different frames')


def add_export(command: argparse.ArgumentParser, default: str = 'default') -> None:
    """Add the option ``--export``, the formats of the written files."""
    command.add_argument('--export', type=read_names, default=(default,), metavar='FORMATS',
                         help='formats of the written files, with commas between, such as '
                         f'default,colmap,usd: docs/reference/formats.md; default: {default}')


def read_frame_prefix(text: str) -> str:
    """Read the prefix of the names of camera frames."""
    if not re.fullmatch(r'([A-Za-z_][A-Za-z0-9_/]*)?', text):
        raise argparse.ArgumentTypeError(
            f'found {text!r}; expected letters, digits, _ and /, a letter first, such as rig_a_')
    return text


def add_room(command: argparse.ArgumentParser) -> None:
    """Add the argument ``room``."""
    command.add_argument('room', metavar='ROOM', help='a scan, or the seed of a generated room')


def add_placement(command: argparse.ArgumentParser, **options: Any) -> None:
    """
    Add the argument ``placement`` and the option ``--rig``.

    :param options: other options of the argument, as of ``add_argument``.
    """
    command.add_argument('placement', type=Path, metavar='PLACEMENT',
                         help='placement file, YAML or JSON: docs/reference/placement.md',
                         **options)
    command.add_argument('--rig', type=find_config, help='rig file, used instead of the one in '
                         'the placement: docs/reference/rig.md')


def add_overwrite(command: argparse.ArgumentParser) -> None:
    """Add the option ``--overwrite``, which allows replacing existing files."""
    command.add_argument('--overwrite', action='store_true', help='replace existing files also '
                         'outside ./out; inputs are never replaced')


def add_reading(command: argparse.ArgumentParser, points: bool = True) -> None:
    """
    Add the options for reading a scan: units, axes, and the points to leave out.

    :param points: whether to add ``--points``, the largest number of points of a room.
    """
    add_units(command)
    if points:
        command.add_argument('--points', type=read_room_points, metavar='N',
                             help='number of points of a generated room; a larger scan is thinned '
                             'to this number; default: 60000; with a placement: its number')
    command.add_argument('--drop-nonfinite', action='store_true', help='leave out points with NaN '
                         'or inf, which organised clouds contain')
    command.add_argument('--all-rooms', action='store_true', help='keep what the scan shows of '
                         'other rooms through openings')
    command.add_argument('--height', type=float, metavar='METRES', help='height of the walls of '
                         'an occupancy map or a DXF floor plan')
    command.add_argument('--layers', help='layers of walls of a DXF floor plan, with commas; '
                         'default: those named like walls')
    command.add_argument('--storey', help='storey of an IFC model; default: all')
    command.add_argument('--space', help='space of an IFC model; default: all')
    command.add_argument('--open-doors', action='store_true', help='leave out the doors of an IFC '
                         'model')


def room_asked(arguments: argparse.Namespace, recorded: dict[str, Any]
               ) -> 'tuple[Scene, dict[str, Any]]':
    """
    Read the room that a command line names.

    :param arguments: with ``room``, the options for reading a scan, and perhaps ``points``.
    :param recorded: options with which the room was read before, from a placement file; options
        of the command line replace them.
    :returns: the room, and its record for placement files.
    """
    from ocp_ros.rooms.scene_source import READING, room_named
    # Options that are not given are None, or False for flags.
    options = {key: value for key in READING
               if (value := getattr(arguments, key)) is not None and value is not False}
    if options and arguments.room.isdecimal():
        raise ConfigurationError(
            f'--{next(iter(options)).replace("_", "-")}: found it with the generated room '
            f'{arguments.room}; expected a scan, since generated rooms are in metres, z up; leave '
            'it out')
    # The options in READING are of scans, not of generated rooms.
    keys = ('points',) if arguments.room.isdecimal() else ('points', *READING)
    recorded = {key: recorded[key] for key in keys if key in recorded}
    if (points := getattr(arguments, 'points', None)) is not None:
        recorded['points'] = points
    return room_named(arguments.room, **{**recorded, **options})


def room_and_placement(arguments: argparse.Namespace
                       ) -> 'tuple[Scene, Placement, dict[str, Any]]':
    """
    Read the room and the placement that a command line names.

    :param arguments: with ``room``, ``placement``, ``rig`` and the options for reading the room.
    :returns: the room, the placement, and the record of the room for placement files.
    """
    from ocp_ros.rig.placement_file import load_placement
    from ocp_ros.rig.rig_file import load_rig
    rig = load_rig(arguments.rig) if arguments.rig else None
    placement = load_placement(arguments.placement, rig)
    scene, room = room_asked(arguments, placement.room)
    return scene, placement, room
