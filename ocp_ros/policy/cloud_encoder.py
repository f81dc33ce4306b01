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
The encoder: what the network reads, as arrays, computed once for each observation.

Points are chosen by farthest-point sampling and grouped by ball query, as in PointNet++ (Qi et
al., 2017). This depends on the cloud alone, so the indices are stored with the observation and not
computed again at a gradient step.
"""

from contextlib import suppress

import numpy as np
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.online.observed_turn import ObservedTurn, ObservedTurns
from ocp_ros.policy.agent_config import AgentConfig, PAPER
from ocp_ros.rig.free_plane import CLEARANCE
from ocp_ros.rig.motion import bounded_moves
from ocp_ros.scenes.scene import SceneError
from ocp_ros.util.kernels import njit

#: Length that the network reads as 1, metres.
LENGTH_SCALE = 4.0
#: Largest number of other cameras that the network reads for one camera: the nearest ones.
MAX_OTHERS = 7
#: Number of values for the turn and the choosing camera: elapsed share of the episode, number of
#: cameras / 4, share of the air that no camera has covered, longest step / 2 m, path that is left
#: / 8 m (at most 2), range / 4 m, angles of view (as shares of those of an omnidirectional camera)
#: and smallest and largest pitch / 90 degrees (0 for an omnidirectional camera).
OF_TURN = 10
#: Sectors around a camera, between multiples of 45 degrees, for the air that was not covered yet.
SECTORS = 8
#: Number of values for each sector: horizontal vector from the camera to the middle of its unseen
#: air (2), the sector's share of all unseen air, and the unseen share of the sector's air.
OF_SECTOR = 4
#: Number of values for each other camera: the vector to this camera (3), whether the camera
#: exists, and whether it has chosen its move.
OF_OTHERS = 5
#: Number of values for each point: whether the choosing camera sees the point, and the number of
#: other cameras that see the point.
MARKS = 2


@njit(cache=True, nogil=True)
def _squared_distance(first, second):
    """Return the squared distance of two points (3,)."""
    dx, dy, dz = first[0] - second[0], first[1] - second[1], first[2] - second[2]
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
def farthest_points(points, count):
    """
    Choose point 0, then one by one the point that is farthest from all chosen points.

    :param points: (N, 3) float32.
    :param count: number of points to choose; with fewer distinct points, points repeat.
    :returns: (count,) int32 indices of the chosen points.
    """
    chosen = np.zeros(count, dtype=np.int32)
    # Squared distance of each point to the nearest chosen point.
    distances = np.full(points.shape[0], np.inf, dtype=np.float32)
    last = 0
    for k in range(1, count):
        farthest, largest = 0, np.float32(-1.0)
        for i in range(points.shape[0]):
            distances[i] = min(distances[i], _squared_distance(points[i], points[last]))
            if distances[i] > largest:
                farthest, largest = i, distances[i]
        chosen[k] = last = farthest
    return chosen


@njit(cache=True, nogil=True)
def ball_query(points, key_indices, radius, group_size):
    """
    Return for each key point the first points of the array within a radius.

    :param points: (N, 3) float32.
    :param key_indices: (K,) indices of the key points.
    :param radius: in the points' unit.
    :param group_size: points per group; a smaller group repeats its first point.
    :returns: (K, group_size) int32 indices.
    """
    groups = np.empty((key_indices.shape[0], group_size), dtype=np.int32)
    for k in range(key_indices.shape[0]):
        centre, count = points[key_indices[k]], 0
        for i in range(points.shape[0]):
            if _squared_distance(points[i], centre) <= radius * radius:
                groups[k, count] = i
                count += 1
                if count == group_size:
                    break
        for i in range(count, group_size):
            groups[k, i] = groups[k, 0]
    return groups


@njit(cache=True, nogil=True)
def nearest_in_ball(points, key_indices, radius, group_size):
    """
    Return for each key point the nearest points within a radius, the key point first.

    With evenly spread key points, nearly every point is in a group, also in a dense cloud;
    :func:`ball_query` would take the same first points for many groups.

    :param points: (N, 3) float32.
    :param key_indices: (K,) indices of the key points.
    :param radius: in the points' unit.
    :param group_size: points per group; a smaller group repeats its first point.
    :returns: (K, group_size) int32 indices.
    """
    groups = np.empty((key_indices.shape[0], group_size), dtype=np.int32)
    distances = np.empty(group_size, dtype=np.float32)
    for k in range(key_indices.shape[0]):
        centre, count = points[key_indices[k]], 0
        for i in range(points.shape[0]):
            distance = _squared_distance(points[i], centre)
            is_full = count == group_size
            if distance > radius * radius or (is_full and distance >= distances[group_size - 1]):
                continue
            # Insert the point into the group, which is sorted by squared distance.
            rank = min(count, group_size - 1)
            while rank > 0 and distances[rank - 1] > distance:
                distances[rank], groups[k, rank] = distances[rank - 1], groups[k, rank - 1]
                rank -= 1
            distances[rank], groups[k, rank] = distance, i
            count = min(count + 1, group_size)
        for i in range(count, group_size):
            groups[k, i] = groups[k, 0]
    return groups


def encode(cloud: np.ndarray, positions: np.ndarray, config: AgentConfig
           ) -> dict[str, np.ndarray]:
    """
    Return an observation as the network's inputs by name.

    Lengths are in units of ``LENGTH_SCALE``, relative to the centre of the cloud's bounding box.

    :param cloud: (M, 3) float32, metres, map frame: M observed points, in any order.
    :param positions: (K, 3), metres, map frame: current positions of the K cameras.
    :param config: sizes of the network: P points, and for extraction units 1 and 2 the number of
        key points (K1, K2) and of points in a group (G1, G2).
    :returns: float32 ``points`` (P, 3), ``cameras`` (K, 3) and ``half_size`` (3,) of the bounding
        box; int16 indices ``keys_1`` (K1,), ``groups_1`` (K1, G1), ``keys_2`` (K2,) and
        ``groups_2`` (K2, G2).
    """
    positions = positions.astype(np.float32)
    # An empty cloud is replaced by the positions of the cameras.
    cloud = cloud if len(cloud) else positions
    bounds = corners_of(cloud)
    centre = bounds.mean(axis=0)
    points = ((thinned(cloud, config.points) - centre) / LENGTH_SCALE).astype(np.float32)
    keys_1 = farthest_points(points, config.keys_1)
    key_points = points[keys_1]
    keys_2 = farthest_points(key_points, config.keys_2)
    group = ball_query if config.inputs == PAPER else nearest_in_ball
    indices = {
        'keys_1': keys_1,
        'groups_1': group(points, keys_1, config.radius_1 / LENGTH_SCALE, config.group_1),
        'keys_2': keys_2,
        'groups_2': group(key_points, keys_2, config.radius_2 / LENGTH_SCALE, config.group_2)}
    return {
        'points': points,
        # int16 halves the memory of the replay buffer: there are at most 32767 points.
        **{name: value.astype(np.int16) for name, value in indices.items()},
        'cameras': ((positions - centre) / LENGTH_SCALE).astype(np.float32),
        'half_size': (0.5 * (bounds[1] - bounds[0]) / LENGTH_SCALE).astype(np.float32)}


def thinned(rows: np.ndarray, count: int) -> np.ndarray:
    """Return ``count`` evenly spaced rows of an array (N, ...); they repeat if N is smaller."""
    return rows[np.arange(count) * len(rows) // count]


def features_of_others(camera: int, positions: np.ndarray, has_chosen: np.ndarray) -> np.ndarray:
    """
    Return the inputs of a camera that describe the other cameras, the nearest first.

    :param camera: number of the camera that chooses, from 0.
    :param positions: (K, 3) metres: positions of the K cameras, after the moves chosen so far.
    :param has_chosen: (K,) bool, whether each camera has chosen its move.
    :returns: (``MAX_OTHERS``, ``OF_OTHERS``) float32; rows without a camera are 0.
    """
    features = np.zeros((MAX_OTHERS, OF_OTHERS), dtype=np.float32)
    vectors = (np.delete(positions, camera, axis=0) - positions[camera]) / LENGTH_SCALE
    nearest = np.argsort(np.linalg.norm(vectors, axis=1), kind='stable')[:MAX_OTHERS]
    features[:len(nearest), :3] = vectors[nearest]
    features[:len(nearest), 3] = 1.0
    features[:len(nearest), 4] = np.delete(has_chosen, camera)[nearest]
    return features


def features_of_air(position: np.ndarray, centres: np.ndarray, is_unseen: np.ndarray
                    ) -> np.ndarray:
    """
    Return the inputs of a camera that describe the unseen air around it.

    A rotation by a quarter turn, or a reflection, of the room changes the order of the rows, and
    rotates or mirrors the vectors in them.

    :param position: (2 or more,) metres: position of the camera.
    :param centres: (C, 2) metres: centres of the cells of the air.
    :param is_unseen: (C,) bool, whether no camera has covered a cell.
    :returns: (``SECTORS``, ``OF_SECTOR``) float32; rows without unseen air are 0.
    """
    vectors = centres - position[:2]
    angles = np.arctan2(vectors[:, 1], vectors[:, 0]) * (SECTORS / (2.0 * np.pi))
    sectors = np.floor(angles).astype(np.int64) % SECTORS
    cells = np.bincount(sectors, minlength=SECTORS)
    sectors, vectors = sectors[is_unseen], vectors[is_unseen]
    unseen = np.bincount(sectors, minlength=SECTORS)
    sums = [np.bincount(sectors, values, SECTORS) for values in vectors.T]
    features = np.zeros((SECTORS, OF_SECTOR), dtype=np.float32)
    features[:, :2] = np.stack(sums, axis=1) / (np.maximum(unseen, 1)[:, None] * LENGTH_SCALE)
    features[:, 2] = unseen / max(len(sectors), 1)
    features[:, 3] = unseen / np.maximum(cells, 1)
    return features


class EncodedTurn:
    """
    The network's inputs at one turn, camera by camera.

    :param encoder: has the sizes of the network, the limits of the rig and its state.
    :param cloud: (M, 3) float32, metres, map frame: M observed points.
    :param observed: partial map with the cameras' views; None if the cloud is too small for a map.
    :param positions: (K, 3) metres, map frame: current positions of the K cameras.
    :param turn: turns taken so far.
    :param turns: turns of the whole episode.
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
    Encode the observation of a turn for one camera after the other.

    The inputs of a camera are those of :func:`encode`, and ``others`` (``MAX_OTHERS``,
    ``OF_OTHERS``), ``turn`` (``OF_TURN``,), ``heading`` (1, 3), the direction in which the camera
    looks (0 for an omnidirectional camera), ``air`` (``SECTORS``, ``OF_SECTOR``) and uint8
    ``marks`` (P, ``MARKS``) of P points.

    :param config: sizes of the network.
    :param max_range: effective range of the omnidirectional cameras, metres.
    :param max_step: longest move of a camera in one turn, metres.
    :param wall_margin: smallest distance of cameras from the observed bounding box, metres.
    :param clearance: smallest distance of cameras from all observed points, metres.
    :ivar partial_maps: creates the partial map of each turn; it shows which cameras see each
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
        Record a turn, and return its inputs camera by camera.

        :param cloud: (M, 3) float32, metres, map frame: M observed points.
        :param positions: (K, 3) metres, map frame: current positions of the K cameras.
        :param turn: turns taken so far.
        :param turns: turns of the whole episode.
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
