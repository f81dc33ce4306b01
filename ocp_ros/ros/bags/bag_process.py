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
A process that reads a bag with rosbags, within limits of memory, time and file access.

The limits are needed because a few kilobytes of a bag may expand to gigabytes, or without end.
:mod:`~ocp_ros.ros.bags.bag_files` starts the process and sets the limits. The process first writes
the topics, then, for each line of its standard input, messages. An answer is a ``HEADER`` and its
content. An error of the bag is one line on standard error.
"""

from enum import IntEnum
from importlib import import_module
from itertools import islice
import json
import os
from pathlib import Path
import struct
import sys
from typing import Any, BinaryIO

from ocp_ros.util.guarded_process import allow_seconds, confine, limit

CLOUD, POSES = 'sensor_msgs/msg/PointCloud2', 'geometry_msgs/msg/PoseArray'
IMAGE, PNG_IMAGE = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
TRANSFORMS = 'tf2_msgs/msg/TFMessage'
#: The message types that are read, by their names in bags; old bags use another name for
#: transforms, with the same layout.
KINDS = {**{kind: kind for kind in (CLOUD, IMAGE, PNG_IMAGE, CAMERA_INFO, POSES, TRANSFORMS)},
         'tf/msg/tfMessage': TRANSFORMS}
#: Bytes of the largest message: a cloud of five million points is smaller.
MAX_MESSAGE_BYTES = 200_000_000
#: Header of an answer: its kind, the number of the topic, the time of recording (nanoseconds) and
#: the number of bytes of its content.
HEADER = struct.Struct('<BIqQ')


class Answer(IntEnum):
    """Kinds of answers."""

    TOPICS = 0
    MESSAGE = 1
    BROKEN = 2
    END = 3


def refuse_unsafe_schema(path: Path) -> None:
    """
    Refuse an SQLite file that can run code when it is read.

    Views, triggers, computed columns and virtual tables can do that. Only indices and the plain
    tables of a bag are allowed.

    :raises ValueError: if the file has such an entry.
    """
    import apsw
    database = apsw.Connection(f'file:{path}?immutable=1',
                               flags=apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI)
    # All tables of a ROS 2 bag in SQLite, including those that SQLite itself makes.
    tables = {'schema', 'metadata', 'topics', 'messages', 'message_definitions', 'sqlite_sequence',
              'sqlite_stat1', 'sqlite_stat4'}
    for kind, name, sql in list(database.execute('SELECT type, name, sql FROM sqlite_master')):
        # Virtual tables begin with CREATE VIRTUAL TABLE; 13 characters show the difference.
        is_plain = kind == 'index' or (kind == 'table' and name in tables and
                                       sql.lstrip()[:13].upper().startswith('CREATE TABLE'))
        # The last value of a row of table_xinfo is not 0 if the column is computed or hidden.
        if not is_plain or (kind == 'table' and any(
                column[-1] for column in database.execute(f'PRAGMA table_xinfo("{name}")'))):
            raise ValueError(f'{path.name} has the {kind} {name[:60]!r}, which is none of a bag')
    database.close()


def open_reader(path: Path, is_ros1: bool) -> Any:
    """
    Open a bag.

    :param path: file (ROS 1) or folder (ROS 2) of the bag.
    :returns: the open reader of rosbags.
    """
    if is_ros1:
        from rosbags.rosbag1 import Reader as Reader1
        reader: Any = Reader1(path)
    else:
        from rosbags.rosbag2.reader import DirectoryReader, Reader
        from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

        class CheckedReader(Sqlite3Reader):
            """A reader that checks the schema of the file first."""

            def open(self) -> None:  # noqa: A003
                """Check the schema, then open the file."""
                refuse_unsafe_schema(self.path)
                super().open()

        # rosbags takes the reader of SQLite files from this dictionary.
        DirectoryReader.STORAGE_PLUGINS = {**DirectoryReader.STORAGE_PLUGINS,
                                           'sqlite3': CheckedReader}
        reader = Reader(path)
    reader.open()
    return reader


class AnswerWriter:
    """
    Write answers to requests for the content of a bag.

    :param reader: open reader of rosbags.
    :param is_ros1: whether the bag is of ROS 1.
    :param out: stream to which answers are written.
    """

    def __init__(self, reader: Any, is_ros1: bool, out: BinaryIO) -> None:
        from rosbags.typesys import get_typestore, Stores
        self._reader = reader
        self._is_ros1 = is_ros1
        self._out = out
        self._type_store = get_typestore(Stores.ROS2_JAZZY)
        self._names = sorted(reader.topics)

    def _write_answer(self, kind: Answer, topic: int = 0, time: int = 0, content: bytes = b''
                      ) -> None:
        """Write the header and the content of an answer."""
        self._out.write(HEADER.pack(kind, topic, time, len(content)))
        self._out.write(content)

    def write_topics(self) -> None:
        """Write the topics, and the start and the end of the recording."""
        reader = self._reader
        self._write_answer(Answer.TOPICS, content=json.dumps({
            'topics': [(name, reader.topics[name].msgtype or 'several types',
                        reader.topics[name].msgcount) for name in self._names],
            'start': reader.start_time, 'end': reader.end_time}).encode())
        self._out.flush()

    def write_messages(self, names: list[str], start: int | None, stop: int | None,
                       max_messages: int | None) -> None:
        """
        Write the messages of some topics in the order of recording.

        :param names: names of the topics.
        :param start: earliest time of recording, nanoseconds; None for the beginning.
        :param stop: time of recording, nanoseconds, at which to stop, itself excluded; None for
            the end.
        :param max_messages: largest number of messages; None for all.
        """
        connections = [connection for connection in self._reader.connections
                       if connection.topic in names and connection.msgtype in KINDS]
        # Without connections the reader would read the messages of all topics.
        recorded = self._reader.messages(connections, start, stop) if connections else ()
        for connection, time, raw in islice(recorded, max_messages):
            topic = self._names.index(connection.topic)
            kind = KINDS[connection.msgtype]
            try:
                if self._is_ros1:
                    check_element_count(raw, kind)
                    raw = self._type_store.ros1_to_cdr(raw, kind)
                if len(raw) > MAX_MESSAGE_BYTES:
                    raise ValueError(f'{len(raw):,} bytes, more than {MAX_MESSAGE_BYTES:,}')
            except Exception as error:
                self._write_answer(Answer.BROKEN, topic, time,
                                   str(error).encode(errors='replace'))
            else:
                self._write_answer(Answer.MESSAGE, topic, time, raw)
        self._write_answer(Answer.END)
        self._out.flush()


def check_element_count(raw: bytes, kind: str) -> None:
    """
    Refuse a ROS 1 message that states more list elements than its bytes can hold.

    The library would read such a message for hours. It refuses by itself lists of numbers that
    are too long: images and CameraInfo have no others.

    :param raw: the serialised message.
    :param kind: its type, one of the values of ``KINDS``.
    :raises ValueError: if the number is too large.
    """
    if kind in (IMAGE, PNG_IMAGE, CAMERA_INFO):
        return
    count_offset = 0
    if kind != TRANSFORMS:
        # The header has a number (4 bytes), a stamp (8), and the frame: the length of the text (4)
        # and the text. In a cloud, height and width (4 each) follow.
        frame_length, = struct.unpack_from('<I', raw, 12)
        count_offset = 16 + frame_length + (8 if kind == CLOUD else 0)
    count, = struct.unpack_from('<I', raw, count_offset)
    # The least size of an element: a field of a cloud, a pose or a transform, with empty texts.
    min_element_bytes = {CLOUD: 13, POSES: 56, TRANSFORMS: 76}
    if count * min_element_bytes[kind] > len(raw):
        raise ValueError(f'{count:,} parts in {len(raw):,} bytes')


def main(arguments: list[str]) -> int:
    """
    Answer requests for the content of a bag, one for each line of standard input.

    :param arguments: three limits (bytes of memory; processor seconds of all cores for an answer;
        bytes of a written file); ``1`` or ``2`` for the version of ROS; a folder to write to; the
        bag; and the files of the bag that may be read.
    :returns: the exit code: 1 if the bag cannot be read.
    """
    memory_bytes, seconds, written_bytes = map(int, arguments[:3])
    limit(memory_bytes, seconds, written_bytes)
    version, folder, bag, *files = arguments[3:]
    with os.fdopen(os.dup(1), 'wb') as out:
        # Output that libraries print must not get into the answers: it goes to standard error.
        os.dup2(2, 1)
        try:
            # Imported before the process gives up its access to files.
            packages = ('apsw', 'numpy', 'rosbags.rosbag1', 'rosbags.rosbag2',
                        'rosbags.serde.cdr', 'rosbags.serde.primitives', 'rosbags.serde.ros1',
                        'rosbags.serde.utils', 'rosbags.typesys.stores.ros2_jazzy')
            for package in packages:
                import_module(package)
            confine(files, folder)
            is_ros1 = version == '1'
            writer = AnswerWriter(open_reader(Path(bag), is_ros1), is_ros1, out)
            writer.write_topics()
            for line in sys.stdin:
                allow_seconds(seconds)
                writer.write_messages(*json.loads(line))
        except MemoryError:
            print('more memory than a bag needs', file=sys.stderr)
            return 1
        except BrokenPipeError:
            # The process that asked has ended.
            return 1
        except Exception as error:
            print(' '.join(str(error).split()) or type(error).__name__, file=sys.stderr)
            return 1
    return 0
