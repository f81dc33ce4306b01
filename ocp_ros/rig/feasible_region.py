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

"""Feasible region: where cameras may be in a room, and which constraint is violated elsewhere."""

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.geometry.clouds import evenly
from ocp_ros.rig.free_plane import CELL_M, FreePlane
from ocp_ros.rig.mounts import choose_spread, headings_of, MERGE_DISTANCE_M, MountPlaces, places_in
from ocp_ros.rig.rig_file import Rig
from ocp_ros.rig.structure import (
    Air,
    ceiling_of,
    Contact,
    floors_of,
    hidden_walls,
    MAX_MOUNT_GAP_M,
    MountSurface,
    STAND_OFF,
    walls_of,
)
from ocp_ros.rig.zones import moved_into_nearest
from ocp_ros.scenes.scene import Scene
from ocp_ros.util.settings import ConfigurationError
from scipy.spatial import cKDTree

#: Metres: the tolerance for rounding of positions over the floor.
ROUNDING_M = 1e-5
#: Metres by which distances may fall short of their limits.
DISTANCE_TOLERANCE_M = 0.001
#: Metres and radians by which the height and the pitch of a camera may be outside their limits.
MOUNT_TOLERANCE = 0.01
#: Radians: steps of yaw and pitch for a dense grid of poses.
DENSE = np.deg2rad((15.0, 9.5))
#: The name in messages of the constraint that a ball can be moved to the camera.
FREE_SPACE = 'free space'
#: The name in messages of the constraint that there is floor below the camera.
FLOOR = 'the floor'


class Check(NamedTuple):
    """
    One constraint, checked for M cameras.

    :ivar name: the name of the constraint in the message that no position is feasible.
    :ivar violated: (M,) bool, whether each camera violates the constraint.
    :ivar describe: returns the message about a violation, given the number of the camera.
    """

    name: str
    violated: np.ndarray
    describe: Callable[[int], str]


class FeasibleRegion:
    """
    The poses that satisfy the constraints of a rig in a room.

    :param scene: the room.
    :param rig: the cameras and their constraints.
    :param top: the least z of the top of the room, metres, for a partial scan that ends below the
        cameras.
    :raises ConfigurationError: if a height, a camera in place or the mount does not fit the room.
    :ivar floors: the floors; heights of cameras are above the floor below them.
    :ivar floor: z of the largest floor, metres, for the heights of zones.
    :ivar top: z of the top of the room, metres.
    :ivar space: the positions over the floor.
    :ivar air: the air of the room.
    :ivar surface: the ceiling or the walls that cameras are mounted on; None for other mounts.
    """

    def __init__(self, scene: Scene, rig: Rig, top: float | None = None) -> None:
        self.scene, self.rig = scene, rig
        self.floors = floors_of(scene)
        self.floor = self.floors.height
        self.top = max(float(scene.bounds[1, 2]), -np.inf if top is None else top)
        self._check_heights()
        self.space = floor_space(scene, rig, self.top)
        self.air = Air(scene, self.space)
        self.surface = self._find_surface()
        # Cameras keep their clearance from walls that the scan shows only in part, too.
        self._obstacles = np.concatenate([scene.points, hidden_walls(scene)])
        self._tree = cKDTree(self._obstacles)
        # Cameras in place may be up to 1 m outside the bounding box of the room.
        for fixed in rig.fixed:
            position = fixed.pose[:3]
            if (np.clip(position, scene.bounds[0] - 1.0, scene.bounds[1] + 1.0) != position).any():
                raise ConfigurationError(
                    f'{fixed.where}: found a camera at {_place_text(position)}, outside '
                    f'{scene.name}; expected one in the box from {_place_text(scene.bounds[0])} '
                    f'to {_place_text(scene.bounds[1])}; correct its position')

    def _check_heights(self) -> None:
        """Raise ConfigurationError for camera heights above the top of the room."""
        mount, document = self.rig.mount, self.rig.document
        height = self.top - self.floors.levels[0].z
        if mount.heights is not None and mount.heights[0] >= height:
            given = 'height' in document.data.get('mount', {})
            # The message proposes 0.7 of the height of the room, which is below its top.
            raise document.error(
                ('mount', 'height'), f'{round(mount.heights[0], 2):g} m'
                f'{"" if given else " by default"}',
                f'less than the {height:.2f} m that {self.scene.name} is high',
                'lower it' if given else f'write mount: {{on: {mount.on}, height: '
                f'{0.7 * height:.1f}}} in a rig file (--rig)')

    def _find_surface(self) -> MountSurface | None:
        """Find the surface that the cameras are mounted on; None for mounts without one."""
        on = self.rig.mount.on
        if on in ('plane', 'free'):
            return None
        surface = ceiling_of(self.scene) if on == 'ceiling' else walls_of(self.scene)
        if len(surface.points) == 0:
            raise self.rig.document.error(
                ('mount', 'on'), f'{on}, of which {self.scene.name} shows none', 'a scan that '
                'shows it', 'choose another, such as plane with a height, or scan it too')
        return surface

    def candidates(self, model: CameraModel, max_count: int) -> np.ndarray:
        """
        Return feasible candidate poses for a search.

        :param model: the camera model.
        :param max_count: the largest number of poses, above 0. Positions are spread evenly, each
            with all headings, or with some headings if there would be too few positions.
        :returns: (M, 6): M poses x, y, z, metres, map frame, and yaw, pitch, roll, radians.
        :raises ConfigurationError: if there is no place where the camera may hang.
        """
        # Large steps of yaw and pitch, since a search gets few poses.
        relative_headings = headings_of(self.rig, model, *np.deg2rad((30.0, 19.0)))
        # There are at least 48 positions, enough for several cameras, or ``max_count`` if less.
        pose_count = max(max_count, min(48, max_count) * len(relative_headings))
        positions, headings, _ = self._spread_poses(
            model, relative_headings, pose_count, MERGE_DISTANCE_M)
        repeated = np.repeat(positions[:, None], headings.shape[1], axis=1)
        poses = np.concatenate([repeated, headings], axis=2).reshape(-1, 6)
        # If there are more poses than wanted, evenly spaced ones are kept.
        return poses[evenly(len(poses), max_count)]

    def pose_grid(self, model: CameraModel, step: float, max_count: int, min_places: int = 1
                  ) -> tuple[np.ndarray, np.ndarray, float]:
        """
        Return a dense grid of feasible poses.

        :param model: the camera model.
        :param step: metres between positions; half of it for cameras with a single heading.
        :param max_count: the largest number of poses; positions are farther apart if there would
            be more.
        :param min_places: number of positions for which ``max_count`` may be exceeded.
        :returns: P positions (P, 3), metres, map frame; their H headings (P, H, 3), radians; and
            the largest distance of a feasible position from the nearest returned one, metres.
        :raises ConfigurationError: if there is no place where the camera may hang.
        """
        relative_headings = headings_of(self.rig, model, *DENSE)
        min_distance = step if len(relative_headings) > 1 else 0.5 * step
        max_count = max(max_count, min_places * len(relative_headings))
        return self._spread_poses(model, relative_headings, max_count, min_distance)

    def _spread_poses(self, model: CameraModel, relative_headings: np.ndarray, max_count: int,
                      min_distance: float) -> tuple[np.ndarray, np.ndarray, float]:
        """
        Return spread feasible positions, each with H headings; see :meth:`pose_grid`.

        :param relative_headings: (H, 3), their yaw is relative to ``MountPlaces.inwards``.
        """
        places, distance = self.places(
            model, max(max_count // len(relative_headings), 1), min_distance)
        headings = np.repeat(relative_headings[None], len(places.positions), axis=0)
        headings[..., 0] += places.inwards[:, None]
        return places.positions, headings, distance

    def places(self, model: CameraModel, max_count: int, min_distance: float = MERGE_DISTANCE_M
               ) -> tuple[MountPlaces, float]:
        """
        Return feasible positions of a camera, spread evenly and independent of its yaw.

        :param model: the camera model.
        :param max_count: the largest number of positions, above 0.
        :param min_distance: metres; positions nearer to a chosen one are left out.
        :returns: the positions, and the largest distance of a feasible position from the nearest
            returned one, metres.
        :raises ConfigurationError: if there is no place where the camera may hang.
        """
        offered = places_in(self.rig, self.scene, self.space, self.surface)
        if self.rig.keep_in and len(offered.positions) == 0:
            raise self.rig.document.error(
                ('keep_in',), f'no place of the mount {self.rig.mount.on} in any zone over the '
                f'floor of {self.scene.name}', 'one at least', 'correct the corners of the zones, '
                'or the mount or its height')
        # Pitch and roll of these poses are allowed, so that only the position decides.
        poses = np.zeros((len(offered.positions), 6))
        poses[:, :3] = offered.positions
        poses[:, 4:] = np.clip(0.0, *self.rig.pitch), self.rig.rolls[0]
        feasible = self.allowed(poses, model)
        if not feasible.any():
            raise self.rig.document.error(
                ('mount',), f'no feasible pose in {self.scene.name}'
                f'{self._main_reason(poses, model)}', 'one at least', 'change that, or the mount '
                'or its height')
        chosen, distance = choose_spread(offered.positions[feasible], max_count, min_distance)
        return MountPlaces(*(values[feasible][chosen] for values in offered)), distance

    def _main_reason(self, poses: np.ndarray, model: CameraModel) -> str:
        """Return the end of the message about infeasible poses (M, 6): what rejects the most."""
        if len(poses) == 0:
            return ': the mount has none above the floor'
        checks = list(self._checks(poses, [model] * len(poses), ROUNDING_M))
        violations = np.sum([check.violated for check in checks], axis=0)
        # The constraint that the most poses violate without violating another one. If several are
        # equal, the one of these that the most poses violate.
        strictest = max(checks, key=lambda check: (
            np.count_nonzero(check.violated & (violations == 1)),
            np.count_nonzero(check.violated)))
        number = np.count_nonzero(strictest.violated)
        if strictest.name == FREE_SPACE and number == len(poses):
            return ': no candidate connects to free space (several storeys or stray points?)'
        return f': {strictest.name} rejects {number} of {len(poses)} candidates'

    def onto_mount(self, positions: np.ndarray) -> np.ndarray:
        """
        Return the nearest positions on the mount, which may violate other constraints.

        :param positions: (M, 3) metres, map frame.
        :returns: (M, 3) metres; on walls or a ceiling, unchanged if there is none nearby.
        """
        on, heights, _ = self.rig.mount
        moved = (moved_into_nearest(self.rig.keep_in, positions, self.floor) if self.rig.keep_in
                 else positions.copy())
        if on == 'walls':
            contact = self.surface.at(moved)
            shift = np.where(contact.on, STAND_OFF - contact.distances, 0.0)
            moved += shift[:, None] * contact.normals
        # Only a ceiling mount may have no heights; the height of the ceiling is not finite where
        # there is none.
        if heights is None:
            z = self.surface.height_above(moved[:, :2]) - STAND_OFF
            moved[:, 2] = np.where(np.isfinite(z), z, moved[:, 2])
        else:
            moved[:, 2] = np.clip(moved[:, 2], *np.add.outer(heights, self.floors.under(moved)))
        return moved

    def broken(self, poses: np.ndarray) -> list[str]:
        """
        Return the constraint violations of a placement.

        :param poses: (K, 6), poses of the first K cameras, metres, map frame, and radians; (K, 3)
            where no camera has a heading.
        :returns: one sentence for each violation.
        :raises ValueError: for another shape, or more rows than cameras.
        """
        poses = _checked_poses(poses)
        if len(poses) > len(self.rig.cameras):
            raise ValueError(f'poses: found {len(poses)} cameras; expected at most '
                             f'{len(self.rig.cameras)}, those of the rig that are to be placed')
        chosen = self.rig.cameras[:len(poses)]
        # Positions up to one cell beyond the known floor are accepted, since the known floor may
        # end that far before the walls.
        checks = list(self._checks(poses, [camera.model for camera in chosen], CELL_M))
        sentences = [f'{camera.name}: {check.describe(k)}' for k, camera in enumerate(chosen)
                     for check in checks if check.violated[k]]
        for k, camera in enumerate(chosen):
            for other in range(k):
                distance = float(np.linalg.norm(poses[k, :3] - poses[other, :3]))
                if distance < self.rig.spacing - DISTANCE_TOLERANCE_M:
                    sentences.append(
                        f'{camera.name}: {self._spacing_message(distance, chosen[other].name)}')
        return sentences

    def fixed_notes(self) -> list[str]:
        """Return a sentence for each camera in place that is not in the air of the room."""
        # Cameras hang nearer to walls than the air is known, so that positions around a camera
        # count too.
        reach_m = 0.2
        offsets = np.array(list(product((-reach_m, 0.0, reach_m), repeat=3)))
        sentences = []
        for fixed in self.rig.fixed:
            position = fixed.pose[:3]
            around = position + offsets
            places = around[:, :2]
            over_floor = np.linalg.norm(self.space.inside(places) - places, axis=1) <= ROUNDING_M
            at_height = (around[:, 2] >= self.floor) & (around[:, 2] <= self.top)
            if (over_floor & at_height & ~self.air.closed(around)).any():
                continue
            found = ('above or below the room' if not at_height.any() else
                     'not above floor that the scan shows' if not over_floor.any() else
                     'inside furniture, or behind a wall or the ceiling')
            sentences.append(
                f'{fixed.camera.name}: found the fixed camera at {_place_text(position)}, {found}'
                f'; expected it in {self.scene.name}; correct its position')
        return sentences

    def allowed(self, poses: np.ndarray, model: CameraModel | None = None,
                unknown: bool = False) -> np.ndarray:
        """
        Return whether poses of one camera are feasible: whether they violate no constraint.

        Distances between cameras to be placed are not checked. Unlike :meth:`broken`, this accepts
        no positions beyond the known floor, which ends up to a cell before the walls: behind glass
        walls, which scans do not show, a camera would seem to see much.

        :param poses: (M, 6), M poses, metres, map frame, and radians; or (M, 3), positions only.
        :param model: the camera model; None for one with a limited field of view.
        :param unknown: whether poses without known floor or free space are feasible.
        :returns: (M,) bool.
        """
        poses = _checked_poses(poses)
        checks = self._checks(poses, [model] * len(poses), ROUNDING_M)
        return ~np.any([check.violated for check in checks
                        if not (unknown and check.name in (FLOOR, FREE_SPACE))], axis=0)

    def clear(self, positions: np.ndarray, points: np.ndarray) -> np.ndarray:
        """
        Return whether cameras keep their distance from points that may be missing in the scene.

        The feet of tripods keep theirs too.

        :param positions: (M, 3), the positions of M cameras, metres.
        :param points: (N, 3) float32, N points, metres; points of the surface that a camera is
            mounted on are ignored.
        :returns: (M,) bool.
        """
        contact = None if self.surface is None else self.surface.at(positions)
        clear = ~self._clearance_check(positions, contact, points, cKDTree(points)).violated
        if self.rig.mount.footprint:
            clear &= ~self._footprint_check(positions, self._obstacles_among(points)).violated
        return clear

    def _checks(self, poses: np.ndarray, models: Sequence[CameraModel | None],
                floor_margin: float) -> Iterator[Check]:
        """
        Yield all checks of single cameras.

        :param poses: (M, 6) or (M, 3), see :meth:`allowed`.
        :param models: the camera model of each pose.
        :param floor_margin: how far beyond the known floor a camera may be, metres; if it is more
            than the tolerance for rounding, ``keep_in`` zones have a tolerance too.
        """
        positions = poses[:, :3]
        contact = None if self.surface is None else self.surface.at(positions)
        yield (floor_check := self._floor_check(positions, contact, floor_margin))
        # Positions without floor violate that check only, not also the one of free space.
        closed = self.air.closed(positions) & ~floor_check.violated
        yield Check(FREE_SPACE, closed, lambda k: (
            'found a position inside furniture or behind it; expected one in free space; move it '
            'there'))
        yield self._clearance_check(positions, contact, self._obstacles, self._tree)
        yield from self._mount_checks(positions, contact)
        if self.rig.mount.footprint:
            yield self._footprint_check(positions, self._obstacle_tree)
        for number, zone in enumerate(self.rig.keep_out, start=1):
            inside = zone.contains(positions, self.floor)
            yield Check(f'keep-out zone {number}', inside, lambda k, number=number: (
                f'found a position in keep-out zone {number}; expected one outside; '
                'move it out'))
        if self.rig.keep_in:
            outside = ~np.any([zone.contains(positions, self.floor) for zone in self.rig.keep_in],
                              axis=0)
            zone_distance = np.zeros(len(positions))
            zone_distance[outside] = np.linalg.norm(positions[outside] - moved_into_nearest(
                self.rig.keep_in, positions[outside], self.floor), axis=1)
            zone_tolerance = MOUNT_TOLERANCE if floor_margin > ROUNDING_M else 0.0
            yield Check('keep_in', zone_distance > zone_tolerance, lambda k: (
                f'found {_place_text(positions[k])}, {zone_distance[k]:.2f} m outside of the '
                'keep_in zones; expected a position in one; move it there'))
        yield from self._heading_checks(poses, models)
        for fixed in self.rig.fixed:
            distance = np.linalg.norm(positions - fixed.pose[:3], axis=1)
            near = distance < self.rig.spacing - DISTANCE_TOLERANCE_M
            yield Check('spacing', near, lambda k, distance=distance, fixed=fixed: (
                self._spacing_message(distance[k], fixed.camera.name)))

    def _floor_check(self, positions: np.ndarray, contact: Contact | None, margin: float) -> Check:
        """Check that there is floor below or, on walls, in front, and that z is in the room."""
        places, z = positions[:, :2], positions[:, 2]
        if self.rig.mount.on == 'walls':
            # There has to be floor 0.3 m in front of the wall.
            places = places + 0.3 * contact.normals[:, :2]
        distance = np.linalg.norm(self.space.inside(places) - places, axis=1)
        violated = (distance > margin) | (z < self.floors.under(places)) | (z > self.top)
        return Check(FLOOR, violated, lambda k: (
            f'found {_place_text(positions[k])}, which is not above floor that {self.scene.name} '
            'shows; expected a position in the room and not in furniture; move it there'))

    def _clearance_check(self, positions: np.ndarray, contact: Contact | None, points: np.ndarray,
                         tree: cKDTree) -> Check:
        """Check the distance to all surfaces except the one that a camera is mounted on."""
        clearance = self.rig.keep_clear
        nearest = np.full(len(positions), np.inf)
        pending = np.arange(len(positions))
        # Without a mounting surface, the nearest point decides. Otherwise some of the nearest
        # points may belong to that surface, so several are examined.
        count = 1 if contact is None else 16
        while len(pending) and len(points):
            count = min(count, len(points))
            distance, index = tree.query(
                positions[pending], np.arange(1, count + 1), distance_upper_bound=clearance)
            # With ``k`` as an array, the results have two axes also if ``count`` is 1. A neighbour
            # beyond the clearance has the distance inf and the index len(points).
            others = np.isfinite(distance)
            more_in_reach = others[:, -1] & (count < len(points))
            if contact is not None:
                offsets = points[np.minimum(index, len(points) - 1)] - positions[pending, None]
                others &= ~contact.are_on_surface(pending, offsets)
            nearest[pending] = np.where(others, distance, np.inf).min(axis=1)
            # More neighbours are examined if all of these belong to the mounting surface.
            pending = pending[more_in_reach & ~others.any(axis=1)]
            count *= 4
        return Check('keep_clear', nearest < clearance - DISTANCE_TOLERANCE_M, lambda k: (
            f'found {nearest[k]:.2f} m to the nearest surface, walls up to the ceiling included; '
            f'expected at least {clearance:.2f} m (keep_clear); move it away'))

    def _obstacles_among(self, points: np.ndarray) -> cKDTree:
        """Return a search tree of the obstacles on the floor below the cameras, from above."""
        height = points[:, 2] - self.floors.under(points)
        # Points this near to the floor are no obstacles, for example those of skirting boards.
        # Points this near to the height of the cameras are none either.
        gap_m = 0.15
        obstacles = points[(height > gap_m) & (height < self.rig.mount.heights[1] - gap_m), :2]
        # One point in each small cell is enough.
        cell_m = 0.02
        return cKDTree(cell_m * np.unique(np.rint(obstacles / cell_m), axis=0))

    @cached_property
    def _obstacle_tree(self) -> cKDTree:
        """Return the search tree of the obstacles in the scene."""
        return self._obstacles_among(self.scene.points)

    def _footprint_check(self, positions: np.ndarray, obstacles: cKDTree) -> Check:
        """Check that there are no obstacles within the footprint of a tripod."""
        radius = self.rig.mount.footprint
        # The distance is inf if there is no obstacle within the radius.
        distance, _ = obstacles.query(positions[:, :2], distance_upper_bound=radius)
        return Check('mount.footprint', np.isfinite(distance), lambda k: (
            f'found something that stands {distance[k]:.2f} m from the place below it; expected '
            f'floor within {radius:g} m (mount.footprint); move it away'))

    def _mount_checks(self, positions: np.ndarray, contact: Contact | None) -> Iterator[Check]:
        """Check the height, and that there is a surface to mount the camera on."""
        on, heights, _ = self.rig.mount
        if heights is not None:
            low, high = heights
            height = positions[:, 2] - self.floors.under(positions)
            expected = f'{low:.2f}' + (f' to {high:.2f}' if high > low else '')
            outside = (height < low - MOUNT_TOLERANCE) | (height > high + MOUNT_TOLERANCE)
            yield Check('mount.height', outside, lambda k: (
                f'found {height[k]:.2f} m above the floor; expected {expected} m (mount.height); '
                'raise or lower it'))
        if contact is not None:
            mounted = contact.on
            if on == 'ceiling':
                # With a given height, cameras hang lower, on rods.
                gap = self.surface.height_above(positions[:, :2]) - positions[:, 2]
                mounted = (gap > 0.0) & (gap <= (MAX_MOUNT_GAP_M if heights is None else np.inf))
            surface = 'wall' if on == 'walls' else on
            location = 'above it' if on == 'ceiling' and heights is not None else (
                f'within {MAX_MOUNT_GAP_M:g} m')
            yield Check('mount.on', ~mounted, lambda k: (
                f'found no {surface} {location} (mount.on); expected one that {self.scene.name} '
                'shows; mount it there'))

    def _heading_checks(self, poses: np.ndarray, models: Sequence[CameraModel | None]
                        ) -> Iterator[Check]:
        """Check pitch, and roll if the rig's document has any, of cameras that have a heading."""
        if poses.shape[1] == 3:
            return
        aimed = np.array([model is None or not model.omnidirectional for model in models],
                         dtype=bool)
        low, high = self.rig.pitch
        pitch, roll = poses[:, 4], poses[:, 5]
        outside = aimed & ((pitch < low - MOUNT_TOLERANCE) | (pitch > high + MOUNT_TOLERANCE))
        yield Check('pitch', outside, lambda k: (
            f'found a pitch of {np.rad2deg(pitch[k]):.0f} degrees; expected '
            f'{np.rad2deg(low):.0f} to {np.rad2deg(high):.0f} (pitch); tilt it'))
        if 'roll' not in self.rig.document.data:
            return
        rolls = np.array(self.rig.rolls)
        # Differences of angles are wrapped to -180 up to 180 degrees.
        deviation = np.abs((roll[:, None] - rolls + np.pi) % (2.0 * np.pi) - np.pi).min(axis=1)
        offered = ' or '.join(f'{angle:.0f}' for angle in np.rad2deg(rolls))
        # Brackets are turned by hand, so the roll may deviate by 10 degrees.
        yield Check('roll', aimed & (deviation > np.deg2rad(10.0)), lambda k: (
            f'found a roll of {np.rad2deg(roll[k]):.0f} degrees; expected {offered} (roll); turn '
            'it about its viewing direction'))

    def _spacing_message(self, distance: float, other: str) -> str:
        """Return the message that a camera is too near to the other one with a given name."""
        return (f'found {distance:.2f} m to {other}; expected at least {self.rig.spacing:.2f} m '
                '(spacing); move one of the two')


def floor_space(scene: Scene, rig: Rig, top: float) -> FreePlane:
    """
    Return the positions where cameras of a rig have floor below them.

    :param scene: the room.
    :param rig: the cameras and their mount.
    :param top: z of the top of the room, metres, map frame.
    """
    # The highest floor, so that it is below the cameras as well.
    floor = floors_of(scene).levels[-1].z
    max_height = top - floor if rig.mount.heights is None else rig.mount.heights[1]
    # Floor is searched for among the points below this height only. The height is at least a
    # metre, so that there are such points below low cameras too.
    return FreePlane.of(scene.points, floor + max(max_height, 1.0), len(rig.cameras), margin=0.0,
                        clearance=0.0)


def _place_text(position: np.ndarray) -> str:
    """Return a position (3,), metres, as text for messages."""
    return '(' + ', '.join(f'{value:.2f}' for value in position) + ')'


def _checked_poses(poses: np.ndarray) -> np.ndarray:
    """Return poses as float64; raise ValueError if they are not (M, 3) or (M, 6) and finite."""
    poses = np.asarray(poses, dtype=np.float64)
    if poses.ndim != 2 or poses.shape[1] not in (3, 6) or not np.isfinite(poses).all():
        raise ValueError(f'poses: found shape {poses.shape}; expected (M, 6): x, y, z, yaw, '
                         'pitch, roll, or (M, 3), all finite')
    return poses


def satisfies_spacing(places: np.ndarray, others: np.ndarray, spacing: float) -> np.ndarray:
    """
    Return whether positions are far enough from all of some cameras.

    :param places: (M, 3), M positions, metres.
    :param others: (C, 3), the positions of C cameras, metres.
    :param spacing: the least distance, metres.
    :returns: (M,) bool.
    """
    if spacing <= 0.0 or len(others) == 0:
        return np.ones(len(places), dtype=bool)
    distance = np.linalg.norm(places[:, None] - others[None], axis=2)
    return (distance >= spacing).all(axis=1)
