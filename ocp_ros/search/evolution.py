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
Differential evolution (DE), after Storn and Price (1997), and CMA-ES with restarts.

A placement is a set: the order of its cameras is arbitrary. So before DE computes a difference,
the cameras of the other placements are matched with those of the base by the smallest sum of
squared distances.
"""

import logging

import numpy as np
from ocp_ros.search.planner import Planner, Search
from scipy.optimize import linear_sum_assignment

#: Number of placements in a generation, share of the best ones that may be pbest, and probability
#: to take a camera from the mutant.
POPULATION, LEADERS, CROSSOVER = 24, 0.2, 0.5
#: Placements that differ by less than this count as equal, metres.
ALIKE = 1e-3
#: First standard deviation of CMA-ES, as a share of the rectangle's edges.
SIGMA = 0.25


def matched(base: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the other positions (K, 2) in the order that matches the base positions."""
    cost = ((base[:, None] - other[None]) ** 2).sum(axis=-1)
    return other[linear_sum_assignment(cost)[1]]


class DifferentialEvolution(Planner):
    """DE/current-to-pbest/1/bin, with crossover by camera."""

    def search(self) -> Search:
        """Evolve until the budget is used up."""
        space, rng = self.space, self.rng
        count = int(np.clip(self.budget // 10, 5, POPULATION))
        placed = np.array([space.random(rng) for _ in range(count)])
        scores = yield list(placed)
        errors = scores.error.copy()
        while True:
            trials = np.array([self._trial(placed, errors, i) for i in range(count)])
            scores = yield list(trials)
            better = scores.error <= errors
            placed[better], errors[better] = trials[better], scores.error[better]
            if np.ptp([matched(placed[0], other) for other in placed], axis=0).max() < ALIKE:
                # All placements are equal: replace all except the best by random ones.
                best = int(np.argmin(errors))
                for i in range(count):
                    placed[i] = placed[best] if i == best else space.random(rng)
                scores = yield list(placed)
                errors = scores.error.copy()

    def _trial(self, placed: np.ndarray, errors: np.ndarray, i: int) -> np.ndarray:
        """Return the crossover of a placement and its mutant."""
        leaders = np.argsort(errors)[:max(int(LEADERS * len(placed)), 2)]
        base = placed[i]
        lead, one, two = (matched(base, placed[k]) for k in (
            self.rng.choice(leaders), *self.rng.choice(len(placed), 2, replace=False)))
        weight = self.rng.uniform(0.3, 0.9)
        mutant = base + weight * (lead - base) + weight * (one - two)
        take = self.rng.random(len(base)) < CROSSOVER
        take[self.rng.integers(len(base))] = True
        return np.where(take[:, None], self.space.reflected(mutant), base)


class CmaEs(Planner):
    """CMA-ES by pycma; after convergence it restarts at random with a larger population."""

    def search(self) -> Search:
        """Run and restart until the budget is used up."""
        # pycma imports matplotlib, which is slow: import it only for this planner.
        import cma
        logging.getLogger('cma').setLevel(logging.ERROR)
        space, restarts = self.space, 0
        scale = np.maximum(space.size, 1e-9)
        while True:
            mean = ((space.random(self.rng) - space.low) / scale).ravel()
            size = int(4 + 3 * np.log(len(mean))) * 2 ** min(restarts, 3)
            strategy = cma.CMAEvolutionStrategy(mean, SIGMA, {
                'bounds': [0.0, 1.0], 'verbose': -9, 'popsize': size, 'tolfun': 1e-4,
                'tolx': 1e-4, 'seed': np.nan, 'randn': self._normal})
            while not strategy.stop():
                shares = strategy.ask()
                scores = yield [space.inside(space.low + scale * row.reshape(-1, 2))
                                for row in shares]
                strategy.tell(shares, list(scores.error))
            restarts += 1

    def _normal(self, *shape: int) -> np.ndarray:
        """Draw normal numbers for pycma; without it pycma uses NumPy's global generator."""
        return self.rng.standard_normal(shape)
