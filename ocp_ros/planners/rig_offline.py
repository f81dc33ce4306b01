# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Planners that know places on a plane, run for a rig under all its constraints.

What they propose is decoded first, so they are told what cameras are worth where these may hang.
"""

from collections.abc import Sequence
import sys
import time

import numpy as np

from ocp_ros.planners.budget import Budget
from ocp_ros.planners.candidate_pool import check_room, Pool
from ocp_ros.planners.planner import Scores
from ocp_ros.planners.pose_decoder import Decoder
from ocp_ros.planners.registry import OFFLINE
from ocp_ros.planners.rig_search import Answer, Progress, views_of
from ocp_ros.planners.solve import solve
from ocp_ros.simulation.problem import Problem

#: Placements by which it is found out how many there is time for, and the most that are planned
#: for: some methods lay out a grid of as many places.
PILOTS, MOST = 4, 100_000


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


def search_offline(name: str, problem: Problem, pool: Pool, budget: Budget, seed: int,
                   progress: Progress | None = None) -> Answer:
    """
    Find a placement of a rig's cameras by an offline planner.

    :param name: of ``OFFLINE``.
    :param problem: the rig in the room.
    :param pool: candidates of all its models.
    :param budget: how long to go on; where it counts no evaluations, as many are planned for as
        there seems to be time for.
    :param seed: random seed.
    :param progress: called after each placement.
    :raises ConfigurationError: if there is no placement.
    """
    check_room(problem.objective, pool)
    decoder, space = Decoder(problem, pool), problem.region.space
    expected = budget.evaluations or _expected(decoder, budget, seed)
    scorer = RigScorer(decoder, budget, progress)
    planner = OFFLINE[name](space, np.random.default_rng([seed, 0]), expected)
    result = solve(planner, scorer, budget.evaluations or sys.maxsize)
    sites = decoder.completed(decoder(result.placement[:, :2]))
    loss = problem.objective.loss(views_of(sites))
    return Answer(sites, loss, (loss,), scorer.evaluations)


def _expected(decoder: Decoder, budget: Budget, seed: int) -> int:
    """Return about how many placements there is time to judge."""
    rng, scorer = np.random.default_rng([seed, 1]), RigScorer(decoder, budget)
    began = time.monotonic()
    scorer([decoder.region.space.random(rng) for _ in range(PILOTS)])
    each = (time.monotonic() - began) / scorer.evaluations
    return int(np.clip((budget.seconds - budget.elapsed) / each, 1, MOST))
