# SPDX-License-Identifier: Apache-2.0
"""Messages to arrays and back, for any layout of a cloud."""

from hypothesis import given
from hypothesis import settings as budget
from hypothesis import strategies as st
import numpy as np
import pytest

pytest.importorskip('rclpy', reason='messages need ROS 2 (rclpy)')

from builtin_interfaces.msg import Time
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Float64MultiArray, Header, MultiArrayDimension

from ocp_ros.nodes.conversions import (
    bytes_to_msg,
    cloud_to_msg,
    fields_to_msg,
    MessageError,
    msg_to_bytes,
    msg_to_cloud,
    msg_to_fields,
    msg_to_positions,
    ns_to_stamp,
    positions_to_msg,
    stamp_to_ns,
)


@st.composite
def layouts(draw):
    """Draw a cloud, and the same cloud packed in some layout."""
    height, width = draw(st.integers(1, 4)), draw(st.integers(0, 9))
    rng = np.random.default_rng(draw(st.integers(0, 2 ** 32 - 1)))
    points = rng.normal(size=(height * width, 3)).astype(np.float32)
    points[rng.random(len(points)) < draw(st.floats(0.0, 0.6))] = np.nan
    big, kind = draw(st.booleans()), draw(st.sampled_from(['f4', 'f8']))
    size = int(kind[1])
    gaps = [draw(st.integers(0, 9)) for _ in range(4)]
    names = draw(st.permutations('xyz'))
    offsets, at = {}, 0
    for name, gap in zip(names, gaps, strict=False):
        at += gap
        offsets[name] = at
        at += size
    step, pad = at + gaps[3], draw(st.integers(0, 13))
    row_step = step * width + pad
    raw = np.full((height, row_step), 0xAB, np.uint8)
    record = np.dtype({'names': list('xyz'), 'formats': [('>' if big else '<') + kind] * 3,
                       'offsets': [offsets[a] for a in 'xyz'], 'itemsize': step})
    grid = np.ndarray((height, width), record, raw, strides=(row_step, step)) if width else None
    for k, name in enumerate('xyz' if width else ''):
        grid[name] = points[:, k].reshape(height, width)
    datatype = PointField.FLOAT32 if size == 4 else PointField.FLOAT64
    message = PointCloud2(
        height=height, width=width, point_step=step, row_step=row_step, is_bigendian=big,
        fields=[PointField(name=n, offset=offsets[n], datatype=datatype, count=1) for n in names])
    message.data = raw.tobytes()
    return points, message


@given(layout=layouts())
@budget(max_examples=150, deadline=None)
def test_a_cloud_of_any_layout_is_read(layout):
    points, message = layout
    found = msg_to_cloud(message)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, points[np.isfinite(points).all(axis=1)])


@given(layout=layouts(), data=st.data())
@budget(max_examples=150, deadline=None)
def test_a_cloud_whose_numbers_lie_is_refused_or_read_and_never_more(layout, data):
    _, message = layout
    name = data.draw(st.sampled_from(['height', 'width', 'point_step', 'row_step']))
    setattr(message, name, data.draw(st.integers(0, 2 ** 32 - 1)))
    if data.draw(st.booleans()):
        message.fields[0].offset = data.draw(st.integers(0, 2 ** 32 - 1))
    try:
        found = msg_to_cloud(message)
    except MessageError as error:
        assert 'found' in str(error) and 'expected' in str(error)
    else:
        assert found.nbytes <= 3 * len(message.data) + 12


@given(count=st.integers(0, 50), seed=st.integers(0, 99))
@budget(max_examples=20, deadline=None)
def test_a_cloud_comes_back(count, seed):
    points = np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)
    np.testing.assert_array_equal(msg_to_cloud(cloud_to_msg(points, Header())), points)


def test_positions_and_stamps_come_back():
    positions = np.random.default_rng(0).normal(size=(4, 3))
    message = positions_to_msg(positions, Header(stamp=ns_to_stamp(1_795_000_000_123_456_789)))
    np.testing.assert_array_equal(msg_to_positions(message, 4), positions)
    assert stamp_to_ns(message.header.stamp) == 1_795_000_000_123_456_789
    assert message.header.stamp == Time(sec=1_795_000_000, nanosec=123_456_789)
    assert all(pose.orientation.w == 1.0 for pose in message.poses)


def test_named_numbers_come_back_and_lies_are_refused():
    message = fields_to_msg({'a': 1.5, 'b': -2.0})
    assert msg_to_fields(message, ('a', 'b')) == {'a': 1.5, 'b': -2.0}
    with pytest.raises(MessageError, match='found nothing as c'):
        msg_to_fields(message, ('c',))
    with pytest.raises(MessageError, match='found nan as a'):
        msg_to_fields(fields_to_msg({'a': float('nan')}), ('a',))
    short = Float64MultiArray(data=[1.0])
    with pytest.raises(MessageError, match='found 0 labels for 1 numbers'):
        msg_to_fields(short, ())
    short.layout.dim = [MultiArrayDimension(label='a,b')]
    with pytest.raises(MessageError, match='found 2 labels for 1 numbers'):
        msg_to_fields(short, ())


def test_blobs_come_back():
    assert msg_to_bytes(bytes_to_msg(bytes(range(256)))) == bytes(range(256))
