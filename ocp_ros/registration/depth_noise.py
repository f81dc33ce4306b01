# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How far off a measured depth may be, for any depth camera."""

import numpy as np

#: Standard deviation of what registration takes a measured point for: at no distance, metres,
#: and for each square metre of distance, 1/m; between a stereo camera's and a better one's.
NEAR, FARTHER = 0.005, 0.0015


def deviation(distance: np.ndarray) -> np.ndarray:
    """Return the standard deviation of points, metres, at some distances, metres."""
    return np.hypot(NEAR, FARTHER * distance * distance)
