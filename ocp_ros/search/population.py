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
Planners that improve a population of placements.

Differential evolution (DE) follows Storn and Price (1997), the artificial bee colony (ABC)
Karaboga and Basturk (2007), and binary particle swarm optimisation (BPSO) Morsly et al. (2012).
CMA-ES is that of pycma, with restarts.

A placement is a set: the order of its cameras is arbitrary. So before DE or ABC computes a
difference, the cameras of the other placements are matched with those of the base by the smallest
sum of squared distances.
"""

import logging

import numpy as np
from ocp_ros.search.planner import Planner, Search
from ocp_ros.util.settings import need
from scipy.optimize import linear_sum_assignment


def match_positions(base: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the other positions (K, 2) in the order that matches the base positions (K, 2)."""
    squared_distances = ((base[:, None] - other[None]) ** 2).sum(axis=-1)
    return other[linear_sum_assignment(squared_distances)[1]]


class DifferentialEvolution(Planner):
    """
    DE/current-to-pbest/1/bin, with crossover by camera.

    Each placement is crossed with its mutant: the placement moved towards one of the best
    placements (pbest) and by the difference of two random ones.
    """

    def search(self) -> Search:
        """Evolve until the budget is used up."""
        space, rng = self.space, self.rng
        # From a budget of 50 on, there are at least ten generations.
        count = int(np.clip(self.budget // 10, 5, 24))
        placed = np.array([space.random(rng) for _ in range(count)])
        scores = yield list(placed)
        errors = scores.error.copy()
        while True:
            trials = np.array([self._crossover(placed, errors, i) for i in range(count)])
            scores = yield list(trials)
            better = scores.error <= errors
            placed[better], errors[better] = trials[better], scores.error[better]
            positions = [match_positions(placed[0], other) for other in placed]
            if np.ptp(positions, axis=0).max() < 1e-3:
                # All placements are equal within a millimetre, so the search cannot go on: replace
                # all except the best one by random placements.
                for i in np.delete(np.arange(count), np.argmin(errors)):
                    placed[i] = space.random(rng)
                scores = yield list(placed)
                errors = scores.error.copy()

    def _crossover(self, placed: np.ndarray, errors: np.ndarray, i: int) -> np.ndarray:
        """
        Return the crossover of a placement and its mutant.

        :param placed: (P, K, 2) metres, positions of the K cameras of P placements.
        :param errors: (P,) of these placements.
        :param i: number of the placement.
        :returns: (K, 2) metres.
        """
        best_fifth = np.argsort(errors)[:max(int(0.2 * len(placed)), 2)]
        base = placed[i]
        pbest, first, second = (match_positions(base, placed[k]) for k in (
            self.rng.choice(best_fifth), *self.rng.choice(len(placed), 2, replace=False)))
        weight = self.rng.uniform(0.3, 0.9)
        mutant = base + weight * (pbest - base) + weight * (first - second)
        from_mutant = self.rng.random(len(base)) < 0.5
        # At least one camera comes from the mutant.
        from_mutant[self.rng.integers(len(base))] = True
        return np.where(from_mutant[:, None], self.space.reflected(mutant), base)


class CmaEs(Planner):
    """CMA-ES by pycma; after convergence it restarts at random with a larger population."""

    def search(self) -> Search:
        """Run and restart until the budget is used up."""
        need('planner cma', 'cma')
        # pycma imports matplotlib, which is slow: import it only for this planner.
        import cma
        logging.getLogger('cma').setLevel(logging.ERROR)
        space = self.space
        # The strategy works on positions as shares of the edges of the space, which must not be 0.
        edges = np.maximum(space.size, 1e-9)
        restarts = 0
        while True:
            mean = ((space.random(self.rng) - space.low) / edges).ravel()
            # The usual size for this number of dimensions, doubled at the first three restarts.
            population_size = int(4 + 3 * np.log(len(mean))) * 2 ** min(restarts, 3)
            # The first standard deviation is a quarter of the edges. A run has converged if errors
            # or shares change by less than 1e-4. With the seed NaN, pycma leaves NumPy's global
            # generator alone.
            strategy = cma.CMAEvolutionStrategy(mean, 0.25, {
                'bounds': [0.0, 1.0], 'verbose': -9, 'popsize': population_size, 'tolfun': 1e-4,
                'tolx': 1e-4, 'seed': np.nan, 'randn': self._draw_normal})
            while not strategy.stop():
                shares = strategy.ask()
                scores = yield [space.inside(space.low + edges * row.reshape(-1, 2))
                                for row in shares]
                strategy.tell(shares, list(scores.error))
            restarts += 1

    def _draw_normal(self, *shape: int) -> np.ndarray:
        """Draw normal numbers for pycma, which otherwise uses NumPy's global generator."""
        return self.rng.standard_normal(shape)


class BeeColony(Planner):
    """
    ABC over positions.

    Each food source is a placement. Employed bees try v = x + phi (x - other) in one camera of
    each source, phi uniform in [-1, 1]. Onlooker bees do the same at sources drawn by their
    fitness 1 / (1 + depth error). A source with too many trials without improvement is exhausted:
    it is replaced by a random one.
    """

    def search(self) -> Search:
        """Improve the sources until the budget is used up."""
        space, rng = self.space, self.rng
        # A small budget suffices for several rounds of two trials for each source.
        count = min(12, max(self.budget // 8, 2))
        max_failures = 5 * count * space.cameras
        sources = np.array([space.random(rng) for _ in range(count)])
        scores = yield list(sources)
        errors = scores.error.copy()
        # Successive trials without improvement of each source.
        failures = np.zeros(count, dtype=int)
        while True:
            fitness = 1.0 / (1.0 + errors)
            # The employed bees visit each source once, the onlookers draw sources by fitness.
            for visited in (np.arange(count), rng.choice(count, count, p=fitness / fitness.sum())):
                trials = np.array([self._neighbour_of(sources, i) for i in visited])
                scores = yield list(trials)
                for i, trial, error in zip(visited, trials, scores.error):
                    failures[i] += 1
                    if error < errors[i]:
                        sources[i], errors[i], failures[i] = trial, error, 0
            exhausted = int(np.argmax(failures))
            if failures[exhausted] > max_failures:
                sources[exhausted] = space.random(rng)
                scores = yield [sources[exhausted]]
                errors[exhausted], failures[exhausted] = scores.error[0], 0

    def _neighbour_of(self, sources: np.ndarray, i: int) -> np.ndarray:
        """Return source i of S sources (S, K, 2) with one camera moved to v, see the class."""
        # Any source except source i.
        other = sources[(i + self.rng.integers(1, len(sources))) % len(sources)]
        trial = sources[i].copy()
        camera = self.rng.integers(self.space.cameras)
        difference = trial[camera] - match_positions(sources[i], other)[camera]
        trial[camera] = self.space.reflected(
            trial[camera] + self.rng.uniform(-1.0, 1.0, 2) * difference)
        return trial


class BinaryParticleSwarm(Planner):
    """
    BPSO over a grid of M candidate positions, of which K are chosen.

    A particle has a bit x for each candidate. Velocities follow v <- 0.72 v
    + 1.49 r1 (own best - x) + 1.49 r2 (best of all - x) with random r1 and r2, each bit is drawn
    again as rand < sigmoid(v) (Kennedy and Eberhart, 1997), and the bits are repaired so that K
    are set: surplus bits of smallest velocity are cleared, missing bits of largest velocity are
    set.

    The text of the source was not available. The parameters are the usual ones, so details may
    differ from the source.

    :cvar max_candidates: largest M.
    """

    max_candidates = 1024

    def search(self) -> Search:
        """Move the particles until the budget is used up."""
        candidates = self.space.grid(int(np.clip(self.budget // 4, 16, self.max_candidates)))
        cameras = min(self.space.cameras, len(candidates))
        particles = min(24, max(self.budget // 8, 2))
        # At the mean of the first velocities, the sigmoid sets about K of M bits.
        mean_velocity = np.log(cameras / max(len(candidates) - cameras, 1))
        velocity = self.rng.normal(mean_velocity, 1.0, (particles, len(candidates)))
        bits = self._draw_bits(velocity, cameras)
        # The best bits that each particle has had, and their errors.
        best = bits.copy()
        best_error = np.full(particles, np.inf)
        while True:
            scores = yield [candidates[row] for row in bits]
            better = scores.error < best_error
            best[better], best_error[better] = bits[better], scores.error[better]
            leader = best[np.argmin(best_error)]
            r1, r2 = self.rng.random((2, *velocity.shape))
            velocity = (0.72 * velocity + 1.49 * r1 * (best.astype(float) - bits)
                        + 1.49 * r2 * (leader.astype(float) - bits))
            # Within these limits, the sigmoid is from 2 to 98 %: each bit may still change.
            velocity = np.clip(velocity, -4.0, 4.0)
            bits = self._draw_bits(velocity, cameras)

    def _draw_bits(self, velocity: np.ndarray, cameras: int) -> np.ndarray:
        """Draw the bits (P, M) of P particles by velocities (P, M); K = ``cameras`` are set."""
        drawn = self.rng.random(velocity.shape) < 1.0 / (1.0 + np.exp(-velocity))
        # Drawn bits come first (velocities are far below 100), both parts sorted by velocity; the
        # order of equal velocities is random.
        rank = velocity + 1e-6 * self.rng.random(velocity.shape) + 100.0 * drawn
        chosen = np.argsort(-rank, axis=1)[:, :cameras]
        bits = np.zeros(velocity.shape, dtype=bool)
        np.put_along_axis(bits, chosen, True, axis=1)
        return bits
