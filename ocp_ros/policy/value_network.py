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
The network of the map actor: from the observation map to a value of each place.

A small U-shaped convolutional network (Ronneberger et al., 2015) of residual blocks. It is
evaluated for one camera at a time, given the other cameras, and returns the values of all cells.
"""

from ocp_ros.policy.agent_config import AgentConfig
from ocp_ros.policy.observation_map import (
    CELLS,
    NUMBERS,
    OF_LENS,
    OF_OTHERS,
    OF_ROOM,
    used_part,
)
import torch
from torch import nn, Tensor
from torch.nn.functional import pixel_shuffle, pixel_unshuffle, relu

#: The network merges blocks of this many cells along each side.
BLOCK_CELLS = 2
#: Difference of values at which the probabilities of two cells differ by the factor e.
TEMPERATURE = 0.05


class ResidualBlock(nn.Module):
    """Two convolutions whose output is added to their input; before training they add 0."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)

    def forward(self, values: Tensor) -> Tensor:
        """Map (B, C, H, W) to (B, C, H, W)."""
        return values + self.second(relu(self.first(relu(values))))


class ValueMap(nn.Module):
    """
    Predict the depth error if a camera goes to each cell of the map, for each heading there.

    :param headings: D, number of headings; see
        :func:`~ocp_ros.policy.observation_map.yaws_of`.
    :param scalars: names of the scalar inputs besides the maps ``room`` and ``others``, and the
        number of values of each.
    """

    def __init__(self, headings: int, scalars: dict[str, int]) -> None:
        super().__init__()
        self._scalar_names = tuple(scalars)
        # Channels at 1/2, 1/4 and 1/8 of the resolution.
        half, quarter, eighth = 32, 64, 96
        inputs = (OF_ROOM + OF_OTHERS) * BLOCK_CELLS ** 2 + sum(scalars.values())
        self.enter = nn.Conv2d(inputs, half, 3, padding=1)
        # The number of blocks of the encoder at these resolutions.
        blocks = (1, 2, 2)
        self.down_1 = _blocks(half, blocks[0])
        self.to_quarter = nn.Conv2d(half, quarter, 3, stride=2, padding=1)
        self.down_2 = _blocks(quarter, blocks[1])
        self.to_eighth = nn.Conv2d(quarter, eighth, 3, stride=2, padding=1)
        self.down_3 = _blocks(eighth, blocks[2])
        self.whole = nn.Linear(eighth, eighth)
        self.from_eighth = nn.Conv2d(eighth, quarter * 4, 1)
        self.up_2 = _blocks(quarter, 1)
        self.from_quarter = nn.Conv2d(quarter, half * 4, 1)
        self.up_1 = _blocks(half, 1)
        self.leave = nn.Conv2d(half, headings * BLOCK_CELLS ** 2, 3, padding=1)

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        """
        Return the values of all cells.

        :param observation: ``room`` (B, ``OF_ROOM``, H, W) and ``others`` (B, ``OF_OTHERS``, H, W)
            uint8, ``numbers`` (B, ``NUMBERS``), and ``lens`` (B, ``OF_LENS``) if it is an input.
        :returns: (B, D, H, W): ln((E + e) / (E of the others + e)) of the depth error E; less is
            better.
        """
        numbers = torch.cat([observation[name] for name in self._scalar_names], dim=1)
        maps = torch.cat([observation['room'], observation['others']], dim=1).to(numbers.dtype)
        maps = pixel_unshuffle(maps / 255.0, BLOCK_CELLS)
        scalars = numbers[:, :, None, None].expand(-1, -1, *maps.shape[2:])
        half = self.down_1(self.enter(torch.cat([maps, scalars], dim=1)))
        quarter = self.down_2(self.to_quarter(relu(half)))
        eighth = self.down_3(self.to_eighth(relu(quarter)))
        eighth = eighth + self.whole(relu(eighth).mean(dim=(2, 3)))[:, :, None, None]
        quarter = self.up_2(quarter + pixel_shuffle(self.from_eighth(relu(eighth)), 2))
        half = self.up_1(half + pixel_shuffle(self.from_quarter(relu(quarter)), 2))
        return pixel_shuffle(self.leave(relu(half)), BLOCK_CELLS)


class ValueMapNetwork(ValueMap):
    """
    The map actor's network: a value map for omnidirectional cameras, and one for other cameras.

    :param config: its ``headings`` is the number of headings of the second value map, 0 without
        one; its sizes belong to other networks.
    :ivar aimed: the second value map; None without one.
    """

    def __init__(self, config: AgentConfig) -> None:
        super().__init__(1, {'numbers': NUMBERS})
        self.aimed = ValueMap(config.headings, {'numbers': NUMBERS, 'lens': OF_LENS}) \
            if config.headings else None

    def begin_aimed(self) -> None:
        """Copy the weights of the omnidirectional value map into the second one."""
        own = self.state_dict()
        with torch.no_grad():
            for name, value in self.aimed.named_parameters():
                begun = own[name]
                if name == 'enter.weight':
                    value[:, :begun.shape[1]] = begun
                    value[:, begun.shape[1]:] = 0.0
                else:
                    # Only the last layer has another shape: its weights repeat for each heading.
                    value.copy_(begun.repeat(len(value) // len(begun), *[1] * (value.dim() - 1)))


def valued(network: nn.Module, observation: dict[str, Tensor]) -> Tensor:
    """
    Return the values of whole maps; the network reads the used part of the maps alone.

    :param network: :class:`ValueMap`.
    :param observation: its inputs, batched, with maps of 64 x 64 cells.
    :returns: (B, D, 64, 64): inf for cells outside the union of the used parts.
    """
    rows, columns = used_part(observation['room'].amax(dim=0).cpu().numpy())
    part = network(observation | {name: observation[name][:, :, rows, columns]
                                  for name in ('room', 'others')})
    values = part.new_full((*part.shape[:2], CELLS, CELLS), torch.inf)
    values[:, :, rows, columns] = part
    return values


class CellChoices:
    """
    The distribution of a camera's target cell: the softmax of the negative values of free cells.

    :param values: (B, 1, 64, 64) from :func:`valued`.
    :param free: (B, 64, 64), not 0 for feasible cells.
    """

    def __init__(self, values: Tensor, free: Tensor) -> None:
        # Cells outside the used part of the maps are inf and get the smallest logit.
        logits = (-values / TEMPERATURE).clamp(min=-1e4).flatten(1)
        self._log = logits.masked_fill(free.flatten(1) == 0, -1e9).log_softmax(dim=1)

    @property
    def shares(self) -> Tensor:
        """Return the probability of each cell: (B, 64 * 64)."""
        return self._log.exp()

    @property
    def entropy(self) -> Tensor:
        """Return the entropy: (B,), in nats."""
        return -(self.shares * self._log).sum(dim=1)

    def divergence(self, other: 'CellChoices') -> Tensor:
        """Return the Kullback-Leibler divergence D(this || other): (B,), in nats."""
        return (self.shares * (self._log - other._log)).sum(dim=1)

    def best(self) -> Tensor:
        """Return the most probable cells as actions: (B, 2)."""
        return action_of(self._log.argmax(dim=1))

    def sample(self) -> Tensor:
        """Draw cells and return them as actions: (B, 2)."""
        return action_of(torch.multinomial(self.shares, 1)[:, 0])


def action_of(cells: Tensor) -> Tensor:
    """Return the centres (B, 2) of cells (B,), from the map's centre in units of half its side."""
    at = torch.stack([cells // CELLS, cells % CELLS], dim=-1)
    return (2.0 * at + 1.0) / CELLS - 1.0


def cell_of(actions: Tensor) -> Tensor:
    """Return the numbers (B,) of the cells of actions (B, 2)."""
    at = ((actions + 1.0) * (0.5 * CELLS)).long().clamp(0, CELLS - 1)
    return at[:, 0] * CELLS + at[:, 1]


def _blocks(width: int, count: int) -> nn.Sequential:
    """Stack residual blocks."""
    return nn.Sequential(*(ResidualBlock(width) for _ in range(count)))
