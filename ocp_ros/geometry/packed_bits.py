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
Points in blocks of 256, sorted so that neighbours in space are in the same block.

Subsets of these points are packed bits, one 64-bit word for 64 points: the union of two subsets
takes a few instructions, and a subset of 25,000 points takes 3 kB. Everywhere, W is the number of
words of a subset.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from ocp_ros.geometry.cameras import PINHOLE
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.util.kernels import njit

#: 64-bit words per block of points, with one bit for each point.
WORDS_PER_BLOCK = 4
#: Points per block.
POINTS_PER_BLOCK = 256


def spatial_order(points: np.ndarray) -> np.ndarray:
    """
    Sort points along a Morton curve, so that neighbours in the order are neighbours in space.

    :param points: (N, 3), N points, metres.
    :returns: (N,) int64, the indices of the points in this order.
    """
    if len(points) == 0:
        return np.empty(0, dtype=np.int64)
    low, high = corners_of(points)
    extent = max(float((high - low).max()), 1e-9)
    # Cells from 0 to 1023 along each axis: 10 bits, which the Morton code interleaves.
    cells = ((points - low) / extent * 1023).astype(np.int64)
    codes = np.zeros(len(points), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            codes |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(codes, kind='stable')


def block_bounds(points: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """
    Return the bounding box of each block of points, including their discs.

    :param points: (N, 3), N points, metres, in spatial order.
    :param radius: (N,), the radius of each point's disc, metres.
    :returns: (B, 2, 3) float32: the lowest and the highest corner of each of B blocks, metres.
    """
    starts = np.arange(0, len(points), POINTS_PER_BLOCK)
    margin = radius[:, None]
    return np.stack([np.minimum.reduceat(points - margin, starts),
                     np.maximum.reduceat(points + margin, starts)], axis=1).astype(np.float32)


@njit(cache=True, nogil=True)
def find_blocks_in_view(bounds, pose, lens, found):
    """
    Write the indices of the blocks with points that may be in a camera's field of view.

    :param bounds: (B, 2, 3) float32, metres, see :func:`block_bounds`.
    :param pose: the camera's :class:`~ocp_ros.geometry.cameras.Pose`.
    :param lens: the camera model's :class:`~ocp_ros.geometry.cameras.Frustum`.
    :param found: (B,) uint32, out: the indices; later entries do not change.
    :returns: the number of blocks found.
    """
    count = 0
    # The lengths of the normals of the planes of a pinhole camera's viewing cone.
    side_length = np.sqrt(1.0 + lens.half_horizontal * lens.half_horizontal)
    top_length = np.sqrt(1.0 + lens.half_vertical * lens.half_vertical)
    for b in range(bounds.shape[0]):
        # Squared: the distance of the camera from the box, and half the box's diagonal. Also the
        # centre of the box in the camera's body frame.
        squared_gap = squared_radius = x = y = z = 0.0
        for axis in range(3):
            low, high = bounds[b, 0, axis], bounds[b, 1, axis]
            squared_gap += max(low - pose.position[axis], pose.position[axis] - high, 0.0) ** 2
            squared_radius += (0.5 * (high - low)) ** 2
            offset = 0.5 * (low + high) - pose.position[axis]
            x += pose.rotation[axis, 0] * offset
            y += pose.rotation[axis, 1] * offset
            z += pose.rotation[axis, 2] * offset
        if squared_gap > lens.max_range * lens.max_range:
            continue
        # For other cameras only the range is checked.
        if lens.kind == PINHOLE:
            # The largest distance of the block's centre outside a plane of the viewing cone.
            excess = max(-x, (abs(y) - lens.half_horizontal * x) / side_length,
                         (abs(z) - lens.half_vertical * x) / top_length)
            if excess > np.sqrt(squared_radius):
                continue
        found[count] = b
        count += 1
    return count


def no_bits(count: int) -> np.ndarray:
    """Return the packed bits of an empty subset of ``count`` points: (W,) uint64."""
    return np.zeros(-(-count // POINTS_PER_BLOCK) * WORDS_PER_BLOCK, dtype=np.uint64)


def pack(flags: np.ndarray) -> np.ndarray:
    """
    Pack the flags of N points into bits.

    :param flags: (N,) bool.
    :returns: (W,) uint64, the first flag in the lowest bit; the padding of the last block is 0.
    """
    words = no_bits(len(flags))
    packed = np.packbits(flags, bitorder='little')
    words.view(np.uint8)[:len(packed)] = packed
    return words


def unpack(words: np.ndarray, count: int) -> np.ndarray:
    """
    Unpack bits into the flags of N points.

    :param words: (W,) uint64 from :func:`pack`.
    :param count: N, the number of points.
    :returns: (N,) bool.
    """
    return np.unpackbits(words.view(np.uint8), count=count, bitorder='little').view(bool)


@njit(cache=True, nogil=True)
def count_bits(words):
    """Return the number of bits that are set in words (W,) uint64."""
    total = np.uint64(0)
    for word in words:
        # Sums of 2, 4 and 8 neighbouring bits, then of the eight bytes.
        word -= (word >> np.uint64(1)) & np.uint64(0x5555555555555555)
        word = ((word & np.uint64(0x3333333333333333))
                + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333)))
        word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
        total += (word * np.uint64(0x0101010101010101)) >> np.uint64(56)
    return total


def seen_by(views: Sequence[np.ndarray], max_count: int) -> list[np.ndarray]:
    """
    Return the points that at least 1, 2, ... and ``max_count`` of some views contain.

    :param views: one view or more of the same points: (W,) uint64, packed bits of visible points.
    :param max_count: the largest number of views, 1 or more.
    :returns: a list of ``max_count`` subsets (W,) uint64; entry k holds the points that at least
        k + 1 views contain.
    """
    levels = [np.zeros_like(views[0]) for _ in range(max_count)]
    for view in views:
        # The highest level comes first, so that a view raises each point by one level only.
        for k in range(max_count - 1, 0, -1):
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
        """Return the empty subset of the points with the given order (N,) int64."""
        return cls(no_bits(len(order)), order)

    @property
    def mask(self) -> np.ndarray:
        """Return whether each point is in the subset: (N,) bool, in the caller's order."""
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
