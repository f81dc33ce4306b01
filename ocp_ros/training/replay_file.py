# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The replay buffer of a run as one file: an interrupted run goes on with its past moves."""

import os
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
import safetensors.numpy
from stable_baselines3.common.buffers import DictReplayBuffer

from ocp_ros.agent.errors import CheckpointError
from ocp_ros.training.replay_buffer import TurnReplay

#: Names of the arrays that tell how far the rings are filled.
POSITION, FULL = 'ring.position', 'ring.full'


def save_replay(buffer: DictReplayBuffer, path: Path) -> None:
    """
    Write what a replay buffer holds; the file is whole or absent.

    :param buffer: of stable-baselines3, or :class:`~ocp_ros.training.replay_buffer.TurnReplay`.
    :param path: where to; what was there before is replaced.
    :raises OSError: if it cannot be written; what was there before stays.
    """
    written = _written(buffer)
    arrays = {name: np.ascontiguousarray(ring[:written]) for name, ring in _rings(buffer).items()}
    arrays |= {POSITION: np.atleast_1d(np.asarray(buffer.pos, dtype=np.int64)),
               FULL: np.atleast_1d(np.asarray(buffer.full, dtype=bool))}
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f'.{path.name}.part')
    try:
        # To the file at once: a second copy of all moves may not fit into memory.
        safetensors.numpy.save_file(arrays, beside)
        os.replace(beside, path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def load_replay(buffer: DictReplayBuffer, path: Path) -> None:
    """
    Fill an empty replay buffer with what another process has saved.

    :param buffer: made with the same settings.
    :raises CheckpointError: if the file is damaged, or of a buffer of another kind; the buffer is
        as it was.
    """
    try:
        arrays = safetensors.numpy.load_file(path)
        position, full = arrays.pop(POSITION), arrays.pop(FULL)
        if isinstance(buffer, TurnReplay):
            buffer.make_room_for(arrays['observed'].shape[2])
        rings = _rings(buffer)
        _check(arrays, rings, position, full, buffer)
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, IndexError) as error:
        raise CheckpointError(
            f'{path}: found no moves of this run ({error}); expected those that it has saved; '
            'remove the file: the run goes on and plays new moves first, nothing else is lost'
        ) from error
    for name, ring in rings.items():
        ring[:len(arrays[name])] = arrays[name]
    if isinstance(buffer, TurnReplay):
        buffer.pos, buffer.full = position, full
        # The episodes that were being played are not gone on with.
        buffer.waiting[:] = False
    else:
        buffer.pos, buffer.full = int(position[0]), bool(full[0])


def _rings(buffer: DictReplayBuffer) -> dict[str, np.ndarray]:
    """Name the arrays that have a row for each slot and environment: (S, E, ...)."""
    found = {}
    for name, value in vars(buffer).items():
        parts = value if isinstance(value, dict) else {'': value}
        found |= {f'{name}.{part}' if part else name: array for part, array in parts.items()
                  if isinstance(array, np.ndarray)
                  and array.shape[:2] == (_slots(buffer), buffer.n_envs)}
    return found


def _slots(buffer: DictReplayBuffer) -> int:
    """Return how many slots each environment has."""
    return buffer.slots if isinstance(buffer, TurnReplay) else buffer.buffer_size


def _written(buffer: DictReplayBuffer) -> int:
    """Return how many slots have been written to."""
    return _slots(buffer) if np.any(buffer.full) else int(np.max(buffer.pos))


def _check(arrays: dict[str, np.ndarray], rings: dict[str, np.ndarray], position: np.ndarray,
           full: np.ndarray, buffer: DictReplayBuffer) -> None:
    """
    Refuse arrays that are not those of a buffer's rings, and numbers that are not finite.

    :raises ValueError: if so.
    """
    if odd := sorted(arrays.keys() ^ rings.keys()):
        raise ValueError(f'{odd[0]} is {"unknown" if odd[0] in arrays else "missing"}')
    slots, count = _slots(buffer), buffer.n_envs if isinstance(buffer, TurnReplay) else 1
    if (position.shape, full.shape, full.dtype) != ((count,), (count,), bool) or not (
            (position >= 0) & (position < slots)).all():
        raise ValueError('it does not tell how far it is filled')
    written = slots if full.any() else int(position.max())
    for name, ring in rings.items():
        found = arrays[name]
        if found.dtype != ring.dtype or found.shape != (written, *ring.shape[1:]):
            raise ValueError(f'{name} is {found.dtype} {found.shape}, not {ring.dtype} '
                             f'{(written, *ring.shape[1:])}')
        # The cameras that an episode does not have are NaN.
        if found.dtype.kind == 'f' and np.isinf(found).any():
            raise ValueError(f'{name} has inf')
