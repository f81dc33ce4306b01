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

"""Scores of placements with a cache of views, and an objective that is faster to compute."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from ocp_ros.search.budget import Budget, Progress
from ocp_ros.search.planner import Scores
from ocp_ros.simulation.objective import Objective
from ocp_ros.simulation.simulator import Simulator, View


def cached_look(simulator: Simulator) -> Callable[[np.ndarray, int], View]:
    """Return the engine's ``look`` with a cache of views, as a function of pose and camera."""
    # About 16,000 views in a room of 25,000 points; in any room, at least 64 views are cached.
    cache_bytes = 64_000_000
    # A view has a bit for each point and for each cell of the coverage grid.
    bytes_per_view = simulator.nothing().bits.nbytes + len(simulator.grid) // 8

    # The pose is given as bytes, because a cache needs hashable arguments. A kind of camera is the
    # number of its first camera, so the engine accepts it as a camera.
    @lru_cache(max(cache_bytes // bytes_per_view, 64))
    def look(kind: int, pose: bytes) -> View:
        return simulator.look(np.frombuffer(pose), kind)

    # Cameras of the same kind share the cached views.
    return lambda pose, camera: look(
        simulator.kind(camera), np.asarray(pose, dtype=np.float64).tobytes())


def coarse_objective(objective: Objective) -> Objective:
    """Return the same objective with smaller depth maps; it accepts the same views."""
    simulator = objective.simulator
    # Depth maps of 32 rows rank placements nearly the same in less time.
    engine = replace(simulator.config.engine, error_rows=32)
    config = replace(simulator.config, engine=engine)
    return Objective(Simulator(simulator.scene, config, simulator.models), objective.rig)


class Scorer:
    """
    Score placements by the engine, until the budget is used up.

    :param simulator: the engine for a scene.
    :param budget: limit of the search; None for no limit. Once it is used up, no more placements
        are scored. The very first placement is always scored.
    :param progress: called after each placement.
    :ivar evaluations: number of scored placements.
    """

    def __init__(self, simulator: Simulator, budget: Budget | None = None,
                 progress: Progress | None = None) -> None:
        self.simulator = simulator
        self._cached_view_from = cached_look(simulator)
        self._budget = budget
        self._progress = progress
        self._least_error = np.inf
        self.evaluations = 0

    @property
    def used_share(self) -> float:
        """Return the used share of the budget."""
        if self._budget is None:
            return 0.0
        return self._budget.used_share(self.evaluations, self._budget.evaluations)

    def __call__(self, placements: Sequence[np.ndarray]) -> Scores:
        """
        Return the scores of placements.

        :param placements: B placements, (n, 3) or (n, 6), metres and radians, n >= 0.
        :returns: scores of all placements, or of the first ones if the budget is used up.
        """
        scores: list[tuple[float, float]] = []
        for placement in placements:
            if self.evaluations and self.used_share >= 1.0:
                break
            scores.append(self.judge(placement))
            self.evaluations += 1
            self._least_error = min(self._least_error, scores[-1][0])
            if self._progress is not None:
                self._progress(self.used_share, self._least_error)
        # Without scores, both arrays are empty.
        return Scores(*np.array(scores).reshape(-1, 2).T)

    def judge(self, placement: np.ndarray) -> tuple[float, float]:
        """
        Return the depth error, metres, and the space coverage, cubic metres.

        :param placement: (n, 3) or (n, 6), metres and radians, n >= 0.
        """
        if len(placement) == 0:
            return self.simulator.depth_error.worst, 0.0
        result = self.simulator.judge([
            self._cached_view_from(pose, camera) for camera, pose in enumerate(placement)])
        return result.depth_error, result.space_coverage
