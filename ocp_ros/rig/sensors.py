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
Depth sensors on the market, as camera models.

Each number is the manufacturer's, with its source. The range is the ideal range if a data sheet
gives one: beyond the ideal range, a sensor still measures, but less accurately. A field of view is
the nominal one, without tolerance.
"""

from dataclasses import dataclass

import numpy as np
from ocp_ros.geometry.cameras import CameraModel

MICROSOFT = ('Microsoft, Azure Kinect DK hardware specifications, depth camera supported '
             'operating modes')
ORBBEC = 'Orbbec, Femto Bolt hardware specifications, depth camera supported operating modes'
REALSENSE = 'Intel, RealSense product family D400 series datasheet 337029 and product page'


@dataclass(frozen=True)
class Sensor:
    """
    A depth sensor.

    :ivar title: maker, product and mode.
    :ivar model: the camera model.
    :ivar source: the source of the numbers.
    """

    title: str
    model: CameraModel
    source: str


def _sensor(title: str, ranges: tuple[float, float], degrees: tuple[float, float],
            resolution: tuple[int, int], source: str) -> Sensor:
    """Return a sensor, given the least and the largest range, metres, and both fields of view."""
    horizontal, vertical = np.deg2rad(degrees)
    return Sensor(title, CameraModel(*ranges, float(horizontal), float(vertical), resolution),
                  source)


SENSORS = {
    'realsense_d435': _sensor('Intel RealSense D435', (0.3, 3.0), (87.0, 58.0), (1280, 720),
                              f'{REALSENSE}: ideal range 0.3 to 3 m'),
    'realsense_d455': _sensor('Intel RealSense D455', (0.6, 6.0), (87.0, 58.0), (1280, 720),
                              f'{REALSENSE}: ideal range 0.6 to 6 m'),
    'realsense_l515': _sensor(
        'Intel RealSense LiDAR Camera L515', (0.25, 9.0), (70.0, 55.0), (1024, 768),
        'Intel, RealSense LiDAR Camera L515 product page: 0.25 to 9 m, less on dark surfaces'),
    'azure_kinect_nfov': _sensor(
        'Microsoft Azure Kinect, NFOV unbinned', (0.5, 3.86), (75.0, 65.0), (640, 576), MICROSOFT),
    'azure_kinect_wfov': _sensor(
        'Microsoft Azure Kinect, WFOV 2x2 binned', (0.25, 2.88), (120.0, 120.0), (512, 512),
        MICROSOFT),
    'femto_bolt_nfov': _sensor(
        'Orbbec Femto Bolt, NFOV unbinned', (0.5, 3.86), (75.0, 65.0), (640, 576), ORBBEC),
    'femto_bolt_wfov': _sensor(
        'Orbbec Femto Bolt, WFOV 2x2 binned', (0.25, 2.88), (120.0, 120.0), (512, 512), ORBBEC),
    'gemini_2': _sensor('Orbbec Gemini 2', (0.2, 5.0), (91.0, 66.0), (1280, 800),
                        'Seeed Studio, wiki page of the Orbbec Gemini 2: ideal range 0.2 to 5 m, '
                        '91 x 66 degrees, 1280 x 800'),
    'zed_2i_wide': _sensor(
        'Stereolabs ZED 2i, 2.1 mm lens, HD720', (0.3, 12.0), (93.0, 61.0), (1280, 720),
        'Stereolabs, depth settings: ideal range 0.3 to 12 m. Stereolabs support: the HD720 depth '
        'map has 93 degrees across; the 110 degrees of the data sheet are before rectification. '
        'The vertical 61 degrees are computed from 1280 x 720 square pixels'),
    'kinect_v2': _sensor(
        'Microsoft Kinect for Windows v2', (0.5, 4.5), (70.0, 60.0), (512, 424),
        'Microsoft, Kinect for Windows v2 hardware features: 0.5 to 4.5 m, 70 x 60 degrees'),
    'velodyne_vlp16': _sensor(
        'Velodyne VLP-16 spinning lidar, 10 Hz', (1.0, 100.0), (360.0, 30.0), (1800, 16),
        'Velodyne, VLP-16 User Manual 63-9243: 1 to 100 m, 16 channels from -15 to +15 degrees, '
        '0.2 degrees of azimuth at 10 Hz'),
}
