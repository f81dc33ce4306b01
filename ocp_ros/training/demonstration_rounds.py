# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rounds of demonstrations as files."""

import io
from pathlib import Path

import numpy as np

from ocp_ros.agent.agent_config import AgentConfig
from ocp_ros.training.encoded_environment import encoded_space, index_counts
from ocp_ros.util.files import write_atomically
from ocp_ros.util.settings import UserError

#: Names of the arrays of an episode that are no inputs of the network.
NO_INPUTS = MOVES, ACTIONS, REWARDS, LAST, ENDS = (
    'expert', 'actions', 'rewards', 'last', 'ends')


def save_round(path: Path, episodes: list[dict[str, np.ndarray]]) -> None:
    """Write the episodes of a round in a row, in half precision; the file is whole or absent."""
    rows = {name: np.concatenate([one[name] for one in episodes]) for name in episodes[0]}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **{
        name: value.astype(np.float16) if value.dtype == np.float32 else value
        for name, value in rows.items()})
    write_atomically(path, buffer.getvalue())


def load_rounds(folder: Path, count: int, agent: AgentConfig) -> dict[str, np.ndarray]:
    """
    Read the first rounds of a folder: arrays (S, ...) by name, a row for each step.

    :param agent: whose inputs they have.
    :raises UserError: if one is damaged or of another network.
    """
    rounds = [_load_round(folder / f'{number:04}.npz', agent) for number in range(count)]
    return {name: np.concatenate([one[name] for one in rounds]) for name in rounds[0]}


def _load_round(path: Path, agent: AgentConfig) -> dict[str, np.ndarray]:
    """Read a round."""
    try:
        with path.open('rb') as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        _check_round(arrays, agent)
    except Exception as error:  # A broken file makes the libraries raise almost anything.
        reason = ' '.join(str(error).split()) or type(error).__name__
        raise UserError(
            f'{path}: found no whole round of demonstrations ({reason}); expected what was played '
            'for this network; remove the file, and the round is played again: nothing else is '
            'lost') from error
    return arrays


def _check_round(arrays: dict[str, np.ndarray], agent: AgentConfig) -> None:
    """
    Refuse arrays of other names, shapes or types than :func:`save_round` writes, and odd numbers.

    :raises ValueError: if so.
    """
    space, half = encoded_space(agent, 1), np.dtype(np.float16)
    expected = {name: (one.shape, half if one.dtype == np.float32 else one.dtype)
                for name, one in space.spaces.items()}
    expected |= {MOVES: ((1, 2), half), ACTIONS: ((1, 2), half), REWARDS: ((), half),
                 LAST: ((), np.dtype(bool)), ENDS: ((2,), half)}
    if odd := sorted(arrays.keys() ^ expected.keys()):
        raise ValueError(f'{odd[0]} is {"unknown" if odd[0] in arrays else "missing"}')
    steps = len(np.atleast_1d(arrays[LAST]))
    for name, (shape, kind) in expected.items():
        value = arrays[name]
        if value.shape != (steps, *shape) or value.dtype != kind:
            raise ValueError(f'{name} is {value.dtype} {value.shape}')
        most = {MOVES: 1.01, ACTIONS: 1.01}.get(name, np.inf)
        if not (np.isfinite(value) & (np.abs(value) <= most)).all():
            raise ValueError(f'{name} has numbers that were never played')
    if not arrays[LAST][-1:].all() or arrays[LAST].all():
        raise ValueError('its episodes have no end, or no moves')
    for name, count in index_counts(agent).items():
        if name in arrays and not ((arrays[name] >= 0) & (arrays[name] < count)).all():
            raise ValueError(f'{name} has indices beyond {count}')
