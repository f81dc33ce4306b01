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

"""Text files of numbers, with errors that name the line."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
import csv
from itertools import chain, combinations, islice, product
from pathlib import Path
import re
from typing import NamedTuple
import warnings

import numpy as np
from ocp_ros.scenes.scene import Scan, SceneError

#: A number with a separator of thousands, such as ``3,659.7``, ``3.659,7``, ``3'659`` or, in its
#: own cell, ``3 659``.
THOUSANDS = re.compile(r"\d[,.]\d{3}[,.]\d|\d['\u2019_\u00a0\u202f]\d{3}(?!\d)")
#: Names of the columns of coordinates in tables of surveyors.
SURVEY_NAMES = (('e', 'east', 'easting', 'eastings', 'rechts', 'rechtswert'),
                ('n', 'north', 'northing', 'northings', 'hoch', 'hochwert'),
                ('z', 'h', 'elev', 'elevation', 'height', 'altitude', 'up', 'höhe', 'hoehe'))
#: NaN and inf as old programs for Windows write them, such as ``-1.#QNAN0``.
WINDOWS_NONFINITE = re.compile(r'([+-]?)1\.#(QNAN|SNAN|IND|INF|NAN)0*')


class TableFormat(NamedTuple):
    """
    The number format of a text file.

    :ivar separator: the text between two numbers; None for blanks and tabs.
    :ivar decimal_comma: whether 1,5 is one and a half.
    :ivar skipped_lines: the number of lines before the numbers.
    :ivar columns: the indices of the columns to read.
    :ivar has_names: whether a line names the columns.
    :ivar windows_nonfinite: whether NaN and inf are written as ``1.#QNAN`` and ``1.#INF``.
    :ivar count: the number of points that the file declares; None if it declares none.
    :ivar is_quoted: whether cells are in quotes.
    """

    separator: str | None = None
    decimal_comma: bool = False
    skipped_lines: int = 0
    columns: Sequence[int] = (0, 1, 2)
    has_names: bool = False
    windows_nonfinite: bool = False
    count: int | None = None
    is_quoted: bool = False

    def split_cells(self, line: str) -> list[str]:
        """Return the cells of a line, without its comment; [] if all cells are empty."""
        # In ``1.#QNAN`` the # does not begin a comment.
        content = line if self.windows_nonfinite else line.partition('#')[0]
        cells = (next(csv.reader([content.strip()], delimiter=self.separator), [])
                 if self.is_quoted else content.split(self.separator))
        cells = [cell.strip() for cell in cells]
        return [] if not any(cells) else cells

    def parse_number(self, text: str) -> float:
        """Return the number that a cell contains."""
        if self.windows_nonfinite and (found := WINDOWS_NONFINITE.fullmatch(text)):
            return float('nan' if found[2] != 'INF' else f'{found[1]}inf')
        # Python reads 1_000 as a number.
        return float((text.replace(',', '.') if self.decimal_comma else text).replace('_', ' '))

    @property
    def separator_name(self) -> str:
        """Return the name of the separator for messages."""
        return {None: 'blanks', '\t': 'tabs', ',': 'commas', ';': 'semicolons'}[self.separator]


def read_points(path: Path) -> np.ndarray:
    """
    Read the points in a text file: (N, 3) float64, x, y and z.

    The numbers are separated by blanks, commas or semicolons; unless commas separate them,
    decimals may have a comma. The first line may name the columns, such as ``X,Y,Z,R,G,B``,
    ``x [m]``, ``Points:0`` or ``P,N,E,Z,D``; otherwise the first three columns are read, and
    refused if they are no coordinates. The number of points may stand in a line before it.
    """
    _check_lines(path)
    table_format = _detect_format(path)
    _check_columns(path, table_format)
    points = read_table(path, table_format)
    if table_format.count not in (None, len(points)):
        raise SceneError(f'{path.name}: found {len(points):,} points; expected '
                         f'{table_format.count:,}, as its first line says; copy it again')
    return points


def read_ptx_scans(path: Path) -> list[Scan]:
    """
    Read all scans in a PTX file, each moved by its pose; float64.

    A scan consists of its number of columns, its number of rows, the position and the axes of the
    scanner, a matrix (4, 4), and its points, of which 0 0 0 means no point. Row vectors x y z 1
    are multiplied by the matrix.

    :raises ValueError: if the file is broken.
    """
    _check_lines(path)
    scans = []
    with path.open(encoding='latin-1') as file:
        while (line := file.readline()).strip():
            count = int(line) * int(file.readline())
            # A point takes more than a byte.
            if not 0 < count <= path.stat().st_size:
                raise ValueError(f'a scan of {count:,} points')
            header = np.loadtxt(file, max_rows=4, ndmin=2)
            matrix = np.loadtxt(file, max_rows=4, ndmin=2)
            if header.shape != (4, 3) or matrix.shape != (4, 4):
                raise ValueError('no place and matrix before the points of a scan')
            points = np.loadtxt(file, max_rows=count, usecols=(0, 1, 2), ndmin=2)
            if len(points) != count:
                raise ValueError(f'{len(points):,} of {count:,} points')
            scans.append(Scan(matrix[3, :3],
                              points[points.any(axis=1)] @ matrix[:3, :3] + matrix[3, :3]))
    if not scans:
        raise ValueError('no scan')
    return scans


def read_table(path: Path, table_format: TableFormat) -> np.ndarray:
    """Read the columns of a text file that a format names: (N, C) float64, without comments."""
    needs_parser = table_format.decimal_comma or table_format.windows_nonfinite
    converters: Callable[[str], float] | None = table_format.parse_number if needs_parser else None
    with warnings.catch_warnings():
        # A text without numbers is refused later with our own message.
        warnings.simplefilter('ignore', UserWarning)
        try:
            table = np.loadtxt(
                path, usecols=table_format.columns, skiprows=table_format.skipped_lines,
                encoding='latin-1', ndmin=2, delimiter=table_format.separator,
                quotechar='"' if table_format.is_quoted else None,
                converters=converters, comments=None if table_format.windows_nonfinite else '#')
        except ValueError as error:
            if not table_format.windows_nonfinite and _has_windows_numbers(path):
                return read_table(path, table_format._replace(windows_nonfinite=True))
            raise (_find_bad_line(path, table_format) or error) from None
    _check_last_line(path, table_format)
    return table


def _check_lines(path: Path) -> None:
    """Refuse a text file with a line that is too long, before any line is parsed."""
    # The length of the last line of a block, which the next block continues.
    open_bytes = 0
    with path.open('rb') as file:
        max_line_bytes = 100_000
        while block := file.read(1 << 20):
            first_part, *other_parts = re.split(rb'[\r\n]', block)
            longest = max([open_bytes + len(first_part), *map(len, other_parts)])
            if longest > max_line_bytes:
                raise SceneError(f'{path.name}: found a line of more than {max_line_bytes:,} '
                                 'bytes; expected lines of numbers x y z; name the right file, or '
                                 'export it again')
            open_bytes = len(other_parts[-1]) if other_parts else open_bytes + len(first_part)


def _has_windows_numbers(path: Path) -> bool:
    """Return whether a text file has NaN or inf as old Windows programs write them."""
    with path.open(encoding='latin-1') as file:
        return any(WINDOWS_NONFINITE.search(line) for line in file)


def _detect_format(path: Path) -> TableFormat:
    """Return the format of a text file; the default format if it has no content."""
    # The texts and numbers of the first lines with content: names, a number of points, and points.
    first_lines: list[tuple[str, int]] = []
    with path.open(encoding='latin-1') as file:
        for line_number, line in enumerate(file, start=1):
            # Some UTF-8 files begin with a byte order mark. CloudCompare writes the column names
            # after two slashes.
            text = _as_utf8(line).removeprefix('\ufeff')
            if not WINDOWS_NONFINITE.search(text):
                text = text.partition('#')[0]
            text = text.strip(' \r\n').removeprefix('//').strip(' ')
            if text.strip():
                first_lines.append((text, line_number))
            if len(first_lines) == 20:
                break
    # A single number before or after the names is the number of points.
    declared = next((line for line in first_lines[:2] if line[0].strip().isdecimal()),
                    None)
    others = [line for line in first_lines if line != declared]
    if not others:
        return TableFormat()
    table_format = _format_of_lines(others, path.name)
    return table_format if declared is None else table_format._replace(
        count=int(declared[0]), skipped_lines=max(declared[1], table_format.skipped_lines))


def _format_of_lines(lines: Sequence[tuple[str, int]], name: str) -> TableFormat:
    """
    Return the format of a text file.

    :param lines: its first lines with content, and their numbers from 1; the first one may have
        the names of columns.
    :param name: the name of the file, for the error.
    :raises SceneError: if the first line has names, but not those of x, y and z.
    """
    first_line, line_number = lines[0]
    rows = [line for line, _ in lines[1:] or lines]
    # Between blanks, commas belong to the numbers.
    has_blanks = [bool(re.fullmatch(r'[-+]?[\d.,]*\d(?:[eE][-+]?\d+)?', cell))
                  for cell in first_line.split()[:3]] == [True] * 3
    separator = ';' if ';' in first_line else (
        ',' if ',' in first_line and not has_blanks else '\t' if _are_tabbed(rows) else None)
    is_quoted = separator is not None and any('"' in row for row in rows) and not any(
        row.count('"') % 2 for row in rows)
    decimal = r'"[-+]?\d*,\d+"' if separator == ',' else r'\d,\d'
    has_decimal_comma = any(re.search(decimal, line) for line, _ in lines)
    # A unit may stand after the name of a column.
    # No name is longer; the time of the search for a unit grows with the square of the length.
    names = [re.sub(r'\s*[\[(][^\])]*[\])]\s*$', '', cell.strip(' "\'\t')[:100].lower())
             for cell in first_line.split(separator)]
    if separator is None:
        # A unit after a blank, as in x [m], is not a column.
        names = [cell for cell in names if cell]
    # Numbers that count the columns are names too, also below an empty name of the rows.
    first_column = int(names[0] == '')
    if names[first_column:] == [str(number) for number in range(max(
            len(names) - first_column, 3))] and '.' in rows[0]:
        names[first_column:first_column + 3] = 'xyz'
    if columns := _coordinate_columns(names):
        return TableFormat(separator, has_decimal_comma, line_number, columns, has_names=True,
                           is_quoted=is_quoted)
    if len(names) >= 3 and all(cell[:1].isalpha() for cell in names) and '=' not in first_line:
        degrees = set(names) & {'lon', 'long', 'longitude', 'lat', 'latitude'}
        raise SceneError(
            f'{name}: found the names of columns {" ".join(names)[:80]!r} in line {line_number}, '
            'and not which of them are x, y and z; expected x, y and z among them; '
            + ('export coordinates in metres, such as UTM, not degrees' if degrees else
               'name the three columns of coordinates so'))
    return TableFormat(separator, has_decimal_comma, line_number - 1, is_quoted=is_quoted)


def _are_tabbed(rows: Sequence[str]) -> bool:
    """Return whether each tab in lines ends a cell: not in pairs, nor among blanks."""
    cells = [cell.strip() for row in rows for cell in row.split('\t')]
    return (min(row.count('\t') for row in rows) >= 2 and not rows[0].startswith('\t')
            and 2 * sum('\t\t' in row for row in rows) < len(rows)
            and all(re.fullmatch(r'\S*|[-+]?\d{1,3}(?:[ \u00a0\u202f]\d{3})+\S*', cell)
                    for cell in cells))


def _as_utf8(line: str) -> str:
    """Return a line, which was decoded as Latin-1, decoded as UTF-8 if it can be."""
    try:
        return line.encode('latin-1').decode('utf-8')
    except UnicodeDecodeError:
        return line


def _check_columns(path: Path, table_format: TableFormat) -> None:
    """Refuse a text file whose numbers or first columns, by a sample, are no coordinates."""
    pairs = [[table_format.split_cells(line) for line in lines] for lines in _sample_lines(path)]
    pairs = [pair for pair in pairs if all(pair)]
    rows = [row for pair in pairs for row in pair]
    if cause := _cause_of_separators(rows, table_format):
        raise SceneError(f'{path.name}: found {cause}')
    # The columns of three numbers are x, y and z.
    counts = Counter(map(len, rows))
    count = min(counts.most_common(1)[0][0], 12) if counts else 0
    if table_format.has_names or count < 3:
        return
    # Later columns, and more than 30 characters, say nothing of coordinates.
    cells = np.array([[[cell[:30] for cell in row[:count]] for row in pair] for pair in pairs
                      if min(map(len, pair)) >= count], dtype=str)
    found, names = _other_columns(cells, table_format) if count > 3 and len(cells) else ('', [])
    if found:
        header = (table_format.separator or ' ').join(names)
        raise SceneError(
            f'{path.name}: found {found}; expected x, y and z in the first three columns, or a '
            f"first line that names the columns; insert one: sed -i '1i {header}' {path.name}, "
            'with the names in their order')
    # Lines of different widths, of which each has its share.
    groups = {width: np.nan_to_num([[_number_or_nan(cell, table_format) for cell in row]
                                    for row in rows if len(row) == width])
              for width, number in counts.items() if width >= 3 and number >= 0.02 * len(rows)}
    for short, long in combinations(sorted(groups), 2):
        own, first, shifted = (
            np.quantile(columns[:, :3], (0.1, 0.5, 0.9), axis=0) for columns in (
                groups[short], groups[long], groups[long][:, long - short:]))
        if abs(own - shifted).sum() < 0.5 * abs(own - first).sum():
            raise SceneError(
                f'{path.name}: found lines of {short} and of {long} numbers, the longer ones with '
                f'coordinates in columns {long - short + 1} to {long - short + 3}; expected x, y '
                'and z in the first three columns; export it again with equal lines')


def _cause_of_separators(rows: Sequence[Sequence[str]], table_format: TableFormat) -> str:
    """
    Describe points or commas that separate thousands, or commas that are decimals too.

    :param rows: the cells of some lines.
    :returns: what was found, what was expected and what to do; '' if nothing is wrong.
    """
    # Whole thousands have no decimals, so they look like decimals.
    mark = ',' if table_format.decimal_comma else '.'
    for column in table_format.columns:
        numbers = [row[column] for row in rows if column < len(row)]
        marked = [number for number in numbers if mark in number]
        if marked and all(re.fullmatch(rf'[-+]?\d{{1,3}}\{mark}\d{{3}}', number)
                          for number in marked) and any(
                              re.fullmatch(r'[-+]?\d{3}', number) for number in numbers):
            return (f'{marked[0]!r} beside numbers without {mark!r}, which looks like thousands; '
                    'expected decimals; export it without separators of thousands')
    if table_format.separator != ',' or table_format.is_quoted or not rows:
        return ''
    # With commas between the numbers too, lines with more thousands have more cells.
    least = min(map(len, rows))
    longer = [','.join(row) for row in rows if len(row) > least]
    found = f'{",".join(rows[0])[:40]!r}, with commas between numbers and within them; expected'
    if len(longer) > 0.05 * len(rows) and all(
            re.search(r'(?:^|,)[-+]?\d{1,3},\d{3}(?:[.,]|$)', line) for line in longer):
        return f'{found} other separators; export it without separators of thousands'
    # With decimal commas, each second cell has as many digits in all lines.
    if least >= 6 and all(re.fullmatch(r'[-+]?\d+', row[column]) for row in rows
                          for column in (0, 2, 4)) and all(
            {re.fullmatch(r'\d{1,8}', row[column]) and len(row[column]) for row in rows}
            == {len(rows[0][column])} for column in (1, 3, 5)):
        return f'{found} one of the two; export it with decimal points, or with semicolons'
    return ''


def _sample_lines(path: Path) -> Iterator[list[str]]:
    """Yield pairs of successive whole lines of a text file, from all over it."""
    pair_count = 200
    file_bytes = path.stat().st_size
    with path.open('rb') as file:
        for start in range(0, file_bytes, max(file_bytes // pair_count, 1)):
            file.seek(start)
            # The seek may have ended within a line.
            file.readline()
            pair = [file.readline() for _ in range(2)]
            if all(line.endswith(b'\n') for line in pair):
                yield [line.decode('latin-1') for line in pair]


def _other_columns(cells: np.ndarray, table_format: TableFormat) -> tuple[str, list[str]]:
    """
    Describe the first columns of a text file if they are no coordinates.

    :param cells: (P, 2, C) text of C columns in P pairs of successive lines.
    :returns: the description, '' if they may be coordinates; and names for the columns.
    """
    rows = np.array([[_number_or_nan(cell, table_format) for cell in row]
                     for row in cells.reshape(-1, cells.shape[2]).tolist()])
    is_whole = (rows == np.round(rows)).all(axis=0)
    # The number of whole columns before the first one that is not.
    whole_count = int(np.argmin(is_whole)) if not is_whole.all() else 0
    coordinates = ['x', 'y', 'z']
    if np.isnan(rows[:, 0]).all() and np.isfinite(rows[:, 1:4]).all():
        return f'words such as {str(cells[0, 0, 0])!r} in the first column', ['name', *coordinates]
    steps = np.diff(rows[:, 0].reshape(-1, 2))
    if is_whole[0] and steps[0] and (steps == steps[0]).all() and (
            np.diff(rows[::2, 0]) * steps[0] >= 0.0).all():
        return ('the number of the point in the first column (if northings come before eastings, '
                'their names are n and e)'), ['id', *coordinates]
    # No coordinate in metres or millimetres is as large as a time in seconds since 1970, or grows
    # evenly, as no column of points that are sorted by it does.
    if rows[:, 0].min() > 1e8 and abs(rows[:, 1:4]).max() < 1e5 or (
            not is_whole[0] and steps.min() > 0.0 and np.ptp(steps) < np.median(steps)
            and (np.diff(rows[::2, 0]) >= 0.0).all()):
        return 'times in the first column', ['t', *coordinates]
    # Leading columns with numbers of a byte, or of 0 to 1, and the three columns after them.
    for highest, is_full in ((255.0, True), (1.0, False)):
        is_colour = ((rows >= 0.0) & (rows <= highest)).all(axis=0) & (is_whole | (not is_full))
        leading = min(int(np.argmin(np.append(is_colour, False))), rows.shape[1] - 3)
        after = slice(leading, leading + 3)
        if leading >= 3 and not is_colour[after].all() and (
                is_full or not is_whole[after].any() and abs(rows[:, after]).max() > 1.5):
            return (f'{"whole " * is_full}numbers of 0 to {highest:g} in columns 1 to {leading}, '
                    'like colours'), [*'rgb', *'abcdef'[:leading - 3], *coordinates]
        if is_full and 0 < leading < 3 and is_whole.all() and np.ptp(
                rows[:, after], axis=0).min() > 1000.0:
            whole_count = leading
    if rows.shape[1] >= 6 and (abs(np.linalg.norm(rows[:, :3], axis=1) - 1.0) < 0.02).all():
        return 'vectors of length 1 in columns 1 to 3, like normals', [
            'nx', 'ny', 'nz', *coordinates]
    # A time may follow, which grows.
    if 0 < whole_count < rows.shape[1] - 3 and (np.diff(rows[::2, whole_count]) >= 0.0).all():
        whole_count += 1
    following = rows[:, whole_count:whole_count + 3]
    if whole_count and following.shape[1] == 3 and abs(following).max() > 1.0 and (
            is_whole.all() or not is_whole[whole_count:whole_count + 3].any()):
        return (f'whole numbers or times before the coordinates, in column'
                f'{"s 1 to" * (whole_count > 1)} {whole_count}, like intensities or rows of a '
                'grid'), [*'abcdefghi'[:whole_count], *coordinates]
    return '', []


def _number_or_nan(cell: str, table_format: TableFormat) -> float:
    """Return the number in a cell, NaN if it has none."""
    try:
        return table_format.parse_number(cell)
    except ValueError:
        return float('nan')


def _coordinate_columns(names: Sequence[str]) -> list[int] | None:
    """
    Find the columns of coordinates by the names of all columns.

    :returns: the indices of the columns x, y and z; or of three columns whose names differ only in
        these letters, such as ``pos_x``, ``pos_y`` and ``pos_z``; or of columns such as
        ``points_xyz:0`` to ``points_xyz:2``, or easting, northing and elevation; None if there are
        no such columns.
    """
    # The names in their order, as keys, which are found fast: a line may have many.
    known = dict.fromkeys(names)
    # For each x in a name: the names with x, y and z at its position; short names come first.
    triples: Iterator[Sequence[str]] = chain(
        ([name[:position] + axis + name[position + 1:] for axis in 'xyz']
         for name in sorted(known, key=len) for position, letter in enumerate(name)
         if letter == 'x'),
        # For each name such as points_xyz:0: the names with 0, 1 and 2.
        ([f'{name[:-1]}{number}' for number in range(3)] for name in known
         if name.endswith(':0') and re.search('xyz|point|pos|coord', name)),
        product(*SURVEY_NAMES))
    return next(([names.index(name) for name in triple] for triple in triples
                 if known.keys() >= set(triple)), None)


def _find_bad_line(path: Path, table_format: TableFormat) -> SceneError | None:
    """Return an error that names the first line without numbers; None if there is no such line."""
    with path.open(encoding='latin-1') as file:
        for line_number, line in enumerate(file, start=1):
            if line_number <= table_format.skipped_lines or _is_good_line(line, table_format):
                continue
            # Some files are UTF-8.
            line = _as_utf8(line)
            cells = table_format.split_cells(line)
            others = [_is_good_line(other, table_format) for other in islice(file, 10_000)]
            if THOUSANDS.search(' '.join(cells)) or table_format.separator and any(
                    re.fullmatch(r'[-+]?\d{1,3}(?: \d{3})+(?:[.,]\d+)?', cell) for cell in cells):
                remedy = 'export it without separators of thousands'
            elif table_format.count is not None:
                # A declared number of points would be wrong after a line is deleted.
                remedy = 'copy or export it again'
            elif others.count(False) > 0.9 * len(others):
                remedy = 'other lines are such too: export it again as lines of numbers alone'
            elif others.count(False):
                remedy = (f'{others.count(False):,} of the next lines are such too: export it '
                          'again with x, y and z in each line')
            elif line_number == 1:
                remedy = 'name the columns x, y and z, or put # before words that are no names'
            else:
                remedy = f'correct the line or delete it: sed -i {line_number}d {path.name}'
            return SceneError(
                f'{path.name}: found {line.strip()[:60]!r} in line {line_number}; expected '
                f'numbers x y z separated by {table_format.separator_name}; {remedy}')
    return None


def _is_good_line(line: str, table_format: TableFormat) -> bool:
    """Return whether a line has numbers in the columns of coordinates, or no content."""
    values = table_format.split_cells(line)
    try:
        # Parsing raises an error for the first bad cell.
        return not values or bool(
            [table_format.parse_number(values[column]) for column in table_format.columns])
    except (ValueError, IndexError):
        return False


def _check_last_line(path: Path, table_format: TableFormat) -> None:
    """Refuse a file that is truncated within its last line, which may contain half a number."""
    with path.open('rb') as file:
        file.seek(max(path.stat().st_size - 4096, 0))
        file_end = file.read()
    lines = file_end.decode('latin-1').splitlines()
    if not file_end.endswith(b'\n') and len(lines) > 1:
        found, expected = (len(table_format.split_cells(line)) for line in (lines[-1], lines[-2]))
        if 0 < found < expected:
            raise SceneError(f'{path.name}: found {found} numbers in the last line; expected '
                             f'{expected} as in the line before; the file is truncated: '
                             'copy or export it again')
