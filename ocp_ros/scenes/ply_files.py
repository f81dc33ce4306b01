# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""PLY, the Stanford polygon file format: scans with plyfile, meshes with Open3D."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from plyfile import PlyData

from ocp_ros.scenes.mesh_files import read_mesh

#: Bytes in which the header has to end: plyfile reads it letter by letter.
HEADER = 1 << 18


class PlyPart(NamedTuple):
    """
    What a header says of one element.

    :ivar count: rows.
    :ivar kinds: of the properties of each row; ``b'list'`` for lists.
    """

    name: str
    count: int
    kinds: list[bytes]


def read_ply_fields(path: Path) -> dict[str, np.ndarray]:
    """
    Read a PLY file, ascii or binary.

    :returns: each column of the vertices by its name, (N,), or, where there are faces, columns
        x y z nx ny nz of points on them; nothing where there are no vertices.
    :raises ValueError: if the file is broken.
    """
    parts = _parts(path)
    if any(part.name == 'face' and part.count and b'list' in part.kinds for part in parts):
        return dict(zip(('x', 'y', 'z', 'nx', 'ny', 'nz'), read_mesh(path).T))
    content = PlyData.read(str(path))
    if 'vertex' not in content:
        return {}
    rows = content['vertex'].data
    return {field: rows[field] for field in rows.dtype.names}


def _parts(path: Path) -> list[PlyPart]:
    """Return the elements of a PLY file, if there is room for them in it."""
    with path.open('rb') as file:
        head = file.read(HEADER)
    # The first line shows how lines end.
    end_of_line = b'\r\n' if head[3:5] == b'\r\n' else head[3:4]
    header, end, _ = head.partition(end_of_line + b'end_header' + end_of_line)
    if head[:3] != b'ply' or not end:
        raise ValueError(f'no PLY header within {HEADER:,} bytes')
    parts: list[PlyPart] = []
    for line in header.split(end_of_line):
        words = line.split()
        if words[:1] == [b'element'] and len(words) == 3:
            parts.append(PlyPart(words[1].decode('ascii'), int(words[2]), []))
        elif words[:1] == [b'property'] and parts:
            parts[-1].kinds.append(b''.join(words[1:2]))
    # Each number takes a byte or more, and a row without any is none.
    least = sum(part.count * max(len(part.kinds), 1) for part in parts)
    if min((part.count for part in parts), default=0) < 0 or least > path.stat().st_size:
        raise ValueError('more rows than the file has room for')
    return parts
