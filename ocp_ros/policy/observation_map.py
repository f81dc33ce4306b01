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
Observation map: the observed cloud from above, as channels of a square grid for the map actor.

Some channels describe the room: points by height, the depth error at these points if none is
visible, and the observed air. Other channels describe the remaining task beside the other cameras:
the points that none of them sees, the depth error at these points, and the positions of the other
cameras. The map contains observed data alone, and no move is simulated.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import Frustum, OMNIDIRECTIONAL, PINHOLE
from ocp_ros.geometry.clouds import cells_numbered, corners_of
from ocp_ros.geometry.packed_bits import no_bits, unpack
from ocp_ros.online.partial_map import NO_CELL, PartialMap
from ocp_ros.simulation.simulator import View

#: Cells along each side of the grid, and their smallest edge, metres: a room that is larger than
#: the grid has larger cells.
CELLS, EDGE_M = 64, 0.25
#: Smallest free border of the grid around the observed bounding box, metres.
BORDER_M = 0.5
#: Limits between the slices of the points, metres above the floor.
SLICES_M = (0.15, 0.8, 1.5, 2.2)
#: Limit between low and high points, metres above the floor.
SPLIT_M = 1.2
#: Limits between the slices of the air, metres above the floor.
AIR_SLICES_M = (0.9, 1.55)
#: Lowest and highest air, metres above the floor.
AIR_LOW_M, AIR_HIGH_M = 0.2, 2.4
#: Standard deviation of the spots that mark cameras and viewpoints, metres.
SPOT_M = 0.4
#: Channels of the room with the observed air (after the points and their depth error), and the
#: channel of the bounding box.
SEEN_AIR = slice(len(SLICES_M) + 3, len(SLICES_M) + 4 + len(AIR_SLICES_M))
BOX = SEEN_AIR.stop
#: Number of channels of the room, of channels of the other cameras, and of scalar inputs.
OF_ROOM, OF_OTHERS, NUMBERS = BOX + 2, 7, 5
#: Number of values that describe the field of view of a camera.
OF_LENS = 2
#: The sides of the used part of a map are multiples of this.
STRIDE = 8
#: Number of points, and share of the error, at which a cell reaches the value 255.
MANY_POINTS, MUCH_ERROR = 32.0, 0.03
#: Factor of a share before its logarithm: a larger factor resolves smaller shares.
FINE_SHARES = 500.0
#: Added to errors before the logarithm, as a share of the depth error without any visible point.
ERROR_FLOOR = 0.005


def used_part(room: np.ndarray) -> tuple[slice, slice]:
    """
    Return the cells in the middle of a map that contain the observed bounding box.

    :param room: (``OF_ROOM``, 64, 64) of :class:`ObservationMap`.
    :returns: rows and columns, multiples of ``STRIDE`` each.
    """
    box, border = room[BOX] > 0, 2 * round(BORDER_M / EDGE_M)
    across = [int(np.count_nonzero(box.any(axis=axis))) + border for axis in (1, 0)]
    firsts = [(CELLS - min(-(-side // STRIDE) * STRIDE, CELLS)) // 2 for side in across]
    return slice(firsts[0], CELLS - firsts[0]), slice(firsts[1], CELLS - firsts[1])


def lens_features(lens: Frustum | None) -> np.ndarray:
    """
    Return the field of view of a camera as network inputs.

    :param lens: frustum of the camera; None for an omnidirectional camera.
    :returns: (``OF_LENS``,) float32: the angles of view, horizontal and vertical, as shares of
        those of an omnidirectional camera.
    """
    if lens is None or lens.kind == OMNIDIRECTIONAL:
        return np.ones(OF_LENS, dtype=np.float32)
    halves = np.array([lens.half_horizontal, lens.half_vertical])
    if lens.kind == PINHOLE:
        halves = np.arctan(halves)
    return (halves / [np.pi, 0.5 * np.pi]).astype(np.float32)


def yaws_of(headings: int) -> np.ndarray:
    """Return the yaws (D,) of the headings that have values, radians, map frame."""
    return np.arange(headings) * (2.0 * np.pi / headings)


def at_yaws(values: np.ndarray, cells: np.ndarray, yaws: np.ndarray) -> np.ndarray:
    """
    Interpolate values linearly between the yaws of :func:`yaws_of`.

    :param values: (D, C), by yaw and by cell.
    :param cells: (M,) numbers of cells.
    :param yaws: (M,) radians, map frame.
    :returns: (M,).
    """
    count = len(values)
    at = yaws * (count / (2.0 * np.pi))
    low = np.floor(at).astype(np.int64)
    between, next_one = values[low % count, cells], values[(low + 1) % count, cells]
    # Cells outside the observed bounding box are inf at all yaws.
    known = np.isfinite(between)
    between[known] += (at - low)[known] * (next_one[known] - between[known])
    return between


class Window(NamedTuple):
    """
    Position of the grid in the map frame.

    :ivar low: (2,) metres, map frame: corner of the first cell.
    :ivar edge: of the cells, metres.
    """

    low: np.ndarray
    edge: float

    @classmethod
    def around(cls, bounds: np.ndarray, least: float = EDGE_M) -> 'Window':
        """
        Place the grid around a bounding box.

        :param bounds: (2, 3) metres.
        :param least: smallest edge of the cells, metres.
        """
        size = float((bounds[1] - bounds[0])[:2].max()) + 2.0 * BORDER_M
        edge = max(least, size / CELLS)
        return cls(bounds.mean(axis=0)[:2] - 0.5 * CELLS * edge, edge)

    @property
    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the centres of the cells: (64,) x and (64,) y, metres."""
        steps = (np.arange(CELLS) + 0.5) * self.edge
        return self.low[0] + steps, self.low[1] + steps

    @property
    def middles(self) -> np.ndarray:
        """Return the centres of the cells: (64, 64, 2) metres."""
        return np.stack(np.meshgrid(*self.axes, indexing='ij'), axis=-1)

    def cell_of(self, places: np.ndarray) -> np.ndarray:
        """Return the numbers (M,) of the cells of places (M, >= 2), -1 outside."""
        cell = np.floor((places[:, :2] - self.low) / self.edge).astype(np.int64)
        inside = ((cell >= 0) & (cell < CELLS)).all(axis=1)
        return np.where(inside, cell[:, 0] * CELLS + cell[:, 1], -1)


class ObservationMap:
    """
    The channels of one time step.

    :param model: partial map of the observed cloud.
    :param unseen: packed bits of the model's cells of the air that no camera has covered yet.
    :param cameras: K, number of cameras.
    :param max_range: of the camera that chooses, metres.
    :param height: of the cameras, z in metres, map frame.
    :param least: smallest edge of the cells, metres.
    :ivar room: (``OF_ROOM``, 64, 64) uint8.
    """

    def __init__(self, model: PartialMap, unseen: np.ndarray, cameras: int, max_range: float,
                 height: float, least: float = EDGE_M) -> None:
        self._model = model
        self.window = Window.around(model.bounds, least)
        floor = model.bounds[0, 2]
        above = model.points[:, 2] - floor
        cells = self.window.cell_of(model.points)
        #: For each point its cell in the channel of low or of high points, -1 outside.
        self._halves = np.where(cells >= 0, cells + (above > SPLIT_M) * CELLS * CELLS, -1)
        self._air = _AirColumns(model, self.window, floor)
        slices = np.where(cells >= 0, cells + np.searchsorted(SLICES_M, above) * CELLS * CELLS, -1)
        worth = model.depth_error.error_by_point(no_bits(len(model.points)))
        self.room = np.concatenate([
            _density(_summed(slices, len(SLICES_M) + 1)),
            _share(_summed(self._halves, 2, worth) / model.depth_error.worst),
            _bytes(self._air.shares(~unseen, len(AIR_SLICES_M) + 1)),
            self._box(), _spots(self.window, model.depth_error.viewpoints)])
        self._told = ((cameras - 1) / 7.0, max_range / self.window.edge / CELLS,
                      (height - floor) / 3.0, 2.0 * self.window.edge)

    def others(self, views: Sequence[View], places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Compute the channels of the points and the depth error that other cameras do not cover.

        :param views: views of the other cameras in the model.
        :param places: (J, >= 2) metres, their positions.
        :returns: (``OF_OTHERS``, 64, 64) uint8 and (``NUMBERS``,) float32.
        """
        model, together = self._model, self._model.together(views)
        unseen = ~unpack(together.seen, len(model.points))
        lost = model.depth_error.error_by_point(together.seen)
        error, worst = float(lost.sum()), model.depth_error.worst
        channels = np.concatenate([
            _density(_summed(np.where(unseen, self._halves, -1), 2)),
            _share(_summed(self._halves, 2, lost) / (error + ERROR_FLOOR * worst)),
            _bytes(self._air.shares(together.covered, 2)), _spots(self.window, places)])
        level = np.log((error + ERROR_FLOOR * worst) / worst) / 5.0
        return channels, np.array([*self._told, level], dtype=np.float32)

    def _box(self) -> np.ndarray:
        """Mark the cells inside the observed bounding box: (1, 64, 64) uint8."""
        low, high = self._model.bounds[:, :2]
        inside = [(axis >= low[k]) & (axis <= high[k]) for k, axis in enumerate(self.window.axes)]
        return 255 * np.logical_and.outer(*inside).astype(np.uint8)[None]

    def unseen_air(self) -> np.ndarray:
        """Return the unseen share of the air above each cell: (64, 64)."""
        seen = self.room[SEEN_AIR].mean(axis=0) / 255.0
        return np.where(self._air.known, 1.0 - seen, 0.0)


class _AirColumns:
    """The air above each cell of the grid, as cells of the partial map."""

    def __init__(self, model: PartialMap, window: Window, floor: float) -> None:
        self._count = len(model.cells)
        kept = np.flatnonzero(model.cells != NO_CELL)
        cells = cells_numbered(model.cells[kept])
        above = (cells[:, 2] + 0.5) * model.edge - floor
        between = (above > AIR_LOW_M) & (above < AIR_HIGH_M)
        self._kept, cells, above = kept[between], cells[between], above[between]
        # A room lower than AIR_LOW_M has no cells of the air here.
        low, high = (corners_of(cells) if len(cells) else np.zeros((2, 3), dtype=np.int64))[:, :2]
        self._shape = tuple(high - low + 1)
        column = cells[:, :2] - low
        self._columns = column[:, 0] * self._shape[1] + column[:, 1]
        self._slices = {2: (above > SPLIT_M).astype(np.int64),
                        len(AIR_SLICES_M) + 1: np.searchsorted(AIR_SLICES_M, above)}
        #: For each row and column of the grid the index in the air, and whether air is there.
        self._at, there = [], []
        for k, axis in enumerate(window.axes):
            index = np.floor(axis / model.edge).astype(np.int64) - low[k]
            there.append((index >= 0) & (index < self._shape[k]))
            self._at.append(np.clip(index, 0, self._shape[k] - 1))
        self.known = np.logical_and.outer(*there)

    def shares(self, bits: np.ndarray, slices: int) -> np.ndarray:
        """Return the share of the air above each cell whose bits are set: (slices, 64, 64)."""
        flags = unpack(bits, self._count)[self._kept]
        size = self._shape[0] * self._shape[1]
        index = self._slices[slices] * size + self._columns
        there = np.bincount(index, minlength=slices * size)
        found = np.bincount(index[flags], minlength=slices * size)
        share = (found / np.maximum(there, 1)).reshape(slices, *self._shape)
        return share[:, self._at[0][:, None], self._at[1][None, :]] * self.known


def _summed(index: np.ndarray, channels: int, weights: np.ndarray | None = None) -> np.ndarray:
    """Sum weights of points, or count points, in each cell: (channels, 64, 64); skip index -1."""
    inside = index >= 0
    return np.bincount(index[inside], None if weights is None else weights[inside],
                       channels * CELLS * CELLS).reshape(channels, CELLS, CELLS)


def _density(counts: np.ndarray) -> np.ndarray:
    """Convert counts of points into uint8 on a logarithmic scale."""
    return _bytes(np.log1p(counts) / np.log1p(MANY_POINTS))


def _share(shares: np.ndarray) -> np.ndarray:
    """Convert shares of an error into uint8 on a logarithmic scale."""
    return _bytes(np.log1p(FINE_SHARES * shares) / np.log1p(FINE_SHARES * MUCH_ERROR))


def _bytes(values: np.ndarray) -> np.ndarray:
    """Convert numbers from 0 to 1 into uint8; larger ones become 255."""
    return (255.0 * np.minimum(values, 1.0) + 0.5).astype(np.uint8)


def _spots(window: Window, places: np.ndarray) -> np.ndarray:
    """Mark places (J, >= 2) by Gaussian spots: (1, 64, 64) uint8."""
    rows, columns = window.axes
    marks = np.zeros((CELLS, CELLS))
    for place in places:
        marks = np.maximum(marks, np.multiply.outer(
            np.exp(-0.5 * ((rows - place[0]) / SPOT_M) ** 2),
            np.exp(-0.5 * ((columns - place[1]) / SPOT_M) ** 2)))
    return _bytes(marks)[None]
