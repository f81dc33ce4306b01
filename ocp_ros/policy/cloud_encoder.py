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

"""The encoder of ``cloud``: the network's inputs for each camera at each time step."""

from contextlib import suppress

import numpy as np
from ocp_ros.online.observed_turn import ObservedTurn, ObservedTurns
from ocp_ros.policy.agent_config import AgentConfig
from ocp_ros.policy.observation_cloud import chosen, encode, features_of_others, MARKS
from ocp_ros.rig.free_plane import CLEARANCE
from ocp_ros.rig.motion import bounded_moves
from ocp_ros.scenes.scene import SceneError


class EncodedTurn:
    """
    The network's inputs at one time step, camera by camera.

    :param config: sizes of the network.
    :param cloud: (M, 3) float32, metres, map frame: the observed cloud.
    :param known: partial map with the views; None if the cloud is too small for one.
    :param positions: (K, 3) metres: current positions of the cameras.
    :param max_step: farthest a camera moves in one time step, metres.
    :param time: time steps taken so far / time steps of the whole episode.
    """

    def __init__(self, config: AgentConfig, cloud: np.ndarray, known: ObservedTurn | None,
                 positions: np.ndarray, max_step: float, time: float) -> None:
        self._config = config
        self._known = known
        self._max_step = max_step
        self.positions = positions.copy()
        self._time = time
        self._has_chosen = np.zeros(len(positions), dtype=bool)
        # Marks belong to the points of the model, so the network reads these points.
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
        Set the move of a camera; cameras that choose later use its new position.

        :param action: (2,) in units of the longest step.
        :returns: (2,) the corrected move that ends over the floor, in the same units.
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
    Encode the observation for one camera after the other.

    The inputs of a camera are those of :func:`~ocp_ros.policy.observation_cloud.encode`, and
    ``others`` (``OTHERS``, ``OF_OTHERS``), ``turn`` (``OF_TURN``,) and ``marks`` (P, ``MARKS``)
    uint8; see :mod:`ocp_ros.policy.observation_cloud`.

    :param config: sizes of the network.
    :param max_range: effective range of the omnidirectional cameras, metres.
    :param max_step: farthest a camera moves in one time step, metres.
    :param wall_margin: cameras stay this far inside the observed bounding box, metres.
    :param clearance: cameras stay this far from all observed points, metres.
    """

    def __init__(self, config: AgentConfig, max_range: float = 4.0, max_step: float = 0.5,
                 wall_margin: float = 0.1, clearance: float = CLEARANCE) -> None:
        self.config, self.max_step = config, max_step
        # The model in which points are marked by the cameras that see them.
        self.turns = ObservedTurns(max_range, wall_margin, clearance, points=6000, rows=16)

    def turn(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> EncodedTurn:
        """
        Record a time step, and return its inputs camera by camera.

        :param cloud: (M, 3) float32, metres, map frame: the observed cloud.
        :param positions: (K, 3) metres: current positions of the cameras.
        :param turn: time steps taken so far.
        :param turns: time steps of the whole episode.
        """
        known = None
        with suppress(SceneError):
            known = self.turns(cloud, positions, turn, turns)
        return EncodedTurn(self.config, cloud, known, positions, self.max_step, turn / turns)
