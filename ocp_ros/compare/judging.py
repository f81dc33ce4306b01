# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Who judges: what a placement delivers, on points that no search saw.

A search flatters itself twice: its engine calls points visible that are not, and it fits the
placement to the points that it has. So a placement in a generated room is judged by rays cast at
the room's mesh, on a separate scan. A scan of a real room has no mesh: half of its points are
held out of the search, and the engine judges on them.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np

from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.rig.motion import mounted
from ocp_ros.rig.rig_file import load_rig
from ocp_ros.scenes.scene import Scene
from ocp_ros.scenes.scene_source import make_room
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.simulation.truth import engine_of

#: Points that are searched with, and those of the scan that judges.
POINTS, JUDGED_POINTS = 60_000, 90_000
#: Metres that cameras are mounted off, and how many ways of being off are averaged.
MOUNTING, MOUNTINGS = 0.02, 8
#: Of the ways of being off; searches have others.
SEED = 0
#: The judge's depth maps: all points at once, as the depth error is defined. Rays to the cells of
#: a finer coverage grid would take as long as those to the points.
JUDGING = EngineConfig(preset='fine', error_rows=128, coverage_cell=0.5, error_folds=1)


class Judge:
    """
    Judge final placements.

    :param evaluate: returns depth error in metres and space coverage in cubic metres of a
        placement (K, 3) or (K, 6).
    """

    def __init__(self, evaluate: Callable[[np.ndarray], tuple[float, float]]) -> None:
        self._evaluate = evaluate

    def __call__(self, placement: np.ndarray) -> dict[str, float]:
        """
        Judge one placement.

        :param placement: (K, 3) or (K, 6), metres, map frame, and radians.
        :returns: ``exact``, metres, of the placement itself; ``depth_error``, metres, the mean of
            cameras that are mounted 2 cm off; ``space_coverage``, cubic metres.
        """
        error, coverage = self._evaluate(placement)
        off = [self._evaluate(moved)[0] for moved in mounted(placement, MOUNTING, MOUNTINGS, SEED)]
        return {'exact': error, 'depth_error': float(np.mean(off)), 'space_coverage': coverage}


class JudgedRoom:
    """
    A room as searches see it, and as the judge does.

    :param name: the seed of a generated room, or the path of a scan.
    :param rotation: degrees about the vertical axis.
    :param config: the rig, or a rig file, and the engine that searches.
    :param points: that searches see.
    :param judged_points: of the scan that judges a generated room; half of a scan are held out.
    :param scale: metres per unit of a scan.
    :param up: the axis of a scan that points up.
    :ivar scene: what searches see.
    :ivar judged: what the judge sees.
    """

    def __init__(self, name: str, rotation: float, config: SimulationConfig, points: int = POINTS,
                 judged_points: int = JUDGED_POINTS, scale: float = 1.0, up: str = 'z') -> None:
        self.config = config
        if name.isdecimal():
            self.scene = make_room(name, rotation, points)
            # Scanned again from the same tripods: other points.
            self.judged = make_room(name, rotation, judged_points)
        else:
            self.scene, self.judged = _halves(make_room(name, rotation, 2 * points, scale, up))
        self._judging = replace(config, engine=JUDGING)

    @cached_property
    def fine(self) -> Simulator:
        """Return the engine on all points that searches may see: it promises."""
        return Simulator(self.scene, self.config)

    @cached_property
    def simulator(self) -> Simulator:
        """Return the judge's engine: the truth, where it is known."""
        return engine_of(self.judged)(self.judged, self._judging)

    def truth(self) -> Simulator:
        """Return the truth on the points that searches see."""
        engine = replace(self.config.engine, coverage_cell=JUDGING.coverage_cell)
        return engine_of(self.scene)(self.scene, replace(self.config, engine=engine))

    def evaluate(self, placement: np.ndarray) -> tuple[float, float]:
        """Return what the judge says of a placement: metres and cubic metres."""
        result = self.simulator.evaluate(placement)
        return result.depth_error, result.space_coverage

    @cached_property
    def problem(self) -> Problem:
        """Return the rig file in the judge's room."""
        return Problem.of(self.judged, load_rig(self.config.rig_file), self._judging,
                          engine_of(self.judged))

    @cached_property
    def promising(self) -> Problem:
        """Return the rig file in the room and by the engine that it is searched with."""
        return Problem.of(self.scene, load_rig(self.config.rig_file), self.config)


@lru_cache(maxsize=2)
def judged_room(*settings) -> JudgedRoom:
    """Return a room, the same one where it is asked for again; see :class:`JudgedRoom`."""
    return JudgedRoom(*settings)


def _halves(scene: Scene) -> tuple[Scene, Scene]:
    """Split the points of a scan at random into what is searched and what judges."""
    held_out = np.random.default_rng(0).permutation(len(scene)) < len(scene) // 2
    return (Scene(scene.points[~held_out], scene.name), Scene(scene.points[held_out], scene.name))
