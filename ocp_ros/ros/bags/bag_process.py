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

from collections.abc import Iterator
from importlib import import_module
from itertools import islice
import json
import os
from pathlib import Path
import struct
import sys
from typing import Any, BinaryIO

from ocp_ros.util.confinement import allow_seconds, confine, limit

CLOUD, POSES = 'sensor_msgs/msg/PointCloud2', 'geometry_msgs/msg/PoseArray'
TRANSFORMS = 'tf2_msgs/msg/TFMessage'
#: The types that are read; old bags use another type name for transforms, with the same layout.
KINDS = {CLOUD: CLOUD, POSES: POSES, TRANSFORMS: TRANSFORMS, 'tf/msg/tfMessage': TRANSFORMS}
#: Least number of bytes of one list element in ROS 1: field of a cloud, pose, transform.
MIN_ELEMENT_BYTES = {CLOUD: 13, POSES: 56, TRANSFORMS: 76}
#: Bytes of the largest message: a cloud of five million points is smaller.
MAX_MESSAGE_BYTES = 200_000_000
#: The kind of an answer, the number of its topic, its time of recording, bytes of its content.
HEADER = struct.Struct('<BIqQ')
TOPICS, MESSAGE, BROKEN, END = range(4)


def check_schema(path: Path) -> None:
    """
    Refuse an SQLite file with more than plain tables and indices: views can run code.

    Computed columns and those of modules can run code as well.

    :raises ValueError: if the file has such an entry.
    """
    import apsw
    database = apsw.Connection(f'file:{path}?immutable=1',
                               flags=apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI)
    # All tables of a ROS 2 bag in SQLite, including those that SQLite itself makes.
    tables = {'schema', 'metadata', 'topics', 'messages', 'message_definitions', 'sqlite_sequence',
              'sqlite_stat1', 'sqlite_stat4'}
    for kind, name, sql in list(database.execute('SELECT type, name, sql FROM sqlite_master')):
        plain = kind == 'index' or (kind == 'table' and name in tables and
                                    sql.lstrip()[:13].upper().startswith('CREATE TABLE'))
        # The last column is not 0 for columns that are computed or hidden.
        if not plain or kind == 'table' and any(
                column[-1] for column in database.execute(f'PRAGMA table_xinfo("{name}")')):
            raise ValueError(f'{path.name} has the {kind} {name[:60]!r}, which is none of a bag')
    database.close()


def open_reader(path: Path, is_ros1: bool) -> Any:
    """Open a bag."""
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
                check_schema(self.path)
                super().open()

        DirectoryReader.STORAGE_PLUGINS = {**DirectoryReader.STORAGE_PLUGINS,
                                           'sqlite3': CheckedReader}
        reader = Reader(path)
    reader.open()
    return reader


class Answers:
    """
    Answer requests for the content of a bag.

    :param reader: of rosbags, open.
    :param out: stream to which answers are written.
    """

    def __init__(self, reader: Any, is_ros1: bool, out: BinaryIO) -> None:
        from rosbags.typesys import get_typestore, Stores
        self._reader = reader
        self._is_ros1 = is_ros1
        self._out = out
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._names = sorted(reader.topics)

    def _answer(self, kind: int, topic: int = 0, time: int = 0, content: bytes = b'') -> None:
        """Write an answer."""
        self._out.write(HEADER.pack(kind, topic, time, len(content)))
        self._out.write(content)

    def topics(self) -> None:
        """Write the topics, and the start and the end of the recording."""
        reader = self._reader
        self._answer(TOPICS, content=json.dumps({
            'topics': [(name, reader.topics[name].msgtype or 'several types',
                        reader.topics[name].msgcount) for name in self._names],
            'start': reader.start_time, 'end': reader.end_time}).encode())
        self._out.flush()

    def messages(self, names: list[str], start: int | None, stop: int | None, most: int | None
                 ) -> None:
        """Write the messages of some topics, at most ``most`` messages."""
        connections = [one for one in self._reader.connections
                       if one.topic in names and one.msgtype in KINDS]
        found: Iterator = self._reader.messages(connections, start, stop) if connections else (
            iter(()))
        for connection, time, raw in islice(found, most):
            topic, kind = self._names.index(connection.topic), KINDS[connection.msgtype]
            try:
                if self._is_ros1:
                    check_count(raw, kind)
                    raw = self._store.ros1_to_cdr(raw, kind)
                if len(raw) > MAX_MESSAGE_BYTES:
                    raise ValueError(f'{len(raw):,} bytes, more than {MAX_MESSAGE_BYTES:,}')
            except Exception as error:
                self._answer(BROKEN, topic, time, str(error).encode(errors='replace'))
            else:
                self._answer(MESSAGE, topic, time, raw)
        self._answer(END)
        self._out.flush()


def check_count(raw: bytes, kind: str) -> None:
    """
    Refuse a ROS 1 message that states more list elements than its bytes can hold.

    The library would read it for hours.

    :raises ValueError: if the number is too large.
    """
    start = 0
    if kind != TRANSFORMS:
        length, = struct.unpack_from('<I', raw, 12)
        start = 16 + length + (8 if kind == CLOUD else 0)
    count, = struct.unpack_from('<I', raw, start)
    if count * MIN_ELEMENT_BYTES[kind] > len(raw):
        raise ValueError(f'{count:,} parts in {len(raw):,} bytes')


def main(arguments: list[str]) -> int:
    """
    Serve a bag.

    :param arguments: three limits (bytes of memory; processor seconds of all cores for an answer;
        bytes of a written file); ``1`` or ``2`` for the version of ROS; a folder to write to; the
        bag; and the files of the bag that may be read.
    :returns: the exit code: 1 if the bag cannot be read.
    """
    memory, seconds, written = map(int, arguments[:3])
    limit(memory, seconds, written)
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
            answers = Answers(open_reader(Path(bag), version == '1'), version == '1', out)
            answers.topics()
            for line in sys.stdin:
                allow_seconds(seconds)
                answers.messages(*json.loads(line))
        except MemoryError:
            print('more memory than a bag needs', file=sys.stderr)
            return 1
        except BrokenPipeError:
            return 1
        except Exception as error:
            print(' '.join(str(error).split()) or type(error).__name__, file=sys.stderr)
            return 1
    return 0
