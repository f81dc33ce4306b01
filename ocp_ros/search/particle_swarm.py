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
Binary particle swarm optimisation (BPSO) over a candidate grid, after Morsly et al. (2012).

A particle has a bit for each candidate. Velocities follow v <- w v + c1 r1 (own best - x)
+ c2 r2 (best of all - x), each bit is drawn again as rand < sigmoid(v) (Kennedy and Eberhart,
1997), and the bits are repaired to K of M: surplus bits of smallest velocity are cleared, missing
bits of largest velocity are set.

The text of the source was not available. The parameters are the usual ones, so details may differ
from the source.
"""

import numpy as np
from ocp_ros.search.planner import Planner, Search

#: Number of particles, w, c1, c2, and the largest absolute velocity.
PARTICLES, INERTIA, OWN, SOCIAL, FASTEST = 24, 0.72, 1.49, 1.49, 4.0
#: Largest number of candidates.
CANDIDATES = 1024


class BinaryParticleSwarm(Planner):
    """BPSO with repair to K of M."""

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
            velocity = np.clip(velocity, -FASTEST, FASTEST)
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
