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
Merge frames of a camera that does not move: what stays is kept, what moves or flickers is not.

Noise that is independent in time falls with the square root of the number of frames. A person who
walks past, and the pixels at edges whose depth jumps between two surfaces, are in the minority of
the frames of their beam. Errors that are the same in all frames remain.
"""

from collections.abc import Sequence

import numpy as np
from ocp_ros.registration.live_view import direction_cells, standard_deviation

#: The largest number of frames of a camera that are read.
MAX_FRAMES = 30
#: Rows of narrow beams from straight down to straight up, 0.3 degrees each.
BEAM_ROWS = 600
#: The least share of the frames with a measurement in a beam that have to show a surface there.
MIN_SHARE = 0.5
#: Rows of wide beams in which frames are compared, 1.5 degrees each; the percentile of their
#: differences that counts, so that people in most beams change little; and how much more frames of
#: two groups differ than those of one: up to 1.4 without a movement, 1.7 or more after 1 degree.
FRAME_ROWS, COMPARED_PERCENTILE, MIN_APART = 120, 30, 1.5
#: The largest number of points of a frame; larger frames are thinned evenly.
MAX_FRAME_POINTS = 100_000


def steady_cloud(frames: Sequence[np.ndarray]) -> np.ndarray:
    """
    Return the mean of each surface that most frames of a camera show in a beam.

    :param frames: F clouds of a camera that stands still: (N, 3) metres, body frame, N may differ;
        NaN and the origin stand for pixels without a measurement.
    :returns: (M, 3) metres, body frame; a single frame is returned as it is.
    """
    if len(frames) == 1:
        return np.asarray(frames[0])
    kept = [few_measured(frame) for frame in frames]
    points = np.concatenate(kept)
    if len(points) == 0:
        return points
    frame = np.repeat(np.arange(len(kept)), [len(one) for one in kept])
    distance = np.linalg.norm(points, axis=1)
    row, column = direction_cells(points, distance, BEAM_ROWS)
    beam = row * 2 * BEAM_ROWS + column
    order = np.lexsort((distance, beam))
    points, frame, beam, distance = points[order], frame[order], beam[order], distance[order]
    # Surfaces behind each other are separated by a gap in distance.
    reach = 0.03 + 3.0 * standard_deviation(distance)
    starts = np.append(True, (np.diff(beam) != 0) | (np.diff(distance) > reach[1:]))
    group = np.cumsum(starts) - 1
    # Pixels at an edge may bridge the gap, so only points near the group's median belong to it.
    begin = np.flatnonzero(starts)
    count = np.diff(np.append(begin, len(group)))
    median = distance[begin + count // 2]
    near = np.abs(distance - median[group]) <= reach
    showing = _frames_of(group[near], frame[near], len(kept), len(begin))
    beams, beam_rank = np.unique(beam, return_inverse=True)
    measuring = _frames_of(beam_rank, frame, len(kept), len(beams))[beam_rank[begin]]
    steady = near & ((showing >= 2) & (showing >= MIN_SHARE * measuring))[group]
    number = np.unique(group[steady], return_inverse=True)[1]
    size = np.maximum(np.bincount(number), 1)
    return np.stack([np.bincount(number, axis) for axis in points[steady].T], axis=1) \
        / size[:, None]


def measured(points: np.ndarray) -> np.ndarray:
    """Return points (N, 3) without NaN and the origin, which stand for no measurement."""
    return points[np.isfinite(points).all(axis=1) & (points != 0.0).any(axis=1)]


def few_measured(frame: np.ndarray) -> np.ndarray:
    """Return the measured points of a frame (N, 3), at most ``MAX_FRAME_POINTS``, as float64."""
    frame = measured(np.asarray(frame, dtype=np.float64))
    return frame[::max(1, -(-len(frame) // MAX_FRAME_POINTS))]


def _frames_of(group: np.ndarray, frame: np.ndarray, frames: int, groups: int) -> np.ndarray:
    """Return the number of different frames among the points of each group: (groups,)."""
    pairs = np.unique(group.astype(np.int64) * frames + frame)
    return np.bincount(pairs // frames, minlength=groups)


def two_groups(frames: Sequence[np.ndarray]) -> np.ndarray | None:
    """
    Part frames into two groups that show different distances in the same directions.

    :param frames: as for :func:`steady_cloud`.
    :returns: (F,) bool, which frames are not of the group of the first one; None if all are alike,
        or if there are fewer than two or a sixth of a group, whose frames :func:`steady_cloud`
        leaves out.
    """
    maps = np.full((len(frames), 2 * FRAME_ROWS ** 2), np.nan)
    for number, frame in enumerate(map(few_measured, frames)):
        distance = np.linalg.norm(frame, axis=1)
        row, column = direction_cells(frame, distance, FRAME_ROWS)
        cell = row * 2 * FRAME_ROWS + column
        order = np.lexsort((distance, cell))
        cells, begin, count = np.unique(cell[order], return_index=True, return_counts=True)
        maps[number, cells] = distance[order][begin + count // 2]
    # Frames without a common beam are alike: one beam more is the same in all.
    maps = np.column_stack([maps[:, np.isfinite(maps).sum(axis=0) >= 2], np.ones(len(maps))])
    # Standard deviations by which each two frames differ.
    apart = np.array([np.nanpercentile(np.abs(maps - one) / standard_deviation(one),
                                       COMPARED_PERCENTILE, axis=1) for one in maps])
    first, second = np.unravel_index(apart.argmax(), apart.shape)
    groups = apart[first] > apart[second]
    groups ^= groups[0]
    between = groups[:, None] != groups
    within = ~between & ~np.eye(len(groups), dtype=bool)
    if (min(np.count_nonzero(groups), np.count_nonzero(~groups)) < max(2, len(groups) / 6)
            or apart[between].mean() < MIN_APART * apart[within].mean()):
        return None
    return groups
