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
Compute a placement by a planner's name, for a rig under all its constraints.

There are three kinds of planners. A planner with input ``SCAN`` chooses full poses itself. A
planner with input ``SCORES`` proposes positions and receives their scores; for a rig, the cameras
are mounted at feasible poses near these positions before they are scored. A planner with input
``OBSERVED`` runs an episode. On a plane, positions are a placement, and planners of the first kind
are not available.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
import sys
import time

import numpy as np
from ocp_ros.online.rollout import play
from ocp_ros.policy.shipped_models import DEFAULT_MODEL
from ocp_ros.search.budget import Budget, Progress
from ocp_ros.search.candidate_pool import check_regions, check_room, MountedCamera, Pool, pool_of
from ocp_ros.search.finishing import search_and_finish
from ocp_ros.search.pose_annealing import answered, SearchResult, views_of
from ocp_ros.search.pose_decoder import Decoder
from ocp_ros.search.registry import OBSERVED, PLANNERS, RIG_SEARCH, SCAN
from ocp_ros.search.scorer import Scorer
from ocp_ros.search.solve import solve
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import Problem, space_of
from ocp_ros.util.settings import ConfigurationError

#: Number of placements to measure the time of an evaluation, and largest number of evaluations
#: that a planner expects: some planners create a grid of this size.
PILOTS, MAX_EVALUATIONS = 4, 100_000


def plan(problem: Problem, budget: Budget, planner: str = RIG_SEARCH, pool: Pool | None = None,
         seed: int = 0, start: Sequence[MountedCamera] = (), progress: Progress | None = None,
         model: str = DEFAULT_MODEL, clock: Callable[[], float] = time.perf_counter
         ) -> SearchResult:
    """
    Find the best placement of the cameras of a problem.

    :param problem: the rig in the room.
    :param budget: of the search; on a plane it must have evaluations. Without evaluations, a
        planner with input ``SCORES`` estimates their number from the time. For an online planner
        an evaluation is a time step; it takes at most the time steps of an episode, and fewer than
        both limits only if the budget is stopped.
    :param planner: one of :func:`~ocp_ros.search.registry.planner_names`.
    :param pool: candidates of all models of a rig; None to create them.
    :param seed: random seed.
    :param start: a placement of a rig; the result is not worse than it. Empty for none.
    :param progress: called several times a second or after each placement or time step; on a
        plane, after each time step alone.
    :param model: weights of trained online planners: path or name.
    :param clock: returns the current time, seconds, for traces and time steps.
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


class RigScorer(Scorer):
    """
    Score positions by the rig's objective, with the cameras mounted at feasible poses near them.

    The ``error`` of the scores is the rig's objective value: depth error / depth error without any
    visible point, plus the costs of regions. ``space_coverage`` is in cubic metres. The heights of
    positions are not used.

    :param decoder: mounts the cameras.
    :param budget: see :class:`~ocp_ros.search.scorer.Scorer`, as for ``progress``.
    """

    def __init__(self, decoder: Decoder, budget: Budget, progress: Progress | None = None) -> None:
        super().__init__(decoder.objective.simulator, budget, progress)
        self.decoder = decoder

    def judge(self, placement: np.ndarray) -> tuple[float, float]:
        """Return the objective value and the space coverage, cubic metres."""
        found = self.decoder.objective.judge(views_of(self.decoder(placement[:, :2])))
        return found.loss, found.space_coverage


def _searched(make: Callable, problem: Problem, pool: Pool, budget: Budget, seed: int,
              progress: Progress | None) -> SearchResult:
    """Find a placement of a rig by a planner with input ``SCORES``; see :func:`plan`."""
    decoder, space = Decoder(problem, pool), problem.region.space
    expected = budget.evaluations or _expected(decoder, budget, seed)
    scorer = RigScorer(decoder, budget, progress)
    planner = make(space, np.random.default_rng([seed, 0]), expected)
    result = solve(planner, scorer, budget.evaluations or sys.maxsize)
    sites = decoder.completed(decoder(result.placement[:, :2]))
    return answered(problem.objective, sites, scorer.evaluations)


def _searched_on_plane(make: Callable, problem: Problem, budget: Budget, seed: int,
                       clock: Callable[[], float]) -> SearchResult:
    """Find a placement on a plane by a planner with input ``SCORES``; see :func:`plan`."""
    planner = make(space_of(problem.simulator), np.random.default_rng([seed, budget.evaluations]),
                   budget.evaluations)
    result = search_and_finish(planner, Scorer(problem.simulator), budget.evaluations, clock)
    return replace(_on_plane(problem, result.placement, result.evaluations), trace=result.trace)


def _expected(decoder: Decoder, budget: Budget, seed: int) -> int:
    """Estimate the number of placements that can be scored in the time of the budget."""
    rng, scorer = np.random.default_rng([seed, 1]), RigScorer(decoder, budget)
    began = time.monotonic()
    scorer([decoder.region.space.random(rng) for _ in range(PILOTS)])
    each = (time.monotonic() - began) / scorer.evaluations
    return int(np.clip((budget.seconds - budget.elapsed) / each, 1, MAX_EVALUATIONS))


def _played(make: Callable, problem: Problem, pool: Pool | None, budget: Budget, seed: int,
            progress: Progress | None, model: str, clock: Callable[[], float]) -> SearchResult:
    """
    Find a placement by an online planner; see :func:`plan`.

    The episode is simulated: each time step adds the visible points to the observed cloud, and
    constraints and headings are applied as in ``policy_node``. The cameras are then mounted at
    their last poses, or at the nearest feasible ones.
    """
    online = make(problem.simulator.config.episode, problem.rig,
                  np.random.default_rng([seed, 1]), model)
    episode = Episode(problem, np.random.default_rng([seed, 0]))
    turns = min(episode.config.turns, budget.evaluations or episode.config.turns)
    episode.config = replace(episode.config, turns=turns)

    def over(turn: int) -> bool:
        if progress is not None:
            progress(turn / turns, np.inf)
        # The time limit does not end an episode: it takes seconds, and candidates may take longer.
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
    """Return a placement on a plane (K, 3), metres, as a search result."""
    poses = np.hstack([placement, np.zeros_like(placement)])
    sites = [MountedCamera(pose, view) for pose, view in zip(poses, problem.look(poses))]
    return answered(problem.objective, sites, evaluations)
