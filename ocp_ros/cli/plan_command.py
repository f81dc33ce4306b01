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
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
import math
from pathlib import Path
import signal
import sys
from threading import current_thread, main_thread
import time
from typing import Any, TYPE_CHECKING

from ocp_ros.cli.arguments import (
    add_frame,
    add_overwrite,
    add_points,
    add_reading,
    at_least,
    cameras,
    count,
    room_asked,
    seconds,
    seed,
    share,
)
from ocp_ros.cli.common import claim_folder, command_of, Commands, Found, PLAN
from ocp_ros.util.resources import find_config
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.terminal_text import printable

if TYPE_CHECKING:
    from ocp_ros.planning.rig_planning import PlanTask
    from ocp_ros.rig.placement_file import Placement
    from ocp_ros.rig.rig_file import Rig
    from ocp_ros.search.budget import Budget
    from ocp_ros.util.files import FileSet

#: Defaults of the options for counting cameras.
COUNTING = {'target': 0.95, 'by': 'error', 'most': 12}
#: Seconds between two lines of progress if the output is no terminal.
SAID = 10.0


def add_arguments(commands: Commands) -> None:
    """Add ``ocp plan``."""
    planned = commands.add(PLAN, 'plan', 'find the best poses of cameras in a room',
                           'ocp plan room.ply --cameras 4 --model d455 --out out/plan')
    planned.add_argument('room', metavar='ROOM', help='a scan, or the seed of a generated room')
    rig = planned.add_mutually_exclusive_group()
    rig.add_argument('--rig', type=find_config,
                     help='rig file with cameras and constraints: docs/reference/rig.md')
    rig.add_argument('--model', metavar='SENSOR', default='omnidirectional',
                     help='sensor of all cameras, or a part of its name such as d455')
    planned.add_argument('--mount', choices=('walls', 'ceiling', 'plane', 'free'),
                         help='mount of all cameras: walls (1.5 to 2.5 m above the floor), '
                              'ceiling (below it), plane (1.9 m above the floor) or free (1.5 to '
                              '2.5 m); default: walls, or the mount in the rig file')
    planned.add_argument('--cameras', '--count', dest='count', type=count, metavar='N',
                         help='number of cameras, or auto; default: 4, or the number in the rig '
                              'file')
    planned.add_argument('--target', type=share,
                         help='with auto: share to reach of what all candidates reach together; '
                              'default: 0.95')
    planned.add_argument('--by', choices=('error', 'seen', 'coverage'),
                         help='with auto: share of the error reduction, of the seen points or of '
                              'the space coverage')
    planned.add_argument('--most', type=cameras,
                         help='with auto: largest number of cameras; default: 12')
    planned.add_argument('--planner', default='rig_search', metavar='NAME',
                         help='planner that searches: rig_search (default) or a name of '
                         'docs/reference/planners.md, such as cma_es or lookahead')
    planned.add_argument('--seconds', type=seconds, help='seconds of search for each number of '
                                                         'cameras; default: 60, or 15 with auto; '
                                                         'without limit if --evaluations is given')
    planned.add_argument('--evaluations', type=at_least(1),
                         help='number of placements to evaluate; the same seed gives the same '
                              'result')
    planned.add_argument('--seed', type=seed, default=0, help='random seed')
    planned.add_argument('--out', type=Path, default=Path('out/plan'), metavar='DIR',
                         help='folder for report, placement, CSV, launch file, xacro and more')
    add_frame(planned)
    add_overwrite(planned)
    add_points(planned)
    add_reading(planned)
    planned.set_defaults(run=run, show=show)


def run(arguments: argparse.Namespace) -> Found:
    """Plan a rig in a room, and write the placement in all file formats."""
    from ocp_ros.cli.placement_files import written_to
    from ocp_ros.planning.rig_planning import PlannedRig
    from ocp_ros.report.exports import MARK, WRITTEN
    from ocp_ros.util.files import folder_to_write
    task = task_of(arguments)
    claim_folder(arguments, arguments.out, WRITTEN, MARK)
    rig = rig_asked(arguments)
    scene, room = room_asked(arguments, {})
    folder = folder_to_write(arguments.out)
    budget, proving = task.budgets()
    with _stopped_by_hand(budget), _progress(arguments.json) as progress:
        planned = PlannedRig(scene, rig, task, budget, proving, progress)
    placement = planned.placement(room, command_of(arguments.argv))
    with _kept(folder, placement) as files:
        judged = planned.judged(placement, arguments.frame)
        return {**judged.found,
                **written_to(files, judged, lambda aside: _curve(aside, judged.found),
                             arguments.frame_prefix, brief=budget.stopped)}


def task_of(arguments: argparse.Namespace) -> 'PlanTask':
    """Return the settings of the search from a command line."""
    from ocp_ros.planning.rig_planning import Counting, PlanTask
    for name in COUNTING:
        if getattr(arguments, name) is not None and arguments.count != 0:
            raise ConfigurationError(f'--{name}: found it without --count auto; expected it where '
                                     'cameras are counted; leave it out, or add --count auto')
    counting = Counting(*(default if getattr(arguments, name) is None else getattr(arguments, name)
                          for name, default in COUNTING.items()))
    return PlanTask(arguments.planner, arguments.seconds, arguments.evaluations, arguments.seed,
                    counting if arguments.count == 0 else None)


def _curve(folder: Path, found: Mapping[str, Any]) -> Iterator[Path]:
    """Draw the result for each number of cameras if they were counted; yield the file."""
    from ocp_ros.report.count_report import draw_curve
    from ocp_ros.report.exports import CURVE
    if 'curve' in found:
        yield draw_curve(folder / CURVE, found['curve'], found['count'])


@contextmanager
def _kept(folder: Path, placement: 'Placement') -> 'Iterator[FileSet]':
    """Write a placement first, so that a Ctrl-C during evaluation and drawing does not lose it."""
    from ocp_ros.report.exports import MARK, PLACEMENTS, WRITTEN
    from ocp_ros.rig.placement_file import save_placement
    from ocp_ros.util.files import FileSet
    try:
        with FileSet(folder, WRITTEN, MARK) as files:
            # If it cannot be written now, the final writing reports the error.
            with suppress(OSError):
                for name in PLACEMENTS:
                    save_placement(files.aside / name, placement)
            yield files
    except KeyboardInterrupt:
        print(f'ocp: stopped; the placement is in {printable(str(folder / PLACEMENTS[0]))}',
              file=sys.stderr)
        raise


def rig_asked(arguments: argparse.Namespace) -> 'Rig':
    """Return the rig of a command line; with ``auto``, a rig for counting cameras."""
    from ocp_ros.planning.rig_planning import CAMERAS, MOUNT
    from ocp_ros.rig.rig_file import load_rig, rig_of, with_count
    number = arguments.count
    if arguments.rig is None:
        rig = rig_of(number or CAMERAS, arguments.model, mount={'on': arguments.mount or MOUNT})
        return replace(rig, document=replace(rig.document, name='rig (no file)'))
    rig = load_rig(arguments.rig)
    if arguments.mount is not None:
        raise ConfigurationError(
            f'--mount: found {arguments.mount} with --rig; expected one of the two: the rig file '
            'says its mount; leave --mount out, or change the key mount of the file')
    return rig if number is None else with_count(rig, number or len(rig.cameras))


@contextmanager
def _stopped_by_hand(budget: 'Budget') -> Iterator[None]:
    """Stop the search at the first Ctrl-C, and the command at the second one."""
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
def _progress(silent: bool) -> Iterator[Callable[[float, float], None]]:
    """Show the progress as a bar or as lines; yield the function that reports it."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn
    console = Console(stderr=True)
    with Progress(TextColumn('{task.description}'), BarColumn(), TextColumn('{task.fields[loss]}'),
                  console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task('searching (Ctrl-C: best so far)', total=1.0, loss='')
        said = time.monotonic()

        def report(share: float, loss: float) -> None:
            nonlocal said
            value = '' if loss == math.inf else f'objective value {loss:.4f}'
            bar.update(task, completed=share, loss=value)
            if not (silent or console.is_terminal) and time.monotonic() - said >= SAID:
                said = time.monotonic()
                print(f'searching, {100.0 * min(share, 1.0):.0f} %: {value}', file=sys.stderr,
                      flush=True)
        yield report


def show(found: Found) -> None:
    """Print a plan and the names of the written files."""
    from ocp_ros.cli.placement_files import show_written
    from ocp_ros.report.verdict_tables import show_plan, WIDTH
    from rich.console import Console
    show_plan(Console(width=WIDTH), found)
    show_written(found)
    if found['search']['stopped']:
        print('stopped: no report was drawn; `ocp score ROOM PLACEMENT --out DIR` draws it')
