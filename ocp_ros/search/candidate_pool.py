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

"""Candidate poses of a rig's cameras in a room, their views, and first placements."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
import os
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, pose_features
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.rig.feasible_region import FeasibleRegion, satisfies_spacing
from ocp_ros.rig.placement_file import as_written
from ocp_ros.rig.rig_file import Rig
from ocp_ros.search.budget import Budget
from ocp_ros.search.pose_grid import MAX_GRID_POSES, PoseGrid
from ocp_ros.simulation.objective import Objective
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulator import Simulator, View
from ocp_ros.util.settings import ConfigurationError
from scipy.spatial import cKDTree

#: Number of candidates, and their smallest number with a budget of evaluations.
CANDIDATES, MIN_CANDIDATES = 2000, 64
#: Share of the time for the views of the candidates.
VIEWS_TIME_SHARE = 0.2
#: With a budget of evaluations: smallest number of poses of a dense grid, poses per evaluation.
MIN_GRID_POSES, GRID_POSES_EACH = 500, 10
#: Number of poses whose views are computed at a time.
VIEWS_AT_A_TIME = 256
#: Number of poses whose views are computed even without time left.
MIN_VIEWS = 256
#: Metres that a rotation by a radian counts as in the search for the nearest poses.
METRES_PER_RADIAN = 1.0
#: Number of first positions that the close packing of cameras tries.
PACKING_STARTS = 48
#: Depth-map rows that rank placements nearly the same in a quarter of the time.
QUICK_ROWS = 32


class MountedCamera(NamedTuple):
    """
    A camera at a feasible pose.

    :ivar pose: (6,) metres, map frame, and radians, rounded as in a placement file.
    :ivar view: its view from there.
    """

    pose: np.ndarray
    view: View


class CandidateSet(NamedTuple):
    """
    Candidate poses of one camera model.

    :ivar poses: (M, 6) metres, map frame, and radians, M >= 1.
    :ivar views: the view of each pose.
    :ivar tree: k-d tree of positions and viewing directions.
    """

    poses: np.ndarray
    views: list[View]
    tree: cKDTree

    def near(self, pose: np.ndarray, count: int) -> np.ndarray:
        """Return the numbers of the ``count`` poses with the most similar position and heading."""
        count = min(count, len(self.poses))
        here, ranks = pose_features(pose[None], METRES_PER_RADIAN)[0], np.arange(1, count + 1)
        return np.atleast_1d(self.tree.query(here, ranks)[1])


def _offered(allowed: FeasibleRegion, model: CameraModel, most: int) -> np.ndarray:
    """Return feasible poses (M, 6) of a camera; the first m are spread over the room for any m."""
    poses = as_written(allowed.candidates(model, most))
    # Rounding may have moved some poses into a forbidden zone.
    poses = poses[allowed.allowed(poses, model)]
    if len(poses) == 0:
        raise allowed.rig.document.error(
            ('mount',), f'no feasible pose in {allowed.scene.name} after rounding to 0.1 mm',
            'more room', 'lower keep_clear, or change the mount or its height')
    return np.random.default_rng(0).permutation(poses)


def _sees_nothing(problem: Problem, camera: int, poses: int) -> ConfigurationError:
    """Return the error that a camera sees no point of a room, with its possible causes."""
    model, scene = problem.rig.models[camera], problem.simulator.scene
    across = float(np.linalg.norm(np.ptp(corners_of(scene.points), axis=0)))
    return problem.rig.document.error(
        ('cameras',), f'{problem.rig.cameras[camera].name}, which sees from '
        f'{model.min_range:g} m to {model.max_range:g} m and {np.rad2deg(model.horizontal_fov):g}'
        f' x {np.rad2deg(model.vertical_fov):g} degrees: no point of {scene.name}, a room '
        f'{across:.3g} m across, from any of {poses:,} feasible poses',
        'a camera that sees some', 'change its ranges, its field of view, the mount or keep_clear')


class Pool:
    """
    Candidates for each model of a rig, and their views.

    :param problem: a rig of these models in the room.
    :param most: number of candidates of all models together.
    :param among: number of poses, spread over the room, from which the candidates are drawn.
    :param threads: number of threads.
    :param over: returns whether to stop; the views of the first ``MIN_VIEWS`` poses of each model
        are computed in any case.
    :param dense: largest number of poses of :meth:`grid`.
    :raises ConfigurationError: if a camera has no feasible pose, or sees no point from all poses.
    """

    def __init__(self, problem: Problem, most: int, among: int = 0, threads: int = 1,
                 over: Callable[[], bool] = lambda: False, dense: int = MAX_GRID_POSES) -> None:
        rig, simulator, self._kinds = problem.rig, problem.simulator, {}
        self._found: dict[CameraModel, list[View]] = defaultdict(list)
        self._grids: dict[CameraModel, PoseGrid] = {}
        self._dense = dense
        models = rig.placed_models
        #: Whether the views of all offered poses were computed, not only of a part.
        self.complete = True
        for model in models:
            camera, count = rig.models.index(model), max(most // len(models), 1)
            offered = _offered(problem.region, model, max(count, among // len(models)))
            poses = offered[:count]
            # The first MIN_VIEWS poses are spread over the room; the others are grouped by
            # position, so that poses of one position are computed together.
            _, first, place = np.unique(poses[:, :3], axis=0, return_index=True,
                                        return_inverse=True)
            rank = np.where(np.arange(len(poses)) < MIN_VIEWS, -1, first[place.ravel()])
            order, views = np.argsort(rank, kind='stable'), []
            while len(views) < len(poses) and (len(views) < MIN_VIEWS or not over()):
                views += simulator.look_many(
                    poses[order[len(views):len(views) + VIEWS_AT_A_TIME]], camera, threads)
            self.complete &= len(views) == len(offered)
            # Restore the order in which the poses were drawn.
            known = np.argsort(order[:len(views)])
            poses, views = poses[order[known]], [views[k] for k in known]
            if not any(view.seen.any() for view in views):
                raise _sees_nothing(problem, camera, len(views))
            self._kinds[model] = CandidateSet(
                poses, views, cKDTree(pose_features(poses, METRES_PER_RADIAN)))

    def __len__(self) -> int:
        """Return the number of candidates of all models together."""
        return sum(len(kind.poses) for kind in self._kinds.values())

    def kind(self, model: CameraModel) -> CandidateSet:
        """Return the candidates of a model."""
        return self._kinds[model]

    def grid(self, problem: Problem, model: CameraModel, over: Callable[[], bool]) -> PoseGrid:
        """Return the dense grid of a model; the first call computes its views."""
        if model not in self._grids:
            self._grids[model] = PoseGrid.of(problem.region, problem.simulator, model,
                                             problem.rig.models.index(model), self._dense, over)
        return self._grids[model]

    def left(self, rig: Rig, sites: Sequence[MountedCamera]) -> np.ndarray:
        """
        Return the numbers of the candidates for the next camera that satisfy the spacing.

        :param sites: of the cameras before it in the rig.
        """
        poses = self.kind(rig.cameras[len(sites)].model).poses
        return np.flatnonzero(keeps_spacing(poses, sites, rig.spacing))

    def add(self, rig: Rig, sites: Sequence[MountedCamera]) -> None:
        """Add a placement of a rig to the views of :meth:`union_views`."""
        for camera, site in zip(rig.cameras, sites):
            self._found[camera.model].append(site.view)

    def union_views(self, rig: Rig) -> list[View]:
        """
        Return for each camera of a rig the union of the views of all its candidates.

        They give a lower bound of the objective: in any choice of candidates and added placements,
        each point is visible to at most as many cameras as in these views.
        """
        found = []
        for camera in rig.cameras:
            views = [*self.kind(camera.model).views, *self._found[camera.model]]
            found.append(View(np.bitwise_or.reduce([view.seen for view in views]),
                              np.bitwise_or.reduce([view.covered for view in views])))
        return found

    def site(self, model: CameraModel, number: int) -> MountedCamera:
        """Return a candidate of a model."""
        kind = self.kind(model)
        return MountedCamera(kind.poses[number], kind.views[number])


def pool_of(problem: Problem, budget: Budget) -> Pool:
    """
    Create the candidates for a search.

    :param problem: the rig in the room.
    :param budget: of the search; the candidates use a share of it.
    """
    most, dense = CANDIDATES, MAX_GRID_POSES
    if budget.evaluations is not None:
        most = int(np.clip(budget.evaluations // 2, MIN_CANDIDATES, CANDIDATES))
        dense = int(np.clip(budget.evaluations * GRID_POSES_EACH, MIN_GRID_POSES, MAX_GRID_POSES))
    return Pool(problem, most, CANDIDATES, os.cpu_count() or 1,
                lambda: budget.share(0, None) >= VIEWS_TIME_SHARE, dense)


def quick_of(objective: Objective) -> Objective:
    """Return the same objective with smaller depth maps; it accepts the same views."""
    simulator = objective.simulator
    engine = replace(simulator.config.engine, error_rows=QUICK_ROWS)
    quick = replace(simulator.config, engine=engine)
    return Objective(Simulator(simulator.scene, quick, simulator.models), objective.rig)


def keeps_spacing(poses: np.ndarray, sites: Sequence[MountedCamera], spacing: float) -> np.ndarray:
    """
    Return which poses are far enough from all given cameras.

    :param poses: (M, 6) metres and radians.
    :param spacing: metres.
    :returns: (M,) bool.
    """
    others = np.array([site.pose[:3] for site in sites]).reshape(-1, 3)
    return satisfies_spacing(poses[:, :3], others, spacing)


def best_addition(objective: Objective, pool: Pool, sites: Sequence[MountedCamera],
                  among: np.ndarray | None = None) -> MountedCamera | None:
    """
    Choose the candidate for the next camera of a rig with the least ``objective.promise``.

    :param sites: of the cameras before it.
    :param among: numbers of candidates to choose from; None for all candidates.
    :returns: None if all candidates are too near to the other cameras.
    """
    rig = objective.rig
    model, views = rig.cameras[len(sites)].model, [site.view for site in sites]
    kind = pool.kind(model)
    if among is None:
        among = pool.left(rig, sites)
    else:
        among = among[keeps_spacing(kind.poses[among], sites, rig.spacing)]
    if len(among) == 0:
        return None
    worth = [objective.promise([*views, kind.views[number]]) for number in among]
    return pool.site(model, among[int(np.argmin(worth))])


def packed(rig: Rig, pool: Pool) -> list[MountedCamera]:
    """
    Place the cameras of a rig as close together as the spacing allows, to test whether all fit.

    :returns: sites of the first cameras of the rig; of all cameras if all fit.
    """
    best: list[MountedCamera] = []
    first = pool.kind(rig.cameras[0].model)
    for start in np.unique(np.linspace(0, len(first.poses) - 1, PACKING_STARTS).astype(int)):
        sites = [pool.site(rig.cameras[0].model, start)]
        for camera in rig.cameras[1:]:
            left = pool.left(rig, sites)
            if len(left) == 0:
                break
            places = pool.kind(camera.model).poses[left, None, :3]
            others = np.array([site.pose[:3] for site in sites])
            away = np.linalg.norm(places - others, axis=2).sum(axis=1)
            sites.append(pool.site(camera.model, left[int(np.argmin(away))]))
        best = max(best, sites, key=len)
        if len(best) == len(rig.cameras):
            break
    return best


def check_room(objective: Objective, pool: Pool) -> None:
    """
    Check that all cameras of a rig fit into the room.

    :raises ConfigurationError: if the spacing leaves too few feasible positions.
    """
    rig = objective.rig
    if len(sites := packed(rig, pool)) < len(rig.cameras):
        raise rig.document.error(
            ('spacing',), f'{rig.spacing:g} m, at which only {len(sites)} of the '
            f'{len(rig.cameras)} cameras find room in {objective.simulator.scene.name}',
            'a distance at which all do', 'lower it or use fewer cameras')


def check_regions(objective: Objective, pool: Pool) -> None:
    """
    Check that all candidates together see the required share of each region.

    :raises ConfigurationError: if they do not, and the views of all offered poses were computed.
    """
    rig = objective.rig
    shares = objective.judge(pool.union_views(rig)).regions
    for k, (region, share) in enumerate(zip(rig.regions, shares)):
        if pool.complete and share < region.must_see:
            raise rig.document.error(
                ('regions', k, 'must_see'), f'{100.0 * region.must_see:.1f} % of {region.name}, '
                f'of which all {len(pool)} candidates together see {100.0 * share:.1f} %',
                'a share that can be seen', 'lower it, or change the mount or the pitch')


def random_site(rig: Rig, pool: Pool, sites: Sequence[MountedCamera], rng: np.random.Generator
                ) -> MountedCamera | None:
    """Draw a candidate for the next camera of a rig; None if the spacing allows none."""
    left = pool.left(rig, sites)
    return pool.site(rig.cameras[len(sites)].model, rng.choice(left)) if len(left) else None


def random_sites(rig: Rig, pool: Pool, rng: np.random.Generator) -> tuple[MountedCamera, ...]:
    """Draw a placement of a rig among the candidates; () if the spacing leaves too few."""
    sites: list[MountedCamera] = []
    while len(sites) < len(rig.cameras):
        site = random_site(rig, pool, sites, rng)
        if site is None:
            return ()
        sites.append(site)
    return tuple(sites)
