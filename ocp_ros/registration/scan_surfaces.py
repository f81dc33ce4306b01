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
Surfaces of a scan for registration, and which sides of them were scanned.

If a panel was scanned from behind, its scanned face differs from the face that a camera in front
measures by the thickness of the panel, which would displace the camera. Normals show which side
was scanned, and so do the places where the scanner stood, or may have stood. Besides, two kinds of
surfaces are used as one-sided: those with nothing behind them in the scan, such as outer walls,
floor and ceiling, and those with both sides in the scan. Others count less.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, Pose
from ocp_ros.geometry.clouds import voxel_downsample, voxel_size_for
from ocp_ros.geometry.normals import edge_aware_normals
from ocp_ros.geometry.packed_bits import Subset
from ocp_ros.geometry.visibility import FAST, SurfelVisibility
from ocp_ros.registration.alignment import Surfaces
from ocp_ros.scenes.neighbours import nearest
from ocp_ros.scenes.scene import PLANE_NEIGHBOURS, Scene
from ocp_ros.simulation.scan_evidence import only_sides
from scipy.spatial import cKDTree


class SurfacesInView(NamedTuple):
    """
    The surfaces of a scan in the view of a camera.

    :ivar sided: surfaces whose side towards the camera was certainly scanned.
    :ivar every: the surfaces of ``sided``, and surfaces whose other side may have been scanned
        instead.
    """

    sided: Surfaces
    every: Surfaces


class ScanSurfaces:
    """
    A scan for registration, thinned to N points.

    :param scene: the room, as dense as available.
    :ivar points: (N, 3) float64, metres, map frame.
    :ivar normals: (N, 3) float64 unit vectors; towards free space if ``oriented``, otherwise of
        either sign.
    :ivar oriented: whether the normals show which side of a surface was scanned.
    """

    def __init__(self, scene: Scene) -> None:
        sign = inward_sign(scene)
        self.oriented = sign != 0.0
        edge = voxel_size_for(scene.points, 100_000)
        if self.oriented:
            # Six groups, by the main axis of the normal and its sign. Both sides of a thin panel
            # share voxels, but belong to different groups. Groups with too few points to fit
            # planes are left out.
            normals = sign * scene.normals
            axis = np.abs(normals).argmax(axis=1)
            group = 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] > 0.0)
            parts = [_thinned(scene.points[group == k], edge, normals[group == k])
                     for k in range(6) if np.count_nonzero(group == k) > PLANE_NEIGHBOURS]
        else:
            parts = [_thinned(scene.points, edge)]
        self._scans = scene.scans
        # ``_pitch``: (N,) metres, the edge of the square of surface that each point stands for.
        self.points, self.normals, self._pitch = map(np.concatenate, zip(*parts))

    @cached_property
    def fine(self) -> Surfaces:
        """Return the surfaces of all points."""
        return Surfaces.of(self.points, self.normals, self.oriented)

    @cached_property
    def coarse(self) -> Surfaces:
        """Return the surfaces of a random subset of the points."""
        subset = np.random.default_rng(0).permutation(len(self.points))[:12_000]
        return Surfaces.of(self.points[subset], self.normals[subset], self.oriented)

    @cached_property
    def _visibility(self) -> SurfelVisibility:
        """Return the visibility of the points as surfels."""
        # The empty array is for positions in the air, which are not needed here.
        return SurfelVisibility(self.points.astype(np.float32), self.normals.astype(np.float32),
                                self._pitch, np.empty((0, 3), dtype=np.float32), FAST)

    @cached_property
    def _sides(self) -> np.ndarray:
        """Return the side of points that was scanned: (N,), 1 along the normal, -1, 0 unknown."""
        return only_sides(Scene(
            self.points.astype(np.float32), normals=self.normals.astype(np.float32),
            scans=self._scans), self._visibility)

    @cached_property
    def _two_sided(self) -> np.ndarray:
        """Return whether points have a parallel surface: (2, N) bool, behind and in front."""
        # Objects with two sides are at most 0.4 m thick.
        return np.stack([self._have_other_side(sign, max_m=0.4) for sign in (-1.0, 1.0)])

    @cached_property
    def _thin(self) -> np.ndarray:
        """Return whether points belong to objects too thin for fused scans: (N,) bool."""
        # A fused scan mixes both sides of objects thinner than 0.15 m.
        thin = self._have_other_side(-1.0, max_m=0.15)
        if not thin.any():
            return thin
        # If one face has erased the other in the fusion, remnants of the other are left around
        # holes. So points near thin objects with a similar normal count as thin as well.
        distance, index = cKDTree(self.points[thin]).query(
            self.points, k=4, distance_upper_bound=0.3)
        # Without such a point, the tree returns the distance inf and an invalid index.
        found = np.isfinite(distance)
        normals = self.normals[thin][np.where(found, index, 0)]
        similar = np.einsum('ij,ikj->ik', self.normals, normals) > 0.9
        return thin | (found & similar).any(axis=1)

    def _have_other_side(self, sign: float, max_m: float) -> np.ndarray:
        """
        Return whether points have a parallel surface near them along their normals: (N,) bool.

        :param sign: 1 to search along the normals, -1 against them.
        :param max_m: the largest distance of the surface, metres.
        """
        step_m = 0.04
        # Search in balls without gaps along the normal; the first one excludes the point itself.
        radius = max(0.5 * step_m, 1.5 * float(np.median(self._pitch)))
        with_surface = np.zeros(len(self.points), dtype=bool)
        for offset in np.arange(0.5 * step_m + radius, max_m, step_m):
            distance, index = self.fine.tree.query(self.points + sign * offset * self.normals,
                                                   distance_upper_bound=radius)
            found = np.isfinite(distance)
            cosine = np.einsum('ij,ij->i', self.normals[found], self.normals[index[found]])
            # Normals towards free space are opposite on the two sides; others have either sign.
            with_surface[found] |= (-cosine if self.oriented else np.abs(cosine)) > 0.9
        return with_surface

    def in_view(self, pose: Pose, model: CameraModel) -> SurfacesInView:
        """
        Return the surfaces that a camera near a pose can be registered to, in all directions.

        :param pose: the pose, accurate to a few decimetres and degrees.
        :param model: the camera model, for its range.
        """
        seen = Subset.none(self._visibility.order)
        # The pose may be a few decimetres off, so the range is longer.
        omnidirectional = CameraModel(0.0, model.max_range + 0.5)
        self._visibility.look(pose, omnidirectional.lens, seen.bits)
        kept = seen.mask
        facing = np.einsum('ij,ij->i', pose.position - self.points, self.normals)
        if self.oriented:
            # A surface whose oriented normal faces the camera was scanned from that side.
            every = self._subset(kept & (facing > 0.0) & ~self._thin)
            return SurfacesInView(every, every)
        towards = self._sides * facing
        # A surface that was scanned from its other side alone is not the one in view.
        kept &= towards >= 0.0
        # The other side lies against the normal if the normal faces the camera, else along it.
        sided = (towards > 0.0) | np.where(facing > 0.0, *self._two_sided) | self._outermost_from(
            pose.position, np.sign(facing))
        return SurfacesInView(self._subset(kept & sided), self._subset(kept, sided))

    def _subset(self, kept: np.ndarray, is_sided: np.ndarray | None = None) -> Surfaces:
        """Return the surfaces of the points that ``kept`` (N,) marks; if none, a far point."""
        if not kept.any():
            # A point so far away has no matches.
            return Surfaces.of(np.full((1, 3), 1e6), np.array([[0.0, 0.0, 1.0]]), False)
        return Surfaces.of(self.points[kept], self.normals[kept], self.oriented,
                           None if is_sided is None else is_sided[kept])

    def _outermost_from(self, position: np.ndarray, sign: np.ndarray) -> np.ndarray:
        """
        Return whether points have no surface behind them, as seen from a position: (N,) bool.

        :param position: (3,) metres, map frame.
        :param sign: (N,) 1 for points whose normal points towards the position, -1 for others.
        """
        offsets = self.points - position
        distance = np.linalg.norm(offsets, axis=1)
        cell_deg = 6.0
        row = np.rad2deg(np.arcsin(offsets[:, 2] / np.maximum(distance, 1e-6))) // cell_deg
        column = np.rad2deg(np.arctan2(offsets[:, 1], offsets[:, 0])) // cell_deg
        # Rows are from -15 to 15 and columns from -30 to 30, so each pair has another number.
        cell = (row * 61.0 + column).astype(int) + 15 * 61 + 30
        # Of the points of a cell, in the order of their distances, the last one is assigned.
        order, last = np.argsort(distance), np.zeros(31 * 61, dtype=int)
        last[cell[order]] = order
        farthest = self.points[last[cell]]
        # How far the farthest point of its cell lies behind the plane of each point, metres.
        behind = -sign * np.einsum('ij,ij->i', farthest - self.points, self.normals)
        # Points are outermost if the farthest point of their cell is less than 10 cm behind their
        # plane.
        return behind < 0.1


def inward_sign(scene: Scene) -> float:
    """Return the factor that turns a scene's normals towards free space: 1, -1; 0 if unknown."""
    if scene.normals is None:
        return 0.0
    low, high = scene.bounds
    # A point this near to the bounding box belongs to an outermost surface.
    shell_m = 0.1
    outer = ((scene.points < low + shell_m) | (scene.points > high - shell_m)).any(axis=1)
    inward = np.einsum('ij,ij->i', scene.normals[outer], scene.bounds.mean(axis=0)
                       - scene.points[outer]) > 0.0
    share = inward.mean()
    # Normals count as consistent if more than this share of those of the outermost points point
    # into the room, or out of it.
    min_share = 0.8
    return 1.0 if share > min_share else -1.0 if share < 1.0 - min_share else 0.0


def _thinned(points: np.ndarray, edge: float, given_normals: np.ndarray | None = None
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Merge points in voxels.

    :param points: (N, 3) metres.
    :param edge: the edge of a voxel, metres.
    :param given_normals: (N, 3) vectors, to whose side the new normals point; None if unknown.
    :returns: M points (M, 3), metres, their normals (M, 3) and their pitch (M,), metres.
    """
    merged = voxel_downsample(points, edge).astype(np.float64)
    distance, neighbours = nearest(merged, min(PLANE_NEIGHBOURS, len(merged)))
    normals = edge_aware_normals(merged, neighbours).astype(np.float64)
    if given_normals is not None:
        wanted = given_normals[cKDTree(points).query(merged)[1]]
        # Flip the normals that point to the other side.
        normals *= np.where(np.einsum('ij,ij->i', wanted, normals) < 0.0, -1.0, 1.0)[:, None]
    # A disc up to the eighth neighbour has the area of the squares of eight points. An isolated
    # point is a speck, so its square is limited.
    pitch = distance[:, min(8, distance.shape[1] - 1)] * np.sqrt(np.pi / 8.0)
    return merged, normals, np.minimum(pitch, 4.0 * np.median(pitch)).astype(np.float32)
