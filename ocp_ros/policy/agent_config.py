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

"""Type and sizes of the agent's network, and the error of its weights; does not import torch."""

from dataclasses import dataclass

from ocp_ros.util.settings import ConfigurationError, MAX_CAMERAS, setting, UserError

#: Inputs of the network: the observed cloud, read camera by camera (``cloud``), or by one head for
#: all cameras as in the paper (``paper``).
CLOUD, PAPER = 'cloud', 'paper'


class CheckpointError(UserError):
    """Weights that cannot be used; the message says what was found and expected."""


@dataclass(frozen=True)
class AgentConfig:
    """
    Settings of the network.

    It has three extraction units. A unit samples key points by farthest-point sampling, and groups
    the points within a radius of each key point. The last unit has a single key point, whose group
    contains all key points of the second unit.
    """

    inputs: str = setting(
        CLOUD, 'inputs of the network: cloud, the observed cloud and the rig, one camera after '
               'the other; paper, the observed cloud as in the paper, all cameras at once',
        choices=(CLOUD, PAPER))
    cameras: int = setting(
        4, 'with inputs paper: number of cameras, whose moves one head chooses together', 1,
        MAX_CAMERAS)
    points: int = setting(
        256, 'points of the cloud that reach the first extraction unit', 16, 32767)
    keys_1: int = setting(32, 'key points of the first unit', 1, 4096)
    group_1: int = setting(16, 'points per group of the first unit', 1, 256)
    radius_1: float = setting(1.5, 'ball query radius of the first unit, metres', 0.01, 50.0)
    keys_2: int = setting(8, 'key points of the second unit', 1, 1024)
    group_2: int = setting(8, 'points per group of the second unit', 1, 256)
    radius_2: float = setting(3.0, 'ball query radius of the second unit, metres', 0.01, 50.0)
    channels: int = setting(32, 'output channels of the first two units', 1, 1024)
    pooled: int = setting(128, 'output channels of the last unit', 1, 4096)
    hidden: int = setting(128, 'width of the heads', 1, 4096)
    blocks: int = setting(2, 'with inputs cloud: residual blocks of the heads; 0: two plain '
                          'layers', 0, 16)

    def __post_init__(self) -> None:
        """Reject settings without effect, and extraction units that need too much memory."""
        # Output of a layer for all groups of one observation: up to 32 MiB of float32.
        max_values = 1 << 23
        grouped_points = (self.keys_1 * self.group_1, self.keys_2 * self.group_2)
        for unit, points in enumerate(grouped_points, start=1):
            if points * self.channels > max_values:
                raise ConfigurationError(
                    f'agent.keys_{unit}: found keys_{unit} x group_{unit} x channels = '
                    f'{points * self.channels:,}; expected up to {max_values:,}; lower '
                    'one of the three')

    @property
    def one_by_one(self) -> bool:
        """Return whether cameras choose moves one after the other, not all at once."""
        return self.inputs != PAPER

    def check_cameras(self, cameras: int) -> None:
        """
        Reject a number of cameras that the network does not support.

        :param cameras: number of cameras of the rig.
        :raises ConfigurationError: if the head of ``paper`` is for another number of cameras.
        """
        if self.inputs == PAPER and self.cameras != cameras:
            raise ConfigurationError(
                f'agent.cameras: found weights for {self.cameras} cameras, and {cameras} cameras; '
                'expected as many; use weights that serve any number (agent.inputs: cloud), or a '
                f'rig of {self.cameras}')
