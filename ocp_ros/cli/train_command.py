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

"""``ocp train``: train a policy."""

import argparse
from dataclasses import replace
from pathlib import Path
import sys

from ocp_ros.cli.arguments import add_overwrite, read_seed
from ocp_ros.cli.common import claim_file, Commands, Found, LEARN, show_written
from ocp_ros.util.files import folder_to_write, printable
from ocp_ros.util.resources import find_config
from ocp_ros.util.settings import need


def add_arguments(commands: Commands) -> None:
    """Add ``ocp train``."""
    command = commands.add(
        LEARN, 'train', 'train a policy',
        'ocp train --config config/train/actor.yaml --out out/train --model mine.safetensors')
    command.add_argument('--config', type=find_config, required=True,
                         help='YAML of training settings')
    command.add_argument('--out', type=Path, required=True, help='folder of the run; an '
                         'interrupted run continues')
    command.add_argument('--model', type=Path, help='also write the best weights to this file')
    command.add_argument('--seed', type=read_seed, help='random seed that replaces the setting')
    add_overwrite(command)
    command.set_defaults(run=run, show=show)


def run(arguments: argparse.Namespace) -> Found:
    """Train a policy, and return its results in the test rooms."""
    need('ocp train', 'stable_baselines3', 'gymnasium', 'tensorboard')
    # ocp_ros.training sets a variable that torch reads when it is imported, so ``checkpoint``,
    # which imports torch, comes later.
    from ocp_ros.training.run_folder import read_config
    from ocp_ros.training.train import train
    config = read_config(arguments.config)
    command = f'ocp train --config {arguments.config}'
    if arguments.seed is not None:
        config = replace(config, seed=arguments.seed)
        command += f' --seed {arguments.seed}'
    folder_to_write(arguments.out)
    from ocp_ros.policy.checkpoint import card_of
    outputs = [arguments.model, card_of(arguments.model)] if arguments.model else []
    for path in outputs:
        claim_file(arguments, path, 'weights and their card', '--model')
    try:
        checkpoint = train(config, arguments.out, command)
    except KeyboardInterrupt:
        print(f'ocp: stopped; the same command continues with what is saved in '
              f'{printable(str(arguments.out))}', file=sys.stderr)
        raise
    if arguments.model:
        checkpoint.save(arguments.model)
    return {'test': checkpoint.provenance['test'],
            'written': [arguments.model] if arguments.model else []}


def show(result: Found) -> None:
    """Print the results of a policy in the test rooms."""
    for name in ('random_moves', 'policy'):
        figures = result['test'][name]
        print(f'{name:>12}: depth error {figures["depth_error_start"]:.2f} m -> '
              f'{figures["depth_error_end"]:.2f} m ({figures["ratio"]:.3f})')
    show_written(result)
