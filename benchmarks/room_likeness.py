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

"""How much generated rooms are like real ones: the same figures of both, and S3DIS's own."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from ocp_ros.geometry.depth_error import DepthError
from ocp_ros.rig.free_plane import floor_of
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rooms.furniture import SOLID_KINDS
from ocp_ros.rooms.generator import generate_room, plan_of
from ocp_ros.rooms.scanning import scan
from ocp_ros.scenes.scene import Scene
from ocp_ros.simulation.viewpoints import viewpoints_of

#: Points of S3DIS by class, in the order of ``SOLID_KINDS``: the class weights of Open3D-ML.
S3DIS_POINTS = (3370714, 2856755, 4919229, 318158, 375640, 478001, 974733, 650464, 791496, 88727,
                1284130, 229758, 2272837)
#: Metres: edge of the cells whose occupied share is taken.
CELL = 0.25
#: Shares of the height that points are counted in.
HEIGHTS = (0.0, 0.1, 0.4, 0.7, 0.9, 1.0)
#: Rows of the map of directions from the centre.
ROWS = 32
#: Metres above the floor: height of cameras by default.
HEIGHT = RigConfig().height


@dataclass(frozen=True)
class Likeness:
    """
    Figures of a room.

    :ivar floor: square metres where a camera may hang.
    :ivar size: edges of the bounding box, the longest first and the height last, metres.
    :ivar occupied: share of the cells of the bounding box with points in them.
    :ivar heights: share of points between each two of ``HEIGHTS``.
    :ivar directions: share of directions from the centre in which something is hit.
    """

    floor: float
    size: np.ndarray
    occupied: float
    heights: np.ndarray
    directions: float


def likeness(scene: Scene) -> Likeness:
    """Measure a room."""
    points, (low, high) = scene.points, scene.bounds
    cells = np.floor((points - low) / CELL).astype(np.int64)
    occupied = len(np.unique(cells, axis=0)) / np.prod(cells.max(axis=0) + 1)
    share = np.histogram((points[:, 2] - low[2]) / (high[2] - low[2]), HEIGHTS)[0] / len(points)
    error = DepthError(points, scene.spacing, scene.diameter, viewpoints_of(scene), ROWS)
    hit = float((error.depth_map(0) < np.float32(error.far)).mean())
    floor = floor_of(points, low[2] + HEIGHT)
    area = 0.0 if floor is None else floor.area
    size = np.append(np.sort(scene.size[:2])[::-1], scene.size[2])
    return Likeness(area, size, float(occupied), share, hit)


def shares_of_kinds(seeds: Sequence[int], points: int) -> np.ndarray:
    """Return the share of each of ``SOLID_KINDS`` in generated rooms, weighted by floor."""
    total = np.zeros(len(SOLID_KINDS))
    for seed in seeds:
        plan = plan_of(seed)
        kinds = scan(plan, points, np.random.default_rng([seed, 1]))[1]
        shares = np.bincount(kinds, minlength=len(SOLID_KINDS)) / len(kinds)
        total += shares * np.prod(plan.size[:2])
    return total / total.sum()


def summary(rooms: Sequence[Likeness]) -> dict[str, Any]:
    """Return the 10th, 50th and 90th percentile of each figure."""
    def spread(values) -> list[float]:
        return [float(value) for value in np.percentile(values, [10, 50, 90])]
    return {
        'floor (m²)': spread([room.floor for room in rooms]),
        'length (m)': spread([room.size[0] for room in rooms]),
        'width (m)': spread([room.size[1] for room in rooms]),
        'height (m)': spread([room.size[2] for room in rooms]),
        'occupied cells (%)': spread([100.0 * room.occupied for room in rooms]),
        **{f'points from {100 * low:.0f} to {100 * high:.0f} % of the height (%)': spread(
            [100.0 * room.heights[k] for room in rooms])
           for k, (low, high) in enumerate(zip(HEIGHTS, HEIGHTS[1:]))},
        'directions that hit something (%)': spread([100.0 * room.directions for room in rooms])}


def generated(seeds: Sequence[int], points: int) -> list[Likeness]:
    """Measure generated rooms."""
    return [likeness(generate_room(seed, points)) for seed in seeds]
