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
Covisibility: which cameras see the same points, so that they can be calibrated to each other.

Two cameras are linked if both see enough of the same points with a small enough angle between
their lines of sight. All cameras can be brought into one frame if the graph of these links is
connected. Cameras in place have known poses and count as linked.
"""

from collections.abc import Sequence
import math
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.packed_bits import unpack
from ocp_ros.rig.rig_file import Calibratable
from ocp_ros.simulation.simulator import View
from ocp_ros.util.kernels import njit

#: The tolerance for rounding when a share is compared with the required one.
SHARE_TOLERANCE = 1e-9


class Covisibility(NamedTuple):
    """
    The shares of points that pairs of C cameras have in common.

    :ivar shares: (C, C) the number of points that both cameras see with a small enough angle
        between their lines of sight, as a share of the points of the camera that sees fewer; 1
        between cameras in place.
    :ivar tree: the C - 1 links (camera, camera) that connect all cameras by the largest shares.
    :ivar required: the least share at which two cameras are linked.
    """

    shares: np.ndarray
    tree: list[tuple[int, int]]
    required: float

    @property
    def missing(self) -> float:
        """
        Return the mean relative shortfall of the tree's links below ``required``: 0 to 1.

        It is 0 for a single camera, which has no links.
        """
        shortfalls = [1.0 - min(self.shares[link] / self.required, 1.0) for link in self.tree]
        return float(np.mean(shortfalls)) if shortfalls else 0.0

    def linked(self, camera: int, other_camera: int) -> bool:
        """Return whether two cameras share enough points to be linked."""
        return bool(self.shares[camera, other_camera] >= self.required - SHARE_TOLERANCE)

    @property
    def groups(self) -> list[list[int]]:
        """Return the cameras in groups that are connected by links, the largest group first."""
        # The number of the group of each camera. The links of the tree suffice: a maximum spanning
        # tree connects all cameras that any links connect.
        labels = list(range(len(self.shares)))
        for camera, other in self.tree:
            if self.linked(camera, other):
                labels = [labels[camera] if label == labels[other] else label for label in labels]
        return sorted(([camera for camera, label in enumerate(labels) if label == group]
                       for group in dict.fromkeys(labels)), key=len, reverse=True)


def covisibility(points: np.ndarray, views: Sequence[View], condition: Calibratable,
                 fixed_count: int = 0) -> Covisibility:
    """
    Compute the shares of points that pairs of cameras have in common.

    :param points: (N, 3) the points of the room in the engine's order, metres, map frame.
    :param views: the views of C cameras, C >= 1, each from one position.
    :param condition: the least shared part and the largest angle of a link.
    :param fixed_count: the number of cameras in place; their views are the last ones.
    """
    # At most 8192 points, spread evenly, are compared, so that the time is bounded.
    step = -(-len(points) // 8192)
    seen = np.stack([unpack(view.seen, len(points))[::step] for view in views])
    positions = np.stack([view.position for view in views])
    shared = _count_shared(np.ascontiguousarray(points[::step], dtype=np.float64), seen, positions,
                           float(np.cos(condition.angle)))
    seen_counts = shared.diagonal()
    # The maximum avoids a division by 0 for cameras that see nothing.
    shares = shared / np.maximum(np.minimum.outer(seen_counts, seen_counts), 1)
    first_fixed = len(views) - fixed_count
    shares[first_fixed:, first_fixed:] = 1.0
    return Covisibility(shares, _spanning_tree(shares), condition.overlap)


def watched_share(places: np.ndarray, numbers: np.ndarray, bits: Sequence[np.ndarray],
                  views: Sequence[View], seen_by: int, angle: float,
                  max_gap: float = 2.0 * np.pi) -> float:
    """
    Return the share of cells or points that enough cameras see from directions far enough apart.

    :param places: (M, 3) metres, map frame, all cells or points in the engine's order.
    :param numbers: (S,) the indices in ``places`` of those to count, S >= 1.
    :param bits: of each camera, (V,) uint64, packed bits of the places that it sees.
    :param views: the views of the cameras; a view from several positions at once counts for any
        direction.
    :param seen_by: the number of cameras that have to see a place.
    :param angle: the least angle between the lines of sight of any two of these cameras, radians.
    :param max_gap: the largest angle, seen from above, between the directions of neighbouring
        cameras that see a cell, radians; a full turn for no limit.
    """
    # A position of NaN counts for any direction, see ``_count_watched``.
    unknown = np.full(3, np.nan)
    positions = np.array([unknown if view.position is None else view.position for view in views])
    return _count_watched(places, numbers, np.stack(bits), positions, seen_by, np.cos(angle),
                          max_gap) / len(numbers)


def _spanning_tree(shares: np.ndarray) -> list[tuple[int, int]]:
    """Return the links of a maximum spanning tree, grown from the last camera (Prim's method)."""
    count = len(shares)
    outside = np.ones(count, dtype=bool)
    outside[-1] = False
    # Of each camera: its largest share with a camera in the tree, and that camera.
    best_shares, partners = shares[-1].copy(), np.full(count, count - 1)
    tree = []
    for _ in range(count - 1):
        # Shares are at least 0, so -1 rules out the cameras in the tree.
        added = int(np.argmax(np.where(outside, best_shares, -1.0)))
        tree.append((int(partners[added]), added))
        outside[added] = False
        partners = np.where(shares[added] > best_shares, added, partners)
        best_shares = np.maximum(best_shares, shares[added])
    return tree


@njit(cache=True, nogil=True)
def _count_shared(points, seen, positions, cosine):
    """
    Count for each pair of C cameras the points that both see under a small enough angle.

    :param points: (N, 3) metres.
    :param seen: (C, N) bool, whether a camera sees a point.
    :param positions: (C, 3) metres, of the cameras.
    :param cosine: the cosine of the largest angle between two lines of sight.
    :returns: (C, C) int64; the diagonal has the number of points visible to each camera.
    """
    cameras = len(seen)
    counts = np.zeros((cameras, cameras), dtype=np.int64)
    for camera in range(cameras):
        for other in range(camera, cameras):
            total = 0
            for k in range(len(points)):
                if seen[camera, k] and seen[other, k]:
                    dot, square, other_square = 0.0, 0.0, 0.0
                    for axis in range(3):
                        component = points[k, axis] - positions[camera, axis]
                        other_component = points[k, axis] - positions[other, axis]
                        dot += component * other_component
                        square += component * component
                        other_square += other_component * other_component
                    # On the diagonal every point counts, without rounding.
                    if camera == other or dot >= cosine * np.sqrt(square * other_square):
                        total += 1
            counts[camera, other] = counts[other, camera] = total
    return counts


@njit(cache=True, nogil=True)
def _has_clique(linked, candidates, count):
    """
    Return whether ``count`` of the candidate cameras are all linked to each other.

    :param linked: (C,) uint64, C <= 64; bit j of entry i: camera j > i is linked to camera i.
    :param candidates: uint64; bit i: camera i is a candidate.
    :param count: the number of cameras that have to be linked.
    """
    if count == 0:
        return True
    # Links lead to cameras with larger numbers only, so each group is tried once.
    for camera in range(len(linked)):
        if candidates >> np.uint64(camera) & np.uint64(1) and _has_clique(
                linked, candidates & linked[camera], count - 1):
            return True
    return False


@njit(cache=True, nogil=True)
def _largest_gap(directions, seeing):
    """
    Return the largest angle, seen from above, between neighbouring directions, radians.

    :param directions: (C, 3) unit vectors from the cameras; NaN counts for any direction.
    :param seeing: uint64; bit i: the direction of camera i counts.
    """
    angles = np.empty(len(directions))
    count = 0
    for camera in range(len(directions)):
        if seeing >> np.uint64(camera) & np.uint64(1):
            x, y = directions[camera, 0], directions[camera, 1]
            if np.isnan(x):
                return 0.0
            # A camera right above a cell looks from no side.
            if x * x + y * y > 1e-9:
                angles[count] = math.atan2(y, x)
                count += 1
    if count == 0:
        return 2.0 * np.pi
    angles = np.sort(angles[:count])
    gap = angles[0] + 2.0 * np.pi - angles[-1]
    for k in range(count - 1):
        gap = max(gap, angles[k + 1] - angles[k])
    return gap


@njit(cache=True, nogil=True)
def _count_watched(cells, numbers, covered, positions, seen_by, cosine, max_gap):
    """
    Count the cells that C cameras see as :func:`watched_share` requires.

    :param cells: ``places`` of :func:`watched_share`, which has ``numbers`` and ``seen_by`` too.
    :param covered: (C, V) uint64, packed bits of the cells that each camera sees.
    :param positions: (C, 3) metres, of the cameras; NaN for views that count for any direction.
    :param cosine: the cosine of the least angle between two lines of sight.
    :param max_gap: radians, as in :func:`watched_share`.
    """
    cameras, total = len(covered), 0
    # For one cell: the unit vectors from the cameras, and the links between them as bits.
    directions, linked = np.empty((cameras, 3)), np.empty(cameras, dtype=np.uint64)
    for number in numbers:
        word, bit = number >> 6, np.uint64(number & 63)
        seeing = np.uint64(0)
        for camera in range(cameras):
            linked[camera] = 0
            if covered[camera, word] >> bit & np.uint64(1):
                seeing |= np.uint64(1) << np.uint64(camera)
                square = 0.0
                for axis in range(3):
                    directions[camera, axis] = cells[number, axis] - positions[camera, axis]
                    square += directions[camera, axis] ** 2
                length = max(math.sqrt(square), 1e-9)
                for axis in range(3):
                    directions[camera, axis] /= length
                for other in range(camera):
                    if not seeing >> np.uint64(other) & np.uint64(1):
                        continue
                    dot = 0.0
                    for axis in range(3):
                        dot += directions[camera, axis] * directions[other, axis]
                    # NaN is not greater than any number, so a view with NaN is always linked.
                    # 1e-9 is the tolerance for rounding.
                    if not dot > cosine + 1e-9:
                        linked[other] |= np.uint64(1) << np.uint64(camera)
        if _has_clique(linked, seeing, seen_by) and (
                max_gap >= 2.0 * np.pi or _largest_gap(directions, seeing) <= max_gap + 1e-9):
            total += 1
    return total
