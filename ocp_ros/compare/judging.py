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
Who judges: what a placement delivers, on points that no search saw.

A search flatters itself twice: its engine calls points visible that are not, and it fits the
placement to the points that it has. So a placement in a generated room is judged by rays cast at
the room's mesh, on a separate scan. A scan of a real room has no mesh: half of its points are
held out of the search, and the engine judges on them.
"""

from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.rig.motion import mounted
from ocp_ros.rooms.scene_source import make_room
from ocp_ros.scenes.scene import Scene
from ocp_ros.scenes.up_axis import BY_FILE
from ocp_ros.simulation.problem import make_problem, Problem
from ocp_ros.simulation.ray_visibility import with_rays
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator

#: Points that are searched with, and those of the scan that judges.
POINTS, JUDGED_POINTS = 60_000, 90_000
#: Metres that cameras are mounted off, and how many ways of being off are averaged.
MOUNTING, MOUNTINGS = 0.02, 8
#: Of the ways of being off; searches have others.
SEED = 0
#: The judge's depth maps: all points at once, as the depth error is defined. Rays to the cells of
#: a finer coverage grid would take as long as those to the points.
JUDGING = EngineConfig(preset='fine', error_rows=128, coverage_cell=0.5, error_folds=1)


def worth_of(problem: Problem, placement: np.ndarray) -> tuple[float, float]:
    """
    Return the error of a placement in metres, and its space coverage in cubic metres.

    The error of a rig file is objective x depth error of seeing nothing: where the rig asks for
    nothing more, the depth error.
    """
    result = problem.judge(problem.look(placement))
    return problem.error(result), result.space_coverage


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
    :param half: seed of the random half of a scan that searches see.
    :ivar scene: what searches see.
    :ivar judged: what the judge sees.
    """

    def __init__(self, name: str, rotation: float, config: SimulationConfig, points: int = POINTS,
                 judged_points: int = JUDGED_POINTS, scale: float = 0.0, up: str = BY_FILE,
                 half: int = 0) -> None:
        self.config = config
        if name.isdecimal():
            self.scene = make_room(name, rotation, points)
            # Scanned again from the same tripods: other points.
            self.judged = make_room(name, rotation, judged_points)
        else:
            self.scene, self.judged = _halves(
                make_room(name, rotation, 2 * points, scale=scale, up=up), half)

    @cached_property
    def promising(self) -> Problem:
        """Return the rig in the room and by the engine that it is searched with: it promises."""
        return make_problem(self.scene, self.config)

    @cached_property
    def problem(self) -> Problem:
        """Return the rig in the judge's room, by the truth where it is known."""
        return make_problem(self.judged, replace(
            self.config, engine=with_rays(JUDGING, self.judged)))

    @property
    def fine(self) -> Simulator:
        """Return the engine on all points that searches may see."""
        return self.promising.simulator

    def truth(self) -> Simulator:
        """Return the truth on the points that searches see."""
        engine = replace(self.config.engine, coverage_cell=JUDGING.coverage_cell)
        return Simulator(self.scene, replace(self.config, engine=with_rays(engine, self.scene)))

    def judge(self, placement: np.ndarray) -> dict[str, float]:
        """
        Judge a final placement.

        :param placement: (K, 3) or (K, 6), metres, map frame, and radians.
        :returns: ``exact``, metres, of the placement itself; ``depth_error``, metres, the mean of
            cameras that are mounted 2 cm off; ``space_coverage``, cubic metres.
        """
        error, coverage = worth_of(self.problem, placement)
        off = [worth_of(self.problem, moved)[0]
               for moved in mounted(placement, MOUNTING, MOUNTINGS, SEED)]
        return {'exact': error, 'depth_error': float(np.mean(off)), 'space_coverage': coverage}


@lru_cache(maxsize=2)
def judged_room(*settings) -> JudgedRoom:
    """Return a room, the same one where it is asked for again; see :class:`JudgedRoom`."""
    return JudgedRoom(*settings)


def _halves(scene: Scene, half: int) -> tuple[Scene, Scene]:
    """Split the points of a scan at random into what is searched and what judges."""
    held_out = np.random.default_rng(half).permutation(len(scene)) < len(scene) // 2
    return (Scene(scene.points[~held_out], scene.name), Scene(scene.points[held_out], scene.name))
