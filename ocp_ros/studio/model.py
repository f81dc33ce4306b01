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

"""The studio without its page: the room, the placement being edited, and its evaluation."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
import re
from threading import RLock
from typing import Any

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, heading_of, rotation_matrix
from ocp_ros.geometry.engine_config import EngineConfig, PROMISING
from ocp_ros.geometry.packed_bits import unpack
from ocp_ros.report.findings import broken_by, camera_scores, expected_error, rig_scores
from ocp_ros.rig.feasible_region import FeasibleRegion, satisfies_spacing
from ocp_ros.rig.motion import nearest_place
from ocp_ros.rig.placement_file import as_written, created_by, Placement, placement_of
from ocp_ros.rig.rig_file import Camera, Rig, rig_from
from ocp_ros.rig.schemas import MAX_COORDINATE_M, MAX_NAME_LENGTH, RIG
from ocp_ros.scenes.scene import Scene
from ocp_ros.search.proof.certificate import Certificate
from ocp_ros.simulation.objective import Objective, RigEvaluation
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.ray_visibility import with_rays
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator, View
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.yaml_files import check, Document

#: Largest number of positions that are spread over the mount of a camera.
MAX_POSITIONS = 400
#: A camera is moved at most this far out of the room's bounding box, metres.
MAX_OUTSIDE_M = 10.0


@dataclass(frozen=True, eq=False)
class State:
    """
    The placement at one moment of the editing; a state never changes.

    :ivar rig: cameras, constraints and tasks; its document has one entry for each of the K cameras
        to be placed.
    :ivar poses: (K, 6) metres, map frame, and radians, rounded as in placement files.
    :ivar locked: names of the cameras that neither a person nor a planner may move.
    """

    rig: Rig
    poses: np.ndarray
    locked: frozenset[str] = frozenset()

    @property
    def names(self) -> list[str]:
        """Return the names of the cameras to be placed."""
        return [camera.name for camera in self.rig.cameras]


@dataclass
class History:
    """The present state, and the states that undo and redo bring back."""

    present: State
    past_states: list[State] = field(default_factory=list)
    undone_states: list[State] = field(default_factory=list)
    #: The action that led to the present state.
    _action: object = None

    def set_present(self, state: State, action: object = None) -> None:
        """
        Make a state the present one.

        :param action: identifies an action of several changes, such as a drag, which are undone
            together; None if this change is the whole action.
        """
        if action is None or action != self._action:
            # At most 200 states can be undone.
            self.past_states = [*self.past_states, self.present][-200:]
        self.present = state
        self.undone_states = []
        self._action = action

    def undo(self) -> bool:
        """Go back to the previous state; return whether there was one."""
        return self._move_state(self.past_states, self.undone_states)

    def redo(self) -> bool:
        """Go to the state that was undone last; return whether there was one."""
        return self._move_state(self.undone_states, self.past_states)

    def _move_state(self, source: list[State], target: list[State]) -> bool:
        """Append the present state to ``target``, and take the new one from ``source``."""
        if not source:
            return False
        target.append(self.present)
        self.present = source.pop()
        # The next change becomes a step of its own, also if it belongs to the same action.
        self._action = None
        return True


class Evaluation:
    """
    The evaluation of one state; each property is computed when it is first used.

    N is the number of points of the room. Their order is that of the engine, which
    :attr:`Studio.point_order` describes.

    :ivar problem: the rig in the room.
    :ivar state: the placement.
    :ivar views: what each camera to be placed sees.
    """

    def __init__(self, problem: Problem, state: State, views: Sequence[View]) -> None:
        self.problem, self.state, self.views = problem, state, list(views)

    @property
    def objective(self) -> Objective:
        """Return the objective of the rig in the room."""
        return self.problem.objective

    @cached_property
    def rig_evaluation(self) -> RigEvaluation:
        """Return the objective value and its parts."""
        return self.objective.evaluate_views(self.views)

    @cached_property
    def camera_counts(self) -> np.ndarray:
        """Return the number of cameras that see each point: (N,) uint8."""
        counts = np.zeros(len(self.problem.simulator.scene), dtype=np.uint8)
        for view in (*self.views, *self.objective.fixed):
            counts += unpack(view.seen, len(counts))
        return counts

    @cached_property
    def rig_scores(self) -> dict[str, Any]:
        """Return the scores of all cameras together, by name."""
        return rig_scores(self.objective, self.views, self.rig_evaluation)

    @cached_property
    def scores(self) -> dict[str, Any]:
        """Return the scores that ``ocp score`` prints: of all cameras together, and of each."""
        return {**self.rig_scores, **camera_scores(self.objective, self.views)}

    @cached_property
    def violations(self) -> list[str]:
        """Return a sentence for each constraint that the pose of a camera violates."""
        return self.problem.region.broken(self.state.poses)

    def violates_constraint(self, name: str) -> bool:
        """Return whether the pose of a camera violates a constraint."""
        # Each sentence begins with the name of the camera whose pose violates the constraint.
        return any(line.startswith(f'{name}: ') for line in self.violations)

    @cached_property
    def all_violations(self) -> list[str]:
        """Return a sentence for each constraint that a pose or the placement violates."""
        return broken_by(self.problem.region, self.state.poses, self.scores)

    @cached_property
    def expected_error(self) -> dict[str, float]:
        """Return the depth error to expect in the real room, and its interval, metres."""
        return expected_error(self.objective, self.rig_scores)

    def points_seen_by(self, camera: int) -> np.ndarray:
        """Return whether a camera sees each point: (N,) bool."""
        return unpack(self.views[camera].seen, len(self.problem.simulator.scene))

    def unseen_required_points(self) -> np.ndarray:
        """
        Return whether each point lacks cameras and belongs to a region that fails: (N,) bool.

        A region fails if the seen share of its points is less than its ``must_see``. Regions of
        air have no points.
        """
        scene = self.problem.simulator.scene
        required = np.zeros(len(scene), dtype=bool)
        for region, seen_share in zip(self.problem.rig.regions, self.rig_evaluation.regions):
            if seen_share < region.must_see and region.air is None:
                required |= region.zone.contains(scene.points, self.problem.region.floor)
        order = self.problem.simulator.visibility.order
        return required[order] & (self.camera_counts < self.problem.rig.seen_by)


class Studio:
    """
    A placement in a room that is edited step by step; threads may share it.

    :param scene: the room.
    :param room: description of the room, as in placement files.
    :param rig: the rig at the start.
    :param poses: (K, 6) poses of the K cameras to be placed, metres, map frame, and radians; None
        to spread the cameras over the room.
    :param engine: settings of the engine; None for those of ``ocp plan``.
    :param command: the command line, for the record in files.
    :ivar history: the present placement, and those that undo and redo bring back.
    :ivar lock: held while a thread reads or changes the placement in several steps.
    :raises ConfigurationError: if the rig cannot be used in the room.
    """

    def __init__(self, scene: Scene, room: dict[str, Any], rig: Rig,
                 poses: np.ndarray | None = None, engine: EngineConfig | None = None,
                 command: str = 'ocp studio') -> None:
        self.scene, self.room, self.command = scene, room, command
        self.lock = RLock()
        has_exact_mesh = scene.mesh is not None and scene.mesh.exact
        self.engine = engine or (with_rays(PROMISING, scene) if has_exact_mesh else PROMISING)
        rig = split_groups(rig)
        self._simulator = Simulator(scene, SimulationConfig(engine=self.engine), rig.models)
        #: Views by engine, camera model, pose and limits; those that were used last come last.
        self._views: dict[tuple[object, CameraModel, bytes, object], View] = {}
        self._evaluation: Evaluation | None = None
        self._problem = self.problem_of(rig)
        #: Cached positions for :meth:`_allowed_positions`.
        self._positions_by_model: dict[CameraModel, np.ndarray] = {}
        #: The document of a rig, and the lower bound for this rig.
        self._certificate: tuple[dict[str, Any], Certificate] | None = None
        self.history = History(State(rig, self._spread_cameras(rig) if poses is None else
                                     as_written(poses)))

    @property
    def state(self) -> State:
        """Return the present state."""
        return self.history.present

    @property
    def point_order(self) -> np.ndarray:
        """Return the index in ``scene.points`` of each point in the engine's order: (N,) int."""
        return self._simulator.visibility.order

    def problem_of(self, rig: Rig) -> Problem:
        """Return the problem of a rig in the room; all problems share the studio's engine."""
        simulator = self._simulator.with_models(rig.models)
        return Problem(Objective(simulator, rig), FeasibleRegion(self.scene, rig))

    def evaluation(self) -> Evaluation:
        """Return the evaluation of the present state; only cameras that have moved look again."""
        with self.lock:
            state = self.state
            if self._evaluation is None or self._evaluation.state is not state:
                if self._problem.rig is not state.rig:
                    self._set_problem(self.problem_of(state.rig))
                self._evaluation = self.evaluate(self._problem, state)
            return self._evaluation

    def evaluate(self, problem: Problem, state: State) -> Evaluation:
        """
        Evaluate a state, given the problem of its rig.

        The last 64 views are kept, so that undo and comparisons need not compute them again.
        """
        views = []
        for camera, (model, pose) in enumerate(zip(problem.models, state.poses)):
            # Regions of air change the cells of a view, requirements its good points.
            key = (problem.simulator.visibility, model, pose.tobytes(), problem.simulator.limits)
            view = self._views.pop(key, None)
            if view is None:
                view = problem.simulator.look(pose, camera)
            # The view moves to the end, which holds the views that were used last.
            self._views[key] = view
            views.append(view)
        for key in list(self._views)[:-64]:
            del self._views[key]
        return Evaluation(problem, state, views)

    def _set_problem(self, problem: Problem) -> None:
        """Set the problem of another rig, and forget the positions of the old one."""
        self._problem = problem
        self._positions_by_model.clear()

    def set_placement(self, rig: Rig, poses: np.ndarray, locked: frozenset[str] | None = None,
                      action: object = None) -> None:
        """
        Set the present placement.

        :param poses: (K, 6) poses of the K cameras to be placed, metres, map frame, and radians.
        :param locked: names of the locked cameras; None if the same ones stay locked.
        :param action: see :meth:`History.set_present`.
        :raises ConfigurationError: if the rig cannot be used in the room, or if a placement file
            may not have the poses; the placement stays.
        """
        with self.lock:
            poses = as_written(poses)
            if not (np.isfinite(poses).all() and np.abs(poses[:, :3]).max() <= MAX_COORDINATE_M):
                raise ConfigurationError(
                    'poses: found a pose that is not finite or is too far away; expected '
                    f'coordinates up to {MAX_COORDINATE_M:g} m; correct it')
            problem = self._problem if rig is self._problem.rig else self.problem_of(rig)
            locked = self.state.locked if locked is None else locked
            # Removed cameras are no longer locked.
            names = {camera.name for camera in rig.cameras}
            state = State(rig, poses, locked & names)
            # A placement that cannot be evaluated never becomes the present one.
            evaluation = self.evaluate(problem, state)
            if problem is not self._problem:
                self._set_problem(problem)
            self._evaluation = evaluation
            self.history.set_present(state, action)

    def move_camera(self, camera: int, pose: np.ndarray, action: object = None) -> bool:
        """
        Move a camera, at most 10 m out of the room.

        :param camera: number of the camera.
        :param pose: (6,) metres, map frame, and radians; the pitch is limited to 90 degrees.
        :param action: see :meth:`History.set_present`.
        :returns: whether the camera was moved; False if there is no such camera, if the camera is
            locked, or if the pose is not finite.
        """
        with self.lock:
            state = self.state
            if not (0 <= camera < len(state.poses) and np.isfinite(pose).all()) or (
                    state.names[camera] in state.locked):
                return False
            poses = state.poses.copy()
            poses[camera] = self._limited(pose)
            self.set_placement(state.rig, poses, action=action)
            return True

    def _limited(self, pose: np.ndarray) -> np.ndarray:
        """Return a pose (6,) near the room, with yaw and roll from -pi to pi."""
        # A browser may send any numbers.
        low, high = self.scene.bounds
        position = np.clip(pose[:3], low - MAX_OUTSIDE_M, high + MAX_OUTSIDE_M)
        angles = np.where(np.abs(pose[3:]) > np.pi, np.pi - (np.pi - pose[3:]) % (2.0 * np.pi),
                          pose[3:])
        angles[1] = np.clip(pose[4], -0.5 * np.pi, 0.5 * np.pi)
        return np.concatenate([position, angles])

    def dragged_pose(self, camera: int, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """
        Return the pose of a dragged camera; a new viewing direction does not change the roll.

        :param camera: number of the camera.
        :param position: (3,) position to which the camera was dragged, metres, map frame.
        :param rotation: (3, 3) rotation to which it was dragged, from body frame to map frame.
        :returns: (6,) metres, map frame, and radians.
        """
        previous = self.state.poses[camera]
        pose = np.concatenate([position, heading_of(rotation)])
        # If the viewing direction, the first column, is new, the roll did not change on purpose.
        if np.abs(rotation[:, 0] - rotation_matrix(*previous[3:])[:, 0]).max() > 1e-3:
            pose[5] = previous[5]
        return pose

    def add_camera(self, sensor: str, pose: np.ndarray | None = None) -> int:
        """
        Add a camera, and return its number.

        :param sensor: name of a camera of the rig, which is copied, or name of a preset.
        :param pose: (6,) metres, map frame, and radians; None for the position on the mount that
            is farthest from all other cameras.
        """
        with self.lock:
            state = self.state
            entries = state.rig.document.data['cameras']
            # Without such a camera, the name is that of a preset.
            template = next((entry for entry in entries if entry['name'] == sensor),
                            {'sensor': sensor})
            name = new_name(sensor, state.rig.all_cameras)
            rig = changed_rig(state.rig, cameras=[*entries, camera_entry(template, name)])
            if pose is None:
                pose = self._spread_cameras(rig, state.poses)[-1]
            self.set_placement(rig, np.vstack([state.poses, self._limited(pose)]))
            return len(state.poses)

    def remove_camera(self, camera: int) -> None:
        """
        Remove a camera.

        :raises ConfigurationError: if there is no other camera.
        """
        with self.lock:
            state = self.state
            if len(state.poses) < 2:
                raise ConfigurationError('cameras: found one; expected two or more to remove one '
                                         'of them; add another first')
            entries = list(state.rig.document.data['cameras'])
            del entries[camera]
            self.set_placement(changed_rig(state.rig, cameras=entries),
                               np.delete(state.poses, camera, axis=0))

    def set_sensor(self, camera: int, sensor: str) -> None:
        """Give a camera the model of a preset."""
        with self.lock:
            state = self.state
            entries = list(state.rig.document.data['cameras'])
            entries[camera] = {'name': entries[camera]['name'], 'sensor': sensor}
            self.set_placement(changed_rig(state.rig, cameras=entries), state.poses)

    def set_locked(self, camera: int, locked: bool) -> None:
        """Lock a camera, or unlock it."""
        with self.lock:
            state = self.state
            names = frozenset([state.names[camera]])
            self.set_placement(state.rig, state.poses,
                               state.locked | names if locked else state.locked - names)

    def set_rig(self, **new_values: Any) -> None:
        """Change values of the rig by their keys, such as zones; the poses stay."""
        with self.lock:
            self.set_placement(changed_rig(self.state.rig, **new_values), self.state.poses)

    def replace_rig(self, rig: Rig, poses: np.ndarray | None = None) -> None:
        """
        Begin to edit another rig; no camera is locked.

        :param poses: (K, 6) poses of the K cameras to be placed, metres, map frame, and radians;
            None to spread the cameras over the room.
        :raises ConfigurationError: if the rig cannot be used in the room; the placement stays.
        """
        with self.lock:
            rig = split_groups(rig)
            poses = self._spread_cameras(rig) if poses is None else poses
            self.set_placement(rig, poses, frozenset())

    def _spread_cameras(self, rig: Rig, first_poses: Sequence | np.ndarray = ()) -> np.ndarray:
        """
        Put each camera on its mount, as far as possible from the cameras before.

        :param first_poses: (6,) each, poses of the first cameras, which stay.
        :returns: (K, 6) poses of all K cameras, metres, map frame, and radians.
        """
        poses = np.reshape(first_poses, (-1, 6))
        region = self.problem_of(rig).region
        # The pitch is the allowed one nearest to 20 degrees.
        pitch = np.clip(np.deg2rad(20.0), *rig.pitch)
        for camera in rig.cameras[len(poses):]:
            places, _ = region.places(camera.model, MAX_POSITIONS)
            others = np.vstack([poses, rig.fixed_poses])[:, :3]
            distances = (np.linalg.norm(places.positions[:, None] - others[None], axis=2)
                         .min(axis=1) if len(others) else np.zeros(len(places.positions)))
            farthest = int(np.argmax(distances))
            position = places.positions[farthest]
            to_x, to_y = self.scene.bounds.mean(axis=0)[:2] - position[:2]
            # Away from the wall, or towards the centre of the room.
            yaw = places.inwards[farthest] if rig.mount.on == 'walls' else np.arctan2(to_y, to_x)
            poses = np.vstack([poses, [*position, yaw, pitch, rig.rolls[0]]])
        return as_written(poses)

    def nearest_allowed(self, evaluation: Evaluation, camera: int) -> np.ndarray | None:
        """
        Find the allowed pose of a camera that is nearest to its pose.

        :param evaluation: of the placement.
        :param camera: number of the camera.
        :returns: (6,) metres, map frame, and radians; None if no pose is allowed.
        """
        state, region = evaluation.state, evaluation.problem.region
        rig, model = state.rig, state.rig.cameras[camera].model
        pose = state.poses[camera].copy()
        # The yaw stays; pitch and roll become the nearest allowed ones.
        pose[4] = np.clip(pose[4], *rig.pitch)
        # Without the key, any roll is allowed.
        if 'roll' in rig.document.data:
            rolls = np.array(rig.rolls)
            # Differences of angles, wrapped to -pi up to pi.
            differences = np.abs((rolls - pose[5] + np.pi) % (2.0 * np.pi) - np.pi)
            pose[5] = rolls[np.argmin(differences)]
        others = np.vstack([np.delete(state.poses, camera, axis=0), rig.fixed_poses])[:, :3]

        def are_allowed(positions: np.ndarray) -> np.ndarray:
            poses = as_written(np.hstack([positions, np.broadcast_to(pose[3:], positions.shape)]))
            return (satisfies_spacing(poses[:, :3], others, rig.spacing)
                    & region.allowed(poses, model))

        # This searches up to 1 m around a position for the one that is nearest to the pose.
        nearest_around = partial(nearest_place, target=pose[:3], reach=1.0,
                                 move_onto_mount=region.onto_mount, are_allowed=are_allowed)
        nearest = nearest_around(pose[:3])
        # If it finds none, search around another position: of the allowed ones all over the mount,
        # the one nearest to the pose.
        if nearest is None:
            positions = self._allowed_positions(region, model)
            if len(positions):
                positions = positions[are_allowed(positions)]
            if len(positions) == 0:
                return None
            start = positions[np.argmin(np.linalg.norm(positions - pose[:3], axis=1))]
            nearest = nearest_around(start)
            nearest = start if nearest is None else nearest
        return as_written(np.concatenate([nearest, pose[3:]])[None])[0]

    def _allowed_positions(self, region: FeasibleRegion, model: CameraModel) -> np.ndarray:
        """
        Return P feasible positions of a camera, spread over the room: (P, 3) metres.

        P is 0 if no position is feasible.
        """
        if model not in self._positions_by_model:
            try:
                mount_places, *_ = region.places(model, MAX_POSITIONS)
                self._positions_by_model[model] = mount_places.positions
            except ConfigurationError:
                self._positions_by_model[model] = np.empty((0, 3))
        return self._positions_by_model[model]

    def placement(self, scored: bool = False) -> Placement:
        """
        Return the present placement as placement files record it.

        :param scored: whether to add the scores.
        """
        state = self.state
        placement = placement_of(state.rig, state.poses, room=self.room, engine=self.engine,
                                 created=created_by(self.command))
        return replace(placement, scores=self.evaluation().scores) if scored else placement

    def set_certificate(self, rig: Rig, certificate: Certificate) -> None:
        """Set the lower bound that a search has found for all placements of a rig."""
        self._certificate = rig.document.data, certificate

    def certificate(self, evaluation: Evaluation) -> Certificate | None:
        """Return the last lower bound and the loss of a placement; None if the rig has none."""
        if self._certificate is None or self._certificate[0] != evaluation.state.rig.document.data:
            return None
        return replace(self._certificate[1], found=evaluation.rig_evaluation.loss)


def changed_rig(rig: Rig, **new_values: Any) -> Rig:
    """
    Return a rig with other values of some keys of its document.

    :param new_values: by the keys of the document.
    :raises ConfigurationError: if a value cannot be used.
    """
    document = Document(rig.document.name, {**rig.document.data, **new_values})
    check(document, RIG)
    return rig_from(document)


def split_groups(rig: Rig) -> Rig:
    """Return the same rig with one named entry in its document for each camera to be placed."""
    # One entry per camera, in the order of ``rig.cameras``.
    groups = [group for group in rig.document.data['cameras']
              for _ in range(group.get('count', 1))]
    entries = [camera_entry(group, camera.name) for group, camera in zip(groups, rig.cameras)]
    for entry, camera in zip(entries, rig.cameras):
        if camera.device.serial:
            entry['serial'] = camera.device.serial
    return changed_rig(rig, cameras=entries)


def camera_entry(group: dict[str, Any], name: str) -> dict[str, Any]:
    """
    Return the entry of a single camera with a name.

    :param group: the entry of one or more cameras of the same kind.
    """
    return {'name': name, **{key: value for key, value in group.items()
                             if key not in ('name', 'count', 'serial')}}


def new_name(stem: str, cameras: Sequence[Camera]) -> str:
    """Return a name that no camera has: the stem, followed by a number if necessary."""
    used_names = {camera.name for camera in cameras}
    # The number of the stem is replaced by another one; 4 characters are for _ and this number.
    if stem in used_names:
        stem = re.sub(r'_\d+$', '', stem)[:MAX_NAME_LENGTH - 4]
    names = (stem, *(f'{stem}_{k}' for k in range(1, len(used_names) + 2)))
    return next(name for name in names if name not in used_names)
