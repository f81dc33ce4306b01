# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Prove which placements on candidates are the best in test rooms, and time the proofs."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import asdict
import os
import sys
import time
from typing import NamedTuple

from benchmarks import results
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
from ocp_ros.simulation.problem import Problem, space_of
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator

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


def main(argv: list[str] | None = None) -> int:
    """Prove, and print what came of it."""
    parser = argparse.ArgumentParser(prog='certificates', description=__doc__)
    parser.add_argument('--seeds', type=int, nargs='+', default=list(TEST), help='rooms')
    parser.add_argument('--cases', nargs='+', choices=CASES, default=list(CASES),
                        help='what to prove')
    results.add_record(parser, 'certificates')
    options = parser.parse_args(argv)
    cases = {}
    for name, found in measured(options.seeds, options.cases,
                                lambda line: print(line, file=sys.stderr, flush=True)).items():
        proofs = [one for _, one in found]
        cases[name] = {
            'title': CASES[name].name, 'seconds': CASES[name].seconds,
            'proved': sum(one.proved for one in proofs), 'worst_gap': max(
                one.gap for one in proofs),
            'rooms': {str(seed): {'gap': one.gap, **asdict(one)} for seed, one in found}}
        print(f'{CASES[name].name}: the best choice is proved in {cases[name]["proved"]} of '
              f'{len(found)} rooms within {CASES[name].seconds:g} s; the largest gap is '
              f'{100.0 * cases[name]["worst_gap"]:.1f} %')
    if options.record:
        results.write('certificates', {
            'points': POINTS, 'rows': ROWS, 'cores': os.cpu_count(), 'load': os.getloadavg()[0],
            'cases': cases}, results.command_of('certificates', argv))
    return 0


if __name__ == '__main__':
    sys.exit(main())
