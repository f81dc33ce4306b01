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
Experience of a policy: its observations and choices in a turn, and transitions made of them.

The trainer gets exactly the arrays that the network has read, as one safetensors blob. To encode
the turn again would take as long as to play it, and the inputs of cameras that choose later could
not be reconstructed. Experiences, positions and rewards of turns arrive separately, in any order,
or not at all; :class:`Assembler` makes transitions of them.
"""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
import io
import json
from typing import NamedTuple

import numpy as np
from ocp_ros.util.settings import MAX_CAMERAS
from ocp_ros.util.tensor_blob import read_blob, write_blob

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
    blob = io.BytesIO()
    write_blob(blob, arrays, {KEY: header})
    return blob.getvalue()


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
        arrays, metadata = read_blob(blob)
        header = json.loads(metadata[KEY])
        stamp, turn = int(header['stamp']), int(header['turn'])
        actions, targets = arrays.pop('actions'), arrays.pop('targets')
    except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError
            ) as error:
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


class Reward(NamedTuple):
    """
    The reward of a turn.

    :ivar previous: time stamp of the turn before, whose command led to this turn, nanoseconds.
    :ivar stamp: time stamp of the turn, nanoseconds.
    :ivar step: number of turns of the episode so far, including this one.
    :ivar reward: reward of the whole turn.
    :ivar shares: (K,) part of the reward for each of K moves, in the order in which cameras chose.
    :ivar terminated: whether the episode has ended in a terminal state; False at a turn limit.
    """

    previous: int
    stamp: int
    step: int
    reward: float
    shares: tuple[float, ...]
    terminated: bool


class Transition(NamedTuple):
    """
    One step of experience: the move of one camera, or of all cameras that choose together.

    :ivar observation: encoded observation before the move.
    :ivar actions: (C, 2) float32 in [-1, 1], moves of C cameras in units of the longest step.
    :ivar reward: reward of the move.
    :ivar next_observation: encoded observation of the next choice.
    :ivar terminated: whether the next state is terminal.
    """

    observation: dict[str, np.ndarray]
    actions: np.ndarray
    reward: float
    next_observation: dict[str, np.ndarray]
    terminated: bool


class BoundedDict(OrderedDict):
    """A dictionary that drops its oldest entries beyond its capacity."""

    def __init__(self, capacity: int) -> None:
        super().__init__()
        self.capacity = capacity

    def __setitem__(self, key, value) -> None:
        """Store an entry, and drop the oldest one if there are too many."""
        super().__setitem__(key, value)
        while len(self) > self.capacity:
            self.popitem(last=False)


class Assembler:
    """
    Assemble the transitions of one rig by the time stamps of turns.

    A turn is complete when these data have arrived: the choices of the policy, the resulting
    camera positions, the reward, and the next observation of the policy.

    :param patience: number of turns after which an incomplete turn is dropped and counted.
    :ivar assembled: number of complete turns.
    :ivar incomplete: number of turns that were dropped incomplete.
    :ivar inconsistent: number of turns that do not follow from the policy's choices: the cameras
        are not where they were sent, or the number of the turn in the episode differs.
    """

    def __init__(self, patience: int = 32) -> None:
        self.patience = patience
        self.assembled = self.incomplete = self.inconsistent = 0
        self.clear()

    def clear(self) -> None:
        """Drop all turns, for example when the stamps begin again; count the incomplete ones."""
        # When the constructor calls this method, there are no rewards yet.
        self.incomplete += len(getattr(self, '_rewards', ()))
        # Choices and positions stay longer than rewards, which wait for ``patience`` turns.
        capacity = 2 * self.patience
        #: The choices and the positions of turns, by stamp.
        self._experiences: BoundedDict = BoundedDict(capacity)
        self._positions: BoundedDict = BoundedDict(capacity)
        #: The stamps of all turns whose reward has arrived, as keys.
        self._rewarded: BoundedDict = BoundedDict(2 * capacity)
        #: By stamp, the rewards of incomplete turns, each with the number of its arrival.
        self._rewards: dict[int, tuple[int, Reward]] = {}
        self._reward_count = 0

    def add_experience(self, experience: Experience) -> list[Transition]:
        """Store the choices of a policy in a turn; return the transitions of complete turns."""
        self._experiences[experience.stamp] = experience
        return self._take_complete()

    def add_positions(self, stamp: int, positions: np.ndarray) -> list[Transition]:
        """Store the positions (K, 3), metres, after a turn; return as ``add_experience``."""
        self._positions[stamp] = positions
        return self._take_complete()

    def add_reward(self, reward: Reward) -> list[Transition]:
        """Store the reward of a turn, unless the turn has one; return as ``add_experience``."""
        if reward.stamp in self._rewarded:
            return []
        self._rewarded[reward.stamp] = True
        self._reward_count += 1
        self._rewards[reward.stamp] = (self._reward_count, reward)
        for stamp, (number, _) in list(self._rewards.items()):
            if number <= self._reward_count - self.patience:
                del self._rewards[stamp]
                self.incomplete += 1
        return self._take_complete()

    def _take_complete(self) -> list[Transition]:
        """Remove the complete turns, and return their transitions."""
        transitions = []
        for stamp, (_, reward) in list(self._rewards.items()):
            if stamp in self._positions and all(
                    needed in self._experiences for needed in (reward.previous, stamp)):
                del self._rewards[stamp]
                transitions += self._transitions_of(reward)
        return transitions

    def _transitions_of(self, reward: Reward) -> list[Transition]:
        """Return the transitions of a complete turn; if it is inconsistent, only count it."""
        before, after = self._experiences[reward.previous], self._experiences[reward.stamp]
        choices, positions = before.choices, self._positions[reward.stamp]
        if len(reward.shares) == len(before.targets):
            # Leave out the positions of fixed cameras, which have no share and no target. They
            # come last.
            positions = positions[:len(reward.shares)]
        shares: Sequence[float] = reward.shares
        if len(choices) == 1:
            # The only choice, which may be that of all cameras, gets the whole reward.
            shares = [reward.reward]
        # The last condition: a camera is more than 5 cm from its target along x or y.
        if (before.targets.shape != positions.shape or before.turn != reward.step - 1
                or len(shares) != len(choices)
                or np.abs(before.targets - positions)[:, :2].max() > 0.05):
            self.inconsistent += 1
            return []
        self.assembled += 1
        # The observation after a choice is that of the next choice. The last choice of a turn is
        # followed by the first one of the next turn.
        next_choices = [*choices[1:], after.choices[0]]
        terminated = (len(choices) - 1) * [False] + [reward.terminated]
        return [Transition(choice.observation, choice.actions, share, next_choice.observation, end)
                for choice, share, next_choice, end in zip(
                    choices, shares, next_choices, terminated)]
