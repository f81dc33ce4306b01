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
from typing import TypeVar

import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.online.rollout import Outcome
from ocp_ros.rig.feasible_region import FeasibleRegion
from ocp_ros.rig.placement_file import as_written
from ocp_ros.search.budget import Budget, Progress
from ocp_ros.search.candidate_pool import (
    best_addition,
    keeps_spacing,
    MountedCamera,
    packed,
    Pool,
    quick_of,
    random_site,
)
from ocp_ros.search.proof.certificate import Certificate
from ocp_ros.simulation.objective import Objective
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulator import View
from ocp_ros.util.annealing import annealed, between

#: Number of independent searches.
SEARCHES = 4
#: Number of candidates for each camera in the first placement of a search.
FIRST_CANDIDATES = 300
#: Share of the budget for exchanges among candidates, scored with smaller depth maps.
EXCHANGE_TIME_SHARE = 0.35
#: First and last temperature of the exchanges and of the moves, in multiples of the loss of the
#: first placement.
FIRST_EXCHANGE_TEMPERATURE, LAST_EXCHANGE_TEMPERATURE = 0.06, 5e-4
FIRST_MOVE_TEMPERATURE, LAST_MOVE_TEMPERATURE = 0.01, 1e-4
#: Share of exchanges with any candidate; the others take one of the nearest ``NEIGHBOURS``.
ANYWHERE_SHARE = 0.3
NEIGHBOURS = 12
#: Share of exchanges among the moves.
EXCHANGE_SHARE = 0.1
#: Standard deviation of the first and last moves: metres and radians.
FIRST_STEP = np.array([0.4, 0.3])
LAST_STEP = np.array([0.01, 0.01])
#: Share of the moves that draw a new roll, if the mount allows several.
ROLL_SHARE = 0.2
#: Number of moves that are drawn together; the first feasible one is used.
MOVES_DRAWN = 4
#: Smallest loss that is used to compute temperatures.
MIN_LOSS = 1e-3
#: Seconds between two reports of progress.
REPORT_EVERY_S = 0.2
T = TypeVar('T')


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
    :ivar trace: of a search on a plane, see :class:`~ocp_ros.search.solve.Result`.
    :ivar outcome: of an online planner's episode.
    """

    sites: tuple[MountedCamera, ...]
    loss: float
    losses: tuple[float, ...]
    evaluations: int
    certificate: Certificate | None = None
    uncertain: str = ''
    trace: np.ndarray | None = None
    outcome: Outcome | None = None

    @property
    def poses(self) -> np.ndarray:
        """Return the poses (K, 6), metres, map frame, and radians, rounded as in files."""
        return np.array([site.pose for site in self.sites])


def views_of(sites: Sequence[MountedCamera]) -> list[View]:
    """Return the views of mounted cameras."""
    return [site.view for site in sites]


def answered(objective: Objective, sites: Sequence[MountedCamera], evaluations: int
             ) -> SearchResult:
    """Return a placement as the result of a single search."""
    loss = objective.loss(views_of(sites))
    return SearchResult(tuple(sites), loss, (loss,), evaluations)


class Search:
    """
    One search by simulated annealing.

    :param problem: the rig in the room.
    :param quick: the objective with smaller depth maps.
    :param pool: candidates.
    :param budget: of all searches.
    :param rng: the only source of random numbers.
    :param start: first placement; empty to choose one greedily.
    """

    def __init__(self, problem: Problem, quick: Objective, pool: Pool, budget: Budget,
                 rng: np.random.Generator, start: Sequence[MountedCamera] = ()) -> None:
        self.problem, self.objective, self.quick = problem, problem.objective, quick
        self.rig, self.pool, self.budget = problem.rig, pool, budget
        self.rng, self.start = rng, tuple(start)
        self.most = budget.evaluations and max(budget.evaluations // SEARCHES, 1)
        self.evaluations, self.share, self.least = 0, 0.0, np.inf

    def run(self) -> tuple[MountedCamera, ...]:
        """Return the best placement."""
        first = self.start or self.fill()
        self.judge(first)
        loss = max(self.quick.loss(views_of(first)), MIN_LOSS)
        chosen = annealed(
            first, lambda sites: self.quick.loss(views_of(sites)), self._exchanged,
            self._temperatures(loss * FIRST_EXCHANGE_TEMPERATURE, loss * LAST_EXCHANGE_TEMPERATURE,
                               0.0, EXCHANGE_TIME_SHARE), self.rng)
        if self.start and self.objective.loss(views_of(first)) < self.objective.loss(
                views_of(chosen)):
            # The full depth maps decide between the two placements.
            chosen = first
        return self.descend(chosen, loss, EXCHANGE_TIME_SHARE)

    def descend(self, sites: tuple[MountedCamera, ...], loss: float, begin: float, end: float = 1.0
                ) -> tuple[MountedCamera, ...]:
        """
        Anneal a placement by moves and rotations with decreasing steps.

        :param loss: temperatures are multiples of it.
        :param begin: used share of the budget at which the steps start to decrease.
        :param end: used share of the budget at which to stop.
        """
        return annealed(sites, self.judge, self._moved,
                        self._temperatures(loss * FIRST_MOVE_TEMPERATURE,
                                           loss * LAST_MOVE_TEMPERATURE, begin, end), self.rng)

    def fill(self) -> tuple[MountedCamera, ...]:
        """Place one camera after the other greedily, each among some random candidates."""
        sites: list[MountedCamera] = []
        count = FIRST_CANDIDATES
        if self.most is not None:
            count = int(np.clip(self.most // (4 * len(self.rig.cameras)), 1, FIRST_CANDIDATES))
        for camera in self.rig.cameras:
            total = len(self.pool.kind(camera.model).poses)
            # Without time left, compare few candidates.
            some = max(min(count if self.used() < 1.0 else 8, total), 1)
            among = np.sort(self.rng.choice(total, some, replace=False))
            self.evaluations += some
            site = (best_addition(self.quick, self.pool, sites, among)
                    or random_site(self.rig, self.pool, sites, self.rng))
            if site is None:
                return tuple(packed(self.rig, self.pool))
            sites.append(site)
        return tuple(sites)

    def judge(self, sites: Sequence[MountedCamera]) -> float:
        """Return the loss of a placement, and update the smallest loss."""
        loss = self.objective.loss(views_of(sites))
        self.least = min(self.least, loss)
        return loss

    def used(self) -> float:
        """Return the used share of the budget."""
        return self.budget.share(self.evaluations, self.most)

    def _temperatures(self, first: float, last: float, begin: float, end: float
                      ) -> Iterator[float]:
        """Yield one temperature for each step, until a share ``end`` of the budget is used."""
        while (used := self.used()) < end:
            self.share = max(used - begin, 0.0) / (end - begin)
            self.evaluations += 1
            yield between(first, last, self.share)

    def _exchanged(self, sites: tuple[MountedCamera, ...]) -> tuple[MountedCamera, ...] | None:
        """Replace the pose of one camera by a candidate, any or a near one; None if too close."""
        camera = int(self.rng.integers(len(sites)))
        model = self.rig.cameras[camera].model
        kind = self.pool.kind(model)
        if self.rng.random() < ANYWHERE_SHARE:
            number = int(self.rng.integers(len(kind.poses)))
        else:
            number = int(self.rng.choice(kind.near(sites[camera].pose, NEIGHBOURS + 1)))
        others = (*sites[:camera], *sites[camera + 1:])
        site = self.pool.site(model, number)
        if not keeps_spacing(site.pose[None], others, self.rig.spacing)[0]:
            return None
        return (*sites[:camera], site, *sites[camera + 1:])

    def _moved(self, sites: tuple[MountedCamera, ...]) -> tuple[MountedCamera, ...] | None:
        """Move and rotate one camera, or sometimes replace its pose by a candidate."""
        if self.rng.random() < EXCHANGE_SHARE:
            return self._exchanged(sites)
        far, turn = between(FIRST_STEP, LAST_STEP, self.share)
        return moved(self.problem, sites, far, turn, self.rng)


def moved(problem: Problem, sites: tuple[MountedCamera, ...], far: float, turn: float,
          rng: np.random.Generator) -> tuple[MountedCamera, ...] | None:
    """
    Move and rotate one camera of a placement at random; None if no drawn pose is feasible.

    :param far: standard deviation of the move along each axis, metres.
    :param turn: standard deviation of yaw and pitch, radians.
    """
    camera = int(rng.integers(len(sites)))
    others = (*sites[:camera], *sites[camera + 1:])
    model = problem.rig.cameras[camera].model
    poses = poses_around(problem.region, sites[camera].pose, model, far, turn, MOVES_DRAWN, rng)
    good = problem.region.allowed(poses, model) & keeps_spacing(poses, others, problem.rig.spacing)
    if not good.any():
        return None
    pose = poses[int(np.argmax(good))]
    site = MountedCamera(pose, problem.simulator.look(pose, camera))
    return (*sites[:camera], site, *sites[camera + 1:])


def poses_around(region: FeasibleRegion, pose: np.ndarray, model: CameraModel, far: float,
                 turn: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """
    Draw poses on the mount near a pose, feasible or not, rounded as in files.

    :param pose: (6,) metres, map frame, and radians.
    :param far: standard deviation of the position along each axis, metres.
    :param turn: standard deviation of yaw and pitch, radians; omnidirectional cameras keep them.
    :returns: (count, 6).
    """
    poses = np.repeat(pose[None], count, axis=0)
    poses[:, :3] += rng.normal(0.0, far, (count, 3))
    poses[:, :3] = region.onto_mount(poses[:, :3])
    if not model.omnidirectional:
        poses[:, 3:5] += rng.normal(0.0, turn, (count, 2))
        poses[:, 4] = np.clip(poses[:, 4], *region.rig.pitch)
        if len(rolls := region.rig.rolls) > 1:
            flipped = rng.random(count) < ROLL_SHARE
            poses[flipped, 5] = rng.choice(rolls, np.count_nonzero(flipped))
    return as_written(poses)


def anneal(problem: Problem, pool: Pool, budget: Budget, seed: int,
           start: Sequence[MountedCamera] = (), progress: Progress | None = None) -> SearchResult:
    """
    Find the best placement of a rig's cameras by annealing; see :func:`in_background`.

    :param start: a placement; the result is not worse than it. Empty for none.
    """
    quick = quick_of(problem.objective)
    searches = [Search(problem, quick, pool, budget, np.random.default_rng([seed, k]),
                       start if k == 0 else ()) for k in range(SEARCHES)]
    found = in_background([one.run for one in searches], budget, progress and (lambda: progress(
        min(one.used() for one in searches), min(one.least for one in searches))))
    losses = [one.judge(sites) for one, sites in zip(searches, found)]
    best = int(np.argmin(losses))
    return SearchResult(found[best], losses[best], tuple(losses),
                        sum(one.evaluations for one in searches))


def in_background(tasks: Sequence[Callable[[], T]], budget: Budget,
                  report: Callable[[], None] | None) -> list[T]:
    """
    Run each task in a thread, and report several times a second.

    :param budget: of the tasks; it is stopped if a report fails or is interrupted.
    """
    with ThreadPoolExecutor(len(tasks)) as workers:
        runs = [workers.submit(task) for task in tasks]
        try:
            while wait(runs, REPORT_EVERY_S).not_done:
                if report is not None:
                    report()
        except BaseException:
            budget.stop()
            raise
    return [run.result() for run in runs]
