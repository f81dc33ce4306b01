# SPDX-License-Identifier: Apache-2.0
"""The whole state of SAC as safetensors, so that training resumes without unpickling anything."""

from pathlib import Path
import uuid

import safetensors.torch
from stable_baselines3 import SAC
import torch

from ocp_ros.agent.checkpoint import CheckpointError, read_metadata
from ocp_ros.util.files import write_atomically

COUNTERS = ('_n_updates', 'num_timesteps', 'own_updates')


def _optimizers(model: SAC) -> dict[str, torch.optim.Optimizer]:
    """Name SAC's three optimisers."""
    return {'actor': model.actor.optimizer, 'critic': model.critic.optimizer,
            'entropy': model.ent_coef_optimizer}


def new_run() -> str:
    """Name a training run: 12 random hexadecimal digits."""
    return uuid.uuid4().hex[:12]


def save_state(model: SAC, path: Path, run: str) -> None:
    """
    Write networks, optimisers, entropy coefficient and counters; the file is whole or absent.

    The replay buffer is not part of it: it fills again.

    :param model: from :func:`ocp_ros.training.sac.make_sac`.
    :param path: where to.
    :param run: identity of the training run.
    """
    tensors = {f'policy.{name}': value for name, value in model.policy.state_dict().items()}
    tensors['log_ent_coef'] = model.log_ent_coef.detach()
    for name, optimizer in _optimizers(model).items():
        for index, slot in optimizer.state_dict()['state'].items():
            tensors.update({f'optimizer.{name}.{index}.{key}': value
                            for key, value in slot.items()})
    tensors.update({f'counter.{name}': torch.tensor(getattr(model, name)) for name in COUNTERS})
    tensors = {name: value.cpu().contiguous().clone() for name, value in tensors.items()}
    write_atomically(path, safetensors.torch.save(tensors, metadata={'run': run}))


def load_state(model: SAC, path: Path) -> str:
    """
    Put a saved state into a model that was built with the same settings.

    :returns: identity of the training run that goes on.
    :raises CheckpointError: if the file cannot be read or belongs to another network.
    """
    try:
        blob = Path(path).read_bytes()
        tensors, run = safetensors.torch.load(blob), read_metadata(blob)['run']
        model.policy.load_state_dict(
            {name.removeprefix('policy.'): value for name, value in tensors.items()
             if name.startswith('policy.')})
        model.log_ent_coef.data.copy_(tensors['log_ent_coef'])
        for name in COUNTERS:
            setattr(model, name, int(tensors[f'counter.{name}']))
    except (OSError, safetensors.SafetensorError, KeyError, ValueError,
            RuntimeError) as error:
        raise CheckpointError(f'{path}: found no training state for this network ({error}); '
                              'resume with the settings it was saved with') from error
    for name, optimizer in _optimizers(model).items():
        state: dict[int, dict[str, torch.Tensor]] = {}
        prefix = f'optimizer.{name}.'
        for key, value in tensors.items():
            if key.startswith(prefix):
                index, slot = key.removeprefix(prefix).split('.')
                state.setdefault(int(index), {})[slot] = value
        optimizer.load_state_dict({**optimizer.state_dict(), 'state': state})
    return run
