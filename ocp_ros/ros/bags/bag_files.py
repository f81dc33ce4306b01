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

"""Read the topics and messages of ROS 1 and ROS 2 bags without a ROS installation."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
import json
from pathlib import Path
import re
import struct
import tempfile
from typing import Any, NamedTuple

from ocp_ros.ros.bags.bag_process import CLOUD, END, HEADER, KINDS, MESSAGE, POSES, TRANSFORMS
from ocp_ros.util.files import read_regular
from ocp_ros.util.guarded_process import GuardedProcess, ReadingCost
from ocp_ros.util.settings import ConfigurationError
import yaml

#: Limits for reading a bag: bytes of memory, bytes of memory for each byte of the bag, and seconds
#: of all cores for an answer, to which seconds by the size of the bag are added.
READING_COST = ReadingCost(1_500_000_000, 0, 10)
#: Suffix of packed files.
PACKED_SUFFIX = '.zstd'


class Topic(NamedTuple):
    """
    A topic of a bag.

    :ivar kind: its message type, as ROS 2 writes it.
    :ivar count: number of messages.
    """

    name: str
    kind: str
    count: int


class Recorded(NamedTuple):
    """
    A message of a bag.

    :ivar kind: one of the values of ``KINDS``.
    :ivar time: time of recording, nanoseconds.
    :ivar cdr: the message, serialised by ROS 2 (CDR).
    """

    topic: str
    kind: str
    time: int
    cdr: bytes


class BrokenMessage(ValueError):
    """A message of a bag whose content does not fit its type."""


class Bag:
    """
    A bag, read by a separate process; use it in a ``with`` statement.

    :param path: a ROS 1 bag, the folder of a ROS 2 bag, or a file in it.
    :raises ConfigurationError: if it cannot be read; the text is one sentence.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._folder = tempfile.TemporaryDirectory(prefix='ocp_bag_')
        self._process: GuardedProcess | None = None
        try:
            with self._readable():
                if not find_spec('rosbags'):
                    raise ConfigurationError(
                        f'{self.path}: found no package to read bags with; expected rosbags; '
                        'install it: pip install rosbags')
                self._is_ros1, self._bag, self._files = _parts_of(self.path)
                self._found = self._start()
        except BaseException:
            self.__exit__()
            raise

    def __enter__(self) -> 'Bag':
        """Return the bag."""
        return self

    def __exit__(self, *exception) -> None:
        """End the process that reads."""
        self._end()
        self._folder.cleanup()

    def _end(self) -> None:
        """End the process that reads, if there is one."""
        if self._process is not None:
            self._process.__exit__()
            self._process = None

    def _start(self) -> dict[str, Any]:
        """Start the process that reads, and return its description of the bag."""
        size = sum(file.stat().st_size for file in self._files)
        packed = max(sum(file.suffix == PACKED_SUFFIX for file in self._files), 1)
        # Files that are compressed as a whole may unpack to 500 MB, and 50 bytes for each byte.
        self._process = GuardedProcess(
            'ocp_ros.ros.bags.bag_process',
            ['1' if self._is_ros1 else '2', self._folder.name, str(self._bag.absolute()),
             *(str(file.absolute()) for file in self._files)],
            READING_COST, size, (500_000_000 + 50 * size) // packed,
            {'TMPDIR': self._folder.name, 'SQLITE_TMPDIR': self._folder.name})
        return json.loads(self._answer()[-1])

    def _answer(self) -> tuple[int, int, int, bytearray]:
        """Return the next answer of the process: its kind, topic number, time and content."""
        header = self._process.read(HEADER.size)
        if len(header) < HEADER.size:
            raise ValueError('its reader ended too early')
        kind, topic, time, size = HEADER.unpack(header)
        return kind, topic, time, self._process.read(size)

    @contextmanager
    def _readable(self) -> Iterator[None]:
        """Convert any error of the library to a ConfigurationError of one sentence."""
        try:
            yield
        except (ConfigurationError, PermissionError):
            raise
        except Exception as error:
            # Bytes that are no bag make the library raise errors of many types.
            why = ' '.join(str(error).split()) or type(error).__name__
            raise ConfigurationError(
                f'{self.path}: found a bag that cannot be read ({why.rstrip(".")}); expected a '
                'whole one; if its recording was cut short, mend it with rosbag reindex (ROS 1) '
                'or ros2 bag reindex') from error

    @property
    def topics(self) -> list[Topic]:
        """Return all topics, sorted by name."""
        return [Topic(*topic) for topic in self._found['topics']]

    @property
    def clouds(self) -> list[str]:
        """
        Return the topics of clouds, sorted by name.

        :raises ConfigurationError: if there is none; for depth images the text says how to convert
            them to clouds.
        """
        names = [topic.name for topic in self.topics if KINDS.get(topic.kind) == CLOUD]
        if not names:
            found = ', '.join(f'{t.name} ({t.kind})' for t in self.topics) or 'no topic at all'
            images = any('depth' in topic.name
                         and topic.kind.endswith(('/Image', '/CompressedImage'))
                         for topic in self.topics)
            remedy = ('play it, let ros2 run depth_image_proc point_cloud_xyz_node make clouds of '
                      'the depth images, and record these') if images else (
                'record a topic of clouds')
            raise ConfigurationError(f'{self.path}: found no clouds among {found}; expected '
                                     f'{CLOUD}; {remedy}')
        return names

    @property
    def start(self) -> int:
        """Return the time at which the first message was recorded, nanoseconds."""
        return self._found['start']

    @property
    def seconds(self) -> float:
        """Return the duration of the recording, seconds."""
        return max(self._found['end'] - 1 - self.start, 0) * 1e-9

    def frames(self, topic: Topic) -> list[str]:
        """Return the frames of a topic's first messages; empty for transforms and other types."""
        if KINDS.get(topic.kind) not in (CLOUD, POSES):
            return []
        # The frames of 20 messages are read.
        return sorted({_frame(item.cdr) if isinstance(item, Recorded) else '?'
                       for item in self.messages([topic.name], most=20)})

    def messages(self, names: list[str], start: int | None = None, stop: int | None = None,
                 most: int | None = None) -> Iterator[Recorded | BrokenMessage]:
        """
        Yield the messages of some topics in the order in which they were recorded.

        :param names: topics whose kinds are among ``KINDS``.
        :param start: earliest time of recording, nanoseconds; None for the beginning.
        :param stop: time of recording, nanoseconds, at which to stop, itself excluded; None for
            the end.
        :param most: largest number of messages.
        :returns: the messages; for a message that cannot be read, the reason.
        :raises ConfigurationError: if the bag ends too early.
        """
        topics = self.topics
        with self._readable():
            if self._process is None:
                self._start()
            self._process.ask(json.dumps([names, start, stop, most]))
            try:
                while (answer := self._answer())[0] != END:
                    what, number, time, content = answer
                    topic, kind = topics[number].name, KINDS[topics[number].kind]
                    if what == MESSAGE:
                        yield Recorded(topic, kind, time, bytes(content))
                    else:
                        yield BrokenMessage(
                            f'{topic}: found a message that is no {kind} '
                            f'({content.decode()}); expected one; it is left out')
            except BaseException:
                # The process would still send the remaining answers to this request: end it.
                self._end()
                raise

    def transforms(self, cdr: bytes) -> list:
        """
        Return the transforms of a serialised TFMessage; tf2_msgs need not be installed.

        :raises BrokenMessage: if it is no TFMessage.
        """
        try:
            message: Any = _store().deserialize_cdr(cdr, TRANSFORMS)
            return message.transforms
        except Exception as error:
            raise BrokenMessage(f'transforms: found a message that is none ({error}); expected '
                                'one; it is left out') from error


@cache
def _store() -> Any:
    """Return the message types that rosbags can deserialise."""
    from rosbags.typesys import get_typestore, Stores
    return get_typestore(Stores.ROS2_JAZZY)


def _parts_of(path: Path) -> tuple[bool, Path, list[Path]]:
    """Return whether a bag is of ROS 1, the path of the bag, and the files that it consists of."""
    expected = ('expected a ROS 1 bag or the folder of a ROS 2 bag, in which metadata.yaml and '
                '.mcap or .db3 files are')
    if not path.exists():
        raise ConfigurationError(f'{path}: found nothing there; {expected}; correct the path')
    ros2_suffixes = ('.mcap', '.db3')
    if path.is_file() and path.suffix in ros2_suffixes:
        path = path.parent
    if path.is_dir():
        if (path / 'metadata.yaml').is_file():
            files = [file for file in path.iterdir()
                     if file.suffix in (*ros2_suffixes, PACKED_SUFFIX)]
            files = [path / 'metadata.yaml', *files]
            if strange := [file.name for file in files if not file.is_file()]:
                raise ConfigurationError(f'{path}: found {strange[0]}, which is no file; '
                                         f'{expected}; remove it')
            around = path.resolve()
            if links := [file.name for file in files if file.resolve().parent != around]:
                raise ConfigurationError(f'{path}: found {links[0]}, a link to another folder; '
                                         f'{expected}; copy the file here')
            _check_metadata(path / 'metadata.yaml')
            return False, path, files
        recorded = any(file.suffix in ros2_suffixes for file in path.iterdir())
        inside, remedy = ('recorded files without metadata.yaml', 'run ros2 bag reindex') if (
            recorded) else ('a folder that is no bag', 'name the folder that ros2 bag record made')
        raise ConfigurationError(f'{path}: found {inside}; {expected}; {remedy}')
    if not path.is_file():
        raise ConfigurationError(f'{path}: found a pipe or a device; {expected}; correct the path')
    with open(path, 'rb') as file:
        if file.read(9) != b'#ROSBAG V':
            raise ConfigurationError(f'{path}: found a file that is no bag; {expected}; correct '
                                     'the path')
    return True, path, [path]


def _check_metadata(path: Path) -> None:
    """Refuse metadata with YAML aliases: when they are expanded, they may fill the memory."""
    # A bag of hundreds of topics and files has a tenth of 2 MB of metadata.
    text = read_regular(path, 2_000_000)
    loader = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
    # The text may be an alias in YAML; only the parser decides whether it is one.
    alias = re.compile(rb'(^|[\s,\[{])\*\w')
    if alias.search(text) and any(isinstance(event, yaml.AliasEvent)
                                  for event in yaml.parse(text, loader)):
        raise ValueError('metadata.yaml has an alias, which ROS never writes')


def _frame(cdr: bytes) -> str:
    """Return the frame of a message that begins with a header."""
    # The header has the byte order, the stamp, and a text that ends with a zero byte.
    length, = struct.unpack_from('>I' if cdr[1] % 2 == 0 else '<I', cdr, 12)
    # A longer name is no frame.
    if length > min(1000, len(cdr) - 16):
        return '?'
    return cdr[16:16 + length].rstrip(b'\0').decode(errors='replace')
