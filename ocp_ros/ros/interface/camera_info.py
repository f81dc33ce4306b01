# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What image tools need to know of the cameras of a rig."""

from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

from ocp_ros.geometry.cameras import CameraModel, PINHOLE


def camera_info(model: CameraModel, header: Header) -> CameraInfo | None:
    """
    Describe a camera without distortion whose axis is in the middle of its image.

    :param header: its frame is that of the camera, z forward, x right, y down.
    :returns: None for a camera without an image plane or of unknown resolution.
    """
    if model.lens.kind != PINHOLE or model.resolution is None:
        return None
    width, height = model.resolution
    fx = 0.5 * width / float(model.lens.half_horizontal)
    fy = 0.5 * height / float(model.lens.half_vertical)
    cx, cy = 0.5 * (width - 1), 0.5 * (height - 1)
    return CameraInfo(
        header=header, width=width, height=height, distortion_model='plumb_bob', d=[0.0] * 5,
        k=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0])
