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

"""Farthest-point sampling and ball query, as in PointNet++ (Qi et al., 2017)."""

import numpy as np
from ocp_ros.util.kernels import njit


@njit(cache=True, nogil=True)
def _squared(one, other):
    """Return the squared distance of two points (3,)."""
    dx, dy, dz = one[0] - other[0], one[1] - other[1], one[2] - other[2]
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
def farthest_points(points, count):
    """
    Choose points one by one, each the farthest from the chosen points; the first is point 0.

    :param points: (N, 3) float32.
    :param count: number of points to choose; if it exceeds the distinct points, points repeat.
    :returns: (count,) int32 indices.
    """
    chosen = np.zeros(count, dtype=np.int32)
    nearest = np.full(points.shape[0], np.inf, dtype=np.float32)
    last = 0
    for k in range(1, count):
        farthest, best = 0, np.float32(-1.0)
        for i in range(points.shape[0]):
            nearest[i] = min(nearest[i], _squared(points[i], points[last]))
            if nearest[i] > best:
                farthest, best = i, nearest[i]
        chosen[k] = last = farthest
    return chosen


@njit(cache=True, nogil=True)
def ball_query(points, keys, radius, size):
    """
    Group the first points, in their order, within a radius of each key point.

    :param points: (N, 3) float32.
    :param keys: (K,) indices of the key points.
    :param radius: in the points' unit.
    :param size: points per group; a smaller group repeats its first point.
    :returns: (K, size) int32 indices.
    """
    groups = np.empty((keys.shape[0], size), dtype=np.int32)
    for k in range(keys.shape[0]):
        centre, found = points[keys[k]], 0
        for i in range(points.shape[0]):
            if _squared(points[i], centre) <= radius * radius:
                groups[k, found] = i
                found += 1
                if found == size:
                    break
        for i in range(found, size):
            groups[k, i] = groups[k, 0]
    return groups


@njit(cache=True, nogil=True)
def nearest_in_ball(points, keys, radius, size):
    """
    Group the nearest points within a radius of each key point, the key point first.

    With evenly spread key points, nearly every point is in a group, also in a dense cloud; a ball
    query would take the same first points for many groups.

    :param points: (N, 3) float32.
    :param keys: (K,) indices of the key points.
    :param radius: in the points' unit.
    :param size: points per group; a smaller group repeats its first point.
    :returns: (K, size) int32 indices.
    """
    groups = np.empty((keys.shape[0], size), dtype=np.int32)
    away = np.empty(size, dtype=np.float32)
    for k in range(keys.shape[0]):
        centre, found = points[keys[k]], 0
        for i in range(points.shape[0]):
            distance = _squared(points[i], centre)
            if distance > radius * radius or (found == size and distance >= away[size - 1]):
                continue
            at = min(found, size - 1)
            while at > 0 and away[at - 1] > distance:
                away[at], groups[k, at] = away[at - 1], groups[k, at - 1]
                at -= 1
            away[at], groups[k, at] = distance, i
            found = min(found + 1, size)
        for i in range(found, size):
            groups[k, i] = groups[k, 0]
    return groups
