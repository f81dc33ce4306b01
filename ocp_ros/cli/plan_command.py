# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ocp plan``: where to hang the cameras of a rig, how good that is, and how many are needed."""

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
import signal
import sys
from threading import current_thread, main_thread
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

from ocp_ros.cli.score_command import (
    claim_folder,
    CURVE,
    earlier_files,
    room_asked,
    show_verdict,
    show_written,
    written_to,
)
from ocp_ros.geometry.engine_config import PROMISING
from ocp_ros.planners.budget import Budget
from ocp_ros.planners.registry import ONLINE
from ocp_ros.planners.rig_methods import check_planner, EXACT
from ocp_ros.planners.rig_plan import RigPlan, RigPlanner
from ocp_ros.report.assessment import Assessment
from ocp_ros.report.certificate_words import certificate_data
from ocp_ros.report.count_report import draw_curve, rows_of_curve, show_curve
from ocp_ros.report.exports import PLACEMENTS
from ocp_ros.report.findings import verdict
from ocp_ros.report.installer import COLUMNS, rows_of
from ocp_ros.report.key_figures import percent
from ocp_ros.rig.placement_file import (
    created_by,
    data_of,
    Placement,
    placement_of,
    save_placement,
)
from ocp_ros.rig.rig_file import load_rig, Rig, rig_of, with_count
from ocp_ros.util.files import folder_to_write
from ocp_ros.util.own_files import note_own
from ocp_ros.util.shown_text import printable

#: Cameras where nobody says how many, and seconds of search for each number of cameras where one
#: is planned and where several are.
CAMERAS, SECONDS, SECONDS_EACH = 4, 60.0, 15.0
#: Share of the seconds for proving how good an answer is.
PROVING = 0.25
#: Column of the installer's table that the terminal has no room for.
SENSOR = 'sensor'


def plan(arguments: argparse.Namespace, command: str) -> dict[str, Any]:
    """
    Plan a rig in a room, and write the placement in all forms.

    :param arguments: of ``ocp plan``.
    :param command: the command line, for the record.
    :returns: what ``--json`` prints.
    """
    counting = arguments.count == 0
    check_planner(arguments.planner, counting)
    claim_folder(arguments, arguments.out, counting)
    rig = rig_asked(arguments)
    scene, room = room_asked(arguments, {})
    folder = folder_to_write(arguments.out)
    budget, proving = budgets_of(arguments)
    with _stopped_by_hand(budget), _progress() as progress:
        planner = RigPlanner(scene, rig, PROMISING, budget, arguments.seed, progress,
                             arguments.planner)
        plans = list(_counted(planner, rig, arguments) if counting else [planner.plan(rig)])
        plans[-1] = planner.certified(plans[-1], budget.again(proving))
    best = plans[-1]
    placement = placement_of(best.rig, best.answer.poses, room=room, engine=PROMISING,
                             created=created_by(command, best.planner))
    with _kept(folder, placement):
        problem = planner.problem(best.rig)
        found = {'room': room, 'cameras': data_of(placement)['cameras'],
                 **verdict(problem, placement.poses),
                 'search': _search_of(best, budget, arguments.seed)}
        if counting:
            found['curve'] = rows_of_curve(plans)
            found['count'] = {'cameras': len(best.rig.cameras), 'by': arguments.by,
                              'target': arguments.target,
                              'reached': best.reaches(arguments.by, arguments.target)}
        judged = Assessment(problem.objective, replace(placement, scores=found['scores']), found,
                            arguments.frame)
        found['installer'] = [dict(zip(['number', *COLUMNS], row)) for row in rows_of(judged)]
        return {**found, **written_to(folder, judged, _curve(folder, found),
                                      arguments.frame_prefix)}


def _curve(folder: Path, found: dict[str, Any]) -> Iterator[Path]:
    """Draw what more cameras are worth where they were counted; yield the file."""
    if 'curve' in found:
        yield draw_curve(folder / CURVE, found['curve'], found['count'])


@contextmanager
def _kept(folder: Path, placement: Placement) -> Iterator[None]:
    """Write a placement first of all: whoever has enough while it is judged and drawn has it."""
    paths = [folder / name for name in PLACEMENTS]
    # Where it cannot be written now, the end says so.
    with suppress(OSError):
        for path in paths:
            save_placement(path, placement)
            note_own([path])
    try:
        yield
    except KeyboardInterrupt:
        print(f'ocp: stopped; the placement is in {printable(str(paths[0]))}'
              + earlier_files(folder, paths), file=sys.stderr)
        raise


def rig_asked(arguments: argparse.Namespace) -> Rig:
    """Return the rig of a command line; with ``auto``, one that may be counted up."""
    count = arguments.count
    if arguments.rig is None:
        rig = rig_of(count or CAMERAS, arguments.model)
        return replace(rig, document=replace(rig.document, name='rig (no file)'))
    rig = load_rig(arguments.rig)
    return rig if count is None else with_count(rig, count or len(rig.cameras))


def budgets_of(arguments: argparse.Namespace) -> tuple[Budget, float | None]:
    """Return how long a search may take, and the seconds for proving how good its answer is."""
    seconds = arguments.seconds
    if seconds is None and arguments.evaluations is None:
        seconds = SECONDS_EACH if arguments.count == 0 else SECONDS
    if seconds is None or arguments.planner == EXACT:
        return Budget(seconds, arguments.evaluations), seconds
    return Budget((1.0 - PROVING) * seconds, arguments.evaluations), PROVING * seconds


def _counted(planner: RigPlanner, rig: Rig, arguments: argparse.Namespace) -> Iterator[RigPlan]:
    """Yield plans with ever more cameras until one reaches the target."""
    first = max(rig.seen_by - len(rig.fixed), 1)
    for plan in planner.count_up(lambda count: with_count(rig, count), first,
                                 max(arguments.most, first)):
        yield plan
        if plan.reaches(arguments.by, arguments.target):
            return


@contextmanager
def _stopped_by_hand(budget: Budget) -> Iterator[None]:
    """End the search at the first Ctrl-C; the second one ends the command."""
    if current_thread() is not main_thread():
        yield
        return

    def stop(*_) -> None:
        signal.signal(signal.SIGINT, before)
        budget.stop()

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _progress() -> Iterator[Callable[[float, float], None]]:
    """Show the progress on the terminal, where there is one; yields a function to call."""
    console = Console(stderr=True)
    with Progress(TextColumn('{task.description}'), BarColumn(), TextColumn('{task.fields[loss]}'),
                  console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task('searching (Ctrl-C: best so far)', total=1.0, loss='')

        def report(share: float, loss: float) -> None:
            value = '' if np.isinf(loss) else f'objective value {loss:.4f}'
            bar.update(task, completed=share, loss=value)
        yield report


def _search_of(plan: RigPlan, budget: Budget, seed: int) -> dict[str, Any]:
    """Return how a placement was found and what it compares with, as plain data."""
    answer, random = plan.answer, plan.random
    return {'planner': plan.planner, 'seed': seed,
            'loss': plan.worth.loss, 'searches': sorted(answer.losses),
            'evaluations': answer.evaluations, 'seconds': round(plan.seconds, 2),
            'stopped': budget.stopped, 'candidates': plan.candidates,
            'random': {'placements': len(random),
                       'median': float(np.median(random)) if len(random) else None,
                       'best': float(random.min()) if len(random) else None},
            'everywhere': {'loss': plan.everywhere.loss,
                           'depth_error': plan.everywhere.depth_error},
            'certificate': certificate_data(plan)}


def show_plan(found: dict[str, Any]) -> None:
    """Print a plan."""
    console = Console(width=100)
    show_verdict(found)
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
    show_written(found)


def quality(search: dict[str, Any]) -> Iterator[str]:
    """Say how good an answer is, by what it was compared with, and what limits it."""
    loss, random, everywhere = search['loss'], search['random'], search['everywhere']['loss']
    what = 'turns' if search['planner'] in ONLINE else 'placements'
    yield (f'{search["planner"]}: {search["evaluations"]:,} {what} in {search["seconds"]:.1f} s'
           + ('; stopped by Ctrl-C' if search['stopped'] else ''))
    yield f'objective value {loss:.4f}' + _others(search['searches'])
    if random['placements']:
        yield (f'{random["placements"]} random feasible placements: median '
               f'{random["median"]:.4f}, best {random["best"]:.4f}')
    yield (f'lower bound {everywhere:.4f}: the objective value with a camera at each of the '
           f'{search["candidates"]:,} candidates')
    share = everywhere / loss if loss > 0.0 else 1.0
    yield f'{percent(min(share, 1.0))} of the objective value is not visible from any candidate'
    yield search['certificate']['sentence']


def _others(losses: Sequence[float]) -> str:
    """Say what the other searches ended with, where there were several."""
    if len(losses) == 1:
        return ' (one search)'
    best, second, *_ = losses
    apart = f'{percent((second - best) / best)} more' if best > 0.0 else f'{second:.4f}'
    return (f'; of {len(losses)} searches the second best ended at {apart}, the worst at '
            f'{losses[-1]:.4f}')
