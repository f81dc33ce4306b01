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
How good placements are after few long turns and after many short ones.

    python -m benchmarks.few_turns --set test --out docs/results/few_turns_test.json

Online planners play the same rooms with episodes of several lengths; their last placements are
judged as in the benchmark, see :mod:`ocp_ros.compare.judging`. The best known placement of a
room is the best of all these and of a search that sees the truth.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
import json
import os
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.results import stamped
import numpy as np
from ocp_ros.compare.protocol import (
    BenchmarkTask,
    placement_settings,
    Protocol,
    RAY_SEARCH,
    run_task,
)
from ocp_ros.compare.summary import LOG_OFFSET_M, pair
from ocp_ros.rooms.splits import SETS
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.simulation_config import EpisodeConfig
from ocp_ros.util.files import write_atomically
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.worker_pool import WorkerPool
from rich.console import Console
from rich.progress import track
from rich.table import Table

#: Turns, and the longest move of one, metres.
LENGTHS = ((3, 2.0), (5, 2.0), (8, 2.0), (14, 2.0), (30, 0.5))
PLANNERS = ('lookahead', 'learned', 'learned_lookahead', 'greedy_step')
#: Options that change nothing in what is played.
APART = ('workers', 'out', 'first', 'before')


def named(turns: int, metres: float) -> str:
    """Return the name of a length of episodes, such as ``30x0.5``."""
    return f'{turns}x{metres:g}'


class RoomTask(NamedTuple):
    """
    A room to play.

    :ivar room: seed or path.
    :ivar rotation: degrees by which it is turned.
    :ivar half: of a scan that planners see; the other half judges.
    :ivar known: what :func:`play_room` has returned for some of the planners and lengths.
    """

    room: str
    rotation: float
    half: int = 0
    known: dict[str, Any] = {}

    @property
    def name(self) -> str:
        """Return what it is called in a file."""
        return f'{Path(self.room).stem}, {self.rotation:g}' + (
            f', half {self.half}' if self.half else '')

    def lacks(self, protocol: Protocol, lengths: Sequence[tuple[int, float]]) -> bool:
        """Return whether anything is left to be played."""
        errors = self.known.get('errors', {})
        return bool(protocol.truths and 'truth' not in self.known) or (
            'start' not in self.known and not protocol.simulation.rig_file) or any(
            planner not in errors.get(named(*length), {})
            for length in lengths for planner in protocol.planners)


def play_room(protocol: Protocol, lengths: Sequence[tuple[int, float]], task: RoomTask
              ) -> dict[str, Any]:
    """
    Play a room with all planners and lengths.

    :param task: the room; what is known of it is not played again.
    :returns: ``errors``, depth errors in metres by length and planner, geometric means of the
        seeds; ``ms``, milliseconds a turn
        in the median; ``truth``, metres, where the searches with the truth end, unless there are
        none; ``start``, metres, where the cameras begin, unless they are those of a rig file.
    """
    found: dict[str, Any] = {'errors': {}, 'ms': {}} | task.known
    protocol = replace(protocol, half=task.half)
    if protocol.truths and 'truth' not in found:
        found['truth'] = min(row['depth_error'] for row in run_task(
            protocol, BenchmarkTask(task.room, task.rotation, RAY_SEARCH)))
    if 'start' not in found and not protocol.simulation.rig_file:
        found['start'] = start_error(protocol, task.room, task.rotation)
    for turns, metres in lengths:
        episode = replace(protocol.simulation.episode, turns=turns, max_step=metres)
        played = replace(protocol, simulation=replace(protocol.simulation, episode=episode))
        errors, ms = (found[key].setdefault(named(turns, metres), {}) for key in ('errors', 'ms'))
        for planner in protocol.planners:
            if planner in errors:
                continue
            rows = run_task(played, BenchmarkTask(task.room, task.rotation, planner))
            errors[planner] = float(np.exp(np.mean([
                np.log(row['depth_error'] + LOG_OFFSET_M) for row in rows])) - LOG_OFFSET_M)
            if 'seconds_per_turn' in rows[0]:
                ms[planner] = 1e3 * float(np.mean([row['seconds_per_turn'] for row in rows]))
    return found


def start_error(protocol: Protocol, room: str, rotation: float) -> float:
    """Return the depth error, metres, where cameras on a plane begin the episodes of seed 0."""
    judged = protocol.room(room, rotation)
    episode = Episode(judged.search_problem, np.random.default_rng([0, 0]))
    return judged.judge(episode.turn.positions)['depth_error']


def summed(rooms: dict[str, dict[str, Any]], first: str) -> dict[str, dict[str, Any]]:
    """
    Sum up over rooms.

    :param rooms: of :func:`play_room`, by name.
    :param first: the planner that others are compared with.
    :returns: by length and planner: ``sum`` of depth errors, metres; ``ratio``, that sum / the one
        of the best known placements; ``worse``, the rooms in which it ends worse than it began;
        ``ms`` a turn; and the paired comparison with the first, see
        :func:`~ocp_ros.compare.summary.pair`.
    """
    found = list(rooms.values())
    best = sum(min([room.get('truth', np.inf), *(
        error for errors in room['errors'].values() for error in errors.values())])
        for room in found)
    starts = np.array([room.get('start', np.inf) for room in found])
    result: dict[str, dict[str, Any]] = {}
    for length, planners in found[0]['errors'].items():
        own = np.array([room['errors'][length][first] for room in found])
        result[length] = {planner: {
            **pair(own, errors), 'ratio_to_best': float(errors.sum()) / best,
            'worse': int(np.count_nonzero(errors > starts)),
            'ms': _median([room['ms'][length].get(planner) for room in found])}
            for planner in planners
            for errors in [np.array([room['errors'][length][planner] for room in found])]}
    return result


def over_before(rooms: dict[str, dict[str, Any]], before: dict[str, dict[str, Any]]
                ) -> dict[str, dict[str, dict[str, Any]]]:
    """
    Compare planners with themselves in another comparison, as after other training.

    :param rooms: of :func:`play_room`, by name.
    :param before: the same of the other comparison.
    :returns: by length and planner, :func:`~ocp_ros.compare.summary.pair` in the rooms that both
        have; its ``sum`` is that of the other comparison.
    """
    both = [name for name in rooms if name in before]
    lengths = {length: sorted({*errors}.intersection(*(
        side[name]['errors'].get(length, {}) for name in both for side in (rooms, before))))
        for length, errors in rooms[both[0]]['errors'].items()} if both else {}
    return {length: {planner: pair(*(
        np.array([side[name]['errors'][length][planner] for name in both])
        for side in (rooms, before))) for planner in planners}
        for length, planners in lengths.items()}


def _median(times: list[float | None]) -> float | None:
    """Return the median where all are known: those of rig files are not."""
    known = [time for time in times if time is not None]
    return float(np.median(known)) if len(known) == len(times) else None


def show(result: dict[str, dict[str, Any]], first: str) -> None:
    """Print a table."""
    table = Table('turns', 'planner', 'sum (m)', 'to best', 'worse than at first', 'ms a turn',
                  f'{first} better in', 'its error : theirs', 'p')
    for length, planners in result.items():
        for planner, row in planners.items():
            table.add_row(length, planner, f'{row["sum"]:.1f}', f'{row["ratio_to_best"]:.2f}',
                          str(row['worse']),
                          '' if row['ms'] is None else f'{row["ms"]:.0f}',
                          f'{row["wins"]} of {row["rooms"]}',
                          f'{row["ratio"]:.3f}', '' if row['p'] is None else f'{row["p"]:.1e}')
    Console(width=120).print(table)


def command_of(options: argparse.Namespace, defaults: argparse.Namespace) -> str:
    """Return the command that makes a comparison; scans are where whoever has them keeps them."""
    words = ['python -m benchmarks.few_turns']
    for name, value in vars(options).items():
        if name == 'rooms' and value:
            words.append('--rooms SCAN ...')
        elif name not in APART and value != getattr(defaults, name):
            words.append(f'--{name.replace("_", "-")} {value}')
    return ' '.join(words)


def main(argv: Sequence[str] | None = None) -> None:
    """Play, print and keep all of it in a file, from which an interrupted comparison goes on."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    which = parser.add_mutually_exclusive_group()
    which.add_argument('--set', choices=list(SETS), default='test')
    which.add_argument('--rooms', nargs='+', metavar='SCAN', help='scans instead')
    parser.add_argument('--rotations', default='0', help='degrees, with commas between')
    parser.add_argument('--halves', type=int, default=1, help='random halves of each scan')
    parser.add_argument('--seeds', type=int, default=1, help='episodes of each planner')
    parser.add_argument('--lengths', default=','.join(named(*length) for length in LENGTHS),
                        help='such as 8x2,30x0.5: turns x metres')
    parser.add_argument('--planners', default=','.join(PLANNERS))
    parser.add_argument('--first', default='learned_lookahead', help='compared with the others')
    parser.add_argument('--before', type=Path, help='a file of this command, such as of other '
                        'weights: each planner is compared with itself there')
    parser.add_argument('--cameras', type=int, default=4)
    parser.add_argument('--rig', default='', help='a rig file in place of cameras on a plane')
    parser.add_argument('--model', default=Protocol.model)
    parser.add_argument('--truths', type=int, default=1, help='searches with the truth')
    parser.add_argument('--truth-budget', type=int, default=1000, help='their evaluations')
    parser.add_argument('--workers', type=int, default=os.cpu_count())
    parser.add_argument('--out', type=Path, required=True)
    options = parser.parse_args(argv)
    command = command_of(options, parser.parse_args(['--out', str(options.out)]))
    lengths = [(int(turns), float(metres)) for turns, metres in (
        length.split('x') for length in options.lengths.split(','))]
    usual = EpisodeConfig()
    if options.rig and lengths != [(usual.turns, usual.max_step)]:
        raise ConfigurationError(
            f'lengths: found {options.lengths} with a rig file; expected '
            f'{named(usual.turns, usual.max_step)}, which rig files are planned with')
    protocol = Protocol(
        rooms=tuple(options.rooms or map(str, SETS[options.set])),
        rotations=tuple(map(float, options.rotations.split(','))),
        planners=tuple(options.planners.split(',')), seeds=options.seeds, model=options.model,
        truths=options.truths, truth_budget=options.truth_budget,
        simulation=placement_settings(options.cameras, options.rig or None))
    settings = {'lengths': options.lengths, 'planners': options.planners,
                'cameras': options.rig or options.cameras, 'model': options.model,
                'truths': options.truths, 'truth_budget': options.truth_budget,
                'seeds': options.seeds}
    kept = json.loads(options.out.read_bytes()) if options.out.exists() else {}
    if kept and kept['settings'] != settings:
        raise ConfigurationError(
            f'{options.out}: found {kept["settings"]}; expected the comparison that is asked for, '
            f'{settings}; name another file')
    rooms = kept.get('rooms', {})
    tasks = [RoomTask(room, rotation, half) for room in protocol.rooms
             for rotation in protocol.rotations for half in range(options.halves)]
    tasks = [task._replace(known=rooms.get(task.name, {})) for task in tasks]
    left = [task for task in tasks if task.lacks(protocol, lengths)]
    played = {task.name: task.known for task in tasks if task not in left}
    with WorkerPool(options.workers) as pool:
        for number, found in track(
                pool.unordered(partial(play_room, protocol, lengths), left),
                'rooms', len(left), console=Console(stderr=True)):
            played[left[number].name] = found
            record = stamped({'settings': settings, 'rooms': rooms | played,
                              'summary': summed(played, options.first)}, command)
            write_atomically(options.out, json.dumps(record, indent=1) + '\n')
    show(summed(played, options.first), options.first)
    if options.before:
        for length, planners in over_before(
                played, json.loads(options.before.read_bytes())['rooms']).items():
            for planner, row in planners.items():
                print(f'{length} {planner}: {row["ratio"]:.3f} times the error in '
                      f'{options.before}, {row["interval"][0]:.3f} to {row["interval"][1]:.3f}, '
                      f'better in {row["wins"]} of {row["rooms"]} rooms, p = '
                      f'{"unknown" if row["p"] is None else format(row["p"], ".2g")}')


if __name__ == '__main__':
    main()
