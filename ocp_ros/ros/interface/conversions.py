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

"""Messages to arrays and back, as plain functions; malformed messages raise a MessageError."""

from array import array
from collections.abc import Mapping
import math
import struct
from typing import Any, NamedTuple

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseArray, Quaternion
import numpy as np
from ocp_ros.geometry.cameras import Pose as CameraPose
from ocp_ros.util.settings import MAX_CAMERAS
from rclpy.serialization import deserialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Float64MultiArray, Header, MultiArrayDimension, UInt8MultiArray

NS_PER_S = 1_000_000_000
#: NumPy types of the floats of a cloud, without their byte order.
NUMPY_TYPES = {PointField.FLOAT32: 'f4', PointField.FLOAT64: 'f8'}


class MessageError(ValueError):
    """A message that cannot be used; the text says what was found and what was expected."""


def shortened(error: Exception | str) -> str:
    """Return the text of an error, cut to 600 characters: names that it quotes may be longer."""
    text, cut = str(error)[:600], str(error)[600:]
    return f'{text} ...' if cut else text


def stamp_to_ns(stamp: Time) -> int:
    """Return a stamp as nanoseconds."""
    return stamp.sec * NS_PER_S + stamp.nanosec


def ns_to_stamp(nanoseconds: int) -> Time:
    """Return nanoseconds as a stamp."""
    return Time(sec=nanoseconds // NS_PER_S, nanosec=nanoseconds % NS_PER_S)


def ns_of(fields: Mapping[str, float], name: str) -> int:
    """Return the stamp in the fields ``<name>_sec`` and ``<name>_nanosec``, nanoseconds."""
    return int(fields[f'{name}_sec']) * NS_PER_S + int(fields[f'{name}_nanosec'])


def cloud_to_msg(points: np.ndarray, header: Header) -> PointCloud2:
    """
    Pack the points of a cloud as x, y, z of float32.

    :param points: (N, 3), metres, in the header's frame.
    """
    points = np.ascontiguousarray(points, dtype='<f4')
    message = PointCloud2(
        header=header, height=1, width=len(points), point_step=12, row_step=points.nbytes,
        is_bigendian=False, is_dense=True,
        fields=[PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1)
                for k, name in enumerate('xyz')])
    # The setter of rclpy takes an array of type 'B' without checking each byte.
    message.data = array('B', points.tobytes())
    return message


def value_cloud(points: np.ndarray, name: str, values: np.ndarray, header: Header) -> PointCloud2:
    """
    Pack the points of a cloud, with a number for each.

    :param points: (N, 3), metres, in the header's frame.
    :param name: name of the field of the numbers.
    :param values: (N,) float32 or uint32, the numbers.
    """
    datatype = PointField.UINT32 if values.dtype == np.uint32 else PointField.FLOAT32
    records = np.empty(len(points), dtype=[('xyz', '<f4', 3), ('value', values.dtype)])
    records['xyz'], records['value'] = points, values
    # An empty cloud gives the fields x, y and z; their size is the offset of the new field. The
    # sizes and the data are replaced below.
    message = cloud_to_msg(points[:0], header)
    message.width = len(records)
    message.fields = [*message.fields, PointField(name=name, offset=message.point_step,
                                                  datatype=datatype, count=1)]
    message.point_step = records.itemsize
    message.row_step = records.nbytes
    message.data = array('B', records.tobytes())
    return message


class RawMessage(NamedTuple):
    """
    A message as it was received, not deserialised: most clouds are replaced before they are used.

    :ivar message_type: type of the message, which begins with a header.
    :ivar stamp: of its header, nanoseconds.
    :ivar data: the message in CDR.
    """

    message_type: type
    stamp: int
    data: bytes

    @classmethod
    def of(cls, message_type: type, data: bytes) -> 'RawMessage':
        """
        Read the stamp, with which the header begins, after four bytes on the encoding.

        :raises MessageError: if the data are shorter.
        """
        if len(data) < 12:
            raise MessageError(f'cloud: found {len(data)} bytes; expected a message with a stamp')
        # An odd second byte stands for the order of bytes that begins with the lowest.
        order = '<' if data[1] & 1 else '>'
        seconds, nanoseconds = struct.unpack_from(f'{order}iI', data, 4)
        return cls(message_type, seconds * NS_PER_S + nanoseconds, data)

    def message(self) -> Any:
        """
        Deserialise the message.

        :raises MessageError: if it is not of its type.
        """
        try:
            return deserialize_message(self.data, self.message_type)
        except Exception as error:  # rclpy raises errors of several types.
            raise MessageError(f'cloud: found {len(self.data)} bytes that cannot be read '
                               f'({error}); expected a {self.message_type.__name__}') from error


def msg_to_cloud(message: PointCloud2) -> np.ndarray:
    """
    Unpack the positions of a cloud of any field layout.

    ``row_step`` (bytes of a row) is ignored if the data have exactly the bytes of the points: some
    drivers send 0, or the bytes of the whole cloud.

    :returns: (N, 3) float32, metres, in the message's frame; points without a finite position
        (no return) are left out.
    :raises MessageError: if x, y or z is missing, or the message states other sizes than its data
        have.
    """
    fields = [_float_field(message, name) for name in 'xyz']
    height, width, step, size = (
        message.height, message.width, message.point_step, len(message.data))
    is_unpadded = size == height * width * step
    row_step = width * step if is_unpadded else message.row_step
    if row_step < width * step or size != row_step * height:
        raise MessageError(f'cloud: found {size} bytes and row_step {row_step}; expected {height} '
                           f'rows of at least {width} x {step} bytes')
    if height * width == 0:
        return np.empty((0, 3), dtype=np.float32)
    points = np.empty((height, width, 3), dtype=np.float32)
    byte_order = '>' if message.is_bigendian else '<'
    # Values too large for float32 become inf, and their points are left out below. Each field is
    # read through a view of the data, with the bytes from row to row and from point to point.
    with np.errstate(over='ignore', invalid='ignore'):
        for k, field in enumerate(fields):
            points[..., k] = np.ndarray((height, width), byte_order + NUMPY_TYPES[field.datatype],
                                        memoryview(message.data), field.offset, (row_step, step))
    points = points.reshape(-1, 3)
    finite = np.isfinite(points).all(axis=1)
    return points if finite.all() else points[finite]


def _float_field(message: PointCloud2, name: str) -> PointField:
    """Return the field of a name; refuse it unless it is a single float within each point."""
    same_name = [field for field in message.fields if field.name == name]
    if len(same_name) != 1:
        names = [field.name for field in message.fields]
        raise MessageError(f'cloud: found the fields {names}; expected one each of x, y and z')
    field = same_name[0]
    if field.datatype not in NUMPY_TYPES or field.count > 1:
        raise MessageError(f'cloud: found field {name} of datatype {field.datatype} x '
                           f'{field.count}; expected one FLOAT32 or FLOAT64')
    if field.offset + np.dtype(NUMPY_TYPES[field.datatype]).itemsize > message.point_step:
        raise MessageError(f'cloud: found field {name} at offset {field.offset}; expected it '
                           f'within point_step {message.point_step}')
    return field


def positions_to_msg(positions: np.ndarray, header: Header,
                     headings: np.ndarray | None = None) -> PoseArray:
    """
    Pack camera positions and headings as poses.

    :param positions: (K, 3), metres, in the header's frame.
    :param headings: (K, 3) yaw, pitch and roll in radians; None: level cameras that look along x.
    """
    message = PoseArray(header=header, poses=[
        Pose(position=Point(x=float(x), y=float(y), z=float(z))) for x, y, z in positions])
    if headings is not None:
        for pose, heading in zip(message.poses, headings, strict=True):
            pose.orientation = quaternion_of(heading)
    return message


def move_poses(poses: PoseArray, positions: np.ndarray,
               new_headings: Mapping[int, np.ndarray] | None = None) -> PoseArray:
    """
    Pack the poses of cameras that move, and of which some rotate.

    :param poses: present poses of the K cameras.
    :param positions: new positions, (K, 3), metres, in the frame of ``poses``.
    :param new_headings: by camera number: new yaw, pitch and roll in radians, (3,); all other
        cameras keep their orientations.
    """
    message = positions_to_msg(positions, poses.header)
    for pose, present_pose in zip(message.poses, poses.poses, strict=True):
        pose.orientation = present_pose.orientation
    for camera, heading in (new_headings or {}).items():
        message.poses[camera].orientation = quaternion_of(heading)
    return message


def quaternion_of(heading: np.ndarray) -> Quaternion:
    """Pack a heading (3,) of yaw, pitch and roll in radians as a quaternion of length 1."""
    x, y, z, w = Rotation.from_euler('ZYX', heading).as_quat()
    return Quaternion(x=float(x), y=float(y), z=float(z), w=float(w))


def msg_to_positions(message: PoseArray, expected_count: int | None = None) -> np.ndarray:
    """
    Unpack camera positions.

    :param expected_count: expected number of cameras; None for any number that a rig may have.
    :returns: (K, 3) float64, metres, in the message's frame.
    :raises MessageError: if the number of cameras is not the expected one, or a coordinate is not
        finite or beyond 10,000 km.
    """
    count = len(message.poses)
    if not (1 <= count <= MAX_CAMERAS) or expected_count not in (None, count):
        expected = expected_count or f'at least 1, at most {MAX_CAMERAS}'
        raise MessageError(f'poses: found {count} cameras; expected {expected}')
    positions = np.array([[p.position.x, p.position.y, p.position.z] for p in message.poses])
    if not np.isfinite(positions).all():
        raise MessageError('poses: found NaN or inf; expected finite metres')
    # National survey coordinates are smaller.
    max_coordinate_m = 1e7
    if (max_found_m := np.abs(positions).max()) > max_coordinate_m:
        raise MessageError(f'poses: found a camera at {max_found_m:.3g} m; expected it within '
                           f'{max_coordinate_m:.0e} m of the origin')
    return positions


def msg_to_poses(message: PoseArray, expected_count: int | None = None) -> list[CameraPose]:
    """
    Unpack camera poses.

    :param expected_count: expected number of cameras; None for any number that a rig may have.
    :returns: a pose per camera, in the message's frame.
    :raises MessageError: as :func:`msg_to_positions` and :func:`rotation_of`.
    """
    positions = msg_to_positions(message, expected_count)
    return [CameraPose(position, rotation_of(pose.orientation, f'poses: camera {k}'))
            for k, (position, pose) in enumerate(zip(positions, message.poses, strict=True))]


def rotation_of(quaternion: Quaternion, owner: str) -> np.ndarray:
    """
    Convert a quaternion of any length to a rotation matrix.

    :param owner: what has this rotation, in words for the error.
    :returns: (3, 3) float64, from the body frame to the frame of the message.
    :raises MessageError: if the quaternion is zero or not finite.
    """
    xyzw = np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w])
    # A shorter quaternion counts as zero. A length of NaN fails the comparison too.
    if not 1e-6 < (length := math.hypot(*xyzw)) < np.inf:
        raise MessageError(f'{owner}: found the quaternion {xyzw.tolist()}; expected one of '
                           'length 1; send x, y, z, w = 0, 0, 0, 1 for a level camera along x')
    return Rotation.from_quat(xyzw / length).as_matrix()


def fields_to_msg(fields: Mapping[str, float]) -> Float64MultiArray:
    """Pack named numbers; the message lists the names in the label of its only dimension."""
    message = Float64MultiArray(data=[float(value) for value in fields.values()])
    message.layout.dim = [MultiArrayDimension(
        label=','.join(fields), size=len(fields), stride=len(fields))]
    return message


def msg_to_fields(message: Float64MultiArray, expected: tuple[str, ...]) -> dict[str, float]:
    """
    Unpack the named numbers of :func:`fields_to_msg`.

    :param expected: names of the fields that are required.
    :raises MessageError: if the numbers of labels and data differ, or an expected field is missing
        or not finite.
    """
    labels = message.layout.dim[0].label.split(',') if message.layout.dim else []
    if len(labels) != len(message.data):
        raise MessageError(f'reward: found {len(labels)} labels for {len(message.data)} numbers; '
                           'expected as many')
    fields = dict(zip(labels, message.data))
    for name in expected:
        if name not in fields or not np.isfinite(fields[name]):
            raise MessageError(f'reward: found {fields.get(name, "nothing")} as {name}; expected '
                               'a finite number')
    return fields


def bytes_to_msg(content: bytes) -> UInt8MultiArray:
    """Pack the bytes of a safetensors file."""
    message = UInt8MultiArray()
    size = len(content)
    message.layout.dim = [MultiArrayDimension(label='safetensors', size=size, stride=size)]
    message.data = array('B', content)
    return message


def msg_to_bytes(message: UInt8MultiArray) -> bytes:
    """Unpack the bytes of a safetensors file."""
    return bytes(message.data)
