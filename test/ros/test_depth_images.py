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

"""Depth images give the points that their cameras see, whatever their encoding."""

from io import BytesIO
import struct
from zlib import crc32

from conftest import box_room, counted, header_at, HUNG, status
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.geometry.cameras import OPTICAL_TO_BODY, Pose
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import (
    MessageError,
    msg_to_cloud,
    positions_to_msg,
    RawMessage,
)
from ocp_ros.ros.interface.depth_images import read_points
from ocp_ros.ros.policy_node import PolicyNode
from PIL import Image as PngImage
import pytest
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

S = 1_000_000_000
WIDTH, HEIGHT = 80, 60
FX, FY, CX, CY = 50.0, 40.0, 39.0, 30.5
ROOM = np.array([6.0, 4.0, 2.8])
POSES = np.array([[2.0, 2.0, 1.9, 0.4, 0.1, 0.0], [4.0, 1.5, 1.9, -2.0, 0.3, 0.1]])


def camera_info(**changed):
    """Return what a driver says of its camera."""
    k = [FX, 0.0, CX, 0.0, FY, CY, 0.0, 0.0, 1.0]
    p = [FX, 0.0, CX, 0.0, 0.0, FY, CY, 0.0, 0.0, 0.0, 1.0, 0.0]
    return CameraInfo(**{'width': WIDTH, 'height': HEIGHT, 'k': k, 'p': p, **changed})


def seen_from(pose):
    """Return the depth image (H, W) of a box in metres, and its points (N, 3), optical frame."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(u - CX) / FX, (v - CY) / FY, np.ones(u.shape)], axis=-1)
    directions = rays @ (Pose.of(pose).rotation @ OPTICAL_TO_BODY).T
    walls = np.where(directions > 0.0, ROOM, 0.0)
    with np.errstate(divide='ignore'):
        depth = ((walls - pose[:3]) / directions).min(axis=2)
    depth[:5] = 0.0
    return depth, (rays * depth[..., None])[5:].reshape(-1, 3)


def raw_image(depth, encoding='16UC1', big=False, padding=0):
    """Return a message with a depth image."""
    pixels = (np.round(1000.0 * depth) if encoding == '16UC1' else depth).astype(
        '<>'[big] + {'16UC1': 'u2', '32FC1': 'f4'}[encoding])
    rows = [row.tobytes() + bytes(padding) for row in pixels]
    return Image(width=WIDTH, height=HEIGHT, encoding=encoding, is_bigendian=big,
                 step=len(rows[0]), data=b''.join(rows))


def png_image(depth, encoding='16UC1', kind='png', cut=None):
    """Return a message as compressed_depth_image_transport makes it."""
    # Its default parameters for floats: farthest depth 10 m, precision 100.
    a, b = 100.0 * 101.0, 1.0 - 100.0 * 101.0 / 10.0
    with np.errstate(divide='ignore'):
        pixels = np.round(1000.0 * depth) if encoding == '16UC1' else np.where(
            depth > 0.0, a / depth + b, 0.0)
    content = BytesIO()
    PngImage.fromarray(pixels.astype(np.uint16)).save(content, 'PNG')
    return CompressedImage(format=f'{encoding}; compressedDepth {kind}',
                           data=struct.pack('<iff', 0, a, b) + content.getvalue()[:cut])


def points_of(message, info):
    """Return the points of a message that was received."""
    message.header = header_at(S, 'lens')
    return read_points(RawMessage.of(type(message), serialize_message(message)), info)


@pytest.mark.parametrize(('make', 'within'), [
    (raw_image, 0.002), (lambda depth: raw_image(depth, '16UC1', big=True, padding=6), 0.002),
    (lambda depth: raw_image(np.where(depth, depth, np.nan), '32FC1'), 1e-5),
    (png_image, 0.002), (lambda depth: png_image(depth, '32FC1'), 0.01)])
@pytest.mark.parametrize('info', [camera_info(), camera_info(p=[0.0] * 12)])
def test_every_encoding_gives_the_points_and_no_return_gives_none(make, within, info):
    depth, expected = seen_from(POSES[0])
    points, frame = points_of(make(depth), info)
    assert frame == 'lens' and points.dtype == np.float32
    np.testing.assert_allclose(points, expected, atol=within)


#: The beginning of a PNG of 9000 x 9000 pixels.
HUGE = (b'\x89PNG\r\n\x1a\n' + struct.pack('>I4sIIBBBBB', 13, b'IHDR', 9000, 9000, 16, 0, 0, 0, 0)
        + struct.pack('>I', crc32(struct.pack('>4sIIBBBBB', b'IHDR', 9000, 9000, 16, 0, 0, 0, 0)))
        + struct.pack('>I4s', 0, b'IDAT'))
DEPTH = np.full((HEIGHT, WIDTH), 2.0)


@pytest.mark.parametrize(('message', 'info', 'words'), [
    (raw_image(DEPTH), None, 'no CameraInfo'),
    (raw_image(DEPTH), camera_info(k=[0.0] * 9, p=[0.0] * 12), 'focal length'),
    (raw_image(DEPTH), camera_info(width=WIDTH + 1), '80 x 60'),
    (png_image(DEPTH), camera_info(width=WIDTH + 1), '80 x 60'),
    (CompressedImage(format='16UC1; compressedDepth png', data=bytes(12) + HUGE),
     camera_info(width=9000, height=9000), '10,000,000'),
    (Image(width=WIDTH, height=HEIGHT, encoding='rgb8'), camera_info(), "'rgb8'"),
    (Image(width=WIDTH, height=HEIGHT, encoding='16UC1', step=160), camera_info(), '0 bytes'),
    (png_image(DEPTH, cut=100), camera_info(), 'whole'),
    (png_image(DEPTH, kind='rvl', cut=0), camera_info(), 'png'),
    (CompressedImage(format='jpeg'), camera_info(), "'jpeg'")])
def test_an_image_that_cannot_be_used_is_refused_with_what_was_found(message, info, words):
    with pytest.raises(MessageError, match=words):
        points_of(message, info)


@pytest.mark.usefixtures('quick_lookahead')
def test_live_cameras_may_send_depth_images_instead_of_clouds(graph, probe):
    probe.listen(PointCloud2, topics.OBSERVATION, qos.LOOP)
    poses = probe.node.create_publisher(PoseArray, topics.CAMERA_POSES, qos.LOOP)
    named = {'cam0/depth/image_rect_raw': Image, 'cam1/depth/image/compressedDepth':
             CompressedImage}
    publishers = [(probe.node.create_publisher(kind, topic, qos.SENSOR),
                   probe.node.create_publisher(CameraInfo, f'cam{k}/depth/camera_info', qos.LOOP),
                   (raw_image, png_image)[k](seen_from(POSES[k])[0]))
                  for k, (topic, kind) in enumerate(named.items())]
    policy = graph.add(PolicyNode, planner='lookahead', cloud_topics=list(named), max_range=8.0,
                       voxel_size=0.001, cloud_timeout=0.5)
    stamps = iter(range(1000 * S, 10_000 * S, S // 20))
    describes = []

    def send():
        header = header_at(next(stamps))
        poses.publish(positions_to_msg(POSES[:, :3], header, POSES[:, 3:]))
        for k, (images, infos, image) in enumerate(publishers):
            image.header, info = header_at(0, f'camera_{k}_optical'), camera_info()
            image.header.stamp = info.header.stamp = header.stamp
            if describes:
                infos.publish(info)
            images.publish(image)

    probe.node.create_timer(0.05, send)
    # What an image lacks is named.
    graph.until(lambda: '/cam1/depth/camera_info' in status(policy)[1])
    policy.set_parameters([Parameter('cloud_timeout', value=HUNG)])
    describes.append(True)
    points = msg_to_cloud(probe.last(topics.OBSERVATION))
    expected = np.concatenate([
        seen_from(row)[1] @ (Pose.of(row).rotation @ OPTICAL_TO_BODY).T + row[:3]
        for row in POSES])
    assert len(points) == len(expected)
    assert np.abs(np.sort(points, axis=0) - np.sort(expected, axis=0)).max() < 0.01
    assert (points > -0.01).all() and (points < box_room().size + 0.01).all()
    assert counted(policy, 'refused_messages') == 0
