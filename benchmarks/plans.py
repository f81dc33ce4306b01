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
What plans deliver in the test rooms, beside the online planner and a search that sees the truth.

The judge is the integral of :mod:`benchmarks.measure`. The truth is the same search with rays cast
at the mesh in place of the engine's visibility, on fewer points. A hill climb from each answer
tells what the proof has left. The figures join docs/results/measure.json as ``plans``.

    python -m benchmarks.plans --record

With ``--crowds`` it measures many cameras with few evaluations instead, which join the file as
``crowds``.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from itertools import product
import json
from pathlib import Path
import time

from benchmarks import results
from benchmarks.measure import geometric, Judge, MOUNTED
from benchmarks.promise import DENSE, promise_of, rig_named
import numpy as np
from ocp_ros.geometry.engine_config import PROMISING
from ocp_ros.report.findings import expected
from ocp_ros.rig.motion import mounted
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rooms.generator import generate_room
from ocp_ros.scenes.scene import Scene
from ocp_ros.scenes.scene_files import load_scene, READERS
from ocp_ros.search.budget import Budget
from ocp_ros.search.candidate_pool import views_of
from ocp_ros.search.placements import move_camera
from ocp_ros.search.rig_plan import RigPlanner
from ocp_ros.simulation.ray_visibility import with_rays
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.util.annealing import annealed, between
from ocp_ros.util.settings import UserError

#: Rigs of :mod:`benchmarks.promise`; those that the online planner is compared with turn.
RIGS = ('d455_walls', 'd455_stands', 'all_round_stands')
#: Evaluations of a plan, and points of the scan that is searched with the truth.
EVALUATIONS, TRUE_POINTS = 2000, 15_000
#: Many cameras on the ceiling, few evaluations, the planners that are compared, and points.
CROWDS, BUDGETS, CROWD_PLANNERS, CROWD_POINTS = (
    (10, 32), (50, 500), ('rig_search', 'greedy_error', 'random'), 10_000)
#: Evaluations of a hill climb, its first and last step in metres, and radians for each metre.
CLIMBED, FAR, NEAR, TURN = 5000, 0.1, 0.005, 0.5
#: Evaluations of a plan in half a scan, random halves of a scan, and scans that are none.
HALVED, HALVES, MESHES = 500, 1, ('.obj', '.laz')


def planned(scene: Scene, rig_name: str) -> dict:
    """Plan, climb on from the answer, and let the online planner play."""
    rig, began = rig_named(rig_name), time.monotonic()
    planner = RigPlanner(scene, rig, PROMISING, Budget(evaluations=EVALUATIONS))
    plan = planner.plan(rig)
    seconds, known = time.monotonic() - began, plan.certificate
    problem, rng, step = planner.problem(rig), np.random.default_rng(0), [0.0]

    def steps():
        for number in range(CLIMBED):
            step[0] = between(FAR, NEAR, number / CLIMBED)
            yield 1e-12

    climbed = annealed(plan.answer.sites, lambda sites, _: problem.objective.loss(views_of(sites)),
                       lambda sites: move_camera(problem, sites, step[0], TURN * step[0], rng),
                       steps(), rng)
    online = RigPlanner(scene, rig, PROMISING, Budget(evaluations=EVALUATIONS),
                        planner='lookahead').plan(rig)
    # Where nearly all can be seen, no bound is above 0.
    proof = {'gap': 1.0, 'moved': 0.0, 'priced': 0} if known is None else {
        'gap': known.gap, 'moved': known.moved or 0.0, 'priced': known.candidates}
    return {'poses': plan.answer.poses.tolist(), 'seconds': seconds, **proof,
            'climbed': 1.0 - problem.objective.loss(views_of(climbed)) / plan.answer.loss,
            'online': online.answer.poses.tolist()}


def judged(seed: int, rig_name: str, known: dict | None) -> dict:
    """Plan, search with the truth and judge all, unless that is done; and promise."""
    room, rig = generate_room(seed, DENSE), rig_named(rig_name)
    scene = Scene(room.points, room.name)
    if known is None:
        known = planned(scene, rig_name)
        few = Scene(room.points[::len(room) // TRUE_POINTS], room.name, mesh=room.mesh)
        truth = RigPlanner(few, rig, with_rays(PROMISING, few),
                           Budget(evaluations=EVALUATIONS)).plan(rig)
        judge = Judge(room, rig)
        known |= {'delivered': judge.delivered(np.array(known['poses'])),
                  'online_delivered': judge.delivered(np.array(known['online'])),
                  'truth_delivered': judge.delivered(truth.answer.poses)}
    return {'room': seed, 'rig': rig_name, **known, **promise_of(scene, rig, known['poses'])}


def crowded(seed: int, cameras: int, evaluations: int) -> dict:
    """Plan many cameras with few evaluations by several planners, and judge their answers."""
    room = generate_room(seed, CROWD_POINTS)
    rig = rig_of(cameras, 'realsense_d455', mount={'on': 'ceiling'})
    judge, row = Judge(room, rig), {'room': seed, 'cameras': cameras, 'evaluations': evaluations}
    for name in CROWD_PLANNERS:
        began = time.process_time()
        plan = RigPlanner(Scene(room.points, room.name), rig, PROMISING,
                          Budget(evaluations=evaluations), planner=name).plan(rig)
        row |= {name: judge.delivered(plan.answer.poses),
                f'{name}_seconds': time.process_time() - began}
        if name == 'rig_search':
            row |= {'certified': plan.certificate is not None,
                    'promised': plan.validated.placement, 'worst': plan.validated.nothing}
    return row


def crowds_of(rows: list[dict]) -> list[dict]:
    """Sum up the rows with equal numbers of cameras and evaluations: ratios of errors."""
    found = []
    for cameras, evaluations in product(CROWDS, BUDGETS):
        some = [row for row in rows
                if (row['cameras'], row['evaluations']) == (cameras, evaluations)]
        found.append({
            'cameras': cameras, 'evaluations': evaluations, 'rooms': len(some),
            'share_of_nothing': round(float(np.mean(
                [row['rig_search'] / row['worst'] for row in some])), 4),
            # Ratios of sums, because some errors are nearly 0.
            **{f'plan_over_{name}': round(sum(row['rig_search'] for row in some)
                                          / sum(row[name] for row in some), 3)
               for name in CROWD_PLANNERS[1:]},
            'certified': round(float(np.mean([row['certified'] for row in some])), 2),
            'seconds': round(float(np.mean([row['rig_search_seconds'] for row in some])), 1)})
    return found


def halved(scene: Scene, rig_name: str, seed: int) -> dict:
    """Plan in a random half of the points of a scan, and judge by the other half."""
    rig, order = rig_named(rig_name), np.random.default_rng(seed).permutation(len(scene))
    here, there = (Scene(scene.points[np.sort(half)], scene.name)
                   for half in np.array_split(order, 2))
    poses = RigPlanner(here, rig, PROMISING, Budget(evaluations=HALVED)).plan(rig).answer.poses
    judge = Simulator(there, SimulationConfig(engine=PROMISING), rig.models)
    delivered = np.mean([judge.evaluate(np.hstack([places, poses[:, 3:]])).depth_error
                         for places in mounted(poses[:, :3], MOUNTED)])
    return {**promise_of(here, rig, poses.tolist()), 'delivered': float(delivered)}


def scans_of(folder: Path) -> dict:
    """
    Return how far promises hold in real scans that are split in half.

    What one half lacks the other lacks too, so that the expected error cannot be judged.
    """
    rows = []
    for path, rig, seed in product(sorted(folder.iterdir()), RIGS, range(HALVES)):
        if path.suffix in READERS and path.suffix not in MESHES:
            try:
                rows.append(halved(load_scene(path, max_points=2 * DENSE), rig, seed))
            except UserError as error:
                print(f'{path.name}: {error}')
                continue
            print(path.name, rig, rows[-1], flush=True)
    return {'plans': len(rows), 'promise_mean': geometric(
        [row['promised'] / row['delivered'] for row in rows])}


def summary_of(rows: list[dict]) -> dict:
    """Sum the rows up, by rig."""
    found: dict = {'rooms': len({row['room'] for row in rows}), 'evaluations': EVALUATIONS,
                   'rigs': {}}
    for rig in dict.fromkeys(row['rig'] for row in rows):
        some = [row for row in rows if row['rig'] == rig]
        online = [row['delivered'] / row['online_delivered'] for row in some]
        truth = [row['delivered'] / row['truth_delivered'] for row in some]
        hoped = [expected(row['promised'], row['worst'], unscanned=row['unscanned'])
                 for row in some]
        found['rigs'][rig] = {
            'delivered': round(sum(row['delivered'] for row in some), 2),
            'plan_over_lookahead': geometric(online),
            'plan_over_lookahead_worst': round(max(online), 3),
            'plan_over_truth': geometric(truth), 'plan_over_truth_worst': round(max(truth), 3),
            'promise_mean': geometric([row['promised'] / row['delivered'] for row in some]),
            'expected_mean': geometric([hope['depth_error'] / row['delivered']
                                        for hope, row in zip(hoped, some)]),
            'promise_coverage': round(float(np.mean(
                [hope['low'] <= row['delivered'] <= hope['high']
                 for hope, row in zip(hoped, some)])), 3),
            'priced_poses': int(np.median([row['priced'] for row in some])),
            'certificate_gap': round(float(np.median([row['gap'] for row in some])), 4),
            'certificate_gap_worst': round(max(row['gap'] for row in some), 4),
            'moved_off_grid': round(float(np.median([row['moved'] for row in some])), 4),
            'better_after_proof': round(max(row['climbed'] for row in some), 4)}
    return found


def main(argv: list[str] | None = None) -> None:
    """Run."""
    parser = argparse.ArgumentParser(prog='plans', description=__doc__)
    results.add_rooms(parser)
    parser.add_argument('--workers', type=int, default=2, help='processes')
    parser.add_argument('--out', type=Path, default=Path('out/plans.jsonl'),
                        help='rows that were found: their plans are not made again')
    results.add_record(parser, 'measure')
    parser.add_argument('--crowds', action='store_true', help='measure many cameras instead')
    parser.add_argument('--scans', type=Path, help='folder of real scans, for the interval')
    options = parser.parse_args(argv)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    keys, job = (('room', 'cameras', 'evaluations'), crowded) if options.crowds else (
        ('room', 'rig'), judged)
    known = {tuple(row[key] for key in keys): row for row in map(json.loads, lines)}
    rooms = results.rooms_of(options)
    wanted = list(product(rooms, CROWDS, BUDGETS) if options.crowds else product(rooms, RIGS))
    # Plans are judged once, and what is promised of them is computed again.
    rows = [known[task] for task in wanted if task in known] if options.crowds else []
    left = [task for task in wanted if task not in known] if options.crowds else [
        (*task, known.get(task)) for task in wanted]
    with ProcessPoolExecutor(options.workers) as pool, options.out.open('a') as file:
        for row in pool.map(job, *zip(*left)) if left else ():
            rows.append(row)
            print(json.dumps(row), file=file, flush=True)
    if options.crowds:
        crowds = {'rooms': len(rooms), 'points': CROWD_POINTS, 'rows': crowds_of(rows)}
        print(json.dumps(crowds, indent=1))
        if options.record:
            results.write('measure', crowds, results.command_of('plans', argv), part='crowds')
        return
    found = summary_of(rows)
    if options.scans:
        found['scans'] = scans_of(options.scans)
    print(json.dumps(found, indent=1))
    if options.record:
        command = results.command_of('plans', argv).replace(str(options.scans), 'FOLDER')
        results.write('measure', found, command, part='plans')


if __name__ == '__main__':
    main()
