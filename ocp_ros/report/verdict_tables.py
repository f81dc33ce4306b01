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

"""Scores and plans as tables and sentences on a terminal."""

from collections.abc import Callable, Iterator, Mapping, Sequence
import io
from typing import Any

from ocp_ros.report.assessment import COLUMNS
from ocp_ros.report.count_report import show_curve
from ocp_ros.report.key_figures import expectation, percent
from ocp_ros.report.room_facts import show_notes
from ocp_ros.rig.placement_file import ANGLES, FIXED
from ocp_ros.search.registry import OBSERVED, planner_names
from rich.console import Console
from rich.table import Table

#: Width of plain text, characters, and the column of the installer's table that is left out.
WIDTH, SENSOR = 100, 'sensor'


def as_text(show: Callable[[Console, Mapping[str, Any]], None], found: Mapping[str, Any]) -> str:
    """Return the output of a function such as :func:`show_verdict` as plain text."""
    text = io.StringIO()
    show(Console(width=WIDTH, file=text, force_terminal=False, color_system=None), found)
    return '\n'.join(line.rstrip() for line in text.getvalue().splitlines())


def show_verdict(console: Console, found: Mapping[str, Any]) -> None:
    """Print the scores and findings of a placement."""
    scores = found['scores']
    cameras = Table('camera', 'position (m)', 'yaw, pitch, roll', 'error reduction',
                    'seen by this camera only', title='Cameras')
    for placed, added in zip(found['cameras'], scores['cameras']):
        name = f'{added["name"]} (fixed)' if placed['mount'] == FIXED else added['name']
        cameras.add_row(name, ', '.join(f'{value:.2f}' for value in placed['position']),
                        ', '.join(f'{placed[angle]:.0f}' for angle in ANGLES),
                        f'{added["depth_error"]:.2f} m', percent(added['only']))
    console.print(cameras)
    least = scores['seen_by']
    by = 'a camera' if least == 1 else f'{least} cameras'
    console.print(f'depth error {scores["depth_error"]:.3f} m of '
                  f'{scores["depth_error_of_nothing"]:.3f} m; space coverage '
                  f'{scores["space_coverage"]:.1f} of {scores["volume"]:.1f} m³; '
                  f'{percent(scores["seen"])} of the points seen by {by}; objective value '
                  f'{scores["loss"]:.4f}')
    console.print(f'expected in the room itself: {expectation(found["expected"])}')
    if 'planned' in found:
        before = found['planned']
        console.print(f'as planned: depth error {before["depth_error"]:.3f} m, space coverage '
                      f'{before["space_coverage"]:.1f} m³, {percent(before["seen"])} of the '
                      f'points seen, objective value {before["loss"]:.4f}; the line above is '
                      'as built')
    console.print('seen by ' + ', '.join(f'{count}: {percent(points / scores["points"])}'
                                         for count, points in scores['overlap'].items()))
    for region in scores['regions']:
        must = f', {percent(region["must_see"])} required' if region['must_see'] else ''
        console.print(f'region {region["name"]}: {percent(region["seen"])} of its {region["of"]} '
                      f'seen{must}')
    if 'calibratable' in scores:
        console.print(links_line(scores['calibratable']))
    _show_rest(console, found)


def links_line(links: Mapping[str, Any]) -> str:
    """Return the pairs of cameras that can be calibrated to each other, in words."""
    pairs = ', '.join(f'{" and ".join(pair["cameras"])} {percent(pair["overlap"])}'
                      for pair in links['pairs'] if pair['linked'])
    return (f'calibratable: overlaps of {percent(links["overlap"])} or more under at most '
            f'{links["angle"]:.0f} degrees: {pairs or "none"}')


def _show_rest(console: Console, found: Mapping[str, Any]) -> None:
    """Print violated constraints, missed points, one more camera and notes."""
    broken, missed, more = found['broken'], found['missed'], found['one_more']
    kept = 'all constraints are satisfied' + (
        ', but the scan is doubtful (notes below)' if found['notes'] else '')
    console.print(kept if not broken else 'violated constraints:')
    for sentence in broken:
        console.print(f'  {sentence}', style='red', markup=False, highlight=False)
    console.print(f'missed: {percent(missed["share"])} of the points; '
                  f'{percent(missed["hopeless"])} not visible from any candidate')
    for part in missed['places']:
        corners = (', '.join(f'{value:.2f}' for value in part[key]) for key in ('low', 'high'))
        console.print(f'  {percent(part["share"])} from ({next(corners)}) to ({next(corners)})')
    if more is None:
        console.print('one more camera: there is no feasible pose for it')
    else:
        place = ', '.join(f'{value:.2f}' for value in more['position'])
        console.print(f'one more {more["sensor"]} helps most at ({place}), yaw {more["yaw"]:.0f}, '
                      f'pitch {more["pitch"]:.0f}: depth error {more["depth_error"]:.3f} m, '
                      f'{more["gain"]:.3f} m less')
    show_notes(console, found)


def show_plan(console: Console, found: Mapping[str, Any]) -> None:
    """Print a plan: scores, installer's table, and quality of the result."""
    show_verdict(console, found)
    titles = [title for title in COLUMNS if title != SENSOR]
    table = Table('', *titles, title='How to mount the cameras')
    table.columns[1].no_wrap = True
    for row in found['installer']:
        table.add_row(row['number'], *(row[title] for title in titles))
    console.print(table)
    for line in quality(found['search']):
        console.print(line, highlight=False)
    if 'curve' in found:
        show_curve(console, found['curve'], found['count'])


def quality(search: dict[str, Any]) -> Iterator[str]:
    """Yield sentences on the quality of a result: comparisons, bounds and certificate."""
    loss, random, everywhere = search['loss'], search['random'], search['everywhere']['loss']
    what = 'turns' if search['planner'] in planner_names(OBSERVED) else 'placements'
    yield (f'{search["planner"]}: {search["evaluations"]:,} {what} in {search["seconds"]:.1f} s'
           + ('; stopped by Ctrl-C' if search['stopped'] else ''))
    yield f'objective value {loss:.4f}' + _others(search['searches'])
    if random['placements']:
        yield (f'{random["placements"]} random feasible placements: median '
               f'{random["median"]:.4f}, best {random["best"]:.4f}')
    yield (f'lower bound {everywhere:.4f}: the objective value with a camera at each of the '
           f'{search["candidates"]:,} candidates')
    if loss > 0.0:
        share = percent(min(everywhere / loss, 1.0))
        yield f'{share} of the objective value is not visible from any candidate'
    yield search['certificate']['sentence']


def _others(losses: Sequence[float]) -> str:
    """Return the results of the other searches in words."""
    if len(losses) == 1:
        return ' (one search)'
    best, second, *_ = losses
    apart = f'{percent((second - best) / best)} more' if best > 0.0 else f'{second:.4f}'
    return (f'; of {len(losses)} searches the second best ended at {apart}, the worst at '
            f'{losses[-1]:.4f}')
