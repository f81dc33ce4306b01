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

"""The space that a scanner has seen to be free: cells that its rays have crossed."""

import numpy as np
from ocp_ros.util.kernels import njit


@njit(cache=True, nogil=True)
def cross_cells(station, points, low, edge, is_crossed):
    """
    Mark the cells that the rays from a station to points cross.

    The last cell before a point is left out, since a surface and its back share it.

    :param station: (3,) metres.
    :param points: (N, 3) metres.
    :param low: (3,) metres, the corner of the first cell.
    :param edge: the edge of a cell, metres.
    :param is_crossed: (X, Y, Z) bool, in and out.
    """
    for k in range(len(points)):
        offset = points[k] - station
        length = np.sqrt((offset ** 2).sum())
        # Two places in each cell.
        for step in range(int(2.0 * (length - edge) / edge)):
            share = 0.5 * edge * step / length
            x, y, z = _cell(station, offset, share, low, edge)
            if (0 <= x < is_crossed.shape[0] and 0 <= y < is_crossed.shape[1]
                    and 0 <= z < is_crossed.shape[2]):
                is_crossed[x, y, z] = True


@njit(cache=True, nogil=True, inline='always')
def _cell(start, offset, share, low, edge):
    """Return the cell of a share of the way from a start (3,) along an offset (3,), metres."""
    return (int(np.floor((start[0] + share * offset[0] - low[0]) / edge)),
            int(np.floor((start[1] + share * offset[1] - low[1]) / edge)),
            int(np.floor((start[2] + share * offset[2] - low[2]) / edge)))


@njit(cache=True, nogil=True)
def proved_bits(seen, position, points, normals, sides, low, edge, is_crossed, max_unknown):
    """
    Return those of the visible points whose view a scan proves.

    The view is from a side of the surface that the scanner has seen, and crosses little space that
    none of its rays has crossed.

    :param seen: (W,) uint64, packed bits of the visible points.
    :param position: (3,) metres, of the camera.
    :param points: (N, 3) metres, in the order of the bits, as ``normals`` and ``sides``.
    :param normals: (N, 3) unit vectors of either sign.
    :param sides: (N,) int8, 1 or -1 for a surface that was seen only from the side of its normal
        or from the other one, and 0 if that is not known, or from both.
    :param low: (3,) metres, the corner of the first cell.
    :param edge: the edge of a cell, metres.
    :param is_crossed: (X, Y, Z) bool, the cells that rays of the scanner have crossed.
    :param max_unknown: the largest length of the way through other cells, metres.
    :returns: (W,) uint64.
    """
    kept = seen.copy()
    # The least cosine between ray and surface for which its side is sure.
    min_cosine = 0.03
    for k in range(len(points)):
        word, bit = k >> 6, np.uint64(1) << np.uint64(k & 63)
        if not seen[word] & bit:
            continue
        offset = points[k].astype(np.float64) - position
        length = np.sqrt((offset ** 2).sum())
        cosine = -(offset * normals[k]).sum() / max(length, 1e-9)
        is_proved = sides[k] * cosine >= -min_cosine
        unknown = 0.0
        # The cells next to the surface are known by its point.
        for step in range(int(2.0 * (length - 1.5 * edge) / edge)):
            if not is_proved:
                break
            x, y, z = _cell(position, offset, 0.5 * edge * step / length, low, edge)
            if (0 <= x < is_crossed.shape[0] and 0 <= y < is_crossed.shape[1]
                    and 0 <= z < is_crossed.shape[2] and not is_crossed[x, y, z]):
                unknown += 0.5 * edge
                is_proved = unknown <= max_unknown
        if not is_proved:
            kept[word] &= ~bit
    return kept
