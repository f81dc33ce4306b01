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

The network reads the observation map and returns the values of all its cells at once; see
:mod:`ocp_ros.policy.observation_map`. Each camera has a target pose. At each time step some
cameras choose a new target, given the targets of the other cameras. They choose among the cells
over the observed floor within the straight distance that the remaining time steps allow. The few
cells with the best values are then scored on the partial map too. The final score is a weighted
mean: the partial map is more exact for the observed space, the network predicts the unseen space.
"""

from math import ceil
from typing import TYPE_CHECKING

import numpy as np
from ocp_ros.geometry.packed_bits import count_bits
from ocp_ros.geometry.visibility import FAST
from ocp_ros.online.candidate_sites import kinds_of, PITCHES, YAWS
from ocp_ros.online.online_planner import KnownTurn, matched, PipelinedPlanner, standing
from ocp_ros.online.partial_map import KeptModel, NO_CELL, PartialMap
from ocp_ros.online.rig_state import clearance_of, record_views
from ocp_ros.policy.map_turn import MapTurn
from ocp_ros.policy.observation_map import CELLS, ERROR_FLOOR, interpolate_yaws, Window
from ocp_ros.rig.motion import order_of
from ocp_ros.scenes.scene import SceneError
from scipy.ndimage import uniform_filter

if TYPE_CHECKING:
    from ocp_ros.policy.policy import ValuePolicy

#: Rows of the depth maps, and points, of the partial map behind the observation map.
MODEL_ROWS = 32
MODEL_POINTS = 6000
#: Smallest number of time steps of an episode for values by heading, for cameras that are not
#: omnidirectional: in a shorter episode values without headings give better places.
MIN_TURNS_FOR_HEADINGS = 20
#: How often each camera chooses in an episode, on average and at least.
CHOICES_PER_EPISODE = 8


class MapActor(PipelinedPlanner):
    """
    Move cameras to the places that a trained network prefers.

    :param policy: returns the value of each cell.
    :param settings: positional arguments of :class:`~ocp_ros.online.online_planner.Online`.
    """

    def __init__(self, policy: 'ValuePolicy', *settings) -> None:
        super().__init__(*settings)
        self.policy = policy
        self.reset()

    def reset(self) -> None:
        """Discard the state of the last episode."""
        super().reset()
        self._kept_model = KeptModel(self.max_range, self.wall_margin, MODEL_POINTS, MODEL_ROWS)
        #: (K, 6) metres, map frame, and radians: target poses of the K cameras.
        self._target_poses: np.ndarray | None = None
        #: Number of time steps with a plan so far.
        self._planned_turns = 0

    @property
    def targets(self) -> np.ndarray | None:
        """Return the target positions; see :attr:`Online.targets`."""
        return None if self._target_poses is None else self._target_poses[:, :2]

    @property
    def headings(self) -> np.ndarray | None:
        """Return the headings at the targets; see :attr:`Online.headings`."""
        poses = self._target_poses if self.directional else None
        return None if poses is None else poses[:, 3:]

    def begin(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int
              ) -> MapTurn | None:
        """Return a time step as a map, see :meth:`move`; None if the cloud is too small."""
        record_views(self.memory, positions, self.rig_state)
        try:
            return self._read(cloud, positions, turn, turns)
        except SceneError:
            return None

    def _read(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> MapTurn:
        """Return the observation map of a time step; see :meth:`_think`."""
        model, self._space = self._kept_model(cloud, positions, FAST,
                                              clearance_of(self.rig_state, self.clearance))
        return self._map_of(KnownTurn(cloud, positions, turn, turns, model, self._space,
                                      self.memory.unseen(model)))

    def _map_of(self, known: KnownTurn) -> MapTurn:
        """Return a time step as an observation map, with the current targets of the cameras."""
        positions = known.positions
        if not self._has_plan(len(positions)):
            self._target_poses = standing(positions, self.rig_state)
            self._planned_turns = 0
        poses = self._target_poses.copy()
        poses[:, :2] = known.space.inside(poses[:, :2])
        poses[:, 2] = positions[:, 2]
        return MapTurn(known.model, known.space, known.unseen, poses, positions, self.rig_state,
                       self.max_range, reach=(known.turns - known.turn) * self.max_step,
                       aimed=known.turns >= MIN_TURNS_FOR_HEADINGS)

    def _think(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> None:
        """Choose new targets for some cameras; see :meth:`PipelinedPlanner._think`."""
        self._choose(self._read(cloud, positions, turn, turns), turn, turns)

    def propose(self, known: KnownTurn) -> np.ndarray:
        """Choose new targets for some cameras, return those of all; see :meth:`Online.propose`."""
        self._choose(self._map_of(known), known.turn, known.turns)
        return self._target_poses.copy()

    def _choose(self, map_turn: MapTurn, turn: int, turns: int) -> None:
        """Choose new targets for the cameras of :meth:`asked`, until interrupted."""
        for camera in self.asked(len(map_turn.positions), turn, turns):
            if self.interrupted():
                break
            self.choose(map_turn, camera, turn / turns)
        self._settle(map_turn)

    def asked(self, cameras: int, turn: int, turns: int) -> np.ndarray:
        """Return the numbers of the cameras that choose again in this time step, in order."""
        min_choices = 2
        choices = max(min_choices, ceil(CHOICES_PER_EPISODE * cameras / turns))
        # In one plan all cameras choose twice: the first plan of a short episode, the second plan
        # of a long one. The first plan of a long episode delays the cameras: one camera chooses.
        if self._planned_turns == (1 if self._ahead(turns) else 0):
            choices = max(choices, 2 * cameras)
        elif self._planned_turns == 0:
            choices = 1
        # Each time step begins with other cameras; ``np.resize`` repeats the order if necessary.
        return np.resize(order_of(turn * min_choices, cameras), choices)

    def end(self, map_turn: MapTurn) -> np.ndarray:
        """Assign the targets to cameras and return the next moves to them: (K, 2) metres."""
        self._settle(map_turn)
        return self.goals(map_turn.positions) - map_turn.positions[:, :2]

    def _settle(self, map_turn: MapTurn) -> None:
        """Assign the new targets to the cameras with the shortest total path."""
        poses = map_turn.plan
        self._target_poses = poses[matched(map_turn.positions, poses[:, :2], self._camera_kinds())]
        self._planned_turns += 1

    def choose(self, map_turn: MapTurn, camera: int, elapsed_share: float) -> None:
        """
        Change the target of a camera if another pose is better.

        :param map_turn: the time step, whose targets change.
        :param camera: number of the camera, from 0.
        :param elapsed_share: time steps taken so far, divided by the time steps of the episode.
        """
        target = map_turn.plan[camera]
        window = map_turn.room.window
        values = self.policy.values(**map_turn.inputs(camera)).reshape(-1, CELLS * CELLS)
        # The bonus for unseen air falls to 0 in the first half of the episode.
        bonus_weight = 1.5 * max(1.0 - elapsed_share / 0.5, 0.0)
        bonus = bonus_weight * _mean_nearby(map_turn.room.unseen_air(), window).ravel()
        # A metre of path costs 0.01 in units of the value, the logarithm of a ratio of errors.
        costs = 0.01 * map_turn.distances(camera) - bonus
        # The score of a cell has the value of its best heading.
        cell_scores = np.where(map_turn.feasible_cells(camera), values.min(axis=0) + costs, np.inf)
        # The cells with the best scores are scored on the partial map too.
        scored_cells = 16
        best = np.argpartition(cell_scores, scored_cells)[:scored_cells]
        best = best[np.isfinite(cell_scores[best])]
        poses, cell_indices = self._poses_at(camera, np.column_stack(
            [map_turn.cells[best], np.full(len(best), target[2])]))
        # The first pose is the present target.
        cells = np.append(window.cell_of(target[None]), best[cell_indices])
        poses = np.concatenate([target[None], poses])
        views = map_turn.look(camera, poses)
        map_values = map_turn.model.depth_error.changes(
            [view.seen for view in map_turn.other_views(camera)], [view.seen for view in views],
            ERROR_FLOOR)
        # The trust in the network's values grows with the unseen share of the air, and is complete
        # from a share of 0.2.
        trust = float(np.clip(5.0 * _unseen_share(map_turn.model, map_turn.unseen), 0.35, 1.0))
        network_values = interpolate_yaws(values, cells, poses[:, 3])
        pose_scores = trust * network_values + (1.0 - trust) * map_values + costs[cells]
        chosen = int(np.argmin(pose_scores))
        # The target changes only for an improvement of 0.02. A present target outside the
        # observed part of the map has the score inf.
        if pose_scores[chosen] <= pose_scores[0] - 0.02:
            map_turn.set_target(camera, poses[chosen], views[chosen])

    def _poses_at(self, camera: int, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return poses (M * H, 6), all H headings at places (M, 3), and each one's place index."""
        headings = np.zeros((1, 3))
        if self.directional:
            headings = self.rig_state.headings(camera, YAWS, PITCHES)
        place_indices = np.repeat(np.arange(len(places)), len(headings))
        poses = np.hstack([places[place_indices], np.tile(headings, (len(places), 1))])
        return poses, place_indices

    def _camera_kinds(self) -> np.ndarray | None:
        """Return the kind of each camera (K,), see :func:`kinds_of`; None for a single kind."""
        return None if self.rig_state is None else kinds_of(self.rig_state)[0]


def _unseen_share(model: PartialMap, unseen: np.ndarray) -> float:
    """Return the share of the air in the partial map that no camera has covered."""
    return int(count_bits(unseen)) / max(int(np.count_nonzero(model.cells != NO_CELL)), 1)


def _mean_nearby(shares: np.ndarray, window: Window) -> np.ndarray:
    """Return the mean of shares (64, 64) in the square of 3 m around each cell."""
    # Outside the grid, shares count as 0.
    return uniform_filter(shares, max(round(3.0 / window.edge), 1), mode='constant')
