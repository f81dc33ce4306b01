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
Convert positions on a plane to feasible poses of a rig's cameras.

Most planners choose the horizontal position of a camera alone. The decoder chooses a feasible pose
at this position, or near it, with the height of the mount and the heading of the best score.
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from ocp_ros.rig.placement_file import as_written
from ocp_ros.search.candidate_pool import (
    best_addition,
    keeps_spacing,
    MountedCamera,
    packed,
    Pool,
    quick_of,
)
from ocp_ros.search.scorer import remembered_looks
from ocp_ros.simulation.problem import Problem

#: Number of candidates near a position whose heights and headings are compared.
NEAREST = 24


class Decoder:
    """
    Choose feasible poses for the cameras of a rig at given positions, or near them.

    Camera k of the rig gets row k. The candidates of its model that satisfy the spacing and are
    nearest to the position are compared by the objective. The best one gives height and heading.
    With these, or with the desired heading, the camera is mounted at the position itself if that
    is feasible, otherwise at the candidate. If no candidate satisfies the spacing, all cameras are
    packed close together. So every result satisfies all constraints.

    :param problem: the rig in the room.
    :param pool: candidates of all its models.
    """

    def __init__(self, problem: Problem, pool: Pool) -> None:
        self.pool, self.objective, self.region = pool, problem.objective, problem.region
        self.rig, self._quick = problem.rig, quick_of(problem.objective)
        self._look = remembered_looks(problem.simulator)

    def __call__(self, positions: np.ndarray, headings: np.ndarray | None = None
                 ) -> tuple[MountedCamera, ...]:
        """
        Choose a feasible pose for each position.

        :param positions: (n, 2) metres, n at most the number of cameras to place; (n, 3) with
            desired heights.
        :param headings: (n, 3) desired yaw, pitch and roll in radians; None for the best ones.
        :returns: n sites that satisfy all constraints together.
        """
        sites: list[MountedCamera] = []
        for number, place in enumerate(positions):
            site = self._near(place, sites, None if headings is None else headings[number])
            if site is None:
                return self._packed[:len(positions)]
            sites.append(site)
        return tuple(sites)

    def completed(self, sites: Sequence[MountedCamera]) -> tuple[MountedCamera, ...]:
        """Add the missing cameras of the rig greedily."""
        sites = list(sites)
        while len(sites) < len(self.rig.cameras):
            more = best_addition(self.objective, self.pool, sites)
            if more is None:
                return self._packed
            sites.append(more)
        return tuple(sites)

    @cached_property
    def _packed(self) -> tuple[MountedCamera, ...]:
        """Return all cameras, as close together as the spacing allows."""
        return tuple(packed(self.rig, self.pool))

    def _near(self, place: np.ndarray, sites: Sequence[MountedCamera], heading: np.ndarray | None
              ) -> MountedCamera | None:
        """Mount the next camera near a place (2,) or (3,); None if no candidate is feasible."""
        model = self.rig.cameras[len(sites)].model
        poses = self.pool.kind(model).poses
        far = self.pool.left(self.rig, sites)
        away = np.linalg.norm(poses[far, :2] - place[:2], axis=1)
        near = far[np.argsort(away, kind='stable')[:self._count(len(sites))]]
        site = best_addition(self._quick, self.pool, sites, near)
        if site is None:
            return None
        asked = site.pose.copy()
        asked[:len(place)] = place
        if heading is not None:
            asked[3:] = heading
        found = self._there(asked, sites)
        if found is None and heading is not None:
            found = self._there(np.concatenate([place[:2], site.pose[2:]]), sites)
        return found or site

    def _count(self, camera: int) -> int:
        """Return the number of candidates to compare: 1 if they differ in position alone."""
        on, heights, _ = self.rig.mount
        level = on in ('plane', 'ceiling')
        return 1 if level and self.rig.cameras[camera].model.omnidirectional else NEAREST

    def _there(self, pose: np.ndarray, sites: Sequence[MountedCamera]) -> MountedCamera | None:
        """Mount the next camera at a pose (6,), at the mount's height; None if infeasible."""
        camera, pose = len(sites), pose.copy()
        pose[:3] = self.region.onto_mount(pose[None, :3])[0]
        poses = as_written(pose[None])
        model = self.rig.cameras[camera].model
        spaced = keeps_spacing(poses, sites, self.rig.spacing)
        if not (spaced & self.region.allowed(poses, model))[0]:
            return None
        return MountedCamera(poses[0], self._look(poses[0], camera))
