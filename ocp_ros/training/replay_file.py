# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The replay buffer of a run as one safetensors file: a run goes on with its past moves."""

import os
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
import safetensors.numpy
from stable_baselines3.common.buffers import DictReplayBuffer

from ocp_ros.agent.errors import CheckpointError

#: Name of the array that says which slot is written next, and whether all have been.
FILLED = 'filled'


def save_replay(buffer: DictReplayBuffer, path: Path) -> None:
    """
    Write what a replay buffer holds; the file is whole or absent.

    :param buffer: of stable-baselines3.
    :param path: where to; what was there before is replaced.
    :raises OSError: if it cannot be written; what was there before stays.
    """
    arrays = {name: np.ascontiguousarray(rows[:buffer.size()])
              for name, rows in _rows(buffer).items()}
    arrays[FILLED] = np.array([buffer.pos, buffer.full], dtype=np.int64)
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f'.{path.name}.part')
    try:
        # To the file at once: a second copy of all moves may not fit into memory.
        safetensors.numpy.save_file(arrays, beside)
        os.replace(beside, path)
    except BaseException as error:
        beside.unlink(missing_ok=True)
        if isinstance(error, SafetensorError):
            raise OSError(f'{path}: found no room to write it ({error})') from error
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
        position, full = arrays.pop(FILLED).tolist()
        rows = _rows(buffer)
        _check(arrays, rows, buffer.buffer_size if full else position)
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, IndexError) as error:
        raise CheckpointError(
            f'{path}: found no moves of this run ({error}); expected those that it has saved; '
            'remove the file: the run goes on and plays new moves first, nothing else is lost'
        ) from error
    for name, values in arrays.items():
        rows[name][:len(values)] = values
    buffer.pos, buffer.full = position, bool(full)


def _rows(buffer: DictReplayBuffer) -> dict[str, np.ndarray]:
    """Name the arrays that have a row for each slot and environment: (S, E, ...)."""
    found = {}
    for name, value in vars(buffer).items():
        parts = value if isinstance(value, dict) else {'': value}
        found |= {f'{name}.{part}' if part else name: array for part, array in parts.items()
                  if isinstance(array, np.ndarray)
                  and array.shape[:2] == (buffer.buffer_size, buffer.n_envs)}
    return found


def _check(arrays: dict[str, np.ndarray], rows: dict[str, np.ndarray], count: int) -> None:
    """
    Refuse arrays that are not some rows of a buffer's, and numbers that are not finite.

    :raises ValueError: if so.
    """
    if odd := sorted(arrays.keys() ^ rows.keys()):
        raise ValueError(f'{odd[0]} is {"unknown" if odd[0] in arrays else "missing"}')
    for name, expected in rows.items():
        found, shape = arrays[name], (count, *expected.shape[1:])
        if found.dtype != expected.dtype or found.shape != shape or count > len(expected):
            raise ValueError(f'{name} is {found.dtype} {found.shape}, not {expected.dtype} '
                             f'{shape}')
        if found.dtype.kind == 'f' and not np.isfinite(found).all():
            raise ValueError(f'{name} has NaN or inf')
