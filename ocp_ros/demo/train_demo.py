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
Train over real ROS: a trainer and pairs of simulation and policy, each in its own process.

Each pair has its own namespace. The demo shows that trained weights arrive in every
``policy_node``, and writes ``train_demo.json``.
"""

import argparse
from math import nan
from pathlib import Path
import sys
import time
from typing import Any

from ocp_ros.demo.demo import START_TIMEOUT_S
from ocp_ros.demo.node_processes import NodeProcess, stopped_at_the_end
from ocp_ros.demo.watcher import run_watched, Watch
from ocp_ros.policy.shipped_models import DEFAULT_MODEL
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table


def parser() -> argparse.ArgumentParser:
    """Build the parser."""
    top = argparse.ArgumentParser(prog='train_demo', description=__doc__)
    top.add_argument('--turns', type=int, default=400, help='turns to play in all')
    top.add_argument('--pairs', type=int, default=1, choices=range(1, 65), metavar='1..64',
                     help='pairs of sim and policy')
    top.add_argument('--seed', type=int, default=1, help='of the first generated room')
    top.add_argument('--model', default=DEFAULT_MODEL,
                     help='weights to start from: path or name')
    top.add_argument('--out', type=Path, default=Path('out'), help='folder for the results')
    return top


def namespaces(pairs: int) -> list[str]:
    """Return the namespaces of ``pairs`` pairs; a single pair has none."""
    return [f'env_{number}' for number in range(pairs)] if pairs > 1 else ['']


def pair_of(number: int, seed: int, model: str) -> dict[str, dict[str, Any]]:
    """Return the nodes of a pair and their parameters; each pair has its own room."""
    # One thread per policy: the other pairs use the other cores.
    return {'policy_node': {'model': model, 'explore': True, 'seed': number, 'threads': 1},
            'sim_node': {'scene.seed': seed + number, 'seed': number, 'auto_reset': True}}


def start_all(options: argparse.Namespace, domain: int, processes: list[NodeProcess]) -> None:
    """Start the trainer first, so that it receives every turn, and then all pairs."""
    names, logs = namespaces(options.pairs), options.out / 'logs'
    # With these settings the demo takes a few minutes.
    trainer = {'publish_every': 20, 'updates_per_turn': 0.0625, 'sac.learning_starts': 100,
               'sac.burn_in': 20, 'sac.batch_size': 16, 'sac.buffer_size': 4000,
               'sac.learning_rate': 1e-4, 'sac.gamma': 0.99}
    processes.append(NodeProcess('trainer_node', domain, logs / 'trainer_node.log', {
        'model': options.model, 'folder': str(options.out / 'trainer'),
        'sources': ','.join(names), **trainer}))
    for number, namespace in enumerate(names):
        for name, parameters in pair_of(number, options.seed, options.model).items():
            log = logs / namespace / f'{name}.log'
            processes.append(NodeProcess(name, domain, log, parameters, namespace))


def policies_of(watch: Watch, pairs: int) -> list[dict[str, str]]:
    """Return the latest diagnostic values of each policy; empty if none have come yet."""
    return [watch.node.health.get(f'{namespace}/policy_node'.lstrip('/'), {})
            for namespace in namespaces(pairs)]


def play(options: argparse.Namespace, domain: int, watch: Watch) -> dict[str, float]:
    """Run until all turns are played and all have new weights; return speed and losses."""
    node, processes = watch.node, []
    columns = (TextColumn('{task.description}'), BarColumn(), MofNCompleteColumn(),
               TextColumn('{task.fields[state]}'))

    def turns() -> int:
        return int(node.health.get('trainer_node', {}).get('turns', 0))

    with stopped_at_the_end(processes), \
            Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task('starting nodes', total=options.turns, state='')
        start_all(options, domain, processes)

        losses: list[float] = []

        def done() -> bool:
            loss = node.health.get('trainer_node', {}).get('critic_loss', '-')
            if loss != '-' and losses[-1:] != [float(loss)]:
                losses.append(float(loss))
            swapped = [int(one.get('weights_swapped', 0))
                       for one in policies_of(watch, options.pairs)]
            progress.update(task, completed=min(turns(), options.turns), state=(
                f'{node.health.get("trainer_node", {}).get("updates", 0)} updates, '
                f'{min(swapped)} sets of weights arrived'))
            return turns() >= options.turns and min(swapped) > 0

        patience = START_TIMEOUT_S + 10.0 * options.pairs
        watch.until(lambda: turns() > 1, patience, 'first turns', processes)
        progress.update(task, description='training')
        began, first = time.monotonic(), turns()
        watch.until(done, 2.0 * patience + options.turns, 'new weights in every policy_node',
                    processes)
        return {'turns_per_second': (turns() - first) / (time.monotonic() - began),
                'critic_loss_at_first': losses[0] if losses else nan,
                'critic_loss_at_last': losses[-1] if losses else nan}


def result_of(options: argparse.Namespace, watch: Watch, played: dict[str, float]
              ) -> dict[str, Any]:
    """Collect the counts that the nodes published in their diagnostics."""
    trainer, policies = watch.node.health['trainer_node'], policies_of(watch, options.pairs)
    names = ('turns', 'transitions', 'incomplete', 'inconsistent', 'dropped', 'updates',
             'weights_published')
    sources = {name.removeprefix('turns '): int(value) for name, value in trainer.items()
               if name.startswith('turns ')}
    return {'pairs': options.pairs, **played,
            **{name: int(trainer[name]) for name in names},
            'turns_by_source': sources,
            'weights_arrived': min(int(policy['weights_swapped']) for policy in policies),
            'policy_updates': min(int(policy['weights_updates']) for policy in policies),
            'run': trainer['run']}


def show(options: argparse.Namespace, result: dict[str, Any]) -> None:
    """Print the results as a table."""
    table = Table('what', 'count', title='Training over ROS')
    for name, value in result.items():
        table.add_row(name.replace('_', ' '), f'{value:.2f}' if isinstance(value, float) else
                      str(value))
    Console().print(table)
    print(f'wrote {options.out / "train_demo.json"}')


def main(args: list[str] | None = None) -> int:
    """Run the demo."""
    options = parser().parse_args(args)
    return run_watched(
        'train_demo', options.out,
        lambda domain, watch: result_of(options, watch, play(options, domain, watch)),
        lambda result: show(options, result))


if __name__ == '__main__':
    sys.exit(main())
