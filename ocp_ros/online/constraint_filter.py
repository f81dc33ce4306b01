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
Hold targets to the constraints of a rig file, judged on the observed cloud.

Each camera goes to the allowed place nearest to where it was to go, among those that one turn
reaches. Where there is none it stays: nobody is sent through a place where it must not be.
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

#: Metres of air that there are above a camera at least: those that look down do not see it.
ABOVE = 0.1
#: Metres: who goes no farther stays.
STAYS = 0.01
#: Directions around a camera in which it is known how far it looks through free space, and how
#: many on either side of a way have to be free too.
SECTORS, ASIDE = 120, 1


class FilteredTargets(NamedTuple):
    """
    Where cameras may go.

    :ivar targets: (K, 3) metres.
    :ivar held: sentences, one for each camera that stays since it may go nowhere.
    """

    targets: np.ndarray
    held: list[str]


class StepConstraints:
    """
    Bring the moves of a step to where cameras may be, by what was seen and by a rig file.

    :param limits: of one step.
    :param rig: None for cameras that move freely on a plane.
    :ivar filter: holds targets to the constraints of the rig file.
    """

    def __init__(self, limits: Limits, rig: Rig | None) -> None:
        self._limits = limits
        self.filter = None if rig is None else ConstraintFilter(rig, limits.wall_margin)

    def change(self, limits: Limits) -> None:
        """Go on with other limits."""
        self._limits = limits
        if self.filter is not None:
            self.filter.wall_margin = limits.wall_margin

    def reset(self) -> None:
        """Forget the last episode."""
        if self.filter is not None:
            self.filter.reset()

    def prepare(self, cloud: np.ndarray, positions: np.ndarray) -> None:
        """Learn ahead where cameras may be, see :meth:`ConstraintFilter.prepare`."""
        if self.filter is not None:
            self.filter.prepare(cloud, positions)

    def __call__(self, cloud: np.ndarray, state: RigState, moves: np.ndarray) -> FilteredTargets:
        """
        Choose places.

        :param cloud: (N, 3) float32, metres: the points seen so far.
        :param state: the cameras as they are.
        :param moves: (K, 2) metres.
        """
        positions, limits = state.placement[:state.movable, :3], self._limits
        targets = positions.copy()
        if len(cloud) == 0:
            targets[:, :2] = towards(positions[:, :2], positions[:, :2] + moves, limits.max_step)
            return FilteredTargets(targets, [])
        # Nobody leaves the floor that was seen: beyond a wall one looks through its back.
        plane = FreePlane.around(cloud, positions, limits.wall_margin,
                                 clearance_of(state, limits.clearance))
        targets[:, :2] = plane.moved(positions[:, :2], moves, limits.max_step)
        targets, _ = kept_inside(targets, corners_of(cloud).astype(np.float64),
                                 limits.wall_margin)
        if self.filter is None:
            # A camera with a frustum may stand far outside what it has seen.
            targets[:, :2] = towards(positions[:, :2], targets[:, :2], limits.max_step)
            return FilteredTargets(targets, [])
        return self.filter(cloud, positions, targets, limits.max_step,
                           state.placement[state.movable:, :3], state)


class FreeWays(NamedTuple):
    """
    How far a camera looks through free space, all around it.

    :ivar position: (3,) metres, of the camera.
    :ivar reach: (SECTORS,) metres to the first surface that it sees in each direction, or in one
        beside it; 0 where it sees nothing.
    """

    position: np.ndarray
    reach: np.ndarray

    @classmethod
    def of(cls, cloud: np.ndarray, state: RigState, camera: int) -> 'FreeWays':
        """
        Look around.

        :param cloud: (N, 3) float32, metres: the points seen so far.
        :param state: how the cameras are turned.
        """
        pose = Pose.of(state.placement[camera])
        ways = (cloud[in_reach(cloud, pose, state.models[camera].lens)] - pose.position)[:, :2]
        free = np.full(SECTORS, np.inf)
        np.minimum.at(free, _sectors(ways), np.linalg.norm(ways, axis=1))
        # Where nothing is seen, nothing is known.
        free[np.isinf(free)] = 0.0
        return cls(pose.position, np.min(
            [np.roll(free, k) for k in range(-ASIDE, ASIDE + 1)], axis=0))

    def clear(self, places: np.ndarray, least: float) -> np.ndarray:
        """Return which places (P, 3) are so many metres before the first surface on the way."""
        ways = (places - self.position)[:, :2]
        return np.linalg.norm(ways, axis=1) + least <= self.reach[_sectors(ways)]


def _sectors(ways: np.ndarray) -> np.ndarray:
    """Return the numbers of the directions of ways (M, 2)."""
    turns = np.arctan2(ways[:, 1], ways[:, 0]) / (2.0 * np.pi)
    return np.floor(SECTORS * turns).astype(int) % SECTORS


class ConstraintFilter:
    """
    Move targets to allowed places.

    :param rig: what is asked of places; its cameras in place only keep others away.
    :param wall_margin: cameras stay this far inside the observed bounding box, metres.
    """

    def __init__(self, rig: Rig, wall_margin: float) -> None:
        self.rig, self.wall_margin = rig, wall_margin
        # What is in place may be farther off than what has been seen.
        self._movable = replace(rig, fixed=())
        self._known: tuple[np.ndarray, np.ndarray] | None = None
        self._allowed: FeasibleRegion | None = None
        self._why = ''
        self.reset()

    def reset(self) -> None:
        """Forget what was prepared in the last episode."""
        self._prepared = False

    def prepare(self, cloud: np.ndarray, positions: np.ndarray) -> None:
        """
        Learn ahead where cameras may be: the next targets then need the newest points alone.

        Where nothing could be learned, it is tried again when the next targets come.

        :param cloud: (N, 3) float32, metres: the points seen so far.
        :param positions: (K, 3) metres, where the cameras will be that are to be placed.
        """
        self._look(cloud, positions)
        self._prepared = self._allowed is not None

    def __call__(self, cloud: np.ndarray, positions: np.ndarray, targets: np.ndarray,
                 max_step: float, fixed: np.ndarray | None = None,
                 state: RigState | None = None) -> FilteredTargets:
        """
        Choose places.

        :param cloud: (N, 3) float32, metres: the points seen so far.
        :param positions: (K, 3) metres, where the cameras of the rig that are to be placed are.
        :param targets: (K, 3) metres, where they were to go.
        :param max_step: farthest a camera moves in one turn, metres.
        :param fixed: (F, 3) metres, where the cameras in place are; the rig's word for it unless
            told otherwise.
        :param state: how the cameras are turned. One that knows no floor within a step goes where
            it looks through free space: rigs begin close together, and see no floor below them.
        """
        top, prepared = float(positions[:, 2].max()) + ABOVE, self._prepared
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
            going = np.linalg.norm(targets[camera] - positions[camera]) > STAYS
            if found is None and going and state is not None and not prepared:
                found = self._nearest(positions[camera], targets[camera], others, bounds, max_step,
                                      None, FreeWays.of(cloud, state, camera))
            if found is None:
                held.append(f'{name.name} stays at {np.round(positions[camera], 2).tolist()}: '
                            f'found no feasible position within {max_step:g} m')
            else:
                chosen[camera] = found
        if held and prepared:
            # Perhaps the newest points show a place for those that would have to stay.
            return self(cloud, positions, targets, max_step, fixed, state)
        return FilteredTargets(chosen, held)

    def _look(self, cloud: np.ndarray, positions: np.ndarray) -> None:
        """
        Learn from what has been seen where cameras may be, unless that is known.

        Cameras keep the heights at which they are: the floor of a cloud that shows a part of a
        room may be a table, and poses are measured.
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
            self._allowed = FeasibleRegion(scene, rig, float(z.max()) + ABOVE)
        except (ConfigurationError, SceneError) as error:
            self._why = str(error)

    def _nearest(self, position: np.ndarray, target: np.ndarray, others: np.ndarray,
                 bounds: np.ndarray, max_step: float, newest: np.ndarray | None,
                 free: FreeWays | None = None) -> np.ndarray | None:
        """
        Return the allowed place that is nearest to a target, about; None if there is none.

        :param newest: points of which some may not be known yet; None if all are.
        :param free: where the camera may go, whatever is known of the floor; None where floor is
            asked for.
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
        """Bring places to the height of a camera, or to the ceiling that it hangs on: (P, 3)."""
        places = places.copy()
        places[:, 2] = height
        allowed = self._allowed
        if self.rig.mount.heights is None and self.rig.mount.on == 'ceiling':
            above = allowed.surface.height_above(places[:, :2])
            off = ~allowed.surface.at(places).on | (above <= places[:, 2])
            places[off, 2] = np.where(np.isfinite(above), above - STAND_OFF, height)[off]
        return places

    def _inside(self, places: np.ndarray, bounds: np.ndarray) -> np.ndarray:
        """Tell which places are far enough inside the observed bounding box: (P,) bool."""
        inside, _ = kept_inside(places, bounds, self.wall_margin)
        return (np.abs(inside - places) <= ROUNDING).all(axis=1)
