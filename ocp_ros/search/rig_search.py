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
The default search of ``ocp plan``: column generation, local refinement, and a certificate.

Column generation over a dense grid of poses gives a lower bound and several good choices of poses.
Simulated annealing with small moves refines each choice off the grid. Poses near the best results
then join the grid, and both steps are repeated with decreasing distances. At the end, the gains of
all poses are computed for the certificate.

The relaxation counts some goals only in part (see :mod:`ocp_ros.search.proof.loss_trees`). For
these, its choices, a greedy placement and a random one are first improved by exchanges among the
candidates, with the whole objective.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import cycle
import logging
from typing import NamedTuple

import numpy as np
from ocp_ros.rig.feasible_region import DENSE
from ocp_ros.search.budget import Budget, Progress, run_threads
from ocp_ros.search.candidate_pool import (
    are_spaced,
    CandidatePool,
    MountedCamera,
    Sites,
    views_of,
)
from ocp_ros.search.placements import move_camera, SearchResult
from ocp_ros.search.pose_decoder import coarse_objective
from ocp_ros.search.pose_grid import PoseGrid
from ocp_ros.search.proof.certificate import Certificate, relaxed_goals
from ocp_ros.search.proof.column_generation import Choice, Column, ColumnGeneration
from ocp_ros.search.proof.loss_trees import LossTrees
from ocp_ros.simulation.objective import Objective
from ocp_ros.simulation.problem import Problem
from ocp_ros.util.annealing import annealed, between
from ocp_ros.util.threads import mapped


@dataclass(frozen=True)
class RigSearchTuning:
    """
    Constants of the search; a *repetition* adds poses near the best results and refines again.

    :ivar time_shares: shares of the time at which the choice on the grid, the first refinement and
        its repetitions end; the rest is for the proof.
    :ivar relaxed_time_shares: the same shares if the relaxation counts goals only in part.
    :ivar exchanged_time_share: the share at which the exchanges end then.
    :ivar exchanged_poses: number of candidates that an exchange of a camera compares: half of them
        are the nearest ones, the others are drawn.
    :ivar greedy_placements: number of greedy placements that are exchanged.
    :ivar min_evaluations: number of evaluations that are made whatever time they take.
    :ivar first_places: places of the first grid of a search with a limit of time; its bound is
        raised whatever time it takes.
    :ivar grid_growth: number of places of a grid / that of the grid before it.
    :ivar small_gap: with a larger relative difference of loss and bound, a bound that more time
        would raise is replaced by the last one that is final.
    :ivar first_choices: number of choices that are refined first.
    :ivar repeated_choices: number of choices that are refined in each repetition.
    :ivar moves: number of moves of a choice.
    :ivar evaluations_per_choice: with a budget of evaluations, their number for each choice.
    :ivar distances_m: for each repetition the distance from the results within which poses join
        the grid, metres.
    :ivar near_results: number of results near which poses join.
    :ivar near_places: number of places that join for each camera of a result.
    :ivar heading_step_per_metre: radians between headings for each metre of this distance.
    :ivar yaw_steps: number of new headings on either side of the pose in yaw.
    :ivar pitch_steps: number of new headings above and below the pose in pitch.
    :ivar distinct_m: results whose cameras all differ by less than this count as equal, metres.
    :ivar temperatures: first and last temperature of the moves, in multiples of the loss.
    :ivar last_deviation: standard deviation of the last moves: metres, and radians.
    :ivar min_loss: smallest loss that is used to compute temperatures.
    """

    time_shares: tuple[float, float, float] = (0.4, 0.6, 0.8)
    relaxed_time_shares: tuple[float, float, float] = (0.15, 0.75, 0.92)
    exchanged_time_share: float = 0.55
    exchanged_poses: int = 400
    greedy_placements: int = 3
    min_evaluations: int = 200
    first_places: int = 64
    grid_growth: int = 8
    small_gap: float = 0.02
    first_choices: int = 8
    repeated_choices: int = 4
    moves: int = 700
    evaluations_per_choice: int = 250
    distances_m: tuple[float, ...] = (0.3, 0.12, 0.05)
    near_results: int = 3
    near_places: int = 10
    heading_step_per_metre: float = float(np.deg2rad(20.0))
    yaw_steps: int = 4
    pitch_steps: int = 2
    distinct_m: float = 0.2
    temperatures: tuple[float, float] = (0.01, 1e-4)
    last_deviation: float = 0.01
    min_loss: float = 1e-3


TUNING = RigSearchTuning()
_log = logging.getLogger(__name__)


class RatedPlacement(NamedTuple):
    """A placement and its loss."""

    loss: float
    sites: Sites


class ColumnGenerationSearch:
    """
    One search by column generation and local refinement.

    :param problem: the rig in the room.
    :param pool: candidates, with the grids of the rig's models.
    :param budget: with evaluations and without seconds, the result is reproducible.
    :param seed: random seed.
    :param start: a placement; the result is not worse. Empty for none.
    """

    def __init__(self, problem: Problem, pool: CandidatePool, budget: Budget, seed: int,
                 start: Sequence[MountedCamera] = ()) -> None:
        self.problem = problem
        self.objective = problem.objective.searched
        self.pool = pool
        self.budget = budget
        self.rng = np.random.default_rng([seed, 0])
        self.start = tuple(start)
        self.evaluations = 0
        self.least_loss = np.inf
        #: Whether the relaxation counts goals of the rig only in part.
        self._relaxed = bool(relaxed_goals(problem.objective))
        self._time_shares = TUNING.relaxed_time_shares if self._relaxed else TUNING.time_shares
        #: Stage of the search: 0 is the grid, 1 refinement, 2 its repetitions, 3 the proof.
        self._stage = 0
        self._relaxation: ColumnGeneration | None = None
        self._first_choices = TUNING.first_choices
        self._repeated_choices = TUNING.repeated_choices
        #: Moves of each choice, first and in each repetition; a budget of evaluations sets others.
        self._first_moves = self._repeated_moves = TUNING.moves
        if (total := budget.evaluations) is not None:
            self._first_choices = int(np.clip(total // TUNING.evaluations_per_choice, 1,
                                              TUNING.first_choices))
            self._repeated_choices = max(self._first_choices // 2, 1)
            # Half of the evaluations are for the first choices, half for all repetitions.
            self._first_moves = max(total // (2 * self._first_choices), 1)
            repetitions = len(TUNING.distances_m)
            self._repeated_moves = max(total // (2 * repetitions * self._repeated_choices), 1)
        elif self._relaxed:
            # Fewer placements, each by as many moves for each camera as those of four cameras.
            self._first_choices = TUNING.near_results
            self._first_moves = self._repeated_moves = TUNING.moves * max(
                len(problem.rig.cameras) // 4, 1)

    def run(self) -> SearchResult:
        """
        Return the best placement that is found, with its proof.

        The steps: the relaxation over the grid of poses is solved, which gives a lower bound and
        some choices of poses; each choice is refined by small moves off the grid; poses near the
        best placements join the grid, with decreasing distances, and the best choices of them are
        refined again; at last the bound is raised on all poses for the certificate.
        """
        # Choose on the grid.
        grid_share, _, repeated_share = self._time_shares
        proof = GrowingProof(self.problem, self.pool, self.budget, grid_share)
        relaxation = self._relaxation = proof.relaxation
        proof.raise_bound(grid_share)
        choices = relaxation.find_choices(self._first_choices, self.rng,
                                          self.budget.deadline_check(grid_share))
        starts = [self._sites_of(relaxation, choice) for choice in choices]
        # Refine the choices off the grid.
        self._stage = 1
        if self._relaxed:
            starts = self._exchanged([*self._placed(), *starts], self._first_choices)
        first_results = results = self._refine_all(
            [*starts, self.start] if self.start else starts, TUNING.distances_m[0],
            self._first_moves, self._refined_enough)
        # Repeat both with poses near the results.
        self._stage = 2
        deadline = self.budget.deadline_check(repeated_share)
        timed = self.max_evaluations is None
        for distance_m in cycle(TUNING.distances_m) if self._relaxed and timed else (
                TUNING.distances_m):
            if not results or deadline():
                break
            relaxation.known_loss = min(relaxation.known_loss, results[0].loss)
            results = (self._refine_again if self._relaxed else self._repeat_near)(
                relaxation, results, distance_m, deadline)
        if not results:
            # No choice on the grid, and no given placement: the cameras are placed as close
            # together as the spacing allows.
            results = [self._rate_placement(self.pool.packed_sites(self.problem.rig))]
        relaxation.steps = 0
        self._stage, best = 3, results[0]
        if self._relaxed:
            # Links have to hold for what the scan proves, which the search does not look at.
            best = next((result for result in results if self.problem.objective.connects(
                views_of(result.sites))), best)
            self._add_near(relaxation, best, TUNING.distances_m[0])
            # Without the margin of the search.
            best = best._replace(loss=self.problem.objective.loss(views_of(best.sites)))
        relaxation.known_loss = min(relaxation.known_loss, best.loss)
        # The losses of all searches, for the report: one for each refined choice, and two for a
        # given placement, refined and as given. ``first_results`` is sorted and the repetitions
        # start from its first results, so the final loss replaces the first one.
        loss_on_grid = np.inf if self._relaxed else min(
            (choice.loss for choice in choices), default=best.loss)
        losses = (best.loss, *(result.loss for result in first_results[1:]))
        return SearchResult(best.sites, best.loss, losses, self.evaluations, *prove_gap(
            lambda: proof, best.loss, loss_on_grid))

    @property
    def max_evaluations(self) -> int | None:
        """Return the largest number of evaluations; None if the time alone counts."""
        return self.budget.evaluations

    def loss_of(self, sites: Sequence[MountedCamera]) -> float:
        """Return the loss of a placement, and update the smallest loss."""
        loss = self.objective.loss(views_of(sites))
        self.least_loss = min(self.least_loss, loss)
        return loss

    def used_share(self) -> float:
        """Return the used share of the time; without a limit of time, the share that is done."""
        if self.max_evaluations is None or self.budget.seconds is not None or self.budget.stopped:
            return self.budget.used_share(self.evaluations, self.max_evaluations)
        # Half of the evaluations are for the first refinement, half for the repetitions.
        doubled_share = 2.0 * self.evaluations / self.max_evaluations
        # How many steps a proof takes is not known before: each is 15 % of the rest.
        proof_share = 1.0 - 0.85 ** (self._relaxation.steps if self._relaxation else 0)
        stage_share = (0.5 * (self.pool.grid_share + proof_share), doubled_share,
                       doubled_share - 1.0, proof_share)[self._stage]
        starts = (0.0, *self._time_shares, 1.0)
        start, end = starts[self._stage:self._stage + 2]
        return start + (end - start) * float(np.clip(stage_share, 0.0, 1.0))

    def _refined_enough(self) -> bool:
        """Return whether to end the first refinement; a busy machine does not end it at once."""
        return self.budget.stopped or (
            self.evaluations >= TUNING.min_evaluations
            and self.budget.used_share(0, None) >= self._time_shares[1])

    def _rate_placement(self, sites: Sequence[MountedCamera]) -> RatedPlacement:
        """Return a placement with its loss."""
        return RatedPlacement(self.objective.loss(views_of(sites)), tuple(sites))

    def _sites_of(self, relaxation: ColumnGeneration, choice: Choice) -> Sites:
        """Return a choice as sites, in the order of the rig's cameras."""
        columns = [[column for column in choice.columns if column.grid == number]
                   for number in range(len(relaxation.grids))]
        # Grid k belongs to model k.
        models = self.problem.rig.placed_models
        # Each camera takes the first remaining column of its model.
        poses = [relaxation.pose(columns[models.index(camera.model)].pop(0))
                 for camera in self.problem.rig.cameras]
        return tuple(MountedCamera(pose, self.problem.simulator.look(pose, k))
                     for k, pose in enumerate(poses))

    def _refine_all(self, starts: Sequence[Sites], first_step_m: float, moves: int,
                    should_stop: Callable[[], bool]) -> list[RatedPlacement]:
        """Refine placements; return them and the user's placement, if any, the best first."""
        # Each start has a seed, so its result does not depend on the number of threads.
        seeds = self.rng.integers(2 ** 32, size=len(starts))
        results = mapped(lambda pair: self._refine(
            pair[0], first_step_m, moves, np.random.default_rng(pair[1]), should_stop),
            list(zip(starts, seeds)))
        if self.start:
            results.append(self._rate_placement(self.start))
        return sorted(results, key=lambda result: result.loss)

    def _refine(self, sites: Sites, first_step_m: float, moves: int, rng: np.random.Generator,
                should_stop: Callable[[], bool]) -> RatedPlacement:
        """
        Anneal a placement by small moves.

        :param first_step_m: standard deviation of the first moves, metres; in radians half of it.
        :param moves: number of moves.
        """
        # Share of the moves so far; the size of moves and the temperature decrease with it.
        progress = 0.0
        first_loss = max(self.objective.loss(views_of(sites)), TUNING.min_loss)

        def temperatures() -> Iterator[float]:
            nonlocal progress
            for move in range(moves):
                if should_stop():
                    return
                progress = move / moves
                self.evaluations += 1
                yield first_loss * between(*TUNING.temperatures, progress)

        best = annealed(sites, lambda sites, _: self.loss_of(sites), lambda sites: move_camera(
            self.problem, sites, between(first_step_m, TUNING.last_deviation, progress),
            between(0.5 * first_step_m, TUNING.last_deviation, progress), rng),
            temperatures(), rng)
        return RatedPlacement(self.loss_of(best), best)

    @cached_property
    def _coarse_objective(self) -> Objective:
        """Return the objective of exchanges, on smaller depth maps."""
        return coarse_objective(self.problem.objective).searched

    def _placed(self) -> list[Sites]:
        """Return some greedy placements, among random candidates, and the best of random ones."""
        rig, placed = self.problem.rig, []
        for _ in range(TUNING.greedy_placements):
            sites: list[MountedCamera] = []
            while len(sites) < len(rig.cameras) and not self.budget.stopped:
                rows = self.pool.spaced_rows(rig, sites)
                site = self.pool.best_addition(self._coarse_objective, sites, self._drawn_rows(
                    rows, min(TUNING.exchanged_poses, (len(rows) + 1) // 2), self.rng))
                if site is None:
                    break
                sites.append(site)
            placed.append(tuple(sites))
        drawn = [self.pool.random_sites(rig, self.rng) for _ in range(TUNING.first_choices)]
        placed.append(min((sites for sites in drawn if sites), default=(), key=lambda sites:
                          self._coarse_objective.loss(views_of(sites))))
        return [sites for sites in placed if len(sites) == len(rig.cameras)]

    @staticmethod
    def _drawn_rows(rows: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
        """Draw up to ``count`` of some rows of candidates, in their order."""
        return np.sort(rng.choice(rows, min(count, len(rows)), replace=False))

    def _exchanged(self, starts: Sequence[Sites], count: int) -> list[Sites]:
        """Return the best ``count`` placements after exchanges among the candidates."""
        deadline = self.budget.deadline_check(TUNING.exchanged_time_share)
        seeds = self.rng.integers(2 ** 32, size=len(starts))
        results = mapped(lambda pair: self._exchange(
            pair[0], np.random.default_rng(pair[1]), deadline), list(zip(starts, seeds)))
        return [result.sites for result in distinct_results(
            sorted(results, key=lambda result: result.loss), count)]

    def _exchange(self, sites: Sites, rng: np.random.Generator, should_stop: Callable[[], bool]
                  ) -> RatedPlacement:
        """Exchange one camera after the other for its best candidate, while this helps."""
        objective, rig = self._coarse_objective, self.problem.rig
        loss = objective.loss(views_of(sites))
        camera = unchanged = 0
        while unchanged < len(sites) and not should_stop():
            others = (*sites[:camera], *sites[camera + 1:])
            model = rig.cameras[camera].model
            candidates = self.pool.candidates_of(model)
            rows = np.union1d(
                candidates.nearest_rows(sites[camera].pose, TUNING.exchanged_poses // 2),
                self._drawn_rows(np.arange(len(candidates.poses)), TUNING.exchanged_poses // 2,
                                 rng))
            rows = rows[are_spaced(candidates.poses[rows], others, rig.spacing)]
            losses = objective.losses_with(views_of(others),
                                           [candidates.views[row] for row in rows], place=camera)
            unchanged += 1
            if losses.min(initial=np.inf) < loss * (1.0 - 1e-9):
                best = int(np.argmin(losses))
                loss, unchanged = float(losses[best]), 0
                sites = (*sites[:camera], self.pool.mounted_candidate(model, rows[best]),
                         *sites[camera + 1:])
            camera = (camera + 1) % len(sites)
        return RatedPlacement(loss, sites)

    def _refine_again(self, _: ColumnGeneration, results: list[RatedPlacement],
                      distance_m: float, should_stop: Callable[[], bool]) -> list[RatedPlacement]:
        """Refine the best results again by smaller moves."""
        best = distinct_results(results, TUNING.near_results)
        refined = self._refine_all([result.sites for result in best], distance_m,
                                   self._repeated_moves, should_stop)
        return sorted([*best, *refined], key=lambda result: result.loss)

    def _repeat_near(self, relaxation: ColumnGeneration, results: list[RatedPlacement],
                     distance_m: float, should_stop: Callable[[], bool]) -> list[RatedPlacement]:
        """Add poses near the best results to the grids, choose again, and refine the choices."""
        old_counts = [len(grid.places) for grid in relaxation.grids]
        best = distinct_results(results, TUNING.near_results)
        for result in best:
            self._add_near(relaxation, result, distance_m)
        # Only poses at the new places become columns now.
        relaxation.raise_bound(should_stop, [np.arange(count, len(grid.places))
                               for count, grid in zip(old_counts, relaxation.grids)])
        choices = relaxation.find_choices(self._repeated_choices, self.rng, should_stop)
        refined = self._refine_all([self._sites_of(relaxation, choice) for choice in choices],
                                   distance_m, self._repeated_moves, should_stop)
        return sorted([*best, *refined], key=lambda result: result.loss)

    def _add_near(self, relaxation: ColumnGeneration, result: RatedPlacement, distance_m: float
                  ) -> None:
        """Add the poses of a result to the columns, and poses near them to the grids."""
        relaxation.add_columns([self._add_poses_near(relaxation, site.pose, camera, distance_m)
                                for camera, site in enumerate(result.sites)])

    def _add_poses_near(self, relaxation: ColumnGeneration, pose: np.ndarray, camera: int,
                        distance_m: float) -> Column:
        """Add a pose (6,) and poses near it to the grid of its camera; return its column."""
        region = self.problem.region
        model = self.problem.rig.models[camera]
        grid_number = self.problem.rig.placed_models.index(model)
        grid = relaxation.grids[grid_number]
        first_place = len(grid.places)
        # Some poses may be infeasible, so twice as many are drawn; the first is the pose itself.
        poses = np.repeat(pose[None], 2 * TUNING.near_places, axis=0)
        poses[1:, :3] += self.rng.uniform(-distance_m, distance_m, (len(poses) - 1, 3))
        poses[1:, :3] = region.onto_mount(poses[1:, :3])
        feasible = region.allowed(poses, model)
        feasible[0] = True
        headings = pose[None, 3:]
        if not model.omnidirectional:
            # The heading of the pose itself comes first.
            yaws, pitches = (sorted(range(-count, count + 1), key=abs)
                             for count in (TUNING.yaw_steps, TUNING.pitch_steps))
            headings = pose[3:] + TUNING.heading_step_per_metre * distance_m * np.array(
                [(yaw, pitch, 0.0) for pitch in pitches for yaw in yaws])
            headings[:, 1] = np.clip(headings[:, 1], *self.problem.rig.pitch)
        places = poses[feasible][:TUNING.near_places, :3]
        grid.add_poses(places, [headings] * len(places))
        return Column(grid_number, first_place, 0)


class ProvedBound(NamedTuple):
    """
    A lower bound, and the grids that it holds for.

    :ivar bound: of the loss of every choice of poses of the grids.
    :ivar poses: number of these poses.
    :ivar step: see :class:`~ocp_ros.search.proof.certificate.Certificate`.
    :ivar near: see :class:`~ocp_ros.search.proof.certificate.Certificate`.
    """

    bound: float
    poses: int
    step: float
    near: bool


class GrowingProof:
    """
    The relaxed choice of a rig's poses on dense grids, which grow while there is time.

    With a limit of time, the grids grow when the bound of the present ones is final, so that there
    is a final bound at any time. The first grids and their bound do not depend on the time.

    :param problem: the rig in the room.
    :param pool: has the grids, and keeps the views of their poses.
    :param budget: of the search and the proof.
    :param share: share of the time in which the grids grow.
    :ivar relaxation: column generation on the present grids.
    """

    def __init__(self, problem: Problem, pool: CandidatePool, budget: Budget, share: float
                 ) -> None:
        self._problem = problem
        self._budget = budget
        self._last_final: ProvedBound | None = None
        self._has_bound = False
        models = problem.rig.placed_models
        self._pool_grids = [pool.dense_grid(problem, model) for model in models]
        counts = [sum(camera.model == model for camera in problem.rig.cameras) for model in models]
        place_count = None if budget.seconds is None else TUNING.first_places
        self.relaxation = ColumnGeneration(
            LossTrees.of(problem.objective), self._grown_grids(place_count, self._is_stopped),
            counts, problem.rig.spacing, problem.simulator.row_count)
        #: Number of poses of the grids, without those that the search adds.
        self._grid_poses = len(self.relaxation)
        deadline = budget.deadline_check(share)
        while not (self._is_complete or deadline()):
            self.raise_bound(share)
            place_count *= TUNING.grid_growth
            grids = self._grown_grids(place_count, deadline)
            if not deadline():
                self.relaxation.grids = grids
                self._grid_poses = len(self.relaxation)

    def _grown_grids(self, place_count: int | None, should_stop: Callable[[], bool]
                     ) -> list[PoseGrid]:
        """Return the first places of the grids of the pool, which keep the views of all."""
        for grid in self._pool_grids:
            grid.grow(place_count, should_stop)
        # The search adds poses to these grids; those of the pool must not change.
        return [grid.part(place_count) for grid in self._pool_grids]

    @property
    def _is_complete(self) -> bool:
        """Return whether the present grids have all places."""
        return all(grid.complete for grid in self.relaxation.grids)

    def _is_stopped(self) -> bool:
        """Return whether the user has ended the search."""
        return self._budget.stopped

    def raise_bound(self, share: float) -> None:
        """Raise the bound on the present grids, until a share of the time is used."""
        relaxation = self.relaxation
        relaxation.raise_bound(self._budget.deadline_check(share) if self._has_bound
                               else self._is_stopped)
        self._has_bound = True
        if relaxation.closed:
            self._last_final = self._present_bound()

    def _present_bound(self) -> ProvedBound:
        """Return the bound on the present grids."""
        near = len(self.relaxation) > self._grid_poses
        return ProvedBound(self.relaxation.bound, len(self.relaxation), self.relaxation.step, near)

    def certificate(self, loss: float, loss_on_grid: float) -> tuple[Certificate | None, str]:
        """Return the certificate of a placement; see :func:`prove_gap`."""
        self.raise_bound(1.0)
        final, proved = self._last_final, self._present_bound()
        # If there was no time to raise the bound on all poses, that of the grids before says more.
        if final is not None and proved.bound < (1.0 - TUNING.small_gap) * min(loss, final.bound):
            proved = final
        # A final bound of 0 says that no placement gains more than the whole loss of this one.
        relaxed = relaxed_goals(self._problem.objective)
        if proved.bound <= 0.0 < loss and (relaxed or not self.relaxation.closed):
            return None, ('no bound for this goal' if relaxed and self.relaxation.closed
                          else 'there was no time to prove one')
        # Without poses near the cameras, no choice of the grids may be as good as the placement.
        bound = min(max(proved.bound - self.relaxation.trees.rounding, 0.0), loss)
        problem = self._problem
        directional = any(not model.omnidirectional for model in problem.rig.placed_models)
        # Degrees between the yaws of the grid.
        heading_step = round(float(np.rad2deg(DENSE[0])), 1) if directional else 0.0
        return Certificate(
            proved.poses, proved.step, proved.near, heading_step,
            problem.simulator.config.engine.error_rows, loss, bound,
            self._is_complete and self.relaxation.closed,
            loss_on_grid if np.isfinite(loss_on_grid) else None, self._budget.elapsed,
            relaxed), ''


def prove_gap(make_proof: Callable[[], GrowingProof], loss: float, loss_on_grid: float
              ) -> tuple[Certificate | None, str]:
    """
    Prove the optimality gap of a placement with respect to all placements on the grids.

    :param make_proof: returns the proof; if it raises an error, the proof has failed.
    :param loss: of the placement.
    :param loss_on_grid: of the best choice on the grids, before poses were added.
    :returns: a certificate and an empty text, or None and the reason why there is none.
    """
    try:
        return make_proof().certificate(loss, loss_on_grid)
    except Exception as error:  # The placement is valid without the proof, so keep it.
        _log.exception('the proof failed')
        return None, f'its proof failed ({type(error).__name__}: {error})'


def distinct_results(results: Sequence[RatedPlacement], max_count: int) -> list[RatedPlacement]:
    """Choose results, the best first, that differ in the position of at least one camera."""
    chosen: list[RatedPlacement] = []
    for result in results:
        positions = np.array([site.pose[:3] for site in result.sites])
        if all(np.linalg.norm(positions - [site.pose[:3] for site in other.sites], axis=1).max()
               >= TUNING.distinct_m for other in chosen):
            chosen.append(result)
    return chosen[:max_count]


def search(problem: Problem, pool: CandidatePool, budget: Budget, seed: int,
           start: Sequence[MountedCamera] = (), progress: Progress | None = None) -> SearchResult:
    """
    Find the best placement of a rig's cameras, and prove its optimality gap.

    :param problem: the rig in the room.
    :param pool: candidates of all its models.
    :param budget: of the search and the proof.
    :param seed: random seed.
    :param start: a placement; the result is not worse. Empty for none.
    :param progress: called several times a second.
    """
    solver = ColumnGenerationSearch(problem, pool, budget, seed, start)
    report = progress and (lambda: progress(solver.used_share(), solver.least_loss))
    return run_threads([solver.run], budget, report)[0]
