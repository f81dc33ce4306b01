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

"""The depth image of a camera, drawn from the points that it sees."""

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, PINHOLE, rotation_matrix

#: Colour of pixels without depth.
NO_DEPTH_COLOUR = np.array([235, 235, 235], dtype=np.uint8)


def depth_image(points: np.ndarray, pitch: np.ndarray, pose: np.ndarray, model: CameraModel
                ) -> np.ndarray:
    """
    Return the depth image of a camera.

    A pinhole camera has an image plane. The image of any other camera has the azimuth as columns
    and the elevation as rows.

    :param points: (N, 3) points that the camera sees, metres, map frame.
    :param pitch: (N,) edge of the square that each point stands for, metres.
    :param pose: (6,) metres, map frame, and radians.
    :param model: of the camera.
    :returns: (H, W) metres: depth along the optical axis of a pinhole camera, distance from any
        other camera; inf where there is no measurement.
    """
    lens = model.lens
    x, y, z = ((points - pose[:3]) @ rotation_matrix(*pose[3:])).T
    # Positions in the image are from -1 to 1; left and up are positive. Half of the width and of
    # the height are tangents for a pinhole camera, and radians for any other camera.
    if lens.kind == PINHOLE:
        depth = np.maximum(x, 1e-6)
        half_width, half_height = lens.half_horizontal, lens.half_vertical
        horizontal, vertical = y / depth / half_width, z / depth / half_height
    else:
        depth = np.maximum(np.sqrt(x * x + y * y + z * z), 1e-6)
        half_width, half_height = 0.5 * model.horizontal_fov, 0.5 * model.vertical_fov
        horizontal = np.arctan2(y, x) / half_width
        vertical = np.arctan2(z, np.hypot(x, y)) / half_height
    width = 256
    height = max(int(width * (half_height / half_width)), 1)
    centre_row = ((1.0 - vertical) * 0.5 * height).astype(int)
    centre_column = ((1.0 - horizontal) * 0.5 * width).astype(int)
    # A square is drawn for each point: 1.2 times its pitch, and at most 21 pixels wide.
    half_edge = np.clip(0.6 * pitch / depth / half_width * 0.5 * width, 0, 10).astype(int)
    image = np.full((height, width), np.inf)
    # Points with squares of the same size are drawn together; in each pixel the nearest one stays.
    for half_pixels in np.unique(half_edge):
        chosen = half_edge == half_pixels
        for row_offset in range(-half_pixels, half_pixels + 1):
            for column_offset in range(-half_pixels, half_pixels + 1):
                rows = centre_row[chosen] + row_offset
                columns = centre_column[chosen] + column_offset
                inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
                np.minimum.at(image, (rows[inside], columns[inside]), depth[chosen][inside])
    return image


def depth_colours(image: np.ndarray, model: CameraModel) -> np.ndarray:
    """
    Return the colours of a depth image: (H, W, 3) uint8.

    :param image: (H, W) metres; inf where there is no measurement.
    :param model: of the camera; the colours range from its least to its largest range.
    """
    share = (image - model.min_range) / (model.max_range - model.min_range)
    measured = np.isfinite(image)
    # From near to far: equal steps of lightness, for any colour vision.
    steps = np.array(
        [(255, 234, 70), (188, 175, 111), (125, 124, 120), (67, 78, 108), (0, 32, 76)])
    colour_shares = np.linspace(0.0, 1.0, len(steps))
    colours = np.stack([np.interp(np.where(measured, share, 0.0), colour_shares, channel)
                        for channel in steps.T], axis=-1).astype(np.uint8)
    colours[~measured] = NO_DEPTH_COLOUR
    return colours
