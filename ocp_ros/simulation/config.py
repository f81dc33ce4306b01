# SPDX-License-Identifier: Apache-2.0
"""Settings of a simulated rig: cameras, engine, episode and reward."""

from dataclasses import dataclass

from ocp_ros.configuration import ConfigurationError, group, setting
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.geometry.visibility import PRESETS


@dataclass(frozen=True)
class RigConfig:
    """Omnidirectional depth cameras on a horizontal plane."""

    cameras: int = setting(4, 'number of cameras', 1, 64)
    min_range: float = setting(0.0, 'nearest distance a camera measures, metres', 0.0, 10.0)
    max_range: float = setting(4.0, 'effective range of a camera, metres', 0.1, 100.0)
    height: float = setting(1.9, 'height of the cameras above the floor, metres', 0.0, 20.0)

    def __post_init__(self) -> None:
        """Refuse ranges that exclude each other."""
        if self.min_range >= self.max_range:
            raise ConfigurationError(
                f'rig.min_range: found {self.min_range} m with rig.max_range {self.max_range} m; '
                'expected less than it')

    @property
    def model(self) -> CameraModel:
        """Return the camera model that all cameras share."""
        return CameraModel(self.min_range, self.max_range)


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

    turns: int = setting(30, 'turns until the episode ends', 1, 100000)
    max_step: float = setting(0.5, 'farthest a camera moves in one turn, metres', 0.001, 10.0)
    start_radius: float = setting(0.5, 'cameras start this near the centre, metres', 0.0, 50.0)
    wall_margin: float = setting(
        0.1, 'cameras stay this far inside the bounding box, metres', 0.0, 5.0)


@dataclass(frozen=True)
class RewardConfig:
    """Reward of a turn; see :mod:`ocp_ros.simulation.reward` for the formulas."""

    kind: str = setting('potential', 'reward: potential or paper', choices=('potential', 'paper'))
    coverage: float = setting(0.02, 'paper: K_SC, per cubic metre', 0.0, 1000.0)
    depth_error: float = setting(1.0, 'paper: K_DOE, per metre', 0.0, 1000.0)
    penalty: float = setting(-1.0, 'K_P, for a turn that leads out of the room', -1000.0, 0.0)


@dataclass(frozen=True)
class SimulationConfig:
    """Everything about a simulated rig but the room."""

    rig: RigConfig = group(RigConfig)
    engine: EngineConfig = group(EngineConfig)
    episode: EpisodeConfig = group(EpisodeConfig)
    reward: RewardConfig = group(RewardConfig)
