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

"""Find points of a scan outside the room: reflections, dust, views through windows."""

import numpy as np
from ocp_ros.geometry.clouds import away_from, cell_numbers, cells_numbered, corners_of, MAX_CELL
from ocp_ros.scenes.neighbours import nearest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree


def isolated_points(points: np.ndarray) -> np.ndarray:
    """
    Find isolated points in the air of a room: dust, rain, edge pixels with mixed depths.

    A point is isolated if very few other points have it among their nearest points, or if its own
    nearest points are far away and lie on no plane.

    :param points: (N, 3) float32, metres.
    :returns: (N,) bool; all False if more than 5 % would be isolated.
    """
    is_kept = np.ones(len(points), dtype=bool)
    neighbours = 12
    # The second pass finds points whose neighbours were isolated points.
    for _ in range(2):
        kept_points = points[is_kept]
        if len(kept_points) <= 10 * neighbours:
            break
        distances, indices = nearest(kept_points, neighbours + 1)
        list_counts = np.bincount(indices[:, 1:].ravel(), minlength=len(kept_points))
        # The eighth neighbour of a far point is more than three times as far as usual.
        is_far = distances[:, 8] > 3.0 * np.median(distances[:, 8])
        # A point in fewer than three lists of nearest points is alone.
        is_isolated = list_counts < 3
        candidates = np.flatnonzero(is_far | is_isolated)
        neighbourhoods = kept_points[indices[candidates]].astype(np.float64)
        neighbourhoods -= neighbourhoods.mean(axis=1, keepdims=True)
        # The variances along the principal axes of a neighbourhood, ascending, times the number of
        # its points.
        variances = np.linalg.eigvalsh(np.einsum('mpi,mpj->mij', neighbourhoods, neighbourhoods))
        # Points on a line, such as the far rings of a laser scanner, are not isolated.
        on_line = variances[:, 1] <= 0.05 * variances[:, 2]
        off_plane = variances[:, 0] >= 0.1 * variances[:, 1]
        # Points that are alone are isolated, and far points off a plane; points on a line are not.
        is_isolated[candidates] = ~on_line & (is_isolated[candidates] | off_plane)
        # ``is_isolated`` is a mask of the kept points; it is converted to indices of all points.
        is_kept[np.flatnonzero(is_kept)[is_isolated]] = False
    is_removed = ~is_kept
    # A larger share of isolated points is a property of the scanner.
    return is_removed if is_removed.mean() <= 0.05 else np.zeros(len(points), dtype=bool)


def stray_points(points: np.ndarray) -> np.ndarray:
    """
    Find the points that would enlarge the bounds of a room beyond its true size.

    Points in neighbouring cells of a grid are connected. The largest group is the room; a stray
    group has few points and lies outside the bounds of the room. Groups in the air inside the
    bounds, such as a lamp, stay.

    :param points: (N, 3), finite, in metres, or in another unit if that is not known yet.
    :returns: (N,) bool; all False if the size overflows.
    """
    points = np.asarray(points, dtype=np.float64)
    # Two per cent of the points at either end do not count for the size of the room.
    core = np.subtract(*np.percentile(points, [98.0, 2.0], axis=0))
    # The edge of a cell is four times the distance that neighbouring points would have if all
    # points were spread evenly over the sides of this core.
    with np.errstate(over='ignore'):
        area = 2.0 * (core[0] * core[1] + core[1] * core[2] + core[2] * core[0])
        edge = max(0.25, 4.0 * np.sqrt(area / len(points)))
        if not np.isfinite(edge):
            return np.zeros(len(points), dtype=bool)
        cells = (points - np.median(points, axis=0)) / edge
    # Cells beyond the limits of cell numbers are moved to the outermost cell.
    cells = np.clip(np.floor(cells), 1 - MAX_CELL, MAX_CELL - 1).astype(np.int64)
    numbers, cell_of_point = np.unique(cell_numbers(cells), return_inverse=True)
    groups = _connected_groups(cells_numbered(numbers))[cell_of_point]
    sizes = np.bincount(groups)
    corners = corners_of(points[groups == np.argmax(sizes)])
    # For each group, the distance of its nearest point from the bounds of the largest group.
    distances = np.full(len(sizes), np.inf)
    with np.errstate(over='ignore'):
        np.minimum.at(distances, groups, away_from(points, corners))
    # A stray group has at most 0.2 % of the points, or 5 % if it is farther away than the diagonal
    # of the room.
    max_shares = np.where(distances > np.linalg.norm(corners[1] - corners[0]), 0.05, 0.002)
    # A stray group is more than a metre away, and more than the edge of a cell.
    return ((distances > max(1.0, edge)) & (sizes <= max_shares * len(points)))[groups]


def _connected_groups(cells: np.ndarray) -> np.ndarray:
    """Return the group number (M,) of each cell (M, 3); touching cells are in one group."""
    pairs = cKDTree(cells).query_pairs(1.5, p=np.inf, output_type='ndarray')
    graph = coo_array((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])),
                      shape=(len(cells), len(cells)))
    return connected_components(graph, directed=False)[1]
