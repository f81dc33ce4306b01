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

"""A turn of the map actor: cameras choose, one after the other, where they go."""

import numpy as np
from ocp_ros.geometry.cameras import Frustum
from ocp_ros.online.observation_map import CELLS, lens_features, ObservationMap
from ocp_ros.online.partial_map import PartialMap
from ocp_ros.online.rig_state import fixed_views, RigState
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.simulation.simulator import View


class MapTurn:
    """
    What is known at a turn, and where each camera goes as far as it has chosen.

    :param model: the engine on what has been seen.
    :param space: where cameras may be, as far as has been seen.
    :param unseen: packed bits of the model's cells of the air that no camera has covered yet.
    :param plan: (K, 6) metres and radians: where each camera goes, and how it is turned there.
    :param positions: (K, 3) metres: where the cameras are.
    :param rig_state: how they stand and what each sees; None for 360-degree cameras.
    :param max_range: of the cameras, metres.
    :param reach: how far a camera may still go, metres.
    :param aimed: whether cameras that do not see all around are valued by heading.
    :ivar room: the map; see :class:`~ocp_ros.online.observation_map.ObservationMap`.
    :ivar cells: (CELLS * CELLS, 2) metres: the middles of the cells of the map.
    """

    def __init__(self, model: PartialMap, space: FreePlane, unseen: np.ndarray, plan: np.ndarray,
                 positions: np.ndarray, rig_state: RigState | None, max_range: float, reach: float,
                 aimed: bool = True) -> None:
        self.model, self.unseen, self.plan, self.positions = model, unseen, plan, positions
        self._sight, self._reach, self._aimed = rig_state, reach, aimed
        self.room = ObservationMap(model, unseen, len(plan), max_range,
                                   float(np.median(positions[:, 2])))
        self.cells = self.room.window.middles.reshape(-1, 2)
        self._free = space.contains(self.cells)
        self._fixed = fixed_views(model, rig_state)
        self._views = [self.look(camera, row[None])[0] for camera, row in enumerate(plan)]

    def beside(self, camera: int) -> list[View]:
        """Return what all others see, those in place included, from where they go."""
        return [view for k, view in enumerate(self._views) if k != camera] + self._fixed

    def inputs(self, camera: int) -> dict[str, np.ndarray]:
        """
        Return what the network reads for a camera.

        :returns: ``room``, ``others``, ``numbers`` and ``lens``; see
            :class:`~ocp_ros.policy.value_network.ValueMap`.
        """
        others, numbers = self.room.others(self.beside(camera), np.delete(self.plan, camera, 0))
        return {'room': self.room.room, 'others': others, 'numbers': numbers,
                'lens': lens_features(self._lens(camera) if self._aimed else None)}

    def experience(self, camera: int) -> dict[str, np.ndarray]:
        """
        Return what soft actor-critic reads for a camera: :meth:`inputs` and the choices.

        It learns where cameras go that see all around, so it reads of no lens.
        """
        inputs = self.inputs(camera)
        del inputs['lens']
        return inputs | {'choices': self.choices(camera)}

    def away(self, camera: int) -> np.ndarray:
        """Return how far each cell is from a camera: (CELLS * CELLS,) metres."""
        return np.linalg.norm(self.cells - self.positions[camera, :2], axis=-1)

    def open_to(self, camera: int) -> np.ndarray:
        """Return over which cells a camera may be and can be in time: (CELLS * CELLS,) bool."""
        return self._free & (self.away(camera) <= self._reach)

    def choices(self, camera: int) -> np.ndarray:
        """
        Return the cells among which a camera may choose: (CELLS, CELLS) uint8, 1 or 0.

        There is one at least: the cell next to where it goes already.
        """
        free = self.open_to(camera)
        if not free.any():
            free[self._next_to(self.plan[camera, :2], np.ones_like(free))] = True
        return free.reshape(CELLS, CELLS).astype(np.uint8)

    def place(self, camera: int, action: np.ndarray) -> np.ndarray:
        """
        Return the place that an action means: (2,) metres.

        :param action: (2,) from the middle of the map, in units of half its side; where that is
            none of the choices, the nearest of them is taken.
        """
        window = self.room.window
        wanted = window.low + 0.5 * CELLS * window.edge * (np.asarray(action, np.float64) + 1.0)
        return self.cells[self._next_to(wanted, self.choices(camera).ravel() > 0)]

    def _next_to(self, place: np.ndarray, free: np.ndarray) -> int:
        """Return the cell of some (CELLS * CELLS,) that is next to a place."""
        return int(np.argmin(np.where(free, np.linalg.norm(self.cells - place, axis=1), np.inf)))

    def send(self, camera: int, row: np.ndarray, view: View | None = None) -> None:
        """
        Let a camera go somewhere; those that choose after it know.

        :param row: (6,) metres and radians.
        :param view: what it will see there, if that is known.
        """
        self.plan[camera] = row
        self._views[camera] = self.look(camera, row[None])[0] if view is None else view

    def send_to(self, camera: int, action: np.ndarray) -> None:
        """Let a camera go to the place that an action means, turned as it would be; see above."""
        self.send(camera, np.concatenate([self.place(camera, action), self.plan[camera, 2:]]))

    def _lens(self, camera: int) -> Frustum | None:
        """Return the lens of a camera; None for one that sees all around."""
        return None if self._sight is None else self._sight.lenses[camera]

    def look(self, camera: int, rows: np.ndarray) -> list[View]:
        """Compute what a camera would see from rows (M, 6); those of a place are in a row."""
        lens = self._lens(camera)
        if lens is None:
            return [self.model.look(row[:3]) for row in rows]
        ends = np.flatnonzero(np.any(np.diff(rows[:, :3], axis=0), axis=1)) + 1
        return [view for some in np.split(rows, ends)
                for view in self.model.look_many(some[0, :3], some[:, 3:], lens)]
