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
The facts of a placement in words: every number with its unit and rounding, and every sentence.

The terminal, the HTML page, the PNG pages and the installer's page arrange these texts.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
import re
import shlex
from typing import Any, NamedTuple

from ocp_ros.report.assessment import Assessment
from ocp_ros.report.camera_words import camera_label
from ocp_ros.report.findings import MIN_SEEN_SHARE
from ocp_ros.report.rig_planning import gap_percent
from ocp_ros.rig.placement_file import ANGLES
from ocp_ros.search.registry import OBSERVED, planner_names
from ocp_ros.util.files import printable

#: Matches the folders before a file name, in a word of a command line such as --out=folder/name.
FOLDER_PATTERN = re.compile(r'(?<![^=])[^=]*/(?=[^/])')
#: A smaller share of the surface of a region that was not scanned is not mentioned.
MIN_UNSCANNED_SHARE = 0.05
#: Column heads of the table of regions.
REGION_COLUMNS = ('region', 'seen', 'required', 'satisfied')
#: Column heads of the table of rooms.
ROOM_COLUMNS = ('room', 'area', 'around (x, y)', 'cameras', 'seen')
#: Column heads of the table of requirements.
REQUIREMENT_COLUMNS = ('required of', 'by each point', 'met', 'required', 'satisfied')
#: Column heads of the Pareto front of price and objective value.
FRONT_COLUMNS = ('cameras', 'price', 'depth error', 'objective value', 'by')
#: By the key of a share that cameras reach: its column head, and its denominator in a sentence.
SHARE_LABELS = {'seen': ('of visible points', 'points that can be seen'),
                'coverage': ('of reachable space', 'space that can be covered'),
                'error': ('of error reduction', 'possible error reduction')}


class Figure(NamedTuple):
    """A key figure: its name, its value with the unit, and a remark."""

    label: str
    value: str
    remark: str


class CameraFacts(NamedTuple):
    """
    Facts of a camera.

    :ivar name: name of the camera.
    :ivar position: x, y, z in metres, map frame.
    :ivar angles: yaw, pitch, roll in degrees.
    :ivar reduction: increase of the depth error if this camera is left out.
    :ivar only: share of the points that only this camera sees.
    """

    name: str
    position: str
    angles: str
    reduction: str
    only: str


@dataclass(frozen=True)
class Facts:
    """
    Facts of a placement in words.

    :ivar verdict: whether all constraints are satisfied, and the first doubt.
    :ivar satisfied: whether all constraints are satisfied and there are no doubts.
    :ivar doubts: possible errors of the room or the file, a sentence each.
    :ivar figures: the key figures.
    :ivar cameras: the facts of each camera.
    :ivar regions: for each region its row of the table with :data:`REGION_COLUMNS`.
    :ivar rooms: for each room of a floor its row of the table with :data:`ROOM_COLUMNS`, and
        whether cameras see it; empty for one room.
    :ivar room_columns: :data:`ROOM_COLUMNS`, and the quantity of a goal for each room.
    :ivar requirements: for each requirement its row with :data:`REQUIREMENT_COLUMNS`.
    :ivar links: pairs of cameras that can be calibrated to each other; '' if not required.
    :ivar certificate: a sentence on the optimality gap; '' if the placement was not planned.
    """

    verdict: str
    satisfied: bool
    doubts: list[str]
    figures: list[Figure]
    cameras: list[CameraFacts]
    regions: list[tuple[str, ...]]
    rooms: list[tuple[tuple[str, ...], bool]]
    room_columns: tuple[str, ...]
    requirements: list[tuple[str, ...]]
    links: str
    certificate: str


@dataclass(frozen=True)
class PageFacts(Facts):
    """
    Facts of a placement with its room, for pages.

    :ivar title: name of the room and number of cameras.
    :ivar subtitle: size of the room, number of points and sensors.
    :ivar origin: planner, command, date and version of the placement.
    :ivar meaning: corrections of the scan, and the definition of distances.
    :ivar frame: unit and frame of the coordinates.
    :ivar walls: letter and length of each side of the room.
    """

    title: str
    subtitle: str
    origin: str
    meaning: str
    frame: str
    walls: str


def facts_of(findings: Mapping[str, Any]) -> Facts:
    """
    Return the facts of a placement.

    :param findings: plain data of ``ocp score --json`` or ``ocp plan --json``.
    """
    scores, broken = findings['scores'], findings['broken']
    doubts = [printable(note) for note in findings['notes']]
    verdict = (f'{count_text(len(broken), "constraint")} violated' if broken else
               'all constraints are satisfied')
    if doubts:
        # What was found; what was expected and what to do follow in the list of doubts.
        verdict += f', {"and" if broken else "but"} {doubts[0].split(";")[0]}'
    cameras = [CameraFacts(camera_label(added['name'], placed['mount']),
                           ', '.join(f'{value:.2f}' for value in placed['position']),
                           ', '.join(f'{placed[angle]:.0f}' for angle in ANGLES),
                           f'{added["depth_error"]:.3f} m', percent(added['only']))
               for placed, added in zip(findings['cameras'], scores['cameras'])]
    certificate = findings['search']['certificate']['sentence'] if 'search' in findings else ''
    links = links_line(scores['calibratable']) if 'calibratable' in scores else ''
    rows, columns = room_rows(scores), ROOM_COLUMNS
    if 'rooms' in (count := findings.get('count', {})):
        columns = (*ROOM_COLUMNS, SHARE_LABELS[count['by']][0])
        rows = [((*row, percent(room['share'])), is_seen and room['reached'])
                for (row, is_seen), room in zip(rows, count['rooms'])]
    return Facts(verdict, not (broken or doubts), doubts, _figures(findings), cameras,
                 region_rows(scores), rows, columns, requirement_rows(scores), links, certificate)


def region_rows(scores: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return for each region its row of the table with :data:`REGION_COLUMNS`."""
    return [(region['name'], f'{percent(region["seen"])} of its {region["of"]}'
             + (' from all around' if 'around' in region else '')
             + (f'; about {percent(region["unscanned"])} of its surface or more was not scanned '
                '(its back)' if region.get('unscanned', 0.0) >= MIN_UNSCANNED_SHARE else ''),
             percent(region['must_see']), 'yes' if region['met'] else 'no')
            for region in scores['regions']]


def room_rows(scores: Mapping[str, Any]) -> list[tuple[tuple[str, ...], bool]]:
    """Return for each room of a floor its row, and whether more than 0 % of it are seen."""
    return [((room['name'], f'{room["area"]:.1f} m²', '{:.1f}, {:.1f}'.format(*room['at']),
              str(room['cameras']), percent(room['seen'])), room['seen'] >= MIN_SEEN_SHARE)
            for room in scores.get('rooms', ())]


def requirement_rows(scores: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return for each requirement its row of the table with :data:`REQUIREMENT_COLUMNS`."""
    return [(score['region'] or 'the whole room', score['require'], percent(score['share']),
             percent(score['asked']), 'yes' if score['met'] else 'no')
            for score in scores.get('requirements', ())]


def page_facts_of(assessed: Assessment) -> PageFacts:
    """Return the facts of a placement with its room."""
    scene, frame = assessed.scene, assessed.frame
    cameras, created = assessed.placement.cameras, assessed.placement.created
    sensors = Counter(placed.camera.sensor or 'own sensor' for placed in cameras)
    width, depth = assessed.size
    origin = '; '.join(filter(None, [
        f'found by the planner {created["planner"]}' if 'planner' in created else '',
        f'made by {strip_folders(created["command"])}' if 'command' in created else '',
        created.get('date', ''),
        f'ocp_ros {created["version"]}' if 'version' in created else '']))
    return PageFacts(
        **vars(facts_of(assessed.found)),
        title=f'{scene.name}: {count_text(len(cameras), "camera")}',
        subtitle=f'{width:.1f} x {depth:.1f} x {scene.size[2]:.1f} m, {len(scene):,} points; '
        + ', '.join(f'{count} x {sensor.replace("_", " ")}' for sensor, count in sensors.items()),
        origin=printable(origin), meaning=printable('; '.join([
            *scene.remarks, 'distances are perpendicular to the walls, to the centre of the front '
            'of a camera'])),
        # If the scan has the coordinates of the map, readers know the frame as that of the scan.
        frame=f'metres in the frame of the {"scan" if scene.source.is_map else "map"}'
        if frame.is_map else 'in the axes and units of the scan' + (
            '' if frame.scale == 1.0 else f', {frame.unit}'),
        walls=', '.join(wall.description for wall in assessed.walls))


def score_figures(scores: Mapping[str, Any], expected: Mapping[str, float]) -> list[Figure]:
    """
    Return the key figures that scores give.

    :param scores: from :func:`~ocp_ros.report.findings.scores_of`.
    :param expected: from :func:`~ocp_ros.report.findings.expected`, for the room itself.
    """
    viewers = 'a camera' if scores['seen_by'] == 1 else f'{scores["seen_by"]} cameras'
    # The keys of ``overlap`` are '0', '1', '2' and '3 or more' cameras.
    seen_twice = sum(count for key, count in scores['overlap'].items() if key not in ('0', '1'))
    return [
        Figure('depth error', metres(scores['depth_error']),
               f'{metres(scores["depth_error_of_nothing"])} without cameras'),
        Figure('expected (9 of 10 rooms)', metres(expected['depth_error']),
               f'{metres(expected["low"])} to {metres(expected["high"])}'
               + ('; scan more densely to narrow this' if 'sparse' in expected else '')),
        Figure('seen', percent(scores['seen']), f'of the points, by {viewers}'),
        Figure('seen twice', percent(seen_twice / scores['points']), 'by two cameras or more'),
        Figure('space coverage', f'{scores["space_coverage"]:.1f} m³',
               f'of {scores["volume"]:.1f} m³ of the room')]


def _figures(findings: Mapping[str, Any]) -> list[Figure]:
    """Return all key figures of a placement."""
    scores, missed = findings['scores'], findings['missed']
    figures = [*score_figures(scores, findings['expected']),
               Figure('missed', percent(missed['share']),
                      f'no candidate sees {percent(missed["hopeless"])}')]
    if regions := scores['regions']:
        # The region with the largest shortfall.
        worst = min(regions, key=lambda region: region['seen'] - region['must_see'])
        figures.append(Figure(
            'regions', f'{sum(region["met"] for region in regions)} of {len(regions)} met',
            f'{worst["name"]}: {percent(worst["seen"])} seen'))
    if requirements := scores.get('requirements'):
        worst = min(requirements, key=lambda score: score['share'] - score['asked'])
        figures.append(Figure(
            'requirements', f'{sum(score["met"] for score in requirements)} of '
            f'{len(requirements)} met', f'{worst["region"] or "room"}: {percent(worst["share"])} '
            f'of {percent(worst["asked"])}'))
    if links := scores.get('calibratable'):
        groups = len(links['groups'])
        figures.append(Figure('overlap', 'connected' if groups == 1 else f'{groups} groups',
                              f'pairs share {percent(links["overlap"])} or more'))
    certificate = findings['search']['certificate'] if 'search' in findings else {'gap': None}
    if certificate['gap'] is not None and certificate['bound'] > 0.0:
        figures.append(Figure('better by at most', f'{gap_percent(certificate["gap"]):.1f} %',
                              f'on candidate poses {certificate["step"]:.2g} m apart'))
    if one_more := findings['one_more']:
        place = ', '.join(f'{value:.1f}' for value in one_more['position'])
        # By rounding, a gain of 0 may be a little below 0.
        figures.append(Figure('one more camera', f'-{metres(max(one_more["gain"], 0.0))}',
                              f'depth error, at {place}'))
    return figures


def links_line(links: Mapping[str, Any]) -> str:
    """
    Return a sentence on the pairs of cameras that can be calibrated to each other.

    :param links: value of the key ``calibratable`` of the scores.
    """
    pairs = ', '.join(f'{" and ".join(pair["cameras"])} {percent(pair["overlap"])}'
                      for pair in links['pairs'] if pair['linked'])
    return (f'calibratable: overlaps of {percent(links["overlap"])} or more under at most '
            f'{links["angle"]:.0f} degrees: {pairs or "none"}')


def details_of(found: Mapping[str, Any]) -> Iterator[str]:
    """Yield what the key figures summarise: counts, comparison, missed places, suggestion."""
    scores, planned = found['scores'], found.get('planned')
    yield 'seen by ' + ', '.join(f'{cameras}: {percent(count / scores["points"])}'
                                 for cameras, count in scores['overlap'].items())
    for place in found['missed']['places']:
        low, high = (', '.join(f'{value:.2f}' for value in place[end]) for end in ('low', 'high'))
        yield f'missed: {percent(place["share"])} from ({low}) to ({high})'
    yield one_more_line(found['one_more'])
    if (light := scores.get('interference')) and light['pairs']:
        yield (f'{count_text(len(light["pairs"]), "pair")} of cameras light the same surfaces and '
               f'disturb each other: trigger them in {len(light["slots"])} time slots: '
               + '; '.join(', '.join(slot) for slot in light['slots']))
    if planned:
        yield (f'as planned: depth error {metres(planned["depth_error"])}, space coverage '
               f'{planned["space_coverage"]:.1f} m³, {percent(planned["seen"])} of the points '
               f'seen, objective value {planned["loss"]:.4f}; the other figures are as built')


def one_more_line(more: Mapping[str, Any] | None) -> str:
    """Return where one more camera helps most; ``more`` is the key ``one_more`` of findings."""
    if more is None:
        return 'one more camera: there is no feasible pose for it'
    at = ', '.join(f'{value:.2f}' for value in more['position'])
    return (f'one more {more["sensor"]} helps most at ({at}), yaw {more["yaw"]:.0f}, pitch '
            f'{more["pitch"]:.0f}: depth error {metres(more["depth_error"])}')


def quality_lines(findings: Mapping[str, Any]) -> Iterator[str]:
    """Yield lines on the objective value: other searches, random placements, bounds, proof."""
    if 'search' not in findings:
        yield f'objective value {findings["scores"]["loss"]:.4f}'
        return
    search = findings['search']
    loss, random, bound = search['loss'], search['random'], search['everywhere']['loss']
    # Online planners evaluate turns.
    kind = 'turns' if search['planner'] in planner_names(OBSERVED) else 'placements'
    yield (f'{search["planner"]}: {search["evaluations"]:,} {kind} in {search["seconds"]:.1f} s'
           + ('; stopped by Ctrl-C' if search['stopped'] else ''))
    yield f'objective value {loss:.4f}' + _other_searches(search['searches'])
    if random['placements']:
        yield (f'{random["placements"]} random feasible placements: median '
               f'{random["median"]:.4f}, best {random["best"]:.4f}')
    for score, most in zip(findings['scores'].get('requirements', ()),
                           search['everywhere'].get('requirements', ())):
        if not score['met']:
            yield (f'{score["region"] or "the room"}: the candidates together meet '
                   f'{percent(most)} of the required {percent(score["asked"])}')
    yield (f'lower bound {bound:.4f}: the objective value with a camera at each of the '
           f'{search["candidates"]:,} candidates')
    if loss > 0.0:
        # By rounding, the bound may be a little above the objective value.
        yield (f'{percent(min(bound / loss, 1.0))} of the objective value is not visible from any '
               'candidate')
    yield (f'{search["certificate"]["sentence"]} This is about the viewpoints of the search: the '
           f'depth error is {metres(findings["scores"]["depth_error"])} there and '
           f'{metres(findings["scores"]["validation_error"])} on others.')


def front_rows(found: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return the rows of the Pareto front with :data:`FRONT_COLUMNS`; [] without prices."""
    return [(row['mix'], f'{row["price"]:,.0f}', metres(row['depth_error']), f'{row["loss"]:.4f}',
             'plan' if row['planned'] else 'estimate') for row in found.get('front', ())]


def count_sentence(count: Mapping[str, Any]) -> str:
    """Return a sentence on the number of cameras that reaches the target, in this search."""
    target = f'{percent(count["target"])} of the {SHARE_LABELS[count["by"]][1]}'
    cameras, fewer = count_text(count['cameras'], 'camera'), count.get('fewer')
    if rooms := count.get('rooms'):
        names, least = count.get('mix', cameras), count['at_least']
        target += f' in each of {len(rooms)} rooms'
        if not count['reached']:
            return (f'{names} did not reach {target} in this search, but in '
                    f'{sum(room["reached"] for room in rooms)} of them')
        return (f'{names} reach {target}' + (f'; {fewer} did not in this search' if fewer else '')
                + ('' if least is None else f'; candidate poses that do cost at least {least:,.0f}'
                   if 'mix' in count else f'; at least {least} candidate poses are needed for it'))
    if 'mix' in count:
        return f'{count["mix"]} ' + (
            f'reach {target}; no cheaper cameras on the estimated front did in this search'
            if count['reached'] else
            f'did not reach {target} in this search, nor did cheaper cameras')
    if not count['reached']:
        return f'{cameras}, the largest number planned, did not reach {target} in this search'
    return f'{cameras} reach{"es" * (count["cameras"] == 1)} {target}' + (
        f'; {fewer} did not in this search' if fewer else '')


def strip_folders(command: str) -> str:
    """Return a command line whose file names have no folders."""
    # A command with an unclosed quotation mark cannot be split into words.
    try:
        words = shlex.split(command)
    except ValueError:
        return FOLDER_PATTERN.sub('', command)
    return shlex.join(FOLDER_PATTERN.sub('', word) for word in words)


def count_text(count: int, noun: str) -> str:
    """Return a count and a noun as text, such as "1 camera" or "2 cameras"."""
    return f'{count} {noun}{"s" * (count != 1)}'


def metres(length: float) -> str:
    """Return a length in metres as text, with fewer decimals for larger lengths."""
    return f'{length:.{3 if length < 1.0 else 2 if length < 10.0 else 1}f} m'


def percent(share: float) -> str:
    """Return a share from 0 to 1 as text in per cent."""
    return f'{100.0 * share:.1f} %'


def _other_searches(losses: list[float]) -> str:
    """Return in words how much worse the other searches ended; ``losses`` are sorted."""
    if len(losses) == 1:
        return ' (one search)'
    best, second, *_ = losses
    difference = f'{percent((second - best) / best)} more' if best > 0.0 else f'{second:.4f}'
    return (f'; of {len(losses)} searches the second best ended at {difference}, the worst at '
            f'{losses[-1]:.4f}')
