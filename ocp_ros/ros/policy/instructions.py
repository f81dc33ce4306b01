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

"""Instructions in words for a person who moves the cameras."""

import numpy as np

STAY = 'leave every camera where it is'
FINAL = f'the placement is final: {STAY}'


def moving(positions: np.ndarray, targets: np.ndarray, least: float) -> np.ndarray:
    """
    Return which cameras have to be moved.

    :param positions: (K, 3) metres, present positions.
    :param targets: (K, 3) metres, target positions.
    :param least: moves up to this length are left out, metres.
    :returns: (K,) bool.
    """
    return np.linalg.norm(targets - positions, axis=1) > least


def instructions(positions: np.ndarray, targets: np.ndarray, least: float,
                 turns: np.ndarray | None = None, least_turn: float = np.inf,
                 expected: str = '') -> str:
    """
    Write one line for each camera that has to be moved or rotated; see :func:`moving`.

    :param least: at least 0.01 m: the lines have metres with two decimals.
    :param turns: (K, 2) radians: the rotation of each camera, counter-clockwise seen from above,
        and down; None if no camera is rotated.
    :param least_turn: rotations up to this angle are left out, radians; at least a degree.
    :param expected: a sentence on the expected gain, so that a person can decide to stop.
    """
    turns = np.zeros((len(targets), 2)) if turns is None else turns
    moved, turned = moving(positions, targets, least), np.linalg.norm(turns, axis=1) > least_turn
    lines = []
    for camera in np.flatnonzero(moved | turned):
        parts = [_move(positions[camera], targets[camera])] if moved[camera] else []
        parts += [_turn(*np.rad2deg(turns[camera]))] if turned[camera] else []
        lines.append(f'camera {camera}: {"; ".join(parts)}')
    if not lines:
        return STAY
    return '\n'.join([*lines, expected] if expected else lines)


def _turn(yaw: float, pitch: float) -> str:
    """Write the rotation of one camera, from degrees to the left and down."""
    ways = [f'{abs(angle):.0f} degrees {words[int(angle < 0.0)]}' for angle, words in
            ((yaw, ('to the left', 'to the right')), (pitch, ('down', 'up')))
            if abs(angle) >= 0.5]
    return f'turn {" and ".join(ways)}'


def _move(position: np.ndarray, target: np.ndarray) -> str:
    """Write the move of one camera: the distance along each axis, and the target."""
    way = target - position
    ways = [f'{abs(length):.2f} m {words[int(length < 0.0)]}' for length, words in zip(way, (
        ('towards +x', 'towards -x'), ('towards +y', 'towards -y'), ('up', 'down')), strict=True)
        if abs(length) >= 0.005]
    # Adding 0 changes -0 to 0.
    ends = [f'{end + 0.0:.2f}' for end in np.round(target, 2)[:3 if abs(way[2]) >= 0.005 else 2]]
    return f'{" and ".join(ways)}, to ({", ".join(ends)})'
