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


def annealed(state: State, objective: Callable[[State, float], float],
             propose: Callable[[State], Iterable[State]], temperatures: Iterable[float],
             rng: np.random.Generator) -> State:
    """
    Minimise an objective by simulated annealing with symmetric proposals.

    A step is accepted if the objective rises by at most an exponential random number times the
    temperature. This is the rule of Metropolis, with the random number drawn first: the objective
    of a trial need not be computed to the end once it exceeds this limit.

    :param state: the start state.
    :param objective: returns the objective of a state; less is better. Its second argument is a
        limit: for a larger objective, any value above the limit may be returned.
    :param propose: returns random states near the given state, possibly none; they are tried one
        after the other. A state and its neighbour propose each other with equal probability
        (symmetric).
    :param temperatures: one for each call of ``propose``, in units of the objective.
    :param rng: decides which steps that raise the objective are accepted.
    :returns: the best state found, which may be the start.
    """
    best = state
    value = best_value = objective(state, np.inf)
    for temperature in temperatures:
        for trial in propose(state):
            max_value = value + temperature * rng.exponential()
            trial_value = objective(trial, max_value)
            if trial_value <= max_value:
                state, value = trial, trial_value
                if value < best_value:
                    best, best_value = state, value
    return best
