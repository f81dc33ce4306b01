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

"""The encoder of ``cloud``: what the network reads of each camera, turn after turn."""

from contextlib import suppress

import numpy as np
from ocp_ros.online.observed_turn import ObservedTurn, ObservedTurns
from ocp_ros.policy.agent_config import AgentConfig
from ocp_ros.policy.cloud_observation import chosen, encode, features_of_others, MARKS
from ocp_ros.rig.free_plane import CLEARANCE
from ocp_ros.rig.motion import bounded_moves
from ocp_ros.scenes.scene import SceneError

#: Points and rows of depth maps of the model in which points are marked by who sees them.
MARKED_POINTS, MARKED_ROWS = 6000, 16


class EncodedTurn:
    """
    What the network reads of one turn, camera by camera.

    :param config: sizes of the network.
    :param cloud: (M, 3) float32, metres, map frame: the points seen so far.
    :param known: what is known of the room; None where it is not enough for one.
    :param positions: (K, 3) metres: where the cameras are.
    :param max_step: farthest a camera moves in one turn, metres.
    :param time: turns played so far / turns of the whole episode.
    """

    def __init__(self, config: AgentConfig, cloud: np.ndarray, known: ObservedTurn | None,
                 positions: np.ndarray, max_step: float, time: float) -> None:
        self._config, self._known, self._max_step = config, known, max_step
        self.positions, self._time = positions.copy(), time
        self._has_chosen = np.zeros(len(positions), dtype=bool)
        # Points are marked in the model: those that it was made of are read.
        self._cloud = encode(cloud if known is None else known.model.points, positions, config)

    def inputs(self, camera: int) -> dict[str, np.ndarray]:
        """Return the arrays of a single camera; see :class:`Encoder`."""
        config, known = self._config, self._known
        unseen = 1.0 if known is None else known.unseen_share
        marks = np.zeros((config.points, MARKS), dtype=np.uint8)
        if known is not None:
            marks = chosen(np.stack(known.seen_now(camera), axis=1).astype(np.uint8), config)
        return {**self._cloud, 'cameras': self._cloud['cameras'][camera:camera + 1],
                'others': features_of_others(camera, self.positions, self._has_chosen, config),
                'turn': np.array([self._time, len(self.positions) / 4.0, unseen], np.float32),
                'marks': marks}

    def move(self, camera: int, action: np.ndarray) -> np.ndarray:
        """
        Let a camera move, for those that are asked after it.

        :param action: (2,) in units of the longest step.
        :returns: (2,) the move it will make, in the same units: it stays over the floor.
        """
        step, here = bounded_moves(action, self._max_step), self.positions[camera:camera + 1, :2]
        if self._known is not None:
            target = self._known.space.moved(here, step, self._max_step)
        else:
            target = here + step
        step = (target - here)[0]
        self.positions[camera, :2], self._has_chosen[camera] = target[0], True
        if self._known is not None:
            self._known.place(camera, self.positions[camera])
        return step / self._max_step


class Encoder:
    """
    Encode what was seen for one camera after the other.

    A camera reads what :func:`~ocp_ros.policy.cloud_observation.encode` returns, and ``others``
    (``OTHERS``, ``OF_OTHERS``), ``turn`` (``OF_TURN``,) and ``marks`` (P, ``MARKS``) uint8; see
    :mod:`ocp_ros.policy.cloud_observation`.

    :param config: sizes of the network.
    :param max_range: effective range of the omnidirectional cameras, metres.
    :param max_step: farthest a camera moves in one turn, metres.
    :param wall_margin: cameras stay this far inside the observed bounding box, metres.
    :param clearance: cameras stay this far from all points that were seen, metres.
    """

    def __init__(self, config: AgentConfig, max_range: float = 4.0, max_step: float = 0.5,
                 wall_margin: float = 0.1, clearance: float = CLEARANCE) -> None:
        self.config, self.max_step = config, max_step
        self.turns = ObservedTurns(max_range, wall_margin, clearance, points=MARKED_POINTS,
                                   rows=MARKED_ROWS)

    def turn(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> EncodedTurn:
        """
        Take note of a turn, to encode it camera by camera.

        :param cloud: (M, 3) float32, metres, map frame: the points seen so far.
        :param positions: (K, 3) metres: where the cameras are.
        :param turn: turns played so far.
        :param turns: turns of the whole episode.
        """
        known = None
        with suppress(SceneError):
            known = self.turns(cloud, positions, turn, turns)
        return EncodedTurn(self.config, cloud, known, positions, self.max_step, turn / turns)
