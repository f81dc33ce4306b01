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

Column generation over a dense grid of poses gives a lower bound and several good choices.
Simulated annealing with small moves refines each choice off the grid. Poses near the best results
then join the grid, and both steps are repeated with decreasing distances. At the end, all poses
are priced for the certificate.
"""

from collections.abc import Callable, Sequence
from copy import copy
import logging
from typing import NamedTuple

import numpy as np
from ocp_ros.rig.feasible_region import DENSE
from ocp_ros.search.budget import Budget, Progress
from ocp_ros.search.candidate_pool import MountedCamera, packed, Pool
from ocp_ros.search.pose_annealing import (
    anneal,
    in_background,
    moved,
    SearchResult,
    views_of,
)
from ocp_ros.search.pose_grid import PoseGrid
from ocp_ros.search.proof.certificate import Certificate, not_covered
from ocp_ros.search.proof.column_generation import Choice, Column, ColumnGeneration
from ocp_ros.search.proof.loss_trees import LossTrees
from ocp_ros.simulation.problem import Problem
from ocp_ros.util.annealing import annealed, between
from ocp_ros.util.threads import mapped

#: Shares of the time at which the grid, the refinement and its repetitions end; the rest is for
#: the proof.
GRID_SHARE, POLISHED_SHARE, NEARER_SHARE = 0.4, 0.6, 0.8
#: Number of choices that are refined first, and in each repetition.
FIRST_CHOICES, MORE_CHOICES = 8, 4
#: Moves of a choice.
MOVES = 700
#: With a budget of evaluations: number of evaluations for each choice.
EVALUATIONS_EACH = 250
#: Distances from the results within which poses join the grid in each repetition, metres.
STEPS_M = (0.3, 0.12, 0.05)
#: Number of results near which poses join, and of places for each camera of a result.
RESULTS_NEAR, PLACES_NEAR = 3, 10
#: Radians between headings for each metre between places.
TURN_PER_METRE = np.deg2rad(20.0)
#: Number of headings on either side of the pose, in yaw and in pitch.
YAW_STEPS, PITCH_STEPS = 4, 2
#: Results whose cameras all differ by less than this count as equal, metres.
DISTINCT_M = 0.2
#: First and last temperature of the moves, in multiples of the loss.
FIRST_TEMPERATURE, LAST_TEMPERATURE = 0.01, 1e-4
#: Standard deviation of the last moves, metres and radians.
LAST_STEP = 0.01
#: Smallest loss that is used to compute temperatures.
MIN_LOSS = 1e-3

_log = logging.getLogger(__name__)


class Polished(NamedTuple):
    """A placement and its loss."""

    loss: float
    sites: tuple[MountedCamera, ...]


class PricedSearch:
    """
    One search by column generation and local refinement.

    :param problem: the rig in the room, with ``seen_by`` 1 and without ``calibratable`` or regions
        of air.
    :param pool: candidates, with the grids of the rig's models.
    :param budget: with evaluations and without seconds, the result is reproducible.
    :param seed: random seed.
    :param start: a placement; the result is not worse than it. Empty for none.
    """

    def __init__(self, problem: Problem, pool: Pool, budget: Budget, seed: int,
                 start: Sequence[MountedCamera] = ()) -> None:
        self.problem, self.pool, self.budget, self.seed = problem, pool, budget, seed
        self.start, self.evaluations, self.least = tuple(start), 0, np.inf
        self._rng = np.random.default_rng([seed, 0])
        most = budget.evaluations
        #: Number of choices refined first and in each repetition.
        self._starts, self._again = FIRST_CHOICES, MORE_CHOICES
        #: Moves of each choice, first and in each repetition.
        self._moves, self._moves_again = MOVES, MOVES
        if most is not None:
            self._starts = int(np.clip(most // EVALUATIONS_EACH, 1, FIRST_CHOICES))
            self._again = max(self._starts // 2, 1)
            self._moves = max(most // (2 * self._starts), 1)
            self._moves_again = max(most // (2 * len(STEPS_M) * self._again), 1)

    def used(self) -> float:
        """Return the approximate used share of the budget."""
        return self.budget.share(self.evaluations, self.budget.evaluations)

    def _share_used(self, share: float) -> Callable[[], bool]:
        """Return a function that returns whether a share of the time is used."""
        return lambda: self.budget.share(0, None) >= share

    def run(self) -> SearchResult:
        """
        Return the best placement that is found, with its proof.

        The steps: the relaxation over the grid of poses is solved, which gives a lower bound and
        some choices of poses; each choice is polished by small moves off the grid; poses near the
        best placements join the grid, with ever smaller steps, and the best choices of them are
        polished again; at last the bound is raised on all poses for the certificate.
        """
        relaxation = relaxation_of(self.problem, self.pool, self._share_used(0.5 * GRID_SHARE))
        relaxation.raise_bound(self._share_used(GRID_SHARE))
        choices = relaxation.choices(self._starts, self._rng, self._share_used(GRID_SHARE))
        starts = [self._sites(relaxation, choice) for choice in choices]
        found = self._polish([*starts, self.start] if self.start else starts, STEPS_M[0],
                             self._moves, POLISHED_SHARE)
        on_grid = min((choice.loss for choice in choices), default=np.inf)
        first = found
        for step in STEPS_M if found else ():
            if self._share_used(NEARER_SHARE)():
                break
            found = self._nearer(relaxation, found, step)
        if not found:
            found = [self._judged(packed(self.problem.rig, self.pool))]
        best = found[0]
        losses = (best.loss, *(one.loss for one in first[1:]))
        return SearchResult(best.sites, best.loss, losses, self.evaluations, *certified(
            self.problem, lambda: relaxation, best.loss, on_grid, self.budget))

    def _judged(self, sites: Sequence[MountedCamera]) -> Polished:
        """Return a placement with its loss."""
        return Polished(self.problem.objective.loss(views_of(sites)), tuple(sites))

    def _sites(self, relaxation: ColumnGeneration, choice: Choice) -> tuple[MountedCamera, ...]:
        """Return a choice as sites, in the order of the rig's cameras."""
        left = [[one for one in choice.columns if one.grid == number]
                for number in range(len(relaxation.grids))]
        models = self.problem.rig.placed_models
        poses = [relaxation.pose(left[models.index(camera.model)].pop(0))
                 for camera in self.problem.rig.cameras]
        return tuple(MountedCamera(pose, self.problem.simulator.look(pose, camera))
                     for camera, pose in enumerate(poses))

    def _polish(self, starts: Sequence[tuple[MountedCamera, ...]], far: float, moves: int,
                share: float) -> list[Polished]:
        """Refine placements by decreasing moves; return the results and the start, best first."""
        seeds = self._rng.integers(2 ** 32, size=len(starts))
        found = mapped(lambda one: self._moved(one[0], far, moves, np.random.default_rng(one[1]),
                                               self._share_used(share)), list(zip(starts, seeds)))
        if self.start:
            found.append(self._judged(self.start))
        return sorted(found, key=lambda one: one.loss)

    def _moved(self, sites: tuple[MountedCamera, ...], far: float, moves: int,
               rng: np.random.Generator, over: Callable[[], bool]) -> Polished:
        """Anneal a placement by moves whose standard deviation starts at ``far`` metres."""
        objective, turn, share = self.problem.objective, 0.5 * far, 0.0
        loss = max(objective.loss(views_of(sites)), MIN_LOSS)

        def judge(sites: tuple[MountedCamera, ...]) -> float:
            value = objective.loss(views_of(sites))
            self.least = min(self.least, value)
            return value

        def temperatures():
            nonlocal share
            for move in range(moves):
                if over():
                    return
                share = move / moves
                self.evaluations += 1
                yield loss * between(FIRST_TEMPERATURE, LAST_TEMPERATURE, share)

        best = annealed(sites, judge, lambda sites: moved(
            self.problem, sites, between(far, LAST_STEP, share), between(turn, LAST_STEP, share),
            rng), temperatures(), rng)
        return Polished(judge(best), best)

    def _nearer(self, relaxation: ColumnGeneration, found: list[Polished], step: float
                ) -> list[Polished]:
        """Add poses near the best results to the grid, choose again, and refine the choices."""
        before = [len(grid.places) for grid in relaxation.grids]
        best = distinct(found, RESULTS_NEAR)
        for one in best:
            relaxation.join([self._add_near(relaxation, site.pose, camera, step)
                             for camera, site in enumerate(one.sites)])
        relaxation.raise_bound(self._share_used(NEARER_SHARE), [np.arange(first, len(grid.places))
                               for first, grid in zip(before, relaxation.grids)])
        choices = relaxation.choices(self._again, self._rng, self._share_used(NEARER_SHARE))
        again = self._polish([self._sites(relaxation, choice) for choice in choices], step,
                             self._moves_again, NEARER_SHARE)
        return sorted([*best, *again], key=lambda one: one.loss)

    def _add_near(self, relaxation: ColumnGeneration, pose: np.ndarray, camera: int, step: float
                  ) -> Column:
        """Add places and headings near a pose to its camera's grid; return the pose's column."""
        region, rig, model = self.problem.region, self.problem.rig, self.problem.rig.models[camera]
        number = self.problem.rig.placed_models.index(model)
        grid, first = relaxation.grids[number], len(relaxation.grids[number].places)
        poses = np.repeat(pose[None], 2 * PLACES_NEAR, axis=0)
        poses[1:, :3] += self._rng.uniform(-step, step, (len(poses) - 1, 3))
        poses[1:, :3] = region.onto_mount(poses[1:, :3])
        good = region.allowed(poses, model)
        good[0] = True
        headings = pose[None, 3:]
        if not model.omnidirectional:
            yaws, pitches = (sorted(range(-count, count + 1), key=abs)
                             for count in (YAW_STEPS, PITCH_STEPS))
            headings = pose[3:] + TURN_PER_METRE * step * np.array(
                [(yaw, pitch, 0.0) for pitch in pitches for yaw in yaws])
            headings[:, 1] = np.clip(headings[:, 1], *rig.pitch)
        places = poses[good][:PLACES_NEAR, :3]
        grid.add(places, [headings] * len(places))
        return Column(number, first, 0)


def relaxation_of(problem: Problem, pool: Pool, over: Callable[[], bool]) -> ColumnGeneration:
    """Return the column generation for a rig's poses on dense grids."""
    models = problem.rig.placed_models
    grids: list[PoseGrid] = [copy(pool.grid(problem, model, over)) for model in models]
    counts = [sum(camera.model == model for camera in problem.rig.cameras) for model in models]
    return ColumnGeneration(LossTrees.of(problem.objective), grids, counts, problem.rig.spacing,
                            len(problem.simulator.scene))


def certified(problem: Problem, relax: Callable[[], ColumnGeneration], found: float,
              on_grid: float, budget: Budget) -> tuple[Certificate | None, str]:
    """
    Prove the optimality gap of a placement with respect to all placements on the grids.

    :param relax: returns the column generation.
    :param found: the loss of the placement.
    :param on_grid: the loss of the best choice on the grids, before poses were added.
    :param budget: of the search and the proof.
    :returns: a certificate, or None; and the reason if it is None.
    """
    try:
        relaxation = relax()
        relaxation.raise_bound(lambda: budget.share(0, None) >= 1.0)
        if relaxation.bound <= 0.0 < found:
            return None, ('the bound is 0, for these poses together miss almost nothing'
                          if relaxation.closed else 'there was no time to prove one')
        return _certificate(problem, relaxation, found, on_grid, budget.elapsed), ''
    except Exception as error:  # The placement is valid without the proof, so keep it.
        _log.exception('the proof failed')
        return None, f'its proof failed ({type(error).__name__}: {error})'


def _certificate(problem: Problem, relaxation: ColumnGeneration, found: float, on_grid: float,
                 seconds: float) -> Certificate:
    """Return the certificate of a bound, in units of the loss."""
    bound = max(relaxation.bound - relaxation.trees.rounding, 0.0)
    turns = any(not model.omnidirectional for model in problem.rig.placed_models)
    return Certificate(
        len(relaxation), max(grid.step for grid in relaxation.grids),
        round(float(np.rad2deg(DENSE[0])), 1) if turns else 0.0,
        problem.simulator.config.engine.error_rows, found, bound, relaxation.closed, on_grid,
        seconds)


def distinct(found: Sequence[Polished], most: int) -> list[Polished]:
    """Choose results, the best first, that differ in the position of at least one camera."""
    chosen: list[Polished] = []
    for one in found:
        places = np.array([site.pose[:3] for site in one.sites])
        if all(np.linalg.norm(places - [site.pose[:3] for site in other.sites], axis=1).max()
               >= DISTINCT_M for other in chosen):
            chosen.append(one)
    return chosen[:most]


def search(problem: Problem, pool: Pool, budget: Budget, seed: int,
           start: Sequence[MountedCamera] = (), progress: Progress | None = None) -> SearchResult:
    """
    Find the best placement of a rig's cameras, and prove its optimality gap.

    An objective without a lower bound has no prices; then simulated annealing is used.

    :param problem: the rig in the room.
    :param pool: candidates of all its models.
    :param budget: of the search and the proof.
    :param seed: random seed.
    :param start: a placement; the result is not worse than it. Empty for none.
    :param progress: called several times a second.
    """
    if not_covered(problem.objective):
        return anneal(problem, pool, budget, seed, start, progress)
    one = PricedSearch(problem, pool, budget, seed, start)
    report = progress and (lambda: progress(one.used(), one.least))
    return in_background([one.run], budget, report)[0]
