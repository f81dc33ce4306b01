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
Experience of a policy in a turn, its observations and choices, as one safetensors blob.

The trainer gets exactly the arrays that the network has read. To encode the turn again would take
as long as to play it, and the inputs of cameras that choose later could not be reconstructed.
"""

from collections.abc import Mapping, Sequence
import json
import struct
from typing import NamedTuple

import numpy as np
from ocp_ros.policy.checkpoint import read_metadata
from ocp_ros.util.settings import MAX_CAMERAS
from safetensors import SafetensorError
import safetensors.numpy

#: Key, in the blob's metadata, of the JSON text with time stamp and turn.
KEY = 'ocp_ros-experience-1'


class ExperienceError(ValueError):
    """An experience that cannot be used; the message says what was found and what expected."""


class Choice(NamedTuple):
    """
    One input of the network, and the action that the network chose.

    :ivar observation: encoded, see :class:`~ocp_ros.policy.cloud_encoder.Encoder`.
    :ivar actions: (C, 2) float32 in [-1, 1], of the C cameras that choose together: one, or all. A
        row is a move in units of the longest step.
    """

    observation: dict[str, np.ndarray]
    actions: np.ndarray


class Experience(NamedTuple):
    """
    The choices of a policy in one turn.

    :ivar stamp: time stamp of the turn, nanoseconds.
    :ivar turn: number of turns of the episode before this one, as the policy received it.
    :ivar targets: (K, 3) metres: commanded positions of the K cameras.
    :ivar choices: the choices, in the order in which the cameras chose.
    """

    stamp: int
    turn: int
    targets: np.ndarray
    choices: Sequence[Choice]


def to_bytes(experience: Experience) -> bytes:
    """Return an experience with at least one choice as a safetensors blob."""
    choices = experience.choices
    arrays = {f'observation.{name}': np.stack([choice.observation[name] for choice in choices])
              for name in choices[0].observation}
    arrays['actions'] = np.stack([choice.actions for choice in choices]).astype(np.float32)
    arrays['targets'] = np.asarray(experience.targets, dtype=np.float64)
    header = json.dumps({'stamp': experience.stamp, 'turn': experience.turn})
    return safetensors.numpy.save(
        {name: np.ascontiguousarray(value) for name, value in arrays.items()},
        metadata={KEY: header})


def from_bytes(blob: bytes, expected: Mapping[str, tuple[tuple[int, ...], np.dtype]],
               together: int = 1) -> Experience:
    """
    Read an experience from a blob, and check it.

    :param blob: from :func:`to_bytes`.
    :param expected: shape and type of each array of an observation, by name.
    :param together: number of cameras that choose together.
    :raises ExperienceError: if the blob is damaged, has NaN or inf, or is of another network.
    """
    try:
        header = json.loads(read_metadata(blob)[KEY])
        stamp, turn = int(header['stamp']), int(header['turn'])
        arrays = safetensors.numpy.load(blob)
        actions, targets = arrays.pop('actions'), arrays.pop('targets')
    except (SafetensorError, KeyError, TypeError, ValueError, AttributeError, ArithmeticError,
            RecursionError, struct.error) as error:
        raise ExperienceError(
            f'experience: found no readable one ({type(error).__name__}: {error}); expected a '
            'whole safetensors blob of a policy that explores') from error
    count = _count_choices(actions, targets, together)
    wanted = {f'observation.{name}': ((count, *shape), np.dtype(kind))
              for name, (shape, kind) in expected.items()}
    found = {name: (value.shape, value.dtype) for name, value in arrays.items()}
    if found != wanted:
        wrong = min(name for name in found.keys() | wanted.keys()
                    if found.get(name) != wanted.get(name))
        raise ExperienceError(
            f'experience: found {wrong} as {found.get(wrong)}; expected '
            f'{wanted.get(wrong)}; give policy and trainer the same agent settings')
    if not all(np.isfinite(value).all() for value in (actions, targets, *arrays.values())):
        raise ExperienceError('experience: found NaN or inf; expected finite numbers')
    return Experience(stamp, turn, targets.astype(np.float64), [
        Choice({name.removeprefix('observation.'): value[number]
                for name, value in arrays.items()}, actions[number]) for number in range(count)])


def _count_choices(actions: np.ndarray, targets: np.ndarray, together: int) -> int:
    """
    Return the number of choices; refuse actions and targets of wrong shapes.

    :param actions: (choices, cameras that choose together, 2) float32.
    :param targets: (K, 3) of K cameras.
    :param together: number of cameras that one choice moves.
    """
    if targets.ndim != 2 or targets.shape[1] != 3 or not 1 <= len(targets) <= MAX_CAMERAS:
        raise ExperienceError(f'experience: found targets of shape {targets.shape}; expected '
                              f'(K, 3) with at most {MAX_CAMERAS} cameras')
    count = len(actions) if actions.ndim else 0
    # All cameras choose: one by one, or all at once.
    fits = (count, together) in ((len(targets), 1), (1, len(targets)))
    if not fits or actions.shape != (count, together, 2) or actions.dtype != np.float32:
        raise ExperienceError(
            f'experience: found actions as {actions.dtype} {actions.shape} of {len(targets)} '
            f'cameras; expected float32 choices of {together} at a time')
    return count
