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

"""How long a search may go on: by the clock, by a count, or until somebody has had enough."""

from collections.abc import Callable
from threading import Event
import time

from ocp_ros.util.settings import check_positive, check_whole, ConfigurationError


class Budget:
    """
    The limit of a search, which threads may share; its clock runs from the beginning.

    :param seconds: the most time to take.
    :param evaluations: the most placements to judge; with it and without seconds the same seed
        finds the same answer.
    :param clock: tells the seconds.
    :raises ConfigurationError: if there is no limit, or one that is not above 0.
    """

    def __init__(self, seconds: float | None = None, evaluations: int | None = None,
                 clock: Callable[[], float] = time.monotonic) -> None:
        if seconds is None and evaluations is None:
            raise ConfigurationError(
                'budget: found no limit; expected seconds, evaluations or both')
        check_positive('seconds', seconds)
        check_whole('evaluations', evaluations)
        self.seconds, self.evaluations = seconds, evaluations
        self._clock, self._began = clock, clock()
        self._stopped = Event()

    def restarted(self, seconds: float | None = None) -> 'Budget':
        """
        Return a budget of the same limits that begins now; who stops one stops the other.

        :param seconds: the most time to take; as before unless given.
        """
        other = Budget(self.seconds if seconds is None else seconds, self.evaluations, self._clock)
        other._stopped = self._stopped
        return other

    @property
    def stopped(self) -> bool:
        """Return whether somebody has had enough."""
        return self._stopped.is_set()

    def stop(self) -> None:
        """End the search at its next step, from any thread or signal handler."""
        self._stopped.set()

    @property
    def elapsed(self) -> float:
        """Return the seconds since the beginning."""
        return self._clock() - self._began

    def share(self, evaluations: int, most: int | None) -> float:
        """
        Return how much of the budget is used up; from 1 on there is nothing left.

        :param evaluations: how many there were.
        :param most: how many there may be, for a part of the search; None for any number.
        """
        if self.stopped:
            return 1.0
        shares = [0.0]
        if self.seconds is not None:
            shares.append(self.elapsed / self.seconds)
        if most is not None:
            shares.append(evaluations / most)
        return max(shares)
