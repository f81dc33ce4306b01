# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What the map actor's choice of one position owes to what it reads, and to its labels.

    python -m ocp_ros.training.value_ablation --learn 100 --steps 2500 --out out/ablation.json

Validation rooms are walked through as in training. On each map the network chooses a position for
one camera, once with all it reads and once for each group of channels without it: the channels
have their mean everywhere. Beside it stands who has no network and chooses by the engine on the
points that were seen, and who chooses at random. Regret is the difference, in mean, between the
true value of the position that was chosen and that of the best one; see
:mod:`ocp_ros.training.value_states`.

With ``--learn`` two new networks learn as long and from as many training rooms. The labels of one
are those of the true room, the labels of the other are what positions are worth on what was seen.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from datetime import date
import json
import os
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
import torch

from ocp_ros.agent.agent_config import AgentConfig
from ocp_ros.agent.checkpoint import Checkpoint
from ocp_ros.agent.errors import CheckpointError
from ocp_ros.agent.observation_map import AIR, BOX, SEEN_AIR, SLICES
from ocp_ros.agent.value_network import ValueMap, ValueMapNetwork
from ocp_ros.training.training_config import RoomsConfig, ValuesConfig
from ocp_ros.training.training_rooms import room_names
from ocp_ros.training.value_fit import regret_of, ValueFit, ValueSet
from ocp_ros.training.value_states import play_states, StateTask
from ocp_ros.training.value_training import CHECKED, EVERY, WALKED
from ocp_ros.util.files import write_atomically
from ocp_ros.util.resources import DEFAULT_MODEL, find_model
from ocp_ros.util.worker_pool import WorkerPool

#: Groups of what is read: the part of an observation, and which of its channels.
GROUPS = {
    'points': ('room', slice(0, len(SLICES) + 1)),
    'importance': ('room', slice(len(SLICES) + 1, SEEN_AIR.start)),
    'seen_space': ('room', SEEN_AIR),
    'box_and_viewpoints': ('room', slice(BOX, None)),
    'uncovered_points': ('others', slice(0, 2)),
    'error_left': ('others', slice(2, 4)),
    'covered_space': ('others', slice(4, 4 + len(AIR))),
    'other_cameras': ('others', slice(4 + len(AIR), None)),
    'numbers': ('numbers', slice(None)),
}
#: What a new network may learn: places in the true room, and on what was seen.
LABELS = 'values', 'observed'


class Without(torch.nn.Module):
    """
    A network that does not read some of its inputs.

    :param network: the network.
    :param part: name of a part of the observation.
    :param channels: the channels of the part that have their mean instead.
    :param mean: (C,) of all channels of the part.
    """

    def __init__(self, network: ValueMap, part: str, channels: slice, mean: torch.Tensor) -> None:
        super().__init__()
        self._network, self._part, self._channels = network, part, channels
        self._mean = mean[channels]

    def forward(self, observation: dict[str, torch.Tensor]) -> torch.Tensor:
        """Value all cells; see :class:`~ocp_ros.agent.value_network.ValueMap`."""
        part = observation[self._part].clone()
        mean = self._mean.reshape(-1, *[1] * (part.dim() - 2)).to(part.dtype)
        part[:, self._channels] = mean.expand_as(part[:, self._channels])
        return self._network(observation | {self._part: part})


def means_of(states: Sequence[dict[str, np.ndarray]]) -> dict[str, torch.Tensor]:
    """Return the mean of each channel of each part of some states."""
    found = {}
    for part in ('room', 'others', 'numbers'):
        values = np.concatenate([one[part] for one in states]).astype(np.float64)
        axes = tuple(axis for axis in range(values.ndim) if axis != 1)
        found[part] = torch.from_numpy(values.mean(axis=axes))
    return found


def regrets(network: ValueMap, states: Sequence[dict[str, np.ndarray]]) -> dict[str, float]:
    """
    Measure regret with and without each group of what is read.

    :param states: of rooms, with what places are worth on what was seen; see
        :func:`~ocp_ros.training.value_states.play_states`.
    :returns: regret by name: ``all``, ``without_<group>``, ``observed_points``, ``random``.
    """
    choices, means = ValueSet(states), means_of(states)
    found = {'all': regret_of(network, choices)}
    for name, (part, channels) in GROUPS.items():
        found[f'without_{name}'] = regret_of(
            Without(network, part, channels, means[part]), choices)
    values, observed = (np.concatenate([one[name].reshape(len(one[name]), -1) for one in states])
                        .astype(np.float64) for name in ('values', 'observed'))
    best = np.nanmin(values, axis=1)
    chosen = np.take_along_axis(values, np.nanargmin(observed, axis=1)[:, None], axis=1)[:, 0]
    found['observed_points'] = float(np.mean(chosen - best))
    found['random'] = float(np.mean(np.nanmean(values, axis=1) - best))
    return found


def learned(config: AgentConfig, states: Sequence[dict[str, np.ndarray]], labels: str, steps: int,
            seed: int) -> ValueMap:
    """
    Train a new network.

    :param config: what the network is.
    :param states: to learn from; see :func:`regrets`.
    :param labels: which of the states are the labels: ``values`` or ``observed``.
    :param steps: gradient steps.
    :param seed: of first weights and batches.
    """
    torch.manual_seed(seed)
    fit = ValueFit(ValueMapNetwork(config), ValuesConfig(), seed)
    fit.run(ValueSet([one | {'values': one[labels]} for one in states]), steps, steps)
    return fit.average


def show(found: dict[str, float]) -> None:
    """Print a table."""
    table = Table('the choice is made', 'regret')
    for name, regret in found.items():
        table.add_row(name.replace('_', ' '), f'{regret:.3f}')
    Console().print(table)


def _tasks(rooms: RoomsConfig, names: Sequence[str], seed: int, kind: int) -> list[StateTask]:
    """Return how to walk through some rooms."""
    return [StateTask(rooms, name, (seed, kind, number), observed=True)
            for number, name in enumerate(names)]


def main(argv: Sequence[str] | None = None) -> None:
    """Play, measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--model', default=DEFAULT_MODEL, help='path or name')
    parser.add_argument('--rooms', type=int, default=36, help='of the validation rooms')
    parser.add_argument('--learn', type=int, default=0,
                        help='training rooms to compare labels in; 0: labels are not compared')
    parser.add_argument('--steps', type=int, default=1000, help='gradient steps there')
    parser.add_argument('--workers', type=int, default=os.cpu_count())
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--out', type=Path, required=True)
    options = parser.parse_args(argv)
    checkpoint = Checkpoint.load(find_model(options.model))
    if not checkpoint.config.map:
        raise CheckpointError(f'{options.model}: found weights with the inputs '
                              f'{checkpoint.config.inputs!r}; expected those of the map actor')
    network = ValueMapNetwork(checkpoint.config)
    network.load_state_dict(checkpoint.weights)
    rooms = RoomsConfig(training=max(options.learn, 1), validation=options.rooms, points=25000)
    checked = _tasks(rooms, room_names(rooms, 'validation')[::EVERY], options.seed, CHECKED)
    walked = _tasks(rooms, room_names(rooms, 'training')[:options.learn], options.seed, WALKED)
    with WorkerPool(options.workers) as pool:
        played = list(track(pool.map(play_states, checked + walked), 'rooms',
                            len(checked + walked), console=Console(stderr=True)))
    states, shown = played[:len(checked)], played[len(checked):]
    found = regrets(network.eval(), states)
    if shown:
        choices, config = ValueSet(states), replace(checkpoint.config, headings=0)
        for labels in LABELS:
            found[f'labels_{labels}'] = regret_of(
                learned(config, shown, labels, options.steps, options.seed), choices)
    write_atomically(options.out, json.dumps({
        'model': options.model, 'run': checkpoint.run, 'seed': options.seed,
        'rooms': len(checked), 'learned_from': len(walked), 'steps': options.steps,
        'choices': sum(len(one['of']) for one in states), 'date': date.today().isoformat(),
        'regret': found}, indent=1) + '\n')
    show(found)


if __name__ == '__main__':
    main()
