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
from collections.abc import Hashable, Iterable, Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, TYPE_CHECKING

from ocp_ros.cli.arguments import (
    add_export,
    add_overwrite,
    add_placement,
    add_reading,
    read_distance,
    read_frame_prefix,
    read_scale,
    room_asked,
)
from ocp_ros.cli.common import (
    claim_folder,
    command_of,
    Commands,
    EVALUATE,
    Found,
    json_text,
    no_ros,
    show_written,
)
from ocp_ros.util.settings import check_known, ConfigurationError

if TYPE_CHECKING:
    import numpy as np
    from ocp_ros.registration.carried import Seen


#: The file with what all cameras see together, without a scan.
FUSED = 'room.ply'


def add_arguments(commands: Commands) -> None:
    """Add ``ocp calibrate``."""
    command = commands.add(
        EVALUATE, 'calibrate', 'find where cameras hang by what they see',
        'ocp calibrate room.ply placement.yaml --clouds door.ply window.ply --out out/built')
    command.add_argument('room', metavar='ROOM', nargs='?', help='a scan, or the seed of a '
                         'generated room; without ROOM and PLACEMENT, cameras are registered to '
                         'each other')
    add_placement(command, nargs='?')
    command.add_argument('--against', type=Path, metavar='PLACEMENT', help='find out which '
                         'cameras have moved since the run that wrote this placement, and how to '
                         'put them back; without ROOM and PLACEMENT')
    group = command.add_mutually_exclusive_group(required=True)
    group.add_argument('--clouds', nargs='+', metavar='[CAMERA=]FILE',
                       help='a cloud of each camera, or a folder with clouds of it, in metres; '
                       'without CAMERA=, the name of the file or folder is the name of the camera'
                       )
    group.add_argument('--bag', type=Path, help='a ROS bag with a topic of clouds for each camera')
    command.add_argument('--sensor', help='without PLACEMENT: preset of all cameras; default: '
                         'field of view and range as in the clouds')
    command.add_argument('--distance', nargs='+', default=(), metavar='CAMERA:OTHER=METRES',
                         help='measured distances between two cameras, from the middle of one to '
                         'that of the other, to 5 mm')
    command.add_argument('--box', action='store_true', help='a box was set down at some places '
                         'that several cameras see, each for two clouds or more; clouds with the '
                         'same file name, or the same time in a bag, are of the same moment')
    command.add_argument('--near', type=read_distance, metavar='METRES', help='how far cameras '
                         'are from their poses in PLACEMENT at most; default: 1.6')
    command.add_argument('--topics', nargs='+', default=(), metavar='CAMERA=TOPIC',
                         help='topics of the bag; default: the topics whose names contain the '
                         'names of the cameras, otherwise all topics in their order')
    command.add_argument('--cloud-frame', choices=('optical', 'body', 'opengl'),
                         help='frame of the clouds: optical (z forward, x right, y down), body '
                         '(x forward, y left, z up) or opengl (z backward, x right, y up, as of '
                         'the RealSense Viewer); default: optical for files, and the frame '
                         'that a bag names')
    command.add_argument('--cloud-scale', type=read_scale, default=1.0, metavar='METRES',
                         help='metres per unit of the clouds, such as 0.001 for millimetres')
    command.add_argument('--out', type=Path, default=Path('out/built'), metavar='DIR',
                         help='write the placement as built, a launch file of static transforms '
                         'and the figures here')
    command.add_argument('--frame-prefix', type=read_frame_prefix, default='', metavar='NAME',
                         help='before the names of frames in the launch file')
    add_export(command, 'launch')
    add_overwrite(command)
    add_reading(command, points=False)
    command.set_defaults(run=run, show=show)


def run(arguments: argparse.Namespace) -> Found:
    """Register each camera that has a cloud, write the poses and return the results."""
    from ocp_ros.formats.exported import Exported
    from ocp_ros.formats.exports import export, FORMATS, formats_named, WRITTEN
    from ocp_ros.registration import calibration
    from ocp_ros.registration.movement import load_references, REFERENCES, save_references
    from ocp_ros.rig.placement_file import load_placement
    from ocp_ros.rig.rig_file import load_rig
    from ocp_ros.scenes.scene import Scene
    from ocp_ros.scenes.scene_files import save_scene
    from ocp_ros.util.files import file_set, folder_to_write, write_atomically
    # Check the command line and read the inputs. A text of ``--clouds`` is FILE or CAMERA=FILE.
    _check_mode(arguments)
    inputs = [arguments.bag] if arguments.bag else [
        text.partition('=')[2] or text for text in arguments.clouds]
    formats, figures_name = formats_named(arguments.export, '--export'), 'calibration.json'
    if drawn := [name for name in formats if FORMATS[name].room]:
        raise ConfigurationError(
            f'--export: found {drawn[0]}, which is about the whole room; expected other formats; '
            'run ocp score with the placement as built')
    names_of_set = (*WRITTEN, FUSED, REFERENCES, figures_name)
    claim_folder(arguments, arguments.out, names_of_set, figures_name, [
        *inputs, *([arguments.against] if arguments.against else [])])
    rig = load_rig(arguments.rig) if arguments.rig else None
    placement = None
    if path := arguments.placement or arguments.against:
        placement = load_placement(path, rig)
    names = [placed.camera.name for placed in placement.cameras] if placement else None
    clouds, seen = clouds_of(arguments, names)
    folder_to_write(arguments.out)
    command, measured = command_of(arguments.argv), _distances(arguments.distance, clouds)
    if placement is None:
        found = calibration.without_scan(clouds, arguments.sensor or '', command, measured, seen)
    elif arguments.against:
        references, _ = load_references(arguments.against.with_name(REFERENCES))
        found = calibration.since_reference(placement, references, clouds, command)
    else:
        # A generated room has this number of points; 0 stands for all points of a scan.
        points = 120_000 if arguments.room.isdecimal() else 0
        scene, _ = room_asked(arguments, {**placement.room, 'points': points})
        near = {'near': arguments.near} if arguments.near else {}
        found = calibration.by_scan(scene, placement, clouds, command, measured, seen=seen, **near)
    rows = found.rows
    for row in rows:
        # Both ways between these axes are the same.
        if arguments.cloud_frame == 'opengl' and row.get('otherwise') == calibration.OPENGL:
            row['otherwise'] = calibration.OPTICAL
    result: Found = {'cameras': rows, 'written': []}
    # Write the files, without refused cameras except for the placement.
    with file_set(arguments.out, names_of_set, figures_name) as unfinished:
        refused = [row['camera'] for row in rows if row['refused']]
        result |= export(unfinished, Exported(found.placement, arguments.frame_prefix, refused),
                         formats)
        if found.fused is not None:
            save_scene(Scene(found.fused), unfinished / FUSED)
        save_references(unfinished / REFERENCES, found.references,
                        found.placement.pose_by_name)
        result['written'] += [str(arguments.out / name) for name in (
            *([FUSED] if found.fused is not None else []), REFERENCES, figures_name)]
        write_atomically(unfinished / figures_name, json_text(result) + '\n')
    if all(row['refused'] for row in rows):
        result['error'] = (
            f'{arguments.placement or arguments.against}: found no camera that could be '
            'calibrated (' + '; '.join(f'{row["camera"]}: {row["refused"]}' for row in rows)
            + '); expected one at least; correct that')
    return result


def _distances(texts: Sequence[str], names: Iterable[str]) -> dict[tuple[str, str], float]:
    """Read the distances CAMERA:OTHER=METRES between two of some cameras."""
    found = {}
    for text in texts:
        pair, _, value = text.partition('=')
        camera, _, other = pair.partition(':')
        if not (camera and other and value) or camera == other:
            raise ConfigurationError(
                f'--distance: found {text!r}; expected CAMERA:OTHER=METRES, of two cameras; '
                'write, for example, door:window=1.82')
        check_known([camera, other], names, '--distance, cameras')
        try:
            found[camera, other] = read_distance(value)
        except argparse.ArgumentTypeError as error:
            raise ConfigurationError(f'--distance: {error}; write, for example, a:b=1.82'
                                     ) from error
    return found


def _check_mode(arguments: argparse.Namespace) -> None:
    """Raise an error for options of different ways to calibrate."""
    given = [name for name, value in (('ROOM', arguments.room), (
        'PLACEMENT', arguments.placement), ('--against', arguments.against),
        ('--sensor', arguments.sensor)) if value]
    if given not in ([], ['--sensor'], ['--against'], ['ROOM', 'PLACEMENT']):
        raise ConfigurationError(
            f'ocp calibrate: found {" and ".join(given)}; expected ROOM and PLACEMENT to register '
            'cameras to a scan, --against to find out which have moved, or none of these to '
            'register cameras to each other; name what you have')
    for option, value, fits, others in (
            ('--near', arguments.near, arguments.room, 'ROOM and PLACEMENT'),
            ('--distance', arguments.distance, not arguments.against, 'cameras to be registered'),
            ('--box', arguments.box, not arguments.against, 'cameras to be registered')):
        if value and not fits:
            raise ConfigurationError(f'{option}: found it without {others}; expected both; leave '
                                     'it out')


def show(result: Found) -> None:
    """Print the result of each camera, with its largest deviations in metres and in degrees."""
    from ocp_ros.report.terminal import print_table, wide_console
    console = wide_console()
    # The six deviations are three along axes, then three about axes, each three the largest first.
    rows = [(row['camera'], ', '.join(f'{value:.3f}' for value in row['position']),
             ', '.join(f'{row[angle]:.1f}' for angle in ('yaw', 'pitch', 'roll')),
             next((f'{row[since + "_metres"]:.3f} m, {row[since + "_degrees"]:.1f}°'
                   for since in ('from_plan', 'moved') if since + '_metres' in row), ''),
             f'{1000.0 * row["deviations"][0]["metres"]:.1f} mm, '
             f'{row["deviations"][3]["degrees"]:.2f}°' if 'deviations' in row else '',
             f'{100.0 * row["overlap"]:.0f} %')
            for row in result['cameras'] if not row['refused']]
    if rows:
        print_table(console, 'As built', (
            'camera', 'position (m)', 'yaw, pitch, roll', 'difference', 'standard deviation',
            'overlap'), rows)
    for row in result['cameras']:
        if row.get('note'):
            console.print(f'note: {row["camera"]}: {row["note"]}', style='yellow', markup=False,
                          highlight=False)
        if row.get('put_back'):
            console.print(f'moved: {row["camera"]}: to put it back, {row["put_back"]}',
                          style='yellow', markup=False, highlight=False)
        if row.get('otherwise'):
            console.print(f'note: {row["camera"]}: {row["otherwise"]}; correct the placement or '
                          'the option', style='yellow', markup=False, highlight=False)
        if row['refused']:
            console.print(f'refused: {row["camera"]}: {row["refused"]}', style='yellow',
                          markup=False, highlight=False)
    show_written({'written': result['written']})


def clouds_of(arguments: argparse.Namespace, names: Sequence[str] | None
              ) -> 'tuple[dict[str, np.ndarray], Seen]':
    """
    Read the clouds of cameras, and with ``box`` what was set down in their views.

    :param arguments: with ``cloud_frame``, and with ``clouds``, or ``bag`` and ``topics``.
    :param names: names of the cameras; None if the clouds name them.
    :returns: by camera, the N points of its cloud: (N, 3) metres, body frame (x forward, z up);
        and by camera and moment, the points of each thing that was set down.
    :raises ConfigurationError: if the camera of a cloud is not clear, or there is no cloud.
    """
    import numpy as np
    from ocp_ros.registration.carried import moments_of, set_down
    from ocp_ros.registration.movement import still_cloud
    clouds: dict[str, np.ndarray] = {}
    seen: dict[str, dict[Hashable, list[np.ndarray]]] = {}
    times: list[int] = []
    for name, frames in _frames_of(arguments, names):
        frames = {key: arguments.cloud_scale * frame for key, frame in frames.items()}
        clouds[name] = still_cloud(name, frames)
        if arguments.box:
            moments = list(frames)
            if arguments.bag:
                moments = moments_of(moments, times)
                times += moments
            seen[name] = {moments[k]: things for k, things in set_down(
                [*frames.values()], clouds[name]).items()}
    for name, other in combinations(clouds, 2):
        if np.array_equal(clouds[name], clouds[other]):
            raise ConfigurationError(f'--clouds: found the same points for {name} and {other}; '
                                     'expected what each camera sees; name its own file or topic')
    if len(seen) > 1 and all(seen.values()) and not any(
            seen[name].keys() & seen[other].keys() for name, other in combinations(seen, 2)):
        raise ConfigurationError(
            '--box: found no moment at which two cameras have a cloud; expected files of one '
            'moment to have the same name in each folder; rename them')
    if arguments.box and not any(seen.values()):
        raise ConfigurationError(
            '--box: found nothing that was set down for two clouds; expected a box at another '
            'place in some clouds; save at least two clouds of it at each place')
    return clouds, seen


def _frames_of(arguments: argparse.Namespace, names: Sequence[str] | None
               ) -> 'Iterator[tuple[str, dict[Any, np.ndarray]]]':
    """Yield cameras and their frames by file name or time; see :func:`clouds_of`."""
    from ocp_ros.geometry.cameras import TO_BODY
    from ocp_ros.scenes.scene import SceneError
    from ocp_ros.scenes.scene_files import load_cloud
    if arguments.bag:
        if names is None:
            names = [text.partition('=')[0] for text in arguments.topics]
        try:
            from ocp_ros.ros.bags.recorded_clouds import recorded_frames
        except ImportError as error:
            raise no_ros('--bag', error) from error
        topics = dict(_split_pair(text, '--topics', 'TOPIC') for text in arguments.topics)
        check_known(topics, names, '--topics')
        yield from recorded_frames(arguments.bag, names, topics, arguments.cloud_frame)
        return
    if arguments.topics:
        raise ConfigurationError('--topics: found it without --bag; expected both; name the bag')
    files: dict[str, Path] = {}
    for text in arguments.clouds:
        name, path = Path(text).stem, text
        if '=' in text:
            name, path = _split_pair(text, '--clouds', 'FILE')
        if name in files:
            raise ConfigurationError(f'--clouds: found two files of {name}; expected one for each '
                                     'camera; leave one out')
        files[name] = Path(path)
    if names is not None:
        check_known(files, names, '--clouds, cameras')
    rotation = TO_BODY[arguments.cloud_frame or 'optical']
    for name, path in files.items():
        frames = {}
        for one in _frames_in(path):
            try:
                frames[one.name] = load_cloud(one) @ rotation.T
            except SceneError as error:
                raise SceneError(f'{name}: {error} (or leave this cloud out)') from error
        yield name, frames


def _frames_in(path: Path) -> list[Path]:
    """Return up to 30 files of a folder, spread evenly in the order of their names; or a file."""
    from ocp_ros.geometry.clouds import evenly
    from ocp_ros.registration.steady_cloud import MAX_FRAMES
    if not path.is_dir():
        return [path]
    files = sorted(one for one in path.iterdir() if one.is_file() and one.name[0] != '.')
    if not files:
        raise ConfigurationError(f'{path}: found no file in this folder; expected clouds of a '
                                 'camera, one a file; name another folder')
    return [files[k] for k in evenly(len(files), MAX_FRAMES)]


def _split_pair(text: str, option: str, kind: str) -> tuple[str, str]:
    """
    Return the name of the camera and the value of a text CAMERA=VALUE.

    :param option: option that the text belongs to, for errors.
    :param kind: kind of value, as named in the help, for errors.
    """
    name, separator, value = text.partition('=')
    if not (name and separator and value):
        raise ConfigurationError(f'{option}: found {text!r}; expected CAMERA={kind}; write, for '
                                 f'example, door={kind.lower()}')
    return name, value
