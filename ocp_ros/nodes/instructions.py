# SPDX-License-Identifier: Apache-2.0
"""What a person who moves the cameras has to do, in words."""

import numpy as np

STAY = 'leave every camera where it is'
FINAL = f'the placement is final: {STAY}'


def moving(positions: np.ndarray, targets: np.ndarray, least: float) -> np.ndarray:
    """
    Tell which cameras have to be moved.

    :param positions: (K, 3) metres, where they are.
    :param targets: (K, 3) metres, where they shall go, at the same height.
    :param least: shorter moves are not worth it, metres.
    :returns: (K,) bool.
    """
    return np.linalg.norm((targets - positions)[:, :2], axis=1) > least


def instructions(positions: np.ndarray, targets: np.ndarray, least: float) -> str:
    """
    Write one line per camera that has to be moved; see :func:`moving` for the parameters.

    :param least: at least a centimetre, which is what the words tell.
    """
    lines = [_line(camera, positions[camera, :2], targets[camera, :2])
             for camera in np.flatnonzero(moving(positions, targets, least))]
    return '\n'.join(lines) or STAY


def _line(camera: int, position: np.ndarray, target: np.ndarray) -> str:
    """Write where one camera goes."""
    ways = [f'{abs(way):.2f} m towards {"-" if way < 0.0 else "+"}{axis}'
            for axis, way in zip('xy', target - position, strict=True) if abs(way) >= 0.005]
    # Adding 0 makes -0 a 0.
    x, y = np.round(target, 2) + 0.0
    return f'camera {camera}: {" and ".join(ways)}, to ({x:.2f}, {y:.2f})'
