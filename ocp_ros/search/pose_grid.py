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

"""Poses of a camera on a grid of places and headings, and the visible points of each pose."""

from collections.abc import Callable, Sequence

import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.rig.feasible_region import FeasibleRegion
from ocp_ros.rig.placement_file import as_written
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.util.threads import mapped

#: Metres between places.
FIRST_STEP_M = 0.3
#: Approximate largest number of poses, and of bytes for their visible points; if there would be
#: more, places are farther apart.
MAX_GRID_POSES, MAX_BYTES = 40_000, 1_000_000_000
#: Number of places whose views are computed between two checks of the time.
PLACES_AT_A_TIME = 16


class PoseGrid:
    """
    Poses of one camera model: places, each with headings; visible points are computed once.

    :param simulator: the engine.
    :param camera: a camera of this model.
    :ivar places: (P, 3) metres, map frame.
    :ivar headings: P x (H, 3) yaw, pitch and roll in radians.
    :ivar step: largest distance of a feasible place from the grid, metres; 0 if unknown.
    """

    def __init__(self, simulator: Simulator, camera: int = 0) -> None:
        self._simulator, self._camera = simulator, camera
        self.places, self.step = np.empty((0, 3)), 0.0
        self.headings: list[np.ndarray] = []
        self._sees: list[tuple[np.ndarray, np.ndarray]] = []

    @classmethod
    def of(cls, region: FeasibleRegion, simulator: Simulator, model: CameraModel, camera: int,
           most: int = MAX_GRID_POSES, over: Callable[[], bool] = lambda: False) -> 'PoseGrid':
        """
        Create a grid over the feasible region of a mount.

        :param most: largest number of poses.
        :param over: returns whether to stop; the grid then has fewer places.
        :raises ConfigurationError: if the camera has no feasible place.
        """
        grid = cls(simulator, camera)
        most = min(most, 10 * MAX_BYTES // len(simulator.scene))
        places, headings, grid.step = region.pose_grid(model, FIRST_STEP_M, most)
        # In random order, the first n places are spread over the room for any n.
        order = np.random.default_rng(0).permutation(len(places))
        for first in range(0, len(places), PLACES_AT_A_TIME):
            if first and over():
                break
            some = order[first:first + PLACES_AT_A_TIME]
            grid.add(places[some], headings[some])
        return grid

    def __len__(self) -> int:
        """Return the number of poses."""
        return sum(map(len, self.headings))

    def add(self, places: np.ndarray, headings: Sequence[np.ndarray]) -> None:
        """Add places (P, 3), metres, with headings P x (H, 3), radians; compute their views."""
        poses = [as_written(np.column_stack([np.repeat(place[None], len(some), axis=0), some]))
                 for place, some in zip(places, headings)]
        self.places = np.vstack([self.places, *(some[:1, :3] for some in poses)])
        self.headings = [*self.headings, *(some[:, 3:] for some in poses)]
        self._sees = [*self._sees, *mapped(lambda some: self._simulator.look_around(
            some[0, :3], some[:, 3:], self._camera), poses)]

    def pose(self, place: int, heading: int) -> np.ndarray:
        """Return a pose: (6,) metres, map frame, and radians, rounded as in files."""
        return np.append(self.places[place], self.headings[place][heading])

    def points(self, place: int, heading: int) -> np.ndarray:
        """Return the points that a pose sees, in the engine's order: (n,) int32."""
        points, bits = self._sees[place]
        return points[(bits[:, heading >> 6] >> np.uint64(heading & 63)) & np.uint64(1) > 0]

    def batches(self, places: np.ndarray) -> list[list[int]]:
        """Batch places whose headings together fit into 64 bits; one with more is alone."""
        batches, left = [], 0
        for place in places.tolist():
            left -= len(self.headings[place])
            if left < 0:
                batches.append([])
                left = 64 - len(self.headings[place])
            batches[-1].append(place)
        return batches

    def seen_by(self, places: Sequence[int]) -> np.ndarray:
        """
        Return which poses of a batch of places see each point.

        A batch has several places only if all their headings fit into one word of 64 bits.

        :returns: (N, W) uint64: bits of the headings of the first place, then of the next places.
        """
        words = self._sees[places[0]][1].shape[1]
        first = 0
        seen_by = np.zeros((len(self._simulator.scene), words), dtype=np.uint64)
        for place in places:
            points, bits = self._sees[place]
            seen_by[points] |= bits << np.uint64(first)
            first += len(self.headings[place])
        return seen_by
