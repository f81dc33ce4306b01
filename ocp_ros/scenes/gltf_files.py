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
Read the triangles of glTF 2.0 files (ISO/IEC 12113), also with quantized positions.

Materials, textures, skins and morph targets are ignored.
"""

from base64 import b64decode
from collections.abc import Iterator, Sequence
import json
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np

#: Types of numbers by their codes in accessors.
NUMBER_TYPES: dict[int, np.dtype] = {
    5120: np.dtype('<i1'), 5121: np.dtype('<u1'), 5122: np.dtype('<i2'),
    5123: np.dtype('<u2'), 5125: np.dtype('<u4'), 5126: np.dtype('<f4')}
#: Starts of the names of extensions without which the triangles are the same, and of quantized
#: positions, which are read.
KNOWN_EXTENSIONS = ('KHR_materials', 'KHR_texture', 'EXT_texture', 'KHR_lights', 'KHR_animation',
                    'KHR_xmp', 'KHR_mesh_quantization')
#: How the vertices of a primitive make triangles.
TRIANGLES, FAN = 4, 6


def read_document(path: str) -> tuple[dict[str, Any], bytes]:
    """
    Return the JSON of a glTF file and the binary part of a GLB file, b'' for others.

    :raises ValueError: if the file is broken, or needs an extension that is not known.
    """
    content = Path(path).read_bytes()
    binary = b''
    if content[:4] == b'glTF':
        # After 12 bytes come chunks: their length and type in 4 bytes each, and their content.
        json_end = 20 + int.from_bytes(content[12:16], 'little')
        binary = content[json_end + 8:]
        if len(binary) < int.from_bytes(content[json_end:json_end + 4], 'little'):
            raise ValueError('a binary part that is cut off')
        content = content[20:json_end]
    document = json.loads(content)
    unknown = [name for name in document.get('extensionsRequired', ())
               if not name.startswith(KNOWN_EXTENSIONS)]
    if unknown:
        raise ValueError(f'it needs {" and ".join(unknown)[:120]}, which is not known: export it '
                         'without compression or this extension')
    return document, binary


def buffer_files(path: str) -> list[str]:
    """
    Return the paths of the files that contain the buffers of a glTF file.

    :raises ValueError: if a buffer is outside of the folder or does not exist.
    """
    folder = Path(path).resolve().parent
    files = []
    for buffer in read_document(path)[0].get('buffers', ()):
        # Buffers without a URI or with a data URI are in the file itself.
        uri = buffer.get('uri', 'data:')
        if uri.startswith('data:'):
            continue
        file = (folder / unquote(uri)).resolve()
        if file.parent != folder:
            raise ValueError(f'it names {uri[:60]!r}, which is not in its folder')
        if not file.is_file():
            raise ValueError(f'it names {uri[:60]!r}, where there is no file')
        files.append(str(file))
    return files


def read_triangles(path: str) -> tuple[np.ndarray, np.ndarray, float]:
    """
    Read the triangles of a glTF file, all parts in the frame of its scene.

    :returns: vertices (V, 3) float64 in metres, y up; triangles (T, 3), indices of vertices; and
        the largest step, in metres, to which the file rounds a coordinate.
    :raises ValueError: if the file is broken, or needs an extension that is not known.
    """
    document, binary = read_document(path)
    data = [_buffer(buffer, path, binary) for buffer in document.get('buffers', ())]
    vertices, triangles = [np.empty((0, 3))], [np.empty((0, 3), dtype=np.int64)]
    start, step = 0, 0.0
    for matrix, mesh in _placed_meshes(document):
        for primitive in document['meshes'][mesh]['primitives']:
            if primitive.get('mode', TRIANGLES) < TRIANGLES:
                continue
            local = _accessor(document, data, primitive['attributes']['POSITION'])
            indices = (_accessor(document, data, primitive['indices'])[:, 0].astype(np.int64)
                       if 'indices' in primitive else np.arange(len(local)))
            if len(indices) and not 0 <= indices.min() <= indices.max() < len(local):
                raise ValueError('faces with vertices that are not there')
            if local.dtype == np.float32 and len(local):
                scale = np.linalg.norm(matrix[:3, :3], axis=0).max()
                step = max(step, scale * float(np.spacing(np.nanmax(abs(local)))))
            vertices.append(local @ matrix[:3, :3].T + matrix[:3, 3])
            triangles.append(start + _triangles(indices, primitive.get('mode', TRIANGLES)))
            start += len(local)
    return np.concatenate(vertices), np.concatenate(triangles), step


def _placed_meshes(document: dict[str, Any]) -> Iterator[tuple[np.ndarray, int]]:
    """Yield the transform (4, 4) to the scene and the number of each mesh that a node places."""
    nodes = document.get('nodes', ())
    scenes = document.get('scenes', ())
    children = {child for node in nodes for child in node.get('children', ())}
    roots = (scenes[document.get('scene', 0)].get('nodes', ()) if scenes else
             [number for number in range(len(nodes)) if number not in children])
    open_nodes = [(np.eye(4), number) for number in reversed(roots)]
    seen = set()
    while open_nodes:
        parent, number = open_nodes.pop()
        if number in seen:
            raise ValueError('a node that is placed twice')
        seen.add(number)
        node = nodes[number]
        # A matrix is stored column by column.
        matrix = np.array(node.get('matrix', np.eye(4)), dtype=np.float64).reshape(4, 4).T
        if 'matrix' not in node:
            matrix = np.eye(4)
            matrix[:3, :3] = _rotation(node.get('rotation', (0, 0, 0, 1)))
            matrix[:3, :3] *= node.get('scale', (1, 1, 1))
            matrix[:3, 3] = node.get('translation', (0, 0, 0))
        matrix = parent @ matrix
        open_nodes += [(matrix, child) for child in reversed(node.get('children', ()))]
        if 'mesh' in node:
            yield matrix, node['mesh']


def _rotation(quaternion: Sequence[float]) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a quaternion x, y, z, w."""
    *axis, w = np.divide(quaternion, np.linalg.norm(quaternion))
    # The matrix of the cross product with the axis; Rodrigues' formula.
    cross = np.cross(axis, np.eye(3)).T
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def _buffer(buffer: dict[str, Any], path: str, binary: bytes) -> bytes:
    """Return the bytes of a buffer."""
    uri = buffer.get('uri')
    if uri is None:
        return binary
    if uri.startswith('data:'):
        head, _, body = uri.partition(',')
        return b64decode(body) if head.endswith(';base64') else unquote_to_bytes(body)
    return (Path(path).resolve().parent / unquote(uri)).read_bytes()


def _accessor(document: dict[str, Any], data: list[bytes], number: int) -> np.ndarray:
    """Return the numbers of an accessor, (N, C): float64 if they are quantized to 0 to 1."""
    accessor = document['accessors'][number]
    width = {'SCALAR': 1, 'VEC3': 3}[accessor['type']]
    if 'bufferView' in accessor:
        values = _view(document, data, accessor, accessor['count'], width)
    elif 'sparse' in accessor:
        values = np.zeros((accessor['count'], width), NUMBER_TYPES[accessor['componentType']])
    else:
        raise ValueError('positions that are in no buffer, but perhaps in one of the extensions '
                         f'{" ".join(document.get("extensionsUsed", ()))[:120] or "(none)"}')
    if sparse := accessor.get('sparse'):
        values = values.copy()
        places = _view(document, data, sparse['indices'], sparse['count'], 1)[:, 0]
        values[places] = _view(document, data, {**accessor, 'byteOffset': 0, **sparse['values']},
                               sparse['count'], width)
    if accessor.get('normalized'):
        return np.maximum(values / np.iinfo(values.dtype).max, -1.0)
    return values


def _view(document: dict[str, Any], data: list[bytes], accessor: dict[str, Any], count: int,
          width: int) -> np.ndarray:
    """Return the numbers (count, width) that an accessor finds in its part of a buffer."""
    view = document['bufferViews'][accessor['bufferView']]
    number_type = NUMBER_TYPES[accessor['componentType']]
    offset = view.get('byteOffset', 0) + accessor.get('byteOffset', 0)
    row_bytes = view.get('byteStride', width * number_type.itemsize)
    return np.ndarray((count, width), number_type, data[view['buffer']], offset,
                      (row_bytes, number_type.itemsize))


def _triangles(indices: np.ndarray, mode: int) -> np.ndarray:
    """Return the triangles (T, 3) that the indices (N,) of vertices make."""
    if mode == TRIANGLES:
        return indices[:len(indices) // 3 * 3].reshape(-1, 3)
    if mode == FAN:
        return np.stack([np.full(max(len(indices) - 2, 0), indices[:1].sum()), indices[1:-1],
                         indices[2:]], axis=1)
    strip = np.stack([indices[:-2], indices[1:-1], indices[2:]], axis=1)
    # Each second triangle of a strip is the other way round.
    strip[1::2] = strip[1::2, [1, 0, 2]]
    return strip
