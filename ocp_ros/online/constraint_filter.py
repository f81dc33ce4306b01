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
Move targets to feasible positions: check the constraints of a rig file on the observed cloud.

Each camera goes to the feasible position that is nearest to its target and within reach in one
time step. A camera without such a position stays where it is.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import Pose
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.geometry.shadow_maps import in_reach
from ocp_ros.online.rig_state import clearance_of, Limits, RigState
from ocp_ros.rig.feasible_region import FeasibleRegion, satisfies_spacing
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.motion import kept_inside, nearest_place, ROUNDING, towards
from ocp_ros.rig.rig_file import Rig
from ocp_ros.rig.structure import floor_height, STAND_OFF
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.util.settings import ConfigurationError

#: Assumed free height above a camera, metres: cameras that look down do not observe it.
FREE_ABOVE_M = 0.1
#: Metres: a camera whose move is not longer than this counts as staying.
STAYING_M = 0.01
#: Number of horizontal directions in which the free distance around a camera is measured.
SECTORS = 120
#: Number of directions on either side of a path that must be free too.
SECTORS_ASIDE = 1


class FilteredTargets(NamedTuple):
    """
    Feasible targets of the cameras.

    :ivar targets: (K, 3) metres.
    :ivar held: messages, one for each camera that stays because it has no feasible position.
    """

    targets: np.ndarray
    held: list[str]


class StepConstraints:
    """
    Correct the moves of a time step so that they satisfy the constraints on the observed cloud.

    :param limits: of one step.
    :param rig: the rig with its constraints; None for cameras that move freely on a plane.
    :ivar filter: applies the constraints of the rig file; None without one.
    """

    def __init__(self, limits: Limits, rig: Rig | None) -> None:
        self._limits = limits
        self.filter = None if rig is None else ConstraintFilter(rig, limits.wall_margin)

    def change(self, limits: Limits) -> None:
        """Replace the limits."""
        self._limits = limits
        if self.filter is not None:
            self.filter.wall_margin = limits.wall_margin

    def reset(self) -> None:
        """Discard the state of the last episode."""
        if self.filter is not None:
            self.filter.reset()

    def prepare(self, cloud: np.ndarray, positions: np.ndarray) -> None:
        """Compute the feasible region in advance, see :meth:`ConstraintFilter.prepare`."""
        if self.filter is not None:
            self.filter.prepare(cloud, positions)

    def __call__(self, cloud: np.ndarray, state: RigState, moves: np.ndarray) -> FilteredTargets:
        """
        Return the feasible targets of the cameras.

        :param cloud: (N, 3) float32, metres: the observed cloud.
        :param state: current state of the cameras.
        :param moves: (K, 2) metres.
        """
        positions, limits = state.placement[:state.movable, :3], self._limits
        targets = positions.copy()
        if len(cloud) == 0:
            targets[:, :2] = towards(positions[:, :2], positions[:, :2] + moves, limits.max_step)
            return FilteredTargets(targets, [])
        # Cameras stay over the observed floor: behind a wall they would see through its back side.
        plane = FreePlane.around(cloud, positions, limits.wall_margin,
                                 clearance_of(state, limits.clearance))
        targets[:, :2] = plane.moved(positions[:, :2], moves, limits.max_step)
        targets, _ = kept_inside(targets, corners_of(cloud).astype(np.float64),
                                 limits.wall_margin)
        if self.filter is None:
            # A camera with a frustum may be far outside the observed bounding box.
            targets[:, :2] = towards(positions[:, :2], targets[:, :2], limits.max_step)
            return FilteredTargets(targets, [])
        return self.filter(cloud, positions, targets, limits.max_step,
                           state.placement[state.movable:, :3], state)


class FreeWays(NamedTuple):
    """
    Free distance around a camera in each horizontal direction.

    :ivar position: (3,) metres, of the camera.
    :ivar reach: (SECTORS,) metres to the nearest observed point in the camera's view, in each
        direction and the directions beside it; 0 if one of these has no such point.
    """

    position: np.ndarray
    reach: np.ndarray

    @classmethod
    def of(cls, cloud: np.ndarray, state: RigState, camera: int) -> 'FreeWays':
        """
        Compute the free distances around a camera.

        :param cloud: (N, 3) float32, metres: the observed cloud.
        :param state: current state of the cameras.
        """
        pose = Pose.of(state.placement[camera])
        ways = (cloud[in_reach(cloud, pose, state.models[camera].lens)] - pose.position)[:, :2]
        free = np.full(SECTORS, np.inf)
        np.minimum.at(free, _sectors(ways), np.linalg.norm(ways, axis=1))
        # A direction without observed points is unknown, so it does not count as free.
        free[np.isinf(free)] = 0.0
        return cls(pose.position, np.min(
            [np.roll(free, k) for k in range(-SECTORS_ASIDE, SECTORS_ASIDE + 1)], axis=0))

    def clear(self, places: np.ndarray, least: float) -> np.ndarray:
        """Return which places (P, 3) are at least ``least`` metres before the first surface."""
        ways = (places - self.position)[:, :2]
        return np.linalg.norm(ways, axis=1) + least <= self.reach[_sectors(ways)]


def _sectors(ways: np.ndarray) -> np.ndarray:
    """Return the sector number of each horizontal vector (M, 2)."""
    turns = np.arctan2(ways[:, 1], ways[:, 0]) / (2.0 * np.pi)
    return np.floor(SECTORS * turns).astype(int) % SECTORS


class ConstraintFilter:
    """
    Move targets to feasible positions.

    :param rig: the constraints; its fixed cameras matter for the spacing alone.
    :param wall_margin: cameras stay this far inside the observed bounding box, metres.
    """

    def __init__(self, rig: Rig, wall_margin: float) -> None:
        self.rig, self.wall_margin = rig, wall_margin
        # Fixed cameras may be outside the observed bounding box.
        self._movable = replace(rig, fixed=())
        self._known: tuple[np.ndarray, np.ndarray] | None = None
        self._allowed: FeasibleRegion | None = None
        self._why = ''
        self.reset()

    def reset(self) -> None:
        """Discard the region that was prepared in the last episode."""
        self._prepared = False

    def prepare(self, cloud: np.ndarray, positions: np.ndarray) -> None:
        """
        Compute the feasible region in advance: the next call then checks new points alone.

        If this fails, the next call computes the region.

        :param cloud: (N, 3) float32, metres: the observed cloud.
        :param positions: (K, 3) metres, of the movable cameras at the next time step.
        """
        self._look(cloud, positions)
        self._prepared = self._allowed is not None

    def __call__(self, cloud: np.ndarray, positions: np.ndarray, targets: np.ndarray,
                 max_step: float, fixed: np.ndarray | None = None,
                 state: RigState | None = None) -> FilteredTargets:
        """
        Return the feasible targets of the cameras.

        :param cloud: (N, 3) float32, metres: the observed cloud.
        :param positions: (K, 3) metres, current positions of the movable cameras.
        :param targets: (K, 3) metres, their desired positions.
        :param max_step: farthest a camera moves in one time step, metres.
        :param fixed: (F, 3) metres, positions of the fixed cameras; None for those of the rig
            file.
        :param state: current state of the cameras. With it, a camera without observed floor
            within one step may move through the free space in its view: rigs start close
            together and do not see the floor below them.
        """
        top, prepared = float(positions[:, 2].max()) + FREE_ABOVE_M, self._prepared
        if prepared:
            self._prepared, self._allowed.top = False, max(self._allowed.top, top)
        else:
            self._look(cloud, positions)
        if self._allowed is None:
            return FilteredTargets(positions.copy(), [f'all cameras stay: {self._why}'])
        bounds = np.stack([cloud.min(axis=0), cloud.max(axis=0)]).astype(np.float64)
        fixed = self.rig.fixed_poses[:, :3] if fixed is None else fixed
        chosen, held = positions.copy(), []
        for camera, name in enumerate(self.rig.cameras):
            others = np.concatenate([np.delete(chosen, camera, axis=0), fixed])
            found = self._nearest(positions[camera], targets[camera], others, bounds, max_step,
                                  cloud if prepared else None)
            going = np.linalg.norm(targets[camera] - positions[camera]) > STAYING_M
            if found is None and going and state is not None and not prepared:
                found = self._nearest(positions[camera], targets[camera], others, bounds, max_step,
                                      None, FreeWays.of(cloud, state, camera))
            if found is None:
                held.append(f'{name.name} stays at {np.round(positions[camera], 2).tolist()}: '
                            f'found no feasible position within {max_step:g} m')
            else:
                chosen[camera] = found
        if held and prepared:
            # The newest points may add feasible positions for cameras that would have to stay.
            return self(cloud, positions, targets, max_step, fixed, state)
        return FilteredTargets(chosen, held)

    def _look(self, cloud: np.ndarray, positions: np.ndarray) -> None:
        """
        Compute the feasible region of the observed cloud, if cloud or heights have changed.

        Cameras keep their current heights even outside the limits of the rig file: in a partial
        cloud the lowest surface may be a table, and measured poses have errors.
        """
        z = positions[:, 2].astype(np.float64)
        if self._known is not None and np.array_equal(self._known[1], z) and np.array_equal(
                self._known[0], cloud):
            return
        self._known, self._allowed = (cloud, z), None
        try:
            scene, rig = Scene(cloud, 'observed cloud'), self._movable
            if rig.mount.heights is not None:
                above, (low, high) = z - floor_height(scene), rig.mount.heights
                rig = replace(rig, mount=rig.mount._replace(
                    heights=(min(above.min(), low), max(above.max(), high))))
            self._allowed = FeasibleRegion(scene, rig, float(z.max()) + FREE_ABOVE_M)
        except (ConfigurationError, SceneError) as error:
            self._why = str(error)

    def _nearest(self, position: np.ndarray, target: np.ndarray, others: np.ndarray,
                 bounds: np.ndarray, max_step: float, newest: np.ndarray | None,
                 free: FreeWays | None = None) -> np.ndarray | None:
        """
        Return a feasible position, approximately the nearest to a target; None if there is none.

        :param newest: points that the feasible region may not contain yet; None if it has all.
        :param free: free distances that replace the check for observed floor; None to require
            observed floor.
        """
        if newest is not None:
            reach = max_step + self.rig.keep_clear + ROUNDING
            away = np.abs(newest[:, :2] - position[:2].astype(np.float32))
            newest = newest[(away <= reach).all(axis=1)]

        def allowed(places: np.ndarray) -> np.ndarray:
            good = satisfies_spacing(places, others, self.rig.spacing)
            good &= self._inside(places, bounds) if free is None else free.clear(
                places, self.rig.keep_clear)
            good[good] = self._allowed.allowed(
                places[good], unknown=free is not None) if good.any() else False
            if newest is not None and good.any():
                good[good] = self._allowed.clear(places[good], newest)
            return good

        return nearest_place(position, target, max_step,
                             lambda places: self._raised(places, position[2]), allowed)

    def _raised(self, places: np.ndarray, height: float) -> np.ndarray:
        """Set places to the height of a camera, or to that of its mount at the ceiling: (P, 3)."""
        places = places.copy()
        places[:, 2] = height
        allowed = self._allowed
        if self.rig.mount.heights is None and self.rig.mount.on == 'ceiling':
            above = allowed.surface.height_above(places[:, :2])
            off = ~allowed.surface.at(places).on | (above <= places[:, 2])
            places[off, 2] = np.where(np.isfinite(above), above - STAND_OFF, height)[off]
        return places

    def _inside(self, places: np.ndarray, bounds: np.ndarray) -> np.ndarray:
        """Return which places are far enough inside the observed bounding box: (P,) bool."""
        inside, _ = kept_inside(places, bounds, self.wall_margin)
        return (np.abs(inside - places) <= ROUNDING).all(axis=1)
