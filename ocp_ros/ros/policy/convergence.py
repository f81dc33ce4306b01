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

"""Convergence: whether a placement is final, and why."""

from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.qos import LATCHED
from ocp_ros.ros.policy.policy_config import PolicyNodeConfig
from rclpy.node import Node
from std_msgs.msg import String


class Convergence:
    """
    Publish on ``placement_status`` the progress towards a final placement, and why it is final.

    :param node: gets the publisher.
    :ivar still: number of latest turns in which no camera has moved.
    :ivar longest: metres, the longest move of the last turn.
    :ivar why: why the placement is final; empty while it is not.
    :ivar gaps: data that were missing, such as clouds of a camera that was silent in most turns.
    """

    def __init__(self, node: Node) -> None:
        self._status = node.create_publisher(String, topics.PLACEMENT_STATUS, LATCHED)
        self._published = ''
        self.begin()

    def begin(self) -> None:
        """Begin an episode."""
        self.still = 0
        self.longest = 0.0
        self.why = ''
        self.gaps = ''
        #: Number of turns played when the placement became final; None before.
        self._after: int | None = None

    def moved(self, longest: float, widest: float, config: PolicyNodeConfig) -> None:
        """Record the longest move of a turn, metres, and its largest rotation, radians."""
        self.longest = longest
        # Cameras that rotate by less than 0.02 radians count as standing still.
        still = longest < config.convergence_distance and widest < 0.02
        self.still = self.still + 1 if still else 0

    def reason(self, step: int, over: bool, alone: bool, config: PolicyNodeConfig) -> str:
        """
        Return why the placement is final from now on; empty while it is not.

        :param step: turns played so far.
        :param over: whether the simulation has reported that its last turn is played.
        :param alone: whether the policy plays without lookahead; lookahead uses all turns.
        """
        if over:
            return 'the simulation has played its last turn'
        if config.explore:
            return ''
        if step >= config.turns:
            return f'all {config.turns} turns are used up'
        if alone and self.still >= config.convergence_turns:
            return (f'no camera has moved {config.convergence_distance:g} m or more for '
                    f'{self.still} turns')
        return ''

    def say(self, step: int, config: PolicyNodeConfig) -> str:
        """Publish the status text if it has changed, and return it."""
        if self.why:
            self._after = step if self._after is None else self._after
            text = (f'final after {self._after} turns: {self.why}' if not self.gaps else
                    f'final, with gaps, after {self._after} turns: {self.why}; {self.gaps}')
        else:
            text = (f'not final: turn {step} of {config.turns}, longest move {self.longest:.3f} '
                    f'm, standing still for {self.still} turns')
        if text != self._published:
            self._published = text
            self._status.publish(String(data=text))
        return text

    def values(self) -> dict[str, object]:
        """Return the values for diagnostics."""
        return {'final': self.why or '-', 'gaps': self.gaps or '-',
                'longest_move': f'{self.longest:.3f}', 'standing_still': self.still}
