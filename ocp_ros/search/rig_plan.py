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

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.rig.rig_file import Rig, with_counts
from ocp_ros.scenes.scene import Scene
from ocp_ros.search.budget import Budget, Progress
from ocp_ros.search.candidate_pool import check_regions, pool_of, Sites, views_of
from ocp_ros.search.floor_counts import FloorCounts, Placed
from ocp_ros.search.placements import result_of_placement, SearchResult
from ocp_ros.search.plan import plan, prepare_search
from ocp_ros.search.proof.certificate import Certificate
from ocp_ros.search.registry import check_planner, OBSERVED, PLANNERS, RIG_SEARCH
from ocp_ros.search.rig_search import GrowingProof, prove_gap
from ocp_ros.simulation.objective import Objective, RigEvaluation
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.room_gains import RoomGoal, shares_of, VIEWPOINT_TOLERANCE
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.util.resources import DEFAULT_MODEL
from ocp_ros.util.settings import ConfigurationError


@dataclass(frozen=True)
class RigPlan:
    """
    A placement of a rig in a room, with measures of its quality.

    :ivar rig: the rig.
    :ivar answer: the placement.
    :ivar evaluation: of the placement by the objective; connected if proved views link all
        cameras.
    :ivar union_bound: evaluation if each camera has the union of the views of all its candidates
        and of the placements found so far; no choice among these poses is better.
    :ivar validated: depth errors on the validation viewpoints, metres.
    :ivar random: (R,) losses of random feasible placements; empty if hardly any is feasible.
    :ivar candidates: number of candidates.
    :ivar seconds: duration of the search and the proof.
    :ivar planner: name of the planner.
    :ivar certificate: lower bound and optimality gap, if proved; otherwise None.
    :ivar uncertain: reason why there is no certificate; otherwise empty.
    :ivar room_shares: (R,) what the placement reaches in each room of a floor, if they have a
        goal, as a share of what the union bound reaches; otherwise empty.
    """

    rig: Rig
    answer: SearchResult
    evaluation: RigEvaluation
    union_bound: RigEvaluation
    validated: 'ValidatedErrors'
    random: np.ndarray
    candidates: int
    seconds: float
    planner: str
    certificate: Certificate | None = None
    uncertain: str = ''
    room_shares: np.ndarray = field(default_factory=lambda: np.empty(0))

    @property
    def shares(self) -> dict[str, float]:
        """
        Return the results of the placement as shares of those of the union bound.

        :returns: visible points ``seen``, covered space ``coverage`` and reduction of the depth
            ``error``, each as a share of the value of :attr:`union_bound`; 1 if that value is 0.
        """
        result, bound, errors = self.evaluation, self.union_bound, self.validated
        pairs = {'seen': (len(result.seen), len(bound.seen)),
                 'coverage': (result.space_coverage, bound.space_coverage),
                 'error': (errors.nothing - errors.placement, errors.nothing - errors.union)}
        return {name: float(value / largest) if largest > 0.0 else 1.0
                for name, (value, largest) in pairs.items()}

    def reaches(self, by: str, target: float) -> bool:
        """
        Return whether a share reaches a target, in each room, and the rig's requirements are met.

        :param by: name of one of the :attr:`shares`.
        :param target: from 0 to 1.
        """
        least = min([self.shares[by], *self.room_shares])
        return self.evaluation.meets(self.rig) and bool(least >= target - VIEWPOINT_TOLERANCE)


class ValidatedErrors(NamedTuple):
    """Depth errors of a placement, of the union bound, and without any visible point, metres."""

    placement: float
    union: float
    nothing: float


class RigPlanner:
    """
    Plan rigs of the same models in one room.

    :param scene: the room.
    :param rig: a rig; the planned rigs may differ from it in the number of cameras alone.
    :param engine: settings of the engine.
    :param budget: of a search; that of the first search includes the candidates. It starts anew
        when the kernels are loaded.
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
        prepare_search(PLANNERS[planner].input_kind == OBSERVED)
        self.planner = planner
        self.model = model
        self.scene = scene
        self.engine = engine
        self.budget = budget.restarted()
        self.seed = seed
        self._progress = progress
        #: What searches have to reach in each room of a floor; None for nothing.
        self.room_goal: RoomGoal | None = None
        self._problem: Problem | None = None
        problem = self.problem(rig)
        self.pool = pool_of(problem, self.budget)
        check_regions(problem.objective, self.pool)

    def problem(self, rig: Rig) -> Problem:
        """Return the problem of a rig in the room."""
        # Only the last problem is cached. The next one shares its engine, which needs tens of
        # megabytes.
        config, last = SimulationConfig(engine=self.engine), self._problem
        if last is None:
            self._problem = Problem.of(self.scene, rig, config)
        elif rig is not last.rig or last.objective.room_goal is not self.room_goal:
            self._problem = last.with_rig(rig, config, self.room_goal)
        return self._problem

    def plan(self, rig: Rig, before: SearchResult | None = None, start: Sites = ()) -> RigPlan:
        """
        Find the best placement of a rig, and compare it with bounds and random placements.

        :param before: result for a rig with one camera less; the new placement is not worse if
            one more camera fits into that result.
        :param start: a placement of the rig; the new one is not worse. Empty for none.
        :raises ConfigurationError: if the cameras do not fit into the room.
        """
        problem = self.problem(rig)
        # If no camera can be added, the search starts without a placement.
        if before is not None and (
                site := self.pool.best_addition(problem.objective, before.sites)) is not None:
            start = (*before.sites, site)
        answer = plan(problem, self.budget, self.planner, self.pool, self.seed, start,
                      self._progress, self.model)
        return self._with_comparison(rig, answer)

    def _with_comparison(self, rig: Rig, answer: SearchResult) -> RigPlan:
        """Return a placement with its evaluation, the union bound and random placements."""
        objective = self.problem(rig).objective
        # The union bound includes this placement.
        self.pool.add_placement(rig, answer.sites)
        random_count = 64
        # Other random numbers than those of the search.
        rng = np.random.default_rng([self.seed, random_count])
        drawn = [self.pool.random_sites(rig, rng) for _ in range(random_count)]
        losses = [objective.loss(views_of(sites)) for sites in drawn if sites]
        if self.planner == RIG_SEARCH and losses and min(losses) < answer.loss:
            # Few evaluations of many cameras may find less than chance does.
            best = [sites for sites in drawn if sites][int(np.argmin(losses))]
            proof = answer.certificate
            answer = replace(answer, sites=best, loss=min(losses), losses=(
                min(losses), *answer.losses), certificate=proof and replace(
                proof, found=min(losses), bound=min(proof.bound, *losses)))
        views, union = objective.look(answer.poses), self.pool.union_views(rig)
        validation = objective.validation
        proved = self.pool.union_views(rig, validation.simulator.evidence)
        errors = ValidatedErrors(validation.depth_error(views), validation.depth_error(proved),
                                 validation.simulator.depth_error.worst)
        shares = np.empty(0) if (goal := self.room_goal) is None else shares_of(
            self._measure(objective).room_gains(views, goal.by), self._possible_gains(objective))
        return RigPlan(
            rig, answer, objective.evaluate_views(views)._replace(
                connected=objective.connects(views)), objective.evaluate_views(union), errors,
            np.array(losses), len(self.pool), self.budget.elapsed, self.planner,
            answer.certificate, answer.uncertain, shares)

    def _possible_gains(self, objective: Objective) -> np.ndarray:
        """Return what the union bound gains in each room of a floor by the room goal: (R,)."""
        measure = self._measure(objective)
        union = self.pool.union_views(objective.rig, measure.simulator.evidence)
        return measure.room_gains(union, self.room_goal.by)

    def _measure(self, objective: Objective) -> Objective:
        """Return what measures the rooms: for the depth error, the validation viewpoints."""
        return objective.validation if self.room_goal.by == 'error' else objective

    def certified(self, plan: RigPlan, budget: Budget) -> RigPlan:
        """
        Prove the optimality gap of a plan, unless a proof was tried already.

        :param budget: of the proof.
        :returns: the plan with a certificate, or with the reason why there is none.
        """
        problem = self.problem(plan.rig)
        if plan.certificate is not None or plan.uncertain:
            return plan

        def make_proof() -> GrowingProof:
            return GrowingProof(problem, self.pool, budget, 0.5)

        # The best loss on the grid is not known, so the loss of the plan is given for it.
        loss = plan.evaluation.loss
        certificate, reason = prove_gap(make_proof, loss, loss)
        return replace(plan, certificate=certificate, uncertain=reason,
                       seconds=plan.seconds + budget.elapsed)

    def count_up(self, rig_of_count: Callable[[int], Rig], first_count: int, last_count: int
                 ) -> Iterator[RigPlan]:
        """
        Yield a plan for each number of cameras; each search starts from the last plan.

        So the loss never increases with the number of cameras.

        :param rig_of_count: returns the rig with a number of cameras.
        :param first_count: first number of cameras.
        :param last_count: last number of cameras; the plans end earlier if no more cameras fit or
            the budget is stopped.
        :raises ConfigurationError: if the first number of cameras does not fit.
        """
        before = None
        for count in range(first_count, last_count + 1):
            try:
                plan = self.plan(rig_of_count(count), before)
            except ConfigurationError:
                if before is None:
                    raise
                # No more cameras fit.
                return
            yield plan
            if self.budget.stopped:
                return
            before = plan.answer
            # The search for each number of cameras has the whole budget.
            self.budget = self.budget.restarted()

    def count_in_rooms(self, rig: Rig, by: str, target: float, most: int, prices: Sequence[float],
                       max_price: float) -> tuple[list[RigPlan], float | None]:
        """
        Return plans of a floor until the fewest cameras that reach a share in each room.

        Greedy steps find a number of cameras, or a mix of groups, and a first placement. Searches
        with fewer cameras follow; their number is halved between a lower bound and the last that
        suffices. The greedy steps take cameras x points, and the searches the logarithm of the
        number of cameras.

        :param rig: has one group of cameras at least; their numbers are replaced.
        :param by: see :class:`~ocp_ros.simulation.room_gains.RoomGoal`, also for ``target``.
        :param most: largest number of cameras.
        :param prices: of a camera of each group; 1 to count cameras.
        :param max_price: largest price of all cameras.
        :returns: plans, the cheapest first, of which the last is the result; and a lower bound of
            the price of the cameras, None if there is none.
        """
        # The first rig has as many cameras as there may be.
        full = with_counts(rig, [max(most // len(prices), 1)] * len(prices))
        rooms = self.scene.rooms.count
        self.room_goal = RoomGoal(by, np.full(rooms, target), self.pool.union_views(full))
        objective = self.problem(full).objective
        counts = FloorCounts(objective, self.pool, prices)
        possible = self._possible_gains(objective)

        def lacking(placed: Sequence[Placed]) -> np.ndarray | None:
            views = [one.site.view for one in placed]
            shares = shares_of(self._measure(objective).room_gains(views, by), possible)
            if (shares >= target - VIEWPOINT_TOLERANCE).all() and objective.evaluate_views(
                    views).meets(rig):
                return None
            return target - shares

        placed = counts.greedy(most, max_price, lacking, lambda: self.budget.stopped)
        self.room_goal = counts.goal
        least_price = counts.least_price(placed, target)

        def planned(placed: Sequence[Placed]) -> RigPlan:
            placed = sorted(placed, key=attrgetter('group'))
            groups = np.bincount([one.group for one in placed], minlength=len(prices))
            sites = tuple(one.site for one in placed)
            self.budget = self.budget.restarted()
            plan = self.plan(with_counts(rig, groups.tolist()), start=sites)
            if plan.reaches(by, target):
                return plan
            # A search may lose what greedy steps have reached.
            objective = self.problem(plan.rig).objective
            first = self._with_comparison(plan.rig, result_of_placement(
                objective, sites, plan.answer.evaluations))
            return first if first.reaches(by, target) else plan

        # Numbers of cameras that do not suffice and that do, between which the number is halved.
        enough, failed, reached = placed, None, None
        low = counts.fewest(least_price) - 1
        suffices = lacking(placed) is None
        while suffices and not self.budget.stopped and (len(enough) - low > 1 or (
                # Off the candidates, fewer cameras than the bound may suffice.
                failed is None and low >= counts.fewest(None))):
            fewer = enough
            while len(fewer) > min((low + len(enough)) // 2, len(enough) - 1):
                fewer = counts.without_one(fewer)
            plan = planned(fewer)
            if plan.reaches(by, target):
                groups = [one.group for one in sorted(fewer, key=attrgetter('group'))]
                enough, reached = [*map(Placed, groups, plan.answer.sites)], plan
                low = min(low, len(enough) - 1)
            else:
                low, failed = len(fewer), plan
        plans = [failed, reached or planned(enough)]
        return [plan for plan in plans if plan is not None], least_price
