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
One camera after the other, each at the best place that is left.

Space coverage and what is taken from the depth error are monotone and submodular, so that greedy
placement by either takes at least 1 - 1/e of what the best on the same candidates does (Nemhauser,
Wolsey and Fisher, 1978). Of the depth error that is left this says little: 90 % less and 95 % less
leave twice as much. The candidates are a grid as fine as the budget allows.
"""

from collections.abc import Callable, Generator, Sequence

import numpy as np
from ocp_ros.search.planner import Planner, Scores, Search

#: Metres: the first and the last step of the descent, and how many directions it tries.
FIRST_STEP, LAST_STEP, DIRECTIONS = 0.4, 0.02, 8
#: Candidates of a search with exchange: the budget's share for each camera, within these limits.
FEWEST, SHARE, MOST = 20, 16, 150
#: Places that two cameras are put back to, one after the other, when a search begins again.
REBUILT = 48
NOBODY = np.empty((0, 2))
#: Yields placements, gets scores, and ends with positions and their depth error.
SearchResult = Generator[Sequence[np.ndarray], Scores, tuple[np.ndarray, float]]


class GreedyError(Planner):
    """The candidate that takes most from the depth error, K times."""

    def search(self) -> Search:
        """Fill the placement."""
        candidates = self.space.grid(max(self.budget // self.space.cameras, 1))
        yield from fill(self.space.cameras, candidates, self.energy)


class GreedyCoverage(GreedyError):
    """The candidate that adds most space coverage, K times."""

    descends = False

    def energy(self, scores: Scores) -> np.ndarray:
        """Maximise coverage."""
        return -scores.space_coverage


class GreedySwap(Planner):
    """
    Greedy by depth error, then one camera exchanged at a time, then small steps downhill.

    What is left of the budget goes to ruin and recreate: two cameras of the best placement are
    taken away and put back greedily among random places, and all descend again.
    """

    def search(self) -> Search:
        """Fill, exchange, descend, and begin again."""
        cameras = self.space.cameras
        # Coarse: neighbours see much alike, and the descent finds what lies between.
        most = np.clip(self.budget // (SHARE * cameras), FEWEST, MOST)
        candidates = self.space.grid(int(most))
        placed, _ = yield from fill(cameras, candidates, self.energy)
        best, error = yield from exchange(placed, candidates)
        best, error = yield from descend(self, best, error)
        while True:
            kept = self.rng.permutation(cameras)[min(2, cameras):]
            places = np.array([self.space.random(self.rng, 1)[0] for _ in range(REBUILT)])
            start, other_error = yield from fill(
                cameras, places, self.energy, best[kept])
            other, other_error = yield from descend(self, start, other_error)
            if other_error < error:
                best, error = other, other_error


def fill(cameras: int, candidates: np.ndarray, energy: Callable[[Scores], np.ndarray],
         placed: np.ndarray = NOBODY) -> SearchResult:
    """
    Place cameras one by one.

    :param candidates: (M, 2).
    :param energy: of scores; the least is best.
    :param placed: (n, 2), those that are there already.
    :returns: the positions (cameras, 2) and their depth error.
    """
    error = np.inf
    for _ in range(cameras - len(placed)):
        scores = yield [np.vstack([placed, place]) for place in candidates]
        choice = int(np.argmin(energy(scores)))
        placed, error = np.vstack([placed, candidates[choice]]), scores.error[choice]
    return placed, error


def best_place(placed: np.ndarray, camera: int, places: np.ndarray) -> SearchResult:
    """Put one camera to the best of some places (M, 2), even if it stood better before."""
    trials = np.repeat(placed[None], len(places), axis=0)
    trials[:, camera] = places
    scores = yield list(trials)
    choice = int(np.argmin(scores.error))
    return trials[choice], scores.error[choice]


def exchange(placed: np.ndarray, candidates: np.ndarray) -> SearchResult:
    """Exchange one camera for the best candidate until no exchange helps any more."""
    scores = yield [placed]
    error, unchanged, camera = scores.error[0], 0, 0
    while unchanged < len(placed):
        trial, trial_error = yield from best_place(placed, camera, candidates)
        unchanged += 1
        if trial_error < error:
            placed, error, unchanged = trial, trial_error, 1
        camera = (camera + 1) % len(placed)
    return placed, error


def descend(planner: Planner, placed: np.ndarray, error: float) -> SearchResult:
    """Move one camera at a time to the best of a ring of places, with ever smaller steps."""
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
