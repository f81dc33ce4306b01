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
Fit the map actor's network to dense values: regression in which good positions weigh more.

A batch depends only on the seed and on its number, so that an interrupted fit continues exactly
as without the interruption. In this module B is the size of a batch, P the number of labelled
positions on a map, and D the number of headings at each position, 1 for omnidirectional cameras.
"""

from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
import math
from pathlib import Path
from typing import Any

import numpy as np
from ocp_ros.policy.agent_config import CheckpointError
from ocp_ros.policy.checkpoint import read_metadata
from ocp_ros.policy.observation_map import CELLS, used_part, yaws_of
from ocp_ros.policy.value_network import TEMPERATURE, ValueMap
from ocp_ros.training.augmentation import turned_maps
from ocp_ros.training.sac_state import load_slots, saved_slots
from ocp_ros.training.training_config import ValuesConfig
from ocp_ros.util.files import read_regular
import safetensors.torch
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, smooth_l1_loss


class ValueSet:
    """
    Maps, and choices of cameras on them with labels, in memory.

    :param states: states of one room each, see
        :func:`~ocp_ros.training.value_states.play_states`.
    """

    def __init__(self, states: Sequence[dict[str, np.ndarray]]) -> None:
        # The number of the first map of each room; ``zip`` below ignores the last sum.
        first_maps = np.cumsum([0] + [len(arrays['room']) for arrays in states])
        #: The arrays of all rooms, joined; ``numbers`` are scalar inputs of the network.
        self._joined = {name: torch.from_numpy(np.concatenate([arrays[name] for arrays in states]))
                        for name in ('room', 'others', 'numbers', 'lens', 'places', 'values')}
        #: The number of the map of each choice.
        self._map_numbers = torch.from_numpy(np.concatenate(
            [arrays['of'] + first for arrays, first in zip(states, first_maps)])).long()
        #: (M, 2) first used row and column of each of M maps. This corner defines the used part,
        #: which is central.
        self._corners = np.array([[part.start for part in used_part(room)]
                                  for room in self._joined['room'].numpy()])
        corners, map_groups = np.unique(self._corners, axis=0, return_inverse=True)
        choice_groups = map_groups.ravel()[self._map_numbers.numpy()]
        #: The numbers of the choices whose maps have the same used part, for each used part.
        self._alike = [np.flatnonzero(choice_groups == group) for group in range(len(corners))]

    @classmethod
    def joined(cls, sets: Sequence['ValueSet']) -> 'ValueSet':
        """Return one set with the maps and choices of several sets."""
        return cls([{name: value.numpy() for name, value in value_set._joined.items()}
                    | {'of': value_set._map_numbers.numpy()} for value_set in sets])

    def __len__(self) -> int:
        """Return the number of choices."""
        return len(self._map_numbers)

    def draw(self, rng: np.random.Generator, size: int) -> Tensor:
        """Draw the numbers of ``size`` choices whose maps have the same used part."""
        # Draw a used part with a probability proportional to its number of choices.
        shares = np.array([len(choices) for choices in self._alike]) / len(self)
        alike = self._alike[rng.choice(len(shares), p=shares)]
        return torch.from_numpy(rng.choice(alike, size))

    def batches(self, size: int) -> Iterator[Tensor]:
        """Yield the numbers of all choices, at most ``size`` of the same used part at a time."""
        for choices in self._alike:
            yield from torch.from_numpy(choices).split(size)

    def batch(self, rows: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """
        Return some choices as the inputs and labels of a batch.

        :param rows: (B,) numbers of choices whose maps have the same used part.
        :returns: the inputs of the network, the labelled positions (B, P, 2) in cells of its maps,
            and the labels (B, P, D), NaN where there is no label.
        """
        joined, map_rows = self._joined, self._map_numbers[rows]
        # All maps have the used part of the first one.
        corner = self._corners[map_rows[0]]
        # The used part is central: the margins on opposite sides are equal.
        used = (slice(None), slice(None), *(slice(first, CELLS - first) for first in corner))
        return ({'room': joined['room'][map_rows][used], 'others': joined['others'][rows][used],
                 'numbers': joined['numbers'][rows], 'lens': joined['lens'][rows]},
                joined['places'][map_rows] - torch.tensor(corner), joined['values'][rows].float())


def values_at(maps: Tensor, places: Tensor) -> Tensor:
    """
    Return the values of maps at positions, by linear interpolation.

    :param maps: (B, D, rows, columns) values.
    :param places: (B, P, 2) positions, row and column in cells from the outer edge of the first
        cell; the value of a cell is that at its centre, index + 0.5.
    :returns: (B, P, D) values; beyond the outermost centres, the value of the nearest cell.
    """
    # grid_sample expects positions from -1 to 1, between the outer edges of the map as
    # ``align_corners`` is False, in the order of image axes: columns first.
    scale = 2.0 / torch.tensor(maps.shape[2:])
    grid = (places * scale - 1.0).flip(-1)[:, :, None]
    return grid_sample(maps, grid, align_corners=False,
                       padding_mode='border')[..., 0].transpose(1, 2)


def turned_inputs(observation: dict[str, Tensor], places: Tensor, number: int
                  ) -> tuple[dict[str, Tensor], Tensor]:
    """
    Return maps, and positions on them, rotated or mirrored by one symmetry of the square.

    :param observation: inputs of the map actor, batched.
    :param places: (B, P, 2) positions, row and column in cells.
    :param number: the number of the symmetry, 0 to 7; see
        :func:`~ocp_ros.training.augmentation.turned_maps`.
    :returns: the observation, and the positions in cells, both rotated or mirrored.
    """
    centre = 0.5 * torch.tensor(observation['room'].shape[2:])
    turned, offsets = turned_maps(observation, places - centre, number)
    return turned, offsets + 0.5 * torch.tensor(turned['room'].shape[2:])


def turned_headings(count: int, number: int) -> Tensor:
    """Return for each of ``count`` headings its index after symmetry ``number``: (count,)."""
    yaws = torch.from_numpy(yaws_of(count))
    # Directions turn like positions relative to the centre of a map; there are no maps to turn.
    _, directions = turned_maps({}, torch.stack([yaws.cos(), yaws.sin()], dim=-1), number)
    turned_yaws = torch.atan2(directions[:, 1], directions[:, 0])
    return (turned_yaws * (count / (2.0 * math.pi))).round().long() % count


def loss_of(predicted: Tensor, labels: Tensor) -> Tensor:
    """
    Return the loss of predictions: weighted regression, and divergence of the implied policies.

    The policy that values imply is the softmax of the negative values, as in
    :class:`~ocp_ros.policy.value_network.CellChoices`.

    :param predicted: (B, P, D) values; less is better.
    :param labels: (B, P, D) true values; NaN: no label.
    """
    predicted, labels = predicted.flatten(1), labels.flatten(1)
    known = ~labels.isnan()
    # Labels are logarithms of ratios of errors, at most about 0. So 10 is a very bad value: the
    # true policy never chooses a position without a label.
    labels = torch.where(known, labels, 10.0)
    # The best position has an extra weight of 6, which falls by the factor e per 0.1 of the value.
    weights = known * (1.0 + 6.0 * torch.exp((labels.amin(dim=1, keepdim=True) - labels) / 0.1))
    # The loss is quadratic in errors up to 0.1, linear in larger ones.
    losses = smooth_l1_loss(predicted, labels, beta=0.1, reduction='none')
    true_policy = torch.softmax(-labels / TEMPERATURE, dim=1)
    # With the logit -1e4, the predicted policy never chooses a position without a label either.
    log_policy = torch.where(known, -predicted / TEMPERATURE, -1e4).log_softmax(dim=1)
    # The terms of the divergence D(true policy || predicted policy), whose weight in the loss is
    # 0.03. The clamp avoids the logarithm of 0.
    terms = torch.where(known, true_policy * (true_policy.clamp(min=1e-9).log() - log_policy), 0.0)
    return (losses * weights).sum() / weights.sum() + 0.03 * terms.sum(dim=1).mean()


def regret_of(network: ValueMap, choices: ValueSet, size: int = 64) -> float:
    """
    Return the mean regret: label of the position predicted best minus the best, smallest label.

    :param network: predicts the values.
    :param choices: maps, positions and labels.
    :param size: the largest number of choices in a batch.
    """
    regrets = []
    with torch.inference_mode():
        for rows in choices.batches(size):
            observation, places, labels = choices.batch(rows)
            predicted = values_at(network(observation), places).flatten(1)
            labels = labels.flatten(1)
            predicted = torch.where(labels.isnan(), torch.inf, predicted)
            chosen = labels.gather(1, predicted.argmin(dim=1, keepdim=True))[:, 0]
            regrets.append(chosen - labels.nan_to_num(torch.inf).amin(dim=1))
    return float(torch.cat(regrets).mean())


class ValueFit:
    """
    A fit of a network that can be interrupted and resumed.

    :param network: the network, which is trained from its present weights on.
    :param config: batch size, step sizes and averaging.
    :param seed: random seed of the batches.
    :ivar average: the result: a network with the moving average of the weights.
    :ivar step: number of gradient steps so far.
    """

    def __init__(self, network: ValueMap, config: ValuesConfig, seed: int) -> None:
        self.config = config
        self._seed = seed
        self.step = 0
        self.network = network.to(memory_format=torch.channels_last)
        self.average = deepcopy(network).eval()
        self._optimizer = torch.optim.AdamW(network.parameters(), config.learning_rate,
                                            weight_decay=1e-4)

    def run(self, choices: ValueSet, until: int, total: int,
            watch: Callable[[int, float], Any] = lambda step, loss: None) -> None:
        """
        Take gradient steps; the step size falls to its last value along a cosine.

        :param choices: training set.
        :param until: number of the step to stop at, counted from the beginning of the fit.
        :param total: number of the step at which the step size reaches its last value.
        :param watch: is called after each step with its number and its loss; what it returns is
            ignored.
        """
        first, last = self.config.learning_rate, self.config.last_learning_rate
        while self.step < until:
            share = 0.5 * (1.0 + math.cos(math.pi * self.step / total))
            for group in self._optimizer.param_groups:
                # In the first 100 gradient steps the step size grows linearly from 0.
                group['lr'] = (last + (first - last) * share) * min((self.step + 1) / 100, 1.0)
            loss = self._step(choices)
            watch(self.step, loss)

    def _step(self, choices: ValueSet) -> float:
        """Take one gradient step, and return its loss."""
        rng = np.random.default_rng([self._seed, self.step])
        observation, places, labels = choices.batch(choices.draw(rng, self.config.batch_size))
        # A random symmetry changes the inputs alone. Labels keep the order of the headings before
        # it, so predictions are brought into this order.
        number = int(rng.integers(8))
        observation, places = turned_inputs(observation, places, number)
        predicted = values_at(self.network(observation), places)
        loss = loss_of(predicted[..., turned_headings(labels.shape[2], number)], labels)
        self._optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self._optimizer.step()
        self.step += 1
        with torch.no_grad():
            # In the first steps the average follows the weights faster, by a larger share.
            share = 1.0 - min(self.config.averaging, self.step / (self.step + 10.0))
            for average, weights in zip(self.average.parameters(), self.network.parameters()):
                average.lerp_(weights, share)
        return loss.item()

    def to_bytes(self, run: str) -> bytes:
        """Return the state to resume from as a safetensors blob, with the name of the run."""
        tensors = {f'network.{name}': value for name, value in self.network.state_dict().items()}
        tensors |= {f'average.{name}': value for name, value in self.average.state_dict().items()}
        tensors |= saved_slots(self._optimizer, 'optimizer.')
        tensors['step'] = torch.tensor(self.step)
        return safetensors.torch.save({name: value.contiguous().clone()
                                       for name, value in tensors.items()}, {'run': run})

    def load(self, path: Path) -> str:
        """
        Resume from the state in a file.

        :returns: the name of the run.
        :raises CheckpointError: if the state is damaged or of another network.
        """
        try:
            blob = read_regular(path)
            tensors, run = safetensors.torch.load(blob), read_metadata(blob)['run']
            parts: dict[str, dict[str, Tensor]] = {'network': {}, 'average': {}, 'optimizer': {}}
            for name, value in tensors.items():
                if name != 'step':
                    part, _, key = name.partition('.')
                    parts[part][key] = value
            self.network.load_state_dict(parts['network'])
            self.average.load_state_dict(parts['average'])
            load_slots(self._optimizer, parts['optimizer'])
            self.step = int(tensors['step'])
        except (OSError, safetensors.SafetensorError, KeyError, TypeError, ValueError,
                RuntimeError) as error:
            raise CheckpointError(
                f'{path}: found no training state for this network ({error}); expected a whole '
                'one, saved with the same settings; put it back from a copy, or begin in another '
                'folder: states of rooms that were played may be copied there') from error
        return run
