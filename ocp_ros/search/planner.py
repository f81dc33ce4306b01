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

"""Base class of planners: :meth:`Planner.ask` for placements, :meth:`Planner.tell` the scores."""

from abc import ABC, abstractmethod
from collections.abc import Generator, Sequence
from typing import NamedTuple

import numpy as np
from ocp_ros.rig.free_plane import FreePlane


class Scores(NamedTuple):
    """
    Scores of B placements.

    :ivar error: (B,) value to minimise: the rig's objective value.
    :ivar space_coverage: (B,) cubic metres.
    """

    error: np.ndarray
    space_coverage: np.ndarray


#: A search yields placements, positions (n, 2) each, metres, and receives their scores.
Search = Generator[Sequence[np.ndarray], Scores, None]


class Planner(ABC):
    """
    A method that finds a placement of cameras.

    A method is a generator: it yields placements and receives their scores.

    :param space: feasible region of the cameras.
    :param rng: the only source of random numbers.
    :param budget: expected number of evaluations.
    """

    def __init__(self, space: FreePlane, rng: np.random.Generator, budget: int) -> None:
        self.space = space
        self.rng = rng
        self.budget = budget
        # The search runs up to its first placements, so a subclass sets its own attributes before.
        self._search = self.search()
        self._batch: Sequence[np.ndarray] | None = next(self._search, None)

    @abstractmethod
    def search(self) -> Search:
        """Yield batches of placements, positions (n, 2) in the space, and receive their scores."""

    def energy(self, scores: Scores) -> np.ndarray:
        """Return the values that the method minimises, one for each of B placements: (B,)."""
        return scores.error

    def ask(self) -> Sequence[np.ndarray] | None:
        """Return the placements to score next, positions (n, 2) each; None at the end."""
        return self._batch

    def tell(self, scores: Scores) -> None:
        """Receive the scores of the placements of the last :meth:`ask`."""
        try:
            self._batch = self._search.send(scores)
        except StopIteration:
            self._batch = None
