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
Measure how true the engine's visibility is and how fast it is: ``python -m benchmarks.engine``.

Truth is ray casting of generated rooms' meshes. All methods judge the same cameras in one process,
pinned to one core; only the figures that say so use two threads, and the training all cores.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import islice
import os
from pathlib import Path
import sys
from tempfile import TemporaryDirectory
import time
from typing import Any, NamedTuple

from benchmarks import results
import numpy as np
from ocp_ros.geometry.cameras import CameraModel, Pose
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.packed_bits import Subset
from ocp_ros.geometry.visibility import PRESETS
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rooms.generator import generate_room
from ocp_ros.scenes.meshes import MeshRays
from ocp_ros.scenes.scene import Scene
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import PlaneProblem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.training.run_folder import read_config
from ocp_ros.training.train import build_model, environments
from ocp_ros.training.training_rooms import room_names
import open3d as o3d
from rich.console import Console
from rich.progress import track
from rich.table import Table

#: Points of a room at which methods are compared by speed.
MIDDLE = 40_000
#: Radii of hidden point removal, metres; the best one counts.
RADII = (200, 300, 500, 1000, 2000)
SPEEDS = ('env_steps_per_s', 'evaluations_per_s', 'evaluations_per_s_one_moved',
          'scaling_2_threads', 'literal_interactions_per_s')
RANGE = 6.0
LENS = CameraModel(max_range=RANGE).lens
#: Rooms for the figures; none of them is a training room.
FIRST_ROOM = 200
#: Metres from a camera to the nearest surface.
CLEARANCE = 0.35


class Extent(NamedTuple):
    """
    How much is measured.

    :param densities: points per room, with :data:`MIDDLE` among them.
    :param rooms: how many rooms per density.
    :param positions: how many places of a camera in each room.
    :param scales: points of the rooms for time and memory.
    :param interactions: of the training, before the clock starts and with it.
    """

    densities: tuple[int, ...] = (10_000, 15_000, MIDDLE, 100_000)
    rooms: int = 20
    positions: int = 6
    scales: tuple[int, ...] = (40_000, 400_000, 5_000_000)
    interactions: tuple[int, int] = 16_000, 8_000


EXTENTS = {'smoke': Extent((MIDDLE,), 2, 2, (40_000, 400_000), (0, 2_000)), 'full': Extent()}

#: (case) -> the points that are visible, (N,) bool or a subset.
Method = Callable[['Case'], np.ndarray | Subset]


def cycled_seconds(calls: Sequence[Callable[[], Any]], enough: float = np.inf) -> list[float]:
    """
    Return the times of all calls in up to five rounds, one round if that takes ``enough`` seconds.

    A pose that is looked from again and again teaches the processor its branches.
    """
    times: list[float] = []
    while len(times) < 5 * len(calls) and sum(times) < enough:
        for call in calls:
            began = time.perf_counter()
            call()
            times.append(time.perf_counter() - began)
    return times


def median_seconds(call: Callable[[], Any]) -> float:
    """Return the median time of five calls."""
    return float(np.median(cycled_seconds([call])))


def free_places(scene: Scene, height: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """
    Draw places where a camera could hang: nothing of the room within 0.35 m.

    :param scene: the room.
    :param height: metres, map frame.
    :param count: how many places.
    :param rng: draws them.
    :returns: (count, 3) float64, metres.
    """
    places = []
    while len(places) < count:
        place = np.append(rng.uniform(*scene.bounds[:, :2]), height)
        if np.linalg.norm(scene.points - place, axis=1).min() >= CLEARANCE:
            places.append(place)
    return np.array(places)


class Case(NamedTuple):
    """One camera in one room: what each method is asked, and the truth."""

    scene: Scene
    simulators: dict[str, Simulator]
    caster: MeshRays
    position: np.ndarray
    truth: np.ndarray


def cases(density: int, rooms: int, positions: int) -> Iterator[Case]:
    """
    Make the cases of one density.

    :param density: points per room.
    :param rooms: how many rooms.
    :param positions: how many places of a camera in each.
    """
    for seed in range(FIRST_ROOM, FIRST_ROOM + rooms):
        scene, rng = generate_room(seed, density), np.random.default_rng(seed)
        simulators = {preset: Simulator(scene, SimulationConfig(
            rig=RigConfig(max_range=RANGE), engine=EngineConfig(preset=preset)))
            for preset in PRESETS}
        caster = MeshRays(scene.mesh)
        for position in free_places(scene, simulators['fine'].height, positions, rng):
            yield Case(scene, simulators, caster, position,
                       caster.visible(scene.points, position, RANGE))


def preset_of(name: str) -> Method:
    """Return one of the engine's presets as a method to measure."""
    def look(case: Case) -> Subset:
        seen = case.simulators[name].nothing()
        case.simulators[name].visibility.look(Pose.of(case.position), LENS, seen.bits)
        return seen
    return look


def removal(points: np.ndarray, position: np.ndarray, max_range: float, radius: float
            ) -> np.ndarray:
    """
    Tell which points hidden point removal keeps: that of Open3D, after Katz et al. (2007).

    :param points: (N, 3), metres.
    :param position: (3,) of the camera, metres.
    :param max_range: metres; what is farther is left out beforehand.
    :param radius: of the sphere that points are flipped at, metres.
    :returns: (N,) bool.
    """
    near = np.flatnonzero(np.linalg.norm(points - position, axis=1) <= max_range)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[near].astype(np.float64)))
    _, kept = cloud.hidden_point_removal(position, radius)
    seen = np.zeros(len(points), dtype=bool)
    seen[near[np.asarray(kept)]] = True
    return seen


def hidden_point_removal(radius: float) -> Method:
    """Return hidden point removal with one radius, metres, as a method to measure."""
    return lambda case: removal(case.scene.points, case.position, RANGE, radius)


def embree(case: Case) -> np.ndarray:
    """Cast one ray per point at the mesh, which the user of a point cloud does not have."""
    return case.caster.visible(case.scene.points, case.position, RANGE)


METHODS: dict[str, Method] = {
    **{name: preset_of(name) for name in PRESETS},
    **{f'hidden_point_removal {radius}': hidden_point_removal(radius) for radius in RADII},
    'embree': embree}


def mask_of(seen: np.ndarray | Subset) -> np.ndarray:
    """Return what a method says as (N,) bool."""
    return seen.mask if isinstance(seen, Subset) else seen


def confusion(seen: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Count of (N,) bool what is seen rightly, seen wrongly and missed: (3,)."""
    return np.array([(seen & truth).sum(), (seen & ~truth).sum(), (~seen & truth).sum()], float)


def f1_of(counts: np.ndarray) -> float:
    """Return the harmonic mean of precision and recall of :func:`confusion`, or of its sum."""
    right, wrong, missed = counts.tolist()
    return 2 * right / (2 * right + wrong + missed)


def best_radius_only(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Keep, of hidden point removal, the row with the best F1, behind those of the others."""
    removals = [row for row in rows if row['method'].startswith('hidden')]
    others = [row for row in rows if not row['method'].startswith('hidden')]
    return [*others, max(removals, key=lambda row: row['f1'])]


def by_points(rows: list[dict[str, Any]], figure: str) -> dict[str, float]:
    """Name a figure of each row ``METHOD.POINTS``, such as ``fine.10000``."""
    return {f'{row["method"].split()[0]}.{row["density"]}': row[figure] for row in rows}


def measure(density: int, rooms: int, positions: int) -> list[dict[str, Any]]:
    """
    Measure every method on the same cases, side by side.

    :returns: a row per method with its F1 and its median milliseconds per camera.
    """
    counts = {name: np.zeros(3) for name in METHODS}
    times: dict[str, list[float]] = {name: [] for name in METHODS}
    every = cases(density, rooms, positions)
    for _ in range(rooms):
        # Those of one room: the next look is from another place.
        own = list(islice(every, positions))
        for name, method in METHODS.items():
            counts[name] += sum(confusion(mask_of(method(case)), case.truth) for case in own)
            times[name] += cycled_seconds([partial(method, case) for case in own], 0.1)
    return best_radius_only([
        {'density': density, 'method': name, 'f1': f1_of(counts[name]),
         'ms': 1e3 * float(np.median(times[name]))} for name in METHODS])


def speed(points: int = 25000) -> dict[str, float]:
    """
    Time the judgement of four cameras in one room with the ``fast`` preset.

    :param points: points of the room.
    :returns: environment steps per second in two threads, evaluations per second with all cameras
        moved and with one of four moved, and how two threads scale.
    """
    scene = generate_room(FIRST_ROOM, points)
    simulator = Simulator(scene, SimulationConfig(engine=EngineConfig(preset='fast')))
    rng = np.random.default_rng(0)
    placements = rng.uniform(*scene.bounds, (300, 4, 3))
    views = [simulator.look(position) for position in placements[0]]

    def steps(seed: int) -> None:
        episode = Episode(PlaneProblem(simulator), np.random.default_rng(seed))
        for moves in rng.uniform(-0.5, 0.5, (300, 4, 2)):
            episode.move(moves)

    def one_moved(number: int) -> float:
        moved = [simulator.look(placements[number % 300, 0]), *views[1:]]
        return simulator.evaluate_views(moved).depth_error

    with ThreadPoolExecutor(2) as pool:
        both = median_seconds(lambda: list(pool.map(steps, range(2))))
        moved = median_seconds(lambda: list(pool.map(one_moved, range(600))))
        together = median_seconds(lambda: list(pool.map(simulator.evaluate, placements)))
    alone = median_seconds(lambda: list(map(simulator.evaluate, placements)))
    return {'points': len(scene), 'env_steps_per_s': 600 / both,
            'evaluations_per_s': 300 / together, 'evaluations_per_s_one_moved': 600 / moved,
            'scaling_2_threads': alone / together}


def training_speed(warm: int, timed: int) -> float:
    """
    Return the interactions per second of the training of ``config/train/paper.yaml``.

    :param warm: interactions before the clock starts; most rooms are made in them.
    :param timed: interactions that are timed.
    """
    config = read_config(Path('config/train/paper.yaml'))
    with TemporaryDirectory() as folder:
        model = build_model(config, Path(folder))
        model.set_env(environments(config, room_names(config.rooms, 'training')))
        model.env.seed(config.seed)
        model.learn(warm)
        began, before = time.perf_counter(), model.num_timesteps
        model.learn(timed, reset_num_timesteps=False)
        seconds = time.perf_counter() - began
        model.env.close()
        return (model.num_timesteps - before) / seconds


def scale(points: int) -> dict[str, float]:
    """
    Measure time and memory of one scene of many points with the ``fast`` preset.

    :param points: points of the room.
    :returns: nanoseconds per point and camera, bytes per point held for the scene, and seconds
        from points to a simulator.
    """
    scene = generate_room(FIRST_ROOM, points)
    began = time.perf_counter()
    simulator = Simulator(scene, SimulationConfig(
        rig=RigConfig(max_range=RANGE), engine=EngineConfig(preset='fast')))
    ready = time.perf_counter() - began
    places = free_places(scene, simulator.height, 4, np.random.default_rng(0))
    seconds = np.median(cycled_seconds([partial(simulator.look, place) for place in places]))
    return {'points': len(scene), 'ns_per_point_camera': 1e9 * float(seconds) / len(scene),
            'bytes_per_point': bytes_held(simulator) / len(scene), 'seconds_to_build': ready}


def bytes_held(simulator: Simulator) -> int:
    """Return the bytes that a simulator holds for its scene, the points included."""
    def held(value: Any) -> int:
        if isinstance(value, np.ndarray):
            return value.nbytes
        return sum(map(held, value)) if isinstance(value, (tuple, list)) else 0

    scene, parts = simulator.scene, (simulator.visibility, simulator.depth_error)
    return held((scene.points, scene.spacing, simulator.grid,
                 *(value for part in parts for value in vars(part).values())))


def measure_engine(extent: Extent) -> dict[str, Any]:
    """
    Measure how true the engine's visibility is and how fast it is, with progress on stderr.

    :returns: ``f1`` and ``ms`` by method and number of points, the figures of :func:`speed`,
        ``scale`` (a row per size of a room), and how much was measured.
    """
    # One thread for everybody: Embree and hidden point removal would take them all.
    cores, rows = os.sched_getaffinity(0), []
    os.sched_setaffinity(0, {min(cores)})
    try:
        for density in track(extent.densities, 'ray casting', console=Console(stderr=True)):
            rows += measure(density, extent.rooms, extent.positions)
        scales = [scale(points) for points in extent.scales]
    finally:
        os.sched_setaffinity(0, cores)
    return {'f1': by_points(rows, 'f1'), 'ms': by_points(rows, 'ms'), **speed(), 'scale': scales,
            'literal_interactions_per_s': training_speed(*extent.interactions),
            'rooms': extent.rooms, 'positions': extent.positions, 'range': RANGE}


def show(figures: dict[str, Any]) -> None:
    """Print the figures."""
    table = Table('method and points', 'F1', 'ms',
                  title='Visibility from one camera against ray casting, one thread')
    for name, score in figures['f1'].items():
        table.add_row(name, f'{score:.3f}', f'{figures["ms"][name]:.2f}')
    console = Console(width=110)
    console.print(table)
    for name in SPEEDS:
        console.print(f'{name}: {figures[name]:.1f}')


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, and print the figures."""
    parser = argparse.ArgumentParser(description='Measure the engine on this machine.')
    parser.add_argument('--preset', choices=('smoke', 'full'), default='smoke',
                        help='smoke: under a minute; full: a quarter of an hour')
    results.add_record(parser, 'engine')
    options = parser.parse_args(argv)
    figures = measure_engine(EXTENTS[options.preset])
    show(figures)
    if options.record:
        results.write('engine', figures, results.command_of('engine', argv))
    return 0


if __name__ == '__main__':
    sys.exit(main())
