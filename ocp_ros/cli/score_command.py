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

"""``ocp score``: evaluate a placement of a rig in a room, and suggest improvements."""

import argparse
from pathlib import Path

from ocp_ros.cli.arguments import add_frame, add_overwrite, add_points, add_reading
from ocp_ros.cli.common import claim_folder, command_of, Commands, Found, JUDGE
from ocp_ros.util.resources import find_config


def add_arguments(commands: Commands) -> None:
    """Add ``ocp score``."""
    judged = commands.add(JUDGE, 'score', 'evaluate a placement of cameras in a room',
                          'ocp score room.ply placement.yaml --rig rig.yaml --out out/hang-up')
    judged.add_argument('room', metavar='ROOM', help='a scan, or the seed of a generated room')
    judged.add_argument('placement', type=Path, metavar='PLACEMENT',
                        help='placement file, YAML or JSON: docs/reference/placement.md')
    judged.add_argument('--rig', type=find_config,
                        help='rig file, used instead of the one in the placement: '
                        'docs/reference/rig.md')
    judged.add_argument('--out', type=Path, metavar='DIR',
                        help='folder for report, placement, CSV, launch file, xacro and more')
    add_frame(judged)
    add_overwrite(judged)
    add_points(judged)
    add_reading(judged)
    judged.set_defaults(run=run, show=show)


def run(arguments: argparse.Namespace) -> Found:
    """Evaluate a placement, and write its files if ``--out`` is given."""
    from ocp_ros.cli.placement_files import room_and_placement, written_to
    from ocp_ros.planning.assessment import judge
    from ocp_ros.report.exports import MARK, WRITTEN
    from ocp_ros.util.files import FileSet, folder_to_write
    if arguments.out:
        claim_folder(arguments, arguments.out, WRITTEN, MARK)
    scene, placement, room = room_and_placement(arguments)
    folder = arguments.out and folder_to_write(arguments.out)
    judged = judge(scene, placement, room, command_of(arguments.argv), arguments.frame)
    if folder is None:
        return dict(judged.found)
    with FileSet(folder, WRITTEN, MARK) as files:
        return {**judged.found,
                **written_to(files, judged, lambda _: (), arguments.frame_prefix)}


def show(found: Found) -> None:
    """Print the scores and the names of the written files."""
    from ocp_ros.cli.placement_files import show_written
    from ocp_ros.report.verdict_tables import show_verdict, WIDTH
    from rich.console import Console
    show_verdict(Console(width=WIDTH), found)
    show_written(found)
