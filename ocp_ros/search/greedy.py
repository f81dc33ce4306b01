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

Greedy placement adds one camera after the other, each at the best remaining position.

Space coverage and the reduction of the depth error are monotone and submodular: the gain of a
camera is never negative, and never larger after more cameras. So greedy placement by either of
them reaches at least 1 - 1/e of the optimum on the same candidates (Nemhauser, Wolsey and Fisher,
1978). This says little about the remaining depth error: after a reduction by 90 % it is twice as
large as after 95 %. The candidates are a grid as fine as the budget allows.
"""

from collections.abc import Callable, Generator, Sequence

import numpy as np
from ocp_ros.search.planner import Planner, Scores, Search

NO_CAMERAS = np.empty((0, 2))
#: Yields placements, receives their scores, and returns positions (n, 2) and their depth error.
PlacementSteps = Generator[Sequence[np.ndarray], Scores, tuple[np.ndarray, float]]


class Random(Planner):
    """The best of uniformly drawn placements."""

    def search(self) -> Search:
        """Draw placements until the budget is used up."""
        while True:
            yield [self.space.random(self.rng) for _ in range(32)]


class RegularGrid(Planner):
    """The best of the regular arrangements in rows and columns; some cells may stay empty."""

    def search(self) -> Search:
        """Try every number of columns once."""
        cameras = self.space.cameras
        arrangements = []
        for columns in range(1, cameras + 1):
            rows = -(-cameras // columns)
            x, y = np.meshgrid((np.arange(columns) + 0.5) / columns,
                               (np.arange(rows) + 0.5) / rows)
            # Centres of the cells, as shares of the edges of the space.
            centres = np.stack([x, y], axis=-1).reshape(-1, 2)
            # If there are more cells than cameras, the cells nearest to the centre stay empty.
            used = np.argsort(-np.abs(centres - 0.5).max(axis=1), kind='stable')[:cameras]
            arrangements.append(self.space.inside(
                self.space.low + centres[np.sort(used)] * self.space.size))
        yield arrangements


class GreedyError(Planner):
    """Greedy by depth error: add the candidate that reduces it most, K times."""

    def search(self) -> Search:
        """Add cameras until the placement is complete."""
        candidates = self.space.grid(max(self.budget // self.space.cameras, 1))
        yield from add_cameras(self.space.cameras, candidates, self.energy)


class GreedyCoverage(GreedyError):
    """Greedy by space coverage: add the candidate that increases it most, K times."""

    def energy(self, scores: Scores) -> np.ndarray:
        """Return the negative space coverage: (B,) cubic metres."""
        return -scores.space_coverage


class GreedySwap(Planner):
    """
    Greedy by depth error, then exchanges of one camera at a time, then a local search.

    The rest of the budget is used for ruin and recreate: two cameras of the best placement are
    removed and added again greedily at random positions, followed by the local search.
    """

    def search(self) -> Search:
        """Place greedily, exchange, run the local search, and repeat it by ruin and recreate."""
        cameras = self.space.cameras
        # A coarse grid suffices: neighbours have similar views, and the local search refines them.
        # One trial of all candidates for each camera takes about a sixteenth of the budget.
        candidates = self.space.grid(int(np.clip(self.budget // (16 * cameras), 20, 150)))
        placed, _ = yield from add_cameras(cameras, candidates, self.energy)
        best, error = yield from exchange_cameras(placed, candidates)
        best, error = yield from descend(self, best, error)
        while True:
            # All cameras except two random ones.
            remaining = self.rng.permutation(cameras)[min(2, cameras):]
            positions = np.array([self.space.random(self.rng, 1)[0] for _ in range(48)])
            recreated, trial_error = yield from add_cameras(
                cameras, positions, self.energy, best[remaining])
            trial, trial_error = yield from descend(self, recreated, trial_error)
            if trial_error < error:
                best, error = trial, trial_error


def add_cameras(cameras: int, candidates: np.ndarray, energy: Callable[[Scores], np.ndarray],
                placed: np.ndarray = NO_CAMERAS) -> PlacementSteps:
    """
    Add cameras greedily, one by one.

    :param cameras: K, number of cameras at the end.
    :param candidates: (M, 2) positions to choose from, metres.
    :param energy: returns the values to minimise, (B,) for B scores.
    :param placed: (n, 2) positions of cameras that are already placed, metres.
    :yields: placements to score; their :class:`Scores` are sent back.
    :returns: the positions (K, 2) and their depth error; infinity if no camera was missing.
    """
    error = np.inf
    for _ in range(cameras - len(placed)):
        scores = yield [np.vstack([placed, candidate]) for candidate in candidates]
        choice = int(np.argmin(energy(scores)))
        placed = np.vstack([placed, candidates[choice]])
        error = scores.error[choice]
    return placed, error


def move_to_best(placed: np.ndarray, camera: int, positions: np.ndarray) -> PlacementSteps:
    """
    Move one camera to the best of some positions, even if its old position is better.

    :param placed: (n, 2) positions of all cameras, metres.
    :param camera: row of the camera to move.
    :param positions: (M, 2) to choose from, metres.
    :yields: placements to score; their :class:`Scores` are sent back.
    :returns: the positions of all cameras after the move, and their depth error.
    """
    trials = np.repeat(placed[None], len(positions), axis=0)
    trials[:, camera] = positions
    scores = yield list(trials)
    choice = int(np.argmin(scores.error))
    return trials[choice], scores.error[choice]


def exchange_cameras(placed: np.ndarray, candidates: np.ndarray) -> PlacementSteps:
    """Move cameras (n, 2) one at a time to their best candidates (M, 2) until none improves."""
    scores = yield [placed]
    error = scores.error[0]
    # No candidate is better for any of the last ``settled`` cameras that were tried.
    settled = camera = 0
    while settled < len(placed):
        trial, trial_error = yield from move_to_best(placed, camera, candidates)
        settled += 1
        if trial_error < error:
            placed, error = trial, trial_error
            # The other cameras have to be tried again.
            settled = 1
        camera = (camera + 1) % len(placed)
    return placed, error


def descend(planner: Planner, placed: np.ndarray, error: float) -> PlacementSteps:
    """
    Run a local search: move one camera at a time to a better position on a ring around it.

    The radius of the ring is halved after no camera has improved, until it is below 2 cm.

    :param planner: gives the feasible region and the random numbers.
    :param placed: (n, 2) positions of the cameras, metres.
    :param error: their depth error, metres.
    :yields: placements to score; their :class:`Scores` are sent back.
    :returns: the positions after the search, and their depth error.
    """
    radius_m = 0.4
    directions = 8
    # ``unchanged`` counts the cameras tried since the last improvement or change of the radius.
    unchanged = camera = 0
    while radius_m >= 0.02:
        # Each ring has a random rotation, so other directions are tried in the next pass.
        first_angle = planner.rng.uniform(0.0, 2.0 * np.pi)
        angles = first_angle + np.arange(directions) * (2.0 * np.pi / directions)
        ring = placed[camera] + radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        trial, trial_error = yield from move_to_best(placed, camera, planner.space.inside(ring))
        unchanged += 1
        if trial_error < error:
            placed, error = trial, trial_error
            unchanged = 0
        camera = (camera + 1) % len(placed)
        if unchanged >= len(placed):
            radius_m *= 0.5
            unchanged = 0
    return placed, error
