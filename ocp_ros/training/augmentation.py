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
from ocp_ros.policy.observation_map import CELLS, used_part
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
import torch


def turned_maps(observation: dict[str, torch.Tensor], places: torch.Tensor, number: int
                ) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """
    Return maps, and positions on them, rotated or mirrored by one symmetry of the square.

    Contrary to images, the rows of a map (axis -2) are numbered along x, its columns along y.

    :param observation: inputs of the map actor, batched.
    :param places: (B, ..., 2) positions relative to the centre of the maps, in any unit.
    :param number: 0 to 3: number of quarter turns; 4 to 7: the same after a reflection.
    :returns: the observation and the positions, both rotated or mirrored.
    """
    mirrored, quarters = divmod(number, 4)
    turned = dict(observation)
    for name in ('room', 'others', 'choices'):
        if name in observation:
            value = observation[name].flip(-1) if mirrored else observation[name]
            turned[name] = torch.rot90(value, quarters, (-2, -1))
    x, y = places.unbind(-1)
    y = -y if mirrored else y
    for _ in range(quarters):
        # The first axis of a map is rotated towards the second one.
        x, y = -y, x
    return turned, torch.stack([x, y], dim=-1)


def turned_batch(batch: DictReplayBufferSamples) -> DictReplayBufferSamples:
    """Return a batch of maps with one random symmetry applied to all its transitions."""
    number = int(np.random.randint(len(SYMMETRIES)))
    before, actions = turned_maps(batch.observations, batch.actions, number)
    after, _ = turned_maps(batch.next_observations, batch.actions, number)
    return batch._replace(observations=before, next_observations=after, actions=actions)


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


class MapReplayBuffer(DictReplayBuffer):
    """
    A replay buffer of maps; a random symmetry is applied to each batch.

    All maps of a batch have the same used part, the centre that the observed room covers: the
    network reads only that part.
    """

    def __init__(self, *args, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        #: (rows, environments): code of the used part of the map after each transition.
        self.parts = np.zeros((self.buffer_size, self.n_envs), dtype=np.int16)

    def add(self, obs, next_obs, action, reward, done, infos) -> None:
        """Store a transition of each environment."""
        # The base class stores the transitions in row ``pos``, and then goes to the next row.
        self.parts[self.pos] = [_part_code(room) for room in next_obs['room']]
        super().add(obs, next_obs, action, reward, done, infos)

    def sample(self, batch_size: int, env=None) -> DictReplayBufferSamples:
        """Draw a batch in which all maps have one used part; apply one random symmetry to all."""
        # The part is that of a random transition, so each part is as frequent as in the buffer.
        codes = self.parts[:self.size()]
        row, column = np.random.randint(codes.shape[0]), np.random.randint(codes.shape[1])
        alike = np.flatnonzero(codes == codes[row, column])
        return turned_batch(self._get_samples(np.random.choice(alike, batch_size), env))

    def _get_samples(self, batch_inds: np.ndarray, env=None) -> DictReplayBufferSamples:
        """Return transitions by their numbers: row * environments + environment."""
        index = np.divmod(batch_inds, self.n_envs)
        return samples_of(self, index, index, self.rewards[index])


def _part_code(room: np.ndarray) -> int:
    """Return a code for the used part of the channels (C, 64, 64) of a map."""
    rows, columns = used_part(room)
    return rows.start * CELLS + columns.start


class CloudReplayBuffer(DictReplayBuffer):
    """
    A replay buffer of clouds.

    A transition may span n steps. The sum of their rewards leaves out the entropy of the steps in
    between, as in the n-step buffer of stable-baselines3 for plain observations.

    :param n_steps: number n of rewards that are summed before the value of the critics is added.
    :param gamma: discount of the rewards.
    :param augmentation: augmentation of each sample: ``none``, ``symmetries`` or ``jitter``.
    :param demonstrations: number of first transitions that are kept for good; half of each batch
        is drawn from them.
    """

    def __init__(self, *args, n_steps: int = 1, gamma: float = 0.99,
                 augmentation: str = 'symmetries', demonstrations: int = 0, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        self.n_steps = n_steps
        self.gamma = gamma
        self.augmentation = augmentation
        #: Number of first rows that are not overwritten: those of the demonstrations, rounded up,
        #: but at least one row stays free.
        self.kept_rows = min(-(-demonstrations // self.n_envs), self.buffer_size - 1)

    def add(self, obs, next_obs, action, reward, done, infos) -> None:
        """Store a transition of each environment."""
        super().add(obs, next_obs, action, reward, done, infos)
        # A full buffer begins again at row 0: skip the kept rows.
        if self.full:
            self.pos = max(self.pos, self.kept_rows)

    def sample(self, batch_size: int, env=None) -> DictReplayBufferSamples:
        """Draw a batch; apply the augmentation, a random symmetry alone or also noise."""
        batch = super().sample(batch_size, env)
        if self.augmentation == 'none':
            return batch
        numbers = np.random.randint(len(SYMMETRIES), size=len(batch.actions))
        matrices = SYMMETRIES[torch.from_numpy(numbers)].to(batch.actions.device)
        before = turned_observation(batch.observations, matrices)
        after = turned_observation(batch.next_observations, matrices)
        if self.augmentation == 'jitter':
            before, after = jittered(before), jittered(after)
        return batch._replace(observations=before, next_observations=after,
                              actions=turned_vectors(batch.actions, matrices))

    def _get_samples(self, batch_inds: np.ndarray, env=None) -> DictReplayBufferSamples:
        """
        Return n-step transitions from given rows, each of a random environment.

        :param batch_inds: (B,) rows; every second one is replaced by a row of the demonstrations.
        """
        if filled_rows := min(self.kept_rows, self.size()):
            batch_inds[::2] = np.random.randint(filled_rows, size=len(batch_inds[::2]))
        envs = np.random.randint(self.n_envs, size=len(batch_inds))
        steps = np.arange(self.n_steps)
        rows = (batch_inds[:, None] + steps) % self.buffer_size
        # A sum ends at the end of an episode, and at rows that no later step follows: the newest
        # row, and with kept rows also the last kept row and the last row of the buffer. With kept
        # rows, ``pos`` is never 0 after a transition was stored.
        last_rows = ([self.pos - 1, self.kept_rows - 1, self.buffer_size - 1] if self.kept_rows
                     else [(self.pos - 1) % self.buffer_size])
        ends = (self.dones[rows, envs[:, None]] > 0.0) | np.isin(rows, last_rows)
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
    # Points are in units of the agent's ``length_scale``.
    noise = 0.005 * torch.randn_like(observation['points'])
    noisy = {**observation, 'points': observation['points'] + noise}
    for name in ('groups_1', 'groups_2'):
        groups = observation[name]
        # A repeated first point has no effect, as the network takes the maximum over a group.
        replaced = torch.rand(groups.shape, device=groups.device) < 0.1
        noisy[name] = torch.where(replaced, groups[..., :1], groups)
    return noisy
