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
from functools import cached_property
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.coverage import space_coverage
from ocp_ros.geometry.packed_bits import count_bits, no_bits, pack, seen_by, Subset, unpack
from ocp_ros.rig.feasible_region import floor_space
from ocp_ros.rig.rig_file import Region, Rig
from ocp_ros.rig.structure import Air, floor_height
from ocp_ros.simulation.covisibility import Covisibility, covisibility, SHARE_TOLERANCE, watched
from ocp_ros.simulation.simulator import Simulator, View
from ocp_ros.util.settings import ConfigurationError, MAX_CAMERAS

#: The cost of missing all of a region that must be seen; missing the whole room costs 1.
MUST_SEE_COST = 10.0


class RigEvaluation(NamedTuple):
    """
    The evaluation of a placement; a point counts as seen if ``seen_by`` cameras see it.

    :ivar loss: the value to minimise: depth error / depth error of seeing nothing + sum of weight
        x unseen share + 10 x shortfall of each share that must be seen + 10 x shortfall of the
        overlaps that link all cameras, if the rig requires it.
    :ivar depth_error: metres.
    :ivar space_coverage: cubic metres.
    :ivar regions: (R,) the share of each region's points, or of its cells of air, that are seen.
    :ivar seen: the points that enough cameras see.
    :ivar connected: whether all cameras are linked, or the rig does not require it.
    """

    loss: float
    depth_error: float
    space_coverage: float
    regions: np.ndarray
    seen: Subset
    connected: bool


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
    :raises ConfigurationError: if a region contains no points of the room.
    """

    def __init__(self, simulator: Simulator, rig: Rig) -> None:
        self.simulator, self.rig = simulator, rig
        count = len(rig.cameras)
        self.fixed = [simulator.look(pose, count + k) for k, pose in enumerate(rig.fixed_poses)]
        self._nothing = View(no_bits(len(simulator.scene)), no_bits(len(simulator.grid)))
        self._order = simulator.visibility.order
        self._regions = [self._points_of(region) if region.air is None else self._air_of(region)
                         for region in rig.regions]
        self._weights = np.array([region.weight for region in rig.regions])
        self._must = np.array([region.must_see for region in rig.regions])

    def _points_of(self, region: Region) -> np.ndarray:
        """Return the points in a region: (W,) packed bits."""
        scene = self.simulator.scene
        inside = region.zone.contains(scene.points, floor_height(scene))
        self._check_inside(region, inside)
        return pack(inside[self._order])

    def _air_of(self, region: Region) -> np.ndarray:
        """Return the cells of the coverage grid that are air in a region: (S,) in its order."""
        scene, cells = self.simulator.scene, self._cells
        numbers = np.flatnonzero(region.zone.contains(cells, floor_height(scene)))
        # Cells inside furniture are not air.
        numbers = numbers[~self._air.closed(cells[numbers])]
        self._check_inside(region, numbers >= 0)
        return numbers

    @cached_property
    def _air(self) -> Air:
        """Return the air of the room."""
        scene = self.simulator.scene
        return Air(scene, floor_space(scene, self.rig, floor_height(scene), scene.bounds[1, 2]))

    def _check_inside(self, region: Region, inside: np.ndarray) -> None:
        """Refuse a region that contains none of the points or cells that must be seen."""
        if not inside.any():
            scene = self.simulator.scene
            low, high = (', '.join(f'{value:.2f}' for value in corner) for corner in scene.bounds)
            cells = '' if region.air is None else (
                f' in cells of {self.simulator.cell_volume ** (1.0 / 3.0):.2f} m')
            raise ConfigurationError(
                f'{region.where}: found no {region.parts} of {scene.name} in it{cells}; expected '
                f'some, within ({low}) to ({high}); correct its corners, or choose a region that '
                'is in the scan')

    @cached_property
    def _cells(self) -> np.ndarray:
        """Return the cells of the coverage grid in the engine's order: (M, 3) metres."""
        return self.simulator.grid[self.simulator.visibility.place_order].astype(np.float64)

    @cached_property
    def _points(self) -> np.ndarray:
        """Return the points of the room in the engine's order: (N, 3) metres."""
        return self.simulator.scene.points[self._order]

    def point_costs(self) -> Iterator[tuple[np.ndarray, float]]:
        """
        Yield the cost of unseen points, without the depth error.

        :returns: (N,) loss of each point in the engine's order, and the part of their sum that
            costs nothing: first for the weights of all regions, then for each region that must be
            seen.
        """
        shares = [unpack(bits, len(self.simulator.scene)) / count_bits(bits)
                  for bits in self._regions]
        if self._weights.any():
            yield self._weights @ shares, 0.0
        for share, must in zip(shares, self._must):
            if must > 0.0:
                yield MUST_SEE_COST * share, MUST_SEE_COST * (1.0 - must)

    def look(self, poses: np.ndarray) -> list[View]:
        """
        Compute the views of the cameras to be placed.

        :param poses: (K, 6) metres, map frame, and radians, or (K, 3); fewer rows are allowed.
        """
        return [self.simulator.look(pose, camera) for camera, pose in enumerate(poses)]

    def judge(self, views: Sequence[View]) -> RigEvaluation:
        """
        Evaluate cameras, given their views.

        :param views: the views of some of the cameras to be placed, from :meth:`look` or
            :meth:`~ocp_ros.simulation.simulator.Simulator.look`.
        """
        everyone, missing = self._with_fixed(views), self._missing(views)
        seen = self._seen(everyone)
        covered = seen_by([view.covered for view in everyone], self.rig.seen_by)[-1]
        loss, error, shares = self._loss_of(seen, everyone)
        return RigEvaluation(
            loss + missing, error, space_coverage(covered, self.simulator.cell_volume), shares,
            Subset(seen, self._order), missing <= SHARE_TOLERANCE)

    def loss(self, views: Sequence[View]) -> float:
        """Return only the loss of views, which are as for :meth:`judge`."""
        everyone = self._with_fixed(views)
        return self._loss_of(self._seen(everyone), everyone)[0] + self._missing(views)

    def promise(self, views: Sequence[View]) -> float:
        """
        Return the mean of the losses if 1, 2, ... cameras have to see a point or cell of air.

        The last number is the largest that the rig or a region of air requires. This value also
        distinguishes placements with too few cameras, which all have the same loss.

        :param views: as for :meth:`judge`.
        """
        everyone = self._with_fixed(views)
        seen = self._levels(everyone)
        most = max([len(seen), *(region.air.seen_by for region in self.rig.regions if region.air)])
        levels = [self._loss_of(seen[min(count, len(seen)) - 1], everyone, count)[0]
                  for count in range(1, most + 1)]
        return float(np.mean(levels)) + self._missing(views)

    def _loss_of(self, seen: np.ndarray, views: Sequence[View], most: int = MAX_CAMERAS
                 ) -> tuple[float, float, np.ndarray]:
        """
        Return loss, depth error and shares of the regions.

        :param seen: packed bits of the points that count as seen.
        :param views: the views of all cameras, for regions of air.
        :param most: upper limit of the number of cameras that have to see a cell of air.
        """
        error = self.simulator.depth_error(seen)
        shares = np.array([
            count_bits(seen & part) / count_bits(part) if region.air is None else
            watched(self._cells, part, views, min(region.air.seen_by, most), region.air.angle)
            for region, part in zip(self.rig.regions, self._regions)])
        loss = (error / self.simulator.depth_error.worst + self._weights @ (1.0 - shares)
                + MUST_SEE_COST * np.maximum(self._must - shares, 0.0).sum())
        return float(loss), error, shares

    def covisibility(self, views: Sequence[View]) -> Covisibility | None:
        """
        Compute the covisibility of cameras if the rig requires that they can be calibrated.

        :param views: as for :meth:`judge`.
        :returns: the covisibility of these cameras and those in place; None if the rig does not
            require it, or if a view has several positions.
        """
        views, asked = self._with_fixed(views), self.rig.calibratable
        if asked is None or any(view.position is None for view in views):
            return None
        return covisibility(self._points, views, asked, len(self.fixed))

    def _missing(self, views: Sequence[View]) -> float:
        """Return the cost of cameras that are not linked."""
        found = self.covisibility(views)
        return 0.0 if found is None else MUST_SEE_COST * found.missing

    def evaluate(self, poses: np.ndarray) -> RigEvaluation:
        """Evaluate poses (K, 6), metres, map frame, and radians."""
        return self.judge(self.look(poses))

    def overlap(self, views: Sequence[View]) -> list[int]:
        """
        Count how many cameras see each point.

        :param views: as for :meth:`judge`.
        :returns: the numbers of points seen by 0, 1, 2 and by 3 or more cameras.
        """
        seen = [view.seen for view in self._with_fixed(views)]
        # Overlap of more than three cameras is not counted.
        levels = [count_bits(bits) for bits in seen_by(seen, 3)]
        at_least = np.array([len(self.simulator.scene), *levels, 0])
        return [int(count) for count in at_least[:-1] - at_least[1:]]

    def contributions(self, views: Sequence[View]) -> list[Contribution]:
        """
        Compute what each camera contributes in addition to the others.

        :param views: as for :meth:`judge`.
        :returns: the contribution of each view, then of each camera in place.
        """
        error, everyone = self.simulator.depth_error, self._with_fixed(views)
        once, twice = seen_by([view.seen for view in everyone], 2)
        with_all = error(self._seen(everyone))
        views, found = [*views, *self.fixed], []
        for k, view in enumerate(views):
            others = [*views[:k], *views[k + 1:]] or [self._nothing]
            only = count_bits(view.seen & once & ~twice) / len(self.simulator.scene)
            found.append(Contribution(error(self._seen(others)) - with_all, float(only)))
        return found

    def with_one_more(self, views: Sequence[View], more: Sequence[View]) -> np.ndarray:
        """
        Return the depth error after adding each of some further cameras.

        :param views: as for :meth:`judge`.
        :param more: the views of M cameras, of which one at a time is added.
        :returns: (M,) metres.
        """
        levels = self._levels(self._with_fixed(views))
        before = levels[-2] if len(levels) > 1 else ~np.zeros_like(levels[0])
        return np.array([self.simulator.depth_error(levels[-1] | before & view.seen)
                         for view in more])

    def _with_fixed(self, views: Sequence[View]) -> list[View]:
        """Return the views with those of the cameras in place; an empty view if there are none."""
        return [*views, *self.fixed] or [self._nothing]

    def _levels(self, views: Sequence[View]) -> list[np.ndarray]:
        """Return the points that at least 1, 2, ... ``seen_by`` views contain, as packed bits."""
        return seen_by([view.seen for view in views], self.rig.seen_by)

    def _seen(self, views: Sequence[View]) -> np.ndarray:
        """Return the points that ``seen_by`` or more views contain, as packed bits."""
        return self._levels(views)[-1]
