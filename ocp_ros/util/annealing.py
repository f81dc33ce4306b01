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

"""Simulated annealing of any state."""

from collections.abc import Callable, Iterable
from typing import TypeVar

import numpy as np

State = TypeVar('State')


def between(first: float, last: float, share: float | np.ndarray) -> float | np.ndarray:
    """Return a value that goes geometrically from ``first`` at share 0 to ``last`` at share 1."""
    return first * (last / first) ** share


def is_accepted(rise: float, temperature: float, rng: np.random.Generator) -> bool:
    """Return whether annealing takes a step that raises the objective by ``rise``; random."""
    return rise <= 0.0 or rng.random() < np.exp(-rise / temperature)


def annealed(state: State, judge: Callable[[State], float],
             propose: Callable[[State], State | None], temperatures: Iterable[float],
             rng: np.random.Generator) -> State:
    """
    Minimise an objective by simulated annealing with symmetric proposals.

    :param state: the start state.
    :param judge: returns the objective of a state; less is better.
    :param propose: returns a random state near the given state, or None if there is none; a state
        and its neighbour propose each other with equal probability (symmetric).
    :param temperatures: the temperature of each step, in units of the objective.
    :param rng: decides which steps that raise the objective are taken.
    :returns: the best state found, which may be the start.
    """
    value = best_value = judge(state)
    best = state
    for temperature in temperatures:
        trial = propose(state)
        if trial is None:
            continue
        trial_value = judge(trial)
        if is_accepted(trial_value - value, temperature, rng):
            state, value = trial, trial_value
            if value < best_value:
                best, best_value = state, value
    return best
