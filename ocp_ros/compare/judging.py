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
The judge: evaluate a placement on points that were not used in the search.

The scores of a search are too good for two reasons: its engine reports some occluded points as
visible, and the placement is fitted to the points of the search. So a placement in a generated
room is evaluated on a separate scan, by rays cast at the room's mesh. A scan of a real room has no
mesh: half of its points are held out of the search, and the engine evaluates on this half.
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

#: Number of points of the judge's scan.
JUDGED_POINTS = 90_000
#: Number of points of the search's scan.
POINTS = 60_000
#: Number of sets of mounting errors that are averaged.
MOUNTING_DRAWS = 8
#: Horizontal displacement of each camera by a mounting error, metres.
MOUNTING_ERROR_M = 0.02
#: Random seed of the mounting errors; searches use another seed.
MOUNTING_SEED = 0
#: Engine of the judge: depth maps of all points at once, as the depth error is defined. With a
#: finer coverage grid, rays to its cells would take as long as rays to the points.
JUDGE_ENGINE = EngineConfig(preset='fine', error_rows=128, coverage_cell=0.5, error_folds=1)


def score_of(problem: Problem, placement: np.ndarray) -> tuple[float, float]:
    """
    Return the error of a placement in metres, and its space coverage in cubic metres.

    With a rig file the error is the objective value times the depth error of seeing nothing. This
    is the depth error if the rig has no other requirements.
    """
    result = problem.judge(problem.look(placement))
    return problem.error(result), result.space_coverage


class JudgedRoom:
    """
    A room with one scan for searches and one for the judge.

    :param name: the seed of a generated room, or the path of a scan.
    :param rotation: degrees about the vertical axis.
    :param config: the rig, or a rig file, and the engine of the search.
    :param points: number of points for searches.
    :param judged_points: number of points for the judge in a generated room; of a scan, half of
        the points are held out for the judge.
    :param scale: metres per unit of a scan.
    :param up: the axis of a scan that points up.
    :param half: random seed that selects the half of a scan for searches.
    :ivar scene: the scan for searches.
    :ivar judged: the scan for the judge.
    """

    def __init__(self, name: str, rotation: float, config: SimulationConfig, points: int = POINTS,
                 judged_points: int = JUDGED_POINTS, scale: float = 0.0, up: str = BY_FILE,
                 half: int = 0) -> None:
        self.config = config
        if name.isdecimal():
            self.scene = make_room(name, rotation, points)
            # A second scan from the same tripods has other points.
            self.judged = make_room(name, rotation, judged_points)
        else:
            self.scene, self.judged = _halves(
                make_room(name, rotation, 2 * points, scale=scale, up=up), half)

    @cached_property
    def promising(self) -> Problem:
        """Return the problem of the search, with its scan and the engine of promised errors."""
        return make_problem(self.scene, self.config)

    @cached_property
    def problem(self) -> Problem:
        """Return the problem of the judge: its scan, with ray casting if there is a mesh."""
        return make_problem(self.judged, replace(
            self.config, engine=with_rays(JUDGE_ENGINE, self.judged)))

    @property
    def fine(self) -> Simulator:
        """Return the engine on the scan for searches."""
        return self.promising.simulator

    def truth(self) -> Simulator:
        """Return a simulator on the scan for searches, with ray casting if there is a mesh."""
        engine = replace(self.config.engine, coverage_cell=JUDGE_ENGINE.coverage_cell)
        return Simulator(self.scene, replace(self.config, engine=with_rays(engine, self.scene)))

    def judge(self, placement: np.ndarray) -> dict[str, float]:
        """
        Evaluate a final placement.

        :param placement: (K, 3) or (K, 6), metres, map frame, and radians.
        :returns: ``exact``, metres, of the placement itself; ``depth_error``, metres, the mean
            over mounting errors of 2 cm; ``space_coverage``, cubic metres.
        """
        error, coverage = score_of(self.problem, placement)
        off = [score_of(self.problem, moved)[0]
               for moved in mounted(placement, MOUNTING_ERROR_M, MOUNTING_DRAWS, MOUNTING_SEED)]
        return {'exact': error, 'depth_error': float(np.mean(off)), 'space_coverage': coverage}


@lru_cache(maxsize=2)
def judged_room(*settings) -> JudgedRoom:
    """Return a room; the last two rooms are cached; see :class:`JudgedRoom`."""
    return JudgedRoom(*settings)


def _halves(scene: Scene, half: int) -> tuple[Scene, Scene]:
    """Split the points of a scan at random into a half for the search and one for the judge."""
    held_out = np.random.default_rng(half).permutation(len(scene)) < len(scene) // 2
    return (Scene(scene.points[~held_out], scene.name), Scene(scene.points[held_out], scene.name))
