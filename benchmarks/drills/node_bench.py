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
Measure the nodes: how long a policy takes to answer, and how fast training over ROS is.

A turn is answered within one callback, from the cloud received to the command published; what a
planner thinks afterwards, while cameras would move, is told apart. What both take of the processor
is told beside the wall, since other programs make the latter longer.
"""

import argparse
from collections.abc import Iterable
import cProfile
import io
import json
import os
from pathlib import Path
import pstats
import sys
import tempfile
import time
from typing import Any

from benchmarks import results
import numpy as np
from ocp_ros.demo.train_demo import start_nodes
from ocp_ros.demo.watched_nodes import (
    end_on_signals,
    free_domain,
    NodeProcess,
    stopped_at_the_end,
    Watch,
)
from ocp_ros.geometry.cameras import heading_of
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.rooms.generator import generate_room
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import (
    cloud_to_msg,
    fields_to_msg,
    msg_to_poses,
    ns_to_stamp,
    positions_to_msg,
)
from ocp_ros.ros.policy.policy_config import PLANNERS, PolicyNodeConfig
from ocp_ros.ros.policy.simulated_turns import SimulatedTurns
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.ros.runtime.node_main import LOCALHOST_ENVIRONMENT
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import make_problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.util.threads import cores
from rclpy.parameter import Parameter
from rich.console import Console
from rich.progress import track
from std_msgs.msg import Float64MultiArray, Header

POINTS, PAIRS = (25_000, 100_000), (1, 2, 4)
#: Planners and weights; those of the paper's inputs ask no engine.
PLAYED = tuple((planner, PolicyNodeConfig.model) for planner in PLANNERS)
#: A rig file whose cameras are aimed and kept to constraints as well.
RIG = 'config/rig/four_d455.yaml'
#: The first of the rooms in which turns are answered; none of them is a training room.
FIRST_ROOM = 200
#: Share of a room's points that cameras see in the end, about.
SEEN = 0.95
TURNS = 30
#: Gradient steps begin after so many transitions, and measuring after as many more.
STARTS = 100
PATIENCE = 300.0


class Answers:
    """
    A policy node that answers turns of a simulated room, timed.

    :param watch: whose executor spins the node, and which listens to the commands.
    :param planner: of the node.
    :param model: its weights.
    :param rig: path of a rig file; empty for none.
    :ivar profile: of the turns that come, if they shall be profiled and not timed.
    """

    def __init__(self, watch: Watch, planner: str, model: str, rig: str) -> None:
        self.rig = rig
        self.watch, self.wall, self.cpu, self.points = watch, [], [], []
        #: Seconds that were thought after the command, while cameras would move.
        self.thought: list[float] = []
        self.profile: cProfile.Profile | None = None
        self.node = PolicyNode(context=watch.context, parameter_overrides=[
            Parameter('planner', value=planner), Parameter('model', value=model),
            Parameter('turns', value=TURNS), Parameter('rig_file', value=rig)])
        assert isinstance(self.node.source, SimulatedTurns)
        self.turns = self.node.source
        self._published = 0.0
        # In this thread, so that the time is that of the planner alone.
        self._plan_ahead = self.node.decider.step.plan_ahead
        self.node.decider.plan_ahead = self._reflect  # type: ignore[method-assign]
        # A node that has just begun looks first whether another one commands.
        watch.spin_until(lambda: not self.node.must_wait, PATIENCE, 'the right to command', [])

    def _reflect(self) -> None:
        """Think as the node does, and remember when that began."""
        self._published = time.perf_counter()
        self._plan_ahead()

    def play(self, room: int, points: int) -> None:
        """Play an episode in a room of so many points."""
        config = SimulationConfig(
            engine=EngineConfig(preset='fast', error_rows=32), rig_file=self.rig)
        problem = make_problem(generate_room(room, round(points / SEEN)), config)
        episode = Episode(problem, np.random.default_rng(room))
        number = room * 1000
        while not episode.turn.truncated:
            number += 1
            header = Header(stamp=ns_to_stamp(number), frame_id='map')
            self.turns.on_reward(_reward(number, room, episode.turn.step))
            self.turns.on_poses(positions_to_msg(
                episode.turn.positions, header, episode.turn.headings))
            cloud = cloud_to_msg(episode.observed_cloud, header)
            wall, cpu = time.perf_counter(), time.process_time()
            if self.profile:
                self.profile.runcall(self.turns.on_cloud, cloud)
            else:
                self.turns.on_cloud(cloud)
            self.cpu.append(time.process_time() - cpu)
            self.wall.append(self._published - wall)
            self.thought.append(time.perf_counter() - self._published)
            self.points.append(cloud.width)
            targets = msg_to_poses(self.turns.answer)
            moves = [pose.position for pose in targets] - episode.turn.positions
            episode.move(moves, np.array([heading_of(pose.rotation) for pose in targets])
                         if self.rig else None)


def _reward(stamp: int, episode: int, step: int) -> Float64MultiArray:
    """Return what a simulation says of a turn."""
    return fields_to_msg({**dict.fromkeys(topics.REWARD_FIELDS, 0.0), 'stamp_nanosec': stamp,
                          'episode': episode, 'step': step})


def latency(watch: Watch, planner: str, model: str, rig: str, points: int, rooms: int
            ) -> dict[str, Any]:
    """
    Measure how long turns take.

    :param rig: path of a rig file; empty for none.

    :returns: milliseconds, wall and processor, and the functions that took most of the time.
    """
    answers = Answers(watch, planner, model, rig)
    try:
        # What is compiled or built once is not measured.
        answers.play(FIRST_ROOM - 1, 5000)
        answers.wall, answers.cpu, answers.points, answers.thought = [], [], [], []
        for room in range(FIRST_ROOM, FIRST_ROOM + rooms):
            answers.play(room, points)
        wall, cpu = 1e3 * np.array(answers.wall), 1e3 * np.array(answers.cpu)
        answers.profile = cProfile.Profile()
        answers.play(FIRST_ROOM + rooms, points)
        return {'planner': planner, 'model': model, 'rig': rig, 'points': points,
                'turns': len(wall),
                'points_seen_in_the_end': int(max(answers.points)),
                **{f'{name}_{kind}': float(np.percentile(values, level))
                   for kind, values in (('ms', wall), ('cpu_ms', cpu),
                                        ('thought_ms', 1e3 * np.array(answers.thought)))
                   for name, level in (('p50', 50), ('p99', 99), ('max', 100))},
                'profile': _hottest(answers.profile)}
    finally:
        answers.node.destroy_node()


def _hottest(profile: cProfile.Profile) -> list[str]:
    """Return the functions in which most time was spent, as shares of that of all turns."""
    stats: Any = vars(pstats.Stats(profile, stream=io.StringIO()))['stats']
    whole = max((total for (_, _, name), (_, _, _, total, _) in stats.items()
                 if name == 'on_cloud'), default=1.0)
    rows = sorted(((total, own, calls, f'{Path(path).stem}.{name}')
                   for (path, _, name), (_, calls, own, total, _) in stats.items()
                   if 'ocp_ros' in path and name != 'on_cloud'), reverse=True)
    return [f'{100 * total / whole:.0f} % {name} ({calls} calls, itself {100 * own / whole:.0f} %)'
            for total, own, calls, name in rows[:14]]


def cpu_of(pids: Iterable[int]) -> float:
    """Return the seconds of the processor that processes have taken."""
    ticks = 0
    for pid in pids:
        # The name, in parentheses, may hold anything.
        fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf('SC_CLK_TCK')


def training(pairs: int, seconds: float, out: Path) -> dict[str, Any]:
    """
    Measure how fast a trainer learns from pairs of sim and policy.

    :param pairs: how many.
    :param seconds: to measure for.
    :param out: folder of the trainer.
    :returns: interactions per second, each with its gradient step, and the milliseconds of the
        processor that one takes in all processes together.
    """
    options = argparse.Namespace(pairs=pairs, out=out, seed=1, model='actor')
    domain, holder = free_domain()
    processes: list[NodeProcess] = []
    with holder, Watch(domain) as watch, stopped_at_the_end(processes):
        def said(name: str) -> int:
            return int(watch.node.diagnostics.get('trainer_node', {}).get(name, 0))

        start_nodes(options, domain, processes)
        watch.spin_until(lambda: said('transitions') >= 2 * STARTS, PATIENCE, 'transitions',
                         processes)
        pids = [process.process.pid for process in processes]
        began, first, cpu = time.monotonic(), said('transitions'), cpu_of(pids)
        watch.spin_until(lambda: time.monotonic() - began >= seconds, PATIENCE, 'end', processes)
        diagnostics = watch.node.diagnostics
        before = diagnostics['trainer_node']
        watch.spin_until(lambda: diagnostics['trainer_node'] is not before, PATIENCE,
                         'last word', processes)
        if said('inconsistent') or said('dropped'):
            raise RuntimeError(f'found {diagnostics["trainer_node"]}; expected that nothing '
                               'is dropped')
        count, took = said('transitions') - first, time.monotonic() - began
        return {'pairs': pairs, 'interactions_per_s': count / took,
                'cpu_ms': 1e3 * (cpu_of(pids) - cpu) / max(count, 1),
                'load_average': os.getloadavg()[0]}


def parser() -> argparse.ArgumentParser:
    """Build the parser."""
    top = argparse.ArgumentParser(prog='node_bench', description=__doc__)
    top.add_argument('--rooms', type=int, default=4, help='episodes per planner and size')
    top.add_argument('--pairs', type=int, nargs='+', default=PAIRS,
                     help='of sim and policy, to measure training with')
    top.add_argument('--seconds', type=float, default=60.0,
                     help='to measure training for, with each number of pairs; 0 for not')
    results.add_record(top, 'node_bench')
    return top


def main(args: list[str] | None = None) -> int:
    """Measure, and print the figures."""
    options = parser().parse_args(args)
    end_on_signals()
    os.environ.update(LOCALHOST_ENVIRONMENT)
    turns, learned = [], []
    if options.rooms:
        domain, holder = free_domain()
        with holder, Watch(domain) as watch:
            cases = [(*played, '', points) for played in PLAYED for points in POINTS]
            cases += [(planner, PolicyNodeConfig.model, RIG, POINTS[0]) for planner in PLANNERS]
            for case in track(cases, 'turns', console=Console(stderr=True)):
                turns.append(latency(watch, *case, options.rooms))
                print(json.dumps(turns[-1]), flush=True)
    if options.seconds:
        with tempfile.TemporaryDirectory() as folder:
            for pairs in options.pairs:
                learned.append(training(pairs, options.seconds, Path(folder) / str(pairs)))
                print(json.dumps(learned[-1]), flush=True)
    if options.record:
        results.write('nodes', {
            'unit': 'ms from a received cloud to the published command, median and 99 %',
            **published(turns), 'training': learned, 'load_average': os.getloadavg()[1],
            'cores': cores()}, results.command_of('drills.node_bench', args))
    return 0


def published(turns: list[dict[str, Any]]) -> dict[str, Any]:
    """
    Return the figures of :func:`latency` as the documentation shows them.

    :returns: ``value``, by planner and case; ``thought_meanwhile_ms``, median, 99th percentile and
        maximum of the default planner's plans, which are made while the cameras move.
    """
    value: dict[str, dict[str, list[float]]] = {}
    thought: dict[str, list[float]] = {}
    for row in turns:
        case = 'rig_of_four_d455' if row['rig'] else f'points_{row["points"]}'
        value.setdefault(row['planner'], {})[f'{case}_ms'] = [
            round(row[f'{name}_ms'], 1) for name in ('p50', 'p99')]
        if row['planner'] == PolicyNodeConfig.planner and row['points'] == POINTS[0]:
            thought['rig_of_four_d455' if row['rig'] else 'without_rig'] = [
                round(row[f'{name}_thought_ms']) for name in ('p50', 'p99', 'max')]
    return {'value': value, 'thought_meanwhile_ms': thought}


if __name__ == '__main__':
    sys.exit(main())
