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

"""The linear program that chooses poses: a variable for each part of the loss, with cuts."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from ocp_ros.util.settings import need

#: Solutions in a row at which a cut is not binding before it is left out, and the least number of
#: cuts that are left out at a time.
SLACK_SOLUTIONS, LEFT_OUT_TOGETHER = 8, 16
#: Iterations of a run, largest number of runs, and the run that starts anew by interior points.
RUN_ITERATIONS, MAX_RUNS, NEW_START_RUN = 300, 20, 4


class Optimum(NamedTuple):
    """
    Solution of the linear program; sizes as in :class:`CutProgram`.

    :ivar optimal: whether it was solved to the optimum; the multipliers are valid in any case.
    :ivar losses: (B,) loss of each part.
    :ivar shares: (n,) from 0 to 1, the chosen share of each pose.
    :ivar multipliers: (R,) dual values of the cuts, at least 0; the sum over a part's cuts is at
        most 1.
    """

    optimal: bool
    losses: np.ndarray
    shares: np.ndarray
    multipliers: np.ndarray


class CutProgram:
    """
    Minimise the sum of the losses of B parts, none below 0, over choices among n poses.

    A cut is a lower bound of the loss of a part, linear in the choice. Cuts that have not been
    binding for some solutions in a row leave the program.

    :param groups: (n,) int64, the group of each pose: a group has the poses of one camera model.
    :param counts: (G,) number of poses to choose from each group.
    :param parts: B.
    :ivar cuts: (R, 2) int64: of each of R cuts, the number from :meth:`add_cuts` and the part.
    """

    def __init__(self, groups: np.ndarray, counts: np.ndarray, parts: int) -> None:
        need('the certificate', 'highspy')
        import highspy
        self._highs = highspy
        self._part_count = parts
        self._group_count = len(counts)
        self.cuts = np.empty((0, 2), dtype=np.int64)
        #: For each cut, the number of solutions in a row at which it was not binding.
        self._slack_for = np.empty(0, dtype=np.int64)
        self._solver = self._highs.Highs()
        # A run ends at a limit, so that ``solve`` can stop between the runs. A run that ends there
        # loses its progress if a presolve has changed the program.
        for name, value in (('output_flag', False), ('threads', 1), ('presolve', 'off'),
                            ('simplex_iteration_limit', RUN_ITERATIONS)):
            self._solver.setOptionValue(name, value)
        members = groups == np.arange(len(counts))[:, None]
        program = self._highs.HighsLp()
        # The variables are the losses of the parts, then the shares of the poses.
        program.num_col_ = parts + len(groups)
        program.num_row_ = len(counts)
        program.col_cost_ = np.repeat([1.0, 0.0], [parts, len(groups)])
        program.col_lower_ = np.zeros(parts + len(groups))
        program.col_upper_ = np.repeat([self._highs.kHighsInf, 1.0], [parts, len(groups)])
        # One row for each group: the shares of its poses add up to its count.
        program.row_lower_ = program.row_upper_ = np.asarray(counts, dtype=np.float64)
        program.a_matrix_.format_ = self._highs.MatrixFormat.kRowwise
        program.a_matrix_.start_ = np.append(0, np.cumsum(members.sum(axis=1))).astype(np.int32)
        program.a_matrix_.index_ = (np.nonzero(members)[1] + parts).astype(np.int32)
        program.a_matrix_.value_ = np.ones(members.sum())
        self._solver.passModel(program)

    def add_cuts(self, number: int, constants: np.ndarray, gains: np.ndarray,
                 selected: np.ndarray | slice = slice(None)) -> None:
        """
        Add cuts: the loss of part b is at least ``constants[b] - gains[b] @ choice``.

        :param number: the caller's number for these cuts, which :attr:`cuts` stores.
        :param constants: (B,) loss of each part if no pose is chosen.
        :param gains: (B, n) its reduction by each pose.
        :param selected: the parts whose cuts are added, (B,) bool or numbers; by default all.
        """
        # Each cut is a row: the loss of the part + gains @ choice >= constant.
        for part in (added := np.arange(self._part_count)[selected]):
            poses = np.flatnonzero(gains[part])
            columns = np.append(part, poses + self._part_count).astype(np.int32)
            self._solver.addRow(constants[part], self._highs.kHighsInf, len(columns), columns,
                                np.append(1.0, gains[part, poses]))
        self.cuts = np.vstack([self.cuts, np.column_stack([np.full_like(added, number), added])])
        self._slack_for = np.append(self._slack_for, np.zeros_like(added))

    def solve(self, should_stop: Callable[[], bool]) -> Optimum:
        """Solve the program; if ``should_stop`` returns True, return the solution so far."""
        # Degenerate programs may cycle: interior points solve those, and start a program.
        for run in range(MAX_RUNS):
            by_points = run == NEW_START_RUN or not self._solver.getBasis().valid
            self._solver.setOptionValue('solver', 'ipm' if by_points else 'simplex')
            self._solver.run()
            status = self._solver.getModelStatus()
            if status != self._highs.HighsModelStatus.kIterationLimit or should_stop():
                break
        solution = self._solver.getSolution()
        values = np.nan_to_num(np.array(solution.col_value))
        # The rows of the groups are before those of the cuts.
        duals = np.nan_to_num(np.array(solution.row_dual)[self._group_count:])
        optimal = status == self._highs.HighsModelStatus.kOptimal
        if optimal:
            duals = duals[self._leave_out_slack_cuts()]
        # Rounding or an early end may make the duals invalid, so they are moved into their limits.
        multipliers = np.maximum(duals, 0.0)
        parts = self.cuts[:, 1]
        totals = np.bincount(parts, multipliers, self._part_count)
        losses, shares = np.split(values, [self._part_count])
        return Optimum(optimal, losses, np.clip(shares, 0.0, 1.0),
                       multipliers / np.maximum(totals, 1.0)[parts])

    def _leave_out_slack_cuts(self) -> np.ndarray:
        """Leave out cuts that have not been binding for long; return which remain: (R,) bool."""
        basis = self._solver.getBasis()
        slack = np.array([status == self._highs.HighsBasisStatus.kBasic
                          for status in basis.row_status[self._group_count:]], dtype=bool)
        self._slack_for = np.where(slack, self._slack_for + 1, 0)
        kept = self._slack_for < SLACK_SOLUTIONS
        if len(kept) - kept.sum() < LEFT_OUT_TOGETHER:
            return np.ones(len(kept), dtype=bool)
        rows = np.append(np.ones(self._group_count, dtype=bool), kept)
        left_out = np.flatnonzero(~rows).astype(np.int32)
        self._solver.deleteRows(len(left_out), left_out)
        # The basis stays one without its slack rows.
        basis.row_status = [status for status, keep in zip(basis.row_status, rows) if keep]
        self._solver.setBasis(basis)
        self.cuts, self._slack_for = self.cuts[kept], self._slack_for[kept]
        return kept
