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
The one way to a placement: a planner by its name, for a rig under all its constraints.

A planner that knows the scan chooses full poses itself. One that knows the scores of positions
proposes these: for a rig, cameras are hung up near them, so it is told what cameras are worth
where they may hang. One that knows what was observed plays an episode. On a plane, where cameras
may be anywhere, positions are a placement, and no planner knows the scan.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
import sys
import time

import numpy as np
from ocp_ros.online.rollout import play
from ocp_ros.search.budget import Budget
from ocp_ros.search.candidate_pool import check_regions, check_room, MountedCamera, Pool, pool_of
from ocp_ros.search.finishing import search_and_finish
from ocp_ros.search.planner import Scores
from ocp_ros.search.pose_annealing import answered, Progress, SearchResult, views_of
from ocp_ros.search.pose_decoder import Decoder
from ocp_ros.search.registry import OBSERVED, PLANNERS, RIG_SEARCH, SCAN
from ocp_ros.search.scorer import Scorer
from ocp_ros.search.solve import solve
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import Problem, space_of
from ocp_ros.util.resources import DEFAULT_MODEL
from ocp_ros.util.settings import ConfigurationError

#: Placements by which it is found out how many there is time for, and the most that are planned
#: for: some methods lay out a grid of as many places.
PILOTS, MOST = 4, 100_000


def plan(problem: Problem, budget: Budget, planner: str = RIG_SEARCH, pool: Pool | None = None,
         seed: int = 0, start: Sequence[MountedCamera] = (), progress: Progress | None = None,
         model: str = DEFAULT_MODEL, clock: Callable[[], float] = time.perf_counter
         ) -> SearchResult:
    """
    Find the best placement of the cameras of a problem.

    :param problem: the rig in the room.
    :param budget: how long to go on; on a plane it counts evaluations. Where it counts none, a
        planner that knows scores plans for as many as there seems to be time for. Of an online
        planner a turn is an evaluation; it plays no more turns than an episode has, and fewer only
        if the budget is stopped.
    :param planner: one of :func:`~ocp_ros.search.registry.planner_names`.
    :param pool: candidates of all models of a rig; made unless given.
    :param seed: random seed.
    :param start: a placement of a rig that the answer is to be no worse than, if there is one.
    :param progress: called several times a second or after each placement or turn; on a plane,
        after each turn alone.
    :param model: weights of online planners that have learned: path or name.
    :param clock: tells the seconds of traces and turns.
    :raises ConfigurationError: if there is no placement, or the planner cannot plan on a plane.
    """
    knows, make = PLANNERS[planner]
    if problem.rig.free:
        if knows == SCAN or budget.evaluations is None or start:
            raise ConfigurationError(
                f'--planner {planner}: found it for cameras on a plane; expected a planner that '
                'is not for rigs, evaluations and no placement to begin with; use a rig file')
        if knows == OBSERVED:
            return _played(make, problem, None, budget, seed, progress, model, clock)
        return _searched_on_plane(make, problem, budget, seed, clock)
    if pool is None:
        pool = pool_of(problem, budget)
        check_regions(problem.objective, pool)
    check_room(problem.objective, pool)
    if knows == SCAN:
        return make(problem, pool, budget, seed, start, progress)
    if knows == OBSERVED:
        found = _played(make, problem, pool, budget, seed, progress, model, clock)
    else:
        found = _searched(make, problem, pool, budget, seed, progress)
    if not start:
        return found
    before = answered(problem.objective, start, found.evaluations)
    return before if before.loss < found.loss else found


class RigScorer:
    """
    Judge what planners propose by the rig's objective, as long as there is time.

    The error of the scores is the loss of the rig: depth error / depth error of seeing nothing,
    and what regions cost. ``space_coverage`` is that of the cameras in cubic metres.

    :param decoder: hangs up the cameras.
    :param budget: of the search; a batch ends where it does, but one placement is always judged.
    :param progress: called after each placement.
    """

    def __init__(self, decoder: Decoder, budget: Budget, progress: Progress | None = None) -> None:
        self.decoder, self.budget = decoder, budget
        self.evaluations, self.least = 0, np.inf
        self._progress = progress

    @property
    def used(self) -> float:
        """Return how much of the budget is used up."""
        return self.budget.share(self.evaluations, self.budget.evaluations)

    def __call__(self, placements: Sequence[np.ndarray]) -> Scores:
        """
        Judge placements.

        :param placements: B placements, (n, 3) or (n, 2) metres; heights do not matter.
        :returns: scores of all, or of the first where the budget is used up.
        """
        worths = []
        for placement in placements:
            if self.evaluations and self.used >= 1.0:
                break
            sites = self.decoder(placement[:, :2])
            worths.append(self.decoder.objective.judge(views_of(sites)))
            self.evaluations += 1
            self.least = min(self.least, worths[-1].loss)
            if self._progress is not None:
                self._progress(self.used, self.least)
        return Scores(np.array([worth.loss for worth in worths]),
                      np.array([worth.space_coverage for worth in worths]))


def _searched(make: Callable, problem: Problem, pool: Pool, budget: Budget, seed: int,
              progress: Progress | None) -> SearchResult:
    """Find a placement of a rig by a planner that knows scores; see :func:`plan`."""
    decoder, space = Decoder(problem, pool), problem.region.space
    expected = budget.evaluations or _expected(decoder, budget, seed)
    scorer = RigScorer(decoder, budget, progress)
    planner = make(space, np.random.default_rng([seed, 0]), expected)
    result = solve(planner, scorer, budget.evaluations or sys.maxsize)
    sites = decoder.completed(decoder(result.placement[:, :2]))
    return answered(problem.objective, sites, scorer.evaluations)


def _searched_on_plane(make: Callable, problem: Problem, budget: Budget, seed: int,
                       clock: Callable[[], float]) -> SearchResult:
    """Find a placement on a plane by a planner that knows scores; see :func:`plan`."""
    planner = make(space_of(problem.simulator), np.random.default_rng([seed, budget.evaluations]),
                   budget.evaluations)
    result = search_and_finish(planner, Scorer(problem.simulator), budget.evaluations, clock)
    return replace(_on_plane(problem, result.placement, result.evaluations), trace=result.trace)


def _expected(decoder: Decoder, budget: Budget, seed: int) -> int:
    """Return about how many placements there is time to judge."""
    rng, scorer = np.random.default_rng([seed, 1]), RigScorer(decoder, budget)
    began = time.monotonic()
    scorer([decoder.region.space.random(rng) for _ in range(PILOTS)])
    each = (time.monotonic() - began) / scorer.evaluations
    return int(np.clip((budget.seconds - budget.elapsed) / each, 1, MOST))


def _played(make: Callable, problem: Problem, pool: Pool | None, budget: Budget, seed: int,
            progress: Progress | None, model: str, clock: Callable[[], float]) -> SearchResult:
    """
    Find a placement by an online planner; see :func:`plan`.

    The room is a simulation: a turn shows what the cameras see from where they are, and each
    target is held to the rig and each camera turned as ``policy_node`` does it. Where the cameras
    end they are mounted, or at the nearest place where they may be.
    """
    online = make(problem.simulator.config.episode, problem.rig,
                  np.random.default_rng([seed, 1]), model)
    episode = Episode(problem, np.random.default_rng([seed, 0]))
    turns = min(episode.config.turns, budget.evaluations or episode.config.turns)
    episode.config = replace(episode.config, turns=turns)

    def over(turn: int) -> bool:
        if progress is not None:
            progress(turn / turns, np.inf)
        # The clock cuts no episode short: it takes seconds, where candidates may take longer.
        return budget.stopped

    outcome, turn = play(online, episode, over, clock), episode.turn
    if pool is None:
        space = space_of(problem.simulator)
        found = _on_plane(problem, space.placement(space.inside(turn.positions[:, :2])), turn.step)
    else:
        sites = Decoder(problem, pool)(turn.positions, turn.headings)
        found = answered(problem.objective, sites, turn.step)
    return replace(found, outcome=outcome)


def _on_plane(problem: Problem, placement: np.ndarray, evaluations: int) -> SearchResult:
    """Return a placement on a plane (K, 3), metres, as an answer."""
    poses = np.hstack([placement, np.zeros_like(placement)])
    sites = [MountedCamera(pose, view) for pose, view in zip(poses, problem.look(poses))]
    return answered(problem.objective, sites, evaluations)
