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
Augmentation of training samples: rotations by quarter turns, reflections, noise of points.

A rotated or mirrored room is as likely as the room itself. Observations are centred on the
observed bounding box, so these eight symmetries of the plane apply to them exactly. The indices in
an observation and the reward do not change. In this module B is the size of a batch.
"""

import numpy as np
from ocp_ros.policy.networks import SYMMETRIES, turned_observation, turned_vectors
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
import torch


def samples_of(buffer: DictReplayBuffer, first: tuple[np.ndarray, np.ndarray],
               last: tuple[np.ndarray, np.ndarray], rewards: np.ndarray
               ) -> DictReplayBufferSamples:
    """
    Return B transitions of a buffer as training samples: (B, ...) tensors.

    :param first: (B,) rows and (B,) environments of the first step of each transition.
    :param last: (B,) rows and (B,) environments of its last step.
    :param rewards: (B,) reward of each transition, summed over its steps.
    """
    def tensors_at(index: tuple, arrays: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
        return {name: buffer.to_torch(values[index]) for name, values in arrays.items()}

    # An episode that ends at its time limit has no terminal state.
    terminated = buffer.dones[last] * (1.0 - buffer.timeouts[last])
    return DictReplayBufferSamples(
        tensors_at(first, buffer.observations), buffer.to_torch(buffer.actions[first]),
        tensors_at(last, buffer.next_observations), buffer.to_torch(terminated[:, None]),
        buffer.to_torch(rewards.astype(np.float32)[:, None]))


class CloudReplayBuffer(DictReplayBuffer):
    """
    A replay buffer of clouds.

    A transition may span n steps. The sum of their rewards leaves out the entropy of the steps in
    between, as in the n-step buffer of stable-baselines3 for plain observations.

    :param n_steps: number n of rewards that are summed before the value of the critics is added.
    :param gamma: discount of the rewards.
    """

    def __init__(self, *args, n_steps: int, gamma: float, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        self.n_steps = n_steps
        self.gamma = gamma

    def sample(self, batch_size: int, env=None) -> DictReplayBufferSamples:
        """Draw a batch; turn or mirror each sample at random, and add noise."""
        batch = super().sample(batch_size, env)
        numbers = np.random.randint(len(SYMMETRIES), size=len(batch.actions))
        matrices = SYMMETRIES[torch.from_numpy(numbers)].to(batch.actions.device)
        before = jittered(turned_observation(batch.observations, matrices))
        after = jittered(turned_observation(batch.next_observations, matrices))
        return batch._replace(observations=before, next_observations=after,
                              actions=turned_vectors(batch.actions, matrices))

    def _get_samples(self, batch_inds: np.ndarray, env=None) -> DictReplayBufferSamples:
        """Return n-step transitions from given rows (B,), each of a random environment."""
        envs = np.random.randint(self.n_envs, size=len(batch_inds))
        steps = np.arange(self.n_steps)
        rows = (batch_inds[:, None] + steps) % self.buffer_size
        # A sum ends at the end of an episode, and at the newest row, which no later step follows.
        newest_row = (self.pos - 1) % self.buffer_size
        ends = (self.dones[rows, envs[:, None]] > 0.0) | (rows == newest_row)
        # A sum ends after n steps at the latest.
        ends[:, -1] = True
        last_steps = ends.argmax(axis=1)
        weights = self.gamma ** steps * (steps <= last_steps[:, None])
        rewards = (self.rewards[rows, envs[:, None]] * weights).sum(axis=1)
        last = rows[np.arange(len(rows)), last_steps], envs
        # The discount of the critics' value, which is added to the sum.
        discounts = self.to_torch((self.gamma ** (last_steps + 1.0)).astype(np.float32)[:, None])
        return samples_of(self, (batch_inds, envs), last, rewards)._replace(discounts=discounts)


def jittered(observation: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return clouds with noise, and with 10 % of each group's points replaced by its first."""
    # Points are in units of ``LENGTH_SCALE``.
    noise = 0.005 * torch.randn_like(observation['points'])
    noisy = {**observation, 'points': observation['points'] + noise}
    for name in ('groups_1', 'groups_2'):
        groups = observation[name]
        # A repeated first point has no effect, as the network takes the maximum over a group.
        replaced = torch.rand(groups.shape, device=groups.device) < 0.1
        noisy[name] = torch.where(replaced, groups[..., :1], groups)
    return noisy
