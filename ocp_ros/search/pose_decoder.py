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

Most planners choose only the horizontal position of a camera. The decoder chooses a feasible pose
at this position, or near it, with the height and the heading of the best score.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np
from ocp_ros.rig.placement_file import as_written
from ocp_ros.search.candidate_pool import (
    are_spaced,
    CandidatePool,
    MountedCamera,
    Sites,
    views_of,
)
from ocp_ros.simulation.objective import Objective
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulator import Simulator, View


def coarse_objective(objective: Objective) -> Objective:
    """Return the same objective with smaller depth maps; it accepts the same views."""
    simulator = objective.simulator
    # Depth maps of 32 rows rank placements nearly the same in less time.
    engine = replace(simulator.config.engine, error_rows=32)
    config = replace(simulator.config, engine=engine)
    return Objective(Simulator(simulator.scene, config, simulator.models), objective.rig,
                     objective.room_goal)


def _cached_look(simulator: Simulator) -> Callable[[np.ndarray, int], View]:
    """Return the engine's ``look`` with a cache of views, as a function of pose and camera."""
    # About 16,000 views in a room of 25,000 points; in any room, at least 64 views are cached.
    cache_bytes = 64_000_000
    # A view has a bit for each point and for each cell of the coverage grid.
    bytes_per_view = simulator.nothing().bits.nbytes + len(simulator.grid) // 8

    # The pose is given as bytes, because a cache needs hashable arguments. A kind of camera is the
    # number of its first camera, so the engine accepts it as a camera.
    @lru_cache(max(cache_bytes // bytes_per_view, 64))
    def look(kind: int, pose: bytes) -> View:
        return simulator.look(np.frombuffer(pose), kind)

    # Cameras of the same kind share the cached views.
    return lambda pose, camera: look(
        simulator.kind(camera), np.asarray(pose, dtype=np.float64).tobytes())


class Decoder:
    """
    Choose feasible poses for the cameras of a rig at given positions, or near them.

    Camera k of the rig gets position k. The candidates of its model that satisfy the spacing and
    are nearest to the position are compared by the objective; the best candidate gives height and
    heading, unless the caller desires others. The camera is mounted at the position itself if this
    is feasible, otherwise at the best candidate. If no candidate satisfies the spacing, all
    cameras are packed close together. So every result satisfies all constraints.

    :param problem: the rig in the room.
    :param pool: candidates of all its models.
    """

    def __init__(self, problem: Problem, pool: CandidatePool) -> None:
        self.pool = pool
        self.objective = problem.objective
        self.region = problem.region
        self.rig = problem.rig
        self._coarse_objective = coarse_objective(problem.objective)
        self._look = _cached_look(problem.simulator)

    def __call__(self, positions: np.ndarray, headings: np.ndarray | None = None) -> Sites:
        """
        Choose a feasible pose for each position.

        :param positions: (n, 2) metres, n at most the number of cameras to place; (n, 3) with
            desired heights.
        :param headings: (n, 3) desired yaw, pitch and roll in radians; None for the best ones.
        :returns: n sites that satisfy all constraints together.
        """
        sites: list[MountedCamera] = []
        for k, position in enumerate(positions):
            site = self._mount_near(position, sites, None if headings is None else headings[k])
            if site is None:
                return self._packed_sites[:len(positions)]
            sites.append(site)
        return tuple(sites)

    def score(self, positions: np.ndarray) -> tuple[float, float]:
        """
        Return the objective value and the space coverage, cubic metres, of positions (n, 2).

        The objective value is depth error / depth error without any visible point, plus the costs
        of regions; the cameras are mounted at feasible poses near the positions.
        """
        evaluation = self.objective.evaluate_views(views_of(self(positions)))
        return evaluation.loss, evaluation.space_coverage

    def completed_sites(self, sites: Sequence[MountedCamera]) -> Sites:
        """Return the given cameras and the missing ones of the rig, added greedily."""
        sites = list(sites)
        while len(sites) < len(self.rig.cameras):
            site = self.pool.best_addition(self.objective, sites)
            if site is None:
                return self._packed_sites
            sites.append(site)
        return tuple(sites)

    @cached_property
    def _packed_sites(self) -> Sites:
        """Return all cameras, as close together as the spacing allows."""
        return self.pool.packed_sites(self.rig)

    def _mount_near(self, position: np.ndarray, sites: Sequence[MountedCamera],
                    heading: np.ndarray | None) -> MountedCamera | None:
        """
        Mount the next camera at a position, or near it.

        :param position: (2,) or, with a desired height, (3,) metres.
        :param sites: of the cameras before it in the rig.
        :param heading: (3,) desired yaw, pitch and roll in radians; None for the best ones.
        :returns: None if no candidate satisfies the spacing.
        """
        model = self.rig.cameras[len(sites)].model
        # If candidates differ only in position, the nearest one is the best.
        same_height = self.rig.mount.on in ('plane', 'ceiling')
        count = 1 if same_height and model.omnidirectional else 24
        poses = self.pool.candidates_of(model).poses
        rows = self.pool.spaced_rows(self.rig, sites)
        distances = np.linalg.norm(poses[rows, :2] - position[:2], axis=1)
        nearest = rows[np.argsort(distances, kind='stable')[:count]]
        candidate = self.pool.best_addition(self._coarse_objective, sites, nearest)
        if candidate is None:
            return None
        # Height and heading are those of the candidate, unless others are desired.
        desired_pose = candidate.pose.copy()
        desired_pose[:len(position)] = position
        if heading is not None:
            desired_pose[3:] = heading
        site = self._mount_at(desired_pose, sites)
        # If the desired height and heading are infeasible here, try those of the candidate.
        if site is None and heading is not None:
            site = self._mount_at(np.concatenate([position[:2], candidate.pose[2:]]), sites)
        return site or candidate

    def _mount_at(self, pose: np.ndarray, sites: Sequence[MountedCamera]) -> MountedCamera | None:
        """Mount the next camera at a pose (6,), moved onto the mount; None if infeasible."""
        camera = len(sites)
        pose = pose.copy()
        pose[:3] = self.region.onto_mount(pose[None, :3])[0]
        poses = as_written(pose[None])
        model = self.rig.cameras[camera].model
        spaced = are_spaced(poses, sites, self.rig.spacing)
        if not (spaced & self.region.allowed(poses, model))[0]:
            return None
        return MountedCamera(poses[0], self._look(poses[0], camera))
