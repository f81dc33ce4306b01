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

"""A trainer that is told whole turns, of which most lie, and has to go on learning."""

import time

from benchmarks.drills.fuzz_targets import BATCH, Fuzzer, START
from benchmarks.drills.malformed import FLOATS, spoilt_numbers, spoilt_poses
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import (
    bytes_to_msg,
    fields_to_msg,
    msg_to_fields,
    positions_to_msg,
)
from ocp_ros.ros.interface.qos import LATCHED
from ocp_ros.training.experience import Choice, Experience, to_bytes
from std_msgs.msg import Float64MultiArray, UInt8MultiArray

#: Seconds after which good turns are sent again: the trainer tells once a second what it has.
AGAIN = 1.5


class TrainerTarget:
    """
    A trainer without policies, which hears of turns that nobody has played.

    :param fuzzer: sends, waits and counts.
    :param namespace: of the trainer.
    """

    def __init__(self, fuzzer: Fuzzer, namespace: str) -> None:
        self.fuzzer, self._stamp, self.transitions = fuzzer, 0, 0.0
        self._poses = fuzzer.publisher(PoseArray, f'{namespace}/{topics.CAMERA_POSES}')
        self._rewards = fuzzer.publisher(Float64MultiArray, f'{namespace}/{topics.REWARD}')
        self._experiences = fuzzer.publisher(UInt8MultiArray, f'{namespace}/{topics.EXPERIENCE}')
        fuzzer.node.create_subscription(
            Float64MultiArray, f'{namespace}/{topics.TRAINING}', self._on_training, LATCHED)

    def _on_training(self, message: Float64MultiArray) -> None:
        """Take note of how many transitions were learned from."""
        self.transitions = msg_to_fields(message, topics.TRAINING_FIELDS)['transitions']

    def _reward(self) -> Float64MultiArray:
        """Make the reward of a turn."""
        values = dict.fromkeys(topics.REWARD_FIELDS, 0.0)
        values |= {'previous_nanosec': self._stamp - 1, 'stamp_nanosec': self._stamp,
                   'step': self._stamp - 1, 'reward': 0.5}
        return fields_to_msg(values | {
            topics.share_field(number): 0.25 for number in range(len(START))})

    def _turn(self, lie: str = '') -> None:
        """Send the parts of a turn, one of which may lie."""
        fuzzer, rng = self.fuzzer, self.fuzzer.rng
        self._stamp += 1
        choices = [Choice({name: value.copy() for name, value in choice.observation.items()},
                          choice.actions.copy()) for choice in fuzzer.choices]
        reward = self._reward()
        poses = positions_to_msg(np.array(START), fuzzer.header(self._stamp))
        if lie == 'numbers':
            spoilt_numbers(rng, choices)
        elif lie == 'reward':
            at = rng.integers(len(reward.data))
            reward.data[at] = float(rng.choice(FLOATS))
        elif lie == 'order':
            reward.data = [float(value) for value in rng.permutation(reward.data)]
        elif lie == 'poses':
            poses = spoilt_poses(rng)
            poses.header = fuzzer.header(self._stamp)
        blob = to_bytes(Experience(self._stamp, self._stamp - 1, np.array(START), choices))
        for publisher, message in ((self._experiences, bytes_to_msg(blob)), (self._poses, poses),
                                   (self._rewards, reward)):
            publisher.publish(message)
        fuzzer.sent += bool(lie)

    def batch(self) -> None:
        """Send turns that lie, then good ones, from which has to be learned."""
        fuzzer = self.fuzzer
        for _ in range(BATCH):
            self._turn(str(fuzzer.rng.choice(['numbers', 'reward', 'order', 'poses'])))
        before, sent = self.transitions, -AGAIN

        def learned() -> bool:
            nonlocal sent
            if time.monotonic() - sent > AGAIN:
                sent = time.monotonic()
                # What was chosen in one turn is worth what the next one tells.
                for _ in range(2):
                    self._turn()
            return self.transitions > before

        fuzzer.until(learned, 'transitions of good turns')
        fuzzer.answered += 1
