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
The map actor: each camera goes to the place that a trained network finds best for it.

The network reads a map of what was observed and values all places at once; see
:mod:`ocp_ros.online.observation_map`. Each camera has a target. Turn after turn some cameras
choose again, given the targets of the others: among the places over the floor that was seen, no
farther away than the turns that are left lead straight on. The few places that the network finds
best are then tried on what was observed: of what has been seen the trial knows more, of all else
the network does.
"""

from typing import TYPE_CHECKING

import numpy as np
from ocp_ros.geometry.packed_bits import count_bits
from ocp_ros.geometry.visibility import FAST
from ocp_ros.online.candidate_sites import kinds_of, PITCHES, YAWS
from ocp_ros.online.observation_map import at_yaws, CELLS, FLOOR, Window
from ocp_ros.online.online_planner import KnownTurn, matched, PipelinedPlanner, standing
from ocp_ros.online.partial_map import KeptModel, NO_CELL, PartialMap
from ocp_ros.online.rig_state import clearance_of, record_views
from ocp_ros.policy.map_turn import MapTurn
from ocp_ros.rig.motion import order_of
from ocp_ros.scenes.scene import SceneError
from scipy.ndimage import uniform_filter

if TYPE_CHECKING:
    from ocp_ros.policy.policy import ValuePolicy

#: Points and rows of depth maps of the model that is read.
PLAIN_POINTS, PLAIN_ROWS = 6000, 32
#: Cameras that choose again in a turn at least, and how often each does in an episode.
AGAIN, OFTEN = 2, 8
#: Places that are tried: those that the network finds best.
TRIED = 16
#: The least share of the network in what a place is worth, and how much larger it is than the
#: share of the air that has not been seen.
TRUST, PER_UNSEEN = 0.35, 5.0
#: Turns of an episode from which on cameras that do not see all around are valued by heading: in
#: few turns they see so little that it is better to be where most can be seen.
MANY = 20
#: What a metre of way costs, and what a target has to be better by to be changed for, both in
#: units of the value: shares of the error.
PER_METRE, GAIN = 0.01, 0.02
#: What unseen air is worth at first, in the same units, the share of the turns after which it is
#: worth nothing, and the metres around a place in which it counts.
CURIOSITY, EXPLORING, AROUND = 1.5, 0.5, 1.5


class MapActor(PipelinedPlanner):
    """
    Go where a trained network says.

    :param policy: values places.
    :param settings: of :class:`~ocp_ros.online.online_planner.Online`.
    """

    def __init__(self, policy: 'ValuePolicy', *settings) -> None:
        super().__init__(*settings)
        self.policy = policy
        self.reset()

    def reset(self) -> None:
        """Forget the last episode."""
        super().reset()
        self._kept = KeptModel(self.max_range, self.wall_margin, PLAIN_POINTS, PLAIN_ROWS)
        #: (K, 6) metres and radians: where each camera goes, and how it is turned there.
        self._plan: np.ndarray | None = None
        #: How many turns have been planned for.
        self._turns = 0

    @property
    def targets(self) -> np.ndarray | None:
        """Return where each camera goes; see :attr:`Online.targets`."""
        return None if self._plan is None else self._plan[:, :2]

    @property
    def headings(self) -> np.ndarray | None:
        """Return how the cameras are turned there; see :attr:`Online.headings`."""
        return self._plan[:, 3:] if self._plan is not None and self.directional else None

    def begin(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int
              ) -> MapTurn | None:
        """Take note of a turn, see :meth:`move`; None where nothing is known of the room."""
        record_views(self.memory, positions, self.rig_state)
        try:
            return self._read(cloud, positions, turn, turns)
        except SceneError:
            return None

    def _read(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> MapTurn:
        """Read what is known at a turn; see :meth:`_think`."""
        model, self._space = self._kept(cloud, positions, FAST,
                                        clearance_of(self.rig_state, self.clearance))
        return self._map_of(KnownTurn(cloud, positions, turn, turns, model, self._space,
                                      self.memory.unseen(model)))

    def _map_of(self, known: KnownTurn) -> MapTurn:
        """Return the map of what is known, with where cameras go so far."""
        positions = known.positions
        if not self._planned(len(positions)):
            self._plan, self._turns = standing(positions, self.rig_state), 0
        plan = self._plan.copy()
        plan[:, :2], plan[:, 2] = known.space.inside(plan[:, :2]), positions[:, 2]
        return MapTurn(known.model, known.space, known.unseen, plan, positions, self.rig_state,
                       self.max_range, (known.turns - known.turn) * self.max_step,
                       known.turns >= MANY)

    def _think(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> None:
        """Let cameras choose again; see :meth:`PipelinedPlanner._think`."""
        self._choose(self._read(cloud, positions, turn, turns), turn, turns)

    def propose(self, known: KnownTurn) -> np.ndarray:
        """Let cameras choose again; see :meth:`Online.propose`."""
        self._choose(self._map_of(known), known.turn, known.turns)
        return self._plan.copy()

    def _choose(self, known: MapTurn, turn: int, turns: int) -> None:
        """Let the cameras whose turn it is choose again."""
        for camera in self.asked(len(known.positions), turn, turns):
            if self.interrupted():
                break
            self.choose(known, camera, turn / turns)
        self._settle(known)

    def asked(self, cameras: int, turn: int, turns: int) -> np.ndarray:
        """Return the cameras that choose again at the turn that was begun, in their order."""
        asked = max(AGAIN, -(-OFTEN * cameras // turns))
        # All do at first, as soon as nobody waits for an answer; until then one does.
        if self._turns == int(self._ahead(turns)):
            asked = max(asked, 2 * cameras)
        elif self._turns == 0:
            asked = 1
        return np.resize(order_of(turn * AGAIN, cameras), asked)

    def end(self, known: MapTurn) -> np.ndarray:
        """Let cameras go where a turn has sent them: the next moves (K, 2), metres."""
        self._settle(known)
        return self.goals(known.positions) - known.positions[:, :2]

    def _settle(self, known: MapTurn) -> None:
        """Match the cameras with where a turn has sent them, so that they walk least."""
        self._plan = known.plan[matched(known.positions, known.plan[:, :2], self._kinds())]
        self._turns += 1

    def choose(self, known: MapTurn, camera: int, over: float) -> None:
        """Let a camera choose again where it goes, when a share of the turns is over."""
        plan, window = known.plan, known.room.window
        values = self.policy.values(**known.inputs(camera)).reshape(-1, CELLS * CELLS)
        curiosity = CURIOSITY * max(1.0 - over / EXPLORING, 0.0)
        bonus = curiosity * _nearby(known.room.unseen_air(), window).ravel()
        extra = PER_METRE * known.away(camera) - bonus
        scores = np.where(known.open_to(camera), values.min(axis=0) + extra, np.inf)
        best = np.argpartition(scores, TRIED)[:TRIED]
        best = best[np.isfinite(scores[best])]
        rows, of_cells = self._turned(camera, np.column_stack(
            [known.cells[best], np.full(len(best), plan[camera, 2])]))
        at = np.append(window.cell_of(plan[camera, None]), best[of_cells])
        rows = np.concatenate([plan[camera, None], rows])
        looks = known.look(camera, rows)
        change = known.model.depth_error.changes(
            [view.seen for view in known.beside(camera)], [look.seen for look in looks], FLOOR)
        trust = float(np.clip(PER_UNSEEN * _share(known.model, known.unseen), TRUST, 1.0))
        said = at_yaws(values, at, rows[:, 3])
        tried = trust * said + (1.0 - trust) * change + extra[at]
        found = int(np.argmin(tried))
        # Beyond what was seen the network says inf.
        if not tried[found] > tried[0] - GAIN:
            known.send(camera, rows[found], looks[found])

    def _turned(self, camera: int, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Turn a camera all ways at places (M, 3): rows (M * H, 6), and the place of each."""
        headings = np.zeros((1, 3))
        if self.directional:
            headings = self.rig_state.headings(camera, YAWS, PITCHES)
        of_places = np.repeat(np.arange(len(places)), len(headings))
        return np.hstack([places[of_places], np.tile(headings, (len(places), 1))]), of_places

    def _kinds(self) -> np.ndarray | None:
        """Tell which cameras may take each other's places: (K,); None for all."""
        return None if self.rig_state is None else kinds_of(self.rig_state)[0]


def _share(model: PartialMap, unseen: np.ndarray) -> float:
    """Return the share of the air in the model that has not been seen."""
    return int(count_bits(unseen)) / max(int(np.count_nonzero(model.cells != NO_CELL)), 1)


def _nearby(share: np.ndarray, window: Window) -> np.ndarray:
    """Return the mean of a share of the cells around each cell."""
    return uniform_filter(share, max(round(2.0 * AROUND / window.edge), 1), mode='constant')
