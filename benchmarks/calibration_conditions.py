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

"""
Measure under which conditions ``ocp calibrate`` finds cameras, and false alarms of movements.

    python -m benchmarks.calibration_conditions --record

One condition is changed at a time. With a scan from tripods: the first guess, the frames, the
people and how far away the camera's surfaces are; and of a camera that sees one bare wall, whether
a box was set down where another one sees it too. Without a scan, of two cameras: the share of
points that both see, and the angle between their directions. ``--record`` also writes
docs/reference/calibration_conditions.md.
"""

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import combinations
import json
import sys
from textwrap import fill
import time
from typing import Any, NamedTuple

from benchmarks import results
from benchmarks.calibration_bench import (
    add_lines,
    BOTH,
    CAMERAS,
    cast,
    generated,
    likely_in,
    lines_of,
    MUTUAL,
    off,
    POINTS,
    ROOMS,
    row_of,
    shared_by,
    START,
)
import numpy as np
from ocp_ros.geometry.cameras import heading_of, Pose
from ocp_ros.registration.calibration import calibrate
from ocp_ros.registration.carried import set_down
from ocp_ros.registration.joint_alignment import relative_pose
from ocp_ros.registration.live_view import LiveView
from ocp_ros.registration.movement import movement_since
from ocp_ros.registration.mutual_registration import register_mutually
from ocp_ros.registration.scan_surfaces import ScanSurfaces
from ocp_ros.registration.steady_cloud import steady_cloud
from ocp_ros.rig.placement_file import placement_of
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.rooms.furniture import Solid
from ocp_ros.rooms.generator import mesh_of
from ocp_ros.rooms.generator import scan as scan_of
from ocp_ros.rooms.room_plan import RoomPlan
from ocp_ros.scenes.meshes import MeshRays
from ocp_ros.scenes.scene import Scene
from ocp_ros.util.files import write_atomically

PAGE = results.ROOT / 'docs' / 'reference' / 'calibration_conditions.md'
#: Frames and people, unless they are what is changed.
FRAMES, PEOPLE = 20, 1
#: Metres and degrees of first guesses, frames, people: what is changed with a scan.
GUESSES = ((0.1, 3.0), START, (1.0, 30.0))
SEEN = ((1, PEOPLE), (5, PEOPLE), (FRAMES, 0), (FRAMES, PEOPLE), (FRAMES, 3))
#: Metres that part cameras by the median distance of what they see.
FAR = (2.0, 3.0)
#: Shares of common points, degrees between two cameras, and how far a pair is from either.
OVERLAPS, ANGLES, WITHIN = (0.1, 0.2, 0.4), (30.0, 60.0, 90.0), (0.04, 12.0)
#: The common points of pairs at the angles.
COMMON = 0.25, 0.6
#: Poses of which pairs are chosen, pairs of a room for each value.
LIKELY, PAIRS = 24, 3
#: A hall with bare walls, and a box, metres; at how many places it is set down; frames at each,
#: and before; and how often.
HALL, BOX, PLACES, STANDS, EMPTY, DRAWS = (14.0, 4.0, 2.6), (0.4, 0.5, 0.4), 8, 2, 4, 3
#: Frames of a check for movements, as many as policy_node keeps.
CHECKED = 10


class Table(NamedTuple):
    """
    A table of the page.

    :ivar title: its heading.
    :ivar column: the quantity that is changed.
    :ivar values: its values, in the form of the page.
    """

    title: str
    column: str
    values: tuple[str, ...]


TABLES = {
    'guess': Table('First guess, with a scan', 'error of the first guess',
                   tuple(f'{metres:g} m, {degrees:g}°' for metres, degrees in GUESSES)),
    'frames': Table('Number of clouds, with a scan', 'clouds of a camera',
                    ('1', '5', str(FRAMES))),
    'people': Table('People who walk about, with a scan', 'people in a cloud', ('0', '1', '3')),
    'distance': Table(
        'Distance of what a camera sees, with a scan', 'median distance of its points',
        (f'up to {FAR[0]:g} m', f'{FAR[0]:g} to {FAR[1]:g} m', f'from {FAR[1]:g} m')),
    'overlap': Table('Common points of two cameras, without a scan', 'points in common',
                     tuple(f'{100.0 * share:.0f} %' for share in OVERLAPS)),
    'box': Table('A camera that sees one bare wall, with a scan', 'remedy', ('none', '`--box`')),
    'angle': Table('Angle between two cameras, without a scan', 'angle',
                   tuple(f'{angle:g}°' for angle in ANGLES))}


def with_scan(seed: int, sensor: str) -> Iterator[dict]:
    """Yield what becomes of the cameras of a room that has a scan, under each condition."""
    room, = generated(seed, 'tripod')
    scan, rng = ScanSurfaces(room.scene), errors_of(seed, sensor)
    devices = rng.integers(1 << 31, size=len(room.hangs)).tolist()
    for frames, people in SEEN:
        clouds = [steady_cloud(room.see(pose, sensor, frames, people, rng, device))
                  for device, pose in zip(devices, room.hangs)]
        # The conditions that this is a value of.
        usual = (frames, people) == (FRAMES, PEOPLE)
        conditions = [('frames', str(frames))] * (people == PEOPLE) + [
            ('people', str(people))] * (frames == FRAMES)
        for guess, guessed in zip(GUESSES, TABLES['guess'].values):
            if guess != START and not usual:
                continue
            starts = [off(pose, *guess, rng) for pose in room.hangs]
            placement = placement_of(rig_of(len(starts), sensor), np.array(
                [[*start.position, *heading_of(start.rotation)] for start in starts]))
            names = [placed.camera.name for placed in placement.cameras]
            begin = time.process_time()
            found, _ = calibrate(scan, placement, dict(zip(names, clouds)))
            seconds = (time.process_time() - begin) / len(names)
            distances = TABLES['distance'].values
            for name, pose, cloud in zip(names, room.hangs, clouds):
                far = float(np.median(np.linalg.norm(cloud, axis=1)))
                yield from (row_for(*condition, sensor, seconds, row_of(found[name], pose)
                                    if name in found else {'refused': 'no surfaces'})
                            for condition in [
                                *[('guess', guessed)] * usual, *conditions * (guess == START),
                                *[('distance', distances[int(np.searchsorted(FAR, far))])] * (
                                    usual and guess == START)])


def hall(*solids: Solid) -> RoomPlan:
    """Return a hall with bare walls and some solids."""
    return RoomPlan('hallway', np.array(HALL), np.random.default_rng(0), [*solids])


def hung_in_hall(rng: np.random.Generator) -> list[Pose]:
    """Hang two cameras in the hall: one sees an end of it, the other the floor and one wall."""
    return [Pose.of(np.array([
        x + rng.uniform(-0.2, 0.2), 0.3, 2.2, np.deg2rad(rng.uniform(low, low + 6.0)),
        np.deg2rad(25.0), 0.0])) for x, low in ((3.2, 98.0), (5.2, 87.0))]


def with_box(poses: Sequence[Pose], sensor: str, places: int, rng: np.random.Generator
             ) -> list[list[np.ndarray]]:
    """Return frames of each camera in the hall, of the same moments, as a box is set down."""
    devices = rng.integers(1 << 31, size=len(poses)).tolist()
    solids = [Solid('clutter', np.array([*rng.uniform((3.6, 2.0), (4.8, 3.4)), 0.5 * BOX[2]]),
                    np.array(BOX), rng.uniform(0.0, 6.0)) for _ in range(places)]
    # A person walks through the empty hall, and steps out of view when the box stands.
    steps = [(hall(), EMPTY, PEOPLE), *((hall(solid), STANDS, 0) for solid in solids)]
    return [[frame for plan, frames, people in steps for frame in cast(
        MeshRays(mesh_of(plan)), pose, sensor, frames, people, rng, device)]
            for pose, device in zip(poses, devices)]


def along_wall(seed: int, sensor: str) -> Iterator[dict]:
    """Yield what becomes of a camera that sees one bare wall, with and without a box."""
    rng = errors_of(seed, sensor)
    scan = ScanSurfaces(Scene(scan_of(hall(), POINTS, rng)[0]))
    for _ in range(DRAWS):
        poses = hung_in_hall(rng)
        frames = with_box(poses, sensor, PLACES, rng)
        placement = placement_of(rig_of(2, sensor), np.array(
            [[*start.position, *heading_of(start.rotation)]
             for start in (off(pose, *START, rng) for pose in poses)]))
        names = [placed.camera.name for placed in placement.cameras]
        clouds = {name: steady_cloud(one) for name, one in zip(names, frames)}
        seen = {name: set_down(one, clouds[name]) for name, one in zip(names, frames)}
        for value, given in zip(TABLES['box'].values, (None, seen)):
            begin = time.process_time()
            found, _ = calibrate(scan, placement, clouds, seen=given)
            yield row_for('box', value, sensor, (time.process_time() - begin) / 2.0,
                          row_of(found[names[1]], poses[1]))


def errors_of(seed: int, sensor: str) -> np.random.Generator:
    """Return a generator of errors of a sensor in a room."""
    return np.random.default_rng([seed, BOTH.index(sensor)])


def without_scan(seed: int, sensor: str) -> Iterator[dict]:
    """Yield what becomes of the second camera of pairs without a scan, under each condition."""
    see, likely = likely_in(seed, 7, LIKELY)
    model, rng = SENSORS[sensor].model, errors_of(seed, sensor)
    views = [LiveView(see(pose, sensor)[0], model) for pose in likely]
    pairs = [(a, b, min(shared_by(views[a], likely[a], views[b], likely[b]),
                        shared_by(views[b], likely[b], views[a], likely[a])),
              float(np.rad2deg(np.arccos(likely[a].rotation[:, 0] @ likely[b].rotation[:, 0]))))
             for a, b in combinations(range(len(likely)), 2)]
    chosen = [('overlap', value, [pair for pair in pairs if abs(pair[2] - share) < WITHIN[0]])
              for share, value in zip(OVERLAPS, TABLES['overlap'].values)]
    chosen += [('angle', value, [pair for pair in pairs if abs(pair[3] - angle) < WITHIN[1]
                                 and COMMON[0] < pair[2] < COMMON[1]])
               for angle, value in zip(ANGLES, TABLES['angle'].values)]
    for table, value, fitting in chosen:
        for number in rng.permutation(len(fitting))[:PAIRS]:
            a, b, *_ = fitting[number]
            pair = {str(k): LiveView(steady_cloud(see(likely[k], sensor, FRAMES, PEOPLE, rng)),
                                     model) for k in (a, b)}
            begin = time.process_time()
            found, reasons = register_mutually(pair)
            seconds = (time.process_time() - begin) / 2.0
            row: dict[str, Any] = {'refused': ' '.join([
                *reasons.values(), *(one.refused for one in found.values())]).strip()}
            if len(found) == 2:
                away, turn = relative_pose(found[str(b)].pose, found[str(a)].pose).away_from(
                    relative_pose(likely[b], likely[a]))
                row |= {'metres': away, 'right': bool(
                    away <= MUTUAL[0] and turn <= np.deg2rad(MUTUAL[1]))}
            yield row_for(table, value, sensor, seconds, row)


def row_for(table: str, value: str, sensor: str, seconds: float, found: Mapping[str, Any]) -> dict:
    """Return a line about one camera under one condition."""
    return {'table': table, 'value': value, 'sensor': sensor, 'seconds': seconds,
            'refused': bool(found['refused']), 'right': found.get('right', False),
            'metres': found.get('metres')}


def still(seed: int, sensor: str, draws: int) -> Iterator[dict]:
    """
    Yield for each camera of a room how often it is said to have moved, though it has not.

    :param draws: how many checks of each camera, with new noise and other people.
    """
    see, hangs = likely_in(seed, 5, CAMERAS)
    rng = errors_of(seed, sensor)
    for pose, device in zip(hangs, rng.integers(1 << 31, size=CAMERAS).tolist()):
        def view(pose=pose, device=device) -> LiveView:
            return LiveView(steady_cloud(see(pose, sensor, CHECKED, PEOPLE, rng, device)),
                            SENSORS[sensor].model)

        reference = view()
        yield {'table': 'still', 'checks': draws, 'alarms': sum(
            bool(movement_since(reference, view()).has_moved) for _ in range(draws))}


def figures_of(rows: Sequence[dict]) -> dict[str, dict]:
    """Return shares in per cent, millimetres and seconds, by table, sensor and value."""
    rows = [row for row in rows if row['table'] in TABLES]
    found: dict[str, dict] = {}
    for table, sensor, value in dict.fromkeys(
            (row['table'], row['sensor'], row['value']) for row in rows):
        part = [row for row in rows
                if (row['table'], row['sensor'], row['value']) == (table, sensor, value)]
        given = [row for row in part if not row['refused']]
        right = sum(row['right'] for row in given)
        found.setdefault(table, {}).setdefault(sensor, {})[value] = {
            'cameras': len(part), 'right': round(100.0 * right / len(part), 1),
            'refused': round(100.0 * (1.0 - len(given) / len(part)), 1),
            'wrong': round(100.0 * (len(given) - right) / len(part), 1),
            'median_mm': round(1000.0 * float(np.median([row['metres'] for row in given])), 1)
            if given else None,
            'seconds': round(float(np.mean([row['seconds'] for row in part])), 2)}
    return found


def page_of(document: Mapping[str, Any]) -> str:
    """Return the page as Markdown, given what ``--record`` has written."""
    checks = document['still']
    intro = (
        'Cameras near the walls of generated rooms. One condition is changed at a time; the '
        f'others are a first guess that is wrong by {START[0]:g} m and {START[1]:g} degrees, '
        f'{FRAMES} clouds and {PEOPLE} person who walks about. Cameras without a scan have no '
        'first guess. With a scan, *right* is a pose within 1 cm and 0.5 degrees, without one '
        f'within {100.0 * MUTUAL[0]:g} cm and {MUTUAL[1]:g} degrees of that relative to the other '
        'camera; *wrong* is an accepted pose with a larger error. The error is the median of the '
        'accepted poses. Seconds are those of one core for each camera. '
        '[Calibrate](../tasks/calibrate.md) and '
        '[Register cameras to each other](../tasks/calibrate_without_scan.md) say how.')
    lines = ['# Conditions of a calibration', '',
             f'`{document["command"]}`, {document["date"]}, {document["commit"]}:',
             '[calibration_conditions.json](../results/calibration_conditions.json)', '',
             fill(intro, 120, break_long_words=False, break_on_hyphens=False), '']
    for name, table in TABLES.items():
        lines += [f'## {table.title}', '',
                  f'| sensor | {table.column} | cameras | right, % | rejected, % | wrong, % | '
                  'error, mm | seconds |', '|---|---|---|---|---|---|---|---|']
        for sensor in BOTH:
            for value in table.values:
                if row := document['conditions'].get(name, {}).get(sensor, {}).get(value):
                    error = '-' if row['median_mm'] is None else row['median_mm']
                    lines.append(
                        f'| `{sensor}` | {value} | {row["cameras"]} | {row["right"]} | '
                        f'{row["refused"]} | {row["wrong"]} | {error} | {row["seconds"]} |')
        lines.append('')
    return '\n'.join([
        *lines, '## False alarms of `--against`', '',
        f'Of {checks["checks"]} checks of {checks["cameras"]} cameras that did not move, each '
        f'with {CHECKED} new clouds and other people, {checks["alarms"]} found a movement.', ''])


def _rows_of(job: str, part: Callable[..., Iterator[dict]], *settings: int | str) -> list[dict]:
    """Measure a part; each row names its job."""
    return [{'job': job, **row} for row in part(*settings)]


def main(argv: list[str] | None = None) -> int:
    """Measure, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--set', choices=sorted(ROOMS), default='test', help='generated rooms')
    parser.add_argument('--rooms', type=int, default=2, help='how many of them')
    parser.add_argument('--first', type=int, default=10, help='number of the first of them')
    parser.add_argument('--draws', type=int, default=63, help='checks of a camera that is still')
    add_lines(parser, 'calibration_conditions.jsonl', 'a line for each camera under a condition')
    results.add_record(parser, 'calibration_conditions')
    arguments = parser.parse_args(argv)
    rows = lines_of(arguments, {
        f'{part.__name__} {seed} {sensor}': (_rows_of, part, seed, sensor, *more)
        for seed in ROOMS[arguments.set][arguments.first:][:arguments.rooms] for sensor in BOTH
        for part, more in ((with_scan, ()), (along_wall, ()), (without_scan, ()),
                           (still, (arguments.draws,)))})
    checks = [row for row in rows if row['table'] == 'still']
    figures = {'conditions': figures_of(rows), 'still': {
        'cameras': len(checks), **{key: sum(row[key] for row in checks)
                                   for key in ('checks', 'alarms')}}}
    print(json.dumps(figures, indent=1))
    if arguments.record:
        results.write('calibration_conditions', figures,
                      results.command_of('calibration_conditions', argv))
        document = json.loads((results.FOLDER / 'calibration_conditions.json').read_bytes())
        write_atomically(PAGE, page_of(document))
    return 0


if __name__ == '__main__':
    sys.exit(main())
