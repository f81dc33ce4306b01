# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ROS 1 and ROS 2 bags, read without a ROS installation: what is in them, and their messages."""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
import re
import struct
from typing import Any, NamedTuple

import yaml

from ocp_ros.util.files import read_regular
from ocp_ros.util.settings import ConfigurationError

CLOUD, POSES = 'sensor_msgs/msg/PointCloud2', 'geometry_msgs/msg/PoseArray'
TRANSFORMS = 'tf2_msgs/msg/TFMessage'
#: The types that are read; old bags have transforms of another name and the same layout.
KINDS = {CLOUD: CLOUD, POSES: POSES, TRANSFORMS: TRANSFORMS, 'tf/msg/tfMessage': TRANSFORMS}
#: Messages of a topic that are asked for their frame, and the longest name of one.
ASKED, LONGEST = 20, 1000
#: Bytes of metadata, which is text: a bag of hundreds of topics and files has a tenth of it.
METADATA = 10_000_000
#: Bytes that a field of a cloud, a pose and a transform take at least in ROS 1.
PARTS = {CLOUD: 13, POSES: 56, TRANSFORMS: 76}
#: What may be an alias in YAML; whether it is one, only a parser knows.
ALIAS = re.compile(rb'(^|[\s,\[{])\*\w')
#: What a file begins with that is a ROS 1 bag, and how files of ROS 2 bags are called.
ROS1, ROS2_FILES = b'#ROSBAG V', ('.mcap', '.db3')


class Topic(NamedTuple):
    """
    A topic of a bag.

    :ivar kind: its type, as ROS 2 writes it.
    :ivar count: how many messages there are.
    """

    name: str
    kind: str
    count: int


class Recorded(NamedTuple):
    """
    A message of a bag.

    :ivar kind: one of the values of ``KINDS``.
    :ivar time: when it was recorded, nanoseconds.
    :ivar cdr: the message as ROS 2 serialises it.
    """

    topic: str
    kind: str
    time: int
    cdr: bytes


class BrokenMessage(ValueError):
    """A message of a bag that does not hold what its type says."""


class Bag:
    """
    An open bag; use it in a ``with`` statement.

    :param path: a ROS 1 bag, the folder of a ROS 2 bag, or a file in it.
    :raises ConfigurationError: if it cannot be read, in one sentence.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        with self._readable():
            try:
                from rosbags.typesys import get_typestore, Stores
            except ImportError as error:
                raise ConfigurationError(
                    f'{self.path}: found no package to read bags with; expected rosbags; '
                    'install it: pip install rosbags') from error
            self._reader, self._is_ros1 = _reader(self.path)
            self._store = get_typestore(Stores.ROS2_JAZZY)
            self._reader.open()

    def __enter__(self) -> 'Bag':
        """Return itself."""
        return self

    def __exit__(self, *exception) -> None:
        """Close the files."""
        self._reader.close()

    @contextmanager
    def _readable(self) -> Iterator[None]:
        """Turn what the library stumbles over into one sentence."""
        try:
            yield
        except (ConfigurationError, PermissionError):
            raise
        except Exception as error:
            # Bytes that are no bag let it stumble in more ways than it has names for.
            why = ' '.join(str(error).split()) or type(error).__name__
            raise ConfigurationError(
                f'{self.path}: found a bag that cannot be read ({why.rstrip(".")}); expected a '
                'whole one; if its recording was cut short, mend it with rosbag reindex (ROS 1) '
                'or ros2 bag reindex') from error

    @property
    def topics(self) -> list[Topic]:
        """Return all topics by name."""
        with self._readable():
            return [Topic(name, info.msgtype or 'several types', info.msgcount)
                    for name, info in sorted(self._reader.topics.items())]

    @property
    def start(self) -> int:
        """Return when the first message was recorded, nanoseconds."""
        return self._reader.start_time

    @property
    def seconds(self) -> float:
        """Return how long the recording is."""
        return max(self._reader.end_time - 1 - self.start, 0) * 1e-9

    def frames(self, topic: Topic) -> list[str]:
        """Return the frames of a topic's first messages; for transforms none."""
        if KINDS.get(topic.kind) not in (CLOUD, POSES):
            return []
        with self._readable():
            raw = [message for _, _, message in islice(
                self._reader.messages(self._connections([topic.name])), ASKED)]
            return sorted({_frame(message, self._is_ros1) for message in raw})

    def messages(self, names: list[str], start: int | None = None, stop: int | None = None
                 ) -> Iterator[Recorded | BrokenMessage]:
        """
        Yield the messages of some topics in the order in which they were recorded.

        :param names: topics whose kinds are among ``KINDS``.
        :param start: from when on, nanoseconds.
        :param stop: until when, nanoseconds; that itself not included.
        :returns: what can be read; for what cannot the reason.
        :raises ConfigurationError: where the bag ends too early.
        """
        connections = self._connections(names)
        with self._readable():
            if not connections:
                return
            for connection, time, raw in self._reader.messages(connections, start, stop):
                kind = KINDS[connection.msgtype]
                try:
                    if self._is_ros1:
                        _check_count(raw, kind)
                    cdr = bytes(self._store.ros1_to_cdr(raw, kind) if self._is_ros1 else raw)
                except Exception as error:
                    yield BrokenMessage(f'{connection.topic}: found a message that is no {kind} '
                                        f'({error}); expected one; it is left out')
                else:
                    yield Recorded(connection.topic, kind, time, cdr)

    def transforms(self, cdr: bytes) -> list:
        """
        Return the transforms of a message of them, for those who lack its type.

        :raises BrokenMessage: if it is none.
        """
        try:
            message: Any = self._store.deserialize_cdr(cdr, TRANSFORMS)
            return message.transforms
        except Exception as error:
            raise BrokenMessage(f'transforms: found a message that is none ({error}); expected '
                                'one; it is left out') from error

    def _connections(self, names: list[str]) -> list:
        """Return the recorded connections of some topics."""
        return [one for one in self._reader.connections
                if one.topic in names and one.msgtype in KINDS]


def _reader(path: Path):
    """Return the reader of a bag that is not open yet, and whether it is one of ROS 1."""
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    expected = ('expected a ROS 1 bag or the folder of a ROS 2 bag, in which metadata.yaml and '
                '.mcap or .db3 files are')
    if not path.exists():
        raise ConfigurationError(f'{path}: found nothing there; {expected}; correct the path')
    if path.is_file() and path.suffix in ROS2_FILES:
        path = path.parent
    if path.is_dir():
        if (path / 'metadata.yaml').is_file():
            _check_metadata(path / 'metadata.yaml')
            return Reader2(path), False
        recorded = any(file.suffix in ROS2_FILES for file in path.iterdir())
        inside, remedy = ('recorded files without metadata.yaml', 'run ros2 bag reindex') if (
            recorded) else ('a folder that is no bag', 'name the folder that ros2 bag record made')
        raise ConfigurationError(f'{path}: found {inside}; {expected}; {remedy}')
    if not path.is_file():
        raise ConfigurationError(f'{path}: found a pipe or a device; {expected}; correct the path')
    with open(path, 'rb') as file:
        if file.read(len(ROS1)) != ROS1:
            raise ConfigurationError(f'{path}: found a file that is no bag; {expected}; correct '
                                     'the path')
    return Reader1(path), True


def _check_metadata(path: Path) -> None:
    """Refuse metadata in which values stand for others: written out, they may fill the memory."""
    text = read_regular(path, METADATA)
    if ALIAS.search(text) and any(isinstance(token, yaml.AliasToken) for token in yaml.scan(text)):
        raise ValueError('metadata.yaml has an alias, which ROS never writes')


def _check_count(raw: bytes, kind: str) -> None:
    """
    Refuse a ROS 1 message whose list is longer than its bytes: the library would go on for hours.

    :raises ValueError: if so.
    """
    start = 0
    if kind != TRANSFORMS:
        length, = struct.unpack_from('<I', raw, 12)
        start = 16 + length + (8 if kind == CLOUD else 0)
    count, = struct.unpack_from('<I', raw, start)
    if count * PARTS[kind] > len(raw):
        raise ValueError(f'{count:,} parts in {len(raw):,} bytes')


def _frame(raw: bytes, is_ros1: bool) -> str:
    """Return the frame of a message that begins with a header."""
    # ROS 1: sequence, stamp, text. ROS 2: byte order, stamp, text, which ends with a zero byte.
    order = '>' if not is_ros1 and raw[1] % 2 == 0 else '<'
    length, = struct.unpack_from(f'{order}I', raw, 12)
    if length > min(LONGEST, len(raw) - 16):
        return '?'
    return bytes(raw[16:16 + length]).rstrip(b'\0').decode(errors='replace')
