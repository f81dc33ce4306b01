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

from ocp_ros.rig.free_plane import CLEARANCE
from ocp_ros.ros.interface.frames import publish_tf
from ocp_ros.ros.runtime.managed_node import autostart
from ocp_ros.util.resources import DEFAULT_MODEL
from ocp_ros.util.settings import ConfigurationError, setting

PLANNERS = ('learned', 'lookahead')
#: Defaults if ``manual`` is true: few turns with long moves, as each turn is work for a person.
MANUAL_DEFAULTS = {'turns': 5, 'max_step': 2.0, 'max_turn': 1.6}


@dataclass(frozen=True)
class PolicyNodeConfig:
    """Parameters of ``policy_node``."""

    planner: str = setting(
        'learned', 'planner of the moves: learned, where a trained policy explores and a search '
        'on the observed points finishes; lookahead, where this search does both and needs no '
        'weights', choices=PLANNERS)
    model: str = setting(
        DEFAULT_MODEL, 'weights: a path, or the name of a shipped model; lookahead ignores it')
    turns: int = setting(
        30, 'turns until the placement is final; default 5 with manual', 1, 100000, running=True)
    max_step: float = setting(0.5, 'longest move of a camera in one turn, metres; default 2 with '
                              'manual', 0.001, 10.0, running=True)
    max_turn: float = setting(0.5, 'with a rig file: largest rotation in one time step (turn), '
                              'radians, for cameras with a limited field of view; default 1.6 '
                              'with manual; 0: do not turn cameras', 0.0, 3.1416, running=True)
    max_range: float = setting(
        4.0, 'maximum range of the cameras, metres', 0.1, 100.0, running=True)
    wall_margin: float = setting(0.1, 'least distance to the sides of the observed bounding box, '
                                 'metres', 0.0, 5.0, running=True)
    clearance: float = setting(
        CLEARANCE, 'without a rig file: least distance to every observed surface, metres; 0: no '
        'limit; with a rig file keep_clear applies', 0.0, 5.0, running=True)
    explore: bool = setting(
        False, 'for training: draw moves at random from the distribution of the policy, whatever '
               'the planner is; the placement never becomes final')
    seed: int = setting(0, 'seed of exploration and lookahead', 0, 1 << 31)
    threads: int = setting(
        0, 'number of threads that evaluate positions; 0: one per core', 0, 1024)
    rig_file: str = setting(
        '', 'rig file whose constraints every command keeps (docs/reference/rig.md); empty: none')
    placement_file: str = setting('', 'file for the final placement, .yaml or .json '
                                  '(docs/reference/placement.md); empty: write no file')
    scan: str = setting('', 'live: scan of the room in the frame of the poses, metres, z up: '
                        '`~/calibrate` registers the cameras to it; empty: none')
    drift_seconds: float = setting(
        0.0, 'live: time between two checks of a final placement against the scan, seconds; '
        '0: never', 0.0, 86400.0, running=True)
    cloud_topics: str = setting(
        '', 'live: topics of the clouds, separated by commas; empty: work with a simulation')
    voxel_size: float = setting(
        0.05, 'live: edge of the voxels of the fused cloud, metres', 0.001, 1.0)
    most_points: int = setting(100000, 'live: largest number of points of the fused cloud; beyond '
                               'it the voxels grow', 1000, 10000000)
    min_range: float = setting(
        0.0, 'live: minimum range; nearer points are left out, metres', 0.0, 10.0, running=True)
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
    publish_tf: bool = publish_tf()
    autostart: bool = autostart()
    manual: bool = setting(False, 'live: a person moves the cameras as `instructions` says, '
                           'without time limit; defaults are then few turns with long moves')

    def __post_init__(self) -> None:
        """Refuse parameters that contradict each other."""
        if self.min_range >= self.max_range:
            raise ConfigurationError(f'min_range: found {self.min_range} m with max_range '
                                     f'{self.max_range} m; expected less than it')
        if self.scan and not self.live_topics:
            raise ConfigurationError('scan: found one without cloud_topics; expected live cameras '
                                     'to register to it; name the topics of their clouds')
        if self.manual and not self.live_topics:
            raise ConfigurationError('manual: found true without cloud_topics; expected live '
                                     'cameras that a person moves; name the topics of their '
                                     'clouds')

    @property
    def live_topics(self) -> list[str]:
        """Return the topics of live clouds; empty with a simulation."""
        names = [name.strip() for name in self.cloud_topics.split(',')]
        return [name for name in names if name]

    @property
    def needs_no_weights(self) -> bool:
        """Return whether no policy is needed, and therefore no weights."""
        return self.planner == 'lookahead' and not self.explore
