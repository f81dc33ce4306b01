# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Transitions on disk, so that a learner that was killed has its replay buffer again."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
import safetensors.numpy

from ocp_ros.agent.errors import CheckpointError
from ocp_ros.training.transitions import Transition
from ocp_ros.util.files import write_atomically

NUMBERS = ('actions', 'reward', 'terminated')


class TransitionLog:
    """
    Keep the latest transitions in files, each written once and whole or absent.

    A file is named after the transitions before it. The oldest are removed as newer ones come.

    :param folder: where the files are.
    :param capacity: so many of the latest transitions are kept at least.
    :ivar total: transitions so far, those of earlier processes included.
    """

    def __init__(self, folder: Path, capacity: int) -> None:
        self.folder, self.capacity = Path(folder), capacity
        self._waiting: list[Transition] = []
        self._saved = 0

    @property
    def total(self) -> int:
        """Return the number of transitions so far, those not yet saved included."""
        return self._saved + len(self._waiting)

    @property
    def waiting(self) -> int:
        """Return the number of transitions that are not yet saved."""
        return len(self._waiting)

    def append(self, transition: Transition) -> None:
        """Take a transition, to be saved later."""
        self._waiting.append(transition)

    def _files(self) -> list[Path]:
        """Return the files, oldest first."""
        return sorted(path for path in self.folder.glob('*.safetensors') if path.stem.isdecimal())

    def save(self) -> None:
        """Write what has come since the last time, and remove what is too old."""
        if not self._waiting:
            return
        first = self._waiting[0]
        parts = {**{f'before.{key}': [one.observation[key] for one in self._waiting]
                    for key in first.observation},
                 **{f'after.{key}': [one.next_observation[key] for one in self._waiting]
                    for key in first.next_observation},
                 **{key: [getattr(one, key) for one in self._waiting] for key in NUMBERS}}
        arrays = {name: np.ascontiguousarray(np.stack(values)) for name, values in parts.items()}
        self.folder.mkdir(parents=True, exist_ok=True)
        write_atomically(self.folder / f'{self._saved:012}.safetensors',
                         safetensors.numpy.save(arrays))
        self._saved += len(self._waiting)
        self._waiting.clear()
        files = self._files()
        for path, following in zip(files, files[1:]):
            if self._saved - int(following.stem) >= self.capacity:
                path.unlink(missing_ok=True)

    def load(self) -> Iterator[Transition]:
        """
        Yield the transitions of all files, oldest first.

        :raises CheckpointError: if a file cannot be read.
        """
        for path in self._files():
            try:
                arrays = safetensors.numpy.load(path.read_bytes())
                rows = {side: {name.removeprefix(side): value for name, value in arrays.items()
                               if name.startswith(side)} for side in ('before.', 'after.')}
                actions, rewards, ends = (arrays[name] for name in NUMBERS)
                _check(arrays)
            except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
                raise CheckpointError(
                    f'{path}: found no transitions ({type(error).__name__}: {error}); expected '
                    'those that a trainer has saved; remove the file: its transitions are lost, '
                    f'the others are kept; or remove {self.folder} to begin without any'
                ) from error
            for number in range(len(actions)):
                before, after = ({name: value[number] for name, value in rows[side].items()}
                                 for side in ('before.', 'after.'))
                yield Transition(before, actions[number], float(rewards[number]), after,
                                 bool(ends[number]))
            self._saved = int(path.stem) + len(actions)


def _check(arrays: dict[str, np.ndarray]) -> None:
    """
    Refuse arrays that do not belong together, and numbers that are not finite.

    :raises ValueError: if so.
    """
    count = len(arrays['actions'])
    for name, value in arrays.items():
        if value.shape[:1] != (count,) or (name in NUMBERS[1:] and value.ndim != 1):
            raise ValueError(f'{name} has the shape {value.shape}, not that of {count} rows')
        if not np.isfinite(value).all():
            raise ValueError(f'{name} has NaN or inf')
