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

"""The objective of a placement: the depth error, and the requirements of the rig's regions."""

from collections.abc import Iterator, Sequence
from copy import copy
from functools import cached_property
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.packed_bits import count_bits, no_bits, pack, seen_by, Subset, unpack
from ocp_ros.rig.connections import light_of
from ocp_ros.rig.feasible_region import floor_space
from ocp_ros.rig.free_plane import CELL_M, FreePlane
from ocp_ros.rig.rig_file import Region, Rig
from ocp_ros.rig.structure import Air, ceiling_of, floor_height, floors_of
from ocp_ros.rig.zones import Zone
from ocp_ros.simulation.covisibility import (
    Covisibility,
    covisibility,
    SHARE_TOLERANCE,
    watched_share,
)
from ocp_ros.simulation.interference import lit_shares, MAX_LIT_SHARE
from ocp_ros.simulation.room_gains import RoomGains, RoomGoal, shares_of
from ocp_ros.simulation.simulator import Simulator, View
from ocp_ros.util.settings import ConfigurationError, MAX_CAMERAS

#: The cost of missing all of a region that must be seen; missing the whole room costs 1.
MUST_SEE_COST = 10.0
#: The shared part of points that a search demands of linked cameras / that of the rig.
LINK_MARGIN = 1.25


class RigEvaluation(NamedTuple):
    """
    The evaluation of a placement; a point counts as seen if ``seen_by`` cameras see it.

    :ivar loss: the value to minimise: depth error / depth error of seeing nothing + sum of weight
        x unseen share + 10 x shortfall of each share that must be seen + 10 x shortfall of the
        shared points that link all cameras, if the rig requires links + 10 x shortfall of the
        share that meets each requirement, as a mean over the numbers of cameras up to its own.
    :ivar depth_error: metres.
    :ivar space_coverage: cubic metres.
    :ivar regions: (R,) of each of R regions, the share of its points, or of its cells of air,
        that is seen.
    :ivar seen: the points that enough cameras see.
    :ivar connected: whether links connect all cameras and no two cameras disturb each other, as
        far as the rig requires that.
    :ivar requirements: (Q,) the share of the points that meets each requirement of the rig.
    """

    loss: float
    depth_error: float
    space_coverage: float
    regions: np.ndarray
    seen: Subset
    connected: bool
    requirements: np.ndarray

    def meets(self, rig: Rig) -> bool:
        """Return whether a rig's regions, requirements and links have what they need."""
        return bool(self.connected) and all(
            share >= region.must_see for region, share in zip(rig.regions, self.regions)) and all(
            share >= requirement.share
            for requirement, share in zip(rig.requirements, self.requirements))


class Contribution(NamedTuple):
    """
    The contribution of one camera in addition to the others.

    :ivar depth_error: the depth error without the camera minus the error with it, metres.
    :ivar only: the share of all points that only this camera sees.
    """

    depth_error: float
    only: float


class Objective:
    """
    Evaluate placements of a rig in one room.

    Views of cameras in place are included and computed once.

    :param simulator: the engine; its camera models are those of the K cameras to be placed, then
        of the F in place.
    :param rig: the rig of these cameras.
    :param room_goal: what a search has to reach in each room of a floor: :attr:`searched` pays 10
        x the shortfall of each room.
    :raises ConfigurationError: if a region contains no points of the room.
    """

    def __init__(self, simulator: Simulator, rig: Rig, room_goal: RoomGoal | None = None) -> None:
        self.simulator = simulator = simulator.with_requirements(rig.requirements)
        self.rig = rig
        airs = [self._air_in(region) for region in rig.regions if region.air]
        if airs:
            self.simulator = simulator = simulator.with_air(np.concatenate(airs))
        #: Numbers of the cells of the regions of air, one after the other, in the engine's order.
        numbers = np.argsort(simulator.visibility.place_order)[len(simulator.grid):]
        air_numbers = iter(np.split(numbers, np.cumsum([len(cells) for cells in airs])))
        self._link_condition = rig.calibratable
        self.room_goal = room_goal
        #: By quantity, for :meth:`room_gains`.
        self._room_gains: dict[str, RoomGains] = {}
        #: (R,) what is possible in each room, if the loss includes the goal.
        self.possible_gains: np.ndarray | None = None
        count = len(rig.cameras)
        self.fixed = [simulator.look(pose, count + k) for k, pose in enumerate(rig.fixed_poses)]
        #: What a camera that sees nothing sees.
        self.empty_view = View(
            no_bits(len(simulator.scene)), no_bits(len(simulator.places)),
            good=np.array([no_bits(len(simulator.scene))] * len(rig.requirements), np.uint64))
        self._order = simulator.visibility.order
        #: Of each region: packed bits of its points, or the indices of its cells of air.
        self._contents = [
            self._points_of(region.zone, region) if region.air is None else next(air_numbers)
            for region in rig.regions]
        #: Packed bits of the points of each requirement.
        self._required = [self._points_of(requirement.zone) for requirement in rig.requirements]
        self._weights = np.array([region.weight for region in rig.regions])
        self._required_shares = np.array([region.must_see for region in rig.regions])

    def _points_of(self, zone: Zone | None, region: Region | None = None) -> np.ndarray:
        """
        Return the points in a zone as packed bits: (W,) uint64 words.

        :param zone: None for all points.
        :param region: the region of the zone, which is refused if it is empty.
        """
        scene = self.simulator.scene
        inside = (np.ones(len(scene), dtype=bool) if zone is None
                  else zone.contains(scene.points, floor_height(scene)))
        if region is not None:
            self._check_inside(region, inside)
        return pack(inside[self._order])

    def _air_in(self, region: Region) -> np.ndarray:
        """
        Return the cells that are air in a region: (S, 3) metres, their centres.

        Along each axis, a cell is at most a tenth of the region and a cell of the space coverage.
        """
        scene = self.simulator.scene
        floor, edge = floor_height(scene), self.simulator.cell_volume ** (1.0 / 3.0)
        low, high = region.zone.corners(floor)
        low, high = np.maximum(low, scene.bounds[0]), np.minimum(high, scene.bounds[1])
        counts = np.maximum(np.ceil((high - low) / edge - 0.01), 10).astype(int)
        # A region outside of the scan has no cells.
        counts *= int((low < high).all())
        axes = [start + (np.arange(count) + 0.5) * (end - start) / count
                for start, end, count in zip(low, high, counts)]
        cells = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)
        cells = cells[region.zone.contains(cells, floor)]
        # Cells inside furniture are not air; right behind its faces they may count as air.
        is_air, min_share = ~self._air.closed(cells), 0.05
        self._check_inside(region, np.array([is_air.sum() > min_share * len(cells)]))
        return cells[is_air]

    @cached_property
    def validation(self) -> 'Objective':
        """Return the same objective on the validation viewpoints."""
        other = copy(self)
        other.simulator = self.simulator.with_validation()
        other._room_gains = {}
        return other

    @cached_property
    def unscanned(self) -> list[float | None]:
        """
        Return the share of the surface of each region that was not scanned, about or more.

        It is None for regions of air, and if it is not known from where the scan was made.
        """
        evidence, count = self.validation.simulator.evidence, len(self._points)
        return [None if region.air or evidence is None else evidence.unscanned_share(
            unpack(content, count), self._air)
            for region, content in zip(self.rig.regions, self._contents)]

    @cached_property
    def searched(self) -> 'Objective':
        """
        Return the objective of a search: links need a margin, and rooms their share of a goal.

        What two cameras share in the room itself may be less than in the engine.
        """
        condition, goal = self._link_condition, self.room_goal
        if condition is None and goal is None:
            return self
        other = copy(self)
        if condition is not None:
            other._link_condition = condition._replace(
                overlap=min(LINK_MARGIN * condition.overlap, 1.0))
        if goal is not None:
            other.possible_gains = self.room_gains(goal.union, goal.by)
        return other

    @cached_property
    def _air(self) -> Air:
        """Return the air of the room."""
        return Air(self.simulator.scene, self._space)

    @cached_property
    def _space(self) -> FreePlane:
        """Return the positions over the floor of the room."""
        scene = self.simulator.scene
        return floor_space(scene, self.rig, scene.bounds[1, 2])

    @cached_property
    def volume(self) -> float:
        """Return the volume between floor and ceiling, in cells of the coverage, cubic metres."""
        scene, cells = self.simulator.scene, self._cells[self.simulator.is_grid]
        ceiling, top = ceiling_of(scene), np.full(len(cells), np.inf)
        if len(ceiling.points):
            top = ceiling.height_above(cells[:, :2])
            # Without a ceiling above it, the room ends at the top of the scan.
            top[~np.isfinite(top)] = np.inf
        # The known floor ends a cell before the walls.
        distance = np.linalg.norm(self._space.inside(cells[:, :2]) - cells[:, :2], axis=1)
        inside = (distance <= CELL_M) & (cells[:, 2] < top)
        inside &= cells[:, 2] > floors_of(scene).under(cells)
        return float(np.count_nonzero(inside) * self.simulator.cell_volume)

    def _check_inside(self, region: Region, inside: np.ndarray) -> None:
        """
        Refuse a region without points, or without cells of air.

        ``inside`` says which points or cells are in it.
        """
        if not inside.any():
            scene = self.simulator.scene
            low, high = (', '.join(f'{value:.2f}' for value in corner) for corner in scene.bounds)
            remedy = ('correct its corners, or choose a region that is in the scan' if region.air
                      else 'write air: {} if it is in the air, or correct its corners')
            raise ConfigurationError(
                f'{region.where}: found no {region.parts} of {scene.name} in it; expected '
                f'some, within ({low}) to ({high}); {remedy}')

    @cached_property
    def _cells(self) -> np.ndarray:
        """Return all cells of air in the engine's order: (M, 3) metres."""
        return self.simulator.places.astype(np.float64)

    @cached_property
    def _points(self) -> np.ndarray:
        """Return the points of the room in the engine's order: (N, 3) metres."""
        return self.simulator.scene.points[self._order]

    def point_costs(self) -> Iterator[tuple[np.ndarray, float]]:
        """
        Yield the costs of not seeing each of the N points, without the depth error.

        Regions of air are left out, and of requirements of several cameras one camera counts.

        :returns: pairs: the cost of each unseen point in the engine's order, and an amount of the
            summed costs of unseen points that is free: only a larger sum costs, and only its
            excess. The first pair is for the weights of all regions, if there are any; each
            further pair is for one region that must be seen. At last one pair for each
            requirement: for number k, point i has the index N (k + 1) + i, as in
            ``Simulator.look_around``.
        """
        # Each point of a region is an equal share of the region; other points are no part of it.
        numbers = [k for k, region in enumerate(self.rig.regions) if not region.air]
        shares = [unpack(self._contents[k], len(self.simulator.scene))
                  / count_bits(self._contents[k]) for k in numbers]
        if self._weights[numbers].any():
            yield self._weights[numbers] @ shares, 0.0
        for share_by_point, required in zip(shares, self._required_shares[numbers]):
            if required > 0.0:
                yield MUST_SEE_COST * share_by_point, MUST_SEE_COST * (1.0 - required)
        count = len(self.simulator.scene)
        for k, (requirement, bits) in enumerate(zip(self.rig.requirements, self._required)):
            costs = np.zeros(self.simulator.row_count)
            costs[count * (k + 1):][:count] = (
                MUST_SEE_COST * unpack(bits, count) / count_bits(bits))
            yield costs, MUST_SEE_COST * (1.0 - requirement.searched_share)

    def look(self, poses: np.ndarray) -> list[View]:
        """
        Compute the views of the cameras to be placed.

        :param poses: (K, 6) metres, map frame, and radians, or (K, 3); fewer rows are allowed.
        """
        return self.simulator.look_from_all(poses, range(len(poses)))

    def evaluate_views(self, views: Sequence[View]) -> RigEvaluation:
        """
        Evaluate cameras, given their views.

        :param views: the views of some of the cameras to be placed, from :meth:`look` or
            :meth:`~ocp_ros.simulation.simulator.Simulator.look`.
        """
        all_views = self._with_fixed(views)
        pair_cost = self._pair_cost(views)
        seen = self._seen(all_views)
        # The cells that at least ``rig.seen_by`` cameras see.
        covered = self._covered(all_views)
        loss, error, shares, met = self._loss_of(seen, all_views)
        # A cost of pairs within the tolerance is a rounding error.
        return RigEvaluation(
            loss + pair_cost, error, self.simulator.coverage(covered), shares,
            Subset(seen, self._order), pair_cost <= SHARE_TOLERANCE, met)

    def loss(self, views: Sequence[View]) -> float:
        """Return the loss of :meth:`evaluate_views`, without the rest of the evaluation."""
        all_views = self._with_fixed(views)
        return self._loss_of(self._seen(all_views), all_views)[0] + self._pair_cost(views)

    def depth_error(self, views: Sequence[View]) -> float:
        """Return the depth error of :meth:`evaluate_views`, metres, without the rest."""
        return self.simulator.depth_error(self._seen(self._with_fixed(views)))

    def losses_with(self, views: Sequence[View], more: Sequence[View], eased: bool = False,
                    place: int | None = None) -> np.ndarray:
        """
        Return the losses after adding one of M further cameras at a time.

        :param views: as for :meth:`evaluate_views`.
        :param more: the views of the further cameras.
        :param eased: whether to return the means of the losses if 1, 2, ... n cameras have to see
            a point or cell of air, where n is the largest number that the rig or a region of air
            requires. Placements with fewer than n cameras may all have the same loss; this mean
            distinguishes them.
        :param place: the index of the further camera in the rig; None for the one after the views.
        :returns: (M,) losses.
        """
        given = self._with_fixed(views)
        # The first one is all points, since no camera has to see them before the further one.
        levels = [~np.zeros_like(given[0].seen), *self._seen_by_count(given)]
        most = max(self.rig.seen_by, *(region.air.seen_by for region in self.rig.regions
                                       if region.air), 1)
        counts = range(1, most + 1) if eased else [MAX_CAMERAS]
        losses = np.zeros(len(more))
        for count in counts:
            # A region of air may require more cameras than the rig requires for points.
            level = min(count, self.rig.seen_by)
            error_of = self.simulator.depth_error.given(levels[level])
            gains_of = (None if self.possible_gains is None else
                        self._gains_by(self.room_goal.by).given(levels[level]))
            for k, view in enumerate(more):
                # With the further camera, these points count as seen too.
                new = levels[level - 1] & view.seen
                losses[k] += self._loss_of(levels[level] | new, [*given, view], count,
                                           error_of(new), gains_of)[0]
        place = len(views) if place is None else place
        return losses / len(counts) + [self._pair_cost([*views[:place], view, *views[place:]])
                                       for view in more]

    def _loss_of(self, seen: np.ndarray, views: Sequence[View], max_seen_by: int = MAX_CAMERAS,
                 error: float | None = None, gains_of: RoomGains | None = None
                 ) -> tuple[float, float, np.ndarray, np.ndarray]:
        """
        Return the loss without the cost of links, the depth error, and two arrays of shares.

        They are the shares of the regions that are seen, and those that meet the requirements.

        :param seen: packed bits of the points that count as seen.
        :param views: the views of all cameras, for regions of air and requirements.
        :param max_seen_by: a region of air requires at most this number of cameras for a cell;
            :meth:`losses_with` lowers the requirements in this way.
        :param error: the depth error of these points, metres; None to compute it.
        :param gains_of: computes the gains in rooms, for a goal; None for that of all points.
        """
        error = self.simulator.depth_error(seen) if error is None else error
        shares = np.array([
            count_bits(seen & content) / count_bits(content) if region.air is None else
            watched_share(self._cells, content, [view.covered for view in views], views,
                          *region.air.eased(max_seen_by))
            for region, content in zip(self.rig.regions, self._contents)])
        loss = (error / self.simulator.depth_error.worst + self._weights @ (1.0 - shares)
                + MUST_SEE_COST * np.maximum(self._required_shares - shares, 0.0).sum())
        met = np.empty(len(self.rig.requirements))
        for k, requirement in enumerate(self.rig.requirements):
            steps = self._met_shares(k, views)
            met[k] = steps[-1]
            # With fewer cameras more points meet it, so this is 0 only if it is met.
            loss += MUST_SEE_COST * np.maximum(requirement.searched_share - steps, 0.0).mean()
        if (possible := self.possible_gains) is not None:
            gains = (gains_of or self._gains_by(self.room_goal.by))(
                seen, self._covered(views, max_seen_by))
            loss += MUST_SEE_COST * np.maximum(
                self.room_goal.targets - shares_of(gains, possible), 0.0).sum()
        return float(loss), error, shares, met

    def _covered(self, views: Sequence[View], max_seen_by: int = MAX_CAMERAS) -> np.ndarray:
        """Return the cells that enough of all views cover, at most a number: packed bits."""
        return seen_by([view.covered for view in views], min(self.rig.seen_by, max_seen_by))[-1]

    def _gains_by(self, by: str) -> RoomGains:
        """Return what computes the gains in the rooms of a floor, by a quantity."""
        if by not in self._room_gains:
            self._room_gains[by] = RoomGains(self.simulator, by)
        return self._room_gains[by]

    def room_gains(self, views: Sequence[View], by: str, room: int | None = None) -> np.ndarray:
        """
        Return what cameras gain in each room of a floor; see :class:`RoomGains`.

        :param views: as for :meth:`evaluate_views`.
        :param by: see :class:`~ocp_ros.simulation.room_gains.RoomGoal`.
        :param room: the number of the only room that matters; None for all.
        :returns: (R,), or () for one room.
        """
        all_views = self._with_fixed(views)
        bits = self._seen(all_views), self._covered(all_views)
        gains = self._gains_by(by)
        return gains(*bits) if room is None else np.array(gains.of_room(room, *bits))

    def _met_shares(self, number: int, views: Sequence[View]) -> np.ndarray:
        """
        Return the shares of the points that meet a requirement with 1, 2, ... n cameras.

        n is the number that it asks for. If any one camera may fail, one more share follows, the
        least with n cameras without one of all. So the last share is that of the requirement.

        :param number: of the requirement in the rig.
        :param views: the views of all cameras.
        """
        requirement, points = self.rig.requirements[number], self._required[number]
        sight, count, one_fails = (requirement.sight, requirement.sight.seen_by,
                                   requirement.one_may_fail)
        good = [view.good[number] & points for view in views]
        levels, total = seen_by(good, count + 1), count_bits(points)
        shares = [count_bits(level) / total for level in levels[:count]]
        if count > 1 and (sight.angle > 0.0 or sight.around):
            # At most 8192 points, spread evenly, are compared, so that the time is bounded.
            numbers = np.flatnonzero(unpack(points, len(self._points)))
            numbers = numbers[::-(-len(numbers) // 8192)]
            # All cameras, then all but one.
            rows = [np.arange(len(views)), *(np.delete(np.arange(len(views)), k)
                                             for k in range(len(views) if one_fails else 0))]

            def share_of(row: np.ndarray, cameras: int) -> float:
                return watched_share(
                    self._points, numbers, [good[k] for k in row], [views[k] for k in row],
                    *sight.eased(cameras)) if len(row) else 0.0

            shares = [shares[0], *(share_of(rows[0], n) for n in range(2, count + 1))]
            if one_fails:
                shares.append(min(share_of(row, count) for row in rows[1:]))
        elif one_fails:
            # The points that need each of their cameras, and the most of them of one camera.
            exact = levels[count - 1] & ~levels[count]
            shares.append(shares[-1] - max(count_bits(bits & exact) for bits in good) / total)
        return np.array(shares)

    def covisibility(self, views: Sequence[View]) -> Covisibility | None:
        """
        Compute the shares of points that pairs of cameras see, if the rig requires links.

        :param views: as for :meth:`evaluate_views`.
        :returns: the covisibility of these cameras and those in place; None if the rig does not
            require links between cameras, or if a view has several positions.
        """
        views, condition = self._with_fixed(views), self._link_condition
        if condition is None or any(view.position is None for view in views):
            return None
        return covisibility(self._points, views, condition, len(self.fixed))

    def connects(self, views: Sequence[View]) -> bool:
        """
        Return whether no two cameras disturb each other, and proved views link all of them.

        Each applies as far as the rig requires it.

        :param views: as for :meth:`evaluate_views`.
        """
        return self._pair_cost(views) <= SHARE_TOLERANCE and (
            self._link_condition is None
            or self.validation._pair_cost(views) <= SHARE_TOLERANCE)

    def lit_shares(self, views: Sequence[View]) -> np.ndarray:
        """
        Return what pairs of C cameras that may disturb each other light in common.

        :param views: as for :meth:`evaluate_views`, of the first cameras of the rig.
        :returns: (C, C) shares; see :func:`~ocp_ros.simulation.interference.lit_shares`.
        """
        cameras = (*self.rig.cameras[:len(views)], *(one.camera for one in self.rig.fixed))
        return lit_shares(self._points, self._with_fixed(views), cameras)

    def _pair_cost(self, views: Sequence[View]) -> float:
        """Return the cost of missing links and of interference between cameras."""
        covisible = self.covisibility(views)
        cost = 0.0 if covisible is None else MUST_SEE_COST * covisible.missing
        # A search begins with fewer cameras, which may be any of the rig; and some views have
        # several positions.
        cameras = self.rig.cameras
        known = len(views) == len(cameras) or len(set(map(light_of, cameras))) == 1
        if views and known and self.rig.no_interference and all(
                view.position is not None for view in views):
            cost += MUST_SEE_COST * float(np.maximum(
                np.triu(self.lit_shares(views)) - MAX_LIT_SHARE, 0.0).sum())
        return cost

    def evaluate(self, poses: np.ndarray) -> RigEvaluation:
        """Evaluate poses (K, 6), metres, map frame, and radians."""
        return self.evaluate_views(self.look(poses))

    def overlap(self, views: Sequence[View]) -> list[int]:
        """
        Count the points by the number of cameras that see them.

        :param views: as for :meth:`evaluate_views`.
        :returns: the numbers of points seen by 0, 1, 2 and by 3 or more cameras.
        """
        seen = [view.seen for view in self._with_fixed(views)]
        # Entry n: the number of points seen by n or more cameras. With the 0 at the end, the last
        # difference keeps all points seen by 3 or more.
        counts = np.array([len(self.simulator.scene), *map(count_bits, seen_by(seen, 3)), 0])
        return [int(count) for count in counts[:-1] - counts[1:]]

    def contributions(self, views: Sequence[View]) -> list[Contribution]:
        """
        Compute the contribution of each camera in addition to the others.

        :param views: as for :meth:`evaluate_views`.
        :returns: the contribution of each view, then of each camera in place.
        """
        error_of = self.simulator.depth_error
        contributions = []
        all_views = self._with_fixed(views)
        # The points that at least one camera sees, and those that at least two see.
        once, twice = seen_by([view.seen for view in all_views], 2)
        total_error = error_of(self._seen(all_views))
        # The slice leaves out the empty view, which stands for no cameras at all.
        for k, view in enumerate(all_views[:len(views) + len(self.fixed)]):
            others = [*all_views[:k], *all_views[k + 1:]] or [self.empty_view]
            only = count_bits(view.seen & once & ~twice) / len(self.simulator.scene)
            reduction = error_of(self._seen(others)) - total_error
            contributions.append(Contribution(reduction, float(only)))
        return contributions

    def with_one_more(self, views: Sequence[View], more: Sequence[View]) -> np.ndarray:
        """
        Return the depth errors after adding one of M further cameras at a time.

        :param views: as for :meth:`evaluate_views`.
        :param more: the views of the further cameras.
        :returns: (M,) metres.
        """
        seen = self._seen_by_count(self._with_fixed(views))
        # The points that count as seen if one further camera sees them: all if one suffices.
        almost_seen = seen[-2] if len(seen) > 1 else ~np.zeros_like(seen[0])
        return np.array([self.simulator.depth_error(seen[-1] | (almost_seen & view.seen))
                         for view in more])

    def _with_fixed(self, views: Sequence[View]) -> list[View]:
        """
        Return all views, then those of the cameras in place; one empty view if none.

        They contain only what the simulator's evidence proves, if it has any.
        """
        all_views = [*views, *self.fixed] or [self.empty_view]
        evidence = self.simulator.evidence
        return all_views if evidence is None else [
            view._replace(seen=evidence.proved(view.seen, view.position)) for view in all_views]

    def _seen_by_count(self, views: Sequence[View]) -> list[np.ndarray]:
        """Return the points that at least 1, 2, ... ``seen_by`` views contain, as packed bits."""
        return seen_by([view.seen for view in views], self.rig.seen_by)

    def _seen(self, views: Sequence[View]) -> np.ndarray:
        """Return the points that ``seen_by`` or more views contain, as packed bits."""
        return self._seen_by_count(views)[-1]
