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

"""The key figures of an assessment in words, for the sheet and the page."""

from collections import Counter
from collections.abc import Mapping
import re
import shlex
from typing import NamedTuple

from ocp_ros.report.assessment import Assessment
from ocp_ros.report.rig_planning import gap_percent
from ocp_ros.util.terminal_text import printable

DISTANCES = 'distances are perpendicular to the walls, to the centre of the front of a camera'
#: Folders before a file name, in a word of a command line.
FOLDERS = re.compile(r'(?<![^=])[^=]*/(?=[^/])')


class Figures(NamedTuple):
    """
    The texts above and below the pictures.

    :ivar title: name of the room and number of cameras.
    :ivar subtitle: sizes and sensors.
    :ivar verdict: whether all constraints are satisfied, and whether the scan is doubtful.
    :ivar kept: whether all constraints are satisfied and there are no doubts.
    :ivar doubts: possible errors of the room or the file, a sentence each.
    :ivar cards: label, value and a remark of each key figure.
    :ivar foot: two lines: planner, command and date; corrections of the scan, and the definition
        of distances.
    """

    title: str
    subtitle: str
    verdict: str
    kept: bool
    doubts: tuple[str, ...]
    cards: list[tuple[str, str, str]]
    foot: tuple[str, str]


def figures_of(judged: Assessment) -> Figures:
    """Return the key figures of a placement in words."""
    scene, broken = judged.scene, judged.found['broken']
    cameras = judged.placement.cameras
    width, depth = (wall.length for wall in judged.walls[:2])
    sensors = Counter(placed.camera.sensor or 'own sensor' for placed in cameras)
    title = f'{scene.name}: {len(cameras)} camera{"s" * (len(cameras) != 1)}'
    subtitle = f'{width:.1f} x {depth:.1f} x {scene.size[2]:.1f} m, {len(scene):,} points; ' + \
        ', '.join(f'{count} x {sensor.replace("_", " ")}' for sensor, count in sensors.items())
    verdict = 'all constraints are satisfied' if not broken else (
        f'{len(broken)} constraint{"s" * (len(broken) != 1)} violated')
    made = judged.placement.created
    origin = '; '.join(filter(None, [
        f'found by the planner {made["planner"]}' if 'planner' in made else '',
        f'made by {without_folders(made["command"])}' if 'command' in made else '',
        made.get('date', ''),
        f'ocp_ros {made["version"]}' if 'version' in made else '']))
    meaning = '; '.join([*scene.remarks, DISTANCES])
    doubts = tuple(map(printable, judged.found.get('notes', ())))
    if doubts:
        verdict += ', but the scan is doubtful'
    return Figures(title, subtitle, verdict, not (broken or doubts), doubts,
                   _cards(judged), (printable(origin), printable(meaning)))


def without_folders(command: str) -> str:
    """Return a command with file names without their folders."""
    try:
        parts = shlex.split(command)
    except ValueError:
        return FOLDERS.sub('', command)
    return shlex.join(FOLDERS.sub('', part) for part in parts)


def _cards(judged: Assessment) -> list[tuple[str, str, str]]:
    """Return label, value and remark of each key figure."""
    scores, missed = judged.found['scores'], judged.found['missed']
    points, least = scores['points'], scores['seen_by']
    error, nothing = scores['depth_error'], scores['depth_error_of_nothing']
    hoped = judged.found['expected']
    twice = sum(count for number, count in scores['overlap'].items() if number not in '01')
    cards = [
        ('depth error', metres(error), f'{metres(nothing)} without cameras'),
        ('expected (9 of 10 rooms)', metres(hoped['depth_error']),
         f'{metres(hoped["low"])} to {metres(hoped["high"])}'),
        ('seen', percent(scores['seen']),
         'of the points, by a camera' if least == 1 else f'of the points, by {least} cameras'),
        ('seen twice', percent(twice / points), 'by two cameras or more'),
        ('space coverage', f'{scores["space_coverage"]:.1f} m³',
         f'of {scores["volume"]:.1f} m³ in all'),
        ('missed', percent(missed['share']), f'no candidate sees {percent(missed["hopeless"])}')]
    if scores['regions']:
        met = sum(region['met'] for region in scores['regions'])
        worst = min(scores['regions'], key=lambda region: region['seen'] - region['must_see'])
        cards.append(('regions', f'{met} of {len(scores["regions"])} met',
                      f'{worst["name"]}: {percent(worst["seen"])} seen'))
    if 'calibratable' in scores:
        links = scores['calibratable']
        groups = len(links['groups'])
        cards.append(('overlap', 'connected' if groups == 1 else f'{groups} groups',
                      f'pairs share {percent(links["overlap"])} or more'))
    known = judged.found.get('search', {}).get('certificate')
    if known and known['gap'] is not None:
        cards.append(('better by at most', f'{gap_percent(known["gap"]):.1f} %',
                      f'on {known["candidates"]:,} candidate poses'))
    more = judged.found.get('one_more')
    if more:
        x, y, z = more['position']
        cards.append(('one more camera', f'-{metres(max(more["gain"], 0.0))}',
                      f'depth error, at {x:.1f}, {y:.1f}, {z:.1f}'))
    return cards


def metres(length: float) -> str:
    """Return a length in metres as text, with fewer decimals for larger lengths."""
    return f'{length:.{3 if length < 1.0 else 2 if length < 10.0 else 1}f} m'


def expectation(expected: Mapping[str, float]) -> str:
    """Return the expected depth error in the room itself and its interval in words."""
    return (f'{metres(expected["depth_error"])} ({metres(expected["low"])} to '
            f'{metres(expected["high"])} in nine of ten rooms)')


def percent(share: float) -> str:
    """Return a share as per cent."""
    return f'{100.0 * share:.1f} %'
