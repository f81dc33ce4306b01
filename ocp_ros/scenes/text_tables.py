# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Text files of numbers, with errors that name the line."""

from pathlib import Path
import warnings

import numpy as np

from ocp_ros.scenes.scene import SceneError


def read_table(path: Path, columns=(0, 1, 2), skip: int = 0) -> np.ndarray:
    """Read columns of a text file: (N, C) float64; blank lines and what follows # do not count."""
    with warnings.catch_warnings():
        # A text without a line of numbers is refused later, in our words.
        warnings.simplefilter('ignore', UserWarning)
        try:
            table = np.loadtxt(path, usecols=columns, skiprows=skip, encoding='latin-1', ndmin=2)
        except ValueError as error:
            raise _bad_line(path, columns, skip) or error from None
    _check_last_line(path)
    return table


def _bad_line(path: Path, columns, skip: int) -> SceneError | None:
    """Find the first line that is not numbers: NumPy counts rows, which nobody can look up."""
    with path.open(encoding='latin-1') as file:
        for number, line in enumerate(file, start=1):
            values = line.partition('#')[0].split()
            try:
                if number > skip and values:
                    [float(values[column]) for column in columns]
            except (ValueError, IndexError):
                # A header that counts the points would not agree with a line less.
                remedy = 'copy or export it again' if skip else (
                    f'correct the line or delete it: sed -i {number}d {path.name}')
                return SceneError(
                    f'{path.name}: found {line.strip()[:60]!r} in line {number}; expected numbers '
                    f'x y z separated by blanks; {remedy}')
    return None


def _check_last_line(path: Path) -> None:
    """Refuse a copy that broke off within its last line, which may hold half a number."""
    with path.open('rb') as file:
        file.seek(max(path.stat().st_size - 4096, 0))
        tail = file.read()
    lines = tail.splitlines()
    if not tail.endswith(b'\n') and len(lines) > 1:
        found, expected = (len(line.partition(b'#')[0].split()) for line in (lines[-1], lines[-2]))
        if 0 < found < expected:
            raise SceneError(f'{path.name}: found {found} numbers in the last line; expected '
                             f'{expected} as in the line before; the file is truncated: copy or '
                             'export it again')
