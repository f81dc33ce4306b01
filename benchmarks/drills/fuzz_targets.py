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

"""Nodes that are told lies: what is sent to each kind, and what must not come of it."""

from collections.abc import Callable
import time

from benchmarks.drills.malformed import (
    few_points,
    known_lies,
    spoilt_blob,
    spoilt_cloud,
    spoilt_fields,
    spoilt_poses,
    spoilt_weights,
)
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.policy.cloud_encoder import Encoder
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import (
    bytes_to_msg,
    cloud_to_msg,
    MessageError,
    msg_to_cloud,
    msg_to_positions,
    ns_to_stamp,
    positions_to_msg,
    stamp_to_ns,
)
from ocp_ros.ros.interface.qos import LATCHED, LOOP
from ocp_ros.training.experience import Choice, Experience, to_bytes
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64MultiArray, Header, UInt8MultiArray

#: Lies of a kind between two good messages: fewer than the queues hold.
BATCH = 8
#: Size of the room that good messages show, metres, where its cameras are, and their longest step.
ROOM, START, MAX_STEP = (6.0, 4.0, 2.8), ((2.0, 2.0, 1.9), (3.0, 2.0, 1.9)), 0.5
Until = Callable[[Callable[[], bool], str], None]


class FuzzError(RuntimeError):
    """A node that did what it must not."""


def shell(rng: np.random.Generator, count: int = 1500) -> np.ndarray:
    """Return points (N, 3) on floor, ceiling and walls of the room, metres."""
    points = rng.uniform([0, 0, 0], ROOM, (count, 3))
    axis = rng.integers(3, size=count)
    points[np.arange(count), axis] = rng.integers(2, size=count) * np.take(ROOM, axis)
    return points.astype(np.float32)


class Fuzzer:
    """
    Send lies and good messages to the nodes of some namespaces.

    :param node: publishes and listens.
    :param until: waits for something that has a name.
    :param seed: of everything.
    :param weights: of the policy that runs, and of its trainer.
    :ivar sent: messages that lie so far.
    :ivar answered: good messages that were answered.
    :ivar choices: what a policy would choose, and has read.
    :ivar readable: lies that were answered with a command, which was within bounds.
    """

    def __init__(self, node: Node, until: Until, seed: int, weights: Checkpoint) -> None:
        self.node, self.until, self.weights = node, until, weights
        self.rng = np.random.default_rng(seed)
        self.sent = self.answered = self.readable = 0
        self._stamp = 1
        self._cloud, self._spoil = shell(self.rng), few_points(self.rng)
        self._lies = known_lies(self._spoil[0])
        self._experience = self._good_experience()

    def _good_experience(self) -> bytes:
        """Return an experience that the trainer could use."""
        encoder = Encoder(self.weights.config)
        turn = encoder.turn(self._cloud, np.array(START), 0, 30)
        self.choices = [Choice(turn.inputs(camera), np.zeros((1, 2), np.float32))
                        for camera in range(len(START))]
        return to_bytes(Experience(1, 0, np.array(START), self.choices))

    def publisher(self, kind: type, topic: str, profile=LOOP) -> Publisher:
        """Return a publisher that somebody listens to already."""
        publisher = self.node.create_publisher(kind, topic, profile)
        self.until(lambda: publisher.get_subscription_count() > 0, f'listener of {topic}')
        return publisher

    def header(self, stamp: int | None = None) -> Header:
        """Return a header with a stamp of its own unless one is given, nanoseconds."""
        self._stamp += 1
        return Header(stamp=ns_to_stamp(self._stamp if stamp is None else stamp), frame_id='map')

    def spoilt_cloud(self) -> PointCloud2:
        """Make a cloud that lies, one in five as those that killed other programs."""
        if self.rng.random() < 0.2:
            return self._lies[self.rng.integers(len(self._lies))]
        return spoilt_cloud(self.rng, self._spoil)

    def spoilt_reward(self) -> Float64MultiArray:
        """Make a reward that lies."""
        return spoilt_fields(self.rng, [*topics.REWARD_FIELDS, topics.share_field(0)])

    def weights_blob(self) -> bytes:
        """Make weights that have to be refused."""
        return spoilt_weights(self.rng, self.weights)

    def experience_blob(self) -> bytes:
        """Make an experience that lies."""
        return spoilt_blob(self.rng, self._experience)

    def send(self, publisher: Publisher, message) -> None:
        """Send a lie."""
        publisher.publish(message)
        self.sent += 1

    def check(self, found: np.ndarray, box: np.ndarray, what: str,
              before: np.ndarray | None = None) -> None:
        """
        Check where cameras are sent.

        :param found: (K, 3) metres.
        :param box: (2, 3) metres, in which they have to be, seen from above.
        :param before: (K, 3) metres, where they were; who was outside may be so still, but no
            farther.
        """
        low, high = box[:, :2].astype(np.float64)

        def outside(places: np.ndarray) -> np.ndarray:
            return np.maximum(low - places[:, :2], places[:, :2] - high)

        slack = 1e-6 * (1.0 + np.abs(box).max())
        if before is not None:
            slack = slack + np.maximum(outside(before), 0.0)
        if not (np.isfinite(found).all() and (outside(found) <= slack).all()):
            raise FuzzError(f'{what}: found {found.tolist()}; expected cameras within '
                            f'{box.tolist()}')


class PolicyTarget:
    """A policy that answers turns, and a trainer that overhears them; ``explore`` is False."""

    def __init__(self, fuzzer: Fuzzer, namespace: str) -> None:
        self.fuzzer, node = fuzzer, fuzzer.node
        #: Stamp to the messages of a turn that may be answered, and what was commanded.
        self._turns: dict[int, tuple[PointCloud2, PoseArray]] = {}
        self.commands: dict[int, PoseArray] = {}
        self._good: int | None = None

        def publisher(kind, name, profile=LOOP):
            return fuzzer.publisher(kind, f'{namespace}/{name}', profile)

        node.create_subscription(
            PoseArray, f'{namespace}/{topics.CAMERA_COMMANDS}', self._on_command, LOOP)
        self._clouds = publisher(PointCloud2, topics.OBSERVATION)
        self._poses = publisher(PoseArray, topics.CAMERA_POSES)
        self._rewards = publisher(Float64MultiArray, topics.REWARD)
        self._weights = publisher(UInt8MultiArray, topics.POLICY_WEIGHTS, LATCHED)
        self._experiences = publisher(UInt8MultiArray, topics.EXPERIENCE)

    def _on_command(self, message: PoseArray) -> None:
        """Check a command: it stays within the cloud that it answers and what a turn reaches."""
        stamp = stamp_to_ns(message.header.stamp)
        if stamp not in self._turns:
            return
        self.commands[stamp] = message
        cloud, poses = self._turns[stamp]
        cloud, positions = msg_to_cloud(cloud), msg_to_positions(poses)
        targets = np.array([[p.position.x, p.position.y, p.position.z] for p in message.poses])
        if targets.shape != positions.shape or not (
                np.linalg.norm(targets - positions, axis=1) <= MAX_STEP + 1e-6).all():
            raise FuzzError(f'command: found {targets.tolist()} for cameras at '
                            f'{positions.tolist()}; expected as many within {MAX_STEP:g} m')
        self.fuzzer.check(targets, np.stack([cloud.min(axis=0), cloud.max(axis=0)]), 'command',
                          positions)

    def batch(self, again: bool = False) -> None:
        """
        Send lies of all kinds, then a good turn, which has to be answered.

        :param again: the same one as before, whose answer the policy knows if no lie was answered.
        """
        fuzzer = self.fuzzer
        good = cloud_to_msg(fuzzer._cloud, fuzzer.header())
        self.commands = {}
        self._turns = {stamp: turn for stamp, turn in self._turns.items() if stamp == self._good}
        for number in range(BATCH):
            header = fuzzer.header()
            lies = number % 4 != 3
            cloud = fuzzer.spoilt_cloud() if lies else good
            poses = positions_to_msg(np.array(START), header) if lies else spoilt_poses(fuzzer.rng)
            cloud.header = poses.header = header
            self._turns[stamp_to_ns(header.stamp)] = cloud, poses
            self._poses.publish(poses)
            self._clouds.publish(cloud)
            fuzzer.sent += 1
            fuzzer.send(self._rewards, fuzzer.spoilt_reward())
            fuzzer.send(self._experiences, bytes_to_msg(fuzzer.experience_blob()))
        fuzzer.send(self._weights, bytes_to_msg(fuzzer.weights_blob()))
        self.ping(stamp=self._good if again else None)
        fuzzer.readable += len(self.commands) - 1

    def ping(self, points: np.ndarray | None = None, stamp: int | None = None) -> float:
        """Send a good turn, maybe one of an old stamp; returns the seconds until the answer."""
        fuzzer, began = self.fuzzer, time.monotonic()
        header = fuzzer.header(stamp)
        stamp = self._good = stamp_to_ns(header.stamp)
        cloud = cloud_to_msg(fuzzer._cloud if points is None else points, header)
        poses = positions_to_msg(np.array(START), header)
        self._turns[stamp] = cloud, poses
        self._poses.publish(poses)
        self._clouds.publish(cloud)
        fuzzer.until(lambda: stamp in self.commands, 'answer to a good turn')
        fuzzer.answered += 1
        return time.monotonic() - began


class LiveTarget:
    """A policy with live cameras, and a rig that goes where it is told."""

    def __init__(self, fuzzer: Fuzzer, namespace: str, clouds: list[str]) -> None:
        self.fuzzer = fuzzer
        self._at, self._stamp = np.array(START), 1_000_000_000
        self._newest = 0
        fuzzer.node.create_subscription(
            PoseArray, f'{namespace}/{topics.CAMERA_COMMANDS}', self._on_command, LOOP)
        self._poses = fuzzer.publisher(PoseArray, f'{namespace}/{topics.CAMERA_POSES}')
        self._clouds = [fuzzer.publisher(PointCloud2, f'{namespace}/{name}') for name in clouds]

    def _on_command(self, message: PoseArray) -> None:
        """Check a command and carry it out."""
        stamp = stamp_to_ns(message.header.stamp)
        if stamp > self._newest:
            self._newest, self._at = stamp, msg_to_positions(message)
            self.fuzzer.check(self._at, np.array([[0, 0, 0], ROOM]), 'command to live cameras')

    def batch(self) -> None:
        """Send lies, some from a clock that jumps, then good clouds until there is an answer."""
        fuzzer = self.fuzzer
        for _ in range(BATCH):
            poses, jump = spoilt_poses(fuzzer.rng), int(fuzzer.rng.integers(-10**10, 10**10))
            if fuzzer.rng.random() < 0.5 and not _readable(poses):
                poses.header = fuzzer.header(max(self._stamp + jump, 0))
                fuzzer.send(self._poses, poses)
            for publisher in self._clouds:
                cloud = fuzzer.spoilt_cloud()
                cloud.header = fuzzer.header(max(self._stamp, 0))
                cloud.header.frame_id = str(fuzzer.rng.choice(
                    ['map', 'camera_0', 'camera_9', 'camera_1_optical', '', 'nowhere']))
                if _within(cloud):
                    fuzzer.send(publisher, cloud)
        before = self._newest

        def answered() -> bool:
            self._stamp += 20_000_000
            self._poses.publish(positions_to_msg(self._at, fuzzer.header(self._stamp)))
            for publisher in self._clouds:
                publisher.publish(cloud_to_msg(fuzzer._cloud, fuzzer.header(self._stamp)))
            return self._newest > before

        fuzzer.until(answered, 'answer to live cameras')
        fuzzer.answered += 1


def _readable(poses: PoseArray) -> bool:
    """Return whether poses say where cameras are, be it wrongly."""
    try:
        msg_to_positions(poses)
    except MessageError:
        return False
    return True


def _within(cloud: PointCloud2) -> bool:
    """Return whether a cloud has no points that would make the room another one."""
    try:
        return len(msg_to_cloud(cloud)) == 0
    except MessageError:
        return True


class SimTarget:
    """A simulation, whose cameras have to stay in its room and move no farther than they may."""

    def __init__(self, fuzzer: Fuzzer, namespace: str) -> None:
        self.fuzzer, self._box = fuzzer, None
        self._at: np.ndarray | None = None
        self._newest = 0
        fuzzer.node.create_subscription(
            PointCloud2, f'{namespace}/{topics.SCENE}', self._on_scene, LATCHED)
        fuzzer.node.create_subscription(
            PoseArray, f'{namespace}/{topics.CAMERA_POSES}', self._on_poses, LOOP)
        self._commands = fuzzer.publisher(PoseArray, f'{namespace}/{topics.CAMERA_COMMANDS}')
        fuzzer.until(lambda: self._box is not None and self._newest > 0, 'room of the simulation')

    def _on_scene(self, message: PointCloud2) -> None:
        """Take note of the room."""
        points = msg_to_cloud(message)
        self._box = np.stack([points.min(axis=0), points.max(axis=0)])

    def _on_poses(self, message: PoseArray) -> None:
        """Check where the cameras are."""
        stamp, at = stamp_to_ns(message.header.stamp), msg_to_positions(message)
        if stamp <= self._newest or self._box is None:
            return
        self._newest, self._at = stamp, at
        self.fuzzer.check(at, self._box, 'cameras of the simulation')

    def batch(self) -> None:
        """Send lies that answer the turn, then a good command."""
        fuzzer = self.fuzzer
        for _ in range(BATCH):
            command = spoilt_poses(fuzzer.rng)
            command.header = fuzzer.header(self._newest)
            command.header.frame_id = str(fuzzer.rng.choice(['map', 'map', 'odom', '']))
            fuzzer.send(self._commands, command)
        before, last = self._newest, 0

        def moved() -> bool:
            nonlocal last
            if last != self._newest:
                last = self._newest
                self._commands.publish(positions_to_msg(self._at, fuzzer.header(last)))
            return self._newest > before

        fuzzer.until(moved, 'answer of the simulation')
        fuzzer.answered += 1
