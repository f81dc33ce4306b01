# SPDX-License-Identifier: Apache-2.0
"""
Symmetries of the task: a room turned by quarter turns or mirrored is as good a room.

Observations are centred on the observed bounding box, so these eight maps of the plane apply to
them exactly; what indices point to does not change, nor does the reward.
"""

import numpy as np
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
import torch

#: (8, 2, 2): the rotations by 0, 90, 180 and 270 degrees, then the same after a mirror.
SYMMETRIES = torch.tensor([
    [[1, 0], [0, 1]], [[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]],
    [[-1, 0], [0, 1]], [[0, -1], [-1, 0]], [[1, 0], [0, -1]], [[0, 1], [1, 0]]],
    dtype=torch.float32)


def turn(vectors: torch.Tensor, maps: torch.Tensor) -> torch.Tensor:
    """
    Apply one map per batch entry to the first two components.

    :param vectors: (B, ..., 2 or 3).
    :param maps: (B, 2, 2).
    """
    flat = vectors[..., :2].reshape(len(vectors), -1, 2) @ maps.transpose(1, 2)
    return torch.cat([flat.reshape(*vectors.shape[:-1], 2), vectors[..., 2:]], dim=-1)


def turn_observation(observation: dict[str, torch.Tensor], maps: torch.Tensor
                     ) -> dict[str, torch.Tensor]:
    """
    Apply one map per batch entry to an encoded observation.

    :param observation: as :func:`ocp_ros.agent.observation.encode` gives it, batched.
    :param maps: (B, 2, 2).
    """
    return {**observation,
            'points': turn(observation['points'], maps),
            'cameras': turn(observation['cameras'], maps),
            'half_size': turn(observation['half_size'], maps.abs())}


class SymmetricReplayBuffer(DictReplayBuffer):
    """A replay buffer whose samples are turned or mirrored at random, each on its own."""

    def sample(self, batch_size: int, env=None) -> DictReplayBufferSamples:
        """Draw a batch and one symmetry per transition."""
        batch = super().sample(batch_size, env)
        chosen = torch.from_numpy(np.random.randint(len(SYMMETRIES), size=batch_size))
        maps = SYMMETRIES.to(batch.actions.device)[chosen.to(batch.actions.device)]
        actions = turn(batch.actions.reshape(batch_size, -1, 2), maps)
        return batch._replace(
            observations=turn_observation(batch.observations, maps),
            next_observations=turn_observation(batch.next_observations, maps),
            actions=actions.reshape(batch_size, -1))
