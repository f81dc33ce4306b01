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
Find points of a scan where no surface is: reflections, dust, views through windows, mirror images.

A laser beam that hits a mirror yields points behind the wall. Behind the plane of a wall with a
mirror, each point has a counterpart at the mirrored position in front of the plane. Near the wall
there are few such points, since a mirror is smaller than its wall. A real second room has its
floor and walls there, even if it is the same room mirrored.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from ocp_ros.geometry.clouds import away_from, cell_numbers, cells_numbered, corners_of, MAX_CELL
from ocp_ros.geometry.normals import LEVEL, STEEP
from ocp_ros.scenes.neighbours import nearest
from ocp_ros.scenes.scene import MIN_POINTS, Scene
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

#: Largest share of isolated points that are left out of a scan.
MAX_ISOLATED_SHARE = 0.05


def isolated_points(points: np.ndarray) -> np.ndarray:
    """
    Find isolated points in the air of a room: dust, rain, edge pixels with mixed depths.

    A point is isolated if very few other points have it among their nearest points, or if its own
    nearest points are far away and lie on no plane.

    :param points: (N, 3) float32, metres.
    :returns: (N,) bool; a share of more than ``MAX_ISOLATED_SHARE`` is a property of the scanner.
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
    return ~is_kept


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


def without_mirror_images(scene: Scene) -> Scene:
    """Leave out the points behind mirrors and add a note; without mirrors, change nothing."""
    points, normals = scene.points.astype(np.float64), scene.normals_or_estimate
    areas = scene.pitch.astype(np.float64) ** 2
    # The largest distance in metres of a mirrored point from its counterpart.
    match_distance = max(0.08, 1.5 * float(np.median(scene.pitch)))
    # With a larger match distance, a real second room would match like a mirror image.
    if match_distance > 0.3:
        return scene
    is_kept = np.ones(len(points), dtype=bool)
    # A point farther behind a plane than this counts as behind it.
    behind_m = 0.1
    # Each plane comes with both normals. The normal points to the side that is taken as behind it.
    for normal, offset in _vertical_planes(points, normals, areas):
        distances = points @ normal - offset
        is_behind = is_kept & (distances > behind_m)
        count = np.count_nonzero(is_behind)
        if (not (0.005 * len(points) <= count < 0.5 * len(points))
                or np.median(distances[is_behind]) < 0.5):
            # Too few or too many points are behind the plane, or they are too near to it.
            continue
        # A real passage has about as much floor and wall within 0.4 m of the plane on both sides.
        # So the plane is no mirror if more than 0.6 times as many points are behind it as before
        # it. Surfaces that are nearly parallel to the plane do not count.
        crosses_plane = is_kept & (np.abs(normals @ normal) < 0.9)
        count_behind, count_before = (
            np.count_nonzero(crosses_plane & (side > behind_m) & (side < 0.4))
            for side in (distances, -distances))
        if count_behind > 0.6 * count_before:
            continue
        # Floors, ceilings and walls that cross the plane match their mirror images everywhere, so
        # they are excluded.
        tested = np.flatnonzero(is_behind & (np.abs(normals[:, 2]) < LEVEL)
                                & (np.abs(normals @ normal) > STEEP))
        tested = tested[np.random.default_rng(0).permutation(len(tested))[:4000]]
        if len(tested) < 50:
            continue
        front_tree = cKDTree(points[is_kept & (distances <= behind_m)])
        # The points behind the plane are a mirror image if 85 % of the tested ones, mirrored, have
        # a point near them. A mirror may hang up to 6 cm before its wall.
        for mirror_offset_m in (0.0, 0.03, 0.06):
            mirrored = points[tested] - 2.0 * (distances[tested, None] + mirror_offset_m) * normal
            match_distances, _ = front_tree.query(mirrored, distance_upper_bound=match_distance)
            if (match_distances <= match_distance).mean() >= 0.85:
                is_kept &= ~is_behind
                break
    removed_count = len(points) - np.count_nonzero(is_kept)
    if removed_count == 0 or len(points) - removed_count < MIN_POINTS:
        return scene
    note = (f'found {removed_count:,} points behind a wall that mirror the room before it; '
            'expected no mirror image; they are left out: cover mirrors when you scan')
    return replace(scene.only(is_kept), notes=(*scene.notes, note))


def _vertical_planes(points: np.ndarray, normals: np.ndarray, areas: np.ndarray
                     ) -> Iterator[tuple[np.ndarray, float]]:
    """
    Yield the largest vertical planes, each twice: with its normal, and with the opposite normal.

    :param points: (N, 3) metres.
    :param normals: (N, 3) unit vectors.
    :param areas: (N,) the area that each point stands for, square metres.
    :returns: for each plane a unit normal (3,), and the plane's offset in metres: the product of
        the normal with the points of the plane.
    """
    steep = np.flatnonzero(np.abs(normals[:, 2]) <= STEEP)
    # Opposite normals have the same angle.
    angles = np.rad2deg(np.arctan2(normals[steep, 1], normals[steep, 0])) % 180.0
    bin_deg = 2.0
    bins = np.round(angles / bin_deg).astype(int) % round(180.0 / bin_deg)
    bin_angles = np.deg2rad(bin_deg * bins)
    offsets = points[steep, 0] * np.cos(bin_angles) + points[steep, 1] * np.sin(bin_angles)
    # Candidate planes are 10 cm apart. A cell is an angle and a distance from the origin.
    cells, cell_of_point = np.unique(np.stack([bins, np.floor(offsets / 0.1).astype(int)], axis=1),
                                     axis=0, return_inverse=True)
    cell_areas = np.bincount(cell_of_point, areas[steep], len(cells))
    # The 24 largest planes of at least 1 m2 are tested.
    for cell in np.argsort(-cell_areas, kind='stable')[:24]:
        if cell_areas[cell] < 1.0:
            return
        cell_points = steep[cell_of_point == cell]
        angle = bin_angles[cell_of_point == cell][0]
        horizontal = normals[cell_points, :2]
        # Turn all normals of the plane to the same side before averaging them.
        horizontal = horizontal * np.sign(horizontal @ [np.cos(angle), np.sin(angle)])[:, None]
        plane_normal = np.append(np.average(horizontal, axis=0, weights=areas[cell_points]), 0.0)
        plane_normal /= np.linalg.norm(plane_normal)
        plane_offset = float(np.median(points[cell_points] @ plane_normal))
        yield plane_normal, plane_offset
        yield -plane_normal, -plane_offset
