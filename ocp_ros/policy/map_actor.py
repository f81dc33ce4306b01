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

"""
The map actor: each camera goes to the place with the best value of a trained network.

The network reads the observation map and returns values for all places at once; see
:mod:`ocp_ros.policy.observation_map`. Each camera has a target. At each time step some cameras
choose a new target, given the targets of the other cameras. They choose among the places over the
observed floor within the straight distance that the remaining time steps allow. The few places
with the best values are then scored on the partial map. The final score is a weighted mean: the
partial map is more exact for the observed space, the network predicts the unseen space.
"""

from typing import TYPE_CHECKING

import numpy as np
from ocp_ros.geometry.packed_bits import count_bits
from ocp_ros.geometry.visibility import FAST
from ocp_ros.online.candidate_sites import kinds_of, PITCHES, YAWS
from ocp_ros.online.online_planner import KnownTurn, matched, PipelinedPlanner, standing
from ocp_ros.online.partial_map import KeptModel, NO_CELL, PartialMap
from ocp_ros.online.rig_state import clearance_of, record_views
from ocp_ros.policy.map_turn import MapTurn
from ocp_ros.policy.observation_map import at_yaws, CELLS, ERROR_FLOOR, Window
from ocp_ros.rig.motion import order_of
from ocp_ros.scenes.scene import SceneError
from scipy.ndimage import uniform_filter

if TYPE_CHECKING:
    from ocp_ros.policy.policy import ValuePolicy

#: Rows of the depth maps of this model.
MODEL_ROWS = 32
#: Points of the model from which the observation map is computed.
MODEL_POINTS = 6000
#: Smallest number of time steps for values by heading, for cameras that are not omnidirectional:
#: in a shorter episode they observe too little, and values without headings give better places.
MIN_TURNS_FOR_HEADINGS = 20


class MapActor(PipelinedPlanner):
    """
    Move cameras to the places that a trained network prefers.

    :param policy: returns the value of each place.
    :param settings: of :class:`~ocp_ros.online.online_planner.Online`.
    """

    def __init__(self, policy: 'ValuePolicy', *settings) -> None:
        super().__init__(*settings)
        self.policy = policy
        self.reset()

    def reset(self) -> None:
        """Discard the state of the last episode."""
        super().reset()
        self._kept = KeptModel(self.max_range, self.wall_margin, MODEL_POINTS, MODEL_ROWS)
        #: (K, 6) metres and radians: target pose of each camera.
        self._plan: np.ndarray | None = None
        #: Number of time steps with a plan so far.
        self._turns = 0

    @property
    def targets(self) -> np.ndarray | None:
        """Return the target positions; see :attr:`Online.targets`."""
        return None if self._plan is None else self._plan[:, :2]

    @property
    def headings(self) -> np.ndarray | None:
        """Return the headings at the targets; see :attr:`Online.headings`."""
        return self._plan[:, 3:] if self._plan is not None and self.directional else None

    def begin(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int
              ) -> MapTurn | None:
        """Record a time step, see :meth:`move`; None if the cloud is too small for a map."""
        record_views(self.memory, positions, self.rig_state)
        try:
            return self._read(cloud, positions, turn, turns)
        except SceneError:
            return None

    def _read(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> MapTurn:
        """Compute the observation map of a time step; see :meth:`_think`."""
        model, self._space = self._kept(cloud, positions, FAST,
                                        clearance_of(self.rig_state, self.clearance))
        return self._map_of(KnownTurn(cloud, positions, turn, turns, model, self._space,
                                      self.memory.unseen(model)))

    def _map_of(self, known: KnownTurn) -> MapTurn:
        """Return the observation map with the current targets of the cameras."""
        positions = known.positions
        if not self._planned(len(positions)):
            self._plan = standing(positions, self.rig_state)
            self._turns = 0
        plan = self._plan.copy()
        plan[:, :2], plan[:, 2] = known.space.inside(plan[:, :2]), positions[:, 2]
        return MapTurn(known.model, known.space, known.unseen, plan, positions, self.rig_state,
                       self.max_range, (known.turns - known.turn) * self.max_step,
                       known.turns >= MIN_TURNS_FOR_HEADINGS)

    def _think(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> None:
        """Choose new targets for some cameras; see :meth:`PipelinedPlanner._think`."""
        self._choose(self._read(cloud, positions, turn, turns), turn, turns)

    def propose(self, known: KnownTurn) -> np.ndarray:
        """Choose new targets for some cameras and return all; see :meth:`Online.propose`."""
        self._choose(self._map_of(known), known.turn, known.turns)
        return self._plan.copy()

    def _choose(self, known: MapTurn, turn: int, turns: int) -> None:
        """Choose new targets for the cameras of :meth:`asked`, until interrupted."""
        for camera in self.asked(len(known.positions), turn, turns):
            if self.interrupted():
                break
            self.choose(known, camera, turn / turns)
        self._settle(known)

    def asked(self, cameras: int, turn: int, turns: int) -> np.ndarray:
        """Return the cameras that choose again in this time step, in their order."""
        # Two cameras or more choose again in a time step, and each eight times in an episode.
        least_choosing = 2
        asked = max(least_choosing, -(-8 * cameras // turns))
        # In the first plan of a short episode all cameras choose twice. In an episode of many time
        # steps they do so in the second plan, which no time step waits for; in its first plan,
        # which is waited for, one camera chooses.
        if self._turns == int(self._ahead(turns)):
            asked = max(asked, 2 * cameras)
        elif self._turns == 0:
            asked = 1
        return np.resize(order_of(turn * least_choosing, cameras), asked)

    def end(self, known: MapTurn) -> np.ndarray:
        """Return the next moves of the cameras towards their new targets: (K, 2) metres."""
        self._settle(known)
        return self.goals(known.positions) - known.positions[:, :2]

    def _settle(self, known: MapTurn) -> None:
        """Assign the new targets to the cameras with the shortest total path."""
        self._plan = known.plan[matched(known.positions, known.plan[:, :2], self._kinds())]
        self._turns += 1

    def choose(self, known: MapTurn, camera: int, over: float) -> None:
        """Choose the target of a camera again, after a share ``over`` of the episode."""
        plan, window = known.plan, known.room.window
        values = self.policy.values(**known.inputs(camera)).reshape(-1, CELLS * CELLS)
        # The bonus for unseen air falls to 0 in the first half of the episode.
        curiosity = 1.5 * max(1.0 - over / 0.5, 0.0)
        bonus = curiosity * _nearby(known.room.unseen_air(), window).ravel()
        # A metre of path costs 0.01 in units of the value, the logarithm of a ratio of errors.
        extra = 0.01 * known.away(camera) - bonus
        scores = np.where(known.open_to(camera), values.min(axis=0) + extra, np.inf)
        # The places with the best values of the network are scored on the partial map.
        scored = 16
        best = np.argpartition(scores, scored)[:scored]
        best = best[np.isfinite(scores[best])]
        rows, of_cells = self._turned(camera, np.column_stack(
            [known.cells[best], np.full(len(best), plan[camera, 2])]))
        at = np.append(window.cell_of(plan[camera, None]), best[of_cells])
        rows = np.concatenate([plan[camera, None], rows])
        looks = known.look(camera, rows)
        change = known.model.depth_error.changes(
            [view.seen for view in known.beside(camera)], [look.seen for look in looks],
            ERROR_FLOOR)
        # The weight of the network in the score of a place, which grows with the unseen share of
        # the air.
        trust = float(np.clip(5.0 * _share(known.model, known.unseen), 0.35, 1.0))
        said = at_yaws(values, at, rows[:, 3])
        tried = trust * said + (1.0 - trust) * change + extra[at]
        found = int(np.argmin(tried))
        # Outside the observed part of the map the network's value is inf.
        # A target changes only for an improvement of 0.02.
        if not tried[found] > tried[0] - 0.02:
            known.send(camera, rows[found], looks[found])

    def _turned(self, camera: int, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the poses (M * H, 6) of all headings at places (M, 3), and the place of each."""
        headings = np.zeros((1, 3))
        if self.directional:
            headings = self.rig_state.headings(camera, YAWS, PITCHES)
        of_places = np.repeat(np.arange(len(places)), len(headings))
        return np.hstack([places[of_places], np.tile(headings, (len(places), 1))]), of_places

    def _kinds(self) -> np.ndarray | None:
        """Return the kind of each camera (K,), see :func:`kinds_of`; None for a single kind."""
        return None if self.rig_state is None else kinds_of(self.rig_state)[0]


def _share(model: PartialMap, unseen: np.ndarray) -> float:
    """Return the unseen share of the air in the model."""
    return int(count_bits(unseen)) / max(int(np.count_nonzero(model.cells != NO_CELL)), 1)


def _nearby(share: np.ndarray, window: Window) -> np.ndarray:
    """Return the mean share over the cells around each cell."""
    # Cells within 1.5 m on each side of a place.
    return uniform_filter(share, max(round(3.0 / window.edge), 1), mode='constant')
