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

"""Which axis of a scan points up: the six directions, and a guess where nobody says."""

import numpy as np
from ocp_ros.geometry.voxels import voxel_downsample

# The axes of the file, and their signs, that make x, y and z of the map: rotations all of them.
_MAP_FROM_FILE = {
    'x': ([1, 2, 0], [1, 1, 1]), '-x': ([2, 1, 0], [1, 1, -1]),
    'y': ([0, 2, 1], [1, -1, 1]), '-y': ([0, 2, 1], [1, 1, -1]),
    'z': ([0, 1, 2], [1, 1, 1]), '-z': ([0, 1, 2], [1, -1, -1])}
#: The directions of a file that may point up.
UP_AXES = tuple(_MAP_FROM_FILE)
#: What asks for a guess, what the format of the file says and else z, and all that may be said.
AUTO, BY_FILE = 'auto', 'file'
UP_CHOICES = (*UP_AXES, AUTO, BY_FILE)
#: Metres: edge of the cubes that count as one point; band off the floor and off the ceiling whose
#: furniture is compared; and cubes that say nothing.
CUBE, BAND, TRIFLE = 0.1, (0.15, 1.2), 20
#: How much fuller the upper band has to be, as a logarithm, before z is guessed to point down.
DOWN = -0.25


def map_from_file(up: str) -> np.ndarray:
    """
    Return the rotation from the axes of a file to those of the map, z up.

    :param up: one of :data:`UP_AXES`.
    :returns: (3, 3), determinant 1.
    """
    axes, signs = _MAP_FROM_FILE[up]
    return np.eye(3)[axes] * np.array(signs)[:, None]


def up_of(rotation: np.ndarray) -> str:
    """Return the direction of a file that a rotation (3, 3) from it to the map turns upwards."""
    axis = int(np.argmax(np.abs(rotation[2])))
    return ('-' if rotation[2, axis] < 0.0 else '') + 'xyz'[axis]


def axis_of(up: str) -> int:
    """Return the number of the axis of a direction: 0, 1 or 2."""
    return 'xyz'.index(up[-1])


def likely_up_axis(points: np.ndarray) -> str:
    """
    Guess which axis of a room points up or down: that between its two fullest layers.

    Floor and ceiling reach over the whole room, walls have openings and differ: each axis scores
    the geometric mean of the shares of points in its lowest and highest decimetre. The guess
    leaves z only for clear evidence: another axis with half as high a score again, shorter than z
    and, since corridors are narrow but no room is lower, longer than 2 m.

    A bare cube has no up, and a closed shaft higher than 1.5 times its width looks like a room
    lying down: for the first the guess is z, for the second it is wrong.

    :param points: (N, 3), metres.
    :returns: ``'x'``, ``'y'`` or ``'z'``.
    """
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    score = np.sqrt((points < low + 0.1).mean(axis=0) * (points > high - 0.1).mean(axis=0))
    best = int(score.argmax())
    size = high - low
    clear = score[best] > 1.5 * score[2] and 2.0 < size[best] < size[2]
    return 'xyz'[best] if clear else 'z'


def likely_up(points: np.ndarray) -> str:
    """
    Guess which direction of a room points up.

    The axis is that of :func:`likely_up_axis`. Furniture stands on the floor, so the end of the
    axis whose neighbourhood is fuller is the lower one. Files with z down are rare: z is guessed
    to point down only for clear evidence.

    :param points: (N, 3), metres.
    :returns: one of :data:`UP_AXES`.
    """
    axis = likely_up_axis(points)
    cubes = voxel_downsample(np.asarray(points - points.mean(axis=0), dtype=np.float32), CUBE)
    along = cubes[:, axis_of(axis)]
    low, high = np.percentile(along, [0.5, 99.5])
    counts = [np.count_nonzero((away > BAND[0]) & (away < BAND[1]))
              for away in (along - low, high - along)]
    evidence = np.log((TRIFLE + counts[0]) / (TRIFLE + counts[1]))
    return axis if evidence > (DOWN if axis == 'z' else 0.0) else f'-{axis}'
