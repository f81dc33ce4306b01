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


"""Convergence: the turns of an episode, and when and why its placement is final."""

from typing import TYPE_CHECKING

from geometry_msgs.msg import PoseArray
from ocp_ros.rig.placement_file import created_by, save_placement
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.qos import LATCHED
from std_msgs.msg import String

if TYPE_CHECKING:
    from ocp_ros.ros.policy_node import PolicyNode


class Convergence:
    """
    Count the turns of an episode, decide when its placement is final, and publish and save it.

    :param node: gets the publishers.
    :ivar step: number of turns played so far.
    :ivar simulation_ended: whether the simulation has reported that its last turn is played.
    :ivar accepted: whether the next turn is the last one since ``~/accept`` was called.
    :ivar longest_move: longest move of a camera in the last turn, metres.
    :ivar final_poses: the poses at the end of the episode, where the cameras stay; None before.
    :ivar missing_data: data that a final placement lacks, in words; empty if it lacks none.
    """

    def __init__(self, node: 'PolicyNode') -> None:
        self._node = node
        self._placement_publisher = node.create_publisher(PoseArray, topics.PLACEMENT, LATCHED)
        self._status_publisher = node.create_publisher(String, topics.PLACEMENT_STATUS, LATCHED)
        self._published_text = ''
        self.begin_episode()

    def begin_episode(self) -> None:
        """Begin an episode, whose placement is not final."""
        self.step = 0
        self.simulation_ended = self.accepted = False
        self.longest_move = 0.0
        self.final_poses: PoseArray | None = None
        self.missing_data = self._final_reason = ''
        #: Number of turns played when the placement became final.
        self._final_step = 0
        self.publish_status()

    @property
    def is_final(self) -> bool:
        """Return whether the placement is final; that of an exploring policy never is."""
        return self.final_poses is not None and not self._node.config.explore

    def reason_to_finish(self) -> str:
        """Return why the placement is final from now on; empty if it is not final yet."""
        config = self._node.config
        if self.simulation_ended:
            return 'the simulation has played its last turn'
        if self.accepted:
            return 'it was accepted'
        if self.step >= config.turns and not config.explore:
            return f'all {config.turns} turns are used up'
        return ''

    def finish(self, poses: PoseArray) -> None:
        """Publish the final placement and why it is final; do nothing if that has been done."""
        if self.final_poses is not None:
            return
        self._final_reason = self.reason_to_finish()
        self._final_step = self.step
        self.final_poses = poses
        if self._node.config.explore:
            # The cameras stay, but these poses are not the best ones.
            return
        self.missing_data = self._node.source.missing_data
        self._placement_publisher.publish(poses)
        text = f'placement is {self.publish_status()}'
        if self.missing_data:
            self._node.get_logger().warning(text)
        else:
            self._node.get_logger().info(text)
        if self._node.config.placement_file:
            self._save(self._node.config.placement_file, poses)

    def publish_status(self) -> str:
        """Return the status text; publish it if it has changed and no other node commands."""
        if self.is_final:
            plural = 's' if self._final_step != 1 else ''
            text = f'after {self._final_step} turn{plural}: {self._final_reason}'
            text = (f'final, with gaps, {text}; {self.missing_data}' if self.missing_data else
                    f'final {text}')
        else:
            text = (f'not final: turn {self.step} of {self._node.config.turns}, longest move '
                    f'{self.longest_move:.3f} m')
        if text != self._published_text and not self._node.commander.must_wait:
            self._published_text = text
            self._status_publisher.publish(String(data=text))
        return text

    def _save(self, path: str, poses: PoseArray) -> None:
        """Write the placement to a file; log an error if that fails."""
        reasons = filter(None, (self._final_reason, self.missing_data))
        state = self._node.decider.state(poses)
        placement = self._node.decider.placement(
            state.placement[:state.movable], poses.header.frame_id,
            {**created_by('policy_node'), 'final': '; '.join(reasons)})
        try:
            save_placement(path, placement)
        except OSError as error:
            self._node.get_logger().error(
                f'placement_file: found {path}, which cannot be written ({error.strerror}); '
                'expected a file in a folder that can')
        else:
            self._node.get_logger().info(f'wrote {path}')

    def diagnostic_values(self) -> dict[str, object]:
        """Return the values for diagnostics."""
        return {'step': self.step, 'final': self._final_reason or '-',
                'gaps': self.missing_data or '-', 'longest_move': f'{self.longest_move:.3f}'}
