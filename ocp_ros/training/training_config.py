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

"""Settings of a training run."""

from dataclasses import dataclass
from typing import Any

from ocp_ros.policy.agent_config import AgentConfig
from ocp_ros.scenes.source_frame import BY_FILE, UP_CHOICES
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.util.settings import ConfigurationError, group, MAX_CAMERAS, MAX_SEED, setting


@dataclass(frozen=True)
class SacConfig:
    """Settings of soft actor-critic (Haarnoja et al., 2018), named as in stable-baselines3."""

    learning_rate: float = setting(5e-4, 'step size of Adam', 1e-7, 1.0)
    constant_share: float = setting(
        0.6, 'share of the interactions after which the step size falls, to a tenth at the '
             'end', 0.0, 1.0)
    averaging: int = setting(
        4000, 'gradient steps over which the weights that are used are averaged; 0: they are '
              'the last ones', 0, 1000000)
    batch_size: int = setting(128, 'transitions per gradient step', 1, 65536)
    buffer_size: int = setting(100000, 'transitions the replay buffer holds', 100, 1000000)
    learning_starts: int = setting(1000, 'transitions before the first gradient step', 1, 1000000)
    gamma: float = setting(0.95, 'discount per interaction', 0.0, 1.0)
    tau: float = setting(0.01, 'share of the targets replaced per gradient step', 1e-6, 1.0)
    n_steps: int = setting(
        3, 'with agent.inputs cloud: number of interactions whose rewards are added before the '
           'critics value what follows', 1, 100)
    bfloat16: bool = setting(
        False, 'with agent.inputs cloud: the network that is trained computes with 16 bits in '
               'place of 32, which is faster on processors that can')
    burn_in: int = setting(
        0, 'gradient steps of the critics alone before the actor learns', 0, 1 << 31)
    device: str = setting('auto', 'auto, cpu or cuda', choices=('auto', 'cpu', 'cuda'))


@dataclass(frozen=True)
class RoomsConfig:
    """
    The rooms of a run, in three disjoint sets.

    See :mod:`ocp_ros.training.training_rooms`.
    """

    source: str = setting('generated', 'generated, s3dis (S3DIS_DIR) or a folder of scans',
                          choices=('generated', 's3dis', 'folder'))
    folder: str = setting('', 'folder of scans to learn in, for source: folder')
    scale: float = setting(0.0, 'metres per unit of these scans; 0: as each file says, otherwise '
                                '1', 0.0, 1e6)
    up: str = setting(BY_FILE, 'direction of these scans that points up; auto: guess it; file: as '
                               'its format says, otherwise z', choices=UP_CHOICES)
    training: int = setting(96, 'most rooms to learn in', 1, 100000)
    validation: int = setting(12, 'most rooms to choose the best weights by', 1, 100000)
    test: int = setting(10, 'most rooms to report', 1, 100000)
    points: int = setting(12000, 'points per room', 1000, 1000000)
    rotations: str = setting('0,15,30,45,60,75', 'degrees that rooms are turned by')

    def __post_init__(self) -> None:
        """Refuse rotations that are no numbers, and settings of scans without a folder."""
        try:
            angles = self.angles
        except ValueError:
            angles = ()
        if not angles:
            raise ConfigurationError(f'rooms.rotations: found {self.rotations!r}; expected '
                                     'degrees with commas between')
        if bool(self.folder) != (self.source == 'folder'):
            raise ConfigurationError(
                f'rooms.folder: found {self.folder!r} with rooms.source {self.source!r}; '
                'expected a folder with source: folder, and none with another')
        if not self.folder and (self.scale, self.up) != (0.0, BY_FILE):
            raise ConfigurationError(
                f'rooms.scale and rooms.up: found {self.scale:g} and {self.up!r} with '
                f'rooms.source {self.source!r}; expected a folder of scans that they are about; '
                'leave them out')

    @property
    def reading(self) -> dict[str, Any]:
        """Return the options with which ``make_room`` makes each room."""
        return {'points': self.points, 'scale': self.scale, 'up': self.up}

    @property
    def angles(self) -> tuple[float, ...]:
        """Return the rotations in degrees."""
        return tuple(float(angle) for angle in self.rotations.split(',') if angle.strip())


@dataclass(frozen=True)
class EpisodesConfig:
    """
    What is drawn at the start of each episode, besides room and number of cameras.

    The other end of each range is in ``simulation.episode`` and ``simulation.rig``; 0 draws
    nothing.
    """

    fewest_turns: int = setting(0, 'least number of turns', 0, 100000)
    longest_step: float = setting(
        0.0, 'largest max_step, metres; max_turn is the same number of radians, from '
        'simulation.episode.max_turn to 1.6', 0.0, 10.0)
    farthest_range: float = setting(0.0, 'largest range, metres', 0.0, 100.0)
    widest_start: float = setting(0.0, 'largest start_radius, metres', 0.0, 50.0)
    rig_file: str = setting('', 'a rig file whose cameras play some of the episodes')
    rig_share: float = setting(0.0, 'share of the episodes that they play', 0.0, 1.0)


@dataclass(frozen=True)
class TrainingConfig:
    """Settings of a training run, which ``ocp train`` reads from YAML."""

    seed: int = setting(0, 'seed of networks, exploration and order of rooms', 0, MAX_SEED)
    interactions: int = setting(
        100000, 'interactions: choices of one camera, or with agent.inputs paper turns', 1,
        1 << 40)
    environments: int = setting(4, 'episodes played side by side', 1, 1024)
    workers: int = setting(0, 'processes that play; 0 for one on each core', 0, 1024)
    fewest_cameras: int = setting(
        4, 'least number of cameras in an episode; simulation.rig.cameras is the most', 1,
        MAX_CAMERAS)
    updates_per_turn: float = setting(0.25, 'gradient steps per interaction', 0.0, 100.0)
    evaluate_every: int = setting(2000, 'interactions between evaluations', 1, 1 << 40)
    model: str = setting('', 'first weights: path or name; empty: random')
    rooms: RoomsConfig = group(RoomsConfig)
    episodes: EpisodesConfig = group(EpisodesConfig)
    simulation: SimulationConfig = group(SimulationConfig)
    agent: AgentConfig = group(AgentConfig)
    sac: SacConfig = group(SacConfig)

    def __post_init__(self) -> None:
        """Take the number of cameras from a rig file; refuse settings that contradict others."""
        rig = self.simulation.placed_rig
        # A rig that is not free has the cameras of a rig file; each episode has all of them.
        if not rig.free:
            object.__setattr__(self, 'fewest_cameras', len(rig.cameras))
            rig.check_rotations(self.rooms.angles,
                                f'rooms.rotations: found {self.rooms.rotations!r}', "'0'")
        if self.fewest_cameras > len(rig.cameras):
            raise ConfigurationError(
                f'fewest_cameras: found {self.fewest_cameras} with simulation.rig.cameras '
                f'{len(rig.cameras)}; expected no more than these')
        for count in (self.fewest_cameras, len(rig.cameras)):
            self.agent.check_cameras(count)

    @property
    def domain(self) -> dict[str, list[float]]:
        """
        Return the range of each limit that the episodes have: the domain of the trained weights.

        :returns: ``cameras``, ``turns``, ``max_step`` (metres) and ``max_range`` (metres), lowest
            and highest.
        """
        draws, limits, rig = self.episodes, self.simulation.episode, self.simulation.placed_rig
        ranges = {'cameras': (self.fewest_cameras, len(rig.cameras)),
                  'turns': (draws.fewest_turns or limits.turns, limits.turns),
                  'max_step': (limits.max_step, draws.longest_step or limits.max_step),
                  'max_range': (rig.farthest, draws.farthest_range or rig.farthest)}
        return {name: [float(value) for value in pair] for name, pair in ranges.items()}
