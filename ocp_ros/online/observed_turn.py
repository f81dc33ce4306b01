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

"""The partial map at a turn, on which moves of one camera after the other are tried."""

from functools import cached_property

import numpy as np
from ocp_ros.geometry.clouds import cells_numbered
from ocp_ros.geometry.packed_bits import unpack
from ocp_ros.geometry.visibility import FAST, FINE
from ocp_ros.online.partial_map import KeptModel, LookHistory, NO_CELL, PartialMap
from ocp_ros.online.rig_state import (
    AIR_RADIUS_M,
    clearance_of,
    fixed_views,
    record_views,
    RigState,
    view_from,
)
from ocp_ros.rig.free_plane import CLEARANCE, FreePlane
from ocp_ros.simulation.simulator import View


class ObservedTurn:
    """
    The views of K movable cameras, and of fixed ones, in the partial map.

    Cameras choose one after the other. Each uses the new positions of the cameras that have
    already chosen; otherwise two cameras would choose the same gap.

    :param model: partial map of the observed cloud.
    :param unseen: packed bits of the model's cells that no camera has covered.
    :param space: feasible region of the cameras.
    :param positions: (K, 3) metres: current positions of the K movable cameras.
    :param rig_state: camera models and headings; None if all cameras are omnidirectional.
    :ivar positions: as above; the new positions for cameras that have already chosen.
    """

    def __init__(self, model: PartialMap, unseen: np.ndarray, space: FreePlane,
                 positions: np.ndarray, rig_state: RigState | None = None) -> None:
        self.model, self.unseen, self.space = model, unseen, space
        self.positions = positions.copy()
        self._rig_state = rig_state
        self._views = [self.look(camera, position) for camera, position in enumerate(positions)]
        self._fixed_views = fixed_views(model, rig_state)

    def look(self, camera: int, position: np.ndarray) -> View:
        """Return the view of a camera at a position (3,), metres, with its current heading."""
        return view_from(self.model, self._rig_state, camera, position)

    def place(self, camera: int, position: np.ndarray) -> None:
        """Set the new position (3,) of a camera; cameras that choose later use this position."""
        self.positions[camera] = position
        self._views[camera] = self.look(camera, position)

    def other_views(self, camera: int) -> list[View]:
        """Return the views of all cameras except one, fixed cameras included."""
        return self._views[:camera] + self._views[camera + 1:] + self._fixed_views

    @cached_property
    def air(self) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the C cells of the model's air.

        :returns: (C, 2) metres, map frame, the centres of the cells seen from above; and (C,)
            bool, whether no camera has covered a cell.
        """
        is_air = self.model.cells != NO_CELL
        centres = (cells_numbered(self.model.cells[is_air])[:, :2] + 0.5) * self.model.edge
        return centres, unpack(self.unseen, len(is_air))[is_air]

    def seen_now(self, camera: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Return which of the model's N points a camera and the others see from ``positions``.

        :returns: (N,) bool, whether the camera sees each point, and (N,) uint8, the number of
            other cameras that see each point.
        """
        point_count = len(self.model.points)
        other_cameras = np.zeros(point_count, dtype=np.uint8)
        for view in self.other_views(camera):
            other_cameras += unpack(view.seen, point_count)
        return unpack(self._views[camera].seen, point_count), other_cameras


class ObservedTurns:
    """
    Create an :class:`ObservedTurn` at each turn of an episode.

    :param max_range: effective range of the omnidirectional cameras, metres.
    :param wall_margin: cameras stay this far inside the observed bounding box, metres.
    :param clearance: cameras stay this far from all observed points, metres.
    :param points: largest number of points of the model.
    :param rows: rows of the model's depth maps.
    """

    def __init__(self, max_range: float, wall_margin: float, clearance: float = CLEARANCE, *,
                 points: int, rows: int) -> None:
        self._model_arguments = max_range, wall_margin, points, rows
        self._clearance = clearance
        #: Camera models and headings; None if all cameras are omnidirectional.
        self.rig_state: RigState | None = None
        self.reset()

    def reset(self) -> None:
        """Discard the state of the last episode."""
        self._history = LookHistory()
        #: None before the first turn, when the rig may not be known yet.
        self._kept_model: KeptModel | None = None

    def __call__(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int
                 ) -> ObservedTurn:
        """
        Record the current views, and return the partial map with these views.

        :param cloud: (M, 3) float32, metres, map frame: the observed cloud.
        :param positions: (K, 3) metres: current positions of the K movable cameras.
        :param turn: turns taken so far.
        :param turns: turns of the whole episode.
        :raises SceneError: if the points are too few or too flat to be a room.
        """
        record_views(self._history, positions, self.rig_state)
        if self._kept_model is None:
            directional = self.rig_state is not None and self.rig_state.aimed
            self._kept_model = KeptModel(*self._model_arguments,
                                         air_radius=AIR_RADIUS_M if directional else 0.0)
        # The finest rules of visibility are slow, and matter after 60 % of the episode.
        settings = FINE if turn >= 0.6 * turns else FAST
        model, space = self._kept_model(cloud, positions, settings,
                                        clearance_of(self.rig_state, self._clearance))
        return ObservedTurn(model, self._history.unseen(model), space, positions, self.rig_state)
