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
Write what ``ocp benchmark`` has found as a page with tables and figures.

    python -m benchmarks.benchmark_report out/benchmark
"""

import argparse
from collections.abc import Sequence
import json
from pathlib import Path
import sys
from typing import Any

from benchmarks import results
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from ocp_ros.compare.protocol import MOUNTING_ERRORS, RANDOM_PLACEMENTS
from ocp_ros.compare.summary import budgets_of, last_runs
from ocp_ros.report.drawing.room_drawing import INK, PALE_INK
from ocp_ros.report.drawing.saved_pictures import save_figure
from ocp_ros.report.installer_page import escape_markdown
from ocp_ros.search.registry import planner_names, PLANNERS, SCORES
from ocp_ros.util.files import printable, write_atomically

#: Told apart with any kind of colour vision, repeated with another line where there are more.
COLOURS = ('#0072b2', '#e69f00', '#009e73', '#cc79a7', '#56b4e9', '#d55e00', '#8c6d31')
LINES = ('-', '--', ':')
#: Searches that given time should all find what is best, and how far apart they may be.
SEARCHES = ('rig_search', 'greedy_swap', 'tdsa', 'bpso', 'bee_colony', 'differential_evolution',
            'cma_es')
ALIKE = 1.10
TITLES = {'tdsa': 'TDSA', 'bpso': 'BPSO', 'cma_es': 'CMA-ES'}
#: What planners know of a room; what is not named here knows the scores of its placements.
KNOWS = {
    **dict.fromkeys(('greedy_coverage', 'greedy_error'), 'scores of positions on a grid'),
    'greedy_swap': 'scores of positions on a grid, later of any positions',
    'tdsa': 'scores, also of placements with fewer cameras',
    'bpso': 'scores of positions on a grid',
}


def style(number: int) -> dict[str, Any]:
    """Return the colour and the line of a planner."""
    return {'color': COLOURS[number % len(COLOURS)],
            'linestyle': LINES[number // len(COLOURS) % len(LINES)]}


def write_report(folder: Path, target: Path) -> dict[str, Any]:
    """
    Write ``README.md`` and its picture.

    :param folder: of ``ocp benchmark``, with ``summary.json``.
    :param target: folder of the report; it is made.
    :returns: the summary.
    """
    summary = json.loads((folder / 'summary.json').read_bytes())
    draw_bars(target / 'rooms.png', summary)
    write_atomically(target / 'README.md', page(summary))
    return summary


def budget_named(budget: str) -> str:
    """Write a budget as titles have it."""
    return f'{int(budget):,} evaluations' if int(budget) else 'the turns of online planners'


def draw_bars(path: Path, summary: dict[str, Any]) -> None:
    """Draw a group of bars for each room: every planner at the largest budget."""
    budget, rooms = budgets_of(summary)[-1], list(summary['rooms'])
    runs = last_runs(summary)
    names = list(runs)
    wide = max(11.0, 1.2 + 1.5 * len(rooms))
    figure = Figure(figsize=(wide, 5.5), dpi=100, facecolor='white')
    axes = figure.add_axes((0.07, 0.12, 0.91, 0.66))
    width = 0.85 / len(names)
    for k, name in enumerate(names):
        values = [runs[name]['rooms'][room] for room in rooms]
        axes.bar(np.arange(len(rooms)) + (k - 0.5 * (len(names) - 1)) * width, values, width,
                 color=style(k)['color'], hatch=('', '//', '..')[k // len(COLOURS) % 3],
                 edgecolor='white', linewidth=0.4, label=spaced(name))
    for k, room in enumerate(rooms):
        known = summary['rooms'][room]['best_known']
        axes.plot([k - 0.45, k + 0.45], [known, known], color=INK, linewidth=1.2,
                  label='reference' if k == 0 else None)
    axes.set_xticks(range(len(rooms)), [printable(Path(room).stem) for room in rooms],
                    parse_math=False)
    axes.set_ylabel('depth error (m)', color=PALE_INK)
    axes.set_yscale('log')
    _quiet(axes)
    figure.text(0.07, 0.95, f'Depth error of the final placement, {budget_named(budget)}',
                fontsize=14, fontweight='bold', color=INK, va='center')
    figure.legend(loc='upper left', bbox_to_anchor=(0.06, 0.92), ncols=6, frameon=False,
                  fontsize=9)
    save_figure(figure, path)


def _quiet(axes: Axes) -> None:
    """Leave out what does not tell anything."""
    axes.spines[['top', 'right']].set_visible(False)
    axes.tick_params(colors=PALE_INK)
    axes.grid(axis='y', color='#e4e6e8', linewidth=0.8)
    axes.set_axisbelow(True)


def spaced(name: str) -> str:
    """Write a planner's name as one says it."""
    return TITLES.get(name, name.replace('_', ' '))


def capital(words: str) -> str:
    """Write words as a sentence begins."""
    return words[:1].upper() + words[1:]


def shown(number: float | None, digits: int) -> str:
    """Write a number, or a dash where there is none."""
    return '-' if number is None else f'{number:.{digits}f}'


def knows(name: str) -> str:
    """Say what a planner knows of a room."""
    return KNOWS.get(name, PLANNERS[name].input_kind if name in PLANNERS else SCORES)


def page(summary: dict[str, Any]) -> str:
    """Write the comparison as Markdown."""
    lines = [
        '# Planners compared', '',
        'This page compares planners for camera placement. The following command made it on '
        f'{summary["date"]}:', '',
        f'    {printable(summary["command"])}', '',
        f'Each planner places {_placed(summary)}. There are {_rooms(summary)}. Planners with a '
        f'scan search with the preset `fine` of the engine on {summary["points"]:,} points of a '
        'room. The figure of a room is the mean over rotations and seeds. A *judge* computes the '
        'error of each final placement. The judge is independent of the search. In a generated '
        'room it casts rays at the mesh (the *truth*), on another scan of '
        f'{summary["judged_points"]:,} points. In a scan without a mesh it uses the engine on '
        'points that no search has.',
        '', '| column | meaning |', '|---|---|',
        '| knows | what the planner knows of the room |',
        '| delivered | depth error that the judge computes, summed over the rooms. The judge '
        f'moves each camera by {100 * MOUNTING_ERRORS.metres:.0f} cm in a random direction, '
        f'{MOUNTING_ERRORS.count} times, and takes the mean |',
        '| 95 % | bootstrap interval of delivered over the rooms |',
        '| promised | depth error that the engine computes on the points of the search, summed '
        'over the rooms |',
        '| promised / delivered | mean of this ratio over the rooms |',
        '| worst promise | this ratio in the room where it is farthest from 1 |',
        '| gap | mean optimality gap, where the planner proves one |',
        '| regret | delivered / delivered error of the *reference*: the default planner with ray '
        'casting in place of the engine |',
        '| regret, geometric | geometric mean of this ratio over the rooms |',
        '| gap closed | (random - planner) / (random - reference), of the sums over the rooms. '
        f'*random* is the mean of {RANDOM_PLACEMENTS} placements that are drawn at random |',
        '| wins | number of rooms in which no other planner of the same table is better |',
        '| rank | mean over the rooms of the rank of the planner; 1 is the best |',
        '| p | p-value of a signed-rank test (Wilcoxon) against the planner with the best rank, '
        'corrected for the number of tests (Holm) |', '',
        compared(summary), '', *(f'**Note:** {note}.\n' for note in summary.get('notes', ()))]
    for budget in budgets_of(summary):
        heading = f'{int(budget):,} evaluations' if int(budget) else \
            'Online planners, without a scan'
        lines += [f'## {heading}', '', *_table(summary, budget), '']
        test = summary['rank_tests'][budget]
        runs = [(name, runs[budget]) for name, runs in summary['planners'].items()
                if budget in runs]
        for name, run in runs:
            if 'seconds_per_turn' in run:
                lines += [f'{spaced(name)}: {1e3 * run["seconds_per_turn"]:.0f} ms '
                          f'per turn (median), {1e3 * run["seconds_at_most"]:.0f} ms at most.', '']
        friedman = test['friedman_p']
        lines += [f'{capital(spaced(test["leader"]))} has the best rank.' + (
            '' if friedman is None else ' A Friedman test of the hypothesis that all planners of '
            f'this table are equal gives p = {friedman:.2g}.'), '']
    lines += _agreement(summary) + _duels(summary) + _times(summary)
    lines += ['![Depth error of every planner in every room](rooms.png)', '']
    lines += ['## Rooms', '',
              '| room | reference (m) | random (m) | reference / random | cameras everywhere (m) '
              '|', '|---|---|---|---|---|']
    for room, known in summary['rooms'].items():
        lines.append(
            f'| {escape_markdown(Path(room).stem)} | {known["best_known"]:.3f} | '
            f'{known["random_placement"]:.2f} | '
            f'{shown(known["share"], 3)} | '
            f'{known["lower_bound"]:.3f} |')
    lines += ['', '*Reference* and *random* are explained above. *Cameras everywhere* is the '
              'depth error with a camera at each of 400 candidate poses at the same time.', '',
              'Versions: ' + ', '.join(
                  f'{name} {version}' for name, version in summary['versions'].items()) + '.', '']
    return '\n'.join(lines)


def _table(summary: dict[str, Any], budget: str) -> list[str]:
    """Compare all planners of a budget, and below them the search with the truth."""
    test = summary['rank_tests'][budget]
    lines = ['| planner | knows | delivered (m) | 95 % | promised (m) | promised / delivered | '
             'worst promise | gap | regret | regret, geometric | gap closed | wins | '
             'rank | p |', '|---|---|---|---|---|---|---|---|---|---|---|---|---|---|']
    runs = {name: runs[budget] for name, runs in summary['planners'].items() if budget in runs}
    for name, run in sorted(runs.items(), key=lambda item: item[1]['sum']):
        p = test['against_leader'].get(name)
        low, high = run['interval']
        lines.append(
            f'| {spaced(name)} | {knows(name)} | {run["sum"]:.2f} | {low:.2f} to {high:.2f} | '
            f'{_promise(run)} | {shown(run["gap_closed"], 4)} | {run["wins"]} | '
            f'{test["mean_rank"][name]:.1f} | {"" if p is None else f"{p:.3f}"} |')
    truth = summary['truth']
    return [*lines, f'| reference | the mesh, if there is one | {truth["sum"]:.2f} | | '
                    f'{_promise(truth)} | | | | |']


def _promise(run: dict[str, Any]) -> str:
    """Write the cells on what was promised and on what is regretted."""
    return (f'{run["promised"]:.2f} | {shown(run["promise_over_delivered"], 2)} | '
            f'{shown(run["promise_worst_room"], 2)} | '
            f'{shown(run.get("gap"), 3)} | {shown(run["regret"], 2)} | '
            f'{shown(run["regret_geometric"], 2)}')


def _placed(summary: dict[str, Any]) -> str:
    """Say which cameras were placed."""
    return (f'{summary["cameras"]} cameras of the rig file `{_as_code(summary["rig"])}` under all '
            'its constraints, with positions and headings. *Depth error* on this page is the '
            'objective value of the rig file, multiplied by the depth error without cameras')


def _rooms(summary: dict[str, Any]) -> str:
    """Say how many rooms there are, and in how many rotations."""
    rotations = summary['rotations']
    each = 'one rotation' if rotations == 1 else f'{rotations} rotations'
    return f'{len(summary["rooms"])} rooms, each in {each}'


def compared(summary: dict[str, Any]) -> str:
    """Say how many of all planners are compared, and which are not."""
    left_out = [spaced(name) for name in planner_names() if name not in summary['planners']]
    text = f'The comparison has {len(summary["planners"])} of {len(planner_names())} planners.'
    return text + (f' It leaves out: {"; ".join(left_out)}.' if left_out else '')


def _agreement(summary: dict[str, Any]) -> list[str]:
    """Say how far apart the searches are that had the most evaluations."""
    last = budgets_of(summary)[-1]
    sums = {name: runs[last]['sum'] for name, runs in summary['planners'].items()
            if name in SEARCHES and last in runs}
    if len(sums) < 2 or not min(sums.values()):
        return []
    ratios = {name: total / min(sums.values()) for name, total in sums.items()}
    near = [name for name, ratio in ratios.items() if ratio <= ALIKE]
    far = [f'{spaced(name)} {ratio:.2f}' for name, ratio in ratios.items() if ratio > ALIKE]
    text = f'With {int(last):,} evaluations these searches deliver a sum within ' \
        f'{100 * (ALIKE - 1):.0f} % of the smallest one: {", ".join(map(spaced, near))}.'
    if far:
        text += f' The others, as multiples of the smallest sum: {", ".join(far)}.'
    return ['## Agreement of the searches', '', text, '']


def _duels(summary: dict[str, Any]) -> list[str]:
    """Set each online planner against each offline one and budget."""
    planners = summary['planners']
    online = [name for name, runs in planners.items() if '0' in runs]
    offline = [(name, budget) for name, runs in planners.items() for budget in runs
               if budget != '0']
    if not online or not offline:
        return []
    lines = ['## Online against offline', '',
             'A cell has the ratio of two sums of delivered errors over the rooms: online planner '
             '/ offline planner. The number in parentheses says in how many of the '
             f'{len(summary["rooms"])} rooms the online planner is better.', '',
             '| offline planner | evaluations | ' + ' | '.join(map(spaced, online)) + ' |',
             '|---|---|' + '---|' * len(online)]
    for name, budget in offline:
        rival = planners[name][budget]
        cells = []
        for one in online:
            run = planners[one]['0']
            won = sum(run['rooms'][room] < rival['rooms'][room] for room in summary['rooms'])
            ratio = run['sum'] / rival['sum'] if rival['sum'] else None
            cells.append(f'{shown(ratio, 2)} ({won})')
        lines.append(f'| {spaced(name)} | {int(budget):,} | {" | ".join(cells)} |')
    return [*lines, '']


def _times(summary: dict[str, Any]) -> list[str]:
    """Tell how long each planner takes on one core."""
    budgets = budgets_of(summary)
    lines = ['## Time', '', 'The table has the seconds for one placement on one core, by the '
             'number of evaluations. Online planners have turns in place of evaluations. The last '
             'column is the time for one placement in each room and rotation, with the largest '
             'number of evaluations. The time for training the policy is not included.', '',
             '| planner | ' + ' | '.join(
                 f'{int(budget):,} evaluations (s)' if int(budget) else 'turns (s)'
                 for budget in budgets)
             + ' | all rooms (s) |', '|---|' + '---|' * (len(budgets) + 1)]
    places = len(summary['rooms']) * summary['rotations']
    for name, runs in summary['planners'].items():
        cells = [f'{runs[budget]["seconds"]:.2f}' if budget in runs else '' for budget in budgets]
        longest = runs[max(runs, key=int)]['seconds']
        lines.append(f'| {spaced(name)} | {" | ".join(cells)} | {places * longest:.0f} |')
    return [*lines, '']


def _as_code(text: str) -> str:
    """Return a text for a place between two backquotes."""
    return printable(text).replace('`', "'")


def main(argv: Sequence[str] | None = None) -> int:
    """Write the report."""
    parser = argparse.ArgumentParser(prog='benchmark_report', description='Report a comparison.')
    parser.add_argument('folder', type=Path, help='where ocp benchmark wrote its results')
    parser.add_argument('--out', type=Path,
                        help='folder of the report; default: that of the results')
    parser.add_argument('--record', metavar='NAME',
                        help='write the summary to docs/results/NAME.json, such as benchmark')
    options = parser.parse_args(argv)
    target = options.out or options.folder
    summary = write_report(options.folder, target)
    print(f'wrote {target / "README.md"}')
    if options.record:
        results.write(options.record, summary, summary['command'])
    return 0


if __name__ == '__main__':
    sys.exit(main())
