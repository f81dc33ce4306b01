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

"""A time step of the map actor: cameras choose their targets one after the other."""

import numpy as np
from ocp_ros.geometry.cameras import Frustum
from ocp_ros.online.partial_map import PartialMap
from ocp_ros.online.rig_state import fixed_views, RigState
from ocp_ros.policy.observation_map import CELLS, lens_features, ObservationMap
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.simulation.simulator import View


class MapTurn:
    """
    The observation map of a time step, and the current targets of the cameras.

    :param model: partial map of the observed cloud.
    :param space: feasible region of the cameras in the observed part of the room.
    :param unseen: packed bits of the model's cells of the air that no camera has covered yet.
    :param plan: (K, 6) metres, map frame, and radians: target poses of the K cameras;
        :meth:`set_target` changes this array.
    :param positions: (K, 3) metres, map frame: current positions of the cameras.
    :param rig_state: camera models and headings; None for omnidirectional cameras.
    :param max_range: of the cameras, metres.
    :param reach: distance that a camera can still move, metres.
    :param aimed: whether the network values headings of cameras that are not omnidirectional.
    :ivar room: the map; see :class:`~ocp_ros.policy.observation_map.ObservationMap`.
    :ivar cells: (CELLS * CELLS, 2) metres, map frame: centres of the map's cells.
    """

    def __init__(self, model: PartialMap, space: FreePlane, unseen: np.ndarray, plan: np.ndarray,
                 positions: np.ndarray, rig_state: RigState | None, max_range: float, reach: float,
                 aimed: bool = True) -> None:
        self.model = model
        self.unseen = unseen
        self.plan = plan
        self.positions = positions
        self._rig_state = rig_state
        self._reach = reach
        self._aimed = aimed
        self.room = ObservationMap(model, unseen, len(plan), max_range,
                                   height=float(np.median(positions[:, 2])))
        self.cells = self.room.window.centres.reshape(-1, 2)
        self._free = space.contains(self.cells)
        self._fixed = fixed_views(model, rig_state)
        self._views = [self.look(camera, pose[None])[0] for camera, pose in enumerate(plan)]

    def other_views(self, camera: int) -> list[View]:
        """Return the views of the other cameras at their targets, and of fixed cameras."""
        return [view for k, view in enumerate(self._views) if k != camera] + self._fixed

    def inputs(self, camera: int) -> dict[str, np.ndarray]:
        """
        Return the network's inputs for a camera.

        :returns: ``room``, ``others``, ``numbers`` and ``lens``; see
            :class:`~ocp_ros.policy.value_network.ValueMap`.
        """
        other_poses = np.delete(self.plan, camera, axis=0)
        others, numbers = self.room.others(self.other_views(camera), other_poses)
        return {'room': self.room.room, 'others': others, 'numbers': numbers,
                'lens': lens_features(self._lens(camera) if self._aimed else None)}

    def experience(self, camera: int) -> dict[str, np.ndarray]:
        """
        Return the inputs of soft actor-critic for a camera: :meth:`inputs` and :meth:`choices`.

        Soft actor-critic trains the network for omnidirectional cameras, so ``lens`` is left out.
        """
        inputs = self.inputs(camera)
        del inputs['lens']
        return inputs | {'choices': self.choices(camera)}

    def distances(self, camera: int) -> np.ndarray:
        """Return the distances of all cells from a camera: (CELLS * CELLS,) metres."""
        return np.linalg.norm(self.cells - self.positions[camera, :2], axis=-1)

    def feasible_cells(self, camera: int) -> np.ndarray:
        """Return whether each cell is feasible and near enough: (CELLS * CELLS,) bool."""
        return self._free & (self.distances(camera) <= self._reach)

    def choices(self, camera: int) -> np.ndarray:
        """
        Return whether a camera may choose each cell: (CELLS, CELLS) uint8, 1 or 0.

        If no cell is feasible, the camera may choose the cell nearest to its target.
        """
        allowed = self.feasible_cells(camera)
        if not allowed.any():
            allowed[self._nearest_cell(self.plan[camera, :2], np.ones_like(allowed))] = True
        return allowed.reshape(CELLS, CELLS).astype(np.uint8)

    def place(self, camera: int, action: np.ndarray) -> np.ndarray:
        """
        Return the centre of the allowed cell nearest to an action: (2,) metres, map frame.

        :param action: (2,) x and y from the centre of the map, in units of half its side.
        """
        window = self.room.window
        wanted = window.low + 0.5 * CELLS * window.edge * (np.asarray(action, np.float64) + 1.0)
        return self.cells[self._nearest_cell(wanted, self.choices(camera).ravel() > 0)]

    def _nearest_cell(self, place: np.ndarray, allowed: np.ndarray) -> int:
        """Return the number of the cell nearest to a place (2,), among ``allowed`` cells."""
        distances = np.linalg.norm(self.cells - place, axis=1)
        return int(np.argmin(np.where(allowed, distances, np.inf)))

    def set_target(self, camera: int, pose: np.ndarray, view: View | None = None) -> None:
        """
        Set the target pose of a camera; cameras that choose later use it.

        :param camera: number of the camera, from 0.
        :param pose: (6,) metres, map frame, and radians.
        :param view: the camera's view from this pose; None to compute it.
        """
        self.plan[camera] = pose
        self._views[camera] = self.look(camera, pose[None])[0] if view is None else view

    def send_to(self, camera: int, action: np.ndarray) -> None:
        """Set the target of a camera to :meth:`place` of an action; its heading is kept."""
        place = self.place(camera, action)
        self.set_target(camera, np.concatenate([place, self.plan[camera, 2:]]))

    def _lens(self, camera: int) -> Frustum | None:
        """Return the frustum of a camera; None for an omnidirectional camera."""
        return None if self._rig_state is None else self._rig_state.lenses[camera]

    def look(self, camera: int, poses: np.ndarray) -> list[View]:
        """
        Return the views of a camera from poses, in their order.

        :param poses: (M, 6) metres, map frame, and radians; M poses, those at the same position
            one after the other.
        """
        lens = self._lens(camera)
        if lens is None:
            return [self.model.look(pose[:3]) for pose in poses]
        # The poses at one position form a group, which needs one omnidirectional view.
        starts = np.flatnonzero(np.any(np.diff(poses[:, :3], axis=0), axis=1)) + 1
        return [view for group in np.split(poses, starts)
                for view in self.model.look_many(group[0, :3], group[:, 3:], lens)]
