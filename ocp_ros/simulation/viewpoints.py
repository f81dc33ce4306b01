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
Viewpoints of the depth error: the middles of parts of a room's air, or the paper's five.

The paper integrates over all positions of a room (eq. 3). A few viewpoints approximate the
integral best if they are spread evenly over the air. Then the error of a placement does not change
when the scan is rotated, moved or mirrored.
"""

from weakref import WeakKeyDictionary

import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.geometry.depth_error import five_viewpoints
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.structure import Air, MIN_BALL_M, STEEP
from ocp_ros.scenes.scene import Scene, turned
from scipy.spatial import distance

#: The number of viewpoints in the air, a power of two.
VIEWPOINTS = 16

_known: WeakKeyDictionary[Scene, dict[str, np.ndarray]] = WeakKeyDictionary()


def viewpoints_of(scene: Scene, kind: str = 'air') -> np.ndarray:
    """
    Return the viewpoints of the depth error in a room; they are cached with the scene.

    :param kind: ``'air'``: 16 positions in the air; ``'paper'``: the five of the paper, in the
        rectangle along the walls.
    :returns: (V, 3) float64, metres, map frame.
    """
    known = _known.setdefault(scene, {})
    if kind not in known:
        known[kind] = air_viewpoints(scene) if kind == 'air' else paper_viewpoints(scene)
    return known[kind]


def air_viewpoints(scene: Scene) -> np.ndarray:
    """
    Place viewpoints in the middles of 16 equal parts of the air at half height.

    The parts are found by halving, each time across the direction of largest variance. The cells
    of air are aligned with the walls, and ties are broken by coordinates along the walls. So the
    result does not depend on random numbers or on the axes of the scan. If there is too little air
    at half height, all heights are used; if there is none, the paper's five viewpoints.
    """
    angle = wall_direction(scene)
    aligned = turned(scene, -np.rad2deg(angle))
    height = float(scene.bounds[:, 2].mean())
    air = Air(aligned, FreePlane.of(aligned.points, height, 1, 0.0, clearance=0.0),
              centred=True)
    cells = air.cells(height)
    if len(cells) < VIEWPOINTS:
        cells = air.cells()
    if len(cells) < VIEWPOINTS:
        return paper_viewpoints(scene)
    # The order starts at the emptier ends, so that a mirrored room has mirrored viewpoints.
    middle = aligned.bounds.mean(axis=0)
    ends = np.where(aligned.points.mean(axis=0) < middle, -1.0, 1.0)
    long = int(aligned.size[1] > aligned.size[0])
    return _middles(cells, (cells - middle) * ends, long) @ rotation_matrix(angle).T


def observed_viewpoints(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """
    Place viewpoints in a partially observed room, above the observed floor.

    The air of such a room cannot be distinguished yet from the space behind the walls.

    :param points: (N, 3) metres, map frame: the observed points.
    :param corners: (4, 2) metres, the corners of the rectangle around them, from
        :func:`~ocp_ros.online.partial_map.smallest_rectangle`.
    :returns: (V, 3) float64, metres: 16 viewpoints, or the paper's five if there is too little
        floor.
    """
    height = float(corners_of(points)[:, 2].mean())
    floor = FreePlane.of(points, height, 1, 0.0, clearance=MIN_BALL_M).floor
    if floor is None or np.count_nonzero(floor.open) < VIEWPOINTS:
        return five_viewpoints(corners, height)
    cells = floor.low + floor.edge * (np.argwhere(floor.open) + 0.5)
    sides = corners[1:3] - corners[0]
    lengths = np.linalg.norm(sides, axis=1)
    found = _middles(cells, cells @ (sides / lengths[:, None]).T, int(np.argmax(lengths)))
    return np.column_stack([found, np.full(VIEWPOINTS, height)])


def _middles(cells: np.ndarray, keys: np.ndarray, long: int) -> np.ndarray:
    """
    Divide cells into equal parts and return the cell in the middle of each.

    :param cells: (M, D) metres, M >= 16.
    :param keys: (M, D) metres: the coordinates along the axes of the room, each measured from the
        end that comes first.
    :param long: the axis, 0 or 1, along which the room is longer.
    :returns: (16, D) metres.
    """
    parts, order = [np.arange(len(cells))], keys.round(6)
    while len(parts) < VIEWPOINTS:
        halves = []
        for part in parts:
            spread = keys[part].var(axis=0)
            # In square parts noise would decide the direction of a cut.
            spread[long] *= 1.3
            axes = [int(np.argmax(spread)), long, 1 - long, *range(2, keys.shape[1])]
            part = part[np.lexsort(order[part].T[axes[::-1]])]
            halves += [part[:len(part) // 2], part[len(part) // 2:]]
        parts = halves
    middles = [cells[part].mean(axis=0) for part in parts]
    return cells[np.argmin(distance.cdist(middles, cells), axis=1)]


def paper_viewpoints(scene: Scene) -> np.ndarray:
    """Place the paper's five viewpoints in the rectangle along the walls of the room."""
    angle = wall_direction(scene)
    axes = rotation_matrix(-angle)[:2, :2]
    low, high = corners_of(scene.points[:, :2] @ axes.T)
    corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
    return five_viewpoints(corners @ axes, float(scene.bounds[:, 2].mean()))


def wall_direction(scene: Scene) -> float:
    """Return the main direction of the walls: radians to the x axis, from 0 to a right angle."""
    normals = scene.normals_or_estimate
    steep = np.abs(normals[:, 2]) <= STEEP
    if not steep.any():
        return 0.0
    angles = np.rad2deg(np.arctan2(normals[steep, 1], normals[steep, 0])) % 90.0
    # A right angle has 360 bins of wall directions.
    bin_deg = 0.25
    count = round(90.0 / bin_deg)
    bins = np.round(angles / bin_deg).astype(int) % count
    area = scene.pitch[steep].astype(np.float64) ** 2
    areas = np.bincount(bins, area, count)
    # A wall may fall into neighbouring bins, also across 90 degrees.
    best = np.argmax(areas + np.roll(areas, 1) + np.roll(areas, -1))
    off = (angles - best * bin_deg + 45.0) % 90.0 - 45.0
    near = np.abs(off) <= 1.5 * bin_deg
    return float(np.deg2rad(best * bin_deg + np.average(off[near], weights=area[near])))
