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

"""
Send nodes messages that lie, and see that they live, refuse, and command nothing out of bounds.

Messages that lie are what broken drivers, other programs and torn networks send. Most of them
cannot be used; a few can, since not every lie matters. Between the lies come good messages that
have to be answered. Nodes are processes of their own; what they hold in memory is measured before
and after.
"""

import argparse
from array import array
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
import json
from pathlib import Path
import struct
import sys
import time

from benchmarks import results
from benchmarks.drills.drill import grown, rss_of, run_drill
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.demo.watched_nodes import NodeProcess, stopped_at_the_end, Watch
from ocp_ros.policy.checkpoint import Checkpoint, METADATA_KEY
from ocp_ros.policy.cloud_encoder import Encoder
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import (
    bytes_to_msg,
    cloud_to_msg,
    fields_to_msg,
    MessageError,
    msg_to_cloud,
    msg_to_fields,
    msg_to_positions,
    ns_to_stamp,
    positions_to_msg,
    stamp_to_ns,
)
from ocp_ros.ros.interface.qos import LATCHED, LOOP
from ocp_ros.training.experience import Choice, Experience, to_bytes
from ocp_ros.util.resources import find_model
from rclpy.node import Node
from rclpy.publisher import Publisher
from rich.console import Console
from rich.progress import Progress
import safetensors.torch
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Float64MultiArray, Header, UInt8MultiArray

#: What numbers of a message are made to be.
NUMBERS = (0, 1, 3, 12, 255, 65536, 2 ** 31 - 1, 2 ** 31, 2 ** 32 - 1)
FLOATS = (0.0, -0.0, 1.0, np.nan, np.inf, -np.inf, 1e308, -3e38, 5e-324, -1e-7, 1e9)
#: Lies of a kind between two good messages: fewer than the queues hold.
BATCH = 8
#: Size of the room that good messages show, metres, where its cameras are, and their longest step.
ROOM, START, MAX_STEP = (6.0, 4.0, 2.8), ((2.0, 2.0, 1.9), (3.0, 2.0, 1.9)), 0.5
#: Seconds after which good turns are sent again: the trainer tells once a second what it has.
AGAIN = 1.5
#: Seconds to wait for an answer.
PATIENCE = 120.0

Until = Callable[[Callable[[], bool], str], None]


def spoilt_cloud(rng: np.random.Generator, messages: Sequence[PointCloud2]) -> PointCloud2:
    """
    Make a cloud whose numbers, fields or bytes lie.

    :param messages: one of them is spoilt.
    """
    message = deepcopy(messages[rng.integers(len(messages))])
    for _ in range(rng.integers(1, 4)):
        what = rng.choice(['number', 'field', 'twice', 'lost', 'cut', 'more', 'bytes', 'order'])
        field = message.fields[rng.integers(len(message.fields))] if message.fields else None
        if what == 'number':
            name = rng.choice(['height', 'width', 'point_step', 'row_step'])
            near = (getattr(message, name) + int(rng.integers(-1, 2))) % 2 ** 32
            setattr(message, name, int(rng.choice([*NUMBERS, near, near])))
        elif what == 'field' and field:
            field.offset = int(rng.choice([*NUMBERS, 5, 8, 13]))
            field.datatype = int(rng.choice([field.datatype, 7, 8, rng.integers(256)]))
            field.count = int(rng.choice([0, 1, 1, 1, 2, 2 ** 32 - 1]))
        elif what == 'twice' and field:
            message.fields = [*message.fields, deepcopy(field)]
        elif what == 'lost' and field:
            message.fields = [other for other in message.fields if other is not field]
        elif what == 'cut':
            message.data = message.data[:rng.integers(len(message.data) + 1)]
        elif what == 'more':
            message.data = message.data + array('B', bytes(int(rng.integers(1, 100))))
        elif what == 'bytes':
            message.data = array('B', rng.bytes(len(message.data)))
        else:
            message.is_bigendian = not message.is_bigendian
    return message


def spoilt_poses(rng: np.random.Generator) -> PoseArray:
    """Make poses with numbers that are none."""
    message = positions_to_msg(rng.normal(size=(rng.integers(0, 5), 3)), Header())
    for pose in message.poses:
        part = pose.position if rng.random() < 0.5 else pose.orientation
        if rng.random() < 0.7:
            setattr(part, rng.choice(list('xyz')), float(rng.choice(FLOATS)))
        if rng.random() < 0.4:
            pose.orientation.w = float(rng.choice(FLOATS))
    return message


def spoilt_fields(rng: np.random.Generator, known: Sequence[str] = ('a', 'b', 'c', '', 'é')
                  ) -> Float64MultiArray:
    """
    Make named numbers whose names or numbers are missing, twice there or none.

    :param known: names to draw from.
    """
    names = list(rng.choice(known, rng.integers(0, len(known) + 1)))
    message = fields_to_msg(dict.fromkeys(names, 1.0))
    if rng.random() < 0.4:
        message.data = [*message.data, *rng.choice(FLOATS, rng.integers(0, 3))]
    message.data = [float(rng.choice(FLOATS)) if rng.random() < 0.3 else x for x in message.data]
    if rng.random() < 0.3:
        message.layout.dim = message.layout.dim * int(rng.integers(0, 3))
    if message.layout.dim and rng.random() < 0.3:
        message.layout.dim[0].label += str(rng.choice([',', ',a', 'a,,', '\0']))
    return message


def known_lies(cloud: PointCloud2) -> list[PointCloud2]:
    """
    Make the clouds that are known to have killed other programs.

    :param cloud: good, with x, y and z as its first fields.
    :returns: clouds without x, y or z or with one of them twice, with data that is too short or
        too long, with sizes whose product overflows 32 bits, with a row_step that is wrong, and
        with a field outside of its point or of two numbers.
    """
    def changed(**values) -> PointCloud2:
        message = deepcopy(cloud)
        for name, value in values.items():
            setattr(message, name, value)
        return message

    def with_first_field(**values) -> PointCloud2:
        message = changed()
        for name, value in values.items():
            setattr(message.fields[0], name, value)
        return message

    fields, data = list(cloud.fields), cloud.data
    return [*(changed(fields=[one for one in fields if one.name != name]) for name in 'xyz'),
            changed(fields=[]), changed(fields=[*fields, fields[1]]),
            with_first_field(offset=2 ** 32 - 1), with_first_field(count=2),
            changed(data=data[:-1]), changed(data=array('B')),
            changed(data=data + array('B', [0])),
            changed(width=65536, height=65536), changed(width=2 ** 31, height=2 ** 31),
            changed(width=2 ** 32 - 1, row_step=0), changed(point_step=0, row_step=0),
            changed(width=cloud.width - 1, row_step=3),
            changed(height=2, row_step=cloud.row_step // 2 - 1)]


def organised(cloud: PointCloud2) -> PointCloud2:
    """Make the same points with a gap after each, most significant byte first, in two rows."""
    points = np.frombuffer(cloud.data, '<f4').reshape(-1, 3)
    points = points[:len(points) // 2 * 2]
    wide = np.zeros((len(points), 5), '>f4')
    wide[:, [0, 1, 3]] = points
    message = PointCloud2(header=cloud.header, height=2, width=len(points) // 2, point_step=20,
                          row_step=10 * len(points), is_bigendian=True)
    message.fields = [PointField(name=name, offset=offset, datatype=PointField.FLOAT32, count=1)
                      for name, offset in (('x', 0), ('y', 4), ('z', 12))]
    message.data = array('B', wide.tobytes())
    return message


def few_points(rng: np.random.Generator) -> list[PointCloud2]:
    """Make small good clouds of several layouts, to be spoilt."""
    plain = cloud_to_msg(rng.uniform([0, 0, 0], [6, 4, 3], (40, 3)), Header(frame_id='map'))
    return [plain, organised(plain)]


def spoilt_weights(rng: np.random.Generator, good: Checkpoint) -> bytes:
    """
    Make weights that have to be refused.

    :param good: those that run: of no more updates, and of another architecture, are no good.
    """
    blob = good.to_bytes()
    kind = rng.integers(7)
    if kind == 0:
        return blob[:rng.integers(len(blob))]
    if kind == 1:
        weights = {name: value.clone() for name, value in good.weights.items()}
        value = weights[sorted(weights)[rng.integers(len(weights))]].reshape(-1)
        value[rng.integers(len(value))] = float(rng.choice([np.nan, np.inf, -np.inf]))
        return _unchecked(good, weights)
    if kind == 2:
        name = sorted(good.weights)[rng.integers(len(good.weights))]
        return _unchecked(good, {**good.weights, name: good.weights[name][..., :-1]})
    if kind == 3:
        return _unchecked(good, good.weights, updates=int(rng.integers(-5, good.updates + 1)))
    if kind == 4:
        return rng.bytes(rng.integers(200))
    if kind == 5:
        size = float(rng.choice([3e38, -3e38, 1e19]))
        return _unchecked(good, {name: value * 0.0 + size for name, value in good.weights.items()},
                          updates=good.updates + 1)
    (length,) = struct.unpack('<Q', blob[:8])
    torn = bytearray(blob)
    # Within the header: what happens to a single weight may leave a number.
    for at in rng.integers(8 + length, size=4):
        torn[at] = (torn[at] + int(rng.integers(1, 256))) % 256
    return bytes(torn)


def _unchecked(good: Checkpoint, weights: dict, **card) -> bytes:
    """Write weights that no checkpoint would hold."""
    tensors = {name: value.contiguous() for name, value in weights.items()}
    return safetensors.torch.save(
        tensors, metadata={METADATA_KEY: json.dumps({**good.card(), **card})})


def spoilt_blob(rng: np.random.Generator, blob: bytes) -> bytes:
    """Cut a blob, or change some bytes of it, half of them near its beginning."""
    if rng.random() < 0.3 or not blob:
        return blob[:rng.integers(len(blob) + 1)]
    torn = bytearray(blob)
    for at in rng.integers(len(blob) if rng.random() < 0.5 else min(len(blob), 300), size=3):
        torn[at] = int(rng.integers(256))
    return bytes(torn)


def spoilt_numbers(rng: np.random.Generator, choices: Sequence[Choice]) -> None:
    """Put a number that no policy reads or chooses into one array of a choice."""
    choice = choices[rng.integers(len(choices))]
    # A byte of a map may have any value.
    arrays = [array for array in (*choice.observation.values(), choice.actions)
              if array.dtype != np.uint8]
    array = arrays[rng.integers(len(arrays))]
    wrong = (-1, 32767) if array.dtype.kind == 'i' else (3e38, -3e38, 1e30, np.nan, np.inf)
    array.flat[rng.integers(array.size)] = rng.choice(wrong)


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


def parser() -> argparse.ArgumentParser:
    """Build the parser."""
    top = argparse.ArgumentParser(prog='fuzz', description=__doc__)
    top.add_argument('--messages', type=int, default=100_000, help='messages that lie')
    top.add_argument('--minutes', type=float, help='so long, in place of so many')
    top.add_argument('--seed', type=int, default=0, help='of everything')
    top.add_argument('--points', type=int, default=5_000_000, help='of one huge cloud')
    top.add_argument('--out', type=Path, default=Path('out'), help='folder for the results')
    results.add_record(top, 'drills')
    return top


def start(options: argparse.Namespace, domain: int) -> Iterator[NodeProcess]:
    """Start a node of each kind; the policy runs the shipped weights and a live one beside it."""
    logs = options.out / 'logs' / 'fuzz'
    for namespace, name, parameters in (
            ('turns', 'policy_node', {'turns': 100000, 'follow_trainer': True}),
            ('turns', 'trainer_node', {'folder': str(options.out / 'fuzz_trainer'),
                                       'sources': 'turns'}),
            ('learn', 'trainer_node', {'folder': str(options.out / 'fuzz_learner'),
                                       'sources': 'learn',
                                       'updates_per_turn': 1.0, 'sac.batch_size': 16,
                                       'sac.learning_starts': 20, 'sac.buffer_size': 1000,
                                       'most_behind': 1000000}),
            ('live', 'policy_node', {'cloud_topics': 'a,b', 'turns': 100000, 'cloud_timeout': 0.3,
                                     'arrival_timeout': 0.5}),
            ('sim', 'sim_node', {'scene.points': 3000, 'rig.cameras': 3, 'auto_reset': True})):
        log = logs / namespace / f'{name}.log'
        yield NodeProcess(name, domain, log, parameters, namespace)


def fuzz(options: argparse.Namespace, domain: int, watch: Watch) -> dict:
    """Send as many lies as asked for; returns the figures."""
    processes: list[NodeProcess] = []

    def until(predicate: Callable[[], bool], what: str) -> None:
        watch.spin_until(predicate, PATIENCE, what, processes, 0.02)

    with stopped_at_the_end(processes), Progress(console=Console(stderr=True)) as progress:
        processes += start(options, domain)
        weights = Checkpoint.load(find_model('actor'))
        fuzzer = Fuzzer(watch.node, until, options.seed, weights)
        policy = PolicyTarget(fuzzer, '/turns')
        live, sim = LiveTarget(fuzzer, '/live', ['a', 'b']), SimTarget(fuzzer, '/sim')
        learn = TrainerTarget(fuzzer, '/learn')
        huge = policy.ping(shell(fuzzer.rng, options.points))
        task = progress.add_task('messages', total=1.0)
        began, before, rounds = time.monotonic(), None, 0

        def done() -> float:
            if options.minutes is not None:
                return (time.monotonic() - began) / (60.0 * options.minutes)
            return fuzzer.sent / options.messages

        while done() < 1.0:
            policy.batch(again=rounds % 10 > 0)
            sim.batch()
            if rounds % 20 == 0:
                live.batch()
                learn.batch()
            rounds += 1
            progress.update(task, completed=done())
            if before is None and done() >= 0.2:
                before = {one.name: rss_of(one.process.pid) for one in processes}
        growth = {one.name: rss_of(one.process.pid) - before[one.name] for one in processes}
        seconds = time.monotonic() - began
        seen = dict(watch.node.diagnostics)
        until(lambda: all(watch.node.diagnostics[one.name] is not seen.get(one.name)
                          for one in processes), 'last word of every node')
        return {'faults': grown(growth), 'messages': fuzzer.sent,
                'good_messages_answered': fuzzer.answered,
                'lies_answered_within_bounds': fuzzer.readable, 'seconds': seconds,
                'huge_cloud_points': options.points, 'huge_cloud_seconds': huge,
                'rss_growth_mb': growth, 'seed': options.seed, 'refused': {
                    one.name: {key: int(value) for key, value
                               in watch.node.diagnostics[one.name].items() if 'refused' in key}
                    for one in processes}}


def main(args: list[str] | None = None) -> int:
    """Run; 2 if a node did what it must not."""
    return run_drill('fuzz', parser().parse_args(args), args, fuzz)


if __name__ == '__main__':
    sys.exit(main())
