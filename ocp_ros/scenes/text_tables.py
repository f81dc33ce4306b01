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

#: NaN and inf as old programs for Windows write them.
WINDOWS_NONFINITE = re.compile(r'([+-]?)1\.#(QNAN|SNAN|IND|INF|NAN)0*')


class TableForm(NamedTuple):
    """
    The number format of a text file.

    :ivar separator: the separator between two numbers; None for blanks.
    :ivar decimal_comma: whether 1,5 is one and a half.
    :ivar skip: the number of lines before the numbers.
    :ivar columns: the indices of the columns to read.
    :ivar windows: whether NaN and inf are written as ``1.#QNAN`` and ``1.#INF``.
    """

    separator: str | None = None
    decimal_comma: bool = False
    skip: int = 0
    columns: Sequence[int] = (0, 1, 2)
    windows: bool = False

    def split(self, line: str) -> list[str]:
        """Return the cells of a line, without its comment."""
        plain = line if self.windows else line.partition('#')[0]
        cells = [cell.strip() for cell in plain.split(self.separator)]
        return [] if not any(cells) else cells

    def number(self, text: str) -> float:
        """Read a number."""
        if self.windows and (found := WINDOWS_NONFINITE.fullmatch(text)):
            return float('nan' if found[2] != 'INF' else f'{found[1]}inf')
        return float(text.replace(',', '.') if self.decimal_comma else text)

    @property
    def words(self) -> str:
        """Return the name of the separator."""
        return {None: 'blanks', ',': 'commas', ';': 'semicolons'}[self.separator]


def read_points(path: Path) -> np.ndarray:
    """
    Read x, y and z of a text file: (N, 3) float64.

    The numbers are separated by blanks, commas or semicolons; with semicolons, decimals may have a
    comma. The first line may name the columns, such as ``X,Y,Z,R,G,B``, ``x [m]`` or ``Points:0``;
    otherwise the first three columns are read. The first line may be the number of points instead.
    """
    _check_lines(path)
    form, count = _form_of(path)
    points = read_table(path, form)
    if count is not None and len(points) != count:
        raise SceneError(f'{path.name}: found {len(points):,} points; expected {count:,}, as its '
                         'first line says; copy or export it again')
    return points


def read_ptx_points(path: Path) -> np.ndarray:
    """
    Read all scans of a PTX file, each at its pose: (N, 3) float64.

    A scan has its numbers of columns and rows, the scanner's position and axes, a matrix (4, 4)
    that row vectors x y z 1 are multiplied with, and its points; 0 0 0 means no point.

    :raises ValueError: if the file is broken.
    """
    _check_lines(path)
    scans = []
    with path.open(encoding='latin-1') as file:
        while (line := file.readline()).strip():
            count = int(line) * int(file.readline())
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


def read_table(path: Path, form: TableForm) -> np.ndarray:
    """Read columns of a text file, (N, C) float64; ignore blank lines and comments after #."""
    slow = form.decimal_comma or form.windows
    converters: Callable[[str], float] | None = form.number if slow else None
    with warnings.catch_warnings():
        # A text without numbers is refused later with our own message.
        warnings.simplefilter('ignore', UserWarning)
        try:
            table = np.loadtxt(path, usecols=form.columns, skiprows=form.skip, encoding='latin-1',
                               ndmin=2, delimiter=form.separator, converters=converters,
                               comments=None if form.windows else '#')
        except ValueError as error:
            if not form.windows and _has_windows(path):
                return read_table(path, form._replace(windows=True))
            raise _bad_line(path, form) or error from None
    _check_last_line(path, form)
    return table


def _check_lines(path: Path) -> None:
    """Refuse a text with a line that is too long, before any line is parsed."""
    length = 0
    with path.open('rb') as file:
        max_line_bytes = 100_000
        while piece := file.read(1 << 20):
            first, *others = re.split(rb'[\r\n]', piece)
            longest = max([length + len(first), *map(len, others)])
            if longest > max_line_bytes:
                raise SceneError(f'{path.name}: found a line of more than {max_line_bytes:,} '
                                 'bytes; expected lines of numbers x y z; name the right file, or '
                                 'export it again')
            length = len(others[-1]) if others else length + len(first)


def _has_windows(path: Path) -> bool:
    """Return whether a text has NaN or inf as old Windows programs write them."""
    with path.open(encoding='latin-1') as file:
        return any(WINDOWS_NONFINITE.search(line) for line in file)


def _form_of(path: Path) -> tuple[TableForm, int | None]:
    """Return the number format of a text, and the number of points that it declares, or None."""
    with path.open(encoding='latin-1') as file:
        for number, line in enumerate(file, start=1):
            # CloudCompare writes the column names after two slashes.
            # Some UTF-8 files begin with a byte order mark.
            text = line.removeprefix('\xef\xbb\xbf')
            if not WINDOWS_NONFINITE.search(text):
                text = text.partition('#')[0]
            text = text.strip().removeprefix('//').strip()
            if text:
                after = next(file, '')
                if text.isdecimal() and len(after.split()) >= 3:
                    form = _form(after, number + 1, '', path.name)
                    return form._replace(skip=number), int(text)
                return _form(text, number, after, path.name), None
    return TableForm(), None


def _form(text: str, number: int, after: str, name: str) -> TableForm:
    """Return the format of a text, given its first line, its number, and the line after it."""
    separator = ';' if ';' in text else ',' if ',' in text else None
    # A unit may stand after the name of a column.
    names = [re.sub(r'\s*[\[(][^\])]*[\])]\s*$', '', cell.strip(' "\'\t').lower())
             for cell in text.split(separator)]
    if separator is None:
        # A unit after a blank, as in x [m], is not a column.
        names = [cell for cell in names if cell]
    if columns := _columns(names):
        return TableForm(separator, _decimal_comma(separator, after), number, columns)
    if len(names) >= 3 and all(cell[:1].isalpha() for cell in names):
        raise SceneError(
            f'{name}: found the names of columns {" ".join(names)[:80]!r} in line {number}, and '
            'not which of them are x, y and z; expected x, y and z among them; name the three '
            'columns of coordinates so')
    return TableForm(separator, _decimal_comma(separator, text))


def _columns(names: Sequence[str]) -> list[int] | None:
    """
    Find the columns of coordinates by their names.

    :returns: the indices of the columns x, y and z, or of three columns whose names differ only in
        these letters, such as ``pos_x``, ``pos_y`` and ``pos_z``, or of ``points_xyz:0`` to
        ``:2``; None if there are none.
    """
    known = list(names)
    for name in sorted(known, key=len):
        for at in [at for at, letter in enumerate(name) if letter == 'x']:
            three = [f'{name[:at]}{axis}{name[at + 1:]}' for axis in 'xyz']
            if all(one in known for one in three):
                return [known.index(one) for one in three]
    for name in known:
        base, colon, first = name.rpartition(':')
        three = [f'{base}:{number}' for number in range(3)]
        if (colon and first == '0' and re.search('xyz|point|pos|coord', base)
                and all(one in known for one in three)):
            return [known.index(one) for one in three]
    return None


def _decimal_comma(separator: str | None, line: str) -> bool:
    """Return whether a line with semicolons between its numbers has decimal commas."""
    return separator == ';' and bool(re.search(r'\d,\d', line))


def _bad_line(path: Path, form: TableForm) -> SceneError | None:
    """Find the first line that is not numbers; NumPy reports rows, not line numbers."""
    with path.open(encoding='latin-1') as file:
        for number, line in enumerate(file, start=1):
            values = form.split(line)
            try:
                if number > form.skip and values:
                    [form.number(values[column]) for column in form.columns]
            except (ValueError, IndexError):
                # After a header with the number of points, deleting a line would make that number
                # wrong.
                remedy = 'copy or export it again' if form.skip > 1 else (
                    'name the columns x, y and z, or put # before words that are no names'
                    if number == 1 else
                    f'correct the line or delete it: sed -i {number}d {path.name}')
                return SceneError(
                    f'{path.name}: found {line.strip()[:60]!r} in line {number}; expected numbers '
                    f'x y z separated by {form.words}; {remedy}')
    return None


def _check_last_line(path: Path, form: TableForm) -> None:
    """Refuse a file that is truncated within its last line, which may contain half a number."""
    with path.open('rb') as file:
        file.seek(max(path.stat().st_size - 4096, 0))
        tail = file.read()
    lines = tail.decode('latin-1').splitlines()
    if not tail.endswith(b'\n') and len(lines) > 1:
        found, expected = (len(form.split(line)) for line in (lines[-1], lines[-2]))
        if 0 < found < expected:
            raise SceneError(f'{path.name}: found {found} numbers in the last line; expected '
                             f'{expected} as in the line before; the file is truncated: copy or '
                             'export it again')
