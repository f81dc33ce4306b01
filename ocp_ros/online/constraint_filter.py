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
turn. A camera without such a position stays where it is.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import Pose
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.geometry.shadow_maps import in_reach
from ocp_ros.online.rig_state import clearance_of, RigState
from ocp_ros.rig.feasible_region import FeasibleRegion, satisfies_spacing
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.motion import kept_inside, nearest_place, ROUNDING, towards
from ocp_ros.rig.rig_file import Rig
from ocp_ros.rig.structure import floors_of, STAND_OFF
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.simulation.simulation_config import EpisodeLimits
from ocp_ros.util.settings import ConfigurationError

#: Assumed free height above a camera, metres: cameras that look down do not observe it.
FREE_ABOVE_M = 0.1
#: Number of horizontal directions in which the free distance around a camera is measured.
SECTORS = 120


class FilteredTargets(NamedTuple):
    """
    Feasible targets of K movable cameras.

    :ivar targets: (K, 3) metres, map frame.
    :ivar held: messages, one for each camera that stays because it has no feasible position; a
        single one for all cameras if the feasible region could not be computed.
    """

    targets: np.ndarray
    held: list[str]


class StepConstraints:
    """
    Correct the moves of a turn so that they satisfy the constraints on the observed cloud.

    :param limits: limits of the rig in one turn.
    :param rig: the rig with its constraints; None for cameras that move freely on a plane.
    :ivar filter: applies the constraints of the rig file; None without rig file.
    """

    def __init__(self, limits: EpisodeLimits, rig: Rig | None) -> None:
        self._limits = limits
        self.filter = None if rig is None else ConstraintFilter(rig, limits.wall_margin)

    def set_limits(self, limits: EpisodeLimits) -> None:
        """Replace the limits of a turn."""
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
        Return the feasible targets of K movable cameras.

        :param cloud: (N, 3) float32, metres: the observed cloud. If it is empty, only the length
            of the moves is limited.
        :param state: current state of the cameras.
        :param moves: (K, 2) metres, the moves that a planner chose.
        """
        limits = self._limits
        positions = state.placement[:state.movable, :3]
        targets = positions.copy()
        if len(cloud) == 0:
            targets[:, :2] = towards(positions[:, :2], positions[:, :2] + moves, limits.max_step)
            return FilteredTargets(targets, [])
        # Cameras over the observed floor stay there, because behind a wall they would see through
        # its back. Other cameras may move anywhere. Then all targets are moved into the observed
        # bounding box.
        plane = FreePlane.around(cloud, positions, limits.wall_margin,
                                 clearance_of(state, limits.clearance))
        targets[:, :2] = plane.moved(positions[:, :2], moves, limits.max_step)
        targets, _ = kept_inside(targets, corners_of(cloud).astype(np.float64),
                                 limits.wall_margin)
        if self.filter is None:
            # Limit the moves again: a camera with a frustum does not observe its surroundings, so
            # it may be far outside the box, and its way into the box longer than one step.
            targets[:, :2] = towards(positions[:, :2], targets[:, :2], limits.max_step)
            return FilteredTargets(targets, [])
        return self.filter(cloud, positions, targets, limits.max_step,
                           state.placement[state.movable:, :3], state)


class FreeDistances(NamedTuple):
    """
    Free distance around a camera in each of ``SECTORS`` horizontal directions.

    :ivar position: (3,) metres, of the camera.
    :ivar distances: (SECTORS,) metres to the nearest observed point in the camera's view, in each
        direction and the two directions beside it; 0 if one of these has no such point.
    """

    position: np.ndarray
    distances: np.ndarray

    @classmethod
    def of(cls, cloud: np.ndarray, state: RigState, camera: int) -> 'FreeDistances':
        """
        Compute the free distances around a camera.

        :param cloud: (N, 3) float32, metres: the observed cloud.
        :param state: current state of the cameras.
        :param camera: the number of the camera.
        """
        pose = Pose.of(state.placement[camera])
        offsets = (cloud[in_reach(cloud, pose, state.models[camera].lens)] - pose.position)[:, :2]
        distances = np.full(SECTORS, np.inf)
        np.minimum.at(distances, _sectors(offsets), np.linalg.norm(offsets, axis=1))
        # A direction without observed points is unknown, so it does not count as free.
        distances[np.isinf(distances)] = 0.0
        return cls(pose.position, np.min([np.roll(distances, k) for k in (-1, 0, 1)], axis=0))

    def are_free(self, positions: np.ndarray, margin: float) -> np.ndarray:
        """
        Return which positions (P, 3) are ``margin`` metres or more before any surface: (P,) bool.

        In a direction without observed points no position counts as free.
        """
        offsets = (positions - self.position)[:, :2]
        return np.linalg.norm(offsets, axis=1) + margin <= self.distances[_sectors(offsets)]


def _sectors(vectors: np.ndarray) -> np.ndarray:
    """Return the number, below ``SECTORS``, of each horizontal vector's direction: (M,) int."""
    angle_shares = np.arctan2(vectors[:, 1], vectors[:, 0]) / (2.0 * np.pi)
    return np.floor(SECTORS * angle_shares).astype(int) % SECTORS


class ConstraintFilter:
    """
    Move targets to feasible positions.

    :param rig: the rig with its constraints; its fixed cameras matter for the spacing alone.
    :param wall_margin: cameras stay this far inside the observed bounding box, metres.
    """

    def __init__(self, rig: Rig, wall_margin: float) -> None:
        self.rig, self.wall_margin = rig, wall_margin
        # The feasible region rejects fixed cameras far outside the bounding box, and the observed
        # one may be small; so its rig has none.
        self._movable_rig = replace(rig, fixed=())
        #: Heights of the cameras and cloud of the last feasible region.
        self._computed_for: tuple[np.ndarray, np.ndarray] | None = None
        #: The last feasible region; None if it could not be computed.
        self._region: FeasibleRegion | None = None
        #: Why the last feasible region could not be computed.
        self._failure = ''
        self.reset()

    def reset(self) -> None:
        """Make the next call check whether the region is up to date, also if it was prepared."""
        self._is_prepared = False

    def prepare(self, cloud: np.ndarray, positions: np.ndarray) -> None:
        """
        Compute the feasible region in advance: the next call then checks new points alone.

        If this fails, the next call computes the region.

        :param cloud: (N, 3) float32, metres: the observed cloud.
        :param positions: (K, 3) metres, of the K movable cameras at the next turn.
        """
        self._update_region(cloud, positions)
        self._is_prepared = self._region is not None

    def __call__(self, cloud: np.ndarray, positions: np.ndarray, targets: np.ndarray,
                 max_step: float, fixed: np.ndarray | None = None,
                 state: RigState | None = None) -> FilteredTargets:
        """
        Return the feasible targets of the cameras; use a prepared region once.

        :param cloud: (N, 3) float32, metres: the observed cloud.
        :param positions: (K, 3) metres, current positions of the K movable cameras.
        :param targets: (K, 3) metres, desired positions of these cameras.
        :param max_step: farthest a camera moves in one turn, metres.
        :param fixed: (F, 3) metres, positions of the F fixed cameras; None for those in the rig
            file.
        :param state: current state of the cameras. With it, a camera without observed floor
            within one step may move through the free space in its view: rigs start close
            together and do not see the floor below them.
        """
        was_prepared = self._is_prepared
        if was_prepared:
            self._is_prepared = False
            # The region was computed for planned heights; the measured ones may be higher.
            self._region.top = max(self._region.top, float(positions[:, 2].max()) + FREE_ABOVE_M)
        else:
            self._update_region(cloud, positions)
        if self._region is None:
            return FilteredTargets(positions.copy(), [f'all cameras stay: {self._failure}'])
        bounds = np.stack([cloud.min(axis=0), cloud.max(axis=0)]).astype(np.float64)
        fixed = self.rig.fixed_poses[:, :3] if fixed is None else fixed
        chosen, held = positions.copy(), []
        # A prepared region was computed from an older cloud.
        new_points = cloud if was_prepared else None
        for camera, (rig_camera, position, target) in enumerate(
                zip(self.rig.cameras, positions, targets, strict=True)):
            others = np.concatenate([np.delete(chosen, camera, axis=0), fixed])
            place = self._nearest(position, target, others, bounds, max_step, new_points)
            # A move of at most 1 cm counts as staying. After a search in a prepared region, the
            # free space is tried in the second call below.
            is_moving = np.linalg.norm(target - position) > 0.01
            if place is None and is_moving and state is not None and not was_prepared:
                place = self._nearest(position, target, others, bounds, max_step, None,
                                      FreeDistances.of(cloud, state, camera))
            if place is None:
                held.append(f'{rig_camera.name} stays at {np.round(position, 2).tolist()}: '
                            f'found no feasible position within {max_step:g} m')
            else:
                chosen[camera] = place
        if held and was_prepared:
            # The newest points may add feasible positions for cameras that would have to stay, so
            # this call computes the region again: no region is prepared now.
            return self(cloud, positions, targets, max_step, fixed, state)
        return FilteredTargets(chosen, held)

    def allowed(self, cloud: np.ndarray, positions: np.ndarray, places: np.ndarray) -> np.ndarray:
        """
        Return which places violate no constraint of a single camera; all if that is unknown.

        A prepared region is used as it is.

        :param cloud: (N, 3) float32, metres: the observed cloud.
        :param positions: (K, 3) metres, of the K movable cameras.
        :param places: (M, 3) metres, at one height; on a ceiling they are moved to its height.
        :returns: (M,) bool.
        """
        if not self._is_prepared:
            self._update_region(cloud, positions)
        return (self._region.allowed(self._at_height(places, places[0, 2]))
                if len(places) and self._region is not None else np.ones(len(places), dtype=bool))

    def _update_region(self, cloud: np.ndarray, positions: np.ndarray) -> None:
        """
        Compute the feasible region of the observed cloud if cloud or heights have changed.

        Cameras keep their current heights even outside the limits of the rig file: in a partial
        cloud the lowest surface may be a table, and measured poses have errors.
        """
        z = positions[:, 2].astype(np.float64)
        if self._computed_for is not None and all(map(
                np.array_equal, self._computed_for, (z, cloud))):
            return
        self._computed_for = z, cloud
        self._region = None
        try:
            scene = Scene(cloud, 'observed cloud')
            rig = self._movable_rig
            if rig.mount.heights is not None:
                heights = z - floors_of(scene).under(positions)
                low, high = rig.mount.heights
                rig = replace(rig, mount=rig.mount._replace(
                    heights=(min(heights.min(), low), max(heights.max(), high))))
            self._region = FeasibleRegion(scene, rig, float(z.max()) + FREE_ABOVE_M)
        except (ConfigurationError, SceneError) as error:
            self._failure = str(error)

    def _nearest(self, position: np.ndarray, target: np.ndarray, others: np.ndarray,
                 bounds: np.ndarray, max_step: float, new_points: np.ndarray | None,
                 free_distances: FreeDistances | None = None) -> np.ndarray | None:
        """
        Return a feasible position (3,), about the nearest to a target; None if there is none.

        :param others: (C, 3) metres, positions of all other cameras.
        :param bounds: (2, 3) metres, bounding box of the observed cloud.
        :param new_points: (N, 3) metres, points that the feasible region may not contain yet; None
            if it has all.
        :param free_distances: replace the checks for the bounding box, known floor and free space;
            None to make these checks.
        """
        if new_points is not None:
            # Only these points can be too near to a place that the camera can reach.
            distance = max(self.rig.keep_clear, self.rig.mount.footprint)
            radius = max_step + distance + ROUNDING
            offsets = np.abs(new_points[:, :2] - position[:2].astype(np.float32))
            new_points = new_points[(offsets <= radius).all(axis=1)]

        def are_feasible(places: np.ndarray) -> np.ndarray:
            """Return which places (P, 3) violate no constraint: (P,) bool."""
            feasible = satisfies_spacing(places, others, self.rig.spacing)
            feasible &= (self._are_inside(places, bounds) if free_distances is None else
                         free_distances.are_free(places, self.rig.keep_clear))
            # Slower checks only of the places that passed the checks so far.
            if feasible.any():
                feasible[feasible] = self._region.allowed(places[feasible],
                                                          unknown=free_distances is not None)
            if new_points is not None and feasible.any():
                feasible[feasible] = self._region.clear(places[feasible], new_points)
            return feasible

        return nearest_place(position, target, max_step,
                             lambda places: self._at_height(places, position[2]), are_feasible)

    def _at_height(self, places: np.ndarray, height: float) -> np.ndarray:
        """
        Return places (P, 3) at a height, or just below the ceiling if the mount needs it.

        Where the ceiling is unknown, the places have the given height too.
        """
        places = places.copy()
        places[:, 2] = height
        if self.rig.mount.heights is None and self.rig.mount.on == 'ceiling':
            surface = self._region.surface
            ceiling = surface.height_above(places[:, :2])
            # Too far below the ceiling, or not below it; the height of an unknown ceiling is -inf.
            is_off = ~surface.at(places).on | (ceiling <= places[:, 2])
            mounted = np.where(np.isfinite(ceiling), ceiling - STAND_OFF, height)
            places[is_off, 2] = mounted[is_off]
        return places

    def _are_inside(self, places: np.ndarray, bounds: np.ndarray) -> np.ndarray:
        """Return which places are far enough inside the observed bounding box: (P,) bool."""
        moved, _ = kept_inside(places, bounds, self.wall_margin)
        return (np.abs(moved - places) <= ROUNDING).all(axis=1)
