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

#: Number of directions of the moves.
DIRECTIONS = 8
#: Distances of the moves in each direction, metres.
DISTANCES_M = (0.04, 0.15, 0.5)
_ANGLES = np.arange(DIRECTIONS) * (2.0 * np.pi / DIRECTIONS)
#: (1 + D * 3, 2) metres: staying, then the moves of each direction, the shortest first.
MOVES = np.concatenate([np.zeros((1, 2)), (
    np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)[:, None]
    * np.array(DISTANCES_M)[None, :, None]).reshape(-1, 2)])
#: Constant that is added to compared errors, as a share of the error without any visible point.
ERROR_FLOOR = 0.01
#: Points and depth-map rows of the model: on a coarser one the best move is often a bad move.
POINTS, ROWS = 12000, 64


class GreedyStep(Online):
    """Try the moves of each camera on the observed cloud: a baseline for trained policies."""

    def __init__(self, *settings) -> None:
        super().__init__(*settings)
        self._turns = ObservedTurns(self.max_range, self.wall_margin, self.clearance,
                                    points=POINTS, rows=ROWS)

    def reset(self) -> None:
        """Discard the state of the last episode."""
        self._turns.reset()

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Choose the next moves; see :meth:`~ocp_ros.online.online_planner.Online.move`."""
        self._turns.rig_state = self.rig_state
        try:
            known = self._turns(cloud, positions, turn, turns)
        except SceneError:
            return self.random_walk(cloud, positions)
        for camera in order_of(turn, len(positions)):
            best = MOVES[int(np.argmin(_values(known, camera, turn / turns)))]
            here = known.positions[camera]
            step = bounded_moves(best / self.max_step, self.max_step)
            target = known.space.moved(here[None, :2], step, self.max_step)[0]
            known.place(camera, np.append(target, here[2]))
        return (known.positions - positions)[:, :2]


def _values(known: ObservedTurn, camera: int, time: float) -> np.ndarray:
    """
    Return the objective value after each of a camera's ``MOVES``: less is better.

    The value is the depth error less a bonus for covered unseen cells, both as shares of the
    depth error without any visible point.
    """
    model, space = known.model, known.space
    others = known.beside(camera)
    fresh, floor = known.unseen & ~others.covered, ERROR_FLOOR * model.depth_error.worst
    most = model.depth_error.worst + floor
    places = space.placement(space.inside(known.positions[camera, :2] + MOVES[1:]))
    bonus = exploration_bonus(time) / known.count

    def value(place: np.ndarray) -> float:
        look = known.look(camera, place)
        error = (model.depth_error(others.seen | look.seen) + floor) / most
        return error - bonus * int(count_bits(look.covered & fresh))

    return np.array([(known.error + floor) / most, *mapped(value, places)])
