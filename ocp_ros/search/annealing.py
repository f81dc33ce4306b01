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
lambda^n / n! exp(-E / T) over n cameras placed uniformly: E is the depth error and T the
temperature; if E is 0, it is a Poisson process. Each step proposes a birth (one camera more), a
death (one camera less) or a move, and accepts it with the probability

    birth  n -> n + 1   (p_d / p_b) lambda / (n + 1) exp(-dE / T)
    death  n -> n - 1   (p_b / p_d) n / lambda       exp(-dE / T)
    move                                             exp(-dE / T)

with p_b and p_d, the probabilities of proposing a birth and a death, at the numbers of cameras
before and after the proposal: there is no death at 0 and no birth at K. T decreases by a constant
factor in each step.

The text of the source was not available. The moves and the acceptance are those of reversible-jump
annealing in this project's design, so details may differ from the source.
"""

import numpy as np
from ocp_ros.search.planner import Planner, Scores, Search
from ocp_ros.util.annealing import between


class TransDimensionalAnnealing(Planner):
    """TDSA: births, deaths and moves."""

    #: p_b and p_d for 1 to K - 1 cameras; the other proposals are moves.
    birth_probability = 0.1

    def search(self) -> Search:
        """Anneal once, until the budget is used up."""
        # The errors of some random placements set the temperature, and the best one is the start.
        # They take about a fifth of a small budget.
        count = min(16, max(self.budget // 5, 2))
        samples = [self.space.random(self.rng) for _ in range(count)]
        scores = yield samples
        placed = samples[np.argmin(scores.error)]
        error = scores.error.min()
        # Temperatures have to be above 0, also if all these errors are equal.
        error_deviation = max(float(np.std(scores.error)), 1e-9)
        # The share goes from 0 to 1, which takes at least two steps.
        steps = max(self.budget - count, 2)
        for step in range(steps):
            share = step / (steps - 1)
            # Temperatures are multiples of the standard deviation of the errors; the standard
            # deviations of moves are shares of the longer edge of the space.
            temperature = error_deviation * between(0.5, 2e-4, share)
            deviation = self.space.size.max() * between(0.25, 0.01, share)
            placed, error = yield from self.take_step(placed, error, temperature, deviation)

    def take_step(self, placed: np.ndarray, error: float, temperature: float, deviation: float):
        """
        Propose one change and accept or reject it.

        :param placed: (n, 2) positions of the cameras, metres.
        :param error: their depth error, metres.
        :param temperature: metres.
        :param deviation: standard deviation of a move along each axis, metres.
        :yields: the changed placement; its :class:`Scores` are sent back.
        :returns: the positions after the step, and their error.
        """
        trial, ratio = self.propose(placed, deviation)
        scores: Scores = yield [trial]
        log_acceptance = (error - scores.error[0]) / temperature + np.log(ratio)
        # A random number of 0 has no logarithm.
        if np.log(max(self.rng.random(), 1e-300)) < log_acceptance:
            return trial, scores.error[0]
        return placed, error

    def propose(self, placed: np.ndarray, deviation: float) -> tuple[np.ndarray, float]:
        """
        Draw a birth, a death or a move.

        :param placed: (n, 2) positions of the cameras, metres.
        :param deviation: standard deviation of a move along each axis, metres.
        :returns: the changed positions, and the factor of the acceptance probability besides
            exp(-dE / T), as in the table of this module.
        """
        draw = self.rng.random()
        count = len(placed)
        p_birth, p_death = self.proposal_probabilities(count)
        if draw < p_birth:
            trial = np.vstack([placed, self.space.random(self.rng, 1)])
            p_reverse_death = self.proposal_probabilities(count + 1)[1]
            return trial, p_reverse_death / p_birth * self.expected_cameras / (count + 1)
        if draw < p_birth + p_death:
            trial = np.delete(placed, self.rng.integers(count), axis=0)
            p_reverse_birth = self.proposal_probabilities(count - 1)[0]
            return trial, p_reverse_birth / p_death * count / self.expected_cameras
        trial = placed.copy()
        if count:
            camera = self.rng.integers(count)
            moved = self.space.folded(trial[camera] + self.rng.normal(0.0, deviation, 2))
            # Outside the feasible region the target density is 0, so the camera stays.
            trial[camera] = moved if self.space.contains(moved) else trial[camera]
        return trial, 1.0

    @property
    def expected_cameras(self) -> float:
        """Return lambda, the expected number of cameras if the depth error is always 0."""
        return float(self.space.cameras)

    def proposal_probabilities(self, count: int) -> tuple[float, float]:
        """Return the probabilities of proposing a birth and a death with ``count`` cameras."""
        birth_or_death = 2.0 * self.birth_probability
        if count == 0:
            return birth_or_death, 0.0
        if count >= self.space.cameras:
            return 0.0, birth_or_death
        return self.birth_probability, self.birth_probability
