# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""E57 (ASTM E2807), the exchange format of laser scanners, read with pye57."""

from importlib.util import find_spec
from pathlib import Path
import struct

import numpy as np

from ocp_ros.scenes.guarded_reading import read_guarded, ReadingLimits, WORDS

#: Bytes of the header of a file.
HEADER = 48
#: Bytes of memory that reading takes with any file, and for each byte of a file; seconds of all
#: cores with any file, and for each million bytes.
MEMORY, MEMORY_PER_BYTE, SECONDS, SECONDS_PER_MB = 600_000_000, 20, 10, 4
#: Bytes of points for each byte of a file; real files pack a point in 6 bytes or more.
POINTS_PER_BYTE = 24


def read_e57_points(path: Path) -> np.ndarray:
    """
    Read all scans of an E57 file, each at its pose in the file.

    It is read in a process of its own, since broken files may crash the library.

    :returns: (N, 3) float64, in the file's unit, which is the metre by the standard.
    :raises ValueError: if the file is broken.
    :raises ImportError: if there is no pye57.
    """
    _check_header(path)
    if not find_spec('pye57'):
        raise ImportError('pye57; pip install pye57')
    size = path.stat().st_size
    limits = ReadingLimits(MEMORY + MEMORY_PER_BYTE * size,
                           SECONDS + SECONDS_PER_MB * size // 1_000_000,
                           POINTS_PER_BYTE * size + WORDS)
    return read_guarded('e57', path, 3, limits)


def _check_header(path: Path) -> None:
    """Refuse what is no E57 file, or not all of one."""
    with path.open('rb') as file:
        head = file.read(HEADER)
    if len(head) < HEADER or head[:8] != b'ASTM-E57':
        raise ValueError('no E57 header')
    length, = struct.unpack_from('<Q', head, 16)
    if length != path.stat().st_size:
        raise ValueError(f'{path.stat().st_size:,} of {length:,} bytes')
