# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The whole state of SAC as safetensors, so that training resumes without unpickling anything."""

from pathlib import Path
import uuid

import safetensors.torch
from stable_baselines3 import SAC
import torch

from ocp_ros.agent.checkpoint import CheckpointError, LARGEST_WEIGHT, read_metadata
from ocp_ros.util.files import write_atomically

#: Nothing that a run counts is larger.
MOST = 1 << 40
COUNTERS = ('_n_updates', 'num_timesteps', 'own_updates')


def _optimizers(model: SAC) -> dict[str, torch.optim.Optimizer]:
    """Name SAC's three optimisers."""
    return {'actor': model.actor.optimizer, 'critic': model.critic.optimizer,
            'entropy': model.ent_coef_optimizer}


def _networks(model: SAC) -> dict[str, torch.Tensor]:
    """Return all that is saved but for the optimisers."""
    return {**{f'policy.{name}': value for name, value in model.policy.state_dict().items()},
            'log_ent_coef': model.log_ent_coef.detach(),
            **{f'counter.{name}': torch.tensor(getattr(model, name)) for name in COUNTERS}}


def new_run() -> str:
    """Name a training run: 12 random hexadecimal digits."""
    return uuid.uuid4().hex[:12]


def save_state(model: SAC, path: Path, run: str) -> None:
    """
    Write networks, optimisers, entropy coefficient and counters; the file is whole or absent.

    The replay buffer is not part of it; see :mod:`ocp_ros.training.replay_file`.

    :param model: from :func:`ocp_ros.training.sac.make_sac`.
    :param path: where to.
    :param run: identity of the training run.
    """
    tensors = _networks(model)
    for name, optimizer in _optimizers(model).items():
        for index, slot in optimizer.state_dict()['state'].items():
            tensors.update({f'optimizer.{name}.{index}.{key}': value
                            for key, value in slot.items()})
    tensors = {name: value.cpu().contiguous().clone() for name, value in tensors.items()}
    write_atomically(path, safetensors.torch.save(tensors, metadata={'run': run}))


def load_state(model: SAC, path: Path) -> str:
    """
    Put a saved state into a model that was built with the same settings.

    :returns: identity of the training run that goes on.
    :raises CheckpointError: if the file is damaged or belongs to another network; the model is as
        it was.
    """
    try:
        blob = Path(path).read_bytes()
        tensors, run = safetensors.torch.load(blob), read_metadata(blob)['run']
        if not isinstance(run, str):
            raise ValueError(f'its run is {run!r}')
        slots = _slots(model, tensors)
        _check(tensors, _networks(model) | slots)
    except (OSError, safetensors.SafetensorError, KeyError, TypeError, ValueError,
            RuntimeError) as error:
        reason = f'{path}: found no training state for this network ({error}); '
        raise CheckpointError(
            f'{reason}expected a whole one, saved with the same settings; put it back from a '
            'copy, or begin in another folder with model set to the weights beside it: these are '
            'kept, the rest is lost') from error
    model.policy.load_state_dict(
        {name.removeprefix('policy.'): value for name, value in tensors.items()
         if name.startswith('policy.')})
    model.log_ent_coef.data.copy_(tensors['log_ent_coef'])
    for name in COUNTERS:
        setattr(model, name, int(tensors[f'counter.{name}']))
    for name, optimizer in _optimizers(model).items():
        state: dict[int, dict[str, torch.Tensor]] = {}
        for key in slots:
            _, owner, index, slot = key.split('.')
            if owner == name:
                state.setdefault(int(index), {})[slot] = tensors[key]
        optimizer.load_state_dict({**optimizer.state_dict(), 'state': state})
    return run


def _slots(model: SAC, tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return tensors like those that Adam keeps of each parameter that it has a step of."""
    slots = {}
    for name, optimizer in _optimizers(model).items():
        parameters = [one for group in optimizer.param_groups for one in group['params']]
        for index, parameter in enumerate(parameters):
            prefix = f'optimizer.{name}.{index}.'
            if any(key.startswith(prefix) for key in tensors):
                slots |= {f'{prefix}step': torch.zeros(()), f'{prefix}exp_avg': parameter,
                          f'{prefix}exp_avg_sq': parameter}
    return slots


def _check(tensors: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> None:
    """
    Refuse tensors of other names, shapes or types than expected, and numbers that cannot be.

    :raises ValueError: if so.
    """
    if odd := sorted(tensors.keys() ^ expected.keys()):
        raise ValueError(f'{odd[0]} is {"unknown" if odd[0] in tensors else "missing"}')
    for name, tensor in tensors.items():
        if tensor.shape != expected[name].shape or tensor.dtype != expected[name].dtype:
            raise ValueError(f'{name} is {tensor.dtype} {tuple(tensor.shape)}, not '
                             f'{expected[name].dtype} {tuple(expected[name].shape)}')
        low = 0.0 if name.endswith(('.exp_avg_sq', '.step')) or 'counter.' in name else -torch.inf
        most = LARGEST_WEIGHT if name.startswith('policy.') else MOST
        if not ((tensor >= low) & (tensor.abs() <= most)).all():
            raise ValueError(f'{name} has numbers that no training ends with')
