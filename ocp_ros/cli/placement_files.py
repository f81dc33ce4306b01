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

"""Rooms and placements that command lines name, and all files that are written of a placement."""

import argparse
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

from ocp_ros.planning.assessment import Assessment
from ocp_ros.report.exports import export, FORMS
from ocp_ros.rig.placement_file import load_placement, Placement
from ocp_ros.rig.rig_file import load_rig
from ocp_ros.rooms.scene_source import room_named
from ocp_ros.scenes.scene import Scene
from ocp_ros.util.files import FileSet
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.shown_text import printable
from ocp_ros.util.yaml_files import written

#: All that is written of a placement, the part of it that counting cameras adds, and the part
#: that is always there.
CURVE = 'curve.png'
WRITTEN = (*FORMS, 'report.png', 'report_2.png', 'report.html', CURVE)
MARK = 'placement.json'
#: How a scan is read, as command lines and placement files say it.
READING = ('scale', 'up', 'drop_nonfinite')


def written_to(files: FileSet, judged: Assessment, more: Callable[[Path], Iterable[Path]],
               prefix: str = '') -> dict[str, Any]:
    """
    Write a placement in all forms, and the reports.

    :param files: where to.
    :param more: writes other files to a folder, and yields each.
    :param prefix: of the names of frames.
    :returns: ``written``; where not all could be, for want of space say, ``error`` as well.
    """
    paths: list[str] = []
    try:
        for path in chain(export(files.aside, judged, prefix), reports(files.aside, judged),
                          more(files.aside)):
            paths.append(str(files.folder / path.name))
    except OSError as error:
        return {'written': paths, 'error': (
            f'--out: found {files.folder}, where not all could be written '
            f'({error.strerror or error}); expected room for it; use what is printed, or make '
            'room and do it again')}
    return {'written': paths}


def reports(folder: Path, judged: Assessment) -> Iterator[Path]:
    """
    Write the one-page report and the page that can be turned around, and yield each.

    :param folder: it is made where it is not there.
    """
    # What draws is slow to import, and most placements are judged without.
    from ocp_ros.report.drawing import sheet
    from ocp_ros.report.viewer import write_view
    yield from sheet.draw(folder, judged)
    write_view(folder / 'report.html', judged.scene, judged)
    yield folder / 'report.html'


def room_and_placement(arguments: argparse.Namespace
                       ) -> tuple[Scene, Placement, dict[str, Any]]:
    """
    Read what a command line names.

    :param arguments: with ``room``, ``placement``, ``rig``, ``scale`` and ``up``.
    :returns: the room, the placement, and which room it is.
    """
    rig = load_rig(arguments.rig) if arguments.rig else None
    placement = load_placement(arguments.placement, rig)
    scene, room = room_asked(arguments, placement.room)
    return scene, placement, room


def room_asked(arguments: argparse.Namespace, known: dict[str, Any]
               ) -> tuple[Scene, dict[str, Any]]:
    """
    Read the room of a command line.

    :param arguments: with ``room``, how it is read, and perhaps ``points``.
    :param known: how it was read before, as placement files have it; what the command line says
        comes first.
    """
    given = {key: value for key in READING
             if (value := getattr(arguments, key)) is not None and value is not False}
    if given and arguments.room.isdecimal():
        raise ConfigurationError(
            f'--{next(iter(given)).replace("_", "-")}: found it with the generated room '
            f'{arguments.room}; expected a scan, since generated rooms are in metres, z up; leave '
            'it out')
    known = {key: known[key] for key in ('points', *READING) if key in known}
    if (points := getattr(arguments, 'points', None)) is not None:
        known['points'] = points
    if arguments.room.isdecimal():
        known = {key: value for key, value in known.items() if key == 'points'}
    return room_named(arguments.room, **{**known, **given})


def show_written(found: dict[str, Any]) -> None:
    """Print which files were written, and the placement itself where not all could be."""
    for path in found.get('written', ()):
        print(f'wrote {printable(path)}')
    if 'error' in found:
        print(written({'cameras': found['cameras']}, '.yaml'), end='')
