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

"""
Read point clouds from PLY, PCD and E57 files.

PLY, the Stanford polygon file format, is read with plyfile; E57 (ASTM E2807), a format of laser
scanners, with pye57. PCD is the format of the Point Cloud Library.
"""

import io
import logging
from pathlib import Path
import re
import struct
from typing import NamedTuple
from xml.parsers import expat

import numpy as np
from ocp_ros.scenes.guarded_reading import read_guarded
from ocp_ros.scenes.scene import Scan
from ocp_ros.scenes.text_tables import read_table, TableFormat
from ocp_ros.util.files import printable
from ocp_ros.util.settings import need
from scipy.spatial.transform import Rotation

_log = logging.getLogger(__name__)

#: Bytes of a page of an E57 file.
PAGE_BYTES = 1024


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
    :raises ConfigurationError: if there is no plyfile.
    """
    need(path.name, 'plyfile')
    from plyfile import PlyData
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


def read_pcd_fields(path: Path) -> dict[str, np.ndarray]:
    """
    Read a PCD file: ascii, binary or binary_compressed.

    Open3D is not used: without a warning it fills a truncated ascii file with random memory and
    reads 8-byte coordinates as 4-byte ones (0.20), and it takes a second to import.

    :param path: a .pcd file.
    :returns: each field by its name, (N, C) for N points and C values per point; (N,) from an
        ascii file. Only x, y and z if the points were moved, see :func:`_move_to_map`.
    :raises ValueError: if the file is broken.
    """
    with path.open('rb') as file:
        header, header_lines = _read_header(file)
        body = file.read()
    layout, count = _point_layout(header), int(header['POINTS'][0])
    # Real files, packed or not, need a byte or more per point; a quarter of that is accepted. In
    # an ascii file each number takes at least two bytes, a digit and a separator.
    file_bytes = path.stat().st_size
    if count > 4 * file_bytes or (header['DATA'] == ['ascii']
                                  and 2 * count * len(layout.names) > file_bytes):
        raise ValueError(f'{count:,} points in {file_bytes:,} bytes')
    if header['DATA'] == ['ascii']:
        fields = _read_ascii(path, layout, header_lines, count)
    elif header['DATA'] == ['binary']:
        rows = np.frombuffer(body, layout, count)
        fields = {field: rows[field] for field in layout.names}
    else:
        fields = _unpack_fields(body, layout, count)
    found_count = min(map(len, fields.values()))
    if found_count != count:
        raise ValueError(f'{found_count:,} of {count:,} points')
    return _move_to_map(fields, header.get('VIEWPOINT', []), path.name)


def _move_to_map(fields: dict[str, np.ndarray], viewpoint: list[str], name: str
                 ) -> dict[str, np.ndarray]:
    """
    Move points from the sensor frame to the map frame if the header gives the sensor's pose.

    :param fields: the fields of the points by their names.
    :param viewpoint: x y z in the unit of the file, and a quaternion w x y z; [] if the header
        has no pose.
    :param name: the name of the file, for the warning.
    :returns: the same fields if no point was moved; otherwise only x, y and z, since the normals
        are estimated again.
    """
    pose = np.array([float(number) for number in viewpoint])
    # Without a pose, or with the identity, the points are already in the map frame. The caller of
    # the reader refuses fields without x, y and z.
    if (len(pose) != 7 or np.array_equal(pose, (0, 0, 0, 1, 0, 0, 0))
            or not fields.keys() >= set('xyz')):
        return fields
    if not np.isfinite(pose).all() or not pose[3:].any():
        raise ValueError(f'VIEWPOINT {" ".join(viewpoint)[:60]}')
    points = np.stack([np.ravel(fields[column]).astype(np.float64) for column in 'xyz'], axis=1)
    # SciPy expects the quaternion as x y z w.
    points = Rotation.from_quat(np.roll(pose[3:], -1)).apply(points) + pose[:3]
    _log.warning('%s: moved by the VIEWPOINT of its header, %s', printable(name),
                 ' '.join(viewpoint))
    return dict(zip('xyz', points.T))


def _read_header(file) -> tuple[dict[str, list[str]], int]:
    """Read the header of a PCD file; return the values by key, and the number of its lines."""
    # Comments and empty lines become keys too, which are not used.
    header = {}
    line_count = 0
    while 'DATA' not in header and line_count < 1000:
        line = file.readline(1 << 16)
        if not line.endswith(b'\n'):
            raise ValueError('no DATA line')
        line_count += 1
        key, *values = line.decode('ascii').split() or ['']
        header[key] = values
    missing = {'FIELDS', 'SIZE', 'TYPE', 'POINTS', 'DATA'} - header.keys()
    if missing:
        raise ValueError(f'no {" ".join(sorted(missing))} in the header')
    return header, line_count


def _point_layout(header: dict[str, list[str]]) -> np.dtype:
    """Return the record type of one point, given the header of a PCD file."""
    names = header['FIELDS']
    type_codes = {'F': '<f', 'I': '<i', 'U': '<u'}
    repeats = header.get('COUNT', ['1'] * len(names))
    if not all(repeat.isdecimal() and int(repeat) for repeat in repeats):
        raise ValueError(f'COUNT {" ".join(repeats)[:60]}')
    # All padding fields may have the name _, but the names in a record have to differ.
    return np.dtype([
        (f'{name}{index}' if name == '_' else name, type_codes[number_type] + size, (int(repeat),))
        for index, (name, number_type, size, repeat)
        in enumerate(zip(names, header['TYPE'], header['SIZE'], repeats, strict=True))])


def _read_ascii(path: Path, layout: np.dtype, header_lines: int, count: int
                ) -> dict[str, np.ndarray]:
    """Read the fields of a PCD file in ascii, which has one point per line."""
    # Of a field with several columns, only the first is read.
    widths = [layout[field].shape[0] for field in layout.names]
    starts = np.cumsum([0, *widths[:-1]]).tolist()
    table = read_table(path, TableFormat(
        skipped_lines=header_lines, columns=starts, count=count))
    return dict(zip(layout.names, table.T, strict=True))


def _unpack_fields(body: bytes, layout: np.dtype, count: int) -> dict[str, np.ndarray]:
    """Unpack the fields of ``count`` points, which are stored one field after the other."""
    # The body begins with the packed and the unpacked number of bytes, in 4 bytes each.
    packed_bytes, unpacked_bytes = (int(number) for number in np.frombuffer(body, '<u4', 2))
    # LibLZF unpacks up to 264 bytes from three, 88 from one.
    if unpacked_bytes > 88 * len(body) or layout.itemsize * count > unpacked_bytes:
        raise ValueError(f'{count:,} points in {unpacked_bytes:,} bytes, packed to {len(body):,}')
    unpacked = _unpack_lzf(body[8:8 + packed_bytes], unpacked_bytes)
    start = 0
    fields = {}
    for field in layout.names:
        field_layout = layout[field]
        fields[field] = np.frombuffer(unpacked, field_layout, count, start)
        start += field_layout.itemsize * count
    return fields


def _unpack_lzf(packed: bytes, unpacked_bytes: int) -> bytes:
    """Unpack LibLZF: control bytes below 32 precede plain bytes, others copy earlier output."""
    output = bytearray()
    position = 0
    while position < len(packed) and len(output) <= unpacked_bytes:
        control = packed[position]
        position += 1
        if control < 32:
            output += packed[position:position + control + 1]
            position += control + 1
            continue
        # The upper 3 bits of the control byte are the length of the copy, less 2; if they are 7,
        # the next byte is added to them. The lower 5 bits and one more byte are the distance from
        # the end of the output back to the start of the copy, less 1.
        length = control >> 5
        if length == 7:
            length += packed[position]
            position += 1
        start = len(output) - ((control & 31) << 8) - packed[position] - 1
        position += 1
        if start < 0:
            raise ValueError('a copy from before the start')
        copied = output[start:start + length + 2]
        # A copy that reaches beyond the end of the output repeats the bytes up to the end.
        output += (copied * ((length + 2) // len(copied) + 1))[:length + 2]
    if len(output) != unpacked_bytes:
        raise ValueError(f'{len(output):,} of {unpacked_bytes:,} bytes')
    return bytes(output)


def read_e57_scans(path: Path) -> list[Scan]:
    """
    Read all scans of an E57 file, each at its pose in the file.

    The file is read in a separate process, since broken files may crash the library.

    :returns: the scans, float64, in the file's unit, which is the metre by the standard.
    :raises ValueError: if the file is broken.
    :raises ConfigurationError: if there is no pye57.
    """
    file_bytes = path.stat().st_size
    header_bytes = 48
    with path.open('rb') as file:
        header = file.read(header_bytes)
    if len(header) < header_bytes or header[:8] != b'ASTM-E57':
        raise ValueError('no E57 header')
    declared_bytes, xml_start, xml_bytes, page_bytes = struct.unpack_from('<QQQQ', header, 16)
    if declared_bytes != file_bytes:
        raise ValueError(f'{file_bytes:,} of {declared_bytes:,} bytes')
    if page_bytes != PAGE_BYTES:
        raise ValueError(f'pages of {page_bytes:,} bytes, not {PAGE_BYTES:,}')
    _check_xml(_read_xml(path, xml_start, xml_bytes))
    need(path.name, 'pye57')
    # Real files pack a point in 6 bytes or more, so the file has fewer points than bytes.
    rows = read_guarded('e57', path, 4, file_bytes)
    if len(rows) == 0:
        raise ValueError('no scan')
    # The first row of each scan is its station; the last column is the number of the scan.
    first = np.flatnonzero(np.diff(rows[:, 3], prepend=-1.0))
    return [Scan(scan[0], scan[1:]) for scan in np.split(rows[:, :3], first[1:])]


def _read_xml(path: Path, start: int, length: int) -> bytes:
    """Return the XML of an E57 file: ``length`` bytes from ``start`` on, without checksums."""
    # Files with thousands of scans have a tenth of this.
    if length > 50_000_000:
        raise ValueError(f'{length:,} bytes of XML')
    # Each page ends with a checksum.
    checksum_bytes = 4
    # Read whole pages; the first and the last one may contain only a part of the XML.
    with path.open('rb') as file:
        file.seek(start - start % PAGE_BYTES)
        pages = file.read((length // (PAGE_BYTES - checksum_bytes) + 2) * PAGE_BYTES)
    content = b''.join(pages[page_start:page_start + PAGE_BYTES - checksum_bytes]
                       for page_start in range(0, len(pages), PAGE_BYTES))
    xml = content[start % PAGE_BYTES:][:length]
    if len(xml) < length:
        raise ValueError(f'{len(xml):,} of {length:,} bytes of XML')
    return xml


def _check_xml(content: bytes) -> None:
    """Refuse XML that names other files, is not UTF-8 (so cannot be checked) or is too deep."""
    text = content.decode('utf-8')
    encoding = re.match(r'\ufeff?<\?xml[^>]*?encoding\s*=\s*["\']([^"\']*)', text)
    if '\0' in text or (encoding and encoding[1].lower() != 'utf-8'):
        raise ValueError('XML that is not UTF-8')
    # These keywords refer to other files, also on other machines, which the reader would open. XML
    # without a DOCTYPE has no entities.
    if found := re.search('<!DOCTYPE|<!ENTITY|schemaLocation', text, re.IGNORECASE):
        raise ValueError(f'XML with {found[0]}, which names other files')
    depth = 0

    def enter(*_: object) -> None:
        nonlocal depth
        depth += 1
        # Real files have about ten levels; the time of the library grows with their square.
        if depth > 100:
            raise ValueError('XML of more than 100 levels')

    def leave(_: str) -> None:
        nonlocal depth
        depth -= 1

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = enter, leave
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise ValueError(f'broken XML ({error})') from error
