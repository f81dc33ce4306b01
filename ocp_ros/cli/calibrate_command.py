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

"""``ocp calibrate``: find the true poses of cameras from their clouds and a scan of the room."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ocp_ros.cli.arguments import (
    add_overwrite,
    add_placement,
    add_reading,
    add_room,
    frame_prefix,
    room_asked,
)
from ocp_ros.cli.common import (
    claim_folder,
    command_of,
    Commands,
    document,
    Found,
    JUDGE,
    show_written,
)
from ocp_ros.util.settings import check_known, ConfigurationError

if TYPE_CHECKING:
    import numpy as np

#: Names of the files that are written.
WRITTEN = ('placement.yaml', 'cameras.launch.py', 'calibration.json')
#: Number of points of a generated room; all points of a scan are used.
POINTS = 120_000


def add_arguments(commands: Commands) -> None:
    """Add ``ocp calibrate``."""
    command = commands.add(
        JUDGE, 'calibrate', 'find where cameras hang by what they see',
        'ocp calibrate room.ply placement.yaml --clouds door.ply window.ply --out out/built')
    add_room(command)
    add_placement(command)
    seen = command.add_mutually_exclusive_group(required=True)
    seen.add_argument('--clouds', nargs='+', metavar='[CAMERA=]FILE',
                      help='one cloud of each camera, in metres; without CAMERA=, the name of the '
                      'file is the name of the camera')
    seen.add_argument('--bag', type=Path, help='a ROS bag with a topic of clouds for each camera')
    command.add_argument('--topics', nargs='+', default=(), metavar='CAMERA=TOPIC',
                         help='topics of the bag; default: the topics whose names contain the '
                         'names of the cameras, otherwise all topics in their order')
    command.add_argument('--cloud-frame', choices=('optical', 'body'),
                         help='frame of the clouds: optical (z forward, x right, y down) or body '
                         '(x forward, y left, z up); default: optical for files, and the frame '
                         'that a bag names')
    command.add_argument('--out', type=Path, default=Path('out/built'), metavar='DIR',
                         help='write the placement as built, a launch file of static transforms '
                         'and the figures here')
    command.add_argument('--frame-prefix', type=frame_prefix, default='', metavar='NAME',
                         help='before the names of frames in the launch file')
    add_overwrite(command)
    add_reading(command)
    command.set_defaults(run=run, show=show)


def run(arguments: argparse.Namespace) -> Found:
    """Register each camera that has a cloud, and write its pose."""
    from ocp_ros.registration.calibration import answer_of, as_built, calibrate
    from ocp_ros.registration.scan_surfaces import ScanSurfaces
    from ocp_ros.report.exports import launch_of
    from ocp_ros.rig.placement_file import load_placement, save_placement
    from ocp_ros.rig.rig_file import load_rig
    from ocp_ros.util.files import FileSet, folder_to_write, write_atomically
    read = [arguments.bag] if arguments.bag else [
        text.partition('=')[2] or text for text in arguments.clouds]
    claim_folder(arguments, arguments.out, WRITTEN, WRITTEN[-1], read)
    rig = load_rig(arguments.rig) if arguments.rig else None
    placement = load_placement(arguments.placement, rig)
    clouds = clouds_of(arguments, [placed.camera.name for placed in placement.cameras])
    folder_to_write(arguments.out)
    points = POINTS if arguments.room.isdecimal() else 0
    scene, _ = room_asked(arguments, {**placement.room, 'points': points})
    found, broken = calibrate(ScanSurfaces(scene), placement, clouds)
    built = as_built(placement, found, command_of(arguments.argv))
    rows = [answer_of(placed, found[placed.camera.name]) if placed.camera.name in found else {
        'camera': placed.camera.name, 'refused': broken.get(placed.camera.name, 'it has no cloud')}
        for placed in placement.cameras]
    answer: Found = {'cameras': rows,
                     'written': [str(arguments.out / name) for name in WRITTEN]}
    with FileSet(arguments.out, WRITTEN, WRITTEN[-1]) as files:
        save_placement(files.aside / WRITTEN[0], built)
        refused = [row['camera'] for row in rows if row['refused']]
        launch = launch_of(built, (), arguments.frame_prefix, refused)
        write_atomically(files.aside / WRITTEN[1], launch)
        write_atomically(files.aside / WRITTEN[2], document(answer) + '\n')
    if all(row['refused'] for row in rows):
        answer['error'] = (
            f'{arguments.placement}: found no camera that could be calibrated ('
            + '; '.join(f'{row["camera"]}: {row["refused"]}' for row in rows)
            + '); expected one at least; scan more of the room, or correct the placement')
    return answer


def show(found: Found) -> None:
    """Print the result of each camera."""
    from ocp_ros.report.terminal import print_table, WIDTH
    from rich.console import Console
    console = Console(width=WIDTH)
    rows = [(row['camera'], ', '.join(f'{value:.3f}' for value in row['position']),
             ', '.join(f'{row[angle]:.1f}' for angle in ('yaw', 'pitch', 'roll')),
             f'{row["moved_metres"]:.3f} m, {row["moved_degrees"]:.1f}°',
             f'{1000.0 * row["deviations"][0]["metres"]:.1f} mm, '
             f'{row["deviations"][3]["degrees"]:.2f}°',
             f'{1000.0 * row["residual"]:.1f} mm', f'{100.0 * row["overlap"]:.0f} %')
            for row in found['cameras'] if not row['refused']]
    if rows:
        print_table(console, 'As built', (
            'camera', 'position (m)', 'yaw, pitch, roll', 'moved', 'standard deviation',
            'residual', 'overlap'), rows)
    for row in found['cameras']:
        if row.get('otherwise'):
            console.print(f'note: {row["camera"]}: {row["otherwise"]}; correct the placement or '
                          'the option', style='yellow', markup=False, highlight=False)
        if row['refused']:
            console.print(f'refused: {row["camera"]}: {row["refused"]}', style='yellow',
                          markup=False, highlight=False)
    show_written({'written': found['written']})


def clouds_of(arguments: argparse.Namespace, names: Sequence[str]) -> 'dict[str, np.ndarray]':
    """
    Read the clouds of cameras.

    :param arguments: with ``clouds`` or ``bag`` and ``topics``, and ``cloud_frame``.
    :param names: of the cameras.
    :returns: (N, 3) metres, body frame, by camera.
    :raises ConfigurationError: if the camera of a cloud is not clear, or there is no cloud.
    """
    from ocp_ros.geometry.cameras import OPTICAL_TO_BODY
    from ocp_ros.scenes.scene_files import load_cloud
    if arguments.bag:
        try:
            from ocp_ros.ros.bags.recorded_clouds import recorded_clouds
        except ImportError as error:
            raise ConfigurationError(
                f'--bag: found no ROS 2 ({error}); expected rclpy and its messages; run '
                'tools/setup, or save the clouds as files (--clouds)') from error
        chosen = dict(_named(text, '--topics', 'TOPIC') for text in arguments.topics)
        check_known(chosen, names, '--topics')
        return recorded_clouds(arguments.bag, names, chosen, arguments.cloud_frame)
    if arguments.topics:
        raise ConfigurationError('--topics: found it without --bag; expected both; name the bag')
    files: dict[str, Path] = {}
    for text in arguments.clouds:
        name, path = _named(text, '--clouds', 'FILE') if '=' in text else (Path(text).stem, text)
        if name in files:
            raise ConfigurationError(f'--clouds: found two files of {name}; expected one for each '
                                     'camera; leave one out')
        files[name] = Path(path)
    check_known(files, names, '--clouds, cameras')
    clouds = {name: load_cloud(path) for name, path in files.items()}
    return clouds if arguments.cloud_frame == 'body' else {
        name: points @ OPTICAL_TO_BODY.T for name, points in clouds.items()}


def _named(text: str, option: str, what: str) -> tuple[str, str]:
    """Read CAMERA=VALUE; return the name of the camera and the value."""
    name, equals, value = text.partition('=')
    if not (name and equals and value):
        raise ConfigurationError(f'{option}: found {text!r}; expected CAMERA={what}; write, for '
                                 f'example, door={what.lower()}')
    return name, value
