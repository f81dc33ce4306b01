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

"""The free plane: where cameras may be over the floor of a room, at one height."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

import numpy as np
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.geometry.plane_cells import close_cells, move_into_open_cells, nearest_rows
from ocp_ros.rig.motion import kept_inside, ROUNDING, towards
from ocp_ros.scenes.scene import MAX_EXTENT_M
from scipy import ndimage

#: Metres: the edge of a cell of the floor.
CELL_M = 0.2
#: Square metres: the smallest floor that counts.
MIN_FLOOR_AREA_M2 = 1.0
#: Metres: the default distance of cameras from every scanned surface. A camera inside a thin panel
#: would see both its sides.
CLEARANCE = 0.15
#: Metres: the rounding margin added to the clearance.
SLACK_M = 1e-4
#: Metres: the edge of the cells that are closed near surfaces.
FINE_CELL_M = 0.05


@dataclass(frozen=True)
class Floor:
    """
    The cells of a grid that have floor below them.

    :ivar low: (2,) metres, corner of the first cell.
    :ivar open: (X, Y) bool; at least one cell is open.
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
        """Return the nearest open cell in the column of each cell: (X, Y)."""
        return nearest_rows(self.open)

    def inside(self, positions: np.ndarray) -> np.ndarray:
        """Move positions (..., 2) that are over a closed cell into the nearest open one."""
        moved = np.array(positions, dtype=np.float64, order='C')
        move_into_open_cells(moved.reshape(-1, 2), self.low, self.edge, self._nearest)
        return moved

    @property
    def _middles(self) -> list[np.ndarray]:
        """Return x (X,) and y (Y,) of the cell centres, metres."""
        return [self.low[k] + self.edge * (np.arange(self.open.shape[k]) + 0.5) for k in (0, 1)]

    def within(self, low: np.ndarray, high: np.ndarray) -> 'Floor | None':
        """Keep the cells with their centre in a rectangle; None if there are none."""
        middles = self._middles
        within = np.logical_and.outer(*((middles[k] > low[k]) & (middles[k] < high[k])
                                        for k in (0, 1)))
        floor = replace(self, open=self.open & within)
        return floor if floor.open.any() else None

    def near(self, place: np.ndarray, reach: float) -> 'Floor':
        """Keep the cells with their centre within a distance, metres, of a position (2,)."""
        x, y = self._middles
        away = np.hypot.outer(x - place[0], y - place[1])
        return replace(self, open=self.open & (away <= reach + ROUNDING))

    def nearest_middle(self, place: np.ndarray) -> np.ndarray:
        """Return the centre of the open cell nearest to a position: (2,) metres."""
        cell = np.floor((self.inside(place) - self.low) / self.edge)
        return self.low + self.edge * (cell + 0.5)

    def reached(self, place: np.ndarray, step: float) -> Iterator['Floor']:
        """
        Yield the cells that a camera can reach with one move, with two moves and so on.

        A move ends over an open cell; obstacles on its way are ignored.

        :param place: (2,) metres, where it is.
        :param step: no move is longer, metres.
        :returns: the floors in turn, until no cell is added; none if the first move reaches no
            cell.
        """
        cells, count = self.near(place, step).open, 0
        while np.count_nonzero(cells) > count:
            yield replace(self, open=cells)
            count = np.count_nonzero(cells)
            away = ndimage.distance_transform_edt(~cells, sampling=self.edge)
            cells = self.open & (away <= step + ROUNDING)

    def cleared(self, points: np.ndarray, heights: np.ndarray, clearance: float
                ) -> 'Floor | None':
        """
        Close the cells too near to surfaces, and separated parts such as the inside of furniture.

        :param points: (N, 3) metres.
        :param heights: (2,) metres, the lowest and the highest camera.
        :param clearance: metres; every position in the open cells is at least this far from all
            points.
        :returns: the parts of at least the least floor area, or else the largest part; None if no
            cell stays open.
        """
        cells = self.open.copy()
        close_cells(points, heights, clearance + SLACK_M, self.low, self.edge, cells)
        parts, count = ndimage.label(cells)
        if count == 0:
            return None
        sizes = np.bincount(parts.ravel())
        sizes[0] = 0
        large = sizes >= min(MIN_FLOOR_AREA_M2 / self.edge ** 2, sizes.max())
        return replace(self, open=large[parts])


def floor_of(points: np.ndarray, height: float) -> Floor | None:
    """
    Find the floor of a room: cells with points below, small gaps closed, a cell away from walls.

    Rooms with an L-shape or at an angle do not fill their bounding boxes, and a camera outside the
    room would look through the back of a wall.

    :param points: (N, 3) metres, z up.
    :param height: the height of the cameras, metres.
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
    low = lowest - 4.0 * CELL_M
    cell = np.floor((below - low) / CELL_M).astype(np.int64)
    # A margin is needed, since cells at the edge of the grid would not be closed.
    # Radii of the gaps that are closed: the occlusion shadows of furniture, and in sparse scans
    # the space between points.
    radii_cells = (1, 2, 3, 5)
    cell, low = cell + max(radii_cells), low - max(radii_cells) * CELL_M
    seen = np.zeros(corners_of(cell)[1] + max(radii_cells) + 5, dtype=bool)
    seen[cell[:, 0], cell[:, 1]] = True
    widest = _largest_part(seen, radii_cells[-1])
    # The smallest radius is used whose floor has 60 % of the floor of the largest radius.
    enough = max(0.6 * np.count_nonzero(widest), MIN_FLOOR_AREA_M2 / CELL_M ** 2)
    parts = (_largest_part(seen, radius) for radius in radii_cells[:-1])
    part = next((part for part in parts if np.count_nonzero(part) >= enough), widest)
    return Floor(low.astype(np.float64), part) if np.count_nonzero(part) >= enough else None


def _closed(seen: np.ndarray, radius: int) -> np.ndarray:
    """Close gaps up to a radius, then all holes except large ones."""
    x, y = np.ogrid[-radius:radius + 1, -radius:radius + 1]
    closed = ndimage.binary_closing(seen, x * x + y * y <= radius ** 2)
    holes, _ = ndimage.label(ndimage.binary_fill_holes(closed) & ~closed)
    # Holes of more than 10 m2 are not occlusion shadows.
    small = np.bincount(holes.ravel()) * CELL_M ** 2 <= 10.0
    small[0] = False
    return closed | small[holes]


def _largest_part(seen: np.ndarray, radius: int) -> np.ndarray:
    """Close gaps, keep a cell away from the edge, and return the largest connected part."""
    cells = ndimage.binary_erosion(_closed(seen, radius))
    parts, _ = ndimage.label(cells)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return (parts == np.argmax(sizes)) & cells


def _fine(floor: Floor | None, low: np.ndarray, high: np.ndarray) -> Floor | None:
    """
    Divide a floor, or a whole rectangle, into cells small enough to be closed one by one.

    :param floor: the floor; None if it is unknown.
    :param low: (2,) metres, corner of the rectangle.
    :param high: (2,) metres, the other corner.
    :returns: the cells with their centre in the rectangle; None if there are none.
    """
    # With more cells the edge is doubled.
    max_cells = 100_000
    if floor is None:
        edge = FINE_CELL_M
        while np.prod((high - low) / edge) > max_cells:
            edge *= 2.0
        shape = np.ceil((high - low) / edge).astype(int)
        return Floor(low, np.ones(shape, dtype=bool), edge).within(low, high)
    rows, columns = (np.flatnonzero(floor.open.any(axis=axis)) for axis in (1, 0))
    cropped = floor.open[rows[0]:rows[-1] + 1, columns[0]:columns[-1] + 1]
    times = round(CELL_M / FINE_CELL_M)
    while times > 1 and cropped.size * times ** 2 > max_cells:
        times //= 2
    return Floor(floor.low + CELL_M * np.array([rows[0], columns[0]]),
                 cropped.repeat(times, axis=0).repeat(times, axis=1), CELL_M / times
                 ).within(low, high)


def _around(cells: Floor, position: np.ndarray, target: np.ndarray, straight: np.ndarray,
            step: float) -> np.ndarray:
    """Return the end of a move on a path to a target, near the straight move: (2,) metres."""
    # A camera farther away than 60 moves moves straight on.
    for floor in islice(cells.reached(target, step), 60):
        near = floor.near(position, step)
        if near.open.any():
            return near.nearest_middle(straight)
    return straight


@dataclass(frozen=True)
class FreePlane:
    """
    The space of cameras: a rectangle at a height, over the floor if it is known.

    :ivar low: (2,) lowest x and y, metres, map frame.
    :ivar high: (2,) highest x and y, metres.
    :ivar height: z, metres.
    :ivar cameras: K, the number of cameras.
    :ivar floor: the cells that cameras may be over; None for the whole rectangle.
    :ivar clearance: the least distance of all positions of the plane from all points, metres; 0
        for no limit.
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
        Build the space of a room.

        If no position has the required clearance, the clearance is ignored.

        :param points: (N, 3) metres, the room.
        :param height: z of the cameras, metres.
        :param cameras: K.
        :param margin: cameras stay this far inside the bounding box, metres.
        :param clearance: cameras keep this distance from all points, metres; 0 for no limit.
        :param heights: the heights of the lowest and the highest camera, metres, if they differ.
        """
        bounds = corners_of(points).astype(np.float64)
        corners, _ = kept_inside(bounds, bounds, margin)
        low, high = corners[:, :2]
        known = floor_of(points, height)
        floor = None if known is None else known.within(low, high)
        if clearance > 0.0:
            fine = _fine(floor and known, low, high)
            open_cells = fine and fine.cleared(
                points, np.array(heights or (height, height)), clearance)
            if open_cells is not None:
                return cls(low, high, height, cameras, open_cells, clearance)
        return cls(low, high, height, cameras, floor)

    @classmethod
    def around(cls, cloud: np.ndarray, positions: np.ndarray, margin: float, clearance: float
               ) -> 'FreePlane':
        """
        Build the space of cameras from the points they have seen, at their median height.

        :param cloud: (M, 3) metres: the points seen so far, M >= 1.
        :param positions: (K, 3) metres: the positions of the cameras.
        :param margin: as in :meth:`of`.
        :param clearance: as in :meth:`of`; it holds at the height of each camera.
        """
        z = positions[:, 2]
        return cls.of(cloud, float(np.median(z)), len(positions), margin, clearance,
                      (float(z.min()), float(z.max())))

    @property
    def size(self) -> np.ndarray:
        """Return the edges of the rectangle: (2,) metres."""
        return self.high - self.low

    @property
    def area(self) -> float:
        """Return the area that cameras may be over, square metres."""
        return float(np.prod(self.size)) if self.floor is None else self.floor.area

    def random(self, rng: np.random.Generator, cameras: int | None = None) -> np.ndarray:
        """Draw a placement, (cameras, 2), uniformly; K cameras by default."""
        count = self.cameras if cameras is None else cameras
        drawn = rng.uniform(self.low, self.high, (count, 2))
        while not (good := self.contains(drawn)).all():
            drawn[~good] = rng.uniform(self.low, self.high, (np.count_nonzero(~good), 2))
        return drawn

    def inside(self, positions: np.ndarray) -> np.ndarray:
        """Move positions (..., 2) to approximately the nearest allowed positions."""
        if self.floor is not None:
            positions = self.floor.inside(positions)
        return np.clip(positions, self.low, self.high)

    def contains(self, positions: np.ndarray) -> np.ndarray:
        """Return whether cameras may be at positions (..., 2): (...) bool."""
        return (np.abs(self.inside(positions) - positions) <= 1e-5).all(axis=-1)

    def moved(self, positions: np.ndarray, moves: np.ndarray, max_step: float) -> np.ndarray:
        """
        Move cameras so that a camera at an allowed position ends at one.

        :param positions: (K, 2) metres; a camera at a forbidden position that cannot reach an
            allowed one near its way moves freely.
        :param moves: (K, 2) metres; a camera with a zero move stays, also at a forbidden position.
        :param max_step: no camera moves farther, metres.
        :returns: (K, 2) metres.
        """
        target = positions + moves
        good = self.contains(positions)[:, None]
        ended = towards(positions, np.where(good, self.inside(target), target), max_step)
        return self._beside(positions, ended, max_step) if self.clearance else ended

    def _beside(self, positions: np.ndarray, ended: np.ndarray, reach: float) -> np.ndarray:
        """Move those ends of moves (K, 2) that are too near to surfaces to allowed positions."""
        ended, moving = ended.copy(), (ended != positions).any(axis=1)
        for camera in np.flatnonzero(moving & ~self.contains(ended)):
            here = positions[camera]
            # Shares of a move that are tried in turn if its end is too near to a surface.
            shares = (1.0, 0.75, 0.5, 0.25, 0.0)
            places = self.inside(here + np.outer(shares, ended[camera] - here))
            reached = np.linalg.norm(places - here, axis=1) <= reach
            if reached.any():
                ended[camera] = places[np.argmax(reached)]
        return ended

    def reached(self, position: np.ndarray, step: float, turns: int) -> 'FreePlane':
        """
        Return the space that a camera can reach in a number of turns, to about a cell.

        If a step is too short for the cells, or the first move reaches no cell, the result is the
        square around the camera whose half edge is ``turns`` steps.

        :param position: (2,) metres, where it is.
        :param step: no move is longer, metres.
        :param turns: the largest number of moves, 1 or more.
        """
        cells = self._cells_for(step)
        floors = [] if cells is None else list(islice(cells.reached(position, step), turns))
        if floors:
            return replace(self, floor=floors[-1])
        low, high = (np.clip(position + sign * turns * step, self.low, self.high)
                     for sign in (-1.0, 1.0))
        return replace(self, low=low, high=high)

    def on_way(self, positions: np.ndarray, targets: np.ndarray, step: float) -> np.ndarray:
        """
        Move from positions (K, 2) towards targets (K, 2), metres, by one move of at most a step.

        The move is straight if no path needs fewer turns, or if a step is too short for the cells.
        Otherwise it is the move nearest to the straight one that lies on the shortest path.

        :returns: (K, 2) metres.
        """
        ended = self._straight(positions, targets, step)
        cells = self._cells_for(step)
        if cells is None:
            return ended
        for camera, target in enumerate(targets):
            if not self._arrives(positions[camera], target, step, cells.edge):
                ended[camera] = _around(cells, positions[camera], target, ended[camera], step)
        return ended

    def _straight(self, positions: np.ndarray, targets: np.ndarray, step: float) -> np.ndarray:
        """Move straight from positions (K, 2) towards targets (K, 2), metres, by one move."""
        return self.moved(positions, towards(positions, targets, step) - positions, step)

    def _arrives(self, position: np.ndarray, target: np.ndarray, step: float, off: float) -> bool:
        """Return whether straight moves reach a target, to ``off`` metres, in the fewest turns."""
        turns = int(np.ceil(np.linalg.norm(target - position) / step))
        place, goal = position[None], target[None]
        for _ in range(turns):
            before = place
            place = self._straight(place, goal, step)
            if np.array_equal(place, before):
                break
        return bool(np.linalg.norm(place - goal) <= off)

    def _cells_for(self, step: float) -> Floor | None:
        """Return the cells of paths; None if they are too large for such a step."""
        cells = self._cells
        # A path over cells needs steps of two cells or more.
        return cells if cells is not None and step >= 2 * cells.edge else None

    @cached_property
    def _cells(self) -> Floor | None:
        """Return the cells that cameras may be over; None if there are none."""
        return self.floor or _fine(None, self.low, self.high)

    def folded(self, positions: np.ndarray) -> np.ndarray:
        """Reflect positions (..., 2) at the rectangle's edges, which keeps steps symmetric."""
        size = np.maximum(self.size, 1e-12)
        folded = np.mod(positions - self.low, 2.0 * size)
        return self.low + np.minimum(folded, 2.0 * size - folded)

    def reflected(self, positions: np.ndarray) -> np.ndarray:
        """Reflect positions (..., 2) at the edges and move them to allowed positions."""
        return self.inside(self.folded(positions))

    def grid(self, most: int) -> np.ndarray:
        """
        Return a regular grid of at most ``most`` positions: (M, 2), M >= 1.

        The cells around the positions are as square as possible.
        """
        if self.floor is None:
            return self._lattice(most)
        wanted = most * np.prod(self.size) / self.area
        while len(places := self._over_floor(int(wanted))) > most:
            wanted *= 0.97
        return places if len(places) else self.inside(0.5 * (self.low + self.high))[None]

    def _over_floor(self, count: int) -> np.ndarray:
        """Return the positions of a grid of the rectangle that cameras may be at."""
        places = self._lattice(max(count, 1))
        return places[self.contains(places)]

    def _lattice(self, most: int) -> np.ndarray:
        """Return a regular grid of the rectangle."""
        size = np.maximum(self.size, 1e-9)
        across = max(1, min(most, int(np.sqrt(most * size[0] / size[1]))))
        counts = across, max(1, most // across)
        axes = [self.low[k] + (np.arange(counts[k]) + 0.5) * size[k] / counts[k] for k in (0, 1)]
        return np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 2)

    def placement(self, positions: np.ndarray) -> np.ndarray:
        """Add the height of the cameras to positions (n, 2): (n, 3)."""
        return np.column_stack([positions, np.full(len(positions), self.height)])
