# SPDX-License-Identifier: Apache-2.0
"""
Measure the engine: how true its visibility is, and how fast it is.

Truth is ray casting of generated rooms' meshes. Everything runs on one thread in one process.
"""

import argparse
from collections.abc import Callable
from datetime import datetime, timezone
from functools import partial
import json
from pathlib import Path
import sys
import time
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from ocp_ros.benchmark.truth import ray_cast
from ocp_ros.geometry.shadow_maps import Pose
from ocp_ros.geometry.visibility import PRESETS
from ocp_ros.scenes.rooms import generate_room
from ocp_ros.scenes.scene import Scene
from ocp_ros.simulation.config import EngineConfig, RigConfig, SimulationConfig
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.simulator import Simulator

DENSITIES = (15000, 40000, 100000)
RANGE = 6.0
#: Rooms for the figures; none of them is a training room.
FIRST_ROOM = 200
#: Metres from a camera to the nearest surface.
CLEARANCE = 0.35


def median_seconds(call: Callable[[], Any], repeats: int) -> float:
    """Return the median time of a call that has been warmed up."""
    call()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return float(np.median(times))


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


def fidelity(preset: str, density: int, rooms: int, positions: int) -> dict[str, float]:
    """
    Compare the visibility of one preset with ray casting.

    :param preset: ``fine``, ``fast`` or ``paper``.
    :param density: points per room.
    :param rooms: how many rooms.
    :param positions: how many places of a camera in each.
    :returns: precision, recall, F1, and nanoseconds per point and camera.
    """
    config = SimulationConfig(rig=RigConfig(max_range=RANGE), engine=EngineConfig(preset=preset))
    right = wrong = missed = 0
    nanoseconds = []
    for seed in range(FIRST_ROOM, FIRST_ROOM + rooms):
        scene = generate_room(seed, density)
        simulator, rng = Simulator(scene, config), np.random.default_rng(seed)
        for position in free_places(scene, simulator.height, positions, rng):
            pose = Pose(position, np.eye(3))
            seen = np.zeros(len(scene), dtype=bool)
            seconds = median_seconds(partial(simulator.visibility.look, pose, seen), 3)
            nanoseconds.append(1e9 * seconds / len(scene))
            truth = ray_cast(scene.mesh, scene.points, pose.position, RANGE)
            right += int((seen & truth).sum())
            wrong += int((seen & ~truth).sum())
            missed += int((~seen & truth).sum())
    return {'precision': right / (right + wrong), 'recall': right / (right + missed),
            'f1': 2 * right / (2 * right + wrong + missed),
            'ns_per_point_camera': float(np.median(nanoseconds))}


def speed(points: int = 25000) -> dict[str, float]:
    """
    Time the whole judgement of four cameras in one room.

    :param points: points of the room.
    :returns: environment steps and evaluations per second.
    """
    scene = generate_room(FIRST_ROOM, points)
    simulator, rng = Simulator(scene, SimulationConfig()), np.random.default_rng(0)
    episode = Episode(simulator, rng)
    moves = rng.uniform(-0.5, 0.5, (50, 4, 2))
    steps = iter(np.concatenate([moves, moves]))
    positions = episode.turn.positions
    return {'points': len(scene),
            'env_steps_per_s': 1.0 / median_seconds(lambda: episode.move(next(steps)), 50),
            'evaluations_per_s': 1.0 / median_seconds(lambda: simulator.evaluate(positions), 50)}


def show(result: dict[str, Any]) -> None:
    """Print the figures."""
    table = Table('points', 'preset', 'precision', 'recall', 'F1', 'ns per point and camera',
                  title='Visibility against ray casting')
    for row in result['visibility']:
        table.add_row(f'{row["density"]:,}', row['preset'], f'{row["precision"]:.3f}',
                      f'{row["recall"]:.3f}', f'{row["f1"]:.3f}',
                      f'{row["ns_per_point_camera"]:.1f}')
    console = Console()
    console.print(table)
    figures = result['speed']
    console.print(f'4 cameras, {figures["points"]:,} points: '
                  f'{figures["env_steps_per_s"]:.0f} environment steps/s, '
                  f'{figures["evaluations_per_s"]:.0f} evaluations/s')


def main(args: list[str] | None = None) -> int:
    """Measure and write the figures."""
    parser = argparse.ArgumentParser(prog='bench', description=__doc__)
    parser.add_argument('--out', type=Path, default=Path('out/bench.json'))
    parser.add_argument('--rooms', type=int, default=20, help='rooms per density')
    parser.add_argument('--positions', type=int, default=6, help='camera positions per room')
    options = parser.parse_args(args)
    cases = [(preset, density) for density in DENSITIES for preset in PRESETS]
    rows = [{'density': density, 'preset': preset,
             **fidelity(preset, density, options.rooms, options.positions)}
            for preset, density in track(cases, 'ray casting', console=Console(stderr=True))]
    result = {'visibility': rows, 'speed': speed(), 'rooms': options.rooms,
              'positions': options.positions, 'range': RANGE,
              'date': datetime.now(timezone.utc).isoformat(timespec='seconds')}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=2) + '\n')
    show(result)
    print(f'wrote {options.out}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
