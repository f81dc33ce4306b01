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
from dataclasses import replace
from functools import cached_property
from threading import RLock
from typing import Any

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, heading_of, rotation_matrix
from ocp_ros.geometry.engine_config import EngineConfig, PROMISING
from ocp_ros.geometry.packed_bits import unpack
from ocp_ros.report.findings import broken_by, camera_scores, expected, rig_scores
from ocp_ros.rig.feasible_region import FeasibleRegion, satisfies_spacing
from ocp_ros.rig.motion import nearest_place
from ocp_ros.rig.placement_file import as_written, created_by, Placement, placement_of
from ocp_ros.rig.plausibility import missing_surfaces
from ocp_ros.rig.rig_file import Rig
from ocp_ros.scenes.scene import Scene
from ocp_ros.search.proof.certificate import Certificate
from ocp_ros.simulation.objective import Objective, RigEvaluation
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.ray_visibility import with_rays
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator, View
from ocp_ros.studio.state import changed_rig, camera_entry, History, new_name, with_single_entries, State
from ocp_ros.util.settings import ConfigurationError

#: Number of views that are kept for undo and for comparisons.
VIEWS = 64
#: Metres around a pose in which the nearest allowed position is searched for first, and the
#: number of positions spread over the room among which it is searched for then.
AROUND, SPREAD = 1.0, 400
#: Radians: a smaller change of the viewing direction counts as a rotation about it.
SAME_WAY = 1e-3
#: Radians: pitch of the cameras of a new placement, where the rig allows it.
PITCH = np.deg2rad(20.0)


class Evaluation:
    """
    The evaluation of one state; each part is computed when it is first used.

    :ivar problem: the rig in the room.
    :ivar state: the placement.
    :ivar views: of the cameras to be placed.
    """

    def __init__(self, problem: Problem, state: State, views: Sequence[View]) -> None:
        self.problem, self.state, self.views = problem, state, list(views)

    @property
    def objective(self) -> Objective:
        """Return the objective of the rig in the room."""
        return self.problem.objective

    @cached_property
    def worth(self) -> RigEvaluation:
        """Return the objective value and its parts."""
        return self.objective.judge(self.views)

    @cached_property
    def counts(self) -> np.ndarray:
        """Return the number of cameras that see each point: (N,) uint8, in the engine's order."""
        counts = np.zeros(len(self.problem.simulator.scene), dtype=np.uint8)
        for view in (*self.views, *self.objective.fixed):
            counts += unpack(view.seen, len(counts))
        return counts

    @cached_property
    def rig_scores(self) -> dict[str, Any]:
        """Return the scores of the cameras together."""
        return rig_scores(self.objective, self.views, self.worth)

    @cached_property
    def scores(self) -> dict[str, Any]:
        """Return the scores as ``ocp score`` prints them."""
        return {**self.rig_scores, **camera_scores(self.objective, self.views)}

    @cached_property
    def misplaced(self) -> list[str]:
        """Return a sentence for each constraint that the pose of a camera violates."""
        return self.problem.region.broken(self.state.poses)

    def is_misplaced(self, name: str) -> bool:
        """Return whether the pose of a camera violates a constraint."""
        return any(line.startswith(f'{name}: ') for line in self.misplaced)

    @cached_property
    def broken(self) -> list[str]:
        """Return a sentence for each violated constraint, regions included."""
        return broken_by(self.problem.region, self.state.poses, self.scores)

    @cached_property
    def expected(self) -> dict[str, float]:
        """Return the depth error that is expected in the room itself, and its interval."""
        simulator = self.problem.simulator
        return expected(self.worth.depth_error, simulator.depth_error.worst,
                        missing_surfaces(simulator.scene))

    def seen_from(self, camera: int) -> np.ndarray:
        """Return which points a camera sees: (N,) bool, in the engine's order."""
        return unpack(self.views[camera].seen, len(self.problem.simulator.scene))

    def unseen_in_regions(self) -> np.ndarray:
        """Return the points of regions of points whose ``must_see`` is not met: (N,) bool."""
        scene, region = self.problem.simulator.scene, self.problem.region
        found = np.zeros(len(scene), dtype=bool)
        for part, share in zip(self.problem.rig.regions, self.worth.regions):
            if share < part.must_see and part.air is None:
                found |= part.zone.contains(scene.points, region.floor)
        order = self.problem.simulator.visibility.order
        return found[order] & (self.counts < self.problem.rig.seen_by)


class Studio:
    """
    A placement in a room that is edited step by step; threads may share it.

    :param scene: the room.
    :param room: its description, as in placement files.
    :param rig: the rig at the start.
    :param poses: (K, 6) metres, map frame, and radians; None to spread the cameras over the room.
    :param engine: settings of the engine; None for those of ``ocp plan``.
    :param command: for the record in files.
    :ivar lock: for several steps that belong together.
    :raises ConfigurationError: if the rig cannot be used in the room.
    """

    def __init__(self, scene: Scene, room: dict[str, Any], rig: Rig,
                 poses: np.ndarray | None = None, engine: EngineConfig | None = None,
                 command: str = 'ocp studio') -> None:
        self.scene, self.room, self.command, self.lock = scene, room, command, RLock()
        exact = scene.mesh is not None and scene.mesh.exact
        self.engine = engine or (with_rays(PROMISING, scene) if exact else PROMISING)
        rig = with_single_entries(rig)
        self._simulator = Simulator(scene, SimulationConfig(engine=self.engine), rig.models)
        self._views: dict[tuple[CameraModel, bytes], View] = {}
        self._evaluation: Evaluation | None = None
        self._problem = self.problem_of(rig)
        self._places: dict[CameraModel, np.ndarray] = {}
        self._proved: tuple[dict[str, Any], Certificate] | None = None
        self.history = History(State(rig, self._spread(rig) if poses is None else
                                     as_written(poses)))

    @property
    def state(self) -> State:
        """Return the present state."""
        return self.history.now

    @property
    def order(self) -> np.ndarray:
        """Return the index of each point of the engine's order among the room's points: (N,)."""
        return self._simulator.visibility.order

    def problem_of(self, rig: Rig) -> Problem:
        """Return the problem of a rig in the room; it shares the engine of the studio."""
        simulator = self._simulator.with_models(rig.models)
        return Problem(Objective(simulator, rig), FeasibleRegion(self.scene, rig))

    def evaluation(self) -> Evaluation:
        """Evaluate the present state; only cameras that have moved look again."""
        with self.lock:
            state = self.state
            if self._evaluation is None or self._evaluation.state is not state:
                if self._problem.rig is not state.rig:
                    self._use(self.problem_of(state.rig))
                self._evaluation = self.evaluated(self._problem, state)
            return self._evaluation

    def evaluated(self, problem: Problem, state: State) -> Evaluation:
        """Evaluate a state, given the problem of its rig."""
        views = []
        for camera, (model, pose) in enumerate(zip(problem.models, state.poses)):
            key = model, pose.tobytes()
            if key not in self._views:
                self._views[key] = problem.simulator.look(pose, camera)
            # The last views stay.
            self._views[key] = view = self._views.pop(key)
            views.append(view)
        for key in list(self._views)[:-VIEWS]:
            del self._views[key]
        return Evaluation(problem, state, views)

    def _use(self, problem: Problem) -> None:
        """Use the problem of another rig."""
        self._problem = problem
        self._places.clear()

    def change(self, rig: Rig, poses: np.ndarray, locked: frozenset[str] | None = None,
               action: object = None) -> None:
        """
        Set the present state.

        :param poses: (K, 6) metres, map frame, and radians.
        :param action: see :meth:`History.change`.
        :raises ConfigurationError: if the rig cannot be used in the room; the state stays.
        """
        with self.lock:
            if rig is not self._problem.rig:
                self._use(self.problem_of(rig))
            locked = self.state.locked if locked is None else locked
            names = {camera.name for camera in rig.cameras}
            self.history.change(State(rig, as_written(poses), locked & names), action)

    def move(self, camera: int, pose: np.ndarray, action: object = None) -> bool:
        """
        Move a camera.

        :param pose: (6,) metres, map frame, and radians.
        :returns: whether it was moved; False if it is locked, or the pose is not finite.
        """
        with self.lock:
            state = self.state
            # A vanished or hostile page may send anything.
            if not 0 <= camera < len(state.poses) or state.names[camera] in state.locked or not (
                    np.isfinite(pose).all() and np.abs(pose[:3]).max() < 1e4):
                return False
            poses = state.poses.copy()
            poses[camera] = pose
            self.change(state.rig, poses, action=action)
            return True

    def pose_of(self, camera: int, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """
        Return the pose of a camera that was dragged: its roll stays while its direction changes.

        :param position: (3,) metres.
        :param rotation: (3, 3) body frame to map frame.
        """
        before = self.state.poses[camera]
        pose = np.concatenate([position, heading_of(rotation)])
        if np.abs(rotation[:, 0] - rotation_matrix(*before[3:])[:, 0]).max() > SAME_WAY:
            pose[5] = before[5]
        return pose

    def add(self, sensor: str, pose: np.ndarray | None = None) -> int:
        """
        Add a camera, and return its number.

        :param sensor: a preset, or the name of a camera of the rig whose model it gets.
        :param pose: (6,) metres, map frame, and radians; by default where the room has most space.
        """
        with self.lock:
            state = self.state
            entries = state.rig.document.data['cameras']
            like = next((entry for entry in entries if entry['name'] == sensor),
                        {'sensor': sensor})
            name = new_name(sensor, state.rig.all_cameras)
            rig = changed_rig(state.rig, cameras=[*entries, camera_entry(like, name)])
            if pose is None:
                pose = self._spread(rig, state.poses)[-1]
            self.change(rig, np.vstack([state.poses, pose]))
            return len(state.poses)

    def remove(self, camera: int) -> None:
        """Remove a camera; the last one stays."""
        with self.lock:
            state = self.state
            if len(state.poses) < 2:
                raise ConfigurationError('cameras: found one; expected two or more to remove one '
                                         'of them; add another first')
            entries = list(state.rig.document.data['cameras'])
            del entries[camera]
            self.change(changed_rig(state.rig, cameras=entries),
                        np.delete(state.poses, camera, axis=0))

    def set_sensor(self, camera: int, sensor: str) -> None:
        """Give a camera the model of a preset."""
        with self.lock:
            state = self.state
            entries = list(state.rig.document.data['cameras'])
            entries[camera] = {'name': entries[camera]['name'], 'sensor': sensor}
            self.change(changed_rig(state.rig, cameras=entries), state.poses)

    def set_locked(self, camera: int, locked: bool) -> None:
        """Lock a camera, or release it."""
        with self.lock:
            state = self.state
            name = frozenset([state.names[camera]])
            self.change(state.rig, state.poses,
                        state.locked | name if locked else state.locked - name)

    def set_rig(self, **parts: Any) -> None:
        """Change keys of the rig, such as zones; the poses stay."""
        with self.lock:
            self.change(changed_rig(self.state.rig, **parts), self.state.poses)

    def load(self, rig: Rig, poses: np.ndarray | None = None) -> None:
        """Begin to edit another rig; without poses its cameras are spread over the room."""
        with self.lock:
            rig = with_single_entries(rig)
            before = self._problem
            self._use(self.problem_of(rig))
            try:
                poses = self._spread(rig) if poses is None else poses
            except ConfigurationError:
                self._use(before)
                raise
            self.change(rig, poses, frozenset())

    def _spread(self, rig: Rig, taken: np.ndarray | None = None) -> np.ndarray:
        """
        Spread cameras over the places of their mount.

        :param taken: (C, 6) poses of the first cameras, which stay.
        :returns: (K, 6) metres, map frame, and radians.
        """
        poses = np.empty((0, 6)) if taken is None else taken
        region = self.problem_of(rig).region
        for camera in rig.cameras[len(poses):]:
            found, _ = region.places(camera.model, SPREAD)
            others = np.vstack([poses, rig.fixed_poses])[:, :3]
            away = (np.linalg.norm(found.positions[:, None] - others[None], axis=2).min(axis=1)
                    if len(others) else np.zeros(len(found.positions)))
            place = int(np.argmax(away))
            middle = self.scene.bounds.mean(axis=0)[:2] - found.positions[place, :2]
            yaw = float(found.inwards[place]) if rig.mount.on == 'walls' else float(
                np.arctan2(*middle[::-1]))
            poses = np.vstack([poses, [*found.positions[place], yaw,
                                       np.clip(PITCH, *rig.pitch), rig.rolls[0]]])
        return as_written(poses)

    def nearest_allowed(self, evaluation: Evaluation, camera: int) -> np.ndarray | None:
        """
        Find the allowed pose of a camera that is nearest to its pose.

        :returns: (6,) metres, map frame, and radians; None if there is none.
        """
        state, problem = evaluation.state, evaluation.problem
        rig, region, model = state.rig, problem.region, state.rig.cameras[camera].model
        pose = state.poses[camera].copy()
        pose[4] = np.clip(pose[4], *rig.pitch)
        if 'roll' in rig.document.data:
            rolls = np.array(rig.rolls)
            away = np.abs((rolls - pose[5] + np.pi) % (2.0 * np.pi) - np.pi)
            pose[5] = rolls[np.argmin(away)]
        others = np.vstack([np.delete(state.poses, camera, axis=0), rig.fixed_poses])[:, :3]

        def allowed(places: np.ndarray) -> np.ndarray:
            full = np.hstack([places, np.broadcast_to(pose[3:], places.shape)])
            written = as_written(full)
            return (satisfies_spacing(written[:, :3], others, rig.spacing)
                    & region.allowed(written, model))

        place = nearest_place(pose[:3], pose[:3], AROUND, region.onto_mount, allowed)
        if place is None:
            offered = self._places_of(region, model)
            offered = offered[allowed(offered)] if len(offered) else offered
            if len(offered) == 0:
                return None
            first = offered[np.argmin(np.linalg.norm(offered - pose[:3], axis=1))]
            place = nearest_place(first, pose[:3], AROUND, region.onto_mount, allowed)
            place = first if place is None else place
        return as_written(np.concatenate([place, pose[3:]])[None])[0]

    def _places_of(self, region: FeasibleRegion, model: CameraModel) -> np.ndarray:
        """Return positions that are allowed for a camera model, spread over the room: (P, 3)."""
        if model not in self._places:
            try:
                self._places[model] = region.places(model, SPREAD)[0].positions
            except ConfigurationError:
                self._places[model] = np.empty((0, 3))
        return self._places[model]

    def placement(self, scored: bool = False) -> Placement:
        """
        Return the present placement for its file.

        :param scored: whether it has its scores.
        """
        state = self.state
        placement = placement_of(state.rig, state.poses, room=self.room, engine=self.engine,
                                 created=created_by(self.command))
        return replace(placement, scores=self.evaluation().scores) if scored else placement

    def prove(self, rig: Rig, certificate: Certificate) -> None:
        """Keep the lower bound of a search for all placements of this rig."""
        self._proved = rig.document.data, certificate

    def certificate(self, evaluation: Evaluation) -> Certificate | None:
        """Return the last lower bound with the loss of a placement, if it holds for its rig."""
        if self._proved is None or self._proved[0] != evaluation.state.rig.document.data:
            return None
        return replace(self._proved[1], found=evaluation.worth.loss)
