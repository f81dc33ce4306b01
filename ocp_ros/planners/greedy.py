# SPDX-License-Identifier: Apache-2.0
"""
One camera after the other, each at the best place that is left.

Space coverage is monotone and submodular, so that greedy placement by coverage is worth at least
1 - 1/e of the best on the same candidates (Nemhauser, Wolsey and Fisher, 1978). Depth error has no
such bound. The candidates are a grid as fine as the budget allows.
"""

from collections.abc import Generator, Sequence

import numpy as np

from ocp_ros.planners.planner import Planner, Scores, Search

#: Metres: the first and the last step of the descent, and how many directions it tries.
FIRST_STEP, LAST_STEP, DIRECTIONS = 0.4, 0.02, 8


class GreedyCoverage(Planner):
    """The candidate that adds most space coverage, K times."""

    def search(self) -> Search:
        """Fill the placement."""
        candidates = self.space.grid(max(self.budget // self.space.cameras, 1))
        yield from fill(self.space.cameras, candidates, lambda scores: -scores.space_coverage)


class GreedyError(Planner):
    """The candidate that takes most from the depth error, K times."""

    def search(self) -> Search:
        """Fill the placement."""
        candidates = self.space.grid(max(self.budget // self.space.cameras, 1))
        yield from fill(self.space.cameras, candidates, lambda scores: scores.depth_error)


class GreedySwap(Planner):
    """
    Greedy by depth error, then one camera exchanged at a time, then small steps downhill.

    What is left of the budget goes to the same from other starts: the best placement with one or
    two cameras thrown somewhere else.
    """

    def search(self) -> Search:
        """Fill, exchange, descend, and begin again."""
        cameras = self.space.cameras
        # A third of the budget to fill, and at most so fine that neighbours see much alike.
        candidates = self.space.grid(int(np.clip(self.budget // (3 * cameras), 4, 400)))
        placed, _ = yield from fill(cameras, candidates, lambda scores: scores.depth_error)
        best, error = yield from exchange(self, placed, candidates)
        best, error = yield from descend(self, best, error)
        while True:
            start = best.copy()
            thrown = self.rng.permutation(cameras)[:self.rng.integers(1, min(2, cameras) + 1)]
            start[thrown] = self.space.random(self.rng, len(thrown))
            other, other_error = yield from descend(self, start, np.inf)
            if other_error < error:
                best, error = other, other_error


def fill(cameras: int, candidates: np.ndarray,
         energy) -> Generator[Sequence[np.ndarray], Scores, tuple[np.ndarray, float]]:
    """
    Place cameras one by one.

    :param candidates: (M, 2).
    :param energy: of scores; the least is best.
    :returns: the positions (cameras, 2) and their depth error.
    """
    placed, error = np.empty((0, 2)), np.inf
    for _ in range(cameras):
        scores = yield [np.vstack([placed, place]) for place in candidates]
        choice = int(np.argmin(energy(scores)))
        placed, error = np.vstack([placed, candidates[choice]]), scores.depth_error[choice]
    return placed, error


def exchange(planner: Planner, placed: np.ndarray, candidates: np.ndarray,
             ) -> Generator[Sequence[np.ndarray], Scores, tuple[np.ndarray, float]]:
    """Exchange one camera for the best candidate until no exchange helps any more."""
    scores = yield [placed]
    error, unchanged, camera = scores.depth_error[0], 0, 0
    while unchanged < len(placed):
        trials = []
        for place in candidates:
            trial = placed.copy()
            trial[camera] = place
            trials.append(trial)
        scores = yield trials
        choice = int(np.argmin(scores.depth_error))
        unchanged += 1
        if scores.depth_error[choice] < error:
            placed, error, unchanged = trials[choice], scores.depth_error[choice], 1
        camera = (camera + 1) % len(placed)
    return placed, error


def descend(planner: Planner, placed: np.ndarray, error: float,
            ) -> Generator[Sequence[np.ndarray], Scores, tuple[np.ndarray, float]]:
    """Move one camera at a time to the best of a ring of places, with ever smaller steps."""
    if not np.isfinite(error):
        scores = yield [placed]
        error = scores.depth_error[0]
    step, unchanged, camera = FIRST_STEP, 0, 0
    while step >= LAST_STEP:
        angle = planner.rng.uniform(0.0, 2.0 * np.pi)
        angles = angle + np.arange(DIRECTIONS) * (2.0 * np.pi / DIRECTIONS)
        trials = []
        for direction in np.stack([np.cos(angles), np.sin(angles)], axis=1):
            trial = placed.copy()
            trial[camera] = planner.space.inside(trial[camera] + step * direction)
            trials.append(trial)
        scores = yield trials
        choice = int(np.argmin(scores.depth_error))
        unchanged += 1
        if scores.depth_error[choice] < error:
            placed, error, unchanged = trials[choice], scores.depth_error[choice], 0
        camera = (camera + 1) % len(placed)
        if unchanged >= len(placed):
            step, unchanged = 0.5 * step, 0
    return placed, error
