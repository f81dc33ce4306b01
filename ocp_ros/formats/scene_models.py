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

"""Cameras and their fields of view in 3D scenes: USD and glTF."""

from base64 import b64encode
import json
import re
from typing import Any

import numpy as np
from ocp_ros.formats.exported import Exported, pose_matrix
from ocp_ros.geometry.cameras import CameraModel, PINHOLE, view_grid
from ocp_ros.report.camera_words import camera_colour
from ocp_ros.scenes.source_frame import map_from_file

#: Horizontal aperture of a camera in USD, tenths of a unit: its default, that of a 35 mm film.
APERTURE = 20.955
#: The least near clipping distance, metres.
MIN_CLIP_M = 0.01
#: Number of directions along each edge of a field of view.
GRID = 17
#: The rotation from z up to y up, which glTF requires.
Y_UP = np.eye(4)
Y_UP[:3, :3] = map_from_file('y').T


def usd_of(exported: Exported) -> str:
    """
    Return a USD stage with a ``UsdGeom.Camera`` for each camera: metres, z up.

    The focal length has the ratio to the aperture that gives the field of view. A camera without
    image plane is an ``Xform`` with the same axes. Source: OpenUSD, UsdGeomCamera.

    :raises ConfigurationError: if z of the files is not up, as for ``gltf_of``.
    """
    exported.check_z_up('usd')
    prims = ''
    for number, placed in exported.cameras():
        model, matrix = placed.camera.model, pose_matrix(placed, 'opengl')
        # USD multiplies row vectors by matrices.
        rows = ', '.join(f'({", ".join(map(repr, row))})' for row in matrix.T.tolist())
        lines = [f'custom string ocp:name = {json.dumps(placed.camera.name)}',
                 f'matrix4d xformOp:transform = ( {rows} )',
                 'uniform token[] xformOpOrder = ["xformOp:transform"]']
        lens, kind = model.lens, 'Xform'
        if lens.kind == PINHOLE:
            kind = 'Camera'
            near = max(model.min_range, MIN_CLIP_M)
            focal = 0.5 * APERTURE / lens.half_horizontal
            lines += [f'float2 clippingRange = ({near!r}, {model.max_range!r})',
                      f'float focalLength = {focal!r}', f'float horizontalAperture = {APERTURE!r}',
                      f'float verticalAperture = {2.0 * focal * lens.half_vertical!r}',
                      'token projection = "perspective"']
        name = re.sub(r'\W', '_', exported.frame(number))
        prims += f'    def {kind} "{name}"\n    {{\n' + ''.join(
            f'        {line}\n' for line in lines) + '    }\n\n'
    return ('#usda 1.0\n(\n    defaultPrim = "Cameras"\n    metersPerUnit = 1\n'
            f'    upAxis = "Z"\n)\n\ndef Xform "Cameras"\n{{\n{prims}}}\n')


def gltf_of(exported: Exported) -> str:
    """
    Return cameras and the bodies of their fields of view as glTF 2.0: metres, y up.

    A node has the name of the camera's frame; the body, which ends at the range, has the same name
    with ``_field_of_view`` after it.
    """
    exported.check_z_up('gltf')
    content: dict[str, Any] = {
        'asset': {'version': '2.0', 'generator': 'ocp_ros'}, 'scene': 0, 'scenes': [{'nodes': []}],
        'nodes': [], 'cameras': [], 'meshes': [], 'materials': [], 'accessors': [],
        'bufferViews': [], 'buffers': []}
    buffer = b''
    for number, placed in exported.cameras():
        model, lens = placed.camera.model, placed.camera.model.lens
        # glTF writes matrices column by column.
        matrix = (Y_UP @ pose_matrix(placed, 'opengl')).T.ravel().tolist()
        node = {'name': exported.frame(number), 'matrix': matrix,
                'extras': {'name': placed.camera.name}}
        if lens.kind == PINHOLE:
            node['camera'] = len(content['cameras'])
            content['cameras'].append({
                'type': 'perspective', 'name': placed.camera.name, 'perspective': {
                    'yfov': model.vertical_fov, 'zfar': model.max_range,
                    'aspectRatio': lens.half_horizontal / lens.half_vertical,
                    'znear': max(model.min_range, MIN_CLIP_M)}})
        body = {'name': f'{exported.frame(number)}_field_of_view', 'matrix': matrix,
                'mesh': len(content['meshes'])}
        content['nodes'] += [node, body]
        content['materials'].append({
            'name': placed.camera.name, 'alphaMode': 'BLEND', 'doubleSided': True,
            'pbrMetallicRoughness': {'baseColorFactor': [*_rgb(camera_colour(number)), 0.25],
                                     'metallicFactor': 0.0}})
        vertices, triangles = field_of_view_body(model)
        # From the body frame to the axes of OpenGL: x right, y up, z backward.
        vertices = np.column_stack([-vertices[:, 1], vertices[:, 2], -vertices[:, 0]])
        for kind, array, target in (('VEC3', vertices.astype('<f4'), 34962),
                                    ('SCALAR', triangles.ravel().astype('<u4'), 34963)):
            accessor = {'bufferView': len(content['bufferViews']), 'type': kind,
                        'componentType': 5126 if kind == 'VEC3' else 5125, 'count': len(array)}
            if kind == 'VEC3':
                accessor |= {'min': array.min(axis=0).tolist(), 'max': array.max(axis=0).tolist()}
            content['accessors'].append(accessor)
            content['bufferViews'].append({'buffer': 0, 'byteOffset': len(buffer),
                                           'byteLength': array.nbytes, 'target': target})
            buffer += array.tobytes()
        content['meshes'].append({'name': body['name'], 'primitives': [{
            'attributes': {'POSITION': len(content['accessors']) - 2},
            'indices': len(content['accessors']) - 1, 'material': len(content['materials']) - 1}]})
    content['scenes'][0]['nodes'] = list(range(len(content['nodes'])))
    data = b64encode(buffer).decode()
    content['buffers'] = [{'byteLength': len(buffer),
                           'uri': f'data:application/octet-stream;base64,{data}'}]
    # Without any camera, glTF allows no empty list.
    return json.dumps({key: value for key, value in content.items() if value != []}) + '\n'


def _rgb(colour: str) -> list[float]:
    """Return a colour such as ``#0072b2`` as shares of red, green and blue."""
    return [byte / 255.0 for byte in bytes.fromhex(colour[1:])]


def field_of_view_body(model: CameraModel) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the body of a field of view up to the range, as a mesh.

    :returns: (V, 3) vertices, metres, body frame (x forward, y left, z up), the first one being
        the camera; and (T, 3) indices of triangles, counter-clockwise seen from outside.
    """
    grid = 1 + np.arange(GRID * GRID).reshape(GRID, GRID)
    ends = model.max_range * view_grid(model, GRID, GRID).reshape(-1, 3)
    vertices = np.vstack([np.zeros(3), ends])
    if whole_turn := model.horizontal_fov >= 2.0 * np.pi - 1e-9:
        grid[:, -1] = grid[:, 0]
    if model.omnidirectional:
        # Each pole is one vertex.
        grid[0], grid[-1] = grid[0, 0], grid[-1, 0]
    # Each cell of the grid, by its corners from the top left one on, as two triangles.
    first, second, third, fourth = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    triangles = [np.stack([first, third, second], -1), np.stack([first, fourth, third], -1)]
    # Between an edge of the outer surface and the camera.
    edges = [] if model.omnidirectional else [grid[0], grid[-1, ::-1]]
    if not whole_turn:
        edges += [grid[::-1, 0], grid[:, -1]]
    for edge in edges:
        triangles.append(np.stack([np.zeros_like(edge[1:]), edge[1:], edge[:-1]], -1))
    faces = np.concatenate([part.reshape(-1, 3) for part in triangles])
    return vertices, faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
