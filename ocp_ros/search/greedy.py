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
Baselines without a search, and greedy placement with local search.

Greedy placement adds one camera after the other, each at the best remaining place.

Space coverage and the reduction of the depth error are monotone and submodular. So greedy
placement by either of them reaches at least 1 - 1/e of the optimum on the same candidates
(Nemhauser, Wolsey and Fisher, 1978). This says little about the remaining depth error: after a
reduction by 90 % it is twice as large as after 95 %. The candidates are a grid as fine as the
budget allows.
"""

from collections.abc import Callable, Generator, Sequence

import numpy as np
from ocp_ros.search.planner import Planner, Scores, Search

#: First and last step of the local search, metres, and the number of directions that it tries.
FIRST_STEP, LAST_STEP, DIRECTIONS = 0.4, 0.02, 8
#: Candidates of a search with exchange: their smallest number; the evaluations of the budget for
#: each candidate and camera; and their largest number.
MIN_CANDIDATES, EVALUATIONS_EACH, MAX_CANDIDATES = 20, 16, 150
#: Number of random places from which two removed cameras are placed again.
REBUILDING_PLACES = 48
#: Placements that are drawn together.
BATCH = 32
NO_CAMERAS = np.empty((0, 2))
#: Yields placements, gets scores, and ends with positions and their depth error.
PlacementSteps = Generator[Sequence[np.ndarray], Scores, tuple[np.ndarray, float]]


class Random(Planner):
    """The best of uniformly drawn placements."""

    descends = False

    def search(self) -> Search:
        """Draw placements until the budget is used up."""
        while True:
            yield [self.space.random(self.rng) for _ in range(BATCH)]


class RegularGrid(Planner):
    """The best of the regular arrangements in rows and columns; some cells may stay empty."""

    descends = False

    def search(self) -> Search:
        """Try every number of columns once."""
        cameras, low, size = self.space.cameras, self.space.low, self.space.size
        arrangements = []
        for columns in range(1, cameras + 1):
            rows = -(-cameras // columns)
            x, y = np.meshgrid((np.arange(columns) + 0.5) / columns,
                               (np.arange(rows) + 0.5) / rows)
            cells = np.stack([x, y], axis=-1).reshape(-1, 2)
            # If there are more cells than cameras, cells in the middle stay empty.
            keep = np.argsort(-np.abs(cells - 0.5).max(axis=1), kind='stable')[:cameras]
            arrangements.append(self.space.inside(low + cells[np.sort(keep)] * size))
        yield arrangements


class GreedyError(Planner):
    """Greedy by depth error: add the candidate that reduces it most, K times."""

    def search(self) -> Search:
        """Add cameras until the placement is complete."""
        candidates = self.space.grid(max(self.budget // self.space.cameras, 1))
        yield from fill(self.space.cameras, candidates, self.energy)


class GreedyCoverage(GreedyError):
    """Greedy by space coverage: add the candidate that increases it most, K times."""

    descends = False

    def energy(self, scores: Scores) -> np.ndarray:
        """Return the negative space coverage."""
        return -scores.space_coverage


class GreedySwap(Planner):
    """
    Greedy by depth error, then exchanges of one camera at a time, then a local search.

    The rest of the budget is used for ruin and recreate: two cameras of the best placement are
    removed and added again greedily at random places, followed by the local search.
    """

    def search(self) -> Search:
        """Place greedily, exchange, run the local search, and repeat it by ruin and recreate."""
        cameras = self.space.cameras
        # A coarse grid suffices: neighbours have similar views, and the local search refines.
        most = np.clip(self.budget // (EVALUATIONS_EACH * cameras), MIN_CANDIDATES,
                       MAX_CANDIDATES)
        candidates = self.space.grid(int(most))
        placed, _ = yield from fill(cameras, candidates, self.energy)
        best, error = yield from exchange(placed, candidates)
        best, error = yield from descend(self, best, error)
        while True:
            kept = self.rng.permutation(cameras)[min(2, cameras):]
            places = np.array([self.space.random(self.rng, 1)[0]
                               for _ in range(REBUILDING_PLACES)])
            start, other_error = yield from fill(
                cameras, places, self.energy, best[kept])
            other, other_error = yield from descend(self, start, other_error)
            if other_error < error:
                best, error = other, other_error


def fill(cameras: int, candidates: np.ndarray, energy: Callable[[Scores], np.ndarray],
         placed: np.ndarray = NO_CAMERAS) -> PlacementSteps:
    """
    Place cameras one by one.

    :param candidates: (M, 2).
    :param energy: returns the value to minimise for each score.
    :param placed: (n, 2), cameras that are already placed.
    :returns: the positions (cameras, 2) and their depth error.
    """
    error = np.inf
    for _ in range(cameras - len(placed)):
        scores = yield [np.vstack([placed, place]) for place in candidates]
        choice = int(np.argmin(energy(scores)))
        placed, error = np.vstack([placed, candidates[choice]]), scores.error[choice]
    return placed, error


def best_place(placed: np.ndarray, camera: int, places: np.ndarray) -> PlacementSteps:
    """Move one camera to the best of some places (M, 2), even if its old place is better."""
    trials = np.repeat(placed[None], len(places), axis=0)
    trials[:, camera] = places
    scores = yield list(trials)
    choice = int(np.argmin(scores.error))
    return trials[choice], scores.error[choice]


def exchange(placed: np.ndarray, candidates: np.ndarray) -> PlacementSteps:
    """Move one camera at a time to its best candidate, until no exchange reduces the error."""
    scores = yield [placed]
    error, unchanged, camera = scores.error[0], 0, 0
    while unchanged < len(placed):
        trial, trial_error = yield from best_place(placed, camera, candidates)
        unchanged += 1
        if trial_error < error:
            placed, error, unchanged = trial, trial_error, 1
        camera = (camera + 1) % len(placed)
    return placed, error


def descend(planner: Planner, placed: np.ndarray, error: float) -> PlacementSteps:
    """Run a local search: move one camera at a time on a ring of places with decreasing radius."""
    step, unchanged, camera = FIRST_STEP, 0, 0
    while step >= LAST_STEP:
        angle = planner.rng.uniform(0.0, 2.0 * np.pi)
        angles = angle + np.arange(DIRECTIONS) * (2.0 * np.pi / DIRECTIONS)
        ring = placed[camera] + step * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        trial, trial_error = yield from best_place(placed, camera, planner.space.inside(ring))
        unchanged += 1
        if trial_error < error:
            placed, error, unchanged = trial, trial_error, 0
        camera = (camera + 1) % len(placed)
        if unchanged >= len(placed):
            step, unchanged = 0.5 * step, 0
    return placed, error
