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
Trans-dimensional simulated annealing (TDSA), after Liu, Sridharan and Fookes (2013).

The chain lives on placements of any number of cameras up to K, with the target density
lambda^n / n! exp(-E / T) over n cameras placed uniformly: a Poisson process when E is 0. Each step
proposes a birth, a death or a move, and accepts

    birth  n -> n + 1   (p_d / p_b) lambda / (n + 1) exp(-dE / T)
    death  n -> n - 1   (p_b / p_d) n / lambda       exp(-dE / T)
    move                                             exp(-dE / T)

with p_b and p_d at the numbers of cameras before and after the proposal: there is no death at 0
and no birth at K. T decreases by a constant factor in each step.

The text of the source was not available. The moves and the acceptance are those of reversible-jump
annealing in this project's design, so details may differ from the source.
"""

import numpy as np
from ocp_ros.search.planner import Planner, Scores, Search

#: First and last temperature, in multiples of the standard deviation of random placements' errors.
FIRST_TEMPERATURE, LAST_TEMPERATURE = 0.5, 2e-4
#: Standard deviation of the first and last moves, as shares of the longer edge of the space.
FIRST_STEP, LAST_STEP = 0.25, 0.01
#: Number of random placements from which the temperature is computed.
PILOTS = 16


class FixedAnnealing(Planner):
    """Simulated annealing of K cameras, without births and deaths."""

    births = 0.0

    def search(self) -> Search:
        """Anneal once, until the budget is used up."""
        count = min(PILOTS, max(self.budget // 5, 2))
        pilots = [self.space.random(self.rng) for _ in range(count)]
        scores = yield pilots
        placed, error = pilots[np.argmin(scores.error)], scores.error.min()
        spread = max(float(np.std(scores.error)), 1e-9)
        steps = max(self.budget - len(pilots), 2)
        for step in range(steps):
            share = step / (steps - 1)
            cooling = (LAST_TEMPERATURE / FIRST_TEMPERATURE) ** share
            temperature = spread * FIRST_TEMPERATURE * cooling
            sigma = self.space.size.max() * FIRST_STEP * (LAST_STEP / FIRST_STEP) ** share
            placed, error = yield from self.step(placed, error, temperature, sigma)

    def step(self, placed: np.ndarray, error: float, temperature: float, sigma: float):
        """Propose one change and accept or reject it; return the positions and their error."""
        trial, ratio = self.propose(placed, sigma)
        scores: Scores = yield [trial]
        fall = (error - scores.error[0]) / temperature
        if np.log(max(self.rng.random(), 1e-300)) < fall + np.log(ratio):
            return trial, scores.error[0]
        return placed, error

    def propose(self, placed: np.ndarray, sigma: float) -> tuple[np.ndarray, float]:
        """Return changed positions and the acceptance ratio without the factor exp(-dE / T)."""
        choice, count = self.rng.random(), len(placed)
        birth, death = self.probabilities(count)
        if choice < birth:
            trial = np.vstack([placed, self.space.random(self.rng, 1)])
            back = self.probabilities(count + 1)[1]
            return trial, back / birth * self.rate / (count + 1)
        if choice < birth + death:
            trial = np.delete(placed, self.rng.integers(count), axis=0)
            back = self.probabilities(count - 1)[0]
            return trial, back / death * count / self.rate
        trial = placed.copy()
        if count:
            camera = self.rng.integers(count)
            moved = self.space.folded(trial[camera] + self.rng.normal(0.0, sigma, 2))
            # The target density is 0 outside the feasible region.
            trial[camera] = moved if self.space.contains(moved) else trial[camera]
        return trial, 1.0

    @property
    def rate(self) -> float:
        """Return lambda, the expected number of cameras if E is 0."""
        return float(self.space.cameras)

    def probabilities(self, count: int) -> tuple[float, float]:
        """Return the probabilities of proposing a birth and a death at a number of cameras."""
        either = 2.0 * self.births
        if count == 0:
            return either, 0.0
        if count >= self.space.cameras:
            return 0.0, either
        return self.births, self.births


class TransDimensionalAnnealing(FixedAnnealing):
    """TDSA: births, deaths and moves."""

    #: p_b and p_d for 1 to K - 1 cameras; the other proposals are moves.
    births = 0.1
