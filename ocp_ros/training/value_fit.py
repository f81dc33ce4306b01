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
Fit the map actor's network to dense values: regression with larger weights of good positions.

A batch depends only on the seed and on its number, so that an interrupted fit continues exactly
as without the interruption.
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
from ocp_ros.policy.value_network import ValueMap
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
    Maps and choices with labels, in memory.

    :param episodes: from :func:`~ocp_ros.training.value_states.play_states`, of one room each.
    """

    def __init__(self, episodes: Sequence[dict[str, np.ndarray]]) -> None:
        firsts = np.cumsum([0] + [len(one['room']) for one in episodes])
        self._joined = {name: torch.from_numpy(np.concatenate([one[name] for one in episodes]))
                        for name in ('room', 'others', 'numbers', 'lens', 'places', 'values')}
        self._of = torch.from_numpy(np.concatenate(
            [one['of'] + first for one, first in zip(episodes, firsts)])).long()
        #: (M, 2) first used row and column of each map.
        self._firsts = np.array([[part.start for part in used_part(room)]
                                 for room in self._joined['room'].numpy()])
        kinds, of_maps = np.unique(self._firsts, axis=0, return_inverse=True)
        of_choices = of_maps.ravel()[self._of.numpy()]
        self._alike = [np.flatnonzero(of_choices == kind) for kind in range(len(kinds))]

    @classmethod
    def joined(cls, sets: Sequence['ValueSet']) -> 'ValueSet':
        """Return the concatenation of sets."""
        return cls([{name: value.numpy() for name, value in one._joined.items()}
                    | {'of': one._of.numpy()} for one in sets])

    def __len__(self) -> int:
        """Return the number of choices."""
        return len(self._of)

    def draw(self, rng: np.random.Generator, size: int) -> Tensor:
        """Draw ``size`` choices whose maps have the same used part, with equal probability."""
        shares = np.array([len(rows) for rows in self._alike]) / len(self)
        return torch.from_numpy(rng.choice(self._alike[rng.choice(len(shares), p=shares)], size))

    def in_order(self, size: int) -> Iterator[Tensor]:
        """Yield all choices in groups of at most ``size`` whose maps have the same used part."""
        for rows in self._alike:
            yield from torch.from_numpy(rows).split(size)

    def batch(self, rows: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """
        Return some choices as a batch.

        :param rows: (B,) numbers of choices whose maps have the same used part.
        :returns: the inputs of the network, ``places`` (B, P, 2) in cells of its maps, and the
            labels ``values`` (B, P, D), NaN where there is no label.
        """
        joined, of = self._joined, self._of[rows]
        first = self._firsts[of[0]]
        middle = (slice(None), slice(None), *(slice(one, CELLS - one) for one in first))
        return ({'room': joined['room'][of][middle], 'others': joined['others'][rows][middle],
                 'numbers': joined['numbers'][rows], 'lens': joined['lens'][rows]},
                joined['places'][of] - torch.tensor(first), joined['values'][rows].float())


def at_places(values: Tensor, places: Tensor) -> Tensor:
    """
    Interpolate maps at positions.

    :param values: maps (B, D, H, W).
    :param places: positions (B, P, 2) in cells.
    :returns: (B, P, D).
    """
    scale = 2.0 / torch.tensor(values.shape[2:])
    # grid_sample expects positions in the order of image axes: columns first.
    grid = (places * scale - 1.0).flip(-1)[:, :, None]
    return grid_sample(values, grid, align_corners=False,
                       padding_mode='border')[..., 0].transpose(1, 2)


def turned_at_random(observation: dict[str, Tensor], places: Tensor, number: int
                     ) -> tuple[dict[str, Tensor], Tensor]:
    """Rotate or mirror maps and positions by one of the eight symmetries of the square."""
    half = 0.5 * torch.tensor(observation['room'].shape[2:])
    turned, middle = turned_maps(observation, places - half, number)
    half = 0.5 * torch.tensor(turned['room'].shape[2:])
    return turned, middle + half


def turned_headings(headings: int, number: int) -> Tensor:
    """Return the index (D,) to which a symmetry takes each of D headings."""
    yaws = torch.from_numpy(yaws_of(headings))
    _, ahead = turned_maps({}, torch.stack([yaws.cos(), yaws.sin()], dim=-1), number)
    turned = torch.atan2(ahead[:, 1], ahead[:, 0])
    return (turned * (headings / (2.0 * math.pi))).round().long() % headings


def loss_of(predicted: Tensor, values: Tensor) -> Tensor:
    """Return the loss of predictions (B, P, D) against labels (B, P, D), some of them NaN."""
    predicted, values = predicted.flatten(1), values.flatten(1)
    known = ~values.isnan()
    labels = torch.where(known, values, 10.0)
    # The best position has an extra weight, which falls by the factor e per 0.1 of the value.
    weight = (1.0 + 6.0 * torch.exp(
        (labels.amin(dim=1, keepdim=True) - labels) / 0.1)) * known
    # Below an error of 0.1 the loss is quadratic, above it is linear.
    away = smooth_l1_loss(predicted, labels, beta=0.1, reduction='none')
    temperature = 0.05
    best = torch.softmax(-labels / temperature, dim=1)
    said = torch.where(known, -predicted / temperature, -1e4).log_softmax(dim=1)
    cross = torch.where(known, best * (best.clamp(min=1e-9).log() - said), 0.0).sum(dim=1)
    # The divergence of the softmax of predictions from that of labels.
    return (away * weight).sum() / weight.sum() + 0.03 * cross.mean()


def regret_of(network: ValueMap, choices: ValueSet, size: int = 64) -> float:
    """Return the mean regret: label of the position predicted best minus the best label."""
    lost = []
    with torch.inference_mode():
        for rows in choices.in_order(size):
            observation, places, values = choices.batch(rows)
            predicted = at_places(network(observation), places)
            predicted, values = predicted.flatten(1), values.flatten(1)
            predicted = torch.where(values.isnan(), torch.inf, predicted)
            chosen = values.gather(1, predicted.argmin(dim=1, keepdim=True))[:, 0]
            lost.append(chosen - values.nan_to_num(torch.inf).amin(dim=1))
    return float(torch.cat(lost).mean())


class ValueFit:
    """
    A running fit.

    :param network: is trained, from its present weights on.
    :param config: numbers of steps and step sizes.
    :param seed: of the batches.
    :ivar average: network with the moving average of the weights, which is the result.
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
        Take gradient steps whose size falls from the first to the last one along a cosine.

        :param choices: training set.
        :param until: number of the step to stop at, counted from the beginning of the fit.
        :param total: number of the step at which the step size reaches its last value.
        :param watch: is called with the number of each step and its loss.
        """
        first, last = self.config.learning_rate, self.config.last_learning_rate
        while self.step < until:
            part = 0.5 * (1.0 + math.cos(math.pi * self.step / total))
            for group in self._optimizer.param_groups:
                # In the first 100 gradient steps the step size grows linearly from 0.
                group['lr'] = (last + (first - last) * part) * min((self.step + 1) / 100, 1.0)
            loss = self._step(choices)
            watch(self.step, loss)

    def _step(self, choices: ValueSet) -> float:
        """Take one gradient step."""
        rng = np.random.default_rng([self._seed, self.step])
        observation, places, values = choices.batch(choices.draw(rng, self.config.batch_size))
        number = int(rng.integers(8))
        observation, places = turned_at_random(observation, places, number)
        predicted = at_places(self.network(observation), places)
        predicted = predicted[..., turned_headings(values.shape[2], number)]
        loss = loss_of(predicted, values)
        self._optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self._optimizer.step()
        self.step += 1
        with torch.no_grad():
            share = 1.0 - min(self.config.averaging, self.step / (self.step + 10.0))
            for mean, new in zip(self.average.parameters(), self.network.parameters()):
                mean.lerp_(new, share)
        return loss.item()

    def to_bytes(self, run: str) -> bytes:
        """Return the state to resume from as a blob."""
        tensors = {f'network.{name}': value for name, value in self.network.state_dict().items()}
        tensors |= {f'average.{name}': value for name, value in self.average.state_dict().items()}
        tensors |= saved_slots(self._optimizer, 'optimizer.')
        tensors['step'] = torch.tensor(self.step)
        return safetensors.torch.save({name: value.contiguous().clone()
                                       for name, value in tensors.items()}, {'run': run})

    def load(self, path: Path) -> str:
        """
        Resume from a state.

        :returns: the identity of the run.
        :raises CheckpointError: if the state is damaged or of another network.
        """
        try:
            blob = read_regular(path)
            tensors, run = safetensors.torch.load(blob), read_metadata(blob)['run']
            parts: dict[str, dict[str, Tensor]] = {'network': {}, 'average': {}, 'optimizer': {}}
            for name, value in tensors.items():
                if name != 'step':
                    part, _, rest = name.partition('.')
                    parts[part][rest] = value
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
