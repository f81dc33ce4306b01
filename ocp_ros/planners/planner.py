# SPDX-License-Identifier: Apache-2.0
"""What a planner is: asked for placements, told what they are worth."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ocp_ros.simulation.moves import kept_inside


@dataclass(frozen=True)
class Space:
    """
    Where cameras may be: a rectangle at a height.

    :ivar low: (2,) lowest x and y, metres, map frame.
    :ivar high: (2,) highest x and y, metres.
    :ivar height: z, metres.
    :ivar cameras: K, how many there are.
    """

    low: np.ndarray
    high: np.ndarray
    height: float
    cameras: int

    @classmethod
    def of(cls, bounds: np.ndarray, height: float, cameras: int, margin: float) -> 'Space':
        """
        Build the space of a room.

        :param bounds: (2, 3) bounding box, metres.
        :param height: z of the cameras, metres.
        :param cameras: K.
        :param margin: cameras stay this far inside the bounding box, metres.
        """
        corners, _ = kept_inside(np.asarray(bounds, dtype=np.float64), bounds, margin)
        return cls(corners[0, :2], corners[1, :2], height, cameras)

    @property
    def size(self) -> np.ndarray:
        """Return the edges of the rectangle: (2,) metres."""
        return self.high - self.low

    def random(self, rng: np.random.Generator, cameras: int | None = None) -> np.ndarray:
        """Draw a placement, (cameras, 2), uniformly; K cameras unless told otherwise."""
        return rng.uniform(self.low, self.high, (self.cameras if cameras is None else cameras, 2))

    def inside(self, positions: np.ndarray) -> np.ndarray:
        """Move positions (..., 2) to the nearest place in the rectangle."""
        return np.clip(positions, self.low, self.high)

    def reflected(self, positions: np.ndarray) -> np.ndarray:
        """Fold positions (..., 2) back at the edges, which keeps a symmetric step symmetric."""
        size = np.maximum(self.size, 1e-12)
        folded = np.mod(positions - self.low, 2.0 * size)
        return self.low + np.minimum(folded, 2.0 * size - folded)

    def grid(self, most: int) -> np.ndarray:
        """
        Return a regular grid of at most so many places: (M, 2).

        The cells that the places are the middles of are as square as can be.
        """
        size = np.maximum(self.size, 1e-9)
        across = max(1, min(most, int(np.sqrt(most * size[0] / size[1]))))
        counts = across, max(1, most // across)
        axes = [self.low[k] + (np.arange(counts[k]) + 0.5) * size[k] / counts[k] for k in (0, 1)]
        return np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 2)

    def placement(self, positions: np.ndarray) -> np.ndarray:
        """Return positions (n, 2) as a placement (n, 3) at the cameras' height."""
        return np.column_stack([positions, np.full(len(positions), self.height)])


def nothing_seen(number: int) -> np.ndarray:
    """Return the cloud of cameras that see nothing: (0, 3)."""
    return np.empty((0, 3), dtype=np.float32)


class Scores(NamedTuple):
    """
    What placements are worth.

    :ivar depth_error: (B,) metres; a planner minimises it.
    :ivar space_coverage: (B,) cubic metres.
    :ivar cloud: returns what the placement of a number sees, (M, 3) float32, metres, map frame;
        for the few planners that look rather than count.
    """

    depth_error: np.ndarray
    space_coverage: np.ndarray
    cloud: Callable[[int], np.ndarray] = nothing_seen


#: What a search hands out and gets back: positions (n, 2) each, and their scores.
Search = Generator[Sequence[np.ndarray], Scores, None]


class Planner(ABC):
    """
    A method that finds a placement of cameras.

    A method is a generator: it yields placements to be judged and receives their scores.

    :param space: where cameras may be.
    :param rng: the only source of chance.
    :param budget: how many evaluations there will be, for those methods that plan with it.
    """

    def __init__(self, space: Space, rng: np.random.Generator, budget: int) -> None:
        self.space, self.rng, self.budget = space, rng, budget
        self._search = self.search()
        self._batch: Sequence[np.ndarray] | None = next(self._search, None)

    @abstractmethod
    def search(self) -> Search:
        """Yield batches of positions (n, 2), each camera inside the space."""

    def energy(self, scores: Scores) -> np.ndarray:
        """Return what the method minimises: (B,), its answer is the placement of the least."""
        return scores.depth_error

    def ask(self) -> Sequence[np.ndarray] | None:
        """Return the placements to be judged next, positions (n, 2) each; None at the end."""
        return self._batch

    def tell(self, scores: Scores) -> None:
        """Receive what the placements of the last :meth:`ask` are worth."""
        try:
            self._batch = self._search.send(scores)
        except StopIteration:
            self._batch = None
