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
Mounting instructions for a camera, in words.

They contain the distances to two near walls, the height, the pan relative to a side of the room,
the tilt, and the coordinates.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, rotation_matrix
from ocp_ros.report.wall_references import Distance, MAX_DISTANCE_M, ReferenceWall
from ocp_ros.rig.placement_file import FIXED, Placed
from ocp_ros.rig.structure import Floors
from ocp_ros.scenes.scene import Scene
from ocp_ros.scenes.source_frame import SourceFrame

#: Colours that are distinct with any kind of colour vision, without red: red marks missed points.
CAMERA_COLOURS = ('#0072b2', '#e69f00', '#009e73', '#cc79a7', '#56b4e9', '#332288', '#f0e442',
                  '#8c6d31')
#: A smaller angle counts as 0: straight, level, upright.
ZERO_ANGLE_DEGREES = 0.5
#: Column heads of the installer's table for the fields of :class:`Instructions`.
INSTRUCTION_COLUMNS = ('camera', 'sensor', 'place', 'height', 'pan', 'tilt', 'x, y, z')


class Instructions(NamedTuple):
    """Mounting instructions for one camera, in the order of ``INSTRUCTION_COLUMNS``."""

    name: str
    sensor: str
    place: str
    height: str
    pan: str
    tilt: str
    coordinates: str


def instructions_for(placed: Placed, distances: Sequence[Distance], sides: Sequence[ReferenceWall],
                     floor: float, frame: SourceFrame) -> Instructions:
    """
    Return the mounting instructions for a camera.

    :param placed: the camera and its pose.
    :param distances: distances to near walls.
    :param sides: the four sides of the room; the pan is relative to a side.
    :param floor: z of the floor below the camera, metres, map frame.
    :param frame: frame of the coordinates.
    """
    height = f'{100.0 * (placed.position[2] - floor):.0f} cm above the floor'
    # The name of the sensor is empty for a camera whose parameters are given directly.
    return Instructions(placed.camera.name, placed.camera.sensor or 'own',
                        _distances_text(distances), height, _pan_text(placed, sides),
                        _tilt_text(placed), coordinates_text(placed, frame))


def _distances_text(distances: Sequence[Distance]) -> str:
    """Return the distances to near walls in words; if there are fewer than two, say so."""
    texts = [f'{100.0 * distance.metres:.0f} cm {"beyond" if distance.beyond else "from"} wall '
             f'{distance.letter}' for distance in distances]
    if len(texts) < 2:
        other = 'other ' if texts else ''
        texts.append(f'no {other}wall within {MAX_DISTANCE_M:.0f} m: use x, y, z')
    return ', '.join(texts)


def aim_text(placed: Placed, scene: Scene, sides: Sequence[ReferenceWall], floors: Floors
             ) -> str:
    """
    Return the place at the centre of a camera's picture in words, to set the camera's heading.

    :param placed: the camera and its pose.
    :param scene: the room.
    :param sides: the four sides of the room.
    :param floors: the floors of the room.
    :returns: '' for an omnidirectional camera, or if no scene point is near the optical axis.
    """
    if placed.camera.model.omnidirectional:
        return ''
    # The optical axis is x of the body frame.
    axis = rotation_matrix(*placed.pose[3:])[:, 0]
    offsets = scene.points - placed.pose[:3]
    depths = offsets @ axis
    axis_distances = np.linalg.norm(offsets - depths[:, None] * axis, axis=1)
    min_distance_m, tolerance_m, surface_depth_m = 0.3, 0.08, 0.3
    # The axis meets the surface near a point if the point is not farther from the axis than
    # ``pitch``, the edge of the square of surface that the point stands for, or than the tolerance
    # in dense scans. Points nearer to the camera than ``min_distance_m`` are ignored.
    candidates = np.flatnonzero((depths > min_distance_m)
                                & (axis_distances <= np.maximum(scene.pitch, tolerance_m)))
    if len(candidates) == 0:
        return ''
    # The first surface has the points up to ``surface_depth_m`` deeper than the first point. Among
    # them, take the point nearest to the optical axis.
    candidates = candidates[depths[candidates] <= depths[candidates].min() + surface_depth_m]
    nearest = candidates[np.argmin(axis_distances[candidates])]
    aim = placed.pose[:3] + depths[nearest] * axis
    height_cm = 100.0 * (aim[2] - float(floors.under(aim[None])[0]))
    height = 'on the floor' if abs(height_cm) < 5.0 else f'{height_cm:.0f} cm above the floor'
    wall_distances = [abs(wall.offset - wall.outward @ aim[:2]) for wall in sides]
    # Walls 0 and 2, and walls 1 and 3, are parallel.
    near_walls = [min(pair, key=wall_distances.__getitem__) for pair in ((0, 2), (1, 3))]
    texts = [f'{100.0 * wall_distances[wall]:.0f} cm from wall {sides[wall].letter}'
             for wall in sorted(near_walls, key=wall_distances.__getitem__)]
    return ', '.join([height, *texts])


def camera_colour(number: int) -> str:
    """Return the colour of a camera by its number from 0; colours repeat after eight."""
    return CAMERA_COLOURS[number % len(CAMERA_COLOURS)]


def camera_label(name: str, mount: str) -> str:
    """Return the name of a camera, with "(fixed)" if the rig file fixes its pose."""
    return f'{name} (fixed)' if mount == FIXED else name


def lens_text(model: CameraModel) -> str:
    """Return the field of view and the range of a camera in words."""
    range_text = f'{model.min_range:g} to {model.max_range:g} m'
    if model.omnidirectional:
        return f'all around, {range_text}'
    horizontal, vertical = np.rad2deg([model.horizontal_fov, model.vertical_fov])
    return f'{horizontal:.0f} x {vertical:.0f} degrees, {range_text}'


def coordinates_text(placed: Placed, frame: SourceFrame) -> str:
    """Return the position of a camera in a frame as text, to the millimetre."""
    # Three decimals of a metre; a unit ten times smaller needs one decimal less.
    decimals = max(0, 3 + round(np.log10(frame.scales.max())))
    # Adding 0 turns -0.0 into 0.0.
    return ', '.join(f'{value + 0.0:.{decimals}f}' for value in np.round(
        frame.to_source(placed.position), decimals))


def _pan_text(placed: Placed, walls: Sequence[ReferenceWall]) -> str:
    """Return the pan of a camera in words, relative to the wall that it faces most."""
    if placed.camera.model.horizontal_fov >= 2.0 * np.pi - 1e-9:
        return 'any heading'
    yaw, pitch, _ = placed.angles
    # If a camera looks straight down or up, the pan is the direction of the top of the picture:
    # the yaw if the camera looks down (positive pitch), the opposite direction if it looks up.
    vertical_degrees = 85.0
    pan = np.deg2rad(yaw + (180.0 if pitch < -vertical_degrees else 0.0))
    direction = np.array([np.cos(pan), np.sin(pan)])
    wall = max(walls, key=lambda wall: wall.outward @ direction)
    x, y = wall.outward
    # The angle from the outward direction of the wall to the pan, by its sine and cosine.
    left_degrees = np.rad2deg(np.arctan2(x * direction[1] - y * direction[0],
                                         wall.outward @ direction))
    facing = f'top of the picture to wall {wall.letter}' if abs(pitch) > vertical_degrees else (
        f'face wall {wall.letter} squarely')
    if abs(left_degrees) < ZERO_ANGLE_DEGREES:
        return facing
    side = 'left' if left_degrees > 0 else 'right'
    return f'{facing}, then turn {_degrees_text(left_degrees)} to the {side}'


def _degrees_text(angle: float) -> str:
    """Return the absolute value of an angle as text, such as "1 degree"."""
    return f'{abs(angle):.0f} degree{"" if round(abs(angle)) == 1 else "s"}'


def _tilt_text(placed: Placed) -> str:
    """Return the tilt and the roll of a camera in words."""
    _, pitch, roll = placed.angles
    if placed.camera.model.omnidirectional:
        return 'upright'
    tilt = 'level' if abs(pitch) < ZERO_ANGLE_DEGREES else (
        f'{_degrees_text(pitch)} {"down" if pitch > 0 else "up"}')
    if abs(roll) >= ZERO_ANGLE_DEGREES:
        side = 'clockwise' if roll > 0 else 'anticlockwise'
        tilt += f', rolled {_degrees_text(roll)} {side} seen from behind'
    return tilt
