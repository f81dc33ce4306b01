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

"""Marks in a picture: numbered cameras without overlaps, letters of walls, and zones."""

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.patches import Patch, Polygon
import numpy as np
from ocp_ros.report.drawing.room_drawing import INK
from ocp_ros.report.wall_references import InnerWall, ReferenceWall
from ocp_ros.rig.placement_file import Placement
from ocp_ros.rig.rig_file import Rig
from ocp_ros.rig.zones import Zone

#: Colours that are distinct with any kind of colour vision, without red: red marks missed points.
CAMERA_COLOURS = ('#0072b2', '#e69f00', '#009e73', '#cc79a7', '#56b4e9', '#332288', '#f0e442',
                  '#8c6d31')
NO_POSITIONS = np.empty((0, 2))
#: Edge colour, hatching and line style of each kind of zone.
STYLES = {
    'must-see region': {'edgecolor': '#00664d', 'hatch': '//', 'linestyle': '-'},
    'weighted region': {'edgecolor': '#00664d', 'hatch': '..', 'linestyle': '--'},
    'keep-out zone': {'edgecolor': '#9c2f6b', 'hatch': 'xx', 'linestyle': '-'},
    'mounting zone': {'edgecolor': '#0072b2', 'hatch': '', 'linestyle': '-.'}}


def camera_colour(number: int) -> str:
    """Return the colour of a camera by its number from 0; colours repeat after eight."""
    return CAMERA_COLOURS[number % len(CAMERA_COLOURS)]


def move_apart(positions: np.ndarray, min_distance: float, fixed: np.ndarray) -> np.ndarray:
    """
    Return positions that are moved away from each other to about a smallest distance.

    :param positions: (K, 2), K positions.
    :param min_distance: smallest distance, in the unit of the positions.
    :param fixed: (M, 2), M other positions, which do not move.
    :returns: (K, 2).
    """
    # By the noise, equal positions get different directions to move in.
    noise = np.random.default_rng(0).standard_normal(positions.shape)
    moved = positions + 1e-3 * min_distance * noise
    for _ in range(1000):
        vectors = moved[:, None] - np.concatenate([moved, fixed])[None]
        distances = np.linalg.norm(vectors, axis=2)
        # A position does not move away from itself, so this distance is above ``min_distance``.
        np.fill_diagonal(distances, 2.0 * min_distance)
        # Each of two positions moves by half of what is missing in their distance.
        overlaps = np.maximum(min_distance - distances, 0.0) / np.maximum(distances, 1e-9)
        if not overlaps.any():
            break
        moved = moved + 0.5 * (vectors * overlaps[..., None]).sum(axis=1)
    return moved


def draw_numbers(axes: Axes, positions: np.ndarray, size: float, area: float,
                 fixed: np.ndarray = NO_POSITIONS, always: bool = False) -> None:
    """
    Draw cameras as dots with numbers; numbers that would overlap are moved to the side.

    The font size is reduced if the numbers would cover too much of the room. If the font size
    would be too small to read, the numbers are left out.

    :param positions: (K, 2) of the K cameras, data units of the axes.
    :param size: largest font size, points.
    :param area: area of the room in the picture, square data units.
    :param fixed: (M, 2) positions of M other letters, which the numbers must not cover.
    :param always: whether to draw numbers even if they cover too much.
    """
    max_covered_share, min_font_size = 0.35, 4.5
    # Distance between the centres of two numbers, inches for each point of font size.
    spacing = 0.032
    units = units_per_inch(axes)
    # A number covers the square of its spacing in data units.
    size = min(size, float(np.sqrt(max_covered_share * area / len(positions))) / units / spacing)
    if size < min_font_size and not always:
        for number, position in enumerate(positions):
            _draw_dot(axes, position, camera_colour(number))
        return
    size = max(size, min_font_size)
    min_distance = spacing * size * units
    labels = move_apart(positions, min_distance, fixed)
    for number, (position, label) in enumerate(zip(positions, labels)):
        colour = camera_colour(number)
        # A line leads from a camera to a number that was moved.
        if np.linalg.norm(label - position) > 0.2 * min_distance:
            axes.plot(*np.stack([position, label]).T, color=colour, linewidth=1.0, zorder=6)
        _draw_dot(axes, position, colour)
        axes.text(label[0], label[1], str(number + 1), fontsize=size, fontweight='bold',
                  color='white', ha='center', va='center', zorder=7, clip_on=False,
                  bbox={'boxstyle': 'circle,pad=0.22', 'facecolor': darkened(colour),
                        'edgecolor': 'white', 'linewidth': 0.8})


def units_per_inch(axes: Axes) -> float:
    """Return the number of data units of the axes in an inch of the picture."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    box = axes.get_position(original=True)
    width, height = axes.get_figure(root=True).get_size_inches()
    # With an equal aspect, the larger number applies to both axes.
    return max((right - left) / (box.width * width), (top - bottom) / (box.height * height))


def _draw_dot(axes: Axes, position: np.ndarray, colour: str) -> None:
    """Draw the position of a camera as a dot."""
    axes.plot(*position, 'o', color=colour, markersize=3.5, markeredgecolor='white',
              markeredgewidth=0.6, zorder=6)


def draw_headings(axes: Axes, placement: Placement, positions: np.ndarray, rotation: np.ndarray,
                  width: float) -> None:
    """
    Draw the heading of each camera as an arrow, except of cameras that see all yaws.

    :param placement: poses of the K cameras.
    :param positions: (K, 2) of the cameras in the picture, metres.
    :param rotation: (2, 2) from the map frame to the picture, times the length of the arrows in
        metres.
    :param width: width of the lines, points.
    """
    for number, (placed, position) in enumerate(zip(placement.cameras, positions)):
        if placed.camera.model.horizontal_fov < 2.0 * np.pi - 1e-9:
            yaw = np.deg2rad(placed.angles[0])
            axes.annotate('', position + rotation @ [np.cos(yaw), np.sin(yaw)], position, zorder=5,
                          arrowprops={'arrowstyle': '-|>', 'color': camera_colour(number),
                                      'lw': width, 'shrinkA': 0.0, 'shrinkB': 0.0})


def darkened(colour: str) -> tuple[float, float, float]:
    """Return a colour as RGB, darkened so far that white letters on the colour are readable."""
    rgb = np.array(to_rgb(colour))
    # The shares of red, green and blue in the luminance of a colour (ITU-R BT.709).
    lightness = float(rgb @ [0.2126, 0.7152, 0.0722])
    return tuple(rgb * min(1.0, 0.5 / max(lightness, 1e-6)))


def draw_letters(axes: Axes, walls: Sequence[ReferenceWall | InnerWall], positions: np.ndarray,
                 size: float, **style: Any) -> None:
    """
    Write the letters of walls.

    :param walls: M walls.
    :param positions: (M, 2) of the letters, data units of the axes.
    :param size: font size, points.
    :param style: other properties of the texts, as of ``Axes.text``.
    """
    for wall, (x, y) in zip(walls, positions):
        axes.text(x, y, wall.letter, fontsize=size, fontweight='bold', color=INK, ha='center',
                  va='center', **style)


def corners_of(zone: Zone) -> np.ndarray:
    """Return the corners of a zone seen from above: (P, 2) metres, map frame."""
    if zone.polygon is not None:
        return zone.polygon
    (x0, y0), (x1, y1) = zone.low[:2], zone.high[:2]
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def zones_of(rig: Rig) -> list[tuple[str, str, Zone]]:
    """Return each zone of a rig: its kind, which is a key of :data:`STYLES`, name and shape."""
    return [*(('must-see region' if region.must_see else 'weighted region', region.name,
               region.zone) for region in rig.regions),
            *((kind, f'{kind} {number}', zone)
              for kind, zones in (('keep-out zone', rig.keep_out), ('mounting zone', rig.keep_in))
              for number, zone in enumerate(zones, start=1))]


def draw_zones(axes: Axes, rig: Rig, rotation: np.ndarray, zorder: float) -> None:
    """
    Draw the zones of a rig on a plan.

    :param rotation: (2, 2) from the map frame to that of the plan.
    :param zorder: drawing order of matplotlib: larger is in front.
    """
    for kind, _, zone in zones_of(rig):
        axes.add_patch(Polygon(corners_of(zone) @ rotation.T, facecolor='none', linewidth=1.2,
                               zorder=zorder, label=kind, **STYLES[kind]))


def zone_legend(rig: Rig) -> dict[str, Patch]:
    """Return the legend entries of the kinds of zones that a rig has."""
    return {kind: Patch(facecolor='none', **STYLES[kind])
            for kind in dict.fromkeys(kind for kind, *_ in zones_of(rig))}
