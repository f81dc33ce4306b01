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
was scanned. Without normals, only two kinds of surfaces are used as one-sided: those with nothing
behind them in the scan, such as outer walls, floor and ceiling, and those with both sides in the
scan.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, Pose
from ocp_ros.geometry.normals import edge_aware_normals
from ocp_ros.geometry.packed_bits import Subset
from ocp_ros.geometry.visibility import FAST, SurfelVisibility
from ocp_ros.geometry.voxels import voxel_downsample, voxel_size_for
from ocp_ros.registration.alignment import Surfaces
from ocp_ros.scenes.neighbours import nearest
from ocp_ros.scenes.scene import PLANE_NEIGHBOURS, Scene
from scipy.spatial import cKDTree


class SurfacesInView(NamedTuple):
    """
    The surfaces of a scan in the view of a camera.

    :ivar sided: surfaces whose side towards the camera was scanned.
    :ivar every: also surfaces whose other side may have been scanned.
    """

    sided: Surfaces
    every: Surfaces


class ScanSurfaces:
    """
    A scan for registration.

    :param scene: the room, as dense as available.
    :ivar points: (N, 3) float64, metres, map frame.
    :ivar normals: (N, 3) float64 unit vectors; towards free space where they are ``oriented``.
    :ivar oriented: whether the normals show which side of a surface was scanned.
    """

    def __init__(self, scene: Scene) -> None:
        sign = inward_sign(scene)
        self.oriented = sign != 0.0
        edge = voxel_size_for(scene.points, 100_000)
        if self.oriented:
            # Both sides of a thin panel share voxels, but belong to different groups.
            normals = sign * scene.normals
            axis = np.abs(normals).argmax(axis=1)
            group = 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] > 0.0)
            parts = [_thinned(scene.points[group == k], edge, normals[group == k])
                     for k in range(6) if np.count_nonzero(group == k) > PLANE_NEIGHBOURS]
        else:
            parts = [_thinned(scene.points, edge)]
        self.points, self.normals, self._pitch = map(np.concatenate, zip(*parts))

    @cached_property
    def fine(self) -> Surfaces:
        """Return all points."""
        return Surfaces.of(self.points, self.normals, self.oriented)

    @cached_property
    def coarse(self) -> Surfaces:
        """Return a random subset of the points, from all parts of the room."""
        few = np.random.default_rng(0).permutation(len(self.points))[:12_000]
        return Surfaces.of(self.points[few], self.normals[few], self.oriented)

    @cached_property
    def _visibility(self) -> SurfelVisibility:
        """Return the visibility of the points."""
        return SurfelVisibility(self.points.astype(np.float32), self.normals.astype(np.float32),
                                self._pitch, np.empty((0, 3), dtype=np.float32), FAST)

    @cached_property
    def _two_sided(self) -> np.ndarray:
        """Return whether a similar surface is close behind or in front of points: (2, N) bool."""
        # The largest thickness of an object with two sides.
        thickness_m = 0.4
        return np.stack([self._backed(-1.0, thickness_m), self._backed(1.0, thickness_m)])

    @cached_property
    def _thin(self) -> np.ndarray:
        """Return which points belong to objects too thin for fused scans, (N,) bool."""
        # A fused scan mixes both sides of objects thinner than this.
        thin = self._backed(-1.0, 0.15)
        if not thin.any():
            return thin
        # If one face has erased the other in the fusion, remnants are left around holes.
        # Around thin parts the same face is not used.
        distance, index = cKDTree(self.points[thin]).query(
            self.points, k=4, distance_upper_bound=0.3)
        hit = np.isfinite(distance)
        normals = self.normals[thin][np.where(hit, index, 0)]
        alike = np.einsum('ij,ikj->ik', self.normals, normals) > 0.9
        return thin | (hit & alike).any(axis=1)

    def _backed(self, sign: float, thick: float) -> np.ndarray:
        """Return which points have a similar surface closely behind or in front of them, (N,)."""
        step_m = 0.04
        reach = max(0.5 * step_m, 1.5 * float(np.median(self._pitch)))
        found = np.zeros(len(self.points), dtype=bool)
        for away in np.arange(0.5 * step_m + reach, thick, step_m):
            distance, index = self.fine.tree.query(self.points + sign * away * self.normals,
                                                   distance_upper_bound=reach)
            hit = np.isfinite(distance)
            alike = np.einsum('ij,ij->i', self.normals[hit], self.normals[index[hit]])
            found[hit] |= (-alike if self.oriented else np.abs(alike)) > 0.9
        return found

    def in_view(self, pose: Pose, model: CameraModel) -> 'SurfacesInView':
        """
        Return the surfaces that a camera near a pose can be registered to.

        :param pose: the pose, accurate to a few decimetres and degrees.
        :param model: the camera model, for its range.
        """
        seen = Subset.none(self._visibility.order)
        around = CameraModel(0.0, model.max_range + 0.5)
        self._visibility.look(pose, around.lens, seen.bits)
        kept = seen.mask
        facing = np.einsum('ij,ij->i', pose.position - self.points, self.normals)
        if self.oriented:
            every = self._only(kept & (facing > 0.0) & ~self._thin)
            return SurfacesInView(every, every)
        sided = (np.where(facing > 0.0, *self._two_sided)
                 | self._last_seen_from(pose.position, np.sign(facing)))
        return SurfacesInView(self._only(kept & sided), self._only(kept))

    def _only(self, kept: np.ndarray) -> Surfaces:
        """Return the points that ``kept`` marks; if there are none, one that is out of reach."""
        if not kept.any():
            # Points this far away have no matches.
            return Surfaces.of(np.full((1, 3), 1e6), np.array([[0.0, 0.0, 1.0]]), False)
        return Surfaces.of(self.points[kept], self.normals[kept], self.oriented)

    def _last_seen_from(self, position: np.ndarray, sign: np.ndarray) -> np.ndarray:
        """Return which points have nothing behind them as seen from a position, (N,) bool."""
        way = self.points - position
        distance = np.linalg.norm(way, axis=1)
        cell_deg = 6.0
        row = np.rad2deg(np.arcsin(way[:, 2] / np.maximum(distance, 1e-6))) // cell_deg
        column = np.rad2deg(np.arctan2(way[:, 1], way[:, 0])) // cell_deg
        cell = np.unique(row * 1000.0 + column, return_inverse=True)[1]
        order = np.lexsort((distance, cell))
        ends = np.flatnonzero(np.append(np.diff(cell[order]) > 0, True))
        farthest = self.points[order[ends]][cell]
        behind = -sign * np.einsum('ij,ij->i', farthest - self.points, self.normals)
        # Hidden surfaces are at least 10 cm behind others.
        return behind < 0.1


def inward_sign(scene: Scene) -> float:
    """Return the factor that turns normals towards free space: 1, -1, or 0 if unknown."""
    if scene.normals is None:
        return 0.0
    low, high = scene.bounds
    # A surface this near to the bounding box is an outermost one.
    shell_m = 0.1
    outer = ((scene.points < low + shell_m) | (scene.points > high - shell_m)).any(axis=1)
    inward = np.einsum('ij,ij->i', scene.normals[outer], scene.bounds.mean(axis=0)
                       - scene.points[outer]) > 0.0
    share = inward.mean()
    # The share of the outermost surfaces whose normals point inwards (or outwards) if the normals
    # of a file are consistent.
    min_share = 0.8
    return 1.0 if share > min_share else -1.0 if share < 1.0 - min_share else 0.0


def _thinned(points: np.ndarray, edge: float, signs: np.ndarray | None = None
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Merge points in voxels; return them, their normals with given signs, and their pitch."""
    merged = voxel_downsample(points, edge).astype(np.float64)
    distance, neighbours = nearest(merged, min(PLANE_NEIGHBOURS, len(merged)))
    normals = edge_aware_normals(merged, neighbours).astype(np.float64)
    if signs is not None:
        own = signs[cKDTree(points).query(merged)[1]]
        normals *= np.where(np.einsum('ij,ij->i', own, normals) < 0.0, -1.0, 1.0)[:, None]
    pitch = distance[:, min(8, distance.shape[1] - 1)] * np.sqrt(np.pi / 8.0)
    return merged, normals, np.minimum(pitch, 4.0 * np.median(pitch)).astype(np.float32)
