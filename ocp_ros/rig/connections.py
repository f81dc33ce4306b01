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
How sensors send their images, and what light they emit.

The bandwidth of a mode is that of its depth image without compression and protocol: pixels x bytes
x images per second. If a sensor sends other images, from which the computer makes the depth image,
it is the bandwidth of those.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from ocp_ros.rig.rig_file import Camera

#: Two cameras of the same kind that light the same surface disturb each other.
TIME_OF_FLIGHT, STRUCTURED_LIGHT = INTERFERING = ('time of flight', 'structured light')
#: A stereo camera is not disturbed by the patterns of others, nor a lidar by pulses elsewhere.
ACTIVE_STEREO, PASSIVE_STEREO, LIDAR = 'active stereo', 'stereo', 'spinning lidar'
USB3, GIGABIT, FAST_ETHERNET = 'USB 3', 'Ethernet, 1 Gbit/s', 'Ethernet, 100 Mbit/s'
TEN_GIGABIT = 'Ethernet, 10 Gbit/s'
#: Mbit/s that an interface of a computer carries: USB 3 with 5 Gbit/s sends 8 of 10 bits, and a
#: fifth is for its protocol; Ethernet sends 1460 of 1538 bytes of a frame.
CAPACITIES = {USB3: 3200.0, TEN_GIGABIT: 9490.0, GIGABIT: 949.0, FAST_ETHERNET: 94.9}


class Mode(NamedTuple):
    """
    A mode of a sensor.

    :ivar pixels: across and down.
    :ivar rate: images per second.
    :ivar bytes: bytes per pixel.
    """

    pixels: tuple[int, int]
    rate: float
    bytes: float

    @property
    def mbit_s(self) -> float:
        """Return the bandwidth, Mbit/s."""
        return self.pixels[0] * self.pixels[1] * self.rate * self.bytes * 8e-6


class Connection(NamedTuple):
    """
    How a sensor is connected, and what light it emits.

    :ivar light: the kind of its light.
    :ivar interface: a key of :data:`CAPACITIES`.
    :ivar modes: its modes; that of the preset comes first.
    """

    light: str
    interface: str
    modes: tuple[Mode, ...]


_D400 = Connection(ACTIVE_STEREO, USB3, (
    Mode((1280, 720), 30, 2), Mode((848, 480), 30, 2), Mode((640, 480), 30, 2)))
#: Depth and active infrared image, 16 bits each.
_NFOV = Connection(TIME_OF_FLIGHT, USB3, (Mode((640, 576), 30, 4), Mode((640, 576), 15, 4)))
_WFOV = Connection(TIME_OF_FLIGHT, USB3, (Mode((512, 512), 30, 4), Mode((512, 512), 15, 4)))
CONNECTIONS = {
    'realsense_d435': _D400, 'realsense_d455': _D400,
    'realsense_l515': Connection(TIME_OF_FLIGHT, USB3, (
        Mode((1024, 768), 30, 2), Mode((640, 480), 30, 2))),
    'azure_kinect_nfov': _NFOV, 'azure_kinect_wfov': _WFOV,
    'femto_bolt_nfov': _NFOV, 'femto_bolt_wfov': _WFOV,
    'gemini_2': Connection(ACTIVE_STEREO, USB3, (
        Mode((1280, 800), 30, 2), Mode((640, 400), 30, 2))),
    'gemini_335': Connection(ACTIVE_STEREO, USB3, (
        Mode((1280, 800), 30, 2), Mode((848, 480), 60, 2))),
    'oak_d_pro': Connection(ACTIVE_STEREO, USB3, (
        Mode((1280, 800), 30, 2), Mode((640, 400), 30, 2))),
    # x, y, z and intensity, or z alone, 16 bits each.
    'helios2': Connection(TIME_OF_FLIGHT, GIGABIT, (
        Mode((640, 480), 30, 8), Mode((640, 480), 30, 2))),
    # Point cloud of x, y, z (32 bits each) and colour, about 0.3 s for a capture.
    'zivid_2_m70': Connection(STRUCTURED_LIGHT, TEN_GIGABIT, (
        Mode((1944, 1200), 3, 16), Mode((972, 600), 3, 16))),
    # Depth and texture, 32 bits each, about 0.4 s for a scan.
    'phoxi_m': Connection(STRUCTURED_LIGHT, GIGABIT, (Mode((2064, 1544), 2.5, 8),)),
    # Two images side by side, of which the computer makes the depth image.
    'zed_2i_wide': Connection(PASSIVE_STEREO, USB3, (
        Mode((2560, 720), 30, 2), Mode((2560, 720), 15, 2))),
    # Ten raw images of 11 bits (libfreenect2, depth_packet_stream_parser).
    'kinect_v2': Connection(TIME_OF_FLIGHT, USB3, (Mode((512, 424), 30, 13.75),)),
    # 1206 bytes for 384 points (VLP-16 User Manual).
    'velodyne_vlp16': Connection(LIDAR, FAST_ETHERNET, (Mode((1800, 16), 10, 1206 / 384),)),
}


def light_of(camera: Camera) -> str:
    """Return the kind of light of a camera; '' for a camera that is no preset."""
    return CONNECTIONS[camera.sensor].light if camera.sensor in CONNECTIONS else ''


def bandwidth_notes(cameras: Iterable[Camera]) -> Iterator[str]:
    """Yield a sentence for each interface of a computer that cannot carry all its cameras."""
    loads: dict[tuple[str, str], list[float]] = {}
    for camera in cameras:
        if connection := CONNECTIONS.get(camera.sensor):
            loads.setdefault((camera.device.host, connection.interface), []).append(
                connection.modes[0].mbit_s)
    for (host, interface), rates in loads.items():
        # Each camera has its own cable of 100 Mbit/s, and the computer one of 1 Gbit/s.
        capacity = CAPACITIES[GIGABIT if interface == FAST_ETHERNET else interface]
        if sum(rates) > capacity:
            yield (f'{host or "host"}: found {len(rates)} cameras with {sum(rates):,.0f} Mbit/s '
                   f'on {interface}; expected at most {capacity:,.0f}, which one controller '
                   'carries; add controllers or hosts (key host), or use smaller modes')
