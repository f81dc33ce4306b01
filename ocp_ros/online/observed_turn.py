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

"""The partial map at a time step, on which moves of one camera after the other are tried."""

import numpy as np
from ocp_ros.geometry.packed_bits import count_bits, unpack
from ocp_ros.geometry.visibility import FAST, FINE
from ocp_ros.online.partial_map import KeptModel, LookHistory, PartialMap
from ocp_ros.online.rig_state import clearance_of, fixed_views, record_views, RigState, view_from
from ocp_ros.rig.free_plane import CLEARANCE, FreePlane
from ocp_ros.simulation.simulator import View

#: Share of the episode after which the model uses the finest rules of visibility.
LATE_SHARE = 0.6


class ObservedTurn:
    """
    The views of all cameras in the partial map.

    Cameras choose one after the other. Each uses the new positions of the cameras that have
    already chosen; otherwise two cameras would choose the same gap.

    :param model: partial map of the observed cloud.
    :param unseen: packed bits of the model's cells that no camera has covered.
    :param space: feasible region of the cameras.
    :param positions: (K, 3) metres: positions of the cameras, new ones where already chosen.
    :param rig_state: camera models and headings; None if all cameras are omnidirectional.
    """

    def __init__(self, model: PartialMap, unseen: np.ndarray, space: FreePlane,
                 positions: np.ndarray, rig_state: RigState | None = None) -> None:
        self.model, self.unseen, self.space = model, unseen, space
        self.positions, self._sight = positions.copy(), rig_state
        self._views = [self.look(camera, position) for camera, position in enumerate(positions)]
        self._fixed = fixed_views(model, rig_state)

    def look(self, camera: int, position: np.ndarray) -> View:
        """Compute the view of a camera at a position (3,)."""
        return view_from(self.model, self._sight, camera, position)

    def place(self, camera: int, position: np.ndarray) -> None:
        """Set the new position (3,) of a camera; cameras that choose later use it."""
        self.positions[camera], self._views[camera] = position, self.look(camera, position)

    def others(self, camera: int) -> list[View]:
        """Return the views of all cameras except one, fixed cameras included."""
        return self._views[:camera] + self._views[camera + 1:] + self._fixed

    def beside(self, camera: int) -> View:
        """Return the merged view of all other cameras."""
        return self.model.together(self.others(camera))

    @property
    def error(self) -> float:
        """Return the depth error of all cameras together, metres."""
        return self.model.error(self._views + self._fixed)

    @property
    def count(self) -> int:
        """Return the number of cells that no camera has covered, at least 1."""
        return max(int(count_bits(self.unseen)), 1)

    @property
    def unseen_share(self) -> float:
        """Return the share of the air that no camera has covered."""
        return self.count / max(len(self.model.cells), 1)

    def seen_now(self, camera: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Return which points of the model are visible from the current or new positions.

        :returns: (N,) bool, whether the camera sees a point, and (N,) uint8, the number of other
            cameras that see it.
        """
        count = len(self.model.points)
        others = np.zeros(count, dtype=np.uint8)
        for view in self.others(camera):
            others += unpack(view.seen, count)
        return unpack(self._views[camera].seen, count), others


class ObservedTurns:
    """
    Create an :class:`ObservedTurn` at each time step of an episode.

    :param max_range: effective range of the omnidirectional cameras, metres.
    :param wall_margin: cameras stay this far inside the observed bounding box, metres.
    :param clearance: cameras stay this far from all observed points, metres.
    :param points: largest number of points of the model.
    :param rows: of its depth maps.
    """

    def __init__(self, max_range: float, wall_margin: float, clearance: float = CLEARANCE, *,
                 points: int, rows: int) -> None:
        self._settings, self._clearance = (max_range, wall_margin, points, rows), clearance
        #: Camera models and headings; None if all cameras are omnidirectional.
        self.rig_state: RigState | None = None
        self.reset()

    def reset(self) -> None:
        """Discard the state of the last episode."""
        self._history = LookHistory()
        self._kept = KeptModel(*self._settings)

    def __call__(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int
                 ) -> ObservedTurn:
        """
        Record the current views, and return the partial map with these views.

        :param cloud: (M, 3) float32, metres, map frame: the observed cloud.
        :param positions: (K, 3) metres: current positions of the cameras.
        :param turn: time steps taken so far.
        :param turns: time steps of the whole episode.
        :raises SceneError: if the points are too few or too flat to be a room.
        """
        record_views(self._history, positions, self.rig_state)
        model, space = self._kept(cloud, positions, FINE if turn >= LATE_SHARE * turns else FAST,
                                  clearance_of(self.rig_state, self._clearance))
        return ObservedTurn(model, self._history.unseen(model), space, positions, self.rig_state)
