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

"""Run a planner: measure the time, count evaluations, and store the best placements."""

from bisect import insort
from collections.abc import Callable, Sequence
from dataclasses import dataclass
import itertools
import time

import numpy as np
from ocp_ros.search.planner import Planner, Scores

#: Number of best placements to store for a second evaluation.
ARCHIVE_SIZE = 500


@dataclass(frozen=True)
class Result:
    """
    The best placement that a planner found.

    :ivar placement: (K, 3) metres, map frame.
    :ivar depth_error: metres, as scored during the search.
    :ivar space_coverage: cubic metres.
    :ivar evaluations: number of scored placements.
    :ivar seconds: duration of the search.
    :ivar trace: (T, 3) evaluations, seconds (at the end of the batch) and depth error at each
        improvement.
    :ivar best: positions (n, 2) of each of the best placements, the best first, metres.
    """

    placement: np.ndarray
    depth_error: float
    space_coverage: float
    evaluations: int
    seconds: float
    trace: np.ndarray
    best: tuple[np.ndarray, ...]


class Archive:
    """The best placements so far, at most ``ARCHIVE_SIZE``."""

    def __init__(self) -> None:
        #: Each: the values of the rank, a unique number, and the positions.
        self._entries: list[tuple] = []
        self._numbers = itertools.count()

    def add(self, rank: tuple[float, ...], positions: np.ndarray) -> None:
        """Store a placement (n, 2) if it is among the best; the smallest rank is best."""
        # Because of the number, the first of equal ranks wins, and positions are never compared.
        insort(self._entries, (*rank, next(self._numbers), positions))
        del self._entries[ARCHIVE_SIZE:]

    @property
    def best(self) -> tuple[np.ndarray, ...]:
        """Return the stored placements, the best first."""
        return tuple(entry[-1] for entry in self._entries)


def solve(planner: Planner, score: Callable[[Sequence[np.ndarray]], Scores], evaluations: int,
          clock: Callable[[], float] = time.perf_counter) -> Result:
    """
    Run a planner until its budget is used up or its search ends.

    :param planner: the method.
    :param score: returns the scores of placements, each (n, 3) positions of n cameras; if it
        returns fewer scores than placements, the search ends with these.
    :param evaluations: largest number of placements to score.
    :param clock: returns the current time, seconds.
    :raises ValueError: if a planner places cameras outside its space or too many cameras, or no
        placement was scored.
    """
    start_time = clock()
    count = 0
    # The best placement: its rank, then its positions, depth error and space coverage.
    best_rank: tuple[float, ...] = (np.inf, 0, 0.0)
    best: tuple[np.ndarray, float, float] | None = None
    trace = []
    archive = Archive()
    while (batch := planner.ask()) is not None and count < evaluations:
        batch = batch[:evaluations - count]
        for positions in batch:
            _check_positions(planner, positions)
        scores = score([planner.space.placement(positions) for positions in batch])
        seconds = clock() - start_time
        for k, energy in enumerate(planner.energy(scores)):
            # The energy is the value that the planner minimises. Among equal energies, prefer more
            # cameras, then more space coverage.
            rank = float(energy), -len(batch[k]), -float(scores.space_coverage[k])
            archive.add(rank, batch[k])
            if rank < best_rank:
                best_rank = rank
                best = batch[k].copy(), float(scores.error[k]), float(scores.space_coverage[k])
                trace.append((count + k + 1, seconds, best[1]))
        count += len(scores.error)
        # The evaluations or the scorer's budget ended within this batch. ``ask`` still returns the
        # whole batch, since ``tell`` was not called.
        if len(scores.error) < len(planner.ask()):
            break
        planner.tell(scores)
    if best is None:
        raise ValueError(f'{type(planner).__name__}: found no placement in {count} evaluations; '
                         'expected at least one; give it a budget of 1 or more')
    return Result(planner.space.placement(best[0]), *best[1:], count,
                  clock() - start_time, np.array(trace), archive.best)


def _check_positions(planner: Planner, positions: np.ndarray) -> None:
    """Reject positions (n, 2) outside the planner's feasible region, and too many cameras."""
    space = planner.space
    if len(positions) > space.cameras or not space.contains(positions).all():
        raise ValueError(
            f'{type(planner).__name__}: found the positions {positions.tolist()}; expected at '
            f'most {space.cameras}, from {space.low.tolist()} to {space.high.tolist()}, over the '
            'floor')
