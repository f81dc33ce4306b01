# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How much better than a placement any other one on some candidates may be, and the best of them.

What is proved holds for the candidates, for the engine's visibility and for the depth maps that
it was proved with.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.distance import cdist

from ocp_ros.geometry.depth_error import DepthError
from ocp_ros.geometry.packed_bits import count_bits, unpack
from ocp_ros.planners.benders import Benders, Proof
from ocp_ros.planners.candidate_pool import features_of
from ocp_ros.planners.covering import covering_of
from ocp_ros.planners.subproblem import ChoiceRules

#: Rows of depth maps, the best first, and numbers of candidates that are enough and the fewest.
PREFERRED, ENOUGH, FEWEST = (64, 32), 400, 200
#: CandidatePoses by which it is judged how much one sees.
SAMPLE = 64
#: Share of the loss by which a round of nearer candidates has to improve it to be repeated.
IMPROVED = 0.01
#: Subproblems of a round of nearer candidates.
FEW_NODES = 60


@dataclass(frozen=True)
class Certificate:
    """
    What was proved of a placement.

    :ivar candidates: how many poses other placements may choose from.
    :ivar rows: of the depth maps.
    :ivar found: loss of the placement with these maps, without penalties for ``must_see``.
    :ivar bound: no placement on the candidates loses less.
    :ivar proved: whether the search came to its end.
    :ivar seconds: how long it took.
    :ivar nodes: subproblems that were looked into.
    """

    candidates: int
    rows: int
    found: float
    bound: float
    proved: bool
    seconds: float
    nodes: int

    @property
    def gap(self) -> float:
        """Return the share of the loss that others on the candidates may be better by."""
        return max((self.found - self.bound) / self.found, 0.0) if self.found > 0.0 else 0.0

    def of(self, found: float) -> 'Certificate':
        """Return what the same bound says of another placement, by its loss."""
        return replace(self, found=found)


@dataclass(frozen=True, eq=False)
class CandidatePoses:
    """
    Poses to choose from.

    :ivar poses: (M, 3) or (M, 6) metres, map frame, and radians.
    :ivar views: M x (W,) uint64, the packed points that each sees.
    :ivar group: (M,) int64, the group of each: those of one camera model.
    """

    poses: np.ndarray
    views: Sequence[np.ndarray]
    group: np.ndarray

    def __add__(self, other: 'CandidatePoses') -> 'CandidatePoses':
        """Return these and others."""
        return CandidatePoses(np.vstack([self.poses, other.poses]), [*self.views, *other.views],
                              np.append(self.group, other.group))

    def some(self, numbers: Sequence[int]) -> 'CandidatePoses':
        """Return some of them."""
        return CandidatePoses(self.poses[list(numbers)], [self.views[k] for k in numbers],
                              self.group[list(numbers)])


@dataclass(frozen=True, eq=False)
class Question:
    """
    What the best choice is asked for.

    :ivar error: the depth error.
    :ivar points: N, of the scene.
    :ivar counts: (G,) int64, cameras of each group.
    :ivar spacing: least distance of two cameras, metres.
    :ivar fixed: (W,) uint64, what cameras in place see; None where there are none.
    :ivar extra: (N,) metres that each point costs by itself if it is not seen; None for nothing.
    """

    error: DepthError
    points: int
    counts: np.ndarray
    spacing: float = 0.0
    fixed: np.ndarray | None = None
    extra: np.ndarray | None = None

    def loss(self, views: Sequence[np.ndarray]) -> float:
        """Return what is lost where cameras see so much, metres."""
        views = [*views] if self.fixed is None else [*views, self.fixed]
        seen = np.bitwise_or.reduce(views)
        loss = self.error(seen)
        if self.extra is not None:
            loss += float(self.extra[~unpack(seen, self.points)].sum())
        return loss

    def choice(self, candidates: CandidatePoses) -> ChoiceRules:
        """Return what may be chosen of candidates."""
        near = None
        if self.spacing > 0.0:
            near = cdist(candidates.poses[:, :3], candidates.poses[:, :3]) < self.spacing
            np.fill_diagonal(near, False)
        return ChoiceRules(candidates.group, self.counts, features_of(candidates.poses), near)

    def solve(self, candidates: CandidatePoses, over: Callable[[], bool] = lambda: False,
              most: int | None = None, known: float = np.inf,
              starts: Sequence[Sequence[int]] = (), more: int = 0,
              progress: Callable[[float, float], None] = lambda bound, loss: None) -> Proof:
        """
        Find the best choice of candidates, or a bound for all.

        :param over: tells whether there is no time left.
        :param most: subproblems to look into at most.
        :param known: metres; what loses as much or more need not be found.
        :param starts: choices to begin with.
        :param more: choices drawn by chance to begin with.
        :param progress: called with bound and loss, metres, now and then.
        """
        covering = covering_of(self.error.trees, self.error.pixels, self.points, candidates.views,
                               self.fixed, self.extra, over)
        if covering is None:
            return Proof((), np.inf, 0.0, False, 0.0, 0)
        search = Benders(covering, self.choice(candidates), over, most, known, progress)
        return search.run(starts, more)


def size_for(error: DepthError, rows: int, views: Sequence[np.ndarray], points: int,
             largest: float) -> tuple[int, int]:
    """
    Choose rows of depth maps and a number of candidates for a proof in limited time.

    :param error: of maps of so many rows.
    :param views: of all candidates.
    :param points: N, of the scene.
    :param largest: entries of the lists of all customers, about.
    """
    seen = float(np.mean([count_bits(view) for view in views[:SAMPLE]])) / points
    # A prefix is seen by about twice as many candidates as a point; one of three is different.
    each = len(error.trees.point) / 3.0 * min(2.0 * seen, 1.0)
    finest, count = rows, len(views)
    for fewest in (ENOUGH, FEWEST):
        for wanted in PREFERRED:
            rows = min(wanted, finest)
            count = int(min(largest / (each * (rows / finest) ** 2), len(views)))
            if count >= min(fewest, len(views)):
                return rows, count
    return rows, max(count, FEWEST)


def refined(question: Question, found: CandidatePoses,
            drawn: Callable[[CandidatePoses, float], CandidatePoses], steps: tuple[float, float],
            over: Callable[[], bool]) -> tuple[CandidatePoses, CandidatePoses]:
    """
    Improve a choice by the best one among poses near it, ever nearer ones.

    :param found: the choice.
    :param drawn: returns poses near a choice, by so many metres.
    :param steps: the first and the last step, metres.
    :returns: the better choice, and all poses that it was compared with.
    """
    step, last = steps
    loss, tried = question.loss(found.views), found
    while step >= last and not over():
        more = drawn(found, step)
        tried += more
        local = found + more
        proof = question.solve(local, over, FEW_NODES, starts=[range(len(found.poses))])
        if proof.chosen and proof.loss < loss:
            found = local.some(proof.chosen)
        if proof.loss >= loss * (1.0 - IMPROVED):
            step *= 0.5
        loss = min(loss, proof.loss)
    return found, tried
