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

"""The encoder of the network ``cloud``: inputs for each camera at each time step."""

from contextlib import suppress

import numpy as np
from ocp_ros.online.observed_turn import ObservedTurn, ObservedTurns
from ocp_ros.policy.agent_config import AgentConfig
from ocp_ros.policy.observation_cloud import (
    encode,
    features_of_air,
    features_of_others,
    MARKS,
    OF_SECTOR,
    SECTORS,
    thinned,
)
from ocp_ros.rig.free_plane import CLEARANCE
from ocp_ros.rig.motion import bounded_moves
from ocp_ros.scenes.scene import SceneError


class EncodedTurn:
    """
    The network's inputs at one time step, camera by camera.

    :param encoder: has the sizes of the network, the limits of the rig and its state.
    :param cloud: (M, 3) float32, metres, map frame: M observed points.
    :param observed: partial map with the cameras' views; None if the cloud is too small for a map.
    :param positions: (K, 3) metres, map frame: current positions of the K cameras.
    :param turn: time steps taken so far.
    :param turns: time steps of the whole episode.
    :ivar positions: (K, 3) metres: as above; cameras that have chosen are at their new positions.
    """

    def __init__(self, encoder: 'Encoder', cloud: np.ndarray, observed: ObservedTurn | None,
                 positions: np.ndarray, turn: int, turns: int) -> None:
        self._encoder = encoder
        self._config = config = encoder.config
        self._observed = observed
        self._max_step = encoder.max_step
        self.positions = positions.copy()
        self._turn, self._turns = turn, turns
        self._has_chosen = np.zeros(len(positions), dtype=bool)
        # Marks belong to the points of the partial map, so the network reads these points.
        points = cloud if observed is None else observed.model.points
        self._cloud = encode(points, positions, config)

    def inputs(self, camera: int) -> dict[str, np.ndarray]:
        """Return the input arrays of a camera by name; see :class:`Encoder`."""
        observed, config = self._observed, self._config
        unseen_share = 1.0
        air = np.zeros((SECTORS, OF_SECTOR), dtype=np.float32)
        marks = np.zeros((config.points, MARKS), dtype=np.uint8)
        if observed is not None:
            centres, is_unseen = observed.air
            unseen_share = float(is_unseen.mean()) if len(centres) else 0.0
            air = features_of_air(self.positions[camera], centres, is_unseen)
            marks = np.stack(observed.seen_now(camera), axis=1).astype(np.uint8)
            # The rows of the same points as in ``encode``.
            marks = thinned(marks, config.points)
        max_range, views, heading = self._encoder.traits_of(camera)
        path_left = self._max_step * (self._turns - self._turn)
        return {**self._cloud, 'cameras': self._cloud['cameras'][camera:camera + 1],
                'others': features_of_others(camera, self.positions, self._has_chosen),
                'turn': np.array([self._turn / self._turns, len(self.positions) / 4.0,
                                  unseen_share, self._max_step / 2.0, min(path_left / 8.0, 2.0),
                                  max_range / 4.0, *views], np.float32),
                'heading': heading[None], 'air': air, 'marks': marks}

    def move(self, camera: int, action: np.ndarray) -> np.ndarray:
        """
        Move a camera; cameras that choose later see the new position.

        :param camera: number of the camera, from 0.
        :param action: (2,) the wanted move in x and y, in units of ``max_step``.
        :returns: (2,) the corrected move, in the same units; it ends over the observed floor if
            there is a partial map.
        """
        wanted = bounded_moves(action, self._max_step)
        start = self.positions[camera:camera + 1, :2]
        end = start + wanted
        if self._observed is not None:
            end = self._observed.space.moved(start, wanted, self._max_step)
        # ``start`` is a view of the positions and changes with them below.
        step = (end - start)[0]
        self.positions[camera, :2] = end[0]
        self._has_chosen[camera] = True
        if self._observed is not None:
            self._observed.place(camera, self.positions[camera])
        return step / self._max_step


class Encoder:
    """
    Encode the observation of a time step for one camera after the other.

    The inputs of a camera are those of :func:`~ocp_ros.policy.observation_cloud.encode`, and
    ``others`` (``MAX_OTHERS``, ``OF_OTHERS``), ``turn`` (``OF_TURN``,), ``heading`` (1, 3), the
    direction in which the camera looks (0 for an omnidirectional camera), ``air`` (``SECTORS``,
    ``OF_SECTOR``) and uint8 ``marks`` (P, ``MARKS``) of P points; see
    :mod:`ocp_ros.policy.observation_cloud`.

    :param config: sizes of the network.
    :param max_range: effective range of the omnidirectional cameras, metres.
    :param max_step: longest move of a camera in one time step, metres.
    :param wall_margin: smallest distance of cameras from the observed bounding box, metres.
    :param clearance: smallest distance of cameras from all observed points, metres.
    :ivar partial_maps: creates the partial map of each time step; it shows which cameras see each
        point.
    """

    def __init__(self, config: AgentConfig, max_range: float = 4.0, max_step: float = 0.5,
                 wall_margin: float = 0.1, clearance: float = CLEARANCE) -> None:
        self.config = config
        self.max_range, self.max_step = max_range, max_step
        # The depth error of the partial map is not used, so the number of ``rows`` is irrelevant.
        self.partial_maps = ObservedTurns(max_range, wall_margin, clearance, points=6000, rows=16)

    def turn(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> EncodedTurn:
        """
        Record a time step, and return its inputs camera by camera.

        :param cloud: (M, 3) float32, metres, map frame: M observed points.
        :param positions: (K, 3) metres, map frame: current positions of the K cameras.
        :param turn: time steps taken so far.
        :param turns: time steps of the whole episode.
        """
        observed = None
        with suppress(SceneError):  # The cloud is too small for a partial map.
            observed = self.partial_maps(cloud, positions, turn, turns)
        return EncodedTurn(self, cloud, observed, positions, turn, turns)

    def traits_of(self, camera: int) -> tuple[float, list[float], np.ndarray]:
        """
        Return what the network reads of a camera of the rig.

        :returns: range, metres; angles of view and limits of the pitch, scaled as in ``OF_TURN``
            (4); and the direction in which the camera looks, (3,) float32.
        """
        state = self.partial_maps.rig_state
        if state is None or camera not in state.aimed:
            return self.max_range, [1.0, 1.0, 0.0, 0.0], np.zeros(3, dtype=np.float32)
        model = state.models[camera]
        yaw, pitch = state.placement[camera, 3:5]
        # A positive pitch looks down.
        direction = [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), -np.sin(pitch)]
        views = [model.horizontal_fov / (2.0 * np.pi), model.vertical_fov / np.pi,
                 *(np.array(state.pitch) / (0.5 * np.pi))]
        return model.max_range, views, np.array(direction, dtype=np.float32)
