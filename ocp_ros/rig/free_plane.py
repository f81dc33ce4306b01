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
The free plane: where cameras may be over the floor of a room, at one height.

The kernels below use cells of a horizontal grid, an (X, Y) array. Contrary to an image, its rows
are numbered along x and its columns along y. Cameras may be in open cells only.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
import math

import numpy as np
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.rig.motion import kept_inside, ROUNDING, towards
from ocp_ros.scenes.scene import MAX_EXTENT_M
from ocp_ros.util.kernels import njit
from scipy import ndimage

#: The row of the nearest open cell, for a column without any.
NO_ROW = -1
#: Metres: the edge of a cell in which floor is searched for.
CELL_M = 0.2
#: Square metres: smaller floors are ignored.
MIN_FLOOR_AREA_M2 = 1.0
#: Metres: the default distance of cameras from every scanned surface. A camera inside a thin panel
#: would see both its sides.
CLEARANCE = 0.15
#: Metres: the rounding margin added to the clearance.
SLACK_M = 1e-4
#: Metres: the edge of the smaller cells that are closed near surfaces.
FINE_CELL_M = 0.05


@dataclass(frozen=True)
class Floor:
    """
    The open cells of a grid, those with floor below them.

    :ivar low: (2,) metres, corner of the first cell.
    :ivar open: (X, Y) bool, whether a cell is open, X cells along x and Y along y; one at least.
    :ivar edge: the edge of a cell, metres.
    """

    low: np.ndarray
    open: np.ndarray  # noqa: A003
    edge: float = CELL_M

    @property
    def area(self) -> float:
        """Return the area of the open cells, square metres."""
        return float(np.count_nonzero(self.open) * self.edge ** 2)

    @cached_property
    def _nearest(self) -> np.ndarray:
        """
        Return the row of the nearest open cell in the column of each cell: (X, Y) int32.

        Rows are numbered along x, columns along y.
        """
        return nearest_rows(self.open)

    def inside(self, positions: np.ndarray) -> np.ndarray:
        """Return positions (..., 2), metres, moved into the nearest open cells."""
        # In C order, reshape returns a view, so the function changes ``moved`` itself.
        moved = np.array(positions, dtype=np.float64, order='C')
        move_into_open_cells(moved.reshape(-1, 2), self.low, self.edge, self._nearest)
        return moved

    @property
    def _centres(self) -> list[np.ndarray]:
        """Return x (X,) and y (Y,) of the cell centres, metres."""
        return [self.low[k] + self.edge * (np.arange(self.open.shape[k]) + 0.5) for k in (0, 1)]

    def cropped_to(self, low: np.ndarray, high: np.ndarray) -> 'Floor | None':
        """Return the open cells with their centre in a rectangle; None if there are none."""
        centres = self._centres
        inside = np.logical_and.outer(*((centres[k] > low[k]) & (centres[k] < high[k])
                                        for k in (0, 1)))
        floor = replace(self, open=self.open & inside)
        return floor if floor.open.any() else None

    def cells_near(self, position: np.ndarray, radius: float) -> 'Floor':
        """Return the open cells with their centre within a radius, metres, of a position (2,)."""
        x, y = self._centres
        distance = np.hypot.outer(x - position[0], y - position[1])
        return replace(self, open=self.open & (distance <= radius + ROUNDING))

    def nearest_centre(self, position: np.ndarray) -> np.ndarray:
        """Return the centre of the open cell nearest to a position (2,): (2,) metres."""
        cell = np.floor((self.inside(position) - self.low) / self.edge)
        return self.low + self.edge * (cell + 0.5)

    def reachable_floors(self, position: np.ndarray, max_step: float) -> Iterator['Floor']:
        """
        Yield the cells that a camera can reach with one move, then those with two, and so on.

        A move ends over an open cell; obstacles between start and end are ignored. The iteration
        ends when a further move adds no cell. It yields nothing if the first move reaches no cell.

        :param position: (2,) metres, the position of the camera.
        :param max_step: the largest length of a move, metres.
        """
        cells = self.cells_near(position, max_step).open
        count = 0
        while np.count_nonzero(cells) > count:
            yield replace(self, open=cells)
            count = np.count_nonzero(cells)
            # The distance of each cell from the nearest cell reached so far, between the centres.
            distance = ndimage.distance_transform_edt(~cells, sampling=self.edge)
            cells = self.open & (distance <= max_step + ROUNDING)

    def with_clearance(self, points: np.ndarray, heights: np.ndarray, clearance: float
                       ) -> 'Floor | None':
        """
        Return the floor without cells too near to surfaces and without small separate parts.

        Such a part may be the inside of furniture.

        :param points: (N, 3) N points of surfaces, metres.
        :param heights: (2,) z of the lowest and of the highest camera, metres.
        :param clearance: the least distance between the open cells at these heights and all
            points, metres.
        :returns: the parts of at least ``MIN_FLOOR_AREA_M2``; the largest part if all are smaller;
            None if no cell stays open.
        """
        cells = self.open.copy()
        close_cells(points, heights, clearance + SLACK_M, self.low, self.edge, cells)
        parts, count = ndimage.label(cells)
        if count == 0:
            return None
        sizes = np.bincount(parts.ravel())
        # Label 0 is that of the closed cells.
        sizes[0] = 0
        large = sizes >= min(MIN_FLOOR_AREA_M2 / self.edge ** 2, sizes.max())
        return replace(self, open=large[parts])


def floor_of(points: np.ndarray, height: float) -> Floor | None:
    """
    Find the floor of a room: cells with points below, small gaps closed, a cell away from walls.

    Rooms with an L-shape or at an angle do not fill their bounding boxes, and a camera outside the
    room would look through the back of a wall.

    :param points: (N, 3) N points of the room, metres, z up.
    :param height: z of the cameras, metres.
    :returns: the largest connected part; None if there is too little floor, or if the points are
        too far apart to be a room.
    """
    # Points this far below the cameras are floor or furniture.
    below = points[np.flatnonzero(points[:, 2] < height - 0.3), :2]
    if len(below) == 0:
        return None
    lowest, highest = corners_of(below)
    if (highest - lowest).max() > MAX_EXTENT_M:
        return None
    # The grid has a margin of 4 cells on all sides.
    low = lowest - 4.0 * CELL_M
    indices = np.floor((below - low) / CELL_M).astype(np.int64)
    # Radii of the gaps that are filled: the occlusion shadows of furniture, and in sparse scans
    # the space between points.
    radii_cells = (1, 2, 3, 5)
    # The margin is increased by the largest radius on all sides, since gaps at the edge of the
    # grid would not be filled.
    indices = indices + max(radii_cells)
    low = low - max(radii_cells) * CELL_M
    # The size is the largest index plus 1, plus the margin: 4 cells and the largest radius.
    cells = np.zeros(corners_of(indices)[1] + max(radii_cells) + 5, dtype=bool)
    cells[indices[:, 0], indices[:, 1]] = True
    widest = _largest_part(cells, radii_cells[-1])
    # The smallest radius is used whose floor has 60 % of the floor of the largest radius.
    min_count = max(0.6 * np.count_nonzero(widest), MIN_FLOOR_AREA_M2 / CELL_M ** 2)
    parts = (_largest_part(cells, radius) for radius in radii_cells[:-1])
    part = next((part for part in parts if np.count_nonzero(part) >= min_count), widest)
    # ``widest`` itself may be smaller than the least area.
    return Floor(low.astype(np.float64), part) if np.count_nonzero(part) >= min_count else None


def _fill_gaps(cells: np.ndarray, radius: int) -> np.ndarray:
    """Return cells (X, Y) bool with gaps up to a radius in cells and small holes filled."""
    x, y = np.ogrid[-radius:radius + 1, -radius:radius + 1]
    filled = ndimage.binary_closing(cells, x * x + y * y <= radius ** 2)
    holes, _ = ndimage.label(ndimage.binary_fill_holes(filled) & ~filled)
    # Holes of more than 10 m2 are not occlusion shadows.
    small = np.bincount(holes.ravel()) * CELL_M ** 2 <= 10.0
    # Label 0 is that of all cells outside of holes.
    small[0] = False
    return filled | small[holes]


def _largest_part(cells: np.ndarray, radius: int) -> np.ndarray:
    """Fill gaps, keep a cell away from the edge, and return the largest connected part."""
    cells = ndimage.binary_erosion(_fill_gaps(cells, radius))
    parts, _ = ndimage.label(cells)
    sizes = np.bincount(parts.ravel())
    # Label 0 is that of the other cells. If there is no part, ``argmax`` returns 0 too, but then
    # ``cells`` is False everywhere.
    sizes[0] = 0
    return (parts == np.argmax(sizes)) & cells


def _fine_cells(floor: Floor | None, low: np.ndarray, high: np.ndarray) -> Floor | None:
    """
    Divide a floor, or a whole rectangle, into cells small enough to be closed near surfaces.

    :param floor: the floor, in cells of ``CELL_M``; None if it is unknown, then all cells of the
        rectangle are open.
    :param low: (2,) metres, the lowest corner of the rectangle.
    :param high: (2,) metres, its highest corner.
    :returns: the cells with their centre in the rectangle; None if there are none.
    """
    # Cells are made larger until there are at most this many.
    max_cells = 100_000
    if floor is None:
        edge = FINE_CELL_M
        while np.prod((high - low) / edge) > max_cells:
            edge *= 2.0
        shape = np.ceil((high - low) / edge).astype(int)
        return Floor(low, np.ones(shape, dtype=bool), edge).cropped_to(low, high)
    # Only the part of the grid that has open cells is divided. Rows are along x, columns along y.
    rows, columns = (np.flatnonzero(floor.open.any(axis=axis)) for axis in (1, 0))
    cropped = floor.open[rows[0]:rows[-1] + 1, columns[0]:columns[-1] + 1]
    divisions = round(CELL_M / FINE_CELL_M)
    while divisions > 1 and cropped.size * divisions ** 2 > max_cells:
        divisions //= 2
    return Floor(floor.low + CELL_M * np.array([rows[0], columns[0]]),
                 cropped.repeat(divisions, axis=0).repeat(divisions, axis=1), CELL_M / divisions
                 ).cropped_to(low, high)


def _next_on_path(cells: Floor, position: np.ndarray, target: np.ndarray, straight: np.ndarray,
                  max_step: float) -> np.ndarray:
    """
    Return the end of the first move on a shortest path to a target: (2,) metres.

    :param cells: the cells that moves may end in.
    :param position: (2,) metres, the position of the camera.
    :param target: (2,) metres.
    :param straight: (2,) metres, the end of the straight move; the end nearest to it is chosen.
    :param max_step: the largest length of a move, metres.
    """
    # Work backwards from the target: the n-th set has the cells from which the target is at most
    # n moves away. The smallest set with a cell within reach of the camera is on a shortest path.
    # If more than 60 moves are needed, the camera moves straight on.
    for cells_before in islice(cells.reachable_floors(target, max_step), 60):
        near = cells_before.cells_near(position, max_step)
        if near.open.any():
            return near.nearest_centre(straight)
    return straight


@dataclass(frozen=True)
class FreePlane:
    """
    The positions that cameras may be at: a rectangle at a height, over the floor if it is known.

    :ivar low: (2,) lowest x and y, metres, map frame.
    :ivar high: (2,) highest x and y, metres.
    :ivar height: z, metres.
    :ivar cameras: K, the number of cameras, whose positions :meth:`random` draws by default.
    :ivar floor: the cells that cameras may be over; None for the whole rectangle.
    :ivar clearance: the least distance of all these positions from all points, metres; 0 for no
        limit.
    """

    low: np.ndarray
    high: np.ndarray
    height: float
    cameras: int
    floor: Floor | None = None
    clearance: float = 0.0

    @classmethod
    def of(cls, points: np.ndarray, height: float, cameras: int, margin: float,
           clearance: float = CLEARANCE, heights: tuple[float, float] | None = None
           ) -> 'FreePlane':
        """
        Build the free plane of a room.

        If no position has the required clearance, the clearance is ignored.

        :param points: (N, 3) metres, the N points of the room.
        :param height: z of the cameras, metres.
        :param cameras: K, the number of cameras, whose positions :meth:`random` draws by default.
        :param margin: cameras stay this far inside the bounding box, metres.
        :param clearance: cameras keep this distance from all points, metres; 0 for no limit.
        :param heights: z of the lowest and of the highest camera, metres, if they differ.
        """
        bounds = corners_of(points).astype(np.float64)
        # The corners of the bounding box, moved inwards by the margin.
        corners, _ = kept_inside(bounds, bounds, margin)
        low, high = corners[:, :2]
        known = floor_of(points, height)
        floor = None if known is None else known.cropped_to(low, high)
        if clearance > 0.0:
            # A floor without cells in the rectangle counts as unknown.
            fine = _fine_cells(None if floor is None else known, low, high)
            open_cells = None if fine is None else fine.with_clearance(
                points, np.array(heights or (height, height)), clearance)
            if open_cells is not None:
                return cls(low, high, height, cameras, open_cells, clearance)
        return cls(low, high, height, cameras, floor)

    @classmethod
    def around(cls, cloud: np.ndarray, positions: np.ndarray, margin: float, clearance: float,
               allowed: Callable[[np.ndarray], np.ndarray] | None = None) -> 'FreePlane':
        """
        Build the free plane of cameras from the points they have seen, at their median height.

        :param cloud: (M, 3) metres: the M >= 1 points seen so far.
        :param positions: (K, 3) metres: the positions of the cameras.
        :param margin: as in :meth:`of`.
        :param clearance: as in :meth:`of`; it holds at the height of each camera.
        :param allowed: gets places (P, 3), metres, and returns which of these are allowed: (P,)
            bool; None for all. If it allows none, it is ignored.
        """
        z = positions[:, 2]
        space = cls.of(cloud, float(np.median(z)), len(positions), margin, clearance,
                       (float(z.min()), float(z.max())))
        if allowed is None or (cells := space._cells) is None:
            return space
        numbers = np.argwhere(cells.open)
        is_open = np.zeros_like(cells.open)
        is_open[tuple(numbers.T)] = allowed(
            space.placement(cells.low + cells.edge * (numbers + 0.5)))
        return replace(space, floor=replace(cells, open=is_open)) if is_open.any() else space

    @property
    def size(self) -> np.ndarray:
        """Return the edges of the rectangle: (2,) metres."""
        return self.high - self.low

    @property
    def area(self) -> float:
        """Return the area that cameras may be over, square metres."""
        return float(np.prod(self.size)) if self.floor is None else self.floor.area

    def random(self, rng: np.random.Generator, cameras: int | None = None) -> np.ndarray:
        """Draw allowed positions (cameras, 2), metres, uniformly; for K cameras by default."""
        count = self.cameras if cameras is None else cameras
        drawn = rng.uniform(self.low, self.high, (count, 2))
        while not (allowed := self.contains(drawn)).all():
            drawn[~allowed] = rng.uniform(self.low, self.high, (np.count_nonzero(~allowed), 2))
        return drawn

    def inside(self, positions: np.ndarray) -> np.ndarray:
        """Return positions (..., 2), metres, moved to about the nearest allowed positions."""
        if self.floor is not None:
            positions = self.floor.inside(positions)
        return np.clip(positions, self.low, self.high)

    def contains(self, positions: np.ndarray) -> np.ndarray:
        """Return whether cameras may be at positions (..., 2), metres: (...) bool."""
        return (np.abs(self.inside(positions) - positions) <= 1e-5).all(axis=-1)

    def moved(self, positions: np.ndarray, moves: np.ndarray, max_step: float) -> np.ndarray:
        """
        Return the positions of cameras after a move; an allowed position leads to an allowed one.

        :param positions: (K, 2) metres; a camera at a forbidden position moves freely if it cannot
            reach an allowed position near its move.
        :param moves: (K, 2) metres; a camera with a zero move stays, also at a forbidden position.
        :param max_step: the largest length of a move, metres.
        :returns: (K, 2) metres.
        """
        targets = positions + moves
        allowed = self.contains(positions)[:, None]
        ends = towards(positions, np.where(allowed, self.inside(targets), targets), max_step)
        return self._free_ends(positions, ends, max_step) if self.clearance else ends

    def _free_ends(self, positions: np.ndarray, ends: np.ndarray, max_step: float) -> np.ndarray:
        """Return the ends (K, 2) of moves; forbidden ends are moved to allowed positions."""
        moving = (ends != positions).any(axis=1)
        ends = ends.copy()
        for camera in np.flatnonzero(moving & ~self.contains(ends)):
            start = positions[camera]
            # The allowed position nearest to the end may be too far away. Therefore shorter and
            # shorter shares of the move are tried, until the nearest allowed position is within
            # reach: ``argmax`` returns the first such share. If there is none, the end stays.
            shares = (1.0, 0.75, 0.5, 0.25, 0.0)
            places = self.inside(start + np.outer(shares, ends[camera] - start))
            reachable = np.linalg.norm(places - start, axis=1) <= max_step
            if reachable.any():
                ends[camera] = places[np.argmax(reachable)]
        return ends

    def reached(self, position: np.ndarray, max_step: float, turns: int) -> 'FreePlane':
        """
        Return the positions that a camera can reach in a number of turns, to about a cell.

        If ``max_step`` is too short for the cells, or the first move reaches no cell, the result
        is the square around the camera whose half edge is ``turns`` moves.

        :param position: (2,) metres, the position of the camera.
        :param max_step: the largest length of a move, metres.
        :param turns: the largest number of moves, 1 or more.
        """
        cells = self._cells_for(max_step)
        if cells is not None and (reached_cells := list(
                islice(cells.reachable_floors(position, max_step), turns))):
            return replace(self, floor=reached_cells[-1])
        low, high = (np.clip(position + sign * turns * max_step, self.low, self.high)
                     for sign in (-1.0, 1.0))
        return replace(self, low=low, high=high)

    def on_way(self, positions: np.ndarray, targets: np.ndarray, max_step: float) -> np.ndarray:
        """
        Return the positions of cameras after one move towards their targets.

        The move is straight if no path needs fewer turns, or if ``max_step`` is too short for the
        cells. Otherwise it is the move nearest to the straight one that lies on a shortest path.

        :param positions: (K, 2) metres.
        :param targets: (K, 2) metres.
        :param max_step: the largest length of a move, metres.
        :returns: (K, 2) metres.
        """
        ends = self._straight_ends(positions, targets, max_step)
        cells = self._cells_for(max_step)
        if cells is None:
            return ends
        for camera, (position, target) in enumerate(zip(positions, targets)):
            if not self._straight_moves_arrive(position, target, max_step, cells.edge):
                ends[camera] = _next_on_path(cells, position, target, ends[camera], max_step)
        return ends

    def _straight_ends(self, positions: np.ndarray, targets: np.ndarray, max_step: float
                       ) -> np.ndarray:
        """Return the ends (K, 2) of straight moves from positions towards targets (K, 2)."""
        return self.moved(positions, towards(positions, targets, max_step) - positions, max_step)

    def _straight_moves_arrive(self, position: np.ndarray, target: np.ndarray, max_step: float,
                               tolerance: float) -> bool:
        """Return whether straight moves reach a target, to a tolerance, in the fewest turns."""
        turns = int(np.ceil(np.linalg.norm(target - position) / max_step))
        place, goal = position[None], target[None]
        for _ in range(turns):
            previous = place
            place = self._straight_ends(place, goal, max_step)
            if np.array_equal(place, previous):
                break
        return bool(np.linalg.norm(place - goal) <= tolerance)

    def _cells_for(self, max_step: float) -> Floor | None:
        """Return the cells of paths; None if they are too large for moves of this length."""
        cells = self._cells
        # A path over cells needs moves of two cells or more.
        return cells if cells is not None and max_step >= 2 * cells.edge else None

    @cached_property
    def _cells(self) -> Floor | None:
        """Return the cells that cameras may be over; None if there are none."""
        return self.floor or _fine_cells(None, self.low, self.high)

    def folded(self, positions: np.ndarray) -> np.ndarray:
        """
        Return positions (..., 2) reflected at the rectangle's edges.

        So a random step from one position to another stays as likely as the step back.
        """
        # A coordinate that increases goes to and fro over the rectangle. One period is twice its
        # edge long.
        size = np.maximum(self.size, 1e-12)
        folded = np.mod(positions - self.low, 2.0 * size)
        return self.low + np.minimum(folded, 2.0 * size - folded)

    def reflected(self, positions: np.ndarray) -> np.ndarray:
        """Return positions (..., 2) reflected at the edges and moved to allowed positions."""
        return self.inside(self.folded(positions))

    def grid(self, max_count: int) -> np.ndarray:
        """
        Return the allowed positions of a regular grid: (M, 2) metres.

        The cells around the positions are as square as possible.

        :param max_count: the largest number of positions; M is 1 or more.
        """
        if self.floor is None:
            return self._rectangle_grid(max_count)
        # A grid of the whole rectangle with this number of positions has about ``max_count`` that
        # are allowed. The grid gets coarser until there are at most ``max_count`` of them.
        wanted = max_count * np.prod(self.size) / self.area
        while len(places := self._allowed_grid(int(wanted))) > max_count:
            wanted *= 0.97
        return places if len(places) else self.inside(0.5 * (self.low + self.high))[None]

    def _allowed_grid(self, max_count: int) -> np.ndarray:
        """Return the allowed positions (M, 2) of a grid of the whole rectangle."""
        places = self._rectangle_grid(max(max_count, 1))
        return places[self.contains(places)]

    def _rectangle_grid(self, max_count: int) -> np.ndarray:
        """Return a regular grid (M, 2) of at most ``max_count`` positions in the rectangle."""
        size = np.maximum(self.size, 1e-9)
        # With this number of positions along x, the cells around positions are about square.
        x_count = max(1, min(max_count, int(np.sqrt(max_count * size[0] / size[1]))))
        counts = x_count, max(1, max_count // x_count)
        axes = [self.low[k] + (np.arange(counts[k]) + 0.5) * size[k] / counts[k] for k in (0, 1)]
        return np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 2)

    def placement(self, positions: np.ndarray) -> np.ndarray:
        """Return positions (M, 2) with the height of the cameras added: (M, 3) metres."""
        return np.column_stack([positions, np.full(len(positions), self.height)])


@njit(cache=True, nogil=True)
def close_cells(points, heights, clearance, low, edge, cells):
    """
    Close the cells in which a camera may come nearer to a point than a given distance, in 3D.

    :param points: (N, 3) N points of surfaces, metres.
    :param heights: (2,) the lowest and the highest z of cameras, metres.
    :param clearance: the distance, metres.
    :param low: (2,) metres, corner of the first cell.
    :param edge: the edge of a cell, metres.
    :param cells: (X, Y) bool, in and out, whether a cell is open; closed cells become False.
    """
    for point in range(len(points)):
        z = points[point, 2]
        height_gap = max(heights[0] - z, z - heights[1], 0.0)
        if height_gap >= clearance:
            continue
        # The disc in which the sphere of radius ``clearance`` around the point meets the nearest
        # plane of cameras: its radius and its centre in units of cells.
        radius = math.sqrt(clearance * clearance - height_gap * height_gap) / edge
        x, y = (points[point, 0] - low[0]) / edge, (points[point, 1] - low[1]) / edge
        first, last = int(math.floor(x - radius)), int(math.floor(x + radius))
        for i in range(max(first, 0), min(last + 1, cells.shape[0])):
            row_gap = max(i - x, x - (i + 1), 0.0)
            half_width = math.sqrt(max(radius * radius - row_gap * row_gap, 0.0))
            begin, end = int(math.floor(y - half_width)), int(math.floor(y + half_width))
            for j in range(max(begin, 0), min(end + 1, cells.shape[1])):
                cells[i, j] = False


@njit(cache=True, nogil=True)
def nearest_rows(cells):
    """
    Return the row of the open cell nearest to each cell in the same column.

    :param cells: (X, Y) bool, whether a cell is open.
    :returns: (X, Y) int32, the lower row of two equally near ones; ``NO_ROW`` if the column has no
        open cell.
    """
    rows, columns = cells.shape
    nearest = np.full(cells.shape, NO_ROW, dtype=np.int32)
    # Upwards: the nearest open cell in this row or a lower one.
    for i in range(rows):
        for j in range(columns):
            if cells[i, j]:
                nearest[i, j] = i
            elif i > 0:
                nearest[i, j] = nearest[i - 1, j]
    # Downwards: an open cell in a higher row replaces that cell if it is nearer.
    for i in range(rows - 2, -1, -1):
        for j in range(columns):
            upper = nearest[i + 1, j]
            if upper > i and (nearest[i, j] == NO_ROW or upper - i < i - nearest[i, j]):
                nearest[i, j] = upper
    return nearest


@njit(cache=True, nogil=True)
def move_into_open_cells(positions, low, edge, nearest):
    """
    Move positions into the nearest open cells, a micrometre from their edges, in place.

    Of equally near cells, that with the lowest column is taken, then that with the lowest row.

    :param positions: (M, 2) float64, x and y of M positions, metres, in and out; outside the grid,
        the cell of a position is the nearest one.
    :param low: (2,) metres, corner of the first cell.
    :param edge: the edge of a cell, metres.
    :param nearest: (X, Y) int32, from :func:`nearest_rows`; at least one cell has to be open.
    """
    rows, columns = nearest.shape
    inset_m = 1e-6
    for m in range(len(positions)):
        i = int(min(max(math.floor((positions[m, 0] - low[0]) / edge), 0), rows - 1))
        j = int(min(max(math.floor((positions[m, 1] - low[1]) / edge), 0), columns - 1))
        # The least squared distance of an open cell so far, in cells, and that cell. Columns are
        # tried from the nearest on, until their distance alone is too large.
        least, best_row, best_column = rows * rows + columns * columns, i, j
        for gap in range(max(j, columns - 1 - j) + 1):
            if gap * gap > least:
                break
            for column in (j - gap, j + gap):
                if 0 <= column < columns and nearest[i, column] != NO_ROW:
                    squared = gap * gap + (nearest[i, column] - i) ** 2
                    if squared < least or (squared == least and column < best_column):
                        least, best_row, best_column = squared, nearest[i, column], column
        for k, index in enumerate((best_row, best_column)):
            corner = low[k] + edge * index
            positions[m, k] = min(max(positions[m, k], corner + inset_m), corner + edge - inset_m)
