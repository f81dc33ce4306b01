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
One protocol for all planners: the same rooms, budgets and seeds, and one judge.

Seconds are processor time, so other work on the machine does not count.

A planner searches with the engine. Planners are compared by the error that the judge computes for
their final placement. The error that the engine computed in the search is reported too, as
``promised``.

The judge evaluates a placement on points that were not used in the search. The scores of a search
are too good for two reasons: its engine reports some occluded points as visible, and the placement
is fitted to the points of the search. So a placement in a generated room is evaluated on a
separate scan, by rays cast at the room's mesh. A scan of a real room has no mesh: half of its
points are held out of the search, and the engine evaluates on this half.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import product
from pathlib import Path
import time
from typing import Any

import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig, PROMISING
from ocp_ros.rig.motion import mounted, MountingErrors
from ocp_ros.rooms.room_sets import chosen_rooms, s3dis_folder, TEST, TEST_AREAS
from ocp_ros.rooms.scene_source import make_room
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.scenes.scene_files import READERS, scans_in
from ocp_ros.scenes.source_frame import BY_FILE, UP_CHOICES
from ocp_ros.search.budget import Budget
from ocp_ros.search.candidate_pool import CandidatePool
from ocp_ros.search.plan import plan, prepare_search
from ocp_ros.search.registry import OBSERVED, planner_names, REFERENCES, RIG_SEARCH
from ocp_ros.simulation.problem import make_problem, Problem
from ocp_ros.simulation.ray_visibility import with_rays
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.util.resources import DEFAULT_MODEL, find_config
from ocp_ros.util.settings import ConfigurationError

#: The rig of comparisons by default.
PLANE_RIG = 'config/rig/plane.yaml'
#: Number of random placements.
RANDOM_PLACEMENTS = 16
#: References: random placements, and the default planner with ray casting, whose placement is the
#: best known one.
RANDOM_PLACEMENT, RAY_SEARCH = REFERENCES
#: The figures of one run of a planner, by name.
Row = dict[str, Any]
#: Number of points of the scans for the judge and for searches.
JUDGE_POINTS = 90_000
SEARCH_POINTS = 60_000
#: Mounting errors that are averaged; searches use another seed.
MOUNTING_ERRORS = MountingErrors(0.02, count=8, seed=0)
#: Engine of the judge. As the depth error is defined, its depth maps have all points (one fold).
#: With a finer coverage grid, rays to its cells would take as long as rays to the points.
JUDGE_ENGINE = EngineConfig(preset='fine', error_rows=128, coverage_cell=0.5, error_folds=1)


def rooms_of_s3dis() -> list[str]:
    """
    Return the paths of the test rooms of S3DIS; [] if ``S3DIS_DIR`` is not set.

    :raises SceneError: if ``S3DIS_DIR`` is not a folder of S3DIS.
    """
    folder = s3dis_folder()
    return [] if folder is None else [str(path.resolve()) for area in TEST_AREAS
                                      for path in chosen_rooms(folder, area)]


def rooms_in(places: Sequence[Path], scale: float = 0.0, up: str = BY_FILE) -> list[str]:
    """
    Return the paths of scans; each is read once, as a check.

    :param places: scans, and folders of scans.
    :param scale: metres per unit of the scans; 0 for the unit in each file.
    :param up: the axis of the scans that points up.
    :raises SceneError: if a folder has no scans, or one of them cannot be used.
    """
    paths = []
    for place in places:
        scans = scans_in(place) if place.is_dir() else [place]
        if not scans:
            raise SceneError(f'{place}: found no scans; expected files of {", ".join(READERS)}')
        paths += [str(path.resolve()) for path in scans]
    # Few points are enough for a check.
    points = 15000
    for path in paths:
        try:
            make_room(path, 0.0, points, scale=scale, up=up)
        except SceneError as error:
            raise SceneError(f'{error}; every scan is compared: convert this file first, or '
                             'leave it out') from error
    return paths


def placement_settings(rig: str | Path = PLANE_RIG) -> SimulationConfig:
    """Return the settings of a comparison for the cameras of a rig file."""
    return SimulationConfig(engine=PROMISING, rig_file=str(find_config(rig).absolute()))


def error_and_coverage(problem: Problem, placement: np.ndarray) -> tuple[float, float]:
    """
    Return the error of a placement in metres, and its space coverage in cubic metres.

    The error is the objective value times the depth error of seeing nothing. This is the depth
    error if the rig has no other requirements.

    :param placement: (K, 3) or (K, 6), metres, map frame, and radians.
    """
    evaluation = problem.evaluate_views(problem.look(placement))
    return problem.error(evaluation), evaluation.space_coverage


class JudgedRoom:
    """
    A room with one scan for searches and one for the judge.

    :param name: the seed of a generated room or the path of a scan, as text.
    :param rotation: degrees about the vertical axis.
    :param config: the rig, or a rig file, and the engine of the search.
    :param search_points: number of points for searches; a scan is split into two halves of this
        number, one for searches and one for the judge.
    :param judge_points: number of points for the judge in a generated room.
    :param scale: metres per unit of a scan; 0 for the unit in the file.
    :param up: the axis of a scan that points up.
    :param half: random seed that selects the half of a scan for searches.
    :ivar search_scene: the scan for searches.
    :ivar judge_scene: the scan for the judge.
    """

    def __init__(self, name: str, rotation: float, config: SimulationConfig,
                 search_points: int = SEARCH_POINTS, judge_points: int = JUDGE_POINTS,
                 scale: float = 0.0, up: str = BY_FILE, half: int = 0) -> None:
        self.config = config
        if name.isdecimal():
            self.search_scene = make_room(name, rotation, search_points)
            # A second scan from the same tripods. Its points are others because their number is
            # another: the random numbers of both scans begin with the same seed.
            self.judge_scene = make_room(name, rotation, judge_points)
        else:
            self.search_scene, self.judge_scene = _split_scan(
                make_room(name, rotation, 2 * search_points, scale=scale, up=up), half)

    @cached_property
    def search_problem(self) -> Problem:
        """Return the problem of a search: its scan, with the engine that computes its scores."""
        return make_problem(self.search_scene, self.config)

    @cached_property
    def judge_problem(self) -> Problem:
        """Return the problem of the judge: its scan, with ray casting if there is a mesh."""
        return make_problem(self.judge_scene, replace(
            self.config, engine=with_rays(JUDGE_ENGINE, self.judge_scene)))

    @cached_property
    def ray_problem(self) -> Problem:
        """Return the problem of a search with ray casting, if there is a mesh."""
        # The coverage grid is as coarse as that of the judge, because rays to its cells take time.
        engine = replace(self.config.engine, coverage_cell=JUDGE_ENGINE.coverage_cell)
        return make_problem(self.search_scene, replace(
            self.config, engine=with_rays(engine, self.search_scene)))

    def promised_error(self, placement: np.ndarray) -> float:
        """Return the error, metres, of a placement (K, 3) or (K, 6) by the search's engine."""
        return error_and_coverage(self.search_problem, placement)[0]

    def judge(self, placement: np.ndarray) -> dict[str, float]:
        """
        Evaluate a final placement.

        :param placement: (K, 3) or (K, 6), metres, map frame, and radians.
        :returns: ``exact``, the error of the placement itself, metres; ``depth_error``, the mean
            error over mounting errors of 2 cm, metres; ``space_coverage``, cubic metres.
        """
        error, coverage = error_and_coverage(self.judge_problem, placement)
        errors = [error_and_coverage(self.judge_problem, moved)[0]
                  for moved in mounted(placement, MOUNTING_ERRORS)]
        return {'exact': error, 'depth_error': float(np.mean(errors)), 'space_coverage': coverage}


@lru_cache(maxsize=2)
def judged_room(*settings) -> JudgedRoom:
    """Return a room, given the arguments of :class:`JudgedRoom`; cache the last two rooms."""
    return JudgedRoom(*settings)


def _split_scan(scene: Scene, seed: int) -> tuple[Scene, Scene]:
    """Split the points of a scan at random into a half for searches and a half for the judge."""
    held_out = np.random.default_rng(seed).permutation(len(scene)) < len(scene) // 2
    return (Scene(scene.points[~held_out], scene.name), Scene(scene.points[held_out], scene.name))


@dataclass(frozen=True)
class Protocol:
    """
    Settings of a comparison.

    :ivar rooms: seeds of generated rooms and paths of scans, as text.
    :ivar rotations: degrees about the vertical axis.
    :ivar planners: names of planners, offline and online.
    :ivar budgets: evaluations of offline planners; online planners have the episode's turns.
    :ivar seeds: number of runs of each planner and budget.
    :ivar scale: metres per unit of the scans; 0 for the unit in each file.
    :ivar up: the direction of the scans that points up, ``'auto'`` or ``'file'``.
    :ivar simulation: the rig file, whose constraints apply to each planner, and the engine of
        searches, which computes the promised errors.
    :ivar model: weights of trained planners: path or name.
    :ivar policy: the agent of the planner ``own_policy``, see
        :func:`~ocp_ros.training.saved_agents.register_policy`; '' for none.
    :ivar observation: the observation of this agent.
    :ivar points: number of points of the scan for searches.
    :ivar judged_points: number of points of the scan for the judge.
    :ivar truth_budget: number of evaluations of the search with ray casting.
    """

    rooms: tuple[str, ...] = tuple(map(str, TEST))
    rotations: tuple[float, ...] = (0.0,)
    planners: tuple[str, ...] = field(default_factory=planner_names)
    budgets: tuple[int, ...] = (100, 1000)
    seeds: int = 3
    scale: float = 0.0
    up: str = BY_FILE
    simulation: SimulationConfig = field(default_factory=placement_settings)
    model: str = DEFAULT_MODEL
    policy: str = ''
    observation: str = 'dict'
    points: int = SEARCH_POINTS
    judged_points: int = JUDGE_POINTS
    truth_budget: int = 1000

    def __post_init__(self) -> None:
        """Reject settings that cannot be compared."""
        for name in self.planners:
            if name not in planner_names():
                raise ConfigurationError(f'planners: found {name!r}; expected some of '
                                         f'{sorted(planner_names())}')
        for setting in ('planners', 'rooms', 'rotations', 'budgets'):
            values = getattr(self, setting)
            if len(set(values)) < len(values):
                raise ConfigurationError(f'{setting}: found {list(values)}; expected each once')
        if not (0.0 <= self.scale < np.inf) or self.up not in UP_CHOICES:
            raise ConfigurationError(
                f'protocol: found scale={self.scale!r} and up={self.up!r}; expected a number '
                f'of 0 or more and one of {", ".join(UP_CHOICES)}')
        if not self.simulation.rig_file:
            raise ConfigurationError('protocol: found no rig file; expected one, such as '
                                     f'{PLANE_RIG}')
        self.simulation.placed_rig.check_rotations(
            self.rotations, found=f'rotations: found {list(self.rotations)}', expected='0 alone')
        if not self.rooms or not self.budgets or min(self.budgets) < 1 or self.seeds < 1:
            raise ConfigurationError(
                f'protocol: found {len(self.rooms)} rooms, budgets {list(self.budgets)} and '
                f'{self.seeds} seeds; expected at least one of each, all above 0')

    def runs(self, planner: str) -> list[tuple[int, int]]:
        """Return budget and seed of each run of a planner or reference in a room."""
        if planner == RANDOM_PLACEMENT:
            return [(1, seed) for seed in range(RANDOM_PLACEMENTS)]
        if planner == RAY_SEARCH:
            return [(self.truth_budget, 0)]
        # Online planners have turns instead of evaluations.
        budgets = (0,) if planner in planner_names(OBSERVED) else self.budgets
        return list(product(budgets, range(self.seeds)))

    def room(self, name: str, rotation: float) -> JudgedRoom:
        """Return a room with its scans for searches and for the judge."""
        return judged_room(name, rotation, self.simulation, self.points, self.judged_points,
                           self.scale, self.up)

    @property
    def cameras(self) -> int:
        """Return the number of cameras to place."""
        return len(self.simulation.placed_rig.cameras)

    @property
    def tasks(self) -> list['BenchmarkTask']:
        """Return the independent tasks: each a room, a rotation, and a planner or reference."""
        return [BenchmarkTask(room, rotation, planner) for room in self.rooms
                for rotation in self.rotations for planner in (*REFERENCES, *self.planners)]


@dataclass(frozen=True)
class BenchmarkTask:
    """
    One planner in one room, with all budgets and seeds.

    :ivar room: seed of a generated room or path of a scan, as text.
    :ivar rotation: degrees about the vertical axis.
    :ivar planner: name of a planner or reference.
    """

    room: str
    rotation: float
    planner: str


#: Protocols by name.
PRESETS = {'full': Protocol(),
           'smoke': Protocol(rooms=tuple(map(str, TEST[:2])), budgets=(100, 400), seeds=1)}


def run_task(protocol: Protocol, task: BenchmarkTask) -> list[dict[str, Any]]:
    """
    Run a planner in a room with every budget and seed.

    :returns: one row for each run: task, budget and seed, the judge's figures, evaluations,
        seconds, the placement, ``promised``, metres, and further figures of some planners: the
        optimality ``gap``, or the ``trajectory`` and the seconds of turns.
    """
    room = protocol.room(task.room, task.rotation)
    if protocol.policy:
        # Imported only here, as most comparisons need no gymnasium. A worker process does not know
        # the agent yet.
        from ocp_ros.training.saved_agents import register_policy
        register_policy(protocol.policy, protocol.observation)
    if task.planner == RANDOM_PLACEMENT:
        runs = _draw_placements(room.judge_problem)
    elif task.planner == RAY_SEARCH:
        runs = _run_planner(protocol, room.ray_problem, RAY_SEARCH)
    else:
        runs = _run_planner(protocol, room.search_problem, task.planner)
    return [{**asdict(task), 'budget': budget, 'seed': seed, **row, **room.judge(row['placement']),
             'promised': room.promised_error(row['placement']),
             'placement': row['placement'].tolist()}
            for (budget, seed), row in zip(protocol.runs(task.planner), runs)]


def _run_planner(protocol: Protocol, problem: Problem, name: str) -> Iterator[Row]:
    """Plan with every budget and seed; for ``RAY_SEARCH``, use the default planner."""
    prepare_search(name in planner_names(OBSERVED))
    planner = RIG_SEARCH if name == RAY_SEARCH else name
    for budget, seed in protocol.runs(name):
        start_time = time.process_time()
        # A turn of an online planner is an evaluation; its budget in the protocol is 0.
        evaluations = budget or problem.simulator.config.episode.turns
        result = plan(problem, Budget(evaluations=evaluations), planner, seed=seed,
                      model=protocol.model, clock=time.process_time)
        row = {'evaluations': result.evaluations, 'seconds': time.process_time() - start_time,
               'placement': result.poses}
        if result.certificate is not None:
            row['gap'] = result.certificate.gap
        if result.outcome is not None:
            seconds = result.outcome.seconds
            row |= {'seconds': float(seconds.sum()), 'seconds_per_turn': float(np.median(seconds)),
                    'seconds_at_most': float(seconds.max()),
                    'trajectory': result.outcome.trajectory.tolist()}
        yield row


def _draw_placements(problem: Problem) -> Iterator[Row]:
    """Yield random feasible placements without end, with the error of all candidates together."""
    rng = np.random.default_rng(0)
    candidates = 400
    pool = CandidatePool(problem, candidates)
    # If not all cameras fit, every draw would be empty.
    pool.check_fit(problem.objective)
    # No placement of these poses has a smaller error than cameras at all of them.
    lower_bound = problem.error(problem.evaluate_views(pool.union_views(problem.rig)))
    while True:
        placement = np.array([site.pose for site in pool.random_sites(problem.rig, rng)])
        # An empty placement, for which the spacing left too few candidates, is drawn again.
        if len(placement):
            yield {'lower_bound': lower_bound, 'evaluations': 1, 'seconds': 0.0,
                   'placement': placement}
