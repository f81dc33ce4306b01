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

"""The number of seeing cameras and the error at each point of a room, for display."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import Pose
from ocp_ros.geometry.packed_bits import unpack
from ocp_ros.simulation.simulator import Simulator, View


class PointMaps(NamedTuple):
    """
    The number of cameras and the error at each point.

    :ivar points: (N, 3) float32, metres, map frame: the N points of the scene.
    :ivar count: (N,) int64, the number of cameras that see each point.
    :ivar error: (N,) float64, metres, the contribution of each point to the depth error; the sum
        is the depth error.
    """

    points: np.ndarray
    count: np.ndarray
    error: np.ndarray


def maps_of(simulator: Simulator, poses: Sequence[Pose]) -> PointMaps:
    """
    Compute the maps of a placement.

    :param simulator: the engine for the room; its model k belongs to camera k, or its only model
        to all cameras.
    :param poses: the poses of K cameras, K >= 1.
    """
    return maps_of_views(simulator, [simulator.look(pose, camera)
                                     for camera, pose in enumerate(poses)])


def maps_of_views(simulator: Simulator, views: Sequence[View]) -> PointMaps:
    """Compute the maps of a placement, given the views of its cameras."""
    order = simulator.visibility.order
    count, error = np.empty(len(order), dtype=np.int64), np.empty(len(order))
    # Views are in the engine's order; the maps are in the order of the scene.
    count[order] = np.sum([unpack(view.seen, len(order)) for view in views], axis=0)
    error[order] = simulator.depth_error.error_by_point(
        np.bitwise_or.reduce([view.seen for view in views]))
    return PointMaps(simulator.scene.points, count, error)
