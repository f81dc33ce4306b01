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
Send nodes messages that lie, and see that they live, refuse, and command nothing out of bounds.

Between the lies come good messages that have to be answered. Nodes are processes of their own;
what they hold in memory is measured before and after.
"""

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
import sys
import time

from benchmarks import results
from benchmarks.drills.drill import grown, rss_of, run_drill
from benchmarks.drills.fuzz_targets import Fuzzer, LiveTarget, PolicyTarget, shell, SimTarget
from benchmarks.drills.fuzz_trainer import TrainerTarget
from ocp_ros.demo.node_processes import NodeProcess, stopped_at_the_end
from ocp_ros.demo.watcher import Watch
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.util.resources import find_model
from rich.console import Console
from rich.progress import Progress

#: Seconds to wait for an answer.
PATIENCE = 120.0


def parser() -> argparse.ArgumentParser:
    """Build the parser."""
    top = argparse.ArgumentParser(prog='fuzz', description=__doc__)
    top.add_argument('--messages', type=int, default=100_000, help='messages that lie')
    top.add_argument('--minutes', type=float, help='so long, in place of so many')
    top.add_argument('--seed', type=int, default=0, help='of everything')
    top.add_argument('--points', type=int, default=5_000_000, help='of one huge cloud')
    top.add_argument('--out', type=Path, default=Path('out'), help='folder for the results')
    results.add_record(top, 'fuzz')
    return top


def start(options: argparse.Namespace, domain: int) -> Iterator[NodeProcess]:
    """Start a node of each kind; the policy runs the shipped weights and a live one beside it."""
    logs = options.out / 'logs' / 'fuzz'
    for namespace, name, parameters in (
            ('turns', 'policy_node', {'turns': 100000}),
            ('turns', 'trainer_node', {'folder': str(options.out / 'fuzz_trainer'),
                                       'sources': 'turns'}),
            ('learn', 'trainer_node', {'folder': str(options.out / 'fuzz_learner'),
                                       'sources': 'learn',
                                       'updates_per_turn': 1.0, 'sac.batch_size': 16,
                                       'sac.learning_starts': 20, 'sac.buffer_size': 1000,
                                       'most_behind': 1000000}),
            ('live', 'policy_node', {'cloud_topics': 'a,b', 'turns': 100000, 'cloud_timeout': 0.3,
                                     'arrival_timeout': 0.5}),
            ('sim', 'sim_node', {'scene.points': 3000, 'rig.cameras': 3, 'auto_reset': True})):
        log = logs / namespace / f'{name}.log'
        yield NodeProcess(name, domain, log, parameters, namespace)


def fuzz(options: argparse.Namespace, domain: int, watch: Watch) -> dict:
    """Send as many lies as asked for; returns the figures."""
    processes: list[NodeProcess] = []

    def until(predicate: Callable[[], bool], what: str) -> None:
        watch.spin_until(predicate, PATIENCE, what, processes, 0.02)

    with stopped_at_the_end(processes), Progress(console=Console(stderr=True)) as progress:
        processes += start(options, domain)
        weights = Checkpoint.load(find_model('actor'))
        fuzzer = Fuzzer(watch.node, until, options.seed, weights)
        policy = PolicyTarget(fuzzer, '/turns')
        live, sim = LiveTarget(fuzzer, '/live', ['a', 'b']), SimTarget(fuzzer, '/sim')
        learn = TrainerTarget(fuzzer, '/learn')
        huge = policy.ping(shell(fuzzer.rng, options.points))
        task = progress.add_task('messages', total=1.0)
        began, before, rounds = time.monotonic(), None, 0

        def done() -> float:
            if options.minutes is not None:
                return (time.monotonic() - began) / (60.0 * options.minutes)
            return fuzzer.sent / options.messages

        while done() < 1.0:
            policy.batch(again=rounds % 10 > 0)
            sim.batch()
            if rounds % 20 == 0:
                live.batch()
                learn.batch()
            rounds += 1
            progress.update(task, completed=done())
            if before is None and done() >= 0.2:
                before = {one.name: rss_of(one.process.pid) for one in processes}
        growth = {one.name: rss_of(one.process.pid) - before[one.name] for one in processes}
        seconds = time.monotonic() - began
        seen = dict(watch.node.diagnostics)
        until(lambda: all(watch.node.diagnostics[one.name] is not seen.get(one.name)
                          for one in processes), 'last word of every node')
        return {'faults': grown(growth), 'messages': fuzzer.sent,
                'good_messages_answered': fuzzer.answered,
                'lies_answered_within_bounds': fuzzer.readable, 'seconds': seconds,
                'huge_cloud_points': options.points, 'huge_cloud_seconds': huge,
                'rss_growth_mb': growth, 'seed': options.seed, 'refused': {
                    one.name: {key: int(value) for key, value
                               in watch.node.diagnostics[one.name].items() if 'refused' in key}
                    for one in processes}}


def main(args: list[str] | None = None) -> int:
    """Run; 2 if a node did what it must not."""
    return run_drill('fuzz', parser().parse_args(args), args, fuzz)


if __name__ == '__main__':
    sys.exit(main())
