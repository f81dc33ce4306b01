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
The pictures of an assessment: plan, coverage, depth error and perspective views of the room.

The installer's page has its own plan, which shows the distances to reference walls.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, PowerNorm, to_rgb
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Polygon
import numpy as np
from ocp_ros.report.assessment import Assessment
from ocp_ros.report.drawing.frustum_drawing import edges, reach
from ocp_ros.report.drawing.plan_marks import (
    apart,
    camera_colour,
    draw_headings,
    draw_letters,
    draw_numbers,
    draw_zones,
    unit_of,
    zone_legend,
)
from ocp_ros.report.drawing.room_drawing import (
    cut_open,
    draw_discs,
    eye_at,
    fit,
    HEIGHTS,
    heights_of,
    INK,
    PALE_INK,
    Room,
    room_of,
    some_of,
)
from ocp_ros.report.drawing.saved_pictures import save_figure
from ocp_ros.report.facts import count_sentence, SHARES
from scipy import ndimage

#: Colours of points seen by 0, 1, 2, and 3 or more cameras; they differ in hue and lightness.
COUNT_COLOURS = ('#d55e00', '#b7d4ea', '#5b9bd0', '#174f8f')
COUNT_NAMES = ('seen by no camera', 'by 1', 'by 2', 'by 3 or more')
#: Colours from small to large errors; without red and green.
ERROR_COLOURS = LinearSegmentedColormap.from_list(
    'errors', ['#f6e8d4', '#f2b96a', '#d55e00', '#7a2c02', '#2b0f00'])
#: Number of cells of the error map along the room's longer edge.
ERROR_CELLS = 48
#: Smallest and largest edge of a cell of the error map, metres.
ERROR_CELL_LIMITS = (0.1, 0.5)
#: Length of a drawn frustum, as a share of the room's longer edge.
FRUSTUM_SHARE = 0.15
#: Largest length of a drawn frustum, metres.
LONGEST_FRUSTUM = 1.2
#: Largest number of points in a picture of the report page, and in the installer's plan.
SHEET_POINTS = 16_000
PLAN_POINTS = 12_000
#: Inches between the centres of two letters of walls on the sheet.
LETTER_SPACING = 0.17
#: Edge of the cells that separate inside and outside of a room, metres.
INSIDE_CELL = 0.1
#: Metres above the floor and below the ceiling that the installer's plan leaves out.
FLOOR_LAYER = 0.15
CEILING_LAYER = 0.4
#: Size of letters and lines in the installer's plan, in multiples of those on the sheet.
PLAN_SCALE = 1.7
#: Distance of the walls' letters from their walls, as a share of the room's longer edge.
LETTER_SHARE = 0.055
#: Smallest length of a line whose distance is written beside it, as a share of that edge.
MEASURED_SHARE = 0.15
#: Longer edge of the installer's plan, and smallest length of its shorter edge, inches.
LONGER_EDGE = 10.0
LEAST_EDGE = 4.5


def room_for(assessed: Assessment) -> Room:
    """
    Prepare the room of a placement for drawing: wall A at the top, thinned, without the ceiling.

    :returns: a room whose ``colours`` (M, 1) are the numbers of the scene's points.
    """
    points = assessed.scene.points.astype(np.float64)
    some = some_of(len(points), SHEET_POINTS)
    return room_of(points[some] @ assessed.upright.T, some[:, None])


def coloured(room: Room, colours: np.ndarray) -> Room:
    """Return the room of :func:`room_for` in colours (N, 3) of the scene's points."""
    return room._replace(colours=colours[room.colours[:, 0]])


def shaded(room: Room, colours: np.ndarray) -> Room:
    """Return the coloured room, darker with the height, so that walls differ from the floor."""
    room = coloured(room, colours)
    dark = 1.0 - 0.12 * heights_of(room.points)[:, None]
    return room._replace(colours=np.clip(room.colours * dark, 0.0, 1.0))


def count_colours(assessed: Assessment) -> np.ndarray:
    """Return the colour of each point by the number of cameras that see it: (N, 3) RGB."""
    palette = np.array([to_rgb(colour) for colour in COUNT_COLOURS])
    return palette[np.minimum(assessed.counts, len(palette) - 1)]


def draw_room_plan(axes: Axes, room: Room, assessed: Assessment) -> None:
    """Draw the room from above with the walls' letters, the cameras and their ranges."""
    colours = HEIGHTS(heights_of(assessed.scene.points))[:, :3]
    outline = draw_discs(axes, coloured(room, 0.35 + 0.65 * colours), np.eye(3))
    frame, heights = assessed.upright[:2, :2], assessed.scene.bounds[:, 2].tolist()
    strength = min(1.0, 2.0 / np.sqrt(len(assessed.placement.cameras)))
    for number, placed in enumerate(assessed.placement.cameras):
        colour = camera_colour(number)
        seen = reach(placed.camera.model, placed.pose, heights)
        part = Polygon(seen @ frame.T, facecolor=(*to_rgb(colour), 0.2 * strength),
                       edgecolor=(*to_rgb(colour), 0.9 * strength), linewidth=1.0, zorder=3)
        axes.add_patch(part).set_clip_path(outline)
    _hide_outside(axes, room)
    _frame(axes, assessed, 0.1, room.points[:, :2])
    _draw_marks(axes, assessed, 1.0)


def _draw_marks(axes: Axes, assessed: Assessment, scale: float) -> None:
    """
    Draw walls with letters and ticks, zones and cameras on a plan.

    A side of the room that is mostly no wall is dashed. Letters of inner walls are moved away from
    cameras and other letters.

    :param scale: size of letters and lines, in multiples of those on the sheet.
    """
    (left, bottom), (right, top) = corners = _corners(assessed)
    sides = [((left, right), (top, top)), ((right, right), (top, bottom)),
             ((right, left), (bottom, bottom)), ((left, left), (bottom, top))]
    for wall, (x, y) in zip(assessed.walls, sides):
        axes.plot(x, y, color=INK, linewidth=0.9, linestyle='-' if wall.stands else (0, (3, 3)),
                  zorder=4)
    frame, places = assessed.upright[:2, :2], assessed.plan_positions
    longer = max(assessed.size)
    away = LETTER_SHARE * longer
    x, y = corners.mean(axis=0)
    letters = np.array([(x, top + away), (right + away, y), (x, bottom - away), (left - away, y)])
    style = {'zorder': 5, 'path_effects': [patheffects.withStroke(linewidth=2.5 * scale,
                                                                  foreground='white')]}
    draw_letters(axes, assessed.walls, letters, 10.0 * scale, **style)
    inner = assessed.references.inner
    beside = [frame @ (wall.at + 0.5 * away * wall.outward) for wall in inner]
    draw_letters(axes, inner, apart(
        np.array(beside).reshape(-1, 2), LETTER_SPACING * scale * unit_of(axes),
        np.concatenate([letters, places])), 7.0 * scale, **style)
    draw_zones(axes, assessed.objective.rig, frame, 3.8)
    draw_headings(axes, assessed.placement, places, 0.07 * longer * frame, 1.2 * scale)
    draw_numbers(axes, places, 7.0 * scale, float(np.prod(assessed.size)), letters, always=True)
    for axis, start, length in zip((axes.xaxis, axes.yaxis), corners[0], assessed.size):
        ticks = _ticks(length)
        axis.set_ticks(start + ticks, [f'{tick:g}' for tick in ticks])
    axes.tick_params(colors=PALE_INK, labelsize=6.5 * scale, length=2.0, pad=1.5)


def _ticks(length: float) -> np.ndarray:
    """Return about five round distances up to a length, metres."""
    steps = [0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0]
    step = steps[min(np.searchsorted(steps, length / 6.0), len(steps) - 1)]
    return np.arange(0.0, length + 1e-6, step)


def _hide_outside(axes: Axes, room: Room) -> None:
    """Cover the area outside the room with white, for example outside an L-shaped room."""
    flat = room.points[:, :2]
    low = flat.min(axis=0) - 4 * INSIDE_CELL
    cells = np.floor((flat - low) / INSIDE_CELL).astype(int)
    inside = np.zeros(cells.max(axis=0) + 5, dtype=bool)
    inside[tuple(cells.T)] = True
    ball = ndimage.iterate_structure(ndimage.generate_binary_structure(2, 1), 4)
    inside = ndimage.binary_fill_holes(ndimage.binary_closing(inside, ball))
    cover = np.ones((*inside.T.shape, 4))
    cover[..., 3] = 1.0 - np.minimum(ndimage.gaussian_filter(1.6 * inside.T, 0.7), 1.0)
    high = low + INSIDE_CELL * np.array(inside.shape)
    axes.imshow(cover, extent=(low[0], high[0], low[1], high[1]), origin='lower',
                interpolation='bilinear', zorder=3.5)


def _corners(assessed: Assessment) -> np.ndarray:
    """Return the corners of walls D and C, and B and A, in the plan's frame: (2, 2) metres."""
    top, right, bottom, left = (wall.offset for wall in assessed.walls)
    return np.array([[-left, -bottom], [right, top]])


def _frame(axes: Axes, assessed: Assessment, margin: float, *shown: np.ndarray) -> None:
    """Fit the axes to walls and cameras, and to other places (M, 2)."""
    fit(axes, np.concatenate([assessed.plan_positions, _corners(assessed), *shown]), margin)
    axes.spines[:].set_visible(False)


def draw_count_map(axes: Axes, room: Room, assessed: Assessment) -> None:
    """Draw the room from above, coloured by the number of cameras that see each point."""
    draw_discs(axes, shaded(room, count_colours(assessed)), np.eye(3), contrast=0.25)
    _small_map(axes, room, assessed)


def draw_error_map(axes: Axes, room: Room, assessed: Assessment) -> AxesImage:
    """
    Draw a map of the depth error in millimetres for each square metre of the plan.

    :returns: the image, for a colour bar.
    """
    pale = np.full((len(assessed.scene), 3), 0.88)
    draw_discs(axes, shaded(room, pale), np.eye(3), contrast=0.5)
    flat = assessed.scene.points.astype(np.float64) @ assessed.upright[:2].T
    low, size = flat.min(axis=0), np.ptp(flat, axis=0)
    edge = float(np.clip(size.max() / ERROR_CELLS, *ERROR_CELL_LIMITS))
    shape = np.floor(size / edge).astype(int) + 1
    cell = np.ravel_multi_index(tuple(np.floor((flat - low) / edge).astype(int).T), shape)
    sums = np.bincount(cell, assessed.error_by_point, minlength=shape.prod()).reshape(shape)
    density = 1000.0 * sums / edge ** 2
    most = max(float(np.percentile(density[density > 0.0], 99.0)) if density.any() else 0.0, 1.0)
    # Cells below a hundredth of the maximum stay transparent, so that the room is visible.
    image = axes.imshow(np.ma.masked_less(density.T, 0.01 * most), cmap=ERROR_COLOURS,
                        norm=PowerNorm(0.5, 0.0, most), origin='lower', zorder=2,
                        extent=(low[0], low[0] + shape[0] * edge, low[1],
                                low[1] + shape[1] * edge))
    _small_map(axes, room, assessed)
    return image


def _small_map(axes: Axes, room: Room, assessed: Assessment) -> None:
    """Fit the axes of a map to the room, and draw the cameras' numbers."""
    axes.set_xticks([])
    axes.set_yticks([])
    _frame(axes, assessed, 0.02, room.points[:, :2])
    draw_numbers(axes, assessed.plan_positions, 5.0, float(np.prod(assessed.size)))


def draw_look(axes: Axes, room: Room, assessed: Assessment, azimuth: float) -> None:
    """
    Draw the room in perspective without the front walls, coloured by the number of cameras.

    :param azimuth: radians, direction of the viewer in the frame of the plan: 0 is to the right.
    """
    room = shaded(room, count_colours(assessed))
    eye = eye_at(room.points, azimuth)
    part = cut_open(room, eye.view)
    outline = draw_discs(axes, part, eye.view, eye, 0.5)
    floor = float(np.percentile(room.points[:, 2], 2.0))
    longest = min(FRUSTUM_SHARE * float(np.ptp(room.points, axis=0).max()), LONGEST_FRUSTUM)
    places = assessed.positions @ assessed.upright.T
    shown = [outline.get_xy(), eye(places)]
    for number, (placed, place) in enumerate(zip(assessed.placement.cameras, places)):
        model = placed.camera.model
        cone = eye(edges(model, placed.pose, min(longest, model.max_range)) @ assessed.upright.T)
        shown.append(cone)
        axes.plot(*cone.T, color=camera_colour(number), linewidth=0.7, zorder=4)
        axes.plot(*eye(np.stack([place, [*place[:2], floor]])).T, color=INK, linewidth=0.6,
                  linestyle=(0, (2, 2)), zorder=3)
    fit(axes, np.concatenate(shown), 0.02)
    axes.set_axis_off()
    # The outline of a room in perspective fills about half of the rectangle around it.
    draw_numbers(axes, eye(places), 5.0, 0.5 * float(np.prod(np.ptp(outline.get_xy(), axis=0))))


def draw_floor_plan(path: Path, assessed: Assessment) -> None:
    """Write the installer's plan as PNG."""
    save_figure(floor_plan_of(assessed), path, dpi=100)


def floor_plan_of(assessed: Assessment) -> Figure:
    """Draw the installer's plan: the room, wall A at the top, cameras and measured distances."""
    scene = assessed.scene
    low, high = scene.bounds[:, 2]
    points = scene.points[(scene.points[:, 2] > low + FLOOR_LAYER)
                          & (scene.points[:, 2] < high - CEILING_LAYER)]
    flat = points[::max(len(points) // PLAN_POINTS, 1), :2] @ assessed.upright[:2, :2].T
    scale = LONGER_EDGE / max(assessed.size)
    figure = Figure(figsize=[max(scale * edge, LEAST_EDGE) for edge in assessed.size], dpi=100,
                    facecolor='white')
    axes = figure.add_axes((0.05, 0.08, 0.9, 0.9))
    axes.scatter(*flat.T, s=2.0, color=PALE_INK, alpha=0.4, linewidths=0.0)
    _frame(axes, assessed, 0.1)
    _draw_distances(axes, assessed)
    _draw_marks(axes, assessed, PLAN_SCALE)
    _draw_axes(axes, assessed, 0.1 * max(assessed.size))
    explained = zone_legend(assessed.objective.rig)
    if explained:
        figure.legend(explained.values(), explained.keys(), loc='lower center', frameon=False,
                      ncols=len(explained), fontsize=10, labelcolor=INK)
    return figure


def draw_curve(path: Path, found: Mapping[str, Any]) -> None:
    """
    Draw shares and depth error against the number of cameras as PNG.

    :param found: with the data of counted cameras, ``curve`` and ``count``.
    """
    rows, count = found['curve'], found['count']
    figure = Figure(figsize=(7.0, 4.5), dpi=100, facecolor='white')
    axes = figure.add_subplot()
    cameras = [row['cameras'] for row in rows]
    for (name, (_, label)), style in zip(SHARES.items(), ('o-', 's--', '^:')):
        axes.plot(cameras, [100.0 * row[f'share_{name}'] for row in rows], style,
                  color=INK if name == count['by'] else PALE_INK, label=label)
    axes.axhline(100.0 * count['target'], color=INK, lw=0.8, ls=':')
    axes.set(xlabel='cameras', ylabel='per cent', xticks=cameras, ylim=(0.0, 102.0))
    error = axes.twinx()
    error.plot(cameras, [row['depth_error'] for row in rows], 'x-', color='tab:red',
               label='depth error')
    error.set_ylim(bottom=0.0)
    error.set_ylabel('depth error (m)', color='tab:red')
    axes.legend(loc='center right', fontsize=8)
    axes.set_title(count_sentence(count), fontsize=9)
    figure.tight_layout()
    save_figure(figure, path, dpi=100)


def _draw_axes(axes: Axes, assessed: Assessment, length: float) -> None:
    """Draw the coordinate axes at a corner of the room, of a length in metres."""
    frame = assessed.upright[:2, :2]
    corner, origin = frame @ assessed.corner.at, assessed.frame.to_map(np.zeros(3))
    # Move the axes from the corner into the room.
    corner = corner + 0.15 * length * np.sign(_corners(assessed).mean(axis=0) - corner)
    for name, unit in zip('xyz', np.eye(3)):
        way = assessed.frame.to_map(unit) - origin
        way = frame @ way[:2] / np.linalg.norm(way)
        if np.linalg.norm(way) < 0.5:
            continue
        axes.annotate('', corner + length * way, corner, zorder=5, arrowprops={
            'arrowstyle': '-|>', 'color': PALE_INK, 'lw': 1.5, 'shrinkA': 0.0, 'shrinkB': 0.0})
        x, y = corner + 1.15 * length * way
        axes.text(x, y, name, fontsize=10, color=PALE_INK, ha='center', va='center', zorder=5)


def _draw_distances(axes: Axes, assessed: Assessment) -> None:
    """Draw the measured distances: dashed lines, with the numbers where these are readable."""
    frame, longer = assessed.upright[:2, :2], max(assessed.size)
    places = assessed.plan_positions
    # Places of cameras and written distances, which must not be covered.
    taken = places
    for place, distances in zip(places, assessed.references.distances):
        for distance in distances:
            at = frame @ distance.at
            axes.plot(*np.stack([place, at]).T, color=INK, lw=0.8, ls=(0, (2, 2)), zorder=4)
            middle = 0.4 * place + 0.6 * at
            free = np.linalg.norm(taken - middle, axis=1).min() > 0.5 * MEASURED_SHARE * longer
            if free and np.linalg.norm(at - place) > MEASURED_SHARE * longer:
                turn = np.rad2deg(np.arctan2(*(at - place)[::-1]))
                axes.text(middle[0], middle[1], f'{100.0 * distance.away:.0f} cm', fontsize=8,
                          color=INK, ha='center', va='center', zorder=4.5,
                          rotation=(turn + 90.0) % 180.0 - 90.0,
                          bbox={'facecolor': 'white', 'edgecolor': 'none', 'pad': 1.0})
                taken = np.vstack([taken, middle])
