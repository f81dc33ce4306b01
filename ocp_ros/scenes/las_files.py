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

"""Read the points and the units of LAS and LAZ files, which laspy reads."""

from collections.abc import Iterator, Mapping
from importlib.util import find_spec
import logging
from pathlib import Path
import re
import struct
from typing import BinaryIO, NamedTuple

import numpy as np
from ocp_ros.scenes.guarded_reading import read_guarded
from ocp_ros.util.files import printable
from ocp_ros.util.settings import need

_log = logging.getLogger(__name__)

#: Bytes that are read of the header; the last eight are the point count of LAS 1.4.
HEADER_BYTES = 255
#: The bytes before the body of a record (variable length record) before the points, and of an
#: extended record after them.
RECORD_HEADER_BYTES = 54
EXTENDED_HEADER_BYTES = 60


class LengthUnit(NamedTuple):
    """
    A unit of length.

    :ivar name: such as ``US survey foot``.
    :ivar metres: its length in metres.
    """

    name: str
    metres: float


METRE = LengthUnit('metre', 1.0)
FOOT = LengthUnit('foot', 0.3048)
SURVEY_FOOT = LengthUnit('US survey foot', 1200.0 / 3937.0)
#: Units of length by their EPSG codes, which GeoTIFF keys use.
EPSG_UNITS = {
    1025: LengthUnit('millimetre', 0.001), 1033: LengthUnit('centimetre', 0.01),
    9001: METRE, 9002: FOOT, 9003: SURVEY_FOOT, 9005: LengthUnit("Clarke's foot", 0.3047972654),
    9041: LengthUnit('British foot', 0.3047994715386762),
    9080: LengthUnit('Indian foot', 0.30479951024814694),
    9095: LengthUnit('British foot', 0.3048007491), 9096: LengthUnit('yard', 0.9144)}
#: EPSG codes of the coordinate reference systems, projected and vertical, in feet of any kind, by
#: the EPSG dataset of PROJ 9.6: a code, the first and the last of several, or of each second one
#: (/2). Kinds of feet differ by less than 1 cm in a kilometre.
SYSTEMS_IN_FEET = (
    '2136 2155 2159-2160 2194 2204 2222-2289 2314 2867-2930 2964-2968 2992-2994/2 3080 '
    '3089-3091/2 3102 3359-3365/2 3404 3407 3417-3438 3441-3446 3451-3459 3479-3487/2 '
    '3490-3512/2 3515-3553/2 3560-3570 3582-3590/2 3593 3598-3600/2 3605 3608-3636/2 3640-3664/2 '
    '3668-3676/2 3677-3679/2 3680-3682/2 3683 3686-3692/2 3696-3700/2 3728-3739 3753-3760 '
    '3991-3992 4217 4399-4413 4418-4433 4438-4439 4455-4457 5588-5589 5614 5623-5625 5646 '
    '5654-5655 5702 5754 6128-6141 6200-6202 6358-6360 6391 6405-6413/2 6416-6438/2 6441-6479/2 '
    '6484-6496/2 6499-6507/2 6510 6515-6565/2 6568-6578/2 6582-6590/2 6593-6609/2 6612-6618/2 '
    '6625-6627 6633 6785-6863/2 6868 6880 6885-6887/2 6923-6925/2 6966 6997 7057-7070 7119-7128 '
    '7132 7258-7370/2 7587-7645 8035-8036 8050-8053 8065-8068 8091-8093/2 8096-8182/2 8177 8185 '
    '8189 8193-8197/2 8200-8210/2 8213 8216 8220 8224-8228/2 8312-8348/2 8380-8384/2 8387 '
    '8518-8540 8897 9748-9749 10481 10516 10622 20050 23301-23333 24100 26729-26813 26847-26870 '
    '29872 32001-32058 32064-32077 32099 32164-32167 32664-32667')


def read_las_points(path: Path) -> np.ndarray:
    """
    Read a LAS file, or a LAZ file, which is compressed; leave out noise and withheld points.

    Wrong sizes are found before anything is read. The file is read in a separate process, since
    lazrs ends its process if a file asks for more memory than there is.

    :returns: (N, 3) float64, in the file's unit.
    :raises ValueError: if the file is broken.
    :raises ConfigurationError: if there is no laspy or, for a LAZ file, no lazrs or laszip.
    """
    size = path.stat().st_size
    count, is_laz = _declared_count(path, size)
    need(path.name, 'laspy')
    if is_laz and not find_spec('laszip'):
        need(path.name, 'lazrs')
    rows = read_guarded('las', path, 4, count)
    if len(rows) != count:
        raise ValueError(f'{len(rows):,} of {count:,} points')
    # The fourth column is 0 for noise and withheld points.
    is_kept = rows[:, 3] > 0.0
    if not is_kept.all():
        _log.warning('%s: %s points that it calls noise or withheld left out',
                     printable(path.name), f'{np.count_nonzero(~is_kept):,}')
    return rows[is_kept, :3]


def las_units(path: Path) -> tuple[LengthUnit, LengthUnit]:
    """
    Return the units of length that a LAS file names.

    :returns: the unit of x and y, and the unit of z; the metre if the file names no unit of x and
        y, or is broken; the unit of x and y if the file names no unit of z.
    """
    with path.open('rb') as file:
        records = dict(_projection_records(file))
    # Record 34735 is the projection as GeoTIFF keys, record 2112 as text (WKT).
    by_keys = _units_of_keys(records)
    by_text = _units_of_wkt(records.get(2112, b'').decode('latin-1'))
    plan = by_text[0] or by_keys[0] or METRE
    return plan, by_text[1] or by_keys[1] or plan


def _projection_records(file: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Yield the number and the body of each record of a LAS file about its projection."""
    header = file.read(HEADER_BYTES)
    # The fields that are needed end at byte 104.
    if header[:4] != b'LASF' or len(header) < 104:
        return
    header_bytes, points_offset, count = struct.unpack_from('<HII', header, 94)
    sections = [(header_bytes, points_offset - header_bytes, count, '<2x16sHH',
                 RECORD_HEADER_BYTES)]
    if header[25] >= 4 and len(header) == HEADER_BYTES:
        sections.append((*struct.unpack_from('<Q', header, 235), 1_000_000,
                         *struct.unpack_from('<I', header, 243), '<2x16sHQ',
                         EXTENDED_HEADER_BYTES))
    for start, section_bytes, count, layout, prefix_bytes in sections:
        file.seek(min(start, 1 << 62))
        content = file.read(min(max(section_bytes, 0), 1_000_000))
        position = 0
        for _ in range(count):
            if position + prefix_bytes > len(content):
                break
            user_id, record_id, body_bytes = struct.unpack_from(layout, content, position)
            start, position = position + prefix_bytes, position + prefix_bytes + body_bytes
            if user_id.rstrip(b'\0') == b'LASF_Projection':
                yield record_id, content[start:position]


def _units_of_wkt(text: str) -> tuple[LengthUnit | None, LengthUnit | None]:
    """Return the units of plan and height in the text of a coordinate reference system (WKT)."""
    # UNIT and LENGTHUNIT, not ANGLEUNIT or SCALEUNIT. UNIT may be of angles too.
    unit = re.compile(r'\b(?:LENGTH)?UNIT\s*[\[(]\s*"([^"]*)"\s*,\s*'
                      r'((?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?)\s*[,\])]', re.ASCII)
    angle_name = re.compile('deg|rad|gon|grad|arc|unity', re.IGNORECASE)
    # An axis that points up may have a unit of its own.
    plan_text, *height_texts = re.split(r'\bVERT(?:_CS|CS|CRS|ICALCRS)\b|,\s*up\s*,', text,
                                        maxsplit=1)
    found: list[LengthUnit | None] = []
    for part in (plan_text, ''.join(height_texts)):
        # A system may be bound to another one, with units of its own.
        units = [LengthUnit(name[:60], float(metres))
                 for name, metres in unit.findall(part.partition('TARGETCRS')[0]) if not
                 angle_name.search(name)]
        # The unit of a system stands after those of its parts. Units below a millimetre, or of a
        # kilometre or more, are not accepted.
        found.append(units[-1] if units and 1e-3 <= units[-1].metres < 1e3 else None)
    return found[0], found[1]


def _units_of_keys(records: Mapping[int, bytes]) -> tuple[LengthUnit | None, LengthUnit | None]:
    """Return the units of plan and height that GeoTIFF keys give, by themselves or by a system."""
    # Each key has four numbers of two bytes: the key, where its value is, how many, and its value
    # or its place there.
    body = records.get(34735, b'')
    rows = np.frombuffer(body[:len(body) // 8 * 8], '<u2').reshape(-1, 4).tolist()
    keys = {key: value for key, location, _, value in rows if location == 0}
    texts = {key: records.get(34737, b'')[value:value + count].decode('latin-1')
             for key, location, count, value in rows if location == 34737}
    found: list[LengthUnit | None] = []
    # The keys of the unit, of the system, and of its name; first those of the plan.
    for unit_key, system_key, name_key in ((3076, 3072, 3073), (4099, 4096, 4097)):
        is_in_feet = re.search(r'\b(?:foot|feet|us-?ft|ft-?us|ft)\b', texts.get(name_key, ''),
                               re.IGNORECASE)
        found.append(EPSG_UNITS.get(keys.get(unit_key, 0))
                     or _unit_of_system(keys.get(system_key, 0)) or (FOOT if is_in_feet else None))
    # A unit that the file defines itself has its length, key 3077, among the numbers.
    for key, location, _, value in rows:
        if (key, location, keys.get(3076)) == (3077, 34736, 32767):
            metres, = struct.unpack_from('<d', records.get(34736, b'').ljust(8 * value + 8, b'\0'),
                                         8 * value)
            found[0] = LengthUnit(f'{metres:g} m', metres) if 1e-3 <= metres < 1e3 else found[0]
    return found[0], found[1]


def _unit_of_system(code: int) -> LengthUnit | None:
    """Return the unit of a coordinate reference system, by its EPSG code; None for no system."""
    # 32767 is a system that the file defines itself; 5000 to 5199 were ellipsoids and datums.
    if not 1024 <= code < 32767 or 5000 <= code < 5200:
        return None
    for word in SYSTEMS_IN_FEET.split():
        first, last, step = re.fullmatch(r'(\d+)(?:-(\d+))?(?:/(\d))?', word).groups('')
        if code in range(int(first), int(last or first) + 1, int(step or 1)):
            return FOOT
    return METRE


def _declared_count(path: Path, file_bytes: int) -> tuple[int, bool]:
    """Return the declared number of points and whether they are compressed; refuse wrong sizes."""
    with path.open('rb') as file:
        header = file.read(HEADER_BYTES)
    # The shortest header, that of LAS 1.0, has 227 bytes.
    if header[:4] != b'LASF' or len(header) < 227:
        raise ValueError('no LAS header')
    offset, record_count, format_id, point_bytes, count = struct.unpack_from('<IIBHI', header, 96)
    # Byte 25 is the minor version. LAS 1.4 counts the points with eight bytes too.
    if header[25] >= 4:
        count, = struct.unpack_from('<Q', header.ljust(HEADER_BYTES, b'\0'), 247)
    if offset > file_bytes or RECORD_HEADER_BYTES * record_count > offset:
        raise ValueError(f'{record_count:,} records in the {offset:,} bytes before the points')
    # LAZ sets one of the two highest bits of the format.
    is_compressed = format_id >= 64
    # Real scans need one byte or more per compressed point; a quarter of that is accepted.
    min_bytes = count // 4 if is_compressed else count * point_bytes
    if min_bytes > file_bytes - offset:
        raise ValueError(f'{file_bytes - offset:,} bytes for {count:,} points')
    return count, is_compressed
