# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The network of the map actor: from a map of what was observed to what each place is worth.

A small U-shaped network of convolutions (Ronneberger et al., 2015) of residual blocks; it is asked
for one camera at a time, given the others, and answers for every cell at once.
"""

import torch
from torch import nn, Tensor
from torch.nn.functional import pixel_shuffle, pixel_unshuffle, relu

from ocp_ros.agent.agent_config import AgentConfig
from ocp_ros.agent.observation_map import NUMBERS, OF_OTHERS, OF_ROOM

#: Channels at half, a quarter and an eighth of the resolution, and the blocks on the way down.
WIDTHS, DOWN = (32, 64, 96), (1, 2, 2)
#: Cells along each side that the network takes together.
TOGETHER = 2


class ResidualBlock(nn.Module):
    """Two convolutions whose result is added to what they read; at first they add nothing."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)

    def forward(self, values: Tensor) -> Tensor:
        """Map (B, C, H, W) to as much."""
        return values + self.second(relu(self.first(relu(values))))


class ValueMapNetwork(nn.Module):
    """
    What the depth error becomes if a camera goes to each cell of the map.

    :param config: unused sizes; the inputs are those of the map.
    """

    def __init__(self, config: AgentConfig) -> None:
        super().__init__()
        half, quarter, eighth = WIDTHS
        self.enter = nn.Conv2d((OF_ROOM + OF_OTHERS) * TOGETHER ** 2 + NUMBERS, half, 3, padding=1)
        self.down_1 = _blocks(half, DOWN[0])
        self.to_quarter = nn.Conv2d(half, quarter, 3, stride=2, padding=1)
        self.down_2 = _blocks(quarter, DOWN[1])
        self.to_eighth = nn.Conv2d(quarter, eighth, 3, stride=2, padding=1)
        self.down_3 = _blocks(eighth, DOWN[2])
        self.whole = nn.Linear(eighth, eighth)
        self.from_eighth = nn.Conv2d(eighth, quarter * 4, 1)
        self.up_2 = _blocks(quarter, 1)
        self.from_quarter = nn.Conv2d(quarter, half * 4, 1)
        self.up_1 = _blocks(half, 1)
        self.leave = nn.Conv2d(half, TOGETHER ** 2, 3, padding=1)

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        """
        Value all cells.

        :param observation: ``room`` (B, ``OF_ROOM``, H, W) and ``others`` (B, ``OF_OTHERS``, H, W)
            uint8, ``numbers`` (B, ``NUMBERS``).
        :returns: (B, H, W): ln((D + e) / (D of the others + e)), less is better.
        """
        numbers = observation['numbers']
        maps = torch.cat([observation['room'], observation['others']], dim=1).to(numbers.dtype)
        maps = pixel_unshuffle(maps / 255.0, TOGETHER)
        told = numbers[:, :, None, None].expand(-1, -1, *maps.shape[2:])
        half = self.down_1(self.enter(torch.cat([maps, told], dim=1)))
        quarter = self.down_2(self.to_quarter(relu(half)))
        eighth = self.down_3(self.to_eighth(relu(quarter)))
        eighth = eighth + self.whole(relu(eighth).mean(dim=(2, 3)))[:, :, None, None]
        quarter = self.up_2(quarter + pixel_shuffle(self.from_eighth(relu(eighth)), 2))
        half = self.up_1(half + pixel_shuffle(self.from_quarter(relu(quarter)), 2))
        return pixel_shuffle(self.leave(relu(half)), TOGETHER)[:, 0]


def _blocks(width: int, count: int) -> nn.Sequential:
    """Put residual blocks one behind the other."""
    return nn.Sequential(*(ResidualBlock(width) for _ in range(count)))
