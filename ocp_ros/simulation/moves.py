# SPDX-License-Identifier: Apache-2.0
"""Moves of cameras on their plane: bounded in length, kept inside the room."""

import numpy as np


def bounded_moves(actions: np.ndarray, max_step: float) -> np.ndarray:
    """
    Turn actions into moves, none longer than ``max_step``.

    :param actions: (K, 2) in [-1, 1].
    :param max_step: metres.
    :returns: (K, 2) float64, metres.
    """
    actions = np.asarray(actions, dtype=np.float64).reshape(-1, 2)
    length = np.linalg.norm(actions, axis=1, keepdims=True)
    return actions / np.maximum(length, 1.0) * max_step


def towards(positions: np.ndarray, targets: np.ndarray, reach: float) -> np.ndarray:
    """
    Go from positions (K, 2) to targets (K, 2), metres, but no farther than some reach, metres.

    :returns: (K, 2) metres.
    """
    way = targets - positions
    length = np.linalg.norm(way, axis=1, keepdims=True)
    return positions + way * np.minimum(reach / np.maximum(length, 1e-12), 1.0)


def kept_inside(positions: np.ndarray, bounds: np.ndarray, margin: float
                ) -> tuple[np.ndarray, bool]:
    """
    Bring positions back into the bounding box.

    :param positions: (K, 3) metres.
    :param bounds: (2, 3) metres, lowest and highest corner.
    :param margin: metres to keep from the box's sides; at most to its middle.
    :returns: positions (K, 3) float64, and whether any of them was outside the box itself.
    """
    low, high = bounds[0, :2], bounds[1, :2]
    inset = np.minimum(margin, 0.5 * (high - low))
    flat = positions[:, :2]
    outside = bool(((flat < low) | (flat > high)).any())
    inside = np.array(positions, dtype=np.float64)
    inside[:, :2] = np.clip(flat, low + inset, high - inset)
    return inside, outside
