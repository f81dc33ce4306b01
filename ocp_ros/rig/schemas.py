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
JSON Schemas of rig files and placement files: every key, its unit, its range, an example.

Editors complete and check files with them (docs/rig.schema.json, docs/placement.schema.json).
Messages about an invalid file use their descriptions and examples.
"""

from ocp_ros.geometry.visibility import MESH, PRESETS
from ocp_ros.rig.sensors import KINDS
from ocp_ros.scenes.source_frame import UP_AXES
from ocp_ros.util.settings import MAX_ROOM_POINTS, MIN_ROOM_POINTS
from ocp_ros.util.yaml_files import (
    array,
    many,
    mapping,
    number,
    one_of,
    one_or_two,
    Schema,
    text,
    whole,
)

MOUNTS = ('plane', 'ceiling', 'walls', 'free')
#: Metres: the limit of all coordinates in a room.
MAX_COORDINATE_M = 1000.0
#: The largest number of characters of a name.
MAX_NAME_LENGTH = 60
#: Degrees: the least field of view of a depth camera.
MIN_FOV_DEG = 1.0
POINT = {'type': 'number', 'minimum': -MAX_COORDINATE_M, 'maximum': MAX_COORDINATE_M}

NAME = text(f'a name of letters, digits, _, - and blanks, at most {MAX_NAME_LENGTH}', 'door',
            pattern=f'^[A-Za-z0-9_][A-Za-z0-9_ -]{{0,{MAX_NAME_LENGTH - 1}}}$')
MODEL: dict[str, Schema] = {
    'sensor': one_of(KINDS, 'realsense_d455'),
    'horizontal_fov': number(f'degrees from {MIN_FOV_DEG:g} to 360', 90.0, minimum=MIN_FOV_DEG,
                             maximum=360),
    'vertical_fov': number(f'degrees from {MIN_FOV_DEG:g} to 180', 60.0, minimum=MIN_FOV_DEG,
                           maximum=180),
    'focal_length': number('millimetres from 0.1 to 1000, with sensor_size', 4.0, minimum=0.1,
                           maximum=1000),
    'sensor_size': many('width and height in millimetres from 0.1 to 1000, with focal_length',
                        {'type': 'number', 'minimum': 0.1, 'maximum': 1000}, [5.4, 3.0], 2, 2),
    'min_range': number('metres from 0 to 100', 0.3, minimum=0, maximum=100),
    'max_range': number('metres from 0.05 to 1000', 5.0, minimum=0.05, maximum=MAX_COORDINATE_M),
    'resolution': many('whole pixels across and down, both from 1 to 20000',
                       {'type': 'integer', 'minimum': 1, 'maximum': 20000}, [640, 480], 2, 2),
    'depth_noise': many('constant, linear and quadratic part of the standard deviation of a depth '
                        'in millimetres, the depth in metres', {
                            'type': 'number', 'minimum': -1000, 'maximum': 1000},
                        [1.0, 0.0, 2.5], 3, 3),
}
#: ROS 2 drivers that the launch file can start.
DRIVERS = ('realsense2_camera', 'orbbec_camera', 'depthai_ros_driver', 'azure_kinect')
SERIAL = text('a serial number in quotes, of letters, digits, _, . and -', '034422073314',
              pattern='^[A-Za-z0-9_.-]{1,60}$')
NAMESPACE = text('a namespace of ROS without a slash at either end', 'hall',
                 pattern='^[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*$')
#: What connects a camera to a computer.
DEVICE: dict[str, Schema] = {
    'serial': SERIAL, 'driver': one_of(DRIVERS, 'realsense2_camera'), 'namespace': NAMESPACE,
    'host': text('the name of the computer that the camera is connected to', 'pc1',
                 pattern='^[A-Za-z0-9_.-]{1,60}$')}
BOOLEAN = {'description': 'true or false', 'type': 'boolean', 'examples': [True]}
#: Levels of pixel density by name, pixels per metre: EN 62676-4:2025, then detection, observation,
#: recognition and identification (DORI) of EN 62676-4:2015.
PIXEL_DENSITIES = {
    'overview': 20.0, 'outline': 40.0, 'discern': 80.0, 'perceive': 125.0, 'characterise': 250.0,
    'validate': 500.0, 'scrutinise': 1500.0,
    'detect': 25.0, 'observe': 62.5, 'recognise': 125.0, 'identify': 250.0}
#: What the points of a region, or of the whole room, require.
REQUIRE = mapping(
    'a mapping with one condition or more', {'pixel_density': 'recognise'}, (),
    pixel_density={
        'description': 'pixels per metre above 0, or one of ' + ', '.join(PIXEL_DENSITIES),
        'anyOf': [{'type': 'number', 'exclusiveMinimum': 0, 'maximum': 1e6},
                  {'enum': list(PIXEL_DENSITIES)}], 'examples': ['recognise']},
    depth_accuracy=number('millimetres above 0, the largest standard deviation of a depth', 10.0,
                          exclusiveMinimum=0, maximum=1000),
    incidence=number('degrees from 1 to 90', 60.0, minimum=1, maximum=90),
    seen_by=whole('a whole number of cameras, 1 or more', 2, minimum=1, maximum=64),
    angle=number('degrees, 0 to 120', 30.0, minimum=0, maximum=120),
    around=BOOLEAN, one_may_fail=BOOLEAN,
    share=number('the share of the points that has to meet it, above 0, at most 1', 0.95,
                 exclusiveMinimum=0, maximum=1)) | {'minProperties': 1, 'remedies': {
                     'density': "write 'pixel_density'", 'accuracy': "write 'depth_accuracy'"}}
#: What the whole room requires.
ROOM_REQUIRE: Schema = REQUIRE | {'properties': {
    **REQUIRE['properties'], 'interference': one_of(('none',), 'none')}}
POSITION = many('x, y and z in metres, map frame', POINT, [1.0, 2.0, 2.2], 3, 3)
ANGLES: dict[str, Schema] = {
    'yaw': number('degrees counter-clockwise from the x axis, -360 to 360', 90.0, minimum=-360,
                  maximum=360),
    'pitch': number('degrees downwards, -90 to 90', 20.0, minimum=-90, maximum=90),
    'roll': number('degrees about the viewing direction, -180 to 180', 0.0, minimum=-180,
                   maximum=180),
}
#: A zone is a box, or a polygon between two heights.
ZONE = {'box': many('the lowest and the highest corner, metres, map frame', array(POINT, 3, 3),
                    [[0, 0, 0], [1, 1, 3]], 2, 2),
        'polygon': many('three or more corners x, y in metres, map frame', array(POINT, 2, 2),
                        [[0, 0], [2, 0], [2, 1]], 3, 1000),
        'height': many('the lowest and the highest metres above the floor', POINT, [0.0, 3.0],
                       2, 2)}
#: What to do about keys that other programs have.
MODEL_REMEDIES = {
    **dict.fromkeys(('hfov', 'h_fov', 'fov_h', 'fov_horizontal', 'fov_x', 'fovx', 'hfov_deg'),
                    "write 'horizontal_fov'"),
    **dict.fromkeys(('vfov', 'v_fov', 'fov_v', 'fov_vertical', 'fov_y', 'fovy', 'vfov_deg'),
                    "write 'vertical_fov'"),
    **dict.fromkeys(('fov', 'dfov', 'diagonal_fov', 'angle', 'field_of_view', 'angle_of_view',
                     'aov', 'fov_deg'), "write 'horizontal_fov' and 'vertical_fov'"),
    **dict.fromkeys(('fx', 'fy', 'cx', 'cy', 'intrinsics'),
                    "write 'horizontal_fov' and 'vertical_fov', which are 2 atan(width / (2 fx)) "
                    'and 2 atan(height / (2 fy)) in degrees'),
    **dict.fromkeys(('width', 'pixels'), "write 'resolution: [640, 480]'"),
    **dict.fromkeys(('range', 'distance', 'far'), "write 'max_range'"),
    'near': "write 'min_range'",
    **dict.fromkeys(('model', 'type', 'camera'), "write 'sensor'")}
#: What to do about other words for a pose.
POSE_REMEDIES = {
    **dict.fromkeys(('pose', 'x', 'y', 'z', 'xyz', 'location', 'place', 'translation'),
                    "write 'position: [x, y, z]', and yaw, pitch and roll in degrees"),
    **dict.fromkeys(('pan', 'heading', 'azimuth', 'rotation', 'orientation'), "write 'yaw'"),
    'tilt': "write 'pitch'"}
WALL_REMEDIES = dict.fromkeys(
    ('wall', 'walls', 'side', 'surface', 'which', 'only', 'zone', 'box', 'polygon'),
    "write 'keep_in' beside cameras, with a box along the wall: "
    'keep_in: [{box: [[0, 0, 0], [6, 0.3, 3]]}]') | dict.fromkeys(
        ('exclude', 'not', 'except'), "write 'keep_out' beside cameras, with a box along the wall")
CAMERA: Schema = mapping(
    'a sensor, or horizontal_fov, vertical_fov and max_range',
    {'sensor': 'realsense_d455', 'count': 3}, (), **MODEL, name=NAME, **{
        **DEVICE, 'serial': {'description': 'a serial number in quotes, or a list of one for each '
                             'camera of the group', 'anyOf': [SERIAL, array(SERIAL, 1, 64)],
                             'examples': ['034422073314'],
                             'remedies': {'int': "put it in quotes: serial: '034422073314'"}}},
    price=number('the price of one camera, 0 or more', 419.0, minimum=0, maximum=1e6),
    count=whole('a whole number from 1 to 64', 3, minimum=1, maximum=64) | {'remedies': {
        '0': 'leave out the entry', **dict.fromkeys(
            ('str', 'list', 'NoneType', 'dict'), 'write a number, or leave it out and choose the '
            'number by ocp plan --cameras auto')}}) | {
    'remedies': MODEL_REMEDIES | WALL_REMEDIES | {
        **dict.fromkeys(('mount', 'on', 'height', 'heights', 'ceiling', 'footprint'),
                        "write one 'mount' beside cameras: all groups have it; plan groups with "
                        "other mounts one after the other, with the first ones as 'fixed'"),
        **dict.fromkeys(('position', 'yaw', 'fixed', *POSE_REMEDIES), 'write a camera with a pose '
                        "under 'fixed', or all of them in a placement file for ocp score"),
        **dict.fromkeys(('pitch', 'roll'), 'write it beside cameras, for all groups'),
        **dict.fromkeys(('max_count', 'most'), 'leave it out, and choose the number by ocp plan '
                        '--cameras auto --most 5'),
        **dict.fromkeys(('number', 'amount', 'n', 'quantity'), "write 'count'")}}
FIXED = mapping(
    'a camera and its position', {'sensor': 'kinect_v2', 'position': [1.0, 2.0, 2.2], 'yaw': 90},
    ('position',), **MODEL, **ANGLES, position=POSITION, name=NAME, **DEVICE) | {
    'remedies': MODEL_REMEDIES | POSE_REMEDIES | {
        'count': 'write an entry with its pose for each camera'}}
KEEP_OUT = mapping('a box or a polygon', {'box': [[0, 0, 0], [1, 1, 3]]}, (), **ZONE) | {
    'remedies': dict.fromkeys(('wall', 'walls', 'side', 'name'), 'write a box along the wall: '
                              'box: [[0, 0, 0], [6, 0.3, 3]]')}
REGION = mapping(
    'a name with a box or a polygon', {'name': 'table', 'box': [[1, 1, 0.5], [2, 2, 1.2]]},
    ('name',), name=NAME, **ZONE,
    air=mapping(
        'a mapping with seen_by, angle, around or none', {'seen_by': 2, 'angle': 30}, (),
        around=BOOLEAN,
        seen_by=whole('a whole number of cameras, 1 or more', 2, minimum=1, maximum=64),
        angle=number('degrees, 0 to 120', 30.0, minimum=0, maximum=120)) | {
            'remedies': dict.fromkeys(('bool', 'NoneType', 'str', 'list'), 'write air: {}') | {
                'int': 'write air: {seen_by: 2}'}},
    weight=number('a number from 0 to 1000, the whole room being 1', 3.0, minimum=0,
                  maximum=1000),
    must_see={'description': 'true, false or the share that has to be seen, above 0, at most 1',
              'anyOf': [{'type': 'boolean'},
                        {'type': 'number', 'exclusiveMinimum': 0, 'maximum': 1}],
              'examples': [True]}, require=REQUIRE) | {
    'remedies': dict.fromkeys(
        ('volume', 'space', 'empty', 'in_air', 'is_air', 'free_space', 'free', 'kind', 'type',
         'of', 'what', 'points', 'air_seen_by'), 'write air: {} for a region of air') | {
             **dict.fromkeys(('seen_by', 'angle', 'around'), "write it under 'air' or 'require'"),
             **dict.fromkeys(('pixel_density', 'depth_accuracy', 'incidence', 'share'),
                             "write it under 'require'")}}
NO_CAMERAS = ('write the cameras to be placed, such as cameras: [{sensor: realsense_d455}], or '
              'score those that hang already as the cameras of a placement file (ocp score)')
RIG = mapping(
    'a rig with the key cameras', {'cameras': [{'sensor': 'realsense_d455', 'count': 3}]},
    ('cameras',),
    cameras=many('a list of one camera or more', CAMERA, [{'sensor': 'realsense_d455'}], 1) | {
        'remedies': {
            **dict.fromkeys(('[]', '{}', 'null', 'none', '0'), NO_CAMERAS),
            'auto': 'write a sensor, and choose the number by ocp plan --cameras auto'}},
    fixed=many('a list of cameras that stay where they are', FIXED,
               [{'sensor': 'kinect_v2', 'position': [1.0, 2.0, 2.2]}]),
    mount=mapping(
        'a mapping with the key on', {'on': 'plane', 'height': 1.9}, ('on',),
        on=one_of(MOUNTS, 'plane') | {'remedies': {
            **dict.fromkeys(('tripod', 'tripods', 'stand', 'floor', 'pole', 'poles', 'table'),
                            'write on: plane, with the height of the cameras'),
            **dict.fromkeys(('rail', 'rails', 'truss', 'rod', 'rods', 'beam', 'frame', 'edge'),
                            "write on: free, with heights, and 'keep_in' along it"),
            **dict.fromkeys(('roof', 'top'), 'write on: ceiling'),
            'list': 'write one of them; on: free allows all places between two heights'}},
        height=one_or_two('metres above the floor, for walls and free one number or [low, high]',
                          1.9, 0.0, 100.0),
        footprint=number('metres, 0 to 5', 0.4, minimum=0, maximum=5)) | {
            'remedies': WALL_REMEDIES | {on: f'write mount: {{on: {on}}}' for on in MOUNTS} | {
                'list': 'write one mount; plan groups with other mounts one after the other, with '
                        "the first ones as 'fixed'"}},
    motion=mapping(
        'a mapping with max_step, max_turn or turns', {'max_step': 1.5, 'max_turn': 90}, (),
        max_step=number('metres from 0.001 to 10', 1.5, minimum=0.001, maximum=10),
        max_turn=number('degrees, 0 to 180', 90.0, minimum=0, maximum=180),
        turns=whole('a whole number from 1 to 100000', 12, minimum=1, maximum=100000)),
    pitch=one_or_two('degrees downwards, one number or [low, high] within -90 to 90', [0, 60],
                     -90, 90),
    roll=many('the rolls that the mount offers, degrees, -180 to 180',
              {'type': 'number', 'minimum': -180, 'maximum': 180}, [0, 90], 1, 8),
    keep_clear=number('metres, 0 to 10', 0.2, minimum=0, maximum=10),
    spacing=number('metres, 0 to 100', 0.5, minimum=0, maximum=100),
    keep_in=many('a list of boxes and polygons', KEEP_OUT,
                 [{'box': [[0, 0, 2.4], [4, 0.3, 2.6]]}], 0, 1000),
    keep_out=many('a list of boxes and polygons', KEEP_OUT, [{'box': [[0, 0, 0], [1, 1, 3]]}], 0,
                  1000),
    regions=many('a list of regions', REGION,
                 [{'name': 'table', 'box': [[1, 1, 0.5], [2, 2, 1.2]]}], 0, 1000),
    seen_by=whole('a whole number of cameras, 1 or more', 2, minimum=1, maximum=64),
    require=ROOM_REQUIRE, computer=POSITION,
    calibratable=mapping(
        'a mapping with overlap, angle or neither', {'overlap': 0.2, 'angle': 60}, (),
        overlap=number('a share above 0, at most 1', 0.2, exclusiveMinimum=0, maximum=1),
        angle=number('degrees above 0, at most 180', 60.0, exclusiveMinimum=0, maximum=180))) | {
    'remedies': WALL_REMEDIES | {
        **dict.fromkeys(('height', 'heights', 'on', 'ceiling', 'mounts', 'footprint'),
                        "write it under 'mount', such as mount: {on: plane, height: 1.9}"),
        **dict.fromkeys(('sensor', 'sensors', 'count', 'number', 'name', 'resolution',
                         'horizontal_fov', 'vertical_fov', 'max_range', 'min_range', 'hfov',
                         'vfov', 'fov'), "write it in an entry of 'cameras', such as "
                        'cameras: [{sensor: realsense_d455, count: 3}]'),
        **dict.fromkeys(('zone', 'zones', 'areas', 'targets'), "write 'regions'")}}
PLACED = mapping(
    'a camera and its position', {'sensor': 'kinect_v2', 'position': [1.0, 2.0, 2.2], 'yaw': 90},
    ('position',), name=NAME, **MODEL, **DEVICE, position=POSITION, **ANGLES,
    mount={'description': f'fixed or one of {", ".join(MOUNTS)}', 'enum': ['fixed', *MOUNTS],
           'examples': ['plane']},
    planned=mapping('where the camera was planned, if it was found to hang elsewhere',
                    {'position': [1.0, 2.0, 2.2], 'yaw': 90}, ('position',), position=POSITION,
                    **ANGLES)) | {'remedies': MODEL_REMEDIES | POSE_REMEDIES}
ROOM = mapping(
    'a mapping with the key file or seed', {'file': 'room.ply'}, (),
    file=text('the path of a scan', 'room.ply'),
    seed=whole('the seed of a generated room', 7, minimum=0),
    sha256=text('the SHA-256 of the file, or of the points of a generated room, as 64 hexadecimal '
                'digits', '0' * 64, pattern='^[0-9a-f]{64}$'),
    points=whole('the most points that are kept of the scan, 1000 or more', 25000,
                 minimum=MIN_ROOM_POINTS, maximum=MAX_ROOM_POINTS),
    scale=number('metres per unit of the file, above 0', 1.0, exclusiveMinimum=0),
    up=one_of(UP_AXES, 'z'),
    drop_nonfinite=BOOLEAN, all_rooms=BOOLEAN, open_doors=BOOLEAN,
    height=number('metres from 0.5 to 100', 2.7, minimum=0.5, maximum=100),
    layers=text('names of layers with commas', 'A-WALL'),
    storey=text('the name of a storey', 'Ground floor'),
    space=text('the name of a space', 'Office 1'),
    source_from_map={
        'description': 'four rows of four numbers: map coordinates to those of the scan',
        'type': 'array', 'minItems': 4, 'maxItems': 4,
        'items': {'type': 'array', 'minItems': 4, 'maxItems': 4, 'items': {'type': 'number'}},
        'examples': [[[1, 0, 0, 500], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]]})
ENGINE = mapping(
    'settings of the engine', {'preset': 'fine'}, (),
    preset=one_of((*PRESETS, MESH), 'fine'), viewpoints=one_of(('air', 'paper'), 'air'),
    error_rows=whole('a whole number from 16 to 1024', 128, minimum=16, maximum=1024),
    error_folds=whole('a whole number from 1 to 16', 4, minimum=1, maximum=16),
    coverage_cell=number('metres from 0.02 to 5', 0.25, minimum=0.02, maximum=5))
PLACEMENT = mapping(
    'a placement with the key cameras',
    {'cameras': [{'sensor': 'kinect_v2', 'position': [1.0, 2.0, 2.2]}]}, ('cameras',),
    version={'description': 'the number 1', 'const': 1, 'examples': [1]},
    frame=text('the name of the frame of all positions', 'map',
               pattern='^[A-Za-z][A-Za-z0-9_/]{0,99}$'),
    room=ROOM, engine=ENGINE,
    cameras=many('a list of one camera or more', PLACED,
                 [{'sensor': 'kinect_v2', 'position': [1.0, 2.0, 2.2]}], 1),
    rig=RIG,
    scores={'description': 'figures as ocp score --json writes them', 'type': 'object',
            'examples': [{'depth_error': 1.0}]},
    created={'description': 'a mapping of texts', 'type': 'object',
             'additionalProperties': {'type': 'string'}, 'examples': [{'date': '2026-01-01'}]})
