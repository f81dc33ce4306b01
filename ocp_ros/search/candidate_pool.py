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
from ocp_ros.simulation.scan_evidence import ScanEvidence
from ocp_ros.simulation.simulator import View
from ocp_ros.util.settings import ConfigurationError
from scipy.spatial import cKDTree

#: Number of candidates of all models together.
CANDIDATES = 2000
#: Number of poses of each model, for each room of a floor, whose views are computed even without
#: time left.
MIN_VIEWS = 256
#: Distance for which a rotation by a radian counts, to find poses with similar views.
METRES_PER_RADIAN = 1.0


class MountedCamera(NamedTuple):
    """
    A camera at a feasible pose, its *site*.

    :ivar pose: (6,) metres, map frame, and radians, rounded as in a placement file.
    :ivar view: the view of the camera from this pose.
    """

    pose: np.ndarray
    view: View


#: A placement, in the order of the rig's cameras.
Sites = tuple[MountedCamera, ...]


def views_of(sites: Sequence[MountedCamera]) -> list[View]:
    """Return the views of mounted cameras."""
    return [site.view for site in sites]


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

    def nearest_rows(self, pose: np.ndarray, count: int) -> np.ndarray:
        """
        Return the rows of the candidates with the most similar position and viewing direction.

        :param pose: (6,) metres, map frame, and radians.
        :param count: largest number of rows.
        :returns: (n,) int, the most similar first.
        """
        # With a list of ranks, not their number, ``query`` returns an array also for a single row.
        ranks = np.arange(1, min(count, len(self.poses)) + 1)
        features = pose_features(pose[None], METRES_PER_RADIAN)[0]
        return self.tree.query(features, ranks)[1]


def _feasible_poses(region: FeasibleRegion, model: CameraModel, max_poses: int) -> np.ndarray:
    """Return feasible poses (M, 6) in random order: the first n are spread over the room."""
    poses = as_written(region.candidates(model, max_poses))
    # Rounding may have moved some poses into a forbidden zone.
    poses = poses[region.allowed(poses, model)]
    if len(poses) == 0:
        raise region.rig.document.error(
            ('mount',), f'no feasible pose in {region.scene.name} after rounding to 0.1 mm',
            'more room', 'lower keep_clear, or change the mount or its height')
    return np.random.default_rng(0).permutation(poses)


def _blind_camera_error(problem: Problem, camera: int, poses: int) -> ConfigurationError:
    """Return the error that a camera sees no point from n poses, with its possible causes."""
    model = problem.rig.models[camera]
    scene = problem.simulator.scene
    diagonal = float(np.linalg.norm(np.ptp(corners_of(scene.points), axis=0)))
    return problem.rig.document.error(
        ('cameras',), f'{problem.rig.cameras[camera].name}, which sees from '
        f'{model.min_range:g} m to {model.max_range:g} m and {np.rad2deg(model.horizontal_fov):g}'
        f' x {np.rad2deg(model.vertical_fov):g} degrees: no point of {scene.name}, a room '
        f'{diagonal:.3g} m across, from any of {poses:,} feasible poses',
        'a camera that sees some', 'change its ranges, its field of view, the mount or keep_clear')


class CandidatePool:
    """
    Candidates for each model of a rig, and their views.

    :param problem: a rig of these models in the room.
    :param max_candidates: largest number of candidates of all models together.
    :param drawn_poses: number of poses, spread over the room, of which the first are the
        candidates; at least ``max_candidates`` are drawn.
    :param threads: number of threads.
    :param should_stop: returns whether to stop; the views of the first ``MIN_VIEWS`` poses
        of each model and room are computed in any case.
    :param max_grid_poses: largest number of poses of :meth:`dense_grid`.
    :ivar complete: whether the views of all drawn poses were computed.
    :raises ConfigurationError: if a camera has no feasible pose, or sees no point from all poses.
    """

    def __init__(self, problem: Problem, max_candidates: int, drawn_poses: int = 0,
                 threads: int = 1, should_stop: Callable[[], bool] = lambda: False,
                 max_grid_poses: int = MAX_GRID_POSES) -> None:
        self._candidates: dict[CameraModel, CandidateSet] = {}
        self._added_views: dict[CameraModel, list[View]] = defaultdict(list)
        self._grids: dict[CameraModel, PoseGrid] = {}
        self._max_grid_poses = max_grid_poses
        #: By model, the number of places that its grid was asked to have.
        self._min_places: dict[CameraModel, int] = defaultdict(int)
        models = problem.rig.placed_models
        min_views = MIN_VIEWS * room_count(problem)
        self.complete = True
        for model in models:
            camera = problem.rig.models.index(model)
            count = max(max_candidates // len(models), 1)
            drawn = _feasible_poses(problem.region, model, max(count, drawn_poses // len(models)))
            poses = drawn[:count]
            # The first poses, which are spread over the room, stay first. The rank of the others
            # is the first row of their position, so the views of a position are computed together.
            _, first_rows, groups = np.unique(poses[:, :3], axis=0, return_index=True,
                                              return_inverse=True)
            # Some versions of NumPy return the groups as a column, so they are flattened.
            rank = np.where(np.arange(len(poses)) < min_views, -1, first_rows[groups.ravel()])
            order = np.argsort(rank, kind='stable')
            views = []
            # The time is checked before each batch.
            while len(views) < len(poses) and (len(views) < min_views or not should_stop()):
                batch = order[len(views):][:256]
                views += problem.simulator.look_many(poses[batch], camera, threads)
            self.complete &= len(views) == len(drawn)
            # Restore the order in which the poses were drawn, without poses that have no view.
            drawn_order = np.argsort(order[:len(views)])
            poses = poses[order[drawn_order]]
            views = [views[k] for k in drawn_order]
            if not any(view.seen.any() for view in views):
                raise _blind_camera_error(problem, camera, len(views))
            self._candidates[model] = CandidateSet(
                poses, views, cKDTree(pose_features(poses, METRES_PER_RADIAN)))

    def __len__(self) -> int:
        """Return the number of candidates of all models together."""
        return sum(len(candidates.poses) for candidates in self._candidates.values())

    def candidates_of(self, model: CameraModel) -> CandidateSet:
        """Return the candidates of a model."""
        return self._candidates[model]

    def dense_grid(self, problem: Problem, model: CameraModel) -> PoseGrid:
        """Return the dense grid of a model, with the places that searches have added so far."""
        # With few places, the spacing may leave too few for all cameras.
        min_places = 4 * len(problem.rig.cameras)
        if min_places > self._min_places[model] and (
                model not in self._grids or self._grids[model].place_count < min_places):
            self._min_places[model] = min_places
            self._grids[model] = PoseGrid.of(
                problem.region, problem.simulator, model, problem.rig.models.index(model),
                self._max_grid_poses, min_places)
        return self._grids[model]

    @property
    def grid_share(self) -> float:
        """Return the share of the places of the dense grids whose views are known."""
        grids = list(self._grids.values())
        return min((grid.added_share for grid in grids), default=0.0)

    def spaced_rows(self, rig: Rig, sites: Sequence[MountedCamera]) -> np.ndarray:
        """
        Return the rows of the candidates for the next camera that satisfy the spacing.

        :param sites: of the cameras before it in the rig.
        :returns: (n,) int.
        """
        poses = self.candidates_of(rig.cameras[len(sites)].model).poses
        return np.flatnonzero(are_spaced(poses, sites, rig.spacing))

    def add_placement(self, rig: Rig, sites: Sequence[MountedCamera]) -> None:
        """Add the views of a placement to those that :meth:`union_views` unites."""
        for camera, site in zip(rig.cameras, sites):
            self._added_views[camera.model].append(site.view)

    def union_views(self, rig: Rig, evidence: ScanEvidence | None = None) -> list[View]:
        """
        Return for each camera of a rig the union of the views of all its candidates.

        :param evidence: only what it proves counts; None for all views.

        These unions give a lower bound of the objective: in any choice of candidates and added
        placements, each point is visible to at most as many cameras as in the unions.
        """
        unions = []
        for camera in rig.cameras:
            views = [*self.candidates_of(camera.model).views, *self._added_views[camera.model]]
            seen = np.zeros_like(views[0].seen)
            for view in views:
                added = view.seen & ~seen
                # A bound may be too good, so the finer map is not needed.
                seen |= added if evidence is None else evidence.proved(
                    added, view.position, finer=False)
            unions.append(View(seen,
                               np.bitwise_or.reduce([view.covered for view in views]),
                               good=np.bitwise_or.reduce([view.good for view in views])))
        return unions

    def mounted_candidate(self, model: CameraModel, row: int) -> MountedCamera:
        """Return a candidate of a model as a mounted camera."""
        candidates = self.candidates_of(model)
        return MountedCamera(candidates.poses[row], candidates.views[row])

    def best_addition(self, objective: Objective, sites: Sequence[MountedCamera],
                      rows: np.ndarray | None = None) -> MountedCamera | None:
        """
        Choose the candidate for the next camera of a rig with the least eased loss.

        See :meth:`~ocp_ros.simulation.objective.Objective.losses_with`.

        :param objective: of the rig.
        :param sites: of the cameras before it.
        :param rows: (n,) int, the candidates to choose from; None for all candidates.
        :returns: None if all these candidates are too near to the other cameras.
        """
        rig = objective.rig
        model = rig.cameras[len(sites)].model
        views = views_of(sites)
        candidates = self.candidates_of(model)
        if rows is None:
            rows = self.spaced_rows(rig, sites)
        else:
            rows = rows[are_spaced(candidates.poses[rows], sites, rig.spacing)]
        if len(rows) == 0:
            return None
        if len(rows) == 1:
            return self.mounted_candidate(model, rows[0])
        losses = objective.losses_with(views, [candidates.views[row] for row in rows], eased=True)
        return self.mounted_candidate(model, rows[int(np.argmin(losses))])

    def random_site(self, rig: Rig, sites: Sequence[MountedCamera], rng: np.random.Generator
                    ) -> MountedCamera | None:
        """Draw a candidate for the next camera of a rig; None if the spacing allows none."""
        rows = self.spaced_rows(rig, sites)
        model = rig.cameras[len(sites)].model
        return self.mounted_candidate(model, rng.choice(rows)) if len(rows) else None

    def random_sites(self, rig: Rig, rng: np.random.Generator) -> Sites:
        """Draw a placement of a rig among the candidates; () if the spacing leaves too few."""
        sites: list[MountedCamera] = []
        while len(sites) < len(rig.cameras):
            site = self.random_site(rig, sites, rng)
            if site is None:
                return ()
            sites.append(site)
        return tuple(sites)

    def packed_sites(self, rig: Rig) -> Sites:
        """
        Place the cameras as close together as the spacing allows, to test whether all fit.

        :returns: sites of the first cameras of the rig; of all cameras if all fit.
        """
        best: list[MountedCamera] = []
        first_model = rig.cameras[0].model
        last_row = len(self.candidates_of(first_model).poses) - 1
        # Each attempt begins at another candidate. Each further camera is mounted where the sum of
        # its distances from the cameras before it is smallest.
        attempts = 48
        for first_row in np.unique(np.linspace(0, last_row, attempts).astype(int)):
            sites = [self.mounted_candidate(first_model, first_row)]
            for camera in rig.cameras[1:]:
                rows = self.spaced_rows(rig, sites)
                if len(rows) == 0:
                    break
                positions = self.candidates_of(camera.model).poses[rows, None, :3]
                others = np.array([site.pose[:3] for site in sites])
                distances = np.linalg.norm(positions - others, axis=2).sum(axis=1)
                sites.append(self.mounted_candidate(camera.model, rows[int(np.argmin(distances))]))
            best = max(best, sites, key=len)
            if len(best) == len(rig.cameras):
                break
        return tuple(best)

    def check_fit(self, objective: Objective) -> None:
        """
        Check that all cameras of a rig fit into the room.

        :param objective: of the rig.
        :raises ConfigurationError: if the spacing leaves too few feasible positions.
        """
        rig = objective.rig
        if len(sites := self.packed_sites(rig)) < len(rig.cameras):
            raise rig.document.error(
                ('spacing',), f'{rig.spacing:g} m, at which only {len(sites)} of the '
                f'{len(rig.cameras)} cameras find room in {objective.simulator.scene.name}',
                'a distance at which all do', 'lower it or use fewer cameras')


def room_count(problem: Problem) -> int:
    """Return the number of rooms of the floor of a problem; 1 for a single room."""
    rooms = problem.simulator.scene.rooms
    return 1 if rooms is None else rooms.count


def pool_of(problem: Problem, budget: Budget) -> CandidatePool:
    """
    Create the candidates for a search.

    :param problem: the rig in the room.
    :param budget: of the search; the candidates use a share of it.
    """
    # The views of candidates take time that is not counted as evaluations, so a small budget has
    # fewer candidates. They are the first of the same poses for every budget.
    max_candidates, max_grid_poses = CANDIDATES, MAX_GRID_POSES
    if budget.evaluations is not None:
        max_candidates = int(np.clip(budget.evaluations // 2 * room_count(problem), 64,
                                     max_candidates))
        max_grid_poses = int(np.clip(budget.evaluations * 10, 500, max_grid_poses))
    # The views may take a fifth of the time.
    return CandidatePool(problem, max_candidates, CANDIDATES, os.cpu_count() or 1,
                         budget.deadline_check(0.2), max_grid_poses)


def are_spaced(poses: np.ndarray, sites: Sequence[MountedCamera], spacing: float) -> np.ndarray:
    """
    Return which poses are far enough from all given cameras.

    :param poses: (M, 6) metres and radians.
    :param sites: the given cameras.
    :param spacing: smallest distance of two cameras, metres.
    :returns: (M,) bool.
    """
    positions = np.array([site.pose[:3] for site in sites]).reshape(-1, 3)
    return satisfies_spacing(poses[:, :3], positions, spacing)


def check_regions(objective: Objective, pool: CandidatePool) -> None:
    """
    Check that all candidates together see the required share of each region.

    :raises ConfigurationError: if they do not, and the views of all drawn poses were computed.
    """
    rig = objective.rig
    shares = objective.evaluate_views(pool.union_views(rig)).regions
    for k, (region, share) in enumerate(zip(rig.regions, shares)):
        if pool.complete and share < region.must_see:
            raise rig.document.error(
                ('regions', k, 'must_see'), f'{100.0 * region.must_see:.1f} % of {region.name}, '
                f'of which all {len(pool)} candidates together see {100.0 * share:.1f} %',
                'a share that can be seen', 'lower it, or change the mount or the pitch')
