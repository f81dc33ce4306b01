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
Scans as a depth camera in the hand makes them: noisy frames along a path, fused to a mesh.

A frame holds the depth along the camera's axis, in metres, 0 where nothing is measured. Depth is
triangulated from a disparity that is read in steps, as structured light and stereo do: its error
and its resolution grow with the square of the depth. The figures are those of K. Khoshelham and
S. Oude Elberink, "Accuracy and Resolution of Kinect Depth Data for Indoor Mapping Applications",
Sensors 12(2), 2012, equations 10 and 11: a standard deviation of 1.425 mm and a step of 2.85 mm
at one metre.
"""

from collections.abc import Iterable, Iterator

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, Pose, rotation_matrix
from ocp_ros.rooms.generator import Boxes, boxes_of, is_position_free, mesh_of, plan_of
from ocp_ros.rooms.room_plan import RoomPlan
from ocp_ros.scenes.meshes import MeshRays
from ocp_ros.scenes.scene import Mesh
from scipy.ndimage import gaussian_filter1d

#: Pixels of a frame, and what the camera measures: 60 x 47 degrees, 0.4 to 4.5 m.
WIDTH, HEIGHT = 160, 120
FOCAL = 0.5 * WIDTH / np.tan(np.deg2rad(30.0))
CAMERA = CameraModel(0.4, 4.5, 2.0 * np.arctan(0.5 * WIDTH / FOCAL),
                     2.0 * np.arctan(0.5 * HEIGHT / FOCAL), (WIDTH, HEIGHT))
#: Standard deviation and step of a measured depth for each square metre of depth: 1/m.
NOISE, STEP = 1.425e-3, 2.85e-3
#: Edge of the voxels, and how far from a surface they know of it, metres.
VOXEL, TRUNCATION = 0.025, 0.1
#: Frames that have to agree on a voxel, and the least share of a frame's pixels that measure.
WEIGHT, LEAST = 3.0, 0.05
#: Metres: the height of a hand, how far the path stays from the walls, and the air around it.
LOW, HIGH, MARGIN, AIR = 1.4, 1.7, 0.6, 0.25
#: Places that the way leads to, its steps, and metres that its corners are rounded by.
PLACES, STEPS, ROUNDING = 14, 4096, 0.3
#: How often the camera turns around on its way, and how far it looks down, nods and tilts.
TURNS, DOWN, NOD, TILT = 5.0, np.deg2rad(12.0), np.deg2rad(40.0), np.deg2rad(8.0)
#: Frames along a path.
FRAMES = 480


def pixel_rays() -> np.ndarray:
    """Return where pixels look: (H, W, 3) in the body frame, one metre long along the axis."""
    across = (np.arange(WIDTH) + 0.5 - 0.5 * WIDTH) / FOCAL
    down = (np.arange(HEIGHT) + 0.5 - 0.5 * HEIGHT) / FOCAL
    left, up = np.meshgrid(-across, -down)
    return np.stack([np.ones_like(left), left, up], axis=-1)


def measured(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """
    Measure a frame with the noise and in the steps of a camera.

    :param depth: (H, W) float32, exact, metres.
    :param rng: the noise.
    :returns: (H, W) float32, metres, 0 out of range.
    """
    within = (depth >= CAMERA.min_range) & (depth <= CAMERA.max_range)
    exact = np.where(within, depth, 1.0)
    # Equal steps of disparity, which is inverse depth.
    noisy = 1.0 / exact + NOISE * rng.normal(size=exact.shape)
    return np.where(within, 1.0 / (STEP * np.round(noisy / STEP)), 0.0).astype(np.float32)


def hand_held_path(plan: RoomPlan, frames: int, rng: np.random.Generator) -> Iterator[Pose]:
    """
    Carry a camera around the room and look about.

    The way is a closed tour of free places with its corners rounded off; height and headings swing
    slowly. Where something stands in the way there are no frames.

    :param plan: the room.
    :param frames: at most so many.
    :param rng: the places and the swings.
    """
    boxes, time = boxes_of(plan), np.linspace(0.0, 2.0 * np.pi, frames, endpoint=False)
    positions = np.column_stack([
        _tour(_free_places(plan, boxes, rng), time),
        0.5 * (LOW + HIGH) + 0.5 * (HIGH - LOW) * _swing(time, (3, 7, 11), rng)])
    yaw = TURNS * rng.choice([-1.0, 1.0]) * time + 0.5 * _swing(time, (5, 9, 13), rng) \
        + rng.uniform(0.0, 2.0 * np.pi)
    pitch = DOWN + NOD * _swing(time, (7, 11, 17), rng)
    roll = TILT * _swing(time, (4, 9, 15), rng)
    for position, *angles in zip(positions, yaw, pitch, roll):
        if is_position_free(position, AIR, *boxes):
            yield Pose(position, rotation_matrix(*angles))


def _free_places(plan: RoomPlan, boxes: Boxes, rng: np.random.Generator) -> np.ndarray:
    """Draw places on the way, with air around them: (P, 2), metres, at least one."""
    margin, places = np.minimum(MARGIN, 0.3 * plan.size[:2]), []
    while len(places) < PLACES:
        place = np.append(rng.uniform(margin, plan.size[:2] - margin), 0.5 * (LOW + HIGH))
        if is_position_free(place, AIR, *boxes):
            places.append(place[:2])
    return np.array(places)


def _tour(places: np.ndarray, time: np.ndarray) -> np.ndarray:
    """
    Walk from place to the nearest place not yet visited, and back to the first.

    :param places: (P, 2), metres.
    :param time: (T,) from 0 to 2 pi.
    :returns: (T, 2), metres, within the hull of the places.
    """
    rest, way = list(places[1:]), [places[0]]
    while rest:
        way.append(rest.pop(int(np.argmin(np.linalg.norm(np.array(rest) - way[-1], axis=1)))))
    corners = np.array([*way, way[0]])
    along = np.append(0.0, np.linalg.norm(np.diff(corners, axis=0), axis=1).cumsum())
    # On a fine grid of its own, so that the way is the same for few frames as for many.
    steps = np.linspace(0.0, along[-1], STEPS, endpoint=False)
    walked = np.stack([np.interp(steps, along, axis) for axis in corners.T], axis=1)
    round_off = gaussian_filter1d(walked, STEPS * ROUNDING / along[-1], axis=0, mode='wrap')
    return round_off[(STEPS * time / (2.0 * np.pi)).astype(int)]


def _swing(time: np.ndarray, beats: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Return a smooth periodic curve within [-1, 1] of some beats a round, (T,)."""
    return np.mean([np.sin(beat * time + rng.uniform(0.0, 2.0 * np.pi)) for beat in beats], axis=0)


def fuse(frames: Iterable[tuple[np.ndarray, Pose]]) -> Mesh:
    """
    Fuse frames to a truncated signed distance (Curless and Levoy, 1996) and extract its surface.

    :param frames: measured depths (H, W), metres, and the poses of the camera.
    :raises ValueError: if no surface is in three frames.
    """
    import open3d as o3d
    tensor, one = o3d.core.Tensor, o3d.core.float32
    grid = o3d.t.geometry.VoxelBlockGrid(('tsdf', 'weight'), (one, one), ((1), (1)), VOXEL)
    # Open3D takes the pixel whose corner is nearest below: pixel 0 reaches from 0 to 1.
    camera = tensor(np.array([[FOCAL, 0.0, 0.5 * WIDTH], [0.0, FOCAL, 0.5 * HEIGHT],
                              [0.0, 0.0, 1.0]]))
    for depth, pose in frames:
        # Open3D refuses a frame of which the pixels that it tries measure nothing.
        if np.count_nonzero(depth) < LEAST * depth.size:
            continue
        image, extrinsic = o3d.t.geometry.Image(tensor(depth[..., None])), tensor(_extrinsic(pose))
        rule = (camera, extrinsic, 1.0, CAMERA.max_range, TRUNCATION / VOXEL)
        grid.integrate(grid.compute_unique_block_coordinates(image, *rule), image, *rule)
    if float(grid.attribute('weight').max().item()) < WEIGHT:
        raise ValueError(f'found no place that {WEIGHT:.0f} frames measured; expected frames that '
                         'overlap; fuse more of them')
    mesh = grid.extract_triangle_mesh(WEIGHT)
    vertices, triangles = mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy()
    # Threads of Open3D number the vertices, each time in another order.
    order = np.lexsort(vertices.T)
    return Mesh(vertices[order], np.argsort(order)[triangles].astype(np.int32))


def _extrinsic(pose: Pose) -> np.ndarray:
    """Return the (4, 4) transform from the map to the image: x right, y down, z forward."""
    extrinsic = np.eye(4)
    extrinsic[:3, :3] = np.stack([-pose.rotation[:, 1], -pose.rotation[:, 2], pose.rotation[:, 0]])
    extrinsic[:3, 3] = -extrinsic[:3, :3] @ pose.position
    return extrinsic


def scan_by_hand(seed: int) -> Mesh:
    """
    Scan a generated room with a depth camera in the hand; the same seed gives the same mesh.

    :param seed: of the room, see :func:`~ocp_ros.rooms.generator.generate_room`.
    """
    plan, rng = plan_of(seed), np.random.default_rng([seed, 2])
    path = list(hand_held_path(plan, FRAMES, rng))
    rays, pixels = MeshRays(mesh_of(plan)), pixel_rays()
    return fuse((measured(rays.lengths(pose.position, pixels @ pose.rotation.T), rng), pose)
                for pose in path)
