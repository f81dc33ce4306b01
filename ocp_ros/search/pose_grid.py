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

"""Poses of a camera on a grid of positions and headings, and the visible points of each pose."""

from collections.abc import Callable, Sequence
from copy import copy
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.rig.feasible_region import FeasibleRegion
from ocp_ros.rig.placement_file import as_written
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.util.threads import mapped
from scipy.spatial import cKDTree

#: Approximate largest number of poses; if there would be more, places are farther apart.
MAX_GRID_POSES = 40_000


class PlaceView(NamedTuple):
    """
    The points that a camera sees from one place, in little memory: most share their headings.

    :ivar bits: packed bits of the points that are visible with any heading, by ``packbits``.
    :ivar masks: (n, W) uint64, the different sets of headings with which points are visible, as
        bits; see :meth:`~ocp_ros.simulation.simulator.Simulator.look_around`.
    :ivar numbers: for each visible point the number of its set of headings.
    """

    bits: np.ndarray
    masks: np.ndarray
    numbers: np.ndarray

    @property
    def points(self) -> np.ndarray:
        """Return the numbers of the visible points, in the engine's order."""
        # The bits behind the last point are 0.
        return np.flatnonzero(np.unpackbits(self.bits))


class PoseGrid:
    """
    Poses of one camera model: places (positions), each with some headings.

    The visible points of each pose are computed once. P is the number of places, H the number of
    headings of a place, N the number of points of the scene, counted once more for each
    requirement (see ``Simulator.look_around``). A pose is given by the number of its place and the
    number of its heading at this place.

    :param simulator: the engine.
    :param camera: index of a camera of this model in the rig; by it the engine finds the model.
    :ivar places: (P, 3) metres, map frame.
    :ivar headings: P arrays (H, 3): yaw, pitch and roll in radians.
    """

    def __init__(self, simulator: Simulator, camera: int = 0) -> None:
        self._simulator = simulator
        self._camera = camera
        self.places = np.empty((0, 3))
        self.headings: list[np.ndarray] = []
        #: Places and headings of the whole grid, of which the first ones were added.
        self._all_places = np.empty((0, 3))
        self._all_headings = np.empty((0, 0, 3))
        self._added = 0
        self._least_step = 0.0
        self._visible: list[PlaceView] = []

    @classmethod
    def of(cls, region: FeasibleRegion, simulator: Simulator, model: CameraModel, camera: int,
           max_poses: int = MAX_GRID_POSES, min_places: int = 1) -> 'PoseGrid':
        """
        Create a grid over the feasible region of a mount; :meth:`grow` adds its places.

        :param region: feasible region of the rig's cameras.
        :param simulator: the engine.
        :param model: the camera model.
        :param camera: index of a camera of this model in the rig.
        :param max_poses: largest number of poses, unless there would be fewer than ``min_places``.
        :param min_places: number of places.
        :raises ConfigurationError: if the camera has no feasible pose.
        """
        grid = cls(simulator, camera)
        # All poses take at most 0.5 GB: a pose takes about a fortieth of a byte per point.
        max_poses = min(max_poses, 40 * 500_000_000 // simulator.row_count)
        distance_m = 0.3
        places, headings, grid._least_step = region.pose_grid(
            model, distance_m, max_poses, min_places)
        # In random order, the first n places are spread over the room for any n.
        order = np.random.default_rng(0).permutation(len(places))
        grid._all_places, grid._all_headings = places[order], headings[order]
        return grid

    def grow(self, place_count: int | None = None,
             should_stop: Callable[[], bool] = lambda: False) -> None:
        """
        Add the next places of the grid.

        :param place_count: number of places of the grid at the end; None for all of them.
        :param should_stop: returns whether to stop earlier.
        """
        batch_size = 16
        last = len(self._all_places) if place_count is None else min(
            place_count, len(self._all_places))
        # The time is checked before each batch but the first: a grid has some poses.
        while self._added < last and not (self._added and should_stop()):
            batch = slice(self._added, min(self._added + batch_size, last))
            self.add_poses(self._all_places[batch], self._all_headings[batch])
            self._added = batch.stop

    def part(self, place_count: int | None) -> 'PoseGrid':
        """Return a grid of the first places that were added; its arrays may be replaced."""
        part = copy(self)
        part._added = self._added if place_count is None else min(place_count, self._added)
        part.places = self.places[:part._added]
        part.headings = self.headings[:part._added]
        part._visible = self._visible[:part._added]
        return part

    @property
    def place_count(self) -> int:
        """Return the number of places of the whole grid."""
        return len(self._all_places)

    @property
    def added_share(self) -> float:
        """Return the share of the places of the grid that were added."""
        return self._added / len(self._all_places)

    @property
    def complete(self) -> bool:
        """Return whether all places of the grid were added."""
        return self._added == len(self._all_places)

    @property
    def step(self) -> float:
        """Return the largest distance of a feasible position from the nearest place, metres."""
        if self.complete or not self._added:
            return self._least_step
        nearest, _ = cKDTree(self._all_places[:self._added]).query(self._all_places)
        return self._least_step + float(nearest.max())

    def __len__(self) -> int:
        """Return the number of poses."""
        return sum(map(len, self.headings))

    def add_poses(self, places: np.ndarray, headings: Sequence[np.ndarray]) -> None:
        """
        Add places with their headings, and compute the visible points.

        :param places: (Q, 3) metres, map frame.
        :param headings: Q arrays (H, 3): yaw, pitch and roll in radians.
        """
        # For each place its poses (H, 6).
        groups = [as_written(np.column_stack([np.repeat(place[None], len(angles), axis=0),
                                              angles])) for place, angles in zip(places, headings)]
        # The old array and lists stay unchanged, because copies of this grid share them.
        self.places = np.vstack([self.places, *(poses[:1, :3] for poses in groups)])
        self.headings = [*self.headings, *(poses[:, 3:] for poses in groups)]
        self._visible = [*self._visible, *mapped(self._look_around, groups)]

    def _look_around(self, poses: np.ndarray) -> 'PlaceView':
        """Compute the visible points of poses (H, 6) at one place."""
        points, bits = self._simulator.look_around(poses[0, :3], poses[:, 3:], self._camera)
        visible = np.zeros(self._simulator.row_count, dtype=bool)
        visible[points] = True
        # Points in the engine's order are near each other, so mostly the next one is the same.
        changes = np.flatnonzero((bits[1:] != bits[:-1]).any(axis=1)) + 1
        starts = np.append(0, changes)[:len(bits)]
        masks, numbers = np.unique(bits[starts], axis=0, return_inverse=True)
        kind = np.uint16 if len(masks) <= 2 ** 16 else np.uint32
        numbers = np.repeat(numbers.ravel().astype(kind), np.diff(np.append(starts, len(bits))))
        return PlaceView(np.packbits(visible), masks, numbers)

    def pose(self, place: int, heading: int) -> np.ndarray:
        """Return a pose: (6,) metres, map frame, and radians, rounded as in files."""
        return np.append(self.places[place], self.headings[place][heading])

    def visible_points(self, place: int, headings: Sequence[int]) -> list[np.ndarray]:
        """Return the numbers of the points, in the engine's order, that each heading sees."""
        visible = self._visible[place]
        points = visible.points.astype(np.int32)
        with_heading = [(visible.masks[:, heading // 64] >> np.uint64(heading % 64))
                        & np.uint64(1) for heading in headings]
        return [points[seen.astype(bool)[visible.numbers]] for seen in with_heading]

    def batch_places(self, places: np.ndarray) -> list[list[int]]:
        """
        Split places into batches whose headings together fit into 64 bits.

        A place with more than 64 headings has a batch of its own.

        :param places: (n,) int, numbers of the places.
        :returns: the numbers of the places of each batch, in the same order.
        """
        batches: list[list[int]] = []
        # Negative if the next place needs a new batch.
        free_bits = 0
        for place in places.tolist():
            free_bits -= len(self.headings[place])
            if free_bits < 0:
                batches.append([])
                free_bits = 64 - len(self.headings[place])
            batches[-1].append(place)
        return batches

    def seen_by(self, places: Sequence[int]) -> np.ndarray:
        """
        Return which poses of a batch of places see each point.

        :param places: a batch of :meth:`batch_places`.
        :returns: (N, W) uint64, a bit for each pose: the headings of the first place, then of the
            next places. W is the number of words of 64 bits, more than 1 only for a single place.
        """
        # The bits of the first place; the other places of a batch have the same number of words.
        words = self._visible[places[0]].masks.shape[1]
        first_bit = 0
        seen_by = np.zeros((self._simulator.row_count, words), dtype=np.uint64)
        for place in places:
            visible = self._visible[place]
            seen_by[visible.points] |= (visible.masks << np.uint64(first_bit))[visible.numbers]
            first_bit += len(self.headings[place])
        return seen_by
