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
Search on a lattice of positions, then finish by local search between them.

Computing a view is the slow part of an evaluation, and it takes longer with more points. So for
most of the budget, the planner evaluates cameras at positions of a lattice, and the view of each
position is computed once. At the end, the best placements are evaluated again and improved by
local search between these positions. Among the best results, the answer is the placement with the
best mean score over small mounting errors. This excludes a placement whose score depends on the
exact cells of a map.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
import time

import numpy as np
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.motion import mounted, MountingErrors
from ocp_ros.search.greedy import descend
from ocp_ros.search.planner import Planner, Scores, Search
from ocp_ros.search.population import match_positions
from ocp_ros.search.solve import Result, solve

#: Distance of the positions of the lattice, metres.
LATTICE_M = 0.25
#: Mounting errors of each placement for the robust choice.
MOUNTING_ERRORS = MountingErrors(0.05, count=8, seed=1)
#: Smallest :func:`max_distance` of placements among which the robust choice is made.
CHOICE_DISTANCE_M = 0.06
#: Returns the scores of placements (n, 3).
ScoreFunction = Callable[[Sequence[np.ndarray]], Scores]


class LatticeScorer:
    """
    Score placements with each camera moved to its nearest position on a lattice.

    A room has some hundred such positions, so the view of each is computed once and cached.

    :param score: returns the scores of placements (n, 3).
    :param space: feasible region of the cameras.
    """

    def __init__(self, score: ScoreFunction, space: FreePlane) -> None:
        self._score = score
        self._space = space

    def __call__(self, placements: Sequence[np.ndarray]) -> Scores:
        """Return the scores of B placements (n, 3)."""
        return self._score([self._space.placement(self.snapped_positions(placement[:, :2]))
                            for placement in placements])

    def snapped_positions(self, positions: np.ndarray) -> np.ndarray:
        """Return the feasible positions at, or nearest to, the lattice for positions (n, 2)."""
        # The positions of the lattice are the centres of its cells.
        return self._space.inside((np.floor(positions / LATTICE_M) + 0.5) * LATTICE_M)


class FinishingDescent(Planner):
    """
    Evaluate the elites, the best placements of another search, and improve them by local search.

    :param elites: positions (n, 2) each, the best first.
    :param space: feasible region of the cameras.
    :param rng: the only source of random numbers.
    :param budget: expected number of evaluations.
    """

    def __init__(self, elites: Sequence[np.ndarray], space: FreePlane, rng: np.random.Generator,
                 budget: int) -> None:
        # The base class starts the search, which needs the elites.
        self._elites = list(elites)
        super().__init__(space, rng, budget)

    def search(self) -> Search:
        """Run the local search from one elite after the other, the best first."""
        scores = yield self._elites
        for number in np.argsort(scores.error, kind='stable'):
            yield from descend(self, self._elites[number], scores.error[number])


def distinct_placements(placements: Sequence[np.ndarray], max_count: int, min_distance: float
                        ) -> list[np.ndarray]:
    """
    Choose placements that differ from each other.

    :param placements: positions (n, 2) each, the best first.
    :param max_count: largest number of placements to choose.
    :param min_distance: smallest :func:`max_distance` of two chosen placements with the same
        number of cameras, metres.
    """
    chosen: list[np.ndarray] = []
    for placement in placements:
        if len(chosen) >= max_count:
            break
        if all(len(other) != len(placement) or max_distance(placement, other) >= min_distance
               for other in chosen):
            chosen.append(placement)
    return chosen


def max_distance(placement: np.ndarray, other: np.ndarray) -> float:
    """Return the largest distance of matched cameras of two placements (n, 2), metres."""
    distances = np.linalg.norm(match_positions(placement, other) - placement, axis=1)
    return float(distances.max(initial=0.0))


def search_and_finish(planner: Planner, score: ScoreFunction, evaluations: int,
                      clock: Callable[[], float] = time.perf_counter) -> Result:
    """
    Run a planner on a lattice of positions, then finish by local search between them.

    :param planner: the method; if its :attr:`~ocp_ros.search.planner.Planner.descends` is false,
        its placements are evaluated again without a local search.
    :param score: returns the scores of placements (n, 3).
    :param evaluations: largest number of placements to evaluate.
    :param clock: returns the current time, seconds.
    :returns: the placement; the trace is that of the search, then of the local search, without the
        robust choice.
    """
    lattice = LatticeScorer(score, planner.space)
    # The finish has a share of all evaluations; the elites and the robust choice have shares of
    # the finish.
    finish_share, elite_share, choice_share = 0.15, 0.1, 0.15
    finish_count = max(int(finish_share * evaluations), 1)
    search_result = solve(planner, lattice, max(evaluations - finish_count, 1), clock=clock)
    # Each choice takes an evaluation for each mounting error. Without a local search, there is no
    # robust choice, and the whole finish evaluates elites.
    choices = int(choice_share * finish_count) // MOUNTING_ERRORS.count if planner.descends else 0
    max_elites = max(int(elite_share * finish_count), 1) if planner.descends else finish_count
    # The elites differ by at least a step of the lattice.
    elites = distinct_placements([lattice.snapped_positions(best) for best in search_result.best],
                                 max_elites, min_distance=LATTICE_M)
    descent = FinishingDescent(elites, planner.space, planner.rng, finish_count)
    limit = (finish_count - MOUNTING_ERRORS.count * choices) if planner.descends else len(elites)
    result = solve(descent, score, limit, clock=clock)
    # The evaluations and the seconds of the finish follow those of the search.
    later_trace = result.trace + [search_result.evaluations, search_result.seconds, 0.0]
    result = replace(result, evaluations=search_result.evaluations + result.evaluations,
                     seconds=search_result.seconds + result.seconds,
                     trace=np.vstack([search_result.trace, later_trace]))
    return choose_robust(result, planner.space, score, choices, clock)


def choose_robust(result: Result, space: FreePlane, score: ScoreFunction, max_choices: int,
                  clock: Callable[[], float]) -> Result:
    """
    Choose the placement with the smallest mean error over small mounting errors.

    :param result: of a search.
    :param space: feasible region of its cameras.
    :param score: returns the scores of placements (n, 3).
    :param max_choices: number of placements to choose from; with fewer than two, ``result`` is
        returned.
    :param clock: returns the current time, seconds.
    """
    choices = distinct_placements(result.best, min(max_choices, 24), CHOICE_DISTANCE_M)
    if len(choices) < 2:
        return result
    start_time = clock()
    placements = [space.placement(choice) for choice in choices]
    moved = [mounted(placement, MOUNTING_ERRORS) for placement in placements]
    mean_errors = [np.mean(score(list(displaced)).error) for displaced in moved]
    chosen = placements[int(np.argmin(mean_errors))]
    # The result has the scores of the placement without mounting errors.
    scores = score([chosen])
    return replace(
        result, placement=chosen, depth_error=float(scores.error[0]),
        space_coverage=float(scores.space_coverage[0]),
        evaluations=result.evaluations + MOUNTING_ERRORS.count * len(choices),
        seconds=result.seconds + clock() - start_time)
