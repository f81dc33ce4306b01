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
How much better than a placement any other one on a dense grid of poses may be.

What is proved holds for these poses, for the engine's visibility and for its depth maps.
"""

from dataclasses import dataclass

from ocp_ros.simulation.objective import Objective


@dataclass(frozen=True)
class Certificate:
    """
    What was proved of a placement.

    :ivar candidates: how many poses other placements may choose from.
    :ivar step: metres: no feasible place is farther from one of theirs.
    :ivar turn: degrees between their headings; 0 where each place has one.
    :ivar rows: of the depth maps.
    :ivar found: loss of the placement.
    :ivar bound: no placement on the candidates loses less.
    :ivar closed: whether more time would not raise the bound.
    :ivar on_grid: loss of the best placement on the candidates before some were added near it.
    :ivar seconds: how long it took.
    """

    candidates: int
    step: float
    turn: float
    rows: int
    found: float
    bound: float
    closed: bool
    on_grid: float
    seconds: float

    @property
    def gap(self) -> float:
        """Return the share of the loss that others on the candidates may be better by."""
        return max((self.found - self.bound) / self.found, 0.0) if self.found > 0.0 else 0.0

    @property
    def moved(self) -> float:
        """Return the share of the grid's loss that moving off the grid has gained."""
        return max((self.on_grid - self.found) / self.on_grid, 0.0) if self.on_grid > 0.0 else 0.0


def not_covered(objective: Objective) -> str | None:
    """Say why no bound can be proved for a rig; None where one can."""
    if objective.rig.seen_by > 1:
        return (f'found seen_by: {objective.rig.seen_by}; expected 1, for bounds are known where '
                'one camera has to see a place')
    if objective.rig.calibratable is not None:
        return 'found calibratable; expected a rig without it, for bounds do not know of pairs'
    if any(region.air for region in objective.rig.regions):
        return 'found regions of air; expected regions of points, for bounds do not know of pairs'
    return None
