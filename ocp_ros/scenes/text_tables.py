# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Text files of numbers, with errors that name the line."""

from collections.abc import Callable, Sequence
from pathlib import Path
import re
from typing import NamedTuple
import warnings

import numpy as np

from ocp_ros.scenes.scene import SceneError

#: Bytes of the longest line, and that are read at once.
LONGEST, PIECE = 100_000, 1 << 20
#: What UTF-8 files of some programs begin with, read as Latin-1.
MARK = b'\xef\xbb\xbf'.decode('latin-1')


class TableForm(NamedTuple):
    """
    How a text writes its numbers.

    :ivar separator: between two numbers; None for blanks.
    :ivar decimal_comma: whether 1,5 is one and a half.
    :ivar skip: lines before the numbers.
    :ivar columns: numbers of those wanted.
    """

    separator: str | None = None
    decimal_comma: bool = False
    skip: int = 0
    columns: Sequence[int] = (0, 1, 2)

    def split(self, line: str) -> list[str]:
        """Return what stands between the separators of a line, without its comment."""
        cells = [cell.strip() for cell in line.partition('#')[0].split(self.separator)]
        return [] if not any(cells) else cells

    def number(self, text: str) -> float:
        """Read a number."""
        return float(text.replace(',', '.') if self.decimal_comma else text)

    @property
    def words(self) -> str:
        """Say how the numbers are separated."""
        return {None: 'blanks', ',': 'commas', ';': 'semicolons'}[self.separator]


def read_points(path: Path) -> np.ndarray:
    """
    Read x, y and z of a text file: (N, 3) float64.

    They are separated by blanks, commas, or semicolons, with which decimals may have a comma. A
    first line may name the columns, such as ``X,Y,Z,R,G,B``; without it they are the first three.
    """
    _check_lines(path)
    return read_table(path, form_of(path))


def read_table(path: Path, form: TableForm) -> np.ndarray:
    """Read columns of a text file: (N, C) float64; blank lines and what follows # do not count."""
    converters: Callable[[str], float] | None = form.number if form.decimal_comma else None
    with warnings.catch_warnings():
        # A text without a line of numbers is refused later, in our words.
        warnings.simplefilter('ignore', UserWarning)
        try:
            table = np.loadtxt(path, usecols=form.columns, skiprows=form.skip, encoding='latin-1',
                               ndmin=2, delimiter=form.separator, converters=converters)
        except ValueError as error:
            raise _bad_line(path, form) or error from None
    _check_last_line(path, form)
    return table


def _check_lines(path: Path) -> None:
    """Refuse a text with a line that is too long to be one, before a line of it is read."""
    length = 0
    with path.open('rb') as file:
        while piece := file.read(PIECE):
            first, *others = re.split(rb'[\r\n]', piece)
            longest = max([length + len(first), *map(len, others)])
            if longest > LONGEST:
                raise SceneError(f'{path.name}: found a line of more than {LONGEST:,} bytes; '
                                 'expected lines of numbers x y z; name the right file, or '
                                 'export it again')
            length = len(others[-1]) if others else length + len(first)


def form_of(path: Path) -> TableForm:
    """Find out how a text writes its numbers: by its first line that is not empty."""
    with path.open(encoding='latin-1') as file:
        for number, line in enumerate(file, start=1):
            # CloudCompare writes its names of columns behind two slashes.
            text = line.partition('#')[0].removeprefix(MARK).strip().removeprefix('//')
            if text:
                return _form(text, number, next(file, ''))
    return TableForm()


def _form(text: str, number: int, after: str) -> TableForm:
    """Return the form of a text by its first line, which has some number, and the line after."""
    separator = ';' if ';' in text else ',' if ',' in text else None
    names = [cell.strip(' "\'\t').lower() for cell in text.split(separator)]
    if all(axis in names for axis in 'xyz'):
        return TableForm(separator, _decimal_comma(separator, after), number,
                         [names.index(axis) for axis in 'xyz'])
    return TableForm(separator, _decimal_comma(separator, text))


def _decimal_comma(separator: str | None, line: str) -> bool:
    """Tell whether a line between whose numbers are semicolons has commas within them."""
    return separator == ';' and bool(re.search(r'\d,\d', line))


def _bad_line(path: Path, form: TableForm) -> SceneError | None:
    """Find the first line that is not numbers: NumPy counts rows, which nobody can look up."""
    with path.open(encoding='latin-1') as file:
        for number, line in enumerate(file, start=1):
            values = form.split(line)
            try:
                if number > form.skip and values:
                    [form.number(values[column]) for column in form.columns]
            except (ValueError, IndexError):
                # A header that counts the points would not agree with a line less.
                remedy = 'copy or export it again' if form.skip > 1 else (
                    f'correct the line or delete it: sed -i {number}d {path.name}')
                return SceneError(
                    f'{path.name}: found {line.strip()[:60]!r} in line {number}; expected numbers '
                    f'x y z separated by {form.words}; {remedy}')
    return None


def _check_last_line(path: Path, form: TableForm) -> None:
    """Refuse a copy that broke off within its last line, which may hold half a number."""
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
