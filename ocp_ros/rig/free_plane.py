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

"""Where cameras may be: over the floor of a room, at one height."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

import numpy as np
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.geometry.plane_cells import close_near, moved_into, nearest_rows
from ocp_ros.rig.motion import kept_inside, ROUNDING, towards
from ocp_ros.scenes.scene import LARGEST
from scipy import ndimage

#: Metres: edge of a cell of the floor, and how far below the cameras things are that count as it.
EDGE, BELOW = 0.2, 0.3
#: Radii, in cells, of the gaps between points that are closed: furniture's shadows, and where
#: points are few all that lies between them. The least is taken whose floor is worth such a share
#: of that of the largest.
RADII, LEAST_SHARE = (1, 2, 3, 5), 0.6
#: Square metres: larger holes are no shadows, and the smallest floor that counts.
HOLE, LEAST = 10.0, 1.0
#: Metres that cameras keep from every surface that has been scanned, unless a setting says
#: otherwise: one inside a thin panel sees both sides of it.
CLEARANCE = 0.15
#: Metres: edge of the cells that are closed near surfaces, and how much farther than the clearance
#: these are, for rounding. Where there are more cells than so many, their edge is doubled.
FINE_EDGE, SLACK, MOST_CELLS = 0.05, 1e-4, 100_000
#: How many cells a step has to be long for ways over cells, and the moves of the longest way that
#: is sought: who is farther away goes straight on.
CELLS_A_STEP, MOST_MOVES = 2, 60
#: Shares of a way that are tried one after the other where its end is too near to a surface.
SHORTENED = (1.0, 0.75, 0.5, 0.25, 0.0)


@dataclass(frozen=True)
class Floor:
    """
    The cells of a grid that have a room below them.

    :ivar low: (2,) metres, corner of the first cell.
    :ivar open: (X, Y) bool; at least one cell is open.
    :ivar edge: of the cells, metres.
    """

    low: np.ndarray
    open: np.ndarray  # noqa: A003
    edge: float = EDGE

    @property
    def area(self) -> float:
        """Return the area of the open cells, square metres."""
        return float(np.count_nonzero(self.open) * self.edge ** 2)

    @cached_property
    def _nearest(self) -> np.ndarray:
        """Return (X, Y) which open cell of its column is nearest to each."""
        return nearest_rows(self.open)

    def inside(self, positions: np.ndarray) -> np.ndarray:
        """Move positions (..., 2) that are over a closed cell into the nearest open one."""
        moved = np.array(positions, dtype=np.float64, order='C')
        moved_into(moved.reshape(-1, 2), self.low, self.edge, self._nearest)
        return moved

    @property
    def _middles(self) -> list[np.ndarray]:
        """Return the x (X,) and the y (Y,) of the middles of the cells, metres."""
        return [self.low[k] + self.edge * (np.arange(self.open.shape[k]) + 0.5) for k in (0, 1)]

    def within(self, low: np.ndarray, high: np.ndarray) -> 'Floor | None':
        """Keep the cells whose middle is in a rectangle; None if there is none."""
        middles = self._middles
        within = np.logical_and.outer(*((middles[k] > low[k]) & (middles[k] < high[k])
                                        for k in (0, 1)))
        floor = replace(self, open=self.open & within)
        return floor if floor.open.any() else None

    def near(self, place: np.ndarray, reach: float) -> 'Floor':
        """Keep the cells whose middle is no farther than a reach, metres, from a place (2,)."""
        x, y = self._middles
        away = np.hypot.outer(x - place[0], y - place[1])
        return replace(self, open=self.open & (away <= reach + ROUNDING))

    def nearest_middle(self, place: np.ndarray) -> np.ndarray:
        """Return the middle of the open cell that is nearest to a place: (2,) metres."""
        cell = np.floor((self.inside(place) - self.low) / self.edge)
        return self.low + self.edge * (cell + 0.5)

    def reached(self, place: np.ndarray, step: float) -> Iterator['Floor']:
        """
        Tell where a camera can be after one move, after two and so on.

        A move ends over an open cell; what is on its way does not matter.

        :param place: (2,) metres, where it is.
        :param step: no move is longer, metres.
        :returns: one after the other, until no cell is added any more; none where the first move
            leads nowhere.
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
        Close what is too near to surfaces, and what these cut off: the inside of furniture.

        :param points: (N, 3) metres.
        :param heights: (2,) metres, lowest and highest of the cameras.
        :param clearance: metres; all places of the cells that stay open are as far from all
            points.
        :returns: the parts that are no smaller than the smallest floor that counts, or the
            largest one; None if nothing stays open.
        """
        cells = self.open.copy()
        close_near(points, heights, clearance + SLACK, self.low, self.edge, cells)
        parts, count = ndimage.label(cells)
        if count == 0:
            return None
        sizes = np.bincount(parts.ravel())
        sizes[0] = 0
        large = sizes >= min(LEAST / self.edge ** 2, sizes.max())
        return replace(self, open=large[parts])


def floor_of(points: np.ndarray, height: float) -> Floor | None:
    """
    Find where a room is: things lie below, or in small gaps between them; walls are a cell away.

    Rooms fill their bounding boxes badly where they are L-shaped or stand askew, and a camera
    outside would look through the back of a wall.

    :param points: (N, 3) metres, z up.
    :param height: of the cameras, metres.
    :returns: the largest connected part; None if there is hardly any floor to be seen, only scraps
        of it, or points so far apart that they are no room.
    """
    below = points[np.flatnonzero(points[:, 2] < height - BELOW), :2]
    if len(below) == 0:
        return None
    lowest, highest = corners_of(below)
    if (highest - lowest).max() > LARGEST:
        return None
    low = lowest - 4.0 * EDGE
    cell = np.floor((below - low) / EDGE).astype(np.int64)
    # Cells at the edge of the grid would not be closed.
    cell, low = cell + max(RADII), low - max(RADII) * EDGE
    seen = np.zeros(corners_of(cell)[1] + max(RADII) + 5, dtype=bool)
    seen[cell[:, 0], cell[:, 1]] = True
    widest = _largest_part(seen, RADII[-1])
    enough = max(LEAST_SHARE * np.count_nonzero(widest), LEAST / EDGE ** 2)
    parts = (_largest_part(seen, radius) for radius in RADII[:-1])
    part = next((part for part in parts if np.count_nonzero(part) >= enough), widest)
    return Floor(low.astype(np.float64), part) if np.count_nonzero(part) >= enough else None


def _closed(seen: np.ndarray, radius: int) -> np.ndarray:
    """Close gaps up to a radius, and what holes are then left but for large ones."""
    x, y = np.ogrid[-radius:radius + 1, -radius:radius + 1]
    closed = ndimage.binary_closing(seen, x * x + y * y <= radius ** 2)
    holes, _ = ndimage.label(ndimage.binary_fill_holes(closed) & ~closed)
    small = np.bincount(holes.ravel()) * EDGE ** 2 <= HOLE
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
    Divide a floor, or all of a rectangle, into cells small enough to be closed one by one.

    :param floor: None where none is known.
    :param low: (2,) metres, corner of the rectangle.
    :param high: (2,) metres, the other corner.
    :returns: the cells whose middle is in the rectangle; None if there is none.
    """
    if floor is None:
        edge = FINE_EDGE
        while np.prod((high - low) / edge) > MOST_CELLS:
            edge *= 2.0
        shape = np.ceil((high - low) / edge).astype(int)
        return Floor(low, np.ones(shape, dtype=bool), edge).within(low, high)
    rows, columns = (np.flatnonzero(floor.open.any(axis=axis)) for axis in (1, 0))
    cropped = floor.open[rows[0]:rows[-1] + 1, columns[0]:columns[-1] + 1]
    times = round(EDGE / FINE_EDGE)
    while times > 1 and cropped.size * times ** 2 > MOST_CELLS:
        times //= 2
    return Floor(floor.low + EDGE * np.array([rows[0], columns[0]]),
                 cropped.repeat(times, axis=0).repeat(times, axis=1), EDGE / times
                 ).within(low, high)


def _around(cells: Floor, position: np.ndarray, target: np.ndarray, straight: np.ndarray,
            step: float) -> np.ndarray:
    """Return the end of a move towards a target, next to a straight one: (2,) metres."""
    for floor in islice(cells.reached(target, step), MOST_MOVES):
        near = floor.near(position, step)
        if near.open.any():
            return near.nearest_middle(straight)
    return straight


@dataclass(frozen=True)
class FreePlane:
    """
    Where cameras may be: in a rectangle at a height, and over the floor where it is known.

    :ivar low: (2,) lowest x and y, metres, map frame.
    :ivar high: (2,) highest x and y, metres.
    :ivar height: z, metres.
    :ivar cameras: K, how many there are.
    :ivar floor: the cells they may be over; None for the whole rectangle.
    :ivar clearance: metres that all places of the plane are from all points at least; 0 if they
        may be anywhere.
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

        Where no place is as far from all surfaces as asked, the plane is as if nothing were asked.

        :param points: (N, 3) metres, the room.
        :param height: z of the cameras, metres.
        :param cameras: K.
        :param margin: cameras stay this far inside the bounding box, metres.
        :param clearance: cameras stay this far from all points, metres; 0 for those that may
            stand anywhere.
        :param heights: of the lowest and the highest camera, metres, where they differ.
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
        Build the space of cameras from what they have seen, at their median height.

        :param cloud: (M, 3) metres: the points seen so far, M >= 1.
        :param positions: (K, 3) metres: where the cameras are.
        :param margin: of :meth:`of`.
        :param clearance: of :meth:`of`; it holds at the height of each camera.
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
        """Return how much floor there is to be over, square metres."""
        return float(np.prod(self.size)) if self.floor is None else self.floor.area

    def random(self, rng: np.random.Generator, cameras: int | None = None) -> np.ndarray:
        """Draw a placement, (cameras, 2), uniformly; K cameras by default."""
        count = self.cameras if cameras is None else cameras
        drawn = rng.uniform(self.low, self.high, (count, 2))
        while not (good := self.contains(drawn)).all():
            drawn[~good] = rng.uniform(self.low, self.high, (np.count_nonzero(~good), 2))
        return drawn

    def inside(self, positions: np.ndarray) -> np.ndarray:
        """Move positions (..., 2) to the nearest place where cameras may be, roughly."""
        if self.floor is not None:
            positions = self.floor.inside(positions)
        return np.clip(positions, self.low, self.high)

    def contains(self, positions: np.ndarray) -> np.ndarray:
        """Tell of positions (..., 2) whether cameras may be there: (...) bool."""
        return (np.abs(self.inside(positions) - positions) <= 1e-5).all(axis=-1)

    def moved(self, positions: np.ndarray, moves: np.ndarray, max_step: float) -> np.ndarray:
        """
        Move cameras, but none away from where it may be.

        :param positions: (K, 2) metres; who is not where it may be, and does not reach a place
            near its way where it may, goes as it likes.
        :param moves: (K, 2) metres; who does not move stays, wherever it is.
        :param max_step: no camera moves farther, metres.
        :returns: (K, 2) metres.
        """
        target = positions + moves
        good = self.contains(positions)[:, None]
        ended = towards(positions, np.where(good, self.inside(target), target), max_step)
        return self._beside(positions, ended, max_step) if self.clearance else ended

    def _beside(self, positions: np.ndarray, ended: np.ndarray, reach: float) -> np.ndarray:
        """Move ends of ways (K, 2) that are too near to surfaces to places that are not."""
        ended, moving = ended.copy(), (ended != positions).any(axis=1)
        for camera in np.flatnonzero(moving & ~self.contains(ended)):
            here = positions[camera]
            places = self.inside(here + np.outer(SHORTENED, ended[camera] - here))
            reached = np.linalg.norm(places - here, axis=1) <= reach
            if reached.any():
                ended[camera] = places[np.argmax(reached)]
        return ended

    def reached(self, position: np.ndarray, step: float, turns: int) -> 'FreePlane':
        """
        Return where a camera can be in time, to about a cell.

        Where steps are short for the cells, or where the first move leads nowhere, that is the
        square around it with edges of twice so many steps.

        :param position: (2,) metres, where it is.
        :param step: no move is longer, metres.
        :param turns: that many moves at most, 1 or more.
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
        Go from positions (K, 2) to targets (K, 2), metres, by one move no longer than a step.

        It is the straight one where no other leads there in fewer turns, or where steps are short
        for the cells, and otherwise the one next to it that does.

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
        """Go straight from positions (K, 2) to targets (K, 2), metres, by one move."""
        return self.moved(positions, towards(positions, targets, step) - positions, step)

    def _arrives(self, position: np.ndarray, target: np.ndarray, step: float, off: float) -> bool:
        """Return whether a straight way, in as few turns as can be, ends next to a target."""
        turns = int(np.ceil(np.linalg.norm(target - position) / step))
        place, goal = position[None], target[None]
        for _ in range(turns):
            before = place
            place = self._straight(place, goal, step)
            if np.array_equal(place, before):
                break
        return bool(np.linalg.norm(place - goal) <= off)

    def _cells_for(self, step: float) -> Floor | None:
        """Return the cells that ways lead over; None where they are too large for such a step."""
        cells = self._cells
        return cells if cells is not None and step >= CELLS_A_STEP * cells.edge else None

    @cached_property
    def _cells(self) -> Floor | None:
        """Return the cells that cameras may be over; None if there is none."""
        return self.floor or _fine(None, self.low, self.high)

    def folded(self, positions: np.ndarray) -> np.ndarray:
        """Fold positions (..., 2) back at the rectangle's edges: a symmetric step stays so."""
        size = np.maximum(self.size, 1e-12)
        folded = np.mod(positions - self.low, 2.0 * size)
        return self.low + np.minimum(folded, 2.0 * size - folded)

    def reflected(self, positions: np.ndarray) -> np.ndarray:
        """Fold positions (..., 2) back at the edges and move them to where cameras may be."""
        return self.inside(self.folded(positions))

    def grid(self, most: int) -> np.ndarray:
        """
        Return a regular grid of at most so many places: (M, 2), M >= 1.

        The cells that the places are the middles of are as square as can be.
        """
        if self.floor is None:
            return self._lattice(most)
        wanted = most * np.prod(self.size) / self.area
        while len(places := self._over_floor(int(wanted))) > most:
            wanted *= 0.97
        return places if len(places) else self.inside(0.5 * (self.low + self.high))[None]

    def _over_floor(self, count: int) -> np.ndarray:
        """Return the places of a grid of the rectangle where cameras may be."""
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
        """Put positions (n, 2) at the height of the cameras: (n, 3)."""
        return np.column_stack([positions, np.full(len(positions), self.height)])
