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

"""Scores of placements with a cache of views by pose and camera."""

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.search.planner import Scores
from ocp_ros.simulation.simulator import Simulator, View

#: Size of the cache of views, bytes: 16,000 views in a room of 25,000 points.
REMEMBERED = 64_000_000
#: Metres between the places of a lattice.
LATTICE = 0.25


def remembered_looks(simulator: Simulator) -> Callable[[np.ndarray, int], View]:
    """Return ``look`` of an engine with a cache of views by pose and camera."""
    nothing = simulator.nothing().bits.nbytes + len(simulator.grid) // 8

    @lru_cache(max(REMEMBERED // nothing, 64))
    def look(kind: int, pose: bytes) -> View:
        return simulator.look(np.frombuffer(pose), kind)

    # Cameras of the same kind share the cached views.
    return lambda pose, camera: look(
        simulator.kind(camera), np.asarray(pose, dtype=np.float64).tobytes())


class Scorer:
    """
    Score placements by the engine.

    :param simulator: the engine for a scene.
    """

    def __init__(self, simulator: Simulator) -> None:
        self.simulator, self._look = simulator, remembered_looks(simulator)

    def __call__(self, placements: Sequence[np.ndarray]) -> Scores:
        """
        Score placements.

        :param placements: B placements of the simulator, (n, 3) or (n, 6), n >= 0.
        """
        judged = np.array([self._judged(placement) for placement in placements])
        return Scores(*judged.reshape(-1, 2).T)

    def _judged(self, placement: np.ndarray) -> tuple[float, float]:
        """Return the depth error, metres, and the space coverage, cubic metres."""
        if len(placement) == 0:
            return self.simulator.depth_error.worst, 0.0
        result = self.simulator.judge([
            self._look(pose, camera) for camera, pose in enumerate(placement)])
        return result.depth_error, result.space_coverage


class LatticeScorer:
    """
    Score placements with each camera moved to its nearest place on a lattice.

    A room has some hundred such places, so the view of each is computed once and cached.

    :param score: returns the scores of placements (n, 3).
    :param space: feasible region of the cameras.
    """

    def __init__(self, score: Callable[[Sequence[np.ndarray]], Scores], space: FreePlane) -> None:
        self._score, self._space = score, space

    def __call__(self, placements: Sequence[np.ndarray]) -> Scores:
        """Score B placements (n, 3)."""
        return self._score([self._space.placement(self.snapped(placement[:, :2]))
                            for placement in placements])

    def snapped(self, positions: np.ndarray) -> np.ndarray:
        """Move positions (n, 2) to feasible positions at, or nearest to, places of the lattice."""
        return self._space.inside((np.floor(positions / LATTICE) + 0.5) * LATTICE)
