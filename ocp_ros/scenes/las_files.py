# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""LAS and LAZ, the formats of laser scanners, read with laspy."""

from importlib.util import find_spec
from pathlib import Path
import struct

import numpy as np

from ocp_ros.scenes.guarded_reading import read_guarded, ReadingLimits, WORDS

#: Bytes of the longest header that is looked at.
HEADER = 255
#: Bytes of a record before the points, at least.
RECORD = 54
#: Points that a byte may hold where they are compressed; real scans need one byte or more each.
PER_BYTE = 4
#: Bytes of memory that reading takes anyway, and seconds of all cores: with any file, and for each
#: million bytes.
MEMORY, SECONDS, SECONDS_PER_MB = 600_000_000, 10, 4


def read_las_points(path: Path) -> np.ndarray:
    """
    Read a LAS file, compressed or not.

    False sizes are found before anything is read; other errors end in a process of their own,
    since lazrs ends the process that it runs in when it is asked for more memory than there is.

    :returns: (N, 3) float64, in the file's unit.
    :raises ValueError: if the file is broken.
    :raises ImportError: if there is no laspy or, for a LAZ file, no lazrs or laszip.
    """
    size = path.stat().st_size
    count, compressed = _declared(path, size)
    if not find_spec('laspy') or compressed and not (find_spec('lazrs') or find_spec('laszip')):
        raise ImportError('laspy and lazrs; pip install "laspy[lazrs]"')
    limits = ReadingLimits(MEMORY + 3 * size, SECONDS + SECONDS_PER_MB * size // 1_000_000,
                           24 * count + WORDS)
    points = read_guarded('las', path, 3, limits)
    if len(points) != count:
        raise ValueError(f'{len(points):,} of {count:,} points')
    return points


def _declared(path: Path, size: int) -> tuple[int, bool]:
    """Return how many points a file says it has, if they can be in it, and if they are packed."""
    with path.open('rb') as file:
        head = file.read(HEADER)
    if head[:4] != b'LASF' or len(head) < 227:
        raise ValueError('no LAS header')
    offset, records, form, length, count = struct.unpack_from('<IIBHI', head, 96)
    if head[25] >= 4:
        count, = struct.unpack_from('<Q', head.ljust(HEADER, b'\0'), 247)
    if offset > size or RECORD * records > offset:
        raise ValueError(f'{records:,} records in the {offset:,} bytes before the points')
    compressed = form >= 64
    least = count // PER_BYTE if compressed else count * length
    if least > size - offset:
        raise ValueError(f'{size - offset:,} bytes for {count:,} points')
    return count, compressed
