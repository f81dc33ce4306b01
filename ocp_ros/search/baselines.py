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

"""Baselines without a search: random placements, and regular grids as installers use them."""

import numpy as np
from ocp_ros.search.planner import Planner, Search

BATCH = 32


class Random(Planner):
    """The best of uniformly drawn placements."""

    descends = False

    def search(self) -> Search:
        """Draw placements until the budget is used up."""
        while True:
            yield [self.space.random(self.rng) for _ in range(BATCH)]


class RegularGrid(Planner):
    """The best of the regular arrangements in rows and columns; some cells may stay empty."""

    descends = False

    def search(self) -> Search:
        """Try every number of columns once."""
        cameras, low, size = self.space.cameras, self.space.low, self.space.size
        arrangements = []
        for columns in range(1, cameras + 1):
            rows = -(-cameras // columns)
            x, y = np.meshgrid((np.arange(columns) + 0.5) / columns,
                               (np.arange(rows) + 0.5) / rows)
            cells = np.stack([x, y], axis=-1).reshape(-1, 2)
            # If there are more cells than cameras, cells in the middle stay empty.
            keep = np.argsort(-np.abs(cells - 0.5).max(axis=1), kind='stable')[:cameras]
            arrangements.append(self.space.inside(low + cells[np.sort(keep)] * size))
        yield arrangements
