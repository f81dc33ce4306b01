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
Every planner as a method that finds a placement of a rig under all its constraints.

``rig_search`` chooses full poses itself. Offline planners know places on a plane:
what they propose is decoded first, so they are told what cameras are worth where these may hang.
Online planners know only what has been seen, and play an episode.
"""

from collections.abc import Sequence
from dataclasses import replace
import sys
import time

import numpy as np
from ocp_ros.online.rollout import play
from ocp_ros.search.budget import Budget
from ocp_ros.search.candidate_pool import check_room, Pool, Site
from ocp_ros.search.planner import Scores
from ocp_ros.search.pose_decoder import Decoder
from ocp_ros.search.priced_search import search
from ocp_ros.search.proof.certificate import not_covered
from ocp_ros.search.registry import OFFLINE, ONLINE
from ocp_ros.search.rig_search import anneal, Answer, answered, Progress, views_of
from ocp_ros.search.solve import solve
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import Problem
from ocp_ros.util.resources import DEFAULT_MODEL
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.yaml_files import nearest

#: The planner that is used unless another is named.
RIG_SEARCH = 'rig_search'
#: Placements by which it is found out how many there is time for, and the most that are planned
#: for: some methods lay out a grid of as many places.
PILOTS, MOST = 4, 100_000


def planner_names() -> tuple[str, ...]:
    """Return the names of all planners, those of plug-ins included."""
    return (RIG_SEARCH, *OFFLINE, *ONLINE)


def check_planner(name: str, counting: bool = False) -> None:
    """
    Refuse a planner that does not exist, or that cannot do what is asked.

    :param counting: whether it is to find out how many cameras are needed.
    :raises ConfigurationError: one sentence that begins with the option.
    """
    known = planner_names()
    if name not in known:
        raise ConfigurationError(
            f'--planner: found {name!r}; expected one of {", ".join(known)}; '
            f'{nearest(str(name), known, "choose one of them")}')
    if counting and name in ONLINE:
        raise ConfigurationError(
            f'--count: found auto with --planner {name}, which moves the cameras there are and '
            'compares no numbers of them; expected a number; name one, or a planner that '
            f'searches a scan, such as {RIG_SEARCH}')


def find(name: str, problem: Problem, pool: Pool, budget: Budget, seed: int,
         start: Sequence[Site] = (), progress: Progress | None = None,
         model: str = DEFAULT_MODEL) -> Answer:
    """
    Find the best placement of a rig's cameras by a planner.

    :param name: one of :func:`planner_names`.
    :param problem: the rig in the room.
    :param pool: candidates of all its models.
    :param budget: how long to go on. Where it counts no evaluations, an offline planner plans for
        as many as there seems to be time for. Of an online planner a turn is an evaluation; it
        plays no more turns than an episode has, and fewer only if the budget is stopped.
    :param seed: random seed.
    :param start: a placement that the answer is to be no worse than, where there is one.
    :param progress: called several times a second or after each placement or turn.
    :param model: weights of online planners that have learned: path or name.
    :raises ConfigurationError: if there is no placement.
    """
    check_room(problem.objective, pool)
    if name == RIG_SEARCH:
        # Where no bound is known, there is nothing to price by.
        method = anneal if not_covered(problem.objective) else search
        return method(problem, pool, budget, seed, start, progress)
    if name in ONLINE:
        found = _played(name, problem, pool, budget, seed, progress, model)
    else:
        found = _searched(name, problem, pool, budget, seed, progress)
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


def _searched(name: str, problem: Problem, pool: Pool, budget: Budget, seed: int,
              progress: Progress | None) -> Answer:
    """Find a placement by an offline planner; see :func:`find`."""
    decoder, space = Decoder(problem, pool), problem.region.space
    expected = budget.evaluations or _expected(decoder, budget, seed)
    scorer = RigScorer(decoder, budget, progress)
    planner = OFFLINE[name](space, np.random.default_rng([seed, 0]), expected)
    result = solve(planner, scorer, budget.evaluations or sys.maxsize)
    sites = decoder.completed(decoder(result.placement[:, :2]))
    return answered(problem.objective, sites, scorer.evaluations)


def _expected(decoder: Decoder, budget: Budget, seed: int) -> int:
    """Return about how many placements there is time to judge."""
    rng, scorer = np.random.default_rng([seed, 1]), RigScorer(decoder, budget)
    began = time.monotonic()
    scorer([decoder.region.space.random(rng) for _ in range(PILOTS)])
    each = (time.monotonic() - began) / scorer.evaluations
    return int(np.clip((budget.seconds - budget.elapsed) / each, 1, MOST))


def _played(name: str, problem: Problem, pool: Pool, budget: Budget, seed: int,
            progress: Progress | None, model: str) -> Answer:
    """
    Find a placement by an online planner; see :func:`find`.

    The room is a simulation: a turn shows what the cameras see from where they are, and each
    target is held to the rig and each camera turned as ``policy_node`` does it. Where the cameras
    end they are mounted.
    """
    online = ONLINE[name](problem.simulator.config.episode, problem.rig,
                          np.random.default_rng([seed, 1]), model)
    episode = Episode(problem, np.random.default_rng([seed, 0]))
    turns = min(episode.config.turns, budget.evaluations or episode.config.turns)
    episode.config = replace(episode.config, turns=turns)

    def over(turn: int) -> bool:
        if progress is not None:
            progress(turn / turns, np.inf)
        # The clock cuts no episode short: it takes seconds, where candidates may take longer.
        return budget.stopped

    play(online, episode, over)
    sites = Decoder(problem, pool)(episode.turn.positions, episode.turn.headings)
    return answered(problem.objective, sites, episode.turn.step)
