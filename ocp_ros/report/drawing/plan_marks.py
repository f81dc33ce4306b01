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

#: Distinct with any kind of colour vision; red is reserved for points that no camera sees.
CAMERA_COLOURS = ('#0072b2', '#e69f00', '#009e73', '#cc79a7', '#56b4e9', '#332288', '#f0e442',
                  '#8c6d31')
#: Distance between the centres of two numbers, inches for each point of font size.
NUMBER_SPACING = 0.032
#: Smallest readable font size of numbers, points.
LEAST_FONT_SIZE = 4.5
#: Largest share of a room's picture that numbers may cover.
LARGEST_COVER = 0.35
NO_PLACES = np.empty((0, 2))
#: Edge colour, hatching and line style of each kind of zone.
STYLES = {
    'must-see region': {'edgecolor': '#00664d', 'hatch': '//', 'linestyle': '-'},
    'weighted region': {'edgecolor': '#00664d', 'hatch': '..', 'linestyle': '--'},
    'keep-out zone': {'edgecolor': '#9c2f6b', 'hatch': 'xx', 'linestyle': '-'},
    'mounting zone': {'edgecolor': '#0072b2', 'hatch': '', 'linestyle': '-.'}}


def camera_colour(number: int) -> str:
    """Return the colour of a camera, counted from 0."""
    return CAMERA_COLOURS[number % len(CAMERA_COLOURS)]


def apart(places: np.ndarray, least: float, taken: np.ndarray, rounds: int = 1000) -> np.ndarray:
    """
    Move places (K, 2) away from each other until all distances are at least about ``least``.

    :param least: smallest distance, in the unit of the places.
    :param taken: (M, 2) other places, which do not move.
    :param rounds: largest number of iterations.
    """
    moved = places + 1e-3 * least * np.random.default_rng(0).standard_normal(places.shape)
    for _ in range(rounds):
        way = moved[:, None] - np.concatenate([moved, taken])[None]
        distance = np.linalg.norm(way, axis=2)
        np.fill_diagonal(distance, 2.0 * least)
        close = np.maximum(least - distance, 0.0) / np.maximum(distance, 1e-9)
        if not close.any():
            break
        moved = moved + 0.5 * (way * close[..., None]).sum(axis=1)
    return moved


def draw_numbers(axes: Axes, places: np.ndarray, size: float, area: float,
                 taken: np.ndarray = NO_PLACES, always: bool = False) -> None:
    """
    Draw cameras (K, 2) as dots with numbers; numbers that would overlap are moved to the side.

    The size of the numbers is reduced if they would cover too much of the room. If it would be too
    small, the numbers are left out.

    :param size: largest font size, points.
    :param area: of the room in the picture, in the square of the unit of the places.
    :param taken: (M, 2) places of other letters.
    :param always: draw numbers even if they cover too much.
    """
    unit = unit_of(axes)
    size = min(size, float(np.sqrt(LARGEST_COVER * area / len(places))) / unit / NUMBER_SPACING)
    if size < LEAST_FONT_SIZE and not always:
        for number, place in enumerate(places):
            _draw_dot(axes, place, camera_colour(number))
        return
    size = max(size, LEAST_FONT_SIZE)
    least = NUMBER_SPACING * size * unit
    for number, (place, label) in enumerate(zip(places, apart(places, least, taken))):
        colour = camera_colour(number)
        if np.linalg.norm(label - place) > 0.2 * least:
            axes.plot(*np.stack([place, label]).T, color=colour, linewidth=1.0, zorder=6)
        _draw_dot(axes, place, colour)
        axes.text(label[0], label[1], str(number + 1), fontsize=size, fontweight='bold',
                  color='white', ha='center', va='center', zorder=7, clip_on=False,
                  bbox={'boxstyle': 'circle,pad=0.22', 'facecolor': dark(colour),
                        'edgecolor': 'white', 'linewidth': 0.8})


def unit_of(axes: Axes) -> float:
    """Return the data units of the axes in one inch of the picture."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    box = axes.get_position(original=True)
    width, height = axes.get_figure(root=True).get_size_inches()
    return max((right - left) / (box.width * width), (top - bottom) / (box.height * height))


def _draw_dot(axes: Axes, place: np.ndarray, colour: str) -> None:
    """Draw the position of a camera as a dot."""
    axes.plot(*place, 'o', color=colour, markersize=3.5, markeredgecolor='white',
              markeredgewidth=0.6, zorder=6)


def draw_headings(axes: Axes, placement: Placement, places: np.ndarray, frame: np.ndarray,
                  width: float) -> None:
    """
    Draw the heading of each camera that is not omnidirectional as an arrow.

    :param places: (K, 2) of the cameras.
    :param frame: (2, 2) from the map frame to that of the picture; its scale is the length of the
        arrows in metres.
    :param width: of the lines, points.
    """
    for number, (placed, place) in enumerate(zip(placement.cameras, places)):
        if placed.camera.model.horizontal_fov < 2.0 * np.pi - 1e-9:
            yaw = np.deg2rad(placed.angles[0])
            axes.annotate('', place + frame @ [np.cos(yaw), np.sin(yaw)], place, zorder=5,
                          arrowprops={'arrowstyle': '-|>', 'color': camera_colour(number),
                                      'lw': width, 'shrinkA': 0.0, 'shrinkB': 0.0})


def dark(colour: str) -> tuple[float, float, float]:
    """Return a colour, darkened if needed so that white letters on it are readable."""
    rgb = np.array(to_rgb(colour))
    light = float(rgb @ [0.2126, 0.7152, 0.0722])
    return tuple(rgb * min(1.0, 0.5 / max(light, 1e-6)))


def draw_letters(axes: Axes, walls: Sequence[ReferenceWall | InnerWall], places: np.ndarray,
                 size: float, **style: Any) -> None:
    """
    Write the letters of walls.

    :param places: (M, 2) of the letters.
    :param size: of the letters, points.
    :param style: other properties of the texts.
    """
    for wall, (x, y) in zip(walls, places):
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


def draw_zones(axes: Axes, rig: Rig, frame: np.ndarray, level: float) -> None:
    """
    Draw the zones of a rig on a plan.

    :param frame: (2, 2) rotation from the map frame to that of the plan.
    :param level: drawing order (zorder).
    """
    for kind, _, zone in zones_of(rig):
        axes.add_patch(Polygon(corners_of(zone) @ frame.T, facecolor='none', linewidth=1.2,
                               zorder=level, label=kind, **STYLES[kind]))


def zone_legend(rig: Rig) -> dict[str, Patch]:
    """Return the legend entries of the kinds of zones that a rig has."""
    return {kind: Patch(facecolor='none', **STYLES[kind])
            for kind in dict.fromkeys(kind for kind, *_ in zones_of(rig))}
