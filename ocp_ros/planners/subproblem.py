# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A subproblem of the choice of camera poses: what is chosen, what may be yet, and its cuts."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ocp_ros.planners.covering import Covering, Cut
from ocp_ros.planners.cut_model import Rows, Sides

#: A problem shrinks where fewer than this share of its columns are left.
SHRINKING = 0.7


@dataclass(frozen=True, eq=False)
class ChoiceRules:
    """
    What may be chosen.

    :ivar group: (M,) int64, the group of each candidate: those of one camera model.
    :ivar counts: (G,) int64, how many of each group are chosen.
    :ivar features: (M, F), near for candidates that see alike.
    :ivar near: (M, M) bool, candidates that exclude each other; None where none do.
    """

    group: np.ndarray
    counts: np.ndarray
    features: np.ndarray
    near: np.ndarray | None = None

    def allowed(self, chosen: Sequence[int], group: int) -> np.ndarray:
        """Return the candidates (M,) bool of a group that may be added to some."""
        chosen = np.asarray(chosen, dtype=np.int64)
        good = self.group == group
        good[chosen] = False
        if self.near is not None and len(chosen):
            good &= ~self.near[chosen].any(axis=0)
        return good


@dataclass(frozen=True, eq=False)
class Node:
    """
    A subproblem.

    :ivar covering: of this problem or one above.
    :ivar chosen: candidates that are chosen.
    :ivar free: (n,) candidates that may be, ascending.
    :ivar left: (G,) how many are to be chosen yet.
    :ivar rows: cuts.
    :ivar sides: limits.
    :ivar bound: metres.
    :ivar settled: how many of the chosen ones the covering problem knows of.
    """

    covering: Covering
    chosen: tuple[int, ...]
    free: np.ndarray
    left: np.ndarray
    rows: Rows
    sides: Sides
    bound: float
    settled: int = 0

    def kept(self, keep: np.ndarray) -> 'Node':
        """Return the subproblem with some (n,) of its free candidates alone."""
        return replace(self, free=self.free[keep],
                       sides=self.sides._replace(columns=self.sides.columns[:, keep]),
                       rows=self.rows._replace(gains=self.rows.gains[:, keep]))

    def with_chosen(self, column: int, choice: ChoiceRules) -> 'Node':
        """Return the subproblem in which a free candidate is chosen."""
        candidate = int(self.free[column])
        left = self.left.copy()
        left[choice.group[candidate]] -= 1
        keep = left[choice.group[self.free]] > 0
        keep[column] = False
        if choice.near is not None:
            keep &= ~choice.near[candidate, self.free]
        met = self.sides.columns[:, column]
        keep &= ~self.sides.columns[met & ~self.sides.least].any(axis=0)
        rows = self.rows._replace(consts=self.rows.consts - self.rows.gains[:, column])
        return replace(self, chosen=(*self.chosen, candidate), left=left, rows=rows,
                       sides=self.sides.some(~met)).kept(keep)

    def feasible(self, choice: ChoiceRules) -> bool:
        """Tell whether there are enough free candidates."""
        have = np.bincount(choice.group[self.free], minlength=len(self.left))
        return bool((have >= self.left).all()
                    and self.sides.columns[self.sides.least].any(axis=1).all())

    def columns(self, candidates: Sequence[int]) -> np.ndarray:
        """Return the columns of candidates in the covering problem."""
        return np.searchsorted(self.covering.candidates, candidates)

    def shrunk(self) -> 'Node':
        """Return the subproblem with a covering problem of its own, where that is much smaller."""
        covering, new = self.covering, self.chosen[self.settled:]
        if not new and len(self.free) > SHRINKING * len(covering.candidates):
            return self
        keep = np.isin(covering.candidates, self.free)
        return replace(self, covering=covering.shrunk(keep, self.columns(new)),
                       settled=len(self.chosen))

    def share(self, free: np.ndarray) -> np.ndarray:
        """Return what is chosen of the covering problem's columns, by shares (n,) of the free."""
        share = np.zeros(len(self.covering.candidates))
        share[self.columns(self.free)] = free
        share[self.columns(self.chosen[self.settled:])] = 1.0
        return share

    def cut(self, free: np.ndarray) -> Cut:
        """Linearise the loss at shares (n,) of the free candidates."""
        losses, consts, gains = self.covering.cut(self.share(free))
        consts -= np.take(gains, self.columns(self.chosen[self.settled:]), axis=1).sum(axis=1)
        return Cut(losses, consts, np.take(gains, self.columns(self.free), axis=1))


def rows_of(cut: Cut, some: np.ndarray | slice = slice(None)) -> Rows:
    """Return the cuts of all or some blocks."""
    return Rows(np.arange(len(cut.consts))[some], cut.consts[some], cut.gains[some])
