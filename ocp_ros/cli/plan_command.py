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

"""``ocp plan``: find and evaluate poses for the cameras of a rig, and the number of cameras."""

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
import math
from pathlib import Path
import signal
import sys
from threading import current_thread, main_thread
import time
from typing import TYPE_CHECKING

from ocp_ros.cli.arguments import (
    add_export,
    add_frame,
    add_overwrite,
    add_reading,
    add_room,
    read_cameras,
    read_count,
    read_price,
    read_seconds,
    read_seed,
    read_share,
    room_asked,
    whole,
)
from ocp_ros.cli.common import claim_folder, command_of, Commands, Found, PLAN, show_written
from ocp_ros.util.files import printable
from ocp_ros.util.resources import find_config
from ocp_ros.util.settings import ConfigurationError, need

if TYPE_CHECKING:
    from ocp_ros.report.rig_planning import PlanTask
    from ocp_ros.rig.placement_file import Placement
    from ocp_ros.rig.rig_file import Rig
    from ocp_ros.search.budget import Budget


def add_arguments(commands: Commands) -> None:
    """Add ``ocp plan``."""
    command = commands.add(PLAN, 'plan', 'find the best poses of cameras in a room',
                           'ocp plan room.ply --cameras 4 --model d455 --out out/plan')
    add_room(command)
    rig = command.add_mutually_exclusive_group()
    rig.add_argument('--rig', type=find_config, help='rig file with cameras and constraints: '
                     'docs/reference/rig.md')
    rig.add_argument('--model', metavar='SENSOR', default='omnidirectional',
                     help='sensor of all cameras, or a part of its name such as d455')
    command.add_argument('--mount', choices=('walls', 'ceiling', 'plane', 'free'),
                         help='mount of all cameras: walls (1.5 to 2.5 m above the floor), '
                         'ceiling (below it), plane (1.9 m above the floor) or free (1.5 to 2.5 '
                         'm); default: walls, or the mount in the rig file')
    command.add_argument('--cameras', '--count', dest='count', type=read_count, metavar='N',
                         help='number of cameras, or auto; default: 4, or the number in the rig '
                         'file')
    command.add_argument('--target', type=read_share, help='with auto: share to reach of what all '
                         'candidates reach together, also in each room of a floor; default: 0.95')
    command.add_argument('--by', choices=('error', 'seen', 'coverage'),
                         help='with auto: share of the error reduction, of the seen points or of '
                         'the space coverage')
    command.add_argument('--most', type=read_cameras, help='with auto: largest number of cameras, '
                         'on a floor of several rooms times the number of rooms; default: 12')
    command.add_argument('--budget', type=read_price, metavar='PRICE', help='with auto: largest '
                         'price of all cameras to be placed, by the list prices or those of the '
                         'rig file')
    command.add_argument('--planner', default='rig_search', metavar='NAME',
                         help='planner that searches: rig_search (default) or a name of '
                         'docs/reference/planners.md, such as cma_es or lookahead')
    command.add_argument('--seconds', type=read_seconds, help='seconds of search for each number '
                         'of cameras; default: 60, or 15 with auto; without limit if '
                         '--evaluations is given')
    command.add_argument('--evaluations', type=whole(1), help='number of placements to evaluate; '
                         'the same seed gives the same result')
    command.add_argument('--seed', type=read_seed, default=0, help='random seed')
    command.add_argument('--out', type=Path, default=Path('out/plan'), metavar='DIR',
                         help='folder for report, placement, CSV, launch file, xacro and more')
    add_export(command)
    add_frame(command)
    add_overwrite(command)
    add_reading(command)
    command.set_defaults(run=run, show=show)


def run(arguments: argparse.Namespace) -> Found:
    """Plan a rig in a room, write the placement in all file formats and return the data."""
    need('ocp plan', 'plotly', 'highspy')
    from ocp_ros.formats.exported import Exported
    from ocp_ros.formats.exports import export, formats_named, MARK, REPORTS, WRITTEN
    from ocp_ros.report.rig_planning import PlannedRig
    from ocp_ros.util.files import folder_to_write
    formats = formats_named(arguments.export, '--export')
    task = task_of(arguments)
    claim_folder(arguments, arguments.out, WRITTEN, MARK)
    rig = rig_asked(arguments)
    scene, room = room_asked(arguments, {})
    folder = folder_to_write(arguments.out)
    budget, proof_seconds = task.budgets()
    # The constructor of ``PlannedRig`` runs the search.
    with _stop_at_ctrl_c(budget), _show_progress(arguments.json) as progress:
        planned = PlannedRig(scene, rig, task, budget, proof_seconds, progress)
    placement = planned.placement(room, command_of(arguments.argv))
    with _keep_placement(folder, placement) as unfinished:
        assessed = planned.assessment_of(placement, arguments.frame)
        # After Ctrl-C no report is drawn.
        formats = [name for name in formats if not (budget.stopped and name in REPORTS)]
        exported = Exported(assessed.placement, arguments.frame_prefix, assessed=assessed)
        return {**assessed.found, **export(unfinished, exported, formats)}


def show(result: Found) -> None:
    """Print the plan, and the names of the written files."""
    from ocp_ros.report.terminal import show_score, wide_console
    show_score(wide_console(), result)
    show_written(result)
    if result['search']['stopped']:
        print('stopped: no report was drawn; `ocp score ROOM PLACEMENT --out DIR` draws it')


def task_of(arguments: argparse.Namespace) -> 'PlanTask':
    """Return the settings of the search from a command line."""
    from ocp_ros.report.rig_planning import Counting, PlanTask
    # The options for counting have the names of these fields. A count of 0 stands for ``auto``.
    counting = {name: value for name in Counting._fields
                if (value := getattr(arguments, name)) is not None}
    if counting and arguments.count != 0:
        raise ConfigurationError(
            f'--{next(iter(counting))}: found it without --count auto; expected it where cameras '
            'are counted; leave it out, or add --count auto')
    return PlanTask(arguments.planner, arguments.seconds, arguments.evaluations, arguments.seed,
                    Counting(**counting) if arguments.count == 0 else None)


@contextmanager
def _keep_placement(folder: Path, placement: 'Placement') -> Iterator[Path]:
    """Save a placement, so that a Ctrl-C during the evaluation keeps it; see ``file_set``."""
    from ocp_ros.formats.exports import MARK, PLACEMENT_FILES, WRITTEN
    from ocp_ros.rig.placement_file import save_placement
    from ocp_ros.util.files import file_set
    is_saved = False
    try:
        with file_set(folder, WRITTEN, MARK) as unfinished:
            # At the end, also by Ctrl-C, the files are moved into the folder. If the
            # placement cannot be written now, the final writing reports the error.
            with suppress(OSError):
                for name in PLACEMENT_FILES:
                    save_placement(unfinished / name, placement)
                    is_saved = True
            yield unfinished
    except KeyboardInterrupt:
        if is_saved:
            path = printable(str(folder / PLACEMENT_FILES[0]))
            print(f'ocp: stopped; the placement is in {path}', file=sys.stderr)
        raise


def rig_asked(arguments: argparse.Namespace) -> 'Rig':
    """Return the rig; with ``--count auto``, planning replaces its number of cameras later."""
    from ocp_ros.report.rig_planning import CAMERAS, MOUNT
    from ocp_ros.rig.rig_file import load_rig, rig_of, with_count
    number = arguments.count  # 0 for ``auto``, None without the option.
    if arguments.rig is None:
        rig = rig_of(number or CAMERAS, arguments.model, mount={'on': arguments.mount or MOUNT})
        return replace(rig, document=replace(rig.document, name='rig (no file)'))
    rig = load_rig(arguments.rig)
    if arguments.mount is not None:
        raise ConfigurationError(
            f'--mount: found {arguments.mount} with --rig; expected one of the two: the rig file '
            'says its mount; leave --mount out, or change the key mount of the file')
    # ``with_count`` refuses a rig with several groups of cameras.
    return with_count(rig, number) if number else rig


@contextmanager
def _stop_at_ctrl_c(budget: 'Budget') -> Iterator[None]:
    """Let the first Ctrl-C stop the search, and the second one the command."""
    # Python handles signals in the main thread only.
    if current_thread() is not main_thread():
        yield
        return

    def stop(*_) -> None:
        signal.signal(signal.SIGINT, previous_handler)
        budget.stop()

    previous_handler = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous_handler)


@contextmanager
def _show_progress(silent: bool) -> Iterator[Callable[[float, float], None]]:
    """
    Show the progress as a bar on a terminal, else as a line every 10 s.

    :param silent: whether to print no lines, for ``--json``; a bar on a terminal is shown anyway.
    :returns: a context that yields ``report(share, loss)``: share of the budget used so far, and
        smallest objective value so far.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn
    console = Console(stderr=True)
    with Progress(TextColumn('{task.description}'), BarColumn(), TextColumn('{task.fields[loss]}'),
                  console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task('searching (Ctrl-C: best so far)', total=1.0, loss='')
        last_print = time.monotonic()

        def report(share: float, loss: float) -> None:
            nonlocal last_print
            text = '' if loss == math.inf else f'objective value {loss:.4f}'
            bar.update(task, completed=share, loss=text)
            if not (silent or console.is_terminal) and time.monotonic() - last_print >= 10.0:
                last_print = time.monotonic()
                print(f'searching, {100.0 * min(share, 1.0):.0f} %: {text}', file=sys.stderr,
                      flush=True)
        yield report
