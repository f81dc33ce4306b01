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

"""Intrinsic and extrinsic parameters: nerfstudio, COLMAP and NVIDIA Metropolis."""

from collections.abc import Iterator
import json
from typing import Any

import numpy as np
from ocp_ros.formats.exported import Exported, Pinhole, pose_matrix
from ocp_ros.geometry.cameras import rotation_matrix, view_grid
from scipy.spatial.transform import Rotation


def image_name(camera: Pinhole) -> str:
    """Return the name of the image that a user takes with a camera."""
    return f'{camera.frame.replace("/", "_")}.png'


def nerfstudio_of(exported: Exported) -> str:
    """
    Return ``transforms.json`` of nerfstudio: camera axes as in OpenGL, world z up, metres.

    Source: nerfstudio documentation, data conventions.
    """
    frames = []
    for camera in exported.pinholes('nerfstudio'):
        (width, height), (fx, fy) = camera.size, camera.focal
        frames.append({
            'file_path': f'images/{image_name(camera)}', 'w': width, 'h': height, 'fl_x': fx,
            'fl_y': fy, 'cx': 0.5 * width, 'cy': 0.5 * height,
            'transform_matrix': pose_matrix(camera.placed, 'opengl').tolist()})
    return json.dumps({'camera_model': 'OPENCV', 'frames': frames}, indent=1) + '\n'


def colmap_of(exported: Exported) -> Iterator[str]:
    """
    Yield ``cameras.txt``, ``images.txt`` and ``points3D.txt`` of COLMAP, one camera an image.

    Source: COLMAP documentation, output format: from the world to the optical frame.
    """
    cameras, images = ['# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY'], [
        '# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME', '# POINTS2D[] as X Y POINT3D_ID']
    for number, camera in enumerate(exported.pinholes('COLMAP'), start=1):
        (width, height), (fx, fy) = camera.size, camera.focal
        cameras.append(f'{number} PINHOLE {width} {height} {fx!r} {fy!r} '
                       f'{0.5 * width!r} {0.5 * height!r}')
        x, y, z, w = Rotation.from_matrix(camera.from_world[:3, :3]).as_quat().tolist()
        pose = ' '.join(map(repr, (w, x, y, z, *camera.from_world[:3, 3].tolist())))
        # The second line of an image lists its points: it has none.
        images += [f'{number} {pose} {number} {image_name(camera)}', '']
    yield '\n'.join([*cameras, ''])
    yield '\n'.join([*images, ''])
    yield '# POINT3D_ID X Y Z R G B ERROR TRACK[] as IMAGE_ID POINT2D_IDX\n'


def metropolis_of(exported: Exported) -> str:
    """
    Return ``calibration.json`` of NVIDIA Metropolis: a Cartesian calibration in metres.

    Source: NVIDIA VSS documentation, calibration schema. The homography maps the floor to pixels.

    :raises ConfigurationError: if z of the files is not up.
    """
    exported.check_z_up('metropolis')
    assessed = exported.assessed
    floor = exported.to_file(np.array([0.0, 0.0, assessed.floors.height]))[2] if assessed else 0.0
    sensors = [_metropolis_sensor(camera, float(floor))
               for camera in exported.pinholes('Metropolis')]
    return json.dumps({'version': '1.0', 'osmURL': '', 'calibrationType': 'cartesian',
                       'sensors': sensors}, indent=1) + '\n'


def _metropolis_sensor(camera: Pinhole, floor: float) -> dict[str, Any]:
    """Return a camera as a sensor of Metropolis; ``floor`` is z of the floor, metres."""
    x, y, z = camera.placed.position
    projection = camera.matrix @ camera.from_world[:3]
    homography = np.column_stack([projection[:, :2], floor * projection[:, 2] + projection[:, 3]])
    # Places on the floor in the image, within the range.
    directions = view_grid(camera.placed.camera.model, 5, 5).reshape(-1, 3)
    directions = directions @ rotation_matrix(*camera.placed.pose[3:]).T
    distances = (floor - z) / np.minimum(directions[:, 2], -1e-9)
    shown = (distances > 0.0) & (distances <= camera.placed.camera.model.max_range)
    places = camera.placed.position + distances[shown, None] * directions[shown]
    pixels = (camera.matrix @ (camera.from_world[:3, :3] @ places.T
                               + camera.from_world[:3, 3:])).T
    pixels = pixels[:, :2] / pixels[:, 2:]
    attributes = {'fps': 30, 'frameWidth': camera.size[0], 'frameHeight': camera.size[1],
                  'direction': (90.0 - camera.placed.angles[0]) % 360.0, 'depth': '',
                  'fieldOfView': np.rad2deg(camera.placed.camera.model.horizontal_fov)}
    return {
        'type': 'camera', 'id': camera.placed.camera.name, 'origin': {'lng': 0.0, 'lat': 0.0},
        'geoLocation': {'lng': 0.0, 'lat': 0.0}, 'coordinates': {'x': x, 'y': y, 'z': z},
        'scaleFactor': 1.0, 'translationToGlobalCoordinates': {'x': 0.0, 'y': 0.0},
        'attributes': [{'name': key, 'value': f'{value}'} for key, value in attributes.items()],
        'place': [{'name': 'room', 'value': 'room'}],
        'imageCoordinates': [dict(zip('xy', place)) for place in pixels.tolist()],
        'globalCoordinates': [dict(zip('xyz', place)) for place in places.tolist()],
        'intrinsicMatrix': camera.matrix.tolist(),
        'extrinsicMatrix': camera.from_world[:3].tolist(), 'cameraMatrix': projection.tolist(),
        'homography': homography.tolist(), 'tripwires': [], 'rois': []}
