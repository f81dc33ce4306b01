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

"""PCD, the file format of the Point Cloud Library."""

import logging
from pathlib import Path

import numpy as np
from ocp_ros.scenes.text_tables import read_table, TableFormat
from ocp_ros.util.terminal_text import printable
from scipy.spatial.transform import Rotation

_log = logging.getLogger(__name__)


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
