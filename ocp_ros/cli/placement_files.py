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

"""Read the room and placement of a command line, and write all files of a placement."""

import argparse
from collections.abc import Callable, Iterable
from itertools import chain
from pathlib import Path
from typing import Any

from ocp_ros.cli.arguments import room_asked
from ocp_ros.planning.assessment import Assessment
from ocp_ros.report.exports import export, reports
from ocp_ros.rig.placement_file import load_placement, Placement
from ocp_ros.rig.rig_file import load_rig
from ocp_ros.scenes.scene import Scene
from ocp_ros.util.files import FileSet
from ocp_ros.util.terminal_text import printable
from ocp_ros.util.yaml_files import written


def written_to(files: FileSet, judged: Assessment, more: Callable[[Path], Iterable[Path]],
               prefix: str = '', brief: bool = False) -> dict[str, Any]:
    """
    Write a placement in all file formats, and the reports.

    :param files: the files to write.
    :param more: writes other files to a folder, and yields each.
    :param prefix: of the names of frames.
    :param brief: whether to leave out the reports and other files, which take seconds to draw.
    :returns: ``written``; also ``error`` if some files could not be written.
    """
    paths: list[str] = []
    try:
        for path in chain(export(files.aside, judged, prefix), *(
                () if brief else (reports(files.aside, judged), more(files.aside)))):
            paths.append(str(files.folder / path.name))
    except OSError as error:
        return {'written': paths, 'error': (
            f'--out: found {files.folder}, where not all could be written '
            f'({error.strerror or error}); expected room for it; use what is printed, or make '
            'room and do it again')}
    return {'written': paths}


def room_and_placement(arguments: argparse.Namespace
                       ) -> tuple[Scene, Placement, dict[str, Any]]:
    """
    Read the room and the placement that a command line names.

    :param arguments: with ``room``, ``placement``, ``rig``, ``scale`` and ``up``.
    :returns: the room, the placement, and the record of the room for placement files.
    """
    rig = load_rig(arguments.rig) if arguments.rig else None
    placement = load_placement(arguments.placement, rig)
    scene, room = room_asked(arguments, placement.room)
    return scene, placement, room


def show_written(found: dict[str, Any]) -> None:
    """Print the names of the written files, and the placement itself if some are missing."""
    for path in found.get('written', ()):
        print(f'wrote {printable(path)}')
    if 'error' in found:
        print(written({'cameras': found['cameras']}, '.yaml'), end='')
