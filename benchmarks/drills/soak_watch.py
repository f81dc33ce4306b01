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

"""What a soak sends and measures: lies, the time turns take, memory, and a trainer's files."""

from collections import deque
import json
import math
from pathlib import Path
import time

from benchmarks.drills.drill import rss_of
from benchmarks.drills.fuzz import (
    few_points,
    spoilt_cloud,
    spoilt_fields,
    spoilt_poses,
    spoilt_weights,
)
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.demo.watched_nodes import NodeProcess
from ocp_ros.policy.checkpoint import Checkpoint, CheckpointError
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import bytes_to_msg, ns_to_stamp, stamp_to_ns
from ocp_ros.ros.interface.qos import LATCHED, LOOP, RECORDER
from ocp_ros.ros.training_source import topic_of
from ocp_ros.training.learner import ACTOR
from ocp_ros.training.run_folder import REPLAY, STATE
from rclpy.node import Node
import safetensors.numpy
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64MultiArray, Header, UInt8MultiArray

#: Seconds from the first word of a node until its memory is taken down for the first time, and of
#: the times that are compared; and seconds between two looks.
WARM, EACH = 60.0, 1.0


class Latency:
    """
    When the turns of one namespace were sent and answered, as a third party hears it.

    :param node: listens.
    :param namespace: of the pair.
    :ivar turns: that were answered.
    :ivar seconds: from a turn to its answer, for those in which nothing was killed.
    :ivar recovered: turns since the interrupt that were sent and answered after it.
    """

    def __init__(self, node: Node, namespace: str) -> None:
        self.turns, self.recovered, self.seconds = 0, 0, []
        self._open: tuple[int, float] | None = None
        self._newest, self._interrupted = 0, 0
        node.create_subscription(PoseArray, topic_of(namespace, topics.CAMERA_POSES),
                                 self._on_poses, RECORDER)
        node.create_subscription(PoseArray, topic_of(namespace, topics.CAMERA_COMMANDS),
                                 self._on_command, RECORDER)

    def _on_poses(self, message: PoseArray) -> None:
        """Note when a turn was sent for the first time; lies have other stamps."""
        stamp = stamp_to_ns(message.header.stamp)
        if stamp != self._newest and message.header.frame_id == 'map':
            self._newest, self._open = stamp, (stamp, time.monotonic())

    def _on_command(self, message: PoseArray) -> None:
        """Note when it was answered."""
        if self._open and stamp_to_ns(message.header.stamp) == self._open[0]:
            self.turns += 1
            # What a node that is dead has said may still be on its way.
            self.recovered += self._open[0] > self._interrupted
            self.seconds.append(time.monotonic() - self._open[1])
            self._open = None

    def interrupt(self) -> None:
        """Leave out the turn in which something is killed; count those after it."""
        self._open, self.recovered, self._interrupted = None, 0, time.time_ns()


class Lies:
    """
    Send lies to a pair and its trainer; none has the stamp of a turn.

    There are no lies on ``camera_commands``: beside another publisher no policy begins.

    :param node: publishes.
    :param namespace: of the pair.
    :param rng: of the lies.
    """

    def __init__(self, node: Node, namespace: str, rng: np.random.Generator,
                 weights: Checkpoint) -> None:
        self._rng, self._good, self.sent = rng, few_points(rng), 0
        self._weights = weights
        self._publishers = {
            name: node.create_publisher(kind, topic_of(namespace, name), profile)
            for name, kind, profile in (
                (topics.OBSERVATION, PointCloud2, LOOP), (topics.CAMERA_POSES, PoseArray, LOOP),
                (topics.REWARD, Float64MultiArray, LOOP),
                (topics.EXPERIENCE, UInt8MultiArray, LOOP),
                (topics.POLICY_WEIGHTS, UInt8MultiArray, LATCHED))}

    def send(self) -> None:
        """Send one of each kind."""
        cloud, poses = spoilt_cloud(self._rng, self._good), spoilt_poses(self._rng)
        for message in (cloud, poses):
            message.header = Header(stamp=ns_to_stamp(int(self._rng.integers(1, 1000))),
                                    frame_id='lies')
        for name, message in (
                (topics.OBSERVATION, cloud), (topics.CAMERA_POSES, poses),
                (topics.REWARD, spoilt_fields(self._rng, topics.REWARD_FIELDS)),
                (topics.EXPERIENCE, bytes_to_msg(self._rng.bytes(int(self._rng.integers(500))))),
                (topics.POLICY_WEIGHTS, bytes_to_msg(
                    spoilt_weights(self._rng, self._weights)))):
            self._publishers[name].publish(message)
            self.sent += 1


class MemoryWatch:
    """
    How much the memory of processes grows once they have lived for a while.

    An allocator keeps what was freed for some time: the memory of a process that leaks nothing
    goes up and down. So medians are compared, of the last of its minutes and of the first.

    :ivar growth: MB, of the node that grew most in one life, by name.
    :ivar peak: MB by which it was above that first minute at any moment, by name.
    """

    def __init__(self) -> None:
        #: By process: when it was seen first, and each second what it held in the first minute
        #: since it was warm and in the last one.
        self._lives: dict[int, tuple[float, list[float], deque[float]]] = {}
        self._looked = -math.inf
        self.growth: dict[str, float] = {}
        self.peak: dict[str, float] = {}

    def look(self, processes: list[NodeProcess]) -> None:
        """Take down what the processes hold now, once a second."""
        now = time.monotonic()
        if now - self._looked < EACH:
            return
        self._looked = now
        for process in processes:
            began, early, late = self._lives.setdefault(
                process.process.pid, (now, [], deque(maxlen=int(WARM / EACH))))
            if now - began >= WARM and (held := rss_of(process.process.pid)):
                late.append(held)
                if not early or now - began <= 2.0 * WARM:
                    early.append(held)
                first = np.median(early)
                for grown, more in ((self.growth, np.median(late) - first),
                                    (self.peak, held - first)):
                    grown[process.name] = max(grown.get(process.name, 0.0), float(more))


def check_files(folder: Path) -> int:
    """
    Read every file of a trainer's folder.

    :returns: how many there were.
    :raises RuntimeError: if one is torn.
    """
    count = 0
    try:
        if (folder / ACTOR).exists():
            Checkpoint.load(folder / ACTOR)
            json.loads((folder / ACTOR).with_suffix('.json').read_text() or 'null')
            count += 1
        for path in (folder / STATE, folder / REPLAY):
            if path.exists():
                safetensors.numpy.load_file(path)
                count += 1
    except (CheckpointError, ValueError, OSError, safetensors.SafetensorError) as error:
        raise RuntimeError(
            f'{folder}: found a torn file ({error}); expected whole ones') from error
    return count
