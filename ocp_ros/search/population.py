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

#: DE: number of placements in a generation, share of the best ones that may be pbest, and
#: probability to take a camera from the mutant.
POPULATION, LEADERS, CROSSOVER = 24, 0.2, 0.5
#: DE: placements that differ by less than this count as equal, metres.
EQUAL_M = 1e-3
#: CMA-ES: first standard deviation, as a share of the rectangle's edges.
SIGMA = 0.25
#: ABC: largest number of food sources.
SOURCES = 12
#: BPSO: number of particles, w, c1, c2, and the largest absolute velocity.
PARTICLES, INERTIA, OWN, SOCIAL, MAX_VELOCITY = 24, 0.72, 1.49, 1.49, 4.0
#: BPSO: largest number of candidates.
CANDIDATES = 1024


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
            if np.ptp([matched(placed[0], other) for other in placed], axis=0).max() < EQUAL_M:
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


class BeeColony(Planner):
    """
    ABC over positions.

    Each food source is a placement. Employed bees try v = x + phi (x - other) in one camera of
    each source, phi uniform in [-1, 1]. Onlookers do the same at sources drawn by their fitness
    1 / (1 + E). A source with too many trials without improvement is replaced by a random one.
    """

    def search(self) -> Search:
        """Improve the sources until the budget is used up."""
        space, rng = self.space, self.rng
        count = min(SOURCES, max(self.budget // 8, 2))
        limit = 5 * count * space.cameras
        sources = np.array([space.random(rng) for _ in range(count)])
        scores = yield list(sources)
        errors, tried = scores.error.copy(), np.zeros(count, dtype=int)
        while True:
            fitness = 1.0 / (1.0 + errors)
            for visited in (np.arange(count), rng.choice(count, count, p=fitness / fitness.sum())):
                trials = np.array([self._neighbour(sources, i) for i in visited])
                scores = yield list(trials)
                for i, trial, error in zip(visited, trials, scores.error):
                    tried[i] += 1
                    if error < errors[i]:
                        sources[i], errors[i], tried[i] = trial, error, 0
            worn = int(np.argmax(tried))
            if tried[worn] > limit:
                sources[worn] = space.random(rng)
                scores = yield [sources[worn]]
                errors[worn], tried[worn] = scores.error[0], 0

    def _neighbour(self, sources: np.ndarray, i: int) -> np.ndarray:
        """Move one camera of a source along its difference to another source."""
        other = sources[(i + self.rng.integers(1, len(sources))) % len(sources)]
        trial, camera = sources[i].copy(), self.rng.integers(self.space.cameras)
        difference = trial[camera] - matched(sources[i], other)[camera]
        trial[camera] = self.space.reflected(
            trial[camera] + self.rng.uniform(-1.0, 1.0, 2) * difference)
        return trial


class BinaryParticleSwarm(Planner):
    """
    BPSO over a candidate grid, with repair to K of M.

    A particle has a bit for each candidate. Velocities follow v <- w v + c1 r1 (own best - x)
    + c2 r2 (best of all - x), each bit is drawn again as rand < sigmoid(v) (Kennedy and Eberhart,
    1997), and the bits are repaired to K of M: surplus bits of smallest velocity are cleared,
    missing bits of largest velocity are set.

    The text of the source was not available. The parameters are the usual ones, so details may
    differ from the source.
    """

    #: Largest M.
    candidates = CANDIDATES

    def search(self) -> Search:
        """Update the swarm until the budget is used up."""
        candidates = self.space.grid(int(np.clip(self.budget // 4, 16, self.candidates)))
        cameras = min(self.space.cameras, len(candidates))
        particles = min(PARTICLES, max(self.budget // 8, 2))
        # At the mean of the first velocities, the sigmoid sets about K of M bits.
        usual = np.log(cameras / max(len(candidates) - cameras, 1))
        velocity = self.rng.normal(usual, 1.0, (particles, len(candidates)))
        bits = self._drawn(velocity, cameras)
        best, best_error = bits.copy(), np.full(particles, np.inf)
        while True:
            scores = yield [candidates[row] for row in bits]
            better = scores.error < best_error
            best[better], best_error[better] = bits[better], scores.error[better]
            leader = best[np.argmin(best_error)]
            own, social = self.rng.random((2, *velocity.shape))
            velocity = (INERTIA * velocity + OWN * own * (best.astype(float) - bits)
                        + SOCIAL * social * (leader.astype(float) - bits))
            velocity = np.clip(velocity, -MAX_VELOCITY, MAX_VELOCITY)
            bits = self._drawn(velocity, cameras)

    def _drawn(self, velocity: np.ndarray, cameras: int) -> np.ndarray:
        """Draw K of M bits in each row by their velocities."""
        drawn = self.rng.random(velocity.shape) < 1.0 / (1.0 + np.exp(-velocity))
        # Drawn bits come first, sorted by velocity; equal velocities are in random order.
        rank = velocity + 1e-6 * self.rng.random(velocity.shape) + 100.0 * drawn
        chosen = np.argsort(-rank, axis=1)[:, :cameras]
        bits = np.zeros(velocity.shape, dtype=bool)
        np.put_along_axis(bits, chosen, True, axis=1)
        return bits
