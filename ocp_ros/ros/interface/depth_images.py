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

"""Clouds and depth images to points; images need a CameraInfo and have to be rectified."""

from collections.abc import Callable
from io import BytesIO
import struct
from typing import TYPE_CHECKING

import numpy as np
from ocp_ros.ros.interface.conversions import MessageError, msg_to_cloud, RawMessage
from ocp_ros.ros.interface.qos import POSES, SensorSubscription
from ocp_ros.ros.interface.topics import camera_info_of_image
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

if TYPE_CHECKING:
    from ocp_ros.ros.runtime.managed_node import ManagedNode

#: Types of messages that :func:`read_points` reads, by their names.
POINT_SOURCES = {'sensor_msgs/msg/PointCloud2': PointCloud2, 'sensor_msgs/msg/Image': Image,
                 'sensor_msgs/msg/CompressedImage': CompressedImage}
#: By the encoding of depth images: NumPy type of a pixel, and metres of its unit.
ENCODINGS = {'16UC1': ('u2', 0.001), 'mono16': ('u2', 0.001), '32FC1': ('f4', 1.0)}

#: Largest number of pixels: a few bytes of PNG may stand for more than the memory holds.
MAX_PIXELS = 10_000_000


class PointSubscription(SensorSubscription):
    """
    A subscription of clouds, or of depth images and their CameraInfo.

    :param node: gets the subscriptions.
    :param topic: full name of the topic.
    :param callback: is called with the type and the bytes of each message, not deserialised.
    :ivar info_topic: full name of the topic of the CameraInfo.
    """

    def __init__(self, node: 'ManagedNode', topic: str, callback: Callable[[type, bytes], None]
                 ) -> None:
        self.info_topic = camera_info_of_image(topic)
        self._info: CameraInfo | None = None
        self._info_subscription: Subscription | None = None
        super().__init__(node, POINT_SOURCES, topic, callback)

    def match(self) -> None:
        """Receive what is published, and the CameraInfo of images."""
        super().match()
        if self._has_images and self._info_subscription is None:
            self._info_subscription = self._node.create_subscription(
                CameraInfo, self.info_topic, self._on_info, POSES)

    def _on_info(self, info: CameraInfo) -> None:
        """Store the newest CameraInfo."""
        self._info = info

    @property
    def _has_images(self) -> bool:
        """Return whether images are received."""
        return self.message_type in (Image, CompressedImage)

    @property
    def lacks_info(self) -> bool:
        """Return whether images are received, and no CameraInfo has come yet."""
        return self._has_images and self._info is None

    def read(self, raw: RawMessage) -> tuple[np.ndarray, str]:
        """Read the points of a message of this topic, see :func:`read_points`."""
        return read_points(raw, self._info)


def read_points(raw: RawMessage, info: CameraInfo | None) -> tuple[np.ndarray, str]:
    """
    Read the points of a cloud or of a depth image.

    :param raw: a message of one of ``POINT_SOURCES``.
    :param info: CameraInfo of the camera, which depth images need.
    :returns: (N, 3) float32, metres, and the frame of the message; points without a finite
        position (no return) are left out.
    :raises MessageError: if the message cannot be used.
    """
    message = raw.message()
    frame = message.header.frame_id
    if isinstance(message, PointCloud2):
        return msg_to_cloud(message), frame
    if info is None:
        raise MessageError('depth image: found no CameraInfo yet; expected it on the topic '
                           'camera_info beside the image; let the driver publish it')
    read_depth = depth_of_image if isinstance(message, Image) else depth_of_png
    return points_of_depth(read_depth(message, (info.width, info.height)), info), frame


def points_of_depth(depth: np.ndarray, info: CameraInfo) -> np.ndarray:
    """
    Return the points of a depth image in the optical frame: z forward, x right, y down.

    :param depth: (H, W), depth along the optical axis, metres; 0, NaN or inf: no return.
    :returns: (N, 3) float32, metres.
    :raises MessageError: if the CameraInfo has no focal length.
    """
    # Cameras without a rectified image may have no projection matrix.
    matrix = np.reshape(info.p, (3, 4)) if info.p[0] else np.reshape(info.k, (3, 3))
    (fx, _, cx), (_, fy, cy) = matrix[:2, :3]
    if not (fx > 0.0 and fy > 0.0 and np.isfinite(matrix).all()):
        raise MessageError(f'camera_info: found the focal lengths {fx:g} and {fy:g}; expected '
                           'them in pixels; calibrate the camera')
    rows, columns = np.nonzero(np.isfinite(depth) & (depth > 0.0))
    z = depth[rows, columns]
    return np.column_stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z]).astype(np.float32)


def depth_of_image(image: Image, size: tuple[int, int]) -> np.ndarray:
    """
    Return the depth in a raw depth image.

    :param size: expected width and height, pixels.
    :returns: (H, W) float32, metres; 0 or NaN: no return.
    :raises MessageError: if the encoding or the sizes are wrong.
    """
    number, unit = _encoding(image.encoding)
    _check_size((image.width, image.height), size)
    pixel = np.dtype('<>'[image.is_bigendian > 0] + number)
    if image.step < image.width * pixel.itemsize or len(image.data) != image.step * image.height:
        raise MessageError(f'depth image: found {len(image.data)} bytes and step {image.step}; '
                           f'expected {image.height} rows of at least {image.width} x '
                           f'{pixel.itemsize} bytes')
    pixels = np.ndarray((image.height, image.width), pixel, memoryview(image.data), 0,
                        (image.step, pixel.itemsize))
    return pixels * np.float32(unit)


def depth_of_png(image: CompressedImage, size: tuple[int, int]) -> np.ndarray:
    """
    Return the depth in an image of compressed_depth_image_transport with PNG.

    :param size: expected width and height, pixels.
    :returns: (H, W) float32, metres; 0 or NaN: no return.
    :raises MessageError: if the format or the size is wrong, or the data are no PNG.
    """
    encoding, _, transport = image.format.partition(';')
    number, unit = _encoding(encoding.strip())
    # The PNG follows three numbers; two of them, the constants a and b, are for floats only.
    content = bytes(image.data)
    if 'compressedDepth' not in transport or content[12:16] != b'\x89PNG':
        raise MessageError(f'depth image: found the format {image.format!r}; expected '
                           'compressedDepth with PNG; set the parameter format of the driver to '
                           'png, or name the raw image')
    from PIL import Image as PngImage
    try:
        png = PngImage.open(BytesIO(content[12:]), formats=['PNG'])
        _check_size(png.size, size)
        pixels = np.asarray(png, dtype=np.float32)
    except MessageError:
        raise
    except Exception as error:  # Pillow raises errors of many types.
        raise MessageError(f'depth image: found a PNG that cannot be read ({error}); expected a '
                           'whole one') from error
    if not png.mode.startswith('I'):
        raise MessageError(f'depth image: found a PNG of mode {png.mode}; expected 16 bits of '
                           'grey; name a depth image')
    if number == 'u2':
        return pixels * np.float32(unit)
    a, b = struct.unpack_from('<ff', content, 4)
    with np.errstate(divide='ignore', invalid='ignore'):
        return np.where(pixels > 0.0, np.float32(a) / (pixels - np.float32(b)), np.float32(np.nan))


def _encoding(encoding: str) -> tuple[str, float]:
    """Return the NumPy type and the unit (metres) of an encoding."""
    if encoding not in ENCODINGS:
        raise MessageError(f'image: found the encoding {encoding[:40]!r}; expected a depth image '
                           f'with one of {", ".join(ENCODINGS)}; name its topic')
    return ENCODINGS[encoding]


def _check_size(found: tuple[int, int], expected: tuple[int, int]) -> None:
    """Refuse an image that is huge, or whose width and height are not those of the CameraInfo."""
    if found[0] * found[1] > MAX_PIXELS:
        raise MessageError(f'depth image: found {found[0]} x {found[1]} pixels; expected at most '
                           f'{MAX_PIXELS:,}; name the image of a depth camera')
    if tuple(found) != expected:
        raise MessageError(f'depth image: found {found[0]} x {found[1]} pixels; expected '
                           f'{expected[0]} x {expected[1]} as in its CameraInfo; name the image '
                           'that the CameraInfo describes')
