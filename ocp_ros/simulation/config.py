# SPDX-License-Identifier: Apache-2.0
"""Settings of a simulated rig: cameras, engine, episode and reward."""

from dataclasses import dataclass

import numpy as np

from ocp_ros.configuration import check_known, ConfigurationError, group, MOST_CAMERAS, setting
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.geometry.sensors import SENSORS
from ocp_ros.geometry.visibility import PRESETS

OMNIDIRECTIONAL = 'omnidirectional'
KINDS = (OMNIDIRECTIONAL, *SENSORS)


@dataclass(frozen=True)
class RigConfig:
    """Depth cameras on a horizontal plane."""

    cameras: int = setting(4, 'number of cameras', 1, MOST_CAMERAS)
    sensors: str = setting(
        OMNIDIRECTIONAL, 'omnidirectional or the preset of a sensor, one for all cameras or one '
        'for each with commas between')
    min_range: float = setting(
        0.0, 'nearest distance an omnidirectional camera measures, metres', 0.0, 10.0)
    max_range: float = setting(
        4.0, 'effective range of an omnidirectional camera, metres', 0.1, 100.0)
    height: float = setting(1.9, 'height of the cameras above the floor, metres', 0.0, 20.0)
    tilt: float = setting(
        0.0, 'how far the cameras look down, radians; negative looks up', -1.5708, 1.5708)

    def __post_init__(self) -> None:
        """Refuse ranges that exclude each other and sensors that do not exist."""
        if self.min_range >= self.max_range:
            raise ConfigurationError(
                f'rig.min_range: found {self.min_range} m with rig.max_range {self.max_range} m; '
                'expected less than it')
        names = self._names
        check_known(names, KINDS, 'rig.sensors')
        if len(names) not in (1, self.cameras):
            raise ConfigurationError(
                f'rig.sensors: found {len(names)} sensors for rig.cameras {self.cameras}; '
                'expected one for all or one for each')

    @property
    def _names(self) -> list[str]:
        """Return the names of the sensors."""
        return [name.strip() for name in self.sensors.split(',')]

    @property
    def models(self) -> tuple[CameraModel, ...]:
        """Return the model that all cameras share, or one for each."""
        own = CameraModel(self.min_range, self.max_range)
        return tuple(own if name == OMNIDIRECTIONAL else SENSORS[name].model
                     for name in self._names)

    @property
    def ranges(self) -> np.ndarray:
        """Return how far each camera sees: (K,) metres."""
        return np.broadcast_to([model.max_range for model in self.models], self.cameras)

    @property
    def headings(self) -> np.ndarray:
        """Return how the cameras of an episode are turned, outwards: (K, 3) yaw, pitch, roll."""
        headings = np.zeros((self.cameras, 3))
        headings[:, 0] = 2.0 * np.pi * np.arange(self.cameras) / self.cameras
        headings[:, 1] = self.tilt
        return headings


@dataclass(frozen=True)
class EngineConfig:
    """Resolution and rules of the shadow maps."""

    preset: str = setting('fine', 'visibility rules: fine, fast or paper', choices=tuple(PRESETS))
    error_rows: int = setting(
        128, 'rows of the depth maps of the error; they have twice as many columns', 16, 2048)
    coverage_cell: float = setting(0.25, 'edge of a cell of the coverage grid, metres', 0.02, 5.0)


@dataclass(frozen=True)
class EpisodeConfig:
    """Turns of one episode."""

    turns: int = setting(30, 'turns until the episode ends', 1, 100000, running=True)
    max_step: float = setting(
        0.5, 'farthest a camera moves in one turn, metres', 0.001, 10.0, running=True)
    start_radius: float = setting(
        0.5, 'cameras start this near the centre, metres', 0.0, 50.0, running=True)
    wall_margin: float = setting(
        0.1, 'cameras stay this far inside the bounding box, metres', 0.0, 5.0,
        running=True)


@dataclass(frozen=True)
class RewardConfig:
    """Reward of a turn; see :mod:`ocp_ros.simulation.reward` for the formulas."""

    kind: str = setting('potential', 'reward: potential or paper', choices=('potential', 'paper'),
                        running=True)
    coverage: float = setting(0.02, 'paper: K_SC, per cubic metre', 0.0, 1000.0, running=True)
    depth_error: float = setting(1.0, 'paper: K_DOE, per metre', 0.0, 1000.0, running=True)
    penalty: float = setting(-1.0, 'K_P, for a turn that leads out of the room', -1000.0, 0.0,
                             running=True)


@dataclass(frozen=True)
class SimulationConfig:
    """Everything about a simulated rig but the room."""

    rig: RigConfig = group(RigConfig)
    engine: EngineConfig = group(EngineConfig)
    episode: EpisodeConfig = group(EpisodeConfig)
    reward: RewardConfig = group(RewardConfig)
