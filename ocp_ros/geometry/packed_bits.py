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
Points in blocks: sorted so that neighbours lie together, and processed 256 at a time.

Subsets of these points are packed bits, one word of 64 bits for 64 points: a union takes a few
instructions, and a room of 25,000 points takes 3 kB.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from ocp_ros.geometry.cameras import PINHOLE
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.util.kernels import njit

#: 64-bit words per block, with one bit for each point.
WORDS = 4
#: Points per block.
BLOCK = 256


def spatial_order(points: np.ndarray) -> np.ndarray:
    """
    Sort points along a Morton curve, so that neighbours in the order are neighbours in space.

    :param points: (N, 3), metres.
    :returns: (N,) int64 indices.
    """
    if len(points) == 0:
        return np.empty(0, dtype=np.int64)
    low, high = corners_of(points)
    extent = max(float((high - low).max()), 1e-9)
    cells = ((points - low) / extent * 1023).astype(np.int64)
    code = np.zeros(len(points), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind='stable')


def block_bounds(points: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """
    Return the bounding box of each block of ``BLOCK`` points, including their discs.

    :param points: (N, 3), metres, in spatial order.
    :param radius: (N,), metres.
    :returns: (B, 2, 3) float32: lowest and highest corners, metres.
    """
    starts = np.arange(0, len(points), BLOCK)
    if len(starts) == 0:
        return np.empty((0, 2, 3), dtype=np.float32)
    reach = radius[:, None]
    return np.stack([np.minimum.reduceat(points - reach, starts),
                     np.maximum.reduceat(points + reach, starts)], axis=1).astype(np.float32)


@njit(cache=True, nogil=True)
def blocks_in_view(bounds, pose, lens, found):
    """
    Find the blocks with points that may be in a camera's field of view.

    :param bounds: (B, 2, 3) float32, metres.
    :param pose: the camera's :class:`~ocp_ros.geometry.cameras.Pose`.
    :param lens: the camera model's :class:`~ocp_ros.geometry.cameras.Frustum`.
    :param found: (B,) uint32, out: indices of blocks.
    :returns: the number of blocks found.
    """
    count = 0
    across = np.sqrt(1.0 + lens.half_horizontal * lens.half_horizontal)
    up = np.sqrt(1.0 + lens.half_vertical * lens.half_vertical)
    for b in range(bounds.shape[0]):
        away = size = x = y = z = 0.0
        for axis in range(3):
            low, high = bounds[b, 0, axis], bounds[b, 1, axis]
            away += max(low - pose.position[axis], pose.position[axis] - high, 0.0) ** 2
            size += (0.5 * (high - low)) ** 2
            middle = 0.5 * (low + high) - pose.position[axis]
            x += pose.rotation[axis, 0] * middle
            y += pose.rotation[axis, 1] * middle
            z += pose.rotation[axis, 2] * middle
        if away > lens.max_range * lens.max_range:
            continue
        if lens.kind == PINHOLE:
            # The largest distance of the block's centre beyond the planes of the viewing cone.
            beyond = max(-x, (abs(y) - lens.half_horizontal * x) / across,
                         (abs(z) - lens.half_vertical * x) / up)
            if beyond > np.sqrt(size):
                continue
        found[count] = b
        count += 1
    return count


def no_bits(count: int) -> np.ndarray:
    """Return the packed bits of an empty subset of ``count`` points: (W,) uint64."""
    return np.zeros(-(-count // BLOCK) * WORDS, dtype=np.uint64)


def pack(flags: np.ndarray) -> np.ndarray:
    """
    Pack flags into bits.

    :param flags: (N,) bool.
    :returns: (W,) uint64, the first flag in the lowest bit; the padding of the last block is 0.
    """
    words = no_bits(len(flags))
    packed = np.packbits(flags, bitorder='little')
    words.view(np.uint8)[:len(packed)] = packed
    return words


def unpack(words: np.ndarray, count: int) -> np.ndarray:
    """
    Unpack bits into flags.

    :param words: (W,) uint64 from :func:`pack`.
    :param count: N.
    :returns: (N,) bool.
    """
    return np.unpackbits(words.view(np.uint8), count=count, bitorder='little').view(bool)


@njit(cache=True, nogil=True)
def count_bits(words):
    """
    Count the bits that are set.

    :param words: (W,) uint64.
    """
    total = np.uint64(0)
    for word in words:
        # Sums of 2, 4 and 8 neighbouring bits, then of the eight bytes.
        word -= (word >> np.uint64(1)) & np.uint64(0x5555555555555555)
        word = ((word & np.uint64(0x3333333333333333))
                + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333)))
        word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
        total += (word * np.uint64(0x0101010101010101)) >> np.uint64(56)
    return total


def seen_by(views: Sequence[np.ndarray], most: int) -> list[np.ndarray]:
    """
    Find the points that at least 1, 2, ... M of some views contain.

    :param views: K subsets of the same points, (W,) uint64 packed bits each, K >= 1.
    :param most: the largest number of views counted, M >= 1.
    :returns: M subsets (W,) uint64: the points that at least 1, 2, ... M views contain.
    """
    levels = [np.zeros_like(views[0]) for _ in range(most)]
    for view in views:
        for k in range(most - 1, 0, -1):
            levels[k] |= levels[k - 1] & view
        levels[0] |= view
    return levels


@dataclass(frozen=True, eq=False)
class Subset:
    """
    A subset of N points.

    :ivar bits: (W,) uint64, packed flags in the engine's spatial order.
    :ivar order: (N,) int64, the index of each point of that order among the caller's points.
    """

    bits: np.ndarray
    order: np.ndarray

    @classmethod
    def none(cls, order: np.ndarray) -> 'Subset':
        """Return the empty subset of the points with the given order."""
        return cls(no_bits(len(order)), order)

    @property
    def mask(self) -> np.ndarray:
        """Return (N,) bool in the caller's order."""
        mask = np.empty(len(self.order), dtype=bool)
        mask[self.order] = unpack(self.bits, len(self.order))
        return mask

    def __len__(self) -> int:
        """Return the number of points in the subset."""
        return int(count_bits(self.bits))

    def __or__(self, other: 'Subset') -> 'Subset':
        """Return the points in either of two subsets of the same points."""
        return Subset(self.bits | other.bits, self.order)

    def __ge__(self, other: 'Subset') -> bool:
        """Return whether every point of another subset is in this one."""
        return not (other.bits & ~self.bits).any()
