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

Many start poses around the planned pose are registered coarsely. The best of the distinct results
are registered finely: first to the surfaces whose scanned side is certain, then to all visible
ones. The answer is the pose with the best score: the share of the cloud that the scan explains,
minus the share of the scan's surfaces in space that the camera has measured as free, and minus a
multiple of the share of the cloud closely behind scanned surfaces. The pose is refused if the scan
explains little of the cloud, if another pose explains as much, or if the surfaces do not constrain
the pose.

A surface explains a point near its plane: fully at distance 0, less the farther away the point is.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, Pose, rotation_matrix
from ocp_ros.registration.alignment import (
    aligned_poses,
    AlignmentStage,
    axis_name,
    Certainty,
    Matches,
    matches_of,
    MIN_NORMAL_COSINE,
    moved_poses,
    Patches,
    Poses,
    Surfaces,
    weights_of,
)
from ocp_ros.registration.carried import (
    Carried,
    is_contradicted,
    MEETING_STAGE,
    meetings_between,
    NEAR_STAGE,
    NOT_ALIKE,
)
from ocp_ros.registration.joint_alignment import (
    advice,
    all_constraints,
    certainties,
    Constraints,
    depth_shares,
    distances_between,
    joint_poses,
    overlapping_pairs,
    relative_pose,
    RigCamera,
    scan_constraints,
)
from ocp_ros.registration.live_view import LiveView
from ocp_ros.registration.scan_surfaces import ScanSurfaces, SurfacesInView
from scipy.stats import qmc

#: The number of patches for the registration of the best starts.
OUTLINE_PATCHES = 600
#: Metres, and standard deviations, within which points of wrong depths find their surfaces.
WIDE_LIMITS = 0.15, 4.0
FINEST_STAGE = AlignmentStage((0.04, 0.03), (2.0, 0.7), 16)
#: Metres and radians: poses that differ by more than either are distinct.
DISTINCT_POSE_LIMITS = (0.10, np.deg2rad(4.0))
#: Metres: the largest distance of a point to the nearest point of its surface.
MAX_MATCH_DISTANCE_M = 0.15
#: Metres: the largest distance of a pose from its start.
FARTHEST_M = 1.6
#: How many agreements a contradiction outweighs, see :class:`Comparison`.
CONTRADICTION_WEIGHT = 3.0
#: What to do if too little holds a camera along a direction.
LOOSE_REMEDY = ('turn it to surfaces across that, best to the floor and two walls that meet, or '
                'scan what it sees of them')
#: What to check if the scan alone does not tell two poses apart.
DECIDED_BY_OTHERS = ('by the scan alone, another pose fits as well, and the other cameras '
                     'decided: check it by a measured distance to one of them (--distance)')
ALL = slice(None)
#: The weight in the score of the share of points closely behind a surface.
BEHIND_WEIGHT = 3.0


@dataclass(frozen=True)
class AcceptanceLimits:
    """Limits of an accepted answer, chosen on validation rooms."""

    #: The least share of the cloud that the scan explains.
    min_overlap: float = 0.35
    #: The largest share of surfaces in view that are in space measured as free.
    max_violated: float = 0.05
    #: The same where the room has changed since the scan, and the least overlap for this.
    max_changed: float = 0.25
    min_changed_overlap: float = 0.6
    #: The largest share of points closely behind a surface.
    max_behind: float = 0.025
    #: The least lead in score over any distinct pose.
    min_lead: float = 0.06
    #: The least lead over a nearby pose, as a share of the fit score.
    min_near_lead: float = 0.003
    #: The largest deviation if the scan may be partly wrong, metres; ``Certainty.with_doubts``.
    max_metres: float = 0.011
    #: The largest deviation if the scan may be partly wrong, degrees.
    max_degrees: float = 0.45


LIMITS = AcceptanceLimits()


class Registration(NamedTuple):
    """
    The registered pose of a camera and its quality.

    :ivar pose: the pose in the map frame, the best one found even if it is refused.
    :ivar residual: the root mean square distance of matched points from the scan, metres.
    :ivar overlap: the share of the cloud that the scan explains, 0 to 1.
    :ivar violated_share: the share of the scan's surfaces in view that are in space measured as
        free, 0 to 1.
    :ivar certainty: the expected deviations of the pose.
    :ivar displaced_share: the share of the surfaces both seen and scanned that are displaced
        against the scan, 0 to 1.
    :ivar behind_share: the share of the cloud that lies closely behind scanned surfaces, 0 to 1.
    :ivar refused: the reason why the pose must not be used; empty if it can be used.
    :ivar actual_setup: a description of the mounting or of the axes of the cloud, if they differ
        from those given; otherwise empty.
    :ivar note: a reason to check a pose that is not refused; otherwise empty.
    :ivar others: other poses that explain the cloud about as well as the best one.
    """

    pose: Pose
    residual: float
    overlap: float
    violated_share: float
    certainty: Certainty
    displaced_share: float
    behind_share: float
    refused: str
    actual_setup: str = ''
    note: str = ''
    others: tuple[Pose, ...] = ()

    @property
    def mismatched(self) -> bool:
        """Return whether the pose is refused since the cloud does not match the scan."""
        return bool(self.refused) and (self.overlap < LIMITS.min_overlap
                                       or self.violated_share > LIMITS.max_violated)

    def with_note(self, note: str) -> 'Registration':
        """Return the registration with a further note."""
        return self._replace(note='; '.join(filter(None, [self.note, note])))


def register(scan: ScanSurfaces, view: LiveView, start: Pose, model: CameraModel,
             near: float = FARTHEST_M) -> Registration:
    """
    Find the pose of a camera.

    :param scan: the scan of the room.
    :param view: the cloud of the camera.
    :param start: the planned pose, accurate to about a metre and 30 degrees.
    :param model: the model of the camera.
    :param near: how far the pose is from the start at most, metres.
    :returns: the pose and its quality; the pose may be refused.
    """
    poses = [_refined(scan, view, pose, model)
             for pose in _distinct_poses(scan, view, start, near)]
    scores = [_score(scan, view, pose) for pose in poses]
    best = int(np.argmax(scores))
    answer = _evaluated(scan, view, poses[best], model)
    metres = answer.pose.away_from(start)[0]
    # Refinement moves a pose by a few centimetres.
    if not answer.refused and metres > near + 0.1:
        return answer._replace(refused=(
            f'the best pose is {metres:.2f} m from that in the placement, at most {near:.2f} m '
            f'may be; correct the placement, or allow it (--near {metres + 0.1:.1f})'))
    alternatives = [k for k, pose in enumerate(poses)
                    if scores[k] > scores[best] - LIMITS.min_lead
                    and differ(pose, poses[best])]
    changed = _accepted_in_changed_room(answer)
    if answer.refused and changed is None:
        return answer
    if alternatives:
        alternatives.sort(key=lambda k: -scores[k])
        others = (*answer.others, *(poses[k] for k in alternatives))
        reason = _ambiguity_reason(poses[best], others[0], _remedy_by_near(
            [pose.away_from(start)[0] for pose in (poses[best], *others)]))
        return answer._replace(refused=answer.refused or reason, others=others)
    turns = _equal_turns(scan, view, answer.pose, model)
    if changed is not None:
        return answer if turns else changed
    if not turns:
        return answer
    *others, last = map(str, turns)
    return answer._replace(note=(
        f'the room looks the same turned by {", ".join(others)}{" and " * bool(others)}{last} '
        f'degrees: found {len(turns)} more pose{"s" * (len(turns) > 1)} that fit as well; make '
        'sure that it hangs where it was planned'))


def _remedy_by_near(metres: Sequence[float]) -> str:
    """Return how to take the nearest of poses so far from the planned one; empty if two are."""
    nearest, next_nearest = sorted(metres)[:2]
    if next_nearest < nearest + 0.2:
        return ''
    near = f'{0.5 * (nearest + next_nearest):.1f}'
    return f'if it hangs less than {near} m from its planned pose, say so (--near {near})'


def _accepted_in_changed_room(answer: Registration) -> Registration | None:
    """Return an answer as accepted if only changes of the room since the scan speak against it."""
    reason = _rejection_reason(answer.overlap, 0.0, answer.behind_share, answer.certainty,
                               answer.displaced_share)
    if (reason or answer.overlap < LIMITS.min_changed_overlap
            or not LIMITS.max_violated < answer.violated_share <= LIMITS.max_changed):
        return None
    return answer._replace(refused='', note=_change_reason(answer.violated_share))


def _equal_turns(scan: ScanSurfaces, view: LiveView, pose: Pose, model: CameraModel) -> list[int]:
    """
    Return the turns of the room about its middle after which a cloud fits it as well.

    :param pose: the registered pose.
    :returns: 90, 180 and 270 degrees, or some of them.
    """
    centre = 0.5 * (scan.points.min(axis=0) + scan.points.max(axis=0))
    least_score = _score(scan, view, pose) - LIMITS.min_lead
    patches = sampled(view.patches, OUTLINE_PATCHES)
    turns = []
    for degrees in (90, 180, 270):
        rotation = rotation_matrix(np.deg2rad(degrees))
        turned = Pose(centre + rotation @ (pose.position - centre), rotation @ pose.rotation)
        # The middle of the scan may be off by what it shows of other rooms.
        coarse = _first_pose(aligned_poses(scan.coarse, patches, Poses.of(turned),
                                           AlignmentStage((0.4, 0.2), (12.0, 5.0), 12)))
        # A coarse pose has a lower score than a fine one.
        if _score(scan, view, coarse) > least_score - 0.3 and _score(
                scan, view, _refined(scan, view, coarse, model)) > least_score:
            turns.append(degrees)
    return turns


def registered_nearby(scan: ScanSurfaces, view: LiveView, pose: Pose, model: CameraModel
                      ) -> Registration:
    """
    Find the pose of a camera that has hardly moved; cheaper than :func:`register`.

    :param scan: the scan of the room.
    :param view: the cloud of the camera.
    :param pose: the former pose, accurate to a few centimetres.
    :param model: the model of the camera.
    :returns: the pose and its quality; the pose may be refused.
    """
    return _evaluated(scan, view, _refined(scan, view, pose, model), model)


def depth_share(scan: ScanSurfaces, view: LiveView, pose: Pose, model: CameraModel
                ) -> tuple[float, float]:
    """Return by which share depths are longer than in the scan, and its standard deviation."""
    constraints = scan_constraints(0, scan.in_view(pose, model).every, view.patches, pose,
                                   *WIDE_LIMITS)
    shares, deviations = depth_shares([constraints], [pose])
    return float(shares[0]), float(deviations[0])


def register_together(scan: ScanSurfaces, cameras: Mapping[str, tuple[LiveView, CameraModel]],
                      found: Mapping[str, Registration],
                      measured: Mapping[tuple[str, str], float] | None = None,
                      carried: Mapping[str, Carried] | None = None,
                      left_out: Collection[tuple[str, str]] = ()) -> dict[str, Registration]:
    """
    Register cameras to the scan and to each other, after each has been registered alone.

    Cameras that do not match the scan take no part. Where several poses of a camera explain its
    cloud, the one that agrees best with the other cameras is taken.

    :param scan: the scan of the room.
    :param cameras: the view and the model of each camera, by name.
    :param found: the registration of each camera alone, by name.
    :param measured: measured distances between two cameras, metres, by their names.
    :param carried: what was set down in the views of the cameras, by name; of all or of none.
    :param left_out: measured distances that are not used.
    :returns: the registrations, improved.
    """
    names = [name for name, one in found.items() if not one.mismatched]
    if len(names) < 2:
        return dict(found)
    views = [cameras[name][0] for name in names]
    poses = _agreeing_poses(views, [found[name] for name in names])
    measured, carried = measured or {}, carried or {}
    distances = distances_between(names, measured, left_out)
    meetings = meetings_between(names, carried)
    for stage in (*((MEETING_STAGE, NEAR_STAGE) if meetings else ()),
                  AlignmentStage((0.1, 0.05), (3.0, 1.0), 10), FINEST_STAGE):
        rig = [RigCamera.of(view.patches, scan.in_view(pose, cameras[name][1]).every,
                            carried[name][:2] if meetings else None)
               for name, view, pose in zip(names, views, poses)]
        poses = joint_poses(rig, poses, stage, distances=[
            *distances, *(meetings if stage is MEETING_STAGE else ())])
    if meetings and is_contradicted(carried, dict(zip(names, views)), dict(zip(names, poses))):
        return {name: one._replace(refused=one.refused and one.refused + NOT_ALIKE)
                for name, one in register_together(
                    scan, cameras, found, measured, left_out=left_out).items()}
    limits = FINEST_STAGE.max_distances[1], FINEST_STAGE.kernel_widths[1]
    pairs = overlapping_pairs(rig, poses, limits[0])
    constraints = all_constraints(rig, poses, pairs, *limits, distances)
    joint = dict(found)
    for k, (name, certainty) in enumerate(zip(
            names, certainties(constraints, names, poses=poses))):
        own = [one for one in constraints if k in (one.camera, one.other)]
        alone = found[name]
        seen_by_others = np.zeros(len(views[k].patches.points), dtype=bool)
        for other in [other for camera, other in pairs if camera == k]:
            seen_by_others |= _explained(views[other].surfaces, views[k].patches,
                                         relative_pose(poses[k], poses[other]))[0]
        answer = _checked(scan, views[k], poses[k], certainty, _residual(own), (), seen_by_others)
        if answer.refused and not alone.refused:
            answer = _accepted_in_changed_room(answer) or answer
        if answer.refused and certainty.metres[0] > LIMITS.max_metres:
            answer = answer._replace(refused=answer.refused + advice(
                name, certainty.slide_axes[0],
                {other: pose.position for other, pose in zip(names, poses)},
                [names[other] for camera, other in pairs if camera == k], measured))
        doubt = DECIDED_BY_OTHERS if alone.others and not answer.refused else ''
        answer = answer._replace(actual_setup=alone.actual_setup, note=alone.note)
        joint[name] = answer.with_note(doubt)
    return joint


def _agreeing_poses(views: Sequence[LiveView], found: Sequence[Registration]) -> list[Pose]:
    """Return for each camera the one of its likely poses that agrees best with the others."""
    poses = [one.pose for one in found]
    certain = [k for k, one in enumerate(found) if not one.others]
    for k in [k for k, one in enumerate(found) if one.others]:
        likely = [found[k].pose, *found[k].others]
        scores = [sum(comparison(views[k], pose, views[other], poses[other]).agreement
                      for other in certain)
                  for pose in likely]
        poses[k] = likely[int(np.argmax(scores))]
    return poses


class Comparison(NamedTuple):
    """
    What two cameras, or one and several others, see at their poses.

    :ivar seen: the number of points that lie where the other camera has measured a surface.
    :ivar free: the number of points in space that the other camera has measured as free.
    :ivar count: the number of all points.
    """

    seen: int
    free: int
    count: int

    @property
    def agreement(self) -> float:
        """
        Return how well both agree: a likelihood ratio of these poses and chance, at most 1.

        Of the points that can be compared, about 92 % agree at nearly true poses and about 50 % at
        wrong ones, so that one contradiction outweighs three agreements: ln(0.5 / 0.08) =
        3 ln(0.92 / 0.5). The result is a share of all points.
        """
        return (self.seen - CONTRADICTION_WEIGHT * self.free) / max(self.count, 1)


def comparison(view: LiveView, pose: Pose, other: LiveView, other_pose: Pose,
               used: np.ndarray | slice = ALL, other_used: np.ndarray | slice = ALL) -> Comparison:
    """
    Compare what two cameras see.

    :param used: which patches of ``view`` count, (M,) bool; all unless given.
    :param other_used: the same of ``other``.
    """
    seen = free = count = 0
    for one, one_pose, one_used, two, two_pose in (
            (view, pose, used, other, other_pose), (other, other_pose, other_used, view, pose)):
        relative = relative_pose(one_pose, two_pose)
        points, normals = one.patches.points[one_used], one.patches.normals[one_used]
        numbers = two.compared(points @ relative.rotation.T + relative.position,
                               normals @ relative.rotation.T)
        seen, free, count = seen + numbers[0], free + numbers[1], count + len(points)
    return Comparison(seen, free, count)


def _coarse_poses(scan: ScanSurfaces, view: LiveView, start: Pose) -> Poses:
    """Return the best of the coarsely registered poses, from start poses around a planned one."""
    # All start poses are registered with few patches, and the 12 best results with more.
    few_patches, patches = (sampled(view.patches, count) for count in (160, OUTLINE_PATCHES))
    poses = aligned_poses(scan.coarse, few_patches, _start_poses(start),
                          AlignmentStage((1.0, 0.3), (40.0, 8.0), 14))
    best = np.argsort(-_explained_shares(scan.coarse, few_patches, poses, 5.0), kind='stable')[:12]
    # Few patches rank poses badly, so the result for the planned pose (0) is always included.
    best = np.union1d(best, 0)
    return aligned_poses(scan.coarse, patches, poses.subset(best),
                         AlignmentStage((0.4, 0.2), (12.0, 5.0), 12))


def _start_poses(start: Pose) -> Poses:
    """Return a planned pose and the start poses around it."""
    all_steps = [np.zeros((1, 6))]
    # Metres and radians from the planned pose at most, and the number of start poses.
    near_starts = (0.4, np.deg2rad(15.0), 32)
    wide_starts = (1.1, np.deg2rad(32.0), 64)
    for seed, (metres, radians, count) in enumerate((near_starts, wide_starts)):
        # Sobol points are spread evenly from 0 to 1; these steps are from -1 to 1.
        unit_steps = 2.0 * qmc.Sobol(6, seed=seed).random(count) - 1.0
        all_steps.append(unit_steps * np.repeat([radians, metres], 3))
    steps = np.concatenate(all_steps)
    return moved_poses(Poses(np.repeat(start.rotation[None], len(steps), axis=0),
                             np.repeat(start.position[None], len(steps), axis=0)), steps)


def sampled(patches: Patches, count: int) -> Patches:
    """Return a random subset of at most ``count`` patches, the same one in each call."""
    return patches.subset(np.random.default_rng(0).permutation(len(patches.points))[:count])


def _explained_shares(surfaces: Surfaces, patches: Patches, poses: Poses, kernel_width: float
                      ) -> np.ndarray:
    """Return the share of patches that surfaces explain at each of S poses, 0 to 1: (S,)."""
    weight = weights_of(matches_of(surfaces, patches, poses, 0.3), patches.deviation, kernel_width)
    # A weight times the variance is 1 at distance 0 and decreases; it is 0 without a match within
    # 0.3 m.
    return (weight * patches.deviation ** 2).mean(axis=1)


def _distinct_poses(scan: ScanSurfaces, view: LiveView, start: Pose, near: float) -> list[Pose]:
    """
    Return up to three distinct poses around a start that best explain the cloud.

    :returns: the best pose first; the start alone if none of the good poses is near enough to it.
    """
    poses = _coarse_poses(scan, view, start)
    patches = sampled(view.patches, OUTLINE_PATCHES)
    scores = (_explained_shares(scan.coarse, patches, poses, 5.0)
              - view.violated_shares(scan.coarse.points, poses))
    distinct: list[Pose] = []
    for k in np.argsort(-scores, kind='stable'):
        pose = Pose(poses.positions[k], poses.rotations[k])
        # At most 45 degrees from the start, and less than 0.2 worse than the best score.
        if (not differ(pose, start, (near, np.deg2rad(45.0))) and scores[k] > scores.max() - 0.2
                and len(distinct) < 3 and all(differ(pose, other) for other in distinct)):
            distinct.append(pose)
    return distinct or [start]


def _score(scan: ScanSurfaces, view: LiveView, pose: Pose) -> float:
    """Return the score of a finely registered pose, at most 1; see the module's text."""
    return float(_explained_shares(scan.fine, view.patches, Poses.of(pose), 3.0)[0]
                 - BEHIND_WEIGHT * _behind_shares(scan.fine, view.patches, Poses.of(pose))[0]
                 - view.violated_shares(scan.points, Poses.of(pose))[0])


def differ(pose: Pose, other: Pose, limits: tuple[float, float] = DISTINCT_POSE_LIMITS) -> bool:
    """Return whether two poses differ by more than given metres or by more than given radians."""
    metres, radians = pose.away_from(other)
    return metres > limits[0] or radians > limits[1]


def _refined(scan: ScanSurfaces, view: LiveView, pose: Pose, model: CameraModel) -> Pose:
    """
    Return a pose after fine registration: to ``sided`` surfaces, then to ``every`` one in view.

    See :class:`~ocp_ros.registration.scan_surfaces.SurfacesInView` for both.
    """
    for stage in (AlignmentStage((0.15, 0.08), (4.0, 2.0), 16),
                  AlignmentStage((0.1, 0.08), (2.0, 1.0), 16)):
        surfaces = scan.in_view(pose, model).sided
        # Sided surfaces are not used if their points are fewer than about 2 % of the patches.
        if len(surfaces.points) < len(view.patches.points) // 50 + 1:
            break
        pose = _first_pose(aligned_poses(surfaces, view.patches, Poses.of(pose), stage))
    surfaces = scan.in_view(pose, model).every
    return _first_pose(aligned_poses(surfaces, view.patches, Poses.of(pose), FINEST_STAGE))


def _evaluated(scan: ScanSurfaces, view: LiveView, pose: Pose, model: CameraModel) -> Registration:
    """Improve a finely registered pose, measure its quality, and accept or refuse it."""
    in_view = scan.in_view(pose, model)
    pose, alternative = _best_shift(in_view, view.patches, pose)
    surfaces = in_view.every
    constraints = scan_constraints(0, surfaces, view.patches, pose, FINEST_STAGE.max_distances[1],
                                   FINEST_STAGE.kernel_widths[1])
    certainty, = certainties([constraints], [''], poses=[pose])
    return _checked(scan, view, pose, certainty, _residual([constraints]),
                    () if alternative is None else (alternative,))


def _checked(scan: ScanSurfaces, view: LiveView, pose: Pose, certainty: Certainty, residual: float,
             others: tuple[Pose, ...], seen_by_others: np.ndarray | None = None) -> Registration:
    """
    Measure how well a cloud and the scan agree at a pose, and accept or refuse the pose.

    :param others: other poses that explain the cloud as well.
    :param seen_by_others: (M,) bool, which of the M patches other cameras explain.
    """
    explained, displaced = _explained(scan.fine, view.patches, pose)
    overlap = float((explained if seen_by_others is None else explained | seen_by_others).mean())
    displaced_share = float(np.nan_to_num(displaced).sum()
                            / max(np.isfinite(displaced).sum(), 1))
    behind_share = float(_behind_shares(scan.fine, view.patches, Poses.of(pose))[0])
    violated_share = float(view.violated_shares(scan.points, Poses.of(pose))[0])
    refused = _rejection_reason(overlap, violated_share, behind_share, certainty, displaced_share)
    if not refused and others:
        refused = _ambiguity_reason(pose, others[0])
    return Registration(pose, residual, overlap, violated_share, certainty, displaced_share,
                        behind_share, refused, others=others)


def _fine_matches(surfaces: Surfaces, patches: Patches, pose: Pose) -> tuple[Matches, np.ndarray]:
    """Return the matches of a finely registered pose, and their weights."""
    matches = matches_of(surfaces, patches, Poses.of(pose), FINEST_STAGE.max_distances[1])
    return matches, weights_of(matches, patches.deviation, FINEST_STAGE.kernel_widths[1])


def _best_shift(in_view: SurfacesInView, patches: Patches, pose: Pose) -> tuple[Pose, Pose | None]:
    """
    Register a pose again from start poses that are shifted from it.

    With a kernel as narrow as the noise, the registration may stay at a pose where only a few
    surfaces fit.

    :returns: the best pose, and another nearby pose that fits as well, if there is one.
    """
    surfaces = in_view.every
    matches, weights = _fine_matches(surfaces, patches, pose)
    jacobians = matches.jacobians[0]
    # The six independent directions in which the pose may be wrong, as steps: the eigenvectors of
    # the information matrix.
    directions = np.linalg.eigh((jacobians * weights[0, :, None]).T @ jacobians)[1].T
    # A rotation by one radian counts as 2.5 m. Each direction is scaled to 1 m: that is its
    # displacement or its rotation, whichever is larger.
    arm_m = 2.5
    directions /= np.maximum(np.linalg.norm(directions[:, 3:], axis=1),
                             arm_m * np.linalg.norm(directions[:, :3], axis=1))[:, None]
    shifts_m = (0.02, 0.04, 0.06, 0.08)
    steps = np.concatenate([[np.zeros(6)], *(sign * shift * directions for sign in (-1.0, 1.0)
                                             for shift in shifts_m)])
    # Register from the pose itself (number 0) and from the shifted poses.
    starts = Poses(*(np.repeat(values, len(steps), axis=0) for values in Poses.of(pose)))
    few_patches = sampled(patches, 2000)
    ends = aligned_poses(surfaces, few_patches, moved_poses(starts, steps), FINEST_STAGE)
    scores = _fit_scores(in_view, few_patches, ends)
    # The result of a shifted start has to be better than that of the pose itself by this.
    scores[0] += 1e-3
    if scores.argmax() != 0:
        # Compare with all patches: the better one of both is the pose.
        best = aligned_poses(surfaces, patches, ends.subset([scores.argmax()]), FINEST_STAGE)
        both = Poses(*(np.concatenate(pair) for pair in zip(Poses.of(pose), best)))
        pose = _first_pose(both.subset([_fit_scores(in_view, patches, both).argmax()]))
    # Look for another pose, more than 1 cm or 0.5 degrees away, that fits as well.
    distinct = np.array([differ(Pose(position, rotation), pose, (0.01, np.deg2rad(0.5)))
                         for rotation, position in zip(*ends)])
    other_scores = np.where(distinct, scores, -np.inf)
    ambiguous = other_scores.max() > (1.0 - LIMITS.min_near_lead) * scores.max()
    return pose, _first_pose(ends.subset([other_scores.argmax()])) if ambiguous else None


def _fit_scores(in_view: SurfacesInView, patches: Patches, poses: Poses) -> np.ndarray:
    """
    Return the fit scores of S finely registered poses: (S,), at most 2.

    The sum is over both fields of ``in_view``. Surfaces whose scanned side is certain count twice,
    since ``every`` contains them too.
    """
    return np.sum([_explained_shares(surfaces, patches, poses, FINEST_STAGE.kernel_widths[1])
                   - BEHIND_WEIGHT * _behind_shares(surfaces, patches, poses)
                   for surfaces in in_view], axis=0)


def _first_pose(poses: Poses) -> Pose:
    """Return the first of several poses."""
    return Pose(poses.positions[0], poses.rotations[0])


def _residual(constraints: Sequence[Constraints]) -> float:
    """Return the weighted root mean square residual, metres; NaN without matches."""
    weights, residuals = (np.concatenate([getattr(one, key) for one in constraints])
                          for key in ('weights', 'residuals'))
    total = weights.sum()
    return float(np.sqrt((weights * residuals ** 2).sum() / total)) if total else np.nan


def _explained(surfaces: Surfaces, patches: Patches, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    """
    Compare a cloud with surfaces, independently of which side of a surface was scanned.

    :returns: whether surfaces explain each of M patches: (M,) bool; and for patches on scanned
        surfaces, 1 if the surface is displaced, else 0: (M,), NaN elsewhere.
    """
    positions = patches.points @ pose.rotation.T + pose.position
    distance, index = surfaces.tree.query(positions, distance_upper_bound=MAX_MATCH_DISTANCE_M)
    # Without a match, the tree returns the distance inf and an index after the last point.
    found = np.isfinite(distance)
    index = np.where(found, index, 0)
    normals = surfaces.normals[index]
    plane_distance = np.abs(np.einsum('ij,ij->i', positions - surfaces.points[index], normals))
    # Here, a surface explains points within three standard deviations and 2 cm of its plane.
    explained = found & (plane_distance < 3.0 * patches.deviation + 0.02)
    cosine = np.abs(np.einsum('ij,ij->i', patches.normals @ pose.rotation.T, normals))
    # More than two standard deviations and 1 cm from its plane, a surface has been displaced.
    displaced = plane_distance > 2.0 * patches.deviation + 0.01
    scanned = found & (cosine > MIN_NORMAL_COSINE)
    return explained, np.where(scanned, displaced, np.nan)


def _behind_shares(surfaces: Surfaces, patches: Patches, poses: Poses) -> np.ndarray:
    """
    Return the share of patches closely behind a surface that faces each of S cameras: (S,).

    Such points are a sign of a wrong pose: the scanned surface hides what is closely behind it,
    also the back of a thin panel, and objects moved since the scan are mostly farther away.
    """
    matches = matches_of(surfaces, patches, poses, MAX_MATCH_DISTANCE_M)
    # More than two standard deviations and 6 mm behind the plane, seen from the camera.
    behind = -matches.residuals > 2.0 * patches.deviation + 0.006
    return (matches.found & behind).mean(axis=1)


def _ambiguity_reason(pose: Pose, alternative: Pose, remedy: str = '') -> str:
    """Return the message that another pose fits as well, and what to do."""
    metres, radians = alternative.away_from(pose)
    return (f'another pose, {metres:.2f} m and {np.rad2deg(radians):.0f} degrees away, explains '
            'what it sees as well; '
            f'{remedy or "turn it to something that is there only once, and scan that too"}')


def _change_reason(violated_share: float) -> str:
    """Return the message that the room has changed since the scan."""
    return (f'the room has changed since the scan: {100.0 * violated_share:.0f} % of the surfaces '
            'in its view stand where it looked through')


def _rejection_reason(overlap: float, violated_share: float, behind_share: float,
                      certainty: Certainty, displaced_share: float) -> str:
    """Return the reason why a pose must not be used; empty if it can be used."""
    if overlap < LIMITS.min_overlap:
        return (f'the scan explains {100.0 * overlap:.0f} % of what it sees, '
                f'{100.0 * LIMITS.min_overlap:.0f} % are needed; check its planned pose and '
                'whether the cloud is its own')
    if violated_share > LIMITS.max_violated:
        return (f'{_change_reason(violated_share)}, at most '
                f'{100.0 * LIMITS.max_violated:.0f} % may; scan it again, or '
                'check whether the cloud is its own')
    if behind_share > LIMITS.max_behind:
        return (f'{100.0 * behind_share:.1f} % of what it sees lies closely behind scanned '
                f'surfaces, at most {100.0 * LIMITS.max_behind:.1f} % may; scan again what was '
                'moved, and check its planned pose')
    if certainty.loose_motions:
        return (f'it {" and ".join(certainty.loose_motions)}: too few surfaces hold it there; '
                f'{LOOSE_REMEDY}')
    # The deviations grow with little overlap and displaced surfaces; the largest comes first.
    grown = certainty.with_doubts(overlap, displaced_share)
    if grown.metres[0] > LIMITS.max_metres or grown.degrees[0] > LIMITS.max_degrees:
        return (f'it may be off by {1000.0 * grown.metres[0]:.1f} mm along '
                f'{axis_name(grown.slide_axes[0])} and {grown.degrees[0]:.2f} degrees about '
                f'{axis_name(grown.turn_axes[0])}, at most {1000.0 * LIMITS.max_metres:.1f} mm '
                f'and {LIMITS.max_degrees:g} degrees are allowed; {LOOSE_REMEDY}')
    return ''
