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

"""Messages to arrays and back; messages that lie are refused, and nodes outlive them."""

from array import array
from functools import partial

from benchmarks.drills.fuzz import (
    BATCH,
    Fuzzer,
    FuzzError,
    known_lies,
    LiveTarget,
    PolicyTarget,
    shell,
    SimTarget,
    spoilt_cloud,
    spoilt_fields,
    spoilt_poses,
    TrainerTarget,
)
from builtin_interfaces.msg import Time
from conftest import counted, random_checkpoint, SMALL
from geometry_msgs.msg import Pose, PoseArray, Quaternion
from hypothesis import given
from hypothesis import settings as budget
from hypothesis import strategies as st
import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import (
    bytes_to_msg,
    cloud_to_msg,
    fields_to_msg,
    MessageError,
    msg_to_bytes,
    msg_to_cloud,
    msg_to_fields,
    msg_to_poses,
    msg_to_positions,
    ns_to_stamp,
    positions_to_msg,
    RawMessage,
    shortened,
    stamp_to_ns,
)
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.ros.sim_node import SimNode
from ocp_ros.ros.trainer_node import TrainerNode
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Float64MultiArray, Header, MultiArrayDimension, UInt8MultiArray

DATATYPES = {'f4': PointField.FLOAT32, 'f8': PointField.FLOAT64, 'u1': PointField.UINT8,
             'u2': PointField.UINT16, 'u4': PointField.UINT32}


def packed(points, layout, step, shape, order='<', pad=0):
    """Return a cloud of points (N, 3) in rows and columns, its fields at some offsets."""
    raw = np.random.default_rng(0).integers(
        0, 256, (shape[0], step * shape[1] + pad), dtype=np.uint8)
    for k, name in enumerate('xyz' if len(points) else ''):
        kind, offset = layout[name]
        np.ndarray(shape, order + kind, raw, offset, (raw.shape[1], step))[...] = (
            points[:, k].reshape(shape))
    message = PointCloud2(
        height=shape[0], width=shape[1], point_step=step, row_step=raw.shape[1],
        is_bigendian=order == '>', is_dense=False,
        fields=[PointField(name=name, offset=offset, datatype=DATATYPES[kind], count=1)
                for name, (kind, offset) in layout.items()])
    message.data = array('B', raw.tobytes())
    return message


@st.composite
def layouts(draw):
    """Draw a cloud, and the same cloud packed in some layout."""
    shape, pad = (draw(st.integers(0, 4)), draw(st.integers(0, 9))), draw(st.integers(0, 13))
    rng = np.random.default_rng(draw(st.integers(0, 2 ** 32 - 1)))
    points = rng.normal(size=(shape[0] * shape[1], 3)).astype(np.float32)
    points[rng.random(len(points)) < draw(st.floats(0.0, 0.6))] = np.nan
    kind, layout, at = draw(st.sampled_from(['f4', 'f8'])), {}, 0
    for name in draw(st.permutations('xyz')):
        at += draw(st.integers(0, 9))
        layout[name] = kind, at
        at += int(kind[1])
    message = packed(points, layout, at + draw(st.integers(0, 9)), shape,
                     draw(st.sampled_from('<>')), pad)
    if not pad:
        # Drivers are known to send 0, or the size of the whole cloud.
        message.row_step = draw(st.sampled_from([message.row_step, 0, len(message.data), 3]))
    return points, message


@given(layout=layouts())
@budget(max_examples=80, deadline=None)
def test_a_cloud_of_any_layout_is_read(layout):
    points, message = layout
    found = msg_to_cloud(message)
    assert (found.dtype, found.shape[1:]) == (np.float32, (3,))
    np.testing.assert_array_equal(found, points[np.isfinite(points).all(axis=1)])


XYZ = {'x': ('f4', 0), 'y': ('f4', 4), 'z': ('f4', 8)}
#: What drivers document: fields with type and offset, point_step, rows and columns.
DRIVERS = {
    'RealSense': ({**XYZ, 'rgb': ('f4', 16)}, 20, 48, 64),
    'Azure Kinect': ({**XYZ, 'rgb': ('f4', 16)}, 32, 60, 80),
    'Ouster': ({**XYZ, 'intensity': ('f4', 16), 't': ('u4', 20), 'reflectivity': ('u2', 24),
                'ring': ('u2', 26), 'ambient': ('u2', 28), 'range': ('u4', 32)}, 48, 16, 64),
    'Livox': ({**XYZ, 'intensity': ('f4', 12), 'tag': ('u1', 16), 'line': ('u1', 17),
               'timestamp': ('f8', 18)}, 26, 1, 777),
    'float64': ({'x': ('f8', 0), 'y': ('f8', 8), 'z': ('f8', 16)}, 24, 1, 100),
}


def of_driver(driver, order='<', pad=0, rows=None):
    """Return the points that a driver sends with its "no return" among them, and the message."""
    layout, step, height, width = DRIVERS[driver]
    shape = rows or height, width
    points = np.random.default_rng(0).normal(size=(np.prod(shape), 3)).astype(np.float32)
    points[::7], points[3::11, 2], points[5::13] = np.nan, np.inf, 0.0
    message = packed(points, layout, step, shape, order, pad)
    return points[np.isfinite(points).all(axis=1)], message


@pytest.mark.parametrize('driver', DRIVERS)
@pytest.mark.parametrize(('order', 'pad'), [('<', 0), ('>', 0), ('<', 40)])
def test_clouds_of_known_drivers_are_read(driver, order, pad):
    points, message = of_driver(driver, order, pad)
    np.testing.assert_array_equal(msg_to_cloud(message), points)


def test_what_is_known_to_kill_others_is_refused(room):
    for good in (of_driver('Azure Kinect')[1], cloud_to_msg(room.points, Header())):
        for cloud in known_lies(good):
            with pytest.raises(MessageError, match='cloud: found .*; expected'):
                msg_to_cloud(cloud)


def test_what_is_sent_comes_back():
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    message = positions_to_msg(points, Header(stamp=ns_to_stamp(1_795_000_000_123_456_789)))
    np.testing.assert_array_equal(msg_to_positions(message, 50), points)
    assert stamp_to_ns(message.header.stamp) == 1_795_000_000_123_456_789
    assert message.header.stamp == Time(sec=1_795_000_000, nanosec=123_456_789)
    assert all(pose.orientation.w == 1.0 for pose in message.poses)
    for sent in (points, points[:0]):
        np.testing.assert_array_equal(msg_to_cloud(cloud_to_msg(sent, Header())), sent)
    assert msg_to_bytes(bytes_to_msg(bytes(range(256)))) == bytes(range(256))
    assert msg_to_fields(fields_to_msg({'a': 1.5, 'b': -2.0}), ('a', 'b')) == {'a': 1.5, 'b': -2.0}


@pytest.mark.parametrize(('read', 'poses', 'words'), [
    *((msg_to_poses, [Pose(), Pose(orientation=Quaternion(x=x, w=w))], 'camera 1')
      for x, w in ((0.0, 0.0), (0.0, np.nan), (np.inf, 1.0), (1e-9, 0.0))),
    *((read, [Pose()] * count, f'{count} cameras')
      for read in (msg_to_poses, msg_to_positions) for count in (0, 65))])
def test_poses_that_are_none_and_numbers_out_of_bounds_are_refused(read, poses, words):
    with pytest.raises(MessageError, match=words):
        read(PoseArray(poses=poses))


def test_a_float64_that_no_float32_can_hold_is_no_point():
    points, message = of_driver('float64')
    # The first two points that are some: one too far, and one of a NaN that signals.
    message.data[24:32] = array('B', np.float64(1e300).tobytes())
    message.data[48:56] = array('B', b'\x01\x00\x00\x00\x00\x00\xf0\x7f')
    np.testing.assert_array_equal(msg_to_cloud(message), points[2:])


def read_cloud(message):
    """Return a cloud, which is no larger than its message."""
    found = msg_to_cloud(message)
    assert found.nbytes <= 3 * len(message.data) + 12
    return found


@pytest.mark.parametrize(('spoil', 'read'), [
    (partial(spoilt_cloud, messages=[of_driver(driver, order, rows=1)[1]
                                     for driver in DRIVERS for order in '<>']), read_cloud),
    (spoilt_poses, lambda message: np.hstack([part for pose in msg_to_poses(message)
                                              for part in (pose.position, *pose.rotation)])),
    (spoilt_poses, msg_to_positions),
    (spoilt_fields, lambda message: [msg_to_fields(message, ('a', 'b'))[name] for name in 'ab'])],
    ids=['clouds', 'poses', 'positions', 'fields'])
def test_spoilt_messages_are_refused_or_read_and_nothing_else(spoil, read):
    rng = np.random.default_rng(20261121)
    refused = readable = 0
    for _ in range(600):
        message = spoil(rng)
        try:
            assert np.isfinite(read(message)).all()
            readable += 1
        except MessageError as error:
            assert '; expected' in str(error)
            refused += 1
    assert min(refused, readable) > 20


def test_headings_come_back_as_rotations():
    headings = np.random.default_rng(0).uniform(-1.5, 1.5, (4, 3))
    message = positions_to_msg(np.zeros((4, 3)), Header(), headings)
    # Who sends quaternions rounds them.
    message.poses[1].orientation.w *= 1.001
    for pose, heading in zip(msg_to_poses(message, 4), headings, strict=True):
        np.testing.assert_allclose(pose.rotation, rotation_matrix(*heading), atol=2e-3)


@pytest.mark.parametrize(('labels', 'numbers', 'names', 'words'), [
    ('a,b', [1.5, -2.0], 'c', 'as c'), ('a', [np.nan], 'a', 'nan as a'),
    (None, [1.0], '', '0 labels'), ('a,b', [1.0], '', '2 labels')])
def test_named_numbers_that_lie_are_refused(labels, numbers, names, words):
    message = Float64MultiArray(data=numbers)
    if labels:
        message.layout.dim = [MultiArrayDimension(label=labels)]
    with pytest.raises(MessageError, match=words):
        msg_to_fields(message, tuple(names))


def test_an_error_quotes_no_more_of_a_message_than_a_log_can_take():
    cloud = PointCloud2(fields=[PointField(name='x' * 1_000_000)])
    with pytest.raises(MessageError) as caught:
        msg_to_cloud(cloud)
    assert len(shortened(caught.value)) < 700
    assert shortened(MessageError('cloud: found nothing')) == 'cloud: found nothing'


@pytest.fixture
def fuzzer(graph, probe, small_agent):
    """Return what sends lies; the weights are random."""
    weights = random_checkpoint(small_agent, updates=5, run='a')
    return Fuzzer(probe.node, lambda predicate, what: graph.until(predicate), 0, weights)


@pytest.fixture
def policy(graph, fuzzer, tmp_path):
    """Return a policy of these weights."""
    fuzzer.weights.save(tmp_path / 'm.safetensors')
    return graph.add(partial(PolicyNode, namespace='turns'), planner='learned', turns=100000,
                     follow_trainer=True,
                     model=str(tmp_path / 'm.safetensors'))


def test_a_policy_and_its_trainer_outlive_lies(graph, fuzzer, policy, tmp_path):
    trainer = graph.add(partial(TrainerNode, namespace='turns'), folder=str(tmp_path / 'run'))
    target = PolicyTarget(fuzzer, '/turns')
    for number in range(12):
        target.batch(again=number % 3 > 0)
    assert fuzzer.sent == 12 * (3 * BATCH + 1) and fuzzer.answered == 12
    assert counted(policy, 'refused_messages') > 12 * BATCH / 2
    assert counted(policy, 'weights_refused') > 6
    counts = trainer.sources['/turns'].counts
    assert counts['refused'] > 12 * BATCH / 2 and counts['transitions'] == 0


def test_a_trainer_goes_on_learning_whatever_it_is_told(graph, fuzzer, tmp_path, small_agent):
    agent = {f'agent__{name}': value for name, value in vars(small_agent).items()}
    trainer = graph.add(partial(TrainerNode, namespace='learn'), folder=str(tmp_path / 'run'),
                        updates_per_turn=1.0, sac__learning_starts=4, sac__batch_size=8,
                        sac__buffer_size=100,
                        sac__device='cpu', **agent)
    target = TrainerTarget(fuzzer, '/learn')
    for _ in range(2):
        target.batch()
    assert trainer.sources['/learn'].counts['refused'] > 5
    graph.until(lambda: trainer.learner.updates >= 4)
    assert trainer.learner.failure is None


def test_live_cameras_outlive_lies(graph, fuzzer):
    policy = graph.add(partial(PolicyNode, namespace='live'), cloud_topics='a,b', turns=100000,
                       cloud_timeout=0.3, arrival_timeout=0.5)
    target = LiveTarget(fuzzer, '/live', ['a', 'b'])
    for _ in range(4):
        target.batch()
    assert fuzzer.answered == 4 and counted(policy, 'turns_answered') >= 4


def test_a_simulation_outlives_lies(graph, fuzzer):
    sim = graph.add(partial(SimNode, namespace='sim'), **SMALL, rig__cameras=3,
                    auto_reset=True)
    target = SimTarget(fuzzer, '/sim')
    for _ in range(12):
        target.batch()
    assert fuzzer.answered == 12 and counted(sim, 'refused_commands') > 4


def test_a_cloud_of_a_million_points_is_answered(fuzzer, policy, probe):
    # Experiences have a subscriber, but there is no trainer.
    probe.listen(UInt8MultiArray, f'/turns/{topics.EXPERIENCE}', 10)
    points = shell(np.random.default_rng(0), 1_000_000)
    assert PolicyTarget(fuzzer, '/turns').ping(points) > 0.0


def test_a_command_out_of_bounds_is_noticed(fuzzer):
    # Who was outside may be so still, but no farther.
    box, outside = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]), np.array([[2.0, 0.5, 0.5]])
    fuzzer.check(np.array([[0.5, 1.0, 9.0]]), box, 'command')
    fuzzer.check(np.array([[1.5, 0.5, 0.5]]), box, 'command', outside)
    for wrong, before in (([0.5, 1.1, 0.5], None), ([np.nan, 0.5, 0.5], None),
                          ([-0.1, 0.5, 0.5], None), ([2.1, 0.5, 0.5], outside)):
        with pytest.raises(FuzzError, match='command: found'):
            fuzzer.check(np.array([wrong]), box, 'command', before)


def test_a_cloud_as_it_was_received_has_a_stamp_and_is_read_later():
    cloud = cloud_to_msg(np.eye(3, dtype=np.float32), Header(
        stamp=Time(sec=12, nanosec=345), frame_id='map'))
    raw = RawMessage.of(PointCloud2, serialize_message(cloud))
    assert raw.stamp == 12_000_000_345 and raw.message() == cloud
    with pytest.raises(MessageError, match='3 bytes'):
        RawMessage.of(PointCloud2, raw.data[:3])
    with pytest.raises(MessageError, match='cannot be read'):
        RawMessage.of(PointCloud2, raw.data[:20]).message()
