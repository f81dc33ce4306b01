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

"""Estimate normals of points from planes fitted to neighbours, with correct planes near edges."""

import numpy as np
from ocp_ros.util.kernels import njit

#: The largest |z| of the normal of a wall.
STEEP = 0.3
#: The least |z| of the normal of a level surface.
LEVEL = 0.7
#: The number of sweeps of Jacobi's method; a (3, 3) matrix converges in fewer.
SWEEPS = 12
#: The weight of the roughness of a plane.
ROUGHNESS_WEIGHT = 3.0


def edge_aware_normals(points: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """
    Fit a plane to each point's neighbours; then choose the best of the nearby planes.

    A plane that is fitted across an edge matches neither side. So each point adopts the plane of
    the neighbour with the least cost: the distance of the point from the plane in spacings, plus
    the weighted roughness of the plane. Near an edge, this is the plane of a neighbour farther
    inside the face.

    :param points: (N, 3), metres.
    :param neighbours: (N, K) indices of the nearest points, the point itself first.
    :returns: (N, 3) float32 unit vectors of either sign.
    """
    points, neighbours = np.asarray(points, dtype=np.float64), np.ascontiguousarray(neighbours)
    typical = float(np.linalg.norm(points - points[neighbours[:, 1]], axis=1).mean())
    normals, roughness = _planes(points, neighbours)
    # A point may adopt the plane of one of its twelve nearest neighbours.
    return _adopted(points, neighbours[:, :12], normals, roughness, max(typical, 1e-9))


@njit(cache=True, nogil=True)
def _planes(points, neighbours):
    """
    Fit a plane to the neighbours of each point.

    :param points: (N, 3) float64.
    :param neighbours: (N, K) indices.
    :returns: normals (N, 3) float64, and the roughness (N,): the spread of the neighbours off the
        plane as a share of their total spread.
    """
    count, size = neighbours.shape
    normals, roughness = np.empty((count, 3)), np.empty(count)
    scatter, axes = np.empty((3, 3)), np.empty((3, 3))
    mean = np.empty(3)
    for i in range(count):
        mean[:] = 0.0
        for k in range(size):
            for a in range(3):
                mean[a] += points[neighbours[i, k], a]
        mean /= size
        scatter[:] = 0.0
        for k in range(size):
            for a in range(3):
                for b in range(a, 3):
                    scatter[a, b] += ((points[neighbours[i, k], a] - mean[a])
                                      * (points[neighbours[i, k], b] - mean[b]))
        _diagonalise(scatter, axes)
        least = 0
        for a in range(1, 3):
            if scatter[a, a] < scatter[least, least]:
                least = a
        total = scatter[0, 0] + scatter[1, 1] + scatter[2, 2]
        share = min(max(scatter[least, least] / max(total, 1e-30), 0.0), 1.0)
        roughness[i] = np.sqrt(share)
        for a in range(3):
            normals[i, a] = axes[a, least]
    return normals, roughness


@njit(cache=True, nogil=True)
def _diagonalise(matrix, axes):
    """
    Turn a symmetric matrix (3, 3) into its eigenvalues by Jacobi's rotations.

    :param matrix: its upper half, in and out: the diagonal becomes the eigenvalues.
    :param axes: (3, 3), out: the eigenvectors as columns.
    """
    for a in range(3):
        for b in range(3):
            axes[a, b] = 1.0 if a == b else 0.0
    for _ in range(SWEEPS):
        off = abs(matrix[0, 1]) + abs(matrix[0, 2]) + abs(matrix[1, 2])
        if off <= 1e-14 * (abs(matrix[0, 0]) + abs(matrix[1, 1]) + abs(matrix[2, 2])):
            return
        for p in range(2):
            for q in range(p + 1, 3):
                if matrix[p, q] == 0.0:
                    continue
                theta = 0.5 * (matrix[q, q] - matrix[p, p]) / matrix[p, q]
                sign = 1.0 if theta >= 0.0 else -1.0
                t = sign / (abs(theta) + np.sqrt(theta * theta + 1.0))
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                matrix[p, p] -= t * matrix[p, q]
                matrix[q, q] += t * matrix[p, q]
                matrix[p, q] = 0.0
                r = 3 - p - q
                low_p, high_p = min(r, p), max(r, p)
                low_q, high_q = min(r, q), max(r, q)
                to_p, to_q = matrix[low_p, high_p], matrix[low_q, high_q]
                matrix[low_p, high_p] = c * to_p - s * to_q
                matrix[low_q, high_q] = s * to_p + c * to_q
                for a in range(3):
                    along_p, along_q = axes[a, p], axes[a, q]
                    axes[a, p] = c * along_p - s * along_q
                    axes[a, q] = s * along_p + c * along_q


@njit(cache=True, nogil=True)
def _adopted(points, candidates, normals, roughness, typical):
    """
    Choose the best of some nearby planes for each point.

    :param points: (N, 3) float64, metres.
    :param candidates: (N, C) indices of the points whose planes are compared.
    :param normals: (N, 3) float64.
    :param roughness: (N,).
    :param typical: the mean distance between neighbouring points, metres.
    :returns: (N, 3) float32.
    """
    chosen = np.empty(points.shape, dtype=np.float32)
    for i in range(points.shape[0]):
        best, least = candidates[i, 0], np.inf
        for k in range(candidates.shape[1]):
            j = candidates[i, k]
            away = 0.0
            for a in range(3):
                away += (points[i, a] - points[j, a]) * normals[j, a]
            cost = abs(away) / typical + ROUGHNESS_WEIGHT * roughness[j]
            if cost < least:
                best, least = j, cost
        for a in range(3):
            chosen[i, a] = normals[best, a]
    return chosen
