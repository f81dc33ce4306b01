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
def _squared_distance(first, second):
    """Return the squared distance of two points (3,)."""
    dx, dy, dz = first[0] - second[0], first[1] - second[1], first[2] - second[2]
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
def farthest_points(points, count):
    """
    Choose point 0, then one by one the point that is farthest from all chosen points.

    :param points: (N, 3) float32.
    :param count: number of points to choose; with fewer distinct points, points repeat.
    :returns: (count,) int32 indices of the chosen points.
    """
    chosen = np.zeros(count, dtype=np.int32)
    # Squared distance of each point to the nearest chosen point.
    distances = np.full(points.shape[0], np.inf, dtype=np.float32)
    last = 0
    for k in range(1, count):
        farthest, largest = 0, np.float32(-1.0)
        for i in range(points.shape[0]):
            distances[i] = min(distances[i], _squared_distance(points[i], points[last]))
            if distances[i] > largest:
                farthest, largest = i, distances[i]
        chosen[k] = last = farthest
    return chosen


@njit(cache=True, nogil=True)
def ball_query(points, key_indices, radius, group_size):
    """
    Return for each key point the first points of the array within a radius.

    :param points: (N, 3) float32.
    :param key_indices: (K,) indices of the key points.
    :param radius: in the points' unit.
    :param group_size: points per group; a smaller group repeats its first point.
    :returns: (K, group_size) int32 indices.
    """
    groups = np.empty((key_indices.shape[0], group_size), dtype=np.int32)
    for k in range(key_indices.shape[0]):
        centre, count = points[key_indices[k]], 0
        for i in range(points.shape[0]):
            if _squared_distance(points[i], centre) <= radius * radius:
                groups[k, count] = i
                count += 1
                if count == group_size:
                    break
        for i in range(count, group_size):
            groups[k, i] = groups[k, 0]
    return groups


@njit(cache=True, nogil=True)
def nearest_in_ball(points, key_indices, radius, group_size):
    """
    Return for each key point the nearest points within a radius, the key point first.

    With evenly spread key points, nearly every point is in a group, also in a dense cloud;
    :func:`ball_query` would take the same first points for many groups.

    :param points: (N, 3) float32.
    :param key_indices: (K,) indices of the key points.
    :param radius: in the points' unit.
    :param group_size: points per group; a smaller group repeats its first point.
    :returns: (K, group_size) int32 indices.
    """
    groups = np.empty((key_indices.shape[0], group_size), dtype=np.int32)
    distances = np.empty(group_size, dtype=np.float32)
    for k in range(key_indices.shape[0]):
        centre, count = points[key_indices[k]], 0
        for i in range(points.shape[0]):
            distance = _squared_distance(points[i], centre)
            is_full = count == group_size
            if distance > radius * radius or (is_full and distance >= distances[group_size - 1]):
                continue
            # Insert the point into the group, which is sorted by squared distance.
            rank = min(count, group_size - 1)
            while rank > 0 and distances[rank - 1] > distance:
                distances[rank], groups[k, rank] = distances[rank - 1], groups[k, rank - 1]
                rank -= 1
            distances[rank], groups[k, rank] = distance, i
            count = min(count + 1, group_size)
        for i in range(count, group_size):
            groups[k, i] = groups[k, 0]
    return groups
