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

"""Candidate positions and headings that a mount offers, before constraints apply."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.motion import outwards
from ocp_ros.rig.rig_file import Rig
from ocp_ros.rig.structure import floor_height, MountSurface, STAND_OFF
from ocp_ros.rig.zones import lattice_of, nearest_of, Zone
from ocp_ros.scenes.scene import Scene

#: The number of positions examined.
MAX_POSITIONS = 4000
#: Metres: positions this near to each other count as one.
MERGED_M = 0.02


class MountPlaces(NamedTuple):
    """
    The positions that a mount offers.

    :ivar positions: (P, 3) metres, map frame.
    :ivar inwards: (P,) radians, the yaw of a camera that looks into the room; 0 if there is no
        wall.
    """

    positions: np.ndarray
    inwards: np.ndarray


def places_in(rig: Rig, scene: Scene, space: FreePlane,
              surface: MountSurface | None) -> MountPlaces:
    """
    List the positions that a mount offers.

    :param space: the space with floor.
    :param surface: the ceiling or the walls; None for mounts without a surface.
    """
    on, heights, _ = rig.mount
    floor = floor_height(scene)
    if on == 'walls':
        return _along_walls(floor + np.array(heights), space, surface, rig.keep_in, floor)
    low, high = scene.bounds[:, 2] if heights is None else floor + np.array(heights)
    if rig.keep_in:
        places = lattice_of(rig.keep_in, np.append(space.low, low), np.append(space.high, high),
                            floor, MAX_POSITIONS, on != 'free')
        places = places[space.contains(places[:, :2])]
        places, z = places[:, :2], places[:, 2]
    elif on == 'free':
        levels = np.linspace(low, high, int(np.ceil((high - low) / 0.3)) + 1)
        grid = space.grid(max(MAX_POSITIONS // len(levels), 1))
        places = np.repeat(grid, len(levels), axis=0)
        z = np.tile(levels, len(grid))
    else:
        places = space.grid(MAX_POSITIONS)
    if on != 'free':
        z = surface.height_above(places) - STAND_OFF if heights is None else np.full(
            len(places), floor + heights[0])
        places, z = places[np.isfinite(z)], z[np.isfinite(z)]
    return MountPlaces(np.column_stack([places, z]), np.zeros(len(places)))


def _along_walls(heights: np.ndarray, space: FreePlane, walls: MountSurface,
                 zones: Sequence[Zone], ground: float) -> MountPlaces:
    """List positions on the side of walls that faces the floor, in the zones if there are any."""
    low, high = heights
    z = walls.points[:, 2]
    # Points of a wall this near to a height count as at this height.
    band_m = 0.2
    near = np.flatnonzero((z >= low - band_m) & (z <= high + band_m))
    if zones:
        away = nearest_of(zones, walls.points[near], ground) - walls.points[near]
        near = near[np.linalg.norm(away, axis=1) <= band_m]
    near = near[::max(len(near) // MAX_POSITIONS, 1)]
    points, normals = walls.points[near].astype(np.float64), walls.normals[near]
    positions, inwards = [], []
    for side in (-1.0, 1.0):
        moved = points + side * STAND_OFF * normals
        if zones:
            moved = nearest_of(zones, moved, ground)
        moved[:, 2] = np.clip(moved[:, 2], low, high)
        floor = space.contains(moved[:, :2] + 2.0 * side * STAND_OFF * normals[:, :2])
        positions.append(moved[floor])
        inwards.append(np.arctan2(*(side * normals[floor, 1::-1]).T))
    return MountPlaces(np.concatenate(positions), np.concatenate(inwards))


def pitches_of(rig: Rig, step: float) -> np.ndarray:
    """
    Return the candidate pitches.

    Pitches above 38 degrees show little of a room; they are included if the rig asks for them.

    :param step: the approximate step, radians.
    :returns: (P,) radians.
    """
    low, high = rig.pitch
    if 'pitch' not in rig.document.data:
        high = float(np.clip(np.deg2rad(38.0), low, high))
    return np.linspace(low, high, int(np.ceil((high - low) / step - 1e-9)) + 1)


def headings_of(rig: Rig, model: CameraModel, step: float, tilt: float) -> np.ndarray:
    """
    Return the candidate headings of a camera, relative to looking into the room.

    :param step: the step of yaw, radians.
    :param tilt: the step of pitch, radians.
    :returns: (H, 3) yaw, pitch, roll in radians; one for an omnidirectional camera.
    """
    if model.omnidirectional:
        return np.zeros((1, 3))
    full_turn = 2.0 * np.pi
    if model.horizontal_fov >= full_turn - 1e-9:
        # The pitch is as level as the rig allows.
        return np.array([[0.0, np.clip(0.0, *rig.pitch), rig.rolls[0]]])
    yaws = np.arange(0.0, full_turn - 1e-9, step)
    if rig.mount.on == 'walls':
        # A camera on a wall turns up to 60 degrees to either side.
        max_yaw = np.deg2rad(60.0)
        yaws = np.arange(-max_yaw, max_yaw + 1e-9, step)
    return np.array([(yaw, pitch, roll) for roll in rig.rolls for pitch in pitches_of(rig, tilt)
                     for yaw in yaws])


def first_headings(rig: Rig, positions: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """
    Return the first headings of cameras: outwards, or from walls towards the middle.

    :param positions: (K, 3) metres.
    :param middle: (2,) metres, of the room.
    :returns: (K, 3) yaw, pitch and roll in radians.
    """
    headings = outwards(len(positions), float(np.clip(0.0, *rig.pitch)))
    headings[:, 2] = rig.rolls[0]
    if rig.mount.on == 'walls':
        way = middle - positions[:, :2]
        headings[:, 0] = np.arctan2(way[:, 1], way[:, 0])
    return headings


def spread(positions: np.ndarray, count: int, apart: float = MERGED_M) -> tuple[np.ndarray, float]:
    """
    Choose positions one by one, each time the one farthest from those chosen before.

    :param positions: (P, 3) metres, P >= 1.
    :param count: the largest number to choose.
    :param apart: metres; positions nearer to a chosen one are not chosen.
    :returns: indices, the position nearest to the mean first, and the largest distance of a
        position from the nearest chosen one, metres.
    """
    nearest = np.linalg.norm(positions - positions.mean(axis=0), axis=1)
    chosen = [int(np.argmin(nearest))]
    nearest = np.linalg.norm(positions - positions[chosen[0]], axis=1)
    while len(chosen) < count and nearest.max() > apart:
        chosen.append(int(np.argmax(nearest)))
        away = np.linalg.norm(positions - positions[chosen[-1]], axis=1)
        nearest = np.minimum(nearest, away)
    return np.array(chosen), float(nearest.max())
