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
from ocp_ros.rig.motion import mounted, MountingErrors
from ocp_ros.rooms.scene_source import make_room
from ocp_ros.scenes.scene import Scene
from ocp_ros.scenes.source_frame import BY_FILE
from ocp_ros.simulation.problem import make_problem, Problem
from ocp_ros.simulation.ray_visibility import with_rays
from ocp_ros.simulation.simulation_config import SimulationConfig

#: Number of points of the scans for the judge and for searches.
JUDGE_POINTS = 90_000
SEARCH_POINTS = 60_000
#: Mounting errors that are averaged; searches use another seed.
MOUNTING_ERRORS = MountingErrors(0.02, count=8, seed=0)
#: Engine of the judge. As the depth error is defined, its depth maps have all points (one fold).
#: With a finer coverage grid, rays to its cells would take as long as rays to the points.
JUDGE_ENGINE = EngineConfig(preset='fine', error_rows=128, coverage_cell=0.5, error_folds=1)


def error_and_coverage(problem: Problem, placement: np.ndarray) -> tuple[float, float]:
    """
    Return the error of a placement in metres, and its space coverage in cubic metres.

    The error is the objective value times the depth error of seeing nothing. This is the depth
    error if the rig has no other requirements.

    :param placement: (K, 3) or (K, 6), metres, map frame, and radians.
    """
    evaluation = problem.evaluate_views(problem.look(placement))
    return problem.error(evaluation), evaluation.space_coverage


class JudgedRoom:
    """
    A room with one scan for searches and one for the judge.

    :param name: the seed of a generated room or the path of a scan, as text.
    :param rotation: degrees about the vertical axis.
    :param config: the rig, or a rig file, and the engine of the search.
    :param search_points: number of points for searches; a scan is split into two halves of this
        number, one for searches and one for the judge.
    :param judge_points: number of points for the judge in a generated room.
    :param scale: metres per unit of a scan; 0 for the unit in the file.
    :param up: the axis of a scan that points up.
    :param half: random seed that selects the half of a scan for searches.
    :ivar search_scene: the scan for searches.
    :ivar judge_scene: the scan for the judge.
    """

    def __init__(self, name: str, rotation: float, config: SimulationConfig,
                 search_points: int = SEARCH_POINTS, judge_points: int = JUDGE_POINTS,
                 scale: float = 0.0, up: str = BY_FILE, half: int = 0) -> None:
        self.config = config
        if name.isdecimal():
            self.search_scene = make_room(name, rotation, search_points)
            # A second scan from the same tripods. Its points are others because their number is
            # another: the random numbers of both scans begin with the same seed.
            self.judge_scene = make_room(name, rotation, judge_points)
        else:
            self.search_scene, self.judge_scene = _split_scan(
                make_room(name, rotation, 2 * search_points, scale=scale, up=up), half)

    @cached_property
    def search_problem(self) -> Problem:
        """Return the problem of a search: its scan, with the engine that computes its scores."""
        return make_problem(self.search_scene, self.config)

    @cached_property
    def judge_problem(self) -> Problem:
        """Return the problem of the judge: its scan, with ray casting if there is a mesh."""
        return make_problem(self.judge_scene, replace(
            self.config, engine=with_rays(JUDGE_ENGINE, self.judge_scene)))

    @cached_property
    def ray_problem(self) -> Problem:
        """Return the problem of a search with ray casting, if there is a mesh."""
        # The coverage grid is as coarse as that of the judge, because rays to its cells take time.
        engine = replace(self.config.engine, coverage_cell=JUDGE_ENGINE.coverage_cell)
        return make_problem(self.search_scene, replace(
            self.config, engine=with_rays(engine, self.search_scene)))

    def promised_error(self, placement: np.ndarray) -> float:
        """Return the error, metres, of a placement (K, 3) or (K, 6) by the search's engine."""
        return error_and_coverage(self.search_problem, placement)[0]

    def judge(self, placement: np.ndarray) -> dict[str, float]:
        """
        Evaluate a final placement.

        :param placement: (K, 3) or (K, 6), metres, map frame, and radians.
        :returns: ``exact``, the error of the placement itself, metres; ``depth_error``, the mean
            error over mounting errors of 2 cm, metres; ``space_coverage``, cubic metres.
        """
        error, coverage = error_and_coverage(self.judge_problem, placement)
        errors = [error_and_coverage(self.judge_problem, moved)[0]
                  for moved in mounted(placement, MOUNTING_ERRORS)]
        return {'exact': error, 'depth_error': float(np.mean(errors)), 'space_coverage': coverage}


@lru_cache(maxsize=2)
def judged_room(*settings) -> JudgedRoom:
    """Return a room, given the arguments of :class:`JudgedRoom`; cache the last two rooms."""
    return JudgedRoom(*settings)


def _split_scan(scene: Scene, seed: int) -> tuple[Scene, Scene]:
    """Split the points of a scan at random into a half for searches and a half for the judge."""
    held_out = np.random.default_rng(seed).permutation(len(scene)) < len(scene) // 2
    return (Scene(scene.points[~held_out], scene.name), Scene(scene.points[held_out], scene.name))
