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

"""The transform between the map frame and the frame of the file that a room was read from."""

from dataclasses import dataclass, field

import numpy as np
from ocp_ros.scenes.up_axis import up_of


@dataclass(frozen=True, eq=False)
class SourceFrame:
    """
    The transform from file to map coordinates: ``map = scale * rotation @ file - shift``.

    :ivar scale: metres per unit of the file.
    :ivar rotation: (3, 3), from the axes of the file to those of the map, z up.
    :ivar shift: (3,) metres, subtracted after scaling and rotation.
    """

    scale: float = 1.0
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    shift: np.ndarray = field(default_factory=lambda: np.zeros(3))

    @property
    def is_map(self) -> bool:
        """Return whether the file has the coordinates of the map."""
        return bool(self.scale == 1.0 and np.array_equal(self.rotation, np.eye(3))
                    and not np.any(self.shift))

    @property
    def matrix(self) -> np.ndarray:
        """Return the transform of homogeneous coordinates from the map to the file: (4, 4)."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation.T / self.scale
        matrix[:3, 3] = self.rotation.T @ self.shift / self.scale
        return matrix

    @property
    def up(self) -> str:
        """Return the direction of the file that is up in the map, such as ``'z'`` or ``'-y'``."""
        return up_of(self.rotation)

    def to_source(self, positions: np.ndarray) -> np.ndarray:
        """Return positions (..., 3) in the map, metres, as positions in the frame of the file."""
        return (np.asarray(positions, dtype=np.float64) + self.shift) @ self.rotation / self.scale

    def to_map(self, positions: np.ndarray) -> np.ndarray:
        """Return positions (..., 3) in the frame of the file as positions in the map, metres."""
        positions = np.asarray(positions, dtype=np.float64)
        return self.scale * (positions @ self.rotation.T) - self.shift

    def rotated(self, rotation: np.ndarray) -> 'SourceFrame':
        """Return the transform after a rotation (3, 3) of the map about its origin."""
        return SourceFrame(self.scale, rotation @ self.rotation, rotation @ self.shift)
