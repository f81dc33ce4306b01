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
Column generation: a lower bound for all poses of dense grids, and good choices of poses.

A linear program chooses among a pool of some hundred poses. Its loss is bounded from below by
Benders cuts (:mod:`ocp_ros.search.proof.loss_trees`), computed at its optima and half way from
them to a core point. Its multipliers price all poses of the grids. They prove a bound that holds
for every choice of these poses (a Lagrangian bound), and the poses with the largest gains join the
pool, until no pose would improve the choice.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import chain
from typing import NamedTuple

import numpy as np
from ocp_ros.search.pose_grid import PoseGrid
from ocp_ros.search.proof.cut_program import CutProgram
from ocp_ros.search.proof.loss_trees import LossTrees, NOTHING, poses_by_point
from ocp_ros.util.threads import mapped
from scipy.spatial.distance import cdist

#: Number of poses of each grid in the first pool.
FIRST_COLUMNS = 300
#: Largest number of poses that join at a time, and of these at one place.
NEW_COLUMNS, MAX_COLUMNS_PER_PLACE = 150, 3
#: A pose leaves the pool if it gains less than this share of the gain of a chosen pose.
DROP_COST = 0.5
#: Relative tolerance between a program's optimum and the loss: first, then later.
FIRST_TOLERANCE, LAST_TOLERANCE = 0.01, 0.002
#: Largest number of optima of a program, and of programs.
ROUNDS, PROGRAMS = 60, 12
#: Largest relative difference of bound and program's optimum at which the bound is closed.
CLOSED_GAP = 0.004
#: Smallest loss for relative tolerances: smaller losses are mostly noise and slow to prove.
MIN_LOSS = 0.02
#: Losses with a relative difference below this are equal.
EQUAL_LOSS = 1e-6
#: Smallest distance of other choices from a place of the best choice, metres.
PLACES_APART_M = 0.6


class Column(NamedTuple):
    """A pose, given by the numbers of its grid, its place and its heading."""

    grid: int
    place: int
    heading: int


class Choice(NamedTuple):
    """
    A choice of poses.

    :ivar loss: of these poses.
    :ivar columns: of the poses, sorted by grid.
    """

    loss: float
    columns: tuple[Column, ...]


class ColumnGeneration:
    """
    The relaxed choice of poses on grids; places may be added to the grids later.

    :param trees: of the loss.
    :param grids: one for each camera model.
    :param counts: number of poses to choose from each grid.
    :param spacing: smallest distance of two cameras, metres.
    :param points: N, number of points of the scene.
    :ivar bound: lower bound of the loss of every choice among the priced poses; these are all
        poses of the grids, unless places were added since.
    :ivar closed: whether the bound is the best that the relaxation can give.
    """

    def __init__(self, trees: LossTrees, grids: Sequence[PoseGrid], counts: Sequence[int],
                 spacing: float, points: int) -> None:
        self.trees, self.grids, self.counts = trees, grids, np.array(counts)
        self.spacing, self._points = spacing, points
        self.bound, self.closed = 0.0, False
        self._pool: list[Column] = []
        self._seen_by = poses_by_point((), points)
        self._share = np.zeros(0)
        #: For each active cut, the customers that were served by less than 1 at its point.
        self._cuts: list[np.ndarray] = []
        rng = np.random.default_rng(0)
        for number, grid in enumerate(grids):
            poses = [Column(number, place, heading) for place, some in enumerate(grid.headings)
                     for heading in range(len(some))]
            some = rng.choice(len(poses), min(FIRST_COLUMNS, len(poses)), replace=False)
            self.join([poses[k] for k in some])

    def __len__(self) -> int:
        """Return the number of poses of all grids."""
        return sum(map(len, self.grids))

    def pose(self, column: Column) -> np.ndarray:
        """Return a pose: (6,) metres, map frame, and radians."""
        return self.grids[column.grid].pose(column.place, column.heading)

    def join(self, columns: Iterable[Column]) -> None:
        """Add poses to the pool."""
        known = set(self._pool)
        self._set_pool([*self._pool, *(column for column in columns if column not in known)])

    def _set_pool(self, pool: list[Column]) -> None:
        """Replace the pool."""
        self._pool = pool
        self._seen_by = poses_by_point(
            [self.grids[one.grid].points(one.place, one.heading) for one in pool], self._points)
        self._group = np.array([one.grid for one in pool])
        places = np.array([self.pose(one)[:3] for one in pool])
        self._near = cdist(places, places) < self.spacing
        self._share = np.zeros(len(pool))

    def raise_bound(self, over: Callable[[], bool],
                    places: Sequence[np.ndarray] | None = None) -> None:
        """
        Raise the bound until no pose improves the choice, or until ``over``.

        :param over: returns whether to stop.
        :param places: for each grid the numbers of the places to price; None for all. Otherwise
            the bound does not hold for the other places.
        """
        self.bound, self.closed = 0.0, False
        places = [np.arange(len(grid.places)) for grid in self.grids] if places is None else places
        for program in range(PROGRAMS):
            tolerance = LAST_TOLERANCE if program else FIRST_TOLERANCE
            value, multipliers, lost = self._relaxed(tolerance, over)
            gains = self._gains(multipliers, places, over)
            if gains is None:
                return
            self.bound = max(self.bound, lost - sum(
                self._most(of_grid, count) for of_grid, count in zip(gains, self.counts)))
            own, needed = self._needed(gains)
            better = self._better(gains, needed)
            gap = value - self.bound
            self.closed = bool(program and gap <= CLOSED_GAP * max(value, MIN_LOSS)) or not better
            if self.closed or over():
                return
            self._set_pool([*self._staying(own, needed), *better])

    def _most(self, gains: dict[int, np.ndarray], count: int) -> float:
        """Return the largest total gain of ``count`` poses, given the gains at each place."""
        # With a spacing, there is at most one camera at a place.
        each = [best[:1] if self.spacing > 0.0 else best
                for best in (-np.sort(-values) for values in gains.values())]
        return float(np.sort(np.concatenate([*each, np.zeros(count)]))[-count:].sum())

    def _relaxed(self, tolerance: float, over: Callable[[], bool]
                 ) -> tuple[float, np.ndarray, float]:
        """
        Solve the linear program of the pool.

        :param tolerance: largest difference of cuts and loss, as a share of the loss.
        :returns: its optimum, the multipliers (T,) of all customers, and the constant of the
            Lagrangian bound, which is its value without any chosen pose.
        """
        trees, count = self.trees, len(self._pool)
        program = CutProgram(self._group, self.counts, len(trees.slack))
        core = (self.counts / np.bincount(self._group))[self._group]
        made = self._cuts or [trees.unserved(self._seen_by, core)]
        for number, unserved in enumerate(made):
            program.add(number, *trees.cut(self._seen_by, count, unserved))
        made = list(made)
        for _ in range(ROUNDS):
            found = program.solve(over)
            value, above = found.losses.sum(), 0.0
            for share in (found.share, 0.5 * (core + found.share)):
                unserved = trees.unserved(self._seen_by, share)
                consts, gains = trees.cut(self._seen_by, count, unserved)
                losses = np.maximum(consts - gains @ found.share, 0.0)
                above = max(above, losses.sum())
                raised = losses > found.losses + EQUAL_LOSS * above / len(losses)
                program.add(len(made), consts, gains, raised)
                made.append(unserved)
            core = 0.5 * (core + found.share)
            near = above - value <= tolerance * max(above, MIN_LOSS)
            if near or not found.optimal or over():
                break
        # Cuts that were added in the last round have no multipliers yet.
        cuts, multipliers = program.cuts, found.multipliers
        active = np.flatnonzero(multipliers > NOTHING)
        weights, lost = np.zeros(len(trees.weight)), 0.0
        for k in active:
            number, part = cuts[k]
            first, last = trees.parts[part], trees.parts[part + 1]
            weights[first:last] += multipliers[k] * made[number][first:last]
            lost -= multipliers[k] * trees.slack[part]
        self._cuts = [made[number] for number in dict.fromkeys(cuts[active, 0].tolist())]
        self._share = found.share
        weights *= trees.weight
        return float(value), weights, float(weights.sum() + lost)

    def _gains(self, multipliers: np.ndarray, places: Sequence[np.ndarray],
               over: Callable[[], bool]) -> list[dict[int, np.ndarray]] | None:
        """
        Return for each grid the gains of the headings at each place.

        The gain of a pose is the sum of the multipliers of the nodes that it serves.

        :param multipliers: (T,) of the nodes of the trees, metres.
        :param places: for each grid the numbers of the places.
        :param over: returns whether to stop.
        :returns: None if ``over`` has ended the computation.
        """
        trees = self.trees.priced(multipliers)

        def gains_of(grid: PoseGrid, batch: list[int]) -> list[tuple[int, np.ndarray]]:
            if over():
                return []
            ends = np.cumsum([len(grid.headings[place]) for place in batch])
            # The last bits of the last word belong to no pose.
            gains = trees.gains(grid.seen_by(batch))[:ends[-1]]
            return list(zip(batch, np.split(gains, ends[:-1])))

        found = [dict(chain(*mapped(partial(gains_of, grid), grid.batches(some))))
                 for grid, some in zip(self.grids, places)]
        return None if over() else found

    def _needed(self, gains: Sequence[dict[int, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
        """Return the gains (n,) of the pool, and for each grid its ``count``-th largest gain."""
        own = np.array([gains[one.grid][one.place][one.heading]
                        if one.place in gains[one.grid] else 0.0 for one in self._pool])
        return own, np.array([np.sort(own[self._group == group])[::-1][:count].min(initial=np.inf)
                              for group, count in enumerate(self.counts)])

    def _better(self, gains: Sequence[dict[int, np.ndarray]], needed: np.ndarray) -> list[Column]:
        """Return the poses with larger gains than needed, only a few of each place."""
        known, found = set(self._pool), []
        for number, of_grid in enumerate(gains):
            least = needed[number] * (1.0 + EQUAL_LOSS) + NOTHING
            for place, values in of_grid.items():
                best = np.argsort(-values, kind='stable')[:2 * MAX_COLUMNS_PER_PLACE]
                columns = [(values[k], Column(number, place, int(k))) for k in best
                           if values[k] > least]
                found += [pair for pair in columns if pair[1] not in known][:MAX_COLUMNS_PER_PLACE]
        found.sort(key=lambda pair: -pair[0])
        return [column for _, column in found[:NEW_COLUMNS]]

    def _staying(self, own: np.ndarray, needed: np.ndarray) -> list[Column]:
        """Return the poses that stay in the pool: chosen ones, and those with large gains."""
        stays = (self._share > NOTHING) | (own >= DROP_COST * needed[self._group])
        for group, count in enumerate(self.counts):
            members = np.flatnonzero(self._group == group)
            stays[members[np.argsort(-own[members], kind='stable')[:2 * count]]] = True
        return [one for one, stay in zip(self._pool, stays) if stay]

    def choices(self, count: int, rng: np.random.Generator, over: Callable[[], bool]
                ) -> list[Choice]:
        """
        Round the solution of the program, and improve it by exchanges of one pose.

        After the first choice, every second attempt excludes the poses near a place of the best
        choice.

        :param count: largest number of different choices.
        :returns: the best first; [] if the spacing leaves too few places.
        """
        found: dict[tuple[int, ...], float] = {}
        allowed = np.ones(len(self._share), dtype=bool)
        places = np.array([self.pose(one)[:3] for one in self._pool])
        for attempt in range(2 * count):
            share = self._share * (rng.exponential(size=len(self._share)) if attempt else 1.0)
            if found:
                best = min(found, key=lambda chosen: found[chosen])
                centre = places[best[attempt // 2 % len(best)]]
                least = PLACES_APART_M if attempt % 2 else 0.0
                allowed = np.linalg.norm(places - centre, axis=1) >= least
            chosen = self._rounded(share, allowed)
            if chosen is None:
                continue
            chosen, loss = self._exchanged(chosen, allowed, over)
            found[tuple(sorted(chosen))] = loss
            if len(found) == count or over():
                break
        return sorted(Choice(loss, tuple(self._pool[k] for k in chosen))
                      for chosen, loss in found.items())

    def _rounded(self, share: np.ndarray, allowed: np.ndarray) -> list[int] | None:
        """Return a choice of the allowed poses with the largest shares; None if there is none."""
        chosen: list[int] = []
        left = self.counts.copy()
        for k in np.argsort(-share, kind='stable'):
            if allowed[k] and left[self._group[k]] and not self._near[k, chosen].any():
                chosen.append(int(k))
                left[self._group[k]] -= 1
        return None if left.any() else chosen

    def _exchanged(self, chosen: list[int], allowed: np.ndarray, over: Callable[[], bool]
                   ) -> tuple[list[int], float]:
        """Make the best exchange of one pose until none helps; return the choice and its loss."""
        loss = np.inf
        while True:
            best = (loss * (1.0 - EQUAL_LOSS), None, None)
            for number, own in enumerate(chosen):
                others = chosen[:number] + chosen[number + 1:]
                share = np.zeros(len(self._pool))
                share[others] = 1.0
                consts, gains = self.trees.cut(self._seen_by, len(share),
                                               self.trees.unserved(self._seen_by, share))
                losses = np.maximum(consts[:, None] - gains, 0.0).sum(axis=0)
                good = (self._group == self._group[own]) & ~self._near[others].any(axis=0)
                good[others] = False
                losses[~(good & allowed)] = np.inf
                if losses.min() < best[0]:
                    best = (float(losses.min()), number, int(np.argmin(losses)))
            if best[1] is None:
                return chosen, loss
            loss = best[0]
            chosen[best[1]] = best[2]
            if over():
                return chosen, loss
