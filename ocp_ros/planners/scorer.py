# SPDX-License-Identifier: Apache-2.0
"""Scores of placements, where a camera that stands where one stood before costs no look."""

from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ocp_ros.planners.planner import Scores
from ocp_ros.simulation.simulator import Simulator, View

#: Views that are kept: a few kilobytes each.
REMEMBERED = 4096


class Scorer:
    """
    Judge placements by the engine.

    :param simulator: the engine for a scene.
    :param threads: how many to use for a batch.
    """

    def __init__(self, simulator: Simulator, threads: int = 1) -> None:
        self.simulator = simulator
        self._views: OrderedDict[bytes, View] = OrderedDict()
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None

    def __call__(self, placements: Sequence[np.ndarray]) -> Scores:
        """
        Judge placements.

        :param placements: B placements of the simulator, (n, 3) or (n, 6), n >= 0.
        """
        wanted = {pose.tobytes(): pose for placement in placements for pose in placement}
        views = {}
        for key in list(wanted):
            if key in self._views:
                self._views.move_to_end(key)
                views[key] = self._views[key]
                del wanted[key]
        views.update(zip(wanted, self._map(self.simulator.look, list(wanted.values()))))
        self._views.update((key, views[key]) for key in wanted)
        while len(self._views) > REMEMBERED:
            self._views.popitem(last=False)

        def judge(placement: np.ndarray) -> tuple[float, float]:
            if len(placement) == 0:
                return self.simulator.depth_error.worst, 0.0
            result = self.simulator.judge([views[pose.tobytes()] for pose in placement])
            return result.depth_error, result.space_coverage

        return Scores(*np.array(self._map(judge, placements)).reshape(-1, 2).T)

    def _map(self, function, items: Sequence) -> list:
        """Apply a function to all items, in threads where there are several of both."""
        if self._pool is None or len(items) < 2:
            return [function(item) for item in items]
        return list(self._pool.map(function, items))
