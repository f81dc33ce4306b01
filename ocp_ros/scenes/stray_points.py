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

"""Points of a scan that are no part of the room: reflections, dust, what windows show."""

import numpy as np
from ocp_ros.geometry.clouds import (
    away_from,
    cell_numbers,
    cells_numbered,
    corners_of,
    REACH,
)
from ocp_ros.scenes.neighbours import nearest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

#: Edge of the cells that hang together: metres at least, and in multiples of the points' spacing.
EDGE, SPACINGS = 0.25, 4.0
#: Per cent of the points at either end that say nothing about how large a room is.
ENDS = 2.0
#: Metres that a stray group is away from the bounds of the room, and its largest share of the
#: points: the second where it is farther from the room than the room is large.
AWAY, SHARE, FAR_SHARE = 1.0, 0.002, 0.05
#: Nearest points that tell whether a point is isolated, in how many lists of these it has to be,
#: and which of them has to be near: so many times as far as usual.
AROUND, LISTED, NEIGHBOUR, FARTHER = 12, 3, 8, 3.0
#: Least share of the second eigenvalue that the least one has where points lie on no plane, and
#: most of the first that the second one has where they lie on a line, as the far rings of a laser
#: scanner do.
PLANE, LINE = 0.1, 0.05
#: How often the others are looked at anew, and the largest share that may be isolated: more of
#: them are how this scanner sees the room.
TIMES, MOST = 2, 0.05


def isolated_points(points: np.ndarray) -> np.ndarray:
    """
    Find points that hang alone in the air of a room: dust, rain, edges seen by two pixels.

    A point is isolated that hardly any other has among its neighbours, or whose neighbours are far
    and lie on no plane.

    :param points: (N, 3) float32, metres.
    :returns: (N,) bool; none where there would be too many.
    """
    left = np.ones(len(points), dtype=bool)
    for _ in range(TIMES):
        rest = points[left]
        if len(rest) <= 10 * AROUND:
            break
        distances, indices = nearest(rest, AROUND + 1)
        listed = np.bincount(indices[:, 1:].ravel(), minlength=len(rest))
        far = distances[:, NEIGHBOUR] > FARTHER * np.median(distances[:, NEIGHBOUR])
        lone = listed < LISTED
        asked = np.flatnonzero(far | lone)
        around = rest[indices[asked]].astype(np.float64)
        around -= around.mean(axis=1, keepdims=True)
        values = np.linalg.eigvalsh(np.einsum('mpi,mpj->mij', around, around))
        on_line = values[:, 1] <= LINE * values[:, 2]
        lone[asked] = ~on_line & (lone[asked] | (values[:, 0] >= PLANE * values[:, 1]))
        left[np.flatnonzero(left)[lone]] = False
    isolated = ~left
    return isolated if isolated.mean() <= MOST else np.zeros(len(points), dtype=bool)


def stray_points(points: np.ndarray) -> np.ndarray:
    """
    Find the points that would make the bounds of a room larger than it is.

    Points hang together that lie in neighbouring cells of a grid. The largest group is the room;
    a stray group has few points and lies outside the room's bounds. What hangs in the air inside
    of them, such as a lamp, stays.

    :param points: (N, 3), finite, in any unit.
    :returns: (N,) bool.
    """
    points = np.asarray(points, dtype=np.float64)
    core = np.subtract(*np.percentile(points, [100.0 - ENDS, ENDS], axis=0))
    with np.errstate(over='ignore'):
        area = 2.0 * (core[0] * core[1] + core[1] * core[2] + core[2] * core[0])
        edge = max(EDGE, SPACINGS * np.sqrt(area / len(points)))
        if not np.isfinite(edge):
            return np.zeros(len(points), dtype=bool)
        cells = (points - np.median(points, axis=0)) / edge
    cells = np.clip(np.floor(cells), 1 - REACH, REACH - 1).astype(np.int64)
    numbers, cell = np.unique(cell_numbers(cells), return_inverse=True)
    group = _groups(cells_numbered(numbers))[cell]
    sizes = np.bincount(group)
    corners = corners_of(points[group == np.argmax(sizes)])
    away = np.full(len(sizes), np.inf)
    with np.errstate(over='ignore'):
        np.minimum.at(away, group, away_from(points, corners))
    share = np.where(away > np.linalg.norm(corners[1] - corners[0]), FAR_SHARE, SHARE)
    return ((away > max(AWAY, edge)) & (sizes <= share * len(points)))[group]


def _groups(cells: np.ndarray) -> np.ndarray:
    """Give numbers to groups of cells (M, 3) that touch each other, if only at a corner: (M,)."""
    pairs = cKDTree(cells).query_pairs(1.5, p=np.inf, output_type='ndarray')
    joined = coo_array((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])),
                       shape=(len(cells), len(cells)))
    return connected_components(joined, directed=False)[1]
