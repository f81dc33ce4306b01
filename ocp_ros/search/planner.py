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

"""What a planner is: asked for placements, told what they are worth."""

from abc import ABC, abstractmethod
from collections.abc import Generator, Sequence
from typing import ClassVar, NamedTuple

import numpy as np
from ocp_ros.rig.free_plane import FreePlane


class Scores(NamedTuple):
    """
    What placements are worth.

    :ivar error: (B,) what a planner minimises: the depth error in metres, or the loss of a rig.
    :ivar space_coverage: (B,) cubic metres.
    """

    error: np.ndarray
    space_coverage: np.ndarray


#: What a search hands out and gets back: positions (n, 2) each, and their scores.
Search = Generator[Sequence[np.ndarray], Scores, None]


class Planner(ABC):
    """
    A method that finds a placement of cameras.

    A method is a generator: it yields placements to be judged and receives their scores.

    :cvar descends: whether what it finds may be improved by small steps at the end; not so where
        the method is a yardstick that searches nothing.

    :param space: where cameras may be.
    :param rng: the only source of chance.
    :param budget: how many evaluations there will be, for those methods that plan with it.
    """

    descends: ClassVar[bool] = True

    def __init__(self, space: FreePlane, rng: np.random.Generator, budget: int) -> None:
        self.space, self.rng, self.budget = space, rng, budget
        self._search = self.search()
        self._batch: Sequence[np.ndarray] | None = next(self._search, None)

    @abstractmethod
    def search(self) -> Search:
        """Yield batches of positions (n, 2), each camera inside the space."""

    def energy(self, scores: Scores) -> np.ndarray:
        """Return what the method minimises: (B,), its answer is the placement of the least."""
        return scores.error

    def ask(self) -> Sequence[np.ndarray] | None:
        """Return the placements to be judged next, positions (n, 2) each; None at the end."""
        return self._batch

    def tell(self, scores: Scores) -> None:
        """Receive what the placements of the last :meth:`ask` are worth."""
        try:
            self._batch = self._search.send(scores)
        except StopIteration:
            self._batch = None
