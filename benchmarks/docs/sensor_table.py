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

"""Print the table of docs/reference/sensors.md: ``python -m benchmarks.docs.sensor_table``."""

import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.rig.connections import CONNECTIONS
from ocp_ros.rig.sensors import PRICES, SENSORS


def pixel_size(model: CameraModel, distance: float) -> tuple[float, float]:
    """
    Return how wide and how high one pixel is on a wall that faces the camera.

    :param model: one with a resolution.
    :param distance: metres.
    :returns: metres, straight ahead.
    """
    lens = model.lens
    # A pinhole's half angles are tangents: what half the image spans at one metre.
    return (2.0 * distance * lens.half_horizontal / model.resolution[0],
            2.0 * distance * lens.half_vertical / model.resolution[1])


def noise_at(model: CameraModel, depth: float) -> float:
    """Return the standard deviation of a depth, metres, of a surface that faces the camera."""
    noise = model.noise
    return noise.constant + noise.linear * depth + noise.quadratic * depth ** 2


def price_text(name: str) -> str:
    """Return the price of a sensor with its date, or a dash."""
    price = PRICES.get(name)
    return '-' if price is None else f'{price.amount:,.0f} ({price.date})'


def rows() -> list[str]:
    """Return one line of Markdown per sensor."""
    lines = []
    for name, sensor in SENSORS.items():
        model = sensor.model
        angles = ' x '.join(f'{np.rad2deg(angle):.0f}'
                            for angle in (model.horizontal_fov, model.vertical_fov))
        across, down = (f'{1e3 * size:.1f}' for size in pixel_size(model, 3.0))
        mark = '*' * bool(sensor.unverified)
        lines.append(f'| `{name}`{mark} | {sensor.title} | '
                     f'{model.min_range:g} to {model.max_range:g} | {angles} | '
                     f'{model.resolution[0]} x {model.resolution[1]} | '
                     f'{across} x {down} | {1e3 * noise_at(model, 2.0):.1f} | '
                     f'{price_text(name)} |')
    return lines


def unverified_rows() -> list[str]:
    """Return one line of Markdown per sensor with figures that no public page confirmed."""
    return [f'| `{name}` | {sensor.unverified} |' for name, sensor in SENSORS.items()
            if sensor.unverified]


def bandwidth_rows() -> list[str]:
    """Return one line of Markdown per sensor: light, interface and the bandwidth of its modes."""
    lines = []
    for name, connection in CONNECTIONS.items():
        modes = '; '.join(f'{mode.pixels[0]} x {mode.pixels[1]} at {mode.rate:g} Hz: '
                          f'**{mode.mbit_s:.0f}**' for mode in connection.modes)
        lines.append(f'| `{name}` | {connection.light} | {connection.interface} | {modes} |')
    return lines


if __name__ == '__main__':
    print('\n'.join([*rows(), '', *unverified_rows(), '', *bandwidth_rows()]))
