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

"""The engine for one scene: visibility, coverage and depth error of placements."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from functools import cache, partial
import logging
from typing import Any, NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import (
    CameraArrays,
    CameraModel,
    Frustum,
    LEVEL,
    mark_headings,
    OMNIDIRECTIONAL,
    Pose,
    rotation_matrix,
)
from ocp_ros.geometry.coverage import coverable_cell, coverage_grid, space_coverage
from ocp_ros.geometry.depth_error import DepthError
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.measurement_quality import keep_measured_well, QualityLimits
from ocp_ros.geometry.packed_bits import no_bits, pack, Subset, unpack
from ocp_ros.geometry.visibility import CubeVisibility, MESH, PRESETS, SurfelVisibility
from ocp_ros.rig.rig_file import Requirement
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.simulation.ray_visibility import RayVisibility
from ocp_ros.simulation.scan_evidence import ScanEvidence
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.viewpoints import viewpoints_of
from ocp_ros.util.settings import ConfigurationError

_log = logging.getLogger(__name__)
NO_INDICES = np.empty(0, dtype=np.int64)


class View(NamedTuple):
    """
    The view of one camera, as packed bits in the engine's order.

    :ivar seen: (W,) uint64, bits of the points that the camera sees, 64 in each of W words.
    :ivar covered: (V,) uint64, the same for the cells of the coverage grid, and those of regions
        of air, in V words.
    :ivar position: (3,) the position of the camera, metres, map frame; None for several positions
        at once.
    :ivar good: (Q, W) uint64, the same as ``seen`` for the points that the camera measures as each
        of the Q requirements of the simulator asks; without rows if there are none.
    """

    seen: np.ndarray
    covered: np.ndarray
    position: np.ndarray | None = None
    good: np.ndarray = np.empty((0, 0), dtype=np.uint64)


class Evaluation(NamedTuple):
    """
    The evaluation of a placement.

    :ivar seen: the points that at least one camera sees.
    :ivar space_coverage: cubic metres.
    :ivar depth_error: metres.
    """

    seen: Subset
    space_coverage: float
    depth_error: float

    @property
    def visible(self) -> np.ndarray:
        """Return (N,) bool, whether at least one camera sees each point of the scene."""
        return self.seen.mask


def clipped(visibility: SurfelVisibility | RayVisibility, around: View, poses: np.ndarray,
            lens: Frustum) -> list[View]:
    """
    Return the views of a camera with H headings, cut out of one omnidirectional view.

    :param visibility: the engine part that computed the omnidirectional view.
    :param around: the view of an omnidirectional camera at the position of all poses.
    :param poses: (H, 6) metres, map frame, and radians: one position, H headings.
    :param lens: the field of view and the range of the camera.
    """
    return [View(*visibility.narrowed(Pose.of(pose), lens, around.seen, around.covered), pose[:3])
            for pose in poses]


def _make_error(scene: Scene, order: np.ndarray, engine: EngineConfig, viewpoints: str
                ) -> DepthError:
    """Build the function that computes the depth error of seen points in an order."""
    return DepthError(scene.points[order], scene.spacing[order], scene.diameter,
                      viewpoints_of(scene, viewpoints), engine.error_rows, engine.error_folds)


class Simulator:
    """
    Evaluate placements in one scene; threads may share it, and the kernels release the GIL.

    A placement has one row per camera: x, y, z in metres, or x, y, z, yaw, pitch, roll with angles
    in radians (see :func:`~ocp_ros.geometry.cameras.rotation_matrix`); row k belongs to camera k
    of the rig.

    :param scene: the room.
    :param config: the rig and the engine's settings.
    :param models: the camera models of a rig file, which replace ``config.rig`` completely.
    :ivar height: z of the plane of ``config.rig``, metres, map frame.
    :raises SceneError: if that plane is not inside the room.
    """

    def __init__(self, scene: Scene, config: SimulationConfig,
                 models: Sequence[CameraModel] | None = None) -> None:
        if not isinstance(scene, Scene) or not isinstance(config, SimulationConfig):
            raise ConfigurationError(
                f'simulator: found {type(scene).__name__} and {type(config).__name__}; expected a '
                'Scene, such as from load_scene, and a SimulationConfig')
        self.scene, self.config = scene, config
        #: For each of Q requirements, the limits of each of the models.
        self.limits: tuple[tuple[QualityLimits, ...], ...] = ()
        self._set_models((config.rig.model,) if models is None else models)
        self.height = float(scene.bounds[0, 2] + config.rig.height)
        if models is None and self.height >= scene.bounds[1, 2]:
            raise SceneError(
                f'{scene.name}: found a room {scene.size[2]:.2f} m high; expected more than the '
                f"cameras' height of {config.rig.height:.2f} m; lower rig.height")
        asked_cell = config.engine.coverage_cell
        cell = coverable_cell(scene.bounds, asked_cell)
        if cell > asked_cell:
            _log.warning('%s: found a room of %.0f x %.0f x %.0f m, too large for coverage cells '
                         'of %g m; going on with %g m', scene.name, *scene.size, asked_cell, cell)
        self.grid, self.cell_volume = coverage_grid(scene.bounds, cell)
        self.visibility = self._make_visibility()
        self._set_places(self.grid)
        make_error = partial(_make_error, scene, self.visibility.order, config.engine)
        self.depth_error = make_error(config.engine.viewpoints)
        #: Built once, and shared with the simulators of other rigs in this scene.
        self._validation_error = cache(partial(make_error, 'validation'))
        self._scan_evidence = cache(partial(ScanEvidence.of, scene, self.visibility))
        #: What the scan proves about views; None if all views count.
        self.evidence: ScanEvidence | None = None

    def _set_models(self, models: Sequence[CameraModel]) -> None:
        """Set the camera models, and for each the index of the first equal model."""
        self.models = tuple(models)
        self._lenses = [model.lens for model in self.models]
        self._kinds = [self.models.index(model) for model in self.models]

    def with_models(self, models: Sequence[CameraModel], config: SimulationConfig | None = None
                    ) -> 'Simulator':
        """
        Return the simulator of another rig in the same scene, which shares the engine.

        :param models: the camera models of that rig.
        :param config: its settings, with the same engine and height; None for those of this one.
        """
        other = copy(self)
        other._set_models(models)
        # They are those of the other models; the objective sets those of its rig.
        other.limits = ()
        other.config = config or self.config
        return other

    def with_air(self, cells: np.ndarray) -> 'Simulator':
        """
        Return the same simulator with further cells of air, which do not count as space coverage.

        :param cells: (S, 3) metres, map frame, the centres of the cells, such as of regions.
        """
        other = copy(self)
        places = np.concatenate([self.grid, cells]).astype(np.float32)
        other.visibility = self.visibility.with_places(places)
        other._set_places(places)
        return other

    def _set_places(self, places: np.ndarray) -> None:
        """Set the cells (M, 3) of the engine, the grid's first; ``visibility`` has them too."""
        #: (M, 3) float32 in the engine's order, and the bits of those that are cells of the grid.
        self.places = places[self.visibility.place_order]
        self._grid_bits = pack(self.is_grid)

    def coverage(self, covered: np.ndarray) -> float:
        """Return the volume of the cells of the grid that are set in packed bits, m3."""
        return space_coverage(covered & self._grid_bits, self.cell_volume)

    @property
    def is_grid(self) -> np.ndarray:
        """Return which of the M places are cells of the coverage grid: (M,) bool."""
        return self.visibility.place_order < len(self.grid)

    def _make_visibility(self) -> SurfelVisibility | CubeVisibility | RayVisibility:
        """Build the visibility of points and cells by the rules of the preset."""
        scene, preset = self.scene, self.config.engine.preset
        if preset == MESH:
            if scene.mesh is None:
                raise ConfigurationError(
                    f'engine.preset: found {MESH} for {scene.name}, which is no mesh; expected '
                    f'one of {", ".join(PRESETS)}; name one of them')
            return RayVisibility(scene.points, self.grid, scene.mesh)
        if preset == 'paper':
            return CubeVisibility(scene.points, scene.spacing, self.grid, PRESETS[preset])
        return SurfelVisibility(scene.points, scene.normals_or_estimate, scene.pitch, self.grid,
                                PRESETS[preset])

    def with_requirements(self, requirements: Sequence[Requirement]) -> 'Simulator':
        """
        Return the same simulator with views that say which points meet each requirement.

        :raises ValueError: if a camera lacks a parameter that a requirement needs.
        """
        if not requirements and not self.limits:
            return self
        other = copy(self)
        other.limits = tuple(tuple(requirement.limits_of(model) for model in self.models)
                             for requirement in requirements)
        return other

    def _good_points(self, seen: np.ndarray, pose: Pose, camera: int) -> np.ndarray:
        """Return ``View.good`` of a view of one camera, given the points (W,) that it sees."""
        good = np.zeros((len(self.limits), len(seen)), dtype=np.uint64)
        indices = np.flatnonzero(unpack(seen, len(self.scene))) if self.limits else NO_INDICES
        visible = np.ones((len(indices), 1), dtype=np.uint64)
        for row, bits in zip(good, self._good_headings(
                indices, pose.position, pose.rotation[None], visible, camera)):
            flags = np.zeros(len(self.scene), dtype=bool)
            flags[indices] = bits[:, 0] > 0
            row[:] = pack(flags)
        return good

    def _good_headings(self, indices: np.ndarray, position: np.ndarray, rotations: np.ndarray,
                       bits: np.ndarray, camera: int) -> list[np.ndarray]:
        """
        Return with which headings visible points meet each of the Q requirements.

        :param indices: (n,) of the points in the engine's order.
        :param rotations: (H, 3, 3) of the headings.
        :param bits: (n, W) uint64, the headings with which each point is visible.
        :returns: Q arrays like ``bits``.
        """
        if not self.limits:
            return []
        rows = self.visibility.order[indices]
        points = self.scene.points[rows].astype(np.float64)
        normals = self.scene.normals_or_estimate[rows].astype(np.float64)
        found = []
        for limits in self.limits:
            found.append(bits.copy())
            keep_measured_well(points, normals, position, rotations, limits[self.kind(camera)],
                               found[-1])
        return found

    def with_validation(self) -> 'Simulator':
        """
        Return the same simulator with the depth error on the validation viewpoints.

        Only views count that the scan proves; see :mod:`ocp_ros.simulation.scan_evidence`.
        """
        other = copy(self)
        other.depth_error = self._validation_error()
        other.evidence = self._scan_evidence()
        return other

    @property
    def volume(self) -> float:
        """Return the volume of the bounding box in cubic metres."""
        return float(self.scene.size.prod())

    def nothing(self) -> Subset:
        """Return the empty subset of the scene's points."""
        return Subset.none(self.visibility.order)

    def kind(self, camera: int) -> int:
        """Return the index of the first camera of the rig that has the same model."""
        # A single model is that of all cameras, whatever their number.
        return self._kinds[camera] if len(self._kinds) > 1 else 0

    def look(self, pose: np.ndarray | Pose, camera: int = 0) -> View:
        """
        Compute the view of one camera.

        :param pose: a row of a placement, or a pose.
        :param camera: the index of the camera in the rig; unused if there is only one model.
        """
        pose, lens = self._aimed(pose, camera)
        view = View(no_bits(len(self.scene)), no_bits(len(self.places)), pose.position)
        self.visibility.look(pose, lens, view.seen, view.covered)
        return view._replace(good=self._good_points(view.seen, pose, camera))

    def look_from_all(self, poses: np.ndarray, cameras: Sequence[int]) -> list[View]:
        """
        Compute the views of n cameras in one compiled call.

        :param poses: (n, 3) or (n, 6), rows of a placement.
        :param cameras: the indices (n,) of the cameras in the rig.
        """
        if not len(poses):
            return []
        aimed = [self._aimed(pose, camera) for camera, pose in zip(cameras, poses)]
        arrays = CameraArrays.of(aimed)
        # A row of packed bits for each camera, none of them set.
        seen, covered = (np.array([no_bits(count)] * len(aimed))
                         for count in (len(self.scene), len(self.places)))
        self.visibility.look_from_all(arrays, seen, covered)
        return [View(*view, self._good_points(view[0], pose, camera)) for view, (pose, _), camera
                in zip(zip(seen, covered, arrays.positions), aimed, cameras)]

    def _aimed(self, pose: np.ndarray | Pose, camera: int) -> tuple[Pose, Frustum]:
        """Return the pose and the lens (field of view, range) of a camera, for the kernels."""
        lens = self._lenses[self.kind(camera)]
        # The heading of an omnidirectional camera has no effect.
        if lens.kind == OMNIDIRECTIONAL:
            pose = pose._replace(rotation=LEVEL) if isinstance(pose, Pose) else pose[:3]
        return pose if isinstance(pose, Pose) else Pose.of(pose), lens

    def look_around(self, position: np.ndarray, headings: np.ndarray, camera: int = 0
                    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Compute what one camera sees from one position with H headings, all from one view.

        :param position: (3,) metres, map frame.
        :param headings: (H, 3) yaw, pitch and roll in radians.
        :param camera: the index of the camera in the rig.
        :returns: the n points visible with any heading, (n,) int32 indices in the engine's order,
            and the headings with which each point is visible: (n, W) uint64, bit k of word w for
            heading 64 w + k, with W words for H headings. For requirement k, N (k + 1) is added
            to the indices of the points that meet it, N being the number of points.
        """
        lens = self._lenses[self.kind(camera)]
        seen = no_bits(len(self.scene))
        around = lens._replace(kind=OMNIDIRECTIONAL)
        self.visibility.look(Pose(position, LEVEL), around, seen)
        indices = np.flatnonzero(unpack(seen, len(self.scene))).astype(np.int32)
        bits = np.zeros((len(indices), -(-len(headings) // 64)), dtype=np.uint64)
        rotations = np.array([rotation_matrix(*heading) for heading in headings])
        mark_headings(self.scene.points[self.visibility.order[indices]], position, rotations, lens,
                      bits)
        all_bits = np.vstack([bits, *self._good_headings(indices, position, rotations, bits,
                                                         camera)])
        rows = np.concatenate([indices + np.int32(k * len(self.scene))
                               for k in range(1 + len(self.limits))])
        in_any = all_bits.any(axis=1)
        return rows[in_any], all_bits[in_any]

    @property
    def row_count(self) -> int:
        """Return the number of points, counted once more for each requirement."""
        return len(self.scene) * (1 + len(self.limits))

    def evaluate_views(self, views: Sequence[View]) -> Evaluation:
        """
        Evaluate cameras, given their views; after the move of one camera, only its view is new.

        :param views: from :meth:`look` or :meth:`look_from_all`, one per camera.
        """
        seen = np.bitwise_or.reduce([view.seen for view in views])
        covered = np.bitwise_or.reduce([view.covered for view in views])
        return Evaluation(Subset(seen, self.visibility.order),
                          self.coverage(covered), self.depth_error(seen))

    def evaluate(self, placement: np.ndarray) -> Evaluation:
        """
        Evaluate a placement.

        :param placement: (K, 3) or (K, 6), K >= 1; if the rig has several kinds of camera, at most
            one row for each camera.
        :raises ConfigurationError: if it is not a placement, or there are more rows than cameras
            of several kinds.
        """
        placement = self._checked_poses(placement)
        if len(placement) > len(self._lenses) > 1:
            raise ConfigurationError(
                f'placement: found {len(placement)} cameras; expected at most '
                f'{len(self._lenses)}, one for each camera of the rig')
        return self.evaluate_views(self.look_from_all(placement, range(len(placement))))

    @staticmethod
    def _checked_poses(poses: Any) -> np.ndarray:
        """Return a placement as a float64 array; refuse anything else."""
        expected = 'expected (K, 3) or (K, 6), metres and radians, a row for each camera'
        try:
            array = np.asarray(poses, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ConfigurationError(f'placement: found {type(poses).__name__} that is no array '
                                     f'of numbers; {expected}') from error
        if array.ndim != 2 or array.shape[1] not in (3, 6) or not len(array):
            raise ConfigurationError(
                f'placement: found an array of shape {array.shape}; {expected}')
        if not np.isfinite(array).all():
            raise ConfigurationError('placement: found NaN or inf; expected finite numbers')
        return array

    def look_many(self, poses: np.ndarray, camera: int = 0, threads: int = 1) -> list[View]:
        """
        Compute the views of a camera from many poses, such as the candidates of a search.

        For poses with the same position one view is computed and clipped to their viewing cones,
        except with the engine's preset ``paper``.

        :param poses: (M, 3) or (M, 6), M poses, as rows of a placement.
        :param camera: the index of the camera in the rig.
        :param threads: the number of threads.
        """
        poses = np.asarray(poses, dtype=np.float64)
        # Sort the poses into groups that have the same position.
        position_number = np.unique(poses[:, :3], axis=0, return_inverse=True)[1].ravel()
        order = np.argsort(position_number, kind='stable')
        groups = np.split(order, np.flatnonzero(np.diff(position_number[order])) + 1)
        with ThreadPoolExecutor(threads) as pool:
            views = [view for group_views in pool.map(
                lambda rows: self._look_from(poses[rows], camera), groups) for view in group_views]
        # The argsort of an order is its inverse: the views return to the order of the poses.
        return [views[index] for index in np.argsort(order)]

    def _look_from(self, poses: np.ndarray, camera: int) -> list[View]:
        """Compute the views of a camera from poses (H, 6) that all have one position."""
        lens, visibility = self._lenses[self.kind(camera)], self.visibility
        # Clipping saves nothing for a single pose or an omnidirectional camera, and the visibility
        # of the preset ``paper`` has no method for it.
        if len(poses) < 2 or lens.kind == OMNIDIRECTIONAL or not isinstance(
                visibility, (SurfelVisibility, RayVisibility)):
            return [self.look(pose, camera) for pose in poses]
        around = View(no_bits(len(self.scene)), no_bits(len(self.places)))
        visibility.look(Pose(poses[0, :3], LEVEL), lens._replace(kind=OMNIDIRECTIONAL),
                        around.seen, around.covered)
        return [view._replace(good=self._good_points(view.seen, Pose.of(pose), camera))
                for view, pose in zip(clipped(visibility, around, poses, lens), poses)]
