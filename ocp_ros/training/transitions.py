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

"""Transitions from what arrives on its own, in any order, and may be missing."""

from collections import OrderedDict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ocp_ros.training.experience import Experience

#: Where cameras were sent and where they are may differ by so much, metres.
TOLERANCE = 0.05


class Reward(NamedTuple):
    """
    What a turn was worth.

    :ivar previous: stamp of the turn before, whose command led here, nanoseconds.
    :ivar stamp: of the turn, nanoseconds.
    :ivar step: turns of the episode so far, this one included.
    :ivar reward: of the whole turn.
    :ivar shares: (K,) what the move of each camera was worth, in the order in which they chose.
    :ivar terminated: whether nothing can follow; a turn limit alone does not make it so.
    """

    previous: int
    stamp: int
    step: int
    reward: float
    shares: tuple[float, ...]
    terminated: bool


class Transition(NamedTuple):
    """
    One step of experience: the move of one camera, or of all where they choose together.

    :ivar observation: encoded observation before the move.
    :ivar actions: (C, 2) float32 in [-1, 1], in units of the longest step.
    :ivar reward: what the move was worth.
    :ivar next_observation: encoded observation that the next choice was made from.
    :ivar terminated: whether nothing can follow.
    """

    observation: dict[str, np.ndarray]
    actions: np.ndarray
    reward: float
    next_observation: dict[str, np.ndarray]
    terminated: bool


class Bounded(OrderedDict):
    """A dictionary that forgets its oldest entry rather than grow beyond its capacity."""

    def __init__(self, capacity: int) -> None:
        super().__init__()
        self.capacity = capacity

    def __setitem__(self, key, value) -> None:
        """Store an entry."""
        super().__setitem__(key, value)
        while len(self) > self.capacity:
            self.popitem(last=False)


class Assembler:
    """
    Put the transitions of one rig together by stamp.

    A turn is complete when it is known what the policy chose in it, where that has led, what it
    was worth, and what the policy read next.

    :param patience: turns after which what is still incomplete is dropped and counted.
    :param last: whether the last choice of a turn gets its whole reward, and the others nothing: a
        choice is then where a camera goes, which takes turns.
    :ivar assembled: turns that were complete.
    :ivar incomplete: turns that never were.
    :ivar inconsistent: turns that ended elsewhere than the policy meant, or were another turn of
        the episode than it thought.
    """

    def __init__(self, patience: int = 32, last: bool = False) -> None:
        self.patience, self.last = patience, last
        self.assembled = self.incomplete = self.inconsistent = 0
        self.clear()

    def clear(self) -> None:
        """Forget every turn, as when the stamps begin anew; what was incomplete is dropped."""
        self.incomplete += len(getattr(self, '_rewards', ()))
        capacity = 2 * self.patience
        self._experiences: Bounded = Bounded(capacity)
        self._positions: Bounded = Bounded(capacity)
        self._rewarded: Bounded = Bounded(2 * capacity)
        #: Rewards that wait, and the number each came as.
        self._rewards: dict[int, tuple[int, Reward]] = {}
        self._count = 0

    def add_experience(self, experience: Experience) -> list[Transition]:
        """Take what a policy chose in a turn; returns the transitions complete now."""
        self._experiences[experience.stamp] = experience
        return self._complete()

    def add_positions(self, stamp: int, positions: np.ndarray) -> list[Transition]:
        """Take where the cameras were in a turn, (K, 3) metres; returns as above."""
        self._positions[stamp] = positions
        return self._complete()

    def add_reward(self, reward: Reward) -> list[Transition]:
        """Take the reward of a turn, once; returns the transitions complete now."""
        if reward.stamp in self._rewarded:
            return []
        self._rewarded[reward.stamp] = True
        self._count += 1
        self._rewards[reward.stamp] = (self._count, reward)
        for stamp, (number, _) in list(self._rewards.items()):
            if number <= self._count - self.patience:
                del self._rewards[stamp]
                self.incomplete += 1
        return self._complete()

    def _complete(self) -> list[Transition]:
        """Take out what is complete."""
        found = []
        for stamp, (_, reward) in list(self._rewards.items()):
            if stamp in self._positions and all(
                    end in self._experiences for end in (reward.previous, stamp)):
                del self._rewards[stamp]
                found += self._turn(reward)
        return found

    def _turn(self, reward: Reward) -> list[Transition]:
        """Return the transitions of a turn, unless something else than the policy made it."""
        before, after = (self._experiences[at] for at in (reward.previous, reward.stamp))
        choices, positions = before.choices, self._positions[reward.stamp]
        if len(reward.shares) == len(before.targets):
            # Those that have a share are the cameras that move; those in place come behind them.
            positions = positions[:len(reward.shares)]
        shares: Sequence[float] = reward.shares
        if self.last or len(choices) == 1:
            shares = (len(choices) - 1) * [0.0] + [reward.reward]
        if (before.targets.shape != positions.shape or before.turn != reward.step - 1
                or len(shares) != len(choices)
                or np.abs(before.targets - positions)[:, :2].max() > TOLERANCE):
            self.inconsistent += 1
            return []
        self.assembled += 1
        following = [*choices[1:], after.choices[0]]
        last = len(choices) - 1
        return [Transition(choice.observation, choice.actions, share, then.observation,
                           reward.terminated and number == last)
                for number, (choice, share, then) in enumerate(zip(choices, shares, following))]
