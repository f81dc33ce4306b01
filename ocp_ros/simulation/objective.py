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

"""What a placement of a rig is worth: the depth error, and what the rig's regions ask for."""

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.coverage import space_coverage
from ocp_ros.geometry.packed_bits import count_bits, no_bits, pack, seen_by, Subset, unpack
from ocp_ros.rig.feasible_region import floor_space
from ocp_ros.rig.rig_file import Region, Rig
from ocp_ros.rig.structure import Air, floor_height
from ocp_ros.simulation.covisibility import Covisibility, covisibility, ROUNDING, watched
from ocp_ros.simulation.simulator import Simulator, View
from ocp_ros.util.settings import ConfigurationError, MOST_CAMERAS

#: What it costs to miss all of what a region says must be seen; the room itself costs 1.
MUST = 10.0
#: Overlap is counted up to as many cameras.
COUNTED = 3


class RigEvaluation(NamedTuple):
    """
    What a placement is worth; a place counts as seen where ``seen_by`` cameras see it.

    :ivar loss: what a search minimises: depth error / depth error of seeing nothing
        + sum of weight x unseen share + 10 x what is missing of each share that must be seen
        + 10 x what is missing of the overlaps that link all cameras, where the rig asks for it.
    :ivar depth_error: metres.
    :ivar space_coverage: cubic metres.
    :ivar regions: (R,) share of each region's points that are seen.
    :ivar seen: the points that are seen.
    :ivar connected: whether all cameras are linked, or need not be.
    """

    loss: float
    depth_error: float
    space_coverage: float
    regions: np.ndarray
    seen: Subset
    connected: bool


class Contribution(NamedTuple):
    """
    What one camera adds to the others.

    :ivar depth_error: metres, the error without it minus the error with it.
    :ivar only: share of all points that no other camera sees.
    """

    depth_error: float
    only: float


class Objective:
    """
    Judge placements of a rig in one room; the cameras in place count, and are looked from once.

    :param simulator: the engine; its models are those of the K cameras to be placed, then of the
        F in place.
    :param rig: the same rig.
    :raises ConfigurationError: if a region holds no points of the room.
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
        # What is in furniture is no air.
        numbers = numbers[~self._air.closed(cells[numbers])]
        self._check_inside(region, numbers >= 0)
        return numbers

    @cached_property
    def _air(self) -> Air:
        """Return the air of the room."""
        scene = self.simulator.scene
        return Air(scene, floor_space(scene, self.rig, floor_height(scene), scene.bounds[1, 2]))

    def _check_inside(self, region: Region, inside: np.ndarray) -> None:
        """Refuse a region without anything in it that is asked for."""
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
        Yield what points cost that are not seen, beside the depth error.

        :returns: (N,) loss of each point in the engine's order, and how much of their sum is
            free: first for the weights of all regions, then for each that must be seen.
        """
        shares = [unpack(bits, len(self.simulator.scene)) / count_bits(bits)
                  for bits in self._regions]
        if self._weights.any():
            yield self._weights @ shares, 0.0
        for share, must in zip(shares, self._must):
            if must > 0.0:
                yield MUST * share, MUST * (1.0 - must)

    def look(self, poses: np.ndarray) -> list[View]:
        """
        Compute what the cameras to be placed see.

        :param poses: (K, 6) metres, map frame, and radians, or (K, 3); or fewer rows.
        """
        return [self.simulator.look(pose, camera) for camera, pose in enumerate(poses)]

    def judge(self, views: Sequence[View]) -> RigEvaluation:
        """
        Judge cameras by what they see.

        :param views: of some of the cameras to be placed, from :meth:`look` or
            :meth:`~ocp_ros.simulation.simulator.Simulator.look`.
        """
        everyone, missing = self._with_fixed(views), self._missing(views)
        seen = self._seen(everyone)
        covered = seen_by([view.covered for view in everyone], self.rig.seen_by)[-1]
        loss, error, shares = self._loss_of(seen, everyone)
        return RigEvaluation(
            loss + missing, error, space_coverage(covered, self.simulator.cell_volume), shares,
            Subset(seen, self._order), missing <= ROUNDING)

    def loss(self, views: Sequence[View]) -> float:
        """Return the loss alone, of views as for :meth:`judge`."""
        everyone = self._with_fixed(views)
        return self._loss_of(self._seen(everyone), everyone)[0] + self._missing(views)

    def promise(self, views: Sequence[View]) -> float:
        """
        Return the mean of what the loss were if 1, 2, ... cameras had to see a place.

        They are as many at most as the rig asks for, or a region of air.

        It tells too few cameras apart, which are worth nothing yet.

        :param views: as for :meth:`judge`.
        """
        everyone = self._with_fixed(views)
        seen = self._levels(everyone)
        most = max([len(seen), *(region.air.seen_by for region in self.rig.regions if region.air)])
        levels = [self._loss_of(seen[min(count, len(seen)) - 1], everyone, count)[0]
                  for count in range(1, most + 1)]
        return float(np.mean(levels)) + self._missing(views)

    def _loss_of(self, seen: np.ndarray, views: Sequence[View], most: int = MOST_CAMERAS
                 ) -> tuple[float, float, np.ndarray]:
        """
        Return loss, depth error and shares of the regions.

        :param seen: packed bits of the points that count as seen.
        :param views: of all cameras, for regions of air.
        :param most: cameras that are asked to see these.
        """
        error = self.simulator.depth_error(seen)
        shares = np.array([
            count_bits(seen & part) / count_bits(part) if region.air is None else
            watched(self._cells, part, views, min(region.air.seen_by, most), region.air.angle)
            for region, part in zip(self.rig.regions, self._regions)])
        loss = (error / self.simulator.depth_error.worst + self._weights @ (1.0 - shares)
                + MUST * np.maximum(self._must - shares, 0.0).sum())
        return float(loss), error, shares

    def covisibility(self, views: Sequence[View]) -> Covisibility | None:
        """
        Compare what cameras see, where the rig asks for cameras that can be calibrated.

        :param views: as for :meth:`judge`.
        :returns: of these cameras and those in place; None where the rig does not ask for it, or
            where views are of several positions at once.
        """
        views, asked = self._with_fixed(views), self.rig.calibratable
        if asked is None or any(view.position is None for view in views):
            return None
        return covisibility(self._points, views, asked, len(self.fixed))

    def _missing(self, views: Sequence[View]) -> float:
        """Return what it costs that cameras are not linked."""
        found = self.covisibility(views)
        return 0.0 if found is None else MUST * found.missing

    def evaluate(self, poses: np.ndarray) -> RigEvaluation:
        """Judge poses (K, 6), metres, map frame, and radians."""
        return self.judge(self.look(poses))

    def overlap(self, views: Sequence[View]) -> list[int]:
        """
        Count how many cameras see each point.

        :param views: as for :meth:`judge`.
        :returns: points seen by 0, 1, 2 and by 3 or more.
        """
        seen = [view.seen for view in self._with_fixed(views)]
        levels = [count_bits(bits) for bits in seen_by(seen, COUNTED)]
        at_least = np.array([len(self.simulator.scene), *levels, 0])
        return [int(count) for count in at_least[:-1] - at_least[1:]]

    def contributions(self, views: Sequence[View]) -> list[Contribution]:
        """
        Compare what all cameras are worth with what they are without each.

        :param views: as for :meth:`judge`.
        :returns: for each view, and then for each camera in place.
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
        Return the depth error with each of some further cameras.

        :param views: as for :meth:`judge`.
        :param more: of M cameras, of which one is added.
        :returns: (M,) metres.
        """
        levels = self._levels(self._with_fixed(views))
        before = levels[-2] if len(levels) > 1 else ~np.zeros_like(levels[0])
        return np.array([self.simulator.depth_error(levels[-1] | before & view.seen)
                         for view in more])

    def _with_fixed(self, views: Sequence[View]) -> list[View]:
        """Return views and those of the cameras in place, one at least."""
        return [*views, *self.fixed] or [self._nothing]

    def _levels(self, views: Sequence[View]) -> list[np.ndarray]:
        """Return the points that at least 1, 2, ... ``seen_by`` views hold, as packed bits."""
        return seen_by([view.seen for view in views], self.rig.seen_by)

    def _seen(self, views: Sequence[View]) -> np.ndarray:
        """Return the points that enough views hold, as packed bits."""
        return self._levels(views)[-1]
