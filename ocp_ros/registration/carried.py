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
Hold cameras to each other by a box that is set down at several places in their common view.

What stands in space that a camera measures as free in most frames has been brought there. It
counts where it stands still: where its middle is that of the frame before or after. So the cameras
need not take their frames at exactly the same time, and the person who carries the box is left
out. Middles of the same moment show about how two cameras hang; faces of the box that both see
hold them exactly.
"""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, Pose
from ocp_ros.registration.alignment import AlignmentStage, Patches
from ocp_ros.registration.joint_alignment import Meeting, relative_pose
from ocp_ros.registration.live_view import faces_origin, LiveView, patches_of
from ocp_ros.registration.steady_cloud import few_measured
from ocp_ros.scenes.scene import SceneError
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

#: Metres: the edge of cells, of which those that touch are one thing.
CELL_M = 0.1
#: The least number of points of a thing in a frame.
MIN_POINTS = 60
#: How far the middle of what stands still may move from one frame to the next, metres.
STILL_M = 0.01
#: Frames of two cameras at most so far apart are of the same moment, nanoseconds.
SAME_MOMENT_NS = 600_000_000
#: The largest number of patches of a frame.
MAX_PATCHES = 400
#: How much the distances between places may differ between two cameras, since they see different
#: sides of the box, metres; the least share of moments at which they do not, and their number.
SIDES_M, MIN_AGREEING, MIN_MOMENTS = 0.25, 0.6, 3
#: The largest share of what was set down that another camera should have seen too but has not.
MAX_UNSEEN = 0.3
#: How near both see it, metres.
SEEN_M = 0.1
#: Why a box was left out.
NOT_ALIKE = ('; the box was left out, since the cameras do not see it at the same places: save '
             'their clouds at the same moments')
#: Registration by middles, and then from as far as these are wrong.
MEETING_STAGE = AlignmentStage((0.15, 0.1), (4.0, 3.0), 20)
NEAR_STAGE = AlignmentStage((0.3, 0.1), (8.0, 3.0), 14)


#: By camera and moment, the points (N, 3) of each thing that was set down in its view.
Seen = Mapping[str, Mapping[Hashable, list[np.ndarray]]]


class Carried(NamedTuple):
    """
    What stood at some moments in view of a camera.

    :ivar patches: M patches, body frame.
    :ivar moments: (M,) the number of the moment of each, from 1.
    :ivar middles: the middle (3,) of it at each moment, metres, body frame.
    """

    patches: Patches
    moments: np.ndarray
    middles: dict[int, np.ndarray]


def set_down(frames: Sequence[np.ndarray], still: np.ndarray) -> dict[int, list[np.ndarray]]:
    """
    Find what is brought into view and stands still.

    :param frames: F clouds of a camera in the order of time: (N, 3) metres, body frame.
    :param still: what most frames show, see
        :func:`~ocp_ros.registration.steady_cloud.steady_cloud`.
    :returns: by the number of a frame: the points of each thing, (M, 3) metres, body frame, the
        thing with the most points first; frames without anything are left out.
    :raises SceneError: if ``still`` has too few points.
    """
    view = LiveView(still, CameraModel(0.0, 1e6))
    things = []
    for frame in map(few_measured, frames):
        things.append(_connected(frame[view.beside(frame)[0]]))
    found = {}
    for number, present in enumerate(things):
        beside = [thing.mean(axis=0) for near in things[max(number - 1, 0):number + 2]
                  if near is not present for thing in near]
        standing = [thing for thing in present if any(
            np.linalg.norm(thing.mean(axis=0) - middle) < STILL_M for middle in beside)]
        if standing:
            found[number] = sorted(standing, key=len, reverse=True)
    return found


def _connected(points: np.ndarray) -> list[np.ndarray]:
    """Return the connected parts of points (N, 3) that have enough points."""
    if len(points) < MIN_POINTS:
        return []
    cells, of = np.unique(np.floor(points / CELL_M), axis=0, return_inverse=True)
    # Cells touch if they differ by at most one in each direction.
    pairs = cKDTree(cells).query_pairs(1.1, p=np.inf, output_type='ndarray')
    graph = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(cells),) * 2)
    parts = connected_components(graph, directed=False)[1][of.ravel()]
    return [points[parts == part] for part in np.flatnonzero(np.bincount(parts) >= MIN_POINTS)]


def moments_of(times: Iterable[int], known: Sequence[int]) -> list[int]:
    """Return times, nanoseconds, or instead of each the same moment of another camera."""
    nearest = [min(known, key=lambda one: abs(one - time), default=time) for time in times]
    return [near if abs(near - time) <= SAME_MOMENT_NS else time
            for near, time in zip(nearest, times)]


def carried_by(seen: Seen, models: Mapping[str, CameraModel]) -> dict[str, Carried]:
    """
    Return what was set down in the views of cameras.

    :param seen: by camera and moment: what :func:`set_down` has found.
    :param models: the cameras' models; points out of range are left out.
    :returns: of each model; empty if no two cameras see things at the same moments and places.
    """
    numbers = {moment: k for k, moment in enumerate(
        dict.fromkeys(moment for one in seen.values() for moment in one), 1)}
    found = {}
    for name, model in models.items():
        patches, moments = [Patches(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))], []
        middles: dict[int, np.ndarray] = {}
        for moment, things in seen.get(name, {}).items():
            points = np.concatenate(things)
            distance = np.linalg.norm(points, axis=1)
            points = points[(distance > model.min_range) & (distance <= model.max_range)]
            # A thing that is partly out of range has another middle.
            if len(points) < len(distance):
                continue
            with suppress(SceneError):
                patches.append(patches_of(points, name, MAX_PATCHES))
                moments.append(np.full(len(patches[-1].points), numbers[moment]))
                middles[numbers[moment]] = things[0].mean(axis=0)
        found[name] = Carried(Patches(*map(np.concatenate, zip(*patches))),
                              np.concatenate([np.zeros(0), *moments]), middles)
    return found if meetings_between(list(found), found) else {}


def meetings_between(names: Sequence[str], carried: Mapping[str, Carried]) -> list[Meeting]:
    """Return the meetings of pairs of cameras that see things at the same places, by numbers."""
    found = []
    for a, b in combinations(range(len(names)), 2):
        middles = [carried[names[k]].middles if carried else {} for k in (a, b)]
        both = [moment for moment in middles[0] if moment in middles[1]]
        if len(both) < MIN_MOMENTS:
            continue
        places = [np.array([one[moment] for moment in both]) for one in middles]
        # Between places, both cameras see the same distances.
        apart = [np.linalg.norm(one[:, None] - one, axis=2) for one in places]
        alike = (np.abs(apart[0] - apart[1]) < SIDES_M).mean(axis=1) >= MIN_AGREEING
        if alike.mean() >= MIN_AGREEING and np.count_nonzero(alike) >= MIN_MOMENTS:
            found.append(Meeting(a, b, places[0][alike], places[1][alike]))
    return found


def is_contradicted(carried: Mapping[str, Carried], views: Mapping[str, LiveView],
                    poses: Mapping[str, Pose]) -> bool:
    """
    Return whether cameras do not see what others see set down.

    :param views: the still scene of each camera, which hides what is behind it.
    :param poses: the registered poses.
    """
    unseen: list[np.ndarray] = []
    for a, b in permutations(poses, 2):
        one, other, relative = carried[a], carried[b], relative_pose(poses[a], poses[b])
        common = np.isin(one.moments, list(other.middles))
        points, normals = (values[common] @ relative.rotation.T for values in one.patches[:2])
        points = points + relative.position
        shown = views[b].beside(points)[0] & faces_origin(points, normals)
        for moment in np.unique(one.moments[common]):
            here = shown & (one.moments[common] == moment)
            tree = cKDTree(other.patches.points[other.moments == moment])
            unseen.append(tree.query(points[here])[0] > SEEN_M)
    return bool(unseen) and float(np.concatenate(unseen).mean()) > MAX_UNSEEN
