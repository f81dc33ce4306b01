# SPDX-License-Identifier: Apache-2.0
"""
Training over real ROS: sim, policy and trainer, each a process, for a few hundred turns.

Shows that weights trained from the topics arrive in ``policy_node``; writes ``train_demo.json``.
"""

import argparse
import json
import os
from pathlib import Path
import sys
import time
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table

from ocp_ros.nodes.demo import START_TIMEOUT
from ocp_ros.nodes.processes import (
    end_on_signals,
    free_domain,
    LOCALHOST,
    NodeProcess,
    stopped_at_the_end,
)
from ocp_ros.nodes.watcher import Watch


def parser() -> argparse.ArgumentParser:
    """Build the parser."""
    top = argparse.ArgumentParser(prog='train_demo', description=__doc__)
    top.add_argument('--turns', type=int, default=400, help='turns to play in all')
    top.add_argument('--seed', type=int, default=1, help='of the generated room')
    top.add_argument('--model', default='default', help='weights to start from: path or name')
    top.add_argument('--out', type=Path, default=Path('out'), help='folder for the results')
    return top


def nodes(options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Return the nodes and their parameters; the trainer first, so that it hears every turn."""
    return {
        'trainer_node': {'model': options.model, 'folder': str(options.out / 'trainer'),
                         'publish_every': 20, 'sac.learning_starts': 100, 'sac.burn_in': 20,
                         'updates_per_turn': 0.5},
        'policy_node': {'model': options.model, 'explore': True},
        'sim_node': {'scene.seed': options.seed, 'auto_reset': True}}


def play(options: argparse.Namespace, domain: int, watch: Watch) -> float:
    """Run the loop for the turns asked for, and until new weights have arrived; seconds taken."""
    node, processes = watch.node, []
    columns = (TextColumn('{task.description}'), BarColumn(), MofNCompleteColumn(),
               TextColumn('{task.fields[state]}'))
    with stopped_at_the_end(processes), \
            Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task('starting nodes', total=options.turns, state='')
        for name, parameters in nodes(options).items():
            log = options.out / 'logs' / f'{name}.log'
            processes.append(NodeProcess(name, domain, log, parameters))

        def done() -> bool:
            played = len(node.rewards)
            swapped = int(node.health.get('policy_node', {}).get('weights_swapped', 0))
            progress.update(task, completed=min(played, options.turns), state=(
                f'{node.health.get("trainer_node", {}).get("updates", 0)} updates, '
                f'{swapped} sets of weights arrived'))
            return played >= options.turns and swapped > 0

        watch.until(lambda: len(node.rewards) > 1, START_TIMEOUT, 'first turns', processes)
        progress.update(task, description='training')
        began = time.monotonic()
        watch.until(done, 2.0 * START_TIMEOUT, 'new weights in policy_node', processes)
        return time.monotonic() - began


def result_of(watch: Watch, seconds: float) -> dict[str, Any]:
    """Collect the counts that the nodes published about themselves."""
    trainer, policy = (watch.node.health[name] for name in ('trainer_node', 'policy_node'))
    names = ('transitions', 'incomplete', 'inconsistent', 'updates', 'weights_published')
    turns = len(watch.node.rewards)
    return {'turns': turns, 'turns_per_second': turns / seconds,
            **{name: int(trainer[name]) for name in names},
            'weights_arrived': int(policy['weights_swapped']),
            'policy_updates': int(policy['weights_updates']), 'run': policy['weights_run']}


def main(args: list[str] | None = None) -> int:
    """Run the demo."""
    options = parser().parse_args(args)
    end_on_signals()
    os.environ.update(LOCALHOST)
    domain, holder = free_domain()
    try:
        with holder, Watch(domain) as watch:
            result = result_of(watch, play(options, domain, watch))
    except RuntimeError as error:
        print(f'train_demo: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    (options.out / 'train_demo.json').write_text(json.dumps(result, indent=2) + '\n')
    table = Table('what', 'count', title='Training over ROS')
    for name, value in result.items():
        table.add_row(name.replace('_', ' '), f'{value:.1f}' if isinstance(value, float) else
                      str(value))
    Console().print(table)
    print(f'wrote {options.out / "train_demo.json"}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
