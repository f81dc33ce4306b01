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
Play for long, kill nodes at random times, send lies, and see that the loop always goes on.

Two pairs of sim and policy play, and one trainer learns from both. One pair and the trainer are
killed, one node after the other, with SIGKILL; a simulation comes back with
another room. The other pair lives through it with a clock that jumps. The trainer's files are read
whenever it has been killed. Writes ``soak.json``.
"""

import argparse
from collections.abc import Callable
import os
from pathlib import Path
import signal
import sys
import time
from typing import Any

from benchmarks import results
from benchmarks.drills.drill import grown, run_drill
from benchmarks.drills.soak_watch import check_files, Latency, Lies, MemoryWatch
import numpy as np
from ocp_ros.demo.train_demo import pair_parameters
from ocp_ros.demo.watched_nodes import NodeProcess, stopped_at_the_end, Watch
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.ros.interface.conversions import ns_to_stamp
from ocp_ros.util.resources import find_model
from ocp_ros.util.threads import cores
from rclpy.qos import qos_profile_system_default
from rich.console import Console
from rich.progress import Progress
from rosgraph_msgs.msg import Clock

#: Which pair is killed, and which has a clock that jumps.
KILLED, STEADY = NAMESPACES = ('env_0', 'env_1')
#: Seconds from one kill to the next at most.
LONGEST = 5.0
#: Gradient steps, and turns, of a life after which a trainer, or a policy, needs no more memory.
LEARNS, EPISODE = 20, 30
#: Turns that a pair has to play, and times that the trainer has to say it lives, after a kill.
RECOVERED = 3


class Soak:
    """
    Everything that runs, and what happens to it.

    :param options: of the command line.
    :param domain: ROS domain id.
    :param watch: hears diagnostics, publishes lies and the clock.
    :ivar kills: how often each node was killed.
    :ivar recovery: seconds from each kill until the loop went on.
    :ivar refused: messages that the nodes have refused.
    """

    def __init__(self, options: argparse.Namespace, domain: int, watch: Watch) -> None:
        self.options, self.domain, self.watch = options, domain, watch
        self.rng = np.random.default_rng(options.seed)
        self.processes: list[NodeProcess] = []
        self.trainer = options.out / 'soak_trainer'
        self.kills = dict.fromkeys(('trainer_node', f'{KILLED}/policy_node', f'{KILLED}/sim_node'),
                                   0)
        self.recovery: list[float] = []
        self.refused, self._counted = 0, {}
        #: When each node was started, nanoseconds; 0 for its first life.
        self._started: dict[str, int] = {}
        #: Gradient steps that a trainer began a life with, by process.
        self._updates: dict[int, int] = {}
        self.memory = MemoryWatch()
        self.latency = {name: Latency(watch.node, f'/{name}') for name in NAMESPACES}
        weights = Checkpoint.load(find_model('actor'))
        self.lies = [Lies(watch.node, f'/{name}', self.rng, weights) for name in NAMESPACES]
        self._clock = watch.node.create_publisher(Clock, '/clock', qos_profile_system_default)
        self._time, self._jumps, self._lied = 1_000_000_000_000, 0, 0.0

    def start(self, name: str, number: int = 0) -> NodeProcess:
        """Start a node by its full name; ``number`` tells the lives before."""
        namespace, _, kind = name.rpartition('/')
        if kind == 'trainer_node':
            parameters: dict[str, Any] = {
                'model': 'actor', 'folder': str(self.trainer), 'save_seconds': 5.0,
                'publish_every': 8, 'sac.learning_starts': 40, 'sac.batch_size': 4,
                'sac.buffer_size': 200, 'updates_per_turn': 0.25, 'sources': ','.join(NAMESPACES),
                # Nobody waits for it: how long turns take is measured.
                'most_behind': 100000}
        else:
            index = NAMESPACES.index(namespace)
            # Each life of a simulation is in another room.
            parameters = pair_parameters(index, 1 + 7 * number, 'actor')[kind]
            if kind == 'sim_node':
                parameters |= {'scene.points': 3000, 'engine.preset': 'fast',
                               'use_sim_time': namespace == STEADY, 'resend_period': 0.2}
        self._started[name] = time.time_ns() if number else 0
        log = self.options.out / 'logs' / 'soak' / f'{name.replace("/", "_")}_{number}.log'
        process = NodeProcess(kind, self.domain, log, parameters, namespace)
        self.processes.append(process)
        return process

    def says(self, name: str) -> dict[str, str] | None:
        """Return what a node has said last in this life, None before it has said anything."""
        node = self.watch.node
        stamp = node.diagnostics_stamps.get(name, -1)
        return node.diagnostics[name] if stamp >= self._started[name] else None

    def ready(self, process: NodeProcess) -> bool:
        """
        Return whether a node has done all that it does, and so has the memory that it needs.

        A policy has played as many turns as an episode has, a trainer has learned.
        """
        values = self.says(process.name)
        if values is None:
            return False
        if 'updates' not in values:
            return int(values.get('turns_answered', EPISODE)) >= EPISODE
        updates = int(values['updates'])
        return updates - self._updates.setdefault(process.process.pid, updates) >= LEARNS

    def tick(self) -> None:
        """Do what happens all the time: the clock goes on or jumps, lies are told, memory."""
        self._time += 10_000_000
        if self.rng.random() < 0.002:
            self._jumps += 1
            # Never before 0: rclpy itself ends with a clock that says so.
            self._time = max(self._time + int(self.rng.integers(-900, 900)) * 1_000_000_000, 0)
        self._clock.publish(Clock(clock=ns_to_stamp(self._time)))
        if time.monotonic() - self._lied > 0.1:
            self._lied = time.monotonic()
            for lies in self.lies:
                lies.send()
            self.memory.look([one for one in self.processes if self.ready(one)])
            self._count()

    def _count(self) -> None:
        """Add up what the nodes have refused; who was killed counts from 0 again."""
        for name, values in self.watch.node.diagnostics.items():
            now = sum(int(value) for key, value in values.items() if key in (
                'refused_messages', 'weights_refused', 'refused_commands'))
            before = self._counted.get(name, 0)
            self.refused += now - before if now >= before else now
            self._counted[name] = now

    def until(self, predicate: Callable[[], bool], what: str) -> None:
        """Go on until something has happened."""
        def looked() -> bool:
            self.tick()
            return predicate()

        self.watch.spin_until(looked, self.options.patience, what, self.processes, 0.02)

    def recovered(self, name: str) -> Callable[[], bool]:
        """Return what returns whether the loop goes on without, or with, a node of this name."""
        if name == 'trainer_node':
            return lambda: int((self.says(name) or {'turns': 0})['turns']) >= RECOVERED
        return lambda: self.latency[KILLED].recovered >= RECOVERED

    def next(self, share: float) -> str:  # noqa: A003
        """
        Return who is killed next: all of them in turn, in a random order.

        :param share: of the time that is over. In the second half the trainer is left to live, so
            that its memory is seen to stay flat.
        """
        kills = {name: count for name, count in self.kills.items()
                 if name != 'trainer_node' or self.options.kills or share < 0.5}
        fewest = min(kills.values())
        return str(self.rng.choice([name for name, count in kills.items() if count == fewest]))

    def kill(self, name: str) -> None:
        """Kill a node, read what a trainer has left, start it again and wait until it plays."""
        process = next(one for one in self.processes if one.name == name)
        self.processes.remove(process)
        process.process.send_signal(signal.SIGKILL)
        process.process.wait()
        for latency in self.latency.values():
            latency.interrupt()
        self.kills[name] += 1
        if name == 'trainer_node':
            # One that lives removes old files while they are read.
            check_files(self.trainer)
        began = time.monotonic()
        self.start(name, sum(self.kills.values()))
        self.until(self.recovered(name), f'recovery after {name} was killed')
        self.recovery.append(time.monotonic() - began)

    def run(self) -> None:
        """Play, kill and lie for the time or the kills asked for."""
        with stopped_at_the_end(self.processes), Progress(console=Console(stderr=True)) as bar:
            for name in ('trainer_node', *(f'{one}/{kind}' for one in NAMESPACES
                                           for kind in ('policy_node', 'sim_node'))):
                self.start(name)
            self.until(lambda: all(one.turns > RECOVERED for one in self.latency.values())
                       and 'trainer_node' in self.watch.node.diagnostics, 'first turns')
            began = time.monotonic()
            most = self.options.kills or 60.0 * self.options.minutes
            task = bar.add_task('soak', total=most)
            while True:
                seconds = time.monotonic() - began
                done = sum(self.kills.values()) if self.options.kills else seconds
                bar.update(task, completed=done)
                if done >= most:
                    break
                pause = time.monotonic() + self.rng.uniform(0.0, LONGEST)
                self.until(lambda at=pause: time.monotonic() >= at, 'time to pass')
                self.kill(self.next(done / most))
            self.seconds = time.monotonic() - began
            self.until(lambda: self.latency[STEADY].turns > 0, 'end')
        check_files(self.trainer)

    def result(self) -> dict[str, Any]:
        """Return the figures."""
        seconds = np.concatenate([one.seconds for one in self.latency.values()])
        return {
            'faults': grown(self.memory.growth), 'seconds': self.seconds,
            'turns': sum(one.turns for one in self.latency.values()),
            'turns_by_pair': {name: one.turns for name, one in self.latency.items()},
            'restarts_survived': sum(self.kills.values()), 'kills': self.kills,
            'recovery_seconds_p50': float(np.median(self.recovery)) if self.recovery else None,
            'recovery_seconds_max': max(self.recovery, default=None),
            'malformed_messages_sent': sum(lies.sent for lies in self.lies),
            'malformed_messages_refused': self.refused, 'clock_jumps': self._jumps,
            'rss_growth_mb': max(self.memory.growth.values(), default=None),
            'rss_growth_mb_by_node': self.memory.growth, 'rss_peak_mb_by_node': self.memory.peak,
            'turn_latency_p50_ms': 1e3 * float(np.percentile(seconds, 50)),
            'turn_latency_p99_ms': 1e3 * float(np.percentile(seconds, 99)),
            'load_average': os.getloadavg()[1], 'cores': cores(),
            'seed': self.options.seed}


def parser() -> argparse.ArgumentParser:
    """Build the parser."""
    top = argparse.ArgumentParser(prog='soak', description=__doc__)
    top.add_argument('--minutes', type=float, default=5.0, help='how long to play')
    top.add_argument('--kills', type=int, default=0,
                     help='end after so many kills instead; 0 to go by minutes')
    top.add_argument('--patience', type=float, default=180.0,
                     help='seconds in which the loop has to go on after a kill')
    top.add_argument('--seed', type=int, default=0, help='of the times, the nodes and the lies')
    top.add_argument('--out', type=Path, default=Path('out'), help='folder for the results')
    results.add_record(top, 'drills')
    return top


def soak(options: argparse.Namespace, domain: int, watch: Watch) -> dict[str, Any]:
    """Play to the end; return the figures."""
    everything = Soak(options, domain, watch)
    everything.run()
    return everything.result()


def main(args: list[str] | None = None) -> int:
    """Run; 2 if the loop did not go on, a file was torn or memory has grown."""
    return run_drill('soak', parser().parse_args(args), args, soak)


if __name__ == '__main__':
    sys.exit(main())
