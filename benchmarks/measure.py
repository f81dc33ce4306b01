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
How well the depth error measures a room, whatever its scan: turned, or with stray points.

The judge is the integral of the paper (eq. 3): depth maps from 100 random places in the air, of
50,000 points on the mesh that no search has seen, with rays cast at the mesh, and cameras 2 cm
off. Placements are of four D455 on walls.

    python -m benchmarks.measure --record
"""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace

from benchmarks import results
import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.geometry.depth_error import DepthError
from ocp_ros.geometry.engine_config import EngineConfig, PROMISING
from ocp_ros.geometry.visibility import MESH
from ocp_ros.report.rig_planning import PlannedRig, PlanTask
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.motion import mounted, MountingErrors
from ocp_ros.rig.rig_file import Rig, rig_of
from ocp_ros.rig.structure import Air
from ocp_ros.rooms.generator import generate_room
from ocp_ros.scenes.meshes import sample_faces
from ocp_ros.scenes.scene import Scene, turned
from ocp_ros.scenes.scene_files import scene_of
from ocp_ros.search.budget import Budget
from ocp_ros.search.candidate_pool import CandidatePool
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from scipy.stats import spearmanr

RIG = rig_of(4, 'realsense_d455', mount={'on': 'walls'})
#: Points of scans and of the judge, places that it looks from, and rows of its maps.
POINTS, JUDGED, PLACES, ROWS = 60_000, 50_000, 100, 64
#: How far cameras hang off, and how often they are hung.
MOUNTED = MountingErrors(0.02, count=8, seed=0)
#: Degrees that scans are turned by, and shares of stray points.
ANGLES, STRAYS = (17.0, 45.0), (0.002, 0.01, 0.05)
#: Random placements of a room, and evaluations of a search.
PLACEMENTS, EVALUATIONS = 40, 1000


class Judge:
    """
    The integral over a generated room.

    :param room: with its mesh.
    :param rig: that it judges placements of.
    """

    def __init__(self, room: Scene, rig: Rig = RIG) -> None:
        points = sample_faces(room.mesh.corners, JUDGED)[:, :3]
        scene = Scene(points.astype(np.float32), 'judge', mesh=room.mesh)
        self._simulator = Simulator(
            scene, SimulationConfig(engine=EngineConfig(MESH, error_rows=16)), rig.models)
        height = float(room.bounds[:, 2].mean())
        air = Air(room, FreePlane.of(room.points, height, 1, 0.0, clearance=0.0)).cells()
        places = air[np.random.default_rng(1).choice(len(air), PLACES, replace=False)]
        order = self._simulator.visibility.order
        self._simulator.depth_error = DepthError(
            scene.points[order], scene.spacing[order], scene.diameter, places, ROWS)

    def __call__(self, poses: np.ndarray) -> float:
        """Return the depth error of poses (K, 6), metres."""
        return self._simulator.evaluate(poses).depth_error

    def delivered(self, poses: np.ndarray) -> float:
        """Return the mean error of poses (K, 6) that are hung a little off, metres."""
        return float(np.mean([self(np.hstack([places, poses[:, 3:]]))
                              for places in mounted(poses[:, :3], MOUNTED)]))


def planned(scene: Scene, angle: float = 0.0) -> tuple[np.ndarray, float]:
    """
    Plan the rig in a scan that was turned by some degrees.

    :returns: poses (K, 6) in the room as it was, and the error that the engine promises, metres.
    """
    found = PlannedRig(scene, RIG, PlanTask(evaluations=EVALUATIONS), Budget(None, EVALUATIONS))
    poses = np.array(found.best.answer.poses)
    promise = found.best.validated.placement
    poses[:, :3] = poses[:, :3] @ rotation_matrix(np.deg2rad(angle))
    poses[:, 3] -= np.deg2rad(angle)
    return poses, promise


def placements_of(room: Scene) -> list[np.ndarray]:
    """Draw random placements of the rig: (K, 6) each."""
    pool = CandidatePool(Problem.of(room, RIG, SimulationConfig(engine=PROMISING)), 400)
    rng = np.random.default_rng(0)
    drawn = (pool.random_sites(RIG, rng) for _ in range(PLACEMENTS))
    return [np.array([site.pose for site in sites]) for sites in drawn if sites]


def objective_of(scene: Scene, kind: str) -> Callable[[np.ndarray], float]:
    """Return what the engine says of placements (K, 6) in a scan, with one kind of viewpoints."""
    config = SimulationConfig(engine=replace(PROMISING, viewpoints=kind))
    simulator = Simulator(scene, config, RIG.models)
    return lambda poses: simulator.evaluate(poses).depth_error


def compared(room: Scene, judge: Judge, kind: str) -> dict[str, list[float]]:
    """Compare the engine with the judge, and with itself in scans that are turned."""
    placements = placements_of(room)
    true = np.array([judge(poses) for poses in placements])
    known = objective_of(room, kind)
    here = np.array([known(poses) for poses in placements])
    changes = []
    for angle in ANGLES:
        rotation, there = rotation_matrix(np.deg2rad(angle)), objective_of(
            turned(room, angle), kind)
        for poses, error in zip(placements, here):
            moved = poses.copy()
            moved[:, :3] = poses[:, :3] @ rotation.T
            moved[:, 3] += np.deg2rad(angle)
            changes.append(abs(there(moved) / error - 1.0))
    good = np.argsort(true)[:len(true) // 2]
    return {'change': changes, 'rank': [spearmanr(true, here)[0]],
            'rank_good': [spearmanr(true[good], here[good])[0]],
            'over_judge': [float(np.median(here / true))]}


def strayed(room: Scene, share: float) -> Scene:
    """Return a room as it is read from a scan with stray points in its air."""
    drawn = np.random.default_rng(0).uniform(*room.bounds, (round(share * len(room)), 3))
    return scene_of(np.concatenate([room.points, drawn]), name=room.name)


def searches(room: Scene, judge: Judge) -> Iterator[tuple[str, float, float]]:
    """Plan in scans of a room; yield which it is, what is delivered and what was promised."""
    for angle in (0.0, *ANGLES):
        poses, promise = planned(turned(room, angle) if angle else room, angle)
        yield f'turned_{angle:g}', judge.delivered(poses), promise
    for share in (0.0, *STRAYS):
        poses, promise = planned(strayed(room, share))
        yield f'strays_{share:g}', judge.delivered(poses), promise


def geometric(ratios: list[float]) -> float:
    """Return the geometric mean."""
    return round(float(np.exp(np.mean(np.log(ratios)))), 3)


def measured(seeds: list[int]) -> dict:
    """Measure all in some generated rooms."""
    kinds: dict[str, dict[str, list[float]]] = {'air': {}, 'paper': {}}
    plans: dict[str, list[tuple[float, float]]] = {}
    for seed in seeds:
        room = generate_room(seed, POINTS)
        judge = Judge(room)
        for kind, found in kinds.items():
            for name, values in compared(room, judge, kind).items():
                found.setdefault(name, []).extend(values)
        for name, error, promise in searches(room, judge):
            plans.setdefault(name, []).append((error, promise))
            print(f'{seed} {name}: delivered {error:.2f} m, promised {promise:.2f} m',
                  flush=True)
    delivered = {name: np.array(found)[:, 0] for name, found in plans.items()}
    promised = {name: geometric(list(np.array(found)[:, 1] / np.array(found)[:, 0]))
                for name, found in plans.items()}
    turned_ratios = [ratio for angle in ANGLES for ratio in
                     delivered[f'turned_{angle:g}'] / delivered['turned_0']]
    return {
        'rooms': len(seeds), 'evaluations': EVALUATIONS,
        'viewpoints': {kind: {
            'turned_objective_change': round(float(np.mean(found['change'])), 4),
            'turned_objective_change_worst': round(float(np.max(found['change'])), 4),
            'rank_correlation': round(float(np.mean(found['rank'])), 3),
            'rank_correlation_good': round(float(np.mean(found['rank_good'])), 3),
            'over_judge': round(float(np.mean(found['over_judge'])), 3)}
            for kind, found in kinds.items()},
        'turned_delivered_ratio': geometric(turned_ratios),
        'turned_delivered_ratio_worst': round(float(max(turned_ratios)), 3),
        'stray_delivered_ratio': {f'{share:g}': geometric(list(
            delivered[f'strays_{share:g}'] / delivered['strays_0'])) for share in STRAYS},
        'promise_over_delivered': promised}


def main(argv: list[str] | None = None) -> None:
    """Run."""
    parser = argparse.ArgumentParser(prog='measure', description=__doc__)
    results.add_rooms(parser)
    results.add_record(parser, 'measure')
    options = parser.parse_args(argv)
    found = measured(results.rooms_of(options))
    print(found)
    if options.record:
        results.write('measure', found, results.command_of('measure', argv))


if __name__ == '__main__':
    main()
