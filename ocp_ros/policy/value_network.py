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
The network of the map actor: from the observation map to a value of each cell.

It is a small U-shaped convolutional network (Ronneberger et al., 2015) of residual blocks. It is
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

#: The network merges squares of this many cells along each side.
BLOCK_CELLS = 2
#: Difference of two cells' values at which their probabilities differ by the factor e (2.718).
TEMPERATURE = 0.05


class ResidualBlock(nn.Module):
    """Two convolutions whose output, 0 before training, is added to their input."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)

    def forward(self, values: Tensor) -> Tensor:
        """Return the output (B, C, H, W) for C channels of H x W cells of B maps."""
        return values + self.second(relu(self.first(relu(values))))


class ValueMap(nn.Module):
    """
    Predict the change of the depth error by a camera in each cell, for each heading.

    :param headings: D, number of headings; see
        :func:`~ocp_ros.policy.observation_map.yaws_of`.
    :param scalars: number of values of each scalar input by name; the maps ``room`` and
        ``others`` are inputs too.
    """

    def __init__(self, headings: int, scalars: dict[str, int]) -> None:
        super().__init__()
        self._scalar_names = tuple(scalars)
        # Channels at 1/2, 1/4 and 1/8 of the resolution.
        half, quarter, eighth = 32, 64, 96
        inputs = (OF_ROOM + OF_OTHERS) * BLOCK_CELLS ** 2 + sum(scalars.values())
        self.enter = nn.Conv2d(inputs, half, 3, padding=1)
        # Numbers of residual blocks on the way down, at 1/2, 1/4 and 1/8 of the resolution.
        blocks = (1, 2, 2)
        self.down_1 = _residual_blocks(half, blocks[0])
        self.to_quarter = nn.Conv2d(half, quarter, 3, stride=2, padding=1)
        self.down_2 = _residual_blocks(quarter, blocks[1])
        self.to_eighth = nn.Conv2d(quarter, eighth, 3, stride=2, padding=1)
        self.down_3 = _residual_blocks(eighth, blocks[2])
        # The mean of the features over all cells passes this layer, and is added to each cell.
        self.whole = nn.Linear(eighth, eighth)
        # A pixel shuffle turns these 4 C channels into C channels at twice the resolution.
        self.from_eighth = nn.Conv2d(eighth, quarter * 4, 1)
        self.up_2 = _residual_blocks(quarter, 1)
        self.from_quarter = nn.Conv2d(quarter, half * 4, 1)
        self.up_1 = _residual_blocks(half, 1)
        self.leave = nn.Conv2d(half, headings * BLOCK_CELLS ** 2, 3, padding=1)

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        """
        Return the values of all H x W cells in B observations.

        :param observation: ``room`` (B, ``OF_ROOM``, H, W) and ``others`` (B, ``OF_OTHERS``, H, W)
            uint8, ``numbers`` (B, ``NUMBERS``), and ``lens`` (B, ``OF_LENS``) if it is an input.
        :returns: (B, D, H, W): ln((E1 + e) / (E0 + e)) of the depth error E0 of the other cameras,
            E1 with this camera too, and a small e; less is better.
        """
        numbers = torch.cat([observation[name] for name in self._scalar_names], dim=1)
        maps = torch.cat([observation['room'], observation['others']], dim=1).to(numbers.dtype)
        maps = pixel_unshuffle(maps / 255.0, BLOCK_CELLS)
        scalars = numbers[:, :, None, None].expand(-1, -1, *maps.shape[2:])
        half = self.down_1(self.enter(torch.cat([maps, scalars], dim=1)))
        quarter = self.down_2(self.to_quarter(relu(half)))
        eighth = self.down_3(self.to_eighth(relu(quarter)))
        # Each cell gets features of the whole map.
        eighth = eighth + self.whole(relu(eighth).mean(dim=(2, 3)))[:, :, None, None]
        quarter = self.up_2(quarter + pixel_shuffle(self.from_eighth(relu(eighth)), 2))
        half = self.up_1(half + pixel_shuffle(self.from_quarter(relu(quarter)), 2))
        return pixel_shuffle(self.leave(relu(half)), BLOCK_CELLS)


class ValueMapNetwork(ValueMap):
    """
    The map actor's network: a value map for omnidirectional cameras, and one for other cameras.

    :param config: its ``headings`` is the number of headings of the second value map; 0 for no
        second value map. The other sizes in it belong to other networks.
    :ivar aimed: the second value map; None if there is none.
    """

    def __init__(self, config: AgentConfig) -> None:
        super().__init__(1, {'numbers': NUMBERS})
        scalars = {'numbers': NUMBERS, 'lens': OF_LENS}
        self.aimed = ValueMap(config.headings, scalars) if config.headings else None

    def begin_aimed(self) -> None:
        """Copy the weights of the omnidirectional value map into the second one."""
        weights = self.state_dict()
        with torch.no_grad():
            for name, target in self.aimed.named_parameters():
                source = weights[name]
                if name == 'enter.weight':
                    # The first layer has further input channels, those of ``lens``.
                    target[:, :source.shape[1]] = source
                    target[:, source.shape[1]:] = 0.0
                else:
                    # The last layer has more outputs: its weights repeat for each heading. All
                    # other layers have the same shape, so their weights are used once.
                    repeats = len(target) // len(source)
                    target.copy_(source.repeat(repeats, *[1] * (target.dim() - 1)))


def valued(network: nn.Module, observation: dict[str, Tensor]) -> Tensor:
    """
    Return the values of whole maps, of which the network reads the used part alone.

    :param network: a :class:`ValueMap`.
    :param observation: inputs of the network for B observations, with maps of 64 x 64 cells.
    :returns: (B, D, 64, 64): values for D headings; inf outside the union of the used parts.
    """
    rows, columns = used_part(observation['room'].amax(dim=0).cpu().numpy())
    maps = {name: observation[name][:, :, rows, columns] for name in ('room', 'others')}
    used_values = network(observation | maps)
    values = used_values.new_full((*used_values.shape[:2], CELLS, CELLS), torch.inf)
    values[:, :, rows, columns] = used_values
    return values


class CellChoices:
    """
    The distribution of a camera's target cell: softmax of the feasible cells' negative values.

    :param values: (B, 1, 64, 64) from :func:`valued`, of B observations.
    :param feasible: (B, 64, 64), not 0 for feasible cells.
    """

    def __init__(self, values: Tensor, feasible: Tensor) -> None:
        # Logits are finite, so that the entropy has no 0 * inf = NaN. Cells outside the used part
        # of the maps have the value inf; if feasible, they stay above infeasible cells.
        logits = (-values / TEMPERATURE).clamp(min=-1e4).flatten(1)
        logits = logits.masked_fill(feasible.flatten(1) == 0, -1e9)
        self._log_shares = logits.log_softmax(dim=1)

    @property
    def shares(self) -> Tensor:
        """Return the probability of each cell: (B, 64 * 64)."""
        return self._log_shares.exp()

    @property
    def entropy(self) -> Tensor:
        """Return the entropy of each distribution: (B,), in nats."""
        return -(self.shares * self._log_shares).sum(dim=1)

    def divergence(self, other: 'CellChoices') -> Tensor:
        """Return the Kullback-Leibler divergence D(this || other): (B,), in nats."""
        return (self.shares * (self._log_shares - other._log_shares)).sum(dim=1)

    def best(self) -> Tensor:
        """Return the most probable cells as actions: (B, 2)."""
        return action_of(self._log_shares.argmax(dim=1))

    def sample(self) -> Tensor:
        """Draw cells and return them as actions: (B, 2)."""
        return action_of(torch.multinomial(self.shares, 1)[:, 0])


def action_of(cells: Tensor) -> Tensor:
    """
    Return the centres of cells as actions.

    :param cells: (B,) numbers of cells: row * 64 + column. Rows are numbered along x, columns
        along y.
    :returns: (B, 2), x and y from the map's centre, in units of half its side.
    """
    row_and_column = torch.stack([cells // CELLS, cells % CELLS], dim=-1)
    return (2.0 * row_and_column + 1.0) / CELLS - 1.0


def cell_of(actions: Tensor) -> Tensor:
    """Return the numbers (B,) of the cells of actions (B, 2); see :func:`action_of`."""
    row_and_column = ((actions + 1.0) * (0.5 * CELLS)).long().clamp(0, CELLS - 1)
    return row_and_column[:, 0] * CELLS + row_and_column[:, 1]


def _residual_blocks(width: int, count: int) -> nn.Sequential:
    """Return ``count`` residual blocks of ``width`` channels, one after the other."""
    return nn.Sequential(*(ResidualBlock(width) for _ in range(count)))
