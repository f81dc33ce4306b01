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
differences are not negative, so each prefix 1..j of the points has a weight: it is a customer of
the covering problem. In the trees of :class:`~ocp_ros.geometry.depth_error.DepthError` a prefix is
a node: it has the points from the root to the node. A node is *served* by the poses that see at
least one of its points. The requirement of a region is a tree of one node for each of its points.

Lower bound: for all multipliers u between 0 and the weights of the nodes, the loss of every choice
of poses is at least the sum of u minus the gains of the chosen poses. The gain of a pose is the
sum of u over the nodes that this pose serves. The gains of all headings of a place are computed in
one traversal of the trees.

If several cameras have to see a point, k in addition to those in place, each pose serves 1 / k of
a node. This bounds the loss from below, since k poses that see the same point of a node serve all
of it. Links between cameras and regions of air, whose costs are not negative, are left out.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.depth_error import Trees
from ocp_ros.geometry.packed_bits import no_bits, unpack
from ocp_ros.geometry.packed_bits import seen_by as enough_seen
from ocp_ros.simulation.objective import Objective
from ocp_ros.util.kernels import njit
from ocp_ros.util.threads import mapped

#: Shares and gains up to this count as 0.
ZERO_TOLERANCE = 1e-9


class LossTrees(NamedTuple):
    """
    The loss as T nodes of trees, parents before children, in B parts.

    Other sizes of arrays: N points of the scene, counted once more for each requirement, n poses,
    W words of 64 bits.

    :ivar points: (T,) uint32, the last point of each node.
    :ivar ends: (T,) uint32, the first node after the subtree of each node.
    :ivar parents: (T,) int32; -1 at a root.
    :ivar weights: (T,) float64, the loss that each node adds while none of its points is visible.
    :ivar depth: largest number of nodes from a root to a leaf.
    :ivar part_starts: (B + 1,) int64, first node of each part, and T; each part has its own cuts.
    :ivar slacks: (B,) loss of each part that costs nothing: for a region, the share that need not
        be visible.
    :ivar rounding: largest amount by which clamped negative weights raise the loss.
    :ivar needed: number of poses that have to see a point in addition to the cameras in place.
    """

    points: np.ndarray
    ends: np.ndarray
    parents: np.ndarray
    weights: np.ndarray
    depth: int
    part_starts: np.ndarray
    slacks: np.ndarray
    rounding: float
    needed: int = 1

    @classmethod
    def of(cls, objective: Objective) -> 'LossTrees':
        """
        Build the trees of a rig's objective.

        :param objective: the nodes that its fixed cameras serve weigh 0.
        """
        error = objective.simulator.depth_error
        # The arrays of the depth error, then of the requirements of regions.
        point_arrays = [error.trees.point]
        end_arrays = [error.trees.end]
        parents, _ = _parents_and_depth(error.trees.end)
        weight_arrays = [_prefix_weights(error.trees, parents) / (error.pixels * error.worst)]
        # The depth error has about this number of parts, each of whole trees.
        error_parts = 16
        roots = np.flatnonzero(parents < 0)
        nodes = np.arange(1, error_parts) * len(parents) // error_parts
        # Each part but the first begins at a root: the next one after an equal share of the nodes.
        part_roots = roots[np.minimum(np.searchsorted(roots, nodes), len(roots) - 1)]
        starts = sorted({0, *part_roots.tolist()})
        slacks = [0.0] * len(starts)
        # The costs of regions: each point that costs something is a tree of one node.
        for costs, free_cost in objective.point_costs():
            costly = np.flatnonzero(costs)
            starts.append(sum(map(len, weight_arrays)))
            slacks.append(free_cost)
            point_arrays.append(costly.astype(np.uint32))
            end_arrays.append(starts[-1] + 1 + np.arange(len(costly)))
            weight_arrays.append(costs[costly])
        # Negative weights come from rounding, and are set to 0.
        weights = np.concatenate(weight_arrays)
        rounding = -float(weights[weights < 0.0].sum())
        ends = np.concatenate(end_arrays).astype(np.uint32)
        parents, depth = _parents_and_depth(ends)
        trees = cls(np.concatenate(point_arrays), ends, parents, np.maximum(weights, 0.0), depth,
                    np.array([*starts, len(weights)]), np.array(slacks), rounding)
        # The nodes that fixed cameras serve cost nothing. All fixed cameras together are one pose.
        rig, count = objective.rig, len(objective.simulator.scene)
        seen = np.zeros(objective.simulator.row_count, dtype=bool)
        for view in objective.fixed:
            seen |= np.concatenate([unpack(bits, count) for bits in (view.seen, *view.good)])
        seen[:count] = unpack(enough_seen([no_bits(count), *(
            view.seen for view in objective.fixed)], rig.seen_by)[-1], count)
        needed = min([rig.seen_by, *(entry.sight.seen_by for entry in rig.requirements)])
        return trees._replace(
            weights=trees.weights * trees.unserved_nodes(
                seen.astype(np.uint64)[:, None], np.ones(1)),
            needed=max(needed - len(objective.fixed), 1))

    def merged(self, seen_by: np.ndarray) -> tuple['LossTrees', np.ndarray]:
        """
        Merge each node into its parent if the same given poses serve both.

        The loss of every choice of these poses stays the same, with fewer nodes.

        :param seen_by: (N, W) uint64, bits of the poses that see each point.
        :returns: the merged trees, and for each node the number of its merged node: (T,) int32.
        """
        kept, rows = _merge_nodes(self.points, self.ends, seen_by, self.depth)
        count = len(kept)
        # The kept nodes before each node; the last number is for ends behind all nodes.
        ends = np.append(self.ends[kept], self.part_starts).astype(np.uint32)
        starts = np.searchsorted(kept, ends)
        parents, depth = _parents_and_depth(starts[:count].astype(np.uint32))
        return self._replace(
            points=self.points[kept], ends=starts[:count].astype(np.uint32), parents=parents,
            weights=np.bincount(rows, self.weights, count), depth=depth,
            part_starts=starts[count:]), rows

    def unserved_nodes(self, seen_by: np.ndarray, shares: np.ndarray) -> np.ndarray:
        """
        Return the nodes for which the shares of the poses that serve them sum to too little.

        :param seen_by: (N, W) uint64, bits of the poses that see each point.
        :param shares: (n,) from 0 to 1, the chosen share of each pose.
        :returns: (T,) bool.
        """
        padded_shares = np.zeros(64 * seen_by.shape[1])
        padded_shares[:len(shares)] = shares / self.needed
        chosen = np.packbits(padded_shares > ZERO_TOLERANCE, bitorder='little').view(np.uint64)
        unserved = np.zeros(len(self.weights), dtype=bool)

        def mark_part(part: int) -> None:
            _mark_unserved(self.points, self.ends, seen_by, chosen, padded_shares, self.depth,
                           self.part_starts[part], self.part_starts[part + 1], unserved)

        mapped(mark_part, range(len(self.slacks)))
        return unserved

    def loss_cuts(self, seen_by: np.ndarray, count: int, weights: np.ndarray
                  ) -> tuple[np.ndarray, np.ndarray]:
        """
        Linearise the loss of each part at a choice of poses.

        Benders cuts (Cordeau, Furini, Ljubic 2019): for every choice z (n,) the loss of part b is
        at least ``constants[b] - gains[b] @ z``.

        :param seen_by: (N, W) uint64, bits of the poses that see each point.
        :param count: n, number of poses.
        :param weights: (T,) the weights of the :meth:`unserved_nodes` of the choice, and 0 for
            the other nodes; any values from 0 to the weights give a valid cut.
        :returns: constants (B,) and gains (B, n).
        """
        sums = _subtree_sums(self.parents, weights) / self.needed
        gains = np.zeros((len(self.slacks), 64 * seen_by.shape[1]))

        def constant_of(part: int) -> float:
            first, last = self.part_starts[part], self.part_starts[part + 1]
            _add_gains(self.points, self.ends, sums, seen_by, self.depth, first, last, gains[part])
            return weights[first:last].sum() - self.slacks[part]

        return np.array(mapped(constant_of, range(len(self.slacks)))), gains[:, :count]

    def gain_trees(self, multipliers: np.ndarray) -> 'GainTrees':
        """Return the trees that give the gains of poses for multipliers (T,)."""
        sums = _subtree_sums(self.parents, multipliers) / self.needed
        positive = sums > 0.0
        # Nodes without gain are left out. These are the new numbers of the old nodes; the last one
        # is for ends behind all nodes.
        numbers = np.zeros(len(positive) + 1, dtype=np.uint32)
        np.cumsum(positive, dtype=np.uint32, out=numbers[1:])
        return GainTrees(self.points[positive], numbers[self.ends[positive]], sums[positive],
                         self.depth)


class GainTrees(NamedTuple):
    """
    The T nodes with positive multipliers in their subtrees; see :class:`LossTrees`.

    :ivar points: (T,) uint32, the last point of each node.
    :ivar ends: (T,) uint32, the first node after the subtree of each node.
    :ivar sums: (T,) float64, the sum of the multipliers in the subtree of each node.
    :ivar depth: largest number of nodes from a root to a leaf.
    """

    points: np.ndarray
    ends: np.ndarray
    sums: np.ndarray
    depth: int

    def pose_gains(self, seen_by: np.ndarray) -> np.ndarray:
        """Return the gains (64 W,) of poses, given which poses see each point: bits (N, W)."""
        gains = np.zeros(64 * seen_by.shape[1])
        _add_gains(self.points, self.ends, self.sums, seen_by, self.depth, 0, len(self.points),
                   gains)
        return gains


def poses_by_point(visible_points: Sequence[np.ndarray], points: int) -> np.ndarray:
    """
    Return which poses see each point.

    :param visible_points: for each of n poses the numbers of the points that it sees.
    :param points: N, number of points of the scene.
    :returns: (N, W) uint64, bit k of word w for pose 64 w + k.
    """
    seen_by = np.zeros((points, max(-(-len(visible_points) // 64), 1)), dtype=np.uint64)
    for pose, numbers in enumerate(visible_points):
        seen_by[numbers, pose // 64] |= np.uint64(1 << (pose % 64))
    return seen_by


def _prefix_weights(trees: Trees, parents: np.ndarray) -> np.ndarray:
    """Return the loss that each node adds while none of its points is visible: (T,) metres."""
    # The weight of a node is the loss of its pixels if the next point of their lists is the first
    # visible one, minus their loss if its own point is (``gap``). A list that ends at the node has
    # the loss of an empty pixel next (``rest``).
    gaps = trees.gap.astype(np.float64)
    weights = trees.rest.astype(np.float64) - gaps
    has_parent = parents >= 0
    np.add.at(weights, parents[has_parent], gaps[has_parent])
    return weights


@njit(cache=True, nogil=True)
def _parents_and_depth(ends):
    """Return the parent of each node, -1 at a root: (T,) int32, and the depth of the trees."""
    nodes = ends.shape[0]
    parents = np.empty(nodes, dtype=np.int32)
    # The nodes from a root to the current node.
    path = np.empty(nodes, dtype=np.int32)
    depth = max_depth = 0
    for node in range(nodes):
        while depth and ends[path[depth - 1]] <= node:
            depth -= 1
        parents[node] = path[depth - 1] if depth else -1
        path[depth] = node
        depth += 1
        max_depth = max(max_depth, depth)
    return parents, max_depth


@njit(cache=True, nogil=True)
def _merge_nodes(points, ends, seen_by, max_depth):
    """
    Find the nodes of merged trees: the roots, and nodes that more poses serve than their parent.

    :returns: (S,) uint32, these nodes, and for each node the index of its merged node among them:
        (T,) int32.
    """
    words = seen_by.shape[1]
    kept = np.empty(points.shape[0], dtype=np.uint32)
    rows = np.empty(points.shape[0], dtype=np.int32)
    # For the merged node at depth d of the path: its end and its row in entry d, and the poses
    # that serve it in entry d + 1. Entry 0 has no poses.
    path_ends = np.empty(max_depth + 1, dtype=np.int64)
    path_rows = np.empty(max_depth + 1, dtype=np.int32)
    path_poses = np.zeros((max_depth + 1, words), dtype=np.uint64)
    count = depth = 0
    for node in range(points.shape[0]):
        while depth and path_ends[depth - 1] <= node:
            depth -= 1
        new = depth == 0
        for word in range(words):
            path_poses[depth + 1, word] = (path_poses[depth, word]
                                           | seen_by[points[node], word])
            new |= path_poses[depth + 1, word] != path_poses[depth, word]
        if new:
            kept[count] = node
            path_ends[depth], path_rows[depth] = ends[node], count
            depth += 1
            count += 1
        rows[node] = path_rows[depth - 1]
    return kept[:count].copy(), rows


@njit(nogil=True, inline='always')
def _lowest_bit(word):
    """Return the number of the lowest set bit of a word of 64 bits."""
    # Set the bits below the lowest set bit, clear all others, and count the set bits by sums of 2,
    # 4 and 8 neighbouring bits, then of the eight bytes.
    bits = (word & (~word + np.uint64(1))) - np.uint64(1)
    bits -= (bits >> np.uint64(1)) & np.uint64(0x5555555555555555)
    bits = ((bits & np.uint64(0x3333333333333333))
            + ((bits >> np.uint64(2)) & np.uint64(0x3333333333333333)))
    bits = (bits + (bits >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((bits * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit(cache=True, nogil=True)
def _mark_unserved(points, ends, seen_by, chosen, shares, max_depth, first, last, unserved):
    """
    Set ``unserved`` (T,) for the nodes from ``first`` to before ``last``.

    :param chosen: (W,) uint64, bits of the poses with a share.
    :param shares: (64 W,) share of each pose.
    """
    # The shares of the poses that serve a node sum to 1, except for rounding.
    served_share = 1.0 - 1e-9
    words = seen_by.shape[1]
    # For the node at depth d of the path: its end in entry d; in entry d + 1 the poses that serve
    # it, and the sum of their shares. Entry 0 has no poses.
    path_ends = np.empty(max_depth + 1, np.int64)
    path_poses = np.zeros((max_depth + 1, words), dtype=np.uint64)
    path_shares = np.zeros(max_depth + 1)
    depth = 0
    node = first
    while node < last:
        while depth and path_ends[depth - 1] <= node:
            depth -= 1
        share = path_shares[depth]
        for word in range(words):
            parent_poses = path_poses[depth, word]
            new_poses = seen_by[points[node], word] & chosen[word] & ~parent_poses
            path_poses[depth + 1, word] = parent_poses | new_poses
            # Each pass clears the lowest bit.
            while new_poses:
                share += shares[word * 64 + _lowest_bit(new_poses)]
                new_poses &= new_poses - np.uint64(1)
        end = np.int64(ends[node])
        if share >= served_share:
            # The poses that serve a node also serve its whole subtree.
            node = end
            continue
        unserved[node] = True
        path_ends[depth] = end
        path_shares[depth + 1] = share
        depth += 1
        node += 1


@njit(cache=True, nogil=True)
def _subtree_sums(parents, values):
    """Return the sum of the values (T,) in the subtree of each node: (T,)."""
    sums = values.copy()
    # Backwards, children come before their parents.
    for node in range(sums.shape[0] - 1, -1, -1):
        if parents[node] >= 0:
            sums[parents[node]] += sums[node]
    return sums


@njit(cache=True, nogil=True)
def _add_gains(points, ends, sums, seen_by, max_depth, first, last, gains):
    """
    Add to the gain of each pose, (64 W,), the sums at the topmost nodes that it serves.

    The nodes are those from ``first`` to before ``last``.

    :param sums: (T,) sum of the multipliers in the subtree of each node.
    """
    words = seen_by.shape[1]
    # For the node at depth d of the path: its end in entry d, the poses that serve it in entry
    # d + 1. Entry 0 has no poses.
    path_ends = np.empty(max_depth + 1, dtype=np.int64)
    path_poses = np.zeros((max_depth + 1, words), dtype=np.uint64)
    depth = 0
    node = first
    while node < last:
        while depth and path_ends[depth - 1] <= node:
            depth -= 1
        end = np.int64(ends[node])
        if sums[node] <= 0.0:
            node = end
            continue
        for word in range(words):
            parent_poses = path_poses[depth, word]
            new_poses = seen_by[points[node], word] & ~parent_poses
            path_poses[depth + 1, word] = parent_poses | new_poses
            # Each pass clears the lowest bit.
            while new_poses:
                gains[word * 64 + _lowest_bit(new_poses)] += sums[node]
                new_poses &= new_poses - np.uint64(1)
        path_ends[depth] = end
        depth += 1
        node += 1
