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
What the agent is worth: as explorer before the common search, alone, and against all others.

    python -m benchmarks.agent --set validation --seeds 3 --out out/agent_validation.json
    python -m benchmarks.agent --set test --baselines 100 1000 --lengths 30x0.5 8x2 --cameras 4
    python -m benchmarks.agent --record validation=out/agent_validation.json ...

Online planners play the same episodes: ``learned`` (the agent explores, the search finishes),
``lookahead`` (its own plans explore), ``random`` (random moves explore, the search finishes) and
``alone`` (the agent moves until the end). Final placements are judged as in the benchmark, see
:mod:`ocp_ros.compare.protocol`. An interrupted comparison goes on from its file.
"""

import argparse
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
import json
import os
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import results
import numpy as np
from ocp_ros.compare.protocol import JUDGE_POINTS, judged_room, PLANE_RIG, SEARCH_POINTS
from ocp_ros.compare.summary import LOG_OFFSET_M
from ocp_ros.geometry.engine_config import PROMISING
from ocp_ros.online.lookahead import Lookahead
from ocp_ros.online.online_planner import Online, settings_of
from ocp_ros.online.step import play
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.policy.learned import Learned, PolicyAlone
from ocp_ros.policy.policy import Policy
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rig.rig_file import load_rig, with_count
from ocp_ros.rooms.room_sets import SETS
from ocp_ros.scenes.source_frame import BY_FILE
from ocp_ros.search.budget import Budget
from ocp_ros.search.plan import plan
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.training.encoded_environment import turn_for
from ocp_ros.training.validation import RandomMoves
from ocp_ros.util.files import write_atomically
from ocp_ros.util.resources import DEFAULT_MODEL, find_config, find_model
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.worker_pool import WorkerPool
from rich.console import Console
from rich.progress import track

RIG = 'config/rig/four_d455.yaml'
#: Cameras on a plane, or a rig file; turns and longest moves (metres); online planners.
CAMERAS = ('2', '4', '6', RIG)
LENGTHS = ('5x2', '8x2', '30x0.5')
PLANNERS = ('learned', 'lookahead', 'random', 'alone')
#: Planners that know the room's scores.
BASELINES = ('tdsa', 'bpso', 'regular_grid', 'random')


class Task(NamedTuple):
    """
    A room with all planners that play in it.

    :ivar room: seed or path of a scan.
    :ivar half: of a scan that planners see; the other half judges. 0 for generated rooms.
    :ivar rotation: degrees.
    :ivar cameras: number of cameras on a plane, or path of a rig file.
    :ivar length: turns and longest move, such as ``8x2``.
    """

    room: str
    half: int
    rotation: float
    cameras: str
    length: str

    @property
    def name(self) -> str:
        """Return the name of the task in a file: its setting, such as ``4_8x2``, and its room."""
        return f'{Path(self.cameras).stem}_{self.length}, {Path(self.room).stem}, {self.half}'

    @property
    def settings(self) -> SimulationConfig:
        """Return the settings of its episodes."""
        on_plane = self.cameras.isdecimal()
        settings = SimulationConfig(
            RigConfig(int(self.cameras)) if on_plane else RigConfig(), PROMISING,
            rig_file='' if on_plane else self.cameras)
        turns, metres = self.length.split('x')
        episode = EpisodeConfig(turns=int(turns), max_step=float(metres))
        return replace(settings, episode=replace(
            episode, max_turn=turn_for(episode.max_step, episode)))


def with_random_moves(policy: Policy, *settings) -> Online:
    """Return the planner ``learned`` whose cameras explore by random moves."""
    planner = Learned(policy, *settings)
    planner.explorer = RandomMoves(*settings)
    return planner


def makers(model: str) -> dict[str, Callable[..., Online]]:
    """Return what makes each online planner from the settings of ``Online``."""
    policy = Policy(Checkpoint.load(find_model(model)))
    return {'learned': partial(Learned, policy), 'lookahead': Lookahead,
            'random': partial(with_random_moves, policy), 'alone': partial(PolicyAlone, policy)}


def play_task(planners: Sequence[str], baselines: Sequence[int], seeds: int, model: str,
              task: Task) -> dict[str, dict[str, float]]:
    """
    Play a room.

    :returns: by planner the mean of the logarithm of the delivered depth error (plus 1 cm), the
        mean share of points seen in the episode, and milliseconds a turn.
    """
    settings = task.settings
    episode_config = settings.episode
    # All lengths of episodes share a room.
    settings = replace(settings, episode=EpisodeConfig())
    room = judged_room(task.room, task.rotation, settings, SEARCH_POINTS, JUDGE_POINTS, 0.0,
                       BY_FILE, task.half)
    problem = room.search_problem
    free, known = problem.rig.free, problem
    if free and baselines:
        # Planners that know the room place the same cameras as a rig on this plane.
        rig = with_count(load_rig(find_config(PLANE_RIG)), int(task.cameras))
        known = Problem.of(room.search_scene, rig, settings)
    found: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    make = makers(model)
    for seed in range(seeds):
        for name in planners:
            rng = np.random.default_rng([seed, 1])
            planner = make[name](*settings_of(episode_config, problem.rig, rng))
            episode = Episode(problem, np.random.default_rng([seed, 0]),
                              config=episode_config)
            outcome = play(planner, episode, clock=_processor_seconds)
            poses = episode.placement[:len(episode.turn.positions)]
            found[name].append((
                room.judge(poses[:, :3] if free else poses)['depth_error'],
                len(episode.observed) / len(episode.scene), 1e3 * outcome.seconds.mean()))
        for budget in baselines:
            for name in BASELINES:
                if name == 'random' and budget != 100:
                    continue
                poses = plan(known, Budget(evaluations=budget), name, seed=seed).poses
                found[f'{name}_{budget}'].append((
                    room.judge(poses[:, :3] if free else poses)['depth_error'], 1.0, 0.0))
    return {name: dict(zip(('log_error', 'seen', 'ms'), np.mean(
        [(np.log(error + LOG_OFFSET_M), seen, ms) for error, seen, ms in rows], axis=0).tolist()))
        for name, rows in found.items()}


def _processor_seconds() -> float:
    """Return the processor time of this process, seconds."""
    return float(sum(os.times()[:2]))


def ratios(tasks: dict[str, dict[str, dict[str, float]]], first: str = 'learned'
           ) -> dict[str, dict[str, Any]]:
    """
    Compare a planner with all others.

    :param tasks: of :func:`play_task`, by name.
    :returns: by planner: ``ratio``, the geometric mean of the errors of ``first`` / of it;
        its 95 % ``interval`` (bootstrap over rooms), and the rooms ``won`` by ``first``.
    """
    # A room counts once: its settings are averaged first.
    by_room: dict[str, list[dict[str, dict[str, float]]]] = defaultdict(list)
    for name, planners in tasks.items():
        by_room[name.split(', ', 1)[1]].append(planners)
    rng, found = np.random.default_rng(0), {}
    for other in next(iter(tasks.values())):
        if other == first:
            continue
        logs = np.array([np.mean([task[first]['log_error'] - task[other]['log_error']
                                  for task in room if other in task])
                         for room in by_room.values()])
        drawn = logs[rng.integers(len(logs), size=(10_000, len(logs)))].mean(axis=1)
        found[other] = {'ratio': float(np.exp(logs.mean())),
                        'interval': np.exp(np.percentile(drawn, [2.5, 97.5])).tolist(),
                        'won': int((logs < 0.0).sum()), 'rooms': len(logs)}
    return found


def summary(tasks: dict[str, dict[str, dict[str, float]]]) -> dict[str, Any]:
    """Return :func:`ratios` pooled and by setting, and the means of seen share and time."""
    groups = defaultdict(dict)
    for name, planners in tasks.items():
        groups[name.split(', ')[0]][name] = planners
    names = next(iter(tasks.values()))
    return {'pooled': ratios(tasks), 'settings': {name: ratios(part)
                                                  for name, part in groups.items()},
            **{figure: {planner: float(np.mean([task[planner][figure] for task in tasks.values()]))
                        for planner in names if planner in PLANNERS}
               for figure in ('seen', 'ms')}}


def main(argv: Sequence[str] | None = None) -> None:
    """Run."""
    parser = argparse.ArgumentParser(
        prog='agent', description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--set', choices=list(SETS), default='validation')
    parser.add_argument('--rooms', nargs='+', metavar='SCAN', help='scans instead')
    parser.add_argument('--most-rooms', type=int, help='play only the first rooms of the set')
    parser.add_argument('--halves', type=int, default=1, help='random halves of each scan')
    parser.add_argument('--seeds', type=int, default=1)
    parser.add_argument('--cameras', nargs='+', default=list(CAMERAS), help='numbers, rig files')
    parser.add_argument('--lengths', nargs='+', default=list(LENGTHS), help='such as 8x2')
    parser.add_argument('--planners', nargs='+', default=list(PLANNERS), choices=PLANNERS)
    parser.add_argument('--baselines', nargs='*', type=int, default=(), help='budgets of the '
                        'planners that know the room, evaluations')
    parser.add_argument('--model', default=DEFAULT_MODEL)
    parser.add_argument('--others', type=Path, help='a comparison of other weights, with as many '
                        'seeds: the planners that are not played, and have no weights, are taken '
                        'from it')
    parser.add_argument('--workers', type=int, default=os.cpu_count())
    parser.add_argument('--out', type=Path, help='file of this comparison')
    parser.add_argument('--record', nargs='+', metavar='NAME=FILE', help='write the summaries of '
                        'comparisons to docs/results/agent.json, and what all of them say about '
                        'lookahead; play nothing')
    options = parser.parse_args(argv)
    if options.record:
        record(options.record)
        return
    command = results.command_of('agent', argv)
    for path in options.rooms or ():
        # Scans are where the person who measures keeps them.
        command = command.replace(f' {path}', '', 1)
    command = command.replace('--rooms', '--rooms SCAN ...')
    rooms = (options.rooms or [str(seed) for seed in SETS[options.set]])[:options.most_rooms]
    angles = (0.0,) if options.rooms else (0.0, 15.0, 30.0, 45.0, 60.0, 75.0)
    tasks = [Task(room, half, angles[number % len(angles)], cameras, length)
             for number, room in enumerate(rooms) for half in range(options.halves)
             for cameras in options.cameras for length in options.lengths]
    settings = {'planners': options.planners, 'baselines': list(options.baselines),
                'seeds': options.seeds, 'model': options.model}
    document = json.loads(options.out.read_bytes()) if options.out.exists() else {}
    if document and document['settings'] != settings:
        raise ConfigurationError(
            f'{options.out}: found {document["settings"]}; expected the comparison that is asked '
            f'for, {settings}; name another file')
    played = document.get('tasks', {})
    left = [task for task in tasks if task.name not in played]
    others = json.loads(options.others.read_bytes())['tasks'] if options.others else {}
    job = partial(play_task, options.planners, options.baselines, options.seeds, options.model)
    with WorkerPool(options.workers) as pool:
        for number, found in track(pool.unordered(job, left), 'rooms', len(left),
                                   console=Console(stderr=True)):
            known = others.get(left[number].name, {})
            played[left[number].name] = found | {
                name: row for name, row in known.items() if name not in ('learned', 'alone')}
            write_atomically(options.out, json.dumps(results.stamped(
                {'settings': settings, 'tasks': played, 'summary': summary(played)}, command),
                indent=1) + '\n')
    print(json.dumps(summary(played), indent=1))


def record(named_files: Sequence[str]) -> None:
    """Write the summaries of some comparisons beside those of the same model, and the model."""
    path = results.FOLDER / 'agent.json'
    before = json.loads(path.read_text()) if path.exists() else {}
    checkpoint = Checkpoint.load(find_model(DEFAULT_MODEL))
    model = {'run': checkpoint.run, 'updates': checkpoint.updates, **{
        key: checkpoint.provenance[key] for key in ('interactions', 'seed', 'date')}}
    found = dict(before['comparisons']) if before.get('model') == model else {}
    tasks: dict[str, dict[str, dict[str, float]]] = {}
    for item in named_files:
        name, file = item.split('=', 1)
        document = json.loads(Path(file).read_bytes())
        found[name] = {key: document[key] for key in ('command', 'commit', 'date', 'summary')}
        if name != 'test':
            # Only the rooms that chose the weights are put together.
            tasks |= {task: {planner: values[planner] for planner in ('learned', 'lookahead')}
                      for task, values in document['tasks'].items() if 'lookahead' in values}
    results.write('agent', {'model': model, 'pooled': ratios(tasks), 'comparisons': found},
                  results.command_of('agent', None))


if __name__ == '__main__':
    main()
