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

"""LAS, LAZ and E57 (ASTM E2807), the formats of laser scanners, read with laspy and pye57."""

from importlib.util import find_spec
import logging
from pathlib import Path
import re
import struct

import numpy as np
from ocp_ros.scenes.guarded_reading import read_guarded
from ocp_ros.util.terminal_text import printable

_log = logging.getLogger(__name__)

#: Bytes of the largest header of a LAS file.
LAS_HEADER_BYTES = 255
#: Bytes of a page of an E57 file.
PAGE_BYTES = 1024
#: The least size in bytes of a record before the points.
MIN_RECORD_BYTES = 54
METRE = ('metre', 1.0)
#: The units of length by their codes in GeoTIFF keys.
GEO_KEY_UNITS = {9001: METRE, 9002: ('foot', 0.3048),
                 9003: ('US survey foot', 1200.0 / 3937.0)}


def read_las_points(path: Path) -> np.ndarray:
    """
    Read a LAS file, compressed or not.

    Wrong sizes are found before anything is read. The file is read in a separate process, since
    lazrs ends its process if a file asks for more memory than there is.

    :returns: (N, 3) float64, in the file's unit.
    :raises ValueError: if the file is broken.
    :raises ImportError: if there is no laspy or, for a LAZ file, no lazrs or laszip.
    """
    size = path.stat().st_size
    count, compressed = _declared(path, size)
    if not find_spec('laspy') or compressed and not (find_spec('lazrs') or find_spec('laszip')):
        raise ImportError('laspy and lazrs; pip install "laspy[lazrs]"')
    points = read_guarded('las', path, 4, count)
    if len(points) != count:
        raise ValueError(f'{len(points):,} of {count:,} points')
    kept = points[:, 3] > 0.0
    if not kept.all():
        _log.warning('%s: %s points that it calls noise or withheld left out',
                     printable(path.name), f'{np.count_nonzero(~kept):,}')
    return points[kept, :3]


def las_unit(path: Path) -> tuple[str, float]:
    """
    Return the unit of length that a LAS file names.

    :returns: the name of the unit and its length in metres; the metre if the file names none, or
        is broken.
    """
    with path.open('rb') as file:
        head = file.read(LAS_HEADER_BYTES)
        if head[:4] != b'LASF' or len(head) < 104:
            return METRE
        size, = struct.unpack_from('<H', head, 94)
        offset, records = struct.unpack_from('<II', head, 96)
        file.seek(size)
        content = file.read(min(max(offset - size, 0), 1_000_000))
    at, named = 0, METRE
    wkt_unit = re.compile(r'UNIT\s*\[\s*"([^"]*)"\s*,\s*([0-9.]+(?:[eE][+-]?[0-9]+)?)')
    length_name = re.compile('met(?:er|re)|f(?:oo|ee)t|ft', re.IGNORECASE)
    for _ in range(records):
        if at + MIN_RECORD_BYTES > len(content):
            break
        user, kind, length = struct.unpack_from('<2x16sHH', content, at)
        body = content[at + MIN_RECORD_BYTES:at + MIN_RECORD_BYTES + length]
        at += MIN_RECORD_BYTES + length
        if user.rstrip(b'\0') != b'LASF_Projection':
            continue
        # The projection as text (WKT).
        if kind == 2112:
            found = wkt_unit.findall(body.decode('latin-1'))
            units = [(name, float(metres)) for name, metres in found if length_name.search(name)]
            named = units[-1] if units else named
        # The projection as numbers (GeoTIFF keys); key 3076 is the unit of length.
        elif kind == 34735:
            keys = np.frombuffer(body[:len(body) // 8 * 8], '<u2').reshape(-1, 4)
            named = next((GEO_KEY_UNITS[code] for key, place, _, code in keys.tolist()
                          if key == 3076 and place == 0 and code in GEO_KEY_UNITS), named)
    return named if 1e-3 < named[1] < 1e3 else METRE


def _declared(path: Path, size: int) -> tuple[int, bool]:
    """Return the declared number of points, if plausible, and whether they are compressed."""
    with path.open('rb') as file:
        head = file.read(LAS_HEADER_BYTES)
    if head[:4] != b'LASF' or len(head) < 227:
        raise ValueError('no LAS header')
    offset, records, form, length, count = struct.unpack_from('<IIBHI', head, 96)
    if head[25] >= 4:
        count, = struct.unpack_from('<Q', head.ljust(LAS_HEADER_BYTES, b'\0'), 247)
    if offset > size or MIN_RECORD_BYTES * records > offset:
        raise ValueError(f'{records:,} records in the {offset:,} bytes before the points')
    compressed = form >= 64
    # Real scans need one byte or more per compressed point.
    least = count // 4 if compressed else count * length
    if least > size - offset:
        raise ValueError(f'{size - offset:,} bytes for {count:,} points')
    return count, compressed


def read_e57_points(path: Path) -> np.ndarray:
    """
    Read all scans of an E57 file, each at its pose in the file.

    The file is read in a separate process, since broken files may crash the library.

    :returns: (N, 3) float64, in the file's unit, which is the metre by the standard.
    :raises ValueError: if the file is broken.
    :raises ImportError: if there is no pye57.
    """
    size = path.stat().st_size
    header_bytes = 48
    with path.open('rb') as file:
        head = file.read(header_bytes)
    if len(head) < header_bytes or head[:8] != b'ASTM-E57':
        raise ValueError('no E57 header')
    length, start, xml, page = struct.unpack_from('<QQQQ', head, 16)
    if length != size:
        raise ValueError(f'{size:,} of {length:,} bytes')
    if page != PAGE_BYTES:
        raise ValueError(f'pages of {page:,} bytes, not {PAGE_BYTES:,}')
    _check_xml(_xml_of(path, start, xml))
    if not find_spec('pye57'):
        raise ImportError('pye57; pip install pye57')
    # Real files pack a point in 6 bytes or more.
    return read_guarded('e57', path, 3, size)


def _xml_of(path: Path, start: int, length: int) -> bytes:
    """Return ``length`` bytes of XML of an E57 file from ``start`` on, without checksums."""
    # Files with thousands of scans need a tenth of it.
    if length > 50_000_000:
        raise ValueError(f'{length:,} bytes of XML')
    checksum_bytes = 4
    with path.open('rb') as file:
        file.seek(start - start % PAGE_BYTES)
        pages = file.read((length // (PAGE_BYTES - checksum_bytes) + 2) * PAGE_BYTES)
    logical = b''.join(pages[at:at + PAGE_BYTES - checksum_bytes]
                       for at in range(0, len(pages), PAGE_BYTES))
    xml = logical[start % PAGE_BYTES:][:length]
    if len(xml) < length:
        raise ValueError(f'{len(xml):,} of {length:,} bytes of XML')
    return xml


def _check_xml(content: bytes) -> None:
    """Refuse XML that names other files, or has an encoding in which this cannot be checked."""
    text = content.decode('utf-8')
    encoding = re.match(r'\ufeff?<\?xml[^>]*?encoding\s*=\s*["\']([^"\']*)', text)
    if '\0' in text or encoding and encoding[1].lower() != 'utf-8':
        raise ValueError('XML that is not UTF-8')
    # These refer to other files, which the reader would open, also on other machines. XML without
    # a DOCTYPE has no entities.
    if found := re.search('<!DOCTYPE|<!ENTITY|schemaLocation', text, re.IGNORECASE):
        raise ValueError(f'XML with {found[0]}, which names other files')
