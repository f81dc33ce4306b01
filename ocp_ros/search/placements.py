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

"""Placements of a search: its result, and small moves of the cameras of a placement."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.online.step import Outcome
from ocp_ros.rig.feasible_region import FeasibleRegion
from ocp_ros.rig.placement_file import as_written
from ocp_ros.search.candidate_pool import are_spaced, MountedCamera, Sites, views_of
from ocp_ros.search.proof.certificate import Certificate
from ocp_ros.simulation.objective import Objective
from ocp_ros.simulation.problem import Problem

#: Number of poses drawn for a move; the first feasible pose is used.
DRAWN_POSES = 4
#: Share of the moves that draw a new roll, if the mount allows several.
ROLL_SHARE = 0.2


@dataclass(frozen=True)
class SearchResult:
    """
    The best placement of a search.

    :ivar sites: the mounted cameras, in the rig's order.
    :ivar loss: objective value; less is better.
    :ivar losses: objective values of the results of all searches.
    :ivar evaluations: number of proposed placements, infeasible ones included.
    :ivar certificate: lower bound and optimality gap, if the search proved them; otherwise None.
    :ivar uncertain: reason why a tried proof gave no certificate; otherwise empty.
    :ivar outcome: of an online planner's episode.
    """

    sites: Sites
    loss: float
    losses: tuple[float, ...]
    evaluations: int
    certificate: Certificate | None = None
    uncertain: str = ''
    outcome: Outcome | None = None

    @property
    def poses(self) -> np.ndarray:
        """Return the poses (K, 6), metres, map frame, and radians, rounded as in files."""
        return np.array([site.pose for site in self.sites])


def result_of_placement(objective: Objective, sites: Sequence[MountedCamera], evaluations: int
                        ) -> SearchResult:
    """Return a placement as the result of a single search."""
    loss = objective.loss(views_of(sites))
    return SearchResult(tuple(sites), loss, (loss,), evaluations)


def move_camera(problem: Problem, sites: Sites, metres: float, radians: float,
                rng: np.random.Generator) -> list[Sites]:
    """
    Move and rotate one random camera of a placement.

    :param metres: standard deviation of the move along each axis.
    :param radians: standard deviation of yaw and pitch.
    :returns: the changed sites; an empty list if no drawn pose is feasible.
    """
    camera = int(rng.integers(len(sites)))
    others = (*sites[:camera], *sites[camera + 1:])
    model = problem.rig.cameras[camera].model
    poses = poses_around(problem.region, sites[camera].pose, model, metres, radians,
                         DRAWN_POSES, rng)
    feasible = problem.region.allowed(poses, model) & are_spaced(
        poses, others, problem.rig.spacing)
    if not feasible.any():
        return []
    # The first feasible pose.
    pose = poses[int(np.argmax(feasible))]
    site = MountedCamera(pose, problem.simulator.look(pose, camera))
    return [(*sites[:camera], site, *sites[camera + 1:])]


def poses_around(region: FeasibleRegion, pose: np.ndarray, model: CameraModel, metres: float,
                 radians: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """
    Draw poses on the mount near a pose, feasible or not, rounded as in files.

    :param region: feasible region of the rig's cameras.
    :param pose: (6,) metres, map frame, and radians.
    :param model: the camera model; omnidirectional cameras keep their heading.
    :param metres: standard deviation of the position along each axis.
    :param radians: standard deviation of yaw and pitch.
    :param count: M, number of poses.
    :returns: (M, 6) metres and radians.
    """
    poses = np.repeat(pose[None], count, axis=0)
    poses[:, :3] += rng.normal(0.0, metres, (count, 3))
    poses[:, :3] = region.onto_mount(poses[:, :3])
    if not model.omnidirectional:
        poses[:, 3:5] += rng.normal(0.0, radians, (count, 2))
        poses[:, 4] = np.clip(poses[:, 4], *region.rig.pitch)
        if len(rolls := region.rig.rolls) > 1:
            rerolled = rng.random(count) < ROLL_SHARE
            poses[rerolled, 5] = rng.choice(rolls, np.count_nonzero(rerolled))
    return as_written(poses)
