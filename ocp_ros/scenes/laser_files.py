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

#: Bytes that are read of the header of a LAS file; the last eight are the point count of 1.4.
LAS_HEADER_BYTES = 255
#: Bytes of a page of an E57 file.
PAGE_BYTES = 1024
#: The least size in bytes of a record (variable length record) before the points.
MIN_RECORD_BYTES = 54
METRE_UNIT = ('metre', 1.0)
#: Names and metres of the units of length, by their codes in GeoTIFF keys.
GEO_KEY_UNITS = {9001: METRE_UNIT, 9002: ('foot', 0.3048),
                 9003: ('US survey foot', 1200.0 / 3937.0)}


def read_las_points(path: Path) -> np.ndarray:
    """
    Read a LAS file, or a LAZ file, which is compressed; leave out noise and withheld points.

    Wrong sizes are found before anything is read. The file is read in a separate process, since
    lazrs ends its process if a file asks for more memory than there is.

    :returns: (N, 3) float64, in the file's unit.
    :raises ValueError: if the file is broken.
    :raises ImportError: if there is no laspy or, for a LAZ file, no lazrs or laszip.
    """
    size = path.stat().st_size
    count, is_laz = _declared_count(path, size)
    if not find_spec('laspy') or (is_laz and not (find_spec('lazrs') or find_spec('laszip'))):
        raise ImportError('laspy and lazrs; pip install "laspy[lazrs]"')
    rows = read_guarded('las', path, 4, count)
    if len(rows) != count:
        raise ValueError(f'{len(rows):,} of {count:,} points')
    # The fourth column is 0 for noise and withheld points.
    is_kept = rows[:, 3] > 0.0
    if not is_kept.all():
        _log.warning('%s: %s points that it calls noise or withheld left out',
                     printable(path.name), f'{np.count_nonzero(~is_kept):,}')
    return rows[is_kept, :3]


def las_unit(path: Path) -> tuple[str, float]:
    """
    Return the unit of length that a LAS file names.

    :returns: the name of the unit, and its length in metres; the metre if the file names no unit,
        or is broken.
    """
    with path.open('rb') as file:
        header = file.read(LAS_HEADER_BYTES)
        # The fields that are needed end at byte 104.
        if header[:4] != b'LASF' or len(header) < 104:
            return METRE_UNIT
        # The records are between the header and the points.
        header_bytes, = struct.unpack_from('<H', header, 94)
        points_offset, record_count = struct.unpack_from('<II', header, 96)
        file.seek(header_bytes)
        content = file.read(min(max(points_offset - header_bytes, 0), 1_000_000))
    position = 0
    unit = METRE_UNIT
    wkt_unit = re.compile(r'UNIT\s*\[\s*"([^"]*)"\s*,\s*([0-9.]+(?:[eE][+-]?[0-9]+)?)')
    length_name = re.compile('met(?:er|re)|f(?:oo|ee)t|ft', re.IGNORECASE)
    for _ in range(record_count):
        if position + MIN_RECORD_BYTES > len(content):
            break
        user_id, record_id, body_bytes = struct.unpack_from('<2x16sHH', content, position)
        body = content[position + MIN_RECORD_BYTES:position + MIN_RECORD_BYTES + body_bytes]
        position += MIN_RECORD_BYTES + body_bytes
        if user_id.rstrip(b'\0') != b'LASF_Projection':
            continue
        # Record 2112 is the projection as text (WKT). The last of its units of length counts.
        if record_id == 2112:
            matches = wkt_unit.findall(body.decode('latin-1'))
            units = [(name, float(metres)) for name, metres in matches if length_name.search(name)]
            unit = units[-1] if units else unit
        # Record 34735 is the projection as numbers (GeoTIFF keys); key 3076 is the unit of length.
        # With location 0 the fourth number of a key is its value.
        elif record_id == 34735:
            # Each key has four numbers of two bytes.
            keys = np.frombuffer(body[:len(body) // 8 * 8], '<u2').reshape(-1, 4)
            unit = next((GEO_KEY_UNITS[code] for key, location, _, code in keys.tolist()
                         if key == 3076 and location == 0 and code in GEO_KEY_UNITS), unit)
    # Units below a millimetre, or of a kilometre or more, are not accepted.
    return unit if 1e-3 <= unit[1] < 1e3 else METRE_UNIT


def _declared_count(path: Path, file_bytes: int) -> tuple[int, bool]:
    """Return the declared number of points and whether they are compressed; refuse wrong sizes."""
    with path.open('rb') as file:
        header = file.read(LAS_HEADER_BYTES)
    # The shortest header, that of LAS 1.0, has 227 bytes.
    if header[:4] != b'LASF' or len(header) < 227:
        raise ValueError('no LAS header')
    offset, record_count, format_id, point_bytes, count = struct.unpack_from('<IIBHI', header, 96)
    # Byte 25 is the minor version. LAS 1.4 counts the points with eight bytes too.
    if header[25] >= 4:
        count, = struct.unpack_from('<Q', header.ljust(LAS_HEADER_BYTES, b'\0'), 247)
    if offset > file_bytes or MIN_RECORD_BYTES * record_count > offset:
        raise ValueError(f'{record_count:,} records in the {offset:,} bytes before the points')
    # LAZ sets one of the two highest bits of the format.
    is_compressed = format_id >= 64
    # Real scans need one byte or more per compressed point; a quarter of that is accepted.
    min_bytes = count // 4 if is_compressed else count * point_bytes
    if min_bytes > file_bytes - offset:
        raise ValueError(f'{file_bytes - offset:,} bytes for {count:,} points')
    return count, is_compressed


def read_e57_points(path: Path) -> np.ndarray:
    """
    Read all scans of an E57 file, each at its pose in the file.

    The file is read in a separate process, since broken files may crash the library.

    :returns: (N, 3) float64, in the file's unit, which is the metre by the standard.
    :raises ValueError: if the file is broken.
    :raises ImportError: if there is no pye57.
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
    if not find_spec('pye57'):
        raise ImportError('pye57; pip install pye57')
    # Real files pack a point in 6 bytes or more, so the file has fewer points than bytes.
    return read_guarded('e57', path, 3, file_bytes)


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
    """Refuse XML that names other files, or is not UTF-8, so that it cannot be checked."""
    text = content.decode('utf-8')
    encoding = re.match(r'\ufeff?<\?xml[^>]*?encoding\s*=\s*["\']([^"\']*)', text)
    if '\0' in text or (encoding and encoding[1].lower() != 'utf-8'):
        raise ValueError('XML that is not UTF-8')
    # These keywords refer to other files, also on other machines, which the reader would open. XML
    # without a DOCTYPE has no entities.
    if found := re.search('<!DOCTYPE|<!ENTITY|schemaLocation', text, re.IGNORECASE):
        raise ValueError(f'XML with {found[0]}, which names other files')
