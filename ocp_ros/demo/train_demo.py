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
``policy_node``, and writes ``train_demo.json``. With ``--model ''`` and thousands of turns it
shows how the error falls in a training from random weights.
"""

import argparse
from pathlib import Path
import sys
import time
from typing import Any

from ocp_ros.demo.demo import START_TIMEOUT_S
from ocp_ros.demo.watched_nodes import NodeProcess, run_watched, stopped_at_the_end, Watch
from ocp_ros.util.resources import DEFAULT_MODEL
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(prog='train_demo', description=__doc__)
    parser.add_argument('--turns', type=int, default=400, help='turns to play in all')
    parser.add_argument('--pairs', type=int, default=1, choices=range(1, 65), metavar='1..64',
                        help='pairs of sim and policy')
    parser.add_argument('--seed', type=int, default=1, help='of the first generated room')
    parser.add_argument('--model', default=DEFAULT_MODEL,
                        help='weights to start from: path or name; empty: random, and the '
                        'shipped model makes the first moves')
    parser.add_argument('--out', type=Path, default=Path('out'), help='folder for the results')
    return parser


def namespaces(pairs: int) -> list[str]:
    """Return the namespace of each pair; that of a single pair is empty."""
    return [f'env_{number}' for number in range(pairs)] if pairs > 1 else ['']


def pair_parameters(number: int, seed: int, model: str) -> dict[str, dict[str, Any]]:
    """Return the parameters of each node of a pair, by node; each pair has its own room."""
    # One thread per policy, because the other pairs use the other cores.
    return {'policy_node': {'model': model or DEFAULT_MODEL, 'explore': True, 'seed': number,
                            'threads': 1},
            'sim_node': {'scene.seed': seed + number, 'seed': number, 'auto_reset': True}}


def start_nodes(options: argparse.Namespace, domain: int, processes: list[NodeProcess]) -> None:
    """
    Start the trainer first, so that it receives every turn, and then all pairs.

    :param processes: the started processes are added to it.
    """
    sources = namespaces(options.pairs)
    logs = options.out / 'logs'
    # The recipe is that of the shipped weights; it begins early, so that the demo takes
    # a few minutes.
    settings = {'publish_every': 20, 'sac.learning_starts': 100, 'sac.burn_in': 20,
                'sac.buffer_size': max(4000, 8 * options.turns)}
    processes.append(NodeProcess('trainer_node', domain, logs / 'trainer_node.log', {
        'model': options.model, 'folder': str(options.out / 'trainer'),
        'sources': ','.join(sources), **settings}))
    for number, namespace in enumerate(sources):
        for name, parameters in pair_parameters(number, options.seed, options.model).items():
            log = logs / namespace / f'{name}.log'
            processes.append(NodeProcess(name, domain, log, parameters, namespace))


def policy_diagnostics(watch: Watch, pairs: int) -> list[dict[str, str]]:
    """Return the latest diagnostic values of each policy; {} for a policy without values yet."""
    return [watch.node.diagnostics.get(f'{namespace}/policy_node'.lstrip('/'), {})
            for namespace in namespaces(pairs)]


def run_training(options: argparse.Namespace, domain: int, watch: Watch) -> dict[str, Any]:
    """Train until all turns are done and all policies have new weights; return the figures."""
    processes: list[NodeProcess] = []
    # Values of the trainer with the turns so far.
    curves: dict[str, list[tuple[int, float]]] = {'critic_loss': [], 'error_ratio': []}
    columns = (TextColumn('{task.description}'), BarColumn(), MofNCompleteColumn(),
               TextColumn('{task.fields[state]}'))

    def trainer_value(name: str, default: Any = 0) -> Any:
        return watch.node.diagnostics.get('trainer_node', {}).get(name, default)

    with stopped_at_the_end(processes), \
            Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task('starting nodes', total=options.turns, state='')
        start_nodes(options, domain, processes)

        def is_done() -> bool:
            # Store values that have changed; the trainer reports ``-`` before the first one.
            turns = int(trainer_value('turns'))
            for name, values in curves.items():
                value = trainer_value(name, '-')
                if value != '-' and (not values or values[-1][1] != float(value)):
                    values.append((turns, float(value)))
            swaps = min(int(values.get('weights_swapped', 0))
                        for values in policy_diagnostics(watch, options.pairs))
            progress.update(task, completed=min(turns, options.turns), state=(
                f'{trainer_value("updates")} updates, {swaps} sets of weights arrived'))
            return turns >= options.turns and swaps > 0

        # More pairs take longer to start. In the training, each turn may take a second more.
        timeout_s = START_TIMEOUT_S + 10.0 * options.pairs
        watch.spin_until(lambda: int(trainer_value('turns')) > 1, timeout_s, 'first turns',
                         processes)
        progress.update(task, description='training')
        start_time = time.monotonic()
        first_turns = int(trainer_value('turns'))
        watch.spin_until(is_done, 2.0 * timeout_s + options.turns,
                         'new weights in every policy_node', processes)
        turns = int(trainer_value('turns')) - first_turns
        return {'turns_per_second': turns / (time.monotonic() - start_time),
                **{f'{name}_by_turns': values for name, values in curves.items()}}


def collect_result(options: argparse.Namespace, watch: Watch, figures: dict[str, Any]
                   ) -> dict[str, Any]:
    """Return the figures of the training and the counts of the nodes' diagnostics."""
    trainer = watch.node.diagnostics['trainer_node']
    policies = policy_diagnostics(watch, options.pairs)
    names = ('turns', 'transitions', 'incomplete', 'inconsistent', 'dropped', 'updates',
             'weights_published')
    # The trainer reports ``turns SOURCE`` for each pair, by namespace.
    sources = {name.removeprefix('turns '): int(value) for name, value in trainer.items()
               if name.startswith('turns ')}
    return {'pairs': options.pairs, **figures, **{name: int(trainer[name]) for name in names},
            'turns_by_source': sources,
            'weights_arrived': min(int(policy['weights_swapped']) for policy in policies),
            'policy_updates': min(int(policy['weights_updates']) for policy in policies),
            'run': trainer['run']}


def print_result(options: argparse.Namespace, result: dict[str, Any]) -> None:
    """Print the results as a table."""
    table = Table('what', 'count', title='Training over ROS')
    for name, value in result.items():
        if isinstance(value, list):
            value = value[:1] + value[-1:]
        table.add_row(name.replace('_', ' '), f'{value:.2f}' if isinstance(value, float) else
                      str(value))
    Console().print(table)
    print(f'wrote {options.out / "train_demo.json"}')


def main(args: list[str] | None = None) -> int:
    """Run the demo; return the exit code."""
    options = build_parser().parse_args(args)
    return run_watched(
        'train_demo', options.out,
        lambda domain, watch: collect_result(options, watch, run_training(options, domain, watch)),
        lambda result: print_result(options, result))


if __name__ == '__main__':
    sys.exit(main())
