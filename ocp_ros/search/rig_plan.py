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

"""Plan a rig in a room: the placement, its quality, and the number of cameras."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.policy.shipped_models import DEFAULT_MODEL
from ocp_ros.rig.rig_file import Rig
from ocp_ros.scenes.scene import Scene
from ocp_ros.search.budget import Budget, Progress
from ocp_ros.search.candidate_pool import best_addition, check_regions, pool_of, random_sites
from ocp_ros.search.plan import plan
from ocp_ros.search.pose_annealing import SearchResult
from ocp_ros.search.proof.certificate import Certificate, not_covered
from ocp_ros.search.proof.column_generation import ColumnGeneration
from ocp_ros.search.registry import check_planner, RIG_SEARCH
from ocp_ros.search.rig_search import certified, relaxation_of
from ocp_ros.simulation.objective import RigEvaluation
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.util.settings import ConfigurationError

#: Share of the time of a proof for the views of the grid.
VIEWS_TIME_SHARE = 0.5
#: Number of random placements for comparison.
RANDOM_PLACEMENTS = 64
#: A target share is reached if the share is below it by at most this.
ROUNDING = 1e-9


@dataclass(frozen=True)
class RigPlan:
    """
    A placement of a rig in a room, with measures of its quality.

    :ivar rig: the rig.
    :ivar answer: the placement.
    :ivar evaluation: of the placement by the objective.
    :ivar union_bound: evaluation with the union of the views of all candidates for each camera,
        placements found so far included; no choice among these is better.
    :ivar worst: the depth error without any visible point, metres.
    :ivar random: (R,) losses of random feasible placements; empty if hardly any is feasible.
    :ivar candidates: number of candidates.
    :ivar seconds: duration of the search and the proof.
    :ivar planner: name of the planner.
    :ivar certificate: lower bound and optimality gap, if proved; otherwise None.
    :ivar uncertain: reason why there is no certificate; otherwise empty.
    """

    rig: Rig
    answer: SearchResult
    evaluation: RigEvaluation
    union_bound: RigEvaluation
    worst: float
    random: np.ndarray
    candidates: int
    seconds: float
    planner: str
    certificate: Certificate | None = None
    uncertain: str = ''

    @property
    def shares(self) -> dict[str, float]:
        """
        Return the results of the placement as shares of those of the union bound.

        :returns: visible points ``seen``, covered space ``coverage`` and reduction of the depth
            ``error``, each as a share of the value of :attr:`union_bound`; 1 if that value is 0.
        """
        worth, most = self.evaluation, self.union_bound
        pairs = {'seen': (len(worth.seen), len(most.seen)),
                 'coverage': (worth.space_coverage, most.space_coverage),
                 'error': (self.worst - worth.depth_error, self.worst - most.depth_error)}
        return {name: float(part / whole) if whole > 0.0 else 1.0
                for name, (part, whole) in pairs.items()}

    def reaches(self, by: str, target: float) -> bool:
        """Return whether a share reaches a target and all requirements of the rig are met."""
        met = all(share >= region.must_see
                  for region, share in zip(self.rig.regions, self.evaluation.regions))
        return met and self.evaluation.connected and self.shares[by] >= target - ROUNDING


class RigPlanner:
    """
    Plan rigs of the same models in one room.

    :param scene: the room.
    :param rig: a rig; the planned rigs may differ from it in the number of cameras alone.
    :param engine: settings.
    :param budget: of a search; that of the first plan includes the candidates.
    :param seed: random seed.
    :param progress: called several times a second.
    :param planner: one of :func:`~ocp_ros.search.registry.planner_names`.
    :param model: weights of trained planners: path or name.
    :raises ConfigurationError: if a camera has no feasible pose, too small a share of a region is
        visible, or the planner does not exist.
    """

    def __init__(self, scene: Scene, rig: Rig, engine: EngineConfig, budget: Budget, seed: int = 0,
                 progress: Progress | None = None, planner: str = RIG_SEARCH,
                 model: str = DEFAULT_MODEL) -> None:
        check_planner(planner)
        self.planner, self.model = planner, model
        self.scene, self.engine, self.budget, self.seed = scene, engine, budget, seed
        self._progress, self._problems = progress, {}
        problem = self.problem(rig)
        self.pool = pool_of(problem, budget)
        check_regions(problem.objective, self.pool)

    def problem(self, rig: Rig) -> Problem:
        """Return the problem of a rig in the room."""
        if rig not in self._problems:
            # Only the last problem is cached: an engine needs some ten megabytes.
            config = SimulationConfig(engine=self.engine)
            self._problems = {rig: Problem.of(self.scene, rig, config)}
        return self._problems[rig]

    def plan(self, rig: Rig, before: SearchResult | None = None) -> RigPlan:
        """
        Find the best placement of a rig.

        :param before: result for a rig with one camera less; the new placement is not worse if
            one more camera fits beside that one.
        :raises ConfigurationError: if the cameras do not fit into the room.
        """
        problem, start = self.problem(rig), ()
        if before is not None:
            more = best_addition(problem.objective, self.pool, before.sites)
            # If the added camera does not fit, the search starts without a placement.
            start = () if more is None else (*before.sites, more)
        answer = plan(problem, self.budget, self.planner, self.pool, self.seed, start,
                      self._progress, self.model)
        return self._compared(rig, answer)

    def _compared(self, rig: Rig, answer: SearchResult) -> RigPlan:
        """Return a placement with its evaluation and the values for comparison."""
        objective = self.problem(rig).objective
        self.pool.add(rig, answer.sites)
        rng = np.random.default_rng([self.seed, RANDOM_PLACEMENTS])
        drawn = [random_sites(rig, self.pool, rng) for _ in range(RANDOM_PLACEMENTS)]
        return RigPlan(
            rig, answer, objective.evaluate(answer.poses),
            objective.judge(self.pool.union_views(rig)), objective.simulator.depth_error.worst,
            np.array([objective.loss([site.view for site in sites]) for sites in drawn if sites]),
            len(self.pool), self.budget.elapsed, self.planner, answer.certificate,
            answer.uncertain)

    def certified(self, plan: RigPlan, budget: Budget) -> RigPlan:
        """
        Prove the optimality gap of a plan, unless a proof was tried already.

        :param budget: of the proof.
        :returns: the plan with a certificate, or with the reason why there is none.
        """
        problem = self.problem(plan.rig)
        if plan.certificate is not None or plan.uncertain:
            return plan
        if (reason := not_covered(problem.objective)) is not None:
            return replace(plan, uncertain=reason)

        def relax() -> ColumnGeneration:
            return relaxation_of(problem, self.pool,
                                 lambda: budget.share(0, None) >= VIEWS_TIME_SHARE)

        loss = plan.evaluation.loss
        known, reason = certified(problem, relax, loss, loss, budget)
        return replace(plan, certificate=known, uncertain=reason,
                       seconds=plan.seconds + budget.elapsed)

    def count_up(self, rig_of_count: Callable[[int], Rig], first: int, most: int
                 ) -> Iterator[RigPlan]:
        """
        Plan with an increasing number of cameras, each time from the last plan.

        So the loss never increases with the number of cameras.

        :param rig_of_count: returns the rig with a number of cameras.
        :param first: first number of cameras.
        :param most: last number of cameras; it ends earlier if no more cameras fit or the budget
            is stopped.
        """
        before = None
        for count in range(first, most + 1):
            try:
                plan = self.plan(rig_of_count(count), before)
            except ConfigurationError:
                if before is None:
                    raise
                return
            yield plan
            if self.budget.stopped:
                return
            before, self.budget = plan.answer, self.budget.restarted()
