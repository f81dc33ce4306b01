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

#: Width of an image and the largest half width of a drawn point, pixels.
WIDTH, WIDEST = 256, 10
#: Half the edge of the square that is drawn for a point, in multiples of its pitch.
HALF = 0.6
#: Colours of depths from near to far, of equal steps of lightness for any colour vision, and of
#: pixels without depth.
COLOURS = np.array([(255, 234, 70), (188, 175, 111), (125, 124, 120), (67, 78, 108), (0, 32, 76)])
NOTHING = np.array([235, 235, 235], dtype=np.uint8)


def depth_image(points: np.ndarray, pitch: np.ndarray, pose: np.ndarray, model: CameraModel
                ) -> np.ndarray:
    """
    Return the depth image of a camera; azimuth and elevation where it has no image plane.

    :param points: (N, 3) metres, map frame, that it sees.
    :param pitch: (N,) metres, edge of the square that each point stands for.
    :param pose: (6,) metres, map frame, and radians.
    :returns: (H, W) metres: along the optical axis, or the distance without an image plane; inf
        where there is no measurement.
    """
    lens = model.lens
    x, y, z = ((points - pose[:3]) @ rotation_matrix(*pose[3:])).T
    if lens.kind == PINHOLE:
        depth = np.maximum(x, 1e-6)
        across, up = y / depth / lens.half_horizontal, z / depth / lens.half_vertical
        aspect, wide = lens.half_vertical / lens.half_horizontal, lens.half_horizontal
    else:
        depth = np.maximum(np.sqrt(x * x + y * y + z * z), 1e-6)
        across, up = (np.arctan2(y, x) / (0.5 * model.horizontal_fov),
                      np.arctan2(z, np.hypot(x, y)) / (0.5 * model.vertical_fov))
        aspect, wide = model.vertical_fov / model.horizontal_fov, 0.5 * model.horizontal_fov
    height = max(int(WIDTH * aspect), 1)
    column = ((1.0 - across) * 0.5 * WIDTH).astype(int)
    row = ((1.0 - up) * 0.5 * height).astype(int)
    half = np.clip(HALF * pitch / depth / wide * 0.5 * WIDTH, 0, WIDEST).astype(int) + 1
    image = np.full((height, WIDTH), np.inf)
    for size in np.unique(half):
        some = half == size
        for down in range(-size + 1, size):
            for right in range(-size + 1, size):
                rows, columns = row[some] + down, column[some] + right
                inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < WIDTH)
                np.minimum.at(image, (rows[inside], columns[inside]), depth[some][inside])
    return image


def coloured(image: np.ndarray, model: CameraModel) -> np.ndarray:
    """Return a depth image as colours: (H, W, 3) uint8, from the least to the largest range."""
    share = (image - model.min_range) / (model.max_range - model.min_range)
    known = np.isfinite(image)
    steps = np.linspace(0.0, 1.0, len(COLOURS))
    picture = np.stack([np.interp(np.where(known, share, 0.0), steps, channel)
                        for channel in COLOURS.T], axis=-1).astype(np.uint8)
    picture[~known] = NOTHING
    return picture
