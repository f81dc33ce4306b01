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
Point-to-plane registration of points to surfaces, from many start poses at once.

The method is iteratively reweighted least squares (Chen and Medioni, 1992) with the kernel of
Geman and McClure, which gives points far from their surface little weight. A point is matched only
to a surface that faces the camera and has a similar normal. Everywhere, S is the number of poses,
M that of measured points and N that of surface points.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import Pose
from ocp_ros.util.annealing import between
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

#: The least cosine between the normals of a point and its match: 60 degrees.
MIN_NORMAL_COSINE = 0.5
#: The weight of a match to a surface that may have been scanned from its other side.
UNSIDED_WEIGHT = 0.1
#: The deviation of an unconstrained camera, in metres and in radians.
FREE_DEVIATION = 10.0


class Poses(NamedTuple):
    """
    S poses of one camera.

    :ivar rotations: (S, 3, 3), body frame to map frame.
    :ivar positions: (S, 3), metres, map frame.
    """

    rotations: np.ndarray
    positions: np.ndarray

    @classmethod
    def of(cls, pose: Pose) -> 'Poses':
        """Return one pose, S = 1."""
        return cls(pose.rotation[None], pose.position[None])

    def subset(self, indices: np.ndarray) -> 'Poses':
        """Return the poses with the given indices (K,)."""
        return Poses(self.rotations[indices], self.positions[indices])


class Surfaces(NamedTuple):
    """
    N points of a scan with normals.

    :ivar points: (N, 3) float64, metres, map frame.
    :ivar normals: (N, 3) unit vectors.
    :ivar oriented: whether the normals point to the scanned side of the surface; otherwise they
        have either sign.
    :ivar tree: a search tree of the points.
    :ivar is_sided: (N,) bool, whether it is certain from which side a surface was scanned; None:
        of all.
    """

    points: np.ndarray
    normals: np.ndarray
    oriented: bool
    tree: cKDTree
    is_sided: np.ndarray | None = None

    @classmethod
    def of(cls, points: np.ndarray, normals: np.ndarray, oriented: bool,
           is_sided: np.ndarray | None = None) -> 'Surfaces':
        """Build the surfaces and their search tree from points and normals (N, 3)."""
        return cls(points, normals, oriented, cKDTree(points), is_sided)


class Patches(NamedTuple):
    """
    M measured points of a camera, thinned, with the normals of their surfaces.

    :ivar points: (M, 3) metres, body frame.
    :ivar normals: (M, 3) unit vectors towards the camera.
    :ivar deviation: (M,) metres, the standard deviation of each point.
    """

    points: np.ndarray
    normals: np.ndarray
    deviation: np.ndarray

    def subset(self, indices: np.ndarray) -> 'Patches':
        """Return the patches with the given indices (K,)."""
        return Patches(*(values[indices] for values in self))


class AlignmentStage(NamedTuple):
    """
    One stage of a registration.

    :ivar max_distances: the largest distance between a point and its match, metres, in the first
        and in the last step.
    :ivar kernel_widths: the width of the kernel in standard deviations, in the first and in the
        last step.
    :ivar max_steps: the largest number of steps.
    """

    max_distances: tuple[float, float]
    kernel_widths: tuple[float, float]
    max_steps: int


class Matches(NamedTuple):
    """
    Matches of M measured points and surface points, for each of S poses.

    :ivar residuals: (S, M) the signed distances from the planes of the surface points, metres.
    :ivar jacobians: (S, M, 6): the derivatives of the residuals by a rotation about the map axes
        through the camera, radians, and by a displacement along these axes, metres.
    :ivar found: (S, M) bool, whether there is a match.
    :ivar indices: (S, M) indices of the matched surface points.
    :ivar is_sided: (S, M) bool, whether it is certain from which side they were scanned.
    """

    residuals: np.ndarray
    jacobians: np.ndarray
    found: np.ndarray
    indices: np.ndarray
    is_sided: np.ndarray


def matches_of(surfaces: Surfaces, patches: Patches, poses: Poses, max_distance: float,
               layers: np.ndarray | None = None) -> Matches:
    """
    Return the match of each measured point: the nearest surface point, if it is suitable.

    A suitable surface point faces the camera and has a normal similar to that of the point.

    :param surfaces: the surfaces of the scan.
    :param patches: the measured points of the camera.
    :param poses: the poses of the camera.
    :param max_distance: the largest distance between a point and its match, metres.
    :param layers: (M,) a fourth coordinate of the points, where the tree has one.
    """
    turns = np.swapaxes(poses.rotations, 1, 2)
    offsets = patches.points @ turns
    positions = offsets + poses.positions[:, None]
    placed = positions if layers is None else np.concatenate(
        [positions, np.broadcast_to(layers[:, None], (*positions.shape[:2], 1))], axis=2)
    distance, index = surfaces.tree.query(placed, distance_upper_bound=max_distance)
    # Without a match, the tree returns the distance inf and an index after the last point.
    found = np.isfinite(distance)
    index = np.where(found, index, 0)
    surface_points, normals = surfaces.points[index], surfaces.normals[index]
    facing = np.einsum('smi,smi->sm', normals, poses.positions[:, None] - surface_points)
    if surfaces.oriented:
        found &= facing > 0.0
    else:
        # Normals of either sign are turned towards the camera.
        normals = np.where(facing[..., None] < 0.0, -normals, normals)
    found &= np.einsum('smi,smi->sm', normals, patches.normals @ turns) > MIN_NORMAL_COSINE
    residuals = np.einsum('smi,smi->sm', normals, positions - surface_points)
    jacobians = np.concatenate([np.cross(offsets, normals), normals], axis=2)
    is_sided = np.ones(index.shape, dtype=bool) if surfaces.is_sided is None \
        else surfaces.is_sided[index]
    return Matches(residuals, jacobians, found, index, is_sided)


def weights_of(matches: Matches, deviation: np.ndarray, kernel_width: float) -> np.ndarray:
    """
    Return the weights of matches by the kernel of Geman and McClure.

    :param deviation: (M,) the standard deviation of each measured point, metres.
    :param kernel_width: in standard deviations.
    :returns: (S, M) 1/m², for S poses and M measured points; 0 without a match.
    """
    # The inverse variance of a point, times the kernel 1 / (1 + scaled^2)^2.
    scaled = matches.residuals / (kernel_width * deviation)
    trust = matches.found * np.where(matches.is_sided, 1.0, UNSIDED_WEIGHT)
    return trust / (deviation * (1.0 + scaled * scaled)) ** 2


def moved_poses(poses: Poses, steps: np.ndarray) -> Poses:
    """Return poses after steps (S, 6): rotation vectors, radians, and metres, both map frame."""
    rotations = Rotation.from_rotvec(steps[:, :3]).as_matrix()
    return Poses(rotations @ poses.rotations, poses.positions + steps[:, 3:])


def aligned_poses(surfaces: Surfaces, patches: Patches, poses: Poses, stage: AlignmentStage
                  ) -> Poses:
    """
    Register points to surfaces from several start poses.

    :param surfaces: the surfaces of the scan.
    :param patches: the measured points of the camera.
    :param poses: the start poses.
    :param stage: the limits of the iteration.
    :returns: the final pose for each start pose.
    """
    for number in range(stage.max_steps):
        # The limits change geometrically and reach their last values after 70 % of the steps.
        progress = min(number / max(0.7 * stage.max_steps, 1.0), 1.0)
        max_distance = between(*stage.max_distances, progress)
        kernel_width = between(*stage.kernel_widths, progress)
        matches = matches_of(surfaces, patches, poses, max_distance)
        weights = weights_of(matches, patches.deviation, kernel_width)
        steps = best_steps(matches, weights)
        poses = moved_poses(poses, steps)
        # All steps are shorter than 0.01 mm and 0.01 mrad.
        if progress == 1.0 and np.abs(steps).max() < 1e-5:
            break
    return poses


def best_steps(matches: Matches, weights: np.ndarray) -> np.ndarray:
    """
    Return the steps of poses that minimise the weighted squares of the residuals.

    :param weights: (S, M), see :func:`weights_of`.
    :returns: (S, 6), see :func:`moved_poses`.
    """
    weighted = matches.jacobians * weights[..., None]
    information = np.swapaxes(weighted, 1, 2) @ matches.jacobians
    gradient = np.einsum('smi,sm->si', weighted, matches.residuals)
    mean = np.trace(information, axis1=1, axis2=2)[:, None, None] / 6.0
    # A share of the mean information is added in all directions, so that directions without
    # surfaces stay solvable; the constant does so for poses without matches.
    damped = information + (1e-4 * mean + 1e-9) * np.eye(6)
    return -np.linalg.solve(damped, gradient[..., None])[..., 0]


class Certainty(NamedTuple):
    """
    Expected standard deviations of a pose.

    :ivar slide_axes: (3, 3), one axis a row: directions of a possible displacement, map frame.
    :ivar metres: (3,) deviations along these axes, the largest first.
    :ivar turn_axes: (3, 3), one axis a row: axes of a possible rotation, map frame.
    :ivar degrees: (3,) deviations about these axes, the largest first.
    :ivar held_by: for each of the six axes, displacements first: the share of what holds the
        camera there, by name: ``scan`` or another camera; empty where nothing does.
    :ivar covariance: (6, 6) of a rotation about the map axes, radians, and a displacement along
        them, metres.
    :ivar by_depths: (6, 6), what errors of depths add to it.
    """

    slide_axes: np.ndarray
    metres: np.ndarray
    turn_axes: np.ndarray
    degrees: np.ndarray
    held_by: tuple[dict[str, float], ...] = ({},) * 6
    covariance: np.ndarray | float = 0.0
    by_depths: np.ndarray | float = 0.0

    @classmethod
    def of(cls, covariance: np.ndarray, by_depths: np.ndarray | float,
           sources: Mapping[str, np.ndarray]) -> 'Certainty':
        """
        Return the deviations of a pose.

        :param covariance: (6, 6), with ``by_depths``.
        :param sources: by the name of what holds the camera: its information matrix (6, 6).
        """
        slide_axes, metres = _principal_axes(covariance[3:, 3:])
        turn_axes, radians = _principal_axes(covariance[:3, :3])
        still = np.zeros((3, 3))
        held_by = []
        for axis in np.vstack([np.hstack([still, slide_axes]), np.hstack([turn_axes, still])]):
            amounts = {name: float(axis @ one @ axis) for name, one in sources.items()}
            total = sum(amounts.values())
            held_by.append({name: amount / total for name, amount in amounts.items()
                            if amount > 0.01 * total})
        return cls(slide_axes, metres, turn_axes, np.rad2deg(radians), tuple(held_by),
                   covariance, by_depths)

    def with_doubts(self, overlap: float, displaced_share: float) -> 'Certainty':
        """
        Return the deviations of the pose if the scan may be partly wrong.

        Displaced surfaces were moved, or the scan shows their other side. The more of them there
        are, the more of the other surfaces may be wrong too. With little overlap, few surfaces
        would show such errors. Errors of depths stay as they are.

        :param overlap: the share of the cloud that the scan explains, 0 to 1.
        :param displaced_share: the share of displaced surfaces, 0 to 1.
        """
        # The weight 2 was chosen on validation rooms.
        factor = 1.0 + 2.0 * (1.0 - overlap + displaced_share)
        return Certainty.of(
            factor ** 2 * (self.covariance - self.by_depths) + self.by_depths, self.by_depths, {})

    @property
    def loose_motions(self) -> list[str]:
        """Return descriptions of the unconstrained directions; empty if there are none."""
        # Up to 5 cm or 2 degrees, a direction counts as constrained.
        return [*(f'can slide along {axis_name(axis)}' for axis, deviation
                  in zip(self.slide_axes, self.metres) if deviation > 0.05),
                *(f'can turn about {axis_name(axis)}' for axis, deviation
                  in zip(self.turn_axes, self.degrees) if deviation > 2.0)]


def axis_name(axis: np.ndarray) -> str:
    """Return the name in messages of an axis (3,), map frame, independently of its sign."""
    largest = int(np.abs(axis).argmax())
    # Axes up to 18 degrees from x, y or z are named after it.
    if abs(axis[largest]) > 0.95:
        return ('the x direction', 'the y direction', 'the vertical')[largest]
    # Other axes up to 17 degrees from the level are named by their direction in the plan.
    if abs(axis[2]) < 0.3:
        # Lines have no sign, so their angles are from 0 to 180 degrees.
        angle = np.rad2deg(np.arctan2(axis[1], axis[0])) % 180.0
        return f'the level line at {angle:.0f} degrees from x'
    # The largest component is positive; adding 0.0 turns -0.0 into 0.0 for the text.
    axis = axis * np.sign(axis[largest]) + 0.0
    return 'the line ' + ', '.join(f'{value:.2f}' for value in axis)


def _principal_axes(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the principal axes as rows, and their standard deviations, largest first."""
    # ``eigh`` returns ascending eigenvalues, and the eigenvectors as columns.
    values, vectors = np.linalg.eigh(covariance)
    return vectors.T[::-1], np.minimum(np.sqrt(np.maximum(values[::-1], 0.0)), FREE_DEVIATION)
