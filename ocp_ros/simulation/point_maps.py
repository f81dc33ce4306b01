# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What of a room some cameras see and what they miss, point by point, to look at."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ocp_ros.geometry.cameras import LEVEL, OMNIDIRECTIONAL, Pose
from ocp_ros.geometry.packed_bits import no_bits, unpack
from ocp_ros.simulation.simulator import Simulator, View


class PointMaps(NamedTuple):
    """
    What cameras see and miss.

    :ivar points: (N, 3) float32, metres, map frame.
    :ivar count: (N,) int64, how many cameras see each point now.
    :ivar error: (N,) float64, metres, the part of the depth error that comes about at each point;
        together they are the depth error.
    """

    points: np.ndarray
    count: np.ndarray
    error: np.ndarray


def maps_of(simulator: Simulator, poses: Sequence[Pose]) -> PointMaps:
    """
    Look from each camera and count.

    :param simulator: the engine for the room; camera k sees as its model k has it, or as its only
        one.
    :param poses: K >= 1.
    """
    models, visibility = simulator.models, simulator.visibility
    counted = np.zeros(len(simulator.scene), dtype=np.int64)
    seen = no_bits(len(simulator.scene))
    for camera, pose in enumerate(poses):
        view = View(no_bits(len(simulator.scene)), no_bits(len(simulator.grid)))
        lens = models[camera if len(models) > 1 else 0].lens
        # How an omnidirectional camera is turned makes no difference.
        turned = Pose(pose.position, LEVEL) if lens.kind == OMNIDIRECTIONAL else pose
        visibility.look(turned, lens, view.seen, view.covered)
        counted += unpack(view.seen, len(counted))
        seen |= view.seen
    count, error = np.empty_like(counted), np.empty(len(counted))
    count[visibility.order], error[visibility.order] = (
        counted, simulator.depth_error.by_point(seen))
    return PointMaps(simulator.scene.points, count, error)
