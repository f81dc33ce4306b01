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
Point-to-plane registration of points to surfaces, from many starts at once.

The method is iteratively reweighted least squares (Chen and Medioni, 1992) with the kernel of
Geman and McClure. A point is matched only to a surface that faces the camera and has a similar
normal.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

#: The least cosine between the normals of a point and its match: 60 degrees.
MIN_COSINE = 0.5


class Poses(NamedTuple):
    """
    Several poses of one camera.

    :ivar rotations: (S, 3, 3), body frame to map frame.
    :ivar positions: (S, 3), metres, map frame.
    """

    rotations: np.ndarray
    positions: np.ndarray

    def only(self, which: np.ndarray) -> 'Poses':
        """Return a part of the arrays."""
        return Poses(self.rotations[which], self.positions[which])


class Surfaces(NamedTuple):
    """
    Points of a scan with normals.

    :ivar points: (N, 3) float64, metres, map frame.
    :ivar normals: (N, 3) unit vectors.
    :ivar oriented: whether the normals point to the visible side of the surface.
    :ivar tree: a tree of the points.
    """

    points: np.ndarray
    normals: np.ndarray
    oriented: bool
    tree: cKDTree

    @classmethod
    def of(cls, points: np.ndarray, normals: np.ndarray, oriented: bool) -> 'Surfaces':
        """Build the surfaces and their tree."""
        return cls(points, normals, oriented, cKDTree(points))


class Patches(NamedTuple):
    """
    The measured points of a camera, thinned.

    :ivar points: (M, 3) metres, body frame.
    :ivar normals: (M, 3) unit vectors towards the camera.
    :ivar deviation: (M,) metres, the standard deviation of each point.
    """

    points: np.ndarray
    normals: np.ndarray
    deviation: np.ndarray

    def only(self, which: np.ndarray) -> 'Patches':
        """Return a part of the arrays."""
        return Patches(*(values[which] for values in self))


class AlignmentStage(NamedTuple):
    """
    One stage of a registration.

    :ivar gate: the largest distance between a point and its match, metres, in the first and in the
        last step.
    :ivar kernel: the width of the kernel in standard deviations, in the first and in the last
        step.
    :ivar steps: the largest number of steps.
    """

    gate: tuple[float, float]
    kernel: tuple[float, float]
    steps: int


class Matches(NamedTuple):
    """
    Matches of points and surfaces, for several poses.

    :ivar residuals: (S, M) metres across the surface.
    :ivar jacobians: (S, M, 6): the derivatives of the residuals by radians about the map axes
        through the camera, and by metres along them.
    :ivar found: (S, M) bool, whether there is a match.
    :ivar indices: (S, M) indices of the matched surface points.
    """

    residuals: np.ndarray
    jacobians: np.ndarray
    found: np.ndarray
    indices: np.ndarray


def matched(surfaces: Surfaces, patches: Patches, poses: Poses, gate: float) -> Matches:
    """Match points to the nearest surface points, if these face the camera as the points do."""
    arms = np.einsum('sij,mj->smi', poses.rotations, patches.points)
    placed = arms + poses.positions[:, None]
    distance, index = surfaces.tree.query(placed, distance_upper_bound=gate)
    found = np.isfinite(distance)
    index = np.where(found, index, 0)
    foot, normals = surfaces.points[index], surfaces.normals[index]
    facing = np.einsum('smi,smi->sm', normals, poses.positions[:, None] - foot)
    if surfaces.oriented:
        found &= facing > 0.0
    else:
        normals = np.where(facing[..., None] < 0.0, -normals, normals)
    own = np.einsum('sij,mj->smi', poses.rotations, patches.normals)
    found &= np.einsum('smi,smi->sm', normals, own) > MIN_COSINE
    residuals = np.einsum('smi,smi->sm', normals, placed - foot)
    return Matches(residuals, np.concatenate([np.cross(arms, normals), normals], axis=2), found,
                   index)


def weights_of(matches: Matches, deviation: np.ndarray, kernel: float) -> np.ndarray:
    """Return the weights of matches (S, M), 1/m²: a kernel of Geman and McClure."""
    scaled = matches.residuals / (kernel * deviation)
    return matches.found / (deviation * (1.0 + scaled * scaled)) ** 2


def moved(poses: Poses, steps: np.ndarray) -> Poses:
    """Move poses by (S, 6) radians and metres in the map frame."""
    turns = Rotation.from_rotvec(steps[:, :3]).as_matrix()
    return Poses(turns @ poses.rotations, poses.positions + steps[:, 3:])


def aligned(surfaces: Surfaces, patches: Patches, poses: Poses, stage: AlignmentStage) -> Poses:
    """
    Register points to surfaces from several starts.

    :param surfaces: the surfaces of the scan.
    :param patches: the measured points of the camera.
    :param poses: the start poses.
    :param stage: the limits of the iteration.
    :returns: the final pose of each start.
    """
    for step in range(stage.steps):
        along = min(step / max(0.7 * stage.steps, 1.0), 1.0)
        gate, kernel = (first * (last / first) ** along for first, last in stage[:2])
        matches = matched(surfaces, patches, poses, gate)
        weights = weights_of(matches, patches.deviation, kernel)
        change = solved(matches, weights)
        poses = moved(poses, change)
        # The step is shorter than a hundredth of a millimetre.
        if along == 1.0 and np.abs(change).max() < 1e-5:
            break
    return poses


def solved(matches: Matches, weights: np.ndarray) -> np.ndarray:
    """Return the steps (S, 6) that minimise the weighted residuals."""
    weighted = matches.jacobians * weights[..., None]
    normal = np.swapaxes(weighted, 1, 2) @ matches.jacobians
    right = np.einsum('smi,sm->si', weighted, matches.residuals)
    mean = np.trace(normal, axis1=1, axis2=2)[:, None, None] / 6.0
    # Directions without surfaces stay solvable, since a share of the mean information is added in
    # all directions.
    return -np.linalg.solve(normal + (1e-4 * mean + 1e-9) * np.eye(6), right[..., None])[..., 0]
