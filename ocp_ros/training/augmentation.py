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
Augmentation of training samples: rotations by quarter turns, reflections and noise of points.

A rotated or mirrored room is as likely as the room itself. Observations are centred on the
observed bounding box, so these eight symmetries of the plane apply to them exactly. The indices in
an observation and the reward do not change.
"""

import numpy as np
from ocp_ros.policy.observation_map import CELLS, used_part
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
import torch

#: (8, 2, 2): rotations by 0, 90, 180 and 270 degrees, then the same after a reflection.
SYMMETRIES = torch.tensor([
    [[1, 0], [0, 1]], [[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]],
    [[-1, 0], [0, 1]], [[0, -1], [-1, 0]], [[1, 0], [0, -1]], [[0, 1], [1, 0]]],
    dtype=torch.float32)


def turn(vectors: torch.Tensor, maps: torch.Tensor) -> torch.Tensor:
    """
    Apply one linear map per batch entry to the first two components of vectors.

    :param vectors: (B, ..., 2 or more).
    :param maps: (B, 2, 2).
    """
    flat = vectors[..., :2].reshape(len(vectors), -1, 2) @ maps.transpose(1, 2)
    return torch.cat([flat.reshape(*vectors.shape[:-1], 2), vectors[..., 2:]], dim=-1)


def turn_observation(observation: dict[str, torch.Tensor], maps: torch.Tensor
                     ) -> dict[str, torch.Tensor]:
    """
    Apply one linear map per batch entry to an encoded observation.

    :param observation: inputs of a network that reads clouds, batched.
    :param maps: (B, 2, 2).
    """
    return {**observation, 'half_size': turn(observation['half_size'], maps.abs()),
            **{name: turn(observation[name], maps) for name in ('points', 'cameras', 'others')}}


def turned_maps(observation: dict[str, torch.Tensor], places: torch.Tensor, number: int
                ) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """
    Rotate or mirror maps, and positions on them, by one of the eight symmetries of the square.

    :param observation: inputs of the map actor, batched.
    :param places: (B, ..., 2) relative to the middle of the maps.
    :param number: of the symmetry, 0 to 7; see ``SYMMETRIES``.
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
    """Apply one random symmetry to all transitions of a batch of maps."""
    number = int(np.random.randint(len(SYMMETRIES)))
    before, actions = turned_maps(batch.observations, batch.actions, number)
    after, _ = turned_maps(batch.next_observations, batch.actions, number)
    return batch._replace(observations=before, next_observations=after, actions=actions)


def transitions(buffer: DictReplayBuffer, begin: tuple[np.ndarray, np.ndarray],
                end: tuple[np.ndarray, np.ndarray], rewards: np.ndarray
                ) -> DictReplayBufferSamples:
    """
    Return transitions of a buffer as training samples: (B, ...) tensors.

    :param begin: rows and environments of the first step of each transition.
    :param end: rows and environments of its last step.
    :param rewards: (B,) reward of each transition, summed over its steps.
    """
    def taken(arrays: dict[str, np.ndarray], at: tuple) -> dict[str, torch.Tensor]:
        return {name: buffer.to_torch(values[at]) for name, values in arrays.items()}

    ended = buffer.dones[end] * (1.0 - buffer.timeouts[end])
    return DictReplayBufferSamples(
        taken(buffer.observations, begin), buffer.to_torch(buffer.actions[begin]),
        taken(buffer.next_observations, end), buffer.to_torch(ended[:, None]),
        buffer.to_torch(rewards.astype(np.float32)[:, None]))


class MapReplayBuffer(DictReplayBuffer):
    """
    A replay buffer of maps; a random symmetry is applied to each batch.

    All maps of a batch have the same used part: the network reads only that part.
    """

    def __init__(self, *args, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        #: Code of the used part of the map of each transition.
        self.parts = np.zeros((self.buffer_size, self.n_envs), dtype=np.int16)

    def add(self, obs, next_obs, action, reward, done, infos) -> None:
        """Store a transition of each environment."""
        self.parts[self.pos] = [_part(rooms) for rooms in next_obs['room']]
        super().add(obs, next_obs, action, reward, done, infos)

    def sample(self, batch_size: int, env=None) -> DictReplayBufferSamples:
        """Draw a batch, all transitions with equal probability, and one symmetry for all."""
        parts = self.parts[:self.size()]
        row, column = np.random.randint(parts.shape[0]), np.random.randint(parts.shape[1])
        alike = np.flatnonzero(parts == parts[row, column])
        return turned_batch(self._get_samples(np.random.choice(alike, batch_size), env))

    def _get_samples(self, batch_inds: np.ndarray, env=None) -> DictReplayBufferSamples:
        """Return transitions by their numbers, counted over all environments."""
        at = np.divmod(batch_inds, self.n_envs)
        return transitions(self, at, at, self.rewards[at])


def _part(room: np.ndarray) -> int:
    """Return a code for the used part of a map."""
    rows, columns = used_part(room)
    return rows.start * CELLS + columns.start


class CloudReplayBuffer(DictReplayBuffer):
    """
    A replay buffer of clouds.

    The n-step sums of rewards leave out the entropy of the steps in between, as the n-step buffer
    of stable-baselines3 for plain observations does.

    :param n_steps: number of rewards that are summed before the value of the critics is added.
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
        #: Number of first rows that are not overwritten.
        self.kept = min(-(-demonstrations // self.n_envs), self.buffer_size - 1)

    def add(self, obs, next_obs, action, reward, done, infos) -> None:
        """Store a transition of each environment."""
        super().add(obs, next_obs, action, reward, done, infos)
        if self.full:
            self.pos = max(self.pos, self.kept)

    def sample(self, batch_size: int, env=None) -> DictReplayBufferSamples:
        """Draw a batch, and augment it as ``augmentation`` says: one symmetry per transition."""
        batch = super().sample(batch_size, env)
        if self.augmentation == 'none':
            return batch
        numbers = np.random.randint(len(SYMMETRIES), size=len(batch.actions))
        maps = SYMMETRIES[torch.from_numpy(numbers)].to(batch.actions.device)
        before, after = (turn_observation(one, maps)
                         for one in (batch.observations, batch.next_observations))
        if self.augmentation == 'jitter':
            before, after = jittered(before), jittered(after)
        return batch._replace(observations=before, next_observations=after,
                              actions=turn(batch.actions, maps))

    def _get_samples(self, batch_inds: np.ndarray, env=None) -> DictReplayBufferSamples:
        """Return n-step transitions, each of a random environment."""
        if kept := min(self.kept, self.size()):
            batch_inds[::2] = np.random.randint(kept, size=len(batch_inds[::2]))
        column, steps = np.random.randint(self.n_envs, size=len(batch_inds)), np.arange(
            self.n_steps)
        rows = (batch_inds[:, None] + steps) % self.buffer_size
        # A sum ends at the end of an episode, and at rows that no later step follows.
        last_rows = [self.pos - 1, self.kept - 1, self.buffer_size - 1] if self.kept else [
            (self.pos - 1) % self.buffer_size]
        ends = (self.dones[rows, column[:, None]] > 0.0) | np.isin(rows, last_rows)
        ends[:, -1] = True
        last = ends.argmax(axis=1)
        shares = self.gamma ** steps * (steps <= last[:, None])
        rewards = (self.rewards[rows, column[:, None]] * shares).sum(axis=1)
        end = rows[np.arange(len(rows)), last], column
        return transitions(self, (batch_inds, column), end, rewards)._replace(
            discounts=self.to_torch((self.gamma ** (last + 1.0)).astype(np.float32)[:, None]))


def jittered(observation: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Add noise to the points of clouds, and replace some points of each group by its first."""
    points, found = observation['points'], dict(observation)
    found['points'] = points + 0.005 * torch.randn_like(points)
    for name in ('groups_1', 'groups_2'):
        groups = observation[name]
        dropped = torch.rand(groups.shape, device=groups.device) < 0.1
        found[name] = torch.where(dropped, groups[..., :1], groups)
    return found
