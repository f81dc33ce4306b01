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
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.rig.free_plane import CELL_M, FreePlane
from ocp_ros.rig.mounts import headings_of, MERGED_M, MountPlaces, places_in, spread
from ocp_ros.rig.rig_file import Rig
from ocp_ros.rig.structure import (
    Air,
    ceiling_of,
    Contact,
    floor_height,
    MAX_MOUNT_GAP_M,
    MountSurface,
    STAND_OFF,
    walls_of,
)
from ocp_ros.rig.zones import nearest_of
from ocp_ros.scenes.scene import Scene
from ocp_ros.util.settings import ConfigurationError
from scipy.spatial import cKDTree

#: Metres of rounding, which must not matter for an exact mount.
ROUNDING_M = 1e-5
#: Metres by which distances may fall short.
DISTANCE_TOLERANCE_M = 0.001
#: Metres and radians by which the height and the pitch of a camera may be off.
MOUNT_TOLERANCE = 0.01
#: Radians: steps of yaw and pitch for a dense grid.
DENSE = np.deg2rad((15.0, 9.5))
#: The name in messages of the constraint that a ball can be moved to the camera.
FREE_SPACE = 'free space'
#: The name in messages of the constraint that there is floor.
FLOOR = 'the floor'


class Check(NamedTuple):
    """
    One constraint, checked for several cameras.

    :ivar name: the name of the constraint in the message that no position is feasible.
    :ivar broken: (M,) bool, whether each camera violates the constraint.
    :ivar says: returns the message about a violation, given the number of the camera.
    """

    name: str
    broken: np.ndarray
    says: Callable[[int], str]


class FeasibleRegion:
    """
    Check whether cameras satisfy the constraints of a rig in a room.

    :param scene: the room.
    :param rig: the cameras and their constraints.
    :param top: the least z of the top of the room, metres: the cameras' own height is air, even if
        cameras that look down do not see above themselves.
    :raises ConfigurationError: if a height, a camera in place or the mount does not fit the room.
    """

    def __init__(self, scene: Scene, rig: Rig, top: float | None = None) -> None:
        self.scene, self.rig = scene, rig
        self.floor = floor_height(scene)
        self.top = max(float(scene.bounds[1, 2]), -np.inf if top is None else top)
        self._check_heights()
        self.space = floor_space(scene, rig, self.floor, self.top)
        self.air = Air(scene, self.space)
        self.surface = self._find_surface()
        self._tree = cKDTree(scene.points)
        for fixed in rig.fixed:
            position = fixed.pose[:3]
            if (np.clip(position, scene.bounds[0] - 1.0, scene.bounds[1] + 1.0) != position).any():
                raise ConfigurationError(
                    f'{fixed.where}: found a camera at {_place(position)}, outside {scene.name}; '
                    f'expected one in the box from {_place(scene.bounds[0])} to '
                    f'{_place(scene.bounds[1])}; correct its position')

    def _check_heights(self) -> None:
        """Refuse heights that the room does not have."""
        mount, document, height = self.rig.mount, self.rig.document, self.top - self.floor
        if mount.heights is not None and mount.heights[0] >= height:
            given = 'height' in document.data.get('mount', {})
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

    def candidates(self, model: CameraModel, most: int) -> np.ndarray:
        """
        Return feasible candidate poses for a search.

        :param model: the camera.
        :param most: the largest number of poses, above 0. Positions are spread evenly, each with
            all headings, or with some headings if there would be too few positions.
        :returns: (M, 6) metres, map frame, and radians.
        :raises ConfigurationError: if there is no place where the camera may hang.
        """
        # Steps of yaw and pitch for a few poses.
        headings = headings_of(self.rig, model, *np.deg2rad((30.0, 19.0)))
        # Several cameras find room among 48 positions.
        places, headings, _ = self._poses(
            model, headings, max(most, min(48, most) * len(headings)))
        poses = np.concatenate([np.repeat(places[:, None], headings.shape[1], axis=1), headings],
                               axis=2).reshape(-1, 6)
        count = min(most, len(poses))
        return poses[np.arange(count) * len(poses) // count]

    def pose_grid(self, model: CameraModel, step: float, most: int
                  ) -> tuple[np.ndarray, np.ndarray, float]:
        """
        Return a dense grid of feasible poses.

        :param model: the camera.
        :param step: metres between positions; half of it for cameras with a single heading.
        :param most: the largest number of poses; positions are farther apart if there would be
            more.
        :returns: positions (P, 3), metres, map frame, headings (P, H, 3), radians, and the largest
            distance of a feasible position from the nearest of these, metres.
        :raises ConfigurationError: if there is no place where the camera may hang.
        """
        headings = headings_of(self.rig, model, *DENSE)
        return self._poses(model, headings, most, step if len(headings) > 1 else 0.5 * step)

    def _poses(self, model: CameraModel, headings: np.ndarray, most: int, apart: float = MERGED_M
               ) -> tuple[np.ndarray, np.ndarray, float]:
        """Spread positions, with headings (H, 3); see :meth:`pose_grid`."""
        places, away = self.places(model, max(most // len(headings), 1), apart)
        turned = np.repeat(headings[None], len(places.positions), axis=0)
        turned[..., 0] += places.inwards[:, None]
        return places.positions, turned, away

    def places(self, model: CameraModel, most: int, apart: float = MERGED_M
               ) -> tuple[MountPlaces, float]:
        """
        Spread feasible positions of a camera, independently of its yaw.

        :param model: the camera.
        :param most: the largest number of positions, above 0.
        :param apart: metres; positions nearer to a chosen one are left out.
        :returns: positions, and the largest distance of other feasible ones from the nearest of
            these, metres.
        :raises ConfigurationError: if there is no place where the camera may hang.
        """
        offered = places_in(self.rig, self.scene, self.space, self.surface)
        if self.rig.keep_in and len(offered.positions) == 0:
            raise self.rig.document.error(
                ('keep_in',), f'no place of the mount {self.rig.mount.on} in any zone over the '
                f'floor of {self.scene.name}', 'one at least', 'correct the corners of the zones, '
                'or the mount or its height')
        # Use an allowed pitch and roll, so that only the position is checked.
        level = np.zeros((len(offered.positions), 6))
        level[:, :3], level[:, 4] = offered.positions, np.clip(0.0, *self.rig.pitch)
        level[:, 5] = self.rig.rolls[0]
        good = self.allowed(level, model)
        if not good.any():
            raise self.rig.document.error(
                ('mount',), f'no feasible pose in {self.scene.name}'
                f'{self._bites(level, model)}', 'one at least', 'change that, or the mount or '
                'its height')
        chosen, away = spread(offered.positions[good], most, apart)
        return MountPlaces(*(part[good][chosen] for part in offered)), away

    def _bites(self, poses: np.ndarray, model: CameraModel) -> str:
        """Return the constraint that alone rejects the most of some infeasible poses."""
        if len(poses) == 0:
            return ': the mount has none above the floor'
        checks = list(self._checks(poses, [model] * len(poses), ROUNDING_M))
        count = np.sum([check.broken for check in checks], axis=0)
        # Ties are decided by the number of all poses that violate the constraint.
        bites = max(checks, key=lambda check: (np.count_nonzero(check.broken & (count == 1)),
                                               np.count_nonzero(check.broken)))
        number = np.count_nonzero(bites.broken)
        if bites.name == FREE_SPACE and number == len(poses):
            return ': no candidate connects to free space (several storeys or stray points?)'
        return f': {bites.name} rejects {number} of {len(poses)} candidates'

    def onto_mount(self, positions: np.ndarray) -> np.ndarray:
        """
        Move positions to the nearest positions on the mount, which may violate other constraints.

        :param positions: (M, 3) metres, map frame.
        :returns: (M, 3); unchanged if no ceiling or wall is near.
        """
        on, heights, _ = self.rig.mount
        moved = (nearest_of(self.rig.keep_in, positions, self.floor) if self.rig.keep_in
                 else positions.copy())
        if on == 'walls':
            contact = self.surface.at(moved)
            off = np.where(contact.on, STAND_OFF - contact.distances, 0.0)
            moved += off[:, None] * contact.normals
        if heights is None:
            z = self.surface.height_above(moved[:, :2]) - STAND_OFF
            moved[:, 2] = np.where(np.isfinite(z), z, moved[:, 2])
        else:
            moved[:, 2] = np.clip(moved[:, 2], *(self.floor + np.array(heights)))
        return moved

    def broken(self, poses: np.ndarray, cameras: Sequence[int] | None = None) -> list[str]:
        """
        Return the constraint violations of a placement.

        :param poses: (K, 6) metres, map frame, and radians; (K, 3) where no camera has a heading.
        :param cameras: the camera of the rig for each row; the first K by default.
        :returns: one sentence for each violation.
        :raises ValueError: for another shape, or more rows than cameras.
        """
        poses = _checked(poses)
        cameras = range(len(poses)) if cameras is None else cameras
        if len(poses) > len(self.rig.cameras):
            raise ValueError(f'poses: found {len(poses)} cameras; expected at most '
                             f'{len(self.rig.cameras)}, those of the rig that are to be placed')
        chosen = [self.rig.cameras[camera] for camera in cameras]
        # The known floor may end up to one cell before the walls.
        checks = list(self._checks(poses, [camera.model for camera in chosen], CELL_M))
        found = [f'{camera.name}: {check.says(k)}' for k, camera in enumerate(chosen)
                 for check in checks if check.broken[k]]
        for k, camera in enumerate(chosen):
            for other in range(k):
                away = float(np.linalg.norm(poses[k, :3] - poses[other, :3]))
                if away < self.rig.spacing - DISTANCE_TOLERANCE_M:
                    found.append(f'{camera.name}: {self._too_near(away, chosen[other].name)}')
        return found

    def allowed(self, poses: np.ndarray, model: CameraModel | None = None,
                unknown: bool = False) -> np.ndarray:
        """
        Return which poses of one camera are feasible; distances to other cameras are not checked.

        A feasible pose violates no constraint. Only :meth:`broken` accepts positions up to a cell
        off the known floor, since that ends before the walls. A search must not use this
        tolerance: behind glass walls, which scans do not show, a camera would seem to see much.

        :param poses: (M, 6) metres, map frame, and radians, or (M, 3).
        :param model: the camera; by default one with a limited field of view.
        :param unknown: whether poses without known floor or free space are feasible.
        :returns: (M,) bool.
        """
        poses = _checked(poses)
        checks = self._checks(poses, [model] * len(poses), ROUNDING_M)
        return ~np.any([check.broken for check in checks
                        if not (unknown and check.name in (FLOOR, FREE_SPACE))], axis=0)

    def clear(self, positions: np.ndarray, points: np.ndarray) -> np.ndarray:
        """
        Return where a camera keeps its distance from points that the scene may not contain yet.

        :param positions: (M, 3) metres.
        :param points: (N, 3) float32, metres; points of the surface that a camera is mounted on
            are ignored.
        :returns: (M,) bool.
        """
        contact = None if self.surface is None else self.surface.at(positions)
        return ~self._too_close(positions, contact, points, cKDTree(points)).broken

    def _checks(self, poses: np.ndarray, models: Sequence[CameraModel | None], beyond: float
                ) -> Iterator[Check]:
        """Yield all checks of single cameras; ``beyond`` is the floor's tolerance, metres."""
        positions = poses[:, :3]
        contact = None if self.surface is None else self.surface.at(positions)
        yield (outside := self._outside(positions, contact, beyond))
        closed = self.air.closed(positions) & ~outside.broken
        yield Check(FREE_SPACE, closed, lambda k: (
            'found a position inside furniture or behind it; expected one in free space; move it '
            'there'))
        yield self._too_close(positions, contact, self.scene.points, self._tree)
        yield from self._off_mount(positions, contact)
        if self.rig.mount.footprint:
            yield self._on_furniture(positions)
        for number, zone in enumerate(self.rig.keep_out, start=1):
            inside = zone.contains(positions, self.floor)
            yield Check(f'keep-out zone {number}', inside, lambda k, number=number: (
                f'found a position in keep-out zone {number}; expected one outside; '
                'move it out'))
        if self.rig.keep_in:
            out = ~np.any([zone.contains(positions, self.floor) for zone in self.rig.keep_in],
                          axis=0)
            away = np.zeros(len(positions))
            away[out] = np.linalg.norm(positions[out] - nearest_of(
                self.rig.keep_in, positions[out], self.floor), axis=1)
            allowed = MOUNT_TOLERANCE if beyond > ROUNDING_M else 0.0
            yield Check('keep_in', away > allowed, lambda k: (
                f'found {_place(positions[k])}, {away[k]:.2f} m outside of the keep_in zones; '
                'expected a position in one; move it there'))
        yield from self._turned(poses, models)
        for fixed in self.rig.fixed:
            away = np.linalg.norm(positions - fixed.pose[:3], axis=1)
            near = away < self.rig.spacing - DISTANCE_TOLERANCE_M
            yield Check('spacing', near, lambda k, away=away, fixed=fixed: (
                self._too_near(away[k], fixed.camera.name)))

    def _outside(self, positions: np.ndarray, contact: Contact | None, beyond: float) -> Check:
        """Check that there is floor below or, on walls, in front, and that z is in the room."""
        places, z = positions[:, :2], positions[:, 2]
        if self.rig.mount.on == 'walls':
            # There has to be floor 0.3 m in front of the wall.
            places = places + 0.3 * contact.normals[:, :2]
        away = np.linalg.norm(self.space.inside(places) - places, axis=1)
        wrong = (away > beyond) | (z < self.floor) | (z > self.top)
        return Check(FLOOR, wrong, lambda k: (
            f'found {_place(positions[k])}, which is not above floor that {self.scene.name} '
            'shows; expected a position in the room and not in furniture; move it there'))

    def _too_close(self, positions: np.ndarray, contact: Contact | None, points: np.ndarray,
                   tree: cKDTree) -> Check:
        """Check the distance to all surfaces except the one that a camera is mounted on."""
        least = self.rig.keep_clear
        nearest, left = np.full(len(positions), np.inf), np.arange(len(positions))
        # Some neighbours may belong to the surface that the camera is mounted on.
        count = 1 if contact is None else 16
        while len(left) and len(points):
            count = min(count, len(points))
            away, index = tree.query(
                positions[left], np.arange(1, count + 1), distance_upper_bound=least)
            others = np.isfinite(away)
            full = others[:, -1] & (count < len(points))
            if contact is not None:
                ways = points[np.minimum(index, len(points) - 1)] - positions[left, None]
                others &= ~contact.own(left, ways)
            nearest[left] = np.where(others, away, np.inf).min(axis=1)
            # All neighbours so far belong to the mounting surface: examine more.
            left, count = left[full & ~others.any(axis=1)], 4 * count
        return Check('keep_clear', nearest < least - DISTANCE_TOLERANCE_M, lambda k: (
            f'found {nearest[k]:.2f} m to the nearest surface; expected at least {least:.2f} m '
            '(keep_clear); move it away'))

    @cached_property
    def _standing(self) -> cKDTree:
        """Return the points of obstacles on the floor below the cameras, seen from above."""
        points = self.scene.points
        above = points[:, 2] - self.floor
        # A point must be higher above the floor to count as an obstacle there: skirting boards do
        # not.
        skirting_m = 0.15
        low = points[(above > skirting_m) & (above < self.rig.mount.heights[1] - skirting_m), :2]
        # One point in each small cell is enough.
        merged_m = 0.02
        return cKDTree(merged_m * np.unique(np.rint(low / merged_m), axis=0))

    def _on_furniture(self, positions: np.ndarray) -> Check:
        """Check that there are no obstacles within the footprint of a tripod."""
        radius = self.rig.mount.footprint
        away, _ = self._standing.query(positions[:, :2], distance_upper_bound=radius)
        return Check('mount.footprint', np.isfinite(away), lambda k: (
            f'found something that stands {away[k]:.2f} m from the place below it; expected floor '
            f'within {radius:g} m (mount.footprint); move it away'))

    def _off_mount(self, positions: np.ndarray, contact: Contact | None) -> Iterator[Check]:
        """Check the height, and that there is a surface to mount the camera on."""
        on, heights, _ = self.rig.mount
        if heights is not None:
            low, high = heights
            above = positions[:, 2] - self.floor
            expected = f'{low:.2f}' + (f' to {high:.2f}' if high > low else '')
            wrong = (above < low - MOUNT_TOLERANCE) | (above > high + MOUNT_TOLERANCE)
            yield Check('mount.height', wrong, lambda k: (
                f'found {above[k]:.2f} m above the floor; expected {expected} m (mount.height); '
                'raise or lower it'))
        if contact is not None:
            on_it = contact.on
            if on == 'ceiling':
                # With a given height, cameras hang lower, on rods.
                below = self.surface.height_above(positions[:, :2]) - positions[:, 2]
                on_it = (below > 0.0) & (below <= (MAX_MOUNT_GAP_M if heights is None else np.inf))
            surface = 'wall' if on == 'walls' else on
            near = 'above it' if on == 'ceiling' and heights is not None else (
                f'within {MAX_MOUNT_GAP_M:g} m')
            yield Check('mount.on', ~on_it, lambda k: (
                f'found no {surface} {near} (mount.on); expected one that {self.scene.name} '
                'shows; mount it there'))

    def _turned(self, poses: np.ndarray, models: Sequence[CameraModel | None]) -> Iterator[Check]:
        """Check pitch, and roll if the file gives any, of cameras that have a heading."""
        if poses.shape[1] == 3:
            return
        aimed = np.array([model is None or not model.omnidirectional for model in models],
                         dtype=bool)
        (low, high), pitch, roll = self.rig.pitch, poses[:, 4], poses[:, 5]
        wrong = aimed & ((pitch < low - MOUNT_TOLERANCE) | (pitch > high + MOUNT_TOLERANCE))
        yield Check('pitch', wrong, lambda k: (
            f'found a pitch of {np.rad2deg(pitch[k]):.0f} degrees; expected '
            f'{np.rad2deg(low):.0f} to {np.rad2deg(high):.0f} (pitch); tilt it'))
        if 'roll' not in self.rig.document.data:
            return
        rolls = np.array(self.rig.rolls)
        away = np.abs((roll[:, None] - rolls + np.pi) % (2.0 * np.pi) - np.pi).min(axis=1)
        offered = ' or '.join(f'{angle:.0f}' for angle in np.rad2deg(rolls))
        # Brackets are turned by hand: the roll may be off by 10 degrees.
        yield Check('roll', aimed & (away > np.deg2rad(10.0)), lambda k: (
            f'found a roll of {np.rad2deg(roll[k]):.0f} degrees; expected {offered} (roll); turn '
            'it about its viewing direction'))

    def _too_near(self, away: float, other: str) -> str:
        """Return the message that two cameras are too near to each other."""
        return (f'found {away:.2f} m to {other}; expected at least {self.rig.spacing:.2f} m '
                '(spacing); move one of the two')


def floor_space(scene: Scene, rig: Rig, floor: float, top: float) -> FreePlane:
    """
    Return the space where cameras of a rig have floor below them.

    :param floor: z of the floor, metres, map frame.
    :param top: z of the top of the room, metres, map frame.
    """
    high = top - floor if rig.mount.heights is None else rig.mount.heights[1]
    # Floor is searched for from at least a metre above it.
    return FreePlane.of(scene.points, floor + max(high, 1.0), len(rig.cameras), 0.0,
                        clearance=0.0)


def _place(position: np.ndarray) -> str:
    """Return a position as text for messages."""
    return '(' + ', '.join(f'{value:.2f}' for value in position) + ')'


def _checked(poses: np.ndarray) -> np.ndarray:
    """Return poses as (M, 3) or (M, 6) float64, all finite."""
    poses = np.asarray(poses, dtype=np.float64)
    if poses.ndim != 2 or poses.shape[1] not in (3, 6) or not np.isfinite(poses).all():
        raise ValueError(f'poses: found shape {poses.shape}; expected (M, 6): x, y, z, yaw, '
                         'pitch, roll, or (M, 3), all finite')
    return poses


def satisfies_spacing(places: np.ndarray, others: np.ndarray, spacing: float) -> np.ndarray:
    """
    Return which positions are far enough from all cameras.

    :param places: (M, 3) metres.
    :param others: (C, 3) metres, the positions of the cameras.
    :param spacing: metres.
    :returns: (M,) bool.
    """
    if spacing <= 0.0 or len(others) == 0:
        return np.ones(len(places), dtype=bool)
    away = np.linalg.norm(places[:, None] - others[None], axis=2)
    return (away >= spacing).all(axis=1)
