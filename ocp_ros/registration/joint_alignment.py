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
Register several cameras at once: to the scan, if there is one, and to each other.

The poses of K cameras are 6K unknowns of one problem. Each measured point has a residual to the
plane of the nearest surface point of the scan, and one to that of each other camera. All are
minimised together by iteratively reweighted Gauss-Newton steps, as in
:mod:`~ocp_ros.registration.alignment`. So a neighbour holds a camera in directions in which the
scan does not: along a bare wall, for example.

The covariance of all poses is estimated from blocks with an edge of one metre. Neighbouring points
have common errors, since they belong to one panel or one frame of the scan. So the number of
blocks counts, not the number of points. The covariance has two terms: that of the delete-a-group
jackknife, which is how much the poses change if one block is left out, and that of blocks with
independent errors as large as those observed.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import Pose
from ocp_ros.registration.alignment import (
    AlignmentStage,
    Certainty,
    FREE_DEVIATION,
    matches_of,
    Patches,
    Poses,
    Surfaces,
    weights_of,
)
from ocp_ros.util.annealing import between
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

#: The number of patches of a camera that are matched to those of another camera.
MUTUAL_PATCHES = 4000
#: The least share of these that has to match, so that two cameras hold each other.
MIN_MUTUAL_SHARE = 0.04
#: The number of points of a whole block.
WHOLE_BLOCK_POINTS = 8
#: The standard deviation of a distance that a person has measured, metres.
DISTANCE_DEVIATION_M = 0.005
#: Standard deviations of errors that are the same in all frames of a camera: in metres; and as a
#: share of the distance: everywhere, and per metre along the axes of the body, which is a bend.
DEPTH_ERRORS = np.array([2e-3, 1e-3, 2e-4, 2e-4, 2e-4])
#: The least standard deviation of what the points of a block have in common, metres: by errors of
#: a scan, and where ``DEPTH_ERRORS`` stand for errors.
BLOCK_DEVIATIONS = 0.003, 0.001
#: The same of a surface that may have been scanned from its other side, about its thickness; and
#: the edge of a block of such points, about that of a partition.
UNSIDED_DEVIATION, UNSIDED_EDGE_M = 0.03, 3.0
#: By which share depths are too long or too short at most, in general: a standard deviation.
LARGEST_DEPTH_SHARE = 0.03
#: The pose of a camera in its own body frame.
HERE = Pose(np.zeros(3), np.eye(3))
#: The number of patches of what was carried that are matched to those of another camera, and how
#: far those of different moments are apart in the fourth coordinate, metres.
CARRIED_PATCHES, LAYER_M = 2000, 100.0
#: The standard deviation by which meetings count, metres.
MEETING_DEVIATION_M = 0.01
#: The name of the scan among what holds a camera.
SCAN = 'scan'


class Constraints(NamedTuple):
    """
    Residuals of M points between a camera and the scan or another camera.

    :ivar camera: the number of the camera that measured the points.
    :ivar other: the number of the other camera; -1 for the scan.
    :ivar jacobians: (M, 6) or (M, 12): derivatives of the residuals by the rotation about the map
        axes through the camera, radians, and the displacement along these axes, metres; then by
        those of the other camera.
    :ivar residuals: (M,) metres.
    :ivar weights: (M,) 1/m², 0 without a match.
    :ivar points: (M, 3) the measured points, metres, map frame.
    :ivar normals: (M, 3) the normals of the matched surfaces.
    :ivar by_hand: whether a person has measured it, so that no depths are in it.
    :ivar is_sided: (M,) bool, of the matched surfaces, see :class:`Surfaces`; None: all are.
    """

    camera: int
    other: int
    jacobians: np.ndarray
    residuals: np.ndarray
    weights: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    by_hand: bool = False
    is_sided: np.ndarray | None = None

    @property
    def columns(self) -> np.ndarray:
        """Return the numbers of the unknowns that the columns of the jacobians stand for."""
        cameras = [self.camera] if self.other < 0 else [self.camera, self.other]
        return np.concatenate([np.arange(6 * k, 6 * k + 6) for k in cameras])

    def by_depths(self, poses: Sequence[Pose]) -> np.ndarray:
        """Return the derivatives (M, 5K) of the residuals by ``DEPTH_ERRORS`` of K cameras."""
        found = np.zeros((len(self.points), len(poses), 5))
        for camera, sign in () if self.by_hand else ((self.camera, 1.0), (self.other, -1.0)):
            if camera >= 0:
                offsets = self.points - poses[camera].position
                along = sign * np.einsum('ij,ij->i', offsets, self.normals)
                found[:, camera] = along[:, None] * np.column_stack([
                    1.0 / np.linalg.norm(offsets, axis=1), np.ones(len(offsets)),
                    offsets @ poses[camera].rotation])
        return found.reshape(len(self.points), -1)


class RigCamera(NamedTuple):
    """
    A camera to register with others.

    :ivar patches: its measured points, body frame.
    :ivar surfaces: the surfaces of the scan in its view; None without a scan.
    :ivar own: its points as surfaces for other cameras, body frame.
    :ivar few: some of its points, to be matched to the surfaces of other cameras.
    :ivar deviation: the standard deviations of the points of ``own``, metres.
    :ivar layers: of ``few``: a fourth coordinate, by which only points of the same moment are
        matched; None: all are of the still scene.
    """

    patches: Patches
    surfaces: Surfaces | None
    own: Surfaces
    few: Patches
    deviation: np.ndarray
    layers: np.ndarray | None = None

    @classmethod
    def of(cls, patches: Patches, surfaces: Surfaces | None = None,
           carried: tuple[Patches, np.ndarray] | None = None) -> 'RigCamera':
        """
        Build a camera from its patches and the surfaces of the scan in its view.

        :param carried: (C,) patches of what was there at some moments only, and the number of the
            moment of each, from 1 on; for all cameras of a rig or for none.
        """
        order = np.random.default_rng(0).permutation(len(patches.points))[:MUTUAL_PATCHES]
        if carried is None:
            return cls(patches, surfaces, Surfaces.of(patches.points, patches.normals, True),
                       patches.subset(order), patches.deviation)
        moving, moments = carried
        seen = Patches(*map(np.concatenate, zip(patches, moving)))
        layers = LAYER_M * np.concatenate([np.zeros(len(patches.points)), moments])
        tree = cKDTree(np.column_stack([seen.points, layers]))
        chosen = np.random.default_rng(0).permutation(len(moments))[:CARRIED_PATCHES]
        order = np.concatenate([order, len(patches.points) + chosen])
        return cls(patches, surfaces, Surfaces(seen.points, seen.normals, True, tree),
                   seen.subset(order), seen.deviation, layers[order])


def scan_constraints(camera: int, surfaces: Surfaces, patches: Patches, pose: Pose,
                     max_distance: float, kernel_width: float) -> Constraints:
    """
    Match the points of a camera to surfaces of the scan.

    :param camera: the number of the camera.
    :param surfaces: surfaces of the scan, map frame.
    :param max_distance: the largest distance between a point and its match, metres.
    :param kernel_width: the width of the kernel in standard deviations.
    """
    matches = matches_of(surfaces, patches, Poses.of(pose), max_distance)
    weights = weights_of(matches, patches.deviation, kernel_width)
    points = patches.points @ pose.rotation.T + pose.position
    return Constraints(camera, -1, matches.jacobians[0], matches.residuals[0], weights[0], points,
                       matches.jacobians[0, :, 3:], is_sided=matches.is_sided[0])


def _mutual_constraints(camera: int, other: int, rig: Sequence[RigCamera], poses: Sequence[Pose],
                        max_distance: float, kernel_width: float) -> Constraints:
    """Match the points of a camera to those of another; see :func:`scan_constraints`."""
    patches, surfaces = rig[camera].few, rig[other].own
    pose, base = poses[camera], poses[other]
    matches = matches_of(surfaces, patches, Poses.of(relative_pose(pose, base)), max_distance,
                         rig[camera].layers)
    # Both points have errors.
    deviation = np.hypot(patches.deviation, rig[other].deviation[matches.indices[0]])
    weights = weights_of(matches, deviation, kernel_width)[0]
    normals = matches.jacobians[0, :, 3:] @ base.rotation.T
    offsets = patches.points @ pose.rotation.T
    points = offsets + pose.position
    jacobians = _pair_jacobians(offsets, points - base.position, normals)
    return Constraints(camera, other, jacobians, matches.residuals[0], weights, points, normals)


def _pair_jacobians(offsets: np.ndarray, other_offsets: np.ndarray, normals: np.ndarray
                    ) -> np.ndarray:
    """Return derivatives (M, 12) of distances along normals; offsets are from both cameras."""
    return np.hstack([np.cross(offsets, normals), normals,
                      -np.cross(other_offsets, normals), -normals])


def relative_pose(pose: Pose, base: Pose) -> Pose:
    """Return a pose in the body frame of a camera at another pose."""
    return Pose((pose.position - base.position) @ base.rotation, base.rotation.T @ pose.rotation)


class Distance(NamedTuple):
    """
    A distance between two cameras that a person has measured.

    :ivar camera: the number of one camera.
    :ivar other: the number of the other camera.
    :ivar metres: from the middle of one to that of the other.
    """

    camera: int
    other: int
    metres: float

    def constraints(self, poses: Sequence[Pose]) -> Constraints:
        """Return the residuals of the distance; it counts as much as a whole block of points."""
        offset = poses[self.camera].position - poses[self.other].position
        length = float(np.linalg.norm(offset))
        direction, still = offset / max(length, 1e-9), np.zeros(3)
        rows = np.ones(WHOLE_BLOCK_POINTS)
        # The block is one of its own, far from all others.
        return Constraints(
            self.camera, self.other,
            np.outer(rows, np.concatenate([still, direction, still, -direction])),
            rows * (length - self.metres), rows * 10.0 / DISTANCE_DEVIATION_M ** 2,
            np.full((WHOLE_BLOCK_POINTS, 3), 1e4 + 100.0 * self.camera + self.other),
            np.outer(rows, direction), by_hand=True)


class Meeting(NamedTuple):
    """
    The middles of what two cameras see of one thing at several moments.

    They see different sides of it, so that this is a start only.

    :ivar camera: the number of one camera.
    :ivar other: the number of the other camera.
    :ivar places: (F, 3) metres, body frame of the camera, at F moments.
    :ivar other_places: the same in that of the other camera.
    """

    camera: int
    other: int
    places: np.ndarray
    other_places: np.ndarray

    def constraints(self, poses: Sequence[Pose]) -> Constraints:
        """Return the residuals of the middles along all axes."""
        offsets, other_offsets = (
            np.repeat(places @ poses[k].rotation.T, 3, axis=0) for k, places in (
                (self.camera, self.places), (self.other, self.other_places)))
        points = offsets + poses[self.camera].position
        normals = np.tile(np.eye(3), (len(self.places), 1))
        apart = points - other_offsets - poses[self.other].position
        return Constraints(self.camera, self.other,
                           _pair_jacobians(offsets, other_offsets, normals),
                           (apart * normals).sum(axis=1),
                           np.full(len(points), MEETING_DEVIATION_M ** -2.0), points, normals)


def distances_between(names: Sequence[str], measured: Mapping[tuple[str, str], float],
                      left_out: Collection[tuple[str, str]] = ()) -> list[Distance]:
    """Return the measured distances, metres, between two of some cameras, by their numbers."""
    return [Distance(names.index(a), names.index(b), metres) for (a, b), metres in measured.items()
            if a in names and b in names and (a, b) not in left_out]


def with_distances(
        register: Callable[[Collection[tuple[str, str]]], tuple[dict[str, Any], dict[str, str]]],
        measured: Mapping[tuple[str, str], float]) -> tuple[dict[str, Any], dict[str, str]]:
    """
    Register cameras, by a measured distance only where the clouds do not hold both cameras.

    A distance between cameras that are accepted without it is compared with that of their poses.

    :param register: registers all cameras without the given ones of the distances; it returns the
        registrations, and for other cameras the reasons why they have none, by name.
    :param measured: measured distances between two cameras, metres, by their names.
    :returns: as ``register``; distances that disagree are named in the notes and the reasons.
    """
    free = answer = register(measured)
    accepted = {name for name, one in free[0].items() if not one.refused}
    left_out = {pair for pair in measured if accepted.issuperset(pair)}
    if len(left_out) < len(measured):
        held = register(left_out)
        # A wrong distance does not take the pose from a camera that has one without it.
        if all(name in held[0] and not held[0][name].refused for name in accepted):
            answer = held
        else:
            left_out = set(measured)
    found = dict(answer[0])
    for pair in [pair for pair in measured if all(name in free[0] for name in pair)]:
        one, other = (free[0][name] for name in pair)
        apart = one.pose.position - other.pose.position
        length = float(np.linalg.norm(apart))
        covariance = one.certainty.covariance[3:, 3:] + other.certainty.covariance[3:, 3:]
        deviation = float(np.sqrt(apart @ covariance @ apart)) / max(length, 1e-9)
        spread, is_left_out = np.hypot(deviation, DISTANCE_DEVIATION_M), pair in left_out
        for name, to in (pair, pair[::-1]):
            if name not in found or (name in accepted and not is_left_out):
                continue
            # Stated deviations of accepted poses are rather too large, those of others too small.
            refused = found[name].refused
            limit = DISTANCE_DEVIATION_M if refused else spread if is_left_out else 2.0 * spread
            if abs(length - measured[pair]) > limit:
                key = 'refused' if refused else 'note'
                says = ('the clouds say', '; the distance was left out') if is_left_out else (
                    'used for its pose; without it, the clouds say', '')
                text = (f'measured {measured[pair]:.3f} m to {to}, {says[0]} {length:.3f} m'
                        f'{says[1]}: check that it is between the middles of these two cameras, '
                        'and the scale of their depths')
                found[name] = found[name]._replace(**{
                    key: '; '.join(filter(None, [getattr(found[name], key), text]))})
    return found, answer[1]


def advice(name: str, axis: np.ndarray, places: Mapping[str, np.ndarray],
           neighbours: Sequence[str] = (), measured: Collection[tuple[str, str]] = ()) -> str:
    """
    Return what would hold a camera along an axis; empty if nothing would.

    :param axis: (3,) unit vector, map frame.
    :param places: the positions (3,) of all cameras, metres, by name.
    :param neighbours: cameras whose views overlap with that of the camera.
    :param measured: pairs of cameras whose distance has been measured.
    """
    shares = {other: abs(axis @ (place - places[name])) / np.linalg.norm(place - places[name])
              for other, place in places.items() if other != name
              and not {(name, other), (other, name)} & {*measured}}
    best = max(shares, key=lambda other: shares[other], default='')
    # Across the axis, a distance does not hold it.
    remedies = [f'measure its distance to {best} (--distance {name}:{best}=METRES)'] \
        if best and shares[best] >= 0.5 else []
    remedies += [f'set a box down where {other} sees it too (--box)' for other in neighbours[:1]]
    return '; ' * bool(remedies) + ', or '.join(remedies)


def all_constraints(rig: Sequence[RigCamera], poses: Sequence[Pose],
                    pairs: Sequence[tuple[int, int]], max_distance: float, kernel_width: float,
                    distances: Sequence[Distance | Meeting] = ()) -> list[Constraints]:
    """Return the constraints by the scan, by pairs of cameras and by measured distances."""
    limits = max_distance, kernel_width
    return [*(scan_constraints(k, one.surfaces, one.patches, poses[k], *limits)
              for k, one in enumerate(rig) if one.surfaces is not None),
            *(_mutual_constraints(camera, other, rig, poses, *limits) for camera, other in pairs),
            *(one.constraints(poses) for one in distances)]


def overlapping_pairs(rig: Sequence[RigCamera], poses: Sequence[Pose], max_distance: float
                      ) -> list[tuple[int, int]]:
    """Return the pairs of cameras, in both orders, that see enough of the same surfaces."""
    found = []
    for camera in range(len(rig)):
        for other in range(len(rig)):
            if camera != other:
                matched = _mutual_constraints(camera, other, rig, poses, max_distance, 3.0)
                if np.mean(matched.weights > 0.0) >= MIN_MUTUAL_SHARE:
                    found.append((camera, other))
    return found


def joint_poses(rig: Sequence[RigCamera], poses: Sequence[Pose], stage: AlignmentStage,
                anchors: Collection[int] = (),
                distances: Sequence[Distance | Meeting] = ()) -> list[Pose]:
    """
    Register cameras to the scan and to each other.

    :param rig: the K cameras.
    :param poses: their start poses.
    :param stage: the limits of the iteration.
    :param anchors: cameras that keep their poses: at least one where no camera has a scan.
    :param distances: distances between cameras that a person has measured, and meetings.
    :returns: their final poses.
    """
    poses = list(poses)
    pairs = overlapping_pairs(rig, poses, stage.max_distances[0])
    for number in range(stage.max_steps):
        progress = min(number / max(0.7 * stage.max_steps, 1.0), 1.0)
        constraints = all_constraints(rig, poses, pairs, between(*stage.max_distances, progress),
                                      between(*stage.kernel_widths, progress), distances)
        information, gradient = _normal_equations(constraints, len(poses))
        damping = 1e-4 * np.repeat(
            information.diagonal().reshape(-1, 6).mean(axis=1), 6) + 1e-9
        for anchor in anchors:
            damping[6 * anchor:6 * anchor + 6] += 1e6 * max(information.diagonal().max(), 1.0)
        steps = -np.linalg.solve(information + np.diag(damping), gradient).reshape(-1, 6)
        poses = [Pose(pose.position + step[3:],
                      Rotation.from_rotvec(step[:3]).as_matrix() @ pose.rotation)
                 for pose, step in zip(poses, steps)]
        # All steps are shorter than 0.01 mm and 0.01 mrad.
        if progress == 1.0 and np.abs(steps).max() < 1e-5:
            break
    return poses


def _normal_equations(constraints: Sequence[Constraints], cameras: int
                      ) -> tuple[np.ndarray, np.ndarray]:
    """Return the information matrix (6K, 6K) and the gradient (6K,) of weighted residuals."""
    information, gradient = np.zeros((6 * cameras, 6 * cameras)), np.zeros(6 * cameras)
    for one in constraints:
        weighted = one.jacobians * one.weights[:, None]
        information[np.ix_(one.columns, one.columns)] += weighted.T @ one.jacobians
        gradient[one.columns] += weighted.T @ one.residuals
    return information, gradient


def pose_covariance(constraints: Sequence[Constraints], cameras: int,
                    anchors: Collection[int] = (), poses: Sequence[Pose] = ()
                    ) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the expected covariance of the poses of K registered cameras.

    :param constraints: those of the registered poses.
    :param cameras: K.
    :param anchors: cameras whose poses are exact by definition.
    :param poses: the registered poses, if what ``DEPTH_ERRORS`` do to them is to be added; where
        no camera has a scan, in place of errors of the scan.
    :returns: (6K, 6K), radians and metres, map axes, each camera's rotation about its own
        position; and the part of it that ``DEPTH_ERRORS`` add.
    """
    size = 6 * cameras
    jacobians, residuals, weights, blocks, sided = _in_blocks(constraints, size)
    has_scan = any(one.other < 0 for one in constraints)
    scale, parts = _block_scales(residuals, weights, blocks, sided,
                                 BLOCK_DEVIATIONS[bool(poses) and not has_scan])
    count = len(parts)
    weighted = jacobians * weights[:, None]
    information = weighted.T @ jacobians
    independent = (weighted * scale[blocks, None]).T @ jacobians
    # A weak prior keeps unconstrained directions solvable.
    prior = np.full(size, FREE_DEVIATION ** -2.0)
    for anchor in anchors:
        prior[6 * anchor:6 * anchor + 6] = 1e14
    covariance = np.linalg.inv(independent + np.diag(prior))
    # The jackknife: the step of the poses if each block is left out. The gradients of all blocks
    # add up to about 0, so that of the others is the opposite of that of the block. The prior is
    # converted from the information of independent blocks to that of all points.
    ratio = np.trace(independent) / max(np.trace(information), 1e-30)
    damped = information + np.diag(prior / max(ratio, 1e-12))
    spread = np.zeros((size, size))
    for part in parts:
        left = damped - weighted[part].T @ jacobians[part]
        step = np.linalg.solve(left, weighted[part].T @ residuals[part])
        spread += np.outer(step, step)
    covariance += (count - 1) / max(count, 1) * spread
    by_depths = np.zeros((size, size))
    if poses:
        moved = np.zeros((size, 5 * cameras))
        for one in constraints:
            moved[one.columns] += (one.jacobians * one.weights[:, None]).T @ one.by_depths(poses)
        moved = np.linalg.solve(damped, moved) * np.tile(DEPTH_ERRORS, cameras)
        by_depths = moved @ moved.T
    return covariance + by_depths, by_depths


def depth_shares(constraints: Sequence[Constraints], poses: Sequence[Pose]
                 ) -> tuple[np.ndarray, np.ndarray]:
    """
    Estimate by which share the depths of K registered cameras are too long.

    Shares and poses are estimated together, by one Gauss-Newton step in which each block of points
    counts as one measurement.

    :param constraints: those of the registered poses.
    :param poses: of the K cameras.
    :returns: (K,) the shares, and (K,) their standard deviations.
    """
    size = 6 * len(poses)
    jacobians, residuals, weights, blocks, sided = _in_blocks(constraints, size, poses)
    scale, _ = _block_scales(residuals, weights, blocks, sided)
    weighted = jacobians * (weights * scale[blocks])[:, None]
    prior = np.repeat([FREE_DEVIATION, LARGEST_DEPTH_SHARE], [size, len(poses)]) ** -2.0
    covariance = np.linalg.inv(weighted.T @ jacobians + np.diag(prior))
    # The step would make depths shorter by what they are too long.
    return ((covariance @ (weighted.T @ residuals))[size:],
            np.sqrt(covariance.diagonal()[size:]))


def _block_scales(residuals: np.ndarray, weights: np.ndarray, blocks: np.ndarray,
                  is_sided: np.ndarray, least: float = BLOCK_DEVIATIONS[0]
                  ) -> tuple[np.ndarray, list[slice]]:
    """
    Return by what the weights of points are multiplied so that a block is one measurement.

    :param residuals: (M,) metres, of M points; their weights (M,) and their B blocks (M,).
    :param is_sided: (B,) bool, whether the scanned side of a block is certain.
    :param least: the least standard deviation that the points of a block have in common, metres.
    :returns: (B,) factors, and the points of each block.
    """
    # Points of a block are consecutive.
    lengths = np.bincount(blocks)
    ends = np.cumsum(lengths)
    parts = [slice(end - length, end) for end, length in zip(ends, lengths)]
    total_weight = np.bincount(blocks, weights)
    # The mean of the squared residuals of each block.
    mean_square = np.bincount(blocks, weights * residuals ** 2) / total_weight
    # A fifth of the variance within a block is common to its points.
    variance = max(_block_deviation(residuals, parts), least) ** 2 + 0.2 * mean_square
    variance[~is_sided] += UNSIDED_DEVIATION ** 2
    # A whole block counts as one measurement with this variance, a block of few points as less.
    fill_share = np.minimum(lengths / WHOLE_BLOCK_POINTS, 1.0)
    return fill_share / total_weight / variance, parts


def _in_blocks(constraints: Sequence[Constraints], size: int, poses: Sequence[Pose] = ()
               ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """
    Sort the points of constraints by blocks.

    A block has one main axis of the normals and is of pairs of cameras or of the scan: of surfaces
    whose scanned side is certain, with an edge of a metre, or of others, with a longer one.

    :param poses: of the K cameras, to add K columns to the jacobians: the derivatives by the share
        by which depths are too long; empty: they are left out.
    :returns: of all M points with a weight, in the order of their blocks: jacobians (M, size),
        residuals (M,), weights (M,) and the numbers of their blocks (M,); and whether the scanned
        side of each of B blocks is certain (B,).
    """
    # Without any constraint, all arrays are empty.
    rows, cells = [np.zeros((0, size + len(poses)))], [np.zeros((0, 6))]
    residuals, weights = [np.zeros(0)], [np.zeros(0)]
    for one in constraints:
        # Points of almost no weight are left out.
        used = one.weights > 1e-9 * max(one.weights.max(initial=0.0), 1e-9)
        full = np.zeros((np.count_nonzero(used), size))
        full[:, one.columns] = one.jacobians[used]
        if poses:
            full = np.hstack([full, one.by_depths(poses)[used, 1::5]])
        rows.append(full)
        cells.append(np.column_stack([
            np.floor(one.points[used]), np.abs(one.normals[used]).argmax(axis=1),
            np.full(len(full), one.other >= 0),
            np.ones(len(full)) if one.is_sided is None else one.is_sided[used]]))
        residuals.append(one.residuals[used])
        weights.append(one.weights[used])
    values = np.concatenate(cells)
    blocks = np.unique(values[:, :5], axis=0, return_inverse=True)[1].ravel()
    # Most of the points decide, since some are sided by chance.
    values[:, 5] = (np.bincount(blocks, values[:, 5]) > 0.5 * np.bincount(blocks))[blocks]
    values[values[:, 5] == 0.0, :3] //= UNSIDED_EDGE_M
    found, blocks = np.unique(values, axis=0, return_inverse=True)
    blocks = blocks.ravel()
    order = np.argsort(blocks, kind='stable')
    return (np.concatenate(rows)[order], np.concatenate(residuals)[order],
            np.concatenate(weights)[order], blocks[order], found[:, 5] > 0.0)


def _block_deviation(residuals: np.ndarray, parts: Sequence[slice]) -> float:
    """
    Return the standard deviation of the error that the points of a block have in common, metres.

    :param residuals: (M,) metres, of M points.
    :param parts: the points of each block.
    :returns: 2 cm if fewer than four blocks are whole.
    """
    medians = [np.median(residuals[part]) for part in parts
               if part.stop - part.start >= WHOLE_BLOCK_POINTS]
    # Fewer than four whole blocks do not show how accurate the scan is: 2 cm are assumed.
    if len(medians) < 4:
        return 0.02
    # Few panels were scanned from the other side, so the median ignores their errors.
    # 1.4826 is the standard deviation of a normal distribution over its median absolute deviation.
    return 1.4826 * float(np.median(np.abs(medians)))


def certainties(constraints: Sequence[Constraints], names: Sequence[str],
                anchors: Collection[int] = (), poses: Sequence[Pose] = ()) -> list[Certainty]:
    """
    Return the expected deviations of each of K registered poses, and what holds them.

    :param constraints: those of the registered poses.
    :param names: of the K cameras.
    :param anchors: see :func:`pose_covariance`; ``poses`` as well.
    """
    covariance, by_depths = pose_covariance(constraints, len(names), anchors, poses)
    found = []
    for k in range(len(names)):
        own = slice(6 * k, 6 * k + 6)
        # The information about this camera alone from the scan and from each other camera.
        sources: dict[str, np.ndarray] = {}
        for one in constraints:
            if k in (one.camera, one.other):
                source = SCAN if one.other < 0 else names[
                    one.other if one.camera == k else one.camera]
                half = one.jacobians[:, :6] if one.camera == k else one.jacobians[:, 6:]
                sources[source] = sources.get(source, np.zeros((6, 6))) + (
                    half * one.weights[:, None]).T @ half
        found.append(Certainty.of(covariance[own, own], by_depths[own, own], sources))
    return found
