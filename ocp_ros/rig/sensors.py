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
the nominal one, without tolerance. The noise is the standard deviation of one depth in one frame,
as the maker or a paper publishes it; it depends on the angle of incidence where that model does.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, DepthNoise

MICROSOFT = ('Microsoft, Azure Kinect DK hardware specifications, depth camera supported '
             'operating modes')
ORBBEC = ('Orbbec, Femto Bolt hardware specifications, depth camera supported operating modes, '
          'https://www.orbbec.com/documentation/femto-bolt-hardware-specifications/. Random '
          'error: that of the same chip in the Azure Kinect')
REALSENSE = 'Intel, RealSense product family D400 series datasheet 337029 and product page'


@dataclass(frozen=True)
class Sensor:
    """
    A depth sensor.

    :ivar title: maker, product and mode.
    :ivar model: the camera model.
    :ivar source: the source of the numbers.
    :ivar unverified: the numbers that no public page was found to confirm, in words; users have to
        compare them with the data sheet.
    """

    title: str
    model: CameraModel
    source: str
    unverified: str = ''


class Price(NamedTuple):
    """
    The list price of a sensor, without tax.

    :ivar amount: in :data:`CURRENCY`.
    :ivar source: who asked this price.
    :ivar date: when: year, or year and month.
    """

    amount: float
    source: str
    date: str


def _sensor(title: str, ranges: tuple[float, float], degrees: tuple[float, float],
            resolution: tuple[int, int], noise: DepthNoise, source: str, unverified: str = ''
            ) -> Sensor:
    """Return a sensor, given the least and the largest range, metres, and both fields of view."""
    horizontal, vertical = np.deg2rad(degrees)
    return Sensor(title, CameraModel(*ranges, float(horizontal), float(vertical), resolution,
                                     noise), source, unverified)


def _stereo(baseline_m: float, degrees: float, pixels: int, disparity: float = 0.08) -> DepthNoise:
    """
    Return the noise of stereo: z^2 x disparity error / (focal length x baseline).

    Intel, "Best-Known-Methods for Tuning Intel RealSense D400 Depth Cameras for Best Performance",
    has this formula, and 0.08 pixels for a surface with texture.

    :param degrees: horizontal field of view.
    :param pixels: pixels across.
    :param disparity: standard deviation of the disparity, pixels.
    """
    focal_pixels = 0.5 * pixels / np.tan(np.deg2rad(0.5 * degrees))
    return DepthNoise(quadratic=float(disparity / (focal_pixels * baseline_m)))


#: Microsoft, and Orbbec for the same chip: random error of at most 17 mm in the whole range.
AT_MOST_17_MM = DepthNoise(constant=0.017)


SENSORS = {
    'realsense_d435': _sensor('Intel RealSense D435', (0.3, 3.0), (87.0, 58.0), (1280, 720),
                              _stereo(0.050, 87.0, 1280),
                              f'{REALSENSE}: ideal range 0.3 to 3 m, baseline 50 mm'),
    'realsense_d455': _sensor('Intel RealSense D455', (0.6, 6.0), (87.0, 58.0), (1280, 720),
                              _stereo(0.095, 87.0, 1280),
                              f'{REALSENSE}: ideal range 0.6 to 6 m, baseline 95 mm'),
    'realsense_l515': _sensor(
        'Intel RealSense LiDAR Camera L515', (0.25, 9.0), (70.0, 55.0), (1024, 768),
        DepthNoise(constant=0.000875, linear=0.001625),
        'Intel, RealSense LiDAR Camera L515 product page: 0.25 to 9 m, less on dark surfaces; '
        'standard deviation 2.5 mm at 1 m and 15.5 mm at 9 m, here a line through both'),
    'azure_kinect_nfov': _sensor(
        'Microsoft Azure Kinect, NFOV unbinned', (0.5, 3.86), (75.0, 65.0), (640, 576),
        AT_MOST_17_MM, MICROSOFT),
    'azure_kinect_wfov': _sensor(
        'Microsoft Azure Kinect, WFOV 2x2 binned', (0.25, 2.88), (120.0, 120.0), (512, 512),
        AT_MOST_17_MM, MICROSOFT),
    'femto_bolt_nfov': _sensor(
        'Orbbec Femto Bolt, NFOV unbinned', (0.5, 3.86), (75.0, 65.0), (640, 576),
        AT_MOST_17_MM, ORBBEC),
    'femto_bolt_wfov': _sensor(
        'Orbbec Femto Bolt, WFOV 2x2 binned', (0.25, 2.88), (120.0, 120.0), (512, 512),
        AT_MOST_17_MM, ORBBEC),
    'gemini_2': _sensor('Orbbec Gemini 2', (0.2, 5.0), (91.0, 66.0), (1280, 800),
                        DepthNoise(quadratic=0.01),
                        'Seeed Studio, wiki page of the Orbbec Gemini 2: ideal range 0.2 to 5 m, '
                        '91 x 66 degrees, 1280 x 800; depth accuracy 2 % at 2 m, here with '
                        'the square of the distance, as that of stereo'),
    'gemini_335': _sensor(
        'Orbbec Gemini 335', (0.25, 6.0), (90.0, 65.0), (1280, 800), DepthNoise(quadratic=0.0075),
        'Orbbec, Gemini 335 product page: ideal range 0.25 to 6 m, depth 90 x 65 degrees, up to '
        '1280 x 800 at 30 Hz; spatial precision 1.5 % at 2 m, here with the square of the '
        'distance, as that of stereo', 'range, field of view, resolution, frame rate and noise'),
    'oak_d_pro': _sensor(
        'Luxonis OAK-D Pro', (0.8, 12.0), (80.0, 55.0), (1280, 800), DepthNoise(quadratic=0.005),
        'Luxonis, https://docs.luxonis.com/hardware/products/OAK-D%20Pro: OV9282 pair, 80 x 55 '
        'degrees, 1280 x 800, dot projector, ideal range of this pair about 0.8 to 12 m. '
        'https://docs.luxonis.com/hardware/platform/depth/depth-accuracy: baseline 75 mm, error '
        'below 2 % up to 4 m, 4 % up to 7 m and 6 % up to 10.5 m, which this parabola reaches at '
        '4 m'),
    'zed_2i_wide': _sensor(
        'Stereolabs ZED 2i, 2.1 mm lens, HD720', (0.3, 12.0), (93.0, 61.0), (1280, 720),
        DepthNoise(quadratic=0.01 / 3.0),
        'Stereolabs, depth settings: ideal range 0.3 to 12 m. Stereolabs support: the HD720 depth '
        'map has 93 degrees across; the 110 degrees of the data sheet are before rectification. '
        'The vertical 61 degrees are computed from 1280 x 720 square pixels. Data sheet: depth '
        'accuracy below 1 % up to 3 m and 5 % up to 15 m, both on this parabola'),
    'kinect_v2': _sensor(
        'Microsoft Kinect for Windows v2', (0.5, 4.5), (70.0, 60.0), (512, 424),
        DepthNoise(0.0015, -0.0005, 0.0003, 0.0001),
        'Microsoft, Kinect for Windows v2 hardware features: 0.5 to 4.5 m, 70 x 60 degrees. '
        'Noise: Fankhauser et al., Kinect v2 for Mobile Robot Navigation, ICAR 2015, axial'),
    'helios2': _sensor(
        'LUCID Helios2', (0.3, 8.3), (69.0, 51.0), (640, 480), DepthNoise(linear=0.001),
        'LUCID, Helios2 product page: Sony IMX556, 0.3 to 8.3 m, 69 x 51 degrees, 640 x 480 at '
        '30 Hz; precision below 1 mm at 1 m, here with the distance. The technical reference of '
        'the Helios2 Wide, of the same chip, has operating modes up to 8.3 m at 30 Hz: https://'
        '1stvision.com/cameras/Lucid-Vision-Labs/Helios2-Wide-Technical-Reference/html/'
        'camera_features_helios2.html', 'least range, field of view and noise'),
    'zivid_2_m70': _sensor(
        'Zivid 2 M70', (0.5, 1.1), (56.6, 35.6), (1944, 1200), DepthNoise(quadratic=0.000112),
        'Zivid, Zivid 2 M70 data sheet: optimal distance 0.5 to 1.1 m, 754 x 449 mm at 0.7 m, '
        'point precision 55 um there, here with the square of the distance. Zivid support: '
        '1944 x 1200, https://support.zivid.com/en/latest/camera/reference-articles/'
        'specs_terminology.html', 'range, field of view, frame rate and noise'),
    'phoxi_m': _sensor(
        'Photoneo PhoXi 3D Scanner M', (0.458, 1.118), (47.5, 36.0), (2064, 1544),
        DepthNoise(constant=0.0001),
        'Photoneo, PhoXi 3D Scanner M product page: 458 to 1118 mm, 2064 x 1544, temporal noise '
        '0.1 mm. Photoneo wiki: projection angles 47.5 x 36 degrees, '
        'https://wiki.photoneo.com/index.php?title=PhoXi_3D_scanners_family',
        'range, resolution, frame rate and noise'),
    'velodyne_vlp16': _sensor(
        'Velodyne VLP-16 spinning lidar, 10 Hz', (1.0, 100.0), (360.0, 30.0), (1800, 16),
        DepthNoise(constant=0.03),
        'Velodyne, VLP-16 User Manual 63-9243: 1 to 100 m, 16 channels from -15 to +15 degrees, '
        '0.2 degrees of azimuth at 10 Hz, typical accuracy 30 mm'),
}
OMNIDIRECTIONAL = 'omnidirectional'
#: The values of ``sensor`` that a camera of a rig file may have.
KINDS = (OMNIDIRECTIONAL, *SENSORS)
CURRENCY = 'USD'
_AZURE = Price(399.0, 'Microsoft Store, sold until 2023', '2019-07')
#: By the name of a sensor; sensors without a public list price have none.
PRICES = {
    'realsense_d435': Price(314.0, 'RealSense store', '2024'),
    'realsense_d455': Price(419.0, 'RealSense store', '2024'),
    'realsense_l515': Price(349.0, 'Intel, at its launch; sold until 2022', '2019-12'),
    'azure_kinect_nfov': _AZURE, 'azure_kinect_wfov': _AZURE,
    'zed_2i_wide': Price(499.0, 'Stereolabs store', '2023'),
    'kinect_v2': Price(199.0, 'Microsoft Store, sold until 2015', '2014-07'),
    'velodyne_vlp16': Price(3999.0, 'Velodyne, press release', '2018-01'),
}
