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

"""Budget of a search: a time, a number of evaluations, or until it is stopped."""

from collections.abc import Callable
from threading import Event
import time

from ocp_ros.util.settings import check_positive, check_whole, ConfigurationError

#: Gets the used share of the budget and the smallest loss so far.
Progress = Callable[[float, float], None]


class Budget:
    """
    The limit of a search; threads may share it, and its clock starts at its creation.

    :param seconds: largest time; None for no limit.
    :param evaluations: largest number of placements to evaluate; None for no limit. With it and
        without ``seconds``, the same seed gives the same result.
    :param clock: returns the current time, seconds.
    :raises ConfigurationError: if there is no limit, or a limit is not above 0.
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
        Return a budget with the same limits that starts now; stopping one stops the other too.

        :param seconds: largest time; None for the same as before.
        """
        other = Budget(self.seconds if seconds is None else seconds, self.evaluations, self._clock)
        other._stopped = self._stopped
        return other

    @property
    def stopped(self) -> bool:
        """Return whether :meth:`stop` was called."""
        return self._stopped.is_set()

    def stop(self) -> None:
        """End the search at its next step, from any thread or signal handler."""
        self._stopped.set()

    @property
    def elapsed(self) -> float:
        """Return the seconds since the budget was created."""
        return self._clock() - self._began

    def share(self, evaluations: int, most: int | None) -> float:
        """
        Return the used share of the budget; at 1 or more it is used up.

        :param evaluations: number of evaluations so far.
        :param most: largest number of evaluations of this part of the search; None for any number.
        """
        if self.stopped:
            return 1.0
        shares = [0.0]
        if self.seconds is not None:
            shares.append(self.elapsed / self.seconds)
        if most is not None:
            shares.append(evaluations / most)
        return max(shares)
