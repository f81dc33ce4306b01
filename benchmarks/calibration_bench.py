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
Measure how near ``ocp calibrate`` comes to where cameras hang: ``python -m`` this module.

Cameras hang near the walls of a room; what they see is ray cast at the room's mesh, with the noise
of their sensor; registration starts off by some metres and degrees. Rooms are generated ones,
scanned from tripods (points alone) or by hand (a mesh), and real scans where there are some: of
one with a mesh, that is ray cast; of others, one half of the points is the scan and the other half
what is seen.

A D455 is given the noise of stereo: a standard deviation of depth squared times 0.08 pixels over
focal length and baseline (Intel, "Best-Known-Methods for Tuning Intel RealSense D400 Depth
Cameras"), the same over neighbouring pixels. An Azure Kinect is given the largest random error of
its sheet, 17 mm, pixel by pixel. Errors that are the same in every frame are not modelled.
"""

import argparse
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
import json
from multiprocessing import get_context
from pathlib import Path
import sys
from typing import NamedTuple

from benchmarks import results
from benchmarks.hand_held_scan import scan_by_hand
import numpy as np
from ocp_ros.geometry.cameras import angle_between, CameraModel, Pose
from ocp_ros.geometry.packed_bits import Subset
from ocp_ros.geometry.visibility import FINE, SurfelVisibility
from ocp_ros.registration.camera_registration import register
from ocp_ros.registration.live_view import LiveView
from ocp_ros.registration.scan_surfaces import ScanSurfaces
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.rooms.generator import boxes_of, generate_room, is_position_free, mesh_of, plan_of
from ocp_ros.rooms.room_sets import SETS
from ocp_ros.scenes.meshes import MeshRays, sample_faces
from ocp_ros.scenes.scene import Mesh, Scene
from ocp_ros.scenes.scene_files import load_scene
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

#: Metres and degrees that a start is off.
STARTS = ((0.1, 3.0), (0.3, 10.0), (1.0, 30.0))
#: Metres and degrees within which an answer is right.
RIGHT = 0.01, 0.5
#: Pixels across of what is rendered: depth cameras are thinned as much before anything is done.
PIXELS = 320
#: Stereo: standard deviation at one metre, and over how many pixels it is the same; time of
#: flight: standard deviation at any distance, metres.
STEREO, ALIKE, FLIGHT = 0.08 / (675.0 * 0.095), 1.0, 0.017
#: Points of a scan from tripods.
POINTS = 120_000
#: Cameras in a room, metres from walls at most, from anything at least, and above the floor.
CAMERAS, NEAR, AIR, HEIGHTS = 2, 0.6, 0.15, (1.7, 2.4)


def stereo(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Measure depths (H, W), metres, by disparity, which errs alike in neighbouring pixels."""
    noise = gaussian_filter(rng.normal(size=depth.shape), ALIKE)
    return 1.0 / np.maximum(1.0 / depth + STEREO * noise / noise.std(), 1e-3)


def flight(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Measure depths (H, W), metres, by the time of flight."""
    return depth + FLIGHT * rng.normal(size=depth.shape)


NOISE: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {
    'realsense_d455': stereo, 'azure_kinect_nfov': flight}

#: (pose, sensor, noise) -> (M, 3) points in the body frame.
See = Callable[[Pose, str, np.random.Generator], np.ndarray]


class BenchRoom(NamedTuple):
    """
    A room to measure in.

    :ivar kind: of the scan.
    :ivar name: of the room.
    :ivar scene: its scan.
    :ivar see: what a camera sees there.
    :ivar hangs: poses of cameras, in the map frame.
    """

    kind: str
    name: str
    scene: Scene
    see: See
    hangs: list[Pose]


def pixel_rays(model: CameraModel) -> np.ndarray:
    """Return where pixels look: (H, W, 3) in the body frame, one metre long along the axis."""
    lens = model.lens
    rows = round(PIXELS * lens.half_vertical / lens.half_horizontal)
    left, up = np.meshgrid(*(-((np.arange(count) + 0.5) / count * 2.0 - 1.0) * half
                             for count, half in ((PIXELS, lens.half_horizontal),
                                                 (rows, lens.half_vertical))))
    return np.stack([np.ones_like(left), left, up], axis=-1)


def cast(rays: MeshRays, pose: Pose, sensor: str, rng: np.random.Generator) -> np.ndarray:
    """Return what a sensor measures of a mesh: (M, 3) metres, body frame."""
    model = SENSORS[sensor].model
    pixels = pixel_rays(model)
    depth = rays.lengths(pose.position, pixels @ pose.rotation.T)
    there = np.isfinite(depth)
    return (NOISE[sensor](np.where(there, depth, 50.0), rng)[..., None] * pixels)[there]


def picked(half: Scene, pose: Pose, sensor: str, rng: np.random.Generator) -> np.ndarray:
    """Return what a sensor measures of points that stand for a room: (M, 3), body frame."""
    visibility = SurfelVisibility(half.points, half.normals_or_estimate, half.pitch,
                                  np.empty((0, 3), np.float32), FINE)
    seen = Subset.none(visibility.order)
    visibility.look(pose, SENSORS[sensor].model.lens, seen.bits)
    points = (half.points[seen.mask] - pose.position) @ pose.rotation
    depth = np.maximum(points[:, :1], 0.1)
    return points * NOISE[sensor](depth, rng) / depth


def hung(size: np.ndarray, is_free: Callable[[np.ndarray], bool], rng: np.random.Generator
         ) -> list[Pose]:
    """Hang cameras near the walls of a room of a size (3,), looking about its middle and down."""
    poses: list[Pose] = []
    for _ in range(20_000):
        low, high = HEIGHTS[0], min(HEIGHTS[1], size[2] - AIR)
        at = np.append(rng.uniform(0.2, size[:2] - 0.2), rng.uniform(low, max(low, high)))
        if np.minimum(at[:2], size[:2] - at[:2]).min() <= NEAR and is_free(at):
            x, y = 0.5 * size[:2] - at[:2]
            poses.append(Pose.of(np.array([*at, np.arctan2(y, x) + np.deg2rad(
                rng.uniform(-25.0, 25.0)), np.deg2rad(rng.uniform(10.0, 40.0)), 0.0])))
            if len(poses) == CAMERAS:
                break
    return poses


def generated(seed: int) -> Iterator[BenchRoom]:
    """Yield a generated room, scanned from tripods and by hand."""
    plan = plan_of(seed)
    rays, boxes = MeshRays(mesh_of(plan)), boxes_of(plan)
    hangs = hung(plan.size, lambda at: is_position_free(at, AIR, *boxes),
                 np.random.default_rng([seed, 5]))

    def see(*what) -> np.ndarray:
        return cast(rays, *what)

    yield BenchRoom('tripod', str(seed), generate_room(seed, POINTS), see, hangs)
    mesh = scan_by_hand(seed)
    points, normals = np.hsplit(sample_faces(mesh.corners), 2)
    yield BenchRoom('hand', str(seed), Scene(points, normals=normals), see, hangs)


def real(folder: Path) -> Iterator[BenchRoom]:
    """Yield the real scans of a folder that are there."""
    for name, up in (('washitsu_mesh_y_up.obj', 'y'), ('office_open.ply', 'z'),
                     ('living_room_open.ply', 'z')):
        if not (folder / name).is_file():
            continue
        scene, rng = load_scene(folder / name, up=up), np.random.default_rng(7)
        low = scene.bounds[0]
        if up == 'y':
            rays = MeshRays(_turned_up(folder / name))

            def see(*what, rays=rays) -> np.ndarray:
                return cast(rays, *what)
        else:
            one = rng.random(len(scene)) < 0.5
            half, scene = Scene(scene.points[one]), Scene(scene.points[~one])

            def see(*what, half=half) -> np.ndarray:
                return picked(half, *what)
        surfaces = scene.points - low

        def is_free(at: np.ndarray, surfaces=surfaces) -> bool:
            return bool(np.linalg.norm(surfaces - at, axis=1).min() > AIR)

        hangs = [Pose(pose.position + low, pose.rotation)
                 for pose in hung(scene.size, is_free, rng)]
        yield BenchRoom('real', name.split('_')[0], scene, see, hangs)


def _turned_up(path: Path) -> Mesh:
    """Read a mesh whose y axis points up."""
    import open3d as o3d
    mesh = o3d.io.read_triangle_mesh(str(path))
    vertices = np.asarray(mesh.vertices, dtype=np.float32)[:, [0, 2, 1]]
    return Mesh(vertices * np.array([1, -1, 1], np.float32),
                np.asarray(mesh.triangles, dtype=np.int32))


def off(pose: Pose, metres: float, degrees: float, rng: np.random.Generator) -> Pose:
    """Return a pose that is off by exactly so much, in a direction of chance."""
    slide, axis = (way / np.linalg.norm(way) for way in rng.normal(size=(2, 3)))
    turn = Rotation.from_rotvec(np.deg2rad(degrees) * axis).as_matrix()
    return Pose(pose.position + metres * slide, turn @ pose.rotation)


def measured_in(room: BenchRoom) -> Iterator[dict]:
    """Yield what becomes of each camera, sensor and start in a room."""
    scan, rng = ScanSurfaces(room.scene), np.random.default_rng(0)
    for sensor in NOISE:
        model = SENSORS[sensor].model
        for number, pose in enumerate(room.hangs):
            view = LiveView(room.see(pose, sensor, rng), model)
            for metres, degrees in STARTS:
                found = register(scan, view, off(pose, metres, degrees, rng), model)
                metre = float(np.linalg.norm(found.pose.position - pose.position))
                degree = float(np.rad2deg(angle_between(found.pose.rotation, pose.rotation)))
                yield {'kind': room.kind, 'room': room.name, 'sensor': sensor, 'camera': number,
                       'start': metres, 'metres': metre, 'degrees': degree,
                       'right': metre <= RIGHT[0] and degree <= RIGHT[1],
                       'overlap': found.overlap, 'beside': found.displaced_share,
                       'behind': found.behind_share,
                       'expected': float(found.certainty.metres[0]),
                       'refused': found.refused}


def shares(rows: list[dict]) -> dict[str, float]:
    """
    Return shares of cameras, 0 to 1.

    :returns: of those that are given a right pose, a wrong one, and none; of the right ones among
        those that are given one; and of those whose best pose is right, refused or not.
    """
    given = [row for row in rows if not row['refused']]
    right = sum(row['right'] for row in given)
    return {'within_1cm_05deg': right / len(rows), 'wrong': (len(given) - right) / len(rows),
            'refused': 1.0 - len(given) / len(rows),
            'right_of_given': right / max(len(given), 1),
            'best_is_right': sum(row['right'] for row in rows) / len(rows)}


def figures_of(rows: list[dict]) -> dict[str, float]:
    """Return all figures by name, in per cent: for each kind, sensor and start, and in total."""
    found = {}
    generated_rows = [row for row in rows if row['kind'] != 'real']
    groups = {'': [row for row in generated_rows if row['start'] == 0.3]}
    for row in rows:
        key = f'{row["kind"]}.{row["sensor"].split("_")[0]}.{round(100 * row["start"])}cm.'
        groups.setdefault(key, []).append(row)
    for key, part in groups.items():
        if part:
            found |= {key + name: round(100.0 * value, 1) for name, value in shares(part).items()}
    return found


def _rows_of(rooms: Callable[..., Iterator[BenchRoom]], which: int | Path) -> list[dict]:
    """Measure in the rooms of a seed or a folder."""
    return [row for room in rooms(which) for row in measured_in(room)]


def main(argv: list[str] | None = None) -> int:
    """Measure, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--set', choices=sorted(SETS), default='test', help='generated rooms')
    parser.add_argument('--rooms', type=int, default=10, help='how many of them')
    parser.add_argument('--real', type=Path, help='folder of real scans')
    parser.add_argument('--workers', type=int, default=1, help='processes')
    parser.add_argument('--out', type=Path, default=Path('out/calibration.jsonl'),
                        help='a line for each registration')
    results.add_record(parser, 'calibration')
    arguments = parser.parse_args(argv)
    rows: list[dict] = []
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    seeds = SETS[arguments.set][:arguments.rooms]
    jobs = [partial(_rows_of, generated, seed) for seed in seeds]
    jobs += [partial(_rows_of, real, arguments.real)] if arguments.real else []
    with open(arguments.out, 'w') as file, ProcessPoolExecutor(
            arguments.workers, get_context('spawn')) as pool:
        for job in [pool.submit(job) for job in jobs]:
            rows += job.result()
            file.writelines(f'{json.dumps(row)}\n' for row in job.result())
            file.flush()
            print(rows[-1]['room'], shares(rows), file=sys.stderr)
    found = figures_of(rows)
    print(json.dumps(found, indent=1))
    if arguments.record:
        results.write('calibration', {'unit': '%', 'registrations': len(rows), 'shares': found},
                      results.command_of('calibration_bench', argv))
    return 0


if __name__ == '__main__':
    sys.exit(main())
