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
Read and write arrays as a safetensors blob, which contains no code.

A blob is the length of the header (uint64), the header (JSON) and the arrays, all little-endian
and without gaps; see https://github.com/huggingface/safetensors. Ubuntu, from whose packages the
nodes of a robot are installed, has no package of the library of that name.
"""

from collections.abc import Mapping
import json
import math
import struct
from typing import Any, BinaryIO

import numpy as np

#: NumPy's type of each type of the format.
TYPES = {'F64': '<f8', 'F32': '<f4', 'F16': '<f2', 'I64': '<i8', 'I32': '<i4', 'I16': '<i2',
         'I8': '|i1', 'U64': '<u8', 'U32': '<u4', 'U16': '<u2', 'U8': '|u1', 'BOOL': '|b1'}
NAMES = {np.dtype(kind): name for name, kind in TYPES.items()}
LENGTH = struct.Struct('<Q')


def write_blob(file: BinaryIO, arrays: Mapping[str, np.ndarray],
               metadata: Mapping[str, str] | None = None) -> None:
    """
    Write arrays to a file.

    :param arrays: by name, of types in ``TYPES``.
    :param metadata: texts by name.
    """
    # The library writes large elements first, so that all are aligned.
    names = sorted(arrays, key=lambda name: (-arrays[name].itemsize, name))
    header: dict[str, Any] = {'__metadata__': dict(metadata)} if metadata else {}
    end = 0
    for name in names:
        array, begin, end = arrays[name], end, end + arrays[name].nbytes
        header[name] = {'dtype': NAMES[array.dtype], 'shape': list(array.shape),
                        'data_offsets': [begin, end]}
    text = json.dumps(header, separators=(',', ':')).encode()
    text += b' ' * (-len(text) % LENGTH.size)
    file.write(LENGTH.pack(len(text)) + text)
    for name in names:
        file.write(np.ascontiguousarray(arrays[name]).data)


def read_blob(blob: Any) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """
    Return the arrays of a blob and its metadata.

    :param blob: bytes, or an array of uint8 such as a mapped file. The arrays are views of it, and
        read-only if it is.
    :raises ValueError: if the blob is incomplete or damaged.
    """
    header, first = _read_header(blob)
    metadata = header.pop('__metadata__', {})
    arrays, spans = {}, []
    for name, entry in header.items():
        try:
            kind, shape, (begin, end) = (
                np.dtype(TYPES[entry['dtype']]), entry['shape'], entry['data_offsets'])
            if not all(type(number) is int and number >= 0 for number in (*shape, begin, end)) or (
                    end - begin != math.prod(shape) * kind.itemsize):
                raise ValueError('shape and offsets do not agree')
            arrays[name] = np.frombuffer(
                blob, kind, math.prod(shape), first + begin).reshape(shape)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise ValueError(f'damaged entry {name!r} ({error})') from error
        spans.append((begin, end))
    position = 0
    for begin, end in sorted(spans):
        if begin != position:
            raise ValueError('arrays that overlap, or bytes that belong to none')
        position = end
    if position != len(blob) - first:
        raise ValueError(f'{len(blob) - first} bytes of arrays, not {position}')
    return arrays, metadata


def _read_header(blob: Any) -> tuple[dict[str, Any], int]:
    """Return the header of a blob, and the number of the first byte after it."""
    # A blob shorter than the length is padded here, and refused below.
    (length,) = LENGTH.unpack(bytes(blob[:LENGTH.size]).ljust(LENGTH.size, b'\0'))
    first = LENGTH.size + length
    if first > len(blob):
        raise ValueError(f'{len(blob)} bytes are too few for a header of {length}')
    try:
        header = json.loads(bytes(blob[LENGTH.size:first]))
    except RecursionError as error:
        raise ValueError(f'damaged header ({error})') from error
    if not isinstance(header, dict) or not isinstance(header.get('__metadata__', {}), dict):
        raise ValueError(f'a header of {type(header).__name__}; expected entries by name')
    return header, first
