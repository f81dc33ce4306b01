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

"""PLY, the Stanford polygon file format, read with plyfile."""

import io
from pathlib import Path
from typing import NamedTuple

import numpy as np
from ocp_ros.scenes.guarded_reading import read_guarded
from plyfile import PlyData


class PlyPart(NamedTuple):
    """
    An element as the header declares it.

    :ivar count: the number of rows.
    :ivar kinds: the type of each property by its name; ``b'list'`` for lists.
    :ivar end: where its declaration ends in the header, bytes.
    """

    name: str
    count: int
    kinds: dict[str, bytes]
    end: int

    @property
    def has_lists(self) -> bool:
        """Return whether rows are of different lengths."""
        return b'list' in self.kinds.values()


def read_ply_fields(path: Path) -> dict[str, np.ndarray]:
    """
    Read a PLY file, ascii or binary.

    Elements after the vertices are not read. If lists come before the vertices, a separate process
    reads the file.

    :returns: each column of the vertices by its name, (N,); nothing if there are no vertices. From
        a file with lists before its vertices, only the columns that a room needs.
    :raises ValueError: if the file is broken.
    """
    header, end_of_line, parts = _parts(path)
    names = [part.name for part in parts]
    if 'tristrips' in names:
        raise ValueError('its faces are strips of triangles (tristrips): export it with faces')
    if 'vertex' not in names:
        return {}
    read = parts[:names.index('vertex') + 1]
    vertices = read[-1]
    if not vertices.kinds.keys() >= set('xyz'):
        return dict.fromkeys(vertices.kinds, np.empty(0))
    if any(part.has_lists for part in read):
        # Each row takes a microsecond or two and 100 bytes.
        max_list_rows = 1_000_000
        if (lists := sum(part.count for part in read if part.has_lists)) > max_list_rows:
            raise ValueError(f'{lists:,} rows with lists up to its vertices, more than '
                             f'{max_list_rows:,}')
        columns = [name for name in ('x', 'y', 'z', 'nx', 'ny', 'nz') if name in vertices.kinds]
        rows = read_guarded('ply', path, len(columns), vertices.count, columns)
        return dict(zip(columns, rows.T))
    if len(read) == len(parts):
        content = PlyData.read(str(path))
    else:
        with path.open('rb') as file:
            file.seek(len(header) + len(b'end_header') + len(end_of_line))
            content = PlyData.read(io.BytesIO(
                header[:vertices.end] + b'end_header' + end_of_line + file.read()))
    found = content['vertex'].data
    return {field: found[field] for field in found.dtype.names}


def has_faces(path: Path) -> bool:
    """
    Return whether a PLY file is a mesh.

    :raises ValueError: if its header is broken.
    """
    return any(part.name == 'face' and part.count and part.has_lists for part in _parts(path)[2])


def _parts(path: Path) -> tuple[bytes, bytes, list[PlyPart]]:
    """Return the header, its line ending, and its elements; refuse a file too small for them."""
    # plyfile reads a header byte by byte.
    max_header_bytes = 1 << 18
    with path.open('rb') as file:
        head = file.read(max_header_bytes)
    # The first line shows the line ending.
    end_of_line = b'\r\n' if head[3:5] == b'\r\n' else head[3:4]
    header, end, _ = head.partition(end_of_line + b'end_header' + end_of_line)
    if head[:3] != b'ply' or not end:
        raise ValueError(f'no PLY header within {max_header_bytes:,} bytes')
    parts: list[PlyPart] = []
    at = 0
    for line in header.split(end_of_line):
        words = line.split()
        at += len(line) + len(end_of_line)
        if words[:1] == [b'element'] and len(words) == 3:
            parts.append(PlyPart(words[1].decode('ascii'), int(words[2]), {}, at))
        elif words[:1] == [b'property'] and parts:
            parts[-1].kinds[words[-1].decode('ascii')] = b''.join(words[1:2])
            parts[-1] = parts[-1]._replace(end=at)
    # Each number takes a byte or more, and each row has at least one number.
    least = sum(part.count * max(len(part.kinds), 1) for part in parts)
    if min((part.count for part in parts), default=0) < 0 or least > path.stat().st_size:
        raise ValueError('more rows than the file has room for')
    return header + end_of_line, end_of_line, parts
