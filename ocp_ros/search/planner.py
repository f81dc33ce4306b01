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
Base class of planners that propose positions, and the loop that runs them.

:meth:`Planner.ask` for placements, :meth:`Planner.tell` the scores.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Sequence
from typing import NamedTuple

import numpy as np
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.search.budget import Budget, Progress
from ocp_ros.util.settings import ConfigurationError


class Scores(NamedTuple):
    """
    Scores of B placements.

    :ivar error: (B,) value to minimise: the rig's objective value.
    :ivar space_coverage: (B,) cubic metres.
    """

    error: np.ndarray
    space_coverage: np.ndarray


#: A search yields placements, positions (n, 2) each, metres, and receives their scores.
Search = Generator[Sequence[np.ndarray], Scores, None]


class Planner(ABC):
    """
    A method that finds a placement of cameras.

    A method is a generator: it yields placements and receives their scores.

    :param space: feasible region of the cameras.
    :param rng: the only source of random numbers.
    :param budget: expected number of evaluations.
    """

    def __init__(self, space: FreePlane, rng: np.random.Generator, budget: int) -> None:
        self.space = space
        self.rng = rng
        self.budget = budget
        # The search runs up to its first placements, so a subclass sets its own attributes before.
        self._search = self.search()
        self._batch: Sequence[np.ndarray] | None = next(self._search, None)

    @abstractmethod
    def search(self) -> Search:
        """Yield batches of placements, positions (n, 2) in the space, and receive their scores."""

    def energy(self, scores: Scores) -> np.ndarray:
        """Return the values that the method minimises, one for each of B placements: (B,)."""
        return scores.error

    def ask(self) -> Sequence[np.ndarray] | None:
        """Return the placements to score next, positions (n, 2) each; None at the end."""
        return self._batch

    def tell(self, scores: Scores) -> None:
        """Receive the scores of the placements of the last :meth:`ask`."""
        try:
            self._batch = self._search.send(scores)
        except StopIteration:
            self._batch = None


class Solution(NamedTuple):
    """
    The best positions that a planner found.

    :ivar positions: (n, 2) metres, map frame; n may be less than the number of cameras.
    :ivar error: value that was minimised, see :class:`~ocp_ros.search.planner.Scores`.
    :ivar space_coverage: cubic metres.
    :ivar evaluations: number of scored placements.
    """

    positions: np.ndarray
    error: float
    space_coverage: float
    evaluations: int


class Scorer:
    """
    Score placements until the budget is used up.

    :param evaluate: returns the error and the space coverage, cubic metres, of positions (n, 2).
    :param budget: limit of the search. Once it is used up, no more placements are scored. The
        very first placement is always scored.
    :param progress: called after each placement.
    :ivar evaluations: number of scored placements.
    """

    def __init__(self, evaluate: Callable[[np.ndarray], tuple[float, float]], budget: Budget,
                 progress: Progress | None = None) -> None:
        self._evaluate = evaluate
        self._budget = budget
        self._progress = progress
        self._least_error = np.inf
        self.evaluations = 0

    @property
    def used_share(self) -> float:
        """Return the used share of the budget."""
        return self._budget.used_share(self.evaluations, self._budget.evaluations)

    def __call__(self, placements: Sequence[np.ndarray]) -> Scores:
        """
        Return the scores of placements.

        :param placements: B placements, positions (n, 2) each, metres, n >= 0.
        :returns: scores of all placements, or of the first ones if the budget is used up.
        """
        scores: list[tuple[float, float]] = []
        for positions in placements:
            if self.evaluations and self.used_share >= 1.0:
                break
            scores.append(self._evaluate(positions))
            self.evaluations += 1
            self._least_error = min(self._least_error, scores[-1][0])
            if self._progress is not None:
                self._progress(self.used_share, self._least_error)
        # Without scores, both arrays are empty.
        return Scores(*np.array(scores).reshape(-1, 2).T)


def solve(planner: Planner, score: Callable[[Sequence[np.ndarray]], Scores], evaluations: int
          ) -> Solution:
    """
    Run a planner until its budget is used up or its search ends.

    :param planner: the method.
    :param score: returns the scores of placements, positions (n, 2) of n cameras each; if it
        returns fewer scores than placements, the search ends with these.
    :param evaluations: largest number of placements to score.
    :raises ConfigurationError: if a planner places cameras outside its space or too many cameras,
        or no placement was scored.
    """
    count = 0
    best_rank: tuple[float, ...] = (np.inf, 0, 0.0)
    best: tuple[np.ndarray, float, float] | None = None
    while (batch := planner.ask()) is not None and count < evaluations:
        batch = batch[:evaluations - count]
        for positions in batch:
            _check_positions(planner, positions)
        scores = score(batch)
        for k, energy in enumerate(planner.energy(scores)):
            # The energy is the value that the planner minimises. Among equal energies, prefer more
            # cameras, then more space coverage.
            rank = float(energy), -len(batch[k]), -float(scores.space_coverage[k])
            if rank < best_rank:
                best_rank = rank
                best = batch[k].copy(), float(scores.error[k]), float(scores.space_coverage[k])
        count += len(scores.error)
        # The evaluations or the scorer's budget ended within this batch. ``ask`` still returns the
        # whole batch, since ``tell`` was not called.
        if len(scores.error) < len(planner.ask()):
            break
        planner.tell(scores)
    if best is None:
        raise ConfigurationError(
            f'{type(planner).__name__}: found no placement in {count} evaluations; expected at '
            'least one; give it a budget of 1 or more')
    return Solution(*best, count)


def _check_positions(planner: Planner, positions: np.ndarray) -> None:
    """Reject positions (n, 2) outside the planner's feasible region, and too many cameras."""
    space = planner.space
    if len(positions) > space.cameras or not space.contains(positions).all():
        raise ConfigurationError(
            f'{type(planner).__name__}: found the positions {positions.tolist()}; expected at '
            f'most {space.cameras}, from {space.low.tolist()} to {space.high.tolist()}, over the '
            'floor; let it yield what self.space.inside() returns')
