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
their final placement, see :mod:`ocp_ros.compare.judging`: by ray casting if there is a mesh. The
error that the engine computed in the search is reported too, as ``promised``.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
import time
from typing import Any

import numpy as np
from ocp_ros.compare.judging import JUDGE_POINTS, judged_room, JudgedRoom, SEARCH_POINTS
from ocp_ros.geometry.engine_config import PROMISING
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rooms.scene_source import make_room
from ocp_ros.rooms.splits import TEST
from ocp_ros.scenes.s3dis import chosen_rooms, s3dis_folder, TEST_AREAS
from ocp_ros.scenes.scene import SceneError
from ocp_ros.scenes.scene_files import READERS, scans_in
from ocp_ros.scenes.up_axis import BY_FILE, UP_CHOICES
from ocp_ros.search.budget import Budget
from ocp_ros.search.candidate_pool import CandidatePool
from ocp_ros.search.greedy import GreedySwap
from ocp_ros.search.plan import plan
from ocp_ros.search.pose_grid import PoseGrid
from ocp_ros.search.proof.column_generation import ColumnGeneration
from ocp_ros.search.proof.loss_trees import LossTrees
from ocp_ros.search.registry import OBSERVED, planner_names, planners_for, REFERENCES, RIG_SEARCH
from ocp_ros.search.scorer import Scorer
from ocp_ros.search.solve import solve
from ocp_ros.simulation.problem import make_problem, Problem, space_of
from ocp_ros.simulation.ray_visibility import with_rays
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.util.resources import DEFAULT_MODEL
from ocp_ros.util.settings import ConfigurationError

#: Number of random placements.
RANDOM_PLACEMENTS = 16
#: References: random placements; searches with ray casting, whose best placement is the best known
#: one; and the best placement of column generation on a grid and near it, with a lower bound.
RANDOM_PLACEMENT, RAY_SEARCH, PROVED_OPTIMUM = REFERENCES
#: The figures of one run of a planner, by name.
Row = dict[str, Any]


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


def placement_settings(cameras: int | None = None, rig: str | Path | None = None
                       ) -> SimulationConfig:
    """
    Return the configuration of cameras to place.

    :param cameras: number of cameras on a plane; None for the default.
    :param rig: path of a rig file, which replaces the cameras on a plane.
    """
    rig_config = RigConfig() if cameras is None else RigConfig(cameras=cameras)
    return SimulationConfig(rig_config, PROMISING, rig_file='' if rig is None else str(rig))


@dataclass(frozen=True)
class Protocol:
    """
    Settings of a comparison.

    :ivar rooms: seeds of generated rooms and paths of scans, as text.
    :ivar rotations: degrees about the vertical axis.
    :ivar planners: names of planners, offline and online.
    :ivar budgets: evaluations of offline planners; online planners have the episode's time steps.
    :ivar seeds: number of runs of each planner and budget.
    :ivar scale: metres per unit of the scans; 0 for the unit in each file.
    :ivar up: the direction of the scans that points up, ``'auto'`` or ``'file'``.
    :ivar simulation: the cameras on a plane, or a rig file whose constraints apply to each
        planner; and the engine of searches, which computes the promised errors.
    :ivar model: weights of trained planners: path or name.
    :ivar points: number of points of the scan for searches.
    :ivar judged_points: number of points of the scan for the judge.
    :ivar half: random seed that selects the half of a scan for searches; the judge has the other.
    :ivar truths: number of searches with ray casting; their best result is the best known.
    :ivar truth_budget: number of evaluations of each of these searches.
    :ivar candidates: number of places of the grid for ``PROVED_OPTIMUM``.
    :ivar proving: largest time of this proof, seconds.
    """

    rooms: tuple[str, ...] = tuple(map(str, TEST))
    rotations: tuple[float, ...] = (0.0,)
    planners: tuple[str, ...] = field(default_factory=planners_for)
    budgets: tuple[int, ...] = (100, 1000, 10000)
    seeds: int = 3
    scale: float = 0.0
    up: str = BY_FILE
    simulation: SimulationConfig = field(default_factory=placement_settings)
    model: str = DEFAULT_MODEL
    points: int = SEARCH_POINTS
    judged_points: int = JUDGE_POINTS
    half: int = 0
    truths: int = 3
    truth_budget: int = 3000
    candidates: int = 400
    proving: float = 60.0

    def __post_init__(self) -> None:
        """Reject settings that cannot be compared."""
        available = planners_for(bool(self.simulation.rig_file))
        for name in self.planners:
            if name not in available:
                raise ConfigurationError(f'planners: found {name!r}; expected some of '
                                         f'{sorted(available)}')
        for setting in ('planners', 'rooms', 'rotations', 'budgets'):
            values = getattr(self, setting)
            if len(set(values)) < len(values):
                raise ConfigurationError(f'{setting}: found {list(values)}; expected each once')
        if not (0.0 <= self.scale < np.inf) or self.up not in UP_CHOICES:
            raise ConfigurationError(
                f'protocol: found scale={self.scale!r} and up={self.up!r}; expected a number '
                f'of 0 or more and one of {", ".join(UP_CHOICES)}')
        if any(not model.omnidirectional for model in self.simulation.rig.models):
            raise ConfigurationError(
                f'rig.sensors: found {self.simulation.rig.sensors!r}; expected omnidirectional: '
                'planners choose where cameras are, not where they look')
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
        if planner == PROVED_OPTIMUM:
            return [(self.candidates, 0)]
        if planner == RAY_SEARCH and self.simulation.rig_file:
            # With a rig file the views of all candidates are slow to compute, so there is one
            # search with a fifth of the evaluations.
            return [(max(int(0.2 * self.truth_budget), 1), 0)]
        if planner == RAY_SEARCH:
            return [(self.truth_budget, seed) for seed in range(self.truths)]
        # Online planners have time steps instead of evaluations.
        budgets = (0,) if planner in planner_names(OBSERVED) else self.budgets
        return list(product(budgets, range(self.seeds)))

    def room(self, name: str, rotation: float) -> JudgedRoom:
        """Return a room with its scans for searches and for the judge."""
        return judged_room(name, rotation, self.simulation, self.points, self.judged_points,
                           self.scale, self.up, self.half)

    @property
    def cameras(self) -> int:
        """Return the number of cameras to place."""
        return len(self.simulation.placed_rig.cameras)

    @property
    def references(self) -> tuple[str, ...]:
        """Return the names of the references; ``PROVED_OPTIMUM`` is not for rig files."""
        return (RANDOM_PLACEMENT, RAY_SEARCH) if self.simulation.rig_file else REFERENCES

    @property
    def tasks(self) -> list['BenchmarkTask']:
        """Return the independent tasks: each a room, a rotation, and a planner or reference."""
        return [BenchmarkTask(room, rotation, planner) for room in self.rooms
                for rotation in self.rotations for planner in (*self.references, *self.planners)]


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


#: Number of places on the plane whose views together count as everything visible from the plane.
REFERENCE_PLACES = 400
#: Protocols by name.
PRESETS = {'full': Protocol(),
           'smoke': Protocol(rooms=tuple(map(str, TEST[:2])), budgets=(100, 400), seeds=2)}


def run_task(protocol: Protocol, task: BenchmarkTask) -> list[dict[str, Any]]:
    """
    Run a planner in a room with every budget and seed.

    :returns: one row for each run: task, budget and seed, the judge's figures, evaluations,
        seconds, the placement, ``promised``, metres, and the trace of the search.
    """
    room = protocol.room(task.room, task.rotation)
    return [{**asdict(task), 'budget': budget, 'seed': seed, **row, **room.judge(row['placement']),
             'promised': room.promised_error(row['placement']),
             'placement': row['placement'].tolist()}
            for (budget, seed), row in zip(protocol.runs(task.planner),
                                           _run_all(protocol, room, task.planner))]


def _run_all(protocol: Protocol, room: JudgedRoom, planner: str) -> Iterator[Row]:
    """Return an iterator that runs a planner or reference, and yields the figures of each run."""
    if planner == RANDOM_PLACEMENT:
        return _draw_placements(room.judge_problem)
    if planner == PROVED_OPTIMUM:
        return _prove_optimum(protocol, room.search_problem)
    # In a free rig, cameras move on a plane without any constraint.
    if planner == RAY_SEARCH and room.search_problem.rig.free:
        return _search_with_rays(protocol, room.ray_simulator())
    if planner == RAY_SEARCH:
        engine = with_rays(room.config.engine, room.search_scene)
        return _run_planner(protocol, make_problem(room.search_scene, replace(
            room.config, engine=engine)), RAY_SEARCH)
    return _run_planner(protocol, room.search_problem, planner)


def _run_planner(protocol: Protocol, problem: Problem, name: str) -> Iterator[Row]:
    """Plan with every budget and seed; for ``RAY_SEARCH``, use the default planner."""
    planner = RIG_SEARCH if name == RAY_SEARCH else name
    config = problem.simulator.config
    on_plane = problem.rig.free
    if on_plane:
        # Load the compiled kernels from disk before time is measured.
        problem.judge(problem.look(problem.start(
            np.random.default_rng(0), config.episode, protocol.cameras)))
    for budget, seed in protocol.runs(name):
        start_time = time.process_time()
        # A time step of an online planner is an evaluation; its budget in the protocol is 0.
        evaluations = budget or config.episode.turns
        result = plan(problem, Budget(evaluations=evaluations), planner, seed=seed,
                      model=protocol.model, clock=time.process_time)
        row = {'evaluations': result.evaluations, 'seconds': time.process_time() - start_time,
               'placement': result.poses[:, :3] if on_plane else result.poses,
               'trace': [] if result.trace is None else result.trace.tolist()}
        if result.outcome is not None:
            seconds = result.outcome.seconds
            row |= {'seconds': float(seconds.sum()), 'seconds_per_turn': float(np.median(seconds)),
                    'seconds_at_most': float(seconds.max()),
                    'trajectory': result.outcome.trajectory.tolist()}
        yield row


def _search_with_rays(protocol: Protocol, simulator: Simulator) -> Iterator[Row]:
    """Search on the plane with a simulator that casts rays; yield the figures of each run."""
    space = space_of(simulator)
    for budget, seed in protocol.runs(RAY_SEARCH):
        planner = GreedySwap(space, np.random.default_rng([seed, budget]), budget)
        result = solve(planner, Scorer(simulator), budget, clock=time.process_time)
        yield {'evaluations': result.evaluations, 'seconds': result.seconds,
               'placement': result.placement, 'trace': result.trace.tolist()}


def _prove_optimum(protocol: Protocol, problem: Problem) -> Iterator[Row]:
    """Run column generation on a grid of places, then with added places; yield one row."""
    simulator = problem.simulator
    start_time = time.process_time()
    space = space_of(simulator)
    rng = np.random.default_rng(0)
    grid = PoseGrid(simulator)

    def should_stop() -> bool:
        return time.process_time() - start_time >= protocol.proving

    def add_places(positions: np.ndarray) -> None:
        # Omnidirectional cameras need one heading at each place.
        headings = [np.zeros((1, 3))] * len(positions)
        grid.add_poses(space.placement(space.inside(positions)), headings)

    # Find the best choice on the grid.
    add_places(space.grid(protocol.candidates))
    # The spacing 0.0 allows any distance between two cameras.
    relaxation = ColumnGeneration(LossTrees.of(problem.objective), [grid], [space.cameras], 0.0,
                                  len(simulator.scene))
    relaxation.raise_bound(should_stop)
    max_choices = 8
    # The best choice comes first.
    best = relaxation.find_choices(max_choices, rng, should_stop)[0]
    # In each round, places on two rings around each camera of the best choice join the grid.
    directions = 8
    angles = np.arange(directions) * (2.0 * np.pi / directions)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for radius_m in (0.2, 0.1, 0.05, 0.02):
        best_positions = grid.places[[column.place for column in best.columns], :2]
        rings = radius_m * np.concatenate([ring, 0.5 * ring])
        add_places((best_positions[:, None] + rings).reshape(-1, 2))
        relaxation.add_columns(best.columns)
        relaxation.raise_bound(should_stop)
        # Choices are compared by their loss first.
        best = min([best, *relaxation.find_choices(max_choices, rng, should_stop)])
    # A loss of 1 is the error without any visible point.
    error_per_loss = simulator.depth_error.worst
    # Rounding must not raise the bound above the loss.
    bound = min(relaxation.bound, best.loss)
    # With a gap below 0.1 % the placement counts as proved optimal.
    yield {'evaluations': 0, 'seconds': time.process_time() - start_time,
           'placement': grid.places[[column.place for column in best.columns]], 'trace': [],
           'found': error_per_loss * best.loss, 'bound': error_per_loss * bound,
           'proved': bool(bound >= best.loss * (1.0 - 1e-3))}


def _draw_placements(problem: Problem) -> Iterator[Row]:
    """Yield random feasible placements without end, with the error of all candidates together."""
    rng = np.random.default_rng(0)
    rig = problem.rig
    if rig.free:
        space = space_of(problem.simulator)
        views = problem.simulator.look_many(space.placement(space.grid(REFERENCE_PLACES)))
    else:
        pool = CandidatePool(problem, REFERENCE_PLACES)
        # If not all cameras fit, every draw would be empty.
        pool.check_fit(problem.objective)
        views = pool.union_views(rig)
    # No placement of these poses has a smaller error than cameras at all of them.
    lower_bound = problem.error(problem.judge(views))
    while True:
        placement = space.placement(space.random(rng)) if rig.free else np.array(
            [site.pose for site in pool.random_sites(rig, rng)])
        # An empty placement, for which the spacing left too few candidates, is drawn again.
        if len(placement):
            yield {'lower_bound': lower_bound, 'evaluations': 1, 'seconds': 0.0, 'trace': [],
                   'placement': placement}
