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
The loss of a rig as a maximal covering problem on trees of points.

The depth of a pixel of the depth maps is that of its first visible point. With its points in order
of distance, its loss is the sum over j of (g_{j+1} - g_j) u_j, where g_j is its loss if point j is
the first visible one, and u_j is 1 if none of the points 1..j is visible, otherwise 0. The
differences are not negative, so each prefix 1..j of a list is a customer with a weight. It is
served by the poses that see at least one of its points. In the trees of
:class:`~ocp_ros.geometry.depth_error.DepthError` a prefix is a node. The requirement of a region
is a tree of one node for each of its points.

Lower bound: for all multipliers u between 0 and the weights of the customers, the loss of every
choice of poses is at least the sum of u minus the gains of the chosen poses. The gain of a pose is
the sum of u over the prefixes that this pose serves. The gains of all headings of a place are
computed in one traversal of the trees.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.packed_bits import no_bits, unpack
from ocp_ros.simulation.objective import Objective
from ocp_ros.util.kernels import njit
from ocp_ros.util.threads import mapped

#: Number of parts of the depth error; each part has its own cuts.
PARTS = 16
#: A customer is served if the shares of its poses add up to at least this.
SERVED = 1.0 - 1e-9
#: Shares below this count as 0.
NOTHING = 1e-9


class LossTrees(NamedTuple):
    """
    Customers as T nodes of trees, parents before children.

    :ivar point: (T,) uint32, the point of a node.
    :ivar end: (T,) uint32, the first node after the subtree of a node.
    :ivar parent: (T,) int32; -1 at a root.
    :ivar weight: (T,) float64, loss if no point from the root to the node is visible, in units of
        the loss.
    :ivar depth: largest number of nodes from a root to a leaf.
    :ivar parts: (B + 1,) int64, first node of each part; each part has its own cuts.
    :ivar slack: (B,) part of the loss that is free of cost: for a region, the share that need not
        be visible.
    :ivar rounding: largest amount by which clamped negative weights raise the loss.
    """

    point: np.ndarray
    end: np.ndarray
    parent: np.ndarray
    weight: np.ndarray
    depth: int
    parts: np.ndarray
    slack: np.ndarray
    rounding: float

    @classmethod
    def of(cls, objective: Objective) -> 'LossTrees':
        """Build the trees of a rig's objective; customers served by fixed cameras weigh 0."""
        error = objective.simulator.depth_error
        point, end = [error.trees.point], [error.trees.end]
        weights = [_prefix_weights(error.trees) / (error.pixels * error.worst)]
        roots = np.flatnonzero(_parents(end[0])[0] < 0)
        wanted = np.arange(1, PARTS) * len(point[0]) // PARTS
        later = roots[np.minimum(np.searchsorted(roots, wanted), len(roots) - 1)]
        starts = sorted({0, *later.tolist()})
        slack = [0.0] * len(starts)
        for costs, free in objective.point_costs():
            some = np.flatnonzero(costs)
            starts.append(sum(map(len, weights)))
            slack.append(free)
            point.append(some.astype(np.uint32))
            end.append(starts[-1] + 1 + np.arange(len(some)))
            weights.append(costs[some])
        weight = np.concatenate(weights)
        rounding = -float(weight[weight < 0.0].sum())
        end = np.concatenate(end).astype(np.uint32)
        parent, depth = _parents(end)
        trees = cls(np.concatenate(point), end, parent, np.maximum(weight, 0.0), depth,
                    np.array([*starts, len(weight)]), np.array(slack), rounding)
        fixed = np.bitwise_or.reduce([no_bits(len(objective.simulator.scene)),
                                      *(view.seen for view in objective.fixed)])
        seen_by = unpack(fixed, len(objective.simulator.scene)).astype(np.uint64)[:, None]
        return trees._replace(weight=trees.weight * trees.unserved(seen_by, np.ones(1)))

    def unserved(self, seen_by: np.ndarray, share: np.ndarray) -> np.ndarray:
        """
        Return which customers are served by less than 1.

        :param seen_by: (N, W) uint64, bits of the poses that see each point.
        :param share: (n,) from 0 to 1, the chosen share of each pose.
        :returns: (T,) bool.
        """
        shares = np.zeros(64 * seen_by.shape[1])
        shares[:len(share)] = share
        chosen = np.packbits(shares > NOTHING, bitorder='little').view(np.uint64)
        found = np.zeros(len(self.weight), dtype=bool)

        def part(number: int) -> None:
            _mark_unserved(self.point, self.end, seen_by, chosen, shares, self.depth,
                           self.parts[number], self.parts[number + 1], found)

        mapped(part, range(len(self.slack)))
        return found

    def cut(self, seen_by: np.ndarray, count: int, unserved: np.ndarray
            ) -> tuple[np.ndarray, np.ndarray]:
        """
        Linearise the loss of each part at a choice, given its unserved customers.

        Benders cuts (Cordeau, Furini, Ljubic 2019): for every choice z (n,) the loss of part b is
        at least ``consts[b] - gains[b] @ z``.

        :param seen_by: (N, W) uint64, bits of the poses that see each point.
        :param count: n, number of poses.
        :param unserved: (T,) bool, from :meth:`unserved`.
        :returns: consts (B,) and gains (B, n).
        """
        weight = np.where(unserved, self.weight, 0.0)
        below = _sums_below(self.parent, weight)
        gains = np.zeros((len(self.slack), 64 * seen_by.shape[1]))

        def part(number: int) -> float:
            first, last = self.parts[number], self.parts[number + 1]
            _add_gains(self.point, self.end, below, seen_by, self.depth, first, last,
                       gains[number])
            return weight[first:last].sum() - self.slack[number]

        return np.array(mapped(part, range(len(self.slack)))), gains[:, :count]

    def priced(self, multipliers: np.ndarray) -> 'PricedTrees':
        """Return the trees that give the gains of poses; multipliers (T,), at most the weights."""
        points, ends, sums = _kept(self.point, self.end, _sums_below(self.parent, multipliers))
        return PricedTrees(points, ends, sums, self.depth)


class PricedTrees(NamedTuple):
    """
    The T nodes with positive multipliers in their subtrees; see :class:`LossTrees`.

    :ivar point: (T,) uint32.
    :ivar end: (T,) uint32.
    :ivar below: (T,) float64, the sum of the multipliers in the subtree of a node.
    :ivar depth: largest number of nodes from a root to a leaf.
    """

    point: np.ndarray
    end: np.ndarray
    below: np.ndarray
    depth: int

    def gains(self, seen_by: np.ndarray) -> np.ndarray:
        """Return the gains (64 W,) of poses from the bits (N, W) of the poses that see a point."""
        gains = np.zeros(64 * seen_by.shape[1])
        _add_gains(self.point, self.end, self.below, seen_by, self.depth, 0, len(self.point),
                   gains)
        return gains


def poses_by_point(sees: Sequence[np.ndarray], points: int) -> np.ndarray:
    """
    Return which poses see each point.

    :param sees: for each of n poses the points that it sees.
    :returns: (points, W) uint64, bit k of word w for pose 64 w + k.
    """
    seen_by = np.zeros((points, max(-(-len(sees) // 64), 1)), dtype=np.uint64)
    for number, some in enumerate(sees):
        seen_by[some, number // 64] |= np.uint64(1 << number % 64)
    return seen_by


@njit(cache=True, nogil=True)
def _prefix_weights(trees):
    """Return the loss if no point from a tree's root to a node is visible: (T,) metres."""
    nodes = trees.point.shape[0]
    weights, path = np.zeros(nodes), np.empty(nodes, dtype=np.uint32)
    depth = 0
    for node in range(nodes):
        while depth and trees.end[path[depth - 1]] <= node:
            depth -= 1
        weights[node] += np.float64(trees.rest[node]) - np.float64(trees.gap[node])
        if depth:
            weights[path[depth - 1]] += np.float64(trees.gap[node])
        path[depth] = node
        depth += 1
    return weights


@njit(cache=True, nogil=True)
def _parents(end):
    """Return the parent of each node, -1 at a root: (T,) int32, and the depth of the trees."""
    nodes = end.shape[0]
    parent, path = np.empty(nodes, dtype=np.int32), np.empty(nodes, dtype=np.int32)
    depth = deepest = 0
    for node in range(nodes):
        while depth and end[path[depth - 1]] <= node:
            depth -= 1
        parent[node] = path[depth - 1] if depth else -1
        path[depth] = node
        depth += 1
        deepest = max(deepest, depth)
    return parent, deepest


@njit(nogil=True, inline='always')
def _lowest(word):
    """Return the number of the lowest set bit of a word."""
    bits = (word & (~word + np.uint64(1))) - np.uint64(1)
    bits -= (bits >> np.uint64(1)) & np.uint64(0x5555555555555555)
    bits = ((bits & np.uint64(0x3333333333333333))
            + ((bits >> np.uint64(2)) & np.uint64(0x3333333333333333)))
    bits = (bits + (bits >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((bits * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit(cache=True, nogil=True)
def _mark_unserved(points, ends, seen_by, chosen, shares, deepest, first, last, found):
    """Compute :meth:`LossTrees.unserved` of nodes ``first`` to ``last`` into ``found`` (T,)."""
    words, sums = seen_by.shape[1], np.zeros(deepest + 1)
    path, until = np.zeros((deepest + 1, words), dtype=np.uint64), np.empty(deepest + 1, np.int64)
    depth, node = 0, first
    while node < last:
        while depth and until[depth - 1] <= node:
            depth -= 1
        total = sums[depth]
        for word in range(words):
            before = path[depth, word]
            new = seen_by[points[node], word] & chosen[word] & ~before
            path[depth + 1, word] = before | new
            while new:
                total += shares[word * 64 + _lowest(new)]
                new &= new - np.uint64(1)
        end = np.int64(ends[node])
        if total >= SERVED:
            node = end
            continue
        found[node] = True
        until[depth], sums[depth + 1] = end, total
        depth, node = depth + 1, node + 1


@njit(cache=True, nogil=True)
def _sums_below(parent, values):
    """Return the sum of the values in the subtree of each node: (T,)."""
    sums = values.copy()
    for node in range(sums.shape[0] - 1, -1, -1):
        if parent[node] >= 0:
            sums[parent[node]] += sums[node]
    return sums


@njit(cache=True, nogil=True)
def _kept(points, ends, sums):
    """Remove the nodes whose sums are 0; return points, ends and sums of the other nodes."""
    nodes = points.shape[0]
    before, count = np.empty(nodes + 1, dtype=np.uint32), 0
    for node in range(nodes):
        before[node] = count
        count += sums[node] > 0.0
    before[nodes] = count
    kept = np.flatnonzero(sums > 0.0)
    return points[kept], before[ends[kept]], sums[kept]


@njit(cache=True, nogil=True)
def _add_gains(points, ends, sums, seen_by, deepest, first, last, gains):
    """Add the sums at the topmost nodes whose point a pose sees to its gain: (64 W,)."""
    words, until = seen_by.shape[1], np.empty(deepest + 1, dtype=np.int64)
    path = np.zeros((deepest + 1, words), dtype=np.uint64)
    depth, node = 0, first
    while node < last:
        while depth and until[depth - 1] <= node:
            depth -= 1
        end = np.int64(ends[node])
        if sums[node] <= 0.0:
            node = end
            continue
        for word in range(words):
            before = path[depth, word]
            new = seen_by[points[node], word] & ~before
            path[depth + 1, word] = before | new
            while new:
                gains[word * 64 + _lowest(new)] += sums[node]
                new &= new - np.uint64(1)
        until[depth] = end
        depth, node = depth + 1, node + 1
