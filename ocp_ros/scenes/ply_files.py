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


class DeclaredElement(NamedTuple):
    """
    An element (table) of a PLY file, as the header declares it.

    :ivar name: such as ``vertex`` or ``face``.
    :ivar count: the number of rows.
    :ivar types: the type of each property (column) by its name; ``b'list'`` for lists.
    :ivar end: the number of bytes from the start of the header to the end of the declaration.
    """

    name: str
    count: int
    types: dict[str, bytes]
    end: int

    @property
    def has_lists(self) -> bool:
        """Return whether a property is a list, so that rows have different lengths."""
        return b'list' in self.types.values()


def read_ply_fields(path: Path) -> dict[str, np.ndarray]:
    """
    Read the vertices of a PLY file, ascii or binary.

    Elements after the vertices are not read. If lists come before the vertices or in them, a
    separate process with limits of time and memory reads the file.

    :returns: each column (N,) of the vertices by its name; an empty dictionary if the file has no
        element of vertices. If lists come before the vertices or in them, only coordinates and
        normals. If x, y or z is missing, the columns are empty.
    :raises ValueError: if the file is broken.
    """
    header, end_of_line, elements = _read_elements(path)
    names = [element.name for element in elements]
    if 'tristrips' in names:
        raise ValueError('its faces are strips of triangles (tristrips): export it with faces')
    if 'vertex' not in names:
        return {}
    needed_elements = elements[:names.index('vertex') + 1]
    vertices = needed_elements[-1]
    # If x, y or z is missing, the caller needs only the names, for its error.
    if not vertices.types.keys() >= set('xyz'):
        return dict.fromkeys(vertices.types, np.empty(0))
    if any(element.has_lists for element in needed_elements):
        # Reading a row with lists takes a microsecond or two and 100 bytes.
        max_list_rows = 1_000_000
        list_rows = sum(element.count for element in needed_elements if element.has_lists)
        if list_rows > max_list_rows:
            raise ValueError(f'{list_rows:,} rows with lists up to its vertices, more than '
                             f'{max_list_rows:,}')
        columns = [name for name in ('x', 'y', 'z', 'nx', 'ny', 'nz') if name in vertices.types]
        rows = read_guarded('ply', path, len(columns), vertices.count, columns)
        return dict(zip(columns, rows.T))
    if len(needed_elements) == len(elements):
        ply = PlyData.read(str(path))
    else:
        # With a header that ends after the vertices, plyfile reads nothing after them.
        with path.open('rb') as file:
            file.seek(len(header) + len(b'end_header') + len(end_of_line))
            ply = PlyData.read(io.BytesIO(
                header[:vertices.end] + b'end_header' + end_of_line + file.read()))
    vertex_rows = ply['vertex'].data
    return {field: vertex_rows[field] for field in vertex_rows.dtype.names}


def has_faces(path: Path) -> bool:
    """
    Return whether a PLY file has faces, so that it is a mesh.

    :raises ValueError: if its header is broken.
    """
    return any(element.name == 'face' and element.count and element.has_lists
               for element in _read_elements(path)[2])


def _read_elements(path: Path) -> tuple[bytes, bytes, list[DeclaredElement]]:
    """
    Return the header of a PLY file, its line ending and its elements.

    :returns: the header up to the line ``end_header``, which is left out; the bytes that end a
        line; and the elements in the order of the file.
    :raises ValueError: if there is no header, or the file is too small for its elements.
    """
    # plyfile reads a header byte by byte, so a longer one is refused.
    max_header_bytes = 1 << 18
    with path.open('rb') as file:
        first_bytes = file.read(max_header_bytes)
    # The first line is ``ply``, so the line ending begins at byte 3.
    end_of_line = b'\r\n' if first_bytes[3:5] == b'\r\n' else first_bytes[3:4]
    header, end_marker, _ = first_bytes.partition(end_of_line + b'end_header' + end_of_line)
    if first_bytes[:3] != b'ply' or not end_marker:
        raise ValueError(f'no PLY header within {max_header_bytes:,} bytes')
    elements: list[DeclaredElement] = []
    position = 0
    for line in header.split(end_of_line):
        words = line.split()
        position += len(line) + len(end_of_line)
        if words[:1] == [b'element'] and len(words) == 3:
            elements.append(DeclaredElement(words[1].decode('ascii'), int(words[2]), {}, position))
        elif words[:1] == [b'property'] and elements:
            # The last word is the name, the second one the type; a broken line may lack the type.
            elements[-1].types[words[-1].decode('ascii')] = b''.join(words[1:2])
            elements[-1] = elements[-1]._replace(end=position)
    # Each number takes a byte or more, and each row has at least one number.
    min_bytes = sum(element.count * max(len(element.types), 1) for element in elements)
    min_count = min((element.count for element in elements), default=0)
    if min_count < 0 or min_bytes > path.stat().st_size:
        raise ValueError('more rows than the file has room for')
    return header + end_of_line, end_of_line, elements
