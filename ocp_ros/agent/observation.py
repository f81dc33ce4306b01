# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The observation cache: what the network reads, computed once per observation.

Sampling and grouping only depend on the cloud, so their indices are stored with the observation
and never computed again at a gradient step.
"""

import numpy as np

from ocp_ros.agent.agent_config import AgentConfig
from ocp_ros.agent.sampling import ball_query, farthest_points
from ocp_ros.geometry.clouds import fixed_size


def encode(cloud: np.ndarray, camera_positions: np.ndarray, bounds: np.ndarray,
           config: AgentConfig) -> dict[str, np.ndarray]:
    """
    Turn an observation into the network's inputs, in units of ``length_scale``.

    The origin is the middle of the observed cloud's bounding box.

    :param cloud: (N, 3) float32, metres, map frame, N >= 1: the points seen so far.
    :param camera_positions: (K, 3), metres, map frame.
    :param bounds: (2, 3), metres: bounding box of all points seen so far.
    :param config: sizes.
    :returns: ``points`` (P, 3), ``keys_1`` (K1,), ``groups_1`` (K1, G1), ``keys_2`` (K2,),
        ``groups_2`` (K2, G2), all indices int16, ``cameras`` (K, 3) and ``half_size`` (3,).
    """
    centre, scale = bounds.mean(axis=0), config.length_scale
    points = ((fixed_size(cloud, config.points) - centre) / scale).astype(np.float32)
    keys_1 = farthest_points(points, config.keys_1)
    key_points = points[keys_1]
    keys_2 = farthest_points(key_points, config.keys_2)
    indices = {
        'keys_1': keys_1,
        'groups_1': ball_query(points, keys_1, config.radius_1 / scale, config.group_1),
        'keys_2': keys_2,
        'groups_2': ball_query(key_points, keys_2, config.radius_2 / scale, config.group_2)}
    return {
        'points': points,
        # Half the memory where they are kept: there are never more than 32767 points.
        **{name: value.astype(np.int16) for name, value in indices.items()},
        'cameras': ((camera_positions - centre) / scale).astype(np.float32),
        'half_size': (0.5 * (bounds[1] - bounds[0]) / scale).astype(np.float32)}
