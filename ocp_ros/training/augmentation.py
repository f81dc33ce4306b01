# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Symmetries of the task: a room turned by quarter turns or mirrored is as good a room.

Observations are centred on the observed bounding box, so these eight maps of the plane apply to
them exactly; what indices point to does not change, nor does the reward. What is told by direction
is shifted or reversed. In which order the cameras are makes no difference to the networks, which
share their weights among them.
"""

from typing import NamedTuple

import numpy as np
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
import torch

from ocp_ros.agent.move_effects import WAYS

#: (8, 2, 2): the rotations by 0, 90, 180 and 270 degrees, then the same after a mirror.
SYMMETRIES = torch.tensor([
    [[1, 0], [0, 1]], [[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]],
    [[-1, 0], [0, 1]], [[0, -1], [-1, 0]], [[1, 0], [0, -1]], [[0, 1], [1, 0]]],
    dtype=torch.float32)
_WAYS = torch.tensor(WAYS, dtype=torch.float32)
#: (8, D): which direction becomes direction d.
SOURCES = (_WAYS @ (SYMMETRIES @ _WAYS.T)).argmax(dim=2)


class Symmetries(NamedTuple):
    """
    One symmetry per batch entry.

    :ivar matrices: (B, 2, 2).
    :ivar sources: (B, D), which direction becomes direction d.
    """

    matrices: torch.Tensor
    sources: torch.Tensor

    @classmethod
    def of(cls, numbers: torch.Tensor, device: torch.device | str = 'cpu') -> 'Symmetries':
        """Return the symmetries of some numbers (B,)."""
        return cls(SYMMETRIES[numbers].to(device), SOURCES[numbers].to(device))


def random_symmetries(count: int, device: torch.device | str = 'cpu') -> Symmetries:
    """Draw so many symmetries."""
    return Symmetries.of(torch.from_numpy(np.random.randint(len(SYMMETRIES), size=count)), device)


def turn(vectors: torch.Tensor, maps: torch.Tensor) -> torch.Tensor:
    """
    Apply one map per batch entry to the first two components.

    :param vectors: (B, ..., 2 or 3).
    :param maps: (B, 2, 2).
    """
    flat = vectors[..., :2].reshape(len(vectors), -1, 2) @ maps.transpose(1, 2)
    return torch.cat([flat.reshape(*vectors.shape[:-1], 2), vectors[..., 2:]], dim=-1)


def turn_observation(observation: dict[str, torch.Tensor], maps: Symmetries
                     ) -> dict[str, torch.Tensor]:
    """
    Apply one map per batch entry to an encoded observation.

    :param observation: as :class:`ocp_ros.agent.encoder.Encoder` gives it, batched.
    :param maps: B of them.
    """
    turned = dict(observation)
    for name in ('points', 'cameras'):
        if name in observation:
            turned[name] = turn(observation[name], maps.matrices)
    if 'half_size' in observation:
        turned['half_size'] = turn(observation['half_size'], maps.matrices.abs())
    if 'directions' in observation:
        directions = observation['directions']
        sources = maps.sources[:, None, :, None].expand(directions.shape)
        turned['directions'] = directions.gather(2, sources)
    return turned


def symmetric(batch: DictReplayBufferSamples) -> DictReplayBufferSamples:
    """Turn or mirror each transition of a batch at random."""
    maps = random_symmetries(len(batch.actions), batch.actions.device)
    actions = turn(batch.actions.unflatten(1, (-1, 2)), maps.matrices)
    return batch._replace(
        observations=turn_observation(batch.observations, maps),
        next_observations=turn_observation(batch.next_observations, maps),
        actions=actions.flatten(1))


class SymmetricReplayBuffer(DictReplayBuffer):
    """A replay buffer whose samples are turned or mirrored at random, each on its own."""

    def sample(self, batch_size: int, env=None) -> DictReplayBufferSamples:
        """Draw a batch and one symmetry per transition."""
        return symmetric(super().sample(batch_size, env))
