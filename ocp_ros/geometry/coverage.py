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

"""Space coverage: the volume that at least one camera sees."""

import numpy as np
from ocp_ros.geometry.packed_bits import count_bits

#: The largest number of coverage cells of a room: each takes about 60 bytes.
MAX_CELLS = 8_000_000


def _counts(bounds: np.ndarray, cell: float) -> np.ndarray:
    """Return the number of cells along each axis of a box (2, 3), with edges in metres: (3,)."""
    return np.maximum(np.round((bounds[1] - bounds[0]) / cell).astype(np.int64), 1)


def coverable_cell(bounds: np.ndarray, cell: float) -> float:
    """
    Double the edge of a cell until a box has at most ``MAX_CELLS`` cells.

    :param bounds: (2, 3) the lowest and the highest corner of the box, metres.
    :param cell: the wanted edge of a cell, metres.
    :returns: the edge, metres.
    """
    # A product of integers could overflow.
    while _counts(bounds, cell).prod(dtype=np.float64) > MAX_CELLS:
        cell *= 2.0
    return cell


def coverage_grid(bounds: np.ndarray, cell: float) -> tuple[np.ndarray, float]:
    """
    Divide a bounding box into equal cells.

    :param bounds: (2, 3) the lowest and the highest corner of the box, metres.
    :param cell: the wanted edge of a cell, metres; each axis uses the nearest edge that divides it
        evenly.
    :returns: the centres (M, 3) float32 of the M cells, metres, and the volume of one cell, cubic
        metres.
    :raises ValueError: if the cell is not positive, or there would be too many cells.
    """
    if not cell > 0.0:
        raise ValueError(f'coverage cell: found {cell}; expected metres above 0')
    size, counts = bounds[1] - bounds[0], _counts(bounds, cell)
    if counts.prod(dtype=np.float64) > MAX_CELLS:
        raise ValueError(f'coverage cell: found {cell} m, which makes {counts.prod():,} cells; '
                         f'expected at most {MAX_CELLS:,}; use larger cells')
    axes = [bounds[0][k] + (np.arange(counts[k]) + 0.5) * size[k] / counts[k] for k in range(3)]
    centres = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)
    return centres.astype(np.float32), float(size.prod() / counts.prod())


def space_coverage(covered: np.ndarray, cell_volume: float) -> float:
    """
    Sum the volume of the visible cells.

    :param covered: (W,) uint64, packed bits, 64 cells a word: whether a camera sees the centre of
        each cell.
    :param cell_volume: the volume of one cell, cubic metres.
    :returns: cubic metres.
    """
    return int(count_bits(covered)) * cell_volume
