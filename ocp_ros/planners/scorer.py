# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scores of placements, where a camera that stands where one stood before costs no look."""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ocp_ros.planners.planner import Scores
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.simulation.simulator import Simulator, View

#: Bytes of views that are kept: 16,000 of them in a room of 25,000 points.
REMEMBERED = 64_000_000
#: Metres between the places of a lattice.
LATTICE = 0.25


class Scorer:
    """
    Judge placements by the engine.

    :param simulator: the engine for a scene.
    :param threads: how many to use for a batch.
    """

    def __init__(self, simulator: Simulator, threads: int = 1) -> None:
        self.simulator = simulator
        self._views: OrderedDict[tuple[int, bytes], View] = OrderedDict()
        nothing = simulator.nothing().bits.nbytes + len(simulator.grid) // 8
        self._most = max(REMEMBERED // nothing, 64)
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None

    def __call__(self, placements: Sequence[np.ndarray]) -> Scores:
        """
        Judge placements.

        :param placements: B placements of the simulator, (n, 3) or (n, 6), n >= 0.
        """
        wanted = {self._key(camera, pose): pose
                  for placement in placements for camera, pose in enumerate(placement)}
        views = {}
        for key in list(wanted):
            if key in self._views:
                self._views.move_to_end(key)
                views[key] = self._views[key]
                del wanted[key]
        looks = self._map(lambda item: self.simulator.look(item[1], item[0][0]),
                          list(wanted.items()))
        views.update(zip(wanted, looks))
        self._views.update((key, views[key]) for key in wanted)
        while len(self._views) > self._most:
            self._views.popitem(last=False)

        def views_of(placement: np.ndarray) -> list[View]:
            return [views[self._key(camera, pose)] for camera, pose in enumerate(placement)]

        def judge(placement: np.ndarray) -> tuple[float, float]:
            if len(placement) == 0:
                return self.simulator.depth_error.worst, 0.0
            result = self.simulator.judge(views_of(placement))
            return result.depth_error, result.space_coverage

        errors, coverage = np.array(self._map(judge, placements)).reshape(-1, 2).T
        return Scores(errors, coverage)

    def _key(self, camera: int, pose: np.ndarray) -> tuple[int, bytes]:
        """Return what a view is remembered by."""
        # Where cameras are alike, who stands where makes no difference.
        return self.simulator.kind(camera), pose.tobytes()

    def _map(self, function, items: Sequence) -> list:
        """Apply a function to all items, in threads where there are several of both."""
        if self._pool is None or len(items) < 2:
            return [function(item) for item in items]
        return list(self._pool.map(function, items))


class LatticeScorer:
    """
    Judge placements as if each camera stood at the place of a lattice that is nearest to it.

    A room has some hundred such places. Each is looked from once, whatever a search asks.

    :param score: judges placements (n, 3).
    :param space: where cameras may be.
    """

    def __init__(self, score: Callable[[Sequence[np.ndarray]], Scores], space: FreePlane) -> None:
        self._score, self._space = score, space

    def __call__(self, placements: Sequence[np.ndarray]) -> Scores:
        """Judge B placements (n, 3)."""
        return self._score([self._space.placement(self.snapped(placement[:, :2]))
                            for placement in placements])

    def snapped(self, positions: np.ndarray) -> np.ndarray:
        """Move positions (n, 2) to places of the lattice, or near them where no camera may be."""
        return self._space.inside((np.floor(positions / LATTICE) + 0.5) * LATTICE)
