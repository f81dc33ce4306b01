# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The choice of camera poses among candidates as a maximal covering problem.

A pixel of the depth maps reads its first visible point. With its points in order of distance, it
loses the sum over j of (g_{j+1} - g_j) u_j, where g_j is its loss if point j is the first visible
one, and u_j tells that none of the points 1..j is seen. The differences are not negative, so each
beginning of a list is a customer with a weight, served by the candidates that see any of its
points. Customers that the same candidates serve are one.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ocp_ros.geometry.depth_error import Trees
from ocp_ros.geometry.packed_bits import unpack
from ocp_ros.util.kernels import njit

#: Seed of the keys by which customers are compared.
KEYS = 7
#: Blocks of customers with cuts of their own.
BLOCKS = 32
#: Customers whose candidates add up to at least this are served.
SERVED = 1.0 - 1e-9


class Covering(NamedTuple):
    """
    Customers and who serves them; the loss is the weight of those that nobody chosen serves.

    :ivar weights: (C,) float64, metres.
    :ivar starts: (C + 1,) int64, where the list of each customer begins.
    :ivar who: (L,) uint16, the columns that serve each customer, ascending.
    :ivar blocks: (B + 1,) int64, where each block of customers begins; each has cuts of its own.
    :ivar candidates: (n,) int64, the candidate of each column.
    :ivar constants: (B,) metres that each block loses whatever is chosen.
    :ivar rounding: metres by which rounded weights may have raised the loss.
    """

    weights: np.ndarray
    starts: np.ndarray
    who: np.ndarray
    blocks: np.ndarray
    candidates: np.ndarray
    constants: np.ndarray
    rounding: float

    def cut(self, share: np.ndarray) -> 'Cut':
        """
        Linearise the loss of each block at a choice (Cordeau, Furini, Ljubic 2019).

        :param share: (n,) from 0 to 1, how much of each column is chosen.
        """
        losses, consts, gains = _linearised(
            self.weights, self.starts, self.who, self.blocks, share)
        return Cut(losses + self.constants, consts + self.constants, gains)

    def loss(self, columns: Sequence[int]) -> float:
        """Return what is lost where some columns are chosen, metres."""
        return float(self.cut(self.chosen(columns)).losses.sum())

    def chosen(self, columns: Sequence[int]) -> np.ndarray:
        """Return the choice (n,) of some columns."""
        share = np.zeros(len(self.candidates))
        share[np.asarray(columns, dtype=np.int64)] = 1.0
        return share

    def exchanges(self, columns: Sequence[int]) -> tuple[float, np.ndarray]:
        """
        Return the loss of some columns, and of each exchange of one of them: (K, n), metres.

        Columns that are chosen already are as good as none.
        """
        number = np.full(len(self.candidates), -1, dtype=np.int64)
        number[np.asarray(columns, dtype=np.int64)] = np.arange(len(columns))
        unserved, alone, gains, added = _exchanged(
            self.weights, self.starts, self.who, number, len(columns))
        loss = float(self.constants.sum()) + unserved
        return loss, loss + alone[:, None] - gains - added

    def shrunk(self, keep: np.ndarray, chosen: Sequence[int]) -> 'Covering':
        """
        Leave out columns and who the chosen ones serve, and merge customers again.

        :param keep: (n,) bool, columns that may still be chosen.
        :param chosen: columns that are chosen for good.
        """
        new = np.where(keep, np.cumsum(keep) - 1, -1)
        new[np.asarray(chosen, dtype=np.int64)] = -2
        count = int(keep.sum())
        keys = np.random.default_rng(KEYS).integers(1, 2 ** 63, count, dtype=np.uint64)
        weights, starts, who, blocks, missed = _merged(
            self.weights, self.starts, self.who, self.blocks, new, keys, count)
        return Covering(weights, starts, who, blocks, self.candidates[keep],
                        self.constants + missed, self.rounding)


class Cut(NamedTuple):
    """
    What holds for every choice z: block b loses at least ``consts[b] - gains[b] @ z``.

    :ivar losses: (B,) metres, of the choice at which that was computed.
    :ivar consts: (B,) metres.
    :ivar gains: (B, n) metres.
    """

    losses: np.ndarray
    consts: np.ndarray
    gains: np.ndarray


@njit(cache=True, nogil=True)
def _linearised(weights, starts, who, blocks, share):
    """Return the fields of :class:`Cut`, without what is lost whatever is chosen."""
    count = blocks.shape[0] - 1
    losses, consts, gains = np.empty(count), np.empty(count), np.zeros((count, share.shape[0]))
    for block in range(count):
        loss = missed = 0.0
        for customer in range(blocks[block], blocks[block + 1]):
            served = 0.0
            for k in range(starts[customer], starts[customer + 1]):
                served += share[who[k]]
                if served >= SERVED:
                    break
            if served < SERVED:
                weight = weights[customer]
                loss += weight * (1.0 - served)
                missed += weight
                for k in range(starts[customer], starts[customer + 1]):
                    gains[block, who[k]] += weight
        losses[block], consts[block] = loss, missed
    return losses, consts, gains


@njit(cache=True, nogil=True)
def _exchanged(weights, starts, who, number, count):
    """
    Add up what each chosen column serves alone, and what others would gain.

    :param number: (n,) int64, which of the chosen ones a column is, or -1.
    :param count: K, how many are chosen.
    :returns: the weight that none serves; (K,) weight that one chosen column alone serves; (K, n)
        of that weight, what each column serves; and (n,) what each column serves of the weight
        that none serves.
    """
    loss, alone, added = 0.0, np.zeros(count), np.zeros(number.shape[0])
    gains = np.zeros((count, number.shape[0]))
    for customer in range(weights.shape[0]):
        serving, last = 0, -1
        for k in range(starts[customer], starts[customer + 1]):
            if number[who[k]] >= 0:
                serving, last = serving + 1, number[who[k]]
                if serving > 1:
                    break
        weight = weights[customer]
        if serving == 0:
            loss += weight
            for k in range(starts[customer], starts[customer + 1]):
                added[who[k]] += weight
        elif serving == 1:
            alone[last] += weight
            for k in range(starts[customer], starts[customer + 1]):
                gains[last, who[k]] += weight
    return loss, alone, gains, added


@njit(cache=True, nogil=True)
def _hash_table(entries):
    """Return an empty hash table for so many entries: a power of two of slots, -1 each."""
    size = 16
    while size < 2 * entries:
        size *= 2
    return np.full(size, -1, dtype=np.int32)


@njit(cache=True, nogil=True)
def _same(one, other):
    """Return whether two lists of numbers are the same."""
    count, alike = one.shape[0], 0
    if count != other.shape[0]:
        return False
    while alike < count and one[alike] == other[alike]:
        alike += 1
    return alike == count


@njit(cache=True, nogil=True)
def _merged(weights, starts, who, blocks, new, keys, count):
    """
    Write the customers that are left, those of a block with the same columns once.

    :param new: (n,) int64, the new number of each column, -1 to leave it out, -2 if chosen.
    :param keys: (count,) uint64.
    :param count: columns that are left.
    :returns: weights, starts, who and blocks of :class:`Covering`, and the weight (B,) that
        nobody serves.
    """
    customers = weights.shape[0]
    table = _hash_table(customers)
    hashes = np.empty(customers, dtype=np.uint64)
    merged, begins = np.empty(customers), np.zeros(customers + 1, dtype=np.int64)
    kept = np.empty(who.shape[0], dtype=np.uint16)
    total, missed = 0, np.zeros(blocks.shape[0] - 1)
    block, bounds = 0, np.zeros(blocks.shape[0], dtype=np.int64)
    for customer in range(customers):
        while customer >= blocks[block + 1]:
            block += 1
            bounds[block] = total
        begin, key, served = begins[total], np.uint64(0), False
        end = begin
        for k in range(starts[customer], starts[customer + 1]):
            column = new[who[k]]
            if column == -2:
                served = True
                break
            if column >= 0:
                kept[end] = column
                key += keys[column]
                end += 1
        if served or end - begin == count:
            continue
        if end == begin:
            missed[block] += weights[customer]
            continue
        slot = np.int64((key ^ (key >> np.uint64(31))) & np.uint64(table.shape[0] - 1))
        while table[slot] >= 0:
            other = table[slot]
            if (hashes[other] == key and other >= bounds[block]
                    and _same(kept[begins[other]:begins[other + 1]], kept[begin:end])):
                break
            slot = (slot + 1) & (table.shape[0] - 1)
        if table[slot] >= 0:
            merged[table[slot]] += weights[customer]
            continue
        table[slot] = total
        hashes[total], merged[total] = key, weights[customer]
        total += 1
        begins[total] = end
    bounds[block + 1:] = total
    return (merged[:total].copy(), begins[:total + 1].copy(), kept[:begins[total]].copy(), bounds,
            missed)


@njit(cache=True, nogil=True)
def _prefix_weights(trees):
    """Return what is lost where no point from a tree's root to a node is seen: (T,) metres."""
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
def _found(words, sets, hashes, table, total):
    """Return the number of a set of candidates (W,), which is added where it is new."""
    key = np.uint64(1469598103934665603)
    for word in words:
        key = (key ^ word) * np.uint64(0x9E3779B97F4A7C15)
        key ^= key >> np.uint64(29)
    slot = np.int64(key & np.uint64(table.shape[0] - 1))
    while table[slot] >= 0:
        other = table[slot]
        if hashes[other] == key and _same(sets[other], words):
            return other
        slot = (slot + 1) & (table.shape[0] - 1)
    table[slot] = total
    hashes[total] = key
    sets[total] = words
    return total


@njit(cache=True, nogil=True)
def _customers(trees, prefix, seers, fixed, extra, sets):
    """
    Gather prefixes and single points by the candidates that see them.

    :param prefix: (T,) metres, from :func:`_prefix_weights`.
    :param seers: (N, W) uint64, the candidates that see each point.
    :param fixed: (N,) bool, points that cameras in place see.
    :param extra: (N,) metres, what each point that is not seen costs by itself.
    :param sets: (T + N, W) uint64, out: different sets of candidates.
    :returns: (C,) metres, the weight of each set.
    """
    nodes, words = trees.point.shape[0], seers.shape[1]
    table, hashes = _hash_table(sets.shape[0]), np.empty(sets.shape[0], dtype=np.uint64)
    weights, total = np.zeros(sets.shape[0]), 0
    ends, path = np.empty(nodes, dtype=np.uint32), np.zeros((nodes + 1, words), dtype=np.uint64)
    depth, node = 0, 0
    while node < nodes:
        point = trees.point[node]
        if fixed[point]:
            node = trees.end[node]
            continue
        while depth and ends[depth - 1] <= node:
            depth -= 1
        path[depth + 1] = path[depth] | seers[point]
        ends[depth] = trees.end[node]
        depth += 1
        number = _found(path[depth], sets, hashes, table, total)
        total += number == total
        weights[number] += prefix[node]
        node += 1
    for point in range(extra.shape[0]):
        if extra[point] > 0.0 and not fixed[point]:
            number = _found(seers[point], sets, hashes, table, total)
            total += number == total
            weights[number] += extra[point]
    return weights[:total].copy()


@njit(cache=True, nogil=True)
def _lists(sets, count):
    """Return the lists (starts, who) of sets of so many candidates (C, W) uint64."""
    starts = np.zeros(sets.shape[0] + 1, dtype=np.int64)
    for customer in range(sets.shape[0]):
        total = 0
        for candidate in range(count):
            total += (sets[customer, candidate >> 6] >> np.uint64(candidate & 63)) & np.uint64(1)
        starts[customer + 1] = starts[customer] + np.int64(total)
    who, end = np.empty(starts[-1], dtype=np.uint16), 0
    for customer in range(sets.shape[0]):
        for candidate in range(count):
            if (sets[customer, candidate >> 6] >> np.uint64(candidate & 63)) & np.uint64(1):
                who[end] = candidate
                end += 1
    return starts, who


def covering_of(trees: Trees, pixels: float, points: int, views: Sequence[np.ndarray],
                fixed: np.ndarray | None = None, extra: np.ndarray | None = None,
                over: Callable[[], bool] = lambda: False) -> Covering | None:
    """
    Build the covering problem of candidates in a room.

    :param trees: of the depth error.
    :param pixels: what its sum is divided by.
    :param points: N, of the scene.
    :param views: (W,) uint64 packed points that each of M >= 1 candidates sees.
    :param fixed: (W,) uint64, what cameras in place see.
    :param extra: (N,) metres that each point costs by itself if it is not seen.
    :param over: tells whether there is no time left.
    :returns: None where there was no time left.
    :raises ValueError: if there are more candidates than 65,536.
    """
    if len(views) > 2 ** 16:
        raise ValueError(f'views: found {len(views)} candidates; expected at most {2 ** 16}')
    seers = np.zeros((points, -(-len(views) // 64)), dtype=np.uint64)
    for candidate, view in enumerate(views):
        seers[unpack(view, points), candidate // 64] |= np.uint64(1 << candidate % 64)
        if over():
            return None
    seen = np.zeros(points, dtype=bool) if fixed is None else unpack(fixed, points)
    extra = np.zeros(points) if extra is None else extra
    sets = np.empty((len(trees.point) + points, seers.shape[1]), dtype=np.uint64)
    weights = _customers(trees, _prefix_weights(trees) / pixels, seers, seen, extra, sets)
    if over():
        return None
    starts, who = _lists(sets[:len(weights)], len(views))
    rounding = -float(weights[weights < 0.0].sum())
    # As much work for each block: neighbours in the trees look alike and see alike.
    blocks = np.searchsorted(starts, np.linspace(0, len(who), BLOCKS + 1))
    blocks[-1] = len(weights)
    covering = Covering(np.maximum(weights, 0.0), starts, who, blocks, np.arange(len(views)),
                        np.zeros(BLOCKS), rounding)
    return covering.shrunk(np.ones(len(views), dtype=bool), ())
