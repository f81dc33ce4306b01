# SPDX-License-Identifier: Apache-2.0
"""
One protocol for all planners: the same rooms, budgets and seeds, and one judge.

Seconds are those of a processor's time, so that other work on the machine does not count.

While it searches, a planner is scored by the engine's ``fast`` preset. What counts is the depth
error of its final placement alone, judged anew with ``fine`` and depth maps of 128 x 256 pixels,
as the mean over cameras mounted 2 cm off: nobody mounts a camera to the millimetre, and a
placement that exploits the cells of a map loses what it gained.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
import time
from typing import Any

import numpy as np

from ocp_ros.evaluation.benchmark_rooms import POINTS, ROTATIONS, space_of, TEST_ROOMS
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.planners.budget import Budget
from ocp_ros.planners.candidate_pool import Pool, random_sites
from ocp_ros.planners.registry import OFFLINE, ONLINE
from ocp_ros.planners.rig_methods import PLANNERS
from ocp_ros.planners.rig_plan import RigPlanner
from ocp_ros.planners.rollout import play
from ocp_ros.planners.scorer import Scorer
from ocp_ros.planners.solve import solve
from ocp_ros.rig.rig_file import load_rig, Rig
from ocp_ros.scenes.scene import Scene
from ocp_ros.scenes.scene_files import UP_AXES
from ocp_ros.scenes.scene_source import make_room
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import PlaneProblem, Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.util.settings import ConfigurationError

#: Metres that cameras are mounted off; the first is what counts.
MOUNTING = (0.02, 0.05, 0.10)
#: How many ways of being off are averaged.
MOUNTINGS = 8
#: The control: placements drawn at random, this many of them, without any choice.
CONTROL, CONTROLS = 'random_placement', 32
#: What stands for a budget of evaluations where there are turns instead.
TURNS = 0
#: Places on the plane that together see whatever can be seen from it.
POOL = 1500


@dataclass(frozen=True)
class Protocol:
    """
    What is compared.

    :ivar rooms: seeds of generated rooms and paths of scans, as text.
    :ivar rotations: degrees about the vertical axis.
    :ivar planners: names of planners, offline and online.
    :ivar budgets: evaluations of offline planners; online ones have the episode's turns.
    :ivar seeds: how many runs of each.
    :ivar scale: metres per unit of the scans.
    :ivar up: the axis of the scans that points up.
    :ivar simulation: the rig, or a rig file, for which each planner plans under all its
        constraints; its engine is the judge's.
    :ivar model: weights of planners that have learned: path or name.
    """

    rooms: tuple[str, ...] = tuple(str(seed) for seed in TEST_ROOMS)
    rotations: tuple[float, ...] = ROTATIONS
    planners: tuple[str, ...] = (*OFFLINE, *ONLINE)
    budgets: tuple[int, ...] = (100, 1000, 10000)
    seeds: int = 3
    scale: float = 1.0
    up: str = 'z'
    simulation: SimulationConfig = SimulationConfig(engine=EngineConfig(preset='fine'))
    model: str = 'default'

    def __post_init__(self) -> None:
        """Refuse what cannot be compared."""
        known = PLANNERS if self.simulation.rig_file else {**OFFLINE, **ONLINE}
        for name in self.planners:
            if name not in known:
                raise ConfigurationError(f'planners: found {name!r}; expected some of '
                                         f'{sorted(known)}')
        for figure in ('planners', 'rooms', 'rotations', 'budgets'):
            given = getattr(self, figure)
            if len(set(given)) < len(given):
                raise ConfigurationError(f'{figure}: found {list(given)}; expected each once')
        if not 0.0 < self.scale < np.inf or self.up not in UP_AXES:
            raise ConfigurationError(
                f'protocol: found scale={self.scale!r} and up={self.up!r}; expected a number '
                f'above 0 and one of {sorted(UP_AXES)}')
        if any(not model.omnidirectional for model in self.simulation.rig.models):
            raise ConfigurationError(
                f'rig.sensors: found {self.simulation.rig.sensors!r}; expected omnidirectional: '
                'planners choose where cameras are, not where they look')
        if self.simulation.rig_file:
            load_rig(self.simulation.rig_file).check_rotations(
                self.rotations, f'rotations: found {list(self.rotations)}', '0 alone')
        if not self.rooms or not self.budgets or min(self.budgets) < 1 or self.seeds < 1:
            raise ConfigurationError(
                f'protocol: found {len(self.rooms)} rooms, budgets {list(self.budgets)} and '
                f'{self.seeds} seeds; expected at least one of each, all above 0')

    @property
    def tasks(self) -> list['BenchmarkTask']:
        """Return what can be done independently of each other: a room, turned, and a planner."""
        return [BenchmarkTask(room, rotation, planner) for room in self.rooms
                for rotation in self.rotations for planner in (CONTROL, *self.planners)]


@dataclass(frozen=True)
class BenchmarkTask:
    """One planner in one room, with all budgets and seeds."""

    room: str
    rotation: float
    planner: str


PRESETS = {
    'full': Protocol(),
    'smoke': Protocol(rooms=tuple(str(seed) for seed in TEST_ROOMS[:2]), rotations=(0.0,),
                      budgets=(100, 400), seeds=2),
}


class Judge:
    """
    Score final placements.

    :param simulator: the engine at its best.
    """

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        self._space = space_of(simulator)

    def __call__(self, placement: np.ndarray) -> dict[str, float]:
        """
        Judge one placement.

        :param placement: (K, 3) metres.
        :returns: ``exact``, and for each of ``MOUNTING`` the mean depth error of cameras mounted
            so far off, in metres; and the space coverage, in cubic metres.
        """
        return judged_off(placement, self._space.inside, self._evaluate)

    def _evaluate(self, placement: np.ndarray) -> tuple[float, float]:
        """Return depth error and space coverage."""
        result = self.simulator.evaluate(placement)
        return result.depth_error, result.space_coverage


class RigJudge:
    """
    Score final placements of a rig file by its objective.

    ``depth_error`` is objective x depth error of seeing nothing, metres: where the rig asks for
    nothing more, the depth error.

    :param problem: the rig in the room; its engine is at its best.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem

    def __call__(self, placement: np.ndarray) -> dict[str, float]:
        """Judge one placement (K, 6), metres and radians; see :meth:`Judge.__call__`."""
        # Who hangs a camera a little off hangs it on its mount all the same.
        return judged_off(placement, lambda positions: positions, self._evaluate)

    def _evaluate(self, placement: np.ndarray) -> tuple[float, float]:
        """Return the objective in metres, and space coverage."""
        result = self.problem.objective.evaluate(placement)
        return self.problem.error(result), result.space_coverage


def judged_off(placement: np.ndarray, inside: Callable[[np.ndarray], np.ndarray],
               evaluate: Callable[[np.ndarray], tuple[float, float]]) -> dict[str, float]:
    """Judge a placement as it is, and mounted a little off; see :meth:`Judge.__call__`."""
    error, coverage = evaluate(placement)
    judged = {'exact': error, 'space_coverage': coverage}
    for off in MOUNTING:
        judged[f'off_{100 * off:.0f}_cm'] = float(np.mean(
            [evaluate(moved)[0] for moved in mounted(placement, off, inside)]))
    judged['depth_error'] = judged[f'off_{100 * MOUNTING[0]:.0f}_cm']
    return judged


def mounted(placement: np.ndarray, off: float, inside: Callable[[np.ndarray], np.ndarray]
            ) -> np.ndarray:
    """
    Mount cameras a little off, in the same ways for every placement.

    :param placement: (K, 3) or (K, 6), metres and radians.
    :param off: how far each camera is off on the plane, metres.
    :param inside: moves positions (..., 2) to where cameras may be.
    :returns: (8, K, 3) or (8, K, 6).
    """
    angles = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, (MOUNTINGS, len(placement)))
    moved = np.repeat(placement[None], MOUNTINGS, axis=0)
    moved[..., :2] += off * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    moved[..., :2] = inside(moved[..., :2])
    return moved


def run_task(protocol: Protocol, task: BenchmarkTask) -> list[dict[str, Any]]:
    """
    Run a planner in a room with every budget and seed.

    :returns: one row for each run: what was run, ``Judge``'s figures, evaluations, seconds, the
        placement and the trace of the search.
    """
    scene = make_room(task.room, task.rotation, POINTS, protocol.scale, protocol.up)
    if protocol.simulation.rig_file:
        return _rig(protocol, scene, load_rig(protocol.simulation.rig_file), task)
    judge = Judge(Simulator(scene, protocol.simulation))
    if task.planner == CONTROL:
        return _control(judge, task)
    if task.planner in ONLINE:
        return _online(protocol, judge, task)
    engine = replace(protocol.simulation.engine, preset='fast')
    simulator = Simulator(scene, replace(protocol.simulation, engine=engine))
    space, rows = space_of(simulator), []
    # Kernels are read from disk before the clock runs.
    Scorer(simulator)([space.placement(space.random(np.random.default_rng(0)))])
    for budget in protocol.budgets:
        for seed in range(protocol.seeds):
            planner = OFFLINE[task.planner](space, np.random.default_rng([seed, budget]), budget)
            result = solve(planner, Scorer(simulator), budget, clock=time.process_time)
            rows.append({**asdict(task), 'budget': budget, 'seed': seed,
                         **judge(result.placement), 'searched': result.depth_error,
                         'evaluations': result.evaluations, 'seconds': result.seconds,
                         'placement': result.placement.tolist(), 'trace': result.trace.tolist()})
    return rows


def _online(protocol: Protocol, judge: Judge, task: BenchmarkTask) -> list[dict[str, Any]]:
    """Play an episode with every seed; the last placement is what counts."""
    rows = []
    for seed in range(protocol.seeds):
        online = ONLINE[task.planner](protocol.simulation, np.random.default_rng([seed, 1]),
                                      protocol.model)
        episode = Episode(PlaneProblem(judge.simulator), np.random.default_rng([seed, 0]))
        outcome = play(online, episode, clock=time.process_time)
        # Whoever ends beyond a wall is hung up on the near side of it.
        space, last = space_of(judge.simulator), outcome.trajectory[-1]
        placement = space.placement(space.inside(last[:, :2]))
        rows.append({**asdict(task), 'budget': TURNS, 'seed': seed, **judge(placement),
                     'evaluations': 0, 'seconds': float(outcome.seconds.sum()),
                     'seconds_per_turn': float(np.median(outcome.seconds)),
                     'seconds_at_most': float(outcome.seconds.max()),
                     'placement': placement.tolist(), 'trace': [],
                     'trajectory': outcome.trajectory.tolist()})
    return rows


def _control(judge: Judge, task: BenchmarkTask) -> list[dict[str, Any]]:
    """Judge random placements, and what all places of the plane together miss."""
    simulator, space = judge.simulator, space_of(judge.simulator)
    pool = space.placement(space.grid(POOL))
    least = simulator.judge(simulator.look_many(pool)).depth_error
    rng, rows = np.random.default_rng(0), []
    for seed in range(CONTROLS):
        placement = space.placement(space.random(rng))
        rows.append({**asdict(task), 'budget': 1, 'seed': seed, **judge(placement),
                     'lower_bound': least, 'evaluations': 1, 'seconds': 0.0,
                     'placement': placement.tolist(), 'trace': []})
    return rows


def _rig(protocol: Protocol, scene: Scene, rig: Rig, task: BenchmarkTask) -> list[dict[str, Any]]:
    """Plan a rig file with every budget and seed; see :func:`run_task`."""
    judge = RigJudge(Problem.of(scene, rig, protocol.simulation))
    if task.planner == CONTROL:
        return _rig_control(judge, task)
    # A time step of an online planner is an evaluation: its budget is that of the episode.
    budgets = (TURNS,) if task.planner in ONLINE else protocol.budgets
    rows = []
    for budget in budgets:
        for seed in range(protocol.seeds):
            began = time.process_time()
            limit = Budget(evaluations=budget or protocol.simulation.episode.turns)
            planner = RigPlanner(scene, rig, replace(protocol.simulation.engine, preset='fast'),
                                 limit, seed, planner=task.planner, model=protocol.model)
            plan, seconds = planner.plan(rig), time.process_time() - began
            rows.append({**asdict(task), 'budget': budget, 'seed': seed,
                         **judge(plan.answer.poses), 'searched': plan.answer.loss * plan.worst,
                         'evaluations': plan.answer.evaluations, 'seconds': seconds,
                         'placement': plan.answer.poses.tolist(), 'trace': []})
    return rows


def _rig_control(judge: RigJudge, task: BenchmarkTask) -> list[dict[str, Any]]:
    """Judge random feasible placements of a rig, and what all candidates together miss."""
    problem, rig = judge.problem, judge.problem.rig
    pool = Pool(problem, POOL)
    least = problem.error(problem.judge(pool.everywhere(rig)))
    rng, rows = np.random.default_rng(0), []
    while len(rows) < CONTROLS:
        if not (sites := random_sites(rig, pool, rng)):
            continue
        poses = np.array([site.pose for site in sites])
        rows.append({**asdict(task), 'budget': 1, 'seed': len(rows), **judge(poses),
                     'lower_bound': least, 'evaluations': 1, 'seconds': 0.0,
                     'placement': poses.tolist(), 'trace': []})
    return rows
