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

Four cameras hang near the walls of a room; what they see is ray cast at the room's mesh. Rooms are
generated ones, scanned from tripods (points alone) or by hand (a mesh), and real scans where there
are some: of one with a mesh, that is ray cast; of others, one half of the points is the scan and
the other half what is seen.

Frames have errors as sensors do. A D455 has the noise of stereo: a standard deviation of depth
squared times 0.08 pixels over focal length and baseline (Intel, "Best-Known-Methods for Tuning
Intel RealSense D400 Depth Cameras"), the same over neighbouring pixels. Three quarters of its
variance are drawn anew in each frame, and one quarter is the same in all frames; disparity is read
in steps of 1/32 pixel. An Azure Kinect has the largest random error of its sheet, 17 mm, anew in
each pixel and frame, and an offset of 2 mm. Both have a wrong scale of 0.1 % and a bend towards
the edges of the image of 2 mm at 3 m (standard deviations), which stay the same. Half of the
pixels at jumps of depth lie anywhere between both sides, anew in each frame. With people, each
frame has some at random places.
"""

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
import json
from multiprocessing import get_context
from pathlib import Path
import sys
import time
from typing import NamedTuple

from benchmarks import results
from benchmarks.hand_held_scan import scan_by_hand
import numpy as np
from ocp_ros.geometry.cameras import CameraModel, heading_of, Pose
from ocp_ros.geometry.packed_bits import Subset
from ocp_ros.geometry.visibility import FINE, SurfelVisibility
from ocp_ros.registration.calibration import calibrate
from ocp_ros.registration.camera_registration import Registration
from ocp_ros.registration.joint_alignment import relative_pose
from ocp_ros.registration.live_view import LiveView
from ocp_ros.registration.movement import movement_since
from ocp_ros.registration.mutual_registration import register_mutually
from ocp_ros.registration.scan_surfaces import ScanSurfaces
from ocp_ros.registration.steady_cloud import steady_cloud
from ocp_ros.rig.placement_file import placement_of
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.rooms.generator import boxes_of, generate_room, is_position_free, mesh_of, plan_of
from ocp_ros.rooms.room_sets import SETS
from ocp_ros.scenes.meshes import MeshRays, sample_faces
from ocp_ros.scenes.scene import Mesh, Scene
from ocp_ros.scenes.scene_files import load_scene
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation

#: Rooms in which nothing was chosen; measured once for each version.
ROOMS = {'validation': SETS['validation'], 'test': tuple(range(6001, 6041))}
#: Metres and degrees that a start is off.
START = 0.3, 10.0
#: Metres and degrees within which an answer is right.
RIGHT = 0.01, 0.5
#: The same of cameras without a scan, against one of them.
MUTUAL = 0.02, 0.7
#: Metres, and degrees, by which cameras move.
MOVES = 0.02, 1.0
#: Pixels across of what is rendered: depth cameras are thinned as much before anything is done.
PIXELS = 320
#: Stereo: standard deviation at one metre, over how many pixels it is the same, share of its
#: variance that is new in each frame, and step of 1/depth; time of flight: standard deviation at
#: any distance, and offset, metres.
STEREO, ALIKE, ANEW, STEP = 0.08 / (675.0 * 0.095), 1.0, 0.75, 1.0 / 32.0 / (675.0 * 0.095)
FLIGHT, OFFSET = 0.017, 0.002
#: Standard deviations of the scale, and of the bend at the edge of the image, 1/m.
SCALE, BEND = 1e-3, 2e-3 / 9.0
#: Points of a scan from tripods.
POINTS = 120_000
#: Cameras in a room, metres from walls at most, from anything at least, and above the floor.
CAMERAS, NEAR, AIR, HEIGHTS = 4, 0.6, 0.15, (1.7, 2.4)
#: Frames of each camera.
FRAMES = 20
#: The sensors.
BOTH = 'realsense_d455', 'azure_kinect_nfov'
#: Radius and height of a person, metres.
PERSON = 0.25, 1.75


class Device:
    """
    The errors of one sensor that stay the same in all frames.

    :param sensor: a name of ``SENSORS``, of stereo or of time of flight.
    :param shape: rows and columns of its image.
    """

    def __init__(self, sensor: str, shape: tuple[int, int], rng: np.random.Generator) -> None:
        self._stereo = sensor.startswith('realsense')
        up, left = np.meshgrid(*(np.linspace(-1.0, 1.0, count) for count in shape), indexing='ij')
        self._scale = 1.0 + SCALE * rng.normal()
        # A bend that is 0 in the middle.
        self._bend = BEND * (rng.normal() * (left * left + up * up) + rng.normal() * left * up
                             + rng.normal() * left + rng.normal() * up) / 2.0
        self._offset = 0.0 if self._stereo else OFFSET * rng.normal()
        self._fixed = _alike(shape, rng)

    def measure(self, depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return a frame of depths (H, W), metres, given the true ones."""
        depth = depth * self._scale + depth * depth * self._bend + self._offset
        if not self._stereo:
            return depth + FLIGHT * rng.normal(size=depth.shape)
        noise = np.sqrt(ANEW) * _alike(depth.shape, rng) + np.sqrt(1.0 - ANEW) * self._fixed
        inverse = np.maximum(1.0 / np.maximum(depth, 0.01) + STEREO * noise, STEP)
        return 1.0 / (STEP * np.round(inverse / STEP))


def _alike(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Return noise (H, W) of standard deviation 1 that neighbouring pixels share."""
    noise = gaussian_filter(rng.normal(size=shape), ALIKE)
    return noise / noise.std()


#: (pose, sensor, frames, people, rng) -> frames of points (M, 3) in the body frame.
See = Callable[..., list[np.ndarray]]


class BenchRoom(NamedTuple):
    """
    A room to measure in.

    :ivar kind: of the scan.
    :ivar name: of the room.
    :ivar scene: its scan.
    :ivar see: what a camera sees there.
    :ivar hangs: poses of cameras, in the map frame.
    :ivar sensors: the cameras' presets, one measured after the other.
    """

    kind: str
    name: str
    scene: Scene
    see: See
    hangs: list[Pose]
    sensors: tuple[str, ...] = BOTH

    @property
    def rng(self) -> np.random.Generator:
        """Return a new generator of errors; each room has other devices."""
        return np.random.default_rng([*self.name.encode()])


def pixel_rays(model: CameraModel) -> np.ndarray:
    """Return where pixels look: (H, W, 3) in the body frame, one metre long along the axis."""
    lens = model.lens
    rows = round(PIXELS * lens.half_vertical / lens.half_horizontal)
    left, up = np.meshgrid(*(-((np.arange(count) + 0.5) / count * 2.0 - 1.0) * half
                             for count, half in ((PIXELS, lens.half_horizontal),
                                                 (rows, lens.half_vertical))))
    return np.stack([np.ones_like(left), left, up], axis=-1)


def cast(rays: MeshRays, pose: Pose, sensor: str, frames: int = 1, people: int = 0,
         rng: np.random.Generator | None = None, device: int | None = None) -> list[np.ndarray]:
    """
    Return frames that a sensor measures of a mesh, each of points (M, 3), metres, body frame.

    :param people: how many stand within 4 m in each frame, each time elsewhere.
    :param device: a number that draws the errors that stay the same; None: drawn by ``rng``.
    """
    rng = rng or np.random.default_rng(0)
    pixels = pixel_rays(SENSORS[sensor].model)
    directions = pixels @ pose.rotation.T
    depth = rays.lengths(pose.position, directions)
    there = np.isfinite(depth)
    fixed = rng if device is None else np.random.default_rng(device)
    errors, seen = Device(sensor, depth.shape, fixed), []
    for _ in range(frames):
        now = np.where(there, depth, 50.0)
        for _ in range(people):
            now = np.minimum(now, _person(pose, directions, rng))
        low, high = minimum_filter(now, 3), maximum_filter(now, 3)
        flies = (high - low > 0.05) & (rng.random(now.shape) < 0.5)
        now = np.where(flies, low + (high - low) * rng.random(now.shape), now)
        seen.append((errors.measure(now, rng)[..., None] * pixels)[there])
    return seen


def _person(pose: Pose, directions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the depths (H, W) of a person at a random place, an upright cylinder; else inf."""
    ahead = pose.rotation[:, 0]
    turn = np.arctan2(ahead[1], ahead[0]) + rng.uniform(-0.7, 0.7)
    x, y = rng.uniform(1.0, 4.0) * np.array([np.cos(turn), np.sin(turn)])
    across, along = directions[..., 0] * y - directions[..., 1] * x, \
        directions[..., 0] * x + directions[..., 1] * y
    square = (directions[..., :2] ** 2).sum(axis=-1)
    root = PERSON[0] ** 2 * square - across ** 2
    depth = (along - np.sqrt(np.maximum(root, 0.0))) / square
    height = pose.position[2] + depth * directions[..., 2]
    return np.where((root > 0.0) & (depth > 0.0) & (height > 0.0) & (height < PERSON[1]), depth,
                    np.inf)


def picked(half: Scene, pose: Pose, sensor: str, frames: int, people: int,
           rng: np.random.Generator) -> list[np.ndarray]:
    """Return frames that a sensor measures of points that stand for a room, without people."""
    visibility = SurfelVisibility(half.points, half.normals_or_estimate, half.pitch,
                                  np.empty((0, 3), np.float32), FINE)
    seen = Subset.none(visibility.order)
    visibility.look(pose, SENSORS[sensor].model.lens, seen.bits)
    points = (half.points[seen.mask] - pose.position) @ pose.rotation
    depth = np.maximum(points[:, :1], 0.1)
    device = Device(sensor, depth.shape, rng)
    return [points * device.measure(depth, rng) / depth for _ in range(frames)]


def hung(size: np.ndarray, is_free: Callable[[np.ndarray], bool], rng: np.random.Generator,
         count: int = CAMERAS) -> list[Pose]:
    """Hang cameras near the walls of a room of a size (3,), looking about its middle and down."""
    poses: list[Pose] = []
    for _ in range(20_000):
        low, high = HEIGHTS[0], min(HEIGHTS[1], size[2] - AIR)
        at = np.append(rng.uniform(0.2, size[:2] - 0.2), rng.uniform(low, max(low, high)))
        if np.minimum(at[:2], size[:2] - at[:2]).min() <= NEAR and is_free(at):
            x, y = 0.5 * size[:2] - at[:2]
            poses.append(Pose.of(np.array([*at, np.arctan2(y, x) + np.deg2rad(
                rng.uniform(-25.0, 25.0)), np.deg2rad(rng.uniform(10.0, 40.0)), 0.0])))
            if len(poses) == count:
                break
    return poses


def likely_in(seed: int, stream: int, count: int) -> tuple[See, list[Pose]]:
    """Return what cameras see in a generated room, and poses near its walls by some stream."""
    plan = plan_of(seed)
    boxes = boxes_of(plan)
    return partial(cast, MeshRays(mesh_of(plan))), hung(
        plan.size, lambda at: is_position_free(at, AIR, *boxes),
        np.random.default_rng([seed, stream]), count)


def generated(seed: int, kind: str) -> Iterator[BenchRoom]:
    """Yield a generated room, scanned from tripods ('tripod') or by hand ('hand')."""
    see, hangs = likely_in(seed, 5, CAMERAS)
    if kind == 'tripod':
        scene = generate_room(seed, POINTS)
    else:
        points, normals = np.hsplit(sample_faces(scan_by_hand(seed).corners), 2)
        scene = Scene(points, normals=normals)
    yield BenchRoom(kind, str(seed), scene, see, hangs)


def linked(seed: int, least: float) -> Iterator[BenchRoom]:
    """
    Yield a generated room for each sensor, in which each camera shares points with an earlier one.

    :param least: the least share of its points, at most 20 % less than the largest.
    """
    see, likely = likely_in(seed, 6, 60)
    for sensor in BOTH:
        chosen: list[tuple[LiveView, Pose]] = []
        for pose in likely:
            view = LiveView(see(pose, sensor)[0], SENSORS[sensor].model)
            largest = max((min(shared_by(view, pose, *one), shared_by(*one, view, pose))
                           for one in chosen), default=least)
            if least <= largest <= least + 0.2:
                chosen.append((view, pose))
            if len(chosen) == CAMERAS:
                yield BenchRoom('none', str(seed), generate_room(seed, 1000), see,
                                [pose for _, pose in chosen], (sensor,))
                break


def shared_by(view: LiveView, pose: Pose, other: LiveView, other_pose: Pose) -> float:
    """Return the share of what a camera sees that another one sees too."""
    relative = relative_pose(pose, other_pose)
    return other.compared(
        view.patches.points @ relative.rotation.T + relative.position,
        view.patches.normals @ relative.rotation.T)[0] / len(view.patches.points)


def real(folder: Path) -> Iterator[BenchRoom]:
    """Yield the real scans of a folder that are there."""
    for name, up in (('washitsu_mesh_y_up.obj', 'y'), ('office_open.ply', 'z'),
                     ('living_room_open.ply', 'z')):
        if not (folder / name).is_file():
            continue
        scene, rng = load_scene(folder / name, up=up), np.random.default_rng(7)
        low, see = scene.bounds[0], partial(cast, MeshRays(_turned_up(folder / name))) \
            if up == 'y' else None
        if see is None:
            one = rng.random(len(scene)) < 0.5
            half, scene = Scene(scene.points[one]), Scene(scene.points[~one])
            see = partial(picked, half)
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


def measured_in(room: BenchRoom, people: int, frames: int) -> Iterator[dict]:
    """Yield what becomes of each camera and sensor in a room, before and after."""
    scan, rng = ScanSurfaces(room.scene), room.rng
    for sensor in room.sensors:
        seen = [room.see(pose, sensor, frames, people, rng) for pose in room.hangs]
        rows = [[*start.position, *heading_of(start.rotation)]
                for start in (off(pose, *START, rng) for pose in room.hangs)]
        placement = placement_of(rig_of(len(rows), sensor), np.array(rows))
        names = [placed.camera.name for placed in placement.cameras]
        for method, merged, groups in (
                ('alone', lambda one: one[0], [[name] for name in names]),
                ('together', steady_cloud, [names])):
            begin, found = time.process_time(), {}
            clouds = dict(zip(names, map(merged, seen)))
            for group in groups:
                found |= calibrate(scan, placement, {name: clouds[name] for name in group})[0]
            seconds = (time.process_time() - begin) / len(names)
            for name, pose in zip(names, room.hangs):
                if name in found:
                    yield {'kind': room.kind, 'room': room.name, 'sensor': sensor, 'camera': name,
                           'method': method, 'seconds': seconds,
                           **row_of(found[name], pose)}


def mutual_in(room: BenchRoom, people: int, frames: int) -> Iterator[dict]:
    """Yield what becomes of cameras without a scan, and of cameras that move or do not."""
    for sensor in room.sensors:
        model, rng = SENSORS[sensor].model, room.rng
        devices = rng.integers(1 << 31, size=len(room.hangs))

        def view(number: int, pose: Pose, sensor=sensor, model=model, rng=rng, devices=devices
                 ) -> LiveView:
            return LiveView(steady_cloud(room.see(
                pose, sensor, frames, people, rng, int(devices[number]))), model)

        views = {str(k): view(k, pose) for k, pose in enumerate(room.hangs)}
        begin = time.process_time()
        found, reasons = register_mutually(views)
        seconds = (time.process_time() - begin) / len(views)
        given = [name for name, one in found.items() if not one.refused]
        base = min(given, key=lambda name: found[name].certainty.metres[0]) if given else ''
        for name in views:
            row = {'kind': room.kind, 'room': room.name, 'sensor': sensor, 'camera': name,
                   'seconds': seconds, 'method': 'mutual', 'refused': reasons.get(name, ''),
                   'right': False}
            if name in found:
                one = found[name]
                row |= {'refused': one.refused, 'total': one.overlap, 'lead': one.lead,
                        'expected': one.certainty.metres.tolist()}
                if base:
                    true = relative_pose(room.hangs[int(name)], room.hangs[int(base)])
                    away, turn = relative_pose(one.pose, found[base].pose).away_from(true)
                    row |= {'metres': away, 'degrees': float(np.rad2deg(turn)), 'right': bool(
                        away <= MUTUAL[0] and turn <= np.deg2rad(MUTUAL[1]))}
            yield row
        for k, pose in enumerate(room.hangs):
            for method, moves in (('still', ((0.0, 0.0),) * 2),
                                  ('moved', ((MOVES[0], 0.0), (0.0, MOVES[1])))):
                for metres, degrees in moves:
                    begin = time.process_time()
                    now = movement_since(views[str(k)], view(k, off(pose, metres, degrees, rng)))
                    yield {'kind': room.kind, 'room': room.name, 'sensor': sensor,
                           'camera': str(k), 'seconds': time.process_time() - begin,
                           'method': method, 'refused': '', 'metres': now.metres,
                           'degrees': now.degrees, 'agreement': now.agreement,
                           'right': bool(now.has_moved == (method == 'moved'))}


def row_of(found: Registration, true: Pose) -> dict:
    """Return how far a registered pose is from the true one, and what the judge knew."""
    metre, radian = found.pose.away_from(true)
    degree, certainty = float(np.rad2deg(radian)), found.certainty
    turn = Rotation.from_matrix(found.pose.rotation @ true.rotation.T).as_rotvec(degrees=True)
    errors = [*(certainty.slide_axes @ (found.pose.position - true.position) / certainty.metres),
              *(certainty.turn_axes @ turn / certainty.degrees)]
    return {'metres': metre, 'degrees': degree,
            'right': bool(metre <= RIGHT[0] and degree <= RIGHT[1]), 'overlap': found.overlap,
            'beside': found.displaced_share, 'behind': found.behind_share,
            'violated': found.violated_share, 'expected': certainty.metres.tolist(),
            'expected_degrees': certainty.degrees.tolist(), 'normalised': np.round(
                errors, 3).tolist(), 'others': len(found.others), 'refused': found.refused}


def off(pose: Pose, metres: float, degrees: float, rng: np.random.Generator) -> Pose:
    """Return a pose that is off by exactly so much, in a direction of chance."""
    slide, axis = (way / np.linalg.norm(way) for way in rng.normal(size=(2, 3)))
    turn = Rotation.from_rotvec(np.deg2rad(degrees) * axis).as_matrix()
    return Pose(pose.position + metres * slide, turn @ pose.rotation)


def shares(rows: Sequence[dict]) -> dict[str, float]:
    """
    Return shares of cameras, 0 to 1.

    :returns: of those that are given a right pose, a wrong one, and none; and of those whose best
        pose is right, refused or not. Of accepted poses, the share of the errors along six axes
        that are within the 90 % that their deviations state; left out where it was not measured.
    """
    given = [row for row in rows if not row['refused']]
    right = sum(row['right'] for row in given)
    found = {'right': right / len(rows), 'wrong': (len(given) - right) / len(rows),
             'refused': 1.0 - len(given) / len(rows),
             'best_is_right': sum(row['right'] for row in rows) / len(rows)}
    if stated := [np.abs(row['normalised']) < 1.645 for row in given if 'normalised' in row]:
        found['within_stated_90'] = float(np.mean(stated))
    return found


def figures_of(rows: Sequence[dict]) -> dict[str, float]:
    """Return shares in per cent and seconds per camera, by scan, sensor and method."""
    groups: dict[str, list[dict]] = {}
    for row in rows:
        key = f'{row["kind"]}.{row["sensor"].split("_")[0]}.{row["method"]}.'
        groups.setdefault(key, []).append(row)
    found = {}
    for key, part in sorted(groups.items()):
        found |= {key + name: round(100.0 * value, 1) for name, value in shares(part).items()}
        found[key + 'seconds'] = round(float(np.mean([row['seconds'] for row in part])), 2)
    return found


def _rows_of(job: str, rooms: Callable[..., Iterator[BenchRoom]],
             measure: Callable[..., Iterator[dict]], people: int, frames: int,
             *which: int | float | str | Path) -> list[dict]:
    """Measure in the rooms of a seed or a folder; each row names its job."""
    return [{'job': job, **row} for room in rooms(*which)
            for row in measure(room, people, frames)]


def add_lines(parser: argparse.ArgumentParser, name: str, line: str) -> None:
    """Add where the lines of jobs are kept, a file of a name in ``out``, and what of them."""
    parser.add_argument('--resume', action='store_true', help='keep the lines of earlier calls, '
                        'and measure what is missing')
    parser.add_argument('--most', type=int, help='end after so many jobs, to be resumed')
    parser.add_argument('--workers', type=int, default=1, help='processes')
    parser.add_argument('--out', type=Path, default=Path('out') / name, help=line)


def lines_of(arguments: argparse.Namespace, jobs: Mapping[str, tuple]) -> list[dict]:
    """
    Do the jobs whose lines are missing, and return the lines of all.

    :param jobs: by name: a function and its arguments behind the name; it returns its lines, each
        with the key ``job``.
    """
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in arguments.out.read_text().splitlines()] \
        if arguments.resume and arguments.out.is_file() else []
    done = {row['job'] for row in rows}
    missing = [job for job in jobs if job not in done]
    with open(arguments.out, 'a' if arguments.resume else 'w') as file, ProcessPoolExecutor(
            arguments.workers, get_context('spawn')) as pool:
        for running in [pool.submit(jobs[job][0], job, *jobs[job][1:])
                        for job in missing[:arguments.most]]:
            # A room without linked cameras has no rows.
            rows += running.result()
            file.writelines(f'{json.dumps(row)}\n' for row in running.result())
            file.flush()
    return rows


def main(argv: list[str] | None = None) -> int:
    """Measure, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--set', choices=sorted(ROOMS), default='test', help='generated rooms')
    parser.add_argument('--rooms', type=int, default=10, help='how many of them')
    parser.add_argument('--first', type=int, default=0, help='number of the first of them')
    parser.add_argument('--kinds', nargs='+', choices=('tripod', 'hand', 'none'),
                        default=('tripod', 'hand', 'none'), help='scans; none: without a scan')
    parser.add_argument('--overlap', type=float, default=0.3, help='least share of points that '
                        'cameras without a scan share')
    parser.add_argument('--real', type=Path, help='folder of real scans')
    parser.add_argument('--people', type=int, default=1, help='people in each frame')
    parser.add_argument('--frames', type=int, default=FRAMES, help='frames of each camera')
    add_lines(parser, 'calibration.jsonl', 'a line for each registration')
    results.add_record(parser, 'calibration')
    arguments = parser.parse_args(argv)
    how = arguments.people, arguments.frames
    jobs = {f'{kind} {seed}': (_rows_of, linked, mutual_in, *how, seed, arguments.overlap)
            if kind == 'none' else (_rows_of, generated, measured_in, *how, seed, kind)
            for seed in ROOMS[arguments.set][arguments.first:][:arguments.rooms]
            for kind in arguments.kinds}
    if arguments.real:
        jobs['real'] = (_rows_of, real, measured_in, *how, arguments.real)
    rows = lines_of(arguments, jobs)
    found = figures_of(rows)
    print(json.dumps(found, indent=1))
    if arguments.record:
        results.write('calibration', {'unit': '%', 'registrations': len(rows), 'shares': found},
                      results.command_of('calibration_bench', argv))
    return 0


if __name__ == '__main__':
    sys.exit(main())
