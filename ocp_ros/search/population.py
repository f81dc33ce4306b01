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
                # All are equal within a millimetre: replace all except the best by random ones.
                best = int(np.argmin(errors))
                for i in range(count):
                    placed[i] = placed[best] if i == best else space.random(rng)
                scores = yield list(placed)
                errors = scores.error.copy()

    def _crossover(self, placed: np.ndarray, errors: np.ndarray, i: int) -> np.ndarray:
        """Return the crossover of placement i of (P, K, 2) and its mutant; errors are (P,)."""
        best_fifth = np.argsort(errors)[:max(int(0.2 * len(placed)), 2)]
        base = placed[i]
        pbest, first, second = (match_positions(base, placed[k]) for k in (
            self.rng.choice(best_fifth), *self.rng.choice(len(placed), 2, replace=False)))
        weight = self.rng.uniform(0.3, 0.9)
        mutant = base + weight * (pbest - base) + weight * (first - second)
        from_mutant = self.rng.random(len(base)) < 0.5
        from_mutant[self.rng.integers(len(base))] = True
        return np.where(from_mutant[:, None], self.space.reflected(mutant), base)


class CmaEs(Planner):
    """CMA-ES by pycma; after convergence it restarts at random with a larger population."""

    def search(self) -> Search:
        """Run and restart until the budget is used up."""
        # pycma imports matplotlib, which is slow: import it only for this planner.
        import cma
        logging.getLogger('cma').setLevel(logging.ERROR)
        space = self.space
        # The strategy works on positions as shares of the edges of the space.
        edges = np.maximum(space.size, 1e-9)
        restarts = 0
        while True:
            mean = ((space.random(self.rng) - space.low) / edges).ravel()
            population_size = int(4 + 3 * np.log(len(mean))) * 2 ** min(restarts, 3)
            # The first standard deviation is a quarter of the edges.
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
        count = min(12, max(self.budget // 8, 2))
        max_trials = 5 * count * space.cameras
        sources = np.array([space.random(rng) for _ in range(count)])
        scores = yield list(sources)
        errors = scores.error.copy()
        tried = np.zeros(count, dtype=int)
        while True:
            fitness = 1.0 / (1.0 + errors)
            for visited in (np.arange(count), rng.choice(count, count, p=fitness / fitness.sum())):
                trials = np.array([self._neighbour_of(sources, i) for i in visited])
                scores = yield list(trials)
                for i, trial, error in zip(visited, trials, scores.error):
                    tried[i] += 1
                    if error < errors[i]:
                        sources[i], errors[i], tried[i] = trial, error, 0
            exhausted = int(np.argmax(tried))
            if tried[exhausted] > max_trials:
                sources[exhausted] = space.random(rng)
                scores = yield [sources[exhausted]]
                errors[exhausted], tried[exhausted] = scores.error[0], 0

    def _neighbour_of(self, sources: np.ndarray, i: int) -> np.ndarray:
        """Return source i of (S, K, 2) with one camera moved along a difference of sources."""
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
            velocity = np.clip(velocity, -4.0, 4.0)
            bits = self._draw_bits(velocity, cameras)

    def _draw_bits(self, velocity: np.ndarray, cameras: int) -> np.ndarray:
        """Draw K bits in each row of (P, M) by the velocities (P, M); P is that of particles."""
        drawn = self.rng.random(velocity.shape) < 1.0 / (1.0 + np.exp(-velocity))
        # Drawn bits come first, sorted by velocity; equal velocities are in random order.
        rank = velocity + 1e-6 * self.rng.random(velocity.shape) + 100.0 * drawn
        chosen = np.argsort(-rank, axis=1)[:, :cameras]
        bits = np.zeros(velocity.shape, dtype=bool)
        np.put_along_axis(bits, chosen, True, axis=1)
        return bits
