# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the agent reads and the sizes of its networks."""

from dataclasses import dataclass

from ocp_ros.util.settings import ConfigurationError, MOST_CAMERAS, setting

#: Networks that answer with moves: soft actor-critic trains them.
OF_MOVES = ('world', 'cloud', 'both')
#: What the network reads: what a few moves would change on what was seen (``world``), the observed
#: cloud itself as in the paper (``cloud``), both, or a map of what was observed (``map``).
INPUTS = (*OF_MOVES, 'map')


@dataclass(frozen=True)
class AgentConfig:
    """
    Inputs, the feature extractor's three units and the heads behind it.

    A unit samples key points by farthest-point sampling and groups neighbours by ball query; the
    last one has a single key point and groups all that reach it.
    """

    inputs: str = setting(
        'world', 'input of the network: world, cloud, both or map', choices=INPUTS)
    points: int = setting(
        512, 'points of the cloud that reach the first extraction unit', 16, 32767)
    keys_1: int = setting(32, 'key points of the first unit', 1, 4096)
    group_1: int = setting(8, 'points per group of the first unit', 1, 256)
    radius_1: float = setting(0.8, 'ball query radius of the first unit, metres', 0.01, 50.0)
    keys_2: int = setting(8, 'key points of the second unit', 1, 1024)
    group_2: int = setting(8, 'points per group of the second unit', 1, 256)
    radius_2: float = setting(2.0, 'ball query radius of the second unit, metres', 0.01, 50.0)
    channels: int = setting(32, "output channels of each unit's perceptron", 1, 1024)
    hidden: int = setting(256, 'width of the heads', 1, 4096)
    length_scale: float = setting(4.0, 'length that the network reads as 1, metres', 0.01, 100.0)
    others: int = setting(
        0, 'with inputs cloud or both: cameras choose one after the other, and the network reads '
           'the positions of at most so many other cameras; 0: it does not read them',
        0, MOST_CAMERAS)
    marks: bool = setting(
        False, 'whether the network reads for each point if the choosing camera sees it now, '
               'and how many other cameras see it; set agent.others above 0 too')
    centred: bool = setting(
        False, 'whether the centre of the last unit is the camera, not the middle of the cloud')
    nearest: bool = setting(
        False, 'whether groups take the nearest points within the radius, not the first ones')
    pooled: int = setting(
        0, 'output channels of the last unit; 0: as many as the other units have', 0, 4096)
    normed: bool = setting(False, 'whether the units normalise their features')
    choices: bool = setting(
        False, 'whether the head for cloud inputs chooses among 25 moves; otherwise its answer is '
               'a Gaussian')
    headings: int = setting(
        0, 'with inputs map: headings in which the network values each cell for cameras that do '
           'not see all around; 0: it values cells for those that do, whatever the camera',
        0, 64)
    joint: int = setting(
        0, 'with the cloud: number of cameras whose moves one head chooses together, as in '
           'stable-baselines3; 0: each camera has the same head, and there may be any number', 0,
        MOST_CAMERAS)

    def __post_init__(self) -> None:
        """Refuse what is never read."""
        if self.others and not self.cloud:
            raise ConfigurationError(f'agent.others: found {self.others} with agent.inputs '
                                     f'{self.inputs!r}; expected 0, or the inputs cloud or both')
        if self.marks and not self.others:
            raise ConfigurationError('agent.marks: found true with agent.others 0; expected '
                                     'cameras that choose one after the other; set agent.others')
        if self.joint and (self.one_by_one or self.choices):
            raise ConfigurationError(
                f'agent.joint: found {self.joint} with agent.inputs {self.inputs!r}, agent.others '
                f'{self.others} and agent.choices {str(self.choices).lower()}; expected 0, or the '
                'inputs cloud with others 0 and choices false: one head answers for all cameras')
        if self.headings and not self.map:
            raise ConfigurationError(f'agent.headings: found {self.headings} with agent.inputs '
                                     f'{self.inputs!r}; expected 0, or the inputs map')

    @property
    def world(self) -> bool:
        """Return whether the network reads what moves would change."""
        return self.inputs in ('world', 'both')

    @property
    def cloud(self) -> bool:
        """Return whether the network reads the observed cloud."""
        return self.inputs in ('cloud', 'both')

    @property
    def one_by_one(self) -> bool:
        """Return whether one camera chooses after the other, each told of those before it."""
        return self.world or self.map or self.others > 0

    def check_cameras(self, cameras: int) -> None:
        """
        Refuse another number of cameras than that of a joint head.

        :raises ConfigurationError: if it is another.
        """
        if self.joint not in (0, cameras):
            raise ConfigurationError(
                f'agent.joint: found weights for {self.joint} cameras, and {cameras} cameras; '
                'expected as many; use weights of a head that cameras share (agent.joint: 0), or '
                f'a rig of {self.joint}')

    @property
    def map(self) -> bool:
        """Return whether the network reads a map of what was observed."""
        return self.inputs == 'map'
