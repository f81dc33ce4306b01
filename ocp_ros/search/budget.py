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
Budget of a search: a time, a number of evaluations, or until it is stopped.

Searches run in threads, which end when it is stopped.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from threading import Event
import time
from typing import TypeVar

from ocp_ros.util.settings import check_positive, check_whole, ConfigurationError

T = TypeVar('T')

#: Receives the used share of the budget and the smallest loss so far; its result is ignored.
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
        self.seconds = seconds
        self.evaluations = evaluations
        self._clock = clock
        self._start_time = clock()
        self._stopped = Event()

    def restarted(self, seconds: float | None = None) -> 'Budget':
        """
        Return a budget that starts now; stopping either of the two budgets stops both.

        :param seconds: largest time; None for that of this budget. The other limit is the same.
        """
        copy = Budget(self.seconds if seconds is None else seconds, self.evaluations, self._clock)
        copy._stopped = self._stopped
        return copy

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
        return self._clock() - self._start_time

    def deadline_check(self, share: float) -> Callable[[], bool]:
        """Return a function that returns whether a share of the time is used, or it is stopped."""
        return lambda: self.used_share(0, None) >= share

    def used_share(self, evaluations: int, max_evaluations: int | None) -> float:
        """
        Return the used share of the budget; at 1 or more the budget is used up.

        :param evaluations: number of evaluations so far.
        :param max_evaluations: limit of their number, which may be a part of :attr:`evaluations`
            if several searches share the budget; None if the time alone counts.
        """
        if self.stopped:
            return 1.0
        shares = [0.0]
        if self.seconds is not None:
            shares.append(self.elapsed / self.seconds)
        if max_evaluations is not None:
            shares.append(evaluations / max_evaluations)
        return max(shares)


def run_threads(tasks: Sequence[Callable[[], T]], budget: Budget,
                report: Callable[[], None] | None) -> list[T]:
    """
    Run each task in a thread, report several times a second, and return the tasks' results.

    :param budget: of the tasks; it is stopped if a report fails or is interrupted.
    :param report: called with no arguments, for its effect; None for no reports.
    """
    report_interval_s = 0.2
    with ThreadPoolExecutor(len(tasks)) as workers:
        runs = [workers.submit(task) for task in tasks]
        try:
            while wait(runs, report_interval_s).not_done:
                if report is not None:
                    report()
        except BaseException:
            budget.stop()
            raise
    return [run.result() for run in runs]
