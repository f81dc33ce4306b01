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

A linear program chooses among some hundred poses of the grids, its *columns*. Its loss is bounded
from below by Benders cuts, which are linear (:mod:`ocp_ros.search.proof.loss_trees`). They are
computed at points between its optima and a core point, an interior point of the relaxation, and at
an optimum itself once its loss seems to be exact (Ben-Ameur and Neto 2007). The multipliers of the
cuts give the gains of all poses of the grids. The gains prove a bound that holds for every choice
of these poses (a Lagrangian bound), and the poses with the largest gains become columns, until no
pose would improve the choice, or the bound could rise by little of what is left open.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, groupby
from typing import NamedTuple

import numpy as np
from ocp_ros.search.pose_grid import PoseGrid
from ocp_ros.search.proof.cut_program import CutProgram, Optimum
from ocp_ros.search.proof.loss_trees import LossTrees, poses_by_point, ZERO_TOLERANCE
from ocp_ros.util.threads import mapped
from scipy.spatial.distance import cdist


@dataclass(frozen=True)
class ColumnTuning:
    """
    Constants of column generation.

    :ivar first_columns: number of poses of each grid that are columns at first.
    :ivar new_columns: largest number of poses that become columns at a time.
    :ivar new_columns_per_place: largest number of these at one place.
    :ivar dropped_gain_share: a column is dropped if it gains less than this share of the gain of a
        chosen pose.
    :ivar first_tolerance: largest difference between the optimum of the first program and its
        loss, as a share of the loss.
    :ivar later_tolerance: the same for the later programs.
    :ivar open_tolerance: nothing is computed more exactly than this share of the difference of the
        least known loss and the relaxed one: for a bound on all places, and for choices at some.
    :ivar core_step: share of the way to the optimum by which the core point moves.
    :ivar old_core: share of the last core point in the first one of the next program.
    :ivar max_rounds: largest number of optima of a program.
    :ivar max_programs: largest number of programs.
    :ivar closed_gap: largest relative difference of bound and optimum of a closed bound.
    :ivar min_loss: smallest loss for relative tolerances: smaller losses are mostly noise and slow
        to prove.
    :ivar negligible_loss: a relaxed loss up to this is not computed more exactly.
    :ivar equal_loss: losses with a relative difference below this are equal.
    :ivar other_place_m: smallest distance of other choices from a place of the best one, metres.
    """

    first_columns: int = 300
    new_columns: int = 150
    new_columns_per_place: int = 3
    dropped_gain_share: float = 0.7
    first_tolerance: float = 0.01
    later_tolerance: float = 0.002
    open_tolerance: tuple[float, float] = (0.1, 0.25)
    core_step: float = 0.3
    old_core: float = 0.8
    max_rounds: int = 16
    max_programs: int = 12
    closed_gap: float = 0.004
    min_loss: float = 0.02
    negligible_loss: float = 1e-3
    equal_loss: float = 1e-6
    other_place_m: float = 0.6


TUNING = ColumnTuning()


class Column(NamedTuple):
    """A pose, given by the numbers of its grid, its place and its heading."""

    grid: int
    place: int
    heading: int


class Choice(NamedTuple):
    """
    A choice of poses.

    :ivar loss: of these poses.
    :ivar columns: the poses, of all grids.
    """

    loss: float
    columns: tuple[Column, ...]


class ColumnGeneration:
    """
    The relaxed choice of poses on grids; places may be added to the grids later.

    Sizes of arrays: T nodes of the trees, n columns, H headings of a place.

    :param trees: of the loss.
    :param grids: one for each camera model.
    :param counts: number of poses to choose from each grid.
    :param spacing: smallest distance of two cameras, metres.
    :param points: N, number of points of the scene.
    :ivar bound: lower bound of the loss of every choice of poses whose gains were computed: all
        poses of the grids, except at places that were added later.
    :ivar closed: whether the bound is the best that the relaxation can give, up to the tolerances.
    :ivar steps: number of optima and of passes over all poses since the bound began to rise.
    :ivar known_loss: least loss of a placement that is known, also off the grids; at first that of
        the whole room without cameras.
    """

    def __init__(self, trees: LossTrees, grids: Sequence[PoseGrid], counts: Sequence[int],
                 spacing: float, points: int) -> None:
        self.trees = trees
        self.grids = grids
        self.counts = np.array(counts)
        self.spacing = spacing
        self._point_count = points
        self.steps = 0
        self.known_loss = 1.0
        #: Columns of the greedy choice, which are always kept; None before the first program.
        self._greedy: list[Column] | None = None
        #: The loss of the shares, which is not below the optimum of the program.
        self._relaxed_loss = np.inf
        #: Whether the last program was solved.
        self._is_solved = False
        #: The last core point: the share of each of its columns.
        self._core: dict[Column, float] = {}
        #: For each choice with active cuts, its unserved nodes, (T / 8,) uint8, packed bits, and
        #: the numbers of the parts whose cuts are active, (S,) int64.
        self._active_cuts: list[tuple[np.ndarray, np.ndarray]] = []
        rng = np.random.default_rng(0)
        columns = []
        for number, grid in enumerate(grids):
            poses = [Column(number, place, heading) for place, angles in enumerate(grid.headings)
                     for heading in range(len(angles))]
            first = rng.choice(len(poses), min(TUNING.first_columns, len(poses)), replace=False)
            columns += [poses[k] for k in first]
        self._set_columns(columns)

    def __len__(self) -> int:
        """Return the number of poses of all grids."""
        return sum(map(len, self.grids))

    @property
    def step(self) -> float:
        """Return the largest distance of a feasible position from the places of its grid."""
        return max(grid.step for grid in self.grids)

    def pose(self, column: Column) -> np.ndarray:
        """Return a pose: (6,) metres, map frame, and radians."""
        return self.grids[column.grid].pose(column.place, column.heading)

    def add_columns(self, columns: Iterable[Column]) -> None:
        """Add poses to the columns of the program, unless they are columns already."""
        known = set(self._columns)
        self._set_columns([*self._columns, *(column for column in columns if column not in known)])

    def _set_columns(self, columns: list[Column]) -> None:
        """Replace the columns; their shares are 0 until the program is solved."""
        self._columns = columns
        self._seen_by = self._poses_by_point(columns)
        #: The loss of choices among the columns, and the merged node of each node.
        self._merged, self._merged_rows = self.trees.merged(self._seen_by)
        self._grid_numbers = np.array([column.grid for column in columns])
        self._positions = np.array([self.pose(column)[:3] for column in columns])
        self._too_near = cdist(self._positions, self._positions) < self.spacing
        self._shares = np.zeros(len(columns))

    def _poses_by_point(self, columns: Sequence[Column]) -> np.ndarray:
        """Return which columns see each point: (N, W) uint64, see :func:`poses_by_point`."""
        visible_points: dict[Column, np.ndarray] = {}
        # All headings of a place together, because its visible points are unpacked.
        for (grid, place), group in groupby(sorted(columns), lambda column: column[:2]):
            members = list(group)
            visible_points.update(zip(members, self.grids[grid].visible_points(
                place, [column.heading for column in members])))
        return poses_by_point([visible_points[column] for column in columns], self._point_count)

    def raise_bound(self, should_stop: Callable[[], bool],
                    places: Sequence[np.ndarray] | None = None) -> None:
        """
        Raise the bound until no pose improves the choice.

        :param should_stop: returns whether to stop earlier.
        :param places: for each grid the numbers of the places for which the bound has to hold;
            None for all places.
        """
        # No loss is below 0.
        self.bound = 0.0
        self.closed = False
        self.steps = 0
        if self._greedy is None:
            self._greedy = self._choose_greedily(should_stop)
            self.add_columns(self._greedy)
        if self._greedy:
            # The programs cannot raise the bound above the loss of the greedy choice.
            shares = np.array([column in self._greedy for column in self._columns], dtype=float)
            greedy_loss = self._merged_loss(shares)
            self.known_loss = min(self.known_loss, greedy_loss)
            if greedy_loss <= TUNING.negligible_loss:
                self._shares, self.closed = shares, True
                return
        self._open_tolerance = TUNING.open_tolerance[places is not None]
        places = [np.arange(len(grid.places)) for grid in self.grids] if places is None else places
        for number in range(TUNING.max_programs):
            # Solve the linear program of the columns.
            optimum, multipliers, constant = self._solve_relaxation(
                TUNING.later_tolerance if number else TUNING.first_tolerance, should_stop)
            # Compute the gains of all poses, and raise the bound by them.
            gains = self._pose_gains(multipliers, places, should_stop)
            if gains is None:
                return
            largest_gain = sum(map(self._largest_gain, gains, self.counts))
            self.bound = max(self.bound, constant - largest_gain)
            # Find new columns. Columns at places without computed gains count with a gain of 0.
            column_gains = np.array([gains[grid][place][heading] if place in gains[grid] else 0.0
                                     for grid, place, heading in self._columns])
            # With n poses to choose from a grid, the n-th largest gain of its columns: only a pose
            # with a larger gain can improve the choice.
            chosen_gains = np.array([
                np.sort(column_gains[self._grid_numbers == grid])[::-1][:count].min(initial=np.inf)
                for grid, count in enumerate(self.counts)])
            new_columns = self._improving_columns(gains, chosen_gains)
            max_gap = self._allowed(TUNING.closed_gap, optimum)
            # The optimum of the first program is too inexact for the gap.
            self.closed = self._is_solved and (
                not new_columns or bool(number and optimum - self.bound <= max_gap)
                or self._relaxed_loss <= TUNING.negligible_loss)
            # After the last program, its shares are needed for choices.
            if self.closed or should_stop() or number == TUNING.max_programs - 1:
                return
            self._set_columns([*self._kept_columns(column_gains, chosen_gains), *new_columns])

    def _choose_greedily(self, should_stop: Callable[[], bool]) -> list[Column]:
        """Choose one pose after the other, each of the largest gain; [] if too few fit."""
        chosen: list[Column] = []
        missing = self.counts.copy()
        places = [np.arange(len(grid.places)) for grid in self.grids]
        while missing.any():
            unserved = self.trees.unserved_nodes(
                self._poses_by_point(chosen), np.ones(len(chosen)))
            gains = self._pose_gains(self.trees.weights * unserved, places, should_stop)
            if gains is None:
                return []
            positions = np.array([self.pose(column)[:3] for column in chosen]).reshape(-1, 3)
            best: tuple[float, Column] | None = None
            for number in np.flatnonzero(missing):
                distances = cdist(self.grids[number].places, positions)
                for place in np.flatnonzero((distances >= self.spacing).all(axis=1)).tolist():
                    heading = int(np.argmax(gains[number][place]))
                    gain = float(gains[number][place][heading])
                    column = Column(int(number), place, heading)
                    # With a spacing of 0, cameras may share a place, but not a pose.
                    if column not in chosen and (best is None or gain > best[0]):
                        best = gain, column
            if best is None:
                return []
            chosen.append(best[1])
            missing[best[1].grid] -= 1
        return chosen

    def _merged_loss(self, choice: np.ndarray) -> float:
        """Return the loss of a choice (n,) of columns, each 0 or 1."""
        unserved = self._merged.unserved_nodes(self._seen_by, choice)
        constants, _ = self._merged.loss_cuts(self._seen_by, len(choice),
                                              self._merged.weights * unserved)
        return float(np.maximum(constants, 0.0).sum())

    def _largest_gain(self, gains: dict[int, np.ndarray], count: int) -> float:
        """Return the largest total gain of ``count`` poses, given the gains (H,) at each place."""
        # With a spacing, there is at most one camera at a place.
        per_place = [best[:1] if self.spacing > 0.0 else best
                     for best in (-np.sort(-values) for values in gains.values())]
        # The zeros stand for missing poses if there are fewer than ``count``.
        return float(np.sort(np.concatenate([*per_place, np.zeros(count)]))[-count:].sum())

    def _allowed(self, tolerance: float, loss: float) -> float:
        """Return the error that matters neither beside a loss nor beside what it leaves open."""
        return max(tolerance * max(loss, TUNING.min_loss),
                   self._open_tolerance * (self.known_loss - loss))

    def _solve_relaxation(self, tolerance: float, should_stop: Callable[[], bool]
                          ) -> tuple[float, np.ndarray, float]:
        """
        Solve the linear program of the columns.

        :param tolerance: largest difference of cuts and loss, as a share of the loss.
        :returns: its optimum, the multipliers (T,) of all nodes, and the constant of the
            Lagrangian bound, which is its value without any chosen pose.
        """
        trees = self._merged
        count, nodes = len(self._columns), len(trees.weights)
        program = CutProgram(self._grid_numbers, self.counts, len(trees.slacks))
        # The first core point has equal shares for all columns of a grid, the others more of the
        # old one.
        core = (self.counts / np.bincount(self._grid_numbers))[self._grid_numbers]
        if self._core:
            old = np.array([self._core.get(column, 0.0) for column in self._columns])
            totals = np.bincount(self._grid_numbers, old)
            old *= (self.counts / totals)[self._grid_numbers]
            core += TUNING.old_core * (old - core)
        # Start from the active cuts of the last program; the first program starts from cuts at the
        # core point. The program numbers these cuts from 0, and goes on with the new ones.
        old_cuts = self._active_cuts
        for number, (bits, parts) in enumerate(old_cuts):
            unserved = np.unpackbits(bits, count=len(self._merged_rows))
            weights = np.bincount(self._merged_rows, self.trees.weights * unserved, nodes)
            program.add_cuts(number, *trees.loss_cuts(self._seen_by, count, weights), parts)
        # The unserved merged nodes of the new cuts, as packed bits.
        new_cuts: list[np.ndarray] = []

        def add_cuts(shares: np.ndarray, solution: Optimum | None) -> float:
            """Add the cuts at a choice; return their loss at the solution."""
            unserved = trees.unserved_nodes(self._seen_by, shares)
            constants, gains = trees.loss_cuts(self._seen_by, count, trees.weights * unserved)
            losses, raised = np.zeros(len(constants)), slice(None)
            if solution is not None:
                losses = np.maximum(constants - gains @ solution.shares, 0.0)
                # Only cuts above the program's losses are added; equal losses differ by rounding.
                raised = losses > solution.losses + TUNING.equal_loss * losses.sum() / len(losses)
            program.add_cuts(len(old_cuts) + len(new_cuts), constants, gains, raised)
            new_cuts.append(np.packbits(unserved))
            return float(losses.sum())

        if not old_cuts:
            add_cuts(core, None)
        # Add cuts at the optima until the program's losses are nearly the real ones.
        for _ in range(TUNING.max_rounds):
            solution = program.solve(should_stop)
            self.steps += 1
            optimum = solution.losses.sum()
            core += TUNING.core_step * (solution.shares - core)
            # The loss at the solution: the largest value of the new cuts there. The cut at the
            # solution itself gives its loss, and is the weaker one until the program is solved.
            loss = 0.0
            for shares in (core, solution.shares):
                loss = max(loss, add_cuts(shares, solution))
                converged = (loss - optimum <= self._allowed(tolerance, loss)
                             or loss <= TUNING.negligible_loss)
                if not converged:
                    break
            if converged or not solution.optimal or should_stop():
                break

        def nodes_of(number: int) -> np.ndarray:
            """Return the unserved nodes of a cut of all trees: (T,) bool."""
            if number < len(old_cuts):
                return np.unpackbits(old_cuts[number][0], count=len(self._merged_rows)).view(bool)
            return np.unpackbits(new_cuts[number - len(old_cuts)], count=nodes).view(bool)[
                self._merged_rows]

        # Convert the multipliers of the cuts to those of the nodes. Cuts that were added in the
        # last round have no multipliers yet.
        active = np.flatnonzero(solution.multipliers > ZERO_TOLERANCE)
        multipliers = np.zeros(len(self.trees.weights))
        slack = 0.0
        self._active_cuts = []
        for number in np.unique(program.cuts[active, 0]):
            unserved = nodes_of(number)
            parts = program.cuts[rows := active[program.cuts[active, 0] == number], 1]
            # Keep the choices of active cuts, each once.
            self._active_cuts.append((np.packbits(unserved), parts))
            for k, part in zip(rows, parts):
                first, last = self.trees.part_starts[part:part + 2]
                multipliers[first:last] += solution.multipliers[k] * unserved[first:last]
                slack -= solution.multipliers[k] * trees.slacks[part]
        multipliers *= self.trees.weights
        self._shares, self._relaxed_loss = solution.shares, loss
        self._is_solved = solution.optimal
        if not solution.optimal:
            self._active_cuts = old_cuts
        self._core = dict(zip(self._columns, core))
        return float(optimum), multipliers, float(multipliers.sum() + slack)

    def _pose_gains(self, multipliers: np.ndarray, places: Sequence[np.ndarray],
                    should_stop: Callable[[], bool]) -> list[dict[int, np.ndarray]] | None:
        """
        Compute the gain of each pose: the sum of the multipliers of the nodes that it serves.

        :param multipliers: (T,) of the nodes of the trees, in units of the loss.
        :param places: for each grid the numbers of the places.
        :returns: for each grid the gains (H,) of the headings by place; None if ``should_stop``
            has ended the computation.
        """
        trees = self.trees.gain_trees(multipliers)
        self.steps += 1

        def batch_gains(grid: PoseGrid, batch: list[int]) -> list[tuple[int, np.ndarray]]:
            if should_stop():
                return []
            ends = np.cumsum([len(grid.headings[place]) for place in batch])
            # The last bits of the last word belong to no pose.
            gains = trees.pose_gains(grid.seen_by(batch))[:ends[-1]]
            return list(zip(batch, np.split(gains, ends[:-1])))

        gains = [dict(chain(*mapped(partial(batch_gains, grid), grid.batch_places(numbers))))
                 for grid, numbers in zip(self.grids, places)]
        return None if should_stop() else gains

    def _improving_columns(self, gains: Sequence[dict[int, np.ndarray]], chosen_gains: np.ndarray
                           ) -> list[Column]:
        """Return poses with larger gains than chosen columns of their grid, a few per place."""
        known = set(self._columns)
        improving: list[tuple[float, Column]] = []
        for number, grid_gains in enumerate(gains):
            # Rounding must not make a pose seem better.
            min_gain = chosen_gains[number] * (1.0 + TUNING.equal_loss) + ZERO_TOLERANCE
            for place, values in grid_gains.items():
                # Some of the best may be columns already, so twice as many are looked at.
                best = np.argsort(-values, kind='stable')[:2 * TUNING.new_columns_per_place]
                pairs = [(values[k], Column(number, place, int(k))) for k in best
                         if values[k] > min_gain]
                pairs = [pair for pair in pairs if pair[1] not in known]
                improving += pairs[:TUNING.new_columns_per_place]
        improving.sort(key=lambda pair: -pair[0])
        return [column for _, column in improving[:TUNING.new_columns]]

    def _kept_columns(self, column_gains: np.ndarray, chosen_gains: np.ndarray) -> list[Column]:
        """
        Return the columns to keep: those with a share, and those with large gains.

        :param column_gains: (n,) gain of each column.
        :param chosen_gains: for each grid, the gain of a chosen pose, see :meth:`raise_bound`.
        """
        kept = (self._shares > ZERO_TOLERANCE) | (
            column_gains >= TUNING.dropped_gain_share * chosen_gains[self._grid_numbers])
        # Keep enough columns of each grid for a choice and its exchanges.
        for grid, count in enumerate(self.counts):
            rows = np.flatnonzero(self._grid_numbers == grid)
            kept[rows[np.argsort(-column_gains[rows], kind='stable')[:2 * count]]] = True
        kept |= [column in self._greedy for column in self._columns]
        return [column for column, keep in zip(self._columns, kept) if keep]

    def find_choices(self, count: int, rng: np.random.Generator, should_stop: Callable[[], bool]
                     ) -> list[Choice]:
        """
        Return the greedy choice and rounded shares of the program, improved by exchanges.

        An exchange replaces one pose. After the first choice, every second attempt to round
        excludes the poses near a place of the best choice.

        :param count: largest number of different choices.
        :param rng: the shares are multiplied by random numbers, except at the first attempt.
        :param should_stop: returns whether to return the choices so far.
        :returns: the best first; [] if the spacing leaves too few places.
        """
        losses: dict[tuple[int, ...], float] = {}
        allowed = np.ones(len(self._shares), dtype=bool)
        if self._greedy:
            chosen = [self._columns.index(column) for column in self._greedy]
            loss = self._exchange_poses(chosen, allowed, should_stop)
            losses[tuple(sorted(chosen))] = loss
        for attempt in range(2 * count):
            shares = self._shares * (rng.exponential(size=len(self._shares)) if attempt else 1.0)
            if losses:
                best = min(losses, key=lambda rows: losses[rows])
                # Odd attempts exclude the surroundings of the places of the best choice in turn.
                centre = self._positions[best[(attempt // 2) % len(best)]]
                min_distance = TUNING.other_place_m if attempt % 2 else 0.0
                allowed = np.linalg.norm(self._positions - centre, axis=1) >= min_distance
            chosen = self._round_shares(shares, allowed)
            if chosen is None:
                continue
            # This replaces poses in ``chosen``.
            loss = self._exchange_poses(chosen, allowed, should_stop)
            losses[tuple(sorted(chosen))] = loss
            if len(losses) > count or should_stop():
                break
        self.known_loss = min([self.known_loss, *losses.values()])
        return sorted(Choice(loss, tuple(self._columns[k] for k in rows))
                      for rows, loss in losses.items())[:count]

    def _round_shares(self, shares: np.ndarray, allowed: np.ndarray) -> list[int] | None:
        """Choose allowed columns, (n,) bool, with the largest shares (n,); None if too few fit."""
        chosen: list[int] = []
        missing = self.counts.copy()
        for k in np.argsort(-shares, kind='stable'):
            grid = self._grid_numbers[k]
            if allowed[k] and missing[grid] and not self._too_near[k, chosen].any():
                chosen.append(int(k))
                missing[grid] -= 1
        return None if missing.any() else chosen

    def _exchange_poses(self, chosen: list[int], allowed: np.ndarray,
                        should_stop: Callable[[], bool]) -> float:
        """Replace in ``chosen`` one column at a time while this helps; return the last loss."""
        # The first exchange helps in any case, also of a column for itself.
        loss, number, unchanged = np.inf, 0, 0
        while unchanged < len(chosen):
            others = chosen[:number] + chosen[number + 1:]
            shares = np.zeros(len(self._columns))
            shares[others] = 1.0
            # The cuts at the other poses give the exact loss after adding any one column.
            unserved = self._merged.unserved_nodes(self._seen_by, shares)
            constants, gains = self._merged.loss_cuts(
                self._seen_by, len(shares), self._merged.weights * unserved)
            losses = np.maximum(constants[:, None] - gains, 0.0).sum(axis=0)
            # The new column is one of the same grid, far enough from the others.
            feasible = allowed & (self._grid_numbers == self._grid_numbers[chosen[number]])
            feasible &= ~self._too_near[others].any(axis=0)
            feasible[others] = False
            losses[~feasible] = np.inf
            unchanged += 1
            if losses.min() < loss * (1.0 - TUNING.equal_loss):
                best = int(np.argmin(losses))
                loss, unchanged, chosen[number] = float(losses[best]), 1, best
            number = (number + 1) % len(chosen)
            if should_stop():
                break
        return loss
