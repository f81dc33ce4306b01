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

"""
The frame of the file that a room was read from: its up direction, and the transform to the map.

If no up direction is given, it is guessed.
"""

from dataclasses import dataclass, field

import numpy as np
from ocp_ros.geometry.clouds import voxel_downsample

#: For each up direction: the axes of the file, and their signs, that become x, y, z of the map.
_AXES_AND_SIGNS = {
    'x': ([1, 2, 0], [1, 1, 1]), '-x': ([2, 1, 0], [1, 1, -1]),
    'y': ([0, 2, 1], [1, -1, 1]), '-y': ([0, 2, 1], [1, 1, -1]),
    'z': ([0, 1, 2], [1, 1, 1]), '-z': ([0, 1, 2], [1, -1, -1])}
#: The directions of a file that may point up.
UP_AXES = tuple(_AXES_AND_SIGNS)
#: The option for the direction that the file format declares, else z.
BY_FILE = 'file'
#: The option for a direction that is guessed from the points.
AUTO = 'auto'
UP_CHOICES = (*UP_AXES, AUTO, BY_FILE)


def map_from_file(up: str) -> np.ndarray:
    """
    Return the rotation from the axes of a file to those of the map, z up.

    :param up: one of :data:`UP_AXES`.
    :returns: (3, 3), determinant 1.
    """
    axes, signs = _AXES_AND_SIGNS[up]
    return np.eye(3)[axes] * np.array(signs)[:, None]


def axis_of(up: str) -> int:
    """Return the number of the axis, 0, 1 or 2, of a direction such as ``-y``."""
    return 'xyz'.index(up[-1])


def likely_up_axis(points: np.ndarray) -> str:
    """
    Guess the vertical axis of a room: the axis along which floor and ceiling stand out.

    Floor and ceiling extend over the whole room, while walls have openings. The score of an axis
    is the geometric mean of the shares of points in its lowest and highest decimetre. The guess
    differs from z only with clear evidence: the other axis has more than 1.5 times the score of z,
    and its extent is shorter than that of z and, since corridors are narrow but no room is lower,
    longer than 2 m.

    For a bare cube the guess is z. For a closed shaft higher than 1.5 times its width the guess is
    wrong, since it looks like a room lying on its side.

    :param points: (N, 3), metres.
    :returns: ``'x'``, ``'y'`` or ``'z'``.
    """
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    scores = np.sqrt((points < low + 0.1).mean(axis=0) * (points > high - 0.1).mean(axis=0))
    best = int(scores.argmax())
    size = high - low
    is_clear = scores[best] > 1.5 * scores[2] and 2.0 < size[best] < size[2]
    return 'xyz'[best] if is_clear else 'z'


def likely_up(points: np.ndarray) -> str:
    """
    Guess which direction of a room points up.

    The axis is that of :func:`likely_up_axis`. Furniture stands on the floor, so the end of the
    axis with more points nearby is the lower one. Files with z down are rare, so z is guessed to
    point down only with clear evidence.

    :param points: (N, 3), metres.
    :returns: one of :data:`UP_AXES`.
    """
    axis = likely_up_axis(points)
    # All points in a cube of 10 cm count as one point.
    cubes = voxel_downsample(np.asarray(points - points.mean(axis=0), dtype=np.float32), 0.1)
    heights = cubes[:, axis_of(axis)]
    low, high = np.percentile(heights, [0.5, 99.5])
    # Furniture is counted at these distances from either end of the axis.
    min_distance_m, max_distance_m = 0.15, 1.2
    count_low, count_high = (
        np.count_nonzero((distances > min_distance_m) & (distances < max_distance_m))
        for distances in (heights - low, high - heights))
    # This number is added to both counts, since few cubes are no evidence.
    added_cubes = 20
    evidence = np.log((added_cubes + count_low) / (added_cubes + count_high))
    return axis if evidence > (-0.25 if axis == 'z' else 0.0) else f'-{axis}'


@dataclass(frozen=True, eq=False)
class SourceFrame:
    """
    The transform from file to map coordinates: ``map = rotation @ (scales * file) - shift``.

    :ivar scales: (3,) metres per unit of each axis of the file.
    :ivar rotation: (3, 3), from the axes of the file to those of the map, z up.
    :ivar shift: (3,) metres, subtracted after scaling and rotation.
    """

    scales: np.ndarray = field(default_factory=lambda: np.ones(3))
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    shift: np.ndarray = field(default_factory=lambda: np.zeros(3))

    @property
    def scale(self) -> float | None:
        """Return the metres per unit of the file; None if its axes have different units."""
        return float(self.scales[0]) if np.ptp(self.scales) == 0.0 else None

    @property
    def unit(self) -> str:
        """Return the unit of the file in words, or the units of its axes if they differ."""
        units = {1.0: 'metres', 0.001: 'millimetres', 0.01: 'centimetres', 0.0254: 'inches',
                 0.3048: 'feet', 0.30480061: 'US survey feet'}
        names = [units.get(round(scale, 9), f'{scale:g} m') for scale in self.scales.tolist()]
        return names[0] if self.scale is not None else ', '.join(
            f'{axis} in {name}' for axis, name in zip('xyz', names))

    @property
    def is_map(self) -> bool:
        """Return whether the file has the coordinates of the map."""
        return bool(self.scale == 1.0 and np.array_equal(self.rotation, np.eye(3))
                    and not np.any(self.shift))

    @property
    def matrix(self) -> np.ndarray:
        """Return the transform of homogeneous coordinates from the map to the file: (4, 4)."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation.T / self.scales[:, None]
        matrix[:3, 3] = self.rotation.T @ self.shift / self.scales
        return matrix

    @property
    def up(self) -> str:
        """Return the direction of the file that is up in the map, such as ``'z'`` or ``'-y'``."""
        axis = int(np.argmax(np.abs(self.rotation[2])))
        return ('-' if self.rotation[2, axis] < 0.0 else '') + 'xyz'[axis]

    def to_source(self, positions: np.ndarray) -> np.ndarray:
        """Return positions (..., 3) in the map, metres, as positions in the frame of the file."""
        return (np.asarray(positions, dtype=np.float64) + self.shift) @ self.rotation / self.scales

    def to_map(self, positions: np.ndarray) -> np.ndarray:
        """Return positions (..., 3) in the frame of the file as positions in the map, metres."""
        positions = np.asarray(positions, dtype=np.float64)
        return (self.scales * positions) @ self.rotation.T - self.shift

    def rotated(self, rotation: np.ndarray) -> 'SourceFrame':
        """Return the transform after a rotation (3, 3) of the map about its origin."""
        return SourceFrame(self.scales, rotation @ self.rotation, rotation @ self.shift)
