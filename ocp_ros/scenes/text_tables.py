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

from collections.abc import Callable, Sequence
from pathlib import Path
import re
from typing import NamedTuple
import warnings

import numpy as np
from ocp_ros.scenes.scene import SceneError

#: NaN and inf as old programs for Windows write them, such as ``-1.#QNAN0``.
WINDOWS_NONFINITE = re.compile(r'([+-]?)1\.#(QNAN|SNAN|IND|INF|NAN)0*')


class TableFormat(NamedTuple):
    """
    The number format of a text file.

    :ivar separator: the text between two numbers; None for blanks.
    :ivar decimal_comma: whether 1,5 is one and a half.
    :ivar skipped_lines: the number of lines before the numbers.
    :ivar columns: the indices of the columns to read.
    :ivar windows_nonfinite: whether NaN and inf are written as ``1.#QNAN`` and ``1.#INF``.
    :ivar count: the number of points that the file declares; None if it declares none.
    """

    separator: str | None = None
    decimal_comma: bool = False
    skipped_lines: int = 0
    columns: Sequence[int] = (0, 1, 2)
    windows_nonfinite: bool = False
    count: int | None = None

    def split_cells(self, line: str) -> list[str]:
        """Return the cells of a line, without its comment; [] if all cells are empty."""
        # In ``1.#QNAN`` the # does not begin a comment.
        content = line if self.windows_nonfinite else line.partition('#')[0]
        cells = [cell.strip() for cell in content.split(self.separator)]
        return [] if not any(cells) else cells

    def parse_number(self, text: str) -> float:
        """Return the number that a cell contains."""
        if self.windows_nonfinite and (found := WINDOWS_NONFINITE.fullmatch(text)):
            return float('nan' if found[2] != 'INF' else f'{found[1]}inf')
        return float(text.replace(',', '.') if self.decimal_comma else text)

    @property
    def separator_name(self) -> str:
        """Return the name of the separator for messages."""
        return {None: 'blanks', ',': 'commas', ';': 'semicolons'}[self.separator]


def read_points(path: Path) -> np.ndarray:
    """
    Read the points in a text file: (N, 3) float64, x, y and z.

    The numbers are separated by blanks, commas or semicolons; with semicolons, decimals may have a
    comma. The first line may name the columns, such as ``X,Y,Z,R,G,B``, ``x [m]`` or ``Points:0``;
    otherwise the first three columns are read. The number of points may stand in a line before it.
    """
    _check_lines(path)
    table_format = _detect_format(path)
    points = read_table(path, table_format)
    if table_format.count not in (None, len(points)):
        raise SceneError(f'{path.name}: found {len(points):,} points; expected '
                         f'{table_format.count:,}, as its first line says; copy it again')
    return points


def read_ptx_points(path: Path) -> np.ndarray:
    """
    Read the points of all scans in a PTX file, each moved by its pose: (N, 3) float64.

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
            scans.append(points[points.any(axis=1)] @ matrix[:3, :3] + matrix[3, :3])
    if not scans:
        raise ValueError('no scan')
    return np.concatenate(scans)


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
            text = line.removeprefix('\xef\xbb\xbf')
            if not WINDOWS_NONFINITE.search(text):
                text = text.partition('#')[0]
            if text := text.strip().removeprefix('//').strip():
                first_lines.append((text, line_number))
            if len(first_lines) == 3:
                break
    # A single number before or after the names is the number of points.
    declared = next((line for line in first_lines[:2] if line[0].isdecimal()), None)
    others = [line for line in first_lines if line != declared]
    if not others:
        return TableFormat()
    table_format = _format_of_line(*others[0], others[1][0] if others[1:] else '', path.name)
    return table_format if declared is None else table_format._replace(
        count=int(declared[0]), skipped_lines=max(declared[1], table_format.skipped_lines))


def _format_of_line(first_line: str, line_number: int, next_line: str, name: str) -> TableFormat:
    """
    Return the format of a text file.

    :param first_line: its first line with content: numbers or the names of columns.
    :param line_number: the number of this line, from 1: the lines to skip if it has names.
    :param next_line: the line after it: the first line with numbers if it has names.
    :param name: the name of the file, for the error.
    :raises SceneError: if the line has names, but not those of x, y and z.
    """
    separator = ';' if ';' in first_line else ',' if ',' in first_line else None
    # A unit may stand after the name of a column.
    names = [re.sub(r'\s*[\[(][^\])]*[\])]\s*$', '', cell.strip(' "\'\t').lower())
             for cell in first_line.split(separator)]
    if separator is None:
        # A unit after a blank, as in x [m], is not a column.
        names = [cell for cell in names if cell]
    if columns := _coordinate_columns(names):
        return TableFormat(separator, _has_decimal_comma(separator, next_line), line_number,
                           columns)
    if len(names) >= 3 and all(cell[:1].isalpha() for cell in names):
        raise SceneError(
            f'{name}: found the names of columns {" ".join(names)[:80]!r} in line {line_number}, '
            'and not which of them are x, y and z; expected x, y and z among them; name the three '
            'columns of coordinates so')
    return TableFormat(separator, _has_decimal_comma(separator, first_line), line_number - 1)


def _coordinate_columns(names: Sequence[str]) -> list[int] | None:
    """
    Find the columns of coordinates by the names of all columns.

    :returns: the indices of the columns x, y and z; or of three columns whose names differ only in
        these letters, such as ``pos_x``, ``pos_y`` and ``pos_z``; or of columns such as
        ``points_xyz:0`` to ``points_xyz:2``; None if there are no such columns.
    """
    known = list(names)
    # For each x in a name: the names with x, y and z at its position; short names come first.
    triples = [[name[:position] + axis + name[position + 1:] for axis in 'xyz']
               for name in sorted(known, key=len)
               for position, letter in enumerate(name) if letter == 'x']
    # For each name such as points_xyz:0: the names with 0, 1 and 2.
    triples += [[f'{name[:-1]}{number}' for number in range(3)] for name in known
                if name.endswith(':0') and re.search('xyz|point|pos|coord', name)]
    return next(([known.index(name) for name in triple] for triple in triples
                 if all(name in known for name in triple)), None)


def _has_decimal_comma(separator: str | None, line: str) -> bool:
    """Return whether a line with semicolons between its numbers has decimal commas."""
    return separator == ';' and bool(re.search(r'\d,\d', line))


def _find_bad_line(path: Path, table_format: TableFormat) -> SceneError | None:
    """Return an error that names the first line without numbers; None if there is no such line."""
    with path.open(encoding='latin-1') as file:
        for line_number, line in enumerate(file, start=1):
            values = table_format.split_cells(line)
            try:
                # Parsing raises an error for the first bad cell.
                if line_number > table_format.skipped_lines and values:
                    [table_format.parse_number(values[column]) for column in table_format.columns]
            except (ValueError, IndexError):
                # A declared number of points would be wrong after a line is deleted.
                remedy = 'copy or export it again' if table_format.count is not None else (
                    'name the columns x, y and z, or put # before words that are no names'
                    if line_number == 1 else
                    f'correct the line or delete it: sed -i {line_number}d {path.name}')
                return SceneError(
                    f'{path.name}: found {line.strip()[:60]!r} in line {line_number}; expected '
                    f'numbers x y z separated by {table_format.separator_name}; {remedy}')
    return None


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
