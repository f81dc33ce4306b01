# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Prove which placements on candidates are the best in test rooms, and tell how long it took."""

import argparse
from collections.abc import Callable, Sequence
from datetime import date
import os
from pathlib import Path
import sys
import time
from typing import NamedTuple

from ocp_ros.evaluation.benchmark_rooms import space_of
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.planners.benders import STARTS
from ocp_ros.planners.candidate_pool import Pool
from ocp_ros.planners.candidate_proof import Certificate
from ocp_ros.planners.exact import exact_plane, RigQuestion
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rig.rig_file import load_rig
from ocp_ros.scenes.scene import Scene
from ocp_ros.scenes.splits import TEST
from ocp_ros.scenes.synthetic.generator import generate_room
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.util.files import write_atomically

#: Points of a room and rows of the depth maps.
POINTS, ROWS = 60000, 64
ENGINE = EngineConfig(preset='fine', error_rows=ROWS)


class ProofCase(NamedTuple):
    """
    What is proved.

    :ivar name: what it is called.
    :ivar cameras: how many, all around, on the plane; those of the rig file where there is one.
    :ivar candidates: how many at most.
    :ivar seconds: how long it may take, looking from the candidates included.
    :ivar rig: a rig file, or nothing.
    """

    name: str
    cameras: int
    candidates: int
    seconds: float
    rig: str = ''


CASES = {
    'four': ProofCase('Four omnidirectional cameras, 400 candidates', 4, 400, 60.0),
    'thousand': ProofCase('Four omnidirectional cameras, 1,000 candidates', 4, 1000, 120.0),
    'six': ProofCase('Six omnidirectional cameras, 400 candidates', 6, 400, 120.0),
    'd455': ProofCase('Four RealSense D455 on stands, 1,000 candidates', 4, 1000, 120.0,
                      'config/rig/four_d455.yaml')}


def proved(scene: Scene, case: ProofCase) -> Certificate:
    """Find the best placement on candidates in a room, and prove what can be in the time."""
    if case.rig:
        return _rig_proved(scene, case)
    config = SimulationConfig(rig=RigConfig(cameras=case.cameras), engine=ENGINE)
    simulator = Simulator(scene, config)
    return exact_plane(simulator, space_of(simulator), case.candidates, case.seconds, ROWS,
                       near=False).certificate


def _rig_proved(scene: Scene, case: ProofCase) -> Certificate:
    """Do the same for a rig file; in metres."""
    problem = Problem.of(scene, load_rig(case.rig), SimulationConfig(engine=ENGINE))
    began = time.monotonic()

    def over() -> bool:
        return time.monotonic() - began >= case.seconds

    asked = RigQuestion(problem, Pool(problem, case.candidates), case.seconds)
    proof = asked.question.solve(asked.offered, over, more=STARTS)
    return Certificate(len(asked.offered.poses), asked.rows, proof.loss, proof.bound,
                       proof.proved, time.monotonic() - began, proof.nodes)


def page(command: str, rows: dict[str, list[tuple[int, Certificate]]], load: float) -> str:
    """
    Write the results as Markdown.

    :param command: that makes them again.
    :param rows: seed and certificate of each room, for each case.
    :param load: of the machine, when it ended.
    """
    lines = ['# Certificates in the test rooms', '',
             'The planner `exact` chooses the poses of the cameras among candidate poses. A '
             'certificate says how much better any', 'other choice among the same candidates can '
             'be: [how good a plan is](explanation/certificate.md).', '',
             f'The rooms have {POINTS:,} points, and visibility is that of the preset `fine`. '
             f'This command measured the', f'tables on {date.today().isoformat()}, on '
             f'{os.cpu_count()} processors with a load of {load:.1f}:',
             '', f'    {command}', '',
             '| column | meaning |', '|---|---|',
             '| room | seed of the generated room |',
             '| candidates | number of candidate poses |',
             '| rows | rows of the depth maps that the depth error is computed with |',
             '| found | depth error of the best choice that was found |',
             '| bound | lower bound of the depth error of all choices among the candidates |',
             '| gap | (found - bound) / found; 0 means that the choice is proved to be the best |',
             '| subproblems | number of subproblems that the proof solved |',
             '| s | time in seconds; it includes the visibility of all candidates |']
    for name, found in rows.items():
        done = sum(certificate.proved for _, certificate in found)
        most = max(certificate.gap for _, certificate in found)
        lines += ['', f'## {CASES[name].name}', '',
                  f'In {done} of {len(found)} rooms the best choice is proved within '
                  f'{CASES[name].seconds:g} s. The largest gap is {100.0 * most:.1f} %.', '',
                  '| room | candidates | rows | found (m) | bound (m) | gap (%) | subproblems '
                  '| s |', '|---|---|---|---|---|---|---|---|']
        lines += [f'| {seed} | {one.candidates} | {one.rows} | {one.found:.4f} | {one.bound:.4f} '
                  f'| {100.0 * one.gap:.1f} | {one.nodes} | {one.seconds:.1f} |'
                  for seed, one in found]
    return '\n'.join([*lines, ''])


def measured(seeds: Sequence[int], cases: Sequence[str], told: Callable[[str], None]
             ) -> dict[str, list[tuple[int, Certificate]]]:
    """Prove each case in each room; the first room is done once before, to compile."""
    rows: dict[str, list[tuple[int, Certificate]]] = {name: [] for name in cases}
    for case in {bool(CASES[name].rig): CASES[name] for name in cases}.values():
        proved(generate_room(seeds[0], 2000), _quick(case))
    for seed in seeds:
        scene = generate_room(seed, POINTS)
        for name in cases:
            rows[name].append((seed, proved(scene, CASES[name])))
            told(f'{name} {seed}: {rows[name][-1][1]}')
    return rows


def _quick(case: ProofCase) -> ProofCase:
    """Return a case that takes a few seconds."""
    return case._replace(candidates=50, seconds=5.0)


def main(args: list[str] | None = None) -> int:
    """Write the page of the documentation."""
    parser = argparse.ArgumentParser(prog='certificates', description=__doc__)
    parser.add_argument('--out', type=Path, default=Path('out/certificates.md'),
                        help='page to write')
    parser.add_argument('--seeds', type=int, nargs='+', default=list(TEST), help='rooms')
    parser.add_argument('--cases', nargs='+', choices=CASES, default=list(CASES),
                        help='what to prove')
    options = parser.parse_args(args)
    rows = measured(options.seeds, options.cases,
                    lambda line: print(line, file=sys.stderr, flush=True))
    command = ' '.join(['python -m ocp_ros.evaluation.certificates', *(args or sys.argv[1:])])
    write_atomically(options.out, page(command, rows, os.getloadavg()[0]))
    print(f'wrote {options.out}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
