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
Covisibility: which cameras see the same surfaces, so that they can be calibrated to each other.

Two cameras are linked if enough points are visible to both under a small enough angle. All cameras
can be brought into one frame if the graph of these links is connected. Cameras in place have known
poses and count as linked.
"""

from collections.abc import Sequence
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
    The shares of points that pairs of cameras have in common.

    :ivar shares: (C, C) the number of points visible to both cameras under a small enough angle,
        as a share of the points of the camera that sees fewer; 1 between cameras in place.
    :ivar tree: the C - 1 links (camera, camera) that connect all cameras by the largest shares.
    :ivar required: the least share at which two cameras are linked.
    """

    shares: np.ndarray
    tree: list[tuple[int, int]]
    required: float

    @property
    def missing(self) -> float:
        """Return the mean shortfall of the links of the tree: 0 if connected, at most 1."""
        lacks = [1.0 - min(self.shares[link] / self.required, 1.0) for link in self.tree]
        return float(np.mean(lacks)) if lacks else 0.0

    def linked(self, one: int, other: int) -> bool:
        """Return whether two cameras share enough points to be linked."""
        return bool(self.shares[one, other] >= self.required - SHARE_TOLERANCE)

    @property
    def groups(self) -> list[list[int]]:
        """Return the cameras in groups that are connected by links, the largest group first."""
        of = list(range(len(self.shares)))
        for one, other in self.tree:
            if self.linked(one, other):
                of = [of[one] if group == of[other] else group for group in of]
        return sorted(([camera for camera, own in enumerate(of) if own == group]
                       for group in dict.fromkeys(of)), key=len, reverse=True)


def covisibility(points: np.ndarray, views: Sequence[View], asked: Calibratable, fixed: int = 0
                 ) -> Covisibility:
    """
    Compute which points pairs of cameras share.

    :param points: (N, 3) the points of the room in the engine's order, metres, map frame.
    :param views: the views of C cameras, C >= 1, each from one position.
    :param asked: the conditions for a link between two cameras.
    :param fixed: the number of cameras in place, which are the last ones.
    """
    # At most 8192 points are compared.
    step = -(-len(points) // 8192)
    seen = np.stack([unpack(view.seen, len(points))[::step] for view in views])
    positions = np.stack([view.position for view in views])
    shared = _shared(np.ascontiguousarray(points[::step], dtype=np.float64), seen, positions,
                     float(np.cos(asked.angle)))
    own = shared.diagonal()
    shares = shared / np.maximum(np.minimum(own[:, None], own[None]), 1)
    movable = len(views) - fixed
    shares[movable:, movable:] = 1.0
    return Covisibility(shares, _spanning(shares), asked.overlap)


def watched(cells: np.ndarray, numbers: np.ndarray, views: Sequence[View], seen_by: int,
            angle: float) -> float:
    """
    Return the share of air positions that enough cameras see from enough directions.

    :param cells: (M, 3) metres, map frame, all coverage cells in the engine's order.
    :param numbers: (S,) the indices of the cells to count, S >= 1.
    :param views: the views of C cameras; a view from several positions at once counts for any
        direction.
    :param seen_by: the number of cameras that have to see a cell.
    :param angle: the least angle between the lines of sight of any two of these cameras, radians.
    """
    nowhere = np.full(3, np.nan)
    positions = np.array([nowhere if view.position is None else view.position for view in views])
    return float(_watched(cells, numbers, np.stack([view.covered for view in views]), positions,
                          seen_by, np.cos(angle))) / len(numbers)


def _spanning(shares: np.ndarray) -> list[tuple[int, int]]:
    """Return the links of a maximum spanning tree (Prim's method), the last camera first."""
    count = len(shares)
    outside = np.ones(count, dtype=bool)
    outside[-1] = False
    best, nearest = shares[-1].copy(), np.full(count, count - 1)
    tree = []
    for _ in range(count - 1):
        added = int(np.argmax(np.where(outside, best, -1.0)))
        tree.append((int(nearest[added]), added))
        outside[added] = False
        closer = shares[added] > best
        best, nearest = np.where(closer, shares[added], best), np.where(closer, added, nearest)
    return tree


@njit(cache=True, nogil=True)
def _shared(points, seen, positions, cosine):
    """
    Count the points that pairs of cameras see under a small enough angle.

    :param points: (S, 3) metres.
    :param seen: (C, S) bool.
    :param positions: (C, 3) metres.
    :param cosine: the cosine of the largest angle between two lines of sight.
    :returns: (C, C) int64; the diagonal has the number of points visible to each camera.
    """
    count = len(seen)
    found = np.zeros((count, count), dtype=np.int64)
    for one in range(count):
        for other in range(one, count):
            total = 0
            for k in range(len(points)):
                if seen[one, k] and seen[other, k]:
                    dot, square, other_square = 0.0, 0.0, 0.0
                    for axis in range(3):
                        a = points[k, axis] - positions[one, axis]
                        b = points[k, axis] - positions[other, axis]
                        dot, square, other_square = dot + a * b, square + a * a, \
                            other_square + b * b
                    if one == other or dot >= cosine * np.sqrt(square * other_square):
                        total += 1
            found[one, other] = found[other, one] = total
    return found


@njit(cache=True, nogil=True)
def _clique(linked, among, count):
    """Return whether any ``count`` cameras of the bits ``among`` are all linked to each other."""
    if count == 0:
        return True
    one, everyone = 0, among
    while among:
        # ``linked[one]`` contains only cameras with higher numbers.
        if among & np.uint64(1) and _clique(linked, everyone & linked[one], count - 1):
            return True
        among, one = among >> np.uint64(1), one + 1
    return False


@njit(cache=True, nogil=True)
def _watched(cells, numbers, covered, positions, seen_by, cosine):
    """
    Count the cells that enough cameras see from enough directions; see :func:`watched`.

    :param covered: (C, V) uint64, packed bits of the cells.
    :param positions: (C, 3) metres; NaN for views that count for any direction.
    :param cosine: the cosine of the least angle between two lines of sight.
    """
    count, total = len(covered), 0
    ways, linked = np.empty((count, 3)), np.empty(count, dtype=np.uint64)
    for number in numbers:
        word, bit = number >> 6, np.uint64(number & 63)
        among, seers = np.uint64(0), 0
        for one in range(count):
            linked[one] = 0
            if covered[one, word] >> bit & np.uint64(1):
                among |= np.uint64(1) << np.uint64(one)
                seers += 1
                ways[one] = cells[number] - positions[one]
                ways[one] /= max(np.sqrt((ways[one] ** 2).sum()), 1e-9)
                for other in range(one):
                    # NaN is not greater than any number, so such a view is always linked.
                    if not (ways[one] * ways[other]).sum() > cosine + 1e-9:
                        linked[other] |= np.uint64(1) << np.uint64(one)
        if seers >= seen_by and _clique(linked, among, seen_by):
            total += 1
    return total
