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
The fewest cameras with which each room of a floor reaches its share, and a bound of their number.

Cameras are added greedily by the reduction of the loss of a search, which pays for each room below
its share. With more cameras in place, a camera reduces this loss less. So earlier reductions are
upper limits, and a step computes only those of candidates whose limits are large (lazy greedy:
Minoux, 1978).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from ocp_ros.search.candidate_pool import are_spaced, CandidatePool, MountedCamera
from ocp_ros.search.pose_decoder import coarse_objective
from ocp_ros.simulation.objective import Objective
from ocp_ros.simulation.room_gains import RoomGoal, shares_of, VIEWPOINT_TOLERANCE
from ocp_ros.simulation.simulator import View
from scipy.optimize import Bounds, LinearConstraint, milp

#: Number of candidates whose reductions are computed at once.
BATCH = 64
#: Largest number of nodes in the search for the bound.
BOUND_NODES = 1000


class Placed(NamedTuple):
    """A mounted camera, and the index of its group in the rig's document."""

    group: int
    site: MountedCamera


def views_of(placed: Sequence[Placed]) -> list[View]:
    """Return the views of mounted cameras."""
    return [one.site.view for one in placed]


class FloorCounts:
    """
    Add cameras until each room reaches its share, and remove cameras.

    :param objective: of the rig with its largest number of cameras, with a goal for rooms.
    :param pool: candidates of all its models.
    :param prices: of a camera of each group of the rig, in its document's order; 1 to count.
    """

    def __init__(self, objective: Objective, pool: CandidatePool, prices: Sequence[float]) -> None:
        self._objective = coarse_objective(objective).searched
        self._rig = objective.rig
        self._prices = np.array(prices, dtype=float)
        self._candidates = [
            Placed(group, pool.mounted_candidate(camera.model, row))
            for group, camera in enumerate(self._rig.group_cameras)
            for row in range(len(pool.candidates_of(camera.model).poses))]
        self._groups = np.array([one.group for one in self._candidates])
        self._poses = np.array([one.site.pose for one in self._candidates])
        #: Of each candidate, the largest reduction of the loss that it can still give.
        self._limits = np.full(len(self._candidates), np.inf)

    @property
    def goal(self) -> RoomGoal:
        """Return the goal, whose targets :meth:`greedy` may have raised."""
        return self._objective.room_goal

    def fewest(self, least_price: float | None) -> int:
        """Return the least number of cameras to be placed, by the rig and by a least price."""
        return max(self._rig.least_cameras - len(self._rig.fixed), 1,
                   int(np.ceil((least_price or 0.0) / self._prices.max())))

    def greedy(self, most: int, max_price: float,
               lacking: Callable[[Sequence[Placed]], np.ndarray | None],
               should_stop: Callable[[], bool]) -> list[Placed]:
        """
        Add cameras until each room reaches its share, as far as they are allowed.

        :param most: largest number of cameras.
        :param max_price: largest price of all cameras.
        :param lacking: returns the share (R,) that each room lacks by another measure, by
            which its target is raised; None if the cameras suffice.
        :param should_stop: returns whether to stop.
        """
        placed: list[Placed] = []
        while len(placed) < most and not should_stop():
            shares = shares_of(self._objective.room_gains(views_of(placed), self.goal.by),
                               self._objective.possible_gains)
            if len(placed) >= self.fewest(None) and (shares >= self.goal.targets).all():
                if (lack := lacking(placed)) is None:
                    break
                self._objective.room_goal = self.goal._replace(
                    targets=np.clip(self.goal.targets + np.maximum(lack, 0.0), 0.0, 1.0))
                self._limits[:] = np.inf
            if (added := self.addition(placed, max_price)) is None:
                break
            placed.append(added)
        return placed

    def addition(self, placed: Sequence[Placed], max_price: float) -> Placed | None:
        """Return the camera that reduces the loss most for its price; None if none is allowed."""
        given = views_of(placed)
        before = self._objective.losses_with(given, [self._objective.empty_view], eased=True)[0]
        prices = self._prices[self._groups]
        waiting = are_spaced(self._poses, [one.site for one in placed], self._rig.spacing)
        waiting &= prices <= max_price - self.price(placed) + 1e-9
        best, best_rate = None, -np.inf
        while waiting.any():
            rows = np.flatnonzero(waiting)
            rows = rows[np.argsort(-self._limits[rows] / prices[rows], kind='stable')][:BATCH]
            if self._limits[rows[0]] / prices[rows[0]] <= best_rate:
                break
            self._limits[rows] = before - self._objective.losses_with(
                given, [self._candidates[row].site.view for row in rows], eased=True)
            waiting[rows] = False
            rates = self._limits[rows] / prices[rows]
            if rates.max() > best_rate:
                best, best_rate = self._candidates[rows[int(np.argmax(rates))]], rates.max()
        return best

    def without_one(self, placed: Sequence[Placed]) -> list[Placed]:
        """Return the cameras without that whose loss is least for its price."""
        rests = [[*placed[:k], *placed[k + 1:]] for k in range(len(placed))]
        loss = self._objective.loss(views_of(placed))
        rises = [self._objective.loss(views_of(rest)) - loss for rest in rests]
        return rests[int(np.argmin(rises / self._prices[[one.group for one in placed]]))]

    def price(self, placed: Sequence[Placed]) -> float:
        """Return the price of all these cameras."""
        return float(self._prices[[one.group for one in placed]].sum())

    def least_price(self, placed: Sequence[Placed], target: float) -> float | None:
        """
        Return a lower bound of the price of candidates with which each room reaches its share.

        Gains are submodular: with cameras S in place, cameras A raise the gain of a room by at
        most the sum of what each raises it alone. This holds for no cameras S, and for those of a
        placement that are outside the room, which leave most to the cameras inside. The bound is
        that of the integer program with both inequalities for each room (Nemhauser and Wolsey,
        1981). It holds on the viewpoints and the small depth maps of the search.

        :param placed: a placement.
        :param target: the share to reach in each room.
        :returns: None if several cameras have to see a point: such gains are not submodular.
        """
        objective, goal = self._objective, self.goal
        if self._rig.seen_by > 1:
            return None
        rooms = objective.simulator.scene.rooms
        needed = (target - VIEWPOINT_TOLERANCE) * objective.possible_gains
        own_room = rooms.at(np.array([one.site.pose[:2] for one in placed]))
        views = views_of(self._candidates)
        nothing = objective.room_gains([], goal.by)
        alone = np.array([objective.room_gains([view], goal.by) for view in views]) - nothing
        rows, limits = [*alone.T], [*(needed - nothing)]
        for room in range(1, rooms.count + 1):
            outside = [view for view, own in zip(views_of(placed), own_room) if own != room]
            before = objective.room_gains(outside, goal.by, room)
            gains = np.zeros(len(views))
            for k in np.flatnonzero(alone[:, room - 1] > 0.0):
                gains[k] = objective.room_gains([*outside, views[k]], goal.by, room) - before
            rows.append(gains)
            limits.append(needed[room - 1] - before)
        solved = milp(self._prices[self._groups], integrality=np.ones(len(views)),
                      bounds=Bounds(0, 1), constraints=LinearConstraint(np.array(rows), limits),
                      options={'node_limit': BOUND_NODES})
        # The least prices are often whole numbers, so their rounding errors matter.
        return None if solved.mip_dual_bound is None else float(solved.mip_dual_bound) - 1e-6
