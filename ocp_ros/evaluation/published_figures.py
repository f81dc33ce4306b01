# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Published figures: ``docs/figures.json`` holds each one, pages show them, and both have to agree.

In running text a marker that no reader sees stands right behind the number that it binds, and in a
table a line above it names the columns and a marker in the first cell names the row::

    it leaves 1.34<!--=default.test_rooms_m--> m

    <!--columns=other_cameras. policy_m greedy_coverage_m - p-->

    | cameras | the policy (m) | greedy coverage (m) | rooms | p |
    |---|---|---|---|---|
    | 1<!--row=1--> | 321.8 | 322.5 | 10 | 0.7 |

The second cell of that row shows ``other_cameras.1.policy_m``; a column named ``-`` shows none.
A number in the text is the value rounded to the digits shown. Where a value is a list, the marker
stands behind the last of as many numbers, or the cell has them all. A marker may have several keys
with spaces between, where they all have that value.

A figure that has ``from`` is not measured but follows from a file that a measurement has written:
``FILE#POINTER`` (RFC 6901), divided by ``over`` (a number, or another pointer) and less ``minus``;
with ``below`` it is in how many rooms the first is less than the other. Every entry of the tables
in :data:`TABLES` is a figure, without anybody recording it.
"""

from collections.abc import Iterator
from datetime import date
from decimal import Decimal
import json
from pathlib import Path
import re
import subprocess
from typing import Any, NamedTuple

from ocp_ros.util.files import write_atomically

FILE = Path('docs') / 'figures.json'
#: What every figure has; ``internal`` ones need no page.
FIELDS = ('value', 'unit', 'command', 'commit', 'date')
MORE = ('from', 'over', 'minus', 'below', 'internal')
KEY = re.compile(r'[a-z0-9_]+(\.[a-z0-9_]+)+')
NUMBER = re.compile(r'(?<![\w.])-?(?:\d{1,3}(?:,\d{3})+|\d+)(?:\.\d+)?(?:e-?\d+)?')
COMMENT = re.compile(r'<!--.*?-->')
BEHIND = re.compile(r'<!--=([^>]*?)-->')
TABLE = re.compile(r'^<!--columns=(\S*) ([^>]*?)-->\n\n?((?:\|.*\n)+)', re.M)
ROW = re.compile(r'<!--row=([^>]*?)-->')

#: Tables of ratios in files, by the keys' beginning: an entry ``fine.10000`` of the first makes
#: ``bench.f1.fine.10000``.
TABLES = {'bench.f1': 'docs/bench.json#/f1', 'bench.fused_f1': 'docs/bench.json#/fused_f1'}

Value = float | list[float]
Figures = dict[str, dict[str, Any]]


class FigureError(ValueError):
    """A figure that cannot be found, derived or recorded."""


class Shown(NamedTuple):
    """
    Where a page shows a figure.

    :ivar key: of the figure.
    :ivar line: of the page, from 1.
    :ivar numbers: the numbers in the text, as (first, behind the last) offsets.
    """

    key: str
    line: int
    numbers: list[tuple[int, int]]


def load(root: Path) -> Figures:
    """Return all figures of a source tree by key."""
    return json.loads((root / FILE).read_text())


def save(root: Path, figures: Figures) -> None:
    """Write all figures, a line for each, so that two changes seldom meet in one line."""
    lines = [f' {json.dumps(key)}: {json.dumps(figures[key], ensure_ascii=False)}'
             for key in sorted(figures)]
    write_atomically(root / FILE, '{\n' + ',\n'.join(lines) + '\n}\n')


def record(root: Path, key: str, value: Value, unit: str, command: str,
           internal: bool = False) -> None:
    """
    Keep what a script has measured, with today's date and the commit that is checked out.

    :param root: folder of the source tree.
    :param command: which measures it again.
    :param internal: whether no page has to show it; one that was internal stays so.
    :raises FigureError: if the key is none, or if the figure follows from a file.
    """
    figures = load(root)
    old = figures.get(key, {})
    if not KEY.fullmatch(key):
        raise FigureError(f'found the key {key!r}; expected small letters, digits and _ with dots '
                          'between; correct it')
    if 'from' in old:
        raise FigureError(f'{key}: follows from {old["from"]}; expected one that is measured; '
                          'measure that file again, then run tools/figures derive')
    figures[key] = {'value': value, 'unit': unit, 'command': command,
                    'commit': commit(root), 'date': date.today().isoformat()}
    if internal or old.get('internal'):
        figures[key]['internal'] = True
    save(root, figures)


def commit(root: Path, path: str | None = None) -> str:
    """Return the short hash of what is checked out, or of the last commit of a file."""
    command = ['git', '-C', str(root), 'log', '-1', '--format=%h']
    done = subprocess.run(command + (['--', path] if path else []), capture_output=True,
                          text=True, check=True)
    return done.stdout.strip()


def derive(root: Path) -> None:
    """Read again every figure that follows from a file, those that it has lately included."""
    figures = load(root)
    for key, address in entries(root).items():
        figures.setdefault(key, {'unit': '1', 'internal': True, 'from': address})
    for figure in figures.values():
        if 'from' in figure:
            figure |= derived(root, figure)
            path = figure['from'].partition('#')[0]
            # A file that was made of a page later says what commit that page was measured with.
            figure['commit'] = read(root, path).get('commit') or commit(root, path)
    save(root, figures)


def entries(root: Path) -> dict[str, str]:
    """Return the address of each entry of the :data:`TABLES` that there are, by its key."""
    addresses = {}
    for prefix, address in TABLES.items():
        path, _, name = address.partition('#/')
        for entry in read(root, path).get(name, {}):
            addresses[f'{prefix}.{entry}'] = f'{address}/{entry}'
    return addresses


def derived(root: Path, figure: dict[str, Any]) -> dict[str, Any]:
    """
    Return value, command and date of a figure that follows from a file.

    :raises FigureError: if the file does not have it.
    """
    value = found(root, figure['from'])
    if 'below' in figure:
        other = found(root, figure['below'])
        value = sum(value[room] < other[room] for room in value)
    if 'minus' in figure:
        value -= found(root, figure['minus'])
    if 'over' in figure:
        value /= found(root, figure['over']) if isinstance(figure['over'], str) \
            else figure['over']
    document = read(root, figure['from'].partition('#')[0])
    made = document.get('provenance', document)
    return {'value': value, 'command': made['command'], 'date': made['date'][:10]}


def read(root: Path, path: str) -> Any:
    """Return the content of a JSON file of the source tree."""
    try:
        return json.loads((root / path).read_text())
    except (OSError, ValueError) as error:
        raise FigureError(f'found no JSON in {path} ({error})') from error


def found(root: Path, address: str) -> Any:
    """
    Return what ``FILE#POINTER`` names.

    :raises FigureError: if there is nothing.
    """
    path, _, pointer = address.partition('#')
    value = read(root, path)
    try:
        for part in pointer.split('/')[1:]:
            value = value[int(part) if isinstance(value, list) else part]
    except (LookupError, TypeError, ValueError) as error:
        raise FigureError(f'found nothing at {address}; correct the pointer') from error
    return value


def agrees(text: str, value: float) -> bool:
    """Tell whether a number in a text is a value, rounded to the digits shown."""
    number = Decimal(text.replace(',', ''))
    unit = Decimal(1).scaleb(number.as_tuple().exponent)
    return 2 * abs(number - Decimal(str(value))) <= unit


def pages(root: Path) -> list[Path]:
    """Return all pages that may show figures."""
    return sorted([*root.glob('*.md'), *(root / 'docs').rglob('*.md'),
                   *(root / 'models').glob('*.md')])


def shown(text: str, figures: Figures) -> Iterator[Shown]:
    """
    Yield all places of a page where it shows a figure.

    :raises FigureError: if a table has a row without a name.
    """
    for marker in BEHIND.finditer(text):
        for key in marker.group(1).split():
            before = numbers_in(text, 0, marker.start())
            if before and text[before[-1][1]:marker.start()].strip('*'):
                before = []
            yield Shown(key, line_of(text, marker.start()), before[-count(figures.get(key)):])
    for table in TABLE.finditer(text):
        prefix, names, start = table.group(1), table.group(2).split(), table.start(3)
        rows = re.compile(r'.*\n').finditer(text, start, table.end(3))
        for row in list(rows)[2:]:
            yield from shown_in_row(text, row.span(), prefix, names)


def shown_in_row(text: str, row: tuple[int, int], prefix: str, names: list[str]
                 ) -> Iterator[Shown]:
    """Yield what the cells of a table's row show."""
    line = line_of(text, row[0])
    first, *cells = re.compile(r'[^|\n]+').finditer(text, *row)
    name = ROW.search(first.group())
    if name is None or len(cells) != len(names):
        raise FigureError(f'line {line}: found {len(cells)} cells in a row '
                          f'{"without" if name is None else "with"} a name; expected a name '
                          f'(<!--row=...-->) and {len(names)} cells, as the line above the table '
                          'says; correct one of them')
    for cell, column in zip(cells, names):
        if column != '-' and cell.group().strip():
            yield Shown(f'{prefix}{name.group(1)}.{column}', line, numbers_in(text, *cell.span()))


def numbers_in(text: str, start: int, end: int) -> list[tuple[int, int]]:
    """Return where numbers stand in a part of a text, those in markers left out."""
    part = COMMENT.sub(lambda comment: ' ' * len(comment.group()), text[start:end])
    return [(start + number.start(), start + number.end()) for number in NUMBER.finditer(part)]


def count(figure: dict[str, Any] | None) -> int:
    """Return how many numbers a figure has."""
    value = figure['value'] if figure else 0
    return len(value) if isinstance(value, list) else 1


def line_of(text: str, offset: int) -> int:
    """Return the line of a place in a text, from 1."""
    return text.count('\n', 0, offset) + 1


def unbound(text: str, figures: Figures) -> str:
    """Return a page without its markers and without the numbers that they bind."""
    kept = list(text)
    for place in shown(text, figures):
        for start, end in place.numbers:
            kept[start:end] = ' ' * (end - start)
    return COMMENT.sub('', ''.join(kept))


def faults(root: Path) -> list[str]:
    """Return a sentence for everything in which figures and pages differ."""
    figures, used, wrong = load(root), set(), []
    for key, figure in figures.items():
        wrong += [f'{FILE}: {key}: {fault}' for fault in faults_of(root, key, figure)]
    for path in pages(root):
        page, text = path.relative_to(root), path.read_text()
        try:
            for place in shown(text, figures):
                used.add(place.key)
                wrong += [f'{page}:{place.line}: {place.key}: {fault}'
                          for fault in faults_shown(text, place, figures.get(place.key))]
        except FigureError as error:
            wrong.append(f'{page}: {error}')
    return wrong + [f'{FILE}: {key}: found on no page; expected it on one, or "internal": true'
                    for key in figures if key not in used and not figures[key].get('internal')]


def faults_of(root: Path, key: str, figure: dict[str, Any]) -> Iterator[str]:
    """Yield what is wrong with a figure itself."""
    if not KEY.fullmatch(key):
        yield 'found letters that no key has; expected small letters, digits and _ with dots'
    if missing := [name for name in FIELDS if figure.get(name) in (None, '')]:
        yield f'found no {", ".join(missing)}; run tools/figures set'
    if strange := set(figure) - {*FIELDS, *MORE}:
        yield f'found {", ".join(sorted(strange))}; expected {", ".join((*FIELDS, *MORE))}'
    if 'from' in figure:
        try:
            differing = [name for name, value in derived(root, figure).items()
                         if value != figure.get(name)]
        except FigureError as error:
            yield str(error)
        else:
            if differing:
                yield f'found another {", ".join(differing)} in {figure["from"]}; run ' \
                    'tools/figures derive, and correct the pages'


def faults_shown(text: str, place: Shown, figure: dict[str, Any] | None) -> Iterator[str]:
    """Yield what is wrong with a figure where a page shows it."""
    if figure is None:
        yield f'found no such figure in {FILE}; record it with tools/figures set'
        return
    values = figure['value'] if isinstance(figure['value'], list) else [figure['value']]
    # A cell may say more than its figure: 6 of 10.
    numbers = [text[start:end] for start, end in place.numbers]
    if isinstance(figure['value'], list) and len(numbers) != len(values) \
            or len(numbers) < len(values):
        yield f'found {len(numbers)} numbers; expected {len(values)} right before the marker'
        return
    for number, value in zip(numbers, values):
        if not agrees(number, value):
            yield f'found {number}; expected {value}, rounded to the digits shown'
