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
Register the cloud of a camera to the scan of its room, starting near the planned pose.

Many starts around that pose are registered coarsely. The best of the distinct results are
registered finely: first to the surfaces whose scanned side is certain, then to all visible ones.
The answer is the pose that explains most of the cloud with the fewest surfaces in space that the
camera has measured as free. It is refused if the scan explains little of the cloud, if another
pose explains as much, or if the surfaces do not constrain the pose.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, Pose
from ocp_ros.registration.alignment import (
    aligned,
    AlignmentStage,
    matched,
    Matches,
    MIN_COSINE,
    moved,
    Patches,
    Poses,
    Surfaces,
    weights_of,
)
from ocp_ros.registration.live_view import LiveView
from ocp_ros.registration.pose_certainty import axis_words, Certainty, certainty
from ocp_ros.registration.scan_surfaces import ScanSurfaces, SurfacesInView
from scipy.stats import qmc

#: The number of patches for the registration of the best starts.
OUTLINE_PATCHES = 600
FINEST_STAGE = AlignmentStage((0.04, 0.03), (2.0, 0.7), 16)
#: Metres and radians beyond which poses are distinct.
DISTINCT_POSES = (0.10, np.deg2rad(4.0))
#: Metres: the largest distance of a point to the nearest point of its surface.
MAX_MATCH_DISTANCE_M = 0.15
#: The number of explained points that a point closely behind a surface outweighs.
BEHIND_WEIGHT = 3.0


@dataclass(frozen=True)
class AcceptanceLimits:
    """Limits of an accepted answer, chosen on validation rooms."""

    #: The least share of the cloud that the scan explains.
    min_overlap: float = 0.35
    #: The largest share of surfaces in space measured as free.
    max_violated: float = 0.05
    #: The largest share of points closely behind a surface.
    max_behind: float = 0.025
    #: The least lead in score over another pose.
    min_lead: float = 0.06
    #: The least lead over a nearby pose, as a share of the fit.
    min_near_lead: float = 0.003
    #: The largest deviation with doubt, metres.
    max_metres: float = 0.0085
    #: The largest deviation with doubt, degrees.
    max_degrees: float = 0.45


LIMITS = AcceptanceLimits()


class Registration(NamedTuple):
    """
    The registered pose of a camera and its quality.

    :ivar pose: the pose in the map frame; if it is refused, the best one found.
    :ivar residual: the root mean square distance of matched points from the scan, metres.
    :ivar overlap: the share of the cloud that the scan explains, 0 to 1.
    :ivar violated: the share of the scan's surfaces in view that are in space measured as free.
    :ivar certainty: the expected deviations of the pose.
    :ivar beside: the share of the surfaces in view that are displaced against the scan.
    :ivar behind: the share of the cloud that lies closely behind scanned surfaces.
    :ivar refused: the reason why the pose must not be used; empty if it can be used.
    :ivar otherwise: the actual mounting or axes of the cloud, if other than given; else empty.
    """

    pose: Pose
    residual: float
    overlap: float
    violated: float
    certainty: Certainty
    beside: float
    behind: float
    refused: str
    otherwise: str = ''

    @property
    def unlike(self) -> bool:
        """Return whether the cloud does not match the scan."""
        return self.overlap < LIMITS.min_overlap or self.violated > LIMITS.max_violated


def register(scan: ScanSurfaces, view: LiveView, start: Pose, model: CameraModel) -> Registration:
    """
    Find the pose of a camera.

    :param scan: the scan of the room.
    :param view: the cloud of the camera.
    :param start: the planned pose, accurate to about a metre and 30 degrees.
    :param model: the model of the camera.
    """
    poses = [_refined(scan, view, pose, model) for pose in _distinct_poses(scan, view, start)]
    scores = [_score(scan, view, pose) for pose in poses]
    best = int(np.argmax(scores))
    answer = _evaluated(scan, view, poses[best], model)
    alternatives = [k for k, pose in enumerate(poses)
                    if scores[k] > scores[best] - LIMITS.min_lead
                    and _differ(pose, poses[best])]
    if answer.refused or not alternatives:
        return answer
    alternative = max(alternatives, key=lambda k: scores[k])
    return answer._replace(refused=_ambiguity_reason(poses[best], poses[alternative]))


def checked(scan: ScanSurfaces, view: LiveView, pose: Pose, model: CameraModel) -> Registration:
    """
    Find the pose of a camera that has hardly moved; cheaper than :func:`register`.

    :param pose: the former pose, accurate to a few centimetres.
    """
    return _evaluated(scan, view, _refined(scan, view, pose, model), model)


def _coarse_poses(scan: ScanSurfaces, view: LiveView, start: Pose) -> Poses:
    """Register starts around a pose coarsely, and return the results of the best of them."""
    poses = _start_poses(start)
    sketch, outline = (_sampled(view.patches, count) for count in (160, OUTLINE_PATCHES))
    poses = aligned(scan.coarse, sketch, poses, AlignmentStage((1.0, 0.3), (40.0, 8.0), 14))
    best = np.argsort(-_explained_share(scan.coarse, sketch, poses, 5.0), kind='stable')[:12]
    # Few points rank poses badly, so the planned pose is always included.
    best = np.union1d(best, 0)
    better = AlignmentStage((0.4, 0.2), (12.0, 5.0), 12)
    return aligned(scan.coarse, outline, poses.only(best), better)


def _start_poses(start: Pose) -> Poses:
    """Return a pose and the starts around it."""
    around = [np.zeros((1, 6))]
    # Metres and radians from the planned pose at most, and the number of starts.
    nearby = (0.4, np.deg2rad(15.0), 32)
    wide = (1.1, np.deg2rad(32.0), 64)
    for seed, (metres, radians, count) in enumerate((nearby, wide)):
        unit = 2.0 * qmc.Sobol(6, seed=seed).random(count) - 1.0
        around.append(unit * np.repeat([radians, metres], 3))
    steps = np.concatenate(around)
    return moved(Poses(np.repeat(start.rotation[None], len(steps), axis=0),
                       np.repeat(start.position[None], len(steps), axis=0)), steps)


def _sampled(patches: Patches, count: int) -> Patches:
    """Return a random subset of the patches, from all parts of the view."""
    return patches.only(np.random.default_rng(0).permutation(len(patches.points))[:count])


def _explained_share(surfaces: Surfaces, patches: Patches, poses: Poses, kernel: float
                     ) -> np.ndarray:
    """Return the share of patches that surfaces explain, from 0 to 1, (S,)."""
    matches = matched(surfaces, patches, poses, 0.3)
    return (weights_of(matches, patches.deviation, kernel) * patches.deviation ** 2).mean(axis=1)


def _distinct_poses(scan: ScanSurfaces, view: LiveView, start: Pose) -> list[Pose]:
    """Return the distinct poses around a start that best explain the cloud."""
    poses = _coarse_poses(scan, view, start)
    scores = (_explained_share(scan.coarse, _sampled(view.patches, OUTLINE_PATCHES), poses, 5.0)
              - view.violated(scan.coarse.points, poses))
    found: list[Pose] = []
    for k in np.argsort(-scores, kind='stable'):
        pose = Pose(poses.positions[k], poses.rotations[k])
        # At most 1.6 m and 45 degrees from the start, and not much worse than the best.
        if (not _differ(pose, start, (1.6, np.deg2rad(45.0))) and scores[k] > scores.max() - 0.2
                and len(found) < 3 and all(_differ(pose, other) for other in found)):
            found.append(pose)
    return found or [start]


def _score(scan: ScanSurfaces, view: LiveView, pose: Pose) -> float:
    """Return the score of a refined pose, at most 1."""
    return float(_explained_share(scan.fine, view.patches, _as_poses(pose), 3.0)[0]
                 - BEHIND_WEIGHT * _behind_share(scan.fine, view.patches, _as_poses(pose))[0]
                 - view.violated(scan.points, _as_poses(pose))[0])


def _differ(one: Pose, other: Pose, apart: tuple[float, float] = DISTINCT_POSES) -> bool:
    """Return whether two poses differ by more than given metres or radians."""
    metres, radians = one.away_from(other)
    return metres > apart[0] or radians > apart[1]


def _refined(scan: ScanSurfaces, view: LiveView, pose: Pose, model: CameraModel) -> Pose:
    """Register finely from a nearby pose."""
    for stage in (AlignmentStage((0.15, 0.08), (4.0, 2.0), 16),
                  AlignmentStage((0.1, 0.08), (2.0, 1.0), 16)):
        surfaces = scan.in_view(pose, model).sided
        if len(surfaces.points) < len(view.patches.points) // 50 + 1:
            break
        pose = _first_pose(aligned(surfaces, view.patches, _as_poses(pose), stage))
    surfaces = scan.in_view(pose, model).every
    return _first_pose(aligned(surfaces, view.patches, _as_poses(pose), FINEST_STAGE))


def _evaluated(scan: ScanSurfaces, view: LiveView, pose: Pose, model: CameraModel) -> Registration:
    """Register a pose as finely as possible, and decide whether to accept it."""
    inside = scan.in_view(pose, model)
    (pose, alternative), surfaces = _best_shift(inside, view.patches, pose), inside.every
    matches, weights = _fine_matches(surfaces, view.patches, pose)
    held = certainty(surfaces.points[matches.indices[0]], surfaces.normals[matches.indices[0]],
                     matches, weights)
    overlap, beside = _overlap_and_displaced(scan, view, pose)
    behind = float(_behind_share(scan.fine, view.patches, _as_poses(pose))[0])
    violated = float(view.violated(scan.points, _as_poses(pose))[0])
    refused = _rejection_reason(overlap, violated, behind, held, beside)
    if not refused and alternative is not None:
        refused = _ambiguity_reason(pose, alternative)
    return Registration(pose, _residual(matches, weights), overlap, violated, held, beside, behind,
                        refused)


def _fine_matches(surfaces: Surfaces, patches: Patches, pose: Pose) -> tuple[Matches, np.ndarray]:
    """Return the matches of a finely registered pose, and their weights."""
    matches = matched(surfaces, patches, _as_poses(pose), FINEST_STAGE.gate[1])
    return matches, weights_of(matches, patches.deviation, FINEST_STAGE.kernel[1])


def _best_shift(inside: SurfacesInView, patches: Patches, pose: Pose) -> tuple[Pose, Pose | None]:
    """
    Register a pose again from shifted ones.

    With a kernel as narrow as the noise, the registration may stay at a pose where only a few
    surfaces fit.

    :returns: the best pose, and another nearby pose that fits as well, if there is one.
    """
    surfaces = inside.every
    matches, weights = _fine_matches(surfaces, patches, pose)
    jacobians = matches.jacobians[0]
    ways = np.linalg.eigh((jacobians * weights[0, :, None]).T @ jacobians)[1].T
    # A rotation by one radian counts as 2.5 m.
    arm_m = 2.5
    ways /= np.maximum(np.linalg.norm(ways[:, 3:], axis=1),
                       arm_m * np.linalg.norm(ways[:, :3], axis=1))[:, None]
    # A pose is shifted in each of its six directions.
    shifts_m = (0.02, 0.04, 0.06, 0.08)
    steps = np.concatenate([[np.zeros(6)], *(sign * shift * ways for sign in (-1.0, 1.0)
                                             for shift in shifts_m)])
    starts = Poses(*(np.repeat(values, len(steps), axis=0) for values in _as_poses(pose)))
    subset = _sampled(patches, 2000)
    ends = aligned(surfaces, subset, moved(starts, steps), FINEST_STAGE)
    fits = _fit_scores(inside, subset, ends)
    # A shifted pose has to be better by this.
    fits[0] += 1e-3
    if fits.argmax() != 0:
        other = aligned(surfaces, patches, ends.only([fits.argmax()]), FINEST_STAGE)
        both = Poses(*(np.concatenate(pair) for pair in zip(_as_poses(pose), other)))
        pose = _first_pose(both.only([_fit_scores(inside, patches, both).argmax()]))
    distinct = np.array([_differ(Pose(position, rotation), pose, (0.01, np.deg2rad(0.5)))
                         for rotation, position in zip(*ends)])
    others = np.where(distinct, fits, -np.inf)
    alike = others.max() > (1.0 - LIMITS.min_near_lead) * fits.max()
    return pose, _first_pose(ends.only([others.argmax()])) if alike else None


def _fit_scores(inside: SurfacesInView, patches: Patches, poses: Poses) -> np.ndarray:
    """
    Return the fits of finely registered poses, (S,).

    Surfaces whose scanned side is certain count twice.
    """
    return np.sum([_explained_share(surfaces, patches, poses, FINEST_STAGE.kernel[1])
                   - BEHIND_WEIGHT * _behind_share(surfaces, patches, poses)
                   for surfaces in inside], axis=0)


def _first_pose(poses: Poses) -> Pose:
    """Return the first of several poses."""
    return Pose(poses.positions[0], poses.rotations[0])


def _as_poses(pose: Pose) -> Poses:
    """Return a pose as an array of one pose."""
    return Poses(pose.rotation[None], pose.position[None])


def _residual(matches: Matches, weights: np.ndarray) -> float:
    """Return the weighted root mean square residual, metres; NaN without matches."""
    total = weights.sum()
    return float(np.sqrt((weights * matches.residuals ** 2).sum() / total)) if total else np.nan


def _overlap_and_displaced(scan: ScanSurfaces, view: LiveView, pose: Pose) -> tuple[float, float]:
    """
    Compare the cloud with the scan, independently of the side of surfaces that it shows.

    :returns: the share of the cloud that the scan explains; and the share of displaced surfaces
        among those both seen and scanned.
    """
    patches = view.patches
    placed = patches.points @ pose.rotation.T + pose.position
    distance, index = scan.fine.tree.query(placed, distance_upper_bound=MAX_MATCH_DISTANCE_M)
    found = np.isfinite(distance)
    index = np.where(found, index, 0)
    normals = scan.normals[index]
    across = np.abs(np.einsum('ij,ij->i', placed - scan.points[index], normals))
    # A surface explains points within three standard deviations and 2 cm across it.
    explained = found & (across < 3.0 * patches.deviation + 0.02)
    alike = np.abs(np.einsum('ij,ij->i', patches.normals @ pose.rotation.T, normals)) > MIN_COSINE
    known = np.count_nonzero(found & alike)
    # The surface has been displaced.
    beside = np.count_nonzero(found & alike & (across > 2.0 * patches.deviation + 0.01))
    return float(explained.mean()), beside / max(known, 1)


def _behind_share(surfaces: Surfaces, patches: Patches, poses: Poses) -> np.ndarray:
    """
    Return the share of patches that lie closely behind a surface that faces the camera, (S,).

    Neither side of a panel can be seen there, and objects moved since the scan are mostly farther
    away.
    """
    matches = matched(surfaces, patches, poses, MAX_MATCH_DISTANCE_M)
    behind = -matches.residuals > 2.0 * patches.deviation + 0.006
    return (matches.found & behind).mean(axis=1)


def _ambiguity_reason(pose: Pose, alternative: Pose) -> str:
    """Return the message that another pose fits as well."""
    away, turn = alternative.away_from(pose)
    return (f'another pose, {away:.2f} m and {np.rad2deg(turn):.0f} degrees away, explains what '
            'it sees as well')


def _rejection_reason(overlap: float, violated: float, behind: float, held: Certainty,
                      beside: float) -> str:
    """Return the reason why a pose must not be used; empty if it can be used."""
    if overlap < LIMITS.min_overlap:
        return (f'the scan explains {100.0 * overlap:.0f} % of what it sees, '
                f'{100.0 * LIMITS.min_overlap:.0f} % are needed')
    if violated > LIMITS.max_violated:
        return (f'{100.0 * violated:.0f} % of the surfaces in its view stand where it looked '
                f'through, at most {100.0 * LIMITS.max_violated:.0f} % may')
    if behind > LIMITS.max_behind:
        return (f'{100.0 * behind:.1f} % of what it sees lies closely behind scanned surfaces, '
                f'at most {100.0 * LIMITS.max_behind:.1f} % may')
    if held.loose:
        return f'it {" and ".join(held.loose)}: too few surfaces hold it there'
    doubted = held.doubted(overlap, beside)
    if doubted.metres[0] > LIMITS.max_metres or doubted.degrees[0] > LIMITS.max_degrees:
        return (f'it may be off by {1000.0 * doubted.metres[0]:.0f} mm along '
                f'{axis_words(doubted.along[0])} and {doubted.degrees[0]:.1f} degrees about '
                f'{axis_words(doubted.about[0])}, at most {1000.0 * LIMITS.max_metres:.1f} mm and '
                f'{LIMITS.max_degrees:g} degrees are allowed')
    return ''
