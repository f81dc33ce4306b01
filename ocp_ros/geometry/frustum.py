# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Clip what an omnidirectional camera sees to a frustum."""

from numba import njit
import numpy as np

from ocp_ros.geometry.cameras import in_view


@njit(cache=True, nogil=True)
def keep_in_cone(points, pose, lens, seen, kept):
    """
    Keep the points in the viewing cone.

    :param points: N :class:`~ocp_ros.geometry.surfels.Surfels` or
        :class:`~ocp_ros.geometry.surfels.SurfelPlaces`.
    :param pose: the camera's :class:`~ocp_ros.geometry.cameras.Pose`.
    :param lens: the camera model's :class:`~ocp_ros.geometry.cameras.Frustum`.
    :param seen: (W,) uint64, packed bits of the points.
    :param kept: (W,) uint64, packed bits, out: those of ``seen`` in the cone.
    """
    x0, y0, z0 = pose.position[0], pose.position[1], pose.position[2]
    rotation = pose.rotation
    for word in range(seen.shape[0]):
        bits, inside = seen[word], np.uint64(0)
        i = word * 64
        flag = np.uint64(1)
        while bits != np.uint64(0):
            if bits & np.uint64(1):
                dx, dy, dz = points.x[i] - x0, points.y[i] - y0, points.z[i] - z0
                x = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
                y = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
                z = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
                if in_view(x, y, z, lens):
                    inside |= flag
            bits >>= np.uint64(1)
            flag <<= np.uint64(1)
            i += 1
        kept[word] = inside
