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
Search on a lattice of places, then finish by local search between them.

Computing a view is the slow part of an evaluation, and it takes longer with more points. So for
most of the budget, the planner evaluates cameras at places of a lattice, and the view of each
place is computed once. At the end, the best placements are evaluated again and improved by local
search between these places. Among the best results, the answer is the placement with the best mean
score over small mounting errors. This excludes a placement whose score depends on the exact cells
of a map.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
import time

import numpy as np
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.motion import mounted
from ocp_ros.search.greedy import descend
from ocp_ros.search.planner import Planner, Scores, Search
from ocp_ros.search.population import matched
from ocp_ros.search.solve import Result, solve

#: Metres between the places of the lattice.
LATTICE_M = 0.25
#: Share of the evaluations for the end, and the share of these for the elites.
FINISH_SHARE, ELITE_SHARE = 0.15, 0.1
#: Smallest difference of two placements in the position of one camera, metres: among the elites,
#: and in the last choice.
ELITES_APART_M, CHOICES_APART_M = 0.25, 0.06
#: For the last choice: share of the evaluations at the end, and largest number of placements.
CHOICE_SHARE, CHOICES = 0.15, 24
#: Number of drawn mounting errors for each placement, and their size in metres.
MOUNTINGS, MOUNTING_ERROR_M = 8, 0.05
#: Random seed of the mounting errors.
SEED = 1

Score = Callable[[Sequence[np.ndarray]], Scores]


class LatticeScorer:
    """
    Score placements with each camera moved to its nearest place on a lattice.

    A room has some hundred such places, so the view of each is computed once and cached.

    :param score: returns the scores of placements (n, 3).
    :param space: feasible region of the cameras.
    """

    def __init__(self, score: Score, space: FreePlane) -> None:
        self._score, self._space = score, space

    def __call__(self, placements: Sequence[np.ndarray]) -> Scores:
        """Score B placements (n, 3)."""
        return self._score([self._space.placement(self.snapped(placement[:, :2]))
                            for placement in placements])

    def snapped(self, positions: np.ndarray) -> np.ndarray:
        """Move positions (n, 2) to feasible positions at, or nearest to, places of the lattice."""
        return self._space.inside((np.floor(positions / LATTICE_M) + 0.5) * LATTICE_M)


class FinishingDescent(Planner):
    """
    Evaluate the elites of another search again, and improve the best ones by local search.

    :param elites: positions (n, 2) each, the best first.
    :param settings: of :class:`~ocp_ros.search.planner.Planner`.
    """

    def __init__(self, elites: Sequence[np.ndarray], space: FreePlane, rng: np.random.Generator,
                 budget: int) -> None:
        self._elites = list(elites)
        super().__init__(space, rng, budget)

    def search(self) -> Search:
        """Run the local search from one elite after the other, the best first."""
        scores = yield self._elites
        for number in np.argsort(scores.error, kind='stable'):
            yield from descend(self, self._elites[number], scores.error[number])


def distinct(placements: Sequence[np.ndarray], most: int, apart: float = ELITES_APART_M
             ) -> list[np.ndarray]:
    """
    Choose placements that differ.

    :param placements: positions (n, 2) each, the best first.
    :param most: largest number of placements to choose.
    :param apart: smallest difference of two placements in the position of one camera, metres.
    """
    chosen: list[np.ndarray] = []
    for placement in placements:
        if len(chosen) >= most:
            break
        if all(len(other) != len(placement) or differ(placement, other) >= apart
               for other in chosen):
            chosen.append(placement)
    return chosen


def differ(one: np.ndarray, other: np.ndarray) -> float:
    """Return the largest distance between matched cameras of two placements (n, 2), metres."""
    return float(np.linalg.norm(matched(one, other) - one, axis=1).max(initial=0.0))


def search_and_finish(planner: Planner, score: Score, evaluations: int,
                      clock: Callable[[], float] = time.perf_counter) -> Result:
    """
    Run a planner on a lattice of places, then finish by local search between them.

    :param planner: the method; if its :attr:`~ocp_ros.search.planner.Planner.descends` is false,
        its placements are evaluated again without a local search.
    :param score: returns the scores of placements (n, 3).
    :param evaluations: largest number of placements to evaluate.
    :param clock: returns the current time, seconds.
    :returns: the placement; the trace is that of the search, then of the local search, without the
        last choice.
    """
    lattice = LatticeScorer(score, planner.space)
    last = max(int(FINISH_SHARE * evaluations), 1)
    found = solve(planner, lattice, max(evaluations - last, 1), clock=clock)
    choices = int(CHOICE_SHARE * last) // MOUNTINGS if planner.descends else 0
    most = max(int(ELITE_SHARE * last), 1) if planner.descends else last
    elites = distinct([lattice.snapped(one) for one in found.best], most)
    finish = FinishingDescent(elites, planner.space, planner.rng, last)
    limit = last - MOUNTINGS * choices if planner.descends else len(elites)
    end = solve(finish, score, limit, clock=clock)
    trace = np.vstack([found.trace, end.trace + [found.evaluations, found.seconds, 0.0]])
    end = replace(end, evaluations=found.evaluations + end.evaluations,
                  seconds=found.seconds + end.seconds, trace=trace)
    return steadiest(end, planner.space, score, choices, clock)


def steadiest(found: Result, space: FreePlane, score: Score, most: int,
              clock: Callable[[], float]) -> Result:
    """
    Choose the placement with the smallest mean error over small mounting errors.

    :param found: result of a search.
    :param space: feasible region of its cameras.
    :param score: returns the scores of placements (n, 3).
    :param most: number of placements to choose from; with fewer than two, ``found`` is returned.
    :param clock: returns the current time, seconds.
    """
    choices = distinct(found.best, min(most, CHOICES), CHOICES_APART_M)
    if len(choices) < 2:
        return found
    began, placements = clock(), [space.placement(choice) for choice in choices]
    off = [float(np.mean(score(list(mounted(placement, MOUNTING_ERROR_M, MOUNTINGS, SEED))).error))
           for placement in placements]
    chosen = placements[int(np.argmin(off))]
    scores = score([chosen])
    return replace(found, placement=chosen, depth_error=float(scores.error[0]),
                   space_coverage=float(scores.space_coverage[0]),
                   evaluations=found.evaluations + MOUNTINGS * len(choices),
                   seconds=found.seconds + clock() - began)
