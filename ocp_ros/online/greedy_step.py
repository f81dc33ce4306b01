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

"""The greedy step: one camera after the other takes the best of a few moves of one time step."""

import numpy as np
from ocp_ros.geometry.packed_bits import count_bits
from ocp_ros.online.observed_turn import ObservedTurn, ObservedTurns
from ocp_ros.online.online_planner import Online
from ocp_ros.online.partial_map import exploration_bonus
from ocp_ros.rig.motion import bounded_moves, order_of
from ocp_ros.scenes.scene import SceneError
from ocp_ros.util.threads import mapped

_ANGLES = np.arange(8) * (2.0 * np.pi / 8)
#: (25, 2) metres: no move, then for each of 8 directions three moves, the shortest first.
MOVES = np.concatenate([np.zeros((1, 2)), (
    np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)[:, None]
    * np.array([0.04, 0.15, 0.5])[None, :, None]).reshape(-1, 2)])
#: Points and depth-map rows of the model: on a coarser one the best move is often a bad move.
POINTS, ROWS = 12000, 64


class GreedyStep(Online):
    """Try the moves of each camera on the observed cloud: a baseline for trained policies."""

    def __init__(self, *settings) -> None:
        super().__init__(*settings)
        self._partial_maps = ObservedTurns(self.max_range, self.wall_margin, self.clearance,
                                           points=POINTS, rows=ROWS)

    def reset(self) -> None:
        """Discard the state of the last episode."""
        self._partial_maps.reset()

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Choose the next moves; see :meth:`~ocp_ros.online.online_planner.Online.move`."""
        self._partial_maps.rig_state = self.rig_state
        try:
            observed = self._partial_maps(cloud, positions, turn, turns)
        except SceneError:
            return self.random_walk(cloud, positions)
        for camera in order_of(turn, len(positions)):
            best_move = MOVES[int(np.argmin(_move_values(observed, camera, turn / turns)))]
            position = observed.positions[camera]
            # ``bounded_moves`` takes moves in units of the longest step.
            move = bounded_moves(best_move / self.max_step, self.max_step)
            target = observed.space.moved(position[None, :2], move, self.max_step)[0]
            observed.place(camera, np.append(target, position[2]))
        return (observed.positions - positions)[:, :2]


def _move_values(observed: ObservedTurn, camera: int, elapsed_share: float) -> np.ndarray:
    """
    Return the objective value after each of a camera's M = 25 ``MOVES``: less is better.

    The value is the depth error less a bonus for covered unseen cells, both as shares of the
    depth error without any visible point.

    :param elapsed_share: time steps taken so far, divided by the time steps of the episode.
    :returns: (M,) float64.
    """
    model, space = observed.model, observed.space
    others = observed.merge_other_views(camera)
    new_cells = observed.unseen & ~others.covered
    # A share is (error + error_floor) / (worst error + error_floor).
    error_floor = 0.01 * model.depth_error.worst
    max_error = model.depth_error.worst + error_floor
    positions = space.placement(space.inside(observed.positions[camera, :2] + MOVES[1:]))
    cell_bonus = exploration_bonus(elapsed_share) / observed.unseen_count

    def value(position: np.ndarray) -> float:
        view = observed.look(camera, position)
        error = (model.depth_error(others.seen | view.seen) + error_floor) / max_error
        return error - cell_bonus * int(count_bits(view.covered & new_cells))

    # The first move is to stay. It has no bonus: the cells in the current views are not unseen.
    return np.array([(observed.error + error_floor) / max_error, *mapped(value, positions)])
