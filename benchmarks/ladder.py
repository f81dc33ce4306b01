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
Which repairs make the paper's agent learn: a ladder of trainings, each with more repairs.

All have the potential reward, four cameras, 30 turns of at most 0.5 m, and the same rooms, engine
and viewpoints. ``literal`` has the networks and the learning of the paper's run; ``critics`` the
repaired network, whose extractor the critics train, augmented samples, and cameras that choose one
after the other; ``updates`` more and larger gradient steps; ``blocks`` residual heads; ``wide`` a
larger extractor.

    python -m benchmarks.ladder --rungs literal critics --out out/ladder
    python -m benchmarks.ladder --record

A run that was interrupted goes on. ``--record`` writes what the runs of the folder have done,
beside the rows of earlier folders.
"""

import argparse
import json
import logging
from pathlib import Path
from typing import Any

from benchmarks import results
from ocp_ros.training.run_folder import read_config, records
from ocp_ros.training.train import train
from ocp_ros.training.training_config import TrainingConfig
from ocp_ros.util.settings import from_nested
from ocp_ros.util.yaml_files import read_plain

#: Settings of the first rung and of all others, which have the repaired network.
LITERAL, REPAIRED = Path('config/train/paper.yaml'), Path('config/train/actor.yaml')
#: What all rungs have in common, and what each adds to the one before.
COMMON: dict[str, Any] = {
    'interactions': 60_000, 'environments': 4, 'evaluate_every': 10_000, 'fewest_cameras': 4,
    'rooms': {'training': 50, 'validation': 12, 'rotations': '0,60,120'},
    'episodes': {'fewest_turns': 0, 'longest_step': 0.0, 'farthest_range': 0.0,
                 'widest_start': 0.0, 'rig_file': '', 'rig_share': 0.0},
    'simulation': {'engine': {'preset': 'fast', 'error_rows': 64, 'coverage_cell': 0.5,
                              'viewpoints': 'air'},
                   'rig': {'cameras': 4, 'max_range': 4.0}, 'reward': {'kind': 'potential'}},
    'sac': {'buffer_size': 60_000, 'device': 'cpu', 'constant_share': 1.0, 'averaging': 0}}
RUNGS: dict[str, dict[str, Any]] = {
    'literal': {},
    'critics': {'updates_per_turn': 1 / 32, 'agent': {'hidden': 256, 'blocks': 0},
                'sac': {'batch_size': 64, 'gamma': 0.99, 'n_steps': 1, 'tau': 0.005,
                        'learning_rate': 3e-4}},
    'updates': {'updates_per_turn': 0.25,
                'sac': {'batch_size': 128, 'gamma': 0.95, 'n_steps': 3, 'tau': 0.01,
                        'learning_rate': 5e-4}},
    'blocks': {'agent': {'blocks': 2, 'hidden': 128}},
    'wide': {'agent': {'channels': 64, 'keys_2': 16, 'pooled': 256}}}


def merged(settings: dict[str, Any], more: dict[str, Any]) -> dict[str, Any]:
    """Return settings with others put in their place."""
    found = dict(settings)
    for name, value in more.items():
        found[name] = merged(found.get(name, {}), value) if isinstance(value, dict) else value
    return found


def config_of(rung: str, seed: int, interactions: int) -> TrainingConfig:
    """Return the settings of a rung: those of all rungs up to it."""
    nested = merged(read_plain(LITERAL if rung == 'literal' else REPAIRED).data, COMMON)
    nested['simulation']['reward'] = COMMON['simulation']['reward']
    for name, more in RUNGS.items():
        nested = merged(nested, more)
        if name == rung:
            break
    nested |= {'seed': seed, 'interactions': interactions}
    nested['sac'] |= {'buffer_size': interactions}
    return from_nested(TrainingConfig, nested, rung)


def row_of(folder: Path) -> dict[str, Any]:
    """Return what a run has done, from its lines of progress."""
    lines = records(folder)
    config, last = read_config(folder / 'config.yaml'), lines[-1]
    return {'seed': config.seed, 'interactions': last['interactions'], 'updates': last['updates'],
            'minutes': round(last['seconds'] / 60.0, 1), 'ratio': round(last['ratio'], 3),
            'least_ratio': round(min(line['ratio'] for line in lines), 3),
            'critic_loss': last.get('critic_loss'),
            'curve': [[line['interactions'], round(line['ratio'], 3)] for line in lines]}


def main(argv: list[str] | None = None) -> None:
    """Run."""
    parser = argparse.ArgumentParser(prog='ladder', description=__doc__)
    parser.add_argument('--rungs', nargs='*', default=(), choices=tuple(RUNGS))
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--interactions', type=int, default=COMMON['interactions'])
    parser.add_argument('--out', type=Path, default=Path('out/ladder'))
    results.add_record(parser, 'ladder')
    options = parser.parse_args(argv)
    logging.basicConfig(level=logging.INFO)
    command = results.command_of('ladder', argv)
    for rung in options.rungs:
        folder = options.out / f'{rung}_{options.interactions}_{options.seed}'
        train(config_of(rung, options.seed, options.interactions), folder, command)
        print(rung, row_of(folder), flush=True)
    if options.record:
        before = json.loads((results.FOLDER / 'ladder.json').read_text())
        rows = {folder.name: row_of(folder) for folder in sorted(options.out.iterdir())
                if records(folder)}
        results.write('ladder', {'rows': before['rows'] | rows}, command)


if __name__ == '__main__':
    main()
