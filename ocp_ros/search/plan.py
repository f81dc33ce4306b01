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
from functools import cache
import logging
import sys
from threading import Timer
import time

import numpy as np
from ocp_ros.geometry.engine_config import PROMISING
from ocp_ros.online.step import play
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rooms.generator import generate_room
from ocp_ros.search.budget import Budget, Progress
from ocp_ros.search.candidate_pool import CandidatePool, check_regions, MountedCamera, pool_of
from ocp_ros.search.placements import result_of_placement, SearchResult
from ocp_ros.search.planner import Scorer, solve
from ocp_ros.search.pose_decoder import Decoder
from ocp_ros.search.registry import OBSERVED, PLANNERS, RIG_SEARCH, SCAN
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.util.resources import DEFAULT_MODEL
from ocp_ros.util.threads import return_freed_arrays

_log = logging.getLogger(__name__)


def prepare_search(online: bool = False) -> None:
    """
    Load the kernels of a search, and return freed arrays from now on: a search needs large ones.

    :param online: whether kernels of online planners are loaded too.
    """
    return_freed_arrays()
    load_kernels(RIG_SEARCH, 'random', *(('lookahead',) if online else ()))


def load_kernels(*planners: str) -> None:
    """
    Load the compiled kernels of planners, so that this takes none of the time of an answer.

    Each planner plans once in a process in a tiny room; without cached kernels it compiles them.
    """
    # Cached kernels are loaded sooner.
    notice = Timer(5.0, _log.warning, (
        'compiling the kernels, once for this computer: about 30 s; the search begins after this',
    ))
    notice.daemon = True
    notice.start()
    try:
        for planner in planners:
            _plan_in_a_tiny_room(planner)
    finally:
        notice.cancel()


@cache
def _plan_in_a_tiny_room(planner: str) -> None:
    """Run a planner once, which loads its kernels."""
    rig = rig_of(2, 'd455', mount={'on': 'plane', 'height': 1.9}, spacing=0.1)
    problem = Problem.of(generate_room(0, 600), rig, SimulationConfig(engine=PROMISING))
    plan(problem, Budget(evaluations=5), planner)


def plan(problem: Problem, budget: Budget, planner: str = RIG_SEARCH,
         pool: CandidatePool | None = None, seed: int = 0, start: Sequence[MountedCamera] = (),
         progress: Progress | None = None, model: str = DEFAULT_MODEL,
         clock: Callable[[], float] = time.perf_counter) -> SearchResult:
    """
    Find the best placement of the cameras of a problem.

    :param problem: the rig in the room.
    :param budget: of the search. Without evaluations, a planner with input ``SCORES`` estimates
        their number from the time. For an online planner an evaluation is a turn: the planner
        takes as many as the budget and the episode allow, or fewer if the budget is stopped.
    :param planner: one of :func:`~ocp_ros.search.registry.planner_names`.
    :param pool: candidates of all models; None to create them, and to check that they see the
        required shares of the regions.
    :param seed: random seed.
    :param start: a placement; the result is not worse. Empty for none.
    :param progress: called several times a second with input ``SCAN``, otherwise after each
        placement or turn.
    :param model: weights of trained online planners: path or name.
    :param clock: returns the current time, seconds, for the turns of an online planner.
    :raises ConfigurationError: if there is no placement.
    """
    input_kind, make = PLANNERS[planner]
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


def _place_by_scores(make: Callable, problem: Problem, pool: CandidatePool, budget: Budget,
                     seed: int, progress: Progress | None) -> SearchResult:
    """Find a placement of a rig by a planner with input ``SCORES``; see :func:`plan`."""
    decoder = Decoder(problem, pool)
    expected = budget.evaluations or _estimate_evaluations(decoder, budget, seed)
    scorer = Scorer(decoder.score, budget, progress)
    planner = make(problem.region.space, np.random.default_rng([seed, 0]), expected)
    # Without evaluations, the scorer ends the search when the time is used up.
    solution = solve(planner, scorer, budget.evaluations or sys.maxsize)
    # The planner may have placed fewer cameras than the rig has.
    sites = decoder.completed_sites(decoder(solution.positions))
    return result_of_placement(problem.objective, sites, scorer.evaluations)


def _estimate_evaluations(decoder: Decoder, budget: Budget, seed: int) -> int:
    """Estimate how many placements can be scored in the remaining time, by scoring one to four."""
    rng = np.random.default_rng([seed, 1])
    scorer = Scorer(decoder.score, budget)
    start_time = time.monotonic()
    scorer([decoder.region.space.random(rng) for _ in range(4)])
    # The scorer scores the first placement even if no time is left.
    seconds_each = (time.monotonic() - start_time) / scorer.evaluations
    # Some planners create a grid with this number of positions, so it has an upper limit.
    return int(np.clip((budget.seconds - budget.elapsed) / seconds_each, 1, 100_000))


def _place_by_episode(make: Callable, problem: Problem, pool: CandidatePool, budget: Budget,
                      seed: int, progress: Progress | None, model: str,
                      clock: Callable[[], float]) -> SearchResult:
    """
    Find a placement by an online planner; see :func:`plan`.

    The episode is simulated: each turn adds the visible points to the observed cloud, and
    constraints and headings are applied as in ``policy_node``. Limits of a turn are those that the
    settings change, else those of the rig file; cameras on tripods move as far as live ones. The
    cameras are then mounted at their last poses, or near them if these are infeasible.
    """
    rig, given, usual = problem.rig, problem.simulator.config.episode, EpisodeConfig()
    limits = replace(given, **{
        name: limit for name, limit in rig.limits.items()
        if getattr(given, name) == getattr(usual, name)})
    online = make(limits, rig, np.random.default_rng([seed, 1]), model)
    episode = Episode(problem, np.random.default_rng([seed, 0]), config=limits)
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
    sites = Decoder(problem, pool)(last_turn.positions, last_turn.headings)
    result = result_of_placement(problem.objective, sites, last_turn.step)
    return replace(result, outcome=outcome)
