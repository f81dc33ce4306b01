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
import json
from pathlib import Path
import re
import struct
import tempfile
from typing import Any, NamedTuple

from ocp_ros.ros.bags.bag_process import (
    Answer,
    CLOUD,
    HEADER,
    IMAGE,
    KINDS,
    PNG_IMAGE,
    TRANSFORMS,
)
from ocp_ros.ros.interface.topics import camera_info_of_image
from ocp_ros.util.files import read_regular
from ocp_ros.util.guarded_process import GuardedProcess, ReadingCost
from ocp_ros.util.settings import ConfigurationError, need
import yaml

#: Suffix of files that are compressed as a whole.
PACKED_SUFFIX = '.zstd'


class Topic(NamedTuple):
    """
    A topic of a bag.

    :ivar name: name of the topic.
    :ivar kind: message type of the topic, as ROS 2 writes it.
    :ivar count: number of messages.
    """

    name: str
    kind: str
    count: int


class Recorded(NamedTuple):
    """
    A message of a bag.

    :ivar topic: name of the topic.
    :ivar kind: message type, one of the values of ``KINDS``.
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
    :raises ConfigurationError: if the bag cannot be read; the text is one sentence.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._folder = tempfile.TemporaryDirectory(prefix='ocp_bag_')
        self._process: GuardedProcess | None = None
        try:
            with self._explain_errors():
                need(str(self.path), 'rosbags')
                self._is_ros1, self._bag_path, self._files = _identify_bag(self.path)
                self._description = self._start_process()
        except BaseException:
            # Python does not call __exit__ if the constructor fails.
            self.__exit__()
            raise

    def __enter__(self) -> 'Bag':
        """Return the bag."""
        return self

    def __exit__(self, *exception) -> None:
        """End the process that reads."""
        self._end_process()
        self._folder.cleanup()

    def _end_process(self) -> None:
        """End the process that reads, if there is one."""
        if self._process is not None:
            self._process.__exit__()
            self._process = None

    def _start_process(self) -> dict[str, Any]:
        """Start the process that reads; return its description of the bag, topics and times."""
        size = sum(file.stat().st_size for file in self._files)
        packed_files = sum(file.suffix == PACKED_SUFFIX for file in self._files)
        # All compressed files together may unpack to 500 MB plus 50 times the size of the bag.
        # Each is unpacked to a file of its own; the limit of the process is for a single file.
        max_file_bytes = (500_000_000 + 50 * size) // max(packed_files, 1)
        self._process = GuardedProcess(
            'ocp_ros.ros.bags.bag_process',
            ['1' if self._is_ros1 else '2', self._folder.name, str(self._bag_path.absolute()),
             *(str(file.absolute()) for file in self._files)],
            ReadingCost(memory=1_500_000_000, memory_per_byte=0, seconds=10), size,
            max_file_bytes,
            {'TMPDIR': self._folder.name, 'SQLITE_TMPDIR': self._folder.name})
        # The content of the first answer is the description.
        return json.loads(self._read_answer()[-1])

    def _read_answer(self) -> tuple[int, int, int, bytearray]:
        """Return the next answer of the process: its kind, topic number, time and content."""
        header = self._process.read(HEADER.size)
        if len(header) < HEADER.size:
            raise ValueError('its reader ended too early')
        kind, topic, time, size = HEADER.unpack(header)
        return kind, topic, time, self._process.read(size)

    @contextmanager
    def _explain_errors(self) -> Iterator[None]:
        """Convert errors in a ``with`` block to a ConfigurationError of one sentence."""
        try:
            yield
        except (ConfigurationError, PermissionError):
            raise
        except Exception as error:
            # Bytes that are no bag make the library raise errors of many types.
            reason = ' '.join(str(error).split()) or type(error).__name__
            raise ConfigurationError(
                f'{self.path}: found a bag that cannot be read ({reason.rstrip(".")}); expected a '
                'whole one; if its recording was cut short, mend it with rosbag reindex (ROS 1) '
                'or ros2 bag reindex') from error

    @property
    def topics(self) -> list[Topic]:
        """Return all topics, sorted by name."""
        return [Topic(*topic) for topic in self._description['topics']]

    @property
    def clouds(self) -> list[str]:
        """
        Return the names of the topics of clouds, sorted; if there are none, of depth images.

        These are images beside a CameraInfo with ``depth`` in their names; if there are raw ones,
        those of compressed_depth_image_transport are left out.

        :raises ConfigurationError: if there is none.
        """
        kinds = {topic.name: KINDS.get(topic.kind) for topic in self.topics}
        for kind, part in ((CLOUD, ''), (IMAGE, 'depth'), (PNG_IMAGE, '/compressedDepth')):
            names = [name for name, found in kinds.items() if found == kind and part in name and (
                kind == CLOUD or camera_info_of_image(name) in kinds)]
            if names:
                return names
        found = ', '.join(f'{t.name} ({t.kind})' for t in self.topics) or 'no topic at all'
        raise ConfigurationError(
            f'{self.path}: found no clouds among {found}; expected {CLOUD}, or depth images and '
            'their camera_info; record such topics')

    @property
    def start(self) -> int:
        """Return the time at which the first message was recorded, nanoseconds."""
        return self._description['start']

    @property
    def seconds(self) -> float:
        """Return the duration of the recording, seconds."""
        # rosbags ends a bag one nanosecond after its last message.
        return max(self._description['end'] - 1 - self.start, 0) * 1e-9

    def frames(self, topic: Topic) -> list[str]:
        """
        Return the frames of the first 20 messages of a topic, sorted, each once.

        :returns: the frames, with '?' for one that cannot be read; empty for topics that are not
            read, and for transforms.
        """
        if KINDS.get(topic.kind) in (None, TRANSFORMS):
            return []
        return sorted({_frame_of(message.cdr) if isinstance(message, Recorded) else '?'
                       for message in self.messages([topic.name], max_messages=20)})

    def messages(self, names: list[str], start: int | None = None, stop: int | None = None,
                 max_messages: int | None = None) -> Iterator[Recorded | BrokenMessage]:
        """
        Yield the messages of some topics in the order in which they were recorded.

        :param names: names of topics whose types are among ``KINDS``.
        :param start: earliest time of recording, nanoseconds; None for the beginning.
        :param stop: time of recording, nanoseconds, at which to stop, itself excluded; None for
            the end.
        :param max_messages: largest number of messages; None for all.
        :returns: the messages; in place of a message that cannot be read, the error.
        :raises ConfigurationError: if the bag ends too early.
        """
        topics = self.topics
        with self._explain_errors():
            # The process has ended if an earlier call did not read all messages.
            if self._process is None:
                self._start_process()
            self._process.ask(json.dumps([names, start, stop, max_messages]))
            try:
                while (answer := self._read_answer())[0] != Answer.END:
                    answer_kind, number, time, content = answer
                    name, kind = topics[number].name, KINDS[topics[number].kind]
                    if answer_kind == Answer.MESSAGE:
                        yield Recorded(name, kind, time, bytes(content))
                    else:
                        yield BrokenMessage(
                            f'{name}: found a message that is no {kind} '
                            f'({content.decode()}); expected one; it is left out')
            except BaseException:
                # An error, or a caller that needs no more messages: end the process, which would
                # still send the other answers to this request.
                self._end_process()
                raise

    def transforms(self, cdr: bytes) -> list:
        """
        Return the transforms of a serialised TFMessage; tf2_msgs need not be installed.

        :param cdr: the message, serialised by ROS 2 (CDR).
        :raises BrokenMessage: if the bytes are no TFMessage.
        """
        try:
            message: Any = _type_store().deserialize_cdr(cdr, TRANSFORMS)
            return message.transforms
        except Exception as error:
            raise BrokenMessage(f'transforms: found a message that is none ({error}); expected '
                                'one; it is left out') from error


@cache
def _type_store() -> Any:
    """Return the message types that rosbags can deserialise."""
    from rosbags.typesys import get_typestore, Stores
    return get_typestore(Stores.ROS2_JAZZY)


def _identify_bag(path: Path) -> tuple[bool, Path, list[Path]]:
    """Return whether a bag is of ROS 1, the path of the bag, and the paths of its files."""
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
            if not_files := [file.name for file in files if not file.is_file()]:
                raise ConfigurationError(f'{path}: found {not_files[0]}, which is no file; '
                                         f'{expected}; remove it')
            folder = path.resolve()
            if linked_names := [file.name for file in files if file.resolve().parent != folder]:
                raise ConfigurationError(f'{path}: found {linked_names[0]}, a link to another '
                                         f'folder; {expected}; copy the file here')
            _check_metadata(path / 'metadata.yaml')
            return False, path, files
        found, remedy = 'a folder that is no bag', 'name the folder that ros2 bag record made'
        if any(file.suffix in ros2_suffixes for file in path.iterdir()):
            found, remedy = 'recorded files without metadata.yaml', 'run ros2 bag reindex'
        raise ConfigurationError(f'{path}: found {found}; {expected}; {remedy}')
    if not path.is_file():
        raise ConfigurationError(f'{path}: found a pipe or a device; {expected}; correct the path')
    # A ROS 1 bag begins with these bytes.
    with open(path, 'rb') as file:
        if file.read(9) != b'#ROSBAG V':
            raise ConfigurationError(f'{path}: found a file that is no bag; {expected}; correct '
                                     'the path')
    return True, path, [path]


def _check_metadata(path: Path) -> None:
    """Refuse metadata with YAML aliases: when they are expanded, they may fill the memory."""
    # At most 2 MB are read: a bag of hundreds of topics and files has a tenth of that.
    text = read_regular(path, 2_000_000)
    loader = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
    # The pattern finds all aliases and some other texts. If it finds any, the parser looks for
    # aliases: it lists the events of the text and expands nothing.
    alias = re.compile(rb'(^|[\s,\[{])\*\w')
    if alias.search(text) and any(isinstance(event, yaml.AliasEvent)
                                  for event in yaml.parse(text, loader)):
        raise ValueError('metadata.yaml has an alias, which ROS never writes')


def _frame_of(cdr: bytes) -> str:
    """Return the frame of a serialised message that begins with a header; '?' if there is none."""
    # CDR: 4 bytes with the byte order (the second is even for big-endian), the stamp in 8 bytes,
    # the length of the text in 4 bytes, and the text, which ends with a zero byte.
    if len(cdr) < 16:
        return '?'
    length, = struct.unpack_from('>I' if cdr[1] % 2 == 0 else '<I', cdr, 12)
    # A text of more than 1000 bytes is no name of a frame.
    if length > min(1000, len(cdr) - 16):
        return '?'
    return cdr[16:16 + length].rstrip(b'\0').decode(errors='replace')
