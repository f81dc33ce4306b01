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
    """Fall from the first to the last by a constant factor."""
    return first * (last / first) ** share


def accepted(rise: float, temperature: float, rng: np.random.Generator) -> bool:
    """Return whether annealing takes a step that raises what it minimises by so much."""
    return rise <= 0.0 or rng.random() < np.exp(-rise / temperature)


def annealed(state: State, judge: Callable[[State], float],
             propose: Callable[[State], State | None], temperatures: Iterable[float],
             rng: np.random.Generator) -> State:
    """
    Anneal by proposals that are as likely as the way back.

    :param state: where to begin.
    :param judge: returns what a state is worth; less is better.
    :param propose: returns another state near one, or None where there is none to be had.
    :param temperatures: one for each step, in units of the judge.
    :returns: the best state of all, which may be the first.
    """
    value = best_value = judge(state)
    best = state
    for temperature in temperatures:
        trial = propose(state)
        if trial is None:
            continue
        trial_value = judge(trial)
        if accepted(trial_value - value, temperature, rng):
            state, value = trial, trial_value
            if value < best_value:
                best, best_value = state, value
    return best
