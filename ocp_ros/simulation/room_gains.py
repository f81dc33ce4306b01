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
Gains of placements in each room of a floor, and the goal to reach a share of them in each room.

As the loss, a gain counts what enough cameras see; it never falls with one more camera.
"""

from collections.abc import Callable, Sequence
from copy import copy
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.depth_error import DepthError
from ocp_ros.geometry.packed_bits import count_bits, pack
from ocp_ros.simulation.simulator import Simulator, View

#: Another set of viewpoints changes a share of the error reduction by about this.
VIEWPOINT_TOLERANCE = 0.005


class RoomGoal(NamedTuple):
    """
    The goal to reach in each room a share of what is possible there.

    :ivar by: the quantity: ``error`` (reduction of the depth error), ``seen`` (points) or
        ``coverage`` (cells of the space coverage).
    :ivar targets: (R,) the share that a search has to reach in each room, from 0 to 1.
    :ivar union: the views that gain as much as possible, one for each camera of a rig.
    """

    by: str
    targets: np.ndarray
    union: Sequence[View]


def shares_of(gains: np.ndarray, possible: np.ndarray) -> np.ndarray:
    """Return gains (R,) as shares of what is possible (R,); 1 where nothing is."""
    return np.divide(gains, possible, out=np.ones(len(gains)), where=possible > 0.0)


class RoomGains:
    """
    Compute what seen points and cells gain in each of the R rooms of a floor.

    :param simulator: the engine of a scene with rooms.
    :param by: see :class:`RoomGoal`.
    """

    def __init__(self, simulator: Simulator, by: str) -> None:
        rooms = simulator.scene.rooms
        self._numbers = range(1, rooms.count + 1)
        #: By room: its part of the depth error, or packed bits of its points or cells.
        self._errors: dict[int, DepthError] = {}
        self._bits: dict[int, np.ndarray] = {}
        self._is_seen = by == 'seen'
        #: By room: the error of given points and further ones, metres.
        self._error_of: dict[int, Callable[..., float]] = {}
        if by == 'error':
            # A room without air has no viewpoints.
            self._error_of = self._errors = simulator.depth_error.parts(
                rooms.at(simulator.depth_error.viewpoints))
        else:
            room_of = rooms.at(simulator.scene.points[simulator.visibility.order]) if (
                self._is_seen) else rooms.at(simulator.places) * simulator.is_grid
            self._bits = {number: pack(room_of == number) for number in self._numbers}

    def given(self, seen: np.ndarray) -> 'RoomGains':
        """Return the same, faster for points that include given ones, as packed bits (W,)."""
        other = copy(self)
        other._error_of = {number: error.given(seen) for number, error in self._errors.items()}
        return other

    def __call__(self, seen: np.ndarray, covered: np.ndarray) -> np.ndarray:
        """
        Return the gain in each room: (R,) metres, or numbers of points or cells.

        :param seen: packed bits of the points that count as seen.
        :param covered: packed bits of the cells that count as covered.
        """
        return np.array([self.of_room(number, seen, covered) for number in self._numbers])

    def of_room(self, number: int, seen: np.ndarray, covered: np.ndarray) -> float:
        """Return the gain in the room of a number; see :meth:`__call__`."""
        if number in self._bits:
            return float(count_bits(self._bits[number] & (seen if self._is_seen else covered)))
        if number in self._errors:
            return self._errors[number].worst - self._error_of[number](seen)
        return 0.0
