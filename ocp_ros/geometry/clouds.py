# SPDX-License-Identifier: Apache-2.0
"""Clouds of a fixed size."""

import numpy as np


def fixed_size(points: np.ndarray, count: int) -> np.ndarray:
    """
    Take ``count`` points at even strides through a cloud; repeat some if it has fewer.

    :param points: (N, 3), N >= 1.
    :param count: how many to take.
    :returns: (count, 3) float32.
    """
    return np.ascontiguousarray(points[np.arange(count) * len(points) // count], dtype=np.float32)
