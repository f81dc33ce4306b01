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
The network's inputs from an observed cloud, computed once per observation.

Sampling and grouping depend on the cloud alone, so their indices are stored with the observation
and not computed again at a gradient step.
"""

import numpy as np
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.policy.agent_config import AgentConfig, PAPER
from ocp_ros.policy.sampling import ball_query, farthest_points, nearest_in_ball

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
