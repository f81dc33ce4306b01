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

"""Facts of placements and rooms as tables and sentences on a terminal."""

from collections.abc import Callable, Iterable, Mapping, Sequence
import io
from itertools import repeat
from typing import Any

from ocp_ros.report.bill import BILL_COLUMNS, bill_rows
from ocp_ros.report.camera_words import INSTRUCTION_COLUMNS
from ocp_ros.report.facts import (
    count_sentence,
    details_of,
    facts_of,
    FRONT_COLUMNS,
    front_rows,
    metres,
    percent,
    quality_lines,
    REGION_COLUMNS,
    REQUIREMENT_COLUMNS,
    SHARE_LABELS,
)
from ocp_ros.report.room_facts import room_rows
from ocp_ros.util.files import printable
from rich.console import Console
from rich.markup import escape
from rich.table import Table

#: Width of the output, characters.
WIDTH = 100


def wide_console() -> Console:
    """Return a console of :data:`WIDTH` characters on the standard output."""
    return Console(width=WIDTH)


def as_text(show: Callable[[Console, Mapping[str, Any]], None], data: Mapping[str, Any]) -> str:
    """Return the output of a function such as :func:`show_score` for ``data`` as plain text."""
    text = io.StringIO()
    show(Console(width=WIDTH, file=text, force_terminal=False, color_system=None), data)
    return '\n'.join(line.rstrip() for line in text.getvalue().splitlines())


def print_table(console: Console, title: str | None, columns: Sequence[str],
                rows: Iterable[Sequence[str]], is_good: Iterable[bool] = ()) -> None:
    """
    Print a table; it has no head if the names of all columns are empty.

    :param is_good: for each row whether it is as it should be, the others are red; empty for all.
    """
    table = Table(title=title and escape(printable(title)), show_header=any(columns))
    for name in columns:
        table.add_column(escape(printable(name)), no_wrap=name == 'camera', overflow='fold')
    for row, good in zip(rows, is_good or repeat(True)):
        table.add_row(*(escape(printable(cell)) for cell in row), style=None if good else 'red')
    console.print(table)


def show_score(console: Console, findings: Mapping[str, Any]) -> None:
    """Print the findings on a placement, in the data of ``ocp score`` or ``ocp plan --json``."""
    facts = facts_of(findings)
    print_table(console, 'Cameras', (
        'camera', 'position (m)', 'yaw, pitch, roll', 'error reduction',
        'seen by this camera only'), facts.cameras)
    print_table(console, 'Key figures', ('', '', ''), facts.figures)
    if facts.regions:
        print_table(console, 'Regions', REGION_COLUMNS, facts.regions)
    if facts.rooms:
        print_table(console, 'Rooms', facts.room_columns, *zip(*facts.rooms))
    if facts.requirements:
        print_table(console, 'Requirements', REQUIREMENT_COLUMNS, facts.requirements)
    print_table(console, 'Bill of materials', BILL_COLUMNS, bill_rows(findings['bill']))
    for line in filter(None, [*details_of(findings), facts.links]):
        console.print(line)
    console.print(facts.verdict + (':' if findings['broken'] else ''))
    for sentence in findings['broken']:
        console.print(f'  {sentence}', style='red', markup=False, highlight=False)
    show_notes(console, findings)
    if 'installer' in findings:
        columns = [name for name in INSTRUCTION_COLUMNS if name != 'sensor']
        print_table(console, 'How to mount the cameras', ('', *columns), [
            (row['number'], *(row[name] for name in columns))
            for row in findings['installer']])
    for line in quality_lines(findings):
        console.print(line, highlight=False)
    if 'curve' in findings:
        shares = [column for column, _ in SHARE_LABELS.values()]
        print_table(console, 'Number of cameras', (
            'cameras', 'objective value', 'depth error', *shares), [
            (str(row['cameras']), f'{row["loss"]:.4f}', metres(row['depth_error']),
             *(percent(row[f'share_{name}']) for name in SHARE_LABELS))
            for row in findings['curve']])
        if rows := front_rows(findings):
            print_table(console, 'Price', FRONT_COLUMNS, rows)
        console.print(count_sentence(findings['count']), highlight=False)


def show_room(console: Console, facts: Mapping[str, Any]) -> None:
    """Print the facts of a room, in the data of ``ocp info --json``."""
    print_table(console, None, ('room', facts['name']), room_rows(facts))
    show_notes(console, facts)


def show_notes(console: Console, data: Mapping[str, Any]) -> None:
    """Print corrections of the scan, and doubts about a room or a result."""
    for remark in data.get('remarks', ()):
        console.print(remark, markup=False, highlight=False)
    for note in data['notes']:
        console.print(f'note: {note}', style='yellow', markup=False, highlight=False)
