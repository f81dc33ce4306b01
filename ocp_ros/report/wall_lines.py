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

"""Straight lines of the walls in a floor plan, fitted to the points of a scan."""

from collections.abc import Iterator

import numpy as np
from ocp_ros.rig.structure import MountSurface, standing_of
from ocp_ros.scenes.scene import Scene

#: The largest angle between a wall and its points, degrees.
MAX_ANGLE_DEGREES = 6.0
#: The largest distance of the points of a wall from its line, metres.
MAX_OFFSET_M = 0.06
#: The shortest line, metres.
MIN_LENGTH_M = 0.2


def wall_lines(scene: Scene) -> np.ndarray:
    """
    Fit lines to walls, fences, partitions and cupboards that are at least a metre high.

    The line with most points is found first, then the next one among the other points.

    :returns: (L, 2, 2) the ends of L lines, x and y in metres, map frame.
    """
    standing = standing_of(scene)
    lines = list(_lines_of(standing))
    return np.array(lines).reshape(-1, 2, 2)


def _lines_of(standing: MountSurface) -> Iterator[np.ndarray]:
    """Yield lines (2, 2), metres, that are fitted to the points of a surface."""
    places = standing.points[:, :2].astype(np.float64)
    angles = np.rad2deg(np.arctan2(standing.normals[:, 1], standing.normals[:, 0])) % 180.0
    # As many points as a line of the least length has, a metre high, with a fifth of them missing.
    min_points = max(3, int(0.8 * MIN_LENGTH_M / (0.5 * standing.gap) ** 2))
    centre = places.mean(axis=0) if len(places) else np.zeros(2)
    places = places - centre
    while len(places) >= min_points:
        normal, offset = _best_line(places, angles)
        direction = np.rad2deg(np.arctan2(normal[1], normal[0])) % 180.0
        turned = np.abs((angles - direction + 90.0) % 180.0 - 90.0)
        on_line = np.abs(places @ normal - offset) <= MAX_OFFSET_M
        on_line &= turned <= MAX_ANGLE_DEGREES
        if np.count_nonzero(on_line) < min_points:
            return
        along = np.array([-normal[1], normal[0]])
        positions = np.sort(places[on_line] @ along)
        breaks = np.flatnonzero(np.diff(positions) > standing.gap)
        starts = positions[np.append(0, breaks + 1)]
        stops = positions[np.append(breaks, -1)]
        for start, stop in zip(starts, stops):
            if stop - start >= MIN_LENGTH_M:
                yield centre + offset * normal + np.outer([start, stop], along)
        places, angles = places[~on_line], angles[~on_line]


def _best_line(places: np.ndarray, angles: np.ndarray) -> tuple[np.ndarray, float]:
    """
    Return the unit normal (2,) and the offset, metres, of the line with most points.

    :param places: (M, 2) metres.
    :param angles: (M,) of the normals at these places, degrees from 0 to 180.
    """
    best = np.argmax(np.bincount((angles / 2.0).astype(int) % 90))
    turned = (angles - 2.0 * best - 1.0 + 90.0) % 180.0 - 90.0
    similar = np.abs(turned) <= MAX_ANGLE_DEGREES
    direction = np.deg2rad(2.0 * best + 1.0 + np.median(turned[similar]))
    normal = np.array([np.cos(direction), np.sin(direction)])
    offsets = np.sort(places[similar] @ normal)
    # The window of offsets with most points.
    ends = np.searchsorted(offsets, offsets + MAX_OFFSET_M, side='right')
    first = int(np.argmax(ends - np.arange(len(offsets))))
    return normal, float(np.median(offsets[first:ends[first]]))
