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

"""Settings of the simplest rig: depth cameras on a horizontal plane."""

from dataclasses import dataclass

from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.util.settings import ConfigurationError, MAX_CAMERAS, setting


@dataclass(frozen=True)
class RigConfig:
    """Depth cameras that see all around, on a horizontal plane."""

    cameras: int = setting(4, 'number of cameras', 1, MAX_CAMERAS)
    min_range: float = setting(0.0, 'minimum range of a camera, metres', 0.0, 10.0)
    max_range: float = setting(4.0, 'maximum range of a camera, metres', 0.1, 100.0)
    height: float = setting(1.9, 'height of the cameras above the floor, metres', 0.0, 20.0)

    def __post_init__(self) -> None:
        """Refuse contradictory ranges."""
        if self.min_range >= self.max_range:
            raise ConfigurationError(
                f'rig.min_range: found {self.min_range} m with rig.max_range {self.max_range} m; '
                'expected less than it')

    @property
    def model(self) -> CameraModel:
        """Return the model of each camera."""
        return CameraModel(self.min_range, self.max_range)
