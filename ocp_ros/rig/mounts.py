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
from ocp_ros.rig.structure import Floors, floors_of, MountSurface, STAND_OFF
from ocp_ros.rig.zones import grid_positions, moved_into_nearest, Zone
from ocp_ros.scenes.scene import Scene

#: The largest number of positions that are examined; on walls, fewer than four times as many.
MAX_POSITIONS = 4000
#: Metres: positions this near to each other count as one.
MERGE_DISTANCE_M = 0.02


class MountPlaces(NamedTuple):
    """
    P positions that a mount offers.

    :ivar positions: (P, 3) metres, map frame.
    :ivar inwards: (P,) radians, the yaw at which a camera on a wall looks into the room; 0 for
        other mounts.
    """

    positions: np.ndarray
    inwards: np.ndarray


def places_in(rig: Rig, scene: Scene, space: FreePlane,
              surface: MountSurface | None) -> MountPlaces:
    """
    Return the positions that the mount of a rig offers in a room.

    :param space: the positions over the floor.
    :param surface: the ceiling or the walls; None for mounts without a surface.
    :returns: the positions, of which there may be none.
    """
    on, heights, _ = rig.mount
    floors = floors_of(scene)
    if on == 'walls':
        return _wall_positions(np.array(heights), space, surface, rig.keep_in, floors)
    # Only a ceiling mount may have no heights: its zones may be at any height of the room.
    low, high = scene.bounds[:, 2] if heights is None else np.array(heights) + [
        floors.levels[0].z, floors.levels[-1].z]
    if rig.keep_in:
        lowest, highest = np.append(space.low, low), np.append(space.high, high)
        positions = grid_positions(rig.keep_in, lowest, highest, floors.height, MAX_POSITIONS,
                                   one_level=on != 'free')
        positions = positions[space.contains(positions[:, :2])]
        places, z = positions[:, :2], positions[:, 2]
    elif on == 'free':
        # The levels are 0.3 m apart, or less.
        levels = np.linspace(*heights, int(np.ceil((heights[1] - heights[0]) / 0.3)) + 1)
        grid = space.grid(max(MAX_POSITIONS // len(levels), 1))
        places = np.repeat(grid, len(levels), axis=0)
        z = np.tile(levels, len(grid)) + floors.under(places)
    else:
        places = space.grid(MAX_POSITIONS)
    # Only the mount ``free`` has a range of heights. On a plane or a ceiling all cameras have the
    # same height, or hang from the ceiling; this replaces the z of positions in zones.
    if on != 'free' and heights is not None:
        z = heights[0] + floors.under(places)
    elif on != 'free':
        z = surface.height_above(places) - STAND_OFF
        # The height of the ceiling is -inf where there is none.
        places, z = places[np.isfinite(z)], z[np.isfinite(z)]
    return MountPlaces(np.column_stack([places, z]), np.zeros(len(places)))


def _wall_positions(heights: np.ndarray, space: FreePlane, walls: MountSurface,
                    zones: Sequence[Zone], floors: Floors) -> MountPlaces:
    """
    Return positions on the sides of walls that face the floor, in the zones if there are any.

    :param heights: (2,) the lowest and the highest cameras, metres above the floor below them.
    :param space: the positions over the floor.
    :param walls: the points of the walls; their normals may point to either side.
    """
    low, high = np.add.outer(heights, floors.under(walls.points))
    z = walls.points[:, 2]
    # Points of a wall this near to the heights or to a zone are used.
    band_m = 0.2
    used = np.flatnonzero((z >= low - band_m) & (z <= high + band_m))
    if zones:
        offsets = moved_into_nearest(zones, walls.points[used], floors.height) - walls.points[used]
        used = used[np.linalg.norm(offsets, axis=1) <= band_m]
    # Of too many points, each second, third, ... is used: fewer than twice MAX_POSITIONS remain.
    used = used[::max(len(used) // MAX_POSITIONS, 1)]
    points, normals = walls.points[used].astype(np.float64), walls.normals[used]
    positions, inwards = [], []
    for side in (-1.0, 1.0):
        moved = points + side * STAND_OFF * normals
        if zones:
            moved = moved_into_nearest(zones, moved, floors.height)
        # A side of a wall faces the floor if there is floor 20 cm in front of a camera there.
        faces_floor = space.contains(moved[:, :2] + 2.0 * side * STAND_OFF * normals[:, :2])
        moved[:, 2] = np.clip(moved[:, 2], *np.add.outer(heights, floors.under(moved)))
        positions.append(moved[faces_floor])
        # Columns 1 and 0 of the normals are y and x, as arctan2 expects them.
        inwards.append(np.arctan2(*(side * normals[faces_floor, 1::-1]).T))
    return MountPlaces(np.concatenate(positions), np.concatenate(inwards))


def pitches_of(rig: Rig, step: float) -> np.ndarray:
    """
    Return the candidate pitches of cameras.

    Cameras with pitches above 38 degrees see little of a room; such pitches are included only if
    the document of the rig has the key pitch.

    :param step: the approximate step, radians.
    :returns: (P,) radians.
    """
    low, high = rig.pitch
    if 'pitch' not in rig.document.data:
        high = float(np.clip(np.deg2rad(38.0), low, high))
    # 1e-9 is for rounding errors, which must not add a step.
    return np.linspace(low, high, int(np.ceil((high - low) / step - 1e-9)) + 1)


def headings_of(rig: Rig, model: CameraModel, yaw_step: float, pitch_step: float) -> np.ndarray:
    """
    Return the candidate headings of a camera.

    :param yaw_step: radians.
    :param pitch_step: radians, approximately.
    :returns: (H, 3) yaw, pitch, roll in radians of H headings; the yaw is relative to
        ``MountPlaces.inwards``. There is one heading for a camera that sees all yaws.
    """
    if model.omnidirectional:
        return np.zeros((1, 3))
    # 1e-9 in the next lines is for rounding errors.
    full_turn = 2.0 * np.pi
    # A spinning lidar sees all yaws: only its pitch matters.
    if model.horizontal_fov >= full_turn - 1e-9:
        # The pitch is the allowed one nearest to 0.
        return np.array([[0.0, np.clip(0.0, *rig.pitch), rig.rolls[0]]])
    yaws = np.arange(0.0, full_turn - 1e-9, yaw_step)
    if rig.mount.on == 'walls':
        # A camera on a wall turns up to 60 degrees to either side.
        max_yaw = np.deg2rad(60.0)
        yaws = np.arange(-max_yaw, max_yaw + 1e-9, yaw_step)
    return np.array([(yaw, pitch, roll) for roll in rig.rolls
                     for pitch in pitches_of(rig, pitch_step) for yaw in yaws])


def first_headings(rig: Rig, positions: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """
    Return the first headings of cameras: from walls towards the middle, else evenly spread.

    :param positions: (K, 3), the positions of K cameras, metres.
    :param middle: (2,), the middle of the room, metres.
    :returns: (K, 3) yaw, pitch and roll in radians.
    """
    headings = outwards(len(positions), float(np.clip(0.0, *rig.pitch)))
    headings[:, 2] = rig.rolls[0]
    if rig.mount.on == 'walls':
        offsets = middle - positions[:, :2]
        headings[:, 0] = np.arctan2(offsets[:, 1], offsets[:, 0])
    return headings


def choose_spread(positions: np.ndarray, max_count: int, min_distance: float = MERGE_DISTANCE_M
                  ) -> tuple[np.ndarray, float]:
    """
    Choose positions one by one, each time the one farthest from those chosen before.

    :param positions: (P, 3), P >= 1 positions, metres.
    :param max_count: the largest number of chosen positions.
    :param min_distance: metres; positions nearer to a chosen one are not chosen.
    :returns: the indices of the chosen positions, that nearest to the mean first, and the largest
        distance of a position from the nearest chosen one, metres.
    """
    from_mean = np.linalg.norm(positions - positions.mean(axis=0), axis=1)
    chosen = [int(np.argmin(from_mean))]
    # The distance of each position from the nearest chosen one.
    nearest = np.linalg.norm(positions - positions[chosen[0]], axis=1)
    while len(chosen) < max_count and nearest.max() > min_distance:
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(positions - positions[chosen[-1]], axis=1))
    return np.array(chosen), float(nearest.max())
