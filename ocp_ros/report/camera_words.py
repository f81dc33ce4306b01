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
Mounting instructions for a camera, in words that do not need the map frame.

They contain the distances to two near walls, the height, the pan relative to a side of the room
and the tilt. The coordinates in the frame of the scan are added.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, rotation_matrix
from ocp_ros.report.wall_references import Distance, LONGEST_DISTANCE, ReferenceWall
from ocp_ros.rig.placement_file import FIXED, Placed
from ocp_ros.scenes.scene import Scene
from ocp_ros.scenes.source_frame import SourceFrame

#: A smaller angle counts as 0: straight, level, upright.
STRAIGHT_DEGREES = 0.5
#: Beyond this pitch a camera looks straight down or up.
VERTICAL_DEGREES = 85.0
#: Smallest distance of the point at the centre of a camera's picture, metres.
LEAST_AIM_DISTANCE = 0.3
#: Largest distance of this point from the optical axis, metres.
AIM_TOLERANCE = 0.08
#: Largest height that counts as on the floor, centimetres.
ON_FLOOR_CM = 5.0
#: Decimals of coordinates in metres.
DECIMALS = 3
#: Column heads of the installer's table for the fields of :class:`Words`.
COLUMNS = ('camera', 'sensor', 'place', 'height', 'pan', 'tilt', 'x, y, z')


class Words(NamedTuple):
    """Mounting instructions for one camera, in the order of :data:`COLUMNS`."""

    name: str
    sensor: str
    place: str
    height: str
    pan: str
    tilt: str
    coordinates: str


def words_for(placed: Placed, distances: Sequence[Distance], sides: Sequence[ReferenceWall],
              floor: float, frame: SourceFrame) -> Words:
    """
    Return the mounting instructions for a camera.

    :param distances: to near walls.
    :param sides: of the room; the pan is relative to one of them.
    :param floor: height of the floor, metres, map frame.
    :param frame: of the coordinates.
    """
    height = f'{100.0 * (placed.position[2] - floor):.0f} cm above the floor'
    return Words(placed.camera.name, placed.camera.sensor or 'own', _place(distances), height,
                 _pan(placed, sides), _tilt(placed), coordinates_of(placed, frame))


def _place(distances: Sequence[Distance]) -> str:
    """Return the distances to near walls in words, or that there is none."""
    words = [f'{100.0 * one.away:.0f} cm {"beyond" if one.beyond else "from"} wall {one.letter}'
             for one in distances]
    if len(words) < 2:
        other = 'other ' * len(words)
        words.append(f'no {other}wall within {LONGEST_DISTANCE:.0f} m: use x, y, z')
    return ', '.join(words)


def aim_of(placed: Placed, scene: Scene, sides: Sequence[ReferenceWall], floor: float) -> str:
    """
    Return the place at the centre of a camera's picture, in words, to set its heading.

    :param scene: the room.
    :param sides: of the room.
    :param floor: height of the floor, metres, map frame.
    :returns: '' for an omnidirectional camera, or if the scan has no point there.
    """
    if placed.camera.model.omnidirectional:
        return ''
    ahead = rotation_matrix(*placed.pose[3:])[:, 0]
    offsets = scene.points - placed.pose[:3]
    along = offsets @ ahead
    aside = np.linalg.norm(offsets - along[:, None] * ahead, axis=1)
    near = np.flatnonzero((along > LEAST_AIM_DISTANCE)
                          & (aside <= np.maximum(scene.pitch, AIM_TOLERANCE)))
    if len(near) == 0:
        return ''
    # Among the points on the first surface, take the one nearest to the optical axis.
    near = near[along[near] <= along[near].min() + LEAST_AIM_DISTANCE]
    at = placed.pose[:3] + along[near[np.argmin(aside[near])]] * ahead
    above = 100.0 * (at[2] - floor)
    height = 'on the floor' if abs(above) < ON_FLOOR_CM else f'{above:.0f} cm above the floor'
    away = [abs(wall.offset - wall.outward @ at[:2]) for wall in sides]
    nearest = [min(pair, key=away.__getitem__) for pair in ((0, 2), (1, 3))]
    return ', '.join([height, *(f'{100.0 * away[side]:.0f} cm from wall {sides[side].letter}'
                                for side in sorted(nearest, key=away.__getitem__))])


def named(name: str, mount: str) -> str:
    """Return the name of a camera, with a remark if it is mounted already."""
    return f'{name} (fixed)' if mount == FIXED else name


def lens_of(model: CameraModel) -> str:
    """Return the field of view and the range of a camera in words."""
    reach = f'{model.min_range:g} to {model.max_range:g} m'
    if model.omnidirectional:
        return f'all around, {reach}'
    wide, high = np.rad2deg([model.horizontal_fov, model.vertical_fov])
    return f'{wide:.0f} x {high:.0f} degrees, {reach}'


def coordinates_of(placed: Placed, frame: SourceFrame) -> str:
    """Return the position of a camera in a frame as text, to the millimetre."""
    decimals = max(0, DECIMALS + round(np.log10(frame.scale)))
    return ', '.join(f'{value + 0.0:.{decimals}f}' for value in np.round(
        frame.to_source(placed.position), decimals))


def _pan(placed: Placed, walls: Sequence[ReferenceWall]) -> str:
    """Return the pan of a camera in words, seen from above."""
    if placed.camera.model.horizontal_fov >= 2.0 * np.pi - 1e-9:
        return 'any heading'
    yaw, pitch, _ = placed.angles
    # If a camera looks straight up or down, the pan is the direction of the top of the picture.
    turn = np.deg2rad(yaw + (180.0 if pitch < -VERTICAL_DEGREES else 0.0))
    ahead = np.array([np.cos(turn), np.sin(turn)])
    wall = max(walls, key=lambda wall: wall.outward @ ahead)
    left = np.rad2deg(np.arctan2(wall.outward[0] * ahead[1] - wall.outward[1] * ahead[0],
                                 wall.outward @ ahead))
    facing = f'top of the picture to wall {wall.letter}' if abs(pitch) > VERTICAL_DEGREES else (
        f'face wall {wall.letter} squarely')
    if abs(left) < STRAIGHT_DEGREES:
        return facing
    return f'{facing}, then turn {_degrees(left)} to the {"left" if left > 0 else "right"}'


def _degrees(angle: float) -> str:
    """Return an angle in degrees as text."""
    return f'{abs(angle):.0f} degree{"" if round(abs(angle)) == 1 else "s"}'


def _tilt(placed: Placed) -> str:
    """Return the tilt and the roll of a camera in words."""
    _, pitch, roll = placed.angles
    if placed.camera.model.omnidirectional:
        return 'upright'
    tilt = 'level' if abs(pitch) < STRAIGHT_DEGREES else (
        f'{_degrees(pitch)} {"down" if pitch > 0 else "up"}')
    if abs(roll) >= STRAIGHT_DEGREES:
        side = 'clockwise' if roll > 0 else 'anticlockwise'
        tilt += f', rolled {_degrees(roll)} {side} seen from behind'
    return tilt
