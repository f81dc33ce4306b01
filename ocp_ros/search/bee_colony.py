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
Artificial bee colony (ABC), after Karaboga and Basturk (2007).

Each food source is a placement. Employed bees try v = x + phi (x - other) in one camera of each
source, phi uniform in [-1, 1]. Onlookers do the same at sources drawn by their fitness
1 / (1 + E). A source with too many trials without improvement is replaced by a random one. Before
a difference is computed, the cameras of both sources are matched, because their order in a
placement is arbitrary.
"""

import numpy as np
from ocp_ros.search.evolution import matched
from ocp_ros.search.planner import Planner, Search

SOURCES = 12


class BeeColony(Planner):
    """ABC over positions."""

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
