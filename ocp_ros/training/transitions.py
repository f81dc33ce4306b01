# SPDX-License-Identifier: Apache-2.0
"""Transitions from messages that arrive on their own, in any order, and may be missing."""

from collections import OrderedDict
from typing import NamedTuple

import numpy as np

#: Moves commanded and moves seen may differ by so much and still be one transition, metres.
TOLERANCE = 0.05


class Reward(NamedTuple):
    """What a turn was worth; stamps in nanoseconds."""

    previous: int
    stamp: int
    reward: float
    terminated: bool


class Transition(NamedTuple):
    """
    One step of experience.

    :ivar observation: encoded observation before the turn.
    :ivar actions: (K, 2) float32 in [-1, 1], in units of the longest step.
    :ivar reward: the turn's reward.
    :ivar next_observation: encoded observation after the turn.
    :ivar terminated: whether nothing can follow; a turn limit alone does not make it so.
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
    Put transitions together by stamp.

    :param max_step: longest step in metres, to turn commanded moves into actions.
    :param patience: turns after which what is still incomplete is dropped and counted.
    """

    def __init__(self, max_step: float, patience: int = 32) -> None:
        self.max_step, self.patience = max_step, patience
        self.assembled = self.incomplete = self.inconsistent = 0
        self.clear()

    def clear(self) -> None:
        """Forget every turn, as when the stamps begin anew; what was incomplete is dropped."""
        self.incomplete += len(getattr(self, '_rewards', ()))
        capacity = 2 * self.patience
        self._observations: Bounded = Bounded(capacity)
        self._positions: Bounded = Bounded(capacity)
        self._commands: Bounded = Bounded(capacity)
        self._rewarded: Bounded = Bounded(2 * capacity)
        #: Rewards that wait, and the number each came as.
        self._rewards: dict[int, tuple[int, Reward]] = {}
        self._count = 0

    def knows(self, stamp: int) -> bool:
        """Tell whether a turn's observation is here already, as when it was sent again."""
        return stamp in self._observations

    def add_turn(self, stamp: int, observation: dict[str, np.ndarray], positions: np.ndarray
                 ) -> list[Transition]:
        """
        Take a turn.

        :param stamp: nanoseconds.
        :param observation: encoded.
        :param positions: (K, 3), metres.
        :returns: the transitions that are complete now.
        """
        self._observations[stamp], self._positions[stamp] = observation, positions
        return self._complete()

    def add_command(self, stamp: int, positions: np.ndarray) -> list[Transition]:
        """Take the command that answers a turn; returns the transitions complete now."""
        self._commands[stamp] = positions
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
            ends = (reward.previous, stamp)
            if reward.previous in self._commands and all(e in self._observations for e in ends):
                del self._rewards[stamp]
                found += self._transition(reward)
        return found

    def _transition(self, reward: Reward) -> list[Transition]:
        """Build a transition, unless another command than the one heard moved the cameras."""
        before, after = self._positions[reward.previous], self._positions[reward.stamp]
        command = self._commands[reward.previous]
        if command.shape != before.shape or before.shape != after.shape or \
                np.abs(command - after)[:, :2].max() > TOLERANCE:
            self.inconsistent += 1
            return []
        self.assembled += 1
        actions = np.clip((command - before)[:, :2] / self.max_step, -1.0, 1.0)
        return [Transition(self._observations[reward.previous], actions.astype(np.float32),
                           reward.reward, self._observations[reward.stamp], reward.terminated)]
