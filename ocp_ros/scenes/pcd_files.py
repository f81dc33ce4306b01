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
from ocp_ros.scenes.text_tables import read_table, TableForm
from ocp_ros.util.terminal_text import printable
from scipy.spatial.transform import Rotation

_log = logging.getLogger(__name__)


def read_pcd_fields(path: Path) -> dict[str, np.ndarray]:
    """
    Read a PCD file: ascii, binary or binary_compressed.

    Open3D is not used: without a warning it fills a truncated ascii file with random memory and
    reads 8-byte coordinates as 4-byte ones (0.20), and it takes a second to import.

    :param path: a .pcd file.
    :returns: each field by its name, (N, count) or (N,).
    :raises ValueError: if the file is broken.
    """
    with path.open('rb') as file:
        header, skip = _pcd_header(file)
        body = file.read()
    layout, count = _pcd_layout(header), int(header['POINTS'][0])
    # Each number in a text takes two bytes; real binary files need a byte or more per point,
    # packed or not.
    size = path.stat().st_size
    if count > 4 * size or header['DATA'] == ['ascii'] and (
            2 * count * len(layout.names) > size):
        raise ValueError(f'{count:,} points in {size:,} bytes')
    if header['DATA'] == ['ascii']:
        fields = _pcd_ascii(path, layout, skip)
    elif header['DATA'] == ['binary']:
        rows = np.frombuffer(body, layout, count)
        fields = {field: rows[field] for field in layout.names}
    else:
        fields = _pcd_compressed(body, layout, count)
    found = min(map(len, fields.values()))
    if found != count:
        raise ValueError(f'{found:,} of {count:,} points')
    return _placed(fields, header.get('VIEWPOINT', []), path.name)


def _placed(fields: dict[str, np.ndarray], viewpoint: list[str], name: str
            ) -> dict[str, np.ndarray]:
    """
    Move points from the sensor frame to the map frame if the header gives the pose.

    :param viewpoint: x y z in the unit of the file, and a quaternion w x y z.
    :returns: the fields; for moved points only the coordinates, since the normals are estimated
        anew.
    """
    numbers = np.array([float(number) for number in viewpoint])
    # This viewpoint is the identity: the points are already in the map frame.
    if (len(numbers) != 7 or np.array_equal(numbers, (0, 0, 0, 1, 0, 0, 0))
            or not fields.keys() >= set('xyz')):
        return fields
    if not np.isfinite(numbers).all() or not numbers[3:].any():
        raise ValueError(f'VIEWPOINT {" ".join(viewpoint)[:60]}')
    points = np.stack([np.ravel(fields[column]).astype(np.float64) for column in 'xyz'], axis=1)
    points = Rotation.from_quat(np.roll(numbers[3:], -1)).apply(points) + numbers[:3]
    _log.warning('%s: moved by the VIEWPOINT of its header, %s', printable(name),
                 ' '.join(viewpoint))
    return dict(zip('xyz', points.T))


def _pcd_header(file) -> tuple[dict[str, list[str]], int]:
    """Read the header of a PCD file up to its last line; return it and its number of lines."""
    header, lines = {}, 0
    while 'DATA' not in header and lines < 1000:
        line = file.readline(1 << 16)
        if not line.endswith(b'\n'):
            raise ValueError('no DATA line')
        lines += 1
        key, *values = line.decode('ascii').split() or ['']
        header[key] = values
    missing = {'FIELDS', 'SIZE', 'TYPE', 'POINTS', 'DATA'} - header.keys()
    if missing:
        raise ValueError(f'no {" ".join(sorted(missing))} in the header')
    return header, lines


def _pcd_layout(header: dict[str, list[str]]) -> np.dtype:
    """Turn a PCD header into the record of one point."""
    names, kinds = header['FIELDS'], {'F': '<f', 'I': '<i', 'U': '<u'}
    repeats = header.get('COUNT', ['1'] * len(names))
    if not all(repeat.isdecimal() and int(repeat) for repeat in repeats):
        raise ValueError(f'COUNT {" ".join(repeats)[:60]}')
    # Padding fields may all have the same name.
    return np.dtype([
        (f'{name}{index}' if name == '_' else name, kinds[kind] + size, (int(repeat),))
        for index, (name, kind, size, repeat)
        in enumerate(zip(names, header['TYPE'], header['SIZE'], repeats, strict=True))])


def _pcd_ascii(path: Path, layout: np.dtype, skip: int) -> dict[str, np.ndarray]:
    """Read the fields of a PCD file in ascii, one point per line."""
    widths = [layout[field].shape[0] for field in layout.names]
    starts = np.cumsum([0, *widths[:-1]]).tolist()
    table = read_table(path, TableForm(skip=skip, columns=starts))
    return dict(zip(layout.names, table.T, strict=True))


def _pcd_compressed(body: bytes, layout: np.dtype, count: int) -> dict[str, np.ndarray]:
    """Unpack the fields of a compressed PCD file, which are stored one after the other."""
    packed, size = (int(number) for number in np.frombuffer(body, '<u4', 2))
    # LibLZF unpacks up to 264 bytes from three.
    if size > 88 * len(body) or layout.itemsize * count > size:
        raise ValueError(f'{count:,} points in {size:,} bytes, packed to {len(body):,}')
    body, start, fields = _lzf(body[8:8 + packed], size), 0, {}
    for field in layout.names:
        kind = layout[field]
        fields[field] = np.frombuffer(body, kind, count, start)
        start += kind.itemsize * count
    return fields


def _lzf(packed: bytes, size: int) -> bytes:
    """Unpack LibLZF: a control byte below 32 precedes literals, any other a copy."""
    out, i = bytearray(), 0
    while i < len(packed) and len(out) <= size:
        control = packed[i]
        i += 1
        if control < 32:
            out += packed[i:i + control + 1]
            i += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += packed[i]
            i += 1
        start = len(out) - ((control & 31) << 8) - packed[i] - 1
        i += 1
        if start < 0:
            raise ValueError('a copy from before the start')
        piece = out[start:start + length + 2]
        # A copy may overlap its own output: then the piece repeats.
        out += (piece * ((length + 2) // len(piece) + 1))[:length + 2]
    if len(out) != size:
        raise ValueError(f'{len(out):,} of {size:,} bytes')
    return bytes(out)
