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
The room from above, and marks in pictures.

The marks are cameras with numbers, headings and fields of view, letters of walls, and zones.
"""

from collections.abc import Sequence
from typing import Any

from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.patches import Patch, Polygon
import numpy as np
from ocp_ros.geometry.cameras import (
    CameraModel,
    OMNIDIRECTIONAL,
    PINHOLE,
    rotation_matrix,
    view_grid,
)
from ocp_ros.report.camera_words import camera_colour
from ocp_ros.report.drawing.room_drawing import draw_discs, INK, Room
from ocp_ros.report.wall_references import InnerWall, ReferenceWall
from ocp_ros.rig.placement_file import Placement
from ocp_ros.rig.rig_file import Rig
from ocp_ros.rig.zones import Zone
from scipy import ndimage
from scipy.spatial import ConvexHull

NO_POSITIONS = np.empty((0, 2))
#: Number of directions along each edge of a field of view.
EDGE_STEPS = 25
#: Edge colour, hatching and line style of each kind of zone.
STYLES = {
    'must-see region': {'edgecolor': '#00664d', 'hatch': '//', 'linestyle': '-'},
    'weighted region': {'edgecolor': '#00664d', 'hatch': '..', 'linestyle': '--'},
    'keep-out zone': {'edgecolor': '#9c2f6b', 'hatch': 'xx', 'linestyle': '-'},
    'mounting zone': {'edgecolor': '#0072b2', 'hatch': '', 'linestyle': '-.'}}


def draw_plan(axes: Axes, room: Room, ranges: Sequence[np.ndarray], fill: float = 0.2) -> None:
    """
    Draw a room from above, with the ranges of cameras.

    :param room: the room in the axes of the plan.
    :param ranges: for each camera the M corners (M, 2), metres, of the part of the plan in range.
    :param fill: opacity of the ranges, from 0 to 1; that of their edges is higher.
    """
    outline = draw_discs(axes, room, np.eye(3))
    # With many cameras the ranges are paler, so that the room stays visible.
    opacity = min(1.0, 2.0 / np.sqrt(max(len(ranges), 1)))
    for number, corners in enumerate(ranges):
        colour = to_rgb(camera_colour(number))
        patch = Polygon(corners, facecolor=(*colour, fill * opacity),
                        edgecolor=(*colour, 0.9 * opacity), linewidth=1.0, zorder=3)
        axes.add_patch(patch).set_clip_path(outline)
    _hide_outside(axes, room)


def _hide_outside(axes: Axes, room: Room) -> None:
    """Cover the area outside the room with white, for example outside an L-shaped room."""
    cell_m = 0.1
    flat = room.points[:, :2]
    # The margin of four cells on each side is as wide as the closing of gaps below reaches.
    low = flat.min(axis=0) - 4 * cell_m
    cells = np.floor((flat - low) / cell_m).astype(int)
    # Besides the margin, the size is one more than the largest index.
    inside = np.zeros(cells.max(axis=0) + 5, dtype=bool)
    inside[tuple(cells.T)] = True
    structure = ndimage.iterate_structure(ndimage.generate_binary_structure(2, 1), 4)
    inside = ndimage.binary_fill_holes(ndimage.binary_closing(inside, structure))
    # RGBA, opaque outside. The first axis of an image is y, that of the cells is x. The factor 1.6
    # makes the blurred edge more transparent.
    cover = np.ones((*inside.T.shape, 4))
    cover[..., 3] = 1.0 - np.minimum(ndimage.gaussian_filter(1.6 * inside.T, 0.7), 1.0)
    high = low + cell_m * np.array(inside.shape)
    axes.imshow(cover, extent=(low[0], high[0], low[1], high[1]), origin='lower',
                interpolation='bilinear', zorder=3.5)


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


def rim(model: CameraModel) -> np.ndarray:
    """
    Return the directions of M points once around the edge of a field of view.

    :returns: (M, 3) unit vectors, body frame (x forward, y left, z up).
    """
    grid = view_grid(model, EDGE_STEPS, EDGE_STEPS)
    # Bottom, left, top and right edge; the grid begins at the top left corner.
    return np.concatenate([grid[-1, ::-1], grid[::-1, 0], grid[0], grid[:, -1]])


def reach(model: CameraModel, pose: np.ndarray, heights: Sequence[float]) -> np.ndarray:
    """
    Return the part of the floor plan that a camera would see if nothing hid anything.

    :param pose: (6,) metres, map frame, and radians.
    :param heights: heights of floor and ceiling, metres, map frame, which limit the rays.
    :returns: (M, 2) metres, map frame: the M corners of a polygon.
    """
    position, rotation = pose[:3], rotation_matrix(*pose[3:])
    if model.lens.kind != PINHOLE:
        # A circle around the camera, or a sector with the camera as its tip.
        half_angle = 0.5 * model.horizontal_fov
        azimuth = np.linspace(-half_angle, half_angle, 8 * EDGE_STEPS)
        horizontal = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)])
        ends = _ray_ends(position, horizontal @ rotation.T, model.max_range, heights)
        full_circle = half_angle >= np.pi - 1e-6
        return ends[:, :2] if full_circle else np.concatenate([ends, [position]])[:, :2]
    # Directions between the optical axis (scale 0) and the rim (scale 1) are needed too, since the
    # directions near the optical axis may reach farthest in the plan.
    directions = np.concatenate([scale * rim(model) + [1.0 - scale, 0.0, 0.0]
                                 for scale in np.linspace(0.1, 1.0, 10)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ends = _ray_ends(position, directions @ rotation.T, model.max_range, heights)
    corners = np.concatenate([ends, [position]])[:, :2]
    # With the option QJ, corners on one line are no error.
    return corners[ConvexHull(corners, qhull_options='QJ').vertices]


def _ray_ends(position: np.ndarray, directions: np.ndarray, max_range: float,
              heights: Sequence[float]) -> np.ndarray:
    """Return the ends (M, 3) of rays along M directions, at the range, the floor or ceiling."""
    below, above = position[2] - heights[0], heights[1] - position[2]
    space = np.where(directions[:, 2] > 0.0, above, below)
    slopes = np.maximum(np.abs(directions[:, 2]), 1e-9)
    return position + directions * np.minimum(max_range, np.maximum(space, 0.0) / slopes)[:, None]


def edges(model: CameraModel, pose: np.ndarray, length: float) -> np.ndarray:
    """
    Return a camera's frustum as lines: its rim, and for a pinhole camera four rays to the rim.

    :param pose: (6,) metres, map frame, and radians.
    :param length: metres, from the camera to the rim.
    :returns: (M, 3) metres, map frame, points of lines with a row of NaN between two lines; empty
        for an omnidirectional camera.
    """
    if model.lens.kind == OMNIDIRECTIONAL:
        return np.empty((0, 3))
    ring = pose[:3] + length * rim(model) @ rotation_matrix(*pose[3:]).T
    # Each of the four edges in the ring begins at a corner of the field of view.
    rays = [np.stack([pose[:3], ring[k]]) for k in range(0, len(ring), EDGE_STEPS)]
    return chained([np.concatenate([ring, ring[:1]]),
                    *(rays if model.lens.kind == PINHOLE else [])])


def chained(lines: Sequence[np.ndarray]) -> np.ndarray:
    """Return lines (M, 3) as one array, with a row of NaN between two lines."""
    gap = np.full((1, 3), np.nan)
    return np.concatenate([rows for line in lines for rows in (line, gap)])[:-1]


def draw_axis(axes: Axes, name: str, origin: np.ndarray, vector: np.ndarray) -> None:
    """Draw an axis of coordinates: arrow from origin (2,) along vector (2,), with its name."""
    halo = [patheffects.withStroke(linewidth=3.5, foreground='white')]
    axes.annotate('', origin + vector, origin, zorder=5, arrowprops={
        'arrowstyle': '-|>', 'color': INK, 'linewidth': 1.6, 'shrinkA': 0.0, 'shrinkB': 0.0,
        'path_effects': halo})
    axes.annotate(name, origin + vector, 9.0 * vector / np.hypot(*vector), color=INK, fontsize=12,
                  textcoords='offset points', ha='center', va='center', zorder=5,
                  path_effects=halo)


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
