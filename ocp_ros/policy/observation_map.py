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
visible, and the observed air. Other channels describe what the other cameras leave to one camera:
the points that no other camera sees, the depth error at these points, and the positions of the
other cameras. The map contains observed data alone, and no move is simulated.
"""

from collections.abc import Sequence
from math import ceil
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import Frustum, OMNIDIRECTIONAL, PINHOLE
from ocp_ros.geometry.clouds import cells_numbered, corners_of
from ocp_ros.geometry.packed_bits import no_bits, unpack
from ocp_ros.online.partial_map import NO_CELL, PartialMap
from ocp_ros.simulation.simulator import View

#: Number of cells along each side of the grid.
CELLS = 64
#: Smallest edge of a cell, metres: a room that is larger than the grid has larger cells.
EDGE_M = 0.25
#: Smallest free border of the grid around the observed bounding box, metres.
BORDER_M = 0.5
#: Limits between the slices of the points, metres above the floor.
SLICES_M = (0.15, 0.8, 1.5, 2.2)
#: Limit between the low and the high layer of points and air, metres above the floor.
SPLIT_M = 1.2
#: Limits between the slices of the air, metres above the floor.
AIR_SLICES_M = (0.9, 1.55)
#: Channels of the room with the observed air, after those of the points and their depth error.
SEEN_AIR = slice(len(SLICES_M) + 3, len(SLICES_M) + 4 + len(AIR_SLICES_M))
#: Channel of the room with the observed bounding box.
BOX = SEEN_AIR.stop
#: Numbers of channels of the room, channels of the other cameras, and scalar inputs.
OF_ROOM, OF_OTHERS, NUMBERS = BOX + 2, 7, 5
#: Number of values that describe the field of view of a camera.
OF_LENS = 2
#: Added to errors before the logarithm, as a share of the depth error without any visible point.
ERROR_FLOOR = 0.005


def used_part(room: np.ndarray) -> tuple[slice, slice]:
    """
    Return the central part of a map, which contains the observed bounding box.

    :param room: (``OF_ROOM``, 64, 64) channels of :class:`ObservationMap`.
    :returns: rows and columns; the number of each is a multiple of 8.
    """
    # The network has layers at 1/8 of the resolution. The box is in the middle of the map, so the
    # margins on both sides are equal.
    stride = 8
    inside = room[BOX] > 0
    borders = 2 * round(BORDER_M / EDGE_M)
    sides = [int(np.count_nonzero(inside.any(axis=axis))) + borders for axis in (1, 0)]
    margins = [(CELLS - min(ceil(side / stride) * stride, CELLS)) // 2 for side in sides]
    rows, columns = (slice(margin, CELLS - margin) for margin in margins)
    return rows, columns


def lens_features(lens: Frustum | None) -> np.ndarray:
    """
    Return the field of view of a camera as network inputs.

    :param lens: frustum of the camera; None for an omnidirectional camera.
    :returns: (``OF_LENS``,) float32: the angles of view, horizontal and vertical, as shares of
        those of an omnidirectional camera.
    """
    if lens is None or lens.kind == OMNIDIRECTIONAL:
        return np.ones(OF_LENS, dtype=np.float32)
    # Half the angles of view: radians, but tangents for a pinhole camera.
    half_angles = np.array([lens.half_horizontal, lens.half_vertical])
    if lens.kind == PINHOLE:
        half_angles = np.arctan(half_angles)
    return (half_angles / [np.pi, 0.5 * np.pi]).astype(np.float32)


def yaws_of(headings: int) -> np.ndarray:
    """Return the yaws of D = ``headings`` evenly spaced headings: (D,) radians, map frame."""
    return np.arange(headings) * (2.0 * np.pi / headings)


def interpolate_yaws(values: np.ndarray, cells: np.ndarray, yaws: np.ndarray) -> np.ndarray:
    """
    Return the values of M poses, interpolated linearly between the yaws of :func:`yaws_of`.

    :param values: (D, C), value of each of D yaws in each of C cells.
    :param cells: (M,) number of the cell of each pose.
    :param yaws: (M,) yaw of each pose, radians, map frame.
    :returns: (M,) values.
    """
    count = len(values)
    steps = yaws * (count / (2.0 * np.pi))
    below = np.floor(steps).astype(np.int64)
    result, above = values[below % count, cells], values[(below + 1) % count, cells]
    # Cells outside the used part of the map are inf at all yaws, and inf - inf would be NaN.
    finite = np.isfinite(result)
    result[finite] += (steps - below)[finite] * (above[finite] - result[finite])
    return result


class Window(NamedTuple):
    """
    Position of the grid in the map frame.

    Rows are numbered along x and columns along y, unlike in images; cell = row * 64 + column.

    :ivar low: (2,) metres, map frame: corner of the first cell.
    :ivar edge: of the cells, metres.
    """

    low: np.ndarray
    edge: float

    @classmethod
    def around(cls, bounds: np.ndarray, min_edge: float = EDGE_M) -> 'Window':
        """
        Return the position of the grid around a bounding box.

        :param bounds: (2, 3) metres, map frame: lowest and highest corner.
        :param min_edge: smallest edge of the cells, metres.
        """
        size = float((bounds[1] - bounds[0])[:2].max()) + 2.0 * BORDER_M
        edge = max(min_edge, size / CELLS)
        return cls(bounds.mean(axis=0)[:2] - 0.5 * CELLS * edge, edge)

    @property
    def centres_by_axis(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the centres of the rows and of the columns: (64,) x and (64,) y, metres."""
        steps = (np.arange(CELLS) + 0.5) * self.edge
        return self.low[0] + steps, self.low[1] + steps

    @property
    def centres(self) -> np.ndarray:
        """Return the centres of the cells: (64, 64, 2) metres, map frame."""
        return np.stack(np.meshgrid(*self.centres_by_axis, indexing='ij'), axis=-1)

    def cell_of(self, places: np.ndarray) -> np.ndarray:
        """Return the numbers (M,) of the cells of M places (M, 2 or more), metres; -1 outside."""
        cell = np.floor((places[:, :2] - self.low) / self.edge).astype(np.int64)
        inside = ((cell >= 0) & (cell < CELLS)).all(axis=1)
        return np.where(inside, cell[:, 0] * CELLS + cell[:, 1], -1)


class ObservationMap:
    """
    The channels of one time step.

    :param model: partial map of the observed cloud.
    :param unseen: packed bits of the model's cells of the air that no camera has covered yet.
    :param cameras: number of cameras.
    :param max_range: of the camera that chooses, metres.
    :param height: of the cameras, z in metres, map frame.
    :param min_edge: smallest edge of the grid's cells, metres.
    :ivar room: (``OF_ROOM``, 64, 64) uint8, channels of the room.
    :ivar window: position of the grid in the map frame.
    """

    def __init__(self, model: PartialMap, unseen: np.ndarray, cameras: int, max_range: float,
                 height: float, min_edge: float = EDGE_M) -> None:
        self._model = model
        self.window = Window.around(model.bounds, min_edge)
        floor = model.bounds[0, 2]
        heights = model.points[:, 2] - floor
        cells = self.window.cell_of(model.points)
        #: For each point layer * 64 * 64 + cell, layer 0 (low) or 1 (high); -1 outside the grid.
        self._layer_cells = np.where(cells >= 0, cells + (heights > SPLIT_M) * CELLS * CELLS, -1)
        self._air = _AirStacks(model, self.window, floor)
        slices = np.searchsorted(SLICES_M, heights)
        slice_cells = np.where(cells >= 0, cells + slices * CELLS * CELLS, -1)
        point_errors = model.depth_error.error_by_point(no_bits(len(model.points)))
        cell_errors = _cell_sums(self._layer_cells, 2, point_errors)
        self.room = np.concatenate([
            _encode_counts(_cell_sums(slice_cells, len(SLICES_M) + 1)),
            _encode_error_shares(cell_errors / model.depth_error.worst),
            _to_uint8(self._air.shares(~unseen, len(AIR_SLICES_M) + 1)),
            self._box_mask(), _draw_spots(self.window, model.depth_error.viewpoints)])
        #: All scalar inputs but the last, scaled to about 1: number of other cameras, range as a
        #: share of the map's side, height of the cameras above the floor, edge of the cells.
        self._scalars = ((cameras - 1) / 7.0, max_range / self.window.edge / CELLS,
                         (height - floor) / 3.0, 2.0 * self.window.edge)

    def others(self, views: Sequence[View], places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the channels of the other cameras, and the scalar inputs.

        :param views: views of the other cameras in the partial map.
        :param places: (J, 2 or more) metres, map frame: positions of the J other cameras.
        :returns: (``OF_OTHERS``, 64, 64) uint8 and (``NUMBERS``,) float32.
        """
        model = self._model
        joint = model.together(views)
        unseen = ~unpack(joint.seen, len(model.points))
        errors = model.depth_error.error_by_point(joint.seen)
        worst = model.depth_error.worst
        # With this addition, the logarithm in the last scalar input is from about -5.3 to 0.
        error = float(errors.sum()) + ERROR_FLOOR * worst
        channels = np.concatenate([
            _encode_counts(_cell_sums(np.where(unseen, self._layer_cells, -1), 2)),
            _encode_error_shares(_cell_sums(self._layer_cells, 2, errors) / error),
            _to_uint8(self._air.shares(joint.covered, 2)), _draw_spots(self.window, places)])
        return channels, np.array([*self._scalars, np.log(error / worst) / 5.0], dtype=np.float32)

    def _box_mask(self) -> np.ndarray:
        """Return 255 for cells inside the observed bounding box, else 0: (1, 64, 64) uint8."""
        low, high = self._model.bounds[:, :2]
        inside = [(centres >= low[k]) & (centres <= high[k])
                  for k, centres in enumerate(self.window.centres_by_axis)]
        return 255 * np.logical_and.outer(*inside).astype(np.uint8)[None]

    def unseen_air(self) -> np.ndarray:
        """Return the unseen share of the air above each cell, 0 where there is none: (64, 64)."""
        seen_share = self.room[SEEN_AIR].mean(axis=0) / 255.0
        return np.where(self._air.has_air, 1.0 - seen_share, 0.0)


class _AirStacks:
    """
    The cells of the partial map's air above each cell of the grid.

    A stack has all cells of the air at the same x and y.
    """

    def __init__(self, model: PartialMap, window: Window, floor: float) -> None:
        self._count = len(model.cells)
        air_cells = np.flatnonzero(model.cells != NO_CELL)
        cells = cells_numbered(model.cells[air_cells])
        heights = (cells[:, 2] + 0.5) * model.edge - floor
        # The air from 0.2 m to 2.4 m above the floor counts.
        in_range = (heights > 0.2) & (heights < 2.4)
        self._air_cells, cells, heights = air_cells[in_range], cells[in_range], heights[in_range]
        # A very low room has no cells of the air in this range.
        low, high = (corners_of(cells) if len(cells) else np.zeros((2, 3), dtype=np.int64))[:, :2]
        self._shape = tuple(high - low + 1)
        stack = cells[:, :2] - low
        self._stack_numbers = stack[:, 0] * self._shape[1] + stack[:, 1]
        #: The slice of each cell, by the number of slices.
        self._slices = {2: (heights > SPLIT_M).astype(np.int64),
                        len(AIR_SLICES_M) + 1: np.searchsorted(AIR_SLICES_M, heights)}
        # For each row and each column of the grid: index of the stack at its centre along x or y,
        # and whether there is one.
        self._air_indices, has_air = [], []
        for k, axis in enumerate(window.centres_by_axis):
            index = np.floor(axis / model.edge).astype(np.int64) - low[k]
            has_air.append((index >= 0) & (index < self._shape[k]))
            self._air_indices.append(np.clip(index, 0, self._shape[k] - 1))
        self.has_air = np.logical_and.outer(*has_air)

    def shares(self, bits: np.ndarray, slices: int) -> np.ndarray:
        """
        Return the share of the air above each cell of the grid that has its bit set: (S, 64, 64).

        :param bits: packed bits of the partial map's cells.
        :param slices: S, number of slices by height, 2 or 3.
        """
        is_set = unpack(bits, self._count)[self._air_cells]
        # Count the cells of the air, and those with their bit set, by slice and stack.
        size = self._shape[0] * self._shape[1]
        index = self._slices[slices] * size + self._stack_numbers
        counts = np.bincount(index, minlength=slices * size)
        set_counts = np.bincount(index[is_set], minlength=slices * size)
        share = (set_counts / np.maximum(counts, 1)).reshape(slices, *self._shape)
        # Each cell of the grid has the share of the stack at its centre, 0 without a stack.
        x_indices, y_indices = self._air_indices
        return share[:, x_indices[:, None], y_indices[None, :]] * self.has_air


def _cell_sums(index: np.ndarray, channels: int, weights: np.ndarray | None = None) -> np.ndarray:
    """
    Return the sum of the points' weights in each cell, or their number: (channels, 64, 64).

    :param index: (N,) channel * 64 * 64 + cell of each point; -1 to skip a point.
    :param channels: number of channels.
    :param weights: (N,) of the points; None to count points.
    """
    inside = index >= 0
    return np.bincount(index[inside], None if weights is None else weights[inside],
                       channels * CELLS * CELLS).reshape(channels, CELLS, CELLS)


def _encode_counts(counts: np.ndarray) -> np.ndarray:
    """Return counts of points as uint8 on a logarithmic scale; 32 points become 255."""
    return _to_uint8(np.log1p(counts) / np.log1p(32.0))


def _encode_error_shares(shares: np.ndarray) -> np.ndarray:
    """Return shares of an error as uint8 on a logarithmic scale; a share of 0.03 becomes 255."""
    resolution = 500.0  # A larger factor distinguishes smaller shares.
    return _to_uint8(np.log1p(resolution * shares) / np.log1p(resolution * 0.03))


def _to_uint8(values: np.ndarray) -> np.ndarray:
    """Return numbers from 0 to 1 as uint8 from 0 to 255; larger numbers become 255."""
    return (255.0 * np.minimum(values, 1.0) + 0.5).astype(np.uint8)


def _draw_spots(window: Window, places: np.ndarray) -> np.ndarray:
    """Return a channel (1, 64, 64) uint8 with a Gaussian spot at each place (J, 2 or more)."""
    deviation_m = 0.4
    rows, columns = window.centres_by_axis
    marks = np.zeros((CELLS, CELLS))
    for place in places:
        marks = np.maximum(marks, np.multiply.outer(
            np.exp(-0.5 * ((rows - place[0]) / deviation_m) ** 2),
            np.exp(-0.5 * ((columns - place[1]) / deviation_m) ** 2)))
    return _to_uint8(marks)[None]
