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
Certificate of a placement: lower bound and optimality gap over a dense grid of poses.

The proof holds for these poses, for the engine's visibility and for its depth maps.
"""

from dataclasses import dataclass

from ocp_ros.simulation.objective import Objective


@dataclass(frozen=True)
class Certificate:
    """
    Lower bound for a placement, and the grid that it holds for.

    :ivar candidates: number of poses of the grid.
    :ivar step: largest distance of a feasible place from the grid, metres.
    :ivar near: whether the grid has closer poses near the cameras of the placement.
    :ivar turn: degrees between the headings at a place; 0 if each place has one heading.
    :ivar rows: number of rows of the depth maps.
    :ivar found: loss of the placement.
    :ivar bound: lower bound of the loss of every placement on the grid.
    :ivar final: whether the proof is complete: more time neither raises the bound nor refines the
        grid, and a remaining gap is one of the method.
    :ivar on_grid: loss of the best placement on the grid before poses were added near it; None if
        none was found.
    :ivar seconds: duration of the proof, including the search if both share one budget.
    :ivar relaxed: the :func:`relaxed_goals` of the rig, in which the bound is too optimistic.
    """

    candidates: int
    step: float
    near: bool
    turn: float
    rows: int
    found: float
    bound: float
    final: bool
    on_grid: float | None
    seconds: float
    relaxed: tuple[str, ...] = ()

    @property
    def gap(self) -> float:
        """Return the optimality gap to placements on the grid, as a share of the loss."""
        return max((self.found - self.bound) / self.found, 0.0) if self.found > 0.0 else 0.0

    @property
    def moved(self) -> float | None:
        """Return the reduction of the loss by moves off the grid, as a share of ``on_grid``."""
        if self.on_grid is None:
            return None
        return max((self.on_grid - self.found) / self.on_grid, 0.0) if self.on_grid > 0.0 else 0.0


def relaxed_goals(objective: Objective) -> tuple[str, ...]:
    """Return the names of goals that lower bounds count only in part, or not at all."""
    rig = objective.rig
    found = {'seen_by': rig.seen_by > 1, 'calibratable': rig.calibratable is not None,
             'air': any(region.air for region in rig.regions),
             'interference': rig.no_interference,
             'the share of each room': objective.room_goal is not None,
             'require': any(requirement.cameras > 1 for requirement in rig.requirements)}
    return tuple(name for name, relaxed in found.items() if relaxed)
