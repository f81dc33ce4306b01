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
What soft actor-critic keeps: the replay buffer, and its whole state in files.

Samples are augmented by quarter turns, reflections, and noise of points. A rotated or mirrored
room is as likely as the room itself. Observations are centred on the observed bounding box, so
these eight symmetries of the plane apply to them exactly. The indices in an observation and the
reward do not change.

The files are safetensors, so that training resumes without unpickling. The networks, optimisers
and counters are in one file; the replay buffer is in another. In this module B is the size of a
batch.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING
import uuid

import numpy as np
from ocp_ros.policy.checkpoint import CheckpointError, MAX_WEIGHT
from ocp_ros.policy.networks import SYMMETRIES, turned_observation, turned_vectors
from ocp_ros.util.files import check_regular, read_regular, whole_or_absent
from ocp_ros.util.tensor_blob import read_blob, write_blob
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
import torch

if TYPE_CHECKING:
    from ocp_ros.training.sac import AgentSac

#: Name of the array with the row that is written next, and whether the buffer is full.
FILLED = 'filled'
#: Attributes of the model that are saved as numbers.
COUNTERS = ('_n_updates', 'num_timesteps')


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
        # The row and the environment of the first and of the last step of each transition.
        first, last = (batch_inds, envs), (rows[np.arange(len(rows)), last_steps], envs)
        # An episode that ends at its time limit has no terminal state.
        terminated = self.dones[last] * (1.0 - self.timeouts[last])
        # The discount of the critics' value, which is added to the sum.
        discounts = self.gamma ** (last_steps + 1.0)
        columns = [self.to_torch(values.astype(np.float32)[:, None])
                   for values in (terminated, rewards, discounts)]
        before, after = ({name: self.to_torch(values[index]) for name, values in arrays.items()}
                         for index, arrays in ((first, self.observations),
                                               (last, self.next_observations)))
        return DictReplayBufferSamples(before, self.to_torch(self.actions[first]), after, *columns)


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


def select_by_prefix(tensors: dict[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    """Return the tensors whose names begin with a prefix, by their names without the prefix."""
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items()
            if name.startswith(prefix)}


def _optimizers(model: 'AgentSac') -> dict[str, torch.optim.Optimizer]:
    """Return SAC's three optimisers by name."""
    return {'actor': model.actor.optimizer, 'critic': model.critic.optimizer,
            'entropy': model.ent_coef_optimizer}


def _weights_and_counters(model: 'AgentSac') -> dict[str, torch.Tensor]:
    """Return the tensors of networks, entropy coefficient and counters, by name in the file."""
    return {**{f'policy.{name}': value for name, value in model.policy.state_dict().items()},
            **{f'averaged.{name}': value for name, value in (model.averaged or {}).items()},
            'log_ent_coef': model.log_ent_coef.detach(),
            **{f'counter.{name}': torch.tensor(getattr(model, name)) for name in COUNTERS}}


def saved_slots(optimizer: torch.optim.Optimizer, prefix: str) -> dict[str, torch.Tensor]:
    """
    Return the tensors of an optimiser, by name.

    A name has the prefix, the number of the weight, and a key of its state such as ``exp_avg``.
    """
    return {f'{prefix}{index}.{key}': value
            for index, slot in optimizer.state_dict()['state'].items()
            for key, value in slot.items()}


def load_slots(optimizer: torch.optim.Optimizer, slots: dict[str, torch.Tensor]) -> None:
    """Load the tensors of :func:`saved_slots`, named without the prefix."""
    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, value in slots.items():
        index, key = name.split('.')
        state.setdefault(int(index), {})[key] = value
    optimizer.load_state_dict({**optimizer.state_dict(), 'state': state})


def new_run() -> str:
    """Return a name for a training run: 12 random hexadecimal digits."""
    return uuid.uuid4().hex[:12]


def save_state(model: 'AgentSac', path: Path, run: str) -> None:
    """
    Write networks, optimisers, entropy coefficient and counters; the file is whole or absent.

    The file does not contain the replay buffer; see :func:`save_replay`.

    :param model: from :func:`ocp_ros.training.sac.make_sac`.
    :param path: file to write.
    :param run: name of the training run.
    """
    tensors = _weights_and_counters(model)
    for name, optimizer in _optimizers(model).items():
        tensors |= saved_slots(optimizer, f'optimizer.{name}.')
    with whole_or_absent(path) as temporary_path, open(temporary_path, 'wb') as file:
        write_blob(file, {name: value.detach().cpu().numpy() for name, value in tensors.items()},
                   {'run': run})


def load_state(model: 'AgentSac', path: Path) -> str:
    """
    Load a saved state into a model that was built with the same settings.

    :returns: name of the training run.
    :raises CheckpointError: if the file is damaged or belongs to another network; the model stays
        unchanged.
    """
    try:
        arrays, metadata = read_blob(read_regular(path))
        # The copies may be written to, as PyTorch expects.
        tensors = {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}
        run = metadata['run']
        if not isinstance(run, str):
            raise ValueError(f'its run is {run!r}')
        _check_tensors(tensors, _weights_and_counters(model) | _expected_slots(model, tensors))
    except (OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise CheckpointError(
            f'{path}: found no training state for this network ({error}); expected a whole one, '
            'saved with the same settings; put it back from a copy, or begin in another folder '
            'with model set to the weights beside it: these are kept, the rest is lost') from error
    model.policy.load_state_dict(select_by_prefix(tensors, 'policy.'))
    model.log_ent_coef.data.copy_(tensors['log_ent_coef'])
    for name, value in (model.averaged or {}).items():
        value.copy_(tensors[f'averaged.{name}'])
    for name in COUNTERS:
        setattr(model, name, int(tensors[f'counter.{name}']))
    for name, optimizer in _optimizers(model).items():
        load_slots(optimizer, select_by_prefix(tensors, f'optimizer.{name}.'))
    return run


def _expected_slots(model: 'AgentSac', tensors: dict[str, torch.Tensor]
                    ) -> dict[str, torch.Tensor]:
    """
    Return tensors shaped like Adam's state of each weight that has a state in the file.

    :param tensors: those of the file. They are needed as a weight has no state before its first
        gradient step.
    """
    slots = {}
    for name, optimizer in _optimizers(model).items():
        weights = [weight for group in optimizer.param_groups for weight in group['params']]
        for index, weight in enumerate(weights):
            prefix = f'optimizer.{name}.{index}.'
            if any(key.startswith(prefix) for key in tensors):
                slots |= {f'{prefix}step': torch.zeros(()), f'{prefix}exp_avg': weight,
                          f'{prefix}exp_avg_sq': weight}
    return slots


def _check_names(found: Mapping[str, object], expected: Mapping[str, object]) -> None:
    """Raise a ``ValueError`` if the names differ from the expected names."""
    if wrong := sorted(found.keys() ^ expected.keys()):
        raise ValueError(f'{wrong[0]} is {"unknown" if wrong[0] in found else "missing"}')


def _check_tensors(tensors: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> None:
    """
    Refuse tensors of other names, shapes or types than expected, and values out of range.

    :raises ValueError: if a tensor is refused.
    """
    _check_names(tensors, expected)
    for name, tensor in tensors.items():
        if tensor.shape != expected[name].shape or tensor.dtype != expected[name].dtype:
            raise ValueError(f'{name} is {tensor.dtype} {tuple(tensor.shape)}, not '
                             f'{expected[name].dtype} {tuple(expected[name].shape)}')
        # Adam's squares and steps, and the counters, are never negative. All tensors but weights
        # have the limit of the counters: 1 << 40, that of the setting ``interactions``.
        low = 0.0 if name.endswith(('.exp_avg_sq', '.step')) or 'counter.' in name else -torch.inf
        high = MAX_WEIGHT if name.startswith('policy.') else (1 << 40)
        # NaN fails each comparison, and is refused too.
        if not ((tensor >= low) & (tensor.abs() <= high)).all():
            raise ValueError(f'{name} has numbers that no training ends with')


def save_replay(buffer: DictReplayBuffer, path: Path) -> None:
    """
    Write the content of a replay buffer; the file is whole or absent.

    :param buffer: of stable-baselines3.
    :param path: file to write or replace.
    :raises OSError: if the file cannot be written; an older file stays.
    """
    arrays = {name: rows[:buffer.size()] for name, rows in _rows(buffer).items()}
    arrays[FILLED] = np.array([buffer.pos, buffer.full], dtype=np.int64)
    # Write to the file directly: a second copy of the buffer may not fit into memory.
    with whole_or_absent(path) as temporary_path, open(temporary_path, 'wb') as file:
        write_blob(file, arrays)


def load_replay(buffer: DictReplayBuffer, path: Path) -> None:
    """
    Fill an empty replay buffer from a file.

    :param buffer: made with the same settings.
    :raises CheckpointError: if the file is damaged, or of another kind of buffer; the buffer stays
        unchanged.
    """
    try:
        # The file has at most the arrays of a full buffer, and a header below a megabyte.
        check_regular(path, sum(array.nbytes for array in _rows(buffer).values()) + 1_000_000)
        arrays, _ = read_blob(np.memmap(path, np.uint8, 'r'))
        position, full = arrays.pop(FILLED).tolist()
        rows = _rows(buffer)
        _check_rows(arrays, rows, buffer.buffer_size if full else position)
    except (OSError, KeyError, TypeError, ValueError, IndexError) as error:
        raise CheckpointError(
            f'{path}: found no moves of this run ({error}); expected those that it has saved; '
            'remove the file: the run goes on and plays new moves first, nothing else is lost'
        ) from error
    for name, values in arrays.items():
        rows[name][:len(values)] = values
    buffer.pos = position
    buffer.full = bool(full)
    end_episodes(buffer)


def end_episodes(buffer: DictReplayBuffer) -> None:
    """
    Let the last stored transitions end their episodes: the next ones belong to others.

    They end at a time limit if their state is not terminal.
    """
    last_row = buffer.pos - 1
    buffer.timeouts[last_row] = np.maximum(buffer.timeouts[last_row], 1.0 - buffer.dones[last_row])
    buffer.dones[last_row] = 1.0


def _rows(buffer: DictReplayBuffer) -> dict[str, np.ndarray]:
    """Return by name the arrays (S, E, ...) with an entry for each of S rows, E environments."""
    rows = {}
    # Observations are dictionaries of arrays; the key '' stands for an attribute that is itself an
    # array. Attributes without an entry for each row and environment are left out.
    for name, value in vars(buffer).items():
        arrays = value if isinstance(value, dict) else {'': value}
        rows |= {f'{name}.{key}' if key else name: array for key, array in arrays.items()
                 if isinstance(array, np.ndarray)
                 and array.shape[:2] == (buffer.buffer_size, buffer.n_envs)}
    return rows


def _check_rows(arrays: dict[str, np.ndarray], rows: dict[str, np.ndarray], count: int) -> None:
    """
    Refuse arrays that do not fit the rows of a buffer, and numbers that are not finite.

    :param arrays: arrays of a file.
    :param rows: arrays of the buffer, from :func:`_rows`.
    :param count: number of stored rows.
    :raises ValueError: if an array is refused.
    """
    _check_names(arrays, rows)
    for name, expected in rows.items():
        found, shape = arrays[name], (count, *expected.shape[1:])
        if found.dtype != expected.dtype or found.shape != shape or count > len(expected):
            raise ValueError(f'{name} is {found.dtype} {found.shape}, not {expected.dtype} '
                             f'{shape}')
        if found.dtype.kind == 'f' and not np.isfinite(found).all():
            raise ValueError(f'{name} has NaN or inf')
