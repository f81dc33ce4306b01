# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Branch and Benders cut for the choice of camera poses among candidates.

The loss of a choice is bounded from below by cuts (Cordeau, Furini and Ljubic, 2019) at optima of
the linear program, and half way from them to a core point. What duals prove excludes candidates
and chooses others for good; the covering problem then shrinks. The search is best first, and
children inherit all cuts.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
import heapq
import itertools
import time

import numpy as np

from ocp_ros.planners.covering import Covering
from ocp_ros.planners.cut_model import CutModel, Rows, Sides, Solution
from ocp_ros.planners.subproblem import ChoiceRules, Node, rows_of

#: Metres, relative to the loss: placements that differ by less are equally good.
EQUAL = 1e-6
#: Share of the gap by which the loss at the program's optimum may be above it, and the share that
#: cuts of some rounds have to close, so that a node goes on with cuts: with up to so many cameras
#: to choose, and with more, of which branching says little.
HASTY, PATIENT, FEW = (0.7, 0.3, 2), (0.05, 0.05, 4), 4
#: Share of the columns that has to be excluded for a problem to be looked at anew.
REDUCING = 0.1
#: Shares that differ by less from a whole number are whole.
WHOLE = 1e-6
#: Losses up to this multiple of the least are worth exchanges.
PROMISING = 1.02
#: Columns that are tried before one is branched on.
TRIED = 8
#: Placements that exchanges begin from, beside the greedy one.
STARTS = 8


@dataclass(frozen=True)
class Proof:
    """
    The best choice that was found and what was proved.

    :ivar chosen: candidates, those of one group after the other; () where none was found.
    :ivar loss: of the choice, metres.
    :ivar bound: metres: no choice loses less.
    :ivar proved: whether none is better than this or than what was known.
    :ivar seconds: how long it took.
    :ivar nodes: subproblems that were looked into.
    """

    chosen: tuple[int, ...]
    loss: float
    bound: float
    proved: bool
    seconds: float
    nodes: int


class Benders:
    """
    One search.

    :param covering: of all candidates; column k is candidate k.
    :param choice: what may be chosen.
    :param over: tells whether there is no time left.
    :param most: nodes to look into at most.
    :param known: metres; what loses as much or more need not be found.
    :param progress: called with bound and loss, metres, after each node.
    """

    def __init__(self, covering: Covering, choice: ChoiceRules,
                 over: Callable[[], bool] = lambda: False, most: int | None = None,
                 known: float = np.inf,
                 progress: Callable[[float, float], None] = lambda bound, loss: None) -> None:
        self.covering, self.choice, self.over, self.most = covering, choice, over, most
        self.known, self.best = known, ()
        self.loss, self.nodes = np.inf, 0
        self._progress, self._offered = progress, set()

    def run(self, starts: Sequence[Sequence[int]] = (), more: int = STARTS) -> Proof:
        """
        Find the best choice.

        :param starts: choices to begin with, where there are some.
        :param more: choices drawn by chance to begin with.
        """
        began = time.monotonic()
        self._begin(starts, more)
        order, root = itertools.count(), self._root()
        heap = [(root.bound, next(order), root)] if root.feasible(self.choice) else []
        while heap and heap[0][0] < self._enough and not self.over() and self.nodes != self.most:
            node = heapq.heappop(heap)[2]
            self.nodes += 1
            for child in self._explored(node):
                if child.bound < self._enough and child.feasible(self.choice):
                    heapq.heappush(heap, (child.bound, next(order), child))
            self._progress(min([self.loss, *(entry[0] for entry in heap[:1])]), self.loss)
        bound = min([self._enough, *(entry[0] for entry in heap)])
        return Proof(self.best, self.loss, max(bound - self.covering.rounding, 0.0),
                     bool(bound >= self._enough), time.monotonic() - began, self.nodes)

    @property
    def _enough(self) -> float:
        """Return the bound from which on a node holds nothing better than what was found."""
        return min(self.loss, self.known) * (1.0 - EQUAL)

    def _root(self) -> Node:
        """Return the whole problem, with a cut at what was found and one in the middle."""
        count = len(self.covering.candidates)
        node = Node(self.covering, (), np.arange(count), self.choice.counts.copy(),
                    Rows.none(count), Sides.none(count),
                    float(self.covering.constants.sum()))
        shares = [self._even(node)]
        if self.best:
            shares.append(self.covering.chosen(self.best))
        for share in shares:
            node = replace(node, rows=node.rows + rows_of(node.cut(share)))
        return node

    def _even(self, node: Node) -> np.ndarray:
        """Return equal shares of all free candidates of each group."""
        groups = self.choice.group[node.free]
        have = np.maximum(np.bincount(groups, minlength=len(node.left)), 1)
        return (node.left / have)[groups]

    def _begin(self, starts: Sequence[Sequence[int]], more: int) -> None:
        """Find choices to compare bounds with."""
        rng = np.random.default_rng(0)
        for start in (*starts, self._filled(())):
            self._offer(tuple(start))
        for _ in range(more):
            if self.over():
                return
            self._offer(self._filled((), rng))

    def _filled(self, chosen: Sequence[int], rng: np.random.Generator | None = None
                ) -> tuple[int, ...]:
        """Complete a choice by what helps most, or by chance; () where there is no room."""
        chosen = list(chosen)
        left = self.choice.counts - np.bincount(self.choice.group[np.array(chosen, dtype=int)],
                                                minlength=len(self.choice.counts))
        for group in np.repeat(np.arange(len(left)), left):
            allowed = np.flatnonzero(self.choice.allowed(chosen, group))
            if len(allowed) == 0:
                return ()
            if rng is not None:
                chosen.append(int(rng.choice(allowed)))
            else:
                gains = self.covering.cut(self.covering.chosen(chosen)).gains.sum(axis=0)
                chosen.append(int(allowed[np.argmax(gains[allowed])]))
        return tuple(chosen)

    def _offer(self, chosen: tuple[int, ...]) -> None:
        """Keep a choice, exchanged for better ones one at a time, if it is the best."""
        if not chosen:
            return
        places = list(chosen)
        loss, exchanged = self.covering.exchanges(places)
        while not self.over():
            for k, candidate in enumerate(places):
                others = places[:k] + places[k + 1:]
                exchanged[k, ~self.choice.allowed(others, self.choice.group[candidate])] = np.inf
            camera, candidate = np.unravel_index(int(np.argmin(exchanged)), exchanged.shape)
            if exchanged[camera, candidate] >= loss * (1.0 - EQUAL):
                break
            places[camera] = int(candidate)
            loss, exchanged = self.covering.exchanges(places)
        if loss < self.loss:
            places.sort(key=lambda candidate: (self.choice.group[candidate], candidate))
            self.best, self.loss = tuple(places), loss

    def _explored(self, node: Node) -> list[Node]:
        """Return the subproblems that are left of one: none where it holds nothing better."""
        while True:
            node = node.shrunk()
            if node.left.sum() <= 1:
                self._completed(node)
                return []
            model = CutModel(self.choice.group[node.free], node.left, node.covering.constants,
                             node.rows, node.sides)
            node, solution, again = self._bounded(node, model)
            if solution is None or node.bound >= self._enough or not node.feasible(self.choice):
                return []
            if again and self.over():
                return [node]
            if not again:
                return self._branched(node, solution)

    def _completed(self, node: Node) -> None:
        """Offer the best choice of a problem in which at most one candidate is to be chosen."""
        losses, _, gains = node.cut(np.zeros(len(node.free)))
        loss, gains = losses.sum(), gains.sum(axis=0)
        good = node.left[self.choice.group[node.free]] > 0
        good &= node.sides.columns[node.sides.least].all(axis=0)
        if node.left.sum() == 0:
            if node.sides.least.any():
                return
            best, last = loss, ()
        elif good.any():
            column = int(np.argmax(np.where(good, gains, -np.inf)))
            best, last = loss - gains[column], (int(node.free[column]),)
        else:
            return
        if best < self._enough:
            self._offer((*node.chosen, *last))

    def _bounded(self, node: Node, model: CutModel) -> tuple[Node, Solution | None, bool]:
        """
        Raise the bound of a subproblem by cuts.

        :returns: the subproblem with them, the last optimum (None where there is no choice), and
            whether it is to be looked into again: it has become smaller, or there is no time.
        """
        core, bounds = self._even(node), []
        converged, stalled, rounds = HASTY if node.left.sum() <= FEW else PATIENT
        while True:
            solution = model.solve()
            if solution is None:
                return node, None, False
            node = replace(node, rows=model.rows, sides=model.sides,
                           bound=max(node.bound, solution.bound))
            if node.bound >= self._enough:
                return node, solution, False
            smaller = self._reduced(node, solution)
            if smaller is not None:
                return smaller, solution, True
            if self.over():
                return node, solution, True
            if not solution.optimal:
                return node, solution, False
            if self._separated(node, model, solution.share):
                continue
            cut = node.cut(solution.share)
            loss, below = cut.losses.sum(), solution.losses.sum()
            whole = np.abs(solution.share - np.round(solution.share)).max() < WHOLE
            gap = min(self._enough, loss) - node.bound
            bounds.append(node.bound)
            if len(bounds) == 1 or whole:
                self._rounded(node, solution.share)
            done = loss - below <= converged * gap
            if len(bounds) > rounds:
                done |= bounds[-1] - bounds[-1 - rounds] <= stalled * gap
            if loss - below <= EQUAL * loss or (done and not whole):
                self._rounded(node, solution.share)
                return replace(node, rows=node.rows.some(solution.active)), solution, False
            core = 0.5 * (core + solution.share)
            model.add(rows_of(cut, cut.losses > solution.losses + EQUAL * loss / len(cut.losses)))
            middle = node.cut(core)
            model.add(rows_of(middle, middle.consts - middle.gains @ solution.share
                              > solution.losses + EQUAL * loss / len(cut.losses)))

    def _reduced(self, node: Node, solution: Solution) -> Node | None:
        """Choose and exclude what the duals prove; None where that changes little."""
        sure = solution.dearer > self._enough - solution.bound
        chosen = node.free[sure & solution.taken]
        excluded = sure & ~solution.taken
        if len(chosen) == 0 and excluded.sum() < REDUCING * len(node.free):
            return None
        node = node.kept(~excluded)
        for candidate in chosen:
            column = np.flatnonzero(node.free == candidate)
            if len(column) == 0:
                return replace(node, bound=np.inf)
            node = node.with_chosen(int(column[0]), self.choice)
        return node

    def _separated(self, node: Node, model: CutModel, share: np.ndarray) -> bool:
        """Add a clique of candidates that exclude each other of which more than one is chosen."""
        if self.choice.near is None:
            return False
        near = self.choice.near[np.ix_(node.free, node.free)]
        order = np.argsort(-share, kind='stable')
        for first in order[share[order] > WHOLE]:
            clique = [first]
            for other in order:
                if near[other, clique].all():
                    clique.append(other)
            if share[clique].sum() > 1.0 + WHOLE:
                columns = np.isin(np.arange(len(share)), clique)
                model.limit(Sides(columns[None], np.array([False])))
                return True
        return False

    def _rounded(self, node: Node, share: np.ndarray) -> None:
        """Offer the choice that is nearest to shares of the free candidates."""
        chosen, left = list(node.chosen), node.left.copy()
        for column in np.argsort(-share, kind='stable'):
            candidate = int(node.free[column])
            group = self.choice.group[candidate]
            if left[group] and self.choice.allowed(chosen, group)[candidate]:
                chosen.append(candidate)
                left[group] -= 1
        if left.any() or tuple(sorted(chosen)) in self._offered:
            return
        self._offered.add(tuple(sorted(chosen)))
        share = np.isin(node.free, chosen).astype(float)
        if node.cut(share).losses.sum() < PROMISING * self.loss:
            self._offer(tuple(chosen))

    def _branched(self, node: Node, solution: Solution) -> list[Node]:
        """Return two subproblems: none of some candidates that are alike, or one at least."""
        model = CutModel(self.choice.group[node.free], node.left, node.covering.constants,
                         node.rows, node.sides)
        loss = solution.losses.sum()
        tried = list(self._clusters(node, solution.share))
        if not tried and not solution.optimal:
            tried = [np.arange(len(node.free)) == 0]
        if not tried:
            return []
        rises = [(model.loss_without(columns) - loss, model.loss_with(columns) - loss)
                 for columns in tried]
        worth = np.prod(np.clip(rises, EQUAL * loss, self._enough - loss), axis=1)
        columns = tried[int(np.argmax(worth))]
        if columns.sum() == 1:
            one = node.with_chosen(int(np.argmax(columns)), self.choice)
        else:
            one = replace(node, sides=node.sides + Sides(columns[None], np.array([True])))
        return [one, node.kept(~columns)]

    def _clusters(self, node: Node, share: np.ndarray) -> Iterator[np.ndarray]:
        """Yield neighbours (n,) bool of some candidates that have about half a share together."""
        features, groups = self.choice.features[node.free], self.choice.group[node.free]
        order = np.argsort(-share, kind='stable')
        for centre in order[(share[order] > WHOLE) & (share[order] < 1.0 - WHOLE)][:TRIED]:
            away = np.linalg.norm(features - features[centre], axis=1)
            away[groups != groups[centre]] = np.inf
            order = np.argsort(away, kind='stable')
            used = order[share[order] > WHOLE]
            sums = np.cumsum(share[used])
            last = int(np.argmin(np.abs(sums - 0.5)))
            if WHOLE < sums[last] < 1.0 - WHOLE:
                end = away[used[last]]
                if last + 1 < len(used) and np.isfinite(away[used[last + 1]]):
                    end = 0.5 * (end + away[used[last + 1]])
                columns = np.zeros(len(share), dtype=bool)
                # Of candidates as far as the last one, those before it alone.
                columns[order[away[order] <= end]] = True
                columns[used[last + 1:]] = False
                yield columns
