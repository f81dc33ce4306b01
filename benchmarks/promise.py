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
How far what a plan delivers is from what the engine promises: the table behind the promise.

Plans are made in validation rooms, scanned densely and thinly and with a surface missing, and are
judged by the integral of :mod:`benchmarks.measure`. The table holds, for cameras under the ceiling
and for all others, the ratios of what is delivered to what is promised, both with an offset, that
one room in twenty is below, that half of the plans are below, and that one room in twenty is above
(split conformal prediction over rooms). To what is promised, a share is added of
the error of seeing nothing where the scan shows nothing: the one with which the ratios differ
least.

    python -m benchmarks.promise --record
"""

import argparse
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
import json
from pathlib import Path
from typing import NamedTuple

from benchmarks import results
from benchmarks.measure import EVALUATIONS, Judge
import numpy as np
from ocp_ros.geometry.engine_config import PROMISING
from ocp_ros.rig.rig_file import Rig, rig_of
from ocp_ros.rooms.generator import generate_room
from ocp_ros.rooms.room_sets import SETS
from ocp_ros.scenes.scene import Scene
from ocp_ros.search.budget import Budget
from ocp_ros.search.rig_plan import RigPlanner
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.util.files import write_atomically

#: The table that the package reads.
TABLE = results.ROOT / 'ocp_ros' / 'report' / 'promise.json'
#: Rigs: sensor and mount.
RIGS = {'d455_walls': ('realsense_d455', {'on': 'walls'}),
        'd455_stands': ('realsense_d455', {'on': 'plane', 'height': 1.6}),
        'all_round_stands': ('omnidirectional', {'on': 'plane', 'height': 1.6}),
        'all_round_ceiling': ('omnidirectional', {'on': 'ceiling'})}
#: Points of dense, thin and sparse scans, and metres of a missing surface's layer.
DENSE, THIN, SPARSE, LAYER = 60_000, 15_000, 3_000, 0.15
#: Share of the error of seeing nothing that is added to both: ratios of small errors say little.
OFFSET = 0.05
#: Shares of what was not scanned that may count as unseen.
SHARES = np.arange(11) / 10.0
#: Chance that what is delivered is below or above the interval.
OUTSIDE = 0.05


class Case(NamedTuple):
    """
    A plan.

    :ivar rig: a name of :data:`RIGS`.
    :ivar points: of the scan.
    :ivar missing: ``ceiling``, ``floor`` or nothing.
    """

    rig: str
    points: int = DENSE
    missing: str = ''


CASES = (*(Case(rig) for rig in RIGS), Case('d455_walls', THIN), Case('all_round_stands', THIN),
         Case('d455_walls', DENSE, 'ceiling'), Case('d455_walls', DENSE, 'floor'))
#: Scans with a median pitch above :data:`~ocp_ros.report.findings.SPARSE_PITCH_M`.
SPARSE_CASES = Case('d455_walls', SPARSE), Case('all_round_stands', SPARSE)


def rig_named(name: str) -> Rig:
    """Return a rig of four cameras."""
    sensor, mount = RIGS[name]
    return rig_of(4, sensor, mount=mount)


def scanned(room: Scene, missing: str) -> Scene:
    """Return what a scan shows of a room without a surface."""
    low, high = room.bounds[:, 2]
    z = room.points[:, 2]
    kept = (z < high - LAYER if missing == 'ceiling' else
            z > low + LAYER if missing == 'floor' else np.ones(len(z), dtype=bool))
    return Scene(room.points[kept], room.name)


def promise_of(scene: Scene, rig: Rig, poses: list[list[float]]) -> dict[str, float]:
    """
    Return what the engine says of a plan in a scan, metres.

    :returns: the error that is promised, that of seeing nothing, and that of seeing nothing where
        the scan shows nothing.
    """
    validation = Problem.of(scene, rig, SimulationConfig(engine=PROMISING)).objective.validation
    error = validation.simulator.depth_error
    return {'promised': validation.depth_error(validation.look(np.array(poses))),
            'worst': error.worst, 'unscanned': error.unscanned.error}


def row_of(seed: int, case: Case, known: dict | None) -> dict:
    """Plan and judge unless that is done, and promise."""
    rig, scene = rig_named(case.rig), scanned(generate_room(seed, case.points), case.missing)
    if known is None:
        planner = RigPlanner(scene, rig, PROMISING, Budget(evaluations=EVALUATIONS))
        poses = planner.plan(rig).answer.poses
        known = {'poses': poses.tolist(), 'commit': results.commit(),
                 'delivered': Judge(generate_room(seed, DENSE), rig).delivered(poses)}
    return {'room': seed, **case._asdict(), **known, **promise_of(scene, rig, known['poses'])}


def ratios_of(rows: list[dict], share: float) -> np.ndarray:
    """Return what is delivered over what is promised, given a share of what was not scanned."""
    offset = OFFSET * np.array([row['worst'] for row in rows])
    delivered, promised, unscanned = (np.array([row[key] for row in rows]) for key in (
        'delivered', 'promised', 'unscanned'))
    return (delivered + offset) / (promised + share * unscanned + offset)


def share_of(rows: list[dict]) -> float:
    """Return the share of what was not scanned with which the ratios differ least."""
    return float(min(SHARES, key=lambda share: np.log(ratios_of(rows, share)).std()))


def quantiles(rows: list[dict], share: float) -> list[float]:
    """
    Return the ratios that 5 % of the rooms are below, half of the plans, and 5 % are above.

    Plans in one room are alike, so rooms are counted: each by its least and its largest ratio, of
    which the ranks are those of n + 1.
    """
    ratios = ratios_of(rows, share)
    of_room = [ratios[[row['room'] == room for row in rows]]
               for room in dict.fromkeys(row['room'] for row in rows)]
    rank = int(np.floor(OUTSIDE * (len(of_room) + 1)))
    least, largest = np.sort([some.min() for some in of_room]), np.sort(
        [some.max() for some in of_room])
    found = least[max(rank - 1, 0)], np.median(ratios), largest[-max(rank, 1)]
    return [round(float(value), 3) for value in found]


def missed_of(rows: list[dict], share: float) -> dict:
    """Return the ratios of scans that do not show everything, and those without the offset."""
    times = [row['delivered'] / row['promised'] for row in rows]
    return {'plans': len(rows), 'ratios': quantiles(rows, share),
            'times': [round(min(times), 2), round(max(times), 2)]}


def table_of(rows: list[dict]) -> dict:
    """Return the ratios by mount, and for each missing surface."""
    whole = [row for row in rows if not row['missing']]
    share = share_of(whole)
    found = {'offset': OFFSET, 'unscanned': share}
    for name, under in (('mount_ceiling', True), ('mount_others', False)):
        some = [row for row in whole if row['rig'].endswith('ceiling') == under]
        found[name] = {'plans': len(some), 'ratios': quantiles(some, share)}
    for surface in ('ceiling', 'floor'):
        found[surface] = missed_of([row for row in rows if row['missing'] == surface],
                                   share)
    return found


def tasks(seeds: list[int], cases: tuple[Case, ...]) -> Iterator[tuple[int, Case]]:
    """Yield rooms and what is planned in them."""
    for seed in seeds:
        for case in cases:
            yield seed, case


def main(argv: list[str] | None = None) -> None:
    """Run."""
    parser = argparse.ArgumentParser(prog='promise', description=__doc__)
    parser.add_argument('--rooms', type=int, default=18, help='how many validation rooms')
    parser.add_argument('--workers', type=int, default=2, help='processes')
    parser.add_argument('--out', type=Path, default=Path('out/promise.jsonl'),
                        help='rows that were found: their plans are not made again')
    parser.add_argument('--sparse', action='store_true',
                        help='measure sparse scans alone, whose ratios join the table')
    parser.add_argument('--record', action='store_true', help=f'write {TABLE.name}')
    options = parser.parse_args(argv)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in options.out.read_text().splitlines()
            ] if options.out.exists() else []
    known = {(row['room'], row['rig'], row['points'], row['missing']): row for row in rows}
    left = [(seed, case, known.get((seed, *case))) for seed, case in tasks(
        list(SETS['validation'])[:2 * options.rooms:2],
        SPARSE_CASES if options.sparse else CASES)]
    rows = []
    with ProcessPoolExecutor(options.workers) as pool, options.out.open('a') as file:
        for row in pool.map(row_of, *zip(*left)):
            rows.append(row)
            print(json.dumps(row), file=file, flush=True)
    before = json.loads(TABLE.read_text())
    found = missed_of(rows, before['unscanned']) if options.sparse else table_of(rows)
    print(json.dumps(found, indent=1))
    if options.record:
        found = results.stamped({
            'commits_of_plans': sorted({row['commit'] for row in rows}), **found},
            results.command_of('promise', argv))
        write_atomically(TABLE, json.dumps(
            before | {'sparse': found} if options.sparse else found | {
                'sparse': before['sparse']}, indent=1) + '\n')


if __name__ == '__main__':
    main()
