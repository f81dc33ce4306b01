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

"""Turns of a simulation: an observation and poses with the same stamp make a turn."""

from typing import Any, TYPE_CHECKING

from geometry_msgs.msg import PoseArray
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import (
    MessageError,
    msg_to_cloud,
    msg_to_fields,
    ns_of,
    stamp_to_ns,
)
from ocp_ros.ros.interface.qos import LOOP
from ocp_ros.ros.policy.turn_source import TurnSource
from ocp_ros.ros.runtime.managed_node import create_steady_timer, ONE_SIMULATION, warn_of_crowd
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64MultiArray

if TYPE_CHECKING:
    from ocp_ros.ros.policy_node import PolicyNode

#: Number of poses and of rewards that are kept: the messages of a turn may arrive far apart if
#: other nodes publish as well and this node is slow.
MAX_STORED = 16


class SimulatedTurns(TurnSource):
    """Match the messages of a turn by their stamps, and answer the turn."""

    def __init__(self, node: 'PolicyNode') -> None:
        super().__init__(node)
        #: The latest observation.
        self.cloud: PointCloud2 | None = None
        #: Poses by their stamps in nanoseconds, in the order in which they came: those of the turn
        #: answered last, and later ones.
        self.poses: dict[int, PoseArray] = {}
        #: The latest command.
        self.answer: PoseArray | None = None
        #: Episode, step and whether it is the last one, of turns by their stamps like ``poses``.
        self.rewards: dict[int, tuple[int, int, bool]] = {}
        #: False once the wait for the reward of the present turn has timed out.
        self._may_wait = True
        # If the turn before had a reward, the next reward is awaited for 0.25 s: messages of
        # different topics overtake each other, and only a reward shows that an episode begins.
        self._reward_timer = create_steady_timer(node, 0.25, self._answer_without_reward)
        self._reward_timer.cancel()
        # Subscribe to the reward first, so that a new episode is noticed before its first answer.
        node.create_subscription(Float64MultiArray, topics.REWARD, self.on_reward, LOOP)
        node.create_subscription(PoseArray, topics.CAMERA_POSES, self.on_poses, LOOP)
        node.create_subscription(PointCloud2, topics.OBSERVATION, self.on_cloud, LOOP)

    def on_reward(self, message: Float64MultiArray) -> None:
        """Store the data of a turn, and answer the turn if it has waited for them."""
        try:
            fields = msg_to_fields(
                message, ('stamp_sec', 'stamp_nanosec', 'episode', 'step', 'truncated'))
        except MessageError as error:
            self._node.refuse(error)
            return
        stamp = ns_of(fields, 'stamp')
        turn = int(fields['episode']), int(fields['step']), bool(fields['truncated'])
        if self.rewards.get(stamp) == turn:
            # The turn was sent again: it must not begin its episode for a second time.
            return
        self._store(self.rewards, stamp, turn)
        if stamp == self._answered_stamp:
            # ``poses`` always has the poses of the answered turn: only other poses are dropped.
            self._node.set_turn(*turn, self.poses[stamp])
        elif self.cloud is not None and stamp_to_ns(self.cloud.header.stamp) == stamp:
            self.answer_if_ready()

    def on_cloud(self, message: PointCloud2) -> None:
        """Store the observation, and answer the turn if its poses are here."""
        self.cloud = message
        self.answer_if_ready()

    def on_poses(self, message: PoseArray) -> None:
        """Store the poses, and answer the turn if its observation is here."""
        self._store(self.poses, stamp_to_ns(message.header.stamp), message)
        self.answer_if_ready()

    @property
    def _answered_stamp(self) -> int | None:
        """Return the stamp of the turn answered last, nanoseconds; None before the first one."""
        return None if self.answer is None else stamp_to_ns(self.answer.header.stamp)

    def _store(self, messages: dict[int, Any], stamp: int, message: Any) -> None:
        """Store a message, and drop the oldest, but not that of the answered turn."""
        messages[stamp] = message
        if len(messages) > MAX_STORED:
            del messages[next(old for old in messages if old != self._answered_stamp)]

    def answer_if_ready(self) -> None:
        """Answer a turn if both its messages are here; a repeated turn gets the same answer."""
        cloud = self.cloud
        stamp = None if cloud is None else stamp_to_ns(cloud.header.stamp)
        # Without a cloud the stamp is None, which no poses have.
        if stamp not in self.poses or self._node.must_wait:
            return
        poses = self.poses[stamp]
        if self.answer is None or self.answer.header.stamp != poses.header.stamp:
            if self._update_wait_for_reward(stamp):
                return
            try:
                if cloud.header.frame_id != poses.header.frame_id:
                    raise MessageError(f'cloud: found the frame {cloud.header.frame_id!r}; '
                                       f'expected that of the poses, {poses.header.frame_id!r}')
                # Only now: a reward of no turn, or of another simulation, changes nothing.
                if stamp in self.rewards:
                    self._node.set_turn(*self.rewards[stamp])
                self.answer = self._node.decide(msg_to_cloud(cloud), poses)
                # The messages that came before those of this turn are not needed any more.
                for messages in (self.poses, self.rewards):
                    while stamp in messages and next(iter(messages)) != stamp:
                        del messages[next(iter(messages))]
            except MessageError as error:
                self._node.refuse(error)
                return
        self._node.commander.publish(self.answer)
        self._node.decider.plan_ahead()

    def _update_wait_for_reward(self, stamp: int) -> bool:
        """Start or stop the wait for the reward of a turn; return whether to wait."""
        # Wait only if the turn answered last had a reward, this turn has none yet, and the wait
        # for it has not timed out.
        if stamp in self.rewards or self._answered_stamp not in self.rewards or not self._may_wait:
            self._reward_timer.cancel()
            self._may_wait = True
            return False
        if self._reward_timer.is_canceled():
            self._reward_timer.reset()
        return True

    def _answer_without_reward(self) -> None:
        """Answer a turn without its reward."""
        self._reward_timer.cancel()
        self._may_wait = False
        self.answer_if_ready()

    def status(self) -> dict[str, object]:
        """Warn if there are several simulations; return no values."""
        warn_of_crowd(self._node, topics.OBSERVATION, ONE_SIMULATION)
        return {}
