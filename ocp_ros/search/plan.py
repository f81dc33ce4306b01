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
``OBSERVED`` moves the cameras in an episode. On a plane, positions are a placement, and planners
with input ``SCAN`` are not available.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
import sys
import time

import numpy as np
from ocp_ros.online.rollout import play
from ocp_ros.search.budget import Budget, Progress
from ocp_ros.search.candidate_pool import CandidatePool, check_regions, MountedCamera, pool_of
from ocp_ros.search.finishing import search_and_finish
from ocp_ros.search.pose_annealing import result_of_placement, SearchResult
from ocp_ros.search.pose_decoder import Decoder
from ocp_ros.search.registry import OBSERVED, PLANNERS, RIG_SEARCH, SCAN
from ocp_ros.search.scorer import Scorer
from ocp_ros.search.solve import solve
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import Problem, space_of
from ocp_ros.util.resources import DEFAULT_MODEL
from ocp_ros.util.settings import ConfigurationError


def plan(problem: Problem, budget: Budget, planner: str = RIG_SEARCH,
         pool: CandidatePool | None = None, seed: int = 0, start: Sequence[MountedCamera] = (),
         progress: Progress | None = None, model: str = DEFAULT_MODEL,
         clock: Callable[[], float] = time.perf_counter) -> SearchResult:
    """
    Find the best placement of the cameras of a problem.

    :param problem: the rig in the room.
    :param budget: of the search; on a plane it must have evaluations. Without evaluations, a
        planner with input ``SCORES`` estimates their number from the time. For an online planner
        an evaluation is a time step: the planner takes as many as the budget and the episode
        allow, or fewer if the budget is stopped.
    :param planner: one of :func:`~ocp_ros.search.registry.planner_names`.
    :param pool: candidates of all models of a rig; None to create them, and to check that they
        see the required shares of the regions.
    :param seed: random seed.
    :param start: a placement of a rig; the result is not worse. Empty for none.
    :param progress: called several times a second with input ``SCAN``, otherwise after each
        placement or time step; on a plane, only with input ``OBSERVED``.
    :param model: weights of trained online planners: path or name.
    :param clock: returns the current time, seconds, for traces and time steps.
    :raises ConfigurationError: if there is no placement, or the planner cannot plan on a plane.
    """
    input_kind, make = PLANNERS[planner]
    if problem.rig.free:
        if input_kind == SCAN or budget.evaluations is None or start:
            raise ConfigurationError(
                f'--planner {planner}: found it for cameras on a plane; expected a planner that '
                'is not for rigs, evaluations and no placement to begin with; use a rig file')
        if input_kind == OBSERVED:
            return _place_by_episode(make, problem, None, budget, seed, progress, model, clock)
        return _place_on_plane(make, problem, budget, seed, clock)
    if pool is None:
        pool = pool_of(problem, budget)
        check_regions(problem.objective, pool)
    pool.check_fit(problem.objective)
    if input_kind == SCAN:
        return make(problem, pool, budget, seed, start, progress)
    if input_kind == OBSERVED:
        result = _place_by_episode(make, problem, pool, budget, seed, progress, model, clock)
    else:
        result = _place_by_scores(make, problem, pool, budget, seed, progress)
    if not start:
        return result
    start_result = result_of_placement(problem.objective, start, result.evaluations)
    return start_result if start_result.loss < result.loss else result


class RigScorer(Scorer):
    """
    Score positions by the rig's objective, with the cameras mounted at feasible poses near them.

    The ``error`` of the scores is the rig's objective value: depth error / depth error without any
    visible point, plus the costs of regions. ``space_coverage`` is in cubic metres. The heights of
    positions are not used.

    :param decoder: mounts the cameras.
    :param budget: of the search; see :class:`~ocp_ros.search.scorer.Scorer`.
    :param progress: called after each placement.
    """

    def __init__(self, decoder: Decoder, budget: Budget, progress: Progress | None = None) -> None:
        super().__init__(decoder.objective.simulator, budget, progress)
        self.decoder = decoder

    def judge(self, placement: np.ndarray) -> tuple[float, float]:
        """Return the objective value and the space coverage, cubic metres, of positions (n, 3)."""
        sites = self.decoder(placement[:, :2])
        evaluation = self.decoder.objective.judge([site.view for site in sites])
        return evaluation.loss, evaluation.space_coverage


def _place_by_scores(make: Callable, problem: Problem, pool: CandidatePool, budget: Budget,
                     seed: int, progress: Progress | None) -> SearchResult:
    """Find a placement of a rig by a planner with input ``SCORES``; see :func:`plan`."""
    decoder = Decoder(problem, pool)
    expected = budget.evaluations or _estimate_evaluations(decoder, budget, seed)
    scorer = RigScorer(decoder, budget, progress)
    planner = make(problem.region.space, np.random.default_rng([seed, 0]), expected)
    # Without evaluations, the scorer ends the search when the time is used up.
    result = solve(planner, scorer, budget.evaluations or sys.maxsize)
    # The planner may have placed fewer cameras than the rig has.
    sites = decoder.completed_sites(decoder(result.placement[:, :2]))
    return result_of_placement(problem.objective, sites, scorer.evaluations)


def _place_on_plane(make: Callable, problem: Problem, budget: Budget, seed: int,
                    clock: Callable[[], float]) -> SearchResult:
    """Find a placement on a plane by a planner with input ``SCORES``; see :func:`plan`."""
    planner = make(space_of(problem.simulator), np.random.default_rng([seed, budget.evaluations]),
                   budget.evaluations)
    result = search_and_finish(planner, Scorer(problem.simulator), budget.evaluations, clock)
    return replace(_plane_result(problem, result.placement, result.evaluations),
                   trace=result.trace)


def _estimate_evaluations(decoder: Decoder, budget: Budget, seed: int) -> int:
    """Estimate how many placements can be scored in the remaining time, by scoring one to four."""
    rng = np.random.default_rng([seed, 1])
    scorer = RigScorer(decoder, budget)
    start_time = time.monotonic()
    scorer([decoder.region.space.random(rng) for _ in range(4)])
    # The scorer scores the first placement even if no time is left.
    seconds_each = (time.monotonic() - start_time) / scorer.evaluations
    # Some planners create a grid with this number of positions, so it has an upper limit.
    return int(np.clip((budget.seconds - budget.elapsed) / seconds_each, 1, 100_000))


def _place_by_episode(make: Callable, problem: Problem, pool: CandidatePool | None,
                      budget: Budget, seed: int, progress: Progress | None, model: str,
                      clock: Callable[[], float]) -> SearchResult:
    """
    Find a placement by an online planner; see :func:`plan`.

    The episode is simulated: each time step adds the visible points to the observed cloud, and
    constraints and headings are applied as in ``policy_node``. The cameras are then mounted at
    their last poses, or near them if these are infeasible. ``pool`` is None on a plane.
    """
    online = make(problem.simulator.config.episode, problem.rig,
                  np.random.default_rng([seed, 1]), model)
    episode = Episode(problem, np.random.default_rng([seed, 0]))
    max_turns = min(episode.config.turns, budget.evaluations or episode.config.turns)
    episode.config = replace(episode.config, turns=max_turns)

    def should_stop(turns_taken: int) -> bool:
        if progress is not None:
            # The loss of the placement is not known before the end.
            progress(turns_taken / max_turns, np.inf)
        # Creating the candidates may already have used up the time of the budget, and an episode
        # takes only seconds. So only a call of ``budget.stop`` ends an episode, not the time.
        return budget.stopped

    outcome = play(online, episode, should_stop, clock)
    last_turn = episode.turn
    if pool is None:
        space = space_of(problem.simulator)
        placement = space.placement(space.inside(last_turn.positions[:, :2]))
        result = _plane_result(problem, placement, last_turn.step)
    else:
        sites = Decoder(problem, pool)(last_turn.positions, last_turn.headings)
        result = result_of_placement(problem.objective, sites, last_turn.step)
    return replace(result, outcome=outcome)


def _plane_result(problem: Problem, placement: np.ndarray, evaluations: int) -> SearchResult:
    """Return a placement on a plane (K, 3), metres, as a search result."""
    poses = np.hstack([placement, np.zeros_like(placement)])
    sites = [MountedCamera(pose, view) for pose, view in zip(poses, problem.look(poses))]
    return result_of_placement(problem.objective, sites, evaluations)
