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
Register cameras to each other without a scan: which pose has each in the frame of the others.

Each camera that sees the floor knows which way is up and how high it hangs, so two cameras lack
only a turn about the vertical and a displacement across the floor. The turn is one at which the
directions of their walls agree. For each such turn, all displacements are tried at once by
correlating maps (by the fast Fourier transform): what both see at the same height with the same
normal counts for a displacement, and surfaces in space that the other camera has measured as free
count against it. The best ones are registered in all six directions. Then cameras are put together
one after the other, so that all that see each other agree, and all are registered together.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import Pose, rotation_matrix
from ocp_ros.registration.alignment import aligned_poses, AlignmentStage, Certainty, Poses
from ocp_ros.registration.camera_registration import Comparison, comparison, differ, sampled
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
    Distance,
    distances_between,
    HERE,
    joint_poses,
    Meeting,
    overlapping_pairs,
    relative_pose,
    RigCamera,
)
from ocp_ros.registration.live_view import LiveView
from scipy.ndimage import gaussian_filter, gaussian_filter1d, maximum_filter
from scipy.spatial.transform import Rotation

#: Metres: edge of the cells of maps, and half the edge of a map.
CELL_M, REACH_M = 0.1, 12.8
#: Metres above the floor: the bands of maps.
BANDS = ((0.15, 0.8), (0.8, 1.6), (1.6, 4.0))
#: Metres of height after which the sign of level surfaces repeats.
TURN_M = 0.5
#: The weights of level surfaces, and of surfaces in free space.
TOP_WEIGHT, FREE_WEIGHT = 2.0, 0.1
#: How many turns of a pair are tried, displacements of each, and how many poses of a pair kept.
TURNS, SHIFTS, KEPT = 8, 8, 4
#: How many likely rigs are kept while cameras are added.
BEAM = 3
#: Metres and radians: likely poses of a camera that differ by more than either are not the same.
APART = 0.2, np.deg2rad(6.0)
#: From body axes to those of a camera upside down, and the sines of how much a floor is tilted to
#: one side: of a doubtful one at least, and of one below a camera upside down at most.
UPSIDE_DOWN, MAX_TILTS = np.diag([1.0, -1.0, -1.0]), (0.26, 0.09)
#: How all cameras are registered together.
JOINT_STAGES = NEAR_STAGE, AlignmentStage((0.1, 0.06), (3.0, 1.5), 16)


class MutualLimits(NamedTuple):
    """
    Limits of an accepted pose without a scan, chosen on validation rooms.

    :ivar min_agreement: the least agreement with all others together, for a place in the rig.
    :ivar min_total: the least agreement of an accepted pose.
    :ivar max_contradicted: the largest share of compared points in space that another camera has
        measured as free: 0.3 to 3 % at true poses, 14 % and more at wrong ones.
    :ivar min_lead: the least lead in agreement over the next distinct pose.
    :ivar max_metres: the largest expected deviation, metres.
    :ivar max_degrees: the largest expected deviation, degrees.
    """

    min_agreement: float = 0.05
    min_total: float = 0.2
    max_contradicted: float = 0.05
    min_lead: float = 0.25
    max_metres: float = 0.012
    max_degrees: float = 0.5


MUTUAL_LIMITS = MutualLimits()


class LevelView(NamedTuple):
    """
    A camera's view whose vertical is known.

    :ivar view: what the camera sees.
    :ivar pose: its pose in a level frame: the origin is on the floor below it, and it looks along
        x, up or down.
    :ivar telling: which of its M patches are neither on the floor nor on the ceiling, (M,) bool:
        those fit at any place.
    """

    view: LiveView
    pose: Pose
    telling: np.ndarray

    def compared(self, pose: Pose, other: 'LevelView', other_pose: Pose) -> Comparison:
        """Compare what two cameras see, without floor and ceiling."""
        return comparison(self.view, pose, other.view, other_pose, self.telling, other.telling)

    @property
    def is_turned(self) -> bool:
        """Return whether the camera hangs upside down."""
        return bool(self.pose.rotation[2, 2] < 0.0)

    @property
    def may_be_turned(self) -> bool:
        """Return whether what is taken as the floor may be the ceiling."""
        more_tops, highest = self._tops
        return more_tops < -0.01 and self.pose.position[2] < 0.5 * highest

    @property
    def _tops(self) -> tuple[float, float]:
        """Return the share of tops of things, less that of undersides, and the largest height."""
        height = self.view.patches.points @ self.pose.rotation[2] + self.pose.position[2]
        up = self.view.patches.normals @ self.pose.rotation[2]
        highest = float(np.percentile(height, 99.5))
        return (float(np.mean((up > 0.8) & (height > BANDS[0][0])) - np.mean(
            (up < -0.8) & (height > BANDS[0][0]) & (height < highest - BANDS[0][0]))), highest)

    @classmethod
    def of(cls, view: LiveView) -> 'LevelView | None':
        """Find the floor in a view, also of a camera upside down; None if there is none."""
        upright, turned = cls._on_floor(view, np.eye(3)), cls._on_floor(view, UPSIDE_DOWN)
        if turned is None or turned.may_be_turned:
            return upright
        # Of a camera upside down, the ceiling or a wall may look like a floor. A wall is tilted to
        # one side.
        tilts = [abs(one.pose.rotation[2, 1]) if one else 1.0 for one in (upright, turned)]
        is_turned = upright is not None and upright.may_be_turned or (
            tilts[0] > MAX_TILTS[0] and tilts[1] < MAX_TILTS[1] and turned._tops[0] > 0.0)
        return turned if is_turned else upright

    @classmethod
    def _on_floor(cls, view: LiveView, turn: np.ndarray) -> 'LevelView | None':
        """Find the floor in a view after a turn (3, 3) of its axes; None if there is none."""
        points, normals, deviation = view.patches
        floor = floor_of(points @ turn.T, normals @ turn.T, deviation)
        if floor is None:
            return None
        normal, height = floor[0] @ turn, floor[1]
        ahead = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
        ahead /= np.linalg.norm(ahead)
        pose = Pose(np.array([0.0, 0.0, height]),
                    np.stack([ahead, np.cross(normal, ahead), normal]))
        telling = ((view.patches.points @ normal + height > BANDS[0][0])
                   & (view.patches.normals @ normal > -0.7))
        return cls(view, pose, telling)


class MutualRegistration(NamedTuple):
    """
    The registered pose of a camera in the frame of the rig.

    :ivar pose: the pose; z is up and 0 on the floor.
    :ivar overlap: how well the camera agrees with all others, at most 1, see
        :func:`~ocp_ros.registration.camera_registration.Comparison`.
    :ivar lead: the lead in agreement over the next distinct pose.
    :ivar certainty: the expected deviations against the first camera.
    :ivar refused: the reason why the pose must not be used; empty if it can be used.
    :ivar note: what to check of a pose that is not refused; otherwise empty.
    """

    pose: Pose
    overlap: float
    lead: float
    certainty: Certainty
    refused: str
    note: str = ''


def floor_of(points: np.ndarray, normals: np.ndarray, deviation: np.ndarray
             ) -> tuple[np.ndarray, float] | None:
    """
    Find the largest surface that lies below all others and faces up, within 65 degrees of z.

    :param points: (M, 3) metres, body frame.
    :param normals: (M, 3) unit vectors.
    :param deviation: (M,) metres.
    :returns: the unit normal (3,) of the floor, and the height of the camera above it, metres;
        None without such a surface of at least 4 % of the points.
    """
    upward = np.flatnonzero(normals[:, 2] > np.cos(np.deg2rad(65.0)))
    tried = np.random.default_rng(0).permutation(upward)[:200]
    best, best_support = None, 0.04 * len(points)
    for k in tried:
        normal, centre = normals[k], points[k]
        for _ in range(2):
            above = (points - centre) @ normal
            near = (np.abs(above) < 2.5 * deviation + 0.02) & (normals @ normal > 0.94)
            if np.count_nonzero(near) < best_support:
                break
            centre = points[near].mean(axis=0)
            fitted = np.linalg.svd(points[near] - centre, full_matrices=False)[2][2]
            normal = fitted * np.sign(fitted @ normal)
        else:
            above = (points - centre) @ normal
            support = np.count_nonzero(
                (np.abs(above) < 2.5 * deviation + 0.02) & (normals @ normal > 0.94))
            # Flying pixels may lie below the floor.
            if support >= best_support and np.mean(above < -3.0 * deviation - 0.1) < 0.03:
                best, best_support = (normal, float(-centre @ normal)), support
    return best


class _Maps(NamedTuple):
    """
    Transformed maps (N, N) of a camera for correlation.

    :ivar walls: upright surfaces in bands of height (B, N, N); their normals in the plan as
        complex numbers, so that the product of two is the cosine between them.
    :ivar tops: level surfaces; their heights as complex numbers, one turn in ``TURN_M``.
    :ivar solid: upright surfaces in bands, without normals.
    :ivar free: space in bands that the camera has measured as free.
    """

    walls: np.ndarray
    tops: np.ndarray
    solid: np.ndarray
    free: np.ndarray


def _maps_of(one: LevelView, yaw: float) -> _Maps:
    """Return the maps of a camera that stands at the origin and looks in a direction, radians."""
    turn = rotation_matrix(yaw) @ one.pose.rotation
    patches = one.view.patches
    points = patches.points @ turn.T + one.pose.position
    normals = patches.normals @ turn.T
    height = points[:, 2]
    upright = np.abs(normals[:, 2]) < 0.3
    rays = one.pose.position + np.linspace(0.1, 0.92, 24)[:, None, None] * (
        points[::3] - one.pose.position)
    slices = [upright & (height > low) & (height < high) for low, high in BANDS]
    walls = [_drawn(points[chosen], normals[chosen, 0] + 1j * normals[chosen, 1])
             for chosen in slices]
    solid = [_drawn(points[chosen], np.ones(np.count_nonzero(chosen))) for chosen in slices]
    free = [np.minimum(_drawn(passing, np.ones(len(passing))).real, 1.0) for passing in (
        rays[(rays[..., 2] > low) & (rays[..., 2] < high)] for low, high in BANDS)]
    level = (normals[:, 2] > 0.8) & (height > BANDS[0][0])
    tops = _drawn(points[level], np.exp(2j * np.pi * height[level] / TURN_M))
    # One cell of blur, since turns and heights are not exact.
    return _Maps(*map(np.fft.fft2, (_blurred(np.array(walls)), _blurred(tops),
                                    _blurred(np.array(solid)), np.array(free))))


def _drawn(points: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return a map (N, N) with the sums of the values (M,) of points (M, 3)."""
    size = round(2.0 * REACH_M / CELL_M)
    drawn = np.zeros((size, size), dtype=complex)
    row, column, inside = _cells(points)
    np.add.at(drawn, (row, column), values[inside])
    return drawn


def _blurred(maps: np.ndarray) -> np.ndarray:
    """Blur complex maps (..., N, N) by a cell."""
    sigma = (*(0.0,) * (maps.ndim - 2), 1.0, 1.0)
    return gaussian_filter(maps.real, sigma) + 1j * gaussian_filter(maps.imag, sigma)


def _cells(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rows and columns of points (N, 3) that a map contains, and which these are."""
    cells = np.floor((points[:, :2] + REACH_M) / CELL_M).astype(int)
    inside = np.all((cells >= 0) & (cells < round(2.0 * REACH_M / CELL_M)), axis=1)
    return cells[inside, 0], cells[inside, 1], inside


def _turns_between(one: LevelView, other: LevelView) -> np.ndarray:
    """Return the turns, radians, of another camera after which its walls are parallel to ours."""
    spectra = []
    for level in (one, other):
        normals = level.view.patches.normals @ level.pose.rotation.T
        upright = np.abs(normals[:, 2]) < 0.3
        angle = np.rad2deg(np.arctan2(normals[upright, 1], normals[upright, 0])) % 360.0
        histogram = np.bincount(angle.astype(int) // 2, minlength=180)
        spectra.append(np.fft.rfft(gaussian_filter1d(histogram.astype(float), 1.5, mode='wrap')))
    # Walls of a room look in four directions: half of the weight is for parallel ones.
    match = np.fft.irfft(spectra[0] * spectra[1].conj(), 180)
    match = match + np.mean([np.roll(match, 45 * k) for k in range(4)], axis=0)
    peaks = np.flatnonzero(match == maximum_filter(match, 9, mode='wrap'))
    return np.deg2rad(2.0 * peaks[np.argsort(-match[peaks])][:TURNS])


def pair_poses(one: LevelView, other: LevelView, meeting: Meeting | None = None
               ) -> list[tuple[float, Pose]]:
    """
    Find the likely poses of a camera in the body frame of another.

    :param one: the camera that stays.
    :param other: the camera whose pose is wanted.
    :param meeting: where both saw something set down, which shows about where it is.
    :returns: agreements and poses of ``other``, the best first, at most ``KEPT`` distinct ones.
    """
    if meeting:
        return _best_distinct(one, other, [_pose_by(meeting, one, other)])
    fixed, starts = _maps_of(one, 0.0), []
    for yaw in _turns_between(one, other):
        moved = _maps_of(other, yaw)
        product = ((fixed.walls * moved.walls.conj()).sum(axis=0)
                   + TOP_WEIGHT * fixed.tops * moved.tops.conj()
                   - FREE_WEIGHT * (fixed.free * moved.solid.conj()
                                    + fixed.solid * moved.free.conj()).sum(axis=0))
        score = np.fft.ifft2(product).real
        peaks = np.argwhere(score == maximum_filter(score, 5, mode='wrap'))
        values = score[tuple(peaks.T)]
        for k in np.argsort(-values)[:SHIFTS]:
            shift = (peaks[k] + score.shape[0] // 2) % score.shape[0] - score.shape[0] // 2
            place = Pose(other.pose.position + np.append(CELL_M * shift, 0.0),
                         rotation_matrix(yaw) @ other.pose.rotation)
            starts.append(relative_pose(place, one.pose))
    return _best_distinct(one, other, starts)


def _pose_by(meeting: Meeting, one: LevelView, other: LevelView) -> Pose:
    """Return about where a camera is in the body frame of another; see :func:`pair_poses`."""
    places, other_places = (at @ level.pose.rotation.T + level.pose.position for at, level in (
        (meeting.places, one), (meeting.other_places, other)))
    # The turn about the vertical that brings the places of both together.
    flat, other_flat = ((at - at.mean(axis=0))[:, :2] @ [1.0, 1j] for at in (places, other_places))
    turn = rotation_matrix(np.angle((flat * other_flat.conj()).sum()))
    shift = (places.mean(axis=0) - turn @ other_places.mean(axis=0)) * [1.0, 1.0, 0.0]
    return relative_pose(Pose(turn @ other.pose.position + shift, turn @ other.pose.rotation),
                         one.pose)


def _best_distinct(one: LevelView, other: LevelView, starts: Sequence[Pose]
                   ) -> list[tuple[float, Pose]]:
    """Register a view to another from start poses; return the best, see :func:`pair_poses`."""
    distinct: list[tuple[float, Pose]] = []
    for patches, limits, steps, kept in ((200, ((0.5, 0.25), (12.0, 6.0)), 10, 12),
                                         (1000, ((0.3, 0.08), (7.0, 1.5)), 20, KEPT)):
        poses = aligned_poses(one.view.surfaces, sampled(other.view.patches, patches),
                              Poses(np.stack([pose.rotation for pose in starts]),
                                    np.stack([pose.position for pose in starts])),
                              AlignmentStage(*limits, steps))
        scored = sorted(((other.compared(pose, one, HERE).agreement, pose)
                         for pose in map(Pose, poses.positions, poses.rotations)),
                        key=lambda pair: -pair[0])
        distinct = []
        for score, pose in scored:
            if len(distinct) < kept and all(differ(pose, known) for _, known in distinct):
                distinct.append((score, pose))
        starts = [pose for _, pose in distinct]
    return distinct


def register_mutually(views: Mapping[str, LiveView],
                      measured: Mapping[tuple[str, str], float] | None = None,
                      known: Mapping[str, Pose] | None = None,
                      carried: Mapping[str, Carried] | None = None,
                      left_out: Collection[tuple[str, str]] = ()
                      ) -> tuple[dict[str, MutualRegistration], dict[str, str]]:
    """
    Register cameras to each other.

    :param views: what each camera sees, by name.
    :param measured: measured distances between two cameras, metres, by their names.
    :param known: poses of some cameras, which keep them; all poses are then in their frame.
    :param carried: what was set down in the views of the cameras, by name; of all or of none.
    :param left_out: measured distances that are not used.
    :returns: the registrations of the cameras without a known pose, and the reasons why cameras
        have none, by name. In the frame of the poses, unless some are known, z is up and 0 on the
        floor, x is along the walls, and the lowest corner of what all cameras see is the origin.
    """
    known = known or {}
    level = {name: one for name, view in views.items() if (one := LevelView.of(view)) is not None}
    reasons = {name: 'it sees no floor; tilt it down, or if it hangs upside down, turn its '
               'images by 180 degrees' for name in views if name not in level}
    names, measured, carried = list(level), measured or {}, carried or {}
    met = {(names[one.camera], names[one.other]): one for one in meetings_between(names, carried)}
    links = {(a, b): pair_poses(level[a], level[b], met.get((a, b))) for k, a in enumerate(names)
             for b in names[k + 1:] if a not in known or b not in known}
    links |= {(b, a): [(score, relative_pose(HERE, pose)) for score, pose in found]
              for (a, b), found in list(links.items())}
    poses = _assembled(level, links, {name: known[name] for name in names if name in known})
    reasons |= {name: 'it agrees with no other camera: too little of what it sees is seen by '
                'others; turn it to what another one sees' for name in names if name not in poses}
    if poses.keys() <= known.keys():
        return _without_box(views, measured, known, left_out) if met else ({}, reasons)
    while True:
        totals = {name: _total(level, poses, name, poses[name]) for name in poses}
        anchors = [name for name in poses if name in known] or [
            max(totals, key=totals.__getitem__)]
        rig = {name: RigCamera.of(views[name].patches,
                                  carried=carried[name][:2] if carried else None)
               for name in poses}
        distances = distances_between(list(rig), measured, left_out)
        joint = _registered(rig, poses, anchors, distances, carried)
        # A camera at a wrong pose also moves the others.
        contradicted = {name: _contradicted(level, joint, name) for name in joint
                        if name not in known}
        worst = max(contradicted, key=contradicted.__getitem__)
        if contradicted[worst] <= MUTUAL_LIMITS.max_contradicted:
            break
        reasons[worst] = (
            f'{100.0 * contradicted[worst]:.0f} % of what it and others see is in space that is '
            f'free, at most {100.0 * MUTUAL_LIMITS.max_contradicted:.0f} % may; turn it to '
            'something that another one sees and that is there only once')
        del poses[worst]
        if len(poses) < 2 or poses.keys() <= known.keys():
            return {}, reasons | dict.fromkeys(
                poses.keys() - known.keys(), 'no other camera is left that agrees with it; turn '
                'it to what another one sees, or give a scan')
    if carried and is_contradicted(carried, views, joint):
        return _without_box(views, measured, known, left_out)
    leads = {name: _lead(level, links, rig, poses, joint, name, carried) for name in joint
             if name not in known}
    if not known:
        joint = dict(zip(joint, _levelled([level[name] for name in joint], [*joint.values()])))
    placed, limits = list(joint), (JOINT_STAGES[-1].max_distances[1],
                                   JOINT_STAGES[-1].kernel_widths[1])
    ordered, at = list(rig.values()), list(joint.values())
    pairs = overlapping_pairs(ordered, at, limits[0])
    constraints = all_constraints(ordered, at, pairs, *limits, distances)
    found = {}
    for name, certainty in zip(placed, certainties(
            constraints, placed, [placed.index(name) for name in anchors], at)):
        if name in known:
            continue
        refused = _refusal(totals[name], leads[name], certainty)
        if refused and certainty.metres[0] > MUTUAL_LIMITS.max_metres:
            refused += advice(name, certainty.slide_axes[0],
                              {other: pose.position for other, pose in joint.items()},
                              [placed[b] for a, b in pairs if placed[a] == name], measured)
        # Several others may see the same point.
        found[name] = MutualRegistration(joint[name], min(totals[name], 1.0), leads[name],
                                         certainty, refused,
                                         '' if refused else _note_of(level[name]))
    return found, reasons


def _without_box(views: Mapping[str, LiveView], measured: Mapping[tuple[str, str], float],
                 known: Mapping[str, Pose], left_out: Collection[tuple[str, str]]
                 ) -> tuple[dict[str, MutualRegistration], dict[str, str]]:
    """Register cameras without what was set down, and say so; see :func:`register_mutually`."""
    found, reasons = register_mutually(views, measured, known, left_out=left_out)
    return ({name: one._replace(refused=one.refused and one.refused + NOT_ALIKE)
             for name, one in found.items()},
            {name: reason + NOT_ALIKE for name, reason in reasons.items()})


def _registered(rig: Mapping[str, RigCamera], poses: Mapping[str, Pose], anchors: Collection[str],
                distances: Sequence[Distance], carried: Mapping[str, Carried]
                ) -> dict[str, Pose]:
    """Register all cameras together; see :func:`register_mutually`. Anchors keep their poses."""
    names, found = list(rig), [poses[name] for name in rig]
    meetings = meetings_between(names, carried)
    for stage in (*((MEETING_STAGE,) if meetings else ()), *JOINT_STAGES):
        found = joint_poses(list(rig.values()), found, stage, [names.index(k) for k in anchors],
                            [*distances, *(meetings if stage is MEETING_STAGE else ())])
    return dict(zip(names, found))


_Links = Mapping[tuple[str, str], list[tuple[float, Pose]]]


def _total(level: Mapping[str, LevelView], poses: Mapping[str, Pose], name: str, pose: Pose
           ) -> float:
    """Return how well a camera at a pose agrees with all placed cameras but itself."""
    return sum(level[name].compared(pose, level[other], place).agreement
               for other, place in poses.items() if other != name)


def _contradicted(level: Mapping[str, LevelView], poses: Mapping[str, Pose], name: str) -> float:
    """Return the share of points of a camera and others that contradict, of those compared."""
    found = [level[name].compared(poses[name], level[other], pose)
             for other, pose in poses.items() if other != name]
    free = sum(one.free for one in found)
    return free / max(free + sum(one.seen for one in found), 1)


def _assembled(level: Mapping[str, LevelView], links: _Links, known: dict[str, Pose]
               ) -> dict[str, Pose]:
    """
    Put cameras together one after the other, so that all agree.

    :param links: likely poses of the second camera of each pair in the frame of the first.
    :param known: the poses to begin with; none: the best pair.
    :returns: the poses of those that agree with others, in the frame of the known ones or of one.
    """
    starts = sorted(((score, pair, pose) for pair, found in links.items() if pair[0] < pair[1]
                     for score, pose in found), key=lambda one: -one[0])
    rigs = [(score, {a: HERE, b: pose}) for score, (a, b), pose in starts[:BEAM]
            if score > MUTUAL_LIMITS.min_agreement]
    rigs = [(0.0, known)] if known else rigs
    while True:
        grown = []
        for total, poses in rigs:
            for name in [name for name in level if name not in poses]:
                likely: list[Pose] = []
                for place in [pose.within(base) for other, base in poses.items()
                              for _, pose in links[other, name]]:
                    if all(differ(place, one) for one in likely):
                        likely.append(place)
                scores = [_total(level, poses, name, place) for place in likely]
                grown += [(total + score, {**poses, name: place}) for score, place in zip(
                    scores, likely) if score > MUTUAL_LIMITS.min_agreement]
        if not grown:
            return rigs[0][1] if rigs else {}
        rigs = sorted(grown, key=lambda one: -one[0])[:BEAM]


def _lead(level: Mapping[str, LevelView], links: _Links, rig: Mapping[str, RigCamera],
          poses: Mapping[str, Pose], joint: Mapping[str, Pose], name: str,
          carried: Mapping[str, Carried]) -> float:
    """
    Return the lead in agreement of a placed camera's pose over its other likely poses.

    Another pose that agrees about as well is registered too; it counts unless the other cameras
    contradict it.

    :param poses: the poses of the rig before all were registered together; ``joint``: after that.
    """
    lead = own = _total(level, poses, name, poses[name])
    others = [pose.within(base) for other, base in poses.items() if other != name
              for _, pose in links[other, name]]
    for place in [one for one in others if differ(one, poses[name], APART)]:
        ahead = own - _total(level, poses, name, place)
        if ahead < MUTUAL_LIMITS.min_lead:
            moved = _registered(rig, {**joint, name: place}, rig.keys() - {name}, (), carried)
            if (not differ(moved[name], joint[name], APART)
                    or _contradicted(level, moved, name) > MUTUAL_LIMITS.max_contradicted):
                continue
            ahead = (_total(level, joint, name, joint[name])
                     - _total(level, moved, name, moved[name]))
        lead = min(lead, ahead)
    return lead


def _levelled(level: Sequence[LevelView], poses: Sequence[Pose]) -> list[Pose]:
    """Return poses in a frame on the floor that the cameras see, with its axes along the walls."""
    up = np.sum([pose.rotation @ one.pose.rotation[2] for one, pose in zip(level, poses)], axis=0)
    turn = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0].as_matrix()
    poses = [Pose(turn @ pose.position, turn @ pose.rotation) for pose in poses]
    normals = np.concatenate([one.view.patches.normals @ pose.rotation.T
                              for one, pose in zip(level, poses)])
    normals = normals[np.abs(normals[:, 2]) < 0.3]
    # Walls look in four directions: the fourth power makes them one.
    direction = np.angle(((normals[:, 0] + 1j * normals[:, 1]) ** 4).sum()) / 4.0
    turn = rotation_matrix(-direction)
    poses = [Pose(turn @ pose.position, turn @ pose.rotation) for pose in poses]
    points = np.concatenate([one.view.patches.points @ pose.rotation.T + pose.position
                             for one, pose in zip(level, poses)])
    floor = np.mean([pose.position[2] - one.pose.position[2] for one, pose in zip(level, poses)])
    origin = np.append(np.percentile(points[:, :2], 0.2, axis=0), floor)
    return [Pose(pose.position - origin, pose.rotation) for pose in poses]


def _note_of(level: LevelView) -> str:
    """Return what to check of the floor in an accepted view; empty if it is certain."""
    if level.is_turned:
        return ('it hangs upside down by the floor and the tops that it sees; if it does not, '
                'correct the axes of its cloud (--cloud-frame)')
    if level.may_be_turned:
        return (f'what was taken as the floor, {level.pose.position[2]:.1f} m below it, may be '
                'the ceiling: more level surfaces face down than up; if it hangs upside down, '
                'turn its images by 180 degrees')
    return ''


def _refusal(total: float, lead: float, certainty: Certainty) -> str:
    """Return the reason why a pose must not be used; empty if it can be used."""
    if total < MUTUAL_LIMITS.min_total:
        return (f'what it sees agrees with the other cameras by {100.0 * total:.0f} %, '
                f'{100.0 * MUTUAL_LIMITS.min_total:.0f} % are needed; turn it to what another one '
                'sees')
    if lead < MUTUAL_LIMITS.min_lead:
        return ('another pose agrees with the other cameras about as well; turn it to something '
                'that another one sees and that is there only once, or set a box down where both '
                'see it (--box)')
    if certainty.loose_motions:
        return (f'it {" and ".join(certainty.loose_motions)}: too little of what it sees is seen '
                'by others; turn it to what another one sees')
    if (certainty.metres[0] > MUTUAL_LIMITS.max_metres
            or certainty.degrees[0] > MUTUAL_LIMITS.max_degrees):
        return (f'it may be off by {1000.0 * certainty.metres[0]:.1f} mm and '
                f'{certainty.degrees[0]:.1f} degrees against the other cameras, at most '
                f'{1000.0 * MUTUAL_LIMITS.max_metres:.0f} mm and {MUTUAL_LIMITS.max_degrees:g} '
                'degrees are allowed; turn it to what another one sees')
    return ''
