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
Place the cameras of a rig by simulated annealing, for objectives without a lower bound.

A search begins with exchanges among candidates and continues with small moves. Several searches
run with different seeds: if their results agree, the best of them is probably good. Every proposal
is rounded as in a placement file and checked against the rig's constraints before it is scored, so
the score is that of the written placement.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.online.step import Outcome
from ocp_ros.rig.feasible_region import FeasibleRegion
from ocp_ros.rig.placement_file import as_written
from ocp_ros.search.budget import Budget, Progress
from ocp_ros.search.candidate_pool import are_spaced, CandidatePool, MountedCamera, Sites, views_of
from ocp_ros.search.pose_decoder import coarse_objective
from ocp_ros.search.proof.certificate import Certificate
from ocp_ros.simulation.objective import Objective
from ocp_ros.simulation.problem import Problem
from ocp_ros.util.annealing import annealed, between

T = TypeVar('T')


@dataclass(frozen=True)
class AnnealingTuning:
    """
    Constants of the annealing of poses.

    Temperatures are multiples of the loss of the first placement. An *exchange* replaces the pose
    of a camera by a candidate, a *move* displaces and rotates a camera.

    :ivar searches: number of independent searches.
    :ivar first_candidates: candidates compared for each camera of the first placement.
    :ivar exchange_budget_share: share of the budget for exchanges, scored with smaller depth maps.
    :ivar exchange_temperatures: first and last temperature of the exchanges.
    :ivar move_temperatures: first and last temperature of the moves.
    :ivar any_candidate_share: share of the exchanges that draw among all candidates.
    :ivar neighbours: number of nearest candidates among which the other exchanges draw.
    :ivar exchange_share: share of exchanges among the moves.
    :ivar first_deviations: standard deviations of the first moves: metres and radians.
    :ivar last_deviations: standard deviations of the last moves: metres and radians.
    :ivar roll_share: share of the moves that draw a new roll, if the mount allows several.
    :ivar drawn_poses: number of poses drawn for a move; the first feasible pose is used.
    :ivar min_loss: smallest loss that is used to compute temperatures.
    """

    searches: int = 4
    first_candidates: int = 300
    exchange_budget_share: float = 0.35
    exchange_temperatures: tuple[float, float] = (0.06, 5e-4)
    move_temperatures: tuple[float, float] = (0.01, 1e-4)
    any_candidate_share: float = 0.3
    neighbours: int = 12
    exchange_share: float = 0.1
    first_deviations: tuple[float, float] = (0.4, 0.3)
    last_deviations: tuple[float, float] = (0.01, 0.01)
    roll_share: float = 0.2
    drawn_poses: int = 4
    min_loss: float = 1e-3


TUNING = AnnealingTuning()


@dataclass(frozen=True)
class SearchResult:
    """
    The best placement of a search.

    :ivar sites: the mounted cameras, in the rig's order.
    :ivar loss: objective value; less is better.
    :ivar losses: objective values of the results of all searches.
    :ivar evaluations: number of proposed placements, infeasible ones included.
    :ivar certificate: lower bound and optimality gap, if the search proved them; otherwise None.
    :ivar uncertain: reason why a tried proof gave no certificate; otherwise empty.
    :ivar outcome: of an online planner's episode.
    """

    sites: Sites
    loss: float
    losses: tuple[float, ...]
    evaluations: int
    certificate: Certificate | None = None
    uncertain: str = ''
    outcome: Outcome | None = None

    @property
    def poses(self) -> np.ndarray:
        """Return the poses (K, 6), metres, map frame, and radians, rounded as in files."""
        return np.array([site.pose for site in self.sites])


def result_of_placement(objective: Objective, sites: Sequence[MountedCamera], evaluations: int
                        ) -> SearchResult:
    """Return a placement as the result of a single search."""
    loss = objective.loss(views_of(sites))
    return SearchResult(tuple(sites), loss, (loss,), evaluations)


class RigSearch:
    """
    A search for the placement of a rig: it counts evaluations and stores the smallest loss.

    :param problem: the rig in the room.
    :param pool: candidates.
    :param budget: of the search; several searches may share it.
    :param rng: the only source of random numbers.
    :param start: a placement; empty for none.
    """

    def __init__(self, problem: Problem, pool: CandidatePool, budget: Budget,
                 rng: np.random.Generator, start: Sequence[MountedCamera] = ()) -> None:
        self.problem = problem
        self.pool = pool
        self.budget = budget
        self.rng = rng
        self.start = tuple(start)
        # A subclass that shares the budget with other searches replaces this limit by its share.
        self.max_evaluations = budget.evaluations
        self.evaluations = 0
        self.least_loss = np.inf

    def loss_of(self, sites: Sequence[MountedCamera]) -> float:
        """Return the loss of a placement, and update the smallest loss."""
        loss = self.problem.objective.loss(views_of(sites))
        self.least_loss = min(self.least_loss, loss)
        return loss

    def used_share(self) -> float:
        """Return the used share of the budget."""
        return self.budget.used_share(self.evaluations, self.max_evaluations)


class AnnealingSearch(RigSearch):
    """
    One search by simulated annealing.

    :param coarse: the objective with smaller depth maps.
    :param settings: of :class:`RigSearch`; the first placement is chosen greedily if there is no
        ``start``. The searches share the evaluations of the budget.
    """

    def __init__(self, coarse: Objective, *settings: Any) -> None:
        super().__init__(*settings)
        self.coarse_objective = coarse
        if self.max_evaluations is not None:
            self.max_evaluations = max(self.max_evaluations // TUNING.searches, 1)
        #: Share of the current phase, from 0 to 1; temperatures and moves decrease with it. Each
        #: step of :meth:`_temperatures` updates it.
        self._progress = 0.0

    def run(self) -> Sites:
        """Return the best placement."""
        first = self.start or self.place_greedily()
        # The exchanges do not update the smallest loss, so the first placement is rated here.
        self.loss_of(first)
        unit = max(self.coarse_objective.loss(views_of(first)), TUNING.min_loss)
        # Exchanges, scored with smaller depth maps.
        best = annealed(first, lambda sites, _: self.coarse_objective.loss(views_of(sites)),
                        self._exchange_camera, self._temperatures(
                            unit, TUNING.exchange_temperatures, 0.0, TUNING.exchange_budget_share),
                        self.rng)
        objective = self.problem.objective
        # A given placement must not become worse: the full depth maps decide.
        if self.start and objective.loss(views_of(first)) < objective.loss(views_of(best)):
            best = first
        # Small moves, scored with the full depth maps.
        return annealed(best, lambda sites, _: self.loss_of(sites), self._change_camera,
                        self._temperatures(unit, TUNING.move_temperatures,
                                           TUNING.exchange_budget_share, 1.0), self.rng)

    def place_greedily(self) -> Sites:
        """Return a placement: one camera after the other, each the best of random candidates."""
        rig = self.problem.rig
        sites: list[MountedCamera] = []
        max_count = TUNING.first_candidates
        if self.max_evaluations is not None:
            # All cameras together take about a quarter of the evaluations or less.
            max_count = int(np.clip(self.max_evaluations // (4 * len(rig.cameras)), 1, max_count))
        for camera in rig.cameras:
            candidate_count = len(self.pool.candidates_of(camera.model).poses)
            # Without time left, compare few candidates.
            count = min(max_count if self.used_share() < 1.0 else 8, candidate_count)
            rows = np.sort(self.rng.choice(candidate_count, count, replace=False))
            self.evaluations += count
            # If all these candidates are too near to other cameras, draw any that is not.
            site = (self.pool.best_addition(self.coarse_objective, sites, rows)
                    or self.pool.random_site(rig, sites, self.rng))
            if site is None:
                return self.pool.packed_sites(rig)
            sites.append(site)
        return tuple(sites)

    def _temperatures(self, unit: float, multiples: tuple[float, float], first_share: float,
                      last_share: float) -> Iterator[float]:
        """
        Yield a temperature for each step, and count the step as an evaluation.

        :param unit: a loss, the unit of the temperatures.
        :param multiples: first and last temperature, in multiples of ``unit``.
        :param first_share: used share of the budget at which the temperature starts to decrease.
        :param last_share: used share of the budget at which the steps end.
        """
        first, last = (unit * multiple for multiple in multiples)
        while (used_share := self.used_share()) < last_share:
            self._progress = max(used_share - first_share, 0.0) / (last_share - first_share)
            self.evaluations += 1
            yield between(first, last, self._progress)

    def _exchange_camera(self, sites: Sites) -> list[Sites]:
        """Return sites with one pose replaced by a candidate, or [] if cameras are too close."""
        camera = int(self.rng.integers(len(sites)))
        model = self.problem.rig.cameras[camera].model
        candidates = self.pool.candidates_of(model)
        if self.rng.random() < TUNING.any_candidate_share:
            row = int(self.rng.integers(len(candidates.poses)))
        else:
            # One candidate more, because the nearest one may be the present pose.
            row = int(self.rng.choice(
                candidates.nearest_rows(sites[camera].pose, TUNING.neighbours + 1)))
        others = (*sites[:camera], *sites[camera + 1:])
        site = self.pool.mounted_candidate(model, row)
        if not are_spaced(site.pose[None], others, self.problem.rig.spacing)[0]:
            return []
        return [(*sites[:camera], site, *sites[camera + 1:])]

    def _change_camera(self, sites: Sites) -> list[Sites]:
        """Return sites with one camera moved, or sometimes exchanged; [] if infeasible."""
        if self.rng.random() < TUNING.exchange_share:
            return self._exchange_camera(sites)
        metres, radians = between(np.array(TUNING.first_deviations),
                                  np.array(TUNING.last_deviations), self._progress)
        return move_camera(self.problem, sites, metres, radians, self.rng)


def move_camera(problem: Problem, sites: Sites, metres: float, radians: float,
                rng: np.random.Generator) -> list[Sites]:
    """
    Move and rotate one random camera of a placement.

    :param metres: standard deviation of the move along each axis.
    :param radians: standard deviation of yaw and pitch.
    :returns: the changed sites; an empty list if no drawn pose is feasible.
    """
    camera = int(rng.integers(len(sites)))
    others = (*sites[:camera], *sites[camera + 1:])
    model = problem.rig.cameras[camera].model
    poses = poses_around(problem.region, sites[camera].pose, model, metres, radians,
                         TUNING.drawn_poses, rng)
    feasible = problem.region.allowed(poses, model) & are_spaced(
        poses, others, problem.rig.spacing)
    if not feasible.any():
        return []
    # The first feasible pose.
    pose = poses[int(np.argmax(feasible))]
    site = MountedCamera(pose, problem.simulator.look(pose, camera))
    return [(*sites[:camera], site, *sites[camera + 1:])]


def poses_around(region: FeasibleRegion, pose: np.ndarray, model: CameraModel, metres: float,
                 radians: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """
    Draw poses on the mount near a pose, feasible or not, rounded as in files.

    :param region: feasible region of the rig's cameras.
    :param pose: (6,) metres, map frame, and radians.
    :param model: the camera model; omnidirectional cameras keep their heading.
    :param metres: standard deviation of the position along each axis.
    :param radians: standard deviation of yaw and pitch.
    :param count: M, number of poses.
    :returns: (M, 6) metres and radians.
    """
    poses = np.repeat(pose[None], count, axis=0)
    poses[:, :3] += rng.normal(0.0, metres, (count, 3))
    poses[:, :3] = region.onto_mount(poses[:, :3])
    if not model.omnidirectional:
        poses[:, 3:5] += rng.normal(0.0, radians, (count, 2))
        poses[:, 4] = np.clip(poses[:, 4], *region.rig.pitch)
        if len(rolls := region.rig.rolls) > 1:
            rerolled = rng.random(count) < TUNING.roll_share
            poses[rerolled, 5] = rng.choice(rolls, np.count_nonzero(rerolled))
    return as_written(poses)


def anneal(problem: Problem, pool: CandidatePool, budget: Budget, seed: int,
           start: Sequence[MountedCamera] = (), progress: Progress | None = None) -> SearchResult:
    """
    Find the best placement of a rig's cameras by several searches; see :func:`run_threads`.

    :param problem: the rig in the room.
    :param pool: candidates of all its models.
    :param budget: of all searches together.
    :param seed: random seed.
    :param start: a placement; the result is not worse. Empty for none.
    :param progress: called several times a second.
    """
    coarse = coarse_objective(problem.objective)
    # Only the first search begins with the given placement.
    searches = [AnnealingSearch(coarse, problem, pool, budget, np.random.default_rng([seed, k]),
                                start if k == 0 else ()) for k in range(TUNING.searches)]
    # The budget is used up when every search has used its share.
    report = progress and (lambda: progress(min(search.used_share() for search in searches),
                                            min(search.least_loss for search in searches)))
    placements = run_threads([search.run for search in searches], budget, report)
    losses = [search.loss_of(sites) for search, sites in zip(searches, placements)]
    best = int(np.argmin(losses))
    return SearchResult(placements[best], losses[best], tuple(losses),
                        sum(search.evaluations for search in searches))


def run_threads(tasks: Sequence[Callable[[], T]], budget: Budget,
                report: Callable[[], None] | None) -> list[T]:
    """
    Run each task in a thread, report several times a second, and return the tasks' results.

    :param budget: of the tasks; it is stopped if a report fails or is interrupted.
    :param report: called with no arguments, for its effect; None for no reports.
    """
    report_interval_s = 0.2
    with ThreadPoolExecutor(len(tasks)) as workers:
        runs = [workers.submit(task) for task in tasks]
        try:
            while wait(runs, report_interval_s).not_done:
                if report is not None:
                    report()
        except BaseException:
            budget.stop()
            raise
    return [run.result() for run in runs]
