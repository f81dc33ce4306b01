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
    :param plan: (K, 6) metres and radians: target pose of each camera.
    :param positions: (K, 3) metres: current positions of the cameras.
    :param rig_state: camera models and headings; None for omnidirectional cameras.
    :param max_range: of the cameras, metres.
    :param reach: distance that a camera can still move, metres.
    :param aimed: whether the network values headings of cameras that are not omnidirectional.
    :ivar room: the map; see :class:`~ocp_ros.policy.observation_map.ObservationMap`.
    :ivar cells: (CELLS * CELLS, 2) metres: the centres of the cells of the map.
    """

    def __init__(self, model: PartialMap, space: FreePlane, unseen: np.ndarray, plan: np.ndarray,
                 positions: np.ndarray, rig_state: RigState | None, max_range: float, reach: float,
                 aimed: bool = True) -> None:
        self.model = model
        self.unseen = unseen
        self.plan = plan
        self.positions = positions
        self._sight = rig_state
        self._reach = reach
        self._aimed = aimed
        self.room = ObservationMap(model, unseen, len(plan), max_range,
                                   float(np.median(positions[:, 2])))
        self.cells = self.room.window.middles.reshape(-1, 2)
        self._free = space.contains(self.cells)
        self._fixed = fixed_views(model, rig_state)
        self._views = [self.look(camera, row[None])[0] for camera, row in enumerate(plan)]

    def beside(self, camera: int) -> list[View]:
        """Return the views of all other cameras at their targets, fixed cameras included."""
        return [view for k, view in enumerate(self._views) if k != camera] + self._fixed

    def inputs(self, camera: int) -> dict[str, np.ndarray]:
        """
        Return the network's inputs for a camera.

        :returns: ``room``, ``others``, ``numbers`` and ``lens``; see
            :class:`~ocp_ros.policy.value_network.ValueMap`.
        """
        others, numbers = self.room.others(self.beside(camera), np.delete(self.plan, camera, 0))
        return {'room': self.room.room, 'others': others, 'numbers': numbers,
                'lens': lens_features(self._lens(camera) if self._aimed else None)}

    def experience(self, camera: int) -> dict[str, np.ndarray]:
        """
        Return the inputs of soft actor-critic for a camera: :meth:`inputs` and the choices.

        It trains the network for omnidirectional cameras, so ``lens`` is left out.
        """
        inputs = self.inputs(camera)
        del inputs['lens']
        return inputs | {'choices': self.choices(camera)}

    def away(self, camera: int) -> np.ndarray:
        """Return the distance of each cell from a camera: (CELLS * CELLS,) metres."""
        return np.linalg.norm(self.cells - self.positions[camera, :2], axis=-1)

    def open_to(self, camera: int) -> np.ndarray:
        """Return the feasible cells that a camera reaches in time: (CELLS * CELLS,) bool."""
        return self._free & (self.away(camera) <= self._reach)

    def choices(self, camera: int) -> np.ndarray:
        """
        Return the cells among which a camera may choose: (CELLS, CELLS) uint8, 1 or 0.

        There is at least one: without a feasible cell, it is the cell nearest to the target.
        """
        free = self.open_to(camera)
        if not free.any():
            free[self._next_to(self.plan[camera, :2], np.ones_like(free))] = True
        return free.reshape(CELLS, CELLS).astype(np.uint8)

    def place(self, camera: int, action: np.ndarray) -> np.ndarray:
        """
        Return the place of an action: (2,) metres, the nearest of :meth:`choices`.

        :param action: (2,) from the centre of the map, in units of half its side.
        """
        window = self.room.window
        wanted = window.low + 0.5 * CELLS * window.edge * (np.asarray(action, np.float64) + 1.0)
        return self.cells[self._next_to(wanted, self.choices(camera).ravel() > 0)]

    def _next_to(self, place: np.ndarray, free: np.ndarray) -> int:
        """Return the cell that is nearest to a place, among the free ones (CELLS * CELLS,)."""
        return int(np.argmin(np.where(free, np.linalg.norm(self.cells - place, axis=1), np.inf)))

    def send(self, camera: int, row: np.ndarray, view: View | None = None) -> None:
        """
        Set the target pose of a camera; cameras that choose later use it.

        :param row: (6,) metres and radians.
        :param view: the view from there; None to compute it.
        """
        self.plan[camera] = row
        self._views[camera] = self.look(camera, row[None])[0] if view is None else view

    def send_to(self, camera: int, action: np.ndarray) -> None:
        """Set the target of a camera to the place of an action; its heading does not change."""
        self.send(camera, np.concatenate([self.place(camera, action), self.plan[camera, 2:]]))

    def _lens(self, camera: int) -> Frustum | None:
        """Return the frustum of a camera; None for an omnidirectional camera."""
        return None if self._sight is None else self._sight.lenses[camera]

    def look(self, camera: int, rows: np.ndarray) -> list[View]:
        """Compute the views from poses (M, 6); poses at one position are consecutive rows."""
        lens = self._lens(camera)
        if lens is None:
            return [self.model.look(row[:3]) for row in rows]
        ends = np.flatnonzero(np.any(np.diff(rows[:, :3], axis=0), axis=1)) + 1
        return [view for some in np.split(rows, ends)
                for view in self.model.look_many(some[0, :3], some[:, 3:], lens)]
