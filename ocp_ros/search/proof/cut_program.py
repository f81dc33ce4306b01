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

import highspy
import numpy as np

#: Steps of the simplex method between two checks of the time, and largest number of such blocks:
#: degenerate programs may cycle.
ITERATIONS, LOOKS = 300, 20


class Optimum(NamedTuple):
    """
    Solution of the linear program.

    :ivar optimal: whether it was solved to the optimum; the multipliers are valid in any case.
    :ivar losses: (B,) of the parts.
    :ivar share: (n,) from 0 to 1, the chosen share of each pose.
    :ivar multipliers: (R,) of the cuts, at least 0; the sum over a part's cuts is at most 1.
    """

    optimal: bool
    losses: np.ndarray
    share: np.ndarray
    multipliers: np.ndarray


class CutProgram:
    """
    Minimise the sum of the losses of the parts, none below 0, over choices of poses.

    :param group: (n,) int64, the group of each pose: a group has the poses of one camera model.
    :param counts: (G,) number of poses to choose from each group.
    :param parts: B, number of parts of the loss.
    :ivar cuts: (R, 2) int64: the number of each cut, given by the caller, and its part.
    """

    def __init__(self, group: np.ndarray, counts: np.ndarray, parts: int) -> None:
        self._parts, self._groups = parts, len(counts)
        self.cuts = np.empty((0, 2), dtype=np.int64)
        self._solver = highspy.Highs()
        for name, value in (('output_flag', False), ('threads', 1),
                            ('simplex_iteration_limit', ITERATIONS)):
            self._solver.setOptionValue(name, value)
        members = group == np.arange(len(counts))[:, None]
        program = highspy.HighsLp()
        program.num_col_, program.num_row_ = parts + len(group), len(counts)
        program.col_cost_ = np.repeat([1.0, 0.0], [parts, len(group)])
        program.col_lower_ = np.zeros(parts + len(group))
        program.col_upper_ = np.repeat([highspy.kHighsInf, 1.0], [parts, len(group)])
        program.row_lower_ = program.row_upper_ = np.asarray(counts, dtype=np.float64)
        program.a_matrix_.format_ = highspy.MatrixFormat.kRowwise
        program.a_matrix_.start_ = np.append(0, np.cumsum(members.sum(axis=1))).astype(np.int32)
        program.a_matrix_.index_ = (np.nonzero(members)[1] + parts).astype(np.int32)
        program.a_matrix_.value_ = np.ones(members.sum())
        self._solver.passModel(program)

    def add(self, number: int, consts: np.ndarray, gains: np.ndarray,
            which: np.ndarray | slice = slice(None)) -> None:
        """
        Add cuts: the loss of part b is at least ``consts[b] - gains[b] @ choice``.

        :param number: for :attr:`cuts`.
        :param consts: (B,).
        :param gains: (B, n).
        :param which: the parts whose cuts are added.
        """
        for part in np.arange(self._parts)[which]:
            used = np.flatnonzero(gains[part])
            index = np.append(part, used + self._parts).astype(np.int32)
            self._solver.addRow(consts[part], highspy.kHighsInf, len(index), index,
                                np.append(1.0, gains[part, used]))
            self.cuts = np.vstack([self.cuts, (number, part)])

    def solve(self, over: Callable[[], bool]) -> Optimum:
        """Solve the program; if ``over`` returns True, return the solution so far."""
        limit = highspy.HighsModelStatus.kIterationLimit
        for _ in range(LOOKS):
            self._solver.run()
            status = self._solver.getModelStatus()
            if status != limit or over():
                break
        solution = self._solver.getSolution()
        values = np.nan_to_num(np.array(solution.col_value))
        duals = np.nan_to_num(np.array(solution.row_dual)[self._groups:])
        multipliers = np.maximum(duals, 0.0)
        parts = self.cuts[:, 1]
        totals = np.bincount(parts, multipliers, self._parts)
        return Optimum(
            status == highspy.HighsModelStatus.kOptimal, values[:self._parts],
            np.clip(values[self._parts:], 0.0, 1.0),
            multipliers / np.maximum(totals, 1.0)[parts])
