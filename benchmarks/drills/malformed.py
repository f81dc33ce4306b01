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
Messages that lie, for tests: what broken drivers, other programs and torn networks send.

Most of them cannot be used. A few can, since not every lie matters.
"""

from array import array
from collections.abc import Sequence
from copy import deepcopy
import json
import struct

from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.policy.checkpoint import Checkpoint, METADATA_KEY
from ocp_ros.ros.interface.conversions import cloud_to_msg, fields_to_msg, positions_to_msg
from ocp_ros.training.experience import Choice
import safetensors.torch
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Float64MultiArray, Header

#: What numbers of a message are made to be.
NUMBERS = (0, 1, 3, 12, 255, 65536, 2 ** 31 - 1, 2 ** 31, 2 ** 32 - 1)
FLOATS = (0.0, -0.0, 1.0, np.nan, np.inf, -np.inf, 1e308, -3e38, 5e-324, -1e-7, 1e9)


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
