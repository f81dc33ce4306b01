# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The linear program of a choice: one variable for the loss, cuts from below, counts to keep."""

from typing import NamedTuple

import highspy
import numpy as np

#: Steps of the simplex method; programs that end take some hundred.
ITERATIONS = 3000


class Solution(NamedTuple):
    """
    The optimum of the linear program.

    :ivar optimal: whether it is one; else only the bound counts.
    :ivar losses: (B,) metres, of the blocks.
    :ivar share: (n,) from 0 to 1.
    :ivar active: (R,) bool, the cuts that hold it up.
    :ivar bound: metres, proved from the duals: no choice loses less.
    :ivar dearer: (n,) metres that the bound rises by if a column is turned from what the bound
        takes to the opposite.
    :ivar taken: (n,) bool, the columns that the bound takes.
    """

    optimal: bool
    losses: np.ndarray
    share: np.ndarray
    active: np.ndarray
    bound: float
    dearer: np.ndarray
    taken: np.ndarray


class Rows(NamedTuple):
    """
    Cuts: the loss of a block is at least ``consts - gains @ choice``.

    :ivar block: (R,) int64.
    :ivar consts: (R,) metres.
    :ivar gains: (R, n) metres.
    """

    block: np.ndarray
    consts: np.ndarray
    gains: np.ndarray

    @classmethod
    def none(cls, columns: int) -> 'Rows':
        """Return no cuts for so many columns."""
        return cls(np.empty(0, dtype=np.int64), np.empty(0), np.empty((0, columns)))

    def __add__(self, other: 'Rows') -> 'Rows':
        """Return these and others."""
        return Rows(*(np.concatenate(pair) for pair in zip(self, other)))

    def some(self, keep: np.ndarray) -> 'Rows':
        """Return some of the cuts, (R,) bool."""
        return Rows(*(part[keep] for part in self))


class Sides(NamedTuple):
    """
    Limits of how many of some columns are chosen.

    :ivar columns: (Q, n) bool.
    :ivar least: (Q,) bool: one of them at least, else one at most.
    """

    columns: np.ndarray
    least: np.ndarray

    @classmethod
    def none(cls, columns: int) -> 'Sides':
        """Return no limits for so many columns."""
        return cls(np.empty((0, columns), dtype=bool), np.empty(0, dtype=bool))

    def __add__(self, other: 'Sides') -> 'Sides':
        """Return these and others."""
        return Sides(*(np.concatenate(pair) for pair in zip(self, other)))

    def some(self, keep: np.ndarray) -> 'Sides':
        """Return some of the limits, (Q,) bool."""
        return Sides(*(part[keep] for part in self))


class CutModel:
    """
    Minimise the loss, cut from below, over the choices of so many columns of each group.

    :param group: (n,) int64, the group of each column.
    :param left: (G,) int64, how many of each group are chosen; there are as many columns at least.
    :param least: (B,) metres that each block loses in any case.
    :param rows: the cuts.
    :param sides: further limits.
    """

    def __init__(self, group: np.ndarray, left: np.ndarray, least: np.ndarray, rows: Rows,
                 sides: Sides) -> None:
        self.group, self.left, self.least = group, left, least
        self.rows, self.sides = Rows.none(len(group)), Sides.none(len(group))
        self._kinds = [0] * len(left)
        self._solver = highspy.Highs()
        self._solver.setOptionValue('output_flag', False)
        self._solver.setOptionValue('threads', 1)
        self._solver.setOptionValue('simplex_iteration_limit', ITERATIONS)
        self._solver.passModel(self._program())
        self.add(rows)
        self.limit(sides)

    def _program(self) -> highspy.HighsLp:
        """Return the program without cuts: a column for each block, then those of the choice."""
        blocks, count = len(self.least), len(self.group)
        members = np.array([self.group == g for g in range(len(self.left))])
        program = highspy.HighsLp()
        program.num_col_, program.num_row_ = blocks + count, len(self.left)
        program.col_cost_ = np.repeat([1.0, 0.0], [blocks, count])
        program.col_lower_ = np.append(self.least, np.zeros(count))
        program.col_upper_ = np.repeat([highspy.kHighsInf, 1.0], [blocks, count])
        program.row_lower_ = program.row_upper_ = self.left.astype(float)
        program.a_matrix_.format_ = highspy.MatrixFormat.kRowwise
        program.a_matrix_.start_ = np.append(0, np.cumsum(members.sum(axis=1))).astype(np.int32)
        program.a_matrix_.index_ = (np.nonzero(members)[1] + blocks).astype(np.int32)
        program.a_matrix_.value_ = np.ones(members.sum())
        return program

    def add(self, rows: Rows) -> None:
        """Add cuts."""
        self.rows += rows
        blocks = len(self.least)
        for block, const, gains in zip(*rows):
            used = np.flatnonzero(gains)
            index = np.append(block, used + blocks).astype(np.int32)
            self._solver.addRow(const, highspy.kHighsInf, len(index), index,
                                np.append(1.0, gains[used]))
            self._kinds.append(1)

    def limit(self, sides: Sides) -> None:
        """Add limits."""
        self.sides += sides
        for columns, least in zip(*sides):
            index = (np.flatnonzero(columns) + len(self.least)).astype(np.int32)
            low, high = (1.0, highspy.kHighsInf) if least else (-highspy.kHighsInf, 1.0)
            self._solver.addRow(low, high, len(index), index, np.ones(len(index)))
            self._kinds.append(2)

    def loss_without(self, columns: np.ndarray) -> float:
        """Return the optimum, metres, without some columns (n,) bool; infinite where none is."""
        index = (np.flatnonzero(columns) + len(self.least)).astype(np.int32)
        zeros, ones = np.zeros(len(index)), np.ones(len(index))
        self._solver.changeColsBounds(len(index), index, zeros, zeros)
        loss = self.loss()
        self._solver.changeColsBounds(len(index), index, zeros, ones)
        return loss

    def loss_with(self, columns: np.ndarray) -> float:
        """Return the optimum, metres, with one of some columns (n,) bool at least."""
        index = (np.flatnonzero(columns) + len(self.least)).astype(np.int32)
        self._solver.addRow(1.0, highspy.kHighsInf, len(index), index, np.ones(len(index)))
        loss, row = self.loss(), self._solver.getNumRow() - 1
        self._solver.deleteRows(1, np.array([row], dtype=np.int32))
        return loss

    def loss(self) -> float:
        """
        Return the optimum alone, metres.

        :returns: infinite where there is no choice; minus that where the solver gave up.
        """
        self._solver.run()
        status = self._solver.getModelStatus()
        if status == highspy.HighsModelStatus.kOptimal:
            return self._solver.getInfo().objective_function_value
        return np.inf if status == highspy.HighsModelStatus.kInfeasible else -np.inf

    def solve(self) -> Solution | None:
        """
        Return the optimum and what its duals prove; None where there is no choice.

        Degenerate programs may cycle: then another method has a try. Where that fails as well
        the solution is none, but what is proved holds.
        """
        loss = self.loss()
        for method in ('ipm', 'simplex'):
            if loss == -np.inf:
                self._solver.clearSolver()
                self._solver.setOptionValue('solver', method)
                loss = self.loss()
        self._solver.setOptionValue('solver', 'choose')
        if loss == np.inf:
            return None
        solution, blocks = self._solver.getSolution(), len(self.least)
        values = np.nan_to_num(np.array(solution.col_value))
        duals = np.nan_to_num(np.array(solution.row_dual))
        kinds = np.array(self._kinds)
        cuts = np.maximum(duals[kinds == 1], 0.0)
        return Solution(loss > -np.inf, values[:blocks], np.clip(values[blocks:], 0.0, 1.0),
                        cuts > 0.0,
                        *self._proved(cuts, duals[kinds == 2]))

    def _proved(self, cuts: np.ndarray, sides: np.ndarray
                ) -> tuple[float, np.ndarray, np.ndarray]:
        """
        Bound the loss by a mix of all rows: whatever the multipliers, nothing is below.

        :param cuts: (R,) multipliers, not negative.
        :param sides: (Q,) multipliers, of which those of a wrong sign do not count.
        """
        block, consts, gains = self.rows
        totals = np.bincount(block, cuts, len(self.least))
        cuts = cuts / np.maximum(totals, 1.0)[block]
        rest = 1.0 - np.bincount(block, cuts, len(self.least))
        sides = np.where(self.sides.least, np.maximum(sides, 0.0), np.minimum(sides, 0.0))
        gains = cuts @ gains + sides @ self.sides.columns
        bound = cuts @ consts + np.maximum(rest, 0.0) @ self.least + sides.sum()
        taken, dearer = np.zeros(len(gains), dtype=bool), np.zeros(len(gains))
        for group, count in enumerate(self.left):
            members = np.flatnonzero(self.group == group)
            order = members[np.argsort(-gains[members], kind='stable')]
            taken[order[:count]] = True
            bound -= gains[order[:count]].sum()
            least = gains[order[count - 1]] if count else np.inf
            following = gains[order[count]] if count < len(order) else -np.inf
            dearer[order[:count]] = gains[order[:count]] - following
            dearer[order[count:]] = least - gains[order[count:]]
        return float(bound), dearer, taken
