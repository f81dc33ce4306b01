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
from typing import NamedTuple

import numpy as np
from ocp_ros.registration.live_view import direction_cells, standard_deviation

#: The largest number of frames of a camera that are read.
MAX_FRAMES = 30
#: Rows of narrow beams from straight down to straight up, 0.3 degrees each.
BEAM_ROWS = 600
#: The least share of the frames with a measurement in a beam that have to show a surface there.
MIN_SHARE = 0.5
#: Rows of wide beams in which frames are compared, 1.5 degrees or five narrow ones each; the
#: percentile of their differences that counts, so that people in most beams change little; and how
#: much more frames of two groups differ than those of one: up to 1.4 without a movement, 1.7 or
#: more after 1 degree.
FRAME_ROWS, COMPARED_PERCENTILE, MIN_APART = 120, 30, 1.5
#: The largest number of points of a frame; larger frames are thinned evenly.
MAX_FRAME_POINTS = 100_000


class Frames(NamedTuple):
    """
    M points that a camera measures in F frames while it stands still.

    :ivar points: (M, 3) metres, body frame.
    :ivar distance: (M,) metres from the camera.
    :ivar row: (M,) the row of the narrow beam of each point, and ``column``: its column.
    :ivar number: (M,) the number of the frame of each point.
    :ivar count: F.
    """

    points: np.ndarray
    distance: np.ndarray
    row: np.ndarray
    column: np.ndarray
    number: np.ndarray
    count: int

    @classmethod
    def of(cls, frames: Sequence[np.ndarray]) -> 'Frames':
        """
        Read frames.

        :param frames: F clouds: (N, 3) metres, body frame, N may differ; NaN and the origin stand
            for pixels without a measurement.
        """
        kept = [few_measured(frame) for frame in frames]
        points = np.concatenate(kept)
        distance = np.sqrt(np.einsum('ij,ij->i', points, points))
        return cls(points, distance, *direction_cells(points, distance, BEAM_ROWS),
                   np.repeat(np.arange(len(kept)), [len(one) for one in kept]), len(kept))

    def subset(self, chosen: np.ndarray) -> 'Frames':
        """Return the points of chosen frames, (F,) bool."""
        used = chosen[self.number]
        return self._replace(points=self.points[used], distance=self.distance[used],
                             row=self.row[used], column=self.column[used],
                             number=self.number[used])

    def steady_cloud(self) -> np.ndarray:
        """Return the mean (S, 3) of each surface, metres; see :func:`steady_cloud`."""
        beam = self.row * 2 * BEAM_ROWS + self.column
        order = _by_distance(beam, self.distance)
        distance, number, beam = self.distance[order], self.number[order], beam[order]
        # Surfaces behind each other are separated by a gap in distance.
        reach = 0.03 + 3.0 * standard_deviation(distance)
        is_new = np.diff(beam, prepend=-1) != 0
        starts = is_new | (np.diff(distance, prepend=0.0) > reach)
        # Pixels at an edge may bridge the gap: only points near the group's median belong to it.
        begin, median = _medians(starts, distance)
        group, beam_rank = np.cumsum(starts) - 1, np.cumsum(is_new) - 1
        near = np.abs(distance - median[group]) <= reach
        showing = _frames_of(group[near], number[near], self.count, len(begin))
        measuring = _frames_of(beam_rank, number, self.count, np.count_nonzero(is_new))[
            beam_rank[begin]]
        is_steady = (showing >= 2) & (showing >= MIN_SHARE * measuring)
        used = near & is_steady[group]
        rank = (np.cumsum(is_steady) - 1)[group[used]]
        sums = [np.bincount(rank, axis, np.count_nonzero(is_steady))
                for axis in self.points[order[used]].T]
        return np.stack(sums, axis=1) / np.bincount(rank)[:, None]

    def two_groups(self) -> np.ndarray | None:
        """
        Part frames into two groups that show different distances in the same directions.

        :returns: (F,) bool, which frames are not of the group of the first one; None if all are
            alike, or if there are fewer than two or a sixth of a group, whose points
            :func:`steady_cloud` leaves out.
        """
        width = BEAM_ROWS // FRAME_ROWS
        cell = self.row // width * 2 * FRAME_ROWS + self.column // width \
            + self.number * 2 * FRAME_ROWS ** 2
        order = _by_distance(cell, self.distance)
        cell = cell[order]
        begin, median = _medians(np.diff(cell, prepend=-1) != 0, self.distance[order])
        maps = np.full((self.count, 2 * FRAME_ROWS ** 2), np.nan)
        maps.flat[cell[begin]] = median
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


def steady_cloud(frames: Sequence[np.ndarray]) -> np.ndarray:
    """
    Return the mean of each surface that most frames of a camera show in a beam.

    :param frames: see :meth:`Frames.of`.
    :returns: (S, 3) metres, body frame; a single frame is returned as it is.
    """
    return np.asarray(frames[0]) if len(frames) == 1 else Frames.of(frames).steady_cloud()


def measured(points: np.ndarray) -> np.ndarray:
    """Return points (N, 3) without NaN and the origin, which stand for no measurement."""
    return points[_are_measured(points)]


def few_measured(frame: np.ndarray) -> np.ndarray:
    """Return the measured points of a frame (N, 3), at most ``MAX_FRAME_POINTS``, as float64."""
    rows = np.flatnonzero(_are_measured(frame))
    return np.asarray(frame[rows[::max(1, -(-len(rows) // MAX_FRAME_POINTS))]], dtype=np.float64)


def _are_measured(points: np.ndarray) -> np.ndarray:
    """Return which points (N, 3) are neither NaN nor the origin: (N,) bool."""
    squares = np.einsum('ij,ij->i', points, points)
    return np.isfinite(squares) & (squares > 0.0)


def _by_distance(cell: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Return the order (M,) of points by the number of their cell, and by distance in a cell."""
    # One key is sorted four times as fast as two.
    return np.argsort(cell * (distance.max(initial=0.0) + 1.0) + distance)


def _medians(starts: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where G parts of points (M,) begin, (G,), and the median distance of each, (G,)."""
    begin = np.flatnonzero(starts)
    return begin, distance[begin + np.diff(np.append(begin, len(distance))) // 2]


def _frames_of(group: np.ndarray, number: np.ndarray, frames: int, groups: int) -> np.ndarray:
    """Return in how many different frames points of each group are: (groups,)."""
    shown = np.zeros((groups, frames), dtype=bool)
    shown[group, number] = True
    return shown.sum(axis=1)
