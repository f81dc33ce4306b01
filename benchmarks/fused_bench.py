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
Measure how well a scan that was fused of noisy frames tells what another frame sees.

A depth camera scans generated rooms in the hand; then frames of another walk are predicted from
the points of the scan. Truth is the mesh of the room that was scanned, without noise: a point of
the scan at the depth z in a frame is visible if the room's surface is no nearer than z minus 5 cm,
the depth being taken along the ray through the point itself, since one pixel of a slanted floor
may span more than that. Only points within the frame and its range count. Ray casting of the
fused mesh is what a method could reach that knows the surface between the points: noise, and
what was not scanned and hides nothing, keep it from 1.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

from benchmarks.engine_bench import (
    agreement,
    best_radius_only,
    by_points,
    confusion,
    FIRST_ROOM,
    RADII,
    removal,
)
from benchmarks.fused_scan import (
    CAMERA,
    exact_depth,
    FRAMES,
    hand_held_path,
    scan_by_hand,
)
import numpy as np
from ocp_ros.geometry.cameras import Pose
from ocp_ros.geometry.packed_bits import Subset
from ocp_ros.geometry.shadow_maps import in_reach
from ocp_ros.geometry.visibility import CubeVisibility, FAST, FINE, PAPER, SurfelVisibility
from ocp_ros.rooms.generator import mesh_of, plan_of
from ocp_ros.scenes.mesh_rays import MeshRays
from ocp_ros.scenes.scene import Scene
from rich.console import Console
from rich.progress import track

#: Metres that a point of a scan may lie behind the surface that it belongs to.
TOLERANCE = 0.05
LENS = CAMERA.lens
NOWHERE = np.empty((0, 3), dtype=np.float32)

#: (pose) -> the points that a camera sees there, (N,) bool; of what is outside the frame, any.
Look = Callable[[Pose], np.ndarray]


class FusedExtent(NamedTuple):
    """
    How much is measured.

    :param points: most points that scans are thinned to.
    :param rooms: how many rooms are scanned.
    :param frames: how many frames are fused of each, at most.
    :param views: how many frames are predicted, at most.
    """

    points: tuple[int, ...] = (10_000, 20_000, 50_000, 100_000)
    rooms: int = 8
    frames: int = FRAMES
    views: int = 10


EXTENTS = {'smoke': FusedExtent((10_000, 20_000), 1, 120, 4), 'full': FusedExtent()}


class FrameView(NamedTuple):
    """
    A frame to predict.

    :ivar pose: of the camera.
    :ivar within: (N,) bool: the points in the frame and its range.
    :ivar truth: (N,) bool: those of them that are visible.
    """

    pose: Pose
    within: np.ndarray
    truth: np.ndarray


def view_of(points: np.ndarray, rays: MeshRays, pose: Pose) -> FrameView:
    """
    Tell what a frame sees of a scan.

    :param points: (N, 3) float32, of the scan, metres.
    :param rays: casts at the mesh of the room that was scanned.
    :param pose: of the camera.
    """
    within = in_reach(points, pose, LENS)
    seen_from = (points[within] - pose.position) @ pose.rotation
    depth = seen_from[:, 0]
    truth = np.zeros(len(points), dtype=bool)
    truth[within] = depth - TOLERANCE <= exact_depth(rays, pose, seen_from / depth[:, None])
    return FrameView(pose, within, truth)


def looks(scene: Scene) -> dict[str, Look]:
    """Return the methods by name, for one scan."""
    surfels = SurfelVisibility(scene.points, scene.normals_or_estimate, scene.pitch, NOWHERE, FINE)
    cubes = CubeVisibility(scene.points, scene.spacing, NOWHERE, PAPER)
    caster = MeshRays(scene.mesh)
    return {
        'fine': partial(_look, surfels), 'fast': partial(_look, surfels.by(FAST)),
        'paper': partial(_look, cubes),
        'mesh': lambda pose: caster.visible(scene.points, pose.position, CAMERA.max_range),
        **{f'hidden_point_removal {radius}': partial(_removal, scene.points, radius)
           for radius in RADII}}


def _look(visibility: SurfelVisibility | CubeVisibility, pose: Pose) -> np.ndarray:
    """Look by a preset."""
    seen = Subset.none(visibility.order)
    visibility.look(pose, LENS, seen.bits)
    return seen.mask


def _removal(points: np.ndarray, radius: float, pose: Pose) -> np.ndarray:
    """Look by hidden point removal."""
    return removal(points, pose.position, CAMERA.max_range, radius)


def scans(seed: int, extent: FusedExtent) -> Iterator[tuple[int, Scene, list[FrameView]]]:
    """
    Scan a room, and thin the scan.

    :param seed: of the room.
    :param extent: how much is measured.
    :returns: the most points asked for, the scan, and the frames to predict, for each number.
    """
    scan, plan = scan_by_hand(seed, extent.frames), plan_of(seed)
    rays = MeshRays(mesh_of(plan))
    poses = list(hand_held_path(plan, extent.views, np.random.default_rng([seed, 3])))
    for most in extent.points:
        scene = scan.thinned(most)
        yield most, scene, [view_of(scene.points, rays, pose) for pose in poses]


def measure_fused(extent: FusedExtent, first_room: int = FIRST_ROOM) -> dict[str, Any]:
    """
    Measure every method on the same frames, with progress on stderr.

    :param extent: how much is measured.
    :param first_room: seed of the first room; the next ones follow.
    :returns: ``fused``, a row per number of points and method; ``fused_f1``, the same by names,
        ``mesh`` being that of the most points; and how much was measured.
    """
    counts: dict[tuple[int, str], np.ndarray] = {}
    seeds, frames = range(first_room, first_room + extent.rooms), 0
    for seed in track(seeds, 'fused scans', console=Console(stderr=True)):
        for most, scene, views in scans(seed, extent):
            frames += len(views)
            for name, look in looks(scene).items():
                counts.setdefault((most, name), np.zeros(3))
                for view in views:
                    counts[most, name] += confusion(look(view.pose) & view.within, view.truth)
    rows = [row for most in extent.points for row in best_radius_only(
        [{'density': points, 'method': name, **agreement(count)}
         for (points, name), count in counts.items() if points == most])]
    named = by_points(rows, 'f1')
    return {'fused': rows, 'fused_f1': {**named, 'mesh': named[f'mesh.{max(extent.points)}']},
            'fused_rooms': extent.rooms, 'fused_frames': extent.frames,
            'fused_views': frames // len(extent.points)}
