# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ocp plan``: where to hang the cameras of a rig, how good that is, and how many are needed."""

import argparse
from collections.abc import Callable, Iterator, Mapping
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

from ocp_ros.cli.common import claim_folder
from ocp_ros.cli.score_command import (
    CURVE,
    MARK,
    room_asked,
    show_written,
    WRITTEN,
    written_to,
)
from ocp_ros.planning.rig_planning import CAMERAS, Counting, MOUNT, PlannedRig, PlanTask
from ocp_ros.report.count_report import draw_curve
from ocp_ros.report.exports import PLACEMENTS
from ocp_ros.report.verdict_tables import show_plan, WIDTH
from ocp_ros.rig.placement_file import Placement, save_placement
from ocp_ros.rig.rig_file import load_rig, Rig, rig_of, with_count
from ocp_ros.search.budget import Budget
from ocp_ros.util.files import FileSet, folder_to_write
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.shown_text import printable


def plan(arguments: argparse.Namespace, command: str) -> dict[str, Any]:
    """
    Plan a rig in a room, and write the placement in all forms.

    :param arguments: of ``ocp plan``.
    :param command: the command line, for the record.
    :returns: what ``--json`` prints.
    """
    task = task_of(arguments)
    claim_folder(arguments, arguments.out, WRITTEN, MARK)
    rig = rig_asked(arguments)
    scene, room = room_asked(arguments, {})
    folder = folder_to_write(arguments.out)
    budget, proving = task.budgets()
    with _stopped_by_hand(budget), _progress() as progress:
        planned = PlannedRig(scene, rig, task, budget, proving, progress)
    placement = planned.placement(room, command)
    with _kept(folder, placement) as files:
        judged = planned.judged(placement, arguments.frame)
        return {**judged.found,
                **written_to(files, judged, lambda aside: _curve(aside, judged.found),
                             arguments.frame_prefix)}


def task_of(arguments: argparse.Namespace) -> PlanTask:
    """Return what a command line asks of the search."""
    counting = Counting(arguments.target, arguments.by, arguments.most)
    return PlanTask(arguments.planner, arguments.seconds, arguments.evaluations, arguments.seed,
                    counting if arguments.count == 0 else None)


def _curve(folder: Path, found: Mapping[str, Any]) -> Iterator[Path]:
    """Draw what more cameras are worth where they were counted; yield the file."""
    if 'curve' in found:
        yield draw_curve(folder / CURVE, found['curve'], found['count'])


@contextmanager
def _kept(folder: Path, placement: Placement) -> Iterator[FileSet]:
    """Write a placement first of all: whoever has enough while it is judged and drawn has it."""
    try:
        with FileSet(folder, WRITTEN, MARK) as files:
            # Where it cannot be written now, the end says so.
            with suppress(OSError):
                for name in PLACEMENTS:
                    save_placement(files.aside / name, placement)
            yield files
    except KeyboardInterrupt:
        print(f'ocp: stopped; the placement is in {printable(str(folder / PLACEMENTS[0]))}',
              file=sys.stderr)
        raise


def rig_asked(arguments: argparse.Namespace) -> Rig:
    """Return the rig of a command line; with ``auto``, one that may be counted up."""
    count = arguments.count
    if arguments.rig is None:
        rig = rig_of(count or CAMERAS, arguments.model, mount={'on': arguments.mount or MOUNT})
        return replace(rig, document=replace(rig.document, name='rig (no file)'))
    rig = load_rig(arguments.rig)
    if arguments.mount is not None:
        raise ConfigurationError(
            f'--mount: found {arguments.mount} with --rig; expected one of the two: the rig file '
            'says its mount; leave --mount out, or change the key mount of the file')
    return rig if count is None else with_count(rig, count or len(rig.cameras))


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


def show(found: dict[str, Any]) -> None:
    """Print a plan and what was written."""
    show_plan(Console(width=WIDTH), found)
    show_written(found)
