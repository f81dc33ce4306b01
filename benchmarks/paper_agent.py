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

All have the potential reward and the same rooms, engine and viewpoints. ``literal`` has the
networks and the learning of the paper's run; ``critics`` the repaired network, whose extractor the
critics train, and cameras that choose one after the other; ``updates`` more and larger gradient
steps; ``blocks`` residual heads; ``augmented`` symmetries and jitter; ``wide`` a larger extractor.

    python -m benchmarks.paper_agent --rungs literal critics --out out/ladder
    python -m benchmarks.paper_agent --record --evaluation out/evaluation/evaluation.json
    python -m benchmarks.paper_agent --record --alone two_cameras out/actor.json out/paper.json

A run that was interrupted goes on. ``--record`` writes what the runs of the folder have done,
beside the rows of earlier folders, what ``ocp evaluate`` has found about the best weights, and how
the default weights compare with them without lookahead, in two files of ``benchmarks.few_turns``
for each case.
"""

import argparse
import json
import logging
from pathlib import Path
from typing import Any

from benchmarks import results
from benchmarks.few_turns import over_before
from ocp_ros.training.run_folder import read_config, records
from ocp_ros.training.train import train
from ocp_ros.training.training_config import TrainingConfig
from ocp_ros.util.settings import from_nested
from ocp_ros.util.yaml_files import read_plain

#: Settings of the first rung and of all others, which have the repaired network.
LITERAL, REPAIRED = Path('config/train/paper.yaml'), Path('config/train/paper_repaired.yaml')
#: What all rungs have in common, and what each adds to the one before.
COMMON: dict[str, Any] = {
    'interactions': 60_000, 'environments': 4, 'evaluate_every': 10_000,
    'simulation': {'engine': {'preset': 'fast', 'error_rows': 64, 'coverage_cell': 0.5,
                              'viewpoints': 'air'},
                   'reward': {'kind': 'potential'}},
    'sac': {'buffer_size': 60_000, 'device': 'cpu'}}
RUNGS: dict[str, dict[str, Any]] = {
    'literal': {},
    'critics': {'updates_per_turn': 1 / 32, 'agent': {'hidden': 256, 'blocks': 0},
                'sac': {'batch_size': 64, 'gamma': 0.99, 'n_steps': 1, 'tau': 0.005,
                        'learning_rate': 3e-4, 'augmentation': 'none'}},
    'updates': {'updates_per_turn': 0.25,
                'sac': {'batch_size': 128, 'gamma': 0.95, 'n_steps': 3, 'tau': 0.01,
                        'learning_rate': 5e-4}},
    'blocks': {'agent': {'blocks': 2, 'hidden': 128}},
    'augmented': {'sac': {'augmentation': 'jitter'}},
    'wide': {'agent': {'channels': 64, 'keys_2': 16, 'pooled': 256}}}


def merged(settings: dict[str, Any], more: dict[str, Any]) -> dict[str, Any]:
    """Return settings with others put in their place."""
    found = dict(settings)
    for name, value in more.items():
        found[name] = merged(found.get(name, {}), value) if isinstance(value, dict) else value
    return found


def config_of(rung: str, seed: int, interactions: int, demonstrations: int = 0
              ) -> TrainingConfig:
    """Return the settings of a rung: those of all rungs up to it."""
    nested = merged(read_plain(LITERAL if rung == 'literal' else REPAIRED).data, COMMON)
    nested['simulation']['reward'] = COMMON['simulation']['reward']
    for name, more in RUNGS.items():
        nested = merged(nested, more)
        if name == rung:
            break
    nested |= {'seed': seed, 'interactions': interactions}
    nested['sac'] |= {'buffer_size': interactions, 'demonstrations': demonstrations}
    return from_nested(TrainingConfig, nested, rung)


def row_of(folder: Path) -> dict[str, Any]:
    """Return what a run has done, from its lines of progress."""
    lines = [line for line in records(folder) if 'ratio' in line]
    config, last = read_config(folder / 'config.yaml'), lines[-1]
    return {'seed': config.seed, 'demonstrations': config.sac.demonstrations,
            'interactions': last['interactions'], 'updates': last['updates'],
            'minutes': round(last['seconds'] / 60.0, 1), 'ratio': round(last['ratio'], 3),
            'least_ratio': round(min(line['ratio'] for line in lines), 3),
            'critic_loss': last.get('critic_loss'),
            'curve': [[line['interactions'], round(line['ratio'], 3)] for line in lines]}


def against(path: Path) -> dict[str, Any]:
    """
    Return how the agent compares with other planners in the test rooms.

    :param path: ``evaluation.json`` of ``ocp evaluate``, with ``learned`` as the first planner.
    :returns: by planner and budget the ratio of errors (agent / planner, geometric mean), its 95 %
        interval, and the number of rooms that the agent wins.
    """
    found = json.loads(path.read_text())
    (compared,) = found['cameras'].values()
    return {'command': found['command'], 'over': {
        name.replace(', ', '_').replace(',', ''): {
            key: pair[key] for key in ('ratio', 'interval', 'wins', 'rooms')}
        for name, pair in compared['pairs'].items() if not name.startswith('learned')}}


def compare_alone(actor: Path, paper: Path) -> dict[str, Any]:
    """
    Return by length of episodes how two models compare as the only planner.

    :param actor: file of ``benchmarks.few_turns`` with the default weights.
    :param paper: the same with the weights of the paper's agent.
    :returns: ratio of errors (actor / paper, geometric mean), its 95 % interval, rooms, and
        milliseconds a turn of both.
    """
    documents = [json.loads(path.read_text()) for path in (actor, paper)]
    pairs = over_before(*(document['rooms'] for document in documents))
    return {'command': documents[0]['command'], 'lengths': {
        length: {key: row['learned'][key] for key in ('ratio', 'interval', 'rooms')}
        | {'ms': [document['summary'][length]['learned']['ms'] for document in documents]}
        for length, row in pairs.items()}}


def main(argv: list[str] | None = None) -> None:
    """Run."""
    parser = argparse.ArgumentParser(prog='paper_agent', description=__doc__)
    parser.add_argument('--rungs', nargs='*', default=(), choices=tuple(RUNGS))
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--interactions', type=int, default=COMMON['interactions'])
    parser.add_argument('--demonstrations', type=int, default=0, help='first interactions that '
                        'are demonstrations')
    parser.add_argument('--out', type=Path, default=Path('out/ladder'))
    parser.add_argument('--evaluation', type=Path, help='evaluation.json of ocp evaluate')
    parser.add_argument('--alone', nargs=3, action='append', default=[],
                        metavar=('CASE', 'ACTOR', 'PAPER'), help='files of benchmarks.few_turns')
    results.add_record(parser, 'paper_agent')
    options = parser.parse_args(argv)
    logging.basicConfig(level=logging.INFO)
    command = results.command_of('paper_agent', argv)
    for rung in options.rungs:
        demonstrated = '_demonstrations' if options.demonstrations else ''
        folder = options.out / f'{rung}_{options.interactions}_{options.seed}{demonstrated}'
        train(config_of(rung, options.seed, options.interactions, options.demonstrations), folder,
              command)
        print(rung, row_of(folder), flush=True)
    if options.record:
        before = json.loads((results.FOLDER / 'paper_agent.json').read_text())
        rows = {folder.name: row_of(folder) for folder in sorted(options.out.iterdir())
                if any('ratio' in line for line in records(folder))}
        figures = {
            'rows': before['rows'] | rows,
            'test': against(options.evaluation) if options.evaluation else before['test'],
            'alone': before['alone'] | {
                case: compare_alone(*map(Path, paths)) for case, *paths in options.alone}}
        results.write('paper_agent', figures, command)


if __name__ == '__main__':
    main()
