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
    Decide whether a placement is final, and publish that on ``placement_status``.

    :param node: gets the publisher.
    :ivar longest_move: longest move of a camera in the last turn, metres.
    :ivar final_reason: why the placement is final; empty while it is not final.
    :ivar missing_data: data that a final placement lacks, in words; empty if it lacks none.
    """

    def __init__(self, node: Node) -> None:
        self._publisher = node.create_publisher(String, topics.PLACEMENT_STATUS, LATCHED)
        self._published_text = ''
        self.begin_episode()

    def begin_episode(self) -> None:
        """Begin an episode, whose placement is not final."""
        self.longest_move = 0.0
        self.final_reason = ''
        self.missing_data = ''
        #: Number of turns played when the placement became final; None before that.
        self._final_step: int | None = None

    def reason_to_finish(self, step: int, simulation_ended: bool, config: PolicyNodeConfig
                         ) -> str:
        """
        Return why the placement is final from now on; empty if it is not final yet.

        :param step: number of turns played so far.
        :param simulation_ended: whether the simulation has reported that its last turn is played.
        """
        if simulation_ended:
            return 'the simulation has played its last turn'
        if config.explore:
            return ''
        if step >= config.turns:
            return f'all {config.turns} turns are used up'
        return ''

    def publish_status(self, step: int, config: PolicyNodeConfig) -> str:
        """
        Publish the status text if it has changed.

        :param step: number of turns played so far.
        :returns: the status text.
        """
        if self.final_reason:
            self._final_step = step if self._final_step is None else self._final_step
            text = f'after {self._final_step} turns: {self.final_reason}'
            text = (f'final, with gaps, {text}; {self.missing_data}' if self.missing_data else
                    f'final {text}')
        else:
            text = (f'not final: turn {step} of {config.turns}, longest move '
                    f'{self.longest_move:.3f} m')
        if text != self._published_text:
            self._published_text = text
            self._publisher.publish(String(data=text))
        return text

    def diagnostic_values(self) -> dict[str, object]:
        """Return the values for diagnostics."""
        return {'final': self.final_reason or '-', 'gaps': self.missing_data or '-',
                'longest_move': f'{self.longest_move:.3f}'}
