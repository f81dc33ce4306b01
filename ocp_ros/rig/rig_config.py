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
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.util.settings import check_known, ConfigurationError, MAX_CAMERAS, setting

OMNIDIRECTIONAL = 'omnidirectional'
#: The values of ``sensors`` that one camera may have.
KINDS = (OMNIDIRECTIONAL, *SENSORS)


@dataclass(frozen=True)
class RigConfig:
    """Depth cameras on a horizontal plane."""

    cameras: int = setting(4, 'number of cameras', 1, MAX_CAMERAS)
    sensors: str = setting(
        OMNIDIRECTIONAL, 'omnidirectional, or the preset of a sensor: one for all cameras, or one '
        'for each camera, separated by commas')
    min_range: float = setting(
        0.0, 'minimum range of an omnidirectional camera, metres', 0.0, 10.0)
    max_range: float = setting(
        4.0, 'maximum range of an omnidirectional camera, metres', 0.1, 100.0)
    height: float = setting(1.9, 'height of the cameras above the floor, metres', 0.0, 20.0)
    tilt: float = setting(
        0.0, 'pitch of the cameras, radians; positive looks down', -1.5708, 1.5708)

    def __post_init__(self) -> None:
        """Refuse contradictory ranges and unknown sensors."""
        if self.min_range >= self.max_range:
            raise ConfigurationError(
                f'rig.min_range: found {self.min_range} m with rig.max_range {self.max_range} m; '
                'expected less than it')
        names = self._sensor_names
        check_known(names, KINDS, 'rig.sensors')
        if len(names) not in (1, self.cameras):
            raise ConfigurationError(
                f'rig.sensors: found {len(names)} sensors for rig.cameras {self.cameras}; '
                'expected one for all or one for each')

    @property
    def _sensor_names(self) -> list[str]:
        """Return the names of the sensors, one for all cameras or one for each camera."""
        return [name.strip() for name in self.sensors.split(',')]

    @property
    def models(self) -> tuple[CameraModel, ...]:
        """Return one model for all cameras, or one for each camera."""
        omnidirectional = CameraModel(self.min_range, self.max_range)
        return tuple(omnidirectional if name == OMNIDIRECTIONAL else SENSORS[name].model
                     for name in self._sensor_names)
