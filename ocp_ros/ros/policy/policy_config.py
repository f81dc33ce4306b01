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

"""Parameters of ``policy_node``."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from ocp_ros.online.lookahead import TUNING
from ocp_ros.rig.rig_file import MOVING
from ocp_ros.ros.interface.frames import frame_prefix, publish_tf
from ocp_ros.ros.runtime.managed_node import autostart
from ocp_ros.simulation.simulation_config import EpisodeLimits, limits_by_rig
from ocp_ros.util.resources import DEFAULT_MODEL
from ocp_ros.util.settings import ConfigurationError, setting

PLANNERS = ('learned', 'lookahead')
#: Defaults if ``manual`` is true: few turns with long moves, as each turn is work for a person.
MANUAL_DEFAULTS = {'turns': 5, 'max_step': 2.0, 'max_turn': 1.6, 'think_seconds': 0.0}


def limits_of_turns(given: dict[str, Any]) -> dict[str, Any]:
    """
    Return the defaults of the limits of a turn, of live cameras or in a simulation.

    :param given: the parameters that the user has given. Unless a person moves the cameras, the
        limits that a rig file states replace the others.
    """
    live = bool(given.get('cloud_topics'))
    if live and given.get('manual') is True:
        return MANUAL_DEFAULTS
    return (MOVING if live else {}) | limits_by_rig(given.get('rig_file', ''))


@dataclass(frozen=True)
class PolicyNodeConfig(EpisodeLimits):
    """Parameters of ``policy_node``."""

    planner: str = setting(
        'learned', 'planner of the moves: learned, where a trained policy explores and a search '
        'on the observed points finishes; lookahead, where this search does both and needs no '
        'weights', choices=PLANNERS)
    model: str = setting(
        DEFAULT_MODEL, 'weights: a path, or the name of a shipped model; lookahead ignores it')
    max_range: float = setting(4.0, 'maximum range of the cameras, metres; with a rig file its '
                               'ranges apply', 0.1, 100.0, running=True)
    min_range: float = setting(0.0, 'minimum range of the cameras, metres; with a rig file its '
                               'ranges apply', 0.0, 10.0, running=True)
    explore: bool = setting(
        False, 'for training: draw moves at random from the distribution of the policy, whatever '
               'the planner is; the placement never becomes final')
    follow_trainer: bool = setting(
        False, 'take the weights of the first training run that publishes some; with explore '
               'always so')
    seed: int = setting(0, 'seed of exploration and lookahead', 0, 1 << 31)
    threads: int = setting(
        0, 'number of threads that evaluate positions; 0: one per core', 0, 1024)
    rig_file: str = setting(
        '', 'rig file whose constraints every command keeps (docs/reference/rig.md); empty: none, '
        'but real cameras below 2.2 m are taken to be on tripods')
    placement_file: str = setting('', 'file for the final placement, .yaml or .json '
                                  '(docs/reference/placement.md); empty: write no file')
    scan: str = setting('', 'live: scan of the room in the frame of the poses, metres, z up: '
                        '`~/calibrate` registers the cameras to it; empty: to each other')
    drift_seconds: float = setting(
        0.0, 'live: time between two checks whether cameras of a final placement have moved, '
        'seconds; 0: never', 0.0, 86400.0, running=True)
    cloud_topics: str = setting(
        '', 'live: topics of the clouds or depth images, a list or separated by commas; empty: '
        'work with a simulation', names=True)
    camera_frames: str = setting(
        '', 'live: frame of each camera, a list or separated by commas: the poses are read from '
        'tf; empty: they come on `camera_poses`', names=True)
    fixed_frame: str = setting('map', 'live: frame of the poses that are read from tf')
    voxel_size: float = setting(
        0.05, 'live: edge of the voxels of the fused cloud, metres', 0.001, 1.0)
    arrival_distance: float = setting(0.05, 'live: a camera within this distance of its target '
                                      'has arrived, metres', 0.01, 1.0, running=True)
    arrival_angle: float = setting(0.1, 'live: a camera within this angle of its target has '
                                   'arrived, radians', 0.01, 3.1416, running=True)
    arrival_timeout: float = setting(20.0, 'live: after this time the turn goes on with cameras '
                                     'that have not arrived, seconds', 0.1, 3600.0, running=True)
    cloud_timeout: float = setting(2.0, 'live: time to wait for clouds after the arrival of the '
                                   'cameras, seconds', 0.1, 3600.0, running=True)
    turn_seconds: float = setting(0.0, 'live: shortest duration of a turn, seconds; it limits the '
                                  'speed to max_step / turn_seconds', 0.0, 3600.0, running=True)
    think_seconds: float = setting(
        0.3, 'live: longest time from the last cloud of a turn until the command goes out by the '
        'plan so far, which is improved while the cameras move, seconds; 0: no limit, the default '
        'if a person moves the cameras', 0.0, 3600.0)
    publish_tf: bool = publish_tf()
    frame_prefix: str = frame_prefix()
    autostart: bool = autostart()
    manual: bool = setting(False, 'live: a person moves the cameras as `instructions` says, '
                           'without time limit; the defaults are then 5 turns of at most 2 m '
                           'and 1.6 radians, in place of 12 of 1.5 m and 1.6 radians for a rig')

    def __post_init__(self) -> None:
        """Refuse parameters that contradict each other."""
        if self.min_range >= self.max_range:
            raise ConfigurationError(f'min_range: found {self.min_range} m with max_range '
                                     f'{self.max_range} m; expected less than it')
        if self.follow_trainer and self.needs_no_weights:
            raise ConfigurationError('follow_trainer: found true with planner lookahead, which '
                                     'has no weights; expected planner learned')
        if self.scan and not self.live_topics:
            raise ConfigurationError('scan: found one without cloud_topics; expected live cameras '
                                     'to register to it; name the topics of their clouds')
        if self.camera_frames and not self.live_topics:
            raise ConfigurationError('camera_frames: found it without cloud_topics; expected live '
                                     'cameras; name the topics of their clouds')
        if self.manual and not self.live_topics:
            raise ConfigurationError('manual: found true without cloud_topics; expected live '
                                     'cameras that a person moves; name the topics of their '
                                     'clouds')

    @property
    def live_topics(self) -> list[str]:
        """Return the topics of live clouds; empty with a simulation."""
        return names_in(self.cloud_topics)

    @property
    def calibrates(self) -> bool:
        """Return whether the clouds of live cameras are registered."""
        return bool(self.scan) or self.drift_seconds > 0.0

    @property
    def needs_no_weights(self) -> bool:
        """Return whether no policy is needed, and therefore no weights."""
        return self.planner == 'lookahead' and not self.explore


def limits_text(config: PolicyNodeConfig) -> str:
    """Return in words how far the limits of a turn let a camera get."""
    way = config.turns * config.max_step
    exploring = TUNING.refining_share * way
    return (f'limits: {config.turns} turns of at most {config.max_step:g} m and '
            f'{np.rad2deg(config.max_turn):.0f} degrees: a camera explores along at most '
            f'{exploring:.1f} m, and its final pose is within {way - exploring:.1f} m of where it '
            'then is; a larger room needs longer steps or more turns')


def names_in(text: str) -> list[str]:
    """Return the names in a text with commas between them."""
    return [name for name in map(str.strip, text.split(',')) if name]
