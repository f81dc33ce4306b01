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

"""Settings of a simulated rig: cameras, engine, episode and reward."""

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.rig.free_plane import CLEARANCE
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rig.rig_file import load_rig, Rig
from ocp_ros.util.settings import ConfigurationError, group, setting


@dataclass(frozen=True)
class EpisodeLimits:
    """Number of turns of an episode, and limits of the cameras in each turn."""

    turns: int = setting(
        30, 'turns until the episode ends and the placement is final', 1, 100000, running=True)
    max_step: float = setting(
        0.5, 'longest move of a camera in one turn, metres', 0.001, 10.0, running=True)
    max_turn: float = setting(
        0.5, 'largest rotation in one turn, radians, of cameras of a rig file with a limited '
             'field of view; 0: do not turn cameras', 0.0, 3.1416, running=True)
    wall_margin: float = setting(
        0.1, 'least distance to the sides of the bounding box of the room or of the observed '
             'points, metres', 0.0, 5.0, running=True)
    clearance: float = setting(
        CLEARANCE, 'least distance to every surface, metres; 0: no limit; with a rig file '
                   'keep_clear applies', 0.0, 5.0, running=True)


def limits_by_rig(rig_file: str) -> dict[str, float]:
    """
    Return what replaces the default limits of a turn where nothing else is given.

    :param rig_file: a rig file; empty: none. One that cannot be used is refused elsewhere.
    """
    with suppress(ConfigurationError):
        if rig_file:
            return load_rig(rig_file).limits
    return {}


@dataclass(frozen=True)
class EpisodeConfig(EpisodeLimits):
    """Settings of one episode of a simulated rig."""

    start_radius: float = setting(
        0.5, 'largest distance of the start positions from the centre, '
             'metres', 0.0, 50.0, running=True)


@dataclass(frozen=True)
class RewardConfig:
    """Reward of a turn; see :func:`~ocp_ros.simulation.episode.reward` for the formulas."""

    kind: str = setting('potential', 'reward: potential or paper', choices=('potential', 'paper'),
                        running=True)
    coverage: float = setting(
        0.02, 'paper: weight K_SC of space coverage, per cubic metre', 0.0, 1000.0, running=True)
    depth_error: float = setting(
        1.0, 'paper: weight K_DOE of the depth error, per metre', 0.0, 1000.0, running=True)
    explored: float = setting(
        0.0, 'potential: weight of the share of the points that were seen since the episode '
             'began', 0.0, 1000.0, running=True)


@dataclass(frozen=True)
class SimulationConfig:
    """All settings of a simulated rig except the room."""

    rig: RigConfig = group(RigConfig)
    engine: EngineConfig = group(EngineConfig)
    episode: EpisodeConfig = group(EpisodeConfig)
    reward: RewardConfig = group(RewardConfig)
    rig_file: str = setting(
        '', 'rig file (docs/reference/rig.md) that replaces rig.*: cameras and constraints; '
        'empty: none')

    @cached_property
    def placed_rig(self) -> Rig:
        """
        Return the cameras that are placed: those of the rig file, or those that move on a plane.

        :raises ConfigurationError: if the rig file cannot be used.
        """
        return load_rig(self.rig_file) if self.rig_file else Rig.plane(self.rig)
