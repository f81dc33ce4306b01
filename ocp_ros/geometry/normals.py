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

#: The largest |z| of the unit normal of a wall.
STEEP = 0.3
#: The least |z| of the unit normal of a level surface.
LEVEL = 0.7


def edge_aware_normals(points: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """
    Fit a plane to each point's neighbours; then choose the best of the nearby planes.

    A plane that is fitted across an edge matches neither side. So each point adopts the plane of
    the neighbour with the least cost: the distance of the point from the plane in spacings, plus
    the weighted roughness of the plane. Near an edge, this is the plane of a neighbour farther
    inside the face.

    :param points: (N, 3), N points, metres.
    :param neighbours: (N, K) the indices of the K points nearest to each point, itself first.
    :returns: (N, 3) float32, the unit normal of each point, of either sign.
    """
    points, neighbours = np.asarray(points, dtype=np.float64), np.ascontiguousarray(neighbours)
    # A single point has no other neighbour than itself.
    nearest = neighbours[:, min(1, neighbours.shape[1] - 1)]
    spacing = float(np.linalg.norm(points - points[nearest], axis=1).mean())
    normals, roughness = _fit_planes(points, neighbours)
    # A point may adopt the plane of one of its twelve nearest neighbours.
    return _choose_normals(points, neighbours[:, :12], normals, roughness, max(spacing, 1e-9))


@njit(cache=True, nogil=True)
def _fit_planes(points, neighbours):
    """
    Fit a plane to the K neighbours of each of N points.

    :param points: (N, 3) float64, metres.
    :param neighbours: (N, K) indices of points.
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
        # Only the upper half, since ``_diagonalise`` uses no other entries.
        scatter[:] = 0.0
        for k in range(size):
            for a in range(3):
                for b in range(a, 3):
                    scatter[a, b] += ((points[neighbours[i, k], a] - mean[a])
                                      * (points[neighbours[i, k], b] - mean[b]))
        _diagonalise(scatter, axes)
        # The normal is the axis along which the neighbours are spread least.
        thinnest = 0
        for a in range(1, 3):
            if scatter[a, a] < scatter[thinnest, thinnest]:
                thinnest = a
        total = scatter[0, 0] + scatter[1, 1] + scatter[2, 2]
        share = min(max(scatter[thinnest, thinnest] / max(total, 1e-30), 0.0), 1.0)
        roughness[i] = np.sqrt(share)
        for a in range(3):
            normals[i, a] = axes[a, thinnest]
    return normals, roughness


@njit(cache=True, nogil=True)
def _diagonalise(matrix, axes):
    """
    Diagonalise a symmetric matrix by Jacobi's rotations.

    :param matrix: (3, 3), in and out: only the upper half is used, and its diagonal becomes the
        eigenvalues.
    :param axes: (3, 3), out: the eigenvectors as columns.
    """
    for a in range(3):
        for b in range(3):
            axes[a, b] = 1.0 if a == b else 0.0
    # A (3, 3) matrix converges in fewer than 12 sweeps.
    for _ in range(12):
        off_diagonal = abs(matrix[0, 1]) + abs(matrix[0, 2]) + abs(matrix[1, 2])
        if off_diagonal <= 1e-14 * (abs(matrix[0, 0]) + abs(matrix[1, 1]) + abs(matrix[2, 2])):
            return
        for p in range(2):
            for q in range(p + 1, 3):
                if matrix[p, q] == 0.0:
                    continue
                # Rotate axes p and q by the angle that makes entry (p, q) zero.
                theta = 0.5 * (matrix[q, q] - matrix[p, p]) / matrix[p, q]
                sign = 1.0 if theta >= 0.0 else -1.0
                tangent = sign / (abs(theta) + np.sqrt(theta * theta + 1.0))
                cosine = 1.0 / np.sqrt(tangent * tangent + 1.0)
                sine = tangent * cosine
                matrix[p, p] -= tangent * matrix[p, q]
                matrix[q, q] += tangent * matrix[p, q]
                matrix[p, q] = 0.0
                # The entries of both axes with the third one, in the upper half.
                third = 3 - p - q
                low_p, high_p = min(third, p), max(third, p)
                low_q, high_q = min(third, q), max(third, q)
                entry_p, entry_q = matrix[low_p, high_p], matrix[low_q, high_q]
                matrix[low_p, high_p] = cosine * entry_p - sine * entry_q
                matrix[low_q, high_q] = sine * entry_p + cosine * entry_q
                for a in range(3):
                    axis_p, axis_q = axes[a, p], axes[a, q]
                    axes[a, p] = cosine * axis_p - sine * axis_q
                    axes[a, q] = sine * axis_p + cosine * axis_q


@njit(cache=True, nogil=True)
def _choose_normals(points, candidates, normals, roughness, spacing):
    """
    Choose the normal of the best of C nearby planes for each of N points.

    :param points: (N, 3) float64, metres.
    :param candidates: (N, C) indices of the points whose planes are compared.
    :param normals: (N, 3) float64, the unit normal of each point's plane.
    :param roughness: (N,) the roughness of each point's plane, see :func:`_fit_planes`.
    :param spacing: the mean distance between neighbouring points, metres.
    :returns: (N, 3) float32 unit vectors.
    """
    chosen = np.empty(points.shape, dtype=np.float32)
    # A roughness of 1 costs as much as a distance of three spacings.
    roughness_weight = 3.0
    for i in range(points.shape[0]):
        best = candidates[i, 0]
        least_cost = np.inf
        for k in range(candidates.shape[1]):
            j = candidates[i, k]
            distance = 0.0
            for a in range(3):
                distance += (points[i, a] - points[j, a]) * normals[j, a]
            cost = abs(distance) / spacing + roughness_weight * roughness[j]
            if cost < least_cost:
                best, least_cost = j, cost
        for a in range(3):
            chosen[i, a] = normals[best, a]
    return chosen
